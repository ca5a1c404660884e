"""How two maps of the same stems lie on each other: the turn, shift and scale about the vertical.

Both maps are upright and in plan, but one may be a reconstruction in a unit of its own. Triangles of neighbouring stems
have the same ratios of their sides in both; each pair of like triangles proposes a similarity, and the one under which
most stems fall on stems wins. A plantation in rows falls on itself in many ways: then it is said to be ambiguous.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float64, Int64, as_points, readonly

_NEIGHBOURS = 8
_LIKE = 0.06
_MOST_PROPOSALS = 40_000
_CHUNK = 4_000
# A rival under which this share of the winner's stems falls on stems leaves the choice open.
_RIVAL_SHARE = 0.75
_MIN_STEMS = 4


@dataclass(frozen=True, eq=False)
class PlanSimilarity:
    """``target = scale * turn(angle) @ source + shift``, in plan."""

    scale: float
    angle_rad: float
    shift: Float64

    def apply(self, xy: Float64) -> Float64:
        """(N, 2) moved."""
        cos, sin = np.cos(self.angle_rad), np.sin(self.angle_rad)
        return np.asarray(self.scale * xy @ np.array([[cos, sin], [-sin, cos]]) + self.shift)


@dataclass(frozen=True, eq=False)
class StemMatch:
    """The best way to lay one map of stems on the other.

    Attributes:
        target_from_source: In plan.
        pairs: (P, 2) rows of source and target stems that fall on each other.
        rms_m: Root mean square distance of the pairs, target unit.
        rival_pairs: How many the best clearly different way brings together; 0 where there is none.
        reason: Why it must not be believed; empty where it may.
    """

    target_from_source: PlanSimilarity
    pairs: Int64
    rms_m: float
    rival_pairs: int = 0
    reason: str = ""

    def __bool__(self) -> bool:
        return not self.reason


def match_stems(
    source_xy: Any,
    target_xy: Any,
    *,
    source_radius: Any = None,
    target_radius: Any = None,
    scale: float | None = None,
    tolerance_m: float = 0.4,
) -> StemMatch | None:
    """Lay a map of stems on another.

    Args:
        source_xy: (S, 2) positions, any unit.
        target_xy: (T, 2) positions, metres.
        source_radius: (S,) in the source's unit; stems of very different thickness are not paired. None where unknown.
        target_radius: (T,) metres.
        scale: Metres per source unit where it is known; None leaves it free.
        tolerance_m: Stems so near to each other may be the same.

    Returns:
        The match, whose `reason` says where it is not to be believed; None where there are too few stems or nothing
        fits at all.
    """
    source = as_points(source_xy, name="source_xy", n_columns=2).astype(np.float64)
    target = as_points(target_xy, name="target_xy", n_columns=2).astype(np.float64)
    radii = _radii(source_radius, len(source)), _radii(target_radius, len(target))
    if min(len(source), len(target)) < _MIN_STEMS:
        return None
    proposals = _proposals(source, target, scale)
    if not len(proposals):
        return None
    ranking = _scores(source, target, radii, proposals, tolerance_m)
    order = np.argsort(-ranking, kind="stable")
    best = _refined(source, target, radii, proposals[order[0]], tolerance_m, scale)
    rival = 0
    for index in order[1:2_000]:
        if ranking[index] < 3:
            break
        if _is_same(source, proposals[index], best.target_from_source, 2.0 * tolerance_m):
            continue
        other = _refined(source, target, radii, proposals[index], tolerance_m, scale)
        middle = _numbers(other.target_from_source)
        if not _is_same(source, middle, best.target_from_source, 2.0 * tolerance_m):
            rival = len(other.pairs)
            break
    return StemMatch(best.target_from_source, best.pairs, best.rms_m, rival, _doubt(best, rival, source, target))


def _doubt(best: StemMatch, rival: int, source: Float64, target: Float64) -> str:
    n = len(best.pairs)
    possible = min(len(source), len(target))
    if n < _MIN_STEMS or n < 0.3 * possible:
        return f"only {n} of {possible} stems fall on a stem of the other cloud"
    if rival >= _RIVAL_SHARE * n:
        return f"{n} stems fit one way and {rival} another: the stems stand too regularly, or too few are common"
    return ""


def _radii(given: Any, n: int) -> Float64:
    if given is None:
        return np.full(n, np.nan)
    radii = np.asarray(given, np.float64)
    if radii.shape != (n,):
        raise ValueError(f"radii have shape {radii.shape} but ({n},) is needed")
    return radii


def _triangles(xy: Float64) -> tuple[Int64, Float64]:
    """(K, 3) rows, longest side opposite the first and then round to the left, and (K, 2) ratios of the sides."""
    k = min(_NEIGHBOURS + 1, len(xy))
    around = cKDTree(xy).query(xy, k=k)[1]
    corners = {tuple(sorted((int(row[0]), int(row[a]), int(row[b])))) for row in around for a, b in _pairs(k)}
    rows = np.array(sorted(corners), np.int64)
    side = np.linalg.norm(xy[rows[:, [1, 2, 0]]] - xy[rows[:, [2, 0, 1]]], axis=2)
    # The corner opposite the longest side first; the other two in the order that turns left.
    first = side.argmax(axis=1)
    rows = np.take_along_axis(rows, (first[:, None] + np.arange(3)) % 3, axis=1)
    a, b = xy[rows[:, 1]] - xy[rows[:, 0]], xy[rows[:, 2]] - xy[rows[:, 0]]
    right = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] < 0.0
    rows[right] = rows[right][:, [0, 2, 1]]
    longest = np.linalg.norm(xy[rows[:, 1]] - xy[rows[:, 2]], axis=1)
    ratio = np.stack([np.linalg.norm(xy[rows[:, 0]] - xy[rows[:, c]], axis=1) for c in (1, 2)], axis=1)
    usable = longest > 0.0
    return rows[usable], ratio[usable] / longest[usable, None]


def _pairs(k: int) -> list[tuple[int, int]]:
    return list(combinations(range(1, k), 2))


def _proposals(source: Float64, target: Float64, scale: float | None) -> Float64:
    """(H, 4) real and imaginary part of turn times scale, and shift, of like triangles."""
    mine, my_shape = _triangles(source)
    theirs, their_shape = _triangles(target)
    near = cKDTree(their_shape).query_ball_point(my_shape, _LIKE)
    counts = np.array([len(rows) for rows in near], np.int64)
    if not counts.sum():
        return np.empty((0, 4))
    first = np.repeat(np.arange(len(mine)), counts)
    second = np.concatenate([np.asarray(rows, np.int64) for rows in near if rows])
    if scale is not None:
        long = [np.linalg.norm(xy[t[:, 1]] - xy[t[:, 2]], axis=1) for xy, t in ((source, mine), (target, theirs))]
        same = np.abs(np.log(long[1][second] / (scale * long[0][first]))) < 2.0 * _LIKE
        first, second = first[same], second[same]
    if len(first) > _MOST_PROPOSALS:
        likeness = np.linalg.norm(my_shape[first] - their_shape[second], axis=1)
        kept = np.argsort(likeness, kind="stable")[:_MOST_PROPOSALS]
        first, second = first[kept], second[kept]
    a, b = source[mine[first]], target[theirs[second]]
    return _fit_plan(a[..., 0] + 1j * a[..., 1], b[..., 0] + 1j * b[..., 1], scale)


def _fit_plan(a: Any, b: Any, scale: float | None) -> Float64:
    """(H, 4) similarities of least squares of (H, K) complex points."""
    mean_a, mean_b = a.mean(axis=1, keepdims=True), b.mean(axis=1, keepdims=True)
    turn = (np.conj(a - mean_a) * (b - mean_b)).sum(axis=1) / (np.abs(a - mean_a) ** 2).sum(axis=1)
    if scale is not None:
        turn = turn / np.maximum(np.abs(turn), 1e-300) * scale
    shift = mean_b[:, 0] - turn * mean_a[:, 0]
    return np.stack([turn.real, turn.imag, shift.real, shift.imag], axis=1)


def _moved(xy: Float64, proposals: Float64) -> Float64:
    """(H, S, 2) positions under each proposal."""
    moved = (xy[:, 0] + 1j * xy[:, 1])[None] * (proposals[:, :1] + 1j * proposals[:, 1:2])
    moved = moved + (proposals[:, 2:3] + 1j * proposals[:, 3:4])
    return np.stack([moved.real, moved.imag], axis=2)


def _scores(
    source: Float64, target: Float64, radii: tuple[Float64, Float64], proposals: Float64, tolerance: float
) -> Float64:
    """(H,) how many target stems have a source stem on them; nearer ones count a little more."""
    tree = cKDTree(target)
    scores = np.zeros(len(proposals))
    for start in range(0, len(proposals), _CHUNK):
        some = proposals[start : start + _CHUNK]
        moved = _moved(source, some)
        distance, index = tree.query(moved.reshape(-1, 2), distance_upper_bound=tolerance)
        value = np.where(np.isfinite(distance), 1.0 - 0.3 * (np.minimum(distance, tolerance) / tolerance) ** 2, 0.0)
        size = np.hypot(some[:, 0], some[:, 1])
        thin = _thickness_agrees(
            np.tile(radii[0], len(some)) * np.repeat(size, len(source)), np.append(radii[1], np.nan)[index]
        )
        value = np.where(thin, value, 0.0).reshape(len(some), -1)
        index = index.reshape(len(some), -1)
        # A scale that shrinks everything into one stem brings all source stems onto it: each target counts once.
        best = np.zeros((len(some), len(target) + 1))
        np.maximum.at(best, (np.arange(len(some))[:, None], index), value)
        scores[start : start + _CHUNK] = best[:, :-1].sum(axis=1)
    return scores


def _thickness_agrees(a: Float64, b: Float64) -> Bool:
    with np.errstate(invalid="ignore", divide="ignore"):
        agrees: Bool = ~(np.abs(np.log(a / b)) > 0.7)
    return agrees


def _refined(
    source: Float64,
    target: Float64,
    radii: tuple[Float64, Float64],
    proposal: Float64,
    tolerance: float,
    scale: float | None,
) -> StemMatch:
    """One to one pairs of least total distance, and the similarity of these, until they stay the same."""
    pairs = np.empty((0, 2), np.int64)
    for _ in range(8):
        distance = np.linalg.norm(_moved(source, proposal[None])[0][:, None] - target[None], axis=2)
        size = float(np.hypot(*proposal[:2]))
        agrees = _thickness_agrees(radii[0][:, None] * size, radii[1][None])
        cost = np.where((distance <= tolerance) & agrees, distance, 10.0 * tolerance)
        rows, columns = linear_sum_assignment(cost)
        near = cost[rows, columns] <= tolerance
        found = np.column_stack([rows[near], columns[near]])
        if len(found) < 2 or np.array_equal(found, pairs):
            pairs = found
            break
        pairs = found
        a, b = source[pairs[:, 0]], target[pairs[:, 1]]
        proposal = _fit_plan((a[:, 0] + 1j * a[:, 1])[None], (b[:, 0] + 1j * b[:, 1])[None], scale)[0]
    plan = PlanSimilarity(
        float(np.hypot(*proposal[:2])), float(np.arctan2(proposal[1], proposal[0])), readonly(proposal[2:].copy())
    )
    left = plan.apply(source[pairs[:, 0]]) - target[pairs[:, 1]]
    rms = float(np.sqrt((left**2).sum(axis=1).mean())) if len(pairs) else float("nan")
    return StemMatch(plan, readonly(pairs), rms)


def _numbers(plan: PlanSimilarity) -> Float64:
    turn = plan.scale * np.exp(1j * plan.angle_rad)
    return np.array([turn.real, turn.imag, *plan.shift])


def _is_same(source: Float64, proposal: Float64, plan: PlanSimilarity, distance: float) -> bool:
    """Whether two ways put the stems in about the same places."""
    apart = np.linalg.norm(_moved(source, proposal[None])[0] - plan.apply(source), axis=1)
    return bool(np.median(apart) <= distance)
