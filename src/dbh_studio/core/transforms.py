"""Rigid motions and similarities, written `target_from_source` so that a wrong product is visible.

Frames: ``source`` (as loaded), ``world`` (metres, +z up, local origin), ``cam`` (OpenCV axes: +x right, +y down, +z
forward), ``section`` (u, v in the plane across a stem, w along it).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float64, readonly


@dataclass(frozen=True, eq=False)
class Similarity:
    """``target = scale * rotation @ source + translation``.

    Attributes:
        rotation: (3, 3) proper rotation.
        translation: (3,) in target units.
        scale: Target units per source unit, positive.
    """

    rotation: Float64
    translation: Float64
    scale: float = 1.0

    def __post_init__(self) -> None:
        rotation = np.asarray(self.rotation, np.float64)
        translation = np.asarray(self.translation, np.float64)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise ValueError(
                f"rotation {rotation.shape} and translation {translation.shape}; (3, 3) and (3,) are needed"
            )
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9) or np.linalg.det(rotation) < 0:
            raise ValueError("rotation is not a proper rotation")
        if not self.scale > 0 or not np.isfinite(self.scale):
            raise ValueError(f"scale is {self.scale} but must be positive")
        object.__setattr__(self, "rotation", readonly(rotation))
        object.__setattr__(self, "translation", readonly(translation))

    @classmethod
    def identity(cls) -> Similarity:
        """The similarity that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    def apply(self, points: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Transform (N, 3) points; float32 in, float32 out."""
        points = np.asarray(points)
        linear = (self.scale * self.rotation).astype(points.dtype)
        return points @ linear.T + self.translation.astype(points.dtype)

    def inverse(self) -> Similarity:
        """The similarity back from target to source."""
        rotation = self.rotation.T
        return Similarity(rotation, -(rotation @ self.translation) / self.scale, 1.0 / self.scale)

    def __matmul__(self, other: Similarity) -> Similarity:
        """``(c_from_b @ b_from_a).apply(p) == c_from_b.apply(b_from_a.apply(p))``."""
        return Similarity(
            self.rotation @ other.rotation,
            self.scale * self.rotation @ other.translation + self.translation,
            self.scale * other.scale,
        )


UP_AXES = ("+z", "-z", "+y", "-y", "+x", "-x")


def rotation_to_z_up(up_axis: str) -> Float64:
    """(3, 3) proper rotation that turns the named source axis (one of `UP_AXES`) into +z.

    Y-up turns as in OpenGL and Metashape exports: x stays, y becomes z, z becomes -y.
    """
    rotations = {
        "+z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
        "+y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
        "+x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
        "-x": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    }
    if up_axis not in rotations:
        raise ValueError(f"up axis {up_axis!r} is none of {', '.join(UP_AXES)}")
    return np.array(rotations[up_axis], np.float64)
