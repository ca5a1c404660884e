"""Measuring stems: the ground under each, its height of measurement, and its diameter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float64, as_points, finite_points, readonly
from dbh_studio.core.dbh import DbhEstimate, Refusal, measure_stem
from dbh_studio.core.drawn_ring import drawn_diameter
from dbh_studio.core.ground import GroundKind, GroundModel
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.protocol_measure import along_the_stem, measure_by_protocol
from dbh_studio.core.protocols import Protocol
from dbh_studio.core.stem_profile import ProfilePoint, stem_profile
from dbh_studio.core.trunks import Trunk, TrunkSet
from dbh_studio.settings import MeasureSettings
from dbh_studio.stages.stem_ground import STEM_BASE_NOTE, above, ground_at_stem

__all__ = ["STEM_BASE_NOTE", "StemMeasurement", "measure_all", "measure_trunk", "profile_trunk"]

_DEFAULTS = MeasureSettings()
# A ring drawn by hand does not help then: where the ground is, and so its height, its points tell.
_NONE_LEFT = "No point of the stem is left to measure: all were left out by hand, or have no place."


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
        protocol: By which rules it was measured; None where it was not.
    """

    trunk_id: int
    result: DbhEstimate | Refusal
    xy_m: Float64
    z_ground_m: float
    n_points: int
    ground_kind: GroundKind
    protocol: Protocol | None = None


def measure_trunk(
    points_world: NDArray[np.floating[Any]],
    *,
    trunk_id: int,
    ground: GroundModel,
    settings: MeasureSettings = _DEFAULTS,
    curves: Sequence[str] | None = None,
    scale_sd: float = 0.0,
    z_ground_m: float | None = None,
    ring_m: Float64 | None = None,
    usual_arc_deg: float | None = None,
) -> StemMeasurement:
    """Measure one stem.

    Heights are measured from one ground height per stem: the mean of the ground under its axis and under a ring of its
    radius about it, or the ground on its uphill or downhill side. (Heights above the terrain below each *point* would
    shear a section on a slope.)

    Args:
        points_world: (N, 3) the trunk's points, metres, +z up.
        trunk_id: Kept in the result.
        ground: Under the plot.
        settings: Of the measurement.
        curves: Which curves to fit beside the chosen one, as for `core.dbh.measure_stem`.
        scale_sd: Relative standard error of the scale; widens the interval.
        z_ground_m: World height of the stem's base where a person has placed it.
        ring_m: (M, 3) a ring drawn around the stem by hand, world; the diameter is then this ring's.
        usual_arc_deg: The arc that is needed elsewhere, where a person was content with less; the flag says so.
    """
    points = as_points(points_world, name="points_world")
    finite = finite_points(points)
    if not len(finite):
        refusal, protocol = measure_stem(points, settings=settings), Protocol.of(settings)
        if isinstance(refusal, Refusal) and len(points):
            refusal = replace(refusal, reason=_NONE_LEFT, remedy="Withdraw “Points left out” in its card.")
        nowhere = readonly(np.full(2, np.nan))
        return StemMeasurement(trunk_id, refusal, nowhere, np.nan, len(points), ground.kind, protocol)
    at = ground_at_stem(finite, ground, settings, z_ground_m=z_ground_m)
    stem = above(points, at.z_m)
    if ring_m is not None:  # whoever drew it has looked where
        settings = settings.model_copy(update={"above": "nothing"})
    result = measure_by_protocol(
        stem, settings=settings, curves=curves, ground_note=at.note, axis=at.axis, scale_sd=scale_sd
    )
    if ring_m is not None:
        ring = np.asarray(above(ring_m, at.z_m), np.float64)
        wanted = along_the_stem(stem, settings)
        result = drawn_diameter(ring, stem, result, axis=at.axis, settings=wanted, ground_note=at.note)
    elif isinstance(result, DbhEstimate) and result.section.coverage_deg < (usual_arc_deg or 0.0):
        words = f"an arc of {result.section.coverage_deg:.0f}° was accepted by hand"
        codes = (*result.flag_codes, "arc_accepted")
        result = replace(result, flags=(*result.flags, words), flag_codes=codes)
    centre = result.position_m if isinstance(result, DbhEstimate) else at.axis.point_m
    protocol = Protocol.of(settings, base=at.base)
    return StemMeasurement(trunk_id, result, readonly(centre[:2].copy()), at.z_m, len(points), ground.kind, protocol)


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
    return stem_profile(above(points, z_ground_m), settings=settings, scale_sd=scale_sd)


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
