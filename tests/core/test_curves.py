"""The three curves on shapes whose perimeter is known, and the outline geometry under them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.special import ellipe

from dbh_studio.core.curves import CURVE_WORDS, CURVES, BSpline, Ellipse, Fourier
from dbh_studio.core.curves.alpha import alpha_boundaries
from dbh_studio.core.curves.base import contains, distance_to_outline, outline_centroid, outline_metrics
from dbh_studio.core.interval_methods import INTERVAL_METHODS
from dbh_studio.settings import CurveName, MeasureSettings


def ring(n=400, a=1.0, b=1.0, arc_deg=360.0, start_deg=0.0):
    t = np.radians(start_deg) + np.linspace(0, np.radians(arc_deg), n, endpoint=False)
    return np.stack([a * np.cos(t), b * np.sin(t)], axis=1)


def everything(n):
    return np.ones((1, n), bool)


def perimeter_of(curve, uv):
    return outline_metrics(curve.outline(curve.fit(uv, everything(len(uv)))[0]))[0]


def test_registry_has_every_name_a_setting_can_take():
    assert set(CURVES) | set(INTERVAL_METHODS) == set(CurveName.__args__) == set(CURVE_WORDS)
    assert not set(CURVES) & set(INTERVAL_METHODS)
    assert all(curve.name == name for name, curve in CURVES.items())


@pytest.mark.parametrize("name", CURVES)
def test_circle(name):
    assert perimeter_of(CURVES[name], ring()) == pytest.approx(2 * np.pi, rel=2e-3)


@pytest.mark.parametrize(("name", "tolerance"), [("fourier", 5e-4), ("ellipse", 1e-5), ("bspline", 5e-3)])
@pytest.mark.parametrize("b", [0.95, 0.8])
def test_ellipse_perimeter(name, b, tolerance):
    truth = 4 * ellipe(1 - b**2)
    assert perimeter_of(CURVES[name], ring(b=b)) == pytest.approx(truth, rel=tolerance)


def test_ellipse_turned_and_moved():
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    uv = ring(b=0.6) @ turn.T + [0.3, -0.2]
    outline = Ellipse().outline(Ellipse().fit(uv, everything(len(uv)))[0])
    perimeter, area, girth = outline_metrics(outline)
    assert perimeter == pytest.approx(4 * ellipe(1 - 0.36), rel=1e-5)
    assert area == pytest.approx(np.pi * 0.6, rel=1e-4)
    assert girth == pytest.approx(perimeter, rel=1e-9)
    np.testing.assert_allclose(outline_centroid(outline), [0.3, -0.2], atol=1e-9)


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("dents", [0.0, 0.02, 0.3])
def test_the_girth_is_that_of_the_convex_hull(dents, reverse):
    t = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    radius = 1.0 + dents * np.cos(5 * t)  # convex, hardly dented, a star
    outline = np.stack([radius * np.cos(t), radius * np.sin(t)], axis=1)[:: -1 if reverse else 1]
    perimeter, area, girth = outline_metrics(outline)
    hull = ConvexHull(outline)
    assert girth == pytest.approx(hull.area, rel=1e-12)
    is_convex = area == pytest.approx(hull.volume, rel=1e-9)
    assert is_convex == (dents < 0.3)
    assert (girth == pytest.approx(perimeter, rel=1e-9)) == is_convex


def test_the_girth_of_a_walk_that_turns_twice_is_not_its_length():
    """A loop gone round twice turns one way all along, and a tape goes round once."""
    t = np.linspace(0, 4 * np.pi, 720, endpoint=False)
    perimeter, _, girth = outline_metrics(np.stack([np.cos(t), np.sin(t)], axis=1))
    assert perimeter == pytest.approx(4 * np.pi, rel=1e-3)
    assert girth == pytest.approx(2 * np.pi, rel=1e-3)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_fourier_recovers_its_own_coefficients(degree):
    truth = np.array([1.0, 0.03, -0.05, 0.06, 0.02, -0.03, 0.04])[: 2 * degree + 1]
    curve = Fourier(degree=degree)
    t = np.sort(np.random.default_rng(0).uniform(-np.pi, np.pi, 200))
    radius = truth[0] + sum(
        truth[2 * i - 1] * np.cos(i * t) + truth[2 * i] * np.sin(i * t) for i in range(1, degree + 1)
    )
    uv = np.stack([radius * np.cos(t), radius * np.sin(t)], axis=1)
    np.testing.assert_allclose(curve.fit(uv, everything(200))[0], truth, atol=1e-8)
    assert curve.distance(curve.fit(uv, everything(200)), uv).max() < 1e-7


@pytest.mark.parametrize("name", CURVES)
def test_batch_equals_one_at_a_time(name):
    rng = np.random.default_rng(1)
    uv = ring(300, b=0.9) + 0.02 * rng.standard_normal((300, 2))
    members = rng.random((7, 300)) < 0.3
    together = CURVES[name].fit(uv, members)
    alone = np.concatenate([CURVES[name].fit(uv, row[None]) for row in members])
    for row in range(7):
        np.testing.assert_allclose(
            CURVES[name].outline(together[row]), CURVES[name].outline(alone[row]), rtol=1e-9, atol=1e-9
        )


@pytest.mark.parametrize(("name", "tolerance"), [("fourier", 1e-9), ("ellipse", 0.006), ("bspline", 0.004)])
def test_distance_is_what_it_is_on_a_circle(name, tolerance):
    curve = CURVES[name]
    params = curve.fit(ring(), everything(400))
    points = np.array([[1.1, 0.0], [0.0, 0.95], [-1.05, 0.0]])
    truth = [0.1, 0.05, 0.05]
    np.testing.assert_allclose(curve.distance(params, points)[0], truth, atol=max(tolerance, 2e-3))
    both = curve.distance(np.concatenate([params, params]), points)
    np.testing.assert_allclose(both, [truth, truth], atol=max(tolerance, 8e-3))


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize(
    "uv",
    [
        np.zeros((40, 2)) + 0.5,
        np.stack([np.linspace(-1, 1, 40), np.zeros(40)], axis=1),
        np.stack([np.linspace(-1, 1, 40), 0.3 + np.linspace(-1, 1, 40)], axis=1),
        ring(3),
        np.empty((0, 2)),
    ],
    ids=["one spot", "line through the origin", "line", "three points", "nothing"],
)
def test_what_is_no_ring_has_no_curve_through_it(name, uv):
    curve = CURVES[name]
    params = curve.fit(uv, everything(len(uv)))
    outline = curve.outline(params[0])
    if len(outline):  # a Fourier series goes through anything: it must not pretend to fit well inside limits
        assert np.isfinite(outline).all()
    if len(uv) < curve.n_min:
        assert not len(outline)
        assert not (curve.distance(params, ring(5)) < 1e6).any()


def test_ellipse_of_collinear_points_is_none():
    uv = np.stack([np.linspace(-1, 1, 40), 0.3 + 0.5 * np.linspace(-1, 1, 40)], axis=1)
    assert not len(Ellipse().outline(Ellipse().fit(uv, everything(40))[0]))


@pytest.mark.parametrize(
    "conic",
    [[1, 0, -1, 0, 0, -1], [1, 0, 0, 0, 1, 0], [1, 0, 1, 0, 0, 1], [np.nan] * 6],
    ids=["hyperbola", "parabola", "imaginary", "none"],
)
def test_conics_that_are_no_ellipse_have_no_outline(conic):
    assert Ellipse().outline(np.array(conic, float)).shape == (0, 2)


def test_fourier_with_a_radius_below_zero_has_no_outline():
    assert Fourier().outline(np.array([1.0, 1.5, 0, 0, 0])).shape == (0, 2)


def test_settings_reach_the_curves():
    settings = MeasureSettings(fourier_degree=4, spline_controls=11, alpha_radius=0.7)
    assert Fourier().configured(settings).degree == 4
    assert BSpline().configured(settings).n_controls == 11
    assert BSpline().configured(settings).alpha_radius == 0.7


def test_thin_alpha_radius_follows_a_hollow_that_a_wide_one_closes():
    half = ring(200, arc_deg=200)
    wide, thin = BSpline(alpha_radius=20.0), BSpline(alpha_radius=0.3, n_controls=16)
    filled = np.concatenate([half, 0.9 * half])
    assert perimeter_of(thin, filled) > 1.08 * perimeter_of(wide, filled)


def test_spline_of_a_crowded_section_equals_that_of_all_its_points():
    rng = np.random.default_rng(2)
    uv = ring(9000) * (1 + 0.03 * rng.standard_normal((9000, 1)))
    (boundary,), (valid,) = alpha_boundaries([uv], radius=2.0)
    all_points = BSpline()._fit_loops(boundary[None], valid[None])[0]
    few = BSpline().fit(uv, everything(9000))[0]
    np.testing.assert_allclose(
        outline_metrics(BSpline().outline(few))[0], outline_metrics(BSpline().outline(all_points))[0], rtol=1e-3
    )


class TestAlphaShape:
    def test_square_with_a_point_inside(self):
        points = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.4]], float)
        loops, valid = alpha_boundaries([points], radius=5.0)
        assert valid.sum() == 4
        assert {tuple(p) for p in loops[0][valid[0]]} == {(0, 0), (1, 0), (1, 1), (0, 1)}

    def test_loop_is_counter_clockwise_and_in_order(self):
        points = np.random.default_rng(3).permutation(ring(60))
        (loop,), (valid,) = alpha_boundaries([points], radius=2.0)
        turn = np.diff(np.unwrap(np.arctan2(loop[valid][:, 1], loop[valid][:, 0])))
        assert valid.sum() == 60
        assert (turn > 0).all()

    def test_large_loop_is_the_outer_one_of_an_annulus(self):
        points = np.concatenate([ring(200), 0.7 * ring(200)])
        (loop,), (valid,) = alpha_boundaries([points], radius=0.2)
        assert np.hypot(*loop[valid].T).min() == pytest.approx(1.0)

    def test_two_diamonds_touching_in_a_corner_are_walked_round_once(self):
        diamond = np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [0, 0]], float)
        points = np.unique(np.concatenate([diamond, diamond + np.array([2, 0])]), axis=0)
        loops, valid = alpha_boundaries([points], radius=0.8)
        area = outline_metrics(loops[0][valid[0]])[1]
        assert area == pytest.approx(4.0)
        assert valid.sum() == 8

    def test_sets_do_not_mix_and_degenerate_ones_are_empty(self):
        line = np.stack([np.linspace(0, 1, 9), np.zeros(9)], axis=1)
        loops, valid = alpha_boundaries([ring(30), line, 5 + ring(40), np.zeros((2, 2)), np.zeros((9, 2))], radius=3.0)
        assert valid.sum(axis=1).tolist() == [30, 0, 40, 0, 0]
        np.testing.assert_allclose(loops[2][valid[2]].mean(axis=0), [5, 5], atol=1e-9)

    def test_nothing(self):
        loops, valid = alpha_boundaries([], radius=1.0)
        assert loops.shape == (0, 0, 2)
        assert valid.shape == (0, 0)


class TestOutline:
    def test_square(self):
        square = SimpleNamespace(outline=np.array([[0, 0], [2, 0], [2, 2], [0, 2]], float))
        assert outline_metrics(square.outline) == pytest.approx((8.0, 4.0, 8.0))
        np.testing.assert_allclose(outline_centroid(square.outline), [1, 1])
        assert contains(square.outline, np.array([1.0, 1.0]))
        assert not contains(square.outline, np.array([3.0, 1.0]))

    def test_hollow_shape_has_a_shorter_girth(self):
        notch = np.array([[0, 0], [2, 0], [2, 2], [1, 0.5], [0, 2]], float)
        perimeter, area, girth = outline_metrics(notch)
        assert girth == pytest.approx(8.0)
        assert perimeter == pytest.approx(6 + 2 * np.hypot(1, 1.5))
        assert area == pytest.approx(4 - 1.5)

    def test_flat_outline_has_no_area(self):
        flat = np.array([[0, 0], [1, 0], [2, 0], [1, 0]], float)
        assert outline_metrics(flat)[1] == 0.0
        np.testing.assert_allclose(outline_centroid(flat), [1, 0])

    def test_distance_is_to_the_sides_not_the_corners(self):
        square = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], float)
        points = np.array([[1.0, -0.5], [1.0, 0.25], [3.0, 3.0], [0.0, 0.0]])
        np.testing.assert_allclose(distance_to_outline(points, square), [0.5, 0.25, np.sqrt(2), 0.0], atol=1e-12)
