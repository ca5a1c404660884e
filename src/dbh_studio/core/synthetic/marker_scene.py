"""Pictures of scale markers with everything known: the plots on which the marker measurement is developed and judged.

A textured slope, a few textured stems and square markers, some lying on the ground and some upright, ray-cast into any
camera that gives a ray per pixel. The picture then suffers what pictures suffer: lens and resampling blur in linear
light, the response curve, sharpening, noise, JPEG. Lengths are metres; the bit patterns come from the caller, because
the dictionaries belong to a package this layer does not know.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dbh_studio.core.arrays import Bool, Float, Float64, UInt8, readonly
from dbh_studio.core.synthetic.picture_flaws import PictureFlaws, jpeg_luminance, through_the_camera

_TEXTURE_PX = 1024
_SKY = 0.85
_THIN_M = 0.06

RaysOfPixels = Callable[[Float64], Float64]


@dataclass(frozen=True, eq=False)
class MarkerBoard:
    """A printed square marker in the world.

    Attributes:
        key: (dictionary, id), as the detector will name it.
        bits: (n, n) True where white, the black border included.
        side_m: Outer edge of the black border.
        centre_m: (3,) middle of the marker.
        right: (3,) unit vector along the printed top edge, left to right.
        down: (3,) unit vector along the printed left edge, top to bottom.
        margin: White rim outside the black border, as a share of `side_m`.
        shade: Reflectance of the white paper.
    """

    key: tuple[str, int]
    bits: Bool
    side_m: float
    centre_m: Float64
    right: Float64
    down: Float64
    margin: float = 0.12
    shade: float = 0.8

    @property
    def corners_m(self) -> Float64:
        """(4, 3) outer corners of the black border: top left, top right, bottom right, bottom left as printed."""
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (self.side_m / 2)
        return readonly(self.centre_m + signs[:, :1] * self.right + signs[:, 1:] * self.down)


@dataclass(frozen=True, eq=False)
class WrappedMarker:
    """A printed marker bent round an upright stem.

    Attributes:
        bits: (n, n) True where white, the black border included.
        side_m: Its side while flat.
        stem: Index of the stem.
        azimuth_rad: Direction its middle faces, from +x towards +y.
        height_m: z of its middle.
        margin: White rim, as a share of `side_m`.
    """

    bits: Bool
    side_m: float
    stem: int
    azimuth_rad: float
    height_m: float
    margin: float = 0.12


@dataclass(frozen=True, eq=False)
class MarkerScene:
    """The plot.

    Attributes:
        boards: The markers.
        stems_m: (K, 3) x, y and radius of upright stems.
        slope: (2,) rise of the ground per metre along x and y; it passes through the origin.
        texture: (T, T) float32 tile in 0..1 for ground and bark.
        wrapped: Markers bent round stems.
    """

    boards: tuple[MarkerBoard, ...]
    stems_m: Float64
    slope: Float64
    texture: Float
    wrapped: tuple[WrappedMarker, ...] = ()

    def ground_m(self, x_m: Float64, y_m: Float64) -> Float64:
        """Height of the ground."""
        return np.asarray(x_m * self.slope[0] + y_m * self.slope[1])


def noise_texture(rng: np.random.Generator, size_px: int = _TEXTURE_PX) -> Float:
    """(size_px, size_px) float32 tile in 0..1 that repeats without a seam and has detail at every scale."""
    total = np.zeros((size_px, size_px), np.float32)
    for sigma, weight in ((0.7, 1.0), (3.0, 1.2), (14.0, 1.5), (60.0, 1.0)):
        layer = ndimage.gaussian_filter(rng.standard_normal((size_px, size_px)).astype(np.float32), sigma, mode="wrap")
        total += weight * layer / layer.std()
    return np.asarray(np.clip(0.5 + 0.18 * total, 0.0, 1.0), np.float32)


def random_scene(
    seed: int, codes: Sequence[tuple[tuple[str, int], Bool, float]], *, hidden: bool = False
) -> MarkerScene:
    """A plot with the given markers: the first, third … lie on the ground, the others stand upright.

    Args:
        seed: Development uses seeds below 1000, the published figures those from 10 000 on.
        codes: Per marker its (dictionary, id), its (n, n) bits with border, and its side in metres.
        hidden: Whether saplings stand on and before the markers.
    """
    rng = np.random.default_rng([seed, 1])
    slope = rng.uniform(-0.12, 0.12, 2)
    angles = (
        rng.uniform(0, 2 * np.pi)
        + np.arange(len(codes)) * 2 * np.pi / max(len(codes), 1)
        + rng.normal(0, 0.2, len(codes))
    )
    boards = []
    for number, (key, bits, side_m) in enumerate(codes):
        radius = rng.uniform(0.4, 1.8)
        place = radius * np.array([np.cos(angles[number]), np.sin(angles[number])])
        boards.append(_board(rng, key, bits, side_m, place, slope, lying=number % 2 == 0))
    n_stems = int(rng.integers(5, 9))
    away = rng.uniform(4.0, 11.0, n_stems)
    turn = rng.uniform(0, 2 * np.pi) + np.arange(n_stems) * 2 * np.pi / n_stems
    stems = np.column_stack([away * np.cos(turn), away * np.sin(turn), rng.uniform(0.08, 0.3, n_stems)])
    if hidden:
        stems = np.vstack([stems, *(_saplings(rng, board) for board in boards)])
    return MarkerScene(tuple(boards), stems, slope, noise_texture(rng))


def _saplings(rng: np.random.Generator, board: MarkerBoard) -> Float64:
    """(2, 3) one on the marker or close before it, one farther out; each hides a strip of it from some sides."""
    front = np.cross(board.down, board.right)
    lies = abs(front[2]) > 0.7
    spots = []
    for nearest, farthest in ((0.1, 0.45), (0.4, 1.0)):
        away = rng.uniform(nearest, farthest) * board.side_m
        turn = rng.uniform(0, 2 * np.pi) if lies else np.arctan2(front[1], front[0]) + rng.uniform(-0.9, 0.9)
        spots.append([away * np.cos(turn), away * np.sin(turn), rng.uniform(0.006, 0.02)])
    return np.array(spots) + np.append(board.centre_m[:2], 0.0)


def _board(
    rng: np.random.Generator,
    key: tuple[str, int],
    bits: Bool,
    side_m: float,
    place_m: Float64,
    slope: Float64,
    *,
    lying: bool,
) -> MarkerBoard:
    """One marker on the ground, parallel to it, or upright at knee height, facing outwards."""
    ground = float(place_m @ slope)
    turn = rng.uniform(0, 2 * np.pi)
    if lying:
        normal = np.array([-slope[0], -slope[1], 1.0])
        normal /= np.linalg.norm(normal)
        right = np.cross([np.sin(turn), np.cos(turn), 0.0], normal)
        right /= np.linalg.norm(right)
        # Printed right x printed down points into the board.
        down = np.cross(-normal, right)
        centre = np.array([*place_m, ground + 0.01])
    else:
        normal = np.array([np.cos(turn), np.sin(turn), rng.uniform(-0.1, 0.1)])
        normal /= np.linalg.norm(normal)
        down = np.array([0.0, 0.0, -1.0]) + normal * normal[2]
        down /= np.linalg.norm(down)
        right = np.cross(down, -normal)
        centre = np.array([*place_m, ground + side_m / 2 + rng.uniform(0.2, 0.9)])
    return MarkerBoard(
        key, bits, side_m, centre, right, down, margin=rng.uniform(0.08, 0.2), shade=rng.uniform(0.55, 0.9)
    )


def render(
    scene: MarkerScene,
    rays_world: RaysOfPixels,
    origin_m: Float64,
    size_px: tuple[int, int],
    flaws: PictureFlaws,
    *,
    wraps: bool,
    seed: int = 0,
    background_step: int = 1,
) -> UInt8:
    """(H, W, 3) uint8 picture of the scene.

    Args:
        scene: The plot.
        rays_world: (N, 2) pixels, (0, 0) the outer top-left corner, to (N, 3) unit directions in the world.
        origin_m: (3,) centre of the camera.
        size_px: Width and height.
        flaws: What happens on the way to the file.
        wraps: Whether the left and the right border meet (a panorama).
        seed: Of the noise.
        background_step: So many pixels across share one ray where there is no marker: saves time in large pictures.
    """
    width, height = size_px
    shift = np.array(flaws.resampling_px)
    rows, columns = np.indices((height // background_step, width // background_step)).reshape(2, -1)
    pixels = background_step * (np.column_stack([columns, rows]) + 0.5) + shift
    light, is_board = _trace(scene, rays_world(pixels), origin_m)
    light = _enlarged(light.reshape(height // background_step, -1), background_step)
    is_board = _enlarged(is_board.reshape(height // background_step, -1), background_step)
    _supersample(scene, rays_world, origin_m, shift, light, is_board)
    picture = through_the_camera(light, flaws, wraps=wraps)
    noise = np.random.default_rng([seed, 3]).standard_normal(picture.shape, dtype=np.float32)
    picture = np.clip(np.round(255 * picture + flaws.noise * noise), 0, 255)
    if flaws.jpeg_quality:
        picture = jpeg_luminance(picture, flaws.jpeg_quality)
    grey = picture.astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)


def _enlarged(values: NDArray[Any], step: int) -> NDArray[Any]:
    return values.repeat(step, axis=0).repeat(step, axis=1) if step > 1 else values


def _supersample(
    scene: MarkerScene,
    rays_world: RaysOfPixels,
    origin_m: Float64,
    shift_px: Float64,
    light: Float,
    is_board: Bool,
    per_side: int = 4,
) -> None:
    """Average several rays in the pixels on and beside a marker: there the edges are what is measured."""
    rows, columns = np.nonzero(is_board)
    if not len(rows):
        return
    pixels = np.column_stack([columns, rows]) + 0.5 + shift_px
    total = np.zeros(len(rows), np.float32)
    steps = (np.arange(per_side) + 0.5) / per_side - 0.5
    for dx in steps:
        for dy in steps:
            total += _trace(scene, rays_world(pixels + (dx, dy)), origin_m)[0]
    light[rows, columns] = total / per_side**2


def _lookup(texture: Float, a_m: Float, b_m: Float, px_per_m: float) -> Float:
    rows = (a_m * px_per_m).astype(np.int32) % texture.shape[0]
    columns = (b_m * px_per_m).astype(np.int32) % texture.shape[1]
    return texture[rows, columns]


def _trace(scene: MarkerScene, directions: Float, origin_m: Float64) -> tuple[Float, Bool]:
    """Light along each ray, and whether it meets a marker's board or just misses it."""
    rays = np.asarray(directions, np.float32)
    origin = np.asarray(origin_m, np.float32)
    light = np.full(len(rays), _SKY, np.float32)
    depth = np.full(len(rays), np.inf, np.float32)
    sink = rays[:, 0] * np.float32(scene.slope[0]) + rays[:, 1] * np.float32(scene.slope[1]) - rays[:, 2]
    height = np.float32(origin_m[2] - origin_m[:2] @ scene.slope)
    low = np.flatnonzero(sink > 0.01)
    reach = height / sink[low]
    spots = origin[:2] + reach[:, None] * rays[low, :2]
    light[low] = 0.05 + 0.4 * _lookup(scene.texture, spots[:, 0], spots[:, 1], 90.0)
    depth[low] = reach
    is_board = np.zeros(len(rays), bool)
    _paint_stems(scene, rays, origin, light, depth, is_board)
    for board in scene.boards:
        _paint_board(board, rays, origin_m, light, depth, is_board)
    return light, is_board


def _paint_stems(scene: MarkerScene, rays: Float, origin: Float, light: Float, depth: Float, is_board: Bool) -> None:
    level = np.hypot(rays[:, 0], rays[:, 1])
    for number, (x, y, radius) in enumerate(scene.stems_m.astype(np.float32)):
        dx, dy = x - origin[0], y - origin[1]
        along = rays[:, 0] * dx + rays[:, 1] * dy
        miss = np.abs(rays[:, 0] * dy - rays[:, 1] * dx)
        hit = np.flatnonzero((along > 0) & (miss < radius * level))
        inside = np.sqrt(np.maximum(radius**2 - (miss[hit] / level[hit]) ** 2, 0))
        reach = (along[hit] / level[hit] - inside) / level[hit]
        near = (reach > 0) & (reach < depth[hit])
        hit, reach = hit[near], reach[near]
        spots = origin + reach[:, None] * rays[hit]
        azimuth = np.arctan2(spots[:, 1] - y, spots[:, 0] - x)
        light[hit] = 0.04 + 0.25 * _lookup(scene.texture, azimuth * radius * 2, spots[:, 2], 120.0)
        depth[hit] = reach
        for sheet in scene.wrapped:
            if sheet.stem == number:
                _paint_sheet(sheet, hit, azimuth, spots[:, 2], float(radius), light, is_board)
        if radius < _THIN_M:
            # Its edge may lie on a marker.
            is_board[hit] = True


def _paint_sheet(
    sheet: WrappedMarker,
    hit: NDArray[np.int64],
    azimuth: Float,
    height: Float,
    radius_m: float,
    light: Float,
    is_board: Bool,
) -> None:
    away = (azimuth - sheet.azimuth_rad + np.pi) % (2 * np.pi) - np.pi
    # Seen from outside, growing azimuth goes to the right.
    across = away * radius_m / sheet.side_m + 0.5
    along = (sheet.height_m - height) / sheet.side_m + 0.5
    rim = sheet.margin
    on = (across > -rim) & (across < 1 + rim) & (along > -rim) & (along < 1 + rim)
    light[hit[on]] = np.where(_is_white(sheet.bits, across[on], along[on]), 0.8, 0.05)
    is_board[hit[on]] = True


def _is_white(bits: Bool, across: Float, along: Float) -> Bool:
    """The print at places given as shares of the side; its rim is white."""
    count = bits.shape[0]
    rows, columns = np.floor(along * count).astype(int), np.floor(across * count).astype(int)
    inside = (rows >= 0) & (rows < count) & (columns >= 0) & (columns < count)
    white = ~inside
    white[inside] = bits[rows[inside], columns[inside]]
    return white


def _paint_board(
    board: MarkerBoard, rays: Float, origin_m: Float64, light: Float, depth: Float, is_board: Bool
) -> None:
    front = np.cross(board.down, board.right)
    height = float((origin_m - board.centre_m) @ front)
    # Only the rays that can meet it: it is a small part of a panorama.
    middle = board.centre_m - origin_m
    away = float(np.linalg.norm(middle))
    radius = board.side_m * (0.75 + 1.5 * board.margin) + 0.4
    if away > radius:
        narrowest = np.sqrt(1 - (radius / away) ** 2)
        candidates = np.flatnonzero(rays @ (middle / away).astype(np.float32) > narrowest)
    else:
        candidates = np.arange(len(rays))
    # In double precision: no rounding belongs into the truth.
    towards = -(rays[candidates].astype(np.float64) @ front)
    facing = towards * np.sign(height) > 1e-4
    meets = candidates[facing]
    reach = height / towards[facing]
    from_centre = origin_m - board.centre_m + reach[:, None] * rays[meets].astype(np.float64)
    across = from_centre @ board.right / board.side_m + 0.5
    along = from_centre @ board.down / board.side_m + 0.5
    rim = board.margin
    reach_out = 0.15 + 0.02 * abs(height)
    close = (across > -rim - reach_out) & (across < 1 + rim + reach_out)
    close &= (along > -rim - reach_out) & (along < 1 + rim + reach_out)
    is_board[meets[close]] = True
    on = close & (across > -rim) & (across < 1 + rim) & (along > -rim) & (along < 1 + rim)
    on &= reach < depth[meets]
    hit, across, along = meets[on], across[on], along[on]
    white = _is_white(board.bits, across, along)
    if height < 0:
        # Its back.
        light[hit] = 0.3
    else:
        # Light never falls quite evenly on a sheet.
        light[hit] = np.where(white, board.shade, 0.05) * (0.9 + 0.2 * across)
    depth[hit] = reach[on]
