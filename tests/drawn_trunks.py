"""Pictures of brown cylinders on a green floor under a blue sky, of which every pixel's trunk is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.core.transforms import Similarity
from dbh_studio.stages.trunk_prompts import TrunkShape

BROWN, GREEN, BLUE = (92, 66, 43), (60, 120, 50), (150, 180, 210)
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
EYE_M, TOP_M = 1.6, 6.0


@dataclass(frozen=True)
class Stand:
    """Vertical cylinders: x, y, radius of each; the photo is taken at the origin, `EYE_M` above the floor."""

    trunks: tuple[tuple[float, float, float], ...]

    def photo(self, camera: CameraModel, turn: np.ndarray | None = None) -> PosedImage:
        """Looking along +y, or turned by a rotation of the camera's frame."""
        rotation = LEVEL if turn is None else turn @ LEVEL
        return PosedImage("photo.jpg", camera, Similarity(rotation, -rotation @ [0.0, 0.0, EYE_M]))

    def draw(self, photo: PosedImage) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, 3) uint8 and (H, W) which trunk, 1 for the first, 0 for none."""
        height, width = photo.camera.height_px, photo.camera.width_px
        across, down = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        _, rays = photo.ray(np.column_stack([across.ravel(), down.ravel()]))
        picture = np.where(rays[:, 2:] < 0, GREEN, BLUE).astype(np.uint8)
        nearest, truth = np.full(len(rays), np.inf), np.zeros(len(rays), np.int64)
        for number, (x, y, radius) in enumerate(self.trunks, start=1):
            a = rays[:, 0] ** 2 + rays[:, 1] ** 2
            b = rays[:, 0] * x + rays[:, 1] * y
            disc = b * b - a * (x * x + y * y - radius * radius)
            t = (b - np.sqrt(np.maximum(disc, 0))) / np.maximum(a, 1e-12)
            z = EYE_M + t * rays[:, 2]
            hit = (disc > 0) & (t > 0) & (t < nearest) & (z > 0) & (z < TOP_M)
            nearest[hit], truth[hit] = t[hit], number
        picture[truth > 0] = BROWN
        return picture.reshape(height, width, 3), truth.reshape(height, width)

    def shapes(self) -> list[TrunkShape]:
        """The trunks as geometry would give them, with ids from 11."""
        return [
            TrunkShape.cylinder(11 + i, (x, y, 0.3), (x, y, 4.0), radius)
            for i, (x, y, radius) in enumerate(self.trunks)
        ]


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Overlap of two masks."""
    return float(np.count_nonzero(a & b) / max(np.count_nonzero(a | b), 1))
