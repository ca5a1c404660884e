"""One plot captured twice: by a carried camera, in a unit of its own, and by a scanner; with two clocks and two walks.

The stems, the ground and the walk are the same; the noise, the seen sides, the frames and the clocks are not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from dbh_studio.core.arrays import Float32, Float64, Int32
from dbh_studio.core.synthetic.plot import make_plot
from dbh_studio.core.synthetic.recipe import PlotRecipe, TreeTruth
from dbh_studio.core.trajectories import Trajectory
from dbh_studio.core.transforms import Similarity

_WALK_M_S = 0.8


@dataclass(frozen=True)
class PairRecipe:
    """What is wrong with the two recordings.

    Attributes:
        plot: What both see.
        seed: Of frames, clocks and errors; the plot has its own.
        photo_hz: Poses a second of the camera.
        lidar_hz: Of the scanner.
        photo_noise_m: Of the camera's places, per axis.
        lidar_noise_m: Of the scanner's.
        drift_m: How far the camera's track wanders off in the course of the walk.
        outliers: Share of the camera's poses that are metres off.
        arm_m: How far the scanner sits from the camera; it turns with the person.
        offset_s: Scanner's clock minus the camera's; None draws one of up to 100 s.
        metres_per_unit: Of the photo cloud.
        tilt_deg: How far the two frames' verticals are apart.
        lidar_points: Of the scan.
        photo_points: Of the photo cloud.
        straight: Walk along one line through the plot.
    """

    plot: PlotRecipe
    seed: int = 0
    photo_hz: float = 2.0
    lidar_hz: float = 10.0
    photo_noise_m: float = 0.02
    lidar_noise_m: float = 0.01
    drift_m: float = 0.0
    outliers: float = 0.0
    arm_m: float = 0.0
    offset_s: float | None = None
    metres_per_unit: float = 1.0
    tilt_deg: float = 0.5
    lidar_points: int = 400_000
    photo_points: int = 300_000
    straight: bool = False


@dataclass(frozen=True, eq=False)
class TransferPair:
    """Both captures and the truth.

    Attributes:
        photo_xyz: (N, 3) in the photo cloud's unit and frame, z up but for a small tilt.
        photo_tree_ids: (N,) true tree of each point; 0 for none.
        lidar_xyz: (M, 3) metres, z up, in a frame of its own.
        lidar_tree_ids: (M,)
        photo_walk: The camera's, in the photo frame and on the camera's clock.
        lidar_walk: The scanner's.
        lidar_from_photo: The truth.
        offset_s: Scanner's clock minus the camera's.
        trees: The stems, in the plot's own frame.
        photo_from_plot: From the plot's frame, in which the trees are.
    """

    photo_xyz: Float32
    photo_tree_ids: Int32
    lidar_xyz: Float32
    lidar_tree_ids: Int32
    photo_walk: Trajectory
    lidar_walk: Trajectory
    lidar_from_photo: Similarity
    offset_s: float
    trees: tuple[TreeTruth, ...]
    photo_from_plot: Similarity


def make_pair(recipe: PairRecipe) -> TransferPair:
    """Make both captures; the same recipe gives the same ones."""
    rng = np.random.default_rng(recipe.seed)
    photo = make_plot(recipe.plot.changed(capture="walk", points=recipe.photo_points))
    scan = make_plot(
        recipe.plot.changed(capture="all_round", noise=min(0.3, recipe.plot.noise), points=recipe.lidar_points)
    )
    turn = Rotation.from_euler("zyx", [rng.uniform(0, 360), *(recipe.tilt_deg * rng.uniform(-0.7, 0.7, 2))], True)
    lidar_from_plot = Similarity(turn.as_matrix(), rng.uniform(-40, 40, 3))
    heading = Rotation.from_euler("z", rng.uniform(0, 360), True).as_matrix()
    photo_from_plot = Similarity(heading, rng.uniform(-9, 9, 3), 1 / recipe.metres_per_unit)
    # Both clouds of the generator lie about origins of their own.
    photo_plot = photo.cloud.xyz.astype(np.float64) + photo.cloud.origin
    scan_plot = scan.cloud.xyz.astype(np.float64) + scan.cloud.origin
    places = photo.cameras_m + photo.cloud.origin
    if recipe.straight:
        places = _straight(places, recipe.plot.side_m)
    offset = float(rng.uniform(-100, 100)) if recipe.offset_s is None else recipe.offset_s
    photo_walk, lidar_walk = _walks(recipe, places, offset, rng)
    return TransferPair(
        photo_from_plot.apply(photo_plot).astype(np.float32),
        photo.tree_ids,
        lidar_from_plot.apply(scan_plot).astype(np.float32),
        scan.tree_ids,
        photo_walk.moved(photo_from_plot),
        lidar_walk.moved(lidar_from_plot),
        lidar_from_plot @ photo_from_plot.inverse(),
        offset,
        scan.trees,
        photo_from_plot,
    )


def _straight(places: Float64, side_m: float) -> Float64:
    """(C, 3) along one line through the middle, at a height that hardly changes."""
    along = np.linspace(1.0, side_m - 1.0, 60)
    z = float(np.median(places[:, 2]))
    return np.column_stack([along, 0.3 * along + 0.3 * side_m, np.full(60, z)])


def _walks(
    recipe: PairRecipe, places: Float64, offset_s: float, rng: np.random.Generator
) -> tuple[Trajectory, Trajectory]:
    """The camera's and the scanner's, both in the plot's frame; the scanner started earlier and stopped earlier."""
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    # A person slows down and goes on.
    pace = _WALK_M_S * (1.0 + 0.4 * np.sin(np.arange(len(steps)) * 0.37 + rng.uniform(0, 6)))
    when = np.concatenate([[0.0], np.cumsum(steps / pace)])
    end = float(when[-1])

    def at(times: Float64) -> Float64:
        return np.column_stack([np.interp(times, when, places[:, axis]) for axis in range(3)])

    mine = np.arange(0.03 * end, end, 1.0 / recipe.photo_hz)
    theirs = np.arange(0.0, 0.97 * end, 1.0 / recipe.lidar_hz)
    ahead = at(theirs + 0.5) - at(theirs - 0.5)
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    scanner = at(theirs) + recipe.arm_m * ahead + rng.normal(0, recipe.lidar_noise_m, (len(theirs), 3))
    camera = at(mine) + rng.normal(0, recipe.photo_noise_m, (len(mine), 3))
    camera += recipe.drift_m * np.sin(mine[:, None] / end * np.array([4.0, 5.0, 3.0]) + rng.uniform(0, 6, 3))
    lost = rng.random(len(mine)) < recipe.outliers
    camera[lost] += rng.normal(0, 4.0, (int(lost.sum()), 3))
    return Trajectory(mine, camera), Trajectory(theirs + offset_s, scanner)
