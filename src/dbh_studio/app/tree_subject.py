"""A tree as it is looked at in photos: where it stands, its points, its ring."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.app.document import Document
from dbh_studio.core.arrays import Float, Float64

if TYPE_CHECKING:
    from dbh_studio.app.session import Session
    from dbh_studio.core.stem_line import StemLine
    from dbh_studio.stages.measure import StemMeasurement

# Of the stem, metres above its ground: where it is looked for in the photos, and how much a picture shows.
_FROM_M, _TO_M, _TALL_M = 0.2, 2.6, 3.4
_TALL_IN_RADII = 22.0


@dataclass(frozen=True, eq=False)
class TreeSubject:
    """A tree to be looked at, world frame.

    Attributes:
        line: Where it stands.
        points: (N, 3) of the trunk.
        ring: (M, 3) the measured outline at breast height; None where there is none.
        foot: z of the ground.
        tall: How much of it a picture shows.
        is_metric: Whether the frame's unit is the metre.
    """

    line: StemLine
    points: Float
    ring: Float64 | None
    foot: float
    tall: float
    is_metric: bool

    @classmethod
    def of(
        cls, session: Session, document: Document, trunk_id: int, stem: StemMeasurement | None
    ) -> TreeSubject | None:
        """None where the trunk has too few points."""
        from dbh_studio.core.stem_line import StemLine

        points = session.points_world(document)[document.trunks[trunk_id].points]
        if stem is None or not np.isfinite(stem.z_ground_m):
            line = StemLine.of_points(points)
            if line is None:
                return None
            return cls(line, points, None, line.low, _TALL_IN_RADII * line.radius, document.scale.is_known)
        ground = stem.z_ground_m
        height = document.settings.measure.breast_height_m
        ring = ring_world(stem)
        if ring is None:
            low, high = ground + _FROM_M, ground + max(_TO_M, height + 0.5)
            line = StemLine.of_points(points, low=low, high=high, look_at=ground + height)
        else:
            line = _measured_line(stem, ring)
        return None if line is None else cls(line, points, ring, ground, _TALL_M, True)


def _measured_line(stem: StemMeasurement, ring: Float64) -> StemLine:
    from dbh_studio.core.measured import DbhEstimate
    from dbh_studio.core.stem_line import StemLine

    assert isinstance(stem.result, DbhEstimate)
    section = stem.result.section
    direction = section.stem_from_section.rotation[:, 2]
    radius = 0.005 * stem.result.dbh_cm
    top = stem.z_ground_m + max(_TO_M, section.hom_m + 0.5)
    low = stem.z_ground_m + min(_FROM_M, 0.5 * section.hom_m)
    return StemLine(ring.mean(axis=0), direction * (1.0 if direction[2] >= 0.0 else -1.0), radius, low, top)


def ring_world(stem: StemMeasurement) -> Float64 | None:
    """(M, 3) outline of a stem's measured curve, world; None where it was refused."""
    from dbh_studio.core.measured import CurveFit, DbhEstimate

    if not isinstance(stem.result, DbhEstimate):
        return None
    fit = stem.result.fits.get(stem.result.curve)
    if not isinstance(fit, CurveFit):
        return None
    outline = np.column_stack([fit.outline_uv_m, np.zeros(len(fit.outline_uv_m))])
    ring = stem.result.section.stem_from_section.apply(outline) + np.array([0.0, 0.0, stem.z_ground_m])
    return np.asarray(ring, np.float64)
