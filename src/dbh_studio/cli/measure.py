"""`dbh-studio measure`: stems that are already cut out."""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from dbh_studio.cli.common import (
    add_cloud_options,
    add_settings_options,
    counted,
    finite_number,
    path_argument,
    plain,
    progress_for,
    settings_changes,
    unscaled_error,
)
from dbh_studio.errors import FileError, SettingError, StudioError, UnscaledCloudError

if TYPE_CHECKING:
    from dbh_studio.core.arrays import Float64
    from dbh_studio.core.dbh import DbhEstimate, Refusal
    from dbh_studio.core.protocols import Protocol
    from dbh_studio.core.stem_profile import ProfilePoint
    from dbh_studio.settings import MeasureSettings

PROFILE_COLUMNS = ("file", "stem_id", "height_m", "dbh_cm", "dbh_lo_cm", "dbh_hi_cm", "coverage_deg", "reason")
COLUMNS = (
    "file", "stem_id", "tag", "x_m", "y_m", "dbh_cm", "dbh_lo_cm", "dbh_hi_cm", "dbh_method", "dbh_definition",
    "dbh_tape_cm", "dbh_tape_lo_cm", "dbh_tape_hi_cm", "dbh_curve_cm", "dbh_curve_lo_cm", "dbh_curve_hi_cm",
    "dbh_area_cm", "dbh_area_lo_cm", "dbh_area_hi_cm", "hom_m", "breast_height_m", "base", "along", "above",
    "coverage_deg", "max_gap_deg", "rmse_mm", "n_points", "lean_deg", "taper_cm_per_m",
    "quality", "reason", "remedy", "flags", "corrections",
    "shrinkage_cm", "circle_cm", "fourier_cm", "ellipse_cm", "bspline_cm",
)  # fmt: skip


def add_commands(commands: Any) -> None:
    """Register the command."""
    measure = commands.add_parser(
        "measure",
        help="measure stems that are already cut out, one file each, or those of a saved plot",
        description="Measure stems that are already cut out, one file each, or all stems of a saved plot as it says, "
        "and print a CSV table. A file that cannot be read is reported and the others are measured all the same "
        "(status 1; 3 where a scale is missing). A stem that cannot be measured is no error: its row says why.",
    )
    measure.add_argument(
        "stems", type=path_argument, nargs="+", metavar="STEM", help="a cloud of one stem, or a saved NAME.dbh"
    )
    measure.add_argument(
        "--csv", type=path_argument, metavar="OUT", help="write the table there instead of printing it"
    )
    measure.add_argument(
        "--ground-z",
        type=finite_number,
        metavar="M",
        help="height of the ground in the files, metres; 0 where z is already a height; without it the ground "
        "is each stem's own lowest point",
    )
    measure.add_argument(
        "--profile",
        type=path_argument,
        metavar="FILE",
        help="also write the diameters every 10 cm along each stem there, as CSV",
    )
    add_cloud_options(measure)
    add_settings_options(measure, only_measure=True)
    measure.add_argument("--json", action="store_true", help="print JSON")
    measure.add_argument("--quiet", action="store_true", help="no progress")
    measure.set_defaults(command=measure_files)


def measure_files(options: argparse.Namespace) -> int:
    """Measure each file; one that cannot be read is reported and the others go on."""
    from dbh_studio.settings import Settings

    changes = settings_changes(options, only_measure=True).get("measure", {})
    settings = Settings().measure.changed(**changes)
    if options.csv is not None:
        from dbh_studio.io.inventory_csv import check_not_source

        check_not_source(options.csv, options.stems)
    if options.profile is not None:
        from dbh_studio.io.inventory_csv import check_not_source

        check_not_source(options.profile, options.stems)
    rows, errors, profile = [], [], []
    with progress_for(options) as progress:
        for number, path in enumerate(options.stems):
            progress(number / len(options.stems), path.name)
            found, error, along = _rows(path, options, settings, changes)
            rows += found
            profile += along
            if error is not None:
                errors.append(error)
                progress.finish()
                told = error if isinstance(error, FileError) else f"{path.name}: {error}"
                print(f"dbh-studio: {plain(str(told))}", file=sys.stderr)
    _write(rows, options)
    if options.profile is not None:
        _write_csv(options.profile, _csv(profile, PROFILE_COLUMNS), option="--profile")
    if any(isinstance(error, UnscaledCloudError) for error in errors):
        return 3
    return 1 if errors else 0


def _rows(
    path: Path, options: argparse.Namespace, settings: MeasureSettings, changes: dict[str, Any]
) -> tuple[list[dict[str, Any]], StudioError | None, list[dict[str, Any]]]:
    """The rows of a file, why there are none, and the rows of its profiles."""
    from dbh_studio.io.project import is_project

    try:
        if is_project(path):
            rows, along = _measure_plot(path, options, changes)
        else:
            row, along = _measure_file(path, options, settings)
            rows = [row]
        return [{"file": str(path)} | row for row in rows], None, [{"file": str(path)} | point for point in along]
    except UnscaledCloudError:
        error: StudioError = unscaled_error()
    except StudioError as other:
        error = other
    return [{"file": str(path), "reason": error.problem, "remedy": error.remedy}], error, []


def _write(rows: list[dict[str, Any]], options: argparse.Namespace) -> None:
    if options.json:
        # Every row has every column, so that a reader need not ask.
        print(json.dumps([dict.fromkeys(COLUMNS) | row for row in rows], indent=2))
    if options.csv is not None:
        _write_csv(options.csv, _csv(rows, COLUMNS), option="--csv")
        if not options.json and not options.quiet:
            n_measured = sum("dbh_cm" in row for row in rows)
            print(plain(f"{counted(len(rows), 'stem')}, {n_measured} with a diameter: {options.csv}"))
    elif not options.json:
        sys.stdout.write(_csv(rows, COLUMNS))


def _write_csv(path: Path, text: str, *, option: str) -> None:
    from dbh_studio.io.atomic import atomic_file

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as file:
            file.write(text.encode("utf-8", "replace"))
    except OSError as error:
        raise FileError(
            path, f"The table could not be written ({error.strerror or error}).", f"Choose another place for {option}."
        ) from error


def _csv(rows: list[dict[str, Any]], columns: tuple[str, ...]) -> str:
    from dbh_studio.io.inventory_csv import defused

    stream = io.StringIO()
    writer = csv.DictWriter(stream, columns, restval="", lineterminator="\n")
    writer.writeheader()
    # None is written as an empty cell.
    writer.writerows(
        {name: defused(value) if isinstance(value, str) else value for name, value in row.items()} for row in rows
    )
    return stream.getvalue()


def _measure_file(
    path: Path, options: argparse.Namespace, settings: MeasureSettings
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The row of one file, and the rows of its profile where that is wanted."""
    from dbh_studio.core.protocol_measure import measure_by_protocol
    from dbh_studio.core.protocols import Protocol
    from dbh_studio.core.stem_profile import stem_profile
    from dbh_studio.settings import CurveName

    points, scale_sd = _points_of(path, options)
    base = float(points[:, 2].min()) if options.ground_z is None else options.ground_z
    points[:, 2] -= base
    result = measure_by_protocol(points, settings=settings, curves=get_args(CurveName), scale_sd=scale_sd)
    row = _cells(result, settings, Protocol.of(settings, base="stem" if options.ground_z is None else "placed"))
    if options.profile is None:
        return row, []
    return row, _profile(stem_profile(points, settings=settings, scale_sd=scale_sd), result, row, scale_sd)


def _measure_plot(
    path: Path, options: argparse.Namespace, changes: dict[str, Any]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The rows of a saved plot's stems, measured as the plot says and as was said of each; and of their profiles."""
    from dbh_studio.app.commands import change_settings
    from dbh_studio.app.derived import stem_setup_of
    from dbh_studio.app.opening import open_plot
    from dbh_studio.app.session import Session
    from dbh_studio.core.protocols import measured_by

    if options.ground_z is not None:
        raise SettingError("--ground-z was given for a saved plot, which has its own ground.", "Leave it away.")
    session = open_plot(path, scale=options.scale, up=options.up, read_only=True)
    session.require_scale()
    if changes:  # of this table, not of the plot
        session = Session(session.cloud, change_settings("measure", **changes).apply(session.document))
    document, rows, profiles = session.document, [], []
    for i in document.trunks.ids:
        stem = session.compared(i)
        cells = _cells(stem.result, stem_setup_of(document, i).settings, stem.protocol)
        x_m, y_m = (round(float(v), 3) if math.isfinite(v) else None for v in stem.xy_m)
        said = document.record(i)
        about = {"stem_id": i, "tag": said.tag, "x_m": x_m, "y_m": y_m}
        rows.append(about | cells | {"corrections": ";".join(measured_by(said.corrections))})
        if options.profile is not None:
            along = _profile(session.profile(i), stem.result, rows[-1], document.scale.relative_sd)
            profiles += [{"stem_id": i} | point for point in along]
    return rows, profiles


def _cells(result: DbhEstimate | Refusal, settings: MeasureSettings, protocol: Protocol | None) -> dict[str, Any]:
    """What a row says of a stem's measurement."""
    from dbh_studio.core.dbh import CurveFit, DbhEstimate

    row: dict[str, Any] = {}
    if protocol is not None:
        row = {"breast_height_m": round(protocol.breast_height_m, 4), "base": protocol.base}
        row |= {"along": protocol.along, "above": protocol.above}
    if isinstance(result, DbhEstimate):
        section = result.section
        row |= {
            "dbh_cm": round(result.dbh_cm, 2),
            **_intervals(result),
            "dbh_method": result.curve,
            "dbh_definition": result.definition,
            "hom_m": round(section.hom_m, 3),
            "coverage_deg": round(section.coverage_deg, 1),
            "max_gap_deg": round(section.max_gap_deg, 1),
            "rmse_mm": round(result.rmse_mm, 1) if math.isfinite(result.rmse_mm) else None,
            "n_points": result.n_points,
            "lean_deg": round(section.lean_deg, 1) if section.axis_source == "stem" else None,
            "taper_cm_per_m": None if result.taper_cm_per_m is None else round(result.taper_cm_per_m, 2),
            "quality": result.quality,
            "reason": "; ".join(result.flags),
            "flags": ";".join(result.flag_codes),
        }
    else:
        row |= {"quality": "refused", "reason": result.reason, "remedy": result.remedy, "flags": result.code}
    # The curve that was refused is there to be looked at, and its diameter is not to be believed.
    for name, fit in result.fits.items() if isinstance(result, DbhEstimate) else ():
        if isinstance(fit, CurveFit) and f"{name}_cm" in COLUMNS:
            row[f"{name}_cm"] = round(100 * fit.diameter_m(settings.definition), 2)
    return row


def _profile(
    profile: Sequence[ProfilePoint], result: DbhEstimate | Refusal, row: dict[str, Any], scale_sd: float
) -> list[dict[str, Any]]:
    """The rows of a stem's profile; what it says against the diameter is added to `row`, in words and as a flag."""
    from dbh_studio.core.dbh import DbhEstimate
    from dbh_studio.core.stem_profile import breast_height_flag
    from dbh_studio.io.exports.stem_profiles import height_cells

    if isinstance(result, DbhEstimate) and "profile" not in result.flag_codes:
        flag = breast_height_flag(profile, result.hom_m, result.diameters[result.definition], scale_sd=scale_sd)
        if flag is not None:
            row["reason"] = "; ".join(filter(None, (row["reason"], flag.words)))
            row["flags"] = ";".join(filter(None, (row["flags"], flag.code)))
    return [height_cells(point) for point in profile]


def _intervals(result: DbhEstimate) -> dict[str, float | None]:
    """The cells of all three definitions, and the interval of the chosen one."""
    cells: dict[str, float | None] = {}
    for name, diameter in result.diameters.items():
        ends = {"": diameter.value_cm, "_lo": diameter.low_cm, "_hi": diameter.high_cm}
        rounded = {end: None if value is None else round(value, 2) for end, value in ends.items()}
        cells.update({f"dbh_{name}{end}_cm": value for end, value in rounded.items()})
        if name == result.definition:
            cells.update({f"dbh{end}_cm": rounded[end] for end in ("_lo", "_hi")})
    return cells


def _points_of(path: Path, options: argparse.Namespace) -> tuple[Float64, float]:
    """(N, 3) float64 points of a stem file in metres, z up, absolute heights kept; the scale's relative error."""
    import numpy as np

    from dbh_studio.app.opening import open_plot

    session = open_plot(path, scale=options.scale, up=options.up, read_only=True)
    session.require_scale()
    world_from_source = session.document.world_from_source
    origin = world_from_source.apply(session.cloud.origin[None])[0]
    points = session.points_world().astype(np.float64)
    # x and y stay local: only the height's origin matters here.
    points[:, 2] += origin[2]
    return points, session.document.scale.relative_sd
