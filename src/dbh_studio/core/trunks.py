"""Trunks as sets of point indices, so that they survive a new scale and a new ground."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Int32, readonly

# Labels of points and the saved plot hold ids as int32.
MAX_TRUNK_ID = 2**31 - 1


@dataclass(frozen=True, eq=False)
class Trunk:
    """One stem.

    Attributes:
        id: From 1 to `MAX_TRUNK_ID`, never reused within a plot.
        points: (K,) sorted, unique indices into the plot's cloud.
        origin: Where it came from: ``geometry``, ``file``, ``masks``, ``hand``, or ``carried`` from another cloud.
    """

    id: int
    points: Int32
    origin: str = "geometry"

    def __post_init__(self) -> None:
        if not 0 < self.id <= MAX_TRUNK_ID:
            raise ValueError(f"trunk id is {self.id} but must be positive and at most {MAX_TRUNK_ID}")
        points = np.asarray(self.points, np.int32)
        if points.ndim != 1 or (len(points) > 1 and not (np.diff(points) > 0).all()):
            raise ValueError(f"points of trunk {self.id} must be a sorted, unique (K,) array")
        object.__setattr__(self, "points", readonly(points))

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class TrunkSet:
    """Disjoint trunks. Changing one makes a new set that shares all the others.

    Attributes:
        trunks: In order of id.
        next_id: The id the next new trunk gets; grows only, to one above `MAX_TRUNK_ID` where there is none left.
    """

    trunks: tuple[Trunk, ...] = ()
    next_id: int = 1
    _by_id: MappingProxyType[int, Trunk] = field(init=False, repr=False, default_factory=lambda: MappingProxyType({}))

    def __post_init__(self) -> None:
        by_id = {trunk.id: trunk for trunk in self.trunks}
        if len(by_id) != len(self.trunks):
            raise ValueError("two trunks have the same id")
        object.__setattr__(self, "trunks", tuple(sorted(self.trunks, key=lambda trunk: trunk.id)))
        object.__setattr__(self, "next_id", max([self.next_id, *(i + 1 for i in by_id)]))
        if self.next_id > MAX_TRUNK_ID + 1:
            raise ValueError(f"next id is {self.next_id} but must be at most {MAX_TRUNK_ID + 1}")
        object.__setattr__(self, "_by_id", MappingProxyType(by_id))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.trunks, self.next_id)

    @classmethod
    def from_point_sets(
        cls, point_sets: Iterable[NDArray[Any]], *, origin: str = "geometry", first_id: int = 1
    ) -> TrunkSet:
        """Number the given index sets first_id, first_id + 1, … Each set is sorted and made unique."""
        trunks = tuple(
            Trunk(first_id + i, np.unique(np.asarray(points, np.int32)), origin) for i, points in enumerate(point_sets)
        )
        return cls(trunks, first_id + len(trunks))

    def __len__(self) -> int:
        return len(self.trunks)

    def __iter__(self) -> Iterator[Trunk]:
        return iter(self.trunks)

    def __contains__(self, trunk_id: object) -> bool:
        return trunk_id in self._by_id

    def __getitem__(self, trunk_id: int) -> Trunk:
        return self._by_id[trunk_id]

    @property
    def ids(self) -> tuple[int, ...]:
        """All ids, ascending."""
        return tuple(trunk.id for trunk in self.trunks)

    def labels(self, n_points: int) -> Int32:
        """(n_points,) trunk id of every point of the cloud, 0 where none."""
        labels = np.zeros(n_points, np.int32)
        for trunk in self.trunks:
            labels[trunk.points] = trunk.id
        return labels

    def with_trunk(self, trunk: Trunk) -> TrunkSet:
        """The set with `trunk` added, or put in place of the one with its id."""
        others = tuple(other for other in self.trunks if other.id != trunk.id)
        return replace(self, trunks=(*others, trunk))

    def without(self, trunk_id: int) -> TrunkSet:
        """The set without one trunk; its id is not given out again."""
        return replace(self, trunks=tuple(trunk for trunk in self.trunks if trunk.id != trunk_id))
