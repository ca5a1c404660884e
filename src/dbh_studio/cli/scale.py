"""`dbh-studio scale`: what the scale of a plot rests on, and setting it by markers, known lengths or a number."""

from __future__ import annotations

import argparse
import json
import math
from typing import TYPE_CHECKING, Any

from dbh_studio.cli.common import (
    add_photo_options,
    add_relocation_option,
    finite_number,
    path_argument,
    photo_request,
    plain,
    progress_for,
    scale_argument,
)
from dbh_studio.errors import SettingError

if TYPE_CHECKING:
    from dbh_studio.app.session import Session
    from dbh_studio.core.bars import BarRole, ScaleReport

_BAR = ("X", "Y", "Z", "X", "Y", "Z", "M")


def add_commands(commands: Any) -> None:
    """Register the command."""
    scale = commands.add_parser(
        "scale",
        help="report the scale of a plot, or set it by markers, known lengths or a number",
        description="Report what the scale of a plot rests on, or set it. A saved plot (NAME.dbh) keeps the new scale "
        "and its trunks; of a cloud the scale is only reported, for --scale of `dbh-studio run`.",
    )
    scale.add_argument("plot", type=path_argument, help="a saved NAME.dbh, or a cloud")
    add_photo_options(scale)
    hand = scale.add_argument_group("scale from known lengths, coordinates as in the file")
    hand.add_argument("--bar", type=finite_number, nargs=7, action="append", default=[], metavar=_BAR,
                      help="two points and the true distance between them; may be given several times")  # fmt: skip
    hand.add_argument("--check-bar", type=finite_number, nargs=7, action="append", default=[], metavar=_BAR,
                      help="a bar that only tests the scale")  # fmt: skip
    hand.add_argument("--forget", action="append", default=[], metavar="NAME", help="forget a known length")
    number = scale.add_argument_group("scale by number")
    number.add_argument("--factor", type=scale_argument, metavar="M_PER_UNIT", help="metres per unit, or a unit's name")
    number.add_argument(
        "--camera-height", type=finite_number, metavar="M", help="how high above the ground the camera was (weak)"
    )
    number.add_argument(
        "--baseline", nargs=3, metavar=("PHOTO", "PHOTO", "M"), help="distance between two photos (weak)"
    )
    scale.add_argument(
        "--frame-from", metavar="NAME", help="let this marker, lying flat, say where up, north and the origin are"
    )
    scale.add_argument("--dry-run", action="store_true", help="report only; change nothing")
    add_relocation_option(scale)
    scale.add_argument("--json", action="store_true", help="print the result as JSON")
    scale.add_argument("--quiet", action="store_true", help="no progress")
    scale.set_defaults(command=scale_plot)


def scale_plot(options: argparse.Namespace) -> int:
    """Set what was asked for, then report."""
    from dbh_studio.app.opening import open_plot
    from dbh_studio.io.project import is_project

    photos = photo_request(options)
    _check_one_way(options, photos)
    is_kept = is_project(options.plot) and not options.dry_run
    with progress_for(options) as progress:
        session = open_plot(
            options.plot, relocate=options.cloud, read_only=not is_kept, background_save=False, progress=progress
        )
        if not is_kept:
            session = _loose(session)
        try:
            report = _measured(session, options, photos, progress)
            if options.frame_from is not None:
                _take_frame(session, options.frame_from)
            session.flush()
        finally:
            session.close()
    summary = _summary(session, report)
    print(json.dumps(summary, indent=2) if options.json else plain(_text(summary)))
    return 0


def _loose(session: Session) -> Session:
    """The same plot, kept nowhere: what is tried on it is not saved."""
    from dbh_studio.app.session import Session

    return Session(session.cloud, session.document, data_check=session.data_check, notes=session.notes)


def _check_one_way(options: argparse.Namespace, photos: Any) -> None:
    by_bars = bool(options.bar or options.check_bar or options.forget)
    by_path = options.camera_height is not None or options.baseline is not None
    markers = photos is not None and not by_path
    if sum((markers and not by_bars, options.factor is not None, by_path)) > 1 or (by_bars and options.factor):
        raise SettingError("The scale is given in more than one way.", "Choose markers, lengths, or a number.")


def _measured(session: Session, options: argparse.Namespace, photos: Any, progress: Any) -> ScaleReport | None:
    """Do what was asked for; the report of the lengths, where there are any."""
    import numpy as np

    from dbh_studio.app import commands, scaling
    from dbh_studio.app.opening import scale_from
    from dbh_studio.app.photo_scale import PhotoRequest, add_photos, scale_by_photos

    if options.factor is not None:
        session.do(commands.set_scale(scale_from(options.factor)))
    elif options.camera_height is not None or options.baseline is not None:
        posed = add_photos(session, photos or PhotoRequest(), progress=progress).posed
        session.do(commands.set_scale(_weak_scale(session, posed, options)))
    elif photos is not None:
        _add_bars(session, options)
        search = scale_by_photos(session, photos, progress=progress)
        if not len(session.document.evidence.bars):
            return search.report
    elif options.bar or options.check_bar or options.forget:
        _add_bars(session, options)
        session.do(scaling.scale_from_evidence(session.document))
    evidence = session.document.evidence
    return evidence.report(np.array(session.document.up_direction)) if len(evidence) else None


def _add_bars(session: Session, options: argparse.Namespace) -> None:
    from dbh_studio.app import commands
    from dbh_studio.core.scale_evidence import MarkedPoint, ScaleBar

    for name in options.forget:
        session.do(commands.remove_length(name))
    roles: tuple[tuple[BarRole, str, list[list[float]]], ...] = (
        ("control", "Bar", options.bar),
        ("check", "Check bar", options.check_bar),
    )
    for role, stem, bars in roles:
        for values in bars:
            x, y, z, x2, y2, z2, length_m = values
            ends = MarkedPoint((x, y, z)), MarkedPoint((x2, y2, z2))
            name = session.document.evidence.free_name(stem)
            session.do(commands.add_length(ScaleBar(name, ends, length_m, role=role)))


def _weak_scale(session: Session, posed: Any, options: argparse.Namespace) -> Any:
    import numpy as np

    from dbh_studio.app import scaling

    if options.camera_height is not None:
        up = np.array(session.document.up_direction)
        return scaling.scale_from_camera_height(posed, session.cloud, up, options.camera_height)
    first, second, text = options.baseline
    try:
        for name in (first, second):
            posed.by_name(name)
        distance_m = float(text)
    except KeyError as error:
        raise SettingError(f"There is no photo {error}.", f"The first is called {posed.images[0].name}.") from None
    except ValueError:
        raise SettingError(f"--baseline: {text!r} is not a distance in metres.") from None
    return scaling.scale_from_baseline(posed, first, second, distance_m)


def _take_frame(session: Session, name: str) -> None:
    from dbh_studio.app import scaling

    evidence = session.document.evidence
    square = next((each for each in evidence.squares if each.name == name), None)
    if square is None:
        known = ", ".join(each.name for each in evidence.squares) or "none"
        raise SettingError(f"There is no marker {name!r} in this plot.", f"Known: {known}.")
    session.do(scaling.frame_from_square(square, session.cloud))


# ---- the report


def _summary(session: Session, report: ScaleReport | None) -> dict[str, Any]:
    """What ``--json`` prints; the names in it stay."""
    document = session.document
    scale = document.scale
    error = scale.standard_error
    summary: dict[str, Any] = {
        "plot": document.plot_id,
        "metres_per_unit": scale.metres_per_unit if scale.is_known else None,
        "standard_error": error,
        "scale_err_pct": None if error is None else 100 * error / scale.metres_per_unit,
        "scale_source": scale.source,
        "is_weak": scale.is_weak,
        "verdict": None,
        "lengths": [],
    }
    if report is not None:
        verdict = report.verdict
        summary["verdict"] = {
            "level": verdict.level, "code": verdict.code, "message": verdict.message, "remedy": verdict.remedy,
        }  # fmt: skip
        summary["horizontal_over_vertical"] = report.horizontal_over_vertical
    residuals = {residual.name: residual for residual in report.residuals} if report is not None else {}
    summary["lengths"] = [_length_summary(length, residuals.get(length.name)) for length in document.evidence]
    return summary


def _length_summary(length: Any, residual: Any) -> dict[str, Any]:
    points = length.corners if hasattr(length, "corners") else length.ends
    return {
        "name": length.name,
        "kind": "marker" if hasattr(length, "corners") else "bar",
        "role": length.role,
        "length_m": length.length_m,
        "measured_m": None if residual is None else residual.measured_m,
        "residual_pct": None if residual is None else residual.residual_pct,
        "lie": None if residual is None else residual.lie,
        "n_views": getattr(length, "n_views", None),
        "points_src": [list(point.xyz_src) for point in points],
        "views": sorted({sight.image for point in points for sight in point.sights}),
    }


def _text(summary: dict[str, Any]) -> str:
    if summary["metres_per_unit"] is None:
        lines = [f"{summary['plot']}: the scale is not known."]
    else:
        error = "" if summary["scale_err_pct"] is None else f" ± {summary['scale_err_pct']:.2f} %"
        lines = [f"{summary['plot']}: {summary['metres_per_unit']:.6g} m per unit{error} ({summary['scale_source']})"]
    if summary["is_weak"]:
        lines.append("This is a weak scale: measure a marker or a known distance where you can.")
    if summary["verdict"] is not None:
        lines.append(f"{summary['verdict']['message']} {summary['verdict']['remedy']}".strip())
    for length in summary["lengths"]:
        measured, percent = length["measured_m"], length["residual_pct"]
        told = "" if measured is None or math.isnan(measured) else f", measures {measured:.4f} m ({percent:+.2f} %)"
        views = "" if length["n_views"] is None else f", {length['n_views']} photos"
        lines.append(f"  {length['name']} ({length['role']}): {length['length_m']:g} m{told}{views}")
    return "\n".join(lines)
