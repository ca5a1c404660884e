"""What speaks against a fit: arcs not seen, two walls, a bulge, a neighbour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.estimator.fit import CUT, near_surface
from dbh_studio.core.estimator.heap import LIKELY_CLUTTER, HeapSigns, clutter_flag
from dbh_studio.core.estimator.posterior import N_OUTLINE
from dbh_studio.core.estimator.ring_count import OtherStem
from dbh_studio.core.estimator.tube import Polar, Tube
from dbh_studio.core.measured import Flag
from dbh_studio.core.medians import median, quantiles

ODD_SHAPE = 0.05
"""Outlines less round than this (see `oval_of`) may be two stems."""

_FULL_ARC_DEG = 300.0
_GAP_DEG = 60.0
_DRIFT_TO_MENTION = 0.75
_FLUTED = 0.04  # of the fourth wave and up
_BIN_COUNTS = (36, 24, 18, 12, 8)
_POINTS_PER_BIN = 6
_BIN_DEVIATIONS = 2.0  # of the number of clutter points
_BIN_SHARE, _BEST_BINS = 0.05, 0.9
_BIN_PLENTY = 8.0  # points: as many in each sector are no strays, however many more the best ones hold
_WALL_WINDOWS = 18
_WALL_WINDOW_RAD = np.pi / 6
_WALL_POINTS = 15
_WALL_CUT, _WALL_CUT_M = 5.0, 0.04
_BULGE_HALF_M = 0.12
_BUTTRESS_TAPER = 0.03
_FEW_POINTS = 100
_LEAN_DEG = 10.0
_SHORT_STRETCH_M = 0.4
_OFF_M = 0.05
_HERE_M = 0.15
_HERE_SECTORS, _HERE_EXPECTED, _HERE_LEFT = 12, 5.0, 0.1  # points in a sector; what is left of them
_UNSEEN_HERE_DEG = 90.0
_TOUCHING_M = 0.05
# Made stems have a contrast of 0.6 and more and are filled up to 0.45; heaps without any ring have 0.4 and 1.1 in the
# median.
_LEAST_CONTRAST, _MOST_FILLED, _FULL = 0.45, 0.45, 0.7


@dataclass(frozen=True, eq=False)
class Evidence:
    """How a tube agrees with the points; see `EstimatorResult` for the first five.

    Attributes:
        arc_deg: Of the ring.
        gap_deg: Largest unseen sector.
        residual_m: Root mean square distance.
        n_points: On the tube.
        seen: (72,) 1 where the outline is supported.
        stretch_m: Length of stem that was seen.
        off_m: How far breast height is from it; 0 inside.
        unseen_here_deg: How much of the ring seen was seen above or below, and not at breast height itself.
        wall_ratio: How many times thicker the layer of points is on its thick sides than on its thin ones.
        bulge_m: How far the stem at breast height stands out of the taper of the rest; negative for a waist.
        bulge_sd_m: Standard deviation of that.
        contrast: 1 where there is nothing in the layers next to the surface, 0 where they are as dense as it.
        filled: How dense points are well inside, by area, relative to the surface; NaN where there is no such inside.
    """

    arc_deg: float
    gap_deg: float
    residual_m: float
    n_points: int
    seen: Float64
    stretch_m: float
    off_m: float
    unseen_here_deg: float
    wall_ratio: float
    bulge_m: float
    bulge_sd_m: float
    contrast: float
    filled: float

    def is_heap(self, *, is_askew: bool = False) -> bool:
        """Whether points lie beside the ring or within it as they do on it: a shrub, not bark.

        Args:
            is_askew: The axis was not fitted: about a stem that leans all of its points lie beside an upright ring, but
                they do not fill it.
        """
        is_faint = self.contrast < _LEAST_CONTRAST and not (is_askew and self.filled <= _MOST_FILLED)
        return self.filled > _FULL or is_faint


def evidence_of(points: Float64, tube: Tube) -> Evidence | None:
    """How (N, 3) points agree with a tube; None where hardly any are near it."""
    near = near_surface(points, tube)
    if near is None:
        return None
    on = np.abs(near.error) < CUT * tube.sigma
    if on.sum() < 10:
        return None
    at, error = near.at.part(on), near.error[on]
    # The width of the layer that is there: about an upright axis a stem that leans has a wider one than its own noise.
    seen = _seen(near.at.angle(), near.error, max(near.sigma, tube.sigma))
    arc_deg, gap_deg = _arc_and_gap_deg(seen)
    low, high = quantiles(at.along, (0.02, 0.98))
    bulge, bulge_sd = _bulge(near.at, near.error, tube)
    return Evidence(
        arc_deg,
        gap_deg,
        float(np.sqrt((error**2).mean())),
        int(on.sum()),
        np.repeat(seen, N_OUTLINE // len(seen)),
        high - low,
        max(low, -high, 0.0),
        _unseen_here_deg(at, seen, high - low),
        _wall_ratio(near.at, near.error, tube),
        bulge,
        bulge_sd,
        *_contrast_and_filled(points, tube, arc_deg),
    )


def flags_of(
    evidence: Evidence,
    tube: Tube,
    *,
    lean_deg: float,
    beside: tuple[OtherStem, ...],
    drift_chance: float,
    signs: HeapSigns | None,
) -> tuple[Flag, ...]:
    """What to look at, in words.

    Args:
        evidence: Of the tube.
        tube: As fitted.
        lean_deg: Of its axis.
        beside: The stems beside it, from `ring_count.stems_of`.
        drift_chance: That passes do not fit together, from `Calibration.drift_chance`.
        signs: Of a heap.
    """
    flags = []
    if signs is not None and signs.chance > LIKELY_CLUTTER:
        flags.append(clutter_flag(signs))
    if evidence.arc_deg < _FULL_ARC_DEG:
        flags.append(Flag("partial_arc", f"only {evidence.arc_deg:.0f}° of the ring seen"))
    elif evidence.gap_deg > _GAP_DEG:
        flags.append(Flag("gap", f"a gap of {evidence.gap_deg:.0f}° in the ring"))
    if drift_chance > _DRIFT_TO_MENTION:
        words = f"bark {evidence.wall_ratio:.1f} times thicker on some sides: double wall, passes may not fit together"
        flags.append(Flag("double_wall", words))
    if bulge_share(evidence, tube) > 0:
        word = "bulges out" if evidence.bulge_m > 0 else "is narrower"
        words = f"the stem {word} by {1000 * abs(evidence.bulge_m):.0f} mm here (whorl, scar): measure above or below"
        flags.append(Flag("bulge", words))
    if tube.taper > _BUTTRESS_TAPER:
        flags.append(Flag("buttress", f"thickens by {200 * tube.taper:.0f} cm per metre downwards: root swell"))
    if float(np.sqrt(0.5 * (tube.waves[4:] ** 2).sum())) > _FLUTED * tube.radius:
        flags.append(Flag("fluting", "fluted or buttressed: a tape bridges the hollows"))
    if oval_of(tube) > ODD_SHAPE:
        flags.append(Flag("not_round", "far from round: two stems in one section, or a very irregular one"))
    if evidence.off_m > _OFF_M:
        words = f"the stem was seen only {100 * evidence.off_m:.0f} cm away from breast height"
        flags.append(Flag("not_at_height", words))
    elif evidence.unseen_here_deg >= _UNSEEN_HERE_DEG:
        words = f"no points on {evidence.unseen_here_deg:.0f}° of the ring at this height, only above or below"
        flags.append(Flag("not_at_height", words))
    flags += _beside(beside)
    if evidence.n_points < _FEW_POINTS:
        flags.append(Flag("few_points", f"few points: {evidence.n_points}"))
    if lean_deg > _LEAN_DEG:
        flags.append(Flag("lean", f"stem leans {lean_deg:.0f}°"))
    if evidence.stretch_m < _SHORT_STRETCH_M:
        flags.append(Flag("short_stretch", f"only {evidence.stretch_m:.1f} m of stem seen: lean and taper are guesses"))
    return tuple(flags)


def bulge_share(evidence: Evidence, tube: Tube) -> float:
    """By how much of its radius a stem is thicker or narrower at breast height than its taper says; 0 if not surely."""
    least = max(0.03 * tube.radius, 0.004) + 2.0 * evidence.bulge_sd_m
    return abs(evidence.bulge_m) / tube.radius if abs(evidence.bulge_m) > least else 0.0


def _beside(others: tuple[OtherStem, ...]) -> list[Flag]:
    """What to say of other stems in the section."""
    if not others:
        return []
    sizes = " and ".join(f"{200.0 * each.tube.radius:.0f} cm" for each in others)
    if any(each.kind == "fork" for each in others):
        words = f"two stems that meet below breast height, the other {sizes} thick: a fork; split it and measure each"
        return [Flag("fork", words)]
    gap_m = min(each.gap_m for each in others)
    how = "touches it" if gap_m < _TOUCHING_M else f"stands {100 * gap_m:.0f} cm beside it"
    words = f"another stem, {sizes} thick, {how}: see that the points are of this one, or split it by stems"
    return [Flag("neighbour", words)]


def oval_of(tube: Tube) -> float:
    """Root mean square of the second and third wave, relative to the radius."""
    return float(np.sqrt(0.5 * (tube.waves[:4] ** 2).sum())) / tube.radius


def _seen(angle: Float64, error: Float64, sigma: float) -> Float64:
    """(B,) 1 for each sector of the ring that holds bark, 0 for the others; B divides 72.

    Points on the surface count, less half of those in the two layers of its thickness next to it: what is clutter all
    through has none left over, so a fern before the unseen side does not make it seen. What is left must stand out from
    chance, and be no less than a twentieth of what the best sectors hold, or eight points: a handful of strays that
    happen to lie where the far side of a wrong ring would be made an arc of 70° look like one of 180°, with a diameter
    30 % off called sure to 2 %.
    """
    on, beside = np.abs(error) < 1.5 * sigma, (np.abs(error) >= 1.5 * sigma) & (np.abs(error) < 4.5 * sigma)
    n_bins = next((n for n in _BIN_COUNTS if on.sum() >= _POINTS_PER_BIN * n), _BIN_COUNTS[-1])
    sector = np.floor((angle + 2 * np.pi) * (n_bins / (2 * np.pi))).astype(np.int64) % n_bins
    held = np.bincount(sector[on], minlength=n_bins).astype(np.float64)
    clutter = 0.5 * np.bincount(sector[beside], minlength=n_bins)
    around = 0.25 * (np.roll(clutter, 1) + 2.0 * clutter + np.roll(clutter, -1))
    (best,) = quantiles(held, (_BEST_BINS,))
    least = np.maximum(_BIN_DEVIATIONS * np.sqrt(around + 1.0), np.minimum(_BIN_SHARE * best, _BIN_PLENTY))
    return (held - clutter >= least).astype(np.float64)


def _unseen_here_deg(at: Polar, seen: Float64, stretch_m: float) -> float:
    """Sectors of the ring seen that are empty near breast height, where five points and more were if spread evenly."""
    sector = np.floor((at.angle() + 2 * np.pi) * (_HERE_SECTORS / (2 * np.pi))).astype(np.int64) % _HERE_SECTORS
    here = np.bincount(sector[np.abs(at.along) <= _HERE_M], minlength=_HERE_SECTORS)
    expected = np.bincount(sector, minlength=_HERE_SECTORS) * min(2.0 * _HERE_M / max(stretch_m, 1e-9), 1.0)
    is_seen = np.repeat(seen, N_OUTLINE // len(seen)).reshape(_HERE_SECTORS, -1).mean(axis=1) >= 0.5
    is_empty = is_seen & (expected >= _HERE_EXPECTED) & (here <= _HERE_LEFT * expected)
    return float(np.count_nonzero(is_empty) * 360.0 / _HERE_SECTORS)


def _arc_and_gap_deg(seen: Float64) -> tuple[float, float]:
    width_deg = 360.0 / len(seen)
    at = np.flatnonzero(seen)
    if not len(at):
        return 0.0, 360.0
    gap = int(np.diff(np.append(at, at[0] + len(seen))).max()) - 1
    return float(len(at) * width_deg), float(gap * width_deg)


def _contrast_and_filled(points: Float64, tube: Tube, arc_deg: float) -> tuple[float, float]:
    """How much denser the points are on the surface than beside it, and how dense inside relative to it."""
    at = tube.polar(points)
    away = (at.distance - tube.surface(at)) / tube.sigma
    on = max(int(np.count_nonzero(np.abs(away) < 1.5)), 1)
    beside = int(np.count_nonzero((np.abs(away) >= 1.5) & (np.abs(away) < 4.5)))
    # The layers beside are together twice as thick as the surface.
    contrast = 1.0 - 0.5 * beside / on
    inner = tube.radius - 3.0 * tube.sigma
    if inner <= 0.25 * tube.radius:
        return contrast, float("nan")
    ring_m2 = 2.0 * np.pi * tube.radius * 3.0 * tube.sigma * max(arc_deg, 30.0) / 360.0
    # One or two strays in a thin stem of few points are no filling.
    inside = max(int(np.count_nonzero(away < -3.0)) - 2, 0)
    return contrast, float(inside / (np.pi * inner**2) * ring_m2 / on)


def _wall_ratio(at: Polar, error: Float64, tube: Tube) -> float:
    """How many times thicker the bark's layer of points is on its thick sides than on its thin ones.

    Passes that do not fit together leave two walls where they overlap and one where one of them saw the stem alone.
    Windows of 30° overlap by a third, so that no boundary of windows cuts a double wall in two.
    """
    on = np.abs(error) < max(_WALL_CUT * tube.sigma, _WALL_CUT_M)
    angle, off = at.angle()[on], error[on]
    order = np.argsort(angle)
    angle, off = angle[order], off[order]
    # Once more behind the end, so that a window may pass it.
    angle, off = np.concatenate([angle, angle + 2 * np.pi]), np.concatenate([off, off])
    starts = np.arange(_WALL_WINDOWS) * (2 * np.pi / _WALL_WINDOWS) - np.pi
    firsts, lasts = np.searchsorted(angle, starts), np.searchsorted(angle, starts + _WALL_WINDOW_RAD)
    widths = []
    for first, last in zip(firsts, lasts, strict=True):
        if last - first >= _WALL_POINTS:
            piece = off[first:last]
            widths.append(1.4826 * median(np.abs(piece - median(piece))))
    if len(widths) < 4:
        return 1.0
    thin, thick = quantiles(np.array(widths), (0.15, 0.9))
    return max(thick, 1e-4) / max(thin, 1e-4)


def _bulge(at: Polar, error: Float64, tube: Tube) -> tuple[float, float]:
    """How far breast height stands out from the stem above and below, and its standard deviation."""
    here = np.abs(at.along) < _BULGE_HALF_M
    elsewhere = ~here
    if min(here.sum(), elsewhere.sum()) < 30:
        return 0.0, np.inf
    height = median(error[here]) - median(error[elsewhere])
    # Points of one side share their error: a hundred of them tell as much as a few.
    n_told = min(here.sum(), elsewhere.sum()) / 10.0
    return height, float(1.25 * tube.sigma / np.sqrt(n_told))
