"""How a photo is looked at: exactly which pixel of the photo each pixel of the view shows, and back.

A view is `width_px` x `height_px` pixels; (0, 0) is its outer top-left corner, +x right, +y down, as in `core.camera`.
`zoom` is how many pixels of the view one pixel of the photo takes, in the middle of the view.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dbh_studio.core.arrays import Bool, Float32, Float64, as_points
from dbh_studio.core.camera import CameraModel

# Beyond it a pixel of the photo is a tile, and its middle is hit by anybody.
MOST_ZOOM = 12.0
_WIDEST_RAD, _STEEPEST_RAD = np.deg2rad(110.0), np.deg2rad(89.0)
_FIRST_RAD = np.deg2rad(85.0)


Reach = tuple[tuple[tuple[float, float], ...], tuple[float, float]]
"""((u from, u to), …), (v from, v to): parts of a photo side by side, in its pixels; two at the seam."""


class Look(ABC):
    """One view of one photo; immutable."""

    camera: CameraModel
    width_px: int
    height_px: int

    @property
    @abstractmethod
    def zoom(self) -> float:
        """Pixels of the view for one of the photo, in the middle of the view."""

    @abstractmethod
    def photo_from_view(self, xy_px: ArrayLike) -> Float64:
        """(N, 2) pixels of the photo shown at (N, 2) pixels of the view; NaN where it shows none."""

    @abstractmethod
    def view_from_photo(self, uv_px: ArrayLike) -> tuple[Float64, Bool]:
        """(N, 2) pixels of the view where (N, 2) pixels of the photo appear, and (N,) whether inside the view."""

    @abstractmethod
    def panned(self, from_xy: tuple[float, float], to_xy: tuple[float, float]) -> Look:
        """Dragged: what was at `from_xy` is at `to_xy`, as far as the limits allow."""

    @abstractmethod
    def with_zoom(self, zoom: float) -> Look:
        """As near as this, within the limits, about the middle."""

    @abstractmethod
    def centred_on(self, uv_px: tuple[float, float]) -> Look:
        """With this pixel of the photo in the middle, as far as the limits allow."""

    @abstractmethod
    def resized(self, width_px: int, height_px: int) -> Look:
        """The same look in a view of another size."""

    @abstractmethod
    def finer(self, factor: float) -> Look:
        """The same part of the photo in a view with so many times the pixels each way."""

    def zoomed(self, factor: float, at_xy: tuple[float, float]) -> Look:
        """Nearer or farther; what is at `at_xy` stays there, as far as the limits allow."""
        nearer = self.with_zoom(self.zoom * factor)
        shown = self.photo_from_view(np.array([at_xy]))
        xy, _ = nearer.view_from_photo(shown)
        if not np.isfinite(xy).all():
            return nearer
        return nearer.panned((float(xy[0, 0]), float(xy[0, 1])), at_xy)

    @abstractmethod
    def maps(self) -> tuple[Float32, Float32]:
        """(height, width) float32 each: the pixel of the photo that the middle of each pixel of the view shows.

        For the picture, in a few milliseconds and to a hundredth of a pixel; beside the photo they lie outside of it.
        """

    @abstractmethod
    def reach(self, outline_xy: ArrayLike) -> Reach:
        """Where in the photo everything lies that is shown within an outline; what is returned may be too much.

        Args:
            outline_xy: (K, 2) corners of a convex outline, pixels of the view.
        """

    def _inside(self, xy_px: Float64) -> Bool:
        with np.errstate(invalid="ignore"):
            inside: Bool = np.all((xy_px >= 0.0) & (xy_px <= (self.width_px, self.height_px)), axis=1)
        return inside


@dataclass(frozen=True, eq=False)
class FlatLook(Look):
    """A photo as it is: moved, enlarged, and turned by quarters so that up is up.

    Attributes:
        camera: Of the photo; a perspective one or a fisheye.
        width_px: Of the view.
        height_px: Of the view.
        scale: Pixels of the view for one of the photo.
        middle_px: The pixel of the photo in the middle.
        quarter_turns: How often the picture is turned clockwise by 90 degrees.
    """

    camera: CameraModel
    width_px: int
    height_px: int
    scale: float
    middle_px: tuple[float, float]
    quarter_turns: int = 0

    @classmethod
    def whole(cls, camera: CameraModel, width_px: int, height_px: int, up_cam: ArrayLike) -> FlatLook:
        """The whole photo, with the side up that `up_cam`, (3,) in the camera's frame, points to."""
        x, y, z = (float(value) for value in np.asarray(up_cam, np.float64))
        # Looking straight up or down no side is up, and the photo stays as it was taken.
        turns = 0 if abs(z) > 0.7 * np.sqrt(x * x + y * y + z * z) else round(np.arctan2(-x, -y) / (np.pi / 2)) % 4
        look = cls(camera, width_px, height_px, 1.0, (camera.width_px / 2, camera.height_px / 2), turns)
        return replace(look, scale=look._least())

    @property
    def zoom(self) -> float:
        """As `scale`."""
        return self.scale

    def photo_from_view(self, xy_px: ArrayLike) -> Float64:
        """See `Look`."""
        xy = as_points(xy_px, name="xy_px", n_columns=2).astype(np.float64)
        uv = (xy - self._view_middle()) @ self._turn() / self.scale + self.middle_px
        uv[~np.all((uv >= 0.0) & (uv <= (self.camera.width_px, self.camera.height_px)), axis=1)] = np.nan
        return uv

    def view_from_photo(self, uv_px: ArrayLike) -> tuple[Float64, Bool]:
        """See `Look`."""
        uv = as_points(uv_px, name="uv_px", n_columns=2).astype(np.float64)
        xy = self.scale * (uv - self.middle_px) @ self._turn().T + self._view_middle()
        return xy, self._inside(xy)

    def maps(self) -> tuple[Float32, Float32]:
        """See `Look`."""
        (xx, xy), (yx, yy) = self._turn() / self.scale
        x = np.arange(self.width_px)[None, :] + 0.5 - self.width_px / 2
        y = np.arange(self.height_px)[:, None] + 0.5 - self.height_px / 2
        u, v = x * xx + y * yx + self.middle_px[0], x * xy + y * yy + self.middle_px[1]
        return u.astype(np.float32), v.astype(np.float32)

    def reach(self, outline_xy: ArrayLike) -> Reach:
        """See `Look`."""
        xy = as_points(outline_xy, name="outline_xy", n_columns=2).astype(np.float64)
        uv = (xy - self._view_middle()) @ self._turn() / self.scale + self.middle_px
        (u0, v0), (u1, v1) = uv.min(axis=0), uv.max(axis=0)
        return ((float(u0), float(u1)),), (float(v0), float(v1))

    def panned(self, from_xy: tuple[float, float], to_xy: tuple[float, float]) -> FlatLook:
        """See `Look`."""
        step = (np.array(from_xy) - np.array(to_xy)) @ self._turn() / self.scale
        return self._at(np.array(self.middle_px) + step)

    def with_zoom(self, zoom: float) -> FlatLook:
        """See `Look`."""
        least = self._least()
        return replace(self, scale=float(np.clip(zoom, least, max(MOST_ZOOM, least))))._at(np.array(self.middle_px))

    def centred_on(self, uv_px: tuple[float, float]) -> FlatLook:
        """See `Look`."""
        return self._at(np.array(uv_px, np.float64))

    def resized(self, width_px: int, height_px: int) -> FlatLook:
        """See `Look`."""
        is_whole = self.scale <= self._least() * 1.001
        look = replace(self, width_px=width_px, height_px=height_px)
        return look.with_zoom(look._least() if is_whole else self.scale)

    def finer(self, factor: float) -> FlatLook:
        """See `Look`."""
        width, height = round(self.width_px * factor), round(self.height_px * factor)
        return replace(self, width_px=width, height_px=height, scale=self.scale * width / self.width_px)

    def _at(self, middle: Float64) -> FlatLook:
        """The middle of the view stays on the photo; a photo smaller than the view stays in the middle of it."""
        size = np.array([self.camera.width_px, self.camera.height_px], np.float64)
        view = np.abs(np.array([self.width_px, self.height_px]) @ self._turn()) / self.scale
        # The border may come to the middle, so that a corner at the border can be hit.
        margin = np.where(view < 0.999 * size, 0.0, size / 2)
        middle = np.clip(middle, margin, size - margin)
        return replace(self, middle_px=(float(middle[0]), float(middle[1])))

    def _least(self) -> float:
        """The scale at which the whole photo is seen."""
        width, height = self.camera.width_px, self.camera.height_px
        if self.quarter_turns % 2:
            width, height = height, width
        return min(self.width_px / width, self.height_px / height)

    def _turn(self) -> Float64:
        """(2, 2) from directions in the photo to directions in the view: clockwise, y down."""
        turns = ([[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]])
        return np.array(turns[self.quarter_turns % 4], np.float64)

    def _view_middle(self) -> Float64:
        return np.array([self.width_px / 2, self.height_px / 2])


@dataclass(frozen=True, eq=False)
class PanoramaLook(Look):
    """A straight view out of a panorama, upright in the plot.

    Attributes:
        camera: Of the panorama.
        width_px: Of the view.
        height_px: Of the view.
        up_cam: (3,) where the plot's up is, in the camera's frame.
        yaw_rad: To the right of the middle of the panorama.
        pitch_rad: Above the horizon.
        fov_rad: Horizontal field of view.
    """

    camera: CameraModel
    width_px: int
    height_px: int
    up_cam: tuple[float, float, float] = (0.0, -1.0, 0.0)
    yaw_rad: float = 0.0
    pitch_rad: float = 0.0
    fov_rad: float = float(_FIRST_RAD)

    @property
    def zoom(self) -> float:
        """See `Look`."""
        return self._focal_px() / self._photo_px_per_rad()

    def rays(self, xy_px: ArrayLike) -> Float64:
        """(N, 3) unit directions in the camera's frame, of (N, 2) pixels of the view."""
        xy = as_points(xy_px, name="xy_px", n_columns=2).astype(np.float64)
        return self._level(xy, self.pitch_rad, self.yaw_rad) @ self._cam_from_level().T

    def photo_from_view(self, xy_px: ArrayLike) -> Float64:
        """See `Look`."""
        return self.camera.project(self.rays(xy_px))[0]

    def view_from_photo(self, uv_px: ArrayLike) -> tuple[Float64, Bool]:
        """See `Look`."""
        level = self.camera.rays(uv_px) @ self._cam_from_level()
        x, y, z = (level @ _turned(self.pitch_rad, self.yaw_rad)).T
        with np.errstate(all="ignore"):
            xy = np.stack([x / z, y / z], axis=1) * self._focal_px()
        xy += (self.width_px / 2, self.height_px / 2)
        xy[~(z > 1e-6)] = np.nan
        return xy, self._inside(xy)

    def maps(self) -> tuple[Float32, Float32]:
        """See `Look`; as `CameraModel.project` for a panorama, in half the precision and without a matrix product."""
        axes = (self._cam_from_level() @ _turned(self.pitch_rad, self.yaw_rad)).astype(np.float32)
        across = (np.arange(self.width_px, dtype=np.float32)[None, :] + 0.5 - self.width_px / 2).astype(np.float32)
        down = (np.arange(self.height_px, dtype=np.float32)[:, None] + 0.5 - self.height_px / 2).astype(np.float32)
        focal = np.float32(self._focal_px())
        x, y, z = (across * row[0] + down * row[1] + focal * row[2] for row in axes)
        width, height = self.camera.params
        u = np.float32(width) * (np.arctan2(x, z) / np.float32(2 * np.pi) + np.float32(0.5))
        v = np.float32(height) * (np.arctan2(y, np.hypot(x, z)) / np.float32(np.pi) + np.float32(0.5))
        return u, v

    def reach(self, outline_xy: ArrayLike) -> Reach:
        """See `Look`: the cap of the sphere about the outline, widest in longitude where it touches a meridian."""
        rays = self.rays(outline_xy)
        axis = rays.mean(axis=0)
        axis /= np.linalg.norm(axis)
        # What is convex in a straight view is so on the sphere: its corners are the farthest.
        angle = float(np.arccos(np.clip((rays @ axis).min(), -1.0, 1.0))) + 1e-6
        x, y, z = (float(value) for value in axis)
        down = float(np.arctan2(y, np.hypot(x, z)))
        width, height = self.camera.params
        v0, v1 = (height * (side / np.pi + 0.5) for side in (down - angle, down + angle))
        if abs(down) + angle >= np.pi / 2:  # a pole is in it
            return ((0.0, float(width)),), (max(v0, 0.0), min(v1, float(height)))
        half = width * float(np.arcsin(min(np.sin(angle) / np.cos(down), 1.0))) / (2 * np.pi)
        u = width * (float(np.arctan2(x, z)) / (2 * np.pi) + 0.5)
        if 2 * half >= width:
            return ((0.0, float(width)),), (v0, v1)
        u0, u1 = u - half, u + half
        if u0 < 0.0:
            return ((0.0, u1), (u0 + width, float(width))), (v0, v1)
        if u1 > width:
            return ((0.0, u1 - width), (u0, float(width))), (v0, v1)
        return ((u0, u1),), (v0, v1)

    def panned(self, from_xy: tuple[float, float], to_xy: tuple[float, float]) -> PanoramaLook:
        """See `Look`."""
        held = self._level(np.array([from_xy]), self.pitch_rad, self.yaw_rad)[0]
        # Where the pitch brings the ray at `to_xy` to the height of what is held: c sin p - b cos p = height.
        _, b, c = self._level(np.array([to_xy]), 0.0, 0.0)[0]
        height = float(np.clip(-held[1] / np.hypot(b, c), -1.0, 1.0))
        pitch = float(np.clip(np.arcsin(height) + np.arctan2(b, c), -_STEEPEST_RAD, _STEEPEST_RAD))
        there = self._level(np.array([to_xy]), pitch, 0.0)[0]
        yaw = float(np.arctan2(held[0], held[2]) - np.arctan2(there[0], there[2]))
        return replace(self, pitch_rad=pitch, yaw_rad=float(np.arctan2(np.sin(yaw), np.cos(yaw))))

    def with_zoom(self, zoom: float) -> PanoramaLook:
        """See `Look`."""
        focal = max(zoom, 1e-6) * self._photo_px_per_rad()
        narrowest = 2 * np.arctan(self.width_px / 2 / (MOST_ZOOM * self._photo_px_per_rad()))
        fov = float(np.clip(2 * np.arctan(self.width_px / 2 / focal), min(narrowest, _WIDEST_RAD), _WIDEST_RAD))
        return replace(self, fov_rad=fov)

    def centred_on(self, uv_px: tuple[float, float]) -> PanoramaLook:
        """See `Look`."""
        return self.looking_along(self.camera.rays(np.array([uv_px]))[0])

    def looking_along(self, direction_cam: ArrayLike) -> PanoramaLook:
        """Towards a (3,) direction in the camera's frame; unchanged where it is none."""
        level = np.asarray(direction_cam, np.float64) @ self._cam_from_level()
        if not np.isfinite(level).all() or not np.any(level):
            return self
        pitch = np.clip(np.arctan2(-level[1], np.hypot(level[0], level[2])), -_STEEPEST_RAD, _STEEPEST_RAD)
        return replace(self, pitch_rad=float(pitch), yaw_rad=float(np.arctan2(level[0], level[2])))

    def resized(self, width_px: int, height_px: int) -> PanoramaLook:
        """See `Look`."""
        return replace(self, width_px=width_px, height_px=height_px)

    def finer(self, factor: float) -> PanoramaLook:
        """See `Look`."""
        return replace(self, width_px=round(self.width_px * factor), height_px=round(self.height_px * factor))

    def _focal_px(self) -> float:
        return self.width_px / 2 / float(np.tan(self.fov_rad / 2))

    def _photo_px_per_rad(self) -> float:
        return self.camera.width_px / (2 * np.pi)

    def _level(self, xy: Float64, pitch_rad: float, yaw_rad: float) -> Float64:
        """(N, 3) unit directions in the level frame: +x right, +y down, +z to the panorama's middle on the horizon."""
        middle = np.array([self.width_px / 2, self.height_px / 2])
        rays = np.column_stack([(xy - middle) / self._focal_px(), np.ones(len(xy))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        turned: Float64 = rays @ _turned(pitch_rad, yaw_rad).T
        return turned

    def _cam_from_level(self) -> Float64:
        """(3, 3) whose columns are the level frame's axes in the camera's frame."""
        down = -np.asarray(self.up_cam, np.float64)
        down /= np.linalg.norm(down)
        forward: Any = np.array([0.0, 0.0, 1.0]) - down[2] * down
        if np.linalg.norm(forward) < 1e-3:  # the middle of the panorama is the zenith or the nadir
            forward = np.array([1.0, 0.0, 0.0]) - down[0] * down
        forward = forward / np.linalg.norm(forward)
        return np.column_stack([np.cross(down, forward), down, forward])


def _turned(pitch_rad: float, yaw_rad: float) -> Float64:
    """(3, 3) from the view to the level frame: up by the pitch, then right by the yaw."""
    sp, cp, sy, cy = np.sin(pitch_rad), np.cos(pitch_rad), np.sin(yaw_rad), np.cos(yaw_rad)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    turned: Float64 = about_y @ about_x
    return turned


def first_look(camera: CameraModel, width_px: int, height_px: int, up_cam: ArrayLike) -> Look:
    """How a photo is shown at first: a panorama towards its middle, any other whole.

    Args:
        camera: Of the photo.
        width_px: Of the view.
        height_px: Of the view.
        up_cam: (3,) where the plot's up is, in the camera's frame.
    """
    if not camera.is_panorama:
        return FlatLook.whole(camera, width_px, height_px, up_cam)
    x, y, z = (float(value) for value in np.asarray(up_cam, np.float64))
    return PanoramaLook(camera, width_px, height_px, (x, y, z))
