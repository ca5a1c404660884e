"""Where exactly a marker's corners are: its whole known pattern, blurred, fitted to the pixels of the picture itself.

A corner detector finds where the grey value crosses a threshold. Blur, the camera's response curve and the printer's
ink move that place inwards or outwards, by the same amount on every edge, and so make every marker too small or too
large. The pattern inside the marker has edges of both directions, which move oppositely; the blur and the asymmetry of
black and white are therefore unknowns of the fit, like the four corners, and do not bias them.

The model needs no resampling: each pixel of the picture has a ray, each ray a place on the marker, each place an
expected grey value: the pattern convolved with a Gaussian, as products of normal distribution functions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from dbh_studio.core.arrays import Bool, Float, Float64, readonly
from dbh_studio.core.camera import CameraModel

_MAX_PIXELS = 6000
_ITERATIONS = 25
_RIM_PRIOR_CELLS = (0.8, 0.6)
# Between a picture blurred after the response curve (0) and one blurred in linear light with the usual curve (0.65).
_ASYMMETRY_PRIOR = (0.25, 0.35)
_ROUNDNESS_SIGMA = 0.3
_BLUR_BOUNDS_PX = (0.25, 6.0)
_SQRT_2PI = float(np.sqrt(2 * np.pi))


@dataclass(frozen=True, eq=False)
class MarkerFit:
    """The marker as fitted in one picture.

    Attributes:
        corners_px: (4, 2) outer corners, top left first, clockwise as printed; COLMAP pixels.
        correlation: Of the pixels on the marker with the model; 1 is perfect.
        blur_px: Sigma of the blur, in pixels of the picture.
        asymmetry: How far mixed pixels are brighter than the mean of black and white, in shares of the contrast.
        sigma_px: Standard error of a corner from the noise of the pixels alone.
        pixel_rad: Angle of one pixel at the marker.
    """

    corners_px: Float64
    correlation: float
    blur_px: float
    asymmetry: float
    sigma_px: float
    pixel_rad: float


@dataclass(frozen=True, eq=False)
class _Pixels:
    """The pixels around the marker: grey values, places in the tangent plane, and how places move with the pixel."""

    grey: Float64
    plane: Float64
    by_column: Float64
    by_row: Float64


def view_rotation(direction: Float64) -> Float64:
    """(3, 3) view from camera: +z along `direction`, +x level where that has a meaning."""
    forward = direction / np.linalg.norm(direction)
    down = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.98 else np.array([0.0, 0.0, 1.0])
    right = np.cross(down, forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def homography(source: Float64, target: Float64) -> Float64:
    """(3, 3) that takes four (4, 2) points to four others.

    Raises:
        numpy.linalg.LinAlgError: Three of the points are on one line.
    """
    rows = []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows.append([x, y, 1, 0, 0, 0, -u * x, -u * y])
        rows.append([0, 0, 0, x, y, 1, -v * x, -v * y])
    solution = np.linalg.solve(np.array(rows, np.float64), np.asarray(target, np.float64).ravel())
    return np.append(solution, 1.0).reshape(3, 3)


def apply_homography(matrix: Float64, points: Float) -> Float64:
    """(N, 2) points moved."""
    moved = points @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(moved[:, :2] / moved[:, 2:])


def fit_marker(grey: NDArray[Any], camera: CameraModel, corners_px: Float64, bits: Bool) -> MarkerFit | None:
    """Fit the marker's pattern.

    Args:
        grey: (H, W) picture.
        camera: Its camera.
        corners_px: (4, 2) about right (within a pixel or two, and a third of a cell), COLMAP pixels.
        bits: (n, n) True where white, with the black border.

    Returns:
        The fit, or None where these pixels do not show this marker.
    """
    rays = camera.rays(corners_px)
    if not np.isfinite(rays).all():
        return None
    rotation = view_rotation(rays.sum(axis=0))
    local = rays @ rotation.T
    if (local[:, 2] < 0.2).any():
        return None
    quad = local[:, :2] / local[:, 2:]
    cells = float(bits.shape[0])
    pixels = _pixels_around(grey, camera, rotation, quad, cells)
    if pixels is None:
        return None
    try:
        return _Problem(pixels, quad, bits).solve(camera, rotation)
    except np.linalg.LinAlgError:
        return None


def _square(cells: float) -> Float64:
    return np.array([[0, 0], [cells, 0], [cells, cells], [0, cells]], np.float64)


def _pixels_around(
    grey: NDArray[Any], camera: CameraModel, rotation: Float64, quad: Float64, cells: float
) -> _Pixels | None:
    """The pixels on the marker and a little around it."""
    middle = quad.mean(axis=0)
    outline = np.concatenate(
        [np.linspace(a, b, 12, endpoint=False) for a, b in zip(quad, np.roll(quad, -1, 0), strict=True)]
    )
    outline = middle + 1.45 * (outline - middle)
    rays = np.column_stack([outline, np.ones(len(outline))]) @ rotation
    uv, _ = camera.project(rays)
    centre, _ = camera.project((np.append(middle, 1.0) @ rotation)[None])
    if not (np.isfinite(uv).all() and np.isfinite(centre).all()):
        return None
    columns, rows = _window(camera, uv, centre[0], rotation)
    column, row = np.meshgrid(columns, rows)
    spots = np.column_stack([column.ravel(), row.ravel()]) + 0.5
    # Near a pole a row holds far more pixels than it has detail.
    if len(spots) > 40 * _MAX_PIXELS:
        spots = spots[np.linspace(0, len(spots) - 1, 40 * _MAX_PIXELS).astype(int)]
    inverse = homography(quad, _square(cells))
    plane = _to_plane(camera, rotation, spots)
    with np.errstate(invalid="ignore"):
        place = apply_homography(inverse, plane)
        near = (np.abs(place / cells - 0.5) < 0.75).all(axis=1)
    spots, plane = spots[near], plane[near]
    half = 0.5
    by_column = _to_plane(camera, rotation, spots + (half, 0)) - _to_plane(camera, rotation, spots - (half, 0))
    by_row = _to_plane(camera, rotation, spots + (0, half)) - _to_plane(camera, rotation, spots - (0, half))
    good = np.isfinite(by_column).all(axis=1) & np.isfinite(by_row).all(axis=1) & (len(spots) > 0)
    good &= _just_outside(inverse, plane, by_column, by_row, cells)
    chosen = np.flatnonzero(good)
    if len(chosen) < 60:
        return None
    if len(chosen) > _MAX_PIXELS:
        chosen = chosen[np.linspace(0, len(chosen) - 1, _MAX_PIXELS).astype(int)]
    at = np.floor(spots[chosen]).astype(int)
    values = grey[at[:, 1], at[:, 0] % grey.shape[1]].astype(np.float64)
    return _Pixels(values, plane[chosen], by_column[chosen], by_row[chosen])


def _window(
    camera: CameraModel, uv: Float64, centre: Float64, rotation: Float64
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Columns and rows to look at; on a panorama the columns may run past the seam."""
    width, height = camera.width_px, camera.height_px
    across = uv[:, 0] - centre[0]
    low_row, high_row = int(uv[:, 1].min()) - 2, int(uv[:, 1].max()) + 3
    if camera.is_panorama:
        across = (across + width / 2) % width - width / 2
        if np.ptp(across) > 0.45 * width:
            below = rotation[2, 1] > 0
            rows = np.arange(max(low_row, 0), height) if below else np.arange(0, min(high_row, height))
            return np.arange(width), rows
    columns = np.arange(int(np.floor(centre[0] + across.min())) - 2, int(np.ceil(centre[0] + across.max())) + 3)
    if not camera.is_panorama:
        columns = columns[(columns >= 0) & (columns < width)]
    return columns, np.arange(max(low_row, 0), min(high_row, height))


def _to_plane(camera: CameraModel, rotation: Float64, spots: Float) -> Float64:
    """(N, 2) places in the plane one unit before the view; NaN behind it."""
    local = camera.rays(spots) @ rotation.T
    with np.errstate(invalid="ignore", divide="ignore"):
        local[~(local[:, 2] > 0.05)] = np.nan
        return np.asarray(local[:, :2] / local[:, 2:])


def _just_outside(inverse: Float64, plane: Float64, by_column: Float64, by_row: Float64, cells: float) -> Bool:
    """On the marker, or within 2.5 pixels and one cell of it: farther out nothing is known of what is there."""
    place = apply_homography(inverse, plane)
    column, row = (
        apply_homography(inverse, plane + by_column) - place,
        apply_homography(inverse, plane + by_row) - place,
    )
    reach = np.minimum(2.5 * np.hypot(column, row), 1.2)
    return np.asarray(((place > -reach) & (place < cells + reach)).all(axis=1))


class _Problem:
    """Gauss-Newton with damping and Huber weights on the four corners, the blur, the rim and the grey levels."""

    def __init__(self, pixels: _Pixels, quad: Float64, bits: Bool) -> None:
        self.pixels = pixels
        self.bits = bits.astype(np.float64)
        self.cells = float(bits.shape[0])
        low, high = np.percentile(pixels.grey, [10, 90])
        self.contrast = max(float(high - low), 1.0)
        # Scaled so that a unit step of a corner is a pixel.
        self.pixel = float(
            np.sqrt(np.median(np.abs(np.linalg.det(np.stack([pixels.by_column, pixels.by_row], axis=1)))))
        )
        self.quad = quad
        # 8 corner steps, two log blurs, rim; black, white, its two slopes, four grounds, asymmetry.
        self.values = np.concatenate(
            [np.zeros(8), np.log([0.8, 0.8]), [_RIM_PRIOR_CELLS[0]], [low, high, 0, 0], np.full(4, high), [0.0]]
        )

    def model(self, values: Float64) -> tuple[Float64, Float64]:
        """Expected grey values (N,) and their derivatives (N, 20)."""
        quad = self.quad + self.pixel * values[:8].reshape(4, 2)
        inverse = homography(quad, _square(self.cells))
        place = apply_homography(inverse, self.pixels.plane)
        moves = self._corner_moves(quad, place)
        column = apply_homography(inverse, self.pixels.plane + self.pixels.by_column) - place
        row = apply_homography(inverse, self.pixels.plane + self.pixels.by_row) - place
        blur = np.exp(2 * values[8:10])
        spread = np.maximum(blur[0] * column**2 + blur[1] * row**2, 1e-12)
        share = blur[0] * column**2 / spread
        rim = float(np.clip(values[10], 0.05, 4.0))
        lines = np.concatenate([[-rim], np.arange(self.cells + 1), [self.cells + rim]])
        s, t = (_Profile(place[:, axis], np.sqrt(spread[:, axis]), lines) for axis in (0, 1))
        return self._grey(values, place, moves, share, s, t)

    def _corner_moves(self, quad: Float64, place: Float64) -> Float64:
        """(N, 2, 8): how the place of each pixel moves with each corner."""
        moves = np.empty((len(place), 2, 8))
        step = 1e-3
        for number in range(8):
            moved = quad.copy()
            moved[number // 2, number % 2] += step * self.pixel
            moves[:, :, number] = (
                apply_homography(homography(moved, _square(self.cells)), self.pixels.plane) - place
            ) / step
        return moves

    def _grey(
        self, values: Float64, place: Float64, moves: Float64, share: Float64, s: _Profile, t: _Profile
    ) -> tuple[Float64, Float64]:
        black_level, white_level, slope_s, slope_t = values[11:15]
        centred = place / self.cells - 0.5
        side = _nearest_side(centred)
        ground_level = values[15:19][side]
        white_here = white_level + slope_s * centred[:, 0] + slope_t * centred[:, 1]
        lobe = values[19] * self.contrast * 4
        white_bits, paper, square = _fields(self.bits, s.value, t.value)
        white, black = white_bits + paper - square, square - white_bits
        grey = black_level * black + white_here * white + ground_level * (1 - paper) + lobe * black * white
        # The derivative by the white, black and ground coverages, chained with how these move.
        by_white, by_black = white_here + lobe * black, black_level + lobe * white
        by_bits, by_square, by_paper = by_white - by_black, by_black - by_white, by_white - ground_level

        def chained(fields: tuple[Float64, Float64, Float64]) -> Float64:
            return by_bits * fields[0] + by_paper * fields[1] + by_square * fields[2]

        along_s, along_t = (
            chained(_fields(self.bits, s.by_place, t.value)),
            chained(_fields(self.bits, s.value, t.by_place)),
        )
        wider_s, wider_t = (
            chained(_fields(self.bits, s.by_blur, t.value)),
            chained(_fields(self.bits, s.value, t.by_blur)),
        )
        jacobian = np.empty((len(grey), 20))
        jacobian[:, :8] = along_s[:, None] * moves[:, 0] + along_t[:, None] * moves[:, 1]
        jacobian[:, 8] = wider_s * share[:, 0] + wider_t * share[:, 1]
        jacobian[:, 9] = wider_s * (1 - share[:, 0]) + wider_t * (1 - share[:, 1])
        jacobian[:, 10] = by_paper * (s.by_rim * t.paper + s.paper * t.by_rim)
        jacobian[:, 11] = black
        jacobian[:, 12:15] = white[:, None] * np.column_stack([np.ones(len(white)), centred])
        jacobian[:, 15:19] = (1 - paper)[:, None] * (side[:, None] == np.arange(4))
        jacobian[:, 19] = self.contrast * 4 * black * white
        return grey, jacobian

    def _priors(self, values: Float64) -> tuple[Float64, Float64]:
        """Residuals and derivatives, in sigmas, of what is believed before looking."""
        rows = np.zeros((7, 20))
        rows[0, 10] = 1 / _RIM_PRIOR_CELLS[1]
        rows[1, 19] = 1 / _ASYMMETRY_PRIOR[1]
        rows[2, 8:10] = np.array([1, -1]) / _ROUNDNESS_SIGMA
        residuals = [
            (_RIM_PRIOR_CELLS[0] - values[10]) / _RIM_PRIOR_CELLS[1],
            (_ASYMMETRY_PRIOR[0] - values[19]) / _ASYMMETRY_PRIOR[1],
            (values[9] - values[8]) / _ROUNDNESS_SIGMA,
        ]
        # Ground that hardly shows must not run away.
        for number in range(4):
            rows[3 + number, 15 + number] = 1 / (2 * self.contrast)
            residuals.append((values[12] - values[15 + number]) / (2 * self.contrast))
        return np.array(residuals), rows

    def solve(self, camera: CameraModel, rotation: Float64) -> MarkerFit | None:
        damping, noise = 1e-3, 0.1 * self.contrast
        grey, jacobian = self.model(self.values)
        for _ in range(_ITERATIONS):
            residual = self.pixels.grey - grey
            noise = max(1.4826 * float(np.median(np.abs(residual))), 0.5)
            weight = np.minimum(1.0, 1.5 * noise / np.maximum(np.abs(residual), 1e-9)) / noise**2
            prior_residual, prior_rows = self._priors(self.values)
            normal = jacobian.T @ (weight[:, None] * jacobian) + prior_rows.T @ prior_rows
            right = jacobian.T @ (weight * residual) + prior_rows.T @ prior_residual
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), right)
            step[:8] = np.clip(step[:8], -1.0, 1.0)
            step[8:10] = np.clip(step[8:10], -0.5, 0.5)
            candidate = self.values + step
            candidate[8:10] = np.clip(candidate[8:10], *np.log(_BLUR_BOUNDS_PX))
            candidate[10] = np.clip(candidate[10], 0.05, 4.0)
            new_grey, new_jacobian = self.model(candidate)
            new_residual = self.pixels.grey - new_grey
            new_prior = self._priors(candidate)[0]
            cost, new_cost = (
                _huber(r / noise) + float(p @ p) for r, p in ((residual, prior_residual), (new_residual, new_prior))
            )
            if new_cost > cost:
                damping = min(damping * 8, 1e4)
                if damping >= 1e4:
                    break
                continue
            self.values, grey, jacobian, damping = candidate, new_grey, new_jacobian, max(damping / 5, 1e-9)
            if np.abs(step[:8]).max() < 1e-3 and np.abs(step[8:10]).max() < 1e-2:
                break
        return self._answer(camera, rotation, grey, normal)

    def _answer(self, camera: CameraModel, rotation: Float64, grey: Float64, normal: Float64) -> MarkerFit | None:
        steps = self.values[:8].reshape(4, 2)
        if not np.isfinite(steps).all() or self.values[12] - self.values[11] < 8:
            return None
        quad = self.quad + self.pixel * steps
        rays = np.column_stack([quad, np.ones(4)]) @ rotation
        corners, _ = camera.project(rays)
        place = apply_homography(homography(quad, _square(self.cells)), self.pixels.plane)
        on_marker = ((place > -0.3) & (place < self.cells + 0.3)).all(axis=1)
        seen, expected = self.pixels.grey[on_marker], grey[on_marker]
        if len(seen) < 40 or not np.isfinite(corners).all() or seen.std() < 1:
            return None
        correlation = float(np.corrcoef(seen, expected)[0, 1])
        # Neighbouring pixels share their noise after resampling and JPEG: about four count as one.
        covariance = 4.0 * np.linalg.inv(normal)[:8, :8]
        distance = float(np.sqrt(1 + (quad.mean(axis=0) ** 2).sum()))
        return MarkerFit(
            corners_px=readonly(corners),
            correlation=correlation,
            blur_px=float(np.exp(self.values[8:10].mean())),
            asymmetry=float(self.values[19]),
            sigma_px=float(np.sqrt(np.trace(covariance) / 8)),
            pixel_rad=self.pixel / distance**2,
        )


def _huber(scaled: Float64) -> float:
    size = np.abs(scaled)
    return float(np.where(size < 1.5, scaled**2, 3.0 * size - 2.25).sum())


def _nearest_side(centred: Float64) -> NDArray[np.int64]:
    """(N,) which of the four sides of the square a place is nearest to: 0 top, 1 right, 2 bottom, 3 left."""
    x, y = centred.T
    return np.where(np.abs(y) >= np.abs(x), np.where(y < 0, 0, 2), np.where(x > 0, 1, 3))


class _Profile:
    """Blurred intervals along one side of the marker: [paper, square, cell 0, cell 1, …], each (N, cells + 2)."""

    def __init__(self, place: Float64, spread: Float64, lines: Float64) -> None:
        z = (place[:, None] - lines) / spread[:, None]
        below, density = ndtr(z), np.exp(-0.5 * z * z) / _SQRT_2PI
        self.value = _intervals(below)
        self.by_place = _intervals(density / spread[:, None])
        self.by_blur = _intervals(-density * z)
        self.paper = self.value[:, 0]
        self.by_rim = (density[:, 0] + density[:, -1]) / spread


def _intervals(at_lines: Float64) -> Float64:
    paper, square = at_lines[:, 0] - at_lines[:, -1], at_lines[:, 1] - at_lines[:, -2]
    return np.column_stack([paper, square, at_lines[:, 1:-2] - at_lines[:, 2:-1]])


def _fields(bits: Float64, s: Float64, t: Float64) -> tuple[Float64, Float64, Float64]:
    """Coverage by white cells, by the paper and by the whole square."""
    return ((t[:, 2:] @ bits) * s[:, 2:]).sum(axis=1), s[:, 0] * t[:, 0], s[:, 1] * t[:, 1]
