"""Parting a trunk into its stems and following one from a click, on stems that are known."""

from __future__ import annotations

import numpy as np
import pytest
from tests.app.plots import FlatGround
from tests.threestems import STEMS, plot_points, stem_points

from dbh_studio.core.dbh import Refusal
from dbh_studio.stages.stem_edits import grow_stem, part_stems

GROUND = FlatGround()


def pair(gap_m: float, *, second_m: float = 0.24) -> tuple[np.ndarray, np.ndarray]:
    """Two stems whose surfaces are `gap_m` apart, and which point is of which."""
    first, second = stem_points(0.30, seed=1), stem_points(second_m, 9000, seed=2)
    second[:, 0] += 0.15 + second_m / 2 + gap_m
    return np.concatenate([first, second]), np.repeat([0, 1], [len(first), len(second)])


@pytest.mark.parametrize("gap_m", [0.0, 0.05, 0.4])
def test_two_stems_in_one_trunk_are_parted_also_where_they_touch(gap_m):
    points, truth = pair(gap_m)
    labels = part_stems(points.astype(np.float32), GROUND)
    assert np.mean(labels == truth) > 0.97


def test_three_stems_are_three_the_largest_first():
    points, truth = pair(0.1)
    third = stem_points(0.2, 5000, seed=3) + [0.0, 0.5, 0.0]
    labels = part_stems(np.concatenate([points, third]).astype(np.float32), GROUND)
    assert np.mean(labels == np.concatenate([truth, np.full(5000, 2)])) > 0.97


@pytest.mark.parametrize("n_points", [12_000, 600])
def test_one_stem_is_not_parted(n_points):
    found = part_stems(stem_points(0.35, n_points).astype(np.float32), GROUND)
    assert isinstance(found, Refusal) and found.remedy


def test_points_of_nothing_are_not_parted():
    for points in (np.zeros((0, 3), np.float32), np.zeros((2, 3), np.float32), np.full((500, 3), 0.5, np.float32)):
        assert isinstance(part_stems(points, GROUND), Refusal)


def test_thin_stems_without_rings_are_parted_where_they_do_not_touch():
    rng = np.random.default_rng(0)
    poles = [np.c_[rng.normal(x, 0.003, (1500, 2)), rng.uniform(0.3, 4, 1500)] for x in (0.0, 0.25)]
    labels = part_stems(np.concatenate(poles).astype(np.float32), GROUND)
    assert np.mean(labels == np.repeat([0, 1], 1500)) in (0.0, 1.0)


@pytest.mark.parametrize("number", range(3))
def test_a_stem_is_followed_from_a_click(number):
    points = plot_points().astype(np.float32)
    x, y, diameter = STEMS[number]
    grown = grow_stem(points, (x + diameter / 2, y, 1.4), GROUND)
    assert not isinstance(grown, Refusal) and grown.note == ""
    n_ground, n_stem = 30_000, 12_000
    truth = np.arange(n_stem) + n_ground + number * n_stem
    truth = truth[points[truth, 2] > 0.35]
    assert np.isin(truth, grown.rows).mean() > 0.97
    assert np.isin(grown.rows, np.arange(n_stem) + n_ground + number * n_stem).all()
    assert (np.diff(grown.rows) > 0).all()


def test_what_is_not_free_is_left_alone():
    points = plot_points().astype(np.float32)
    x, y, diameter = STEMS[0]
    is_free = np.ones(len(points), bool)
    is_free[30_000:36_000] = False
    grown = grow_stem(points, (x + diameter / 2, y, 1.4), GROUND, is_free=is_free)
    assert not isinstance(grown, Refusal) and is_free[grown.rows].all() and len(grown.rows) > 4000


def test_a_click_beside_a_stem_finds_none():
    points = plot_points().astype(np.float32)
    for place in ((3.0, 3.5, 1.4), (50.0, 50.0, 1.0), (1.5, 2.0, 30.0)):
        found = grow_stem(points, place, GROUND)
        assert isinstance(found, Refusal) and found.remedy


def test_a_pole_without_a_ring_is_taken_as_what_hangs_together_and_says_so():
    rng = np.random.default_rng(0)
    pole = np.c_[rng.normal(0, 0.003, (2000, 2)), rng.uniform(0.3, 4, 2000)].astype(np.float32)
    grown = grow_stem(pole, (0, 0, 1.3), GROUND)
    assert not isinstance(grown, Refusal) and "no ring" in grown.note and len(grown.rows) > 1900
