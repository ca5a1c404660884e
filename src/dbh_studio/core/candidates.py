"""Stems that may be trunks: shown to a person with the reason, and no trunks until somebody says so."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from dbh_studio.core.arrays import Int32, readonly

CandidateKind = Literal["unseen", "denied", "outvoted", "dropped", "low"]
"""A stem by its shape that no photo sees, or that photos see and none calls trunk, or too few, or enough and the steps
after lost it; or no stem by its shape, but called trunk, and ends below breast height: a log or a bush."""


@dataclass(frozen=True, eq=False)
class CandidateTrunk:
    """What may be a trunk: by its shape and not by the masks, or the other way round.

    Attributes:
        points: (K,) sorted, unique indices into the plot's cloud.
        xy_m: Where it stands, metres in the world frame it was found in.
        diameter_m: A guess, by its rings, or by its width where it has none.
        kind: See `CandidateKind`.
        reason: The same for a person, with counts.
        n_seen: Photos that have it in view.
        n_called: Of these, how many call it trunk.
    """

    points: Int32
    xy_m: tuple[float, float]
    diameter_m: float
    kind: CandidateKind
    reason: str
    n_seen: int = 0
    n_called: int = 0

    def __post_init__(self) -> None:
        points = np.asarray(self.points, np.int32)
        if points.ndim != 1 or not len(points) or points[0] < 0 or (np.diff(points) <= 0).any():
            raise ValueError("points of a candidate must be a sorted, unique (K,) array with at least one index")
        object.__setattr__(self, "points", readonly(points))

    def __len__(self) -> int:
        return len(self.points)
