"""`dbh-studio transfer`: the trunks of a photo plot carried to a LiDAR cloud, and both diameters side by side."""

from __future__ import annotations

import argparse
import json
import math
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dbh_studio.cli.common import (
    UP_AXES,
    add_relocation_option,
    counted,
    finite_number,
    path_argument,
    plain,
    progress_for,
    scale_argument,
)
from dbh_studio.errors import SettingError

if TYPE_CHECKING:
    from dbh_studio.app.transfer_plot import TransferReport, TransferRequest
    from dbh_studio.app.transfer_walks import WalkFile


def add_commands(commands: Any) -> None:
    """Register the command."""
    transfer = commands.add_parser(
        "transfer",
        help="carry the trunks of a photo plot to a LiDAR cloud, and compare the diameters",
        description="Lay a photo plot on a LiDAR cloud of the same place, carry its trunks over, and write the plot "
        "DIR/NAME_lidar.dbh, whose trunks have the same numbers, and DIR/NAME_lidar_comparison.csv with both "
        "diameters of each tree. Without trajectories the clouds are laid on each other by their stems.",
    )
    transfer.add_argument("photo", type=path_argument, metavar="PHOTO.dbh", help="a saved plot with trunks")
    transfer.add_argument("lidar", type=path_argument, metavar="LIDAR", help="a cloud, or a saved plot of one")
    walks = transfer.add_argument_group(
        "trajectories", "TUM, KITTI, a table with a header, or poses of photos; each in the frame of its cloud."
    )
    for name, whose, otherwise in (
        ("photo", "camera", "; without it the photos of the plot"),
        ("lidar", "scanner", ""),
    ):
        walks.add_argument(f"--{name}-trajectory", type=path_argument, metavar="FILE",
                           help=f"where the {whose} was{otherwise}")  # fmt: skip
        walks.add_argument(f"--{name}-times", type=path_argument, metavar="FILE",
                           help="one time a line, where the trajectory has none")  # fmt: skip
        walks.add_argument(f"--{name}-rate", type=finite_number, metavar="HZ",
                           help="poses or frames a second, where there are no times")  # fmt: skip
    walks.add_argument("--clock-offset", type=finite_number, metavar="S",
                       help="scanner's clock minus the camera's; searched for without")  # fmt: skip
    fit = transfer.add_argument_group("fit")
    kind = fit.add_mutually_exclusive_group()
    kind.add_argument("--similarity", action="store_true", help="turn, shift and scale; this is the default")
    kind.add_argument("--rigid", action="store_true", help="turn and shift only")
    fit.add_argument("--refine", action="store_true", help="then fit stems and ground of both clouds on each other")
    fit.add_argument("--max-distance", type=finite_number, default=0.2, metavar="M",
                     help="how far a label is carried; 0.2 as in the paper")  # fmt: skip
    transfer.add_argument("--set-scale", action="store_true",
                          help="give the photo plot the LiDAR's scale; and find trunks if it has none")  # fmt: skip
    transfer.add_argument("--lidar-scale", type=scale_argument, metavar="M_PER_UNIT",
                          help="metres per unit of the LiDAR file, or a unit's name, if it does not tell")  # fmt: skip
    transfer.add_argument("--lidar-up", choices=UP_AXES, help="which way is up in the LiDAR file")
    transfer.add_argument("--out", type=path_argument, metavar="DIR", help="where to; beside PHOTO.dbh without")
    transfer.add_argument("--overwrite", action="store_true", help="replace what an earlier transfer left, edits too")
    add_relocation_option(transfer)
    transfer.add_argument("--json", action="store_true", help="print the result as JSON")
    transfer.add_argument("--quiet", action="store_true", help="no progress, no summary")
    transfer.set_defaults(command=transfer_trunks)


def transfer_trunks(options: argparse.Namespace) -> int:
    """Carry, compare, and set the scale where that was asked for."""
    from dbh_studio.app.opening import open_plot
    from dbh_studio.app.transfer_plot import apply_scale, check_outputs, photo_side, transfer_plot
    from dbh_studio.io.project import is_project

    if not is_project(options.photo):
        raise SettingError(
            f"{options.photo.name} is no saved plot.", "Make one and find its trunks first, with `dbh-studio run`."
        )
    if options.rigid and options.set_scale:
        raise SettingError("A rigid fit gives no scale.", "Leave --rigid or --set-scale away.")
    request = _request(options)
    check_outputs(request)
    with progress_for(options) as progress:
        session = open_plot(
            options.photo, relocate=options.cloud, read_only=not options.set_scale, background_save=False
        )
        try:
            report = transfer_plot(*photo_side(session), request, progress=progress)
            if options.set_scale:
                apply_scale(session, report)
                session.flush()
        finally:
            session.close()
    if options.json:
        print(json.dumps(_summary(report, is_set=options.set_scale), indent=2))
    elif not options.quiet:
        for note in report.notes:
            print(f"note: {plain(note)}", file=sys.stderr)
        print(plain(_text(report, is_set=options.set_scale)))
    return 0


def _request(options: argparse.Namespace) -> TransferRequest:
    from dbh_studio.app.transfer_plot import TransferRequest, plot_file_name

    return TransferRequest(
        options.lidar,
        options.out if options.out is not None else options.photo.absolute().parent,
        plot_file_name(options.photo),
        photo_walk=_walk(options, "photo"),
        lidar_walk=_walk(options, "lidar"),
        clock_offset_s=options.clock_offset,
        with_scale=not options.rigid,
        refine=options.refine,
        reach_m=options.max_distance,
        set_scale=options.set_scale,
        lidar_scale=options.lidar_scale,
        lidar_up=options.lidar_up,
        overwrite=options.overwrite,
    )


def _walk(options: argparse.Namespace, name: str) -> WalkFile | None:
    from dbh_studio.app.transfer_walks import WalkFile

    path: Path | None = getattr(options, f"{name}_trajectory")
    times, rate = getattr(options, f"{name}_times"), getattr(options, f"{name}_rate")
    if path is None and (times is not None or rate is not None):
        option = f"--{name}-times" if times is not None else f"--{name}-rate"
        raise SettingError(f"{option} was given without a trajectory.", f"Say which: --{name}-trajectory FILE.")
    return None if path is None else WalkFile(path, times, rate)


# ---- the report


def _known(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, digits)


def _summary(report: TransferReport, *, is_set: bool) -> dict[str, Any]:
    """What ``--json`` prints; the names in it stay."""
    from dataclasses import asdict

    from dbh_studio.app.transfer_report import COMPARISON_DIGITS, summary_of

    placed = report.lidar_from_photo
    scale = report.scale
    trees = [
        {name: _known(value, COMPARISON_DIGITS[name]) if name in COMPARISON_DIGITS else value
         for name, value in asdict(tree).items()}
        for tree in report.trees
    ]  # fmt: skip
    return {
        "project": str(report.project_dir),
        "csv": str(report.csv_path),
        "method": report.method,
        "n_pairs": report.n_pairs,
        "rms_m": _known(report.rms_m, 4),
        "surface_rms_m": _known(report.surface_rms_m, 4),
        "error_m": _known(report.error_m, 4),
        "clock_offset_s": _known(report.clock_offset_s, 4),
        "covered": round(report.covered, 4),
        "lidar_from_photo": {
            "rotation": placed.rotation.tolist(), "translation": placed.translation.tolist(), "scale": placed.scale,
        },
        "scale": None if scale is None else {
            "metres_per_unit": scale.metres_per_unit,
            "standard_error": scale.standard_error,
            "change_pct": None if report.scale_change is None else round(100 * report.scale_change, 4),
            "is_set": is_set,
        },
        "photo_scale": report.photo_scale,
        "lost": list(report.lost),
        "summary": {name: _known(value, 3) for name, value in asdict(summary_of(report.trees)).items()},
        "trees": trees,
        "notes": list(report.notes),
    }  # fmt: skip


def _text(report: TransferReport, *, is_set: bool) -> str:
    from dbh_studio.app.transfer_report import fit_text, scale_text, summary_of, summary_text

    lines = [fit_text(report)]
    if report.scale is not None:
        line = scale_text(report.scale, report.scale_change)
        lines.append(f"{line} The photo plot has it now." if is_set else line)
    lines += ["", f"{'stem':>5} {'photo cm':>9} {'LiDAR cm':>9} {'diff cm':>8} {'diff %':>7} {'apart cm':>8} "
              f"{'points':>8}  remark"]  # fmt: skip
    for tree in report.trees:
        cells = (
            _cell(tree.dbh_photo_cm, 9, ".1f"),
            _cell(tree.dbh_lidar_cm, 9, ".1f"),
            _cell(tree.difference_cm, 8, "+.1f"),
            _cell(tree.difference_pct, 7, "+.1f"),
            _cell(tree.centres_apart_cm, 8, ".1f"),
        )
        lines.append(f"{tree.stem_id:>5} {' '.join(cells)} {tree.n_points_lidar:>8}  {tree.remark}".rstrip())
    n_over = sum(tree.n_points_lidar > 0 for tree in report.trees)
    lines += [
        "",
        summary_text(summary_of(report.trees)),
        f"{counted(n_over, 'trunk')} of {len(report.trees)} carried: {report.csv_path}",
        f"Look at them: dbh-studio open {shlex.quote(str(report.project_dir))}",
    ]
    return "\n".join(lines)


def _cell(value: float | None, width: int, form: str) -> str:
    return f"{'-' if value is None else format(value, form):>{width}}"
