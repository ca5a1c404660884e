"""Tree ids that a cloud already carries, by whichever name the program that made them chose."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, Int64
from dbh_studio.core.cloud import PointCloud

# Most specific first: a file may hold both `treeID` and a semantic `label`.
TREE_ID_NAMES = (
    "treeid",
    "finaltreeid",
    "tree",
    "treeindex",
    "treeno",
    "treenr",
    "treenumber",
    "stemid",
    "stem",
    "trunkid",
    "predinstance",
    "predinstances",
    "instancepred",
    "instancepreds",
    "predtreeid",
    "predictedtreeid",
    "treeinstance",
    "instance",
    "instanceid",
    "instances",
    "instancelabel",
    "finalsegs",
    "segmentid",
    "clusterid",
    "cluster",
    "label",
    "labels",
)
_MAX_DISTINCT_FROM_FLOAT = 2**53


def _normalised(name: str) -> str:
    """Lower case without separators, and without the prefix CloudCompare gives scalar fields in a PLY."""
    return re.sub(r"[^a-z0-9]", "", re.sub(r"^scalar[_ ]", "", name.strip().lower()))


def tree_id_rank(name: str) -> int | None:
    """How specific a name is for tree ids (0 is best); None where it does not name tree ids."""
    plain = _normalised(name)
    if plain in TREE_ID_NAMES:
        return TREE_ID_NAMES.index(plain)
    if plain.startswith("treeiso"):
        return TREE_ID_NAMES.index("finalsegs")
    return None


def is_tree_id_name(name: str) -> bool:
    """Whether an attribute of this name is likely to hold tree ids."""
    return tree_id_rank(name) is not None


def assigned(ids: NDArray[Any]) -> Bool:
    """(N,) which points have a tree.

    Zero, negatives and NaN mean no tree. So does the largest value of the type (lidR writes the largest double, others
    the largest integer), and the largest 32-bit integer in any wider type.
    """
    ids = np.asarray(ids)
    if np.issubdtype(ids.dtype, np.floating):
        with np.errstate(invalid="ignore"):
            return (ids > 0) & (ids < _MAX_DISTINCT_FROM_FLOAT) & (ids != 2**31 - 1) & (ids != 2**32 - 1)
    if not np.issubdtype(ids.dtype, np.integer):
        raise ValueError(f"tree ids are of type {ids.dtype} but numbers are needed")
    has_tree = (ids > 0) & (ids != np.iinfo(ids.dtype).max)
    if ids.dtype.itemsize > 4:
        has_tree &= (ids != 2**31 - 1) & (ids != 2**32 - 1)
    return has_tree


def find_tree_id_attribute(cloud: PointCloud) -> str | None:
    """The attribute of `cloud` that holds tree ids: named like one, whole numbers, at least one tree; else None."""
    ranked = sorted((rank, name) for name in cloud.attributes if (rank := tree_id_rank(name)) is not None)
    for _, name in ranked:
        values = cloud.attributes[name]
        if values.ndim != 1 or not np.issubdtype(values.dtype, np.number):
            continue
        valid = values[assigned(values)]
        if len(valid) and bool((valid == np.round(valid)).all()):
            return name
    return None


def point_sets_from_ids(ids: NDArray[Any], *, min_points: int = 1) -> tuple[Int64, ...]:
    """The points of each tree, in ascending order of id.

    Args:
        ids: (N,) tree id of every point; see `assigned` for what means no tree.
        min_points: Trees with fewer points are left out.

    Returns:
        One ascending (K,) index array per tree.
    """
    ids = np.asarray(ids)
    if ids.ndim != 1:
        raise ValueError(f"ids have shape {ids.shape} but (N,) is needed")
    points = np.flatnonzero(assigned(ids))
    if not len(points):
        return ()
    values = ids[points]
    order = np.argsort(values, kind="stable")
    values = values[order]
    starts = np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1]]))
    groups = np.split(points[order], starts[1:])
    return tuple(group for group in groups if len(group) >= min_points)
