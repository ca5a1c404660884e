"""The ground: known surfaces, noise, holes, slopes, and clouds without ground."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dbh_studio.core.ground import PlaneGround, StemBaseGround, TerrainGround, fit_ground
from dbh_studio.errors import CancelledError
from dbh_studio.settings import GroundSettings


def plot(
    slope_deg: float = 0.0, *, size: float = 16.0, n: int = 120_000, noise: float = 0.01, seed: int = 0
) -> np.ndarray:
    """(N, 3) float32 ground with a bump and a hollow."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-size / 2, size / 2, (n, 2))
    return np.column_stack([xy, surface(xy, slope_deg) + rng.normal(0, noise, n)]).astype(np.float32)


def surface(xy: np.ndarray, slope_deg: float) -> np.ndarray:
    return np.tan(np.radians(slope_deg)) * xy[:, 0] + 0.2 * np.sin(0.6 * xy[:, 0]) * np.cos(0.5 * xy[:, 1])


def stems(xy: np.ndarray, slope_deg: float, *, from_m: float = 0.0, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    parts = []
    for centre in xy:
        h, a = rng.uniform(from_m, 8.0, 8000), rng.uniform(0, 2 * np.pi, 8000)
        z = surface(centre[None], slope_deg)[0] + h
        parts.append(np.column_stack([centre[0] + 0.15 * np.cos(a), centre[1] + 0.15 * np.sin(a), z]))
    return np.concatenate(parts).astype(np.float32)


FEET = np.array([[-5.0, -4.0], [4.5, 3.0], [0.5, -2.0], [-2.0, 5.0]])


@pytest.mark.parametrize("slope_deg", [0.0, 25.0, 42.0])
def test_terrain_under_stems_is_right_to_centimetres(slope_deg: float) -> None:
    ground = fit_ground(np.concatenate([plot(slope_deg), stems(FEET, slope_deg)]))
    assert ground.kind == "terrain"
    assert ground.notes == ()
    error = ground.z_at(FEET) - surface(FEET, slope_deg)
    assert np.abs(error).max() < 0.03


def test_terrain_everywhere_inside_the_plot() -> None:
    ground = fit_ground(plot(20.0))
    xy = np.random.default_rng(5).uniform(-7.5, 7.5, (2000, 2))
    error = ground.z_at(xy) - surface(xy, 20.0)
    assert abs(error.mean()) < 0.01
    assert error.std() < 0.02


def test_one_percent_of_noise_below_ground_moves_it_by_less_than_the_noise_of_the_ground() -> None:
    rng = np.random.default_rng(2)
    good = np.concatenate([plot(25.0), stems(FEET, 25.0)])
    outliers = rng.uniform(good.min(axis=0) - [0, 0, 4], good.max(axis=0), (len(good) // 100, 3)).astype(np.float32)
    error = fit_ground(np.concatenate([good, outliers])).z_at(FEET) - surface(FEET, 25.0)
    assert np.abs(error).max() < 0.03


def test_a_hole_in_the_ground_is_filled_along_the_slope() -> None:
    points = plot(30.0, seed=3)
    hole = np.hypot(points[:, 0] - 0.5, points[:, 1] + 2.0) < 1.5
    ground = fit_ground(np.concatenate([points[~hole], stems(FEET, 30.0, from_m=0.5)]))
    middle = np.array([[0.5, -2.0]])
    assert abs(float((ground.z_at(middle) - surface(middle, 30.0))[0])) < 0.10


def test_undergrowth_is_not_ground() -> None:
    rng = np.random.default_rng(4)
    points = plot(15.0, n=60_000)
    ferns = points[rng.random(len(points)) < 0.5].copy()
    ferns[:, 2] += rng.uniform(0.15, 0.9, len(ferns)).astype(np.float32)
    # Under half of the plot only one point in ten reaches the ground.
    dense = points[:, 0] > 0
    points = points[~dense | (rng.random(len(points)) < 0.1)]
    error = fit_ground(np.concatenate([points, ferns])).z_at(FEET) - surface(FEET, 15.0)
    assert np.abs(error).max() < 0.06


def test_outside_the_cloud_the_slope_runs_on() -> None:
    ground = fit_ground(plot(20.0))
    far = np.array([[30.0, 0.0], [-30.0, 5.0], [1e6, -1e6]])
    z = ground.z_at(far)
    assert np.isfinite(z).all()
    assert abs(z[0] - np.tan(np.radians(20.0)) * 30.0) < 1.5
    assert abs(z[1] + np.tan(np.radians(20.0)) * 30.0) < 1.5


def test_height_above_keeps_precision_and_agrees_with_z_at() -> None:
    points = plot(10.0)
    ground = fit_ground(points)
    height = ground.height_above(points)
    assert height.dtype == np.float32
    assert np.allclose(height, points[:, 2] - ground.z_at(points[:, :2]), atol=1e-5)
    assert ground.height_above(points.astype(np.float64)).dtype == np.float64


def test_removed_ground_is_said_and_each_stem_has_its_own_base() -> None:
    ground = fit_ground(stems(FEET, 20.0, from_m=0.2))
    assert isinstance(ground, StemBaseGround)
    assert ground.kind == "stem_base"
    assert "no ground" in ground.notes[0]
    assert np.abs(ground.z_at(FEET) - (surface(FEET, 20.0) + 0.2)).max() < 0.05


def test_a_single_tree_without_ground_has_one_base() -> None:
    rng = np.random.default_rng(0)
    crown = (rng.normal(0, 1.2, (30_000, 3)) + [0, 0, 9]).astype(np.float32)
    ground = fit_ground(np.concatenate([stems(np.zeros((1, 2)), 0.0), crown]))
    assert ground.kind == "stem_base"
    assert abs(float(ground.z_at(np.array([[0.3, 0.4]]))[0])) < 0.05


@pytest.mark.parametrize("slope_deg", [0.0, 35.0])
def test_the_papers_plane(slope_deg: float) -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(-8, 8, (50_000, 2))
    slope = np.tan(np.radians(slope_deg))
    points = np.column_stack([xy, slope * xy[:, 0] + 3.0 + rng.normal(0, 0.02, len(xy))]).astype(np.float32)
    points = np.concatenate([points, stems(FEET, slope_deg) + np.float32([0, 0, 3])])
    ground = fit_ground(points, settings=GroundSettings(method="plane"))
    assert isinstance(ground, PlaneGround)
    assert ground.slope_deg == pytest.approx(slope_deg, abs=0.2)
    assert np.abs(ground.z_at(FEET) - slope * FEET[:, 0] - 3.0).max() < 0.03
    assert ground.n_inliers >= 49_000


def test_the_plane_keeps_its_precision_far_from_the_origin() -> None:
    points = plot(12.0, noise=0.0).astype(np.float64) + [1e5, -2e5, 500.0]
    ground = fit_ground(points, settings=GroundSettings(method="plane"))
    residual = ground.height_above(points)
    assert np.median(np.abs(residual)) < 0.15


def test_same_input_same_ground_whatever_the_order() -> None:
    points = np.concatenate([plot(20.0), stems(FEET, 20.0)])
    shuffled = points[np.random.default_rng(9).permutation(len(points))]
    first, again, other = fit_ground(points), fit_ground(points), fit_ground(shuffled)
    assert np.array_equal(first.z_at(FEET), again.z_at(FEET))
    assert np.abs(first.z_at(FEET) - other.z_at(FEET)).max() < 0.01


def test_models_are_small_and_survive_pickling() -> None:
    points = np.concatenate([plot(20.0), stems(FEET, 20.0)])
    for model in (fit_ground(points), fit_ground(points, settings=GroundSettings(method="plane"))):
        stored = pickle.dumps(model)
        assert len(stored) < 20_000
        assert np.array_equal(pickle.loads(stored).z_at(FEET), model.z_at(FEET))


def test_points_that_are_not_finite_are_ignored() -> None:
    points = np.concatenate([plot(10.0), np.full((50, 3), np.nan, np.float32), np.full((5, 3), np.inf, np.float32)])
    assert np.abs(fit_ground(points).z_at(FEET) - surface(FEET, 10.0)).max() < 0.03


@pytest.mark.parametrize("n", [1, 3, 30])
def test_a_handful_of_points_gives_finite_heights(n: int) -> None:
    points = np.random.default_rng(0).uniform(0, 1, (n, 3)).astype(np.float32)
    assert np.isfinite(fit_ground(points).z_at(FEET)).all()


def test_an_empty_cloud_and_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="empty"):
        fit_ground(np.empty((0, 3), np.float32))
    with pytest.raises(ValueError, match="points_world"):
        fit_ground(np.zeros((5, 2), np.float32))
    with pytest.raises(ValueError, match="finite"):
        fit_ground(np.full((5, 3), np.nan, np.float32))
    with pytest.raises(ValueError, match="terrain"):
        TerrainGround(np.full((3, 3), np.nan, np.float32), np.zeros(2), 1.0, np.zeros(2), np.ones((3, 3), bool))


@pytest.mark.parametrize("method", ["terrain", "plane"])
def test_cancel_stops_the_work(method: str) -> None:
    def cancel(fraction: float, message: str = "") -> None:
        if fraction > 0.3:
            raise CancelledError

    with pytest.raises(CancelledError):
        fit_ground(plot(), settings=GroundSettings(method=method), progress=cancel)


def test_a_wide_cloud_without_ground_has_bases_and_can_be_cancelled_while_they_settle() -> None:
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(0, 60, (200_000, 2)), rng.uniform(5, 20, 200_000)])
    xyz[:, 2] += 1.5 * np.sin(xyz[:, 0])
    points = xyz.astype(np.float32)
    points[::1000] = np.inf
    seen: list[float] = []
    ground = fit_ground(points, progress=lambda fraction, message="": seen.append(fraction))
    assert isinstance(ground, StemBaseGround)
    assert seen == sorted(seen)
    assert seen[-1] > 0.9
    # Bases are at least half a metre apart, each on one of the lowest points about it.
    bases = ground.bases_m
    assert len(bases) > 500
    assert cKDTree(bases[:, :2]).query(bases[:, :2], k=2)[0][:, 1].min() >= 0.5
    near = cKDTree(xyz[np.isfinite(points).all(axis=1), :2]).query_ball_point(bases[:, :2], 0.4)
    z = xyz[np.isfinite(points).all(axis=1), 2]
    lower = [int(np.count_nonzero(z[rows] < base[2] - 0.01)) for rows, base in zip(near, bases, strict=True)]
    assert np.mean(np.asarray(lower) <= 3) > 0.9

    def cancel(fraction: float, message: str = "") -> None:
        if fraction > 0.9:
            raise CancelledError

    with pytest.raises(CancelledError):
        fit_ground(points, progress=cancel)


@pytest.mark.parametrize("n", [1, 2])
def test_too_few_points_for_a_plane_give_a_flat_one_and_say_so(n: int) -> None:
    points = np.array([[1.0, 2.0, 3.5], [4.0, 2.0, 3.0]], np.float32)[:n]
    ground = fit_ground(points, settings=GroundSettings(method="plane"))
    assert isinstance(ground, PlaneGround)
    assert ground.z_at(FEET).tolist() == [float(points[:, 2].min())] * len(FEET)
    assert "plane" in ground.notes[0]
    with pytest.raises(ValueError, match="finite"):
        fit_ground(np.full((n, 3), np.nan, np.float32), settings=GroundSettings(method="plane"))


def test_points_in_a_row_carry_no_plane_and_that_is_said() -> None:
    points = np.column_stack([np.zeros(40), np.zeros(40), np.linspace(0, 5, 40)]).astype(np.float32)
    ground = fit_ground(points, settings=GroundSettings(method="plane", plane_tolerance_m=0.01))
    assert np.isfinite(ground.z_at(FEET)).all()
    assert ground.notes


@pytest.mark.parametrize("kind", ["plane", "terrain", "stem_base"])
def test_no_ground_within_a_box_is_higher_than_its_highest(kind: str) -> None:
    rng = np.random.default_rng(11)
    nodes = rng.normal(100.0, 0.3, (12, 9)).astype(np.float32)
    slope = np.array([0.4, -0.3])
    ground = {
        "plane": PlaneGround(np.array([*slope, 5.0])),
        "terrain": TerrainGround(nodes, np.array([3.0, -2.0]), 0.5, slope, np.ones(nodes.shape, bool)),
        "stem_base": StemBaseGround(rng.uniform(-5.0, 5.0, (7, 3))),
    }[kind]
    # Inside the grid, across its rim, and around it.
    for lower, upper in (([4.0, -1.0], [6.0, 1.0]), ([0.0, -9.0], [5.0, 0.0]), ([-20.0, -20.0], [30.0, 25.0])):
        within = rng.uniform(lower, upper, (4000, 2))
        highest, seen = ground.highest_z(np.array(lower), np.array(upper)), float(ground.z_at(within).max())
        size = float(np.subtract(upper, lower).sum())
        assert seen <= highest <= seen + 0.5 * size + 2.0 * (kind == "terrain") + 10.0 * (kind == "stem_base")
