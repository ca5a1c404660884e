"""The cross-section of a stem at breast height."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dbh_studio.core.arrays import Bool, Float64, Int64, readonly
from dbh_studio.core.axis import StemAxis, band_m
from dbh_studio.core.medians import median
from dbh_studio.core.robust import Circle, robust_circle
from dbh_studio.core.transforms import Similarity
from dbh_studio.settings import MeasureSettings

_BIN_COUNTS = (72, 36, 24, 18, 12)
_POINTS_PER_BIN = 6
_BIN_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class CrossSection:
    """The points of a band of stem, on the plane across the stem's own axis.

    Attributes:
        uv_m: (N, 2) section coordinates about the ring's centre.
        indices: (N,) which of the stem's points these are.
        stem_from_section: Rigid motion from (u, v, w) to the stem's frame (metres, z = height above ground).
        band_m: Lower and upper height above ground.
        hom_m: Height of measurement: the band's centre above ground.
        lean_deg: Angle between the stem's axis and the vertical.
        axis_source: How the axis was found: ``stem`` (fitted over a long enough stretch), ``vertical`` (assumed), or
            ``prior`` (found together with the outline, but from so little of the stem that it is a guess).
        coverage_deg: How much of the ring was seen.
        max_gap_deg: The largest unseen sector.
        ring_radius_m: Radius of a robust circle: a first idea, not the measurement.
        near_ring: (N,) the points curves are fitted to; the others are too far from the ring to be bark.
    """

    uv_m: Float64
    indices: Int64
    stem_from_section: Similarity
    band_m: tuple[float, float]
    hom_m: float
    lean_deg: float
    axis_source: str
    coverage_deg: float
    max_gap_deg: float
    ring_radius_m: float = float("nan")
    near_ring: Bool = field(default_factory=lambda: np.empty(0, bool))


def cross_section(
    points_m: Float64, indices: Int64, axis: StemAxis, *, settings: MeasureSettings, seed: int
) -> CrossSection | None:
    """Project a band of stem across its axis and find the ring in it.

    Args:
        points_m: (N, 3) finite points of the band, stem frame, in canonical order.
        indices: (N,) which of the stem's points these are.
        axis: Of the stem.
        settings: Of the measurement.
        seed: Of the random samples.

    Returns:
        None where the points form nothing round (a line, a single spot, a heap).
    """
    low, high = band_m(settings)
    hom = 0.5 * (low + high)
    rotation = axis.rotation()
    uv = (points_m - axis.point_m) @ rotation[:, :2]
    # The whole stem knows better than a band seen from one side how thick it is.
    known = axis.ring if axis.source == "stem" else None
    hint = None if known is None else Circle(np.zeros(2), known.radius_m, known.sigma_m)
    ring = robust_circle(
        uv,
        tolerance_m=settings.ransac_tolerance_m,
        max_radius_m=settings.max_diameter_cm / 200.0,
        rng=np.random.default_rng([seed, 102]),
        hint=hint,
    )
    if ring is None:
        return None
    origin = axis.point_m + rotation[:, :2] @ ring.centre_m
    origin = origin + axis.direction * (hom - origin[2]) / axis.direction[2]
    uv = uv - ring.centre_m
    error = np.abs(np.hypot(uv[:, 0], uv[:, 1]) - ring.radius_m)
    gate = settings.ring_gate * ring.radius_m + settings.ransac_tolerance_m if settings.ring_gate else np.inf
    seen = error < max(0.12 * ring.radius_m, min(settings.ransac_tolerance_m, 0.5 * ring.radius_m))
    coverage_deg, max_gap_deg = ring_coverage(np.arctan2(uv[seen, 1], uv[seen, 0]))
    return CrossSection(
        readonly(uv),
        readonly(indices),
        Similarity(rotation, origin),
        (low, high),
        hom,
        axis.lean_deg,
        axis.source,
        coverage_deg,
        max_gap_deg,
        ring.radius_m,
        readonly(error < gate),
    )


def radius_at(radius_m: Float64, angle_rad: Float64) -> Float64:
    """(N,) radius of an outline in (N,) directions of -π..π, from (M,) radii in even steps that begin at 0."""
    at = angle_rad * (len(radius_m) / (2 * np.pi))
    before = np.floor(at)
    # Directions below 0 count from the end of the outline, as negative indices do.
    index = before.astype(np.int64)
    low = radius_m[index]
    found: Float64 = low + (radius_m[index + 1] - low) * (at - before)
    return found


def ring_coverage(angles_rad: Float64) -> tuple[float, float]:
    """How much of a ring was seen, and the largest unseen sector, both in degrees.

    The ring is cut into 72 bins, or fewer (down to 12) so that six points fall into each on average. A bin counts as
    seen with a tenth of the median of the occupied bins, so that stray points do not make an unseen side seen.

    Args:
        angles_rad: (N,) directions of the points on the ring from its centre.
    """
    if not len(angles_rad):
        return 0.0, 360.0
    n_bins = next((n for n in _BIN_COUNTS if len(angles_rad) >= _POINTS_PER_BIN * n), _BIN_COUNTS[-1])
    bins = np.floor((angles_rad + np.pi) * (n_bins / (2 * np.pi))).astype(np.int64) % n_bins
    counts = np.bincount(bins, minlength=n_bins)
    seen = counts >= max(1.0, _BIN_SHARE * median(counts[counts > 0]))
    width_deg = 360.0 / n_bins
    at = np.flatnonzero(seen)
    gap = int(np.diff(np.append(at, at[0] + n_bins)).max()) - 1
    return float(seen.sum() * width_deg), float(gap * width_deg)
