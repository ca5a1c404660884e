"""Which photos are worth a mask: how many `auto` takes of four synthetic walks, and what they show.

    python bench/keyframes.py             the choice alone
    python bench/keyframes.py --trunks    and the trunks that true masks of so many photos give; minutes

250 trees stand at random over each plot; a panorama is taken every half metre or metre along lines. "Show" is the share
of what all photos together show: each of eight sides of every stem within 10 m, twice. Evenly is every n-th photo.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from dbh_studio.app.brought_masks import MaskRequest, MaskSet, read_masks
from dbh_studio.app.image_trunks import find_image_trunks, image_trunks_call, photos_in_world
from dbh_studio.app.mask_making import keyframes_of
from dbh_studio.app.opening import open_plot
from dbh_studio.app.photo_scale import PhotoRequest, add_photos
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.keyframes import choose_keyframes, sides_seen
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.transforms import Similarity

PANORAMA = CameraModel("EQUIRECTANGULAR", 4096, 2048, ())
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
# Lines, their length, the gap between them and the step along them, metres.
SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "synthetic_360"
WALKS = ((4, 25.0, 7.0, 0.5), (1, 100.0, 0.0, 0.5), (4, 50.0, 6.0, 1.0), (5, 40.0, 8.0, 1.0))


def walk(n_lines: int, length: float, gap: float, step: float) -> PosedImages:
    images = []
    for line in range(n_lines):
        along = np.arange(0.0, length, step)
        for x in along if line % 2 == 0 else along[::-1]:
            centre = np.array([x, line * gap, 1.7])
            pose = Similarity(LEVEL, -LEVEL @ centre)
            images.append(PosedImage(f"{len(images):03d}.jpg", PANORAMA, pose, order=len(images)))
    return PosedImages(tuple(images))


def trunks_of_fewer_photos() -> None:
    """Of all photos, those that `auto` takes, and as many evenly spaced or the first: trunks, and points in them."""
    session = open_plot(SHARED / "dense_unscaled.ply", scale=1.33231)
    cameras = add_photos(session, PhotoRequest(SHARED / "colmap_equirectangular", SHARED / "images"))
    document = session.document
    posed = photos_in_world(session, document, cameras.posed)
    masks = read_masks(MaskRequest(SHARED / "masks", categories=("1-199",)), cameras.posed)
    chosen = keyframes_of(session, document, posed, "auto")
    n = len(chosen)
    rows = {"all": np.arange(len(posed)), "auto": chosen.rows}
    rows |= {"evenly": np.linspace(0, len(posed) - 1, n).astype(int), "the first": np.arange(n)}
    whole = None
    for name, those in rows.items():
        call = image_trunks_call(session, document, cameras, _of(masks, {posed.images[row].name for row in those}))
        trunks = find_image_trunks(*call).trunks
        is_trunk = trunks.labels(len(session.cloud)) > 0
        whole = is_trunk if whole is None else whole
        both = np.count_nonzero(is_trunk & whole)
        shares = (
            f"{both / np.count_nonzero(whole):.3f} of the points, {both / np.count_nonzero(is_trunk):.3f} of them right"
        )
        print(f"{name:<10} {len(those):>3} photos: {len(trunks)} trunks, {shares}", flush=True)


def _of(masks: MaskSet, names: set[str]) -> MaskSet:
    found = {name: path for name, path in masks.match.found.items() if name in names}
    return replace(masks, match=replace(masks.match, found=found))


def the_choice() -> None:
    rng = np.random.default_rng(0)
    print(f"{'walk':<28} {'photos':>6} {'auto':>5} {'show':>6} {'40 show':>8} {'40 evenly':>10} {'seconds':>8}")
    for n_lines, length, gap, step in WALKS:
        posed = walk(n_lines, length, gap, step)
        width = max((n_lines - 1) * gap, 8.0)
        trees = np.column_stack([rng.uniform(-3, length + 3, 250), rng.uniform(-3, width + 3, 250), np.full(250, 1.5)])
        started = time.perf_counter()
        sees = sides_seen(trees, posed)
        auto = choose_keyframes(sees)
        seconds = time.perf_counter() - started
        forty = choose_keyframes(sees, budget=40)
        demand = np.minimum(sees.sum(axis=0), 2)
        evenly = sees[np.linspace(0, len(posed) - 1, 40).astype(int)].sum(axis=0)
        share = np.minimum(evenly, demand).sum() / demand.sum()
        name = f"{n_lines} x {length:g} m, every {step:g} m"
        shares = f"{auto.share:>6.3f} {forty.share:>8.3f} {share:>10.3f}"
        print(f"{name:<28} {len(posed):>6} {len(auto):>5} {shares} {seconds:>8.2f}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trunks", action="store_true")
    options = parser.parse_args()
    the_choice()
    if not options.trunks:
        return 0
    if not SHARED.is_dir():
        print("The rendered walk is not there, so no trunks were counted.", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        os.environ["DBH_STUDIO_CACHE"] = folder
        trunks_of_fewer_photos()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
