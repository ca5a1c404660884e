"""Settings of measuring a plot: the method, where on the stem, and what is believed."""

from __future__ import annotations

from typing import Literal

from dbh_studio.settings.base import SettingsModel, setting

CurveName = Literal["shrinkage", "circle", "fourier", "ellipse", "bspline"]
SlopeBase = Literal["uphill", "midpoint", "downhill"]
HeightAlong = Literal["vertical", "stem"]
MeasureAbove = Literal["nothing", "bulge", "buttress"]


class MeasureSettings(SettingsModel):
    """How a diameter is measured."""

    ascending = (("min_diameter_cm", "max_diameter_cm"),)

    curve: CurveName = setting(
        "shrinkage",
        "Method",
        help="shrinkage: a closed curve that shrinks to a circle where nothing was seen; circle: a robust circle; both "
        "with an interval. fourier, ellipse, bspline: the paper's three, which have none",
    )
    breast_height_m: float = setting(
        1.30,
        "Breast height",
        unit="m",
        ge=0.3,
        le=5.0,
        help="1.30 Europe and Canada, 1.37 USA (4.5 ft), 1.40 New Zealand",
    )
    base: SlopeBase = setting(
        "midpoint",
        "Base on a slope",
        help="where the height is measured from: the ground on the stem's uphill or downhill side, or their mean",
    )
    along: HeightAlong = setting(
        "vertical", "Height of a leaning stem", help="vertical: above the base; stem: along the stem's axis"
    )
    above: MeasureAbove = setting(
        "nothing",
        "Measure above",
        help="bulge: where the stem is swollen at breast height, measure where that ends; buttress: also above a "
        "buttress or root swell that reaches breast height; nothing: at breast height whatever is there",
    )
    band_below_m: float = setting(
        0.08,
        "Band below",
        unit="m",
        ge=0.01,
        le=1.0,
        help="0.08 below and 0.22 above 1.30 m is the paper's 1.22-1.52 m",
    )
    band_above_m: float = setting(0.22, "Band above", unit="m", ge=0.01, le=1.0)
    definition: Literal["tape", "curve", "area"] = setting(
        "tape",
        "Diameter",
        help="tape: convex girth/π, what a tape reads; curve: perimeter/π (the paper); area: of the equal circle",
    )
    max_half_width: float = setting(
        0.40,
        "Widest interval",
        gt=0.01,
        le=2.0,
        help="half the 90 % interval, relative; a diameter known less well is not given (shrinkage, circle)",
    )
    ransac_samples: int = setting(50, "RANSAC sample", unit="points", ge=6, le=1000)
    ransac_tolerance_m: float = setting(0.05, "RANSAC tolerance", unit="m", ge=0.002, le=0.5)
    ransac_iterations: int = setting(100, "RANSAC iterations", ge=1, le=10_000)
    axis: Literal["stem", "vertical"] = setting(
        "stem", "Stem axis", help="stem: fitted to the stem around breast height, vertical where too little is seen"
    )
    polar_origin: Literal["ring", "centroid"] = setting(
        "ring",
        "Polar origin",
        help="ring: centre of a robust circle; centroid: mean point, pulled towards the seen side",
    )
    fourier_degree: int = setting(2, "Fourier degree", ge=1, le=8, help="the paper's is 2")
    spline_controls: int = setting(
        6, "Spline control points", ge=4, le=64, help="more follow the bark, and the noise, more closely"
    )
    alpha_radius: float = setting(
        2.0, "Alpha radius", unit="ring radii", ge=0.1, le=50.0, help="smaller follows hollows of the boundary"
    )
    ring_gate: float = setting(
        0.35,
        "Ring gate",
        unit="ring radii",
        ge=0.0,
        le=10.0,
        help="points farther than this and the tolerance from a robust circle are left out; 0 keeps all (the paper)",
    )
    tolerance_share: float = setting(
        0.5,
        "Tolerance of thin stems",
        unit="ring radii",
        ge=0.0,
        le=10.0,
        help="the RANSAC tolerance is at most this share of the radius; 0 keeps it fixed (the paper)",
    )
    roundness: float = setting(
        0.016, "Roundness", unit="radii", gt=0.0, le=0.5, help="shrinkage: expected size of an oval; smaller is rounder"
    )
    bark_share: float = setting(
        0.011,
        "Bark under the tape",
        ge=0.0,
        le=0.1,
        help="shrinkage, circle: a tape lies on the bark's ridges, a curve runs through their middle; relative",
    )
    bloat_chance: float = setting(
        0.2,
        "Chance of bloat",
        ge=0.0,
        lt=1.0,
        help="shrinkage, circle: that bark is smeared outwards far more than usual, before looking; 0: never",
    )
    bloat_m: float = setting(
        0.001,
        "Usual bloat",
        unit="m",
        ge=0.0,
        le=0.1,
        help="shrinkage, circle: by how much points lie outside the bark on average; 0: not at all",
    )
    min_diameter_cm: float = setting(2.0, "Smallest diameter", unit="cm", ge=0.5, le=100.0)
    max_diameter_cm: float = setting(300.0, "Largest diameter", unit="cm", ge=10.0, le=1500.0)
    min_points: int = setting(
        30,
        "Fewest points in the band",
        ge=8,
        le=100_000,
        help="shrinkage, circle: in the stretch of stem used; a third of them within 0.6 m of breast height",
    )
    min_coverage_deg: float = setting(
        90.0, "Smallest arc seen", unit="°", ge=0.0, le=360.0, help="with less of the ring seen no diameter is given"
    )
    seed: int = setting(0, "Random seed", ge=0, le=2**31 - 1)

    @classmethod
    def paper(cls) -> MeasureSettings:
        """The paper's way, as far as it says: Fourier, perimeter/π, no gate, a fixed tolerance, the mean as origin."""
        return cls(curve="fourier", definition="curve", ring_gate=0.0, tolerance_share=0.0, polar_origin="centroid")
