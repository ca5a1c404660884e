from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.treeids import assigned, find_tree_id_attribute, is_tree_id_name, point_sets_from_ids


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
    assert find_tree_id_attribute(_cloud(treeID=[0, 0], label=[0, 1])) == "label"
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
