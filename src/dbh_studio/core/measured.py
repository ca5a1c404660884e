"""What a measurement says: a diameter with all that is needed to judge it, or why there is none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.core.arrays import Bool, Float64

if TYPE_CHECKING:
    from dbh_studio.core.quality import Quality
    from dbh_studio.core.section import CrossSection

DEFINITIONS = ("tape", "curve", "area")
"""Of a diameter: convex girth/π, perimeter/π, and 2√(A/π)."""


@dataclass(frozen=True)
class Diameter:
    """A diameter with its 90 % interval, centimetres; the ends are None where no honest interval is known."""

    value_cm: float
    low_cm: float | None = None
    high_cm: float | None = None

    @property
    def half_width(self) -> float:
        """Half the interval's width, relative to the value; infinite where there is none."""
        if self.low_cm is None or self.high_cm is None:
            return float("inf")
        return 0.5 * (self.high_cm - self.low_cm) / self.value_cm

    def holds(self, truth_cm: float) -> bool:
        """Whether a value is inside; False where there is no interval."""
        return self.low_cm is not None and self.high_cm is not None and self.low_cm <= truth_cm <= self.high_cm


@dataclass(frozen=True)
class Flag:
    """Something to look at that does not forbid a diameter.

    Attributes:
        code: Short name for tables: ``partial_arc``, ``gap``, ``double_wall``, ``bulge``, ``buttress``, ``fluting``,
            ``not_round``, ``not_at_height``, ``neighbour``, ``fork``, ``few_points``, ``lean``, ``short_stretch``,
            ``fallback``, ``wide_interval``, ``profile``, ``ground``, ``clutter``, ``above_bulge``, ``above_buttress``,
            ``drawn``, ``arc_accepted``; of the paper's curves also ``disagree``, ``thick_ring``, ``off_curve``,
            ``upright``.
        words: For the forester.
    """

    code: str
    words: str


@dataclass(frozen=True, eq=False)
class SectionRing:
    """One of the stems in a section, for the picture and to split them.

    Attributes:
        centre_m: (2,) x and y at breast height, stem frame.
        radius_m: Of a circle.
        n_points: On it, of those looked at.
    """

    centre_m: Float64
    radius_m: float
    n_points: int


@dataclass(frozen=True, eq=False)
class CurveFit:
    """One closed curve fitted to a cross-section.

    Attributes:
        curve: Which model, one of `settings.CurveName`.
        outline_uv_m: (M, 2) closed outline in section coordinates (last point joins the first).
        perimeter_m: Length of the curve.
        area_m2: Area inside it.
        hull_girth_m: Perimeter of its convex hull, which is what a tape measures.
        inliers: (N,) which section points support it.
        rmse_m: Root mean square distance of the inliers to the curve.
        diameters: With intervals, where the model gives its own (a tape lies on the bark's ridges, not on the curve).
        outline_sd_m: (M,) standard deviation of the outline's distance from its middle, where it is known.
        outline_seen: (M,) whether points support the outline there, where it is known.
    """

    curve: str
    outline_uv_m: Float64
    perimeter_m: float
    area_m2: float
    hull_girth_m: float
    inliers: Bool
    rmse_m: float
    diameters: Mapping[str, Diameter] = field(default_factory=dict)
    outline_sd_m: Float64 | None = None
    outline_seen: Bool | None = None

    def diameter(self, definition: str) -> Diameter:
        """The diameter with its interval, by definition as for `diameter_m`."""
        given = self.diameters.get(definition)
        return given if given is not None else Diameter(100.0 * self.diameter_m(definition))

    def diameter_m(self, definition: str) -> float:
        """The diameter by definition ``curve`` (perimeter/π), ``tape`` (convex girth/π) or ``area`` (2√(A/π)).

        Raises:
            ValueError: No such definition.
        """
        if definition in self.diameters:
            return 0.01 * self.diameters[definition].value_cm
        if definition == "curve":
            return self.perimeter_m / np.pi
        if definition == "tape":
            return self.hull_girth_m / np.pi
        if definition == "area":
            return 2.0 * float(np.sqrt(self.area_m2 / np.pi))
        raise ValueError(f"definition {definition!r} is none of curve, tape, area")


@dataclass(frozen=True, eq=False)
class Refusal:
    """Why a stem has no diameter, and what would give it one. Falsy, so that ``if estimate:`` reads well.

    Attributes:
        code: Short name for tables and tests: ``no_points``, ``no_band``, ``too_few_points``, ``no_ring``,
            ``clutter``, ``two_rings``, ``small_arc``, ``too_uncertain``, ``no_curve``, ``implausible``,
            ``not_regular``; ``unscaled`` from the stages.
        reason: One sentence for the forester.
        remedy: What to do.
        section: The cross-section, where there is one to look at.
        fits: Curves fitted nonetheless, for the picture only.
        rings: The stems in the section, that with most points first, where any were told apart.
    """

    code: str
    reason: str
    remedy: str
    section: CrossSection | None = None
    fits: Mapping[str, CurveFit | Refusal] = field(default_factory=dict)
    rings: tuple[SectionRing, ...] = ()

    def __bool__(self) -> bool:
        return False


@dataclass(frozen=True, eq=False)
class DbhEstimate:
    """A diameter at breast height with what is needed to judge it.

    Attributes:
        dbh_cm: By `curve` and `definition`.
        curve: The curve it is read from.
        definition: ``curve``, ``tape`` or ``area``.
        section: The cross-section measured.
        fits: Every curve's fit (or refusal) on this section, by name.
        quality: ``good``, ``fair`` or ``poor``: by the interval's width where there is one, else from arc, residual and
            agreement of the curves.
        flags: What to look at, in plain words; empty where nothing stands out.
        position_m: (3,) centre of the ring in the stem's frame.
        flag_codes: Short names of the flags, in their order; see `Flag`.
        taper_cm_per_m: Loss of diameter per metre of stem; None where too little of the stem was seen, or its axis was
            taken as vertical.
        rings: The stems in the section, the one measured first; empty for the paper's curves.
    """

    dbh_cm: float
    curve: str
    definition: str
    section: CrossSection
    fits: Mapping[str, CurveFit | Refusal]
    quality: Quality
    flags: tuple[str, ...]
    position_m: Float64
    flag_codes: tuple[str, ...] = ()
    taper_cm_per_m: float | None = None
    rings: tuple[SectionRing, ...] = ()

    @property
    def hom_m(self) -> float:
        """Height of measurement above ground."""
        return self.section.hom_m

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 90 % interval of `dbh_cm`; None where no honest one is known."""
        chosen = self._chosen.diameters.get(self.definition)
        if chosen is None or chosen.low_cm is None or chosen.high_cm is None:
            return None
        return chosen.low_cm, chosen.high_cm

    @property
    def diameters(self) -> dict[str, Diameter]:
        """By all three definitions, each with its interval."""
        return {name: self._chosen.diameter(name) for name in DEFINITIONS}

    @property
    def rmse_mm(self) -> float:
        """Root mean square distance of the chosen curve's inliers, millimetres."""
        return 1000.0 * self._chosen.rmse_m

    @property
    def n_points(self) -> int:
        """How many points of the section support the chosen curve."""
        return int(self._chosen.inliers.sum())

    @property
    def _chosen(self) -> CurveFit:
        fit = self.fits[self.curve]
        assert isinstance(fit, CurveFit)
        return fit
