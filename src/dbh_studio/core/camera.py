"""Cameras: from a point in front of one to a pixel, and from a pixel back to a direction.

Frame `cam` as in `transforms`: +x right, +y down, +z forward. Pixels are continuous: (0, 0) is the outer top-left
corner of the image, the centre of the first pixel is (0.5, 0.5). OpenCV's coordinates are 0.5 less.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from dbh_studio.core.arrays import Bool, Float64, as_points
from dbh_studio.core.camera_models.inverse import BoundDistortion, DistortionDomain
from dbh_studio.core.camera_models.lenses import LENSES, Array, Lens

CAMERA_KINDS = tuple(LENSES)
_CHUNK = 1 << 18
_IN_PIXELS_X = frozenset({"fx", "cx", "w", "b1", "b2"})
_IN_PIXELS_Y = frozenset({"fy", "cy", "h"})
_STRAIGHT = frozenset({"f", "fx", "fy", "cx", "cy", "b1", "b2"})


@dataclass(frozen=True, eq=False)
class CameraModel:
    """One camera: its lens and the size of its images.

    Attributes:
        kind: One of `CAMERA_KINDS`: COLMAP's names, and METASHAPE_… and OPENSFM_… for what COLMAP has not.
        width_px: Width of the images.
        height_px: Height of the images.
        params: As `param_names` says, in pixels of these images; EQUIRECTANGULAR may leave its w and h out.
    """

    kind: str
    width_px: int
    height_px: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.kind not in LENSES:
            raise ValueError(f"camera kind {self.kind!r} is none of {', '.join(CAMERA_KINDS)}")
        if not (self.width_px > 0 and self.height_px > 0):
            raise ValueError(f"the image is {self.width_px} x {self.height_px} pixels but must have some")
        params = tuple(float(value) for value in self.params)
        if self.is_panorama and not params:
            params = (float(self.width_px), float(self.height_px))
        names = LENSES[self.kind].names
        if len(params) != len(names):
            raise ValueError(f"{self.kind} has {len(params)} parameters but needs {len(names)}: {' '.join(names)}")
        if not np.isfinite(params).all():
            raise ValueError(f"{self.kind} has a parameter that is not a finite number: {params}")
        object.__setattr__(self, "params", params)
        sizes = [self._value(name, 1.0) for name in ("f", "fx", "fy", "w", "h")]
        if min(sizes) <= 0.0 or abs(np.linalg.det(self._affine[0])) < 1e-12:
            raise ValueError(f"{self.kind} has a focal length or size that is not positive: {params}")

    @property
    def is_panorama(self) -> bool:
        """Whether the image shows the whole sphere (equirectangular)."""
        return self._lens.plane == "equirectangular"

    @property
    def param_names(self) -> tuple[str, ...]:
        """What `params` are."""
        return self._lens.names

    def project(self, points_cam: ArrayLike) -> tuple[Float64, Bool]:
        """Where points appear.

        Args:
            points_cam: (N, 3) in the camera's frame, any unit.

        Returns:
            uv_px: (N, 2); NaN where the lens has no image of the point (behind a perspective camera).
            is_visible: (N,) whether the point is in the field of view and inside the image.
        """
        points = as_points(points_cam, name="points_cam")
        uv_px = np.empty((len(points), 2))
        is_visible = np.empty(len(points), bool)
        for part in _chunks(len(points)):
            uv_px[part], is_visible[part] = self._project(points[part].astype(np.float64))
        return uv_px, is_visible

    def rays(self, uv_px: ArrayLike) -> Float64:
        """The direction each pixel looks in.

        Args:
            uv_px: (N, 2); may lie outside the image.

        Returns:
            (N, 3) unit vectors in the camera's frame; NaN where the lens has none for this pixel.
        """
        pixels = as_points(uv_px, name="uv_px", n_columns=2)
        rays = np.empty((len(pixels), 3))
        for part in _chunks(len(pixels)):
            rays[part] = self._rays(pixels[part].astype(np.float64))
        return rays

    def scaled_to(self, width_px: int, height_px: int) -> CameraModel:
        """The same lens for images of another size.

        Raises:
            ValueError: The other size has another aspect: it is a crop or another photo, not a resized one.
        """
        if not self.has_aspect_of(width_px, height_px):
            raise ValueError(
                f"images of {width_px} x {height_px} are no resized ones of {self.width_px} x {self.height_px}"
            )
        x, y = width_px / self.width_px, height_px / self.height_px
        factors = [
            x if name in _IN_PIXELS_X else y if name in _IN_PIXELS_Y else 0.5 * (x + y) if name == "f" else 1.0
            for name in self.param_names
        ]
        params = tuple(value * factor for value, factor in zip(self.params, factors, strict=True))
        return CameraModel(self.kind, int(width_px), int(height_px), params)

    def has_aspect_of(self, width_px: int, height_px: int) -> bool:
        """Whether an image of this size can be a resized one of this camera: the sides agree to a pixel's rounding."""
        if width_px <= 0 or height_px <= 0:
            return False
        (w, h), (wide, high) = sorted([(width_px, height_px), (self.width_px, self.height_px)])
        # The smaller image's sides were rounded to whole pixels: is there one factor that gives both?
        return max((w - 1) / wide, (h - 1) / high) <= min((w + 1) / wide, (h + 1) / high)

    @property
    def _lens(self) -> Lens:
        return LENSES[self.kind]

    def _value(self, name: str, default: float = 0.0) -> float:
        names = self.param_names
        return self.params[names.index(name)] if name in names else default

    @cached_property
    def _affine(self) -> tuple[Float64, Float64]:
        """(2, 2) and (2,): from the distorted plane to pixels."""
        f = self._value("f", 1.0)
        matrix = np.array(
            [[self._value("fx", f) + self._value("b1"), self._value("b2")], [0.0, self._value("fy", f)]], np.float64
        )
        centre = np.array([self._value("cx"), self._value("cy")])
        if self._lens.centre_is_offset:
            centre += np.array([self.width_px, self.height_px]) / 2.0
        return matrix, centre

    @cached_property
    def _distort(self) -> BoundDistortion | None:
        distort = self._lens.distort
        coefficients = dict(zip(self.param_names, self.params, strict=True))
        # Coefficients of zero bend nothing, except that a dual lens mixes in a fisheye then.
        is_straight = self.kind != "OPENSFM_DUAL" and not any(
            value for name, value in coefficients.items() if name not in _STRAIGHT
        )
        if distort is None or is_straight:
            return None

        def bound(u: Array, v: Array) -> tuple[Array, Array]:
            return distort(u, v, coefficients)

        return bound

    @cached_property
    def _domain(self) -> DistortionDomain | None:
        if self._distort is None:
            return None
        limit = {"equidistant": np.pi, "equisolid": 2.0}.get(self._lens.plane)
        radii = np.linspace(0.0, limit, 2048) if limit else np.concatenate([[0.0], np.geomspace(1e-3, 1e6, 2048)])
        return DistortionDomain.of(self._distort, radii)

    def __getstate__(self) -> dict[str, object]:
        # What is remembered holds a closure, which cannot be sent to another process.
        return {name: getattr(self, name) for name in ("kind", "width_px", "height_px", "params")}

    def _project(self, points: Float64) -> tuple[Float64, Bool]:
        if self.is_panorama:
            return self._project_panorama(points)
        x, y, z = points.T
        plane_u, plane_v, in_view = self._to_plane(x, y, z)
        if self._distort is not None and self._domain is not None:
            in_view = in_view & (np.hypot(plane_u, plane_v) <= self._domain.fold_radius)
            with np.errstate(all="ignore"):
                plane_u, plane_v = self._distort(plane_u, plane_v)
        matrix, centre = self._affine
        uv_px = np.stack([plane_u, plane_v], axis=1) @ matrix.T + centre
        return uv_px, in_view & self._is_inside(uv_px)

    def _is_inside(self, uv_px: Float64) -> Bool:
        with np.errstate(invalid="ignore"):
            inside: Bool = np.all((uv_px >= 0.0) & (uv_px <= (self.width_px, self.height_px)), axis=1)
        return inside

    def _to_plane(self, x: Float64, y: Float64, z: Float64) -> tuple[Float64, Float64, Bool]:
        """Undistorted plane coordinates; NaN where there are none."""
        rho = np.hypot(x, y)
        plane = self._lens.plane
        with np.errstate(all="ignore"):
            if plane == "perspective":
                in_view = z > 1e-12 * rho
                factor = 1.0 / z
            elif plane == "division":
                disc = z * z - 4.0 * rho * rho * self._value("k")
                denominator = z + np.sqrt(disc)
                in_view = denominator > 0.0
                factor = 2.0 / denominator
            elif plane == "eucm":
                factor, in_view = self._eucm_factor(rho, z)
            else:
                angle = np.arctan2(rho, z)
                radius = angle if plane == "equidistant" else 2.0 * np.sin(angle / 2.0)
                factor = np.where(rho > 0.0, radius / rho, 1.0 / z)
                in_view = (rho > 0.0) | (z > 0.0)
            factor = np.where(in_view, factor, np.nan)
        return x * factor, y * factor, in_view

    def _eucm_factor(self, rho: Float64, z: Float64) -> tuple[Float64, Bool]:
        """Khomutenko, Garcia and Martinet 2016, with their bound on the field of view."""
        alpha, beta = self._value("alpha"), self._value("beta")
        distance = np.sqrt(beta * rho * rho + z * z)
        denominator = alpha * distance + (1.0 - alpha) * z
        bound = (1.0 - alpha) / alpha if alpha > 0.5 else alpha / (1.0 - alpha)
        return 1.0 / denominator, (denominator > 1e-12 * distance) & (z > -bound * distance)

    def _project_panorama(self, points: Float64) -> tuple[Float64, Bool]:
        x, y, z = points.T
        width, height = self.params
        horizontal = np.hypot(x, z)
        azimuth, elevation = np.arctan2(x, z), np.arctan2(-y, horizontal)
        uv_px = np.stack([width * (0.5 + azimuth / (2.0 * np.pi)), height * (0.5 - elevation / np.pi)], axis=1)
        exists = (horizontal > 0.0) | (y != 0.0)
        uv_px[~exists] = np.nan
        return uv_px, exists & self._is_inside(uv_px)

    def _rays(self, pixels: Float64) -> Float64:
        if self.is_panorama:
            azimuth = 2.0 * np.pi * (pixels[:, 0] / self.params[0] - 0.5)
            elevation = np.pi * (0.5 - pixels[:, 1] / self.params[1])
            level = np.cos(elevation)
            rays = np.stack([level * np.sin(azimuth), -np.sin(elevation), level * np.cos(azimuth)], axis=1)
            # Left and right wrap round; above the zenith and below the nadir there is nothing.
            rays[~(np.isfinite(azimuth) & (np.abs(elevation) <= np.pi / 2.0 + 1e-12))] = np.nan
            return rays
        matrix, centre = self._affine
        u, v = np.linalg.solve(matrix, (pixels - centre).T)
        exists = np.ones(len(pixels), bool)
        if self._distort is not None and self._domain is not None:
            u, v, exists = self._domain.undistort(self._distort, u, v)
        with np.errstate(all="ignore"):
            rays, in_view = self._from_plane(u, v)
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        rays[~(exists & in_view)] = np.nan
        return rays

    def _from_plane(self, u: Float64, v: Float64) -> tuple[Float64, Bool]:
        """Directions, not normalised, from undistorted plane coordinates."""
        r2 = u * u + v * v
        plane = self._lens.plane
        in_view = np.ones(len(u), bool)
        if plane == "perspective":
            z = np.ones_like(u)
        elif plane == "division":
            k = self._value("k")
            z = 1.0 + k * r2
            in_view = k * r2 < 1.0
        elif plane == "eucm":
            alpha, beta = self._value("alpha"), self._value("beta")
            radicand = 1.0 - (2.0 * alpha - 1.0) * beta * r2
            in_view = radicand >= 0.0
            z = (1.0 - alpha * alpha * beta * r2) / (alpha * np.sqrt(radicand) + 1.0 - alpha)
        else:
            radius = np.sqrt(r2)
            limit = np.pi if plane == "equidistant" else 2.0
            in_view = radius <= limit
            angle = radius if plane == "equidistant" else 2.0 * np.arcsin(np.minimum(radius / 2.0, 1.0))
            factor = np.divide(np.sin(angle), radius, out=np.ones_like(radius), where=radius > 0.0)
            u, v, z = u * factor, v * factor, np.cos(angle)
        return np.stack([u, v, z], axis=1), in_view


def _chunks(n: int) -> Iterator[slice]:
    """Slices of bounded length: the inverse needs a few hundred bytes per pixel."""
    for start in range(0, n, _CHUNK):
        yield slice(start, min(start + _CHUNK, n))
