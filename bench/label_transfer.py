"""Trunks carried from a photo plot to a LiDAR cloud: error of the transform, the clocks, the labels and the diameters.

    python bench/label_transfer.py                      6 generated plots, seeds 10 000 …
    python bench/label_transfer.py --first 11 -n 1      development seeds
    python bench/label_transfer.py --cluttered          more undergrowth, hidden stems, twins
    python bench/label_transfer.py --real               a reconstruction from rendered photos, and a scan of the truth

Each plot is captured twice (`core/synthetic/transfer_pair.py`): as photogrammetry along a walk, and as a scan, with two
frames, two clocks and two trajectories. The program works as for a person: files in, `transfer_plot`, a saved plot out.

- transform: root mean square over the photo cloud of where its points come to lie, against the truth; the turn's error;
  the scale's; and the standard error the program gave itself (walks alone).
- labels: the points of the LiDAR plot's trunks against the tree each was drawn from, 0.3-8 m above ground, and 1-2 m;
  and the same for the labels before they are tidied up, which is the paper's rule.
- DBH: photo less LiDAR, over the trees with both.

`--real` takes the dense cloud and the poses that structure from motion made of the rendered 360° walk, unit unknown.
The LiDAR are points drawn from the true surfaces of the twelve measured trees and the ground, 1 cm of noise, in another
frame; its trajectory is where the camera really was, ten times as dense, on another clock. The photos have no times:
their numbers count frames.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dbh_studio.app import pipeline
from dbh_studio.app.opening import open_plot
from dbh_studio.app.transfer_plot import TransferRequest, photo_side, transfer_plot
from dbh_studio.app.transfer_report import fit_text, summary_of, summary_text
from dbh_studio.app.transfer_walks import WalkFile
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.synthetic import PlotRecipe
from dbh_studio.core.synthetic.transfer_pair import PairRecipe, make_pair
from dbh_studio.core.trajectories import Trajectory
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import StudioError
from dbh_studio.io.las import write_las
from dbh_studio.io.ply import write_ply
from dbh_studio.stages.label_carry import carry_labels

SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "synthetic_360"
CLUTTER = {"understorey": 2.5, "crowns": 1.5, "n_trees": 22, "n_hidden": 2, "n_twins": 2}
ROUGH = {
    "arm_m": 0.3, "drift_m": 0.05, "outliers": 0.2, "photo_noise_m": 0.05, "photo_hz": 1.0, "lidar_hz": 20.0,
}  # fmt: skip
# Name, what is wrong with the recordings, what is asked for, which trajectories are kept back or spoiled.
CASES = (
    ("walks 2 cm", {}, {}, ""),
    ("walks 2 cm, --refine", {}, {"refine": True}, ""),
    ("rough walks", ROUGH, {}, ""),
    ("rough walks, --refine", ROUGH, {"refine": True}, ""),
    ("rough walks, rigid, --refine", ROUGH, {"refine": True, "with_scale": False}, ""),
    ("no scale, rough walks, --refine", {**ROUGH, "metres_per_unit": 1.37}, {"refine": True, "set_scale": True}, ""),
    ("straight walk, clock known", {"straight": True, "offset_s": 5.0}, {"clock_offset_s": 5.0}, ""),
    ("straight walk, clock unknown", {"straight": True}, {}, ""),
    ("no trajectories (stems)", {}, {}, "none"),
    ("8 poses", {}, {}, "few"),
    ("another walk", {}, {}, "other"),
)


def write_walk(path: Path, walk: Trajectory) -> WalkFile:
    lines = [f"{t:.6f} {x:.5f} {y:.5f} {z:.5f} 0 0 0 1" for t, (x, y, z) in zip(walk.time_s, walk.xyz, strict=True)]
    path.write_text("\n".join(lines), encoding="utf-8")
    return WalkFile(path)


def spoiled(walk: Trajectory, how: str, seed: int) -> Trajectory:
    if how == "few":
        return Trajectory(walk.time_s[:8], walk.xyz[:8])
    if how == "other":
        rng = np.random.default_rng(seed)
        wander = np.cumsum(np.cumsum(rng.normal(0, 0.01, walk.xyz.shape), axis=0), axis=0)
        return Trajectory(walk.time_s, wander - wander.mean(axis=0) + walk.xyz.mean(axis=0))
    return walk


def precision_recall(labels, truth, trees, band):
    marked, there = (labels > 0) & band, np.isin(truth, trees) & band
    return float((labels[marked] == truth[marked]).mean()), float((labels[there] == truth[there]).mean())


def judge(pair, session, report, truth_scale):
    """One row of the table."""
    lidar = open_plot(report.project_dir, read_only=True)
    metres = report.scale.metres_per_unit if report.photo_scale == "lidar" else session.document.scale.metres_per_unit
    world = replace(session.document, scale=ScaleEstimate(metres, "factor")).world_from_source
    points = pair.photo_xyz[::20].astype(float)
    placed = report.lidar_from_photo.apply(world.apply(points - session.cloud.origin))
    lidar_world = lidar.document.world_from_source
    wanted = lidar_world.apply(pair.lidar_from_photo.apply(points) - lidar.cloud.origin)
    turn = lidar_world.rotation @ pair.lidar_from_photo.rotation @ world.rotation.T @ report.lidar_from_photo.rotation.T
    trunks = report.found_trunks or session.document.trunks
    tree_of = {}
    for trunk in trunks:
        names, counts = np.unique(pair.photo_tree_ids[trunk.points], return_counts=True)
        tree_of[trunk.id] = int(names[counts.argmax()])
    truth, n = pair.lidar_tree_ids, len(pair.lidar_xyz)
    height = lidar.ground().height_above(lidar.points_world())
    low, breast = (height > 0.3) & (height < 8.0), (height > 1.0) & (height < 2.0)
    labels = np.zeros(n, int)
    for trunk in lidar.document.trunks:
        labels[trunk.points] = tree_of[trunk.id]
    given = trunks.labels(len(session.cloud))
    source = world.apply(session.cloud.xyz.astype(float))
    plain = carry_labels(source, given, lidar.points_world(), report.lidar_from_photo)
    paper = np.array([tree_of.get(i, 0) for i in range(int(given.max()) + 1)])[plain.labels]
    trees = sorted(set(tree_of.values()) - {0})
    found = summary_of(report.trees)
    row = {
        "method": report.method,
        "transform_mm": 1000 * float(np.sqrt((np.linalg.norm(placed - wanted, axis=1) ** 2).mean())),
        "said_mm": 1000 * report.error_m,
        "turn_deg": float(np.degrees(np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0],
                                                     turn[1, 0] - turn[0, 1]]) / 2)),
        "scale_pct": np.nan if report.scale is None else 100 * (report.scale.metres_per_unit / truth_scale - 1),
        "scale_se_pct": np.nan if report.scale is None or report.scale.standard_error is None
        else 100 * report.scale.standard_error / report.scale.metres_per_unit,
        "clock_ms": np.nan if report.clock_offset_s is None else 1000 * (report.clock_offset_s - pair.offset_s),
        "trunks": len(lidar.document.trunks), "of": len(trunks),
        "n_dbh": found.n, "bias_cm": found.bias_cm, "rmse_cm": found.rmse_cm,
    }  # fmt: skip
    for name, which, band in (("", labels, low), ("_breast", labels, breast), ("_paper", paper, low),
                              ("_paper_breast", paper, breast)):  # fmt: skip
        row[f"precision{name}"], row[f"recall{name}"] = precision_recall(which, truth, trees, band)
    lidar.close()
    return row


def run_case(seed, folder, case, plot):
    name, wrong, asked, spoil = case
    pair = make_pair(PairRecipe(plot, seed=seed, **wrong))
    unit = wrong.get("metres_per_unit", 1.0)
    photo, scan = folder / "photo.ply", folder / "scan.las"
    write_ply(photo, PointCloud.from_points(pair.photo_xyz))
    write_las(scan, PointCloud.from_points(pair.lidar_xyz))
    session = open_plot(photo, scale="metres" if unit == 1.0 else None)
    if unit == 1.0:
        pipeline.segment(session, in_process=True)
    walks = {} if spoil == "none" else {
        "photo_walk": write_walk(folder / "camera.txt", pair.photo_walk),
        "lidar_walk": write_walk(folder / "scanner.txt", spoiled(pair.lidar_walk, spoil, seed)),
    }  # fmt: skip
    request = TransferRequest(scan, folder / "out", "photo", **walks, **asked)
    start = time.process_time()
    row = {"seed": seed, "case": name}
    try:
        report = transfer_plot(*photo_side(session), request)
        row |= judge(pair, session, report, unit)
    except StudioError as error:
        row |= {"method": "refused", "says": str(error)}
    row["cpu_s"] = time.process_time() - start
    session.close()
    return row


def real_scan(folder):
    """The LiDAR cloud of the rendered plot, its trees, its trajectory, and where the plot's world lies in it."""
    rng = np.random.default_rng(0)
    truth, ground = np.load(SHARED / "gt_trunks.npz"), np.load(SHARED / "gt_ground.npz")
    corners, faces = truth["V"].astype(float), truth["F"]
    a, b, c = (corners[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(faces), 500_000, p=area / area.sum())
    u, v = np.sqrt(rng.random(len(chosen))), rng.random(len(chosen))
    stems = a[chosen] * (1 - u)[:, None] + b[chosen] * (u * (1 - v))[:, None] + c[chosen] * (u * v)[:, None]
    floor = np.column_stack([ground[name].ravel() for name in "XYZ"]).astype(float)
    points = np.concatenate([stems, floor]) + rng.normal(0, 0.01, (len(stems) + len(floor), 3))
    trees = np.concatenate([truth["tree"][faces[chosen, 0]].astype(np.int32), np.zeros(len(floor), np.int32)])
    turn = Rotation.from_euler("zyx", [140.0, 0.4, -0.3], True).as_matrix()
    lidar_from_world = Similarity(turn, np.array([20.0, -35.0, 4.0]))
    frames = json.loads((SHARED / "poses_gt.json").read_text(encoding="utf-8"))["frames"]
    centres = np.array([frame["C"] for frame in frames])
    times = np.linspace(0, len(centres) - 1, 10 * len(centres))
    places = np.column_stack([np.interp(times, np.arange(len(centres)), centres[:, i]) for i in range(3)])
    walk = Trajectory(times / 2.0 + 812.4, places + rng.normal(0, 0.01, places.shape)).moved(lidar_from_world)
    scan = folder / "scan.las"
    write_las(scan, PointCloud.from_points(lidar_from_world.apply(points)))
    return scan, trees, walk, lidar_from_world


def real(folder):
    """The rendered walk, coarse and refined: the transform's error, and each diameter against the truth."""
    known = json.loads((SHARED / "world_from_model.json").read_text(encoding="utf-8"))
    turn = Rotation.from_quat(known["rotation_xyzw"]).as_matrix()
    world_from_model = Similarity(turn, np.array(known["translation"]), known["metres_per_unit"])
    scan, trees, walk, lidar_from_world = real_scan(folder)
    truth = {tree["tree_id"]: tree["dbh_smooth_perim_cm"] for tree in
             json.loads((SHARED / "trees_gt.json").read_text(encoding="utf-8"))}  # fmt: skip
    walks = {
        "photo_walk": WalkFile(SHARED / "colmap_equirectangular", rate_hz=2.0),
        "lidar_walk": write_walk(folder / "scanner.txt", walk),
    }
    for refine in (False, True):
        session = open_plot(SHARED / "dense_unscaled.ply")
        out = folder / f"out{refine}"
        request = TransferRequest(scan, out, "photo", **walks, refine=refine, set_scale=True)
        report = transfer_plot(*photo_side(session), request)
        lidar = open_plot(report.project_dir, read_only=True)
        scale = report.scale
        world = replace(session.document, scale=scale).world_from_source
        sample = session.cloud.xyz[::200].astype(float)
        placed = report.lidar_from_photo.apply(world.apply(sample))
        model = sample + session.cloud.origin
        wanted = lidar_from_world.apply(world_from_model.apply(model))
        wanted = lidar.document.world_from_source.apply(wanted - lidar.cloud.origin)
        near = np.linalg.norm(world_from_model.apply(model)[:, :2], axis=1) < 15.0
        off = np.linalg.norm(placed - wanted, axis=1)[near]
        print(f"refine {refine}: {fit_text(report)}")
        print(f"  transform {1000 * np.sqrt((off**2).mean()):.0f} mm rms over the cloud within 15 m, said "
              f"{1000 * report.error_m:.0f} mm; clock {1000 * (report.clock_offset_s - 812.4):+.0f} ms; scale "
              f"{100 * (scale.metres_per_unit / known['metres_per_unit'] - 1):+.3f} % (said "
              f"{100 * scale.standard_error / scale.metres_per_unit:.3f})")  # fmt: skip
        print(f"  {summary_text(summary_of(report.trees))}")
        print("  tree  as   photo   LiDAR   truth  precision  apart cm")
        for row in report.trees:
            points = lidar.document.trunks[row.stem_id].points if row.stem_id in lidar.document.trunks else []
            names, counts = np.unique(trees[points], return_counts=True)
            best = int(names[counts.argmax()]) if len(names) else 0
            pure = counts.max() / counts.sum() if len(names) else float("nan")
            print(f"  {row.stem_id:>4} {best:>3} {row.dbh_photo_cm or np.nan:>7.1f} {row.dbh_lidar_cm or np.nan:>7.1f} "
                  f"{truth.get(best, np.nan):>7.1f} {pure:>10.3f} {row.centres_apart_cm or np.nan:>9.1f}")  # fmt: skip
        for note in report.notes:
            print(f"  note: {note}")
        lidar.close()
        session.close()


def table(rows):
    form = "{:<33} {:>12} {:>9} {:>7} {:>7} {:>8} {:>8} {:>7} {:>13} {:>13} {:>13} {:>7} {:>7}"
    print(form.format("median over the plots", "method", "error mm", "said", "turn °", "scale %", "clock ms", "trunks",
                      "0.3-8 m p/r", "1-2 m p/r", "paper 1-2 m", "bias cm", "RMSE"))  # fmt: skip
    for name in dict.fromkeys(row["case"] for row in rows):
        mine = [row for row in rows if row["case"] == name]
        done = [row for row in mine if row["method"] != "refused"]
        methods = "/".join(f"{sum(row['method'] == m for row in mine)} {m[:5]}" for m in
                           dict.fromkeys(row["method"] for row in mine))  # fmt: skip
        if not done:
            print(f"{name:<33} {methods}: {mine[0]['says']}")
            continue

        def middle(key, *, size=False, done=done):
            values = np.array([row[key] for row in done if row[key] is not None and np.isfinite(row[key])], float)
            return float(np.median(np.abs(values) if size else values)) if len(values) else float("nan")

        def pair_of(key):
            return f"{middle('precision' + key):.3f}/{middle('recall' + key):.3f}"

        carried = f"{sum(row['trunks'] for row in done)}/{sum(row['of'] for row in done)}"
        print(form.format(
            name, methods, f"{middle('transform_mm'):.1f}", f"{middle('said_mm'):.0f}", f"{middle('turn_deg'):.3f}",
            f"{middle('scale_pct', size=True):.3f}", f"{middle('clock_ms', size=True):.0f}", carried, pair_of(""),
            pair_of("_breast"), pair_of("_paper_breast"), f"{middle('bias_cm'):+.2f}", f"{middle('rmse_cm'):.2f}",
        ))  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=10_000)
    parser.add_argument("-n", "--count", type=int, default=6)
    parser.add_argument("--cluttered", action="store_true")
    parser.add_argument("--only", default="", help="cases whose name holds this")
    parser.add_argument("--real", action="store_true")
    options = parser.parse_args()
    if options.real:
        with tempfile.TemporaryDirectory() as folder:
            real(Path(folder))
        return
    rows = []
    for seed in range(options.first, options.first + options.count):
        plot = PlotRecipe(seed=seed, side_m=20.0, **(CLUTTER if options.cluttered else {"n_trees": 14, "crowns": 0.5}))
        for case in CASES:
            if options.only in case[0]:
                with tempfile.TemporaryDirectory() as folder:
                    rows.append(run_case(seed, Path(folder), case, plot))
                print(json.dumps(rows[-1], default=float), flush=True)
    table(rows)


if __name__ == "__main__":
    main()
