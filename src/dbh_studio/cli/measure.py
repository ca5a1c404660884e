"""`dbh-studio measure`: stems that are already cut out."""

from __future__ import annotations

import argparse
import csv
import io
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from dbh_studio.errors import FileError, StudioError, UnscaledCloudError

if TYPE_CHECKING:
    from dbh_studio.core.arrays import Float64
    from dbh_studio.settings import MeasureSettings

COLUMNS = (
    "file", "dbh_cm", "dbh_method", "dbh_definition", "hom_m", "coverage_deg", "max_gap_deg", "rmse_mm", "n_points",
    "lean_deg", "quality", "reason", "remedy", "flags", "fourier_cm", "ellipse_cm", "bspline_cm",
)  # fmt: skip


def add_commands(commands: Any) -> None:
    """Register the command."""
    measure = commands.add_parser(
        "measure",
        help="measure stems that are already cut out, one file each",
        description="Measure stems that are already cut out, one file each, and print a CSV table. A file that cannot "
        "be read is reported and the others are measured all the same (status 1; 3 where a scale is missing). A stem "
        "that cannot be measured is no error: its row says why.",
    )
    measure.add_argument("stems", type=path_argument, nargs="+", metavar="STEM", help="a cloud of one stem")
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
    add_cloud_options(measure)
    add_settings_options(measure, only_measure=True)
    measure.add_argument("--json", action="store_true", help="print JSON")
    measure.add_argument("--quiet", action="store_true", help="no progress")
    measure.set_defaults(command=measure_files)


def measure_files(options: argparse.Namespace) -> int:
    """Measure each file; one that cannot be read is reported and the others go on."""
    from dbh_studio.settings import Settings

    settings = Settings().measure.changed(**settings_changes(options, only_measure=True).get("measure", {}))
    if options.csv is not None:
        from dbh_studio.io.inventory_csv import check_not_source

        check_not_source(options.csv, options.stems)
    rows, errors = [], []
    with progress_for(options) as progress:
        for number, path in enumerate(options.stems):
            progress(number / len(options.stems), path.name)
            row, error = _row(path, options, settings)
            rows.append(row)
            if error is not None:
                errors.append(error)
                progress.finish()
                told = error if isinstance(error, FileError) else f"{path.name}: {error}"
                print(f"dbh-studio: {plain(str(told))}", file=sys.stderr)
    _write(rows, options)
    if any(isinstance(error, UnscaledCloudError) for error in errors):
        return 3
    return 1 if errors else 0


def _row(
    path: Path, options: argparse.Namespace, settings: MeasureSettings
) -> tuple[dict[str, Any], StudioError | None]:
    try:
        return {"file": str(path)} | _measure_file(path, options, settings), None
    except UnscaledCloudError:
        error: StudioError = unscaled_error()
    except StudioError as other:
        error = other
    return {"file": str(path), "reason": error.problem, "remedy": error.remedy}, error


def _write(rows: list[dict[str, Any]], options: argparse.Namespace) -> None:
    if options.json:
        # Every row has every column, so that a reader need not ask.
        print(json.dumps([dict.fromkeys(COLUMNS) | row for row in rows], indent=2))
    if options.csv is not None:
        _write_csv(options.csv, _csv(rows))
        if not options.json and not options.quiet:
            n_measured = sum("dbh_cm" in row for row in rows)
            print(plain(f"{counted(len(rows), 'stem')}, {n_measured} with a diameter: {options.csv}"))
    elif not options.json:
        sys.stdout.write(_csv(rows))


def _write_csv(path: Path, text: str) -> None:
    from dbh_studio.io.atomic import atomic_file

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as file:
            file.write(text.encode("utf-8", "replace"))
    except OSError as error:
        raise FileError(
            path, f"The table could not be written ({error.strerror or error}).", "Choose another place for --csv."
        ) from error


def _csv(rows: list[dict[str, Any]]) -> str:
    from dbh_studio.io.inventory_csv import defused

    stream = io.StringIO()
    writer = csv.DictWriter(stream, COLUMNS, restval="", lineterminator="\n")
    writer.writeheader()
    # None is written as an empty cell.
    writer.writerows(
        {name: defused(value) if isinstance(value, str) else value for name, value in row.items()} for row in rows
    )
    return stream.getvalue()


def _measure_file(path: Path, options: argparse.Namespace, settings: MeasureSettings) -> dict[str, Any]:
    from dbh_studio.core.dbh import CurveFit, DbhEstimate, measure_stem

    points = _points_of(path, options)
    base = float(points[:, 2].min()) if options.ground_z is None else options.ground_z
    points[:, 2] -= base
    result = measure_stem(points, settings=settings)
    row: dict[str, Any]
    if isinstance(result, DbhEstimate):
        section = result.section
        row = {
            "dbh_cm": round(result.dbh_cm, 2),
            "dbh_method": result.curve,
            "dbh_definition": result.definition,
            "hom_m": round(section.hom_m, 3),
            "coverage_deg": round(section.coverage_deg, 1),
            "max_gap_deg": round(section.max_gap_deg, 1),
            "rmse_mm": round(result.rmse_mm, 1),
            "n_points": result.n_points,
            "lean_deg": None if section.axis_source == "vertical" else round(section.lean_deg, 1),
            "quality": result.quality,
            "flags": "; ".join(result.flags),
        }
    else:
        row = {"quality": "refused", "reason": result.reason, "remedy": result.remedy}
    for name, fit in result.fits.items():
        if isinstance(fit, CurveFit):
            row[f"{name}_cm"] = round(100 * fit.diameter_m(settings.definition), 2)
    return row


def _points_of(path: Path, options: argparse.Namespace) -> Float64:
    """(N, 3) float64 points of a stem file in metres, z up, absolute heights kept."""
    import numpy as np

    from dbh_studio.app.opening import open_plot

    session = open_plot(path, scale=options.scale, up=options.up, read_only=True)
    session.require_scale()
    world_from_source = session.document.world_from_source
    origin = world_from_source.apply(session.cloud.origin[None])[0]
    points = session.points_world().astype(np.float64)
    # x and y stay local: only the height's origin matters here.
    points[:, 2] += origin[2]
    return points
