"""Settings of the estimator of partly seen stems by itself."""

from __future__ import annotations

from typing import Literal

from dbh_studio.settings.base import SettingsModel, setting


class EstimatorSettings(SettingsModel):
    """How the estimator of partly seen stems works; what its numbers rest on stands in `core.estimator`."""

    ascending = (("min_diameter_cm", "max_diameter_cm"),)

    method: Literal["ring", "circle"] = setting(
        "ring", "Method", help="ring: closed curve with a roundness prior; circle: a robust circle, nothing else"
    )
    axis: Literal["stem", "vertical"] = setting(
        "stem", "Stem axis", help="stem: fitted together with taper; vertical: taken as upright (circle only)"
    )
    definition: Literal["tape", "curve", "area"] = setting(
        "tape",
        "Diameter",
        help="tape: convex girth/π; curve: perimeter/π (the paper); area: of the equal circle",
    )
    # Lower than the 0.1 m a person may ask for: along a stem that leans by 45° that is 0.07 m above the base.
    breast_height_m: float = setting(1.30, "Height of measurement", unit="m", ge=0.05, le=100.0)
    below_m: float = setting(
        0.70, "Stem used below", unit="m", ge=0.05, le=2.0, help="axis and taper are found from this stretch of stem"
    )
    above_m: float = setting(0.90, "Stem used above", unit="m", ge=0.05, le=3.0)
    band_m: float = setting(
        0.60, "Circle's band", unit="m", ge=0.02, le=2.0, help="height of the band the plain circle is fitted to"
    )
    tolerance_m: float = setting(
        0.05, "Circle's tolerance", unit="m", ge=0.002, le=0.5, help="points farther away do not move the circle"
    )
    waves: int = setting(
        6, "Highest wave", ge=2, le=12, help="detail of the outline; the prior decides how much is used"
    )
    roundness: float = setting(
        0.016, "Roundness", unit="radii", gt=0.0, le=0.5, help="expected size of an oval's wave; smaller is rounder"
    )
    taper: float = setting(
        0.010, "Expected taper", unit="m/m", ge=-0.05, le=0.1, help="loss of radius per metre of stem"
    )
    taper_sd: float = setting(0.004, "Spread of taper", unit="m/m", gt=0.0, le=0.1)
    bark_share: float = setting(
        0.011,
        "Bark under the tape",
        ge=0.0,
        le=0.1,
        help="expected share of the diameter by which a tape on the ridges exceeds the curve; visible bark decides",
    )
    bloat_chance: float = setting(
        0.2, "Chance of bloat", ge=0.0, lt=1.0, help="that a surface is smeared far more than usual; 0: never"
    )
    bloat_m: float = setting(
        0.001, "Usual bloat", unit="m", ge=0.0, le=0.1, help="by how much surfaces are smeared outwards, on average"
    )
    max_points: int = setting(2500, "Most points used", ge=200, le=1_000_000)
    min_points: int = setting(30, "Fewest points", ge=15, le=100_000)
    min_arc_deg: float = setting(
        90.0, "Smallest arc seen", unit="°", ge=0.0, le=360.0, help="with less of the ring seen no diameter is given"
    )
    max_half_width: float = setting(
        0.40, "Widest interval", gt=0.01, le=2.0, help="half the 90 % interval, relative; wider is refused"
    )
    max_depth_noise: float = setting(
        0.15, "Most noise of an arc", gt=0.0, le=10.0, help="scatter over the depth of the arc seen; more is refused"
    )
    max_clutter: float = setting(
        0.9, "Most like clutter", gt=0.0, le=1.0, help="chance of being no stem; with more it is refused; 1: never"
    )
    min_diameter_cm: float = setting(2.0, "Smallest diameter", unit="cm", ge=0.5, le=100.0)
    max_diameter_cm: float = setting(300.0, "Largest diameter", unit="cm", ge=10.0, le=1500.0)
    seed: int = setting(0, "Random seed", ge=0, le=2**31 - 1)
