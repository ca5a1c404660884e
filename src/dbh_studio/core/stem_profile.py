"""Diameters along the stem, and whether the one at breast height goes with those above and below.

At every height the estimator is asked as at breast height, with half a metre of stem about it, beginning where the
stem was found at breast height. The stem is then a line of diameter over height, fitted robustly: a diameter that the
others contradict by more than both can be wrong is a bulge, a whorl, or a wrong section.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import as_points
from dbh_studio.core.estimator import assess_stem, stem_line
from dbh_studio.core.interval_methods import estimator_settings
from dbh_studio.core.measured import Diameter, Flag
from dbh_studio.core.swelling import flag_of, own_sd
from dbh_studio.settings import MeasureSettings

STEP_M = 0.10
_HALF_M = 0.25  # of stem to either side of a height
_LOWEST_M = 0.3  # the segmentation cuts there
_LEAST_POINTS = 25
_LEAST_OTHERS = 4  # diameters, from both sides, to put a line through
_NEAR_M = 1.0
_TOO_FAR, _AT_LEAST = 2.0, 0.04  # standard deviations, and relative: as of the flag by slabs, `swelling.profile_flag`


@dataclass(frozen=True)
class ProfilePoint:
    """The stem at one height.

    Attributes:
        height_m: Above ground.
        diameter: By the settings' definition, with its 90 % interval; None where it was refused.
        arc_deg: How much of the ring was seen; None where nothing round was.
        reason: Why there is no diameter; empty where there is one.
    """

    height_m: float
    diameter: Diameter | None
    arc_deg: float | None
    reason: str = ""


def stem_profile(
    points_m: NDArray[np.floating[Any]],
    *,
    settings: MeasureSettings,
    scale_sd: float = 0.0,
    highest_m: float = 15.0,
) -> tuple[ProfilePoint, ...]:
    """Diameters every 10 cm as far as the stem is seen, lowest first.

    The paper's curves give no interval, so where one of them is chosen the profile is the shrinkage curve's.

    Args:
        points_m: (N, 3) points of the stem, metres; z is the height above the ground at the stem.
        settings: Of the measurement.
        scale_sd: Relative standard error of the scale.
        highest_m: No diameters above this.

    Raises:
        ValueError: The array has a wrong shape.
    """
    points = as_points(points_m, name="points_m")
    points = points[np.isfinite(points).all(axis=1)]
    method = settings.curve if settings.curve in ("shrinkage", "circle") else "shrinkage"
    options = estimator_settings(settings, method).changed(
        below_m=_HALF_M, above_m=_HALF_M, band_m=2 * _HALF_M, min_points=_LEAST_POINTS
    )
    line = stem_line(points, settings=estimator_settings(settings, method))
    found = []
    for height in _heights(points[:, 2], highest_m):
        at = options.changed(breast_height_m=height)
        window = points[np.abs(points[:, 2] - height) <= _HALF_M]
        if not len(window):
            found.append(ProfilePoint(height, None, None, f"No points within {_HALF_M:.2f} m of this height."))
            continue
        # Far from where the stem was found its sweep leads away from the line.
        near = line if line is not None and abs(height - settings.breast_height_m) <= 1.0 else None
        assessed = assess_stem(window, settings=at, scale_sd=scale_sd, line=near)
        arc = None if assessed.result is None else assessed.result.arc_deg
        if assessed.refusal is not None or assessed.result is None:
            reason = "" if assessed.refusal is None else assessed.refusal.reason
            found.append(ProfilePoint(height, None, arc, reason))
        else:
            found.append(ProfilePoint(height, assessed.result.chosen, arc))
    return tuple(found)


def _heights(heights_m: NDArray[np.floating[Any]], highest_m: float) -> list[float]:
    """Multiples of 10 cm from the lowest points to the highest, within what can be measured."""
    if len(heights_m) < _LEAST_POINTS:
        return []
    low, high = np.quantile(heights_m, [0.005, 0.995])
    first = int(np.ceil(max(float(low) + 0.05, _LOWEST_M) / STEP_M))
    last = int(np.floor(min(float(high) - 0.05, highest_m) / STEP_M))
    return [round(STEP_M * step, 2) for step in range(first, last + 1)]


def breast_height_flag(
    profile: Sequence[ProfilePoint], height_m: float, diameter: Diameter, *, scale_sd: float = 0.0
) -> Flag | None:
    """What to say where the diameter at breast height contradicts the stem above and below it; None where it does not.

    Args:
        profile: From `stem_profile`.
        height_m: Of the measurement.
        diameter: There, with its interval.
        scale_sd: Relative standard error of the scale in that interval: all diameters of a stem share it, so it
            excuses no difference between them.
    """
    expected = _expected(profile, height_m)
    if expected is None:
        return None
    value_cm, spread = expected
    off = float(np.log(diameter.value_cm / value_cm))
    if abs(off) < max(_AT_LEAST, _TOO_FAR * float(np.hypot(own_sd(diameter, scale_sd), spread))):
        return None
    return flag_of(off, value_cm)


def _expected(profile: Sequence[ProfilePoint], height_m: float) -> tuple[float, float] | None:
    """Diameter by a line (Theil, Sen) through those beside breast height, and their relative scatter about it."""
    rows = [
        (point.height_m - height_m, point.diameter.value_cm)
        for point in profile
        if point.diameter is not None and _HALF_M < abs(point.height_m - height_m) <= _NEAR_M
    ]
    if len(rows) < _LEAST_OTHERS or not (min(row[0] for row in rows) < 0 < max(row[0] for row in rows)):
        return None
    height, value = np.array(rows).T
    first, second = np.triu_indices(len(height), 1)
    slope = float(np.median((value[second] - value[first]) / (height[second] - height[first])))
    middle = float(np.median(value - slope * height))
    scatter = 1.4826 * float(np.median(np.abs(value - slope * height - middle)))
    return middle, scatter / middle
