"""Labels of one cloud on the points of another: reach, ties, tidied trunks under their ids."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from dbh_studio.core.ground import fit_ground
from dbh_studio.core.synthetic.recipe import PlotRecipe
from dbh_studio.core.synthetic.transfer_pair import PairRecipe, make_pair
from dbh_studio.core.transforms import Similarity
from dbh_studio.stages.label_carry import CarriedLabels, carried_trunks, carry_labels, share_covered

SAME = Similarity.identity()


@cache
def pair():
    plot = PlotRecipe.simple(seed=31, n_trees=8, side_m=14.0, understorey=0.8)
    return make_pair(PairRecipe(plot, seed=31, photo_points=120_000, lidar_points=150_000))


@cache
def carried():
    both = pair()
    return carry_labels(both.photo_xyz, both.photo_tree_ids, both.lidar_xyz, both.lidar_from_photo)


@cache
def trunks():
    return carried_trunks(pair().lidar_xyz, fit_ground(pair().lidar_xyz), carried())


def test_labels_arrive_on_the_right_points():
    truth, labels = pair().lidar_tree_ids, carried().labels
    marked = labels > 0
    assert (labels[marked] == truth[marked]).mean() > 0.95
    assert (labels == truth)[truth > 0].mean() > 0.8
    assert set(carried().trunk_ids) | set(carried().lost) == set(range(1, 9))


def test_what_is_beyond_the_reach_gets_no_label_and_between_two_the_nearest_counts():
    source = np.array([[0.0, 0, 0], [0.3, 0, 0], [5.0, 0, 0]])
    labels = np.array([4, 7, 0])
    target = np.array([[0.14, 0, 0], [0.16, 0, 0], [0.52, 0, 0], [5.0, 0, 0], [-0.19, 0, 0], [0.0, 0.21, 0]])
    found = carry_labels(source, labels, target, SAME)
    assert found.labels.tolist() == [4, 7, 0, 0, 4, 0] and found.trunk_ids == (4, 7) and found.lost == ()
    assert carry_labels(source, labels, target, SAME, reach_m=0.25).labels.tolist() == [4, 7, 7, 0, 4, 4]
    far = carry_labels(source, labels, target + 100.0, SAME)
    assert far.trunk_ids == () and far.lost == (4, 7) and not far.labels.any()


def test_the_source_may_be_in_another_unit_and_frame():
    placed = Similarity(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([5.0, 0, 0]), 10.0)
    found = carry_labels(np.array([[0.1, 0.0, 0.0]]), np.array([3]), np.array([[5.0, 1.0, 0.1], [1.0, 0, 0]]), placed)
    assert found.labels.tolist() == [3, 0]


def test_nothing_to_carry_is_no_error():
    empty = carry_labels(np.zeros((0, 3)), np.zeros(0, np.int32), np.zeros((4, 3)), SAME)
    assert empty.labels.tolist() == [0] * 4
    assert share_covered(np.zeros((0, 3)), np.zeros((4, 3)), empty, SAME) == 0.0
    with pytest.raises(ValueError, match="source_labels"):
        carry_labels(np.zeros((3, 3)), np.zeros(2, np.int32), np.zeros((4, 3)), SAME)


def test_how_much_of_the_trunks_the_other_cloud_covers():
    both = pair()
    rows = both.photo_tree_ids > 0
    covered = share_covered(both.photo_xyz[rows], both.lidar_xyz, carried(), both.lidar_from_photo)
    assert covered > 0.9
    half = both.lidar_from_photo.apply(both.photo_xyz[rows].astype(float))[:, 0]
    west = both.lidar_xyz[both.lidar_xyz[:, 0] < np.median(half)]
    onto = carry_labels(both.photo_xyz, both.photo_tree_ids, west, both.lidar_from_photo)
    assert share_covered(both.photo_xyz[rows], west, onto, both.lidar_from_photo) == pytest.approx(0.5, abs=0.1)


def test_the_chain_tidies_the_trunks_and_keeps_their_names():
    truth, found = pair().lidar_tree_ids, trunks()
    assert set(found.point_sets) == set(carried().trunk_ids)
    labels = np.zeros(len(truth), np.int32)
    for name, rows in found.point_sets.items():
        assert not labels[rows].any(), "trunks share points"
        labels[rows] = name
        assert (truth[rows] == name).mean() > 0.97
    before = carried().labels
    height = fit_ground(pair().lidar_xyz).height_above(pair().lidar_xyz)
    breast = (truth > 0) & (height > 1.0) & (height < 2.0)
    assert (labels == truth)[breast].mean() > 0.97 > 0.9 < (before == truth)[breast].mean()
    right = [(mine[mine > 0] == truth[mine > 0]).mean() for mine in (labels, before)]
    assert right[0] > right[1]
    assert found.n_carried == {name: int((before == name).sum()) for name in found.n_carried}


def test_points_of_which_the_chain_makes_nothing_stay_as_they_came():
    rng = np.random.default_rng(0)
    ground = np.c_[rng.uniform(0, 8, (20_000, 2)), rng.normal(0, 0.005, 20_000)]
    # Bark seen from afar: no ring, and points too far apart for the chain's clusters.
    bark = np.c_[np.full(12, 4.0), rng.uniform(4, 4.3, 12), np.linspace(0.5, 7.0, 12)]
    points = np.concatenate([ground, bark]).astype(np.float32)
    labels = np.zeros(len(points), np.int32)
    labels[-12:] = 9
    labels[:3] = 9
    found = carried_trunks(points, fit_ground(points), CarriedLabels(labels, (9,), ()))
    assert found.as_carried == (9,) and found.n_carried == {9: 15}
    assert set(found.point_sets[9]) == set(range(20_000, 20_012)), "the ground went, the bark stayed"
