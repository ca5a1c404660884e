"""How far a diameter can be trusted: the documented rule behind good, fair and poor, and what to say about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dbh_studio.core.curves import CURVE_WORDS
from dbh_studio.core.measured import Flag
from dbh_studio.core.section import CrossSection

Quality = Literal["good", "fair", "poor"]

_GRADES: tuple[Quality, ...] = ("good", "fair", "poor")
_LEAN_TO_MENTION_DEG = 10.0

GOOD_HALF_WIDTH, FAIR_HALF_WIDTH = 0.06, 0.15


@dataclass(frozen=True)
class Limits:
    """The worst a diameter may be in each respect to still have a grade.

    Attributes:
        coverage_deg: Of the ring seen, at least. Under 220 the paper's curves leave the stem where it was not seen.
        gap_deg: Largest unseen sector, at most.
        spread: Root mean square distance to the curve over the ring's radius, at most.
        disagreement: Distance of the diameter to the middle of all others (circle included), relative, at most.
        n_points: Points supporting the curve, at least.
        support: Their share of the band's points, at least. A shrub has points on any curve, but not most of them.
    """

    coverage_deg: float
    gap_deg: float
    spread: float
    disagreement: float
    n_points: int
    support: float


GOOD = Limits(coverage_deg=300.0, gap_deg=60.0, spread=0.10, disagreement=0.04, n_points=100, support=0.6)
FAIR = Limits(coverage_deg=220.0, gap_deg=120.0, spread=0.20, disagreement=0.08, n_points=50, support=0.4)


def grade(section: CrossSection, *, rmse_m: float, disagreement: float, n_points: int) -> Quality:
    """``good`` or ``fair`` where every respect is within `GOOD` or `FAIR`, else ``poor``."""
    spread = rmse_m / section.ring_radius_m
    worst = 0
    for limits in (GOOD, FAIR):
        within = (
            section.coverage_deg >= limits.coverage_deg
            and section.max_gap_deg <= limits.gap_deg
            and spread <= limits.spread
            and disagreement <= limits.disagreement
            and n_points >= limits.n_points
            and n_points >= limits.support * len(section.uv_m)
        )
        if within:
            break
        worst += 1
    return _GRADES[worst]


def grade_of_interval(half_width: float) -> Quality:
    """By half of the 90 % interval, relative: ``good`` below 6 %, ``fair`` below 15 %."""
    return "good" if half_width < GOOD_HALF_WIDTH else "fair" if half_width < FAIR_HALF_WIDTH else "poor"


def disagreement_of(chosen_m: float, others_m: Sequence[float]) -> float:
    """|chosen - median of the others| relative to the latter: one curve that has gone astray does not speak for all."""
    middle = float(np.median(others_m))
    return abs(chosen_m - middle) / middle


def plain_flags(
    section: CrossSection,
    *,
    rmse_m: float,
    n_points: int,
    disagreement: float,
    diameters_m: Mapping[str, float],
    ground_note: str,
) -> tuple[Flag, ...]:
    """What stands out, in words for the forester; empty where nothing does."""
    flags = []
    if section.coverage_deg < GOOD.coverage_deg:
        flags.append(Flag("partial_arc", f"only {section.coverage_deg:.0f}° of the ring seen"))
    elif section.max_gap_deg > GOOD.gap_deg:
        flags.append(Flag("gap", f"a gap of {section.max_gap_deg:.0f}° in the ring"))
    if disagreement > GOOD.disagreement:
        said = ", ".join(f"{CURVE_WORDS.get(name, name)} {100 * value:.1f} cm" for name, value in diameters_m.items())
        flags.append(Flag("disagree", f"curves disagree by {100 * disagreement:.0f} %: {said}"))
    if n_points < GOOD.n_points:
        flags.append(Flag("few_points", f"few points: {n_points}"))
    if rmse_m / section.ring_radius_m > GOOD.spread:
        flags.append(Flag("thick_ring", f"thick ring: points lie {1000 * rmse_m:.0f} mm from the curve on average"))
    off_curve = 1.0 - n_points / len(section.uv_m)
    if off_curve > 1.0 - GOOD.support:
        flags.append(Flag("off_curve", f"{100 * off_curve:.0f} % of the band's points are not on the curve"))
    if section.lean_deg > _LEAN_TO_MENTION_DEG:
        flags.append(Flag("lean", f"stem leans {section.lean_deg:.0f}°"))
    if section.axis_source == "vertical":
        flags.append(Flag("upright", "too little of the stem seen to find its lean: taken as upright"))
    if ground_note:
        flags.append(Flag("ground", ground_note))
    return tuple(flags)
