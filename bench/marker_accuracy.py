"""How well markers give the scale, on plots rendered for the purpose.

    python bench/marker_accuracy.py                        30 plots at each of 2048 and 4096 pixels, seeds 20 000 ...
    python bench/marker_accuracy.py --first 0 -n 5 --width 2048     development seeds
    python bench/marker_accuracy.py --real                 synthetic_360, poses from structure from motion
    python bench/marker_accuracy.py --time                 seconds per panorama by width, named and guessed

Each plot has a 1 m marker lying and a 0.5 m marker standing; each gives the scale alone, then both together. The plots
take turns in five circumstances: near, far, over the marker (it lies under the camera), cut by the panorama's seam,
and partly hidden by saplings. Among them stand decoys: a marker nobody named, one of another dictionary, one printed
mirrored, one without its black frame, one bent round a trunk. Poses are off by 3 mm and 0.05 degrees (rms per axis), as
structure from motion leaves them. On a busy machine OPENBLAS_NUM_THREADS=1 makes the fits several times quicker.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from dbh_studio.core.posed_images import PosedImages
from dbh_studio.core.synthetic.marker_plot import marker_plot
from dbh_studio.core.synthetic.marker_scene import MarkerBoard, WrappedMarker, random_scene
from dbh_studio.io.marker_codes import marker_bits
from dbh_studio.io.photos import read_photo
from dbh_studio.io.posed import read_posed_images
from dbh_studio.settings import MarkerSettings
from dbh_studio.stages.markers import find_markers, scale_from_markers, triangulate_markers

SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "synthetic_360"
KEYS = (("DICT_4X4_50", 7), ("DICT_APRILTAG_36h11", 3))
SIDES_M = {KEYS[0]: 1.0, KEYS[1]: 0.5}


LIES = {KEYS[0]: "lying 1 m", KEYS[1]: "standing 0.5 m"}
# What is done to a plot, by seed modulo five: distances of the cameras from the middle, and more.
CIRCUMSTANCES = (
    ("near", dict(reach_m=(2.0, 4.5))),
    ("far", dict(reach_m=(4.5, 7.0))),
    ("over", dict(reach_m=(0.4, 3.0))),
    ("seam", dict(reach_m=(2.0, 5.5), on_seam=True)),
    ("hidden", dict(reach_m=(2.0, 5.5))),
)
BENT = ("DICT_4X4_50", 11)


def decoys(scene, rng):
    """The scene with five wrong markers on a ring round the right ones."""
    noframe = marker_bits(*KEYS[0]).copy()
    noframe[[0, -1], :] = noframe[:, [0, -1]] = True
    prints = [
        (marker_bits("DICT_4X4_50", 23), 0.35),
        (marker_bits("DICT_5X5_50", 4), 0.4),
        (marker_bits(*KEYS[0])[:, ::-1], 0.5),
        (noframe, 0.5),
    ]
    boards = []
    start = rng.uniform(0, 2 * np.pi)
    for number, (bits, side_m) in enumerate(prints):
        turn = start + number * np.pi / 2
        place = 3.2 * np.array([np.cos(turn), np.sin(turn)])
        normal = np.array([np.cos(turn), np.sin(turn), 0.0]) * rng.choice([-1.0, 1.0])
        down = np.array([0.0, 0.0, -1.0])
        centre = np.array([*place, float(place @ scene.slope) + side_m / 2 + 0.1])
        boards.append(MarkerBoard(("decoy", number), bits, side_m, centre, np.cross(down, -normal), down))
    x, y, _ = scene.stems_m[0]
    bent = WrappedMarker(marker_bits(*BENT), 0.4, 0, float(np.arctan2(-y, -x)), 1.3 + float(scene.slope @ (x, y)))
    return dataclasses.replace(scene, boards=scene.boards + tuple(boards), wrapped=(bent,))


def make_plot(seed, width_px, n_photos):
    name, options = CIRCUMSTANCES[seed % len(CIRCUMSTANCES)]
    codes = [(key, marker_bits(*key), SIDES_M[key]) for key in KEYS]
    scene = decoys(random_scene(seed, codes, hidden=name == "hidden"), np.random.default_rng([seed, 9]))
    return name, marker_plot(seed, codes, width_px=width_px, n_photos=n_photos, scene=scene, **options)


def judge(label, report, truth, rows, **more):
    if report.estimate is None:
        row = dict(plot=label, error_pct=None, why=report.verdict.message, **more)
    else:
        estimate = report.estimate
        error = 100 * (estimate.metres_per_unit / truth - 1)
        se = 100 * estimate.standard_error / truth
        row = dict(plot=label, error_pct=round(error, 3), se_pct=round(se, 3), sigmas=round(abs(error) / se, 2), **more)
    rows.append(row)


def judge_markers(label, markers, truth, rows, sides_m, settings, names=None):
    names = names or {key: f"{key[0]} {key[1]} {side_m} m" for key, side_m in sides_m.items()}
    for marker in markers:
        extra = dict(
            marker=names.get(marker.key, marker.name),
            views=len(marker.views_used),
            rejected=len(marker.views_rejected),
            residual_px=round(marker.residual_px, 2),
            stat_pct=round(100 * marker.side_sigma_src / marker.side_src, 3),
            sys_pct=round(100 * marker.size_drift, 3),
            uneven_pct=round(100 * marker.unevenness, 2),
        )
        judge(label, scale_from_markers([marker], sides_m, settings=settings), truth, rows, **extra)
    judge(label, scale_from_markers(markers, sides_m, settings=settings), truth, rows, marker="all")


def one_plot(task):
    """Rows and counts of one plot."""
    seed, width_px, n_photos, guess = task
    settings = MarkerSettings(dictionaries=() if guess else tuple(key[0] for key in KEYS))
    circumstance, plot = make_plot(seed, width_px, n_photos)
    posed, truth = plot.posed, plot.metres_per_unit
    rows = []
    start = time.process_time()
    found = find_markers(posed, settings=settings, read_image=plot.read)
    seconds = time.process_time() - start
    markers = triangulate_markers(found, posed, settings=settings)
    right = [marker for marker in markers if marker.key in SIDES_M]
    judge_markers(seed, right, truth, rows, SIDES_M, settings, LIES)
    # With everything that was found, and the bent one's side given as well.
    whole = scale_from_markers(markers, {**SIDES_M, BENT: 0.4}, settings=settings, only_named=True)
    names = {f"{key[0]} {key[1]}" for key in SIDES_M}
    used = [residual.name for residual in whole.residuals if residual.name not in names]
    judge(seed, whole, truth, rows, marker="all, among decoys")
    lost = set(SIDES_M) - {m.key for m in markers}
    rows += [dict(plot=seed, marker=LIES[key], error_pct=None, why="not placed") for key in lost]
    for row in rows:
        row.update(width=width_px, circumstance=circumstance)
    counts = dict(
        sights=len(found), false=sum(d.key not in SIDES_M for d in found), used_wrong=used, seconds=seconds / n_photos
    )
    return rows, counts


def rendered(first, count, width_px, n_photos, guess, jobs):
    tasks = [(seed, width_px, n_photos, guess) for seed in range(first, first + count)]
    rows, totals = [], []
    with ProcessPoolExecutor(jobs) as pool:
        for some, counts in pool.map(one_plot, tasks):
            rows += some
            totals.append(counts)
            print("\n".join(json.dumps(row) for row in some), flush=True)
            print(json.dumps(counts), flush=True)
    wrong = [name for counts in totals for name in counts["used_wrong"]]
    print(
        f"{width_px} px: {sum(c['sights'] for c in totals)} sights, {sum(c['false'] for c in totals)} of codes nobody "
        f"named, wrong markers in the scale: {wrong or 'none'}; "
        f"{np.mean([c['seconds'] for c in totals]):.2f} CPU-s per photo"
    )
    return rows


def real(settings, limit):
    """synthetic_360 with its pycolmap poses."""
    posed = read_posed_images(SHARED / "colmap_equirectangular", images_dir=SHARED / "images")
    posed = PosedImages(posed.images[:: max(1, limit)])
    truth = json.loads((SHARED / "world_from_model.json").read_text())["metres_per_unit"]
    boards = json.loads((SHARED / "poses_gt.json").read_text())["markers"]
    sides_m = {(b["dictionary"], b["id"]): b["side_m"] for b in boards}

    start = time.process_time()
    found = find_markers(posed, settings=settings, read_image=read_photo)
    print(
        f"{(time.process_time() - start) / len(posed):.2f} CPU-s per photo, {len(found)} sights, "
        f"{sum(d.key not in sides_m for d in found)} of wrong codes"
    )
    rows = []
    judge_markers("synthetic_360", triangulate_markers(found, posed, settings=settings), truth, rows, sides_m, settings)
    print("\n".join(json.dumps(row) for row in rows))
    return rows


def line(label, chosen):
    known = [row for row in chosen if row["error_pct"] is not None]
    if not known:
        return f"| {label} | 0 of {len(chosen)} | – | – | – | – | – | – |"
    errors = np.array([row["error_pct"] for row in known])
    sigmas = np.array([row["sigmas"] for row in known])
    return (
        f"| {label} | {len(known)} of {len(chosen)} | {errors.mean():+.2f} % | {np.sqrt((errors**2).mean()):.2f} % "
        f"| {np.abs(errors).max():.2f} % | {(np.abs(errors) <= 0.3).sum()} | {(sigmas <= 2).sum()} "
        f"| {np.median([r['se_pct'] for r in known]):.2f} % |"
    )


def summary(rows):
    """A Markdown table: by width and marker, then by circumstance."""
    print("\n| plots | measured | bias | rms | worst | within 0.3 % | within 2 SE | median SE |")
    print("|---|--:|--:|--:|--:|--:|--:|--:|")
    for width in sorted({row.get("width", 0) for row in rows}):
        here = [row for row in rows if row.get("width", 0) == width]
        for kind in sorted({row["marker"] for row in here}):
            chosen = [row for row in here if row["marker"] == kind]
            print(line(f"{width or ''} {kind}", chosen))
            for name in sorted({row.get("circumstance", "") for row in chosen} - {""}):
                some = [row for row in chosen if row["circumstance"] == name]
                print(line(f"{width} {kind}, {name}", some))


def timing(n_photos=2):
    """CPU seconds per panorama: two dictionaries named, one named, all of them looked for."""
    for width_px in (2048, 4096, 7680):
        _, plot = make_plot(0, width_px, n_photos)
        for label, names in (("two named", (KEYS[0][0], KEYS[1][0])), ("one named", (KEYS[0][0],)), ("all", ())):
            settings = MarkerSettings(dictionaries=names)
            find_markers(PosedImages(plot.posed.images[:1]), settings=settings, read_image=plot.read)
            start = time.process_time()
            find_markers(plot.posed, settings=settings, read_image=plot.read)
            print(f"{width_px} px, {label}: {(time.process_time() - start) / n_photos:.2f} CPU-s per photo", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=20_000, help="first seed")
    parser.add_argument("-n", type=int, default=30, help="plots")
    parser.add_argument("--photos", type=int, default=8)
    parser.add_argument("--width", type=int, nargs="+", default=[2048, 4096], help="of the panoramas, pixels")
    parser.add_argument("--real", action="store_true")
    parser.add_argument("--time", action="store_true")
    parser.add_argument("--every", type=int, default=1, help="with --real: every so many-th panorama")
    parser.add_argument("--guess", action="store_true", help="do not name the dictionaries")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    if args.time:
        timing()
        return 0
    if args.real:
        rows = real(MarkerSettings(dictionaries=() if args.guess else tuple(key[0] for key in KEYS)), args.every)
    else:
        rows = []
        for width in args.width:
            rows += rendered(args.first, args.n, width, args.photos, args.guess, args.jobs)
    summary(rows)
    if args.out:
        args.out.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
