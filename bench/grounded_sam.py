"""Trunks in the panoramas of synthetic_360 by the models that are on this computer: seconds, and what is found.

    python bench/grounded_sam.py                       the default models, three photos
    python bench/grounded_sam.py --photos 64 --whole   all of them, the panorama as it is: the paper's way
    python bench/grounded_sam.py --prompted            without a detector: boxes from the true trunks
    python bench/grounded_sam.py --set box_threshold=0.2 --set tile_count=6

Pixels: precision and recall of the masks against the rendered truth, where the masks say something. Trees: of the
trunks with at least 400 pixels, those of which one mask covers half and which are half of that mask. The photos are
rendered: what is found in them shows that all is connected rightly, and is no claim for a forest.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from dbh_studio.core.tiles import up_in_camera
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import ModelError
from dbh_studio.io.models import ModelStore
from dbh_studio.io.posed import read_posed_images
from dbh_studio.settings import MaskDetectorSettings, ModelRunSettings
from dbh_studio.stages.grounded_sam import segment_photo, segment_trunks
from dbh_studio.stages.mask_models import open_grounded_sam
from dbh_studio.stages.trunk_prompts import TrunkShape

SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "synthetic_360"
MIN_PIXELS = 400


def true_trunks():
    truth = np.load(SHARED / "gt_trunks.npz")
    points = truth["V"]
    low = points[:, 2] < points[:, 2].min() + 5.0
    return [TrunkShape(int(tree), points[low & (truth["tree"] == tree)]) for tree in np.unique(truth["tree"])]


def judge(mask, truth):
    """Pixels found, true and both; trees found and true."""
    known = np.ones(truth.shape, bool) if mask.ignored is None else ~mask.ignored
    found, real = (mask.labels > 0) & known, (truth > 0) & known
    n_found = n_trees = 0
    for tree in np.unique(truth[real]):
        here = (truth == tree) & known
        size = np.count_nonzero(here)
        if size < MIN_PIXELS:
            continue
        n_trees += 1
        labels, counts = np.unique(mask.labels[here & found], return_counts=True)
        if len(labels):
            best = counts.argmax()
            whole = np.count_nonzero((mask.labels == labels[best]) & known)
            n_found += counts[best] >= 0.5 * max(size, whole)
    return np.count_nonzero(found), np.count_nonzero(real), np.count_nonzero(found & real), n_found, n_trees


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=int, default=3)
    parser.add_argument("--whole", action="store_true")
    parser.add_argument("--prompted", action="store_true")
    parser.add_argument("--detector", default="")
    parser.add_argument("--segmenter", default="")
    parser.add_argument("--models", type=Path, default=None, help="folder of the models, instead of the cache")
    parser.add_argument("--provider", default="auto")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    options = parser.parse_args()
    if not SHARED.is_dir():
        print("The rendered walk is not there, so nothing was measured.", file=sys.stderr)
        return 2
    settings = MaskDetectorSettings().changed(**dict(pair.split("=", 1) for pair in options.set))
    if options.whole:
        settings = settings.changed(panorama="whole")
    try:
        models = open_grounded_sam(
            ModelStore(folder=options.models),
            ModelRunSettings(provider=options.provider),
            detector=options.detector,
            segmenter=options.segmenter,
            with_detector=not options.prompted,
        )
    except ModelError as error:
        print(f"Nothing was measured: {error}", file=sys.stderr)
        return 2
    known = json.loads((SHARED / "world_from_model.json").read_text(encoding="utf-8"))
    turn = Rotation.from_quat(known["rotation_xyzw"]).as_matrix()
    world = Similarity(turn, np.array(known["translation"]), known["metres_per_unit"])
    photos = read_posed_images(SHARED / "colmap_equirectangular", images_dir=SHARED / "images").moved(world).images
    chosen = [photos[i] for i in np.unique(np.linspace(0, len(photos) - 1, options.photos).astype(int))]
    trunks = true_trunks() if options.prompted else []
    totals, wall, cpu = np.zeros(5, int), 0.0, 0.0
    for photo in chosen:
        started, worked = time.perf_counter(), time.process_time()
        up = up_in_camera(photo, [0.0, 0.0, 1.0])
        if options.prompted:
            masks = segment_trunks(photo, trunks, models.segmenter, settings, up_cam=up)
        else:
            masks = segment_photo(photo, models.detector, models.segmenter, settings, up_cam=up)
        mask = masks.trunk_mask(2048)
        wall, cpu = wall + time.perf_counter() - started, cpu + time.process_time() - worked
        truth = np.asarray(Image.open(SHARED / "masks" / f"{Path(photo.name).stem}.png"))
        if options.prompted:
            truth = np.where(truth < 200, truth, 0)  # those behind have no number and are not asked for
        totals += judge(mask, truth)
        print(f"{photo.name}: {len(masks)} trunks")
    n_found, n_true, n_both, trees_found, trees = totals.tolist()
    print(
        f"\n{' and '.join(models.models)}, {len(chosen)} photos: {wall / len(chosen):.1f} s and "
        f"{cpu / len(chosen):.1f} processor-s each; pixels precision {n_both / max(n_found, 1):.3f}, recall "
        f"{n_both / max(n_true, 1):.3f}; {trees_found} of {trees} trees of {MIN_PIXELS} pixels and more"
    )
    for note in models.notes:
        print(note)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
