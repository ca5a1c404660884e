"""Straight tiles of a photo that is too wide to look at as it is: a panorama, or a fisheye.

A model that finds trunks wants square pictures with straight verticals; in a panorama squashed to its size a 30 cm stem
10 m away is 4 pixels wide, in a tile 12, and a stem on the seam is two halves. Frame ``tile`` as `cam`: +x right, +y
down, +z into the tile. Pixels as in `core.camera`: (0, 0) is the outer top-left corner.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dbh_studio.core.arrays import Bool, Float, Float32, Float64, UInt8, as_points, readonly
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.core.transforms import Similarity

# Rows of a tile at a time: bounds the float64 temporaries to some tens of megabytes.
_ROWS = 256
# More samples than this per pixel and side are no better: the photo is then many times finer than the tile.
_MOST_SAMPLES = 4


@dataclass(frozen=True, eq=False)
class Tile:
    """One straight view out of a wide photo.

    Attributes:
        camera: PINHOLE, square, the optical axis in the middle.
        tile_from_cam: (3, 3) rotation from the wide photo's camera frame.
        yaw_deg: Where it looks, to the right of the middle of the photo when that is upright.
        pitch_deg: Where it looks, above the horizon.
    """

    camera: CameraModel
    tile_from_cam: Float64
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0

    def __post_init__(self) -> None:
        rotation = Similarity(self.tile_from_cam, np.zeros(3)).rotation
        object.__setattr__(self, "tile_from_cam", rotation)

    @property
    def size_px(self) -> int:
        """Side of the square."""
        return self.camera.width_px

    def rays(self, uv_px: ArrayLike) -> Float64:
        """(N, 3) unit directions in the wide photo's camera frame, of (N, 2) pixels of the tile."""
        return self.camera.rays(uv_px) @ self.tile_from_cam

    def project(self, points_cam: ArrayLike) -> tuple[Float64, Bool]:
        """(N, 2) pixels of the tile and (N,) whether inside it, of (N, 3) points in the wide photo's camera frame."""
        return self.camera.project(np.asarray(points_cam) @ self.tile_from_cam.T)

    def posed(self, photo: PosedImage, name: str) -> PosedImage:
        """The tile as a photo of its own, taken from the same place."""
        turn = Similarity(self.tile_from_cam, np.zeros(3))
        return replace(photo, name=name, camera=self.camera, cam_from_source=turn @ photo.cam_from_source, path=None)


@dataclass(frozen=True, eq=False)
class TileSet:
    """The tiles of one kind of photo. Make it once per camera: where the pixels lie is computed once and kept.

    Attributes:
        camera: Of the wide photos.
        tiles: In the order of the rows asked for, each from left to right.
    """

    camera: CameraModel
    tiles: tuple[Tile, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "tiles", tuple(self.tiles))
        if not self.tiles:
            raise ValueError("there must be at least one tile")

    @classmethod
    def ring(
        cls,
        camera: CameraModel,
        *,
        count: int = 5,
        fov_deg: float = 90.0,
        size_px: int = 800,
        pitches_deg: Sequence[float] = (0.0,),
        zenith: bool = False,
        nadir: bool = False,
        up_cam: ArrayLike = (0.0, -1.0, 0.0),
    ) -> TileSet:
        """Tiles all round, at every pitch; neighbours overlap by ``fov_deg - 360 / count``.

        Args:
            camera: Of the wide photo. Tiles of which it shows nothing are left out.
            count: Tiles per row.
            fov_deg: Width and height of a tile, below 170.
            size_px: Side of a tile. The public Grounding DINO models read 800 and nothing else.
            pitches_deg: Rows, by how far above the horizon they look.
            zenith: Also one straight up.
            nadir: Also one straight down.
            up_cam: (3,) where up is, in the photo's camera frame: stems are then upright in the tiles though the camera
                was held aslant. `up_in_camera` gives it.

        Raises:
            ValueError: The tiles of a row do not overlap, or the camera sees none of them.
        """
        if count * fov_deg <= 360.0:
            raise ValueError(f"{count} tiles of {fov_deg:g}° leave gaps: more than {360.0 / count:g}° each is needed")
        rows = [(pitch, count) for pitch in pitches_deg]
        rows += [(90.0, 1)] * zenith + [(-90.0, 1)] * nadir
        return cls.rows(camera, rows, fov_deg=fov_deg, size_px=size_px, up_cam=up_cam)

    @classmethod
    def rows(
        cls,
        camera: CameraModel,
        rows: Iterable[tuple[float, int]],
        *,
        fov_deg: float,
        size_px: int,
        up_cam: ArrayLike = (0.0, -1.0, 0.0),
        least_share: float = 0.0,
    ) -> TileSet:
        """Tiles in rows of (pitch in degrees, how many of them); at ±90° one is enough.

        Args:
            camera: Of the wide photo.
            rows: Pitch and count.
            fov_deg: Width and height of a tile, below 170.
            size_px: Side of a tile.
            up_cam: (3,) where up is, in the photo's camera frame.
            least_share: Tiles of which the photo covers no more than this are left out.
        """
        if not 1.0 <= fov_deg < 170.0 or size_px < 8:
            raise ValueError(f"tiles of {fov_deg:g}° and {size_px} pixels; 1° to 170° and 8 pixels are needed")
        level_from_cam = _upright(np.asarray(up_cam, np.float64))
        focal = size_px / (2.0 * np.tan(np.radians(fov_deg) / 2.0))
        pinhole = CameraModel("PINHOLE", size_px, size_px, (focal, focal, size_px / 2.0, size_px / 2.0))
        tiles = []
        for pitch_deg, count in rows:
            for yaw_deg in np.arange(count) * 360.0 / count:
                yaw, pitch = np.radians([yaw_deg, pitch_deg])
                direction = [np.cos(pitch) * np.sin(yaw), -np.sin(pitch), np.cos(pitch) * np.cos(yaw)]
                rotation = view_rotation(np.array(direction)) @ level_from_cam
                tiles.append(Tile(pinhole, rotation, float(yaw_deg), float(pitch_deg)))
        return cls(camera, tuple(tile for tile in tiles if _covered_share(tile, camera) > least_share))

    def __len__(self) -> int:
        return len(self.tiles)

    def sampling_map(self, index: int) -> Float32:
        """(size, size, 2) where each pixel of a tile lies in the photo; NaN where the photo does not reach.

        Continuous pixels of the photo; `cv2.remap` wants 0.5 less. Left and right of a panorama's seam the map jumps:
        interpolate the picture with `sample`, which goes round, never the map.
        """
        tile = self.tiles[index]
        spots = np.empty((tile.size_px, tile.size_px, 2), np.float32)
        for first in range(0, tile.size_px, _ROWS):
            rows = np.arange(first, min(first + _ROWS, tile.size_px))
            spots[rows] = self._spots(tile, rows + 0.5, np.arange(tile.size_px) + 0.5)
        return spots

    def render(self, picture: UInt8, index: int) -> UInt8:
        """A tile of a picture: (size, size) or (size, size, C), 0 where the photo does not reach.

        Where the photo is finer than the tile several samples are averaged, so that thin things do not come and go.

        Args:
            picture: (H, W) or (H, W, C), of the camera's aspect; a smaller copy of the photo will do.
            index: Which tile.
        """
        tile, camera = self.tiles[index], self.camera.scaled_to(picture.shape[1], picture.shape[0])
        n = _n_samples(tile, camera)
        offsets = (np.arange(n) + 0.5) / n
        view = np.zeros((tile.size_px, tile.size_px, *picture.shape[2:]), np.uint8)
        for first in range(0, tile.size_px, _ROWS):
            rows = np.arange(first, min(first + _ROWS, tile.size_px))
            total = np.zeros((len(rows), *view.shape[1:]), np.float32)
            for down in offsets:
                for across in offsets:
                    spots = self._spots(tile, rows + down, np.arange(tile.size_px) + across, camera)
                    total += sample(picture, spots, wraps=camera.is_panorama)
            view[rows] = np.rint(total / (n * n)).astype(np.uint8)
        return view

    def _spots(self, tile: Tile, rows: Float, columns: Float, camera: CameraModel | None = None) -> Float64:
        """(R, C, 2) pixels of the photo, NaN outside it."""
        # As `Tile.rays`, but of a whole grid at once and without unit length, which projecting does not need.
        middle, focal = tile.size_px / 2.0, tile.camera.params[0]
        right, down, forward = tile.tile_from_cam
        rays = ((columns - middle) / focal)[None, :, None] * right + ((rows - middle) / focal)[:, None, None] * down
        uv, is_seen = (camera or self.camera).project((rays + forward).reshape(-1, 3))
        uv[~is_seen] = np.nan
        return uv.reshape(len(rows), len(columns), 2)

    def look_up(self, points_cam: ArrayLike) -> tuple[NDArray[np.int16], Float32, Float32]:
        """Which tile shows each point best: the one in which it is the farthest from the border.

        Args:
            points_cam: (N, 3) in the wide photo's camera frame.

        Returns:
            (N,) index of the tile, -1 where none shows it; (N, 2) its pixel there, NaN where none; (N,) how central it
            is, 1 in the middle and 0 on the border.
        """
        points = as_points(points_cam, name="points_cam")
        best = np.full(len(points), -1, np.int16)
        pixel = np.full((len(points), 2), np.nan, np.float32)
        central = np.full(len(points), -1.0, np.float32)
        for index in range(len(self)):
            rows, uv, depth = self.seen_in(index, points)
            better = depth > central[rows]
            rows = rows[better]
            best[rows], pixel[rows], central[rows] = index, uv[better], depth[better]
        return best, pixel, np.maximum(central, 0.0)

    def seen_in(self, index: int, points_cam: Float) -> tuple[NDArray[np.int64], Float32, Float32]:
        """(M,) rows of the points one tile shows, (M, 2) their pixels there, (M,) how central they are."""
        tile = self.tiles[index]
        # Only what lies in the cone about the axis is projected: of a ring, each tile sees a quarter.
        corner = float(np.cos(np.arctan(np.sqrt(2.0) * tile.size_px / (2.0 * tile.camera.params[0]))))
        axis = tile.tile_from_cam[2].astype(points_cam.dtype)
        length = np.sqrt(np.einsum("ij,ij->i", points_cam, points_cam))
        rows = np.flatnonzero(points_cam @ axis >= corner * length * 0.999)
        uv, is_seen = tile.project(points_cam[rows])
        rows, uv = rows[is_seen], uv[is_seen]
        central = 1.0 - np.abs(uv / (tile.size_px / 2.0) - 1.0).max(axis=1)
        return rows, uv.astype(np.float32), np.maximum(central, 0.0).astype(np.float32)

    @cached_property
    def directions(self) -> Float32:
        """(H * W, 3) float32 unit directions of the wide photo's pixels, row by row; NaN where it shows nothing."""
        width, height = self.camera.width_px, self.camera.height_px
        rays = np.empty((height * width, 3), np.float32)
        for first in range(0, height, _ROWS):
            last = min(first + _ROWS, height)
            across, down = np.meshgrid(np.arange(width) + 0.5, np.arange(first, last) + 0.5)
            rays[first * width : last * width] = self.camera.rays(np.column_stack([across.ravel(), down.ravel()]))
        return rays


def view_rotation(direction: Float64) -> Float64:
    """(3, 3) view from camera: +z along `direction`, +x level, or to the right where it looks straight up or down."""
    forward = direction / np.linalg.norm(direction)
    if abs(forward[1]) < 0.9999:
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
    else:
        right = np.array([1.0, 0.0, 0.0])
        forward = np.array([0.0, np.sign(forward[1]), 0.0])
    return np.stack([right, np.cross(forward, right), forward])


def up_in_camera(photo: PosedImage, up_src: ArrayLike) -> Float64:
    """(3,) the up direction of the plot in a photo's camera frame, for `TileSet.ring`."""
    up: Float64 = photo.cam_from_source.rotation @ np.asarray(up_src, np.float64)
    return up / np.linalg.norm(up)


def sample(picture: NDArray[Any], spots_px: Float, *, wraps: bool) -> Float32:
    """Bilinear values of a picture.

    Args:
        picture: (H, W) or (H, W, C).
        spots_px: (..., 2) continuous pixels; NaN gives 0.
        wraps: Whether left and right are neighbours, and beyond a pole the row on the other side: a panorama.

    Returns:
        (...) or (..., C) float32.
    """
    height, width = picture.shape[:2]
    outside = ~np.isfinite(spots_px).all(axis=-1)
    x = np.where(outside, 0.5, spots_px[..., 0]) - 0.5
    y = np.where(outside, 0.5, spots_px[..., 1]) - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right_share, low_share = (x - left).astype(np.float32), (y - top).astype(np.float32)
    total: Any = 0.0
    for step_down, share_down in ((0, 1.0 - low_share), (1, low_share)):
        for step_right, share_right in ((0, 1.0 - right_share), (1, right_share)):
            row, column = top + step_down, left + step_right
            if wraps:
                beyond = (row < 0) | (row >= height)
                row = np.where(row < 0, -1 - row, np.where(row >= height, 2 * height - 1 - row, row))
                column = (column + np.where(beyond, width // 2, 0)) % width
            row, column = np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)
            weight = share_down * share_right
            values = picture[row, column].astype(np.float32)
            total = total + values * weight.reshape(weight.shape + (1,) * (values.ndim - weight.ndim))
    total[outside] = 0.0
    return np.asarray(total, np.float32)


def _upright(up_cam: Float64) -> Float64:
    """(3, 3) the smallest turn that takes up to -y, which is up in an upright photo."""
    length = float(np.linalg.norm(up_cam))
    if up_cam.shape != (3,) or not np.isfinite(length) or length == 0.0:
        raise ValueError(f"up_cam is {up_cam!r} but a (3,) vector is needed")
    up, wanted = up_cam / length, np.array([0.0, -1.0, 0.0])
    axis, cosine = np.cross(up, wanted), float(up @ wanted)
    if cosine < -1.0 + 1e-9:
        return readonly(np.diag([-1.0, -1.0, 1.0]))
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    # Rodrigues, with sin and cos as the cross and dot product give them.
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + cosine))


def _covered_share(tile: Tile, camera: CameraModel) -> float:
    """Share of the tile that the wide photo shows."""
    if camera.is_panorama:
        return 1.0
    side = (np.arange(32) + 0.5) * tile.size_px / 32.0
    across, down = np.meshgrid(side, side)
    return float(camera.project(tile.rays(np.column_stack([across.ravel(), down.ravel()])))[1].mean())


def _n_samples(tile: Tile, camera: CameraModel) -> int:
    """How many samples per side of a tile's pixel keep a finer photo from aliasing."""
    middle = tile.size_px / 2.0
    uv, _ = camera.project(tile.rays(np.array([[middle - 0.5, middle], [middle + 0.5, middle]])))
    step = float(np.abs(uv[1] - uv[0]).max())
    if camera.is_panorama:
        # Across the seam the difference is the whole width, and near a pole columns crowd: rows tell.
        step = camera.height_px / np.pi / tile.camera.params[0]
    return int(np.clip(np.rint(step), 1, _MOST_SAMPLES)) if np.isfinite(step) else 1
