"""The similarity between two recordings of one walk: a camera's and a scanner's, with clocks and rates of their own.

Procrustes on positions at equal times, as in the paper, with what it takes for granted: the offset between the clocks
is searched for, and positions that are off (drift, a lost track) are weighed down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Bool, Float64, as_points, readonly
from dbh_studio.core.similarity_fit import fit_similarity
from dbh_studio.core.transforms import Similarity

_MOST_POSES = 400
_MOST_OFFSETS = 400
_MIN_POSES = 10
# Nearer to a line than this the turn about it is guesswork.
_THIN = 0.02
# Another clock offset that fits nearly as well leaves the choice open.
_RIVAL = 1.3


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Where a sensor was.

    Attributes:
        time_s: (N,) ascending, of any clock.
        xyz: (N, 3) any unit.
    """

    time_s: Float64
    xyz: Float64

    def __post_init__(self) -> None:
        time, xyz = np.asarray(self.time_s, np.float64), as_points(self.xyz, name="xyz").astype(np.float64)
        if time.shape != (len(xyz),) or not np.isfinite(time).all() or not np.isfinite(xyz).all():
            raise ValueError(f"time {time.shape} and places {xyz.shape} must be finite and equally many")
        if len(time) > 1 and not (np.diff(time) > 0).all():
            raise ValueError("the times of a trajectory must ascend")
        object.__setattr__(self, "time_s", readonly(time))
        object.__setattr__(self, "xyz", readonly(xyz))

    def at(self, time_s: Float64) -> tuple[Float64, Bool]:
        """(K, 3) places at other times, straight between poses, and (K,) whether the recording covers them."""
        inside = (time_s >= self.time_s[0]) & (time_s <= self.time_s[-1])
        places = np.column_stack([np.interp(time_s, self.time_s, self.xyz[:, axis]) for axis in range(3)])
        return places, inside


@dataclass(frozen=True, eq=False)
class TrajectoryFit:
    """How one recording lies on the other.

    Attributes:
        target_from_source: The similarity.
        offset_s: Target's clock minus the source's.
        rms_m: Of the poses kept, in the target's unit.
        n_used: Poses kept.
        n_poses: Poses at times that both recordings cover.
        reason: Why it must not be believed; empty where it may.
    """

    target_from_source: Similarity
    offset_s: float
    rms_m: float
    n_used: int
    n_poses: int
    reason: str = ""

    def __bool__(self) -> bool:
        return not self.reason


def fit_trajectories(
    source: Trajectory,
    target: Trajectory,
    *,
    with_scale: bool = True,
    offset_s: float | None = 0.0,
    least_overlap: float = 0.5,
) -> TrajectoryFit | None:
    """Lay one recording on the other.

    Args:
        source: In any unit.
        target: Metres.
        with_scale: Whether the scale is free.
        offset_s: Target's clock minus the source's; None searches for it.
        least_overlap: So much of the shorter recording must have happened during the other, where it is searched.

    Returns:
        The fit, whose `reason` says where it is not to be believed; None where too few poses were at common times.
    """
    if offset_s is not None:
        fit = _fit(source, target, offset_s, with_scale)
        return None if fit is None else _judged(fit, source, target)
    tried = [_fit(source, target, offset, with_scale) for offset in _offsets(source, target, least_overlap)]
    fits = [fit for fit in tried if fit is not None]
    if not fits:
        return None
    # A short piece fits more easily: what counts is the misfit beside the extent of the piece.
    costs = np.array([_cost(fit, source) for fit in fits])
    best = fits[int(costs.argmin())]
    step = _step(source, target, least_overlap)
    best, cost = _sharpened(source, target, best, step, with_scale)
    return _judged(best, source, target, rival=_has_rival(source, target, fits, costs, best, cost, step, with_scale))


def _judged(fit: TrajectoryFit, source: Trajectory, target: Trajectory, *, rival: bool = False) -> TrajectoryFit:
    times = np.linspace(source.time_s[0], source.time_s[-1], _MOST_POSES)
    places, _ = source.at(times)
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    reason = ""
    if not spread[1] > _THIN * spread[0]:
        reason = "the walk went in one straight line, so the turn about it is open"
    elif rival:
        reason = "the walks fit on each other with several clock offsets"
    elif fit.n_used < 0.5 * fit.n_poses:
        reason = f"only {fit.n_used} of {fit.n_poses} poses fit"
    elif fit.rms_m > 0.1 * fit.target_from_source.scale * spread[0] / np.sqrt(len(places)):
        reason = f"the walks differ by {fit.rms_m:.2f} m"
    return TrajectoryFit(fit.target_from_source, fit.offset_s, fit.rms_m, fit.n_used, fit.n_poses, reason)


def _step(source: Trajectory, target: Trajectory, least_overlap: float) -> float:
    """Between the clock offsets tried."""
    lengths = source.time_s[-1] - source.time_s[0], target.time_s[-1] - target.time_s[0]
    span = lengths[0] + lengths[1] - 2.0 * least_overlap * min(lengths)
    return max(float(span) / _MOST_OFFSETS, 1e-3)


def _offsets(source: Trajectory, target: Trajectory, least_overlap: float) -> Float64:
    shorter = min(source.time_s[-1] - source.time_s[0], target.time_s[-1] - target.time_s[0])
    low = target.time_s[0] - source.time_s[-1] + least_overlap * shorter
    high = target.time_s[-1] - source.time_s[0] - least_overlap * shorter
    return np.arange(low, high, _step(source, target, least_overlap))


def _sharpened(
    source: Trajectory, target: Trajectory, best: TrajectoryFit, step: float, with_scale: bool
) -> tuple[TrajectoryFit, float]:
    """Smaller and smaller steps of the clock about the best."""
    cost = _cost(best, source)
    while step > 1e-3:
        around = [_fit(source, target, best.offset_s + side * step, with_scale) for side in (-1.0, 1.0)]
        better = min((fit for fit in around if fit is not None), key=lambda fit: _cost(fit, source), default=best)
        if _cost(better, source) < cost:
            best, cost = better, _cost(better, source)
        else:
            step *= 0.5
    return best, cost


def _has_rival(
    source: Trajectory,
    target: Trajectory,
    fits: list[TrajectoryFit],
    costs: Float64,
    best: TrajectoryFit,
    cost: float,
    step: float,
    with_scale: bool,
) -> bool:
    """Whether a clearly different offset of the clocks fits about as well."""
    extent = float(source.xyz.std(axis=0).max())
    least = np.flatnonzero((costs <= np.append(costs[1:], np.inf)) & (costs <= np.insert(costs[:-1], 0, np.inf)))
    for index in least[np.argsort(costs[least])][:4]:
        if abs(fits[index].offset_s - best.offset_s) > 5.0 * step:
            other, its_cost = _sharpened(source, target, fits[index], step, with_scale)
            if abs(other.offset_s - best.offset_s) > 5.0 * step and its_cost < _RIVAL * cost + 1e-3 * extent:
                return True
    return False


def _cost(fit: TrajectoryFit, source: Trajectory) -> float:
    return fit.rms_m / fit.target_from_source.scale * fit.n_poses / max(fit.n_used, 1)


def _fit(source: Trajectory, target: Trajectory, offset_s: float, with_scale: bool) -> TrajectoryFit | None:
    """Least squares, repeated without what is farther off than three robust sigmas."""
    times = source.time_s[:: max(1, len(source.time_s) // _MOST_POSES)]
    places, inside = target.at(times + offset_s)
    a, b = source.at(times)[0][inside], places[inside]
    if len(a) < _MIN_POSES:
        return None
    kept = np.ones(len(a), bool)
    for _ in range(10):
        try:
            similarity, rms = fit_similarity(a[kept], b[kept], with_scale=with_scale)
        except ValueError:
            return None
        off = np.linalg.norm(similarity.apply(a) - b, axis=1)
        following = off <= 3.0 * max(float(np.median(off)), 1e-9)
        if np.array_equal(following, kept) or following.sum() < 3:
            break
        kept = following
    return TrajectoryFit(similarity, float(offset_s), rms, int(kept.sum()), len(a))
