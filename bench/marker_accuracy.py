"""How well markers give the scale, on plots rendered for the purpose.

    python bench/marker_accuracy.py                    30 plots, seeds 10 000 …
    python bench/marker_accuracy.py --first 0 -n 3     development seeds
    python bench/marker_accuracy.py --real             the synthetic_360 panoramas with poses from structure from motion

Each plot has a 1 m marker lying and a 0.5 m marker standing; each gives the scale alone, then both together. Poses are
off by 3 mm and 0.05° (rms per axis), as structure from motion leaves them. On a busy machine OPENBLAS_NUM_THREADS=1
makes the fits several times quicker.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from dbh_studio.core.posed_images import PosedImages
from dbh_studio.core.synthetic.marker_plot import marker_plot
from dbh_studio.io.marker_codes import marker_bits
from dbh_studio.io.photos import read_photo
from dbh_studio.io.posed import read_posed_images
from dbh_studio.settings import MarkerSettings
from dbh_studio.stages.markers import find_markers, scale_from_markers, triangulate_markers

SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "synthetic_360"
KEYS = (("DICT_4X4_50", 7), ("DICT_APRILTAG_36h11", 3))
SIDES_M = {KEYS[0]: 1.0, KEYS[1]: 0.5}


def make_plot(seed, **options):
    return marker_plot(seed, [(key, marker_bits(*key), SIDES_M[key]) for key in KEYS], **options)


def judge(label, report, truth, rows, **more):
    if report.estimate is None:
        row = dict(plot=label, error_pct=None, why=report.verdict.message, **more)
    else:
        estimate = report.estimate
        error = 100 * (estimate.metres_per_unit / truth - 1)
        se = 100 * estimate.standard_error / truth
        row = dict(plot=label, error_pct=round(error, 3), se_pct=round(se, 3), sigmas=round(abs(error) / se, 2), **more)
    rows.append(row)
    print(json.dumps(row), flush=True)


def judge_markers(label, markers, truth, rows, sides_m, settings):
    for marker in markers:
        extra = dict(
            marker=f"{marker.name} {sides_m.get(marker.key)} m",
            views=len(marker.views_used),
            rejected=len(marker.views_rejected),
            residual_px=round(marker.residual_px, 2),
            stat_pct=round(100 * marker.side_sigma_src / marker.side_src, 3),
            sys_pct=round(200 * settings.systematic_px * marker.footprint_src / marker.side_src, 3),
            uneven_pct=round(100 * marker.unevenness, 2),
        )
        judge(label, scale_from_markers([marker], sides_m, settings=settings), truth, rows, **extra)
    judge(label, scale_from_markers(markers, sides_m, settings=settings), truth, rows, marker="all")


def rendered(first, count, width_px, settings, n_photos):
    rows, n_false, n_sights, seconds = [], 0, 0, 0.0
    for seed in range(first, first + count):
        plot = make_plot(seed, width_px=width_px, n_photos=n_photos)
        posed, truth = plot.posed, plot.metres_per_unit
        start = time.process_time()
        found = find_markers(posed, settings=settings, read_image=plot.read)
        seconds += time.process_time() - start
        n_false += sum(d.key not in SIDES_M for d in found)
        n_sights += len(found)
        markers = triangulate_markers(found, posed, settings=settings)
        judge_markers(seed, markers, truth, rows, SIDES_M, settings)
        for key in SIDES_M:
            if key not in {m.key for m in markers}:
                rows.append(
                    dict(plot=seed, marker=f"{key[0]} {key[1]} {SIDES_M[key]} m", error_pct=None, why="not placed")
                )
                print(json.dumps(rows[-1]), flush=True)
        if any(m.key not in SIDES_M for m in markers):
            print(f"  wrong markers placed: {[m.name for m in markers if m.key not in SIDES_M]}")
    print(f"{n_sights} sights, {n_false} of wrong codes, {seconds / (count * n_photos):.2f} CPU-s per photo")
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
    return rows


def summary(rows):
    kinds = sorted({row["marker"] for row in rows})
    for kind in kinds:
        chosen = [row for row in rows if row["marker"] == kind]
        known = [row for row in chosen if row["error_pct"] is not None]
        if not known:
            continue
        errors = np.array([row["error_pct"] for row in known])
        sigmas = np.array([row["sigmas"] for row in known])
        print(
            f"{kind}: {len(known)} of {len(chosen)} measured; bias {errors.mean():+.3f} %, "
            f"rms {np.sqrt((errors**2).mean()):.3f} %, worst {np.abs(errors).max():.3f} %; "
            f"within 0.3 %: {np.mean(np.abs(errors) <= 0.3):.0%}; "
            f"within 2 SE: {np.mean(sigmas <= 2):.0%}; median SE {np.median([r['se_pct'] for r in known]):.3f} %"
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=10_000, help="first seed")
    parser.add_argument("-n", type=int, default=30, help="plots")
    parser.add_argument("--photos", type=int, default=14)
    parser.add_argument("--width", type=int, default=2048, help="of the panoramas, pixels")
    parser.add_argument("--real", action="store_true")
    parser.add_argument("--every", type=int, default=1, help="with --real: every so many-th panorama")
    parser.add_argument("--guess", action="store_true", help="do not name the dictionaries")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    settings = MarkerSettings(dictionaries=() if args.guess else tuple(key[0] for key in KEYS))
    rows = real(settings, args.every) if args.real else rendered(args.first, args.n, args.width, settings, args.photos)
    summary(rows)
    if args.out:
        args.out.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
