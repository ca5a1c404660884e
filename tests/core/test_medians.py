"""Medians and quantiles are numpy's own, and so are orders and interpolations that were made quicker."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.arrays import finite_points, finite_rows
from dbh_studio.core.medians import group_medians, median, quantiles
from dbh_studio.core.robust import canonical_order
from dbh_studio.core.section import radius_at

SIZES = (1, 2, 3, 4, 7, 40, 2401)


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int64])
def test_median_is_numpys_to_the_last_digit(n, dtype):
    values = (1000.0 * np.random.default_rng(n).normal(size=n)).astype(dtype)
    assert median(values) == np.median(values)


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("shares", [(0.05, 0.95), (0.01, 0.99), (0.5,), (0.0, 1.0), (0.9, 0.15)])
def test_quantiles_are_numpys_to_the_last_digit(n, shares):
    values = np.random.default_rng(n).normal(size=n)
    assert quantiles(values, shares) == np.quantile(values, shares).tolist()


@pytest.mark.parametrize("offset", [0.0, -5.0, 1e4])
def test_group_medians_are_those_of_each_group(offset):
    rng = np.random.default_rng(1)
    group = rng.permutation(np.repeat([0, 1, 3, 4], [1, 4, 7, 300]))
    values = offset + rng.normal(size=len(group))
    found = group_medians(group, values, np.bincount(group))
    upper = group_medians(group, values, np.bincount(group), upper=True)
    for each in (0, 1, 3, 4):
        own = np.sort(values[group == each])
        assert found[each] == pytest.approx(own[(len(own) - 1) // 2], abs=1e-12 * max(abs(offset), 1.0))
        assert upper[each] == pytest.approx(own[len(own) // 2], abs=1e-12 * max(abs(offset), 1.0))
    assert np.isfinite(found[2])


def test_group_medians_of_equal_values_are_that_value():
    group = np.array([1, 0, 1, 1])
    assert group_medians(group, np.full(4, 0.3), np.bincount(group)) == pytest.approx([0.3, 0.3], rel=1e-15)


@pytest.mark.parametrize("n_values", [1, 3, 50, 10**6])
def test_canonical_order_is_by_all_coordinates_the_last_first(n_values):
    points = np.random.default_rng(2).integers(0, n_values, (500, 3)) / 7.0
    assert (canonical_order(points) == np.lexsort(points.T)).all()
    assert len(canonical_order(points[:0])) == 0


def test_points_without_a_coordinate_are_left_out():
    points = np.random.default_rng(3).normal(size=(6, 3)).astype(np.float32)
    assert finite_points(points) is points
    points[1, 0], points[2, 1], points[4, 2] = np.nan, np.inf, -np.inf
    assert finite_rows(points).tolist() == [True, False, False, True, False, True]
    assert (finite_points(points) == points[[0, 3, 5]]).all()


def test_radius_between_the_outlines_own_directions():
    radius = np.random.default_rng(4).uniform(0.1, 0.2, 72)
    angle = np.append(np.random.default_rng(5).uniform(-np.pi, np.pi, 500), [-np.pi, 0.0, np.pi])
    expected = np.interp(angle, np.arange(72) * (2 * np.pi / 72), radius, period=2 * np.pi)
    assert radius_at(radius, angle) == pytest.approx(expected, rel=1e-12)
