"""The similarity of corresponding points, and the one that keeps the vertical upright."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dbh_studio.core.similarity_fit import fit_similarity, fit_upright
from dbh_studio.core.transforms import Similarity

POINTS = np.random.default_rng(0).normal(size=(12, 3)) * [5.0, 4.0, 1.0]


@given(st.floats(-3, 3), st.floats(0.1, 9.0))
def test_both_find_a_turn_about_the_vertical(angle, scale):
    truth = Similarity(Rotation.from_rotvec([0, 0, angle]).as_matrix(), np.array([3.0, -2.0, 7.0]), scale)
    for fit in (fit_similarity, fit_upright):
        found, rms = fit(POINTS, truth.apply(POINTS))
        assert found.apply(POINTS) == pytest.approx(truth.apply(POINTS), abs=1e-9 * scale + 1e-9)
        assert found.scale == pytest.approx(scale) and rms < 1e-8


def test_a_straight_level_line_is_enough_for_the_upright_one():
    line = np.linspace(0, 9, 10)[:, None] * [0.6, 0.8, 0.0]
    truth = Similarity(Rotation.from_rotvec([0, 0, 2.0]).as_matrix(), np.array([1.0, 2.0, 3.0]), 1.4)
    with pytest.raises(ValueError, match="one line"):
        fit_similarity(line, truth.apply(line))
    found, _ = fit_upright(line, truth.apply(line))
    assert found.apply(POINTS) == pytest.approx(truth.apply(POINTS), abs=1e-9)


def test_without_scale_it_stays_one():
    assert fit_upright(POINTS, 3.0 * POINTS, with_scale=False)[0].scale == 1.0


def test_what_does_not_determine_it_is_refused():
    pole = np.linspace(0, 5, 6)[:, None] * [0.0, 0.0, 1.0]
    with pytest.raises(ValueError, match="above each other"):
        fit_upright(pole, pole)
    with pytest.raises(ValueError, match="at least two"):
        fit_upright(pole[:1], pole[:1])
