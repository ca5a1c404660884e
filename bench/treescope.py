"""Diameters of eight real stems with a field tape, by all methods, as a Markdown table.

The slices are trunks of TreeScope VAT-0723M-05 (LiDAR-SLAM, z = height above ground, cut to 1.10-1.50 m), so their lean
cannot be seen and is taken as zero. The last column is what the data set's authors report for their own method.

    python bench/treescope.py [FOLDER]
"""

from __future__ import annotations

import csv
import sys
import time
from pathlib import Path

import numpy as np

from dbh_studio.core.curves import CURVES
from dbh_studio.core.dbh import CurveFit, DbhEstimate, measure_stem
from dbh_studio.core.interval_methods import INTERVAL_METHODS
from dbh_studio.io.pcd import read_pcd
from dbh_studio.settings import MeasureSettings

DEFAULT_FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data" / "treescope_trunk_slices"


METHODS = (*INTERVAL_METHODS, *CURVES)


def diameters_cm(path: Path) -> tuple[dict[str, float], tuple[float, float], float]:
    """Diameter by every method (NaN where refused), the shrinkage curve's interval, and the seconds that one took.

    The tape's definition for the methods that know of bark, perimeter/π for the paper's curves, as in the paper.
    """
    cloud = read_pcd(path).cloud
    points = cloud.xyz + cloud.origin
    start = time.perf_counter()
    result = measure_stem(points, settings=MeasureSettings())
    seconds = time.perf_counter() - start
    found = {"shrinkage": result.dbh_cm if isinstance(result, DbhEstimate) else np.nan}
    circle = measure_stem(points, settings=MeasureSettings(curve="circle"))
    found["circle"] = circle.dbh_cm if isinstance(circle, DbhEstimate) else np.nan
    paper = measure_stem(points, settings=MeasureSettings(curve="fourier", definition="curve"))
    for name, fit in paper.fits.items():
        found[name] = 100.0 * fit.diameter_m("curve") if isinstance(fit, CurveFit) else np.nan
    interval = (result.interval if isinstance(result, DbhEstimate) else None) or (np.nan, np.nan)
    return {name: found.get(name, np.nan) for name in METHODS}, interval, seconds


def main(folder: Path) -> None:
    if not folder.is_dir():
        sys.exit(f"{folder} is not there: give the folder with reference.csv and the slices.")
    rows = list(csv.DictReader((folder / "reference.csv").read_text().splitlines()))
    methods = [*METHODS, "published"]
    print("| tree | tape cm | " + " | ".join(f"{name} cm (error)" for name in methods) + " | 90 % interval | ms |")
    print("|---" * (len(methods) + 4) + "|")
    errors: dict[str, list[float]] = {name: [] for name in methods}
    tapes = np.array([float(row["dbh_cm"]) for row in rows])
    diameters_cm(folder / rows[0]["file"])  # the first call pays for imports
    for row, tape in zip(rows, tapes, strict=True):
        found, (low, high), seconds = diameters_cm(folder / row["file"])
        found["published"] = float(row["treescope_published_cm"])
        cells = []
        for name in methods:
            errors[name].append(found[name] - tape)
            cells.append(f"{found[name]:.1f} ({found[name] - tape:+.1f})")
        held = f"{low:.1f}-{high:.1f} {'holds' if low <= tape <= high else 'misses'}"
        print(f"| {row['tree_id']} | {tape:.1f} | " + " | ".join(cells) + f" | {held} | {1000 * seconds:.0f} |")
    for title, summary in (
        ("bias cm", lambda e: f"{np.mean(e):+.2f}"),
        ("RMSE cm", lambda e: f"{np.sqrt(np.mean(np.square(e))):.2f}"),
        ("median relative error", lambda e: f"{100 * np.median(np.abs(e) / tapes):.1f} %"),
    ):
        print(f"| {title} | | " + " | ".join(summary(np.array(errors[name])) for name in methods) + " | | |")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else DEFAULT_FOLDER)
