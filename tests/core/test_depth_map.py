"""What stands in front of what: walls, holes, nearness, every direction."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.depth_map import DepthMap


def sphere(n: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(n, 3))
    return (points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)


def wall(distance: float, half_width: float, spacing: float) -> np.ndarray:
    """A square wall across +x."""
    side = np.arange(-half_width, half_width + spacing / 2, spacing)
    y, z = np.meshgrid(side, side)
    return np.column_stack([np.full(y.size, distance), y.ravel(), z.ravel()]).astype(np.float32)


def test_one_point_hides_what_is_behind_it_in_every_direction_and_nothing_else():
    for direction in sphere(200):
        depth = DepthMap.of(2.0 * direction[None], spacing=0.05)
        np.testing.assert_allclose(depth.range_at(5.0 * direction[None])[0], 2.0, rtol=1e-5)
        assert depth.is_hidden(
            np.stack([5.0 * direction, 1.0 * direction, -5.0 * direction]), tolerance=0.1
        ).tolist() == [
            True,
            False,
            False,
        ]


def test_tolerances_are_in_length_and_as_a_share_of_the_distance():
    depth = DepthMap.of(np.array([[4.0, 0.0, 0.0]]), spacing=0.05)
    behind = np.array([[4.1, 0.0, 0.0], [4.3, 0.0, 0.0]])
    assert depth.is_hidden(behind, tolerance=0.05).tolist() == [True, True]
    assert depth.is_hidden(behind, tolerance=0.2).tolist() == [False, True]
    assert depth.is_hidden(behind, tolerance=0.0, tolerance_share=0.05).tolist() == [False, True]


@pytest.mark.parametrize("distance", [0.4, 1.5, 4.0, 12.0])
def test_a_wall_of_points_has_no_holes_however_near_and_its_outline_holds(distance):
    spacing, half = 0.03, 0.6
    points = wall(distance, half, spacing)
    jitter = np.random.default_rng(0).uniform(-spacing / 3, spacing / 3, points.shape)
    depth = DepthMap.of((points + jitter).astype(np.float32), spacing=spacing)
    # Directions through the wall, and beside it by more than a point may reach: its cover, doubled to a power of two.
    rng = np.random.default_rng(1)
    through = np.column_stack([np.full(4000, distance), rng.uniform(-0.95 * half, 0.95 * half, (4000, 2))])
    assert depth.is_hidden(3.0 * through, tolerance=0.5).mean() > 0.995
    pixel = 2.0 / 512 * distance
    beside = through.copy()
    beside[:, 1] = half + 2.0 * max(2.4 * spacing, pixel) + rng.uniform(0.0, 1.0, 4000)
    assert not depth.is_hidden(3.0 * beside, tolerance=0.5).any()


def test_a_wall_all_round_hides_everything_corners_of_the_cube_included():
    # Neighbours are about 3 √(4π/n) = 2 cm apart, at random: three such lengths square are empty once in e⁹ times.
    depth = DepthMap.of(3.0 * sphere(300_000, 1), spacing=3.0 * float(np.sqrt(4 * np.pi / 300_000)), cover=3.0)
    others = 8.0 * sphere(20_000, 2)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    assert depth.is_hidden(others, tolerance=0.1).mean() > 0.999
    assert depth.is_hidden(5.0 * corners, tolerance=0.1).all()
    assert not depth.is_hidden(0.3 * others, tolerance=0.1).any()


def test_a_surface_does_not_hide_itself():
    points = wall(5.0, 1.5, 0.02)
    assert not DepthMap.of(points, spacing=0.02).is_hidden(points, tolerance=0.12).any()


def test_points_at_the_camera_are_left_out_and_an_empty_map_hides_nothing():
    depth = DepthMap.of(np.zeros((3, 3)), spacing=0.1)
    assert np.isinf(depth.range_).all()
    assert not DepthMap.of(np.empty((0, 3)), spacing=0.1).is_hidden(sphere(10), tolerance=0.0).any()


@pytest.mark.parametrize(
    "wrong", [{"spacing": 0.0}, {"spacing": np.nan}, {"spacing": 0.1, "size": 100}, {"spacing": 0.1, "cover": 0.0}]
)
def test_bad_sizes_are_refused(wrong):
    with pytest.raises(ValueError, match=r"must be positive|power of two"):
        DepthMap.of(sphere(5), **wrong)
