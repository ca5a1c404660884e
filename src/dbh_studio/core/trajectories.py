"""The similarity between two recordings of one walk: a camera's and a scanner's, with clocks and rates of their own.

Procrustes on positions at equal times, as in the paper, with what it takes for granted: the offset between the clocks
is searched for, positions that are off (drift, a lost track) are left out, pauses of a recording are not bridged, and
how sure the result is comes from leaving out one stretch of the walk after another.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from dbh_studio.core.arrays import Bool, Float64, as_points, readonly
from dbh_studio.core.similarity_fit import fit_similarity, fit_upright
from dbh_studio.core.transforms import Similarity

_MOST_POSES = 400
# While the clocks are searched; enough to tell a good offset from a bad one.
_MOST_POSES_SEARCHED = 80
_MOST_OFFSETS = 800
# Fewer say nothing that could be checked.
MIN_POSES = 10
# Nearer to a line than this the turn about it is guesswork.
_THIN = 0.02
# The turn about the walk's main direction must be known this well: 2° are 35 cm at 10 m.
_LARGEST_TURN_ERROR_DEG = 2.0
# Another clock offset that fits nearly as well leaves the choice open.
_RIVAL = 1.3
# A recording with a pause longer than this many of its usual steps, and than so many seconds, says nothing in it.
_PAUSE_STEPS, _PAUSE_S = 5.0, 2.0
_SAMPLES = 50
_STRETCHES = 8

# Why such a walk is refused.
STRAIGHT = "the walk went in one straight line, so the turn about it is open"

FitCode = Literal["", "straight", "several_offsets", "few_fit", "differ"]


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

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def duration_s(self) -> float:
        """From the first pose to the last; 0 for fewer than two."""
        return float(self.time_s[-1] - self.time_s[0]) if len(self) else 0.0

    def at(self, time_s: Float64) -> tuple[Float64, Bool]:
        """(K, 3) places at other times, straight between poses, and (K,) whether the recording covers them."""
        inside = (time_s >= self.time_s[0]) & (time_s <= self.time_s[-1])
        places = np.column_stack([np.interp(time_s, self.time_s, self.xyz[:, axis]) for axis in range(3)])
        steps = np.diff(self.time_s)
        if len(steps):
            pause = max(_PAUSE_STEPS * float(np.median(steps)), _PAUSE_S)
            at = np.clip(np.searchsorted(self.time_s, time_s, side="right") - 1, 0, len(steps) - 1)
            inside &= (steps[at] <= pause) | (time_s == self.time_s[-1])
        return places, inside

    @property
    def is_line(self) -> bool:
        """Whether it went along one straight line, so nearly that a turn about it cannot be told."""
        if len(self) < 3:
            return True
        spread = np.linalg.svd(self.xyz - self.xyz.mean(axis=0), compute_uv=False)
        return bool(spread[1] <= _THIN * spread[0])

    def moved(self, target_from_source: Similarity) -> Trajectory:
        """The same walk in another frame."""
        return Trajectory(self.time_s, np.asarray(target_from_source.apply(self.xyz), np.float64))


@dataclass(frozen=True, eq=False)
class Residuals:
    """The poses a fit compared, for a picture.

    Attributes:
        time_s: (K,) source clock.
        placed: (K, 3) source poses brought to the target.
        target: (K, 3) the target's, at the same times.
        kept: (K,) whether the fit rests on it.
    """

    time_s: Float64
    placed: Float64
    target: Float64
    kept: Bool

    @property
    def distance_m(self) -> Float64:
        """(K,) between the two, target unit."""
        return np.asarray(np.linalg.norm(self.placed - self.target, axis=1))


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
        code: Short name of the reason.
        residuals: Of every pose compared.
        without: Fits without one stretch of the walk each; how they differ says how sure the fit is.
    """

    target_from_source: Similarity
    offset_s: float
    rms_m: float
    n_used: int
    n_poses: int
    reason: str = ""
    code: FitCode = ""
    residuals: Residuals | None = None
    without: tuple[Similarity, ...] = ()

    def __bool__(self) -> bool:
        return not self.reason

    @property
    def scale_error(self) -> float | None:
        """Standard error of the scale, as a share of it, by the jackknife over stretches; None where it is fixed."""
        logs = np.log([each.scale for each in self.without])
        return _jackknife(logs) if len(logs) >= 3 and float(np.ptp(logs)) > 0.0 else None

    def error_at(self, points: Float64) -> float:
        """Standard error of where (N, 3) source points come to lie, root mean square over them, target unit."""
        if len(self.without) < 3 or not len(points):
            return float("nan")
        placed = np.array([each.apply(points) for each in self.without])
        n = len(placed)
        variance = (n - 1) / n * ((placed - placed.mean(axis=0)) ** 2).sum(axis=0)
        return float(np.sqrt(variance.sum(axis=1).mean()))


def fit_trajectories(
    source: Trajectory,
    target: Trajectory,
    *,
    with_scale: bool = True,
    offset_s: float | None = 0.0,
    least_overlap: float = 0.5,
    upright: bool = False,
) -> TrajectoryFit | None:
    """Lay one recording on the other.

    Args:
        source: In any unit.
        target: Metres.
        with_scale: Whether the scale is free.
        offset_s: Target's clock minus the source's; None searches for it.
        least_overlap: So much of the shorter recording must have happened during the other, where it is searched.
        upright: Both have z up, so only the turn about it is free: what is left to a walk in one straight line.

    Returns:
        The fit, whose `reason` says where it is not to be believed; None where too few poses were at common times.
    """
    if min(len(source), len(target)) < 2:
        return None
    fitting = _Fitting(source, target, with_scale, upright)
    if offset_s is not None:
        fit = fitting.fit(offset_s, _MOST_POSES)
        return None if fit is None else fitting.judged(fit)
    offsets = _offsets(source, target, least_overlap)
    fits = [fit for fit in (fitting.fit(offset, _MOST_POSES_SEARCHED) for offset in offsets) if fit is not None]
    if not fits:
        return None
    # A short piece fits more easily: what counts is the misfit of all its poses.
    costs = np.array([_cost(fit) for fit in fits])
    step = _step(source, target, least_overlap)
    least = np.flatnonzero((costs <= np.append(costs[1:], np.inf)) & (costs <= np.insert(costs[:-1], 0, np.inf)))
    sharpened = [fitting.sharpened(fits[index], step) for index in least[np.argsort(costs[least])][:8]]
    ways = [way for way in sharpened if way is not None]
    if not ways:
        return None
    best = min(ways, key=_cost)
    extent = float(source.xyz.std(axis=0).max())
    limit = _RIVAL * _cost(best) + 1e-3 * extent
    apart = max(5.0 * step, 1e-3)
    rival = any(abs(way.offset_s - best.offset_s) > apart and _cost(way) < limit for way in ways)
    return fitting.judged(best, rival=rival)


def common_poses(source: Trajectory, target: Trajectory, offset_s: float) -> int:
    """How many poses of the source the target covers."""
    if min(len(source), len(target)) < 2:
        return 0
    return int(target.at(source.time_s + offset_s)[1].sum())


class _Fitting:
    """Two recordings, and what is free."""

    def __init__(self, source: Trajectory, target: Trajectory, with_scale: bool, upright: bool) -> None:
        self.source, self.target = source, target
        self.with_scale, self.upright = with_scale, upright

    def pairs(self, offset_s: float, most: int) -> tuple[Float64, Float64, Float64]:
        """(K,) times and (K, 3) places of both at times both cover."""
        rows = slice(None, None, max(1, len(self.source) // most))
        times, mine = self.source.time_s[rows], self.source.xyz[rows]
        theirs, inside = self.target.at(times + offset_s)
        return times[inside], mine[inside], theirs[inside]

    def similarity(self, a: Float64, b: Float64) -> tuple[Similarity, float]:
        return (fit_upright if self.upright else fit_similarity)(a, b, with_scale=self.with_scale)

    def fit(self, offset_s: float, most: int) -> TrajectoryFit | None:
        """Least squares, repeated without what is farther off than three times the median."""
        times, a, b = self.pairs(offset_s, most)
        if len(a) < MIN_POSES:
            return None
        try:
            similarity, rms = self.similarity(a, b)
            kept = self._first_kept(a, b, similarity)
            for _ in range(10):
                similarity, rms = self.similarity(a[kept], b[kept])
                off = np.linalg.norm(similarity.apply(a) - b, axis=1)
                following = off <= 3.0 * max(float(np.median(off)), 1e-9)
                if np.array_equal(following, kept) or following.sum() < 3:
                    break
                kept = following
        except ValueError:
            return None
        residuals = Residuals(times, np.asarray(similarity.apply(a), np.float64), b, kept)
        return TrajectoryFit(similarity, float(offset_s), rms, int(kept.sum()), len(a), residuals=residuals, without=())

    def _first_kept(self, a: Float64, b: Float64, plain: Similarity) -> Bool:
        """(K,) poses to begin with: least squares over all, or the best of random samples where that fits more.

        A lost track shifts a third of the poses by metres: then least squares over all lies between, and trimming from
        there keeps the wrong ones.
        """
        off = np.linalg.norm(plain.apply(a) - b, axis=1)
        rows = np.random.default_rng(0).integers(0, len(a), (_SAMPLES, 4))
        turns, shifts = _fit_samples(a[rows], b[rows], self.with_scale, self.upright)
        sampled = np.linalg.norm(a @ turns.transpose(0, 2, 1) + shifts[:, None] - b, axis=2)
        middles = np.median(sampled, axis=1)
        best, least = off, float(np.median(off))
        # Clearly better only: samples of good recordings fit a little better or worse by chance.
        if middles.min() < 0.7 * least:
            best, least = sampled[middles.argmin()], float(middles.min())
        return np.asarray(best <= 3.0 * max(least, 1e-9))

    def sharpened(self, best: TrajectoryFit, step: float) -> TrajectoryFit | None:
        """Smaller and smaller steps of the clock about the best."""
        here = self.fit(best.offset_s, _MOST_POSES)
        if here is None:
            return None
        best, cost = here, _cost(here)
        while step > 1e-3:
            around = [self.fit(best.offset_s + side * step, _MOST_POSES) for side in (-1.0, 1.0)]
            better = min((fit for fit in around if fit is not None), key=_cost, default=best)
            if _cost(better) < cost:
                best, cost = better, _cost(better)
            else:
                step *= 0.5
        return best

    def judged(self, fit: TrajectoryFit, *, rival: bool = False) -> TrajectoryFit:
        """With how sure it is, and why it must not be believed."""
        _, a, b = self.pairs(fit.offset_s, _MOST_POSES)
        kept = fit.residuals.kept if fit.residuals is not None else np.ones(len(a), bool)
        without = self._without_stretches(a[kept], b[kept])
        fit = replace(fit, without=without)
        centred = a[kept] - a[kept].mean(axis=0)
        spread = np.linalg.svd(centred, compute_uv=False)
        code: FitCode = ""
        reason = ""
        if self._is_line(spread, centred):
            code, reason = "straight", STRAIGHT
        elif fit.n_used < 0.5 * fit.n_poses:
            code, reason = "few_fit", f"only {fit.n_used} of {fit.n_poses} poses fit"
        elif fit.rms_m > 0.1 * fit.target_from_source.scale * spread[0] / np.sqrt(len(centred)):
            code, reason = "differ", f"the walks differ by {fit.rms_m:.2f} m"
        elif self._turn_is_unsure(centred, without):
            code = "straight"
            reason = (
                f"the walk is too narrow for walks that differ by {fit.rms_m:.2f} m, so the turn about its main "
                "direction is open"
            )
        elif rival:
            code, reason = "several_offsets", "the walks fit on each other with several clock offsets"
        return replace(fit, code=code, reason=reason)

    def _is_line(self, spread: Float64, centred: Float64) -> bool:
        if self.upright:
            # Only an upright walk leaves the turn about the vertical open.
            return bool(np.linalg.norm(centred[:, :2]) <= _THIN * spread[0])
        return bool(spread[1] <= _THIN * spread[0])

    def _turn_is_unsure(self, centred: Float64, without: tuple[Similarity, ...]) -> bool:
        """Whether the turn about the walk's main direction changes with which stretch is left out."""
        if self.upright or len(without) < 3:
            return False
        along = np.linalg.svd(centred, full_matrices=False)[2][0]
        turns = [_turn_about(along, each.rotation @ without[0].rotation.T, without[0].rotation) for each in without]
        return bool(_jackknife(np.degrees(np.array(turns))) > _LARGEST_TURN_ERROR_DEG)

    def _without_stretches(self, a: Float64, b: Float64) -> tuple[Similarity, ...]:
        """A fit without each of some stretches of the walk: neighbours err alike, so single poses tell little."""
        stretch = np.arange(len(a)) * _STRETCHES // max(len(a), 1)
        fits = []
        for number in range(_STRETCHES):
            rest = stretch != number
            if rest.sum() < 3 or rest.all():
                continue
            try:
                fits.append(self.similarity(a[rest], b[rest])[0])
            except ValueError:
                continue
        return tuple(fits)


def _fit_samples(a: Float64, b: Float64, with_scale: bool, upright: bool) -> tuple[Float64, Float64]:
    """(H, 3, 3) turns times scale and (H, 3) shifts of least squares of (H, K, 3) points, many at once.

    Samples that determine nothing give some similarity, which then fits badly.
    """
    mean_a, mean_b = a.mean(axis=1, keepdims=True), b.mean(axis=1, keepdims=True)
    a, b = a - mean_a, b - mean_b
    size = np.maximum((a * a).sum(axis=(1, 2)), 1e-300)
    if upright:
        product = (np.conj(a[..., 0] + 1j * a[..., 1]) * (b[..., 0] + 1j * b[..., 1])).sum(axis=1)
        unit = product / np.maximum(np.abs(product), 1e-300)
        turn = np.zeros((len(a), 3, 3))
        turn[:, 0, 0] = turn[:, 1, 1] = unit.real
        turn[:, 1, 0], turn[:, 0, 1], turn[:, 2, 2] = unit.imag, -unit.imag, 1.0
        scale = (np.abs(product) + (a[..., 2] * b[..., 2]).sum(axis=1)) / size
    else:
        u, singular, vt = np.linalg.svd(b.transpose(0, 2, 1) @ a)
        signs = np.ones((len(a), 3))
        signs[:, 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
        turn = (u * signs[:, None]) @ vt
        scale = (singular * signs).sum(axis=1) / size
    turn = turn * (scale if with_scale else np.ones(len(a)))[:, None, None]
    return turn, mean_b[:, 0] - (mean_a @ turn.transpose(0, 2, 1))[:, 0]


def _turn_about(axis_src: Float64, turn: Float64, rotation: Float64) -> float:
    """Radians of a small rotation of the target about the source's `axis_src`."""
    vector = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine = float(vector @ (rotation @ axis_src))
    return float(np.arctan2(sine, 0.5 * (np.trace(turn) - 1.0)))


def _jackknife(values: Float64) -> float:
    """Standard error from estimates that each leave one part out."""
    n = len(values)
    return float(np.sqrt((n - 1) / n * ((values - values.mean()) ** 2).sum()))


def _step(source: Trajectory, target: Trajectory, least_overlap: float) -> float:
    """Between the clock offsets tried."""
    lengths = source.duration_s, target.duration_s
    span = lengths[0] + lengths[1] - 2.0 * least_overlap * min(lengths)
    return max(float(span) / _MOST_OFFSETS, 1e-3)


def _offsets(source: Trajectory, target: Trajectory, least_overlap: float) -> Float64:
    shorter = min(source.duration_s, target.duration_s)
    low = target.time_s[0] - source.time_s[-1] + least_overlap * shorter
    high = target.time_s[-1] - source.time_s[0] - least_overlap * shorter
    step = _step(source, target, least_overlap)
    # As multiples of the step from the middle: far from zero (seconds since 1970) steps would be rounded.
    return 0.5 * (low + high) + step * np.arange(-int(0.5 * (high - low) / step), int(0.5 * (high - low) / step) + 1)


def _cost(fit: TrajectoryFit) -> float:
    """Misfit in source units; poses left out count against it."""
    return fit.rms_m / fit.target_from_source.scale * fit.n_poses / max(fit.n_used, 1)
