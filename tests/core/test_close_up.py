"""A point on an enlarged surface, against planes and a sphere whose equations are known."""

import numpy as np
import pytest

from dbh_studio.core.close_up import CloseUp, points_near

SPACING = 0.01


def plane(normal, *, n=40_000, size=1.0, noise=0.0, seed=0):
    """Points of a plane through the origin."""
    rng = np.random.default_rng(seed)
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    first = np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.9 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    across = rng.uniform(-size / 2, size / 2, (n, 2))
    return across[:, :1] * first + across[:, 1:] * second + rng.normal(0, noise, (n, 1)) * normal, normal


def looking_down():
    """Rows right, down and away of a look along -z."""
    return np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])


def test_points_near_are_those_in_the_cube():
    points = np.random.default_rng(1).uniform(-1, 1, (5000, 3)).astype(np.float32)
    centre = np.array([0.2, -0.1, 0.3])
    expected = np.flatnonzero((np.abs(points - centre) <= 0.25).all(axis=1))
    assert 0 < len(expected) < 5000
    np.testing.assert_array_equal(points_near(points, centre, 0.25), expected)
    assert len(points_near(np.empty((0, 3)), centre, 1.0)) == 0


@pytest.mark.parametrize("tilt_deg", [0, 40, 65, 75])
def test_a_place_between_samples_lies_on_the_plane(tilt_deg):
    angle = np.deg2rad(tilt_deg)
    points, normal = plane([np.sin(angle), 0, np.cos(angle)], noise=0.001)
    close_up = CloseUp.of(points, None, np.zeros(3), looking_down(), 0.08)
    for x, y in ((0.5, 0.5), (0.31, 0.62), (0.7, 0.45)):
        found = close_up.surface_at(x, y)
        assert abs(found.xyz @ normal) < 0.001
        np.testing.assert_allclose(close_up.place_of(found.xyz), (x, y), atol=1e-9)
        assert abs(found.normal @ normal) > np.cos(np.deg2rad(5))
        assert found.normal[2] > 0  # towards the eye


def test_the_front_of_two_surfaces_is_taken_and_a_floating_point_is_not():
    front, _ = plane([0, 0, 1.0])
    back, _ = plane([0, 0, 1.0], seed=2)
    floating = np.array([[0.0, 0.0, 0.09]])
    points = np.concatenate([back - [0, 0, 0.1], front, floating])
    found = CloseUp.of(points, None, np.zeros(3), looking_down(), 0.08).surface_at(0.5, 0.5)
    assert abs(found.xyz[2]) < 0.001


def test_where_there_is_no_plane_the_nearest_point_is_taken():
    rng = np.random.default_rng(4)
    twig = np.column_stack([np.linspace(-0.1, 0.1, 60), np.zeros(60), np.zeros(60)]) + rng.normal(0, 1e-5, (60, 3))
    found = CloseUp.of(twig, None, np.zeros(3), looking_down(), 0.05).surface_at(0.5, 0.53)
    assert np.linalg.norm(twig - found.xyz, axis=1).min() < 1e-12
    assert found.normal is None


def test_nothing_there_is_none_and_a_width_of_nothing_is_an_error():
    far, _ = plane([0, 0, 1.0])
    assert CloseUp.of(far + [9, 0, 0], None, np.zeros(3), looking_down(), 0.05).surface_at(0.5, 0.5) is None
    with pytest.raises(ValueError, match="half_width"):
        CloseUp.of(far, None, np.zeros(3), looking_down(), 0.0)


def test_the_error_grows_with_the_spacing_and_with_the_pointing():
    fine, coarse = (plane([0, 0, 1.0], n=n)[0] for n in (40_000, 2_500))
    shown = [CloseUp.of(points, None, np.zeros(3), looking_down(), 0.1) for points in (fine, coarse)]
    # Four times the distance between neighbours.
    assert shown[1].spacing == pytest.approx(4 * shown[0].spacing, rel=0.2)
    sigmas = [each.surface_at(0.5, 0.5).sigma for each in shown]
    assert sigmas[1] == pytest.approx(4 * sigmas[0], rel=0.2)
    assert shown[0].surface_at(0.5, 0.5, pointing_sigma=0.05).sigma == pytest.approx(0.05, rel=0.02)


def test_the_picture_shows_colours_where_they_are_and_the_front_before_the_back():
    points, _ = plane([0, 0, 1.0])
    rgb = np.where(points[:, :1] < 0, np.array([[200, 0, 0]]), np.array([[0, 0, 200]])).astype(np.uint8)
    behind = points - [0, 0, 0.03]
    everything = np.concatenate([points, behind])
    colours = np.concatenate([rgb, np.full_like(rgb, 90)])
    picture = CloseUp.of(everything, colours, np.zeros(3), looking_down(), 0.05).picture(120)
    assert picture.shape == (120, 120, 3)
    # Left red, right blue; the grey surface behind is covered.
    np.testing.assert_array_equal(np.median(picture[10:110, 10:50].reshape(-1, 3), axis=0), [200, 0, 0])
    np.testing.assert_array_equal(np.median(picture[10:110, 70:110].reshape(-1, 3), axis=0), [0, 0, 200])


def test_a_cloud_without_colours_has_a_picture_too():
    points, _ = plane([0, 0, 1.0])
    picture = CloseUp.of(points, None, np.zeros(3), looking_down(), 0.05).picture(60)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 1
    empty = CloseUp.of(points + 9, None, np.zeros(3), looking_down(), 0.05).picture(60)
    assert len(np.unique(empty.reshape(-1, 3), axis=0)) == 1
