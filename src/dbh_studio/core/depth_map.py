"""What stands nearest in every direction from a camera, by the cloud itself: which of its points the camera sees.

It is a cube around the camera's centre and not a picture of its lens. Every lens is served by the same code, there is
no seam and no pole, and what stands in front hides what is behind although a distorted lens has no image of it.

A point covers as much as its neighbours are apart. It is put into the level of a pyramid whose pixels have at least
that size where it lies, so a near surface has no holes and every point is written once. The levels are then put
together from coarse to fine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Bool, Float, Float32, Int32, as_points, readonly

_CHUNK = 1 << 18
_N_FACES = 6
# The coarsest pixels are 2⁶ finest ones wide: 14° with 512 pixels to a face.
_MOST_LEVELS = 7


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Distance to the nearest surface in every direction from one place.

    Attributes:
        range_: (6 * size * size,) float32 distances, face by face; infinite where there is nothing.
        size: Pixels along the edge of a face.
    """

    range_: Float32
    size: int

    @classmethod
    def of(cls, from_centre: Float, *, spacing: float, size: int = 512, cover: float = 1.2) -> DepthMap:
        """Of points around a camera.

        Args:
            from_centre: (N, 3) points minus the camera's centre, in any frame that is not turned between making and
                asking. Points at the centre itself are left out.
            spacing: Typical distance between neighbouring points, in the points' unit.
            size: Pixels along the edge of a face; a power of two. 512 makes them 0.22° in the middle of a face, and
                0.11° in its corners.
            cover: How far a point reaches, in spacings. On points thinned to one per cube 1.2 leaves few holes.

        Raises:
            ValueError: Wrong shape, spacing or size.
        """
        points = as_points(from_centre, name="from_centre")
        if not (spacing > 0.0 and np.isfinite(spacing)) or not cover > 0.0:
            raise ValueError(f"the spacing is {spacing} and the cover {cover} but both must be positive")
        if size < 2 or size & (size - 1):
            raise ValueError(f"a face has {size} pixels along its edge but a power of two is needed")
        n_levels = min(_MOST_LEVELS, size.bit_length())
        levels = [np.full(_N_FACES * (size >> k) ** 2, np.inf, np.float32) for k in range(n_levels)]
        for start in range(0, len(points), _CHUNK):
            face, u, v, main = _on_cube(points[start : start + _CHUNK])
            stretch = 1.0 + u * u + v * v
            distance = main * np.sqrt(stretch)
            # A step of one pixel turns the ray least in the corners; there a point covers most pixels.
            with np.errstate(divide="ignore", invalid="ignore"):
                reach = np.float32(0.5 * size * cover * spacing) * stretch / distance
            level = np.zeros(len(face), np.int8)
            for k in range(1, n_levels):
                level += reach > (1 << (k - 1))
            level[~np.isfinite(reach)] = -1
            for k in range(n_levels):
                at = np.flatnonzero(level == k)
                if len(at):
                    pixel = _pixels(face[at], u[at], v[at], size >> k)
                    np.minimum.at(levels[k], pixel, distance[at])
        return cls(readonly(_merged(levels, size)), size)

    def range_at(self, from_centre: Float) -> tuple[Float32, Float32]:
        """(N,) distance of the nearest surface in the direction of each point, and (N,) the point's own distance."""
        points = as_points(from_centre, name="from_centre")
        nearest, own = np.empty(len(points), np.float32), np.empty(len(points), np.float32)
        for start in range(0, len(points), _CHUNK):
            part = slice(start, start + _CHUNK)
            face, u, v, main = _on_cube(points[part])
            nearest[part] = self.range_[_pixels(face, u, v, self.size)]
            own[part] = main * np.sqrt(1.0 + u * u + v * v)
        return nearest, own

    def is_hidden(self, from_centre: Float, *, tolerance: float, tolerance_share: float = 0.0) -> Bool:
        """(N,) whether something stands in front of each point.

        Args:
            from_centre: (N, 3) points minus the centre, turned as when the map was made.
            tolerance: So much nearer a surface may be and still be the point's own, in the points' unit.
            tolerance_share: And by this share of the distance, which poses and clouds are off by.
        """
        nearest, own = self.range_at(from_centre)
        hidden: Bool = own > nearest * np.float32(1.0 + tolerance_share) + np.float32(tolerance)
        return hidden


def _on_cube(points: Float) -> tuple[Int32, Float32, Float32, Float32]:
    """(N,) face, (N,) and (N,) position on it in -1..1, (N,) distance along the face's axis."""
    x, y, z = (points[:, axis].astype(np.float32) for axis in range(3))
    ax, ay, az = np.abs(x), np.abs(y), np.abs(z)
    on_z = (az >= ax) & (az >= ay)
    on_x = ~on_z & (ax >= ay)
    main = np.where(on_z, z, np.where(on_x, x, y))
    # Which way round u and v lie on a face does not matter, as long as it is always the same.
    first, second = np.where(on_x, y, x), np.where(on_z, y, z)
    axis = np.where(on_z, np.int32(2), np.where(on_x, np.int32(0), np.int32(1)))
    face = 2 * axis + (main < 0)
    main = np.abs(main)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(main > 0, np.float32(1.0) / main, np.float32(0.0))
    return face.astype(np.int32), first * scale, second * scale, main


def _pixels(face: Int32, u: Float32, v: Float32, size: int) -> Int32:
    """(N,) flat index into a level."""
    half = np.float32(0.5 * size)
    column = np.minimum(((u + np.float32(1.0)) * half).astype(np.int32), size - 1)
    row = np.minimum(((v + np.float32(1.0)) * half).astype(np.int32), size - 1)
    return (face * np.int32(size) + row) * np.int32(size) + column


def _merged(levels: list[Float32], size: int) -> Float32:
    """The finest level with the coarser ones under it."""
    total = levels[-1].reshape(_N_FACES, size >> (len(levels) - 1), -1)
    for k in range(len(levels) - 2, -1, -1):
        total = np.repeat(np.repeat(total, 2, axis=1), 2, axis=2)
        np.minimum(total, levels[k].reshape(_N_FACES, size >> k, -1), out=total)
    return total.reshape(-1)
