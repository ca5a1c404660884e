"""How photos weigh in a marker's size: near ones are believed, far ones as far as they agree with them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbh_studio.stages.marker_corners import middle_rays, place_corners, side_of
from dbh_studio.stages.marker_sizes import weigh_sizes

SIDE_M = 0.5
PIXEL_RAD = 2 * np.pi / 2048
STANDING = SIDE_M / 2 * np.array([[-1.0, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]]) + (0, 0, 1)


def test_photos_that_agree_all_count():
    footprint = np.linspace(1, 4, 12)
    weights = weigh_sizes(np.zeros(12), np.full(12, 0.002), footprint, 1e-6)
    assert weights.share == pytest.approx(np.full(12, 1 / 12), rel=0.01)
    assert weights.steepness == 1.0
    assert weights.drift < 1e-5


def test_a_noisy_photo_counts_less():
    noise = np.full(8, 0.001)
    noise[3] = 0.004
    sizes = np.random.default_rng(1).normal(0, noise)
    weights = weigh_sizes(sizes, noise, np.ones(8), 1e-6)
    assert weights.share.sum() == pytest.approx(1.0)
    assert weights.share[3] < 0.25 * np.delete(weights.share, 3).min()


@pytest.mark.parametrize("seed", range(4))
def test_far_photos_that_show_it_smaller_hardly_count(seed):
    rng = np.random.default_rng(seed)
    footprint = np.linspace(1, 6, 24)
    sizes = np.where(footprint < 2.5, 0.0, -0.008) + rng.normal(0, 0.0005, 24)
    weights = weigh_sizes(sizes, np.full(24, 0.0005), footprint, 0.0003)
    assert sizes.mean() < -0.005
    assert abs(weights.share @ sizes) < 0.0015
    assert weights.steepness > 2
    assert abs(weights.share @ sizes) < 2 * np.hypot(weights.drift, weights.noise)


def walk(seed, n=24, shrunk=0.008, noise_px=0.04):
    """Photos before a standing marker, which is drawn smaller, towards its first corner, from 4.5 m on."""
    rng = np.random.default_rng(seed)
    starts, rays = [], []
    for reach in np.linspace(1.8, 9.0, n):
        angle = -np.pi / 2 + rng.uniform(-1.0, 1.0)
        start = np.array([reach * np.cos(angle), reach * np.sin(angle), rng.uniform(1.5, 2.2)])
        corners = STANDING if reach < 4.5 else STANDING[0] + (1 - shrunk) * (STANDING - STANDING[0])
        towards = corners - start
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        towards += noise_px * PIXEL_RAD * rng.normal(size=(4, 3))
        turn = Rotation.from_rotvec(np.radians(rng.normal(0, 0.05 if noise_px else 0.0, 3))).as_matrix()
        rays.append(towards / np.linalg.norm(towards, axis=1, keepdims=True) @ turn)
        starts.append(start + rng.normal(0, 0.003 if noise_px else 0.0, 3))
    sigma = np.full(n, max(noise_px, 0.02) * PIXEL_RAD)
    return np.array(starts), np.array(rays), sigma, np.full(n, PIXEL_RAD), STANDING.mean(axis=0), 0.03


def test_exact_rays_give_exact_corners():
    placed = place_corners(*walk(0, shrunk=0.0, noise_px=0.0))
    assert np.abs(placed.corners - STANDING).max() < 1e-9
    assert side_of(placed.corners) == pytest.approx(SIDE_M, rel=1e-9)


def test_the_middle_is_where_the_diagonals_cross():
    starts, rays, *_ = walk(0, shrunk=0.0, noise_px=0.0)
    towards = STANDING.mean(axis=0) - starts
    assert np.allclose(middle_rays(rays), towards / np.linalg.norm(towards, axis=1, keepdims=True), atol=1e-12)


def test_far_photos_do_not_make_the_marker_smaller():
    errors, sigmas = [], []
    for seed in range(10):
        placed = place_corners(*walk(seed))
        errors.append(side_of(placed.corners) / SIDE_M - 1)
        sigmas.append(np.hypot(placed.size_sigma, placed.weights.drift))
    errors, sigmas = np.array(errors), np.array(sigmas)
    assert np.sqrt((errors**2).mean()) < 0.002
    assert (np.abs(errors) < 2 * sigmas).sum() >= 9
    assert np.median(sigmas) < 0.003


def test_views_from_one_direction_place_nothing():
    starts, rays, *rest = walk(0, n=4, shrunk=0.0, noise_px=0.0)
    same = [np.repeat(values[:1], 4, axis=0) for values in (starts, rays)]
    assert place_corners(*same, *rest) is None
