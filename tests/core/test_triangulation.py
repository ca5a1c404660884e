import numpy as np
import pytest

from dbh_studio.core.dbh import Refusal
from dbh_studio.core.triangulation import Triangulated, triangulate


def views(rng, n=8, point=(1.0, 2.0, 3.0), sigma_rad=1e-3):
    origins = rng.normal(size=(n, 3)) * 4
    rays = np.asarray(point) - origins
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    noise = np.cross(rays, rng.normal(size=(n, 3)))
    noise *= rng.normal(0, sigma_rad, (n, 1)) * np.sqrt(2) / np.linalg.norm(noise, axis=1, keepdims=True)
    return origins, rays + noise


def test_exact_rays_meet_in_the_point_also_far_from_the_origin():
    rng = np.random.default_rng(1)
    far = np.array([4.5e6, 5.4e5, 300.0])
    origins, rays = views(rng, sigma_rad=0.0)
    found = triangulate(origins + far, rays, 1e-4)
    assert isinstance(found, Triangulated)
    assert np.abs(found.point - far - (1, 2, 3)).max() < 1e-7
    assert found.inliers.all()
    assert found.residuals_rad.max() < 1e-7


def test_the_covariance_is_what_many_repetitions_show():
    rng = np.random.default_rng(2)
    origins, _ = views(rng, n=10)
    true = np.array([1.0, 2.0, 3.0])
    errors, covariances = [], []
    for _ in range(300):
        rays = true - origins
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        found = triangulate(origins, rays + rng.normal(0, 1e-3, rays.shape), 1e-3)
        errors.append(found.point - true)
        covariances.append(found.covariance)
    measured, said = np.cov(np.array(errors).T), np.mean(covariances, axis=0)
    assert np.trace(said) == pytest.approx(np.trace(measured), rel=0.3)


def test_wrong_clicks_are_left_out():
    rng = np.random.default_rng(3)
    origins, rays = views(rng, n=9)
    rays[[2, 5]] = rng.normal(size=(2, 3))
    found = triangulate(origins, rays, 1e-3)
    assert not found.inliers[[2, 5]].any()
    assert found.inliers.sum() == 7
    assert np.linalg.norm(found.point - (1, 2, 3)) < 0.02


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_the_answer_scales_with_the_scene(scale):
    rng = np.random.default_rng(4)
    origins, rays = views(rng)
    one, other = triangulate(origins, rays, 1e-3), triangulate(scale * origins, rays, 1e-3)
    assert np.allclose(other.point, scale * one.point, rtol=1e-6)
    assert np.allclose(other.covariance, scale**2 * one.covariance, rtol=1e-4)


def test_parallax_is_the_largest_angle_between_two_rays():
    found = triangulate([[-1.0, 0, 0], [1.0, 0, 0]], [[1.0, 0, 1.0], [-1.0, 0, 1.0]], 1e-3)
    assert found.parallax_deg == pytest.approx(90.0)
    assert np.allclose(found.point, [0, 0, 1])


@pytest.mark.parametrize(
    ("origins", "rays", "code"),
    [
        ([[0.0, 0, 0]], [[0, 0, 1.0]], "one_view"),
        (np.zeros((0, 3)), np.zeros((0, 3)), "one_view"),
        ([[0.0, 0, 0], [1, 0, 0]], [[0, 0, 1.0], [0, 0, 1.0]], "parallel"),
        ([[0.0, 0, 0], [0, 0, 0]], [[0, 0, 1.0], [0, 1, 1.0]], "parallel"),
        ([[0.0, 0, 0], [1, 0, 0]], [[-1.0, 0, 1.0], [1.0, 0, 1.0]], "behind"),
        ([[0.0, 0, 0], [1, 0, 0]], [[np.nan, 0, 1.0], [1.0, 0, 1.0]], "bad_ray"),
    ],
)
def test_degenerate_cases_are_named(origins, rays, code):
    answer = triangulate(origins, rays, 1e-3)
    assert isinstance(answer, Refusal)
    assert answer.code == code
    assert answer.reason and answer.remedy


def test_views_of_different_things_are_refused():
    rng = np.random.default_rng(5)
    answer = triangulate(rng.normal(size=(6, 3)) * 5, rng.normal(size=(6, 3)), 1e-5)
    assert not isinstance(answer, Triangulated) or answer.inliers.sum() <= 3


def test_a_sigma_of_zero_is_a_wrong_call():
    with pytest.raises(ValueError, match="positive"):
        triangulate([[0.0, 0, 0], [1, 0, 0]], [[0, 0, 1.0], [0, 1, 1.0]], 0.0)


@pytest.mark.parametrize("miss_rad", [0.01, 0.2])
def test_two_views_of_different_points_are_refused(miss_rad):
    """Two rays always have a nearest point, also where they pass each other."""
    rays = [[1.0, miss_rad, 1.0], [-1.0, -miss_rad, 1.0]]
    answer = triangulate([[-1.0, 0, 0], [1.0, 0, 0]], rays, 1e-3)
    assert isinstance(answer, Refusal)
    assert answer.code == "disagree" and "two views" in answer.reason


def test_without_the_rejected_ray_too_little_parallax_may_be_left():
    """The one ray from the side is far off once the others agree, and they look from nearly one direction."""
    origins = [[0.049, -0.008, -0.054], [0.044, -0.064, -0.036], [8.0, 0.0, 0.0]]
    rays = [[-0.055, 0.009, 10.053], [-0.042, 0.071, 10.028], [-7.986, 0.122, 10.008]]
    answer = triangulate(origins, rays, 2e-3)
    assert isinstance(answer, Refusal) and answer.code == "parallel"
