import numpy as np
import pytest
from tests.treescene import Stem

from dbh_studio.core.stem_line import StemLine


def test_a_round_stem_is_found_where_it_is():
    line = StemLine.of_points(Stem(3.0, -2.0, 0.4).points(), low=0.2, high=2.6, look_at=1.3)
    assert line.point == pytest.approx([3.0, -2.0, 1.3], abs=0.01)
    assert line.radius == pytest.approx(0.2, rel=0.08)
    assert (line.low, line.high) == (0.2, 2.6)


def test_one_that_leans_is_followed():
    points = Stem(0.0, 0.0, 0.3).points()
    points[:, 0] += 0.2 * points[:, 2]
    line = StemLine.of_points(points)
    assert line.at(np.array([1.0, 3.0]))[:, 0] == pytest.approx([0.2, 0.6], abs=0.02)


@pytest.mark.parametrize("unit", [0.02, 50.0])
def test_without_heights_it_is_as_tall_as_it_is_thick(unit):
    line = StemLine.of_points(Stem(0.0, 0.0, 0.3, height=15.0).points() * unit)
    assert line.low == pytest.approx(0.15 * unit, abs=0.1 * unit)
    assert line.high - line.low == pytest.approx(2.4 * unit, rel=0.1)


def test_a_trunk_that_begins_above_the_stretch_still_has_a_place():
    points = Stem(1.0, 1.0, 0.3).points()
    line = StemLine.of_points(points[points[:, 2] > 3.5], low=0.2, high=2.6, look_at=1.3)
    assert line.point[:2] == pytest.approx([1.0, 1.0], abs=0.05)
    assert (line.low, line.high) == (0.2, 2.6)


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.zeros((9, 3)), np.zeros((50, 3)), np.full((50, 3), np.nan)])
def test_too_few_points_have_no_line(points):
    assert StemLine.of_points(points) is None


@pytest.mark.parametrize(
    "values",
    [
        (np.zeros(3), np.array([0, 0, -1.0]), 0.2, 0.0, 2.0),
        (np.full(3, np.nan), np.array([0, 0, 1.0]), 0.2, 0.0, 2.0),
        (np.zeros(3), np.array([0, 0, 1.0]), 0.0, 0.0, 2.0),
        (np.zeros(3), np.array([0, 0, 1.0]), 0.2, 2.0, 2.0),
        (np.zeros(2), np.array([0, 0, 1.0]), 0.2, 0.0, 2.0),
    ],
)
def test_what_is_no_stem_is_refused(values):
    with pytest.raises(ValueError):
        StemLine(*values)
