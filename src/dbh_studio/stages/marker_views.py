"""Straight views out of any photo: a marker detector wants straight lines, and a seam or a pole cuts a panorama's."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float, Float64, UInt8
from dbh_studio.core.camera import CameraModel
from dbh_studio.io.marker_codes import opencv
from dbh_studio.stages.marker_fit import view_rotation

_TILE_FOV_DEG = 80.0
_TILE_OVERSAMPLING = 1.4
# Neighbouring tiles overlap by 35° and more: a marker smaller than that lies whole in one of them.
_TILE_ROWS = ((90.0, 1), (45.0, 6), (0.0, 8), (-45.0, 6), (-90.0, 1))
# Wider photos bend straight lines too much for the detector.
_WIDEST_PLAIN_DEG = 55.0

# What `cv2.remap` needs, and the share of the view the photo covers.
_Maps = tuple[NDArray[Any], NDArray[Any], float]


@dataclass(frozen=True, eq=False)
class View:
    """A straight view.

    Attributes:
        rotation: (3, 3) view from camera.
        size_px: It is square.
        focal_px: Pixels per radian in the middle.
    """

    rotation: Float64
    size_px: int
    focal_px: float

    def rays(self, pixels: Float) -> Float64:
        """(N, 3) directions in the camera's frame of (N, 2) view pixels, (0, 0) the outer top-left corner."""
        plane = (pixels - self.size_px / 2) / self.focal_px
        return np.asarray(np.column_stack([plane, np.ones(len(plane))]) @ self.rotation)

    def maps(self, camera: CameraModel) -> _Maps:
        """What `cv2.remap` needs, and the share of the view the photo covers."""
        columns, rows = np.meshgrid(np.arange(self.size_px), np.arange(self.size_px))
        uv, is_seen = camera.project(self.rays(np.column_stack([columns.ravel(), rows.ravel()]) + 0.5))
        spots = np.where(is_seen[:, None], uv - 0.5, -10.0).astype(np.float32).reshape(self.size_px, self.size_px, 2)
        first, second = opencv().convertMaps(spots, None, opencv().CV_16SC2)
        return first, second, float(is_seen.mean())

    def render(self, picture: UInt8, camera: CameraModel) -> UInt8:
        """The view of a picture of that camera."""
        return remap(picture, self.maps(camera), camera)


def remap(picture: UInt8, maps: _Maps, camera: CameraModel) -> UInt8:
    """A view by its maps."""
    cv2 = opencv()
    border = cv2.BORDER_WRAP if camera.is_panorama else cv2.BORDER_CONSTANT
    view: UInt8 = cv2.remap(picture, maps[0], maps[1], cv2.INTER_CUBIC, borderMode=border)
    return view


def pixel_angle(camera: CameraModel, direction: Float64) -> float:
    """Angle of a pixel of the photo, radians, in a direction: the smaller of across and down, NaN outside."""
    uv, _ = camera.project(direction[None])
    steps = np.array([[0.0, 0.0], [0.0, 1.0]]) if camera.is_panorama else np.array([[0.0, 0.0], [1.0, 0.0]])
    a, b = camera.rays(uv + steps)
    return float(np.arccos(np.clip(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)), -1, 1)))


def view_towards(camera: CameraModel, direction: Float64, field_rad: float, oversampling: float = 2.0) -> View:
    """A view centred on a direction, finer than the photo there."""
    field_rad = float(np.clip(field_rad, 0.05, 2.0))
    angle = pixel_angle(camera, direction)
    focal = oversampling / angle if np.isfinite(angle) and angle > 0 else 500.0
    size = 2 * np.tan(field_rad / 2) * focal
    limited = float(np.clip(size, 120, 900))
    return View(view_rotation(direction), int(limited), focal * limited / size)


def needs_tiles(camera: CameraModel) -> bool:
    """Whether the photo is too wide to look for markers in it as it is."""
    if camera.is_panorama:
        return True
    x, y = np.meshgrid([0.0, 0.5, 1.0], [0.0, 0.5, 1.0])
    rays = camera.rays(np.column_stack([x.ravel() * camera.width_px, y.ravel() * camera.height_px]))
    return not bool((rays[:, 2] > np.cos(np.radians(_WIDEST_PLAIN_DEG))).all())


@lru_cache(maxsize=1)
def _tile_maps(camera_key: tuple[str, int, int, tuple[float, ...]]) -> tuple[tuple[int, View, _Maps], ...]:
    """How many columns to turn the picture by, the view, and its maps.

    The tiles of a row of a panorama differ by a turn only and share their maps: these are far larger than the picture.
    """
    camera = CameraModel(*camera_key)
    per_radian = 1.0 / _finest_angle(camera)
    half = np.radians(_TILE_FOV_DEG / 2)
    size = int(2 * np.tan(half) * per_radian * _TILE_OVERSAMPLING / 8) * 8
    tiles = []
    for pitch_deg, count in _TILE_ROWS:
        shared: _Maps | None = None
        for number in range(count):
            columns = round(number * camera.width_px / count)
            yaw = 2 * np.pi * (columns / camera.width_px if camera.is_panorama else number / count)
            level = np.cos(np.radians(pitch_deg))
            direction = np.array([level * np.sin(yaw), -np.sin(np.radians(pitch_deg)), level * np.cos(yaw)])
            view = View(view_rotation(direction), size, size / (2 * np.tan(half)))
            maps = view.maps(camera) if shared is None else shared
            if camera.is_panorama:
                shared = maps
            if maps[2] > 0.1:
                tiles.append((columns if camera.is_panorama else 0, view, maps))
    return tuple(tiles)


def _finest_angle(camera: CameraModel) -> float:
    if camera.is_panorama:
        return 2 * np.pi / camera.width_px
    middle = camera.rays(np.array([[camera.width_px / 2, camera.height_px / 2]]))[0]
    return pixel_angle(camera, middle)


def tiles_of(picture: UInt8, camera: CameraModel) -> Iterator[tuple[View, UInt8]]:
    """Straight views that cover a wide photo, with overlap, the poles and the seam of a panorama included."""
    for columns, view, maps in _tile_maps((camera.kind, camera.width_px, camera.height_px, camera.params)):
        turned = np.roll(picture, -columns, axis=1) if columns else picture
        yield view, remap(turned, maps, camera)
