"""What the estimator says of a stem."""

from __future__ import annotations

from dataclasses import dataclass

from dbh_studio.core.arrays import Float64
from dbh_studio.core.estimator.interval import Spread
from dbh_studio.core.measured import Diameter, Flag, SectionRing
from dbh_studio.core.transforms import Similarity


@dataclass(frozen=True, eq=False)
class EstimatorResult:
    """A diameter at breast height, and what it rests on.

    Attributes:
        diameters: ``tape`` (convex girth/π), ``curve`` (perimeter/π) and ``area`` (2√(A/π)).
        definition: Which of them is the diameter.
        method: ``ring`` or ``circle``.
        arc_deg: How much of the ring was seen.
        gap_deg: The largest unseen sector.
        residual_mm: Root mean square distance of the points on the curve to it.
        n_points: How many points are on it, of at most `EstimatorSettings.max_points` looked at.
        lean_deg: Of the axis, from the vertical.
        taper_cm_per_m: Loss of *diameter* per metre of stem.
        height_m: Of the measurement above ground.
        position_m: (3,) centre of the section, stem frame.
        stem_from_section: Rigid motion from section coordinates (u, v, w) to the stem's frame.
        outline_uv_m: (72, 2) the likeliest curve, section coordinates.
        outline_sd_m: (72,) standard deviation of its radius.
        outline_seen: (72,) whether points support it there, 1 or 0.
        spread: What the interval of the chosen diameter rests on.
        log_sd: Standard deviation of its logarithm, that of the scale included.
        flags: What to look at.
        rings: All stems in the section, this one first.
    """

    diameters: dict[str, Diameter]
    definition: str
    method: str
    arc_deg: float
    gap_deg: float
    residual_mm: float
    n_points: int
    lean_deg: float
    taper_cm_per_m: float
    height_m: float
    position_m: Float64
    stem_from_section: Similarity
    outline_uv_m: Float64
    outline_sd_m: Float64
    outline_seen: Float64
    spread: Spread
    log_sd: float
    flags: tuple[Flag, ...]
    rings: tuple[SectionRing, ...] = ()

    @property
    def dbh_cm(self) -> float:
        """The diameter by the chosen definition."""
        return self.chosen.value_cm

    @property
    def chosen(self) -> Diameter:
        """The chosen diameter with its interval."""
        return self.diameters[self.definition]
