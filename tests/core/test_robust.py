"""RANSAC and the robust circle: right in spite of much that is not bark, and the same every time."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.curves import CURVES, Fourier
from dbh_studio.core.curves.base import outline_metrics
from dbh_studio.core.robust import canonical_order, ransac, robust_circle, tukey_sigma


def noisy_ring(n=600, radius=1.0, noise=0.01, arc_deg=360.0, centre=(0.0, 0.0), seed=0):
    rng = np.random.default_rng(seed)
    t = rng.uniform(0, np.radians(arc_deg), n)
    r = radius + noise * rng.standard_normal(n)
    return np.stack([r * np.cos(t), r * np.sin(t)], axis=1) + centre


def run(uv, name="fourier", **options):
    arguments = {"n_samples": 50, "tolerance": 0.1, "n_iterations": 100, "rng": np.random.default_rng(0), **options}
    return ransac(uv, CURVES[name], **arguments)


@pytest.mark.parametrize(("name", "tolerance"), [("fourier", 0.002), ("ellipse", 0.002), ("bspline", 0.03)])
def test_outliers_do_not_move_the_curve(name, tolerance):
    rng = np.random.default_rng(5)
    uv = np.concatenate([noisy_ring(), rng.uniform(1.2, 1.6, (60, 2)), rng.uniform(-0.3, 0.3, (30, 2))])
    fit = run(uv, name)
    assert fit is not None
    assert outline_metrics(CURVES[name].outline(fit.params))[0] == pytest.approx(2 * np.pi, rel=tolerance)
    assert fit.inliers[:600].mean() > 0.99
    assert not fit.inliers[600:].any()


@pytest.mark.parametrize("name", CURVES)
def test_same_seed_same_result(name):
    uv = noisy_ring(noise=0.05)
    first, again = run(uv, name), run(uv, name)
    np.testing.assert_array_equal(first.params, again.params)


@pytest.mark.parametrize("name", CURVES)
def test_too_few_points_is_none(name):
    assert run(noisy_ring(5), name) is None
    assert run(np.empty((0, 2)), name) is None


@pytest.mark.parametrize("name", CURVES)
def test_no_support_is_none(name):
    uv = np.random.default_rng(0).uniform(-50, 50, (8, 2))
    assert run(uv, name, tolerance=1e-6) is None


def test_every_hypothesis_with_the_same_inliers_gives_the_plain_least_squares_fit():
    """With noise far below the tolerance all points are inliers, and the paper's loop is one fit to all of them."""
    uv = noisy_ring(800, noise=0.01)
    np.testing.assert_allclose(run(uv).params, Fourier().fit(uv, np.ones((1, 800), bool))[0], atol=1e-12)


def test_batch_equals_the_loop_it_replaces():
    """The paper's loop written out, on the same samples: same support, same curve."""
    rng = np.random.default_rng(7)
    uv = np.concatenate([noisy_ring(400, noise=0.03), rng.uniform(-1.5, 1.5, (80, 2))])
    curve, tolerance = CURVES["fourier"], 0.1
    keys = np.random.default_rng(0).random((100, len(uv)), dtype=np.float32)
    best, support = None, -1
    for row in keys:
        sample = np.zeros((1, len(uv)), bool)
        sample[0, np.argpartition(row, 50)[:50]] = True
        inliers = curve.distance(curve.fit(uv, sample), uv) < tolerance
        params = curve.fit(uv, inliers)
        count = int((curve.distance(params, uv) < tolerance).sum())
        if count > support:
            best, support = params[0], count
    fit = run(uv, tolerance=tolerance)
    assert fit.inliers.sum() == support
    perimeter = outline_metrics(curve.outline(best))[0]
    assert outline_metrics(curve.outline(fit.params))[0] == pytest.approx(perimeter, rel=2e-3)


@pytest.mark.parametrize("name", CURVES)
def test_large_section_is_thinned_for_the_search_but_fitted_with_all_points(name):
    uv = noisy_ring(6000, noise=0.02)
    fit = run(uv, name)
    assert fit.inliers.shape == (6000,)
    assert fit.inliers.mean() > 0.97


def test_thinning_the_search_stays_within_its_own_scatter():
    """With 14 % uniform outliers, seeds alone move the paper's loop by 0.3 % about a bias of 0.9 %."""
    uv = np.concatenate([noisy_ring(5000, noise=0.05), np.random.default_rng(1).uniform(-1.5, 1.5, (800, 2))])
    thinned = run(uv, tolerance=0.2)
    complete = ransac(
        uv, Fourier(n_score=10**6), n_samples=50, tolerance=0.2, n_iterations=100, rng=np.random.default_rng(0)
    )
    perimeters = [outline_metrics(Fourier().outline(fit.params))[0] for fit in (thinned, complete)]
    assert perimeters[0] == pytest.approx(perimeters[1], rel=0.015)
    assert perimeters[0] == pytest.approx(2 * np.pi, rel=0.005)


def test_many_iterations_run_in_bounded_chunks():
    assert run(noisy_ring(200), n_iterations=700) is not None


def test_canonical_order_undoes_any_order():
    points = np.random.default_rng(0).integers(0, 4, (50, 3)).astype(float)
    shuffled = np.random.default_rng(1).permutation(points)
    np.testing.assert_array_equal(points[canonical_order(points)], shuffled[canonical_order(shuffled)])


class TestRobustCircle:
    def fit(self, uv, **options):
        return robust_circle(uv, tolerance_m=0.05, max_radius_m=1.5, rng=np.random.default_rng(0), **options)

    @pytest.mark.parametrize("radius", [0.03, 0.1, 0.3, 1.0])
    def test_radius_and_centre(self, radius):
        circle = self.fit(noisy_ring(500, radius, noise=0.002, centre=(0.4, -0.2)))
        assert circle.radius_m == pytest.approx(radius, abs=1e-3)
        np.testing.assert_allclose(circle.centre_m, [0.4, -0.2], atol=1e-3)
        assert circle.sigma_m == pytest.approx(0.002, rel=0.3)

    def test_half_of_the_points_elsewhere(self):
        rng = np.random.default_rng(3)
        clutter = rng.uniform(-0.6, 0.6, (300, 2))
        circle = self.fit(np.concatenate([noisy_ring(300, 0.2, noise=0.004), clutter]))
        assert circle.radius_m == pytest.approx(0.2, rel=0.03)

    def test_partial_arc(self):
        circle = self.fit(noisy_ring(400, 0.2, noise=0.003, arc_deg=150))
        assert circle.radius_m == pytest.approx(0.2, rel=0.03)

    def test_neighbour_stem_beside_a_larger_one(self):
        uv = np.concatenate([noisy_ring(500, 0.2, noise=0.004), noisy_ring(150, 0.1, noise=0.004, centre=(0.5, 0))])
        circle = self.fit(uv)
        assert circle.radius_m == pytest.approx(0.2, rel=0.02)

    @pytest.mark.parametrize(
        "uv",
        [np.zeros((50, 2)), np.stack([np.linspace(0, 1, 50), np.zeros(50)], axis=1), noisy_ring(5), np.empty((0, 2))],
        ids=["one spot", "line", "five points", "nothing"],
    )
    def test_what_is_not_round_is_none(self, uv):
        assert self.fit(uv) is None

    def test_larger_than_allowed_is_none_or_smaller(self):
        circle = robust_circle(noisy_ring(500, 0.8), tolerance_m=0.05, max_radius_m=0.3, rng=np.random.default_rng(0))
        assert circle is None or circle.radius_m < 0.3


@pytest.mark.parametrize("n", [1, 2, 3, 8, 501])
def test_the_robust_deviation_is_by_the_median(n):
    error = np.random.default_rng(n).normal(size=n)
    assert tukey_sigma(error) == 1.4826 * float(np.median(np.abs(error)))
