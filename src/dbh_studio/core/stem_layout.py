"""One map of stems laid on another: as they are, or turned and shifted in plan where the frames differ.

Diameters are never looked at: pairs chosen by how well they agree would make every evaluation look better than it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Float64, Int64, readonly
from dbh_studio.core.stem_match import PlanSimilarity, StemMatch, match_stems

_NO_FRAME = PlanSimilarity(1.0, 0.0, readonly(np.zeros(2)))
# Laying two maps on each other compares all triangles of neighbours; beyond this it takes minutes.
_MOST_STEMS = 1_500
_FIT_TOLERANCE_M = 0.5
_MIN_SHARE = 0.3
# Turning and shifting unrelated maps brings up to 40 % of their stems together, five in small ones.
_MIN_SHARE_MOVED, _MIN_MOVED = 0.5, 5
_MOST_RIVAL = 0.67
# In a dense stand many stems fall on some stem whatever the shift: standard deviations above that.
_ABOVE_CHANCE = 3.0
_MIN_STEMS = 4

PairBy = Literal["auto", "id", "position"]
Align = Literal["auto", "never"]


@dataclass(frozen=True)
class PairingRule:
    """How stems are paired.

    Attributes:
        by: ``id``, ``position``, or ``auto``: by number where the places agree with it or are unknown, else by place.
        max_distance_m: Stems farther apart are never the same.
        align: ``auto`` turns and shifts the inventory in plan where it then fits clearly better; ``never`` takes both
            tables to be in one frame.
    """

    by: PairBy = "auto"
    max_distance_m: float = 1.0
    align: Align = "auto"

    def __post_init__(self) -> None:
        if self.by not in ("auto", "id", "position") or self.align not in ("auto", "never"):
            raise ValueError(f"no such way of pairing: {self}")
        if not 0.0 < self.max_distance_m < np.inf:
            raise ValueError(f"max_distance_m is {self.max_distance_m} but must be above zero")


@dataclass(frozen=True, eq=False)
class FrameFit:
    """How the inventory of one plot was laid on the reference.

    Attributes:
        plot: Its name.
        target_from_source: Reference from inventory, in plan, for coordinates as they are in the tables.
        moved_m: How far the middle of the inventory was moved.
        rms_m: Root mean square distance of the pairs.
        n_pairs: How many.
        is_moved: Whether the frames differ.
        reason: Why nothing was paired; empty where something was.
    """

    plot: str
    target_from_source: PlanSimilarity = _NO_FRAME
    moved_m: float = 0.0
    rms_m: float = float("nan")
    n_pairs: int = 0
    is_moved: bool = False
    reason: str = ""

    @property
    def turn_deg(self) -> float:
        """Anticlockwise."""
        return float(np.degrees(self.target_from_source.angle_rad))


def lay_on(
    xy_m: Float64, target_m: Float64, *, rule: PairingRule, plot: str = ""
) -> tuple[FrameFit, Int64, Float64, Float64]:
    """Pair two maps of stems, the first turned and shifted where that is what fits.

    Args:
        xy_m: (S, 2) finite places of the inventory.
        target_m: (T, 2) finite places of the reference.
        rule: How far stems may be apart, and whether the frames may differ.
        plot: For the result.

    Returns:
        How they lie on each other; (P, 2) rows of both; (P,) distances, metres; (P,) distance from each reference stem
        to the nearest other inventory stem, NaN where there is none. No pairs where `FrameFit.reason` says why.
    """
    if not len(xy_m) or not len(target_m):
        return FrameFit(plot, reason="one of the tables has no places there"), *_nothing()
    possible = min(len(xy_m), len(target_m))
    direct = nearest_pairs(xy_m, target_m, rule.max_distance_m)
    if rule.align == "never":
        return _result(plot, _NO_FRAME, xy_m, target_m, direct, is_moved=False)
    fits_directly = possible < _MIN_STEMS and len(direct) > 0
    if possible >= _MIN_STEMS and len(direct) >= _MIN_SHARE * possible:
        chance = _chance(xy_m, target_m, rule.max_distance_m)
        fits_directly = len(direct) >= chance + _ABOVE_CHANCE * np.sqrt(chance)
    # Coordinates of a map are millions of metres: about the middle, a turn does not lose the last digits.
    middle, target_middle = np.median(xy_m, axis=0), np.median(target_m, axis=0)
    match = None
    if possible >= _MIN_STEMS and max(len(xy_m), len(target_m)) <= _MOST_STEMS:
        tolerance = min(_FIT_TOLERANCE_M, rule.max_distance_m)
        match = match_stems(xy_m - middle, target_m - target_middle, scale=1.0, tolerance_m=tolerance)
    reason = _moved_in_vain(match, possible)
    if match is not None and not reason:
        turned = PlanSimilarity(1.0, match.target_from_source.angle_rad, readonly(np.zeros(2)))
        shift = match.target_from_source.shift + target_middle - turned.apply(middle[None])[0]
        plan = PlanSimilarity(1.0, turned.angle_rad, readonly(shift))
        pairs = nearest_pairs(plan.apply(xy_m), target_m, rule.max_distance_m)
        if not fits_directly or _is_clearly_better(plan, pairs, direct, xy_m, target_m):
            return _result(plot, plan, xy_m, target_m, pairs, is_moved=True)
    if fits_directly:
        return _result(plot, _NO_FRAME, xy_m, target_m, direct, is_moved=False)
    return FrameFit(plot, reason=_why_not(reason, possible)), *_nothing()


def _moved_in_vain(match: StemMatch | None, possible: int) -> str:
    """Why a turn and shift is not believed: it must bring together more than chance does. Empty where it is."""
    if match is None:
        return "no turn and shift brings them together"
    n = len(match.pairs)
    if n < max(min(possible, _MIN_MOVED), _MIN_SHARE_MOVED * possible):
        return f"at best {n} of {possible} stems fall on a stem of the other table"
    if match.rival_pairs > _MOST_RIVAL * n:
        return f"{n} stems fit one way and {match.rival_pairs} another"
    return match.reason


def _why_not(reason: str, possible: int) -> str:
    if possible < _MIN_STEMS:
        return f"the stems do not stand in the same places, and {possible} are too few to find out how they were moved"
    return f"the places in the two tables do not fit together ({reason})"


def _nothing() -> tuple[Int64, Float64, Float64]:
    return np.empty((0, 2), np.int64), np.empty(0), np.empty(0)


def _result(
    plot: str, plan: PlanSimilarity, xy: Float64, target: Float64, pairs: Int64, *, is_moved: bool
) -> tuple[FrameFit, Int64, Float64, Float64]:
    moved = plan.apply(xy)
    distance = np.linalg.norm(moved[pairs[:, 0]] - target[pairs[:, 1]], axis=1)
    following = np.full(len(pairs), np.nan)
    if len(xy) > 1 and len(pairs):
        near, who = cKDTree(moved).query(target[pairs[:, 1]], k=2)
        following = np.where(who[:, 0] == pairs[:, 0], near[:, 1], near[:, 0])
    rms = float(np.sqrt((distance**2).mean())) if len(pairs) else float("nan")
    middle = np.median(xy, axis=0)
    by_m = float(np.linalg.norm(plan.apply(middle[None])[0] - middle)) if is_moved else 0.0
    reason = "" if len(pairs) else "no two stems stand so near to each other"
    return FrameFit(plot, plan, by_m, rms, len(pairs), is_moved, reason), pairs, distance, following


def _is_clearly_better(plan: PlanSimilarity, pairs: Int64, direct: Int64, xy: Float64, target: Float64) -> bool:
    """Whether turning and shifting is worth it: two coefficients more always fit a little better."""
    if len(pairs) < len(direct):
        return False
    rms = [
        float(np.sqrt(((places[p[:, 0]] - target[p[:, 1]]) ** 2).sum(axis=1).mean()))
        for places, p in ((plan.apply(xy), pairs), (xy, direct))
    ]
    return len(direct) < 0.9 * len(pairs) or (rms[1] > 1.5 * rms[0] and rms[1] > 0.1)


def _chance(xy: Float64, target: Float64, max_distance_m: float) -> int:
    """How many stems fall on stems when the map is shifted to where it certainly does not belong."""
    angles = np.arange(8) * (np.pi / 4.0)
    steps = 4.0 * max_distance_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return int(np.median([len(nearest_pairs(xy + step, target, max_distance_m)) for step in steps]))


def nearest_pairs(xy_m: Float64, target_m: Float64, max_distance_m: float) -> Int64:
    """(P, 2) rows of the one-to-one pairing of least total distance, where a stem left alone costs `max_distance_m`."""
    near = cKDTree(xy_m).sparse_distance_matrix(cKDTree(target_m), max_distance_m, output_type="coo_matrix")
    rows, columns, gap = np.asarray(near.row), np.asarray(near.col), np.asarray(near.data)
    n = len(xy_m) + len(target_m)
    links = coo_array((np.ones(len(rows)), (rows, columns + len(xy_m))), shape=(n, n))
    label = connected_components(links, directed=False)[1][rows] if len(rows) else rows
    order = np.argsort(label, kind="stable")
    pairs = []
    for members in np.split(order, np.flatnonzero(np.diff(label[order])) + 1) if len(order) else []:
        mine, i = np.unique(rows[members], return_inverse=True)
        theirs, j = np.unique(columns[members], return_inverse=True)
        cost = np.full((len(mine), len(theirs)), max_distance_m)
        cost[i, j] = gap[members]
        is_near = np.zeros(cost.shape, bool)
        is_near[i, j] = True
        chosen = [(mine[r], theirs[c]) for r, c in zip(*linear_sum_assignment(cost), strict=True) if is_near[r, c]]
        pairs += chosen
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)
