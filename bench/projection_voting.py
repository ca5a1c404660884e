"""Masks projected onto clouds: the paper's rule, a share of the votes, and votes of what each photo really sees.

    python bench/projection_voting.py                   5 generated plots, seeds 10 000 …
    python bench/projection_voting.py --first 11 -n 1   development seeds
    python bench/projection_voting.py --cluttered       two and a half times the undergrowth, half as much crown again
    python bench/projection_voting.py --real            the masks of synthetic_360, as they are and with faults
    python bench/projection_voting.py --speed           time per million points per photo, alone and in two threads

Points: precision and recall of the candidates among the points between ground clearance and trunk top. Trees: those of
which the trunks that `segment_trunks` makes of the candidates hold a third of the points between 1 and 2 m, most of
each trunk being that tree; a trunk that is no tree is false. Geometry alone is the detector without any mask.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
from mask_scene import LADDER, Faults, MaskScene

from dbh_studio.app.threads import map_in_threads
from dbh_studio.core.ground import fit_ground
from dbh_studio.core.mask_views import ImageMask
from dbh_studio.settings import TrunkSettings, VoteSettings
from dbh_studio.stages.segment import segment_trunks
from dbh_studio.stages.vote import make_voters, vote

SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "synthetic_360"
RULES = {
    "paper (count ≥ 1)": VoteSettings.paper(),
    "paper's rule, count ≥ 2": VoteSettings.paper().changed(min_count=2),
    "share, nothing hides": VoteSettings(occlusion=False),
    "share, hidden do not vote": VoteSettings(),
}
SHORT = (LADDER[0], LADDER[1], LADDER[2], LADDER[6])
CLUTTER = {"understorey": 2.5, "crowns": 1.5, "n_trees": 30, "n_hidden": 2}


def candidates(points, ground, posed, masks, settings):
    """(N,) candidates, and processor seconds of the voting."""
    voters = make_voters(points, posed, ground=ground, settings=settings)

    def masks_of(photo):
        labels = masks.get(photo.name)
        return None if labels is None else ImageMask(photo.camera, labels, edge_px=settings.edge_px)

    start = time.process_time()
    votes = vote(voters, posed, masks_of, settings=settings)
    seconds = time.process_time() - start
    return votes.carried_back(voters.thinned, voters.rows, voters.n_points).is_trunk(settings), seconds


def judge_points(found, tree_ids, band):
    truth, found = (tree_ids > 0) & band, found & band
    both = np.count_nonzero(found & truth)
    return both / max(np.count_nonzero(found), 1), both / max(np.count_nonzero(truth), 1)


def judge_trees(result, tree_ids, height):
    """Trees found, trees there, trunks that are no tree."""
    core = (height > 1.0) & (height < 2.0)
    there = {t for t in np.unique(tree_ids[tree_ids > 0]) if np.count_nonzero((tree_ids == t) & core) >= 30}
    found, false = set(), 0
    for rows in result.point_sets:
        names, counts = np.unique(tree_ids[rows], return_counts=True)
        best = names[counts.argmax()]
        if best == 0 or counts.max() < 0.5 * len(rows):
            false += 1
            continue
        of_tree = (tree_ids == best) & core
        if of_tree[rows].sum() >= of_tree.sum() / 3:
            found.add(best)
    return len(found & there), len(there), false


def compare(scene_name, points, ground, height, tree_ids, given, rows, *, trees=True):
    settings = TrunkSettings()
    band = (height >= settings.ground_clearance_m) & (height < settings.trunk_top_m)
    for faults, posed, masks in given:
        for rule, votes in RULES.items():
            found, seconds = candidates(points, ground, posed, masks, votes)
            precision, recall = judge_points(found, tree_ids, band)
            row = dict(plot=scene_name, faults=faults, rule=rule, precision=precision, recall=recall, cpu_s=seconds)
            if trees:
                result = segment_trunks(points, ground, candidates=found)
                row |= dict(zip(("found", "there", "false"), judge_trees(result, tree_ids, height), strict=True))
            rows.append(row)
            print(json.dumps(row, default=float), flush=True)
    if trees:
        found, there, false = judge_trees(segment_trunks(points, ground), tree_ids, height)
        rows.append(dict(plot=scene_name, faults="any", rule="geometry alone", found=found, there=there, false=false))
        print(json.dumps(rows[-1], default=float), flush=True)


def generated(first, count, n_photos, cluttered, ladder):
    rows = []
    for seed in range(first, first + count):
        scene = MaskScene(seed, n_photos=n_photos, recipe=CLUTTER if cluttered else None)
        given = [(faults.name, *scene.faulty(faults)) for faults in ladder]
        compare(seed, scene.points, scene.ground, scene.height, scene.tree_ids, given, rows)
    return rows


def rendered_walk(rows):
    """synthetic_360: poses from structure from motion, masks numbered by tree; truth by the true stems."""
    from PIL import Image
    from scipy.spatial import cKDTree
    from scipy.spatial.transform import Rotation

    from dbh_studio.core.transforms import Similarity
    from dbh_studio.io.posed import read_posed_images
    from dbh_studio.io.reader import read_reconstruction

    known = json.loads((SHARED / "world_from_model.json").read_text(encoding="utf-8"))
    turn = Rotation.from_quat(known["rotation_xyzw"]).as_matrix()
    world = Similarity(turn, np.array(known["translation"]), known["metres_per_unit"])
    cloud = read_reconstruction(SHARED / "dense_unscaled.ply").cloud
    points = world.apply(cloud.xyz.astype(np.float64) + cloud.origin).astype(np.float32)
    posed = read_posed_images(SHARED / "colmap_equirectangular").moved(world)
    truth = np.load(SHARED / "gt_trunks.npz")
    tree = truth["tree"]
    distance, nearest = cKDTree(truth["V"]).query(points, distance_upper_bound=0.10, workers=2)
    tree_ids = np.where(np.isfinite(distance), np.append(tree, 0)[nearest], 0).astype(np.int32)
    ground = fit_ground(points)
    labels = {}
    for photo in posed:
        mask = np.asarray(Image.open(SHARED / "masks" / (Path(photo.name).stem + ".png")))
        # The truth about points has the twelve measured trees only, so those behind count as anything else.
        labels[photo.name] = np.where(mask < 200, mask, 0).astype(np.uint8)
    compare("synthetic_360", points, ground, ground.height_above(points), tree_ids,
            [(faults.name, *_spoilt(posed, labels, faults)) for faults in (LADDER[0], LADDER[1], LADDER[2], LADDER[5])],
            rows)  # fmt: skip


def _spoilt(posed, labels, faults: Faults):
    """The same faults as in `MaskScene`, without impostors: there is no depth for every photo."""
    from dataclasses import replace

    scene = MaskScene.__new__(MaskScene)
    scene.labels, scene.spots = labels, {}
    rng = np.random.default_rng(5)
    faults = replace(faults, impostors=0)
    masks = {p.name: scene._faulty_mask(p.name, faults, (), rng) for p in posed if rng.random() >= faults.lost}
    return posed, masks


def speed():
    """Processor and wall seconds per million voters per photo of 4096 x 2048."""
    scene = MaskScene(900, n_photos=8, width_px=2048, points=2_000_000)
    posed, masks = scene.faulty(LADDER[0])
    big = {name: np.repeat(np.repeat(mask, 2, axis=0), 2, axis=1) for name, mask in masks.items()}
    for occlusion in (False, True):
        settings = VoteSettings(occlusion=occlusion, max_distance_m=100.0, thinning_m=0.005, occluder_m=0.02)
        voters = make_voters(scene.points, posed, settings=settings)
        for name, mapper in (("one thread", map), ("two threads", map_in_threads)):
            wall, cpu = time.perf_counter(), time.process_time()
            vote(voters, posed, lambda p: ImageMask(p.camera, big[p.name]), settings=settings, map_photos=mapper)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            million = len(voters) * len(posed) / 1e6
            print(
                f"| {'hidden do not vote' if occlusion else 'nothing hides'} | {name} | {len(voters):,} "
                f"| {len(voters.occluders.xyz):,} | {cpu / million:.3f} | {wall / million:.3f} |"
            )


def table(rows) -> str:
    lines = ["| faults | rule | point precision | point recall | trees | false trunks | CPU s |"]
    lines.append("|---|---|--:|--:|--:|--:|--:|")
    for faults, rule in dict.fromkeys((row["faults"], row["rule"]) for row in rows):
        some = [row for row in rows if (row["faults"], row["rule"]) == (faults, rule)]

        def mean(name, some=some):
            values = [row[name] for row in some if name in row]
            return f"{np.mean(values):.3f}" if values else "–"

        found, there, false = (sum(row[name] for row in some) for name in ("found", "there", "false"))
        lines.append(
            f"| {faults} | {rule} | {mean('precision')} | {mean('recall')} | {found} of {there} | {false} "
            f"| {mean('cpu_s')} |"
        )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=10_000, help="first seed; below 1000 for development")
    parser.add_argument("-n", "--count", type=int, default=5, help="how many plots")
    parser.add_argument("--photos", type=int, default=24, help="panoramas per plot")
    parser.add_argument("--cluttered", action="store_true")
    parser.add_argument("--all", action="store_true", help="every kind of fault, not four of them")
    parser.add_argument("--real", action="store_true")
    parser.add_argument("--speed", action="store_true")
    options = parser.parse_args()
    if options.speed:
        speed()
        return 0
    rows: list[dict] = []
    if options.real:
        if not (SHARED / "masks").is_dir():
            print("The rendered walk is not there, so nothing was measured.", file=sys.stderr)
            return 2
        rendered_walk(rows)
    else:
        rows = generated(
            options.first, options.count, options.photos, options.cluttered, LADDER if options.all else SHORT
        )
    text = table(rows)
    print(f"\n{text}\n")
    results = Path(__file__).resolve().parent / "results"
    results.mkdir(exist_ok=True)
    kind = "real" if options.real else "cluttered" if options.cluttered else "plots"
    if options.real or options.first >= 10_000:
        (results / f"projection_voting_{kind}.md").write_text(text + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
