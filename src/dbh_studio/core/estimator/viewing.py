"""Where on the bark a point belongs, when its error lies along the ray it was seen by and not across the bark.

A camera or a scanner errs in depth, along its rays. Who sees a stem from one side only sees the flanks of it at a
grazing angle: an error in depth there moves a point along the bark more than across it, and beyond the edge of what was
seen it leaves tails that run straight back. A fit of distances across the bark takes that for a tighter bend. With 2 cm
of such noise an arc of 140° of a stem of 34 cm reads 5 % too thin and one of 100° 17 %, however many points there are.

The remedy is the one for errors in both coordinates: a point is taken back to the bark in the direction of its error
and not square to the bark. With the noise's standard deviation 1 along the ray and √λ across it, that direction is Σn,
where n is the bark's normal and Σ the noise's covariance; how far the point is off, across the bark, is then uncertain
by n'Σn.

Whether the noise is of that kind is seen in the points: across the bark it must be less on the flanks than in front,

    variance at the angle ψ between ray and normal = σ² (1 - (1 - λ) sin² ψ).

1 - λ is found from that by regression over sectors of the arc and believed from two standard errors on, less half of
one. Arcs that were cut out of a ring that was seen all round, or noise that is alike in all directions, show nothing of
it, and all stays as it was. The rays are taken to come from the middle of the arc, or, for wider ones, from within 75°
of the bark's normal: beyond that bark is hardly ever seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.estimator.tube import Polar, Tube
from dbh_studio.core.medians import group_medians, median, quantiles

_ON = 2.5  # noise widths from the surface
_LEAST_POINTS = 60
_SECTORS = 36
_LEAST_GAP_SECTORS = 10
_OBLIQUE_RAD = np.radians(75.0)
_STEPS = 9  # of ψ to either side
_LEAST_IN_STEP = 15
_LEAST_SIN2 = 0.2  # a flatter arc does not tell
_MOST = 0.94  # of the variance, along the ray
_STANDARD_ERRORS, _HELD_BACK = 2.0, 0.5
_UNCERTAIN = 5.4  # variance of a variance from a median deviation, relative to its square, times the points
_STEEPEST_RAD = 1.48
_FURTHEST_RAD = 0.5


@dataclass(frozen=True, eq=False)
class Viewing:
    """From where an arc was seen.

    Attributes:
        middle: Direction of the arc's middle from the axis, radians.
        reach: How far to either side of it the cameras stood, radians.
        along: 1 - λ, how much of the noise is along the rays.
    """

    middle: float
    reach: float
    along: float

    def obliquity(self, angle: Float64) -> Float64:
        """(N,) angle between normal and ray at (N,) directions from the axis, with its sign."""
        off = _wrapped(angle - self.middle)
        beyond = off - np.minimum(np.maximum(off, -self.reach), self.reach)
        return np.minimum(np.maximum(beyond, -_STEEPEST_RAD), _STEEPEST_RAD)


@dataclass(frozen=True, eq=False)
class OnBark:
    """Points by the place on the bark they belong to.

    Attributes:
        at: That place, with the distance from the axis it speaks for there.
        error: (N,) how far off, outwards positive.
        variance: (N,) of that, relative to the mean of all.
    """

    at: Polar
    error: Float64
    variance: Float64


def on_bark(at: Polar, error: Float64, tube: Tube, viewing: Viewing | None) -> OnBark:
    """Points near a tube's surface, taken back to the bark in the direction of their errors.

    That is where the line of each error meets the bark, which is taken as round there.

    Args:
        at: Of the points.
        error: (N,) their distances to the surface, square to it.
        tube: As fitted so far.
        viewing: From where they were seen; None leaves them at the nearest place.
    """
    if viewing is None:
        return OnBark(at, error, np.ones_like(error))
    angle, from_axis = at.angle(), at.distance
    surface = from_axis - error
    square = surface**2 - from_axis**2
    turn, c, s = np.zeros_like(error), np.ones_like(error), np.zeros_like(error)
    for _ in range(2):  # the normal is that of the place found
        # No angle here is beyond 90°, so its cosine follows from its sine, several times quicker than by itself.
        sin = np.sin(viewing.obliquity(angle + turn))
        variance = 1.0 - viewing.along * sin * sin
        aside = viewing.along * np.sqrt(1.0 - sin * sin) * sin
        length = np.sqrt(variance * variance + aside * aside)
        # The error's direction: outwards and sideways in the frame of the point itself.
        outwards, sideways = (variance * c + aside * s) / length, (variance * s - aside * c) / length
        ahead = from_axis * outwards
        back = ahead - np.sqrt(np.maximum(ahead * ahead + square, 0.0))
        turn = np.arctan2(-back * sideways, from_axis - back * outwards)
        turn = np.minimum(np.maximum(turn, -_FURTHEST_RAD), _FURTHEST_RAD)
        s = np.sin(turn)
        c = np.sqrt(1.0 - s * s)
    error = back * (outwards * c + sideways * s)
    place = Polar(at.cos * c - at.sin * s, at.sin * c + at.cos * s, from_axis, at.along)
    place = Polar(place.cos, place.sin, tube.surface(place) + error, at.along)
    return OnBark(place, error, variance / variance.mean())


def viewing_of(at: Polar, error: Float64, sigma: float) -> Viewing | None:
    """From where points on a surface were seen; None where that cannot be told or makes no difference."""
    on = np.flatnonzero(np.abs(error) < _ON * sigma)
    if len(on) < _LEAST_POINTS:
        return None
    angle, error = np.arctan2(at.sin[on], at.cos[on]), error[on]
    arc = _arc(angle)
    if arc is None:
        return None
    middle, half = arc
    viewing = Viewing(middle, max(half - _OBLIQUE_RAD, 0.0), 0.0)
    along = _along(viewing.obliquity(angle), error)
    return None if along <= 0 else Viewing(middle, viewing.reach, along)


def _wrapped(angle: Float64) -> Float64:
    """(N,) angles by whole turns to -π..π; ten times quicker than by a remainder."""
    return np.asarray(angle - 2 * np.pi * np.rint(angle * (0.5 / np.pi)))


def _arc(angle: Float64) -> tuple[float, float] | None:
    """Middle and half the width of the arc that (N,) points are on, radians; None for most of a ring."""
    count = np.bincount(((angle + np.pi) * (_SECTORS / (2 * np.pi))).astype(np.int64), minlength=_SECTORS + 1)
    count[0] += count[_SECTORS]  # the angle π itself
    count = count[:_SECTORS]
    held = np.flatnonzero(count >= max(3.0, 0.1 * median(count[count > 0])))
    if not len(held):
        return None
    steps = np.diff(np.append(held, held[0] + _SECTORS))
    widest = int(steps.argmax())
    if steps[widest] - 1 < _LEAST_GAP_SECTORS:
        return None
    step = 2 * np.pi / _SECTORS
    first, n_held = held[(widest + 1) % len(held)], _SECTORS - int(steps[widest]) + 1
    middle = -np.pi + (first + 0.5 * n_held) * step
    off = _wrapped(angle - middle)
    low, high = quantiles(off[np.flatnonzero(np.abs(off) <= 0.5 * n_held * step + 0.01)], (0.01, 0.99))
    return float(middle + 0.5 * (low + high)), 0.5 * (high - low)


def _along(oblique: Float64, error: Float64) -> float:
    """1 - λ by regression of the variance across the bark on sin² ψ; 0 where it is not certain."""
    step = np.minimum(np.abs(oblique) * (_STEPS / (0.5 * np.pi)), _STEPS - 1).astype(np.int64) * 2 + (oblique > 0)
    count = np.bincount(step, minlength=2 * _STEPS).astype(np.int64)
    each = np.maximum(count, 1)
    off = np.abs(error - group_medians(step, error, count, upper=True)[step])
    spread = (1.4826 * group_medians(step, off, count, upper=True)) ** 2
    sin2 = np.bincount(step, np.sin(oblique) ** 2, 2 * _STEPS) / each
    held = count >= _LEAST_IN_STEP
    if held.sum() < 3 or sin2[held].max() < _LEAST_SIN2:
        return 0.0
    spread, weight = spread[held], count[held].astype(np.float64)
    design = np.stack([np.ones(len(spread)), -sin2[held]])
    ((total, mixed), (_, square)), (first, second) = (design * weight) @ design.T, (design * weight) @ spread
    determinant = total * square - mixed * mixed
    if determinant < 1e-9 * total**2:
        return 0.0
    front, falls = (square * first - mixed * second) / determinant, (total * second - mixed * first) / determinant
    if front <= 0 or falls <= 0:
        return 0.0
    sd = float(np.sqrt(_UNCERTAIN * total / determinant)) * float(np.mean(spread)) / front
    along = falls / front
    return 0.0 if along < _STANDARD_ERRORS * sd else float(np.clip(along - _HELD_BACK * sd, 0.0, _MOST))
