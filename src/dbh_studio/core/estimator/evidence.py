"""What speaks against a fit: arcs not seen, two walls, a bulge, a neighbour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.estimator.fit import CUT, near_surface
from dbh_studio.core.estimator.posterior import N_OUTLINE
from dbh_studio.core.estimator.result import Flag
from dbh_studio.core.estimator.search import find_rings, offsets
from dbh_studio.core.estimator.tube import Polar, Tube
from dbh_studio.core.section import ring_coverage

_FULL_ARC_DEG = 300.0
_BIN_COUNTS = (36, 24, 18, 12)
_POINTS_PER_BIN = 6
_BIN_SHARE = 0.1
_WALL_SECTORS = 12
_WALL_POINTS = 20
_USUAL_UNEVENNESS = 1.3
_WALLS_TO_MENTION = 1.8
_BULGE_HALF_M = 0.12
_BUTTRESS_TAPER = 0.03
_FEW_POINTS = 100
_LEAN_DEG = 10.0
_SHORT_STRETCH_M = 0.4
_OFF_M = 0.05
_TOUCHING_M = 0.10
_TOUCHING_ARC_DEG = 100.0
_NEIGHBOURHOOD_M = 1.0
_NEIGHBOUR_POINTS = 40
_CLEAN_SHARE = 0.85


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
        two_walls_m: How far apart two walls are; 0 where there is one.
        bulge_m: How far the stem at breast height stands out of the taper of the rest; negative for a waist.
        bulge_sd_m: Standard deviation of that.
    """

    arc_deg: float
    gap_deg: float
    residual_m: float
    n_points: int
    seen: Float64
    stretch_m: float
    off_m: float
    two_walls_m: float
    bulge_m: float
    bulge_sd_m: float


def evidence_of(points: Float64, tube: Tube) -> Evidence | None:
    """How (N, 3) points agree with a tube; None where hardly any are near it."""
    near = near_surface(points, tube)
    if near is None:
        return None
    on = np.abs(near.error) < CUT * tube.sigma
    if on.sum() < 10:
        return None
    at, error = near.at.part(on), near.error[on]
    seen = _seen(near.at.angle(), near.error, tube.sigma)
    arc_deg, gap_deg = _arc_and_gap_deg(seen)
    low, high = np.quantile(at.along, [0.02, 0.98])
    bulge, bulge_sd = _bulge(near.at, near.error, tube)
    return Evidence(
        arc_deg,
        gap_deg,
        float(np.sqrt((error**2).mean())),
        int(on.sum()),
        np.repeat(seen, N_OUTLINE // len(seen)),
        float(high - low),
        float(max(low, -high, 0.0)),
        _two_walls(near.at, near.error, tube),
        bulge,
        bulge_sd,
    )


def flags_of(evidence: Evidence, tube: Tube, *, lean_deg: float, neighbour: bool) -> tuple[Flag, ...]:
    """What to look at, in words."""
    flags = []
    if evidence.arc_deg < _FULL_ARC_DEG:
        flags.append(Flag("partial_arc", f"only {evidence.arc_deg:.0f}° of the ring seen"))
    if evidence.two_walls_m > _WALLS_TO_MENTION * tube.sigma:
        flags.append(
            Flag("double_wall", f"two walls {1000 * evidence.two_walls_m:.0f} mm apart: passes do not fit together")
        )
    if abs(evidence.bulge_m) > max(0.03 * tube.radius, 0.004) + 2.0 * evidence.bulge_sd_m:
        word = "bulges out" if evidence.bulge_m > 0 else "is narrower"
        flags.append(
            Flag("bulge", f"the stem {word} by {1000 * abs(evidence.bulge_m):.0f} mm here: measure above or below")
        )
    if tube.taper > _BUTTRESS_TAPER:
        flags.append(Flag("buttress", f"thickens by {200 * tube.taper:.0f} cm per metre downwards: root swell"))
    if evidence.off_m > _OFF_M:
        flags.append(
            Flag("not_at_height", f"the stem was seen only {100 * evidence.off_m:.0f} cm away from breast height")
        )
    if neighbour:
        flags.append(Flag("neighbour", "another stem touches it: see that the points are of this one"))
    if evidence.n_points < _FEW_POINTS:
        flags.append(Flag("few_points", f"few points: {evidence.n_points}"))
    if lean_deg > _LEAN_DEG:
        flags.append(Flag("lean", f"stem leans {lean_deg:.0f}°"))
    if evidence.stretch_m < _SHORT_STRETCH_M:
        flags.append(Flag("short_stretch", f"only {evidence.stretch_m:.1f} m of stem seen: lean and taper are guesses"))
    return tuple(flags)


def _seen(angle: Float64, error: Float64, sigma: float) -> Float64:
    """(B,) 1 for each sector of the ring that holds bark, 0 for the others; B divides 72.

    Points on the surface count, less half of those in the two layers of its thickness next to it: what is clutter all
    through has none left over, so a fern before the unseen side does not make it seen.
    """
    on, beside = np.abs(error) < 1.5 * sigma, (np.abs(error) >= 1.5 * sigma) & (np.abs(error) < 4.5 * sigma)
    n_bins = next((n for n in _BIN_COUNTS if on.sum() >= _POINTS_PER_BIN * n), _BIN_COUNTS[-1])
    sector = np.floor((angle + 2 * np.pi) * (n_bins / (2 * np.pi))).astype(np.int64) % n_bins
    count = np.bincount(sector[on], minlength=n_bins) - 0.5 * np.bincount(sector[beside], minlength=n_bins)
    occupied = count[count > 0]
    least = max(1.0, _BIN_SHARE * float(np.median(occupied))) if len(occupied) else np.inf
    return (count >= least).astype(np.float64)


def _arc_and_gap_deg(seen: Float64) -> tuple[float, float]:
    width_deg = 360.0 / len(seen)
    at = np.flatnonzero(seen)
    if not len(at):
        return 0.0, 360.0
    gap = int(np.diff(np.append(at, at[0] + len(seen))).max()) - 1
    return float(len(at) * width_deg), float(gap * width_deg)


def _two_walls(at: Polar, error: Float64, tube: Tube) -> float:
    """How far apart two walls are where the bark is thicker than elsewhere; 0 where it is nowhere.

    Passes that do not fit together leave a thick wall where they overlap and thin ones where one of them saw the stem
    alone. So the second thickest sector is compared with the middle one: a single thick sector may be a stub.
    """
    on = np.abs(error) < 4.0 * max(tube.sigma, 0.004)
    sector = np.floor((at.angle()[on] + np.pi) * (_WALL_SECTORS / (2 * np.pi))).astype(np.int64) % _WALL_SECTORS
    off = error[on]
    widths = []
    for number in range(_WALL_SECTORS):
        mine = off[sector == number]
        if len(mine) >= _WALL_POINTS:
            widths.append(1.4826 * float(np.median(np.abs(mine - np.median(mine)))))
    if len(widths) < 3:
        return 0.0
    thick, usual = float(np.sort(widths)[-2]), float(np.median(widths))
    return 2.0 * float(np.sqrt(max(thick**2 - (_USUAL_UNEVENNESS * usual) ** 2, 0.0)))


def _bulge(at: Polar, error: Float64, tube: Tube) -> tuple[float, float]:
    """How far breast height stands out from the stem above and below, and its standard deviation."""
    here = np.abs(at.along) < _BULGE_HALF_M
    elsewhere = ~here
    if min(here.sum(), elsewhere.sum()) < 30:
        return 0.0, np.inf
    height = float(np.median(error[here]) - np.median(error[elsewhere]))
    # Points of one side share their error: a hundred of them tell as much as a few.
    n_told = min(here.sum(), elsewhere.sum()) / 10.0
    return height, float(1.25 * tube.sigma / np.sqrt(n_told))


def stem_beside(points: Float64, tube: Tube, *, widest_m: float, seed: int) -> bool:
    """Whether what is outside the tube holds another clean ring that stands against it."""
    at = tube.polar(points)
    beyond = at.distance - tube.surface(at)
    rest = points[(beyond > 3.0 * tube.sigma) & (beyond < _NEIGHBOURHOOD_M)]
    if len(rest) < max(_NEIGHBOUR_POINTS, 0.12 * len(points)):
        return False
    rings, _ = find_rings(rest, widest_m=widest_m, taper=0.0, rng=np.random.default_rng([seed, 203]))
    if not len(rings.radius):
        return False
    best = rings.at(slice(0, 1))
    radius, sigma = float(best.radius[0]), float(best.sigma[0])
    apart = float(np.hypot(*(best.middles()[0] - tube.centre)))
    if apart < 0.8 * (radius + tube.radius) or apart > radius + tube.radius + _TOUCHING_M:
        return False
    _, out_x, out_y, error = (part[0] for part in offsets(best, rest, 0.0))
    on = np.abs(error) < 2.5 * sigma
    around = error < 0.5 * radius
    clean = on.sum() >= max(_NEIGHBOUR_POINTS, _CLEAN_SHARE * around.sum())
    arc_deg, _ = ring_coverage(np.arctan2(out_y[on], out_x[on]))
    return bool(clean and sigma < 0.15 * radius and arc_deg >= _TOUCHING_ARC_DEG)
