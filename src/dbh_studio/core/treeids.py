"""Tree ids that a cloud already carries, by whichever name the program that made them chose."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, Float, Float64, Int64
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
# Classes and patches of surface are called so as well: the values must look like trees.
_GENERAL_NAMES = frozenset({"segmentid", "clusterid", "cluster", "label", "labels"})
_MAX_DISTINCT_FROM_FLOAT = 2**53
_MAX_TRUNK_ID = 2**31 - 1
_SAMPLE = 200_000
_FEWEST_IN_SAMPLE = 10
# Most trees are narrower than this share of the plot, and taller than this share of its height.
_WIDEST_SHARE = 0.5
_LOWEST_SHARE = 0.1
# Parts of one tree on both sides of a border are nearer to each other than this share of the larger part.
_BORDER_GAP_SHARE = 0.05


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
    """The attribute of `cloud` that holds tree ids, else None.

    It is named like one and holds whole numbers and at least one tree. Where the name is a general one (``label``,
    ``cluster``, ``segment_id``), its values must also look like trees: most of them compact in plan, and high.
    """
    return next((name for name in _named_like_tree_ids(cloud) if _is_believed(cloud, name)), None)


def doubtful_tree_id_attribute(cloud: PointCloud) -> str | None:
    """An attribute with a general name whose values do not look like trees; None where tree ids were found."""
    names = _named_like_tree_ids(cloud)
    return names[0] if names and not any(_is_believed(cloud, name) for name in names) else None


def _named_like_tree_ids(cloud: PointCloud) -> list[str]:
    """The attributes that may hold tree ids by name and type, the most specific name first."""
    ranked = sorted((rank, name) for name in cloud.attributes if (rank := tree_id_rank(name)) is not None)
    return [name for _, name in ranked if _holds_ids(cloud.attributes[name])]


def _holds_ids(values: NDArray[Any]) -> bool:
    if values.ndim != 1 or not np.issubdtype(values.dtype, np.number):
        return False
    valid = values[assigned(values)]
    return bool(len(valid) and (valid == np.round(valid)).all())


def _is_believed(cloud: PointCloud, name: str) -> bool:
    return _normalised(name) not in _GENERAL_NAMES or _look_like_trees(cloud.xyz, cloud.attributes[name])


def _look_like_trees(xyz: Float, ids: NDArray[Any]) -> bool:
    """Whether most of the sets that `ids` makes of (N, 3) points are compact in plan and high.

    Neither the scale nor the up direction is known here, so sizes are shares of the plot's, and what a set takes the
    largest share of is taken for its height.
    """
    step = max(1, len(xyz) // _SAMPLE)
    points, ids = xyz[::step].astype(np.float64), ids[::step]
    finite = np.isfinite(points).all(axis=1)
    known = finite & assigned(ids)
    if not known.any():
        return False
    plot = _sizes(points[finite], np.zeros(np.count_nonzero(finite)), tail=0.005)[0][0]
    sizes, counts = _sizes(points[known], ids[known], tail=0.05)
    sizes = sizes[counts >= _FEWEST_IN_SAMPLE]
    share = sizes / np.maximum(plot, 1e-12)
    is_across = np.arange(3) != share.argmax(axis=1)[:, None]
    wide = np.hypot.reduce(np.where(is_across, sizes, 0.0), axis=1)
    widest = np.hypot.reduce(np.where(is_across, plot, 0.0), axis=1)
    is_tree = (wide <= _WIDEST_SHARE * widest) & (share.max(axis=1, initial=0.0) >= _LOWEST_SHARE)
    return bool(2 * np.count_nonzero(is_tree) > len(sizes))


def _sizes(points: Float64, ids: NDArray[Any], *, tail: float) -> tuple[Float64, Int64]:
    """(K, 3) size of each set along the axes without its outermost points, a share `tail` at each end; (K,) counts."""
    _, group, counts = np.unique(ids, return_inverse=True, return_counts=True)
    first = np.cumsum(counts) - counts
    left_out = (tail * counts).astype(np.int64)
    sizes = np.empty((len(counts), 3))
    for axis in range(3):
        values = points[np.lexsort((points[:, axis], group)), axis]
        sizes[:, axis] = values[first + counts - 1 - left_out] - values[first + left_out]
    return sizes, counts


def ids_of_tiles(tiles: Sequence[PointCloud], name: str) -> tuple[list[NDArray[Any]], str]:
    """The tree ids of tiles, made so that no two trees share one, and a note where that took a change.

    Tiles that were numbered one by one all begin with tree 1. Tiles that were cut from a numbered plot share ids, too:
    of the trees on their borders, whose parts touch. These stay as they are.

    Args:
        tiles: Clouds that all have the attribute.
        name: Of the attribute.

    Returns:
        One (N,) array per tile, and the note; empty where the ids are as they were.
    """
    columns = [tile.attributes[name] for tile in tiles]
    if not is_tree_id_name(name) or not any(_holds_ids(t.attributes[name]) and _is_believed(t, name) for t in tiles):
        return columns, ""
    if not _share_ids_of_different_trees(tiles, columns):
        return columns, ""
    known = [assigned(ids) for ids in columns]
    largest = max(int(ids[has].max(initial=0)) for ids, has in zip(columns, known, strict=True))
    step = 10 ** len(str(largest))
    how = "raised"
    if step * len(tiles) > _MAX_TRUNK_ID:
        columns = [np.searchsorted(np.unique(ids[has]), ids) + 1 for ids, has in zip(columns, known, strict=True)]
        step = 10 ** len(str(max(int(ids[has].max(initial=0)) for ids, has in zip(columns, known, strict=True))))
        how = "counted from 1 and raised"
    apart: list[NDArray[Any]] = []
    for k, (ids, has) in enumerate(zip(columns, known, strict=True)):
        apart.append(np.where(has, np.where(has, ids, 0).astype(np.int64) + k * step, 0))
    return apart, (
        f"The tiles use the same numbers ({name}) for different trees: the numbers of the second tile were {how} by "
        f"{step}, those of the third by {2 * step}, and so on."
    )


def _share_ids_of_different_trees(tiles: Sequence[PointCloud], columns: Sequence[NDArray[Any]]) -> bool:
    """Whether some id occurs in two tiles at places that do not touch."""
    boxes = [_boxes(tile, ids, tiles[0].origin) for tile, ids in zip(tiles, columns, strict=True)]
    for k, (ids, lower, upper) in enumerate(boxes):
        for other_ids, other_lower, other_upper in boxes[k + 1 :]:
            _, a, b = np.intersect1d(ids, other_ids, assume_unique=True, return_indices=True)
            gap = np.maximum(lower[a] - other_upper[b], other_lower[b] - upper[a]).max(axis=1)
            size = np.maximum(upper[a] - lower[a], other_upper[b] - other_lower[b]).max(axis=1)
            if (gap > _BORDER_GAP_SHARE * size).any():
                return True
    return False


def _boxes(tile: PointCloud, ids: NDArray[Any], origin: Float64) -> tuple[NDArray[Any], Float64, Float64]:
    """(K,) ids and the (K, 3) lower and upper corners of each tree's box, about `origin`."""
    rows = np.flatnonzero(assigned(ids))
    rows = rows[np.argsort(ids[rows], kind="stable")]
    names, first = np.unique(ids[rows], return_index=True)
    shift = tile.origin - origin
    lower, upper = np.empty((len(names), 3)), np.empty((len(names), 3))
    for axis in range(3):
        if len(names):
            values = tile.xyz[rows, axis].astype(np.float64)
            lower[:, axis] = np.minimum.reduceat(values, first) + shift[axis]
            upper[:, axis] = np.maximum.reduceat(values, first) + shift[axis]
    return names, lower, upper


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
