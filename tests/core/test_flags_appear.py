"""Each warning of a diameter on a stem made to deserve it, none on one that does not; each refusal with words.

Geometry so plain that a person sees it, so that the limits may move without these tests: what they hold is that there
is such a warning, that it is about this, and that it comes with a diameter and not in place of one.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from tests.threestems import stem_points

from dbh_studio.core.dbh import DbhEstimate, Refusal
from dbh_studio.core.protocol_measure import measure_by_protocol
from dbh_studio.settings import MeasureSettings

DIAMETER_M = 0.30
Shape = Callable[[np.ndarray, np.ndarray], np.ndarray]


def stem() -> np.ndarray:
    return stem_points(DIAMETER_M, 12_000)


def angle_of(points: np.ndarray) -> np.ndarray:
    return np.arctan2(points[:, 1], points[:, 0])


def widened(points: np.ndarray, factor: np.ndarray) -> np.ndarray:
    return np.column_stack([points[:, :2] * factor[:, None], points[:, 2]])


def arc(degrees: float) -> np.ndarray:
    points = stem()
    return points[np.abs(np.degrees(angle_of(points))) < degrees / 2]


def two_walls() -> np.ndarray:
    """Two passes 3 cm apart, of which one saw a part of the ring only."""
    points = stem()
    second = np.arange(len(points)) % 2 == 0
    points[second, 0] += 0.03
    return points[~second | (np.abs(angle_of(points)) < 1.9)]


def fluted() -> np.ndarray:
    points = stem()
    return widened(points, 1 + 0.12 * np.cos(4 * angle_of(points)))


def root_swell() -> np.ndarray:
    points = stem()
    return widened(points, 1 + 0.4 * np.clip(2.0 - points[:, 2], 0, None))


def whorl() -> np.ndarray:
    points = stem()
    return widened(points, np.where(np.abs(points[:, 2] - 1.3) < 0.15, 1.1, 1.0))


def leaning() -> np.ndarray:
    points = stem()
    points[:, 0] += np.tan(np.radians(20)) * points[:, 2]
    return points


def thinned() -> np.ndarray:
    return stem()[np.random.default_rng(3).choice(12_000, 200, replace=False)]


def with_neighbour() -> np.ndarray:
    """A thinner stem that touches it."""
    return np.concatenate([stem(), stem_points(0.20, 3_000, seed=4) + [0.255, 0, 0]])


def with_fork() -> np.ndarray:
    """A thinner stem that leaves it half a metre above the ground."""
    other = stem_points(0.20, 3_000, seed=4)
    other[:, 0] += 0.35 * np.clip(other[:, 2] - 0.55, 0, None)
    return np.concatenate([stem(), other[other[:, 2] > 0.9]])


def measured(points: np.ndarray) -> DbhEstimate | Refusal:
    return measure_by_protocol(points, settings=MeasureSettings())


@pytest.mark.parametrize(
    ("make", "code", "word"),
    [
        (lambda: arc(200), "partial_arc", "ring seen"),
        (two_walls, "double_wall", "double wall"),
        (fluted, "fluting", "tape bridges"),
        (root_swell, "buttress", "root swell"),
        (whorl, "bulge", "whorl"),
        (leaning, "lean", "leans 20°"),
        (thinned, "few_points", "few points"),
        (with_neighbour, "neighbour", "touches"),
        (with_fork, "fork", "fork"),
    ],
)
def test_it_is_said_in_words_beside_a_diameter(make, code, word):
    result = measured(make())
    assert isinstance(result, DbhEstimate), result
    assert code in result.flag_codes
    assert len(result.flags) == len(result.flag_codes)
    assert word in result.flags[result.flag_codes.index(code)]
    assert result.interval is not None and result.interval[0] < result.dbh_cm < result.interval[1]


def test_nothing_is_said_of_a_plain_stem():
    result = measured(stem())
    assert isinstance(result, DbhEstimate)
    assert result.flag_codes == () and result.quality == "good"
    assert result.dbh_cm == pytest.approx(100 * DIAMETER_M, rel=0.01)


def test_an_uncertain_ground_is_said():
    result = measure_by_protocol(stem(), settings=MeasureSettings(), ground_note="ground is 0.4 m off in places")
    assert isinstance(result, DbhEstimate)
    assert result.flag_codes == ("ground",) and result.flags == ("ground is 0.4 m off in places",)


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (lambda: arc(50), "small_arc"),
        (lambda: stem()[::200], "too_few_points"),
        (lambda: np.concatenate([stem(), stem() + [0.29, 0, 0]]), "two_rings"),
        (lambda: np.random.default_rng(1).uniform(-0.3, 0.3, (5000, 3)) + [0, 0, 1.3], "no_ring"),
    ],
)
def test_a_refusal_gives_a_reason_and_what_to_do(make, code):
    result = measured(make())
    assert isinstance(result, Refusal)
    assert result.code == code
    assert len(result.reason.split()) > 4 and len(result.remedy.split()) > 4
