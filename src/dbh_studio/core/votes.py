"""Votes of photos on points: how often each was seen, how often it was called trunk, and what follows from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, Float32, Int32, Int64, readonly
from dbh_studio.core.voxels import Thinned
from dbh_studio.settings import VoteSettings

UInt16 = NDArray[np.uint16]

_VERSION = 1
_ARRAYS = ("n_seen", "n_trunk", "weight_seen", "weight_trunk")


@dataclass(frozen=True, eq=False)
class Votes:
    """Of all photos, for every point.

    Attributes:
        n_seen: (N,) uint16 photos whose masks say something of the point: in view, not hidden.
        n_trunk: (N,) uint16 of these, how many call it trunk: the paper's label count.
        weight_seen: (N,) float32 sum of the weights of the first.
        weight_trunk: (N,) float32 of the second.
    """

    n_seen: UInt16
    n_trunk: UInt16
    weight_seen: Float32
    weight_trunk: Float32

    def __post_init__(self) -> None:
        for name in _ARRAYS:
            array = getattr(self, name)
            if array.shape != self.n_seen.shape:
                raise ValueError(f"{name} has shape {array.shape} but {self.n_seen.shape} is needed")
            object.__setattr__(self, name, readonly(array))

    def __len__(self) -> int:
        return len(self.n_seen)

    @property
    def share(self) -> Float32:
        """(N,) weighted share of the photos that see a point and call it trunk; NaN where none sees it."""
        seen = self.weight_seen > 0
        return np.divide(self.weight_trunk, self.weight_seen, out=np.full(len(self), np.nan, np.float32), where=seen)

    def is_trunk(self, settings: VoteSettings = VoteSettings()) -> Bool:  # noqa: B008 - frozen
        """(N,) whether the votes make a point trunk, by `settings.rule`; a point that no photo sees is not.

        ``share`` asks for the count too: what one photo alone sees between leaves is trunk as often as not.
        """
        enough = self.n_trunk >= settings.min_count
        if settings.rule == "share":
            # Sums in float32: an exact half must stay one.
            enough &= self.weight_trunk >= np.float32(settings.min_share * (1.0 - 1e-6)) * self.weight_seen
        return np.asarray(enough)

    def carried_back(self, thinned: Thinned, rows: Int64, n_points: int) -> Votes:
        """The votes of every point of the cloud, from those of its cubes; none where a point was not asked.

        Args:
            thinned: How the points at `rows` were thinned; these are the votes of its cubes.
            rows: (K,) which points of the cloud had a vote.
            n_points: Of the cloud.
        """
        parts = []
        for name in _ARRAYS:
            values = getattr(self, name)
            full = np.zeros(n_points, values.dtype)
            # Row by row of the thinned order: no second array of all points is made.
            full[rows[thinned.order]] = np.repeat(values, thinned.counts)
            parts.append(full)
        return Votes(*parts)


@dataclass(frozen=True, eq=False)
class PhotoVotes:
    """What one photo says.

    Attributes:
        name: Of the photo.
        rows: (M,) int32 voters it sees, ascending.
        labels: (M,) int32: 0 no trunk, above 0 trunk, or which trunk where the masks tell.
        weights: (M,) float32; None where all are 1.
        has_instances: Whether labels tell one trunk from the next.
    """

    name: str
    rows: Int32
    labels: Int32
    weights: Float32 | None = None
    has_instances: bool = False


class VoteCounter:
    """Adds up photos, one after the other; can be put aside and taken up again.

    Attributes:
        key: What the votes are about: the points, the poses and the settings. Votes on other things must not be mixed.
        done: Names of the photos counted.
    """

    def __init__(self, n_voters: int, key: str = "") -> None:
        self.key = key
        self.done: set[str] = set()
        self._n_seen = np.zeros(n_voters, np.uint16)
        self._n_trunk = np.zeros(n_voters, np.uint16)
        self._weight_seen = np.zeros(n_voters, np.float32)
        self._weight_trunk = np.zeros(n_voters, np.float32)
        # Without weights the sums are the counts, and are not added up a second time.
        self._has_weights = False

    def __len__(self) -> int:
        return len(self._n_seen)

    def add(self, photo: PhotoVotes) -> None:
        """Count a photo. One that was counted already changes nothing."""
        if photo.name in self.done:
            return
        rows, is_trunk = photo.rows, photo.labels > 0
        if photo.weights is not None or self._has_weights:
            weights = np.ones(len(rows), np.float32) if photo.weights is None else photo.weights
            self._sum_counts()
            self._has_weights = True
            self._weight_seen[rows] += weights
            self._weight_trunk[rows] += weights * is_trunk.astype(np.float32)
        # No row is there twice, so adding through an index is right.
        self._n_seen[rows] += np.uint16(1)
        self._n_trunk[rows[is_trunk]] += np.uint16(1)
        self.done.add(photo.name)

    def skip(self, name: str) -> None:
        """Note that a photo has nothing to say."""
        self.done.add(name)

    def votes(self) -> Votes:
        """The votes so far."""
        return Votes(*(array.copy() for array in self._arrays().values()))

    def state(self) -> dict[str, NDArray[Any]]:
        """Plain arrays, for `numpy.savez`."""
        names = np.array(sorted(self.done), dtype=np.str_)
        return {"version": np.array(_VERSION), "key": np.array(self.key), "done": names, **self._arrays()}

    @classmethod
    def from_state(cls, state: Mapping[str, NDArray[Any]], *, n_voters: int, key: str) -> VoteCounter | None:
        """What `state` gave; None where it is about other points, poses or settings, or of another version.

        Args:
            state: Arrays by name.
            n_voters: How many it must be about.
            key: What it must be about.
        """
        wanted = {"version", "key", "done", *_ARRAYS}
        if not wanted <= set(state) or int(state["version"]) != _VERSION or str(state["key"]) != key:
            return None
        counter = cls(n_voters, key)
        for name in _ARRAYS:
            array = getattr(counter, f"_{name}")
            stored = np.asarray(state[name])
            if stored.shape != array.shape or stored.dtype != array.dtype:
                return None
            array[:] = stored
        counter.done = {str(name) for name in state["done"]}
        counter._has_weights = any(
            not np.array_equal(sums, counts)
            for sums, counts in ((counter._weight_seen, counter._n_seen), (counter._weight_trunk, counter._n_trunk))
        )
        return counter

    def _sum_counts(self) -> None:
        if not self._has_weights:
            self._weight_seen[:], self._weight_trunk[:] = self._n_seen, self._n_trunk

    def _arrays(self) -> dict[str, NDArray[Any]]:
        self._sum_counts()
        return {name: getattr(self, f"_{name}") for name in _ARRAYS}
