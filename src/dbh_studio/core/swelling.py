"""Whether a stem is swollen where its diameter is to be read, and where it is regular above that.

A bulge (whorl, scar, ivy, burl) is thicker than the stem both below and above it; a buttress or root swell thickens
faster downwards than stems taper, all the way. Both are read from a `StemCourse`, in which the scale and all else that
the diameters of one stem have in common cancels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.measured import Diameter, Flag
from dbh_studio.core.medians import median
from dbh_studio.core.stem_course import STEP_M, StemCourse

_HERE_M = 0.11  # to either side of a height are two or three slabs
_BESIDE_M, _NEAR_M = 0.20, 1.05  # from a height the stem beside it begins and ends: clear of a whorl, and by like taper
_LEAST_BESIDE, _LEAST_OTHERS = 3, 6  # slabs on each side, and in all: fewer, and one of them could turn the line
_AT_LEAST = 0.04  # relative: what the slabs of a regular stem seen from one side may be off by (3 %) does not reach it
_TOO_FAR = 2.0  # standard deviations
_SLOPE_M = 0.40  # of stem to either side over which a slope is taken; 5 of those 8 slabs must be seen
_LEAST_SLABS = 5
_REGULAR_M = 0.60  # of stem above a swelling must be regular: a shorter piece may be a hollow in it
_SCATTER = 0.015  # about the line of a regular stem, relative
_WIDENING = 0.05  # relative per metre: stems do not thicken upwards, but slopes have errors
# Diameter lost per metre: stems lose up to 3 cm, thick ones in proportion; more than that is a root swell.
_TAPER_M, _TAPER_SHARE = 0.03, 0.08
_USUAL_TAPER_M = 0.02
# A slab, since a bulge's end is known to one; FAO's distance.
_CLEAR_M = {"bulge": STEP_M, "buttress": 0.30}


@dataclass(frozen=True)
class Swelling:
    """A stem that is swollen at breast height.

    Attributes:
        kind: Which.
        share: How much thicker the stem is there than it would be without, relative.
        end_m: Height above ground from which the stem is regular; None where that was not seen.
        measure_m: Where to measure; None likewise.
        seen_to_m: How far up the stem was seen.
    """

    kind: Literal["bulge", "buttress"]
    share: float
    end_m: float | None
    measure_m: float | None
    seen_to_m: float


@dataclass(frozen=True)
class _Line:
    """Logarithm of size over height, by medians (Theil, Sen)."""

    slope: float
    middle: float
    height_m: float
    scatter: float

    def at(self, height_m: float) -> float:
        return self.middle + self.slope * (height_m - self.height_m)


def profile_flag(course: StemCourse, height_m: float, diameter: Diameter, *, scale_sd: float = 0.0) -> Flag | None:
    """What to say where the stem above and below contradicts a diameter; None where it does not.

    Args:
        course: About the very outline the diameter is of.
        height_m: Of the measurement.
        diameter: There, with its interval.
        scale_sd: Relative standard error of the scale, which is in the interval and in nothing that is compared here.
    """
    beside = _beside(course, height_m)
    if beside is None:
        return None
    off = -beside.at(height_m)
    if abs(off) < max(_AT_LEAST, _TOO_FAR * float(np.hypot(own_sd(diameter, scale_sd), beside.scatter))):
        return None
    return flag_of(off, diameter.value_cm * float(np.exp(-off)))


def own_sd(diameter: Diameter, scale_sd: float) -> float:
    """Relative standard error of a diameter without the scale's; 0 where it has no interval."""
    own = diameter.half_width / 1.645 if np.isfinite(diameter.half_width) else 0.0
    return float(np.sqrt(max(own**2 - scale_sd**2, 0.0)))


def flag_of(off: float, expected_cm: float) -> Flag:
    """The words for a diameter that is `off`, logarithm of a ratio, from what the stem says."""
    word = "thicker" if off > 0 else "thinner"
    share = 100 * abs(np.expm1(off))
    words = f"{share:.0f} % {word} than the stem above and below says ({expected_cm:.1f} cm): look at the section"
    return Flag("profile", words)


def swelling_at(course: StemCourse, height_m: float, diameter_m: float) -> Swelling | None:
    """The swelling a stem has at a height; None where it is regular there, or too little is seen to say.

    Args:
        course: Of the stem, as far up as it is worth looking.
        height_m: Above ground.
        diameter_m: Of the stem about there.
    """
    here = _sizes_between(course, height_m - _HERE_M, height_m + _HERE_M)[1]
    if not len(here):
        return None
    size = float(np.median(here))
    taper = max(_TAPER_SHARE, _TAPER_M / diameter_m)
    beside = _beside(course, height_m)
    kind: Literal["bulge", "buttress"] | None = None
    if beside is not None and size - beside.at(height_m) > max(_AT_LEAST, _TOO_FAR * beside.scatter):
        kind = "bulge"
    elif _is_steep(course, height_m, taper):
        kind = "buttress" if _thickens_downwards(course, height_m, size, taper) else "bulge"
    if kind is None:
        return None
    end = _regular_from(course, height_m, taper, beside if kind == "bulge" else None)
    top = float(course.height_m[course.seen].max())
    if end is None:
        share = size - beside.at(height_m) if beside is not None else 0.0
        return Swelling(kind, float(np.expm1(max(share, 0.0))), None, None, top)
    end_m, line = end
    # A stem that is still flaring where it begins to be regular must not excuse the flare below.
    slope = max(line.slope, -_USUAL_TAPER_M / diameter_m)
    share = size - line.at(end_m) - slope * (height_m - end_m)
    if share < _AT_LEAST:
        return None
    return Swelling(kind, float(np.expm1(share)), end_m, min(end_m + _CLEAR_M[kind], max(top, end_m)), top)


def _sizes_between(course: StemCourse, low_m: float, high_m: float) -> tuple[Float64, Float64]:
    chosen = course.seen & (course.height_m >= low_m) & (course.height_m <= high_m)
    return course.height_m[chosen], course.log_size[chosen]


def _line(height: Float64, size: Float64) -> _Line:
    first, second = np.triu_indices(len(height), 1)
    slope = median((size[second] - size[first]) / (height[second] - height[first]))
    at = median(height)
    rest = size - slope * (height - at)
    middle = median(rest)
    return _Line(slope, middle, at, 1.4826 * median(np.abs(rest - middle)))


def _beside(course: StemCourse, height_m: float) -> _Line | None:
    """The line through the stem below and above a height; None where either is not seen."""
    height, size = _sizes_between(course, height_m - _NEAR_M, height_m + _NEAR_M)
    away = np.abs(height - height_m) > _BESIDE_M
    height, size = height[away], size[away]
    n_below = int((height < height_m).sum())
    if min(n_below, len(height) - n_below) < _LEAST_BESIDE or len(height) < _LEAST_OTHERS:
        return None
    return _line(height, size)


def _is_steep(course: StemCourse, height_m: float, taper: float) -> bool:
    """Whether the stem thickens downwards faster than stems taper."""
    height, size = _sizes_between(course, height_m - _SLOPE_M, height_m + _SLOPE_M)
    if len(height) < _LEAST_SLABS or float(np.ptp(height)) < _SLOPE_M:
        return False
    line = _line(height, size)
    error = 2.0 * line.scatter / (float(np.ptp(height)) * np.sqrt(len(height) / 12.0))
    return line.slope < -taper - error


def _thickens_downwards(course: StemCourse, height_m: float, size: float, taper: float) -> bool:
    """Whether the stem goes on thickening below; taken so where that is not seen."""
    height, below = _sizes_between(course, 0.0, height_m - _SLOPE_M)
    if not len(height):
        return True
    lowest = slice(0, 2)
    return float(np.median(below[lowest])) > size + taper * (height_m - float(height[lowest].mean()))


def _regular_from(
    course: StemCourse, height_m: float, taper: float, beside: _Line | None
) -> tuple[float, _Line] | None:
    """The lowest height above a swelling from which the stem tapers as stems do, and the line it has there.

    Args:
        course: Of the stem.
        height_m: Where the swelling is.
        taper: Greatest regular taper.
        beside: The stem to either side of a bulge, to which it must have come back: a broad bulge is regular on top.
    """
    for start in course.height_m[course.seen & (course.height_m > height_m)]:
        height, size = _sizes_between(course, start - 1e-6, start + _REGULAR_M + 1e-6)
        if len(height) < _LEAST_SLABS or float(np.ptp(height)) < _REGULAR_M - 2 * STEP_M:
            continue
        line = _line(height, size)
        allowed = max(_SCATTER, _TOO_FAR * line.scatter)
        is_regular = -taper <= line.slope <= _WIDENING and line.scatter <= 2 * _SCATTER
        is_on_it = abs(float(size[0]) - line.at(float(start))) <= allowed
        has_come_back = beside is None or abs(float(size[0]) - beside.at(float(start))) <= max(
            _AT_LEAST / 2, _TOO_FAR * beside.scatter
        )
        if is_regular and is_on_it and has_come_back:
            return float(start), line
    return None
