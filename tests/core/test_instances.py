"""Masks of many photos tied to trunks by the points they share."""

from __future__ import annotations

import numpy as np

from dbh_studio.core.instances import InstanceGatherer
from dbh_studio.core.votes import PhotoVotes


def stand(n_trees: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Trunks in a row, 1 m apart, and the tree of each point."""
    rng = np.random.default_rng(0)
    parts = []
    for k in range(n_trees):
        angle, z = rng.uniform(0, 2 * np.pi, 1500), rng.uniform(0, 2, 1500)
        parts.append(np.column_stack([k + 0.15 * np.cos(angle), 0.15 * np.sin(angle), z]))
    return np.concatenate(parts), np.repeat(np.arange(1, n_trees + 1), 1500)


def shot(name: str, points: np.ndarray, labels: np.ndarray, azimuth_deg: float) -> PhotoVotes:
    """A photo sees the half of each trunk that faces it."""
    towards = np.array([np.cos(np.radians(azimuth_deg)), np.sin(np.radians(azimuth_deg))])
    around = points[:, :2] - np.round(points[:, :2])
    rows = np.flatnonzero(around @ towards > 0.0).astype(np.int32)
    return PhotoVotes(name, rows, labels[rows].astype(np.int32), has_instances=True)


def test_masks_all_round_become_one_trunk_each_whatever_their_numbers():
    points, tree = stand()
    gatherer, rng = InstanceGatherer(points), np.random.default_rng(1)
    for k, azimuth in enumerate(range(0, 360, 45)):
        numbers = np.concatenate([[0], rng.permutation(50)[:4] + 1])
        gatherer.add(shot(f"{k}", points, numbers[tree], azimuth))
    ties = gatherer.ties()
    assert ties.n_trunks == 4 and ties.n_masks.tolist() == [8] * 4 and ties.in_conflict == ()
    for name in range(1, 5):
        mine = ties.trunk_of_voter[tree == name]
        assert len(np.unique(mine)) == 1 and mine[0] > 0
    assert len(np.unique(ties.trunk_of_voter)) == 4


def test_a_mask_that_swallows_a_neighbour_does_not_tie_them():
    points, tree = stand()
    gatherer = InstanceGatherer(points)
    for k, azimuth in enumerate(range(0, 360, 45)):
        labels = tree.copy()
        if k == 3:
            labels[labels == 2] = 1
        gatherer.add(shot(f"{k}", points, labels, azimuth))
    ties = gatherer.ties()
    first, second = ties.trunk_of_voter[tree == 1], ties.trunk_of_voter[tree == 2]
    assert not set(np.unique(first)) & set(np.unique(second))


def test_a_trunk_cut_in_two_in_one_photo_stays_one():
    points, tree = stand()
    gatherer = InstanceGatherer(points)
    for k, azimuth in enumerate(range(0, 360, 45)):
        labels = tree.copy()
        if k == 3:
            labels[(tree == 1) & (points[:, 2] > 1.5)] = 9
        gatherer.add(shot(f"{k}", points, labels, azimuth))
    ties = gatherer.ties()
    assert len(np.unique(ties.trunk_of_voter[tree == 1])) == 1
    # The piece is a mask of its own that nobody else confirms.
    assert sorted(ties.n_masks.tolist()) == [1, 8, 8, 8, 8]


def test_two_masks_of_one_photo_on_one_trunk_are_flagged():
    points, tree = stand(2)
    gatherer = InstanceGatherer(points)
    gatherer.add(shot("whole", points, tree, 0.0))
    upper = points[:, 2] > 1.0
    gatherer.add(shot("cut", points, np.where((tree == 1) & upper, 9, tree), 0.0))
    # Photos that see only one half agree with that half and with the whole, so the halves meet in one trunk.
    for name, part in (("top", upper), ("foot", ~upper)):
        full = shot(name, points, tree, 0.0)
        rows = full.rows[part[full.rows]]
        gatherer.add(PhotoVotes(name, rows, tree[rows].astype(np.int32), has_instances=True))
    ties = gatherer.ties()
    assert ties.n_trunks == 2
    assert ties.in_conflict == tuple(np.unique(ties.trunk_of_voter[(tree == 1) & (ties.trunk_of_voter > 0)]))


def test_masks_without_numbers_and_no_masks_tie_nothing():
    points, _ = stand()
    gatherer = InstanceGatherer(points)
    gatherer.add(PhotoVotes("a", np.arange(10, dtype=np.int32), np.ones(10, np.int32)))
    ties = gatherer.ties()
    assert ties.n_trunks == 0 and not ties.trunk_of_voter.any()
    assert len(InstanceGatherer(np.empty((0, 3))).ties().trunk_of_voter) == 0


def test_masks_that_lie_over_two_trunks_do_not_tie_them_even_in_many_photos():
    points, tree = stand()
    gatherer = InstanceGatherer(points)
    for k, azimuth in enumerate(range(0, 360, 30)):
        labels = tree.copy()
        if k % 4 == 1:
            labels[labels == 2] = 1
        gatherer.add(shot(f"{k}", points, labels, azimuth))
    ties = gatherer.ties()
    first, second = ties.trunk_of_voter[tree == 1], ties.trunk_of_voter[tree == 2]
    assert not set(np.unique(first)) & set(np.unique(second))
    voters = np.arange(len(points))
    assert ties.apart_and_together(voters[tree == 1], voters[tree == 2]) == (9, 3)
    assert ties.apart_and_together(voters[tree == 3], voters[tree == 4]) == (12, 0)


def test_a_number_for_a_class_is_no_trunk():
    """All trunks under one number, 4 m of them: nothing is tied by it."""
    points, tree = stand(5)
    gatherer = InstanceGatherer(points)
    for k, azimuth in enumerate(range(0, 360, 45)):
        gatherer.add(shot(f"{k}", points, np.ones_like(tree), azimuth))
    assert gatherer.ties().n_trunks == 0


def test_only_candidates_are_tied():
    points, tree = stand()
    gatherer = InstanceGatherer(points)
    for k, azimuth in enumerate(range(0, 360, 45)):
        gatherer.add(shot(f"{k}", points, tree, azimuth))
    ties = gatherer.ties(tree <= 2)
    assert ties.n_trunks == 2 and not ties.trunk_of_voter[tree > 2].any()


def test_how_many_photos_see_a_trunk_and_call_it_one():
    points, tree = stand()
    gatherer = InstanceGatherer(points)
    for k, azimuth in enumerate(range(0, 360, 45)):
        photo = shot(f"{k}", points, np.where((tree == 2) & (k >= 3), 0, tree), azimuth)
        keep = tree[photo.rows] != 3
        gatherer.add(PhotoVotes(photo.name, photo.rows[keep], photo.labels[keep], has_instances=k % 2 == 0))
    seen = [gatherer.in_view(np.flatnonzero(tree == name)) for name in (1, 2, 3)]
    assert [(each.n_seen, each.n_called) for each in seen] == [(8, 8), (8, 3), (0, 0)]
    assert gatherer.in_view(np.empty(0, np.int64)).n_seen == 0
