"""What the heights of one stem are measured from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float64
from dbh_studio.core.axis import StemAxis, band_m
from dbh_studio.core.dbh import axis_of_stem
from dbh_studio.core.ground import GroundModel
from dbh_studio.core.interval_methods import INTERVAL_METHODS, line_of_stem
from dbh_studio.core.medians import median
from dbh_studio.core.protocols import BaseUsed
from dbh_studio.settings import MeasureSettings

_N_AROUND = 12
_N_CONTACT = 72
_MOVED_ENOUGH_M = 0.05
_FOOT_M = 2.0
_CUT_AT_MOST_M = 1.0

STEM_BASE_NOTE = "measured from the stem's own base: the cloud has no ground"


@dataclass(frozen=True, eq=False)
class StemGround:
    """The ground at one stem, and the stem's axis above it.

    Attributes:
        z_m: Height of the base, world.
        axis: Of the stem, with heights above `z_m`.
        note: What to say about the ground; empty where there is nothing.
        base: What `z_m` is.
    """

    z_m: float
    axis: StemAxis
    note: str
    base: BaseUsed


def ground_at_stem(
    points: NDArray[np.floating[Any]],
    ground: GroundModel,
    settings: MeasureSettings,
    *,
    z_ground_m: float | None = None,
) -> StemGround:
    """The base of a stem: the ground on a side of it, a place that somebody gave, or its own lowest points.

    Args:
        points: (N, 3) finite points of the stem, world.
        ground: Under the plot.
        settings: Of the measurement.
        z_ground_m: Height of the base where a person has placed it; the ground is then not asked.
    """
    if z_ground_m is not None:
        return StemGround(z_ground_m, _axis(above(points, z_ground_m), settings), "", "placed")
    low = np.flatnonzero(points[:, 2] <= np.quantile(points[:, 2], 0.02) + _FOOT_M)
    foot = np.array([[median(points[low, 0]), median(points[low, 1])]])
    first = float(ground.z_at(foot)[0])
    if ground.kind == "stem_base":
        z_ground, note = _own_base(points, first)
        return StemGround(z_ground, _axis(above(points, z_ground), settings), note, "stem")
    axis = _axis(above(points, first), settings)
    if settings.base == "midpoint":
        z_ground = _ground_at_foot(axis, first, ground)
    else:
        heights = _contact_heights(axis, first, ground)
        z_ground = float(heights.max() if settings.base == "uphill" else heights.min())
    if abs(z_ground - first) > _MOVED_ENOUGH_M:
        return StemGround(z_ground, _axis(above(points, z_ground), settings), "", settings.base)
    return StemGround(z_ground, _lowered(axis, z_ground - first, settings), "", settings.base)


def above(points: NDArray[np.floating[Any]], z_m: float) -> NDArray[np.floating[Any]]:
    """A copy with z measured from `z_m`, in the points' own precision."""
    moved = points.copy()
    moved[:, 2] -= z_m
    return moved


def _axis(points_above: NDArray[np.floating[Any]], settings: MeasureSettings) -> StemAxis:
    """The stem's axis, found as the settings' method finds it."""
    line = line_of_stem(points_above, settings=settings) if settings.curve in INTERVAL_METHODS else None
    return axis_of_stem(points_above, settings=settings) if line is None else line


def _ground_at_foot(axis: StemAxis, z_axis: float, ground: GroundModel) -> float:
    """Mean ground height under a ring of the stem's radius about the axis, where the axis meets that height.

    Args:
        axis: With heights measured from `z_axis`.
        z_axis: World height of the axis' zero.
        ground: Under the plot.
    """
    radius = axis.ring.radius_m if axis.ring is not None else 0.0
    angle = np.arange(_N_AROUND) * (2 * np.pi / _N_AROUND)
    around = np.vstack([np.zeros((1, 2)), radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)])
    z_ground = z_axis
    for _ in range(4):  # a leaning stem on a slope stands lower or higher than where it was looked for
        z_ground = float(np.mean(ground.z_at(axis.xy_at(z_ground - z_axis) + around)))
    return z_ground


def _contact_heights(axis: StemAxis, z_axis: float, ground: GroundModel) -> Float64:
    """(72,) world heights at which lines on the stem's surface, along its axis, meet the ground."""
    radius = axis.ring.radius_m if axis.ring is not None else 0.0
    angle = np.arange(_N_CONTACT) * (2 * np.pi / _N_CONTACT)
    u, v, w = axis.rotation().T
    start = axis.point_m + radius * (np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v)
    heights = np.full(_N_CONTACT, z_axis)
    for _ in range(12):  # each round leaves slope times lean of the error
        rise = heights - z_axis - start[:, 2]
        heights = ground.z_at(start[:, :2] + rise[:, None] * (w[:2] / w[2]))
    return np.asarray(heights, np.float64)


def _lowered(axis: StemAxis, rise_m: float, settings: MeasureSettings) -> StemAxis:
    """The same line after the ground it is measured from has risen by `rise_m`."""
    low, high = band_m(settings)
    middle = 0.5 * (low + high)
    return replace(axis, point_m=np.array([*axis.xy_at(middle + rise_m), middle]))


def _own_base(points: NDArray[np.floating[Any]], z_model: float) -> tuple[float, str]:
    """Base height of a stem in a cloud without ground, and what to say about it.

    The model's base comes from all points near the stem, the trunk's own lowest point from the trunk alone, whose
    foot the segmentation cuts off (`TrunkSettings.ground_clearance_m`). So the model's is taken unless the two cannot
    be of one stem.
    """
    own = float(np.quantile(points[:, 2], min(1.0, 10.0 / len(points))))
    if 0.0 <= own - z_model <= _CUT_AT_MOST_M:
        return z_model, STEM_BASE_NOTE
    if own < z_model:
        return own, STEM_BASE_NOTE
    missing = f"its lowest point is {own - z_model:.1f} m above the lowest around it, so breast height is uncertain"
    return own, f"{STEM_BASE_NOTE}; {missing}"
