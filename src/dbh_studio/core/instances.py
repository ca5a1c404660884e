"""Which masks of different photos show the same trunk: those that cover the same points.

Each mask of a trunk is a node. Two masks of different photos are one trunk where, of what each covers and the other's
photo sees, most is covered by the other. Points are taken as coarse cubes and what a photo sees as one bit for each of
them, so that 200 photos stay small; what is tied is asked of the candidates only.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from dbh_studio.core.arrays import Bool, Float, Float64, Int32, Int64, readonly
from dbh_studio.core.votes import PhotoVotes
from dbh_studio.core.voxels import cube_keys

# More than a half: a mask over two equal trunks covers half of what it should for each.
_SAME = 0.6
_LEAST_CUBES = 4
# And so much of the smaller one. Photos that look at twins from opposite sides have in common where the two touch.
_LEAST_SHARE = 0.2
# A mask whose cubes scatter more than this (median distance in plan from their middle) is of no single trunk: a class
# that was numbered, or a blob over background.
_WIDEST_M = 1.0
# A photo has a thing in view where it sees this part of its cubes, and calls it trunk where its masks are on this part
# of those it sees.
_IN_VIEW, _CALLED = 0.15, 0.5


@dataclass(frozen=True, eq=False)
class InstanceTies:
    """Trunks as the masks of all photos tell them apart.

    Attributes:
        trunk_of_voter: (M,) int32: 0 none, else the number of the trunk that most masks on its cube belong to.
        n_trunks: How many there are.
        n_masks: (n_trunks,) masks each was seen in.
        in_conflict: Numbers of trunks of which one photo has two masks: a mask elsewhere covers two trunks, or one
            trunk is cut in two by what stands before it. A person should look.
    """

    trunk_of_voter: Int32
    n_trunks: int
    n_masks: Int64
    in_conflict: tuple[int, ...]
    _cube: Int32 = field(repr=False, default_factory=lambda: np.zeros(0, np.int32))
    _covers: csr_matrix | None = field(repr=False, default=None)
    _photo: Int32 = field(repr=False, default_factory=lambda: np.zeros(0, np.int32))

    def apart_and_together(self, first: Int64, second: Int64) -> tuple[int, int]:
        """In how many photos two parts of the cloud have a mask each, and in how many one mask has both.

        Args:
            first: Voters of the one part.
            second: Of the other.
        """
        if self._covers is None:
            return 0, 0
        n_photos = int(self._photo.max(initial=-1)) + 1
        has_most = []
        for part in (first, second):
            count = np.asarray(self._covers[np.unique(self._cube[part])].sum(axis=0)).ravel()
            of_photo = np.bincount(self._photo, count, n_photos)
            # Cubes lie astride the line where two stems touch, so each one's mask has some of the other.
            has_most.append((count >= _LEAST_CUBES) & (count >= _SAME * of_photo[self._photo]))
        both = np.bincount(self._photo[has_most[0] & has_most[1]], minlength=n_photos) > 0
        each = [np.bincount(self._photo[most], minlength=n_photos) > 0 for most in has_most]
        return int(np.count_nonzero(each[0] & each[1] & ~both)), int(np.count_nonzero(both))


@dataclass(frozen=True)
class InView:
    """How many photos speak of a part of the cloud.

    Attributes:
        n_seen: Photos that have it in view, not hidden, with masks that say something there.
        n_called: Of these, how many call it trunk.
    """

    n_seen: int
    n_called: int


class InstanceGatherer:
    """Gathers photos one by one, as `stages.vote.vote` gives them to `on_photo`.

    Memory: a bit per cube and photo, and eight bytes per cube that a photo calls trunk.

    Args:
        points: (M, 3) voters.
        edge_m: Of the coarse cubes.
    """

    def __init__(self, points: Float, *, edge_m: float = 0.10) -> None:
        keys = cube_keys(points, edge_m) if len(points) else np.empty(0, np.int64)
        _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
        self._cube = inverse.reshape(-1).astype(np.int32)
        self._n_cubes = len(first)
        self._xy = np.asarray(points[first, :2] if len(points) else np.empty((0, 2)), np.float64)
        self._seen: list[NDArray[np.uint8]] = []
        self._covered: list[tuple[Int32, Int32]] = []
        self._has_instances: list[bool] = []

    def add(self, photo: PhotoVotes) -> None:
        """Take in a photo. One whose masks do not tell trunks apart ties nothing, but is counted by `in_view`."""
        cube = self._cube[photo.rows]
        seen = np.zeros(self._n_cubes, bool)
        seen[cube] = True
        self._seen.append(np.packbits(seen))
        on_trunk = np.flatnonzero(photo.labels > 0)
        labels = photo.labels[on_trunk].astype(np.int64)
        pairs, counts = np.unique((cube[on_trunk].astype(np.int64) << 32) | labels, return_counts=True)
        # On the edge between two masks the commoner one has the cube.
        pairs = pairs[np.lexsort((-counts, pairs >> 32))]
        first = np.ones(len(pairs), bool)
        first[1:] = (pairs[1:] >> 32) != (pairs[:-1] >> 32)
        pairs = pairs[first]
        self._covered.append(((pairs >> 32).astype(np.int32), (pairs & 0xFFFFFFFF).astype(np.int32)))
        self._has_instances.append(photo.has_instances)

    def in_view(self, voters: Int64) -> InView:
        """How many photos see a part of the cloud, and how many of these call it trunk.

        Args:
            voters: Which rows of the points it is.
        """
        inside = np.zeros(self._n_cubes, bool)
        inside[self._cube[voters]] = True
        n_cubes, bits = int(np.count_nonzero(inside)), np.packbits(inside)
        # A part is few of all cubes: only the bytes that hold some of it are looked at, photo by photo.
        at = np.flatnonzero(bits)
        bits = bits[at]
        n_seen = n_called = 0
        for seen, (cubes, _) in zip(self._seen, self._covered, strict=True):
            n_here = int(_ONES[seen[at] & bits].sum())
            if n_cubes and n_here >= max(_IN_VIEW * n_cubes, 1):
                n_seen += 1
                n_called += int(np.count_nonzero(inside[cubes])) >= _CALLED * n_here
        return InView(n_seen, n_called)

    def ties(self, is_candidate: Bool | None = None) -> InstanceTies:
        """The trunks so far.

        Args:
            is_candidate: (M,) which voters are asked; all by default. What no vote made trunk ties nothing, and is most
                of a cloud.
        """
        asked = np.ones(self._n_cubes, bool)
        if is_candidate is not None:
            asked = np.zeros(self._n_cubes, bool)
            asked[self._cube[is_candidate]] = True
        cubes, masks, photo = self._masks(asked)
        n_masks, n_photos = len(photo), len(self._seen)
        if not n_masks:
            return InstanceTies(readonly(np.zeros(len(self._cube), np.int32)), 0, np.zeros(0, np.int64), ())
        covers = _sparse(cubes, masks, self._n_cubes, n_masks)
        common = (covers.T @ covers).tocoo()
        visible = self._visible(covers, np.flatnonzero(asked), n_photos)
        a, b, count = common.row, common.col, common.data
        seen_by_b, seen_by_a = visible[a, photo[b]], visible[b, photo[a]]
        size = np.asarray(covers.sum(axis=0)).ravel()
        enough = (count >= _LEAST_CUBES) & (count >= _LEAST_SHARE * np.minimum(size[a], size[b]))
        inside = (photo[a] != photo[b]) & enough & (count >= _SAME * seen_by_a)
        same = inside & (count >= _SAME * seen_by_b)
        swallows = _over_several(a, b, inside, same, photo)
        same &= ~swallows[a] & ~swallows[b]
        graph = csr_matrix((np.ones(int(same.sum())), (a[same], b[same])), shape=(n_masks, n_masks))
        n_trunks, trunk = connected_components(graph, directed=False)
        sizes = np.bincount(trunk, minlength=n_trunks)
        twice = np.unique(np.column_stack([trunk, photo]), axis=0, return_counts=True)
        conflict = tuple(int(name) + 1 for name in np.unique(twice[0][twice[1] > 1, 0]))
        of_cube = self._commonest(covers, trunk, n_trunks)
        of_voter = of_cube[self._cube]
        return InstanceTies(
            readonly(of_voter), int(n_trunks), sizes.astype(np.int64), conflict, self._cube, covers, photo
        )

    def _masks(self, asked: Bool) -> tuple[Int32, Int32, Int32]:
        """(P,) cube and (P,) mask of all that is covered, (n_masks,) photo of each mask."""
        cubes, masks, photos = [np.empty(0, np.int32)], [np.empty(0, np.int32)], [np.empty(0, np.int32)]
        n_masks = 0
        for index, (cube, label) in enumerate(self._covered):
            if not self._has_instances[index]:
                continue
            inside = asked[cube]
            cube, label = cube[inside], label[inside]
            names, mask = np.unique(label, return_inverse=True)
            mask = mask.reshape(-1)
            compact = _is_compact(self._xy[cube], mask, len(names))
            number = np.cumsum(compact) - 1
            kept = compact[mask] if len(mask) else np.zeros(0, bool)
            cubes.append(cube[kept])
            masks.append((n_masks + number[mask[kept]]).astype(np.int32))
            n_here = int(np.count_nonzero(compact))
            photos.append(np.full(n_here, index, np.int32))
            n_masks += n_here
        return np.concatenate(cubes), np.concatenate(masks), np.concatenate(photos)

    def _visible(self, covers: csr_matrix, asked: Int64, n_photos: int) -> Int32:
        """(n_masks, n_photos) how many cubes of each mask each photo sees."""
        transposed = covers[asked].T.tocsr()
        visible = np.zeros((transposed.shape[0], n_photos), np.int32)
        for index, seen in enumerate(self._seen):
            visible[:, index] = transposed @ np.unpackbits(seen, count=self._n_cubes)[asked].astype(np.int32)
        return visible

    def _commonest(self, covers: csr_matrix, trunk: Int32, n_trunks: int) -> Int32:
        """(C,) number of the trunk that most masks on each cube belong to, 0 where there is none."""
        to_trunk = _sparse(np.arange(len(trunk), dtype=np.int32), trunk, len(trunk), n_trunks)
        votes = (covers @ to_trunk).tocoo()
        order = np.lexsort((votes.data, votes.row))
        of_cube = np.zeros(self._n_cubes, np.int32)
        # The last entry of a cube is its largest, and assignment keeps the last.
        of_cube[votes.row[order]] = votes.col[order] + 1
        return of_cube


# How many bits are set in every byte.
_ONES = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(axis=1).astype(np.int64)


def _over_several(a: Int32, b: Int32, inside: Bool, same: Bool, photo: Int32) -> Bool:
    """(n_masks,) masks that lie over several trunks, which they would tie together.

    Many photos have two masks within such a one, and not more than twice as many have one that is the same (photos that
    see only the trunk in front have). Of a mask of one trunk most photos have the same, and few have it in two pieces.

    Args:
        a: (P,) and b: (P,) pairs of masks that share cubes.
        inside: (P,) whether most of what b covers, and a's photo sees, is covered by a.
        same: (P,) whether it is so both ways.
        photo: (n_masks,) of each mask.
    """
    n_masks, n_photos = len(photo), int(photo.max(initial=-1)) + 1
    key = a.astype(np.int64) * n_photos + photo[b]
    keys, counts = np.unique(key[inside], return_counts=True)
    in_two = np.bincount(keys[counts >= 2] // max(n_photos, 1), minlength=n_masks)
    in_one = np.bincount(np.unique(key[same]) // max(n_photos, 1), minlength=n_masks)
    return np.asarray((in_two >= 2) & (2 * in_two > in_one))


def _is_compact(xy: Float64, mask: Int64, n_masks: int) -> Bool:
    """(n_masks,) whether a mask's cubes lie about one place in plan."""
    if not n_masks:
        return np.zeros(0, bool)
    away = np.hypot(*(xy - np.column_stack([_medians(xy[:, k], mask, n_masks) for k in (0, 1)])[mask]).T)
    return np.asarray(_medians(away, mask, n_masks) <= _WIDEST_M)


def _medians(values: Float64, group: Int64, n_groups: int) -> Float64:
    """(n_groups,) the lower median of each group; every group has values."""
    order = np.lexsort((values, group))
    counts = np.bincount(group, minlength=n_groups)
    starts = np.cumsum(counts) - counts
    return np.asarray(values[order][starts + (counts - 1) // 2])


def _sparse(row: Int32, column: Int32, n_rows: int, n_columns: int) -> csr_matrix:
    return csr_matrix((np.ones(len(row), np.int32), (row, column)), shape=(n_rows, n_columns))
