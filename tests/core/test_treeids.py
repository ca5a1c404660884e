from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.treeids import (
    assigned,
    doubtful_tree_id_attribute,
    find_tree_id_attribute,
    is_tree_id_name,
    point_sets_from_ids,
)


def _cloud(**attributes):
    n = len(next(iter(attributes.values())))
    return PointCloud(
        np.zeros((n, 3), np.float32), np.zeros(3), attributes={k: np.asarray(v) for k, v in attributes.items()}
    )


@pytest.mark.parametrize(
    "name",
    ["treeID", "tree_id", "TreeId", "PredInstance", "pred_instance", "label", "instance", "scalar_treeID", "final_segs",
     "treeiso_final", "Instance_ID"],
)  # fmt: skip
def test_names(name):
    assert is_tree_id_name(name)


@pytest.mark.parametrize("name", ["intensity", "classification", "gps_time", "red", "street", "", "treetop_height"])
def test_other_names(name):
    assert not is_tree_id_name(name)


def test_the_specific_name_wins():
    assert find_tree_id_attribute(_cloud(label=[1, 2], treeID=[3, 4], instance=[1, 1])) == "treeID"


def test_what_holds_no_tree_or_no_whole_numbers_is_passed_over():
    assert find_tree_id_attribute(_cloud(treeID=[0, 0], instance=[0, 1])) == "instance"
    assert find_tree_id_attribute(_cloud(treeID=[0.5, 1.5])) is None
    assert find_tree_id_attribute(_cloud(treeID=[np.nan, 2.0])) == "treeID"
    assert find_tree_id_attribute(_cloud(intensity=[1, 2])) is None


@pytest.mark.parametrize("dtype", [np.int8, np.uint8, np.int16, np.uint16, np.int32, np.uint32, np.int64, np.uint64])
def test_the_largest_value_means_no_tree(dtype):
    ids = np.array([1, 0, np.iinfo(dtype).max, 7], dtype)
    assert assigned(ids).tolist() == [True, False, False, True]


def test_floats_without_a_tree():
    ids = np.array([1.0, 0.0, -3.0, np.nan, np.inf, np.finfo(np.float64).max, 2.0**31 - 1, 5.0])
    assert assigned(ids).tolist() == [True, False, False, False, False, False, False, True]


@given(st.lists(st.integers(-2, 6), max_size=200), st.integers(1, 5))
def test_point_sets_are_the_positions_of_each_id(ids, min_points):
    array = np.array(ids, np.int32)
    expected = [np.flatnonzero(array == i).tolist() for i in range(1, 7)]
    expected = [points for points in expected if len(points) >= min_points]
    assert [points.tolist() for points in point_sets_from_ids(array, min_points=min_points)] == expected


def test_point_sets_need_one_column():
    with pytest.raises(ValueError, match="shape"):
        point_sets_from_ids(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="type"):
        point_sets_from_ids(np.array(["a"]))


def _plot(n_trees=9, seed=0):
    """(N, 3) points of upright trees 3 apart on a square of ground, and the tree of each (0: ground)."""
    rng = np.random.default_rng(seed)
    side = 3 * int(np.ceil(np.sqrt(n_trees)))
    places = np.array([(3 * (i % (side // 3)) + 1.5, 3 * (i // (side // 3)) + 1.5) for i in range(n_trees)])
    trees = [np.column_stack([rng.normal(xy, 0.4, (300, 2)), rng.uniform(0, 8, 300)]) for xy in places]
    ground = np.column_stack([rng.uniform(0, side, (2000, 2)), rng.normal(0, 0.02, 2000)])
    ids = np.repeat(np.arange(n_trees + 1), [2000, *[300] * n_trees])
    return np.concatenate([ground, *trees]).astype(np.float32), ids


def _plot_cloud(xyz, **attributes):
    return PointCloud(xyz.astype(np.float32), np.zeros(3), attributes=attributes)


@pytest.mark.parametrize("name", ["label", "labels", "Cluster_ID", "scalar_cluster", "segment_id"])
@pytest.mark.parametrize("turn", [[0, 1, 2], [0, 2, 1], [2, 0, 1]], ids=["z up", "y up", "x up"])
@pytest.mark.parametrize("unit", [1.0, 1e-3, 40.0])
def test_a_general_name_is_taken_where_its_values_are_trees(name, turn, unit):
    xyz, ids = _plot()
    cloud = _plot_cloud(unit * xyz[:, turn], **{name: ids})
    assert find_tree_id_attribute(cloud) == name
    assert doubtful_tree_id_attribute(cloud) is None


@pytest.mark.parametrize(
    "values",
    [lambda xyz, ids: np.where(ids > 0, 3, 1), lambda xyz, ids: (ids > 0).astype(int),
     lambda xyz, ids: np.where(ids > 0, 1 + (xyz[:, 2] > 4), 0), lambda xyz, ids: np.ones(len(ids), int)],
    ids=["ground and stems", "stems", "stems and crowns", "all the same"],
)  # fmt: skip
def test_classes_are_no_trees(values):
    xyz, ids = _plot()
    cloud = _plot_cloud(xyz, label=values(xyz, ids))
    assert find_tree_id_attribute(cloud) is None
    assert doubtful_tree_id_attribute(cloud) == "label"


def test_patches_of_surface_are_no_trees():
    xyz, _ = _plot()
    patches = 1 + (xyz / 0.6).astype(int) @ [1, 100, 10_000]
    assert find_tree_id_attribute(_plot_cloud(xyz, segment_id=patches)) is None


def test_a_name_that_says_tree_is_believed_whatever_its_values():
    xyz, ids = _plot()
    cloud = _plot_cloud(xyz, treeID=np.where(ids > 0, 3, 1), label=ids)
    assert find_tree_id_attribute(cloud) == "treeID"
    assert doubtful_tree_id_attribute(cloud) is None


def test_points_that_are_not_finite_do_not_decide():
    xyz, ids = _plot()
    xyz[::50] = np.nan
    assert find_tree_id_attribute(_plot_cloud(xyz, label=ids)) == "label"
