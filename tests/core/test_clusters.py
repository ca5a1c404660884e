"""DBSCAN against its definition, Otsu against all splits, thinning against counting."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dbh_studio.core.clusters import NOISE, dbscan
from dbh_studio.core.otsu import otsu_threshold
from dbh_studio.core.voxels import cube_keys, thin


def blobs(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    centres = np.array([[0, 0, 0], [1, 0, 0], [0.4, 0.8, 0.1]])
    parts = [centre + rng.normal(0, 0.06, (150, 3)) for centre in centres]
    return np.concatenate([*parts, rng.uniform(-1, 2, (120, 3))])


def by_definition(
    points: np.ndarray, distance: float, weight: np.ndarray, min_points: float
) -> tuple[np.ndarray, list[set[int]]]:
    """Core points and the sets of core points that are density-connected, by the definition, pair by pair."""
    near = np.linalg.norm(points[:, None] - points[None], axis=2) <= distance
    core = near @ weight >= min_points
    left, groups = set(np.flatnonzero(core).tolist()), []
    while left:
        todo = [left.pop()]
        group = set(todo)
        while todo:
            reached = set(np.flatnonzero(near[todo.pop()] & core).tolist()) & left
            left -= reached
            group |= reached
            todo += reached
        groups.append(group)
    return core, groups


@pytest.mark.parametrize("weighted", [False, True])
def test_clusters_are_those_of_the_definition(weighted: bool) -> None:
    points = blobs()
    weight = np.random.default_rng(1).integers(1, 5, len(points)) if weighted else np.ones(len(points))
    labels = dbscan(points, distance=0.08, min_points=9, weights=weight if weighted else None)
    core, groups = by_definition(points, 0.08, weight.astype(float), 9)
    assert len(groups) >= 3
    assert {frozenset(np.flatnonzero((labels == k) & core).tolist()) for k in range(labels.max() + 1)} == set(
        map(frozenset, groups)
    )
    near_core = (np.linalg.norm(points[:, None] - points[None, core], axis=2) <= 0.08).any(axis=1)
    assert np.array_equal(labels != NOISE, near_core)


def test_numbers_follow_the_first_point_and_clusters_do_not_depend_on_order() -> None:
    points = blobs()
    labels = dbscan(points, distance=0.12, min_points=6)
    first = [np.flatnonzero(labels == k)[0] for k in range(labels.max() + 1)]
    assert first == sorted(first)
    order = np.random.default_rng(3).permutation(len(points))
    again = np.empty_like(labels)
    again[order] = dbscan(points[order], distance=0.12, min_points=6)
    pairs = {(int(a), int(b)) for a, b in zip(labels, again, strict=True)}
    assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})


def test_nothing_gives_nothing() -> None:
    assert dbscan(np.empty((0, 3)), distance=1.0, min_points=3).shape == (0,)
    assert (dbscan(np.eye(3) * 10, distance=1.0, min_points=2) == NOISE).all()


@given(st.lists(st.floats(0, 1e4), min_size=2, max_size=30))
@settings(max_examples=60, deadline=None)
def test_otsu_is_the_best_of_all_splits(values: list[float]) -> None:
    array = np.array(values)

    def within(threshold: float) -> float:
        parts = (array[array < threshold], array[array >= threshold])
        return sum(float(((part - part.mean()) ** 2).sum()) for part in parts if len(part))

    best = min(within(value) for value in array)
    assert within(otsu_threshold(array)) <= best + 1e-9 * (1.0 + np.square(array).sum())


def test_otsu_of_fragments_and_stems() -> None:
    assert otsu_threshold(np.array([3, 5, 8, 900, 1100, 1000])) == 900
    assert otsu_threshold(np.array([7.0, 7.0])) == 7.0
    with pytest.raises(ValueError, match="finite"):
        otsu_threshold(np.array([]))


def test_thinning_keeps_every_point_once_and_the_means() -> None:
    points = (np.random.default_rng(0).uniform(-3, 3, (5000, 3)) + 700).astype(np.float32)
    thinned = thin(points, 0.25)
    assert thinned.counts.sum() == len(points)
    assert np.array_equal(np.sort(thinned.order), np.arange(len(points)))
    cube = thinned.labels_of_points(np.arange(len(thinned), dtype=np.int32))
    assert np.array_equal(np.bincount(cube), thinned.counts)
    for k in (0, len(thinned) // 2, len(thinned) - 1):
        own = points[cube == k].astype(np.float64)
        assert np.allclose(thinned.points[k], own.mean(axis=0), atol=1e-4)
        assert np.ptp(own, axis=0).max() <= 0.25 + 1e-3
    assert len(np.unique(cube_keys(points, 0.25))) == len(thinned)


def test_thinning_refuses_what_it_cannot_do() -> None:
    assert len(thin(np.empty((0, 3), np.float32), 0.1)) == 0
    with pytest.raises(ValueError, match="positive"):
        thin(np.zeros((3, 3)), 0.0)
    with pytest.raises(ValueError, match="finite"):
        thin(np.array([[0, 0, 0], [np.nan, 0, 0]]), 0.1)
