"""What must not move a diameter: the direction of the noise, bark that is not there."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.estimator import EstimatorResult, estimate_diameter
from dbh_studio.core.estimator.bark import bark_share
from dbh_studio.core.estimator.tube import Tube
from dbh_studio.core.estimator.viewing import Viewing, on_bark, viewing_of
from dbh_studio.settings import EstimatorSettings

SMOOTH = EstimatorSettings(bark_share=0.0, max_half_width=1.0, max_depth_noise=1.0, min_arc_deg=0.0)
RADIUS = 0.17


def arc(arc_deg, noise, kind, seed, n=2500):
    """An upright stem seen from the side of x: noise along rays, across the bark, or alike in all directions."""
    rng = np.random.default_rng(seed)
    half = np.radians(arc_deg / 2)
    t = rng.uniform(-half, half, n)
    points = np.column_stack([RADIUS * np.cos(t), RADIUS * np.sin(t), rng.uniform(0.6, 2.1, n)])
    if kind == "ray":
        way = np.array([4.0, 0.0, 1.6]) - points
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        return points + noise * rng.standard_normal((n, 1)) * way + 0.2 * noise * rng.standard_normal((n, 3))
    if kind == "across":
        return points * (1.0 + noise * rng.standard_normal((n, 1)) / RADIUS * [1, 1, 0])
    return points + noise * rng.standard_normal((n, 3))


def seen(points):
    """Polar coordinates about the true axis, errors and their width."""
    tube = Tube(np.zeros(2), np.zeros(2), RADIUS, 0.0, np.empty(0), 0.01)
    at = tube.polar(points - [0, 0, 1.3])
    error = at.distance - tube.surface(at)
    return tube, at, error, 1.4826 * float(np.median(np.abs(error)))


def relative_error(points):
    result = estimate_diameter(points, settings=SMOOTH)
    assert isinstance(result, EstimatorResult)
    return result.dbh_cm / (200 * RADIUS) - 1.0


class TestViewing:
    def test_a_point_is_taken_back_along_its_ray(self):
        """Errors straight along x: the place on the bark that each point came from is found again."""
        tube = Tube(np.zeros(2), np.zeros(2), RADIUS, 0.0, np.empty(0), 0.01)
        t, off = np.linspace(-1.1, 1.1, 41), 0.008 * np.cos(7.0 * np.arange(41))
        points = np.column_stack([RADIUS * np.cos(t) + off, RADIUS * np.sin(t), np.zeros(41)])
        at = tube.polar(points)
        found = on_bark(at, at.distance - RADIUS, tube, Viewing(0.0, 0.0, 1.0))
        np.testing.assert_allclose(found.at.angle(), t, atol=0.006)
        np.testing.assert_allclose(found.error, off * np.cos(t), atol=2e-4)
        np.testing.assert_allclose(found.at.distance, RADIUS + found.error, atol=1e-12)
        np.testing.assert_allclose(found.variance, np.cos(t) ** 2 / (np.cos(t) ** 2).mean(), atol=0.02)

    @pytest.mark.parametrize("arc_deg", [110, 150, 190])
    def test_noise_along_the_rays_is_recognised(self, arc_deg):
        _, at, error, sigma = seen(arc(arc_deg, 0.01, "ray", 1))
        viewing = viewing_of(at, error, sigma)
        assert viewing is not None
        assert viewing.middle == pytest.approx(0.0, abs=0.1)
        assert viewing.reach == pytest.approx(max(np.radians(arc_deg / 2 - 75), 0.0), abs=0.12)
        assert viewing.along > 0.6

    @pytest.mark.parametrize("kind", ["across", "alike"])
    def test_other_noise_and_whole_rings_are_left_alone(self, kind):
        assert sum(viewing_of(*seen(arc(150, 0.01, kind, seed))[1:]) is not None for seed in range(12)) <= 2
        tube, at, error, sigma = seen(arc(360, 0.01, kind, 0))
        assert viewing_of(at, error, sigma) is None
        assert on_bark(at, error, tube, None).error is error

    @pytest.mark.parametrize(("arc_deg", "noise", "within"), [(140, 0.02, 0.04), (100, 0.008, 0.03)])
    def test_an_arc_seen_from_one_side_is_not_read_thin(self, arc_deg, noise, within):
        """Without the rays taken into account both read 5 % too thin, whatever the number of points."""
        found = [relative_error(arc(arc_deg, noise, "ray", seed)) for seed in range(5)]
        assert abs(np.median(found)) < within

    def test_an_arc_cut_out_of_a_ring_is_read_as_before(self):
        found = [relative_error(arc(140, 0.012, "across", seed)) for seed in range(5)]
        assert abs(np.median(found)) < 0.015


class TestBark:
    tube = Tube(np.zeros(2), np.zeros(2), RADIUS, 0.0, np.empty(0), 0.003)

    def points(self, ridge, noise, n=4000, waves=18):
        rng = np.random.default_rng(3)
        t, z = rng.uniform(-np.pi, np.pi, n), rng.uniform(-0.5, 0.7, n)
        r = RADIUS * (1.0 + ridge * np.cos(waves * t + 2.0 * z)) + noise * rng.standard_normal(n)
        return np.column_stack([r * np.cos(t), r * np.sin(t), z])

    def test_the_rougher_the_more_and_never_less_than_nothing(self):
        found = [bark_share(self.points(ridge, 0.002), self.tube, expected=0.007)[0] for ridge in (0.0, 0.008, 0.016)]
        assert 0.0 <= found[0] < 0.0015 < found[1] < found[2]
        # The root mean square of a wave is its height over √2; a tape reads 1.1 times that too much.
        assert found[1] == pytest.approx(1.1 * 0.008 / np.sqrt(2), rel=0.45)

    def test_what_noise_drowns_is_left_to_the_expectation(self):
        tube = Tube(np.zeros(2), np.zeros(2), RADIUS, 0.0, np.empty(0), 0.03)
        share, sd = bark_share(self.points(0.0, 0.03, n=300), tube, expected=0.007)
        assert share == pytest.approx(0.007, abs=0.0015)
        assert sd == pytest.approx(0.75 * 0.007, rel=0.2)  # of half a normal distribution: √(π/2 - 1) of its mean
        assert bark_share(self.points(0.0, 0.03, n=300), tube, expected=0.0) == (0.0, 0.0)

    def test_slow_waves_are_shape_and_not_bark(self):
        slow, _ = bark_share(self.points(0.012, 0.002, waves=2), self.tube, expected=0.007)
        ridges, _ = bark_share(self.points(0.012, 0.002, waves=18), self.tube, expected=0.007)
        assert slow < 0.25 * ridges

    def test_no_points_near_is_no_evidence(self):
        share, _ = bark_share(np.full((30, 3), 5.0), self.tube, expected=0.007)
        assert share == pytest.approx(0.007, rel=0.05)
