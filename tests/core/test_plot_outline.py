"""A plot's outline: sides that cross are found, and no outline takes hours to look at."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbh_studio.core.stand import MOST_CORNERS, PlotArea


def crosses(corners) -> bool:
    """Whether two sides that are not neighbours meet: each pair worked out by itself, in whole numbers."""
    n = len(corners)

    def side(p, q, r):
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    for i, j in itertools.combinations(range(n), 2):
        if j - i in (1, n - 1):
            continue
        a, b, c, d = corners[i], corners[(i + 1) % n], corners[j], corners[(j + 1) % n]
        if side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0:
            return True
    return False


@given(st.lists(st.tuples(st.integers(-9, 9), st.integers(-9, 9)), min_size=3, max_size=9))
def test_sides_that_cross_are_found_as_pair_by_pair(corners):
    try:
        PlotArea.polygon(corners)
        said = ""
    except ValueError as error:
        said = str(error)
    assert ("cross" in said) == crosses(corners)


def test_an_outline_of_many_corners_is_taken_and_one_of_too_many_is_refused():
    angle = np.linspace(0, 2 * np.pi, MOST_CORNERS + 1, endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    assert PlotArea.polygon(ring[:-1]).area_m2 == pytest.approx(np.pi, rel=1e-3)
    with pytest.raises(ValueError, match="simplify"):
        PlotArea.polygon(ring)
