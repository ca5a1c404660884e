"""Round stems on level ground seen by cameras of any kind and pose: points, and photos whose stems have a colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tests import maskplot

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.core.stem_line import StemLine
from dbh_studio.core.transforms import Similarity

BROWN, GREEN = (92, 66, 43), (90, 120, 80)
PANORAMA = CameraModel("EQUIRECTANGULAR", 2048, 1024, ())
PERSPECTIVE = CameraModel("OPENCV", 1600, 1200, (900.0, 905.0, 810.0, 590.0, -0.08, 0.02, 0.001, -0.001))
PORTRAIT = CameraModel("PINHOLE", 1200, 1600, (1000.0, 1000.0, 600.0, 800.0))
FISHEYE = CameraModel("OPENCV_FISHEYE", 1400, 1400, (420.0, 420.0, 700.0, 700.0, 0.02, -0.004, 0.0, 0.0))
# Camera axes (+x right, +y down, +z forward) of a level camera that looks along +y.
_LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class Stem:
    """An upright round stem; z of the ground is 0."""

    x: float
    y: float
    diameter: float
    height: float = 6.0

    @property
    def line(self) -> StemLine:
        return StemLine(np.array([self.x, self.y, 1.3]), np.array([0.0, 0.0, 1.0]), self.diameter / 2, 0.2, 2.6)

    def ring(self, n: int = 90, z: float = 1.3) -> np.ndarray:
        angle = np.arange(n) * 2 * np.pi / n
        flat = self.diameter / 2 * np.column_stack([np.cos(angle), np.sin(angle)]) + [self.x, self.y]
        return np.column_stack([flat, np.full(n, z)])

    def points(self, spacing: float = 0.02) -> np.ndarray:
        around = int(np.ceil(np.pi * self.diameter / spacing))
        heights = np.arange(0.0, self.height, spacing)
        angle, z = np.meshgrid(np.arange(around) * 2 * np.pi / around, heights)
        radius = self.diameter / 2
        return np.c_[self.x + radius * np.cos(angle.ravel()), self.y + radius * np.sin(angle.ravel()), z.ravel()]


def turned(yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> np.ndarray:
    """(3, 3) camera from world: looks `yaw` to the right of +y, `pitch` above the horizon, rolled clockwise."""
    yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
    about_z = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
    about_x = np.array([[1.0, 0, 0], [0, np.cos(pitch), np.sin(pitch)], [0, -np.sin(pitch), np.cos(pitch)]])
    about_axis = np.array([[np.cos(roll), np.sin(roll), 0], [-np.sin(roll), np.cos(roll), 0], [0, 0, 1.0]])
    return about_axis @ about_x @ _LEVEL @ about_z


def photo(
    name: str, camera: CameraModel, place: Sequence[float], rotation: np.ndarray, path: str | None = None
) -> PosedImage:
    return PosedImage(name, camera, Similarity(rotation, -(rotation @ np.array(place, float))), path)


def facing(name: str, camera: CameraModel, place: Sequence[float], at: Stem, **turn: float) -> PosedImage:
    """A photo that looks at a stem, more or less."""
    away = np.array([at.x, at.y]) - np.array(place[:2], float)
    yaw = float(np.degrees(np.arctan2(away[0], away[1])))
    return photo(name, camera, place, turned(yaw_deg=yaw + turn.pop("aside_deg", 0.0), **turn))


def picture(photo: PosedImage, stems: Sequence[Stem]) -> np.ndarray:
    """(H, W, 3) uint8 of the first stem in brown, the others in grey, on green; black where the lens shows nothing."""
    camera = photo.camera
    across, down = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    origin, rays = photo.ray(np.column_stack([across.ravel(), down.ravel()]))
    seen = np.isfinite(rays).all(axis=1)
    colour = np.where(seen[:, None], np.array(GREEN), 0).astype(np.uint8)
    nearest = np.full(len(rays), np.inf)
    for number, stem in enumerate(stems):
        to = origin[:2] - [stem.x, stem.y]
        with np.errstate(invalid="ignore", divide="ignore"):
            a, b = (rays[:, :2] ** 2).sum(axis=1), rays[:, :2] @ to
            t = (-b - np.sqrt(b * b - a * (to @ to - stem.diameter**2 / 4))) / a
            z = origin[2] + t * rays[:, 2]
            hit = (t > 0) & (t < nearest) & (z >= 0.0) & (z <= stem.height)
        colour[hit] = BROWN if number == 0 else (120, 120, 120)
        nearest[hit] = t[hit]
    return colour.reshape(camera.height_px, camera.width_px, 3)


def is_brown(picture: np.ndarray) -> np.ndarray:
    """(H, W) nearer to the brown of the stem than to the green around it, and to nothing else."""
    offset = picture.astype(int) - np.array(BROWN)
    return np.abs(offset).max(axis=2) < 25


def is_ring(drawn: np.ndarray) -> np.ndarray:
    """(H, W) where the ring was drawn."""
    red, green, blue = (drawn[:, :, k].astype(int) for k in range(3))
    return (red > 190) & (green > 150) & (blue < 110)


def write_plot(folder: Path, *, unit_m: float = 1.0) -> maskplot.MaskPlot:
    """The plot of `maskplot` with its stems brown in the photos."""
    from PIL import Image

    made = maskplot.write_mask_plot(folder, unit_m=unit_m)
    for name, labels in maskplot.labels().items():
        colours = np.where(labels[:, :, None] > 0, BROWN, GREEN).astype(np.uint8)
        Image.fromarray(colours).save(folder / "images" / name, quality=95)
    return made
