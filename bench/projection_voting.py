"""Trunks from the masks of photos: the paper's voting, ours, geometry alone, and ours with what geometry offers.

    python bench/projection_voting.py                   8 generated plots, seeds 10 000 …
    python bench/projection_voting.py --first 11 -n 2   development seeds
    python bench/projection_voting.py --cluttered       dense stands: undergrowth, twins, thin and hidden stems, noise
    python bench/projection_voting.py --all             every kind of fault by itself too
    python bench/projection_voting.py --real            the masks of synthetic_360, as they are and with faults
    python bench/projection_voting.py --speed           time per million points per photo, alone and in two threads
    python bench/projection_voting.py --speed --full    20 million points, 200 panoramas of 4096 x 2048

Points: precision and recall of all points of all trunks, of what stands between ground clearance and trunk top. Trees:
a trunk is right where most of its points are one tree's and it holds a third of that tree's points between 1 and 2 m;
of several such trunks of one tree one is right. What is not right is false: a shrub, a log, a fragment, two trees in
one. Fair: these two names are given for all methods alike; nothing tells the methods the truth.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
from mask_scene import LADDER, LEVEL, Faults, MaskScene, faulty_mask

from dbh_studio.app.threads import map_in_threads
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.ground import fit_ground
from dbh_studio.core.instances import InstanceGatherer
from dbh_studio.core.mask_views import ImageMask
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.transforms import Similarity
from dbh_studio.settings import TrunkSettings, VoteSettings
from dbh_studio.stages.mask_trunks import trunks_from_votes
from dbh_studio.stages.segment import segment_trunks
from dbh_studio.stages.vote import make_voters, vote

SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "synthetic_360"
PAPER = VoteSettings.paper().changed(second_look=False)
OURS = VoteSettings()
SHORT = (LADDER[0], LADDER[-2], LADDER[-1])
CLUTTER = {
    "understorey": 2.5,
    "crowns": 1.5,
    "n_trees": 36,
    "n_twins": 5,
    "n_thin": 6,
    "n_hidden": 2,
    "noise": 2.0,
    "lane_m": 12.0,
}
NAMES = {
    "paper": "the paper's voting (count ≥ 1, nothing hides)",
    "whole paper": "the paper's voting and its chain",
    "plain": "our voting, rings part nothing",
    "plain ties": "the same, masks tell trunks apart",
    "votes": "our voting",
    "ours": "ours: masks tell trunks apart, second look",
    "offered": "ours, candidates accepted",
    "geometry": "geometry alone",
}


def vote_on(points, ground, posed, masks, settings):
    """Voters, their votes, what the masks tell apart, and processor seconds."""
    start = time.process_time()
    voters = make_voters(points, posed, ground=ground, settings=settings)
    gatherer = InstanceGatherer(voters.points.xyz)

    def masks_of(photo):
        labels = masks.get(photo.name)
        return None if labels is None else ImageMask(photo.camera, labels, has_instances=True, edge_px=settings.edge_px)

    votes = vote(voters, posed, masks_of, settings=settings, on_photo=lambda _, photo: gatherer.add(photo))
    return voters, votes, gatherer, time.process_time() - start


def methods(points, ground, posed, masks):
    """Name of each method -> point sets, processor seconds, and what else is to be told."""
    found = {}
    voters, votes, gatherer, seconds = vote_on(points, ground, posed, masks, PAPER)
    for name, chain in (("paper", TrunkSettings()), ("whole paper", TrunkSettings.paper())):
        start = time.process_time()
        result = trunks_from_votes(points, ground, voters, votes, gatherer, settings=PAPER, trunks=chain)
        found[name] = result.point_sets, seconds + time.process_time() - start, {}
    voters, votes, gatherer, seconds = vote_on(points, ground, posed, masks, OURS)
    silent, plain = OURS.changed(tell_apart=False, second_look=False), TrunkSettings(part_touching=False)
    for name, settings, chain in (
        ("plain", silent, plain),
        ("plain ties", OURS.changed(second_look=False), plain),
        ("votes", silent, TrunkSettings()),
        ("ours", OURS, TrunkSettings()),
    ):
        start = time.process_time()
        result = trunks_from_votes(points, ground, voters, votes, gatherer, settings=settings, trunks=chain)
        found[name] = (
            result.point_sets,
            seconds + time.process_time() - start,
            dict(flagged=[result.point_sets[k] for k in result.flags], candidates=result.candidates),
        )
    # Accepted candidates bring no point that a trunk has.
    extra = tuple(each.points for each in found["ours"][2]["candidates"] if each.kind != "low")
    found["offered"] = (*found["ours"][0], *extra), found["ours"][1], {}
    return found


def judge_points(point_sets, tree_ids, band):
    found = np.zeros(len(tree_ids), bool)
    for rows in point_sets:
        found[rows] = True
    truth, found = (tree_ids > 0) & band, found & band
    both = np.count_nonzero(found & truth)
    return both / max(np.count_nonzero(found), 1), both / max(np.count_nonzero(truth), 1)


def judge_trees(point_sets, tree_ids, height):
    """Which sets are right, and how many trees are there."""
    core = (height > 1.0) & (height < 2.0)
    of_core = np.bincount(tree_ids[core], minlength=int(tree_ids.max()) + 1)
    there = {int(t) for t in np.flatnonzero(of_core >= 30) if t > 0}
    best_of_tree = {}
    for number, rows in enumerate(point_sets):
        names, counts = np.unique(tree_ids[rows], return_counts=True)
        best = int(names[counts.argmax()])
        n_core = int(np.count_nonzero(core[rows] & (tree_ids[rows] == best)))
        if best in there and counts.max() >= 0.5 * len(rows) and n_core >= of_core[best] / 3:
            best_of_tree[best] = max(best_of_tree.get(best, (0, -1)), (n_core, number))
    right = {number for _, number in best_of_tree.values()}
    return [number in right for number in range(len(point_sets))], len(there)


def compare(scene_name, points, ground, height, tree_ids, given, rows):
    settings = TrunkSettings()
    band = (height >= settings.ground_clearance_m) & (height < settings.trunk_top_m)

    def note(faults, name, point_sets, seconds, more):
        right, there = judge_trees(point_sets, tree_ids, height)
        precision, recall = judge_points(point_sets, tree_ids, band)
        row = dict(
            plot=scene_name, faults=faults, method=NAMES[name], precision=precision, recall=recall, cpu_s=seconds
        )
        row |= dict(right=sum(right), sets=len(right), there=there)
        if "flagged" in more:
            flagged = {id(rows) for rows in more["flagged"]}
            is_flagged = [id(rows) in flagged for rows in point_sets]
            row |= dict(
                flagged_false=sum(f and not r for f, r in zip(is_flagged, right, strict=True)),
                flagged_right=sum(f and r for f, r in zip(is_flagged, right, strict=True)),
                candidates=len(more["candidates"]),
            )
        rows.append(row)
        print(json.dumps(row, default=float), flush=True)

    for faults, posed, masks in given:
        for name, (point_sets, seconds, more) in methods(points, ground, posed, masks).items():
            note(faults, name, point_sets, seconds, more)
    start = time.process_time()
    alone = segment_trunks(points, ground).point_sets
    note("any", "geometry", alone, time.process_time() - start, {})


def generated(first, count, n_photos, cluttered, ladder):
    rows = []
    for seed in range(first, first + count):
        recipe = CLUTTER if cluttered else None
        scene = MaskScene(seed, n_photos=n_photos, width_px=1536, points=600_000, recipe=recipe)
        given = [(faults.name, *scene.faulty(faults)) for faults in ladder]
        compare(seed, scene.points, scene.ground, scene.height, scene.tree_ids, given, rows)
    return rows


def rendered_walk(rows):
    """synthetic_360: poses from structure from motion, masks numbered by tree; truth by the true stems."""
    from PIL import Image
    from scipy.spatial import cKDTree
    from scipy.spatial.transform import Rotation

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
    given = [(faults.name, *_spoilt(posed, labels, faults)) for faults in (LADDER[0], LADDER[-2], LADDER[-1])]
    compare("synthetic_360", points, ground, ground.height_above(points), tree_ids, given, rows)


def _spoilt(posed, labels, faults: Faults):
    """The same faults as in `MaskScene`, without bushes and logs: there is no depth for every photo."""
    from dataclasses import replace

    rng = np.random.default_rng(5)
    images, masks = [], {}
    for photo in posed:
        turn = Similarity(turned_by(rng.normal(0, faults.pose_deg, 3)), rng.normal(0, faults.pose_m, 3))
        images.append(replace(photo, cam_from_source=turn @ photo.cam_from_source))
        if rng.random() >= faults.lost:
            masks[photo.name] = faulty_mask(labels[photo.name], faults, rng)
    return PosedImages(tuple(images)), masks


def turned_by(degrees):
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(np.radians(degrees)).as_matrix()


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


FULL_POINTS, FULL_PHOTOS = 20_000_000, 200
FULL_CASES = {
    "as by default: ground to trunk top, 15 m, cubes of 2 cm, what is hidden does not vote": VoteSettings(),
    "every point in every photo, what is hidden does not vote": VoteSettings(
        max_distance_m=1000.0, thinning_m=0.002, occluder_m=0.04
    ),
    "every point in every photo, the paper's votes": VoteSettings.paper().changed(thinning_m=0.002),
}


def stand(n_points, seed=900):
    """(N, 3) float32: 300 stems on 60 x 60 m of rough ground, with crowns; no plot, but as large as one."""
    rng = np.random.default_rng(seed)
    n_stems = 300
    xy, radius = rng.uniform(0, 60, (n_stems, 2)), rng.uniform(0.06, 0.3, n_stems)
    parts = []
    of = rng.integers(0, n_stems, int(0.35 * n_points))
    angle, z = rng.uniform(0, 2 * np.pi, len(of)), rng.uniform(0, 12, len(of))
    round_it = np.column_stack([np.cos(angle), np.sin(angle)]) * (radius[of] * (1 - 0.03 * z))[:, None]
    parts.append(np.column_stack([xy[of] + round_it, z]).astype(np.float32))
    n = int(0.35 * n_points)
    parts.append(np.column_stack([rng.uniform(0, 60, (n, 2)), rng.normal(0, 0.03, n)]).astype(np.float32))
    n = n_points - sum(map(len, parts))
    parts.append(np.column_stack([rng.uniform(0, 60, (n, 2)), 5.0 + rng.gamma(2.0, 2.0, n)]).astype(np.float32))
    return rng.permutation(np.concatenate(parts))


def full_case(cloud_file, name):
    """Seconds, and the peak of the memory of this process, from the points in memory to a label count for each."""
    import resource

    points = np.load(cloud_file)
    settings, camera = FULL_CASES[name], CameraModel("EQUIRECTANGULAR", 4096, 2048, (4096.0, 2048.0))
    labels = ((np.arange(4096) % 200 < 20) * (1 + np.arange(4096) // 200)).astype(np.uint8)[None, :] * np.ones(
        (2048, 1), np.uint8
    )
    lanes = np.linspace(0, 10, FULL_PHOTOS, endpoint=False)
    images = [
        PosedImage(f"{k:03d}.jpg", camera, Similarity(LEVEL, -(LEVEL @ np.array([6 * (w % 10), 6 * int(w) + 3, 1.6]))))
        for k, w in enumerate(lanes)
    ]
    posed = PosedImages(tuple(images))
    part = points[:: len(points) // 1_000_000]
    start, turn = time.process_time(), LEVEL.astype(np.float32)
    for k in range(0, len(part), 1 << 16):
        x, y, z = ((part[k : k + (1 << 16)] - np.float32(30.0)) @ turn.T).T
        np.arctan2(x, z), np.arctan2(y, np.sqrt(x * x + z * z))
    floor_s = (time.process_time() - start) / len(part)
    ground = None if settings.max_distance_m > 100 else fit_ground(points)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    wall, cpu = time.perf_counter(), time.process_time()
    voters = make_voters(points, posed, ground=ground, settings=settings)
    gatherer = InstanceGatherer(voters.points.xyz) if settings.tell_apart else None
    prepared = time.perf_counter() - wall
    votes = vote(
        voters,
        posed,
        lambda photo: ImageMask(camera, labels, has_instances=True),
        settings=settings,
        on_photo=None if gatherer is None else lambda _, photo: gatherer.add(photo),
        map_photos=map_in_threads,
    )
    counted = votes.carried_back(voters.thinned, voters.rows, len(points))
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    asked = int(counted.n_seen.astype(np.int64).sum())
    print(
        f"| {name} | {len(voters):,} | {asked:,} | {prepared:.0f} | {wall:.0f} | {cpu:.0f} "
        f"| {len(points) * FULL_PHOTOS * floor_s / 2:.0f} | {peak / 2**20:.1f} ({before / 2**20:.1f} before) |",
        flush=True,
    )


def full():
    """The size that a plot of a morning has; a process for each case, so that each tells its own peak of memory."""
    import subprocess
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        cloud_file = Path(folder) / "cloud.npy"
        np.save(cloud_file, stand(FULL_POINTS))
        print(f"{FULL_POINTS:,} points, {FULL_PHOTOS} panoramas of 4096 x 2048, two threads; masks are in memory.")
        print(
            "| | voters | votes | s to choose them | s in all | processor s | floor s: one pass of the projection's "
            "arithmetic over all points and photos, two cores | peak GiB |\n|---|--:|--:|--:|--:|--:|--:|--:|",
            flush=True,
        )
        for name in FULL_CASES:
            subprocess.run([sys.executable, __file__, "--speed", "--case", name, str(cloud_file)], check=True)


def table(rows) -> str:
    lines = [
        "| faults | method | point precision | point recall | trees found | false trunks | flagged: false, right |"
    ]
    lines.append("|---|---|--:|--:|--:|--:|--:|")
    for faults, method in dict.fromkeys((row["faults"], row["method"]) for row in rows):
        some = [row for row in rows if (row["faults"], row["method"]) == (faults, method)]
        right, there, sets = (sum(row[name] for row in some) for name in ("right", "there", "sets"))
        flagged = "–"
        if "flagged_false" in some[0]:
            flagged = ", ".join(str(sum(row[name] for row in some)) for name in ("flagged_false", "flagged_right"))
        precision, recall = (np.mean([row[name] for row in some]) for name in ("precision", "recall"))
        lines.append(
            f"| {faults} | {method} | {precision:.3f} | {recall:.3f} | {right} of {there} | {sets - right} of {sets} "
            f"| {flagged} |"
        )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=10_000, help="first seed; below 1000 for development")
    parser.add_argument("-n", "--count", type=int, default=8, help="how many plots")
    parser.add_argument("--photos", type=int, default=16, help="panoramas per plot")
    parser.add_argument("--cluttered", action="store_true")
    parser.add_argument("--all", action="store_true", help="every kind of fault, not four of them")
    parser.add_argument("--real", action="store_true")
    parser.add_argument("--speed", action="store_true")
    parser.add_argument("--full", action="store_true", help="with --speed: the whole size, once; takes minutes")
    parser.add_argument("--case", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        full_case(options.case[1], options.case[0])
        return 0
    if options.speed and options.full:
        full()
        return 0
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
