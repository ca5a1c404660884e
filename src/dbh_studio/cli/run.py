"""`dbh-studio run`: a plot in, an inventory out, without a browser."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from typing import Any

from dbh_studio.cli.common import (
    add_cloud_options,
    add_mask_options,
    add_photo_options,
    add_relocation_option,
    add_settings_options,
    counted,
    mask_request,
    path_argument,
    photo_request,
    plain,
    progress_for,
    settings_changes,
    unscaled_error,
)
from dbh_studio.cli.mask_options import add_making_options, ladder_request
from dbh_studio.errors import ProjectExistsError, ProjectLockedError, SettingError, UnscaledCloudError


def add_commands(commands: Any) -> None:
    """Register the command."""
    run = commands.add_parser(
        "run",
        help="read a plot, find and measure its trunks, write the inventory",
        description="Read a plot, find and measure its trunks, and write DIR/NAME.csv and the saved plot DIR/NAME.dbh, "
        "which `dbh-studio open` shows. A saved plot is measured again with the trunks it has.",
    )
    run.add_argument("plot", type=path_argument, help="a cloud, a mesh, a folder of them, or a saved NAME.dbh")
    run.add_argument(
        "--out",
        type=path_argument,
        required=True,
        metavar="DIR",
        help="folder for the inventory and the saved plot; made where it is not there",
    )
    add_cloud_options(run)
    add_relocation_option(run)
    add_settings_options(run)
    add_photo_options(run)
    add_mask_options(run)
    add_making_options(run)
    run.add_argument("--name", default="", help="what to call the plot; the file's name by default")
    run.add_argument(
        "--overwrite",
        action="store_true",
        help="replace the saved plot and the table of an earlier run, and edits made in them",
    )
    run.add_argument(
        "--steps",
        type=path_argument,
        metavar="FILE",
        help="write what each step of the search kept and dropped, and why: .json, or .csv with a line per cluster",
    )
    run.add_argument("--json", action="store_true", help="print the result as JSON")
    run.add_argument("--quiet", action="store_true", help="no progress, no summary")
    run.set_defaults(command=run_plot)


def run_plot(options: argparse.Namespace) -> int:
    """Run the whole chain."""
    from dbh_studio.app import plot_run
    from dbh_studio.app.search_report import check_report, write_search_report

    changes = settings_changes(options)
    if options.steps is not None:
        check_report(options.steps, overwrite=options.overwrite)
    photos = photo_request(options)
    masks = ladder_request(options) or mask_request(options)
    if photos is not None and options.scale is not None:
        raise SettingError("Both --scale and markers in photos were given.", "Leave one of them away.")
    try:
        with progress_for(options) as progress:
            result = plot_run.run_plot(
                options.plot,
                options.out,
                scale=options.scale,
                up=options.up,
                settings=changes,
                photos=photos,
                masks=masks,
                plot_id=options.name,
                relocate=options.cloud,
                overwrite=options.overwrite,
                needs_search=options.steps is not None,
                progress=progress,
            )
    except UnscaledCloudError:
        raise unscaled_error(has_photos=masks is not None) from None
    except ProjectExistsError as error:
        remedy = "Give `run` that plot itself to measure it again, choose another --out or --name, or add --overwrite."
        raise ProjectExistsError(error.problem, remedy) from None
    except ProjectLockedError as error:
        raise ProjectLockedError(error.problem, "Close it there, or choose another --out.") from None
    inventory = result.session.inventory()
    try:
        if options.steps is not None:
            write_search_report(options.steps, result.session)
    finally:
        result.session.close()
    if options.json:
        print(json.dumps(_summary(result, inventory), indent=2))
    elif not options.quiet:
        for note in result.notes:
            print(f"note: {plain(note)}", file=sys.stderr)
        print(plain(_table(inventory)))
        n_measured = len(inventory) - inventory.n_refused
        print(plain(f"\n{counted(len(inventory), 'stem')}, {n_measured} with a diameter: {result.csv_path}"))
        print(plain(f"Look at them: dbh-studio open {shlex.quote(str(result.project_dir))}"))
    return 0


def _summary(result: Any, inventory: Any) -> dict[str, Any]:
    """What ``--json`` prints; the names in it stay."""
    scale = result.session.document.scale
    return {
        "plot": result.session.document.plot_id,
        "csv": str(result.csv_path),
        "project": str(result.project_dir),
        "n_stems": len(inventory),
        "n_measured": len(inventory) - inventory.n_refused,
        "n_refused": inventory.n_refused,
        "metres_per_unit": scale.metres_per_unit,
        "scale_source": scale.source,
        "scale_err_pct": _rounded(_percent(scale.standard_error, scale.metres_per_unit), 4),
        "notes": list(result.notes),
        "seconds": {step: round(seconds, 3) for step, seconds in result.timings_s.items()},
        "stems": [
            {
                "stem_id": row.stem_id,
                "dbh_cm": _rounded(row.dbh_cm, 2),
                "x_m": _rounded(row.x_m, 3),
                "y_m": _rounded(row.y_m, 3),
                "quality": row.quality,
                "reason": row.reason,
            }
            for row in inventory
        ],
    }


def _percent(part: float | None, whole: float) -> float | None:
    return None if part is None else 100 * part / whole


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def _table(inventory: Any) -> str:
    lines = [f"{'stem':>5} {'DBH cm':>7} {'quality':<8} {'arc':>4}  remark"]
    for row in inventory:
        diameter = "-" if row.dbh_cm is None else f"{row.dbh_cm:.1f}"
        arc = "-" if row.coverage_deg is None else f"{row.coverage_deg:.0f}"
        remark = row.reason or row.note or ""
        lines.append(f"{row.stem_id:>5} {diameter:>7} {row.quality or '-':<8} {arc:>4}  {remark}".rstrip())
    return "\n".join(lines)
