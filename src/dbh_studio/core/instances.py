"""Which masks of different photos show the same trunk: those that cover the same points.

Each mask of a trunk is a node. Two masks of different photos are one trunk where, of what each covers and the other's
photo sees, most is covered by the other. Points are taken as coarse cubes, so that 200 photos stay small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from dbh_studio.core.arrays import Float, Int32, Int64, readonly
from dbh_studio.core.votes import PhotoVotes
from dbh_studio.core.voxels import cube_keys

# More than a half: a mask over two equal trunks covers half of what it should for each.
_SAME = 0.6
_LEAST_CUBES = 4


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


class InstanceGatherer:
    """Gathers photos one by one, as `stages.vote.vote` gives them to `on_photo`.

    Args:
        points: (M, 3) voters.
        edge_m: Of the coarse cubes.
    """

    def __init__(self, points: Float, *, edge_m: float = 0.10) -> None:
        keys = cube_keys(points, edge_m) if len(points) else np.empty(0, np.int64)
        self._cube = np.unique(keys, return_inverse=True)[1].reshape(-1).astype(np.int32)
        self._n_cubes = int(self._cube.max()) + 1 if len(self._cube) else 0
        self._seen: list[Int32] = []
        self._covered: list[tuple[Int32, Int32]] = []
        self._photo_of_mask: list[int] = []

    def add(self, photo: PhotoVotes) -> None:
        """Take in a photo. One whose masks do not tell trunks apart says nothing here."""
        if not photo.has_instances:
            return
        cube = self._cube[photo.rows]
        self._seen.append(np.unique(cube).astype(np.int32))
        on_trunk = photo.labels > 0
        cube, labels = cube[on_trunk].astype(np.int64), photo.labels[on_trunk].astype(np.int64)
        pairs, counts = np.unique((cube << 32) | labels, return_counts=True)
        # On the edge between two masks the commoner one has the cube.
        order = np.lexsort((-counts, pairs >> 32))
        pairs = pairs[order]
        first = np.ones(len(pairs), bool)
        first[1:] = (pairs[1:] >> 32) != (pairs[:-1] >> 32)
        pairs = pairs[first]
        names, number = np.unique(pairs & 0xFFFFFFFF, return_inverse=True)
        node = len(self._photo_of_mask) + number.reshape(-1)
        self._covered.append(((pairs >> 32).astype(np.int32), node.astype(np.int32)))
        self._photo_of_mask += [len(self._seen) - 1] * len(names)

    def ties(self) -> InstanceTies:
        """The trunks so far."""
        n_masks, n_photos = len(self._photo_of_mask), len(self._seen)
        if not n_masks:
            return InstanceTies(readonly(np.zeros(len(self._cube), np.int32)), 0, np.zeros(0, np.int64), ())
        covers = _sparse(
            [pair[0] for pair in self._covered], [pair[1] for pair in self._covered], self._n_cubes, n_masks
        )
        photos = [np.full(len(cubes), k, np.int32) for k, cubes in enumerate(self._seen)]
        sees = _sparse(self._seen, photos, self._n_cubes, n_photos)
        photo = np.array(self._photo_of_mask)
        common = (covers.T @ covers).tocoo()
        visible = (covers.T @ sees).tocsr()
        a, b, count = common.row, common.col, common.data
        seen_by_b = np.asarray(visible[a, photo[b]]).ravel()
        seen_by_a = np.asarray(visible[b, photo[a]]).ravel()
        same = (photo[a] != photo[b]) & (count >= _LEAST_CUBES)
        same &= (count >= _SAME * seen_by_b) & (count >= _SAME * seen_by_a)
        graph = csr_matrix((np.ones(int(same.sum())), (a[same], b[same])), shape=(n_masks, n_masks))
        n_trunks, trunk = connected_components(graph, directed=False)
        sizes = np.bincount(trunk, minlength=n_trunks)
        twice = np.unique(np.column_stack([trunk, photo]), axis=0, return_counts=True)
        conflict = tuple(int(name) + 1 for name in np.unique(twice[0][twice[1] > 1, 0]))
        of_cube = self._commonest(covers, trunk, n_trunks)
        return InstanceTies(readonly(of_cube[self._cube]), int(n_trunks), sizes.astype(np.int64), conflict)

    def _commonest(self, covers: csr_matrix, trunk: Int32, n_trunks: int) -> Int32:
        """(C,) number of the trunk that most masks on each cube belong to, 0 where there is none."""
        to_trunk = _sparse([np.arange(len(trunk), dtype=np.int32)], [trunk], len(trunk), n_trunks)
        votes = (covers @ to_trunk).tocoo()
        order = np.lexsort((votes.data, votes.row))
        of_cube = np.zeros(self._n_cubes, np.int32)
        # The last entry of a cube is its largest, and assignment keeps the last.
        of_cube[votes.row[order]] = votes.col[order] + 1
        return of_cube


def _sparse(rows: list[Int32], columns: list[Int32], n_rows: int, n_columns: int) -> csr_matrix:
    row, column = np.concatenate(rows), np.concatenate(columns)
    return csr_matrix((np.ones(len(row), np.int32), (row, column)), shape=(n_rows, n_columns))
