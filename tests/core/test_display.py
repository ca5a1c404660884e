"""The sample that is sent to the screen."""

import numpy as np
import pytest

from dbh_studio.core.display import (
    coarse_first_chunks,
    height_colours,
    rough_heights,
    sample_for_display,
    thin_to,
    tree_colour,
)


@pytest.mark.parametrize(("n_points", "budget"), [(0, 10), (5, 10), (10, 10), (11, 10), (100_000, 777)])
def test_the_sample_is_unique_and_within_budget(n_points, budget):
    indices = sample_for_display(n_points, budget)
    assert len(indices) == min(n_points, budget)
    assert len(np.unique(indices)) == len(indices)
    assert len(indices) == 0 or (indices.min() >= 0 and indices.max() < n_points)


def test_every_part_of_the_file_is_represented():
    indices = sample_for_display(1_000_000, 10_000)
    assert np.bincount(indices // 100_000, minlength=10) == pytest.approx(1000, abs=2)


def test_each_leading_part_is_a_thinned_picture_of_the_whole():
    first = sample_for_display(1_000_000, 100_000)[:5_000]
    assert np.histogram(first, bins=5, range=(0, 1_000_000))[0] == pytest.approx(1000, rel=0.15)


def test_the_sample_is_the_same_each_time():
    assert np.array_equal(sample_for_display(1000, 100), sample_for_display(1000, 100))


def test_a_budget_of_nothing_is_refused():
    with pytest.raises(ValueError, match="budget of 0"):
        sample_for_display(10, 0)


@pytest.mark.parametrize("n_points", [0, 1, 60_000, 60_001, 3_000_000])
def test_the_chunks_cover_everything_once_and_begin_small(n_points):
    chunks = coarse_first_chunks(n_points)
    covered = np.concatenate([np.arange(n_points)[chunk] for chunk in chunks]) if chunks else np.array([])
    assert np.array_equal(covered, np.arange(n_points))
    assert all(len(range(*chunk.indices(n_points))) <= 500_000 for chunk in chunks)
    assert not chunks or chunks[0].stop <= 60_000


def test_higher_is_brighter():
    colours = height_colours(np.linspace(0, 10, 50), top_m=10.0).astype(int)
    assert (np.diff(colours.sum(axis=1)) > 0).mean() > 0.95
    assert height_colours(np.zeros(0)).shape == (0, 3)


def test_rough_heights_follow_a_slope():
    rng = np.random.default_rng(1)
    xy = rng.uniform(0, 40, (50_000, 2))
    above = rng.choice([0.0, 3.0], 50_000)
    points = np.column_stack([xy, 0.2 * xy[:, 0] + above]).astype(np.float32)
    assert rough_heights(points, cell=1.0) == pytest.approx(above, abs=0.25)


def test_a_stray_point_far_away_does_not_make_a_huge_grid():
    points = np.array([[0, 0, 0], [1, 1, 1], [1e7, 1e7, 5]], np.float32)
    assert np.isfinite(rough_heights(points, cell=0.01)).all()


def test_neighbouring_tree_numbers_have_different_colours():
    colours = np.array([tree_colour(i) for i in range(1, 60)])
    assert np.linalg.norm(np.diff(colours.astype(float), axis=0), axis=1).min() > 60


def test_thinning_keeps_small_clouds_as_they_are():
    points = np.zeros((10, 3), np.float32)
    assert thin_to(points, 10) is points
    assert len(thin_to(points, 4)) == 4
