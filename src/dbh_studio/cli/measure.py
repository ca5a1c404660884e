"""`dbh-studio measure`: stems that are already cut out."""

from __future__ import annotations

import argparse
import csv
import io
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from dbh_studio.cli.common import add_cloud_options, add_settings_options, progress_for, settings_from
from dbh_studio.errors import StudioError, UnscaledCloudError

COLUMNS = (
    "file", "dbh_cm", "dbh_method", "dbh_definition", "hom_m", "coverage_deg", "max_gap_deg", "rmse_mm", "n_points",
    "lean_deg", "quality", "reason", "remedy", "flags", "fourier_cm", "ellipse_cm", "bspline_cm",
)  # fmt: skip


def add_commands(commands: Any) -> None:
    """Register the command."""
    measure = commands.add_parser(
        "measure",
        help="measure stems that are already cut out, one file each",
        description="Measure stems that are already cut out, one file each.",
    )
    measure.add_argument("stems", type=Path, nargs="+", metavar="STEM", help="a cloud of one stem")
    measure.add_argument("--csv", type=Path, metavar="OUT", help="write the table there instead of printing it")
    measure.add_argument(
        "--ground-z",
        type=float,
        metavar="M",
        help="height of the ground in the files, metres; 0 where z is already a height; without it the ground "
        "is each stem's own lowest point",
    )
    add_cloud_options(measure)
    add_settings_options(measure)
    measure.add_argument("--json", action="store_true", help="print JSON")
    measure.add_argument("--quiet", action="store_true", help="no progress")
    measure.set_defaults(command=measure_files)


def measure_files(options: argparse.Namespace) -> int:
    """Measure each file; one that cannot be read is reported and the others go on (status 1)."""
    settings = settings_from(options).measure
    progress = progress_for(options)
    rows, n_failed = [], 0
    for number, path in enumerate(options.stems):
        progress(number / len(options.stems), path.name)
        try:
            rows.append(_measure_file(path, options, settings))
        except UnscaledCloudError:
            raise
        except StudioError as error:
            n_failed += 1
            print(f"dbh-studio: {error}", file=sys.stderr)
            rows.append({"file": str(path), "reason": error.problem, "remedy": error.remedy})
    getattr(progress, "finish", lambda: None)()
    if options.json:
        print(json.dumps(rows, indent=2))
    if options.csv is not None:
        from dbh_studio.io.atomic import atomic_file

        with atomic_file(options.csv) as file:
            file.write(_csv(rows).encode())
        if not options.json and not options.quiet:
            print(f"{len(rows) - n_failed} stems: {options.csv}")
    elif not options.json:
        sys.stdout.write(_csv(rows))
    return 1 if n_failed else 0


def _csv(rows: list[dict[str, Any]]) -> str:
    stream = io.StringIO()
    writer = csv.DictWriter(stream, COLUMNS, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: "" if value is None else value for name, value in row.items()} for row in rows)
    return stream.getvalue()


def _measure_file(path: Path, options: argparse.Namespace, settings: Any) -> dict[str, Any]:
    from dbh_studio.core.dbh import CurveFit, DbhEstimate, measure_stem

    points = _points_of(path, options)
    base = float(points[:, 2].min()) if options.ground_z is None else options.ground_z
    points[:, 2] -= base
    result = measure_stem(points, settings=settings)
    row: dict[str, Any] = {"file": str(path)}
    if isinstance(result, DbhEstimate):
        section = result.section
        row |= {
            "dbh_cm": round(result.dbh_cm, 2),
            "dbh_method": result.curve,
            "dbh_definition": result.definition,
            "hom_m": round(section.hom_m, 3),
            "coverage_deg": round(section.coverage_deg, 1),
            "max_gap_deg": round(section.max_gap_deg, 1),
            "rmse_mm": round(result.rmse_mm, 1),
            "n_points": result.n_points,
            "lean_deg": round(section.lean_deg, 1),
            "quality": result.quality,
            "flags": "; ".join(result.flags),
        }
    else:
        row |= {"reason": result.reason, "remedy": result.remedy}
    for name, fit in result.fits.items():
        if isinstance(fit, CurveFit):
            row[f"{name}_cm"] = round(100 * fit.diameter_m(settings.definition), 2)
    return row


def _points_of(path: Path, options: argparse.Namespace) -> np.ndarray[Any, np.dtype[np.float64]]:
    """(N, 3) float64 points of a stem file in metres, z up, absolute heights kept."""
    from dbh_studio.app.opening import open_plot

    session = open_plot(path, scale=options.scale, up=options.up, read_only=True)
    session.require_scale()
    world_from_source = session.document.world_from_source
    origin = world_from_source.apply(session.cloud.origin[None])[0]
    points = session.points_world().astype(np.float64)
    # x and y stay local: only the height's origin matters here.
    points[:, 2] += origin[2]
    return points
