"""Measuring stems: the ground under each, its height of measurement, and its diameter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float64, as_points, readonly
from dbh_studio.core.axis import StemAxis, band_m
from dbh_studio.core.dbh import DbhEstimate, Refusal, axis_of_stem, measure_stem
from dbh_studio.core.ground import GroundKind, GroundModel
from dbh_studio.core.interval_methods import INTERVAL_METHODS, line_of_stem
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.stem_profile import ProfilePoint, stem_profile
from dbh_studio.core.trunks import Trunk, TrunkSet
from dbh_studio.settings import MeasureSettings

_DEFAULTS = MeasureSettings()
_N_AROUND = 12
_MOVED_ENOUGH_M = 0.05
_FOOT_M = 2.0
_CUT_AT_MOST_M = 1.0

STEM_BASE_NOTE = "measured from the stem's own base: the cloud has no ground"


@dataclass(frozen=True, eq=False)
class StemMeasurement:
    """One stem, measured or refused, in its place.

    Attributes:
        trunk_id: Which trunk.
        result: The diameter, or why there is none. In the stem's frame: x and y as in the world, z above `z_ground_m`.
        xy_m: (2,) centre at the height of measurement, world; of the stem where it was refused; NaN without points.
        z_ground_m: Height of the ground at the stem, world.
        n_points: How many points the trunk has.
        ground_kind: What the heights are measured from.
    """

    trunk_id: int
    result: DbhEstimate | Refusal
    xy_m: Float64
    z_ground_m: float
    n_points: int
    ground_kind: GroundKind


def measure_trunk(
    points_world: NDArray[np.floating[Any]],
    *,
    trunk_id: int,
    ground: GroundModel,
    settings: MeasureSettings = _DEFAULTS,
    curves: Sequence[str] | None = None,
    scale_sd: float = 0.0,
) -> StemMeasurement:
    """Measure one stem.

    Heights are measured from one ground height per stem: the mean of the ground under its axis and under a ring of its
    radius about it. (Heights above the terrain below each *point* would shear a section on a slope.)

    Args:
        points_world: (N, 3) the trunk's points, metres, +z up.
        trunk_id: Kept in the result.
        ground: Under the plot.
        settings: Of the measurement.
        curves: Which curves to fit beside the chosen one, as for `core.dbh.measure_stem`.
        scale_sd: Relative standard error of the scale; widens the interval.
    """
    points = as_points(points_world, name="points_world")
    finite = points[np.isfinite(points).all(axis=1)]
    if not len(finite):
        refusal = measure_stem(points, settings=settings)
        return StemMeasurement(trunk_id, refusal, readonly(np.full(2, np.nan)), np.nan, len(points), ground.kind)
    z_ground, axis, note = _ground_at_stem(finite, ground, settings)
    result = measure_stem(
        _above(points, z_ground), settings=settings, curves=curves, ground_note=note, axis=axis, scale_sd=scale_sd
    )
    centre = result.position_m if isinstance(result, DbhEstimate) else axis.point_m
    return StemMeasurement(trunk_id, result, readonly(centre[:2].copy()), z_ground, len(points), ground.kind)


def profile_trunk(
    points_world: NDArray[np.floating[Any]],
    *,
    z_ground_m: float,
    settings: MeasureSettings = _DEFAULTS,
    scale_sd: float = 0.0,
) -> tuple[ProfilePoint, ...]:
    """Diameters every 10 cm along one stem, see `core.stem_profile`.

    Args:
        points_world: (N, 3) the trunk's points, metres, +z up.
        z_ground_m: Height of the ground at the stem, from its measurement.
        settings: Of the measurement.
        scale_sd: Relative standard error of the scale.
    """
    points = as_points(points_world, name="points_world")
    return stem_profile(_above(points, z_ground_m), settings=settings, scale_sd=scale_sd)


def measure_all(
    trunks: TrunkSet,
    points_of: Callable[[Trunk], NDArray[np.floating[Any]]],
    *,
    ground: GroundModel,
    settings: MeasureSettings = _DEFAULTS,
    curves: Sequence[str] | None = None,
    scale_sd: float = 0.0,
    progress: Progress = ignore_progress,
) -> dict[int, StemMeasurement]:
    """Measure every trunk of a set, by id.

    Args:
        trunks: Which stems.
        points_of: Gives a trunk's (N, 3) world points; called once per trunk, so that no copy of the plot is needed.
        ground: Under the plot.
        settings: Of the measurement.
        curves: As for `measure_trunk`.
        scale_sd: As for `measure_trunk`.
        progress: Called before every stem.

    Raises:
        CancelledError: From `progress`.
    """
    measured: dict[int, StemMeasurement] = {}
    for done, trunk in enumerate(trunks):
        progress(done / len(trunks), f"Measuring tree {trunk.id}")
        measured[trunk.id] = measure_trunk(
            points_of(trunk), trunk_id=trunk.id, ground=ground, settings=settings, curves=curves, scale_sd=scale_sd
        )
    progress(1.0, f"Measured {len(measured)} trees")
    return measured


def _above(points: NDArray[np.floating[Any]], z_m: float) -> NDArray[np.floating[Any]]:
    """A copy with z measured from `z_m`, in the points' own precision."""
    moved = points.copy()
    moved[:, 2] -= z_m
    return moved


def _ground_at_stem(
    points: NDArray[np.floating[Any]], ground: GroundModel, settings: MeasureSettings
) -> tuple[float, StemAxis, str]:
    """Ground height at the stem, the stem's axis above it, and what to say about the ground."""
    low = points[:, 2] <= np.quantile(points[:, 2], 0.02) + _FOOT_M
    first = float(ground.z_at(np.median(points[low, :2], axis=0).astype(np.float64)[None])[0])
    z_ground, note = first, ""
    if ground.kind == "stem_base":
        z_ground, note = _own_base(points, first)
    axis = _axis(_above(points, z_ground), settings)
    if ground.kind == "stem_base":
        return z_ground, axis, note
    moved_to = _ground_at_foot(axis, z_ground, ground)
    if abs(moved_to - z_ground) > _MOVED_ENOUGH_M:
        return moved_to, _axis(_above(points, moved_to), settings), note
    return moved_to, _lowered(axis, moved_to - z_ground, settings), note


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
