"""The axis of a stem around breast height.

A principal axis of the points does not do: a band of stem is wider than it is high, so its first principal axis lies
across the stem, and of a longer piece it turns with every branch and every unseen side. Here the *surface* decides:
robust circles in slices start a robust tapered cylinder.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.curves import CURVES
from dbh_studio.core.robust import Circle, robust_circle, thinned, tukey_sigma, tukey_weight
from dbh_studio.settings import MeasureSettings

WINDOW = (0.4, 1.9)
"""The stretch of stem looked at, in breast heights: 0.52-2.47 m for 1.30 m."""

_N_SLICES = 10
_MIN_SLICE_POINTS = 12
_MIN_SPAN = 0.55  # of breast height: 0.7 m of stem
_MAX_LEAN_DEG = 45.0  # the paper's assumption on trunks
_MAX_LEAN_ERROR_DEG = 3.0
_N_EFFECTIVE = 200  # neighbouring points share their error, so more of them tell no more
_N_POINTS = 2000


@dataclass(frozen=True, eq=False)
class StemAxis:
    """A line in the stem's frame, and the ring around it.

    Attributes:
        point_m: (3,) where it passes the band's centre height.
        direction: (3,) unit vector, upwards.
        ring: The stem around it there, across the axis; centre is `point_m`'s x, y. None where nothing round was found.
        source: ``stem`` where it was fitted, ``vertical`` where it was assumed.
        taper: Metres of radius lost per metre of stem; None where it is not known.
    """

    point_m: Float64
    direction: Float64
    ring: Circle | None
    source: str
    taper: float | None = None

    @property
    def lean_deg(self) -> float:
        """Angle to the vertical."""
        return float(np.degrees(np.arctan2(np.hypot(*self.direction[:2]), self.direction[2])))

    def xy_at(self, z_m: float) -> Float64:
        """(2,) where the axis passes the height `z_m`."""
        xy: Float64 = self.point_m[:2] + self.direction[:2] / self.direction[2] * (z_m - self.point_m[2])
        return xy

    def rotation(self) -> Float64:
        """(3, 3) columns u, v, w: w along the axis, u as near to x as can be."""
        w = self.direction
        u = np.array([1.0, 0.0, 0.0]) - w[0] * w
        u /= np.linalg.norm(u)
        return np.column_stack([u, np.cross(w, u), w])


def stem_axis(points_m: Float64, *, settings: MeasureSettings, seed: int) -> StemAxis:
    """The stem's axis, or a vertical one where 0.7 m of stem around breast height do not show it within 3 degrees.

    Args:
        points_m: (N, 3) finite points in canonical order, stem frame; not empty.
        settings: Of the measurement.
        seed: Of the random samples.
    """
    rng = np.random.default_rng([seed, 101])
    band_centre = band_m(settings)[0] / 2 + band_m(settings)[1] / 2
    low, high = WINDOW[0] * settings.breast_height_m, WINDOW[1] * settings.breast_height_m
    window = points_m[(points_m[:, 2] > low) & (points_m[:, 2] < high)]
    window = thinned(window, _N_POINTS, rng)
    heights, circles = _slice_circles(window, low, high, settings, rng)
    if settings.axis == "stem" and len(circles) >= 3 and np.ptp(heights) >= _MIN_SPAN * settings.breast_height_m:
        start = _line_through(heights, circles, band_centre)
        axis = _tapered_cylinder(window, start, band_centre, settings)
        if axis is not None:
            return axis
    return _vertical(points_m, heights, circles, band_centre)


def band_m(settings: MeasureSettings) -> tuple[float, float]:
    """Lower and upper height of the band above ground."""
    return settings.breast_height_m - settings.band_below_m, settings.breast_height_m + settings.band_above_m


def middle_m(settings: MeasureSettings, curve: str) -> float:
    """The height a diameter belongs to: breast height; of the paper's curves the middle of their band."""
    low, high = band_m(settings)
    return 0.5 * (low + high) if curve in CURVES else settings.breast_height_m


def _slice_circles(
    window: Float64, low: float, high: float, settings: MeasureSettings, rng: np.random.Generator
) -> tuple[Float64, list[Circle]]:
    """Mean heights and circles of the slices in which one is found."""
    edges = np.linspace(low, high, _N_SLICES + 1)
    slice_of = np.digitize(window[:, 2], edges[1:-1])
    heights, circles = [], []
    for index in range(_N_SLICES):
        points = window[slice_of == index]
        if len(points) < _MIN_SLICE_POINTS:
            continue
        circle = robust_circle(
            points[:, :2],
            tolerance_m=settings.ransac_tolerance_m,
            max_radius_m=settings.max_diameter_cm / 200.0,
            rng=rng,
            effort=0.4,
        )
        if circle is not None:
            heights.append(float(points[:, 2].mean()))
            circles.append(circle)
    return np.array(heights), circles


def _line_through(heights: Float64, circles: list[Circle], z0: float) -> Float64:
    """(5,) start values cx, cy, sx, sy, R: medians of pairwise slopes (Theil, Sen), so few wrong circles do no harm."""
    centres = np.stack([circle.centre_m for circle in circles])
    first, second = np.triu_indices(len(heights), 1)
    rise = heights[second] - heights[first]
    slope = np.median((centres[second] - centres[first]) / rise[:, None], axis=0)
    point = np.median(centres - slope * (heights - z0)[:, None], axis=0)
    return np.array([*point, *slope, float(np.median([circle.radius_m for circle in circles]))])


def _tapered_cylinder(points: Float64, start: Float64, z0: float, settings: MeasureSettings) -> StemAxis | None:
    """Robust Gauss-Newton on centre, slope, radius and taper; None where the result is not to be trusted.

    Taper has a prior of 1 ± 2 cm of radius per metre, which only matters on a short stretch.
    """
    state = np.append(start, 0.01)
    height = points[:, 2] - z0
    tolerance = settings.ransac_tolerance_m
    sigma, jacobian, weight = tolerance, np.empty((0, 6)), np.empty(0)
    for _ in range(15):
        error, jacobian = _cylinder_residuals(points, height, state)
        near = np.abs(error) < max(tolerance, 0.35 * state[4])
        if near.sum() < 3 * _MIN_SLICE_POINTS:
            return None
        sigma = max(tukey_sigma(error[near]), 0.01 * tolerance)
        weight = tukey_weight(error, sigma) * near
        normal = (jacobian * weight[:, None]).T @ jacobian
        gradient = jacobian.T @ (weight * error)
        prior = (sigma / 0.02) ** 2
        normal[5, 5] += prior
        gradient[5] += prior * (state[5] - 0.01)
        step = -np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(6), gradient)
        state = state + np.clip(step, -0.3 * state[4], 0.3 * state[4])
        if not 0.1 * tolerance < state[4] < settings.max_diameter_cm / 200.0:
            return None
        if np.abs(step).max() < 1e-4:
            break
    return _trusted(points, height, state, sigma, jacobian, weight, z0, settings)


def _cylinder_residuals(points: Float64, height: Float64, state: Float64) -> tuple[Float64, Float64]:
    """(N,) distances to the surface and their (N, 6) derivatives by cx, cy, sx, sy, R, taper."""
    direction = np.array([state[2], state[3], 1.0])
    direction /= np.linalg.norm(direction)
    offset = np.column_stack([points[:, :2] - state[:2], height])
    along = offset @ direction
    across = offset - along[:, None] * direction
    radius = np.maximum(np.linalg.norm(across, axis=1), 1e-9)
    outward = across[:, :2] / radius[:, None]
    jacobian = np.column_stack([-outward, -outward * height[:, None], -np.ones(len(points)), along])
    return radius - (state[4] - state[5] * along), jacobian


def _trusted(
    points: Float64,
    height: Float64,
    state: Float64,
    sigma: float,
    jacobian: Float64,
    weight: Float64,
    z0: float,
    settings: MeasureSettings,
) -> StemAxis | None:
    """The axis of a fit, if enough of the stem supports it and its lean is known well enough."""
    supporting = weight > 0.1
    if supporting.sum() < 0.3 * len(points):
        return None
    low, high = np.quantile(height[supporting], [0.02, 0.98])
    if high - low < _MIN_SPAN * settings.breast_height_m:
        return None
    normal = (jacobian * weight[:, None]).T @ jacobian
    covariance = np.linalg.pinv(normal) * sigma**2 * max(1.0, float(weight.sum()) / _N_EFFECTIVE)
    error_deg = np.degrees(np.sqrt(max(float(covariance[2, 2]), float(covariance[3, 3]))))
    lean_deg = np.degrees(np.arctan(np.hypot(state[2], state[3])))
    if error_deg > _MAX_LEAN_ERROR_DEG or lean_deg > _MAX_LEAN_DEG:
        return None
    direction = np.array([state[2], state[3], 1.0])
    return StemAxis(
        np.array([state[0], state[1], z0]),
        direction / np.linalg.norm(direction),
        Circle(state[:2], float(state[4]), sigma),
        "stem",
        float(state[5]),
    )


def _vertical(points_m: Float64, heights: Float64, circles: list[Circle], z0: float) -> StemAxis:
    """Upright through the circle nearest to the band, else through the median point."""
    ring = circles[int(np.abs(heights - z0).argmin())] if circles else None
    xy = ring.centre_m if ring is not None else np.median(points_m[:, :2], axis=0)
    return StemAxis(np.array([*xy, z0]), np.array([0.0, 0.0, 1.0]), ring, "vertical")
