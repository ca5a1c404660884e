"""A small plot captured twice, as files: a photo plot with trunks, a scan, and the trajectories of both sensors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.synthetic.recipe import PlotRecipe
from dbh_studio.core.synthetic.transfer_pair import PairRecipe, TransferPair, make_pair
from dbh_studio.core.trajectories import Trajectory
from dbh_studio.io.las import write_las
from dbh_studio.io.ply import write_ply

UNIT_M = 1.37


@dataclass(frozen=True, eq=False)
class TransferPlot:
    """What was written, and the truth.

    Attributes:
        folder: Everything below it.
        photo: The photo cloud, in a unit of `UNIT_M`.
        scan: The LiDAR cloud.
        camera: The camera's trajectory, TUM.
        scanner: The scanner's, a table.
        pair: What is true.
    """

    folder: Path
    photo: Path
    scan: Path
    camera: Path
    scanner: Path
    pair: TransferPair


def write_transfer_plot(folder: Path) -> TransferPlot:
    """Make the plot; it takes a second or two."""
    recipe = PlotRecipe.simple(seed=31, n_trees=8, side_m=14.0, lane_m=5.0)
    pair = make_pair(
        PairRecipe(recipe, seed=5, offset_s=37.5, metres_per_unit=UNIT_M, photo_points=120_000, lidar_points=140_000)
    )
    photo, scan = folder / "photo.ply", folder / "scan.las"
    write_ply(photo, PointCloud.from_points(pair.photo_xyz))
    write_las(scan, PointCloud.from_points(pair.lidar_xyz))
    camera = write_tum(folder / "camera.txt", pair.photo_walk)
    scanner = folder / "scanner.csv"
    walk = pair.lidar_walk
    lines = [f"{t:.6f},{x:.5f},{y:.5f},{z:.5f}" for t, (x, y, z) in zip(walk.time_s, walk.xyz, strict=True)]
    scanner.write_text("\n".join(["time_s,x,y,z", *lines]), encoding="utf-8")
    return TransferPlot(folder, photo, scan, camera, scanner, pair)


def write_tum(path: Path, walk: Trajectory) -> Path:
    """A trajectory as TUM."""
    lines = [f"{t:.6f} {x:.5f} {y:.5f} {z:.5f} 0 0 0 1" for t, (x, y, z) in zip(walk.time_s, walk.xyz, strict=True)]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def straightened(walk: Trajectory) -> Trajectory:
    """The same walk, pressed onto one straight line."""
    middle = walk.xyz.mean(axis=0)
    along = np.linalg.svd(walk.xyz - middle, full_matrices=False)[2][0] * [1.0, 1.0, 0.0]
    along /= np.linalg.norm(along)
    return Trajectory(walk.time_s, middle + ((walk.xyz - middle) @ along)[:, None] * along)
