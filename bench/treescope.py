"""Diameters of eight real stems with a field tape, by all methods, as a Markdown table.

The slices are trunks of TreeScope VAT-0723M-05 (LiDAR-SLAM, z = height above ground, cut to 1.10-1.50 m), so their lean
cannot be seen and is taken as zero. The last column is what the data set's authors report for their own method.

    python bench/treescope.py [FOLDER]
    python bench/treescope.py --cut [FOLDER]     a quarter, a half and two thirds of the ring cut away

Each stem is cut at eight places round it: how error and interval of the default grow beside those of a robust circle,
and what is refused. What is kept is thinned towards its edges as it is when a stem is seen from one side.
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
CUT_AWAY = {"nothing": 0.0, "a quarter": 1 / 4, "a half": 1 / 2, "two thirds": 2 / 3}
_PLACES = 8


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


def cut(points: np.ndarray, centre: np.ndarray, share: float, place: int) -> np.ndarray:
    """(N, 3) points without a sector of the ring, the edges of the rest thinned out over 15 degrees."""
    middle = 0.4 + place * (2 * np.pi / _PLACES)
    angle = np.arctan2(points[:, 1] - centre[1], points[:, 0] - centre[0])
    from_edge = np.pi * (1.0 - share) - np.abs((angle - middle + np.pi) % (2 * np.pi) - np.pi)
    kept = np.random.default_rng([place, len(points)]).random(len(points)) < from_edge / np.radians(15.0)
    return points[kept] if share else points


def print_cut(folder: Path, rows: list[dict[str, str]]) -> None:
    """Per share cut away and method: error, interval and refusals."""
    print("| cut away | method | cuts | refused | median % | 90th percentile % | bias % | half width % | holds % |")
    print("|---|---" + "|--:" * 7 + "|")
    stems = []
    for row in rows:
        cloud = read_pcd(folder / row["file"]).cloud
        points = cloud.xyz + cloud.origin
        whole = measure_stem(points, settings=MeasureSettings(curve="circle"))
        centre = whole.position_m if isinstance(whole, DbhEstimate) else np.median(points, axis=0)
        stems.append((points, centre, float(row["dbh_cm"])))
    for name, share in CUT_AWAY.items():
        for method in INTERVAL_METHODS:
            settings, found, n_cuts = MeasureSettings(curve=method), [], 0
            for points, centre, tape in stems:
                for place in range(_PLACES if share else 1):
                    n_cuts += 1
                    result = measure_stem(cut(points, centre, share, place), settings=settings)
                    if isinstance(result, DbhEstimate) and result.interval is not None:
                        found.append((result.dbh_cm / tape - 1.0, *(end / tape - 1.0 for end in result.interval)))
            print(f"| {name} | {method} | {n_cuts} | {n_cuts - len(found)} | {_cut_figures(np.array(found))} |")


def _cut_figures(found: np.ndarray) -> str:
    if not len(found):
        return "– | – | – | – | –"
    error, low, high = found.T
    size = 100 * np.abs(error)
    figures = (np.median(size), np.quantile(size, 0.9), 100 * np.median(error), 50 * np.median(high - low))
    held = 100 * np.mean((low <= 0) & (high >= 0))
    return f"{figures[0]:.1f} | {figures[1]:.1f} | {figures[2]:+.1f} | {figures[3]:.1f} | {held:.0f}"


def main(folder: Path, *, is_cut: bool) -> None:
    if not folder.is_dir():
        sys.exit(f"{folder} is not there: give the folder with reference.csv and the slices.")
    rows = list(csv.DictReader((folder / "reference.csv").read_text().splitlines()))
    if is_cut:
        print_cut(folder, rows)
        return
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
    given = [argument for argument in sys.argv[1:] if argument != "--cut"]
    main(Path(given[0]) if given else DEFAULT_FOLDER, is_cut="--cut" in sys.argv)
