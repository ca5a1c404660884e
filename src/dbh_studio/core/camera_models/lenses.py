"""The formulas of every lens model, as functions of whole arrays.

A lens takes a direction (x, y, z) in the camera's frame to a point of a plane at unit distance, bends it there, and an
affine map brings it to pixels:

    plane        perspective: radius tan(t); equidistant: t; equisolid: 2 sin(t / 2), t the angle from +z
    distortion   (u, v) -> (u', v'), one function per model
    pixels       (fx u' + cx, fy v' + cy)

EQUIRECTANGULAR, DIVISION and EUCM have a closed form in both directions and no distortion function. Distortion
functions also take complex numbers: their exact derivatives come from a complex step (`inverse`).

Sources: COLMAP's documentation of its camera models (https://colmap.github.io/cameras.html); Agisoft Metashape user
manual, appendix "Camera models"; OpenSfM's documentation "Geometric models" (https://opensfm.org/docs/geometry.html).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Coefficients = Mapping[str, float]
Distortion = Callable[[Array, Array, Coefficients], tuple[Array, Array]]
Plane = Literal["perspective", "equidistant", "equisolid", "division", "eucm", "equirectangular"]


@dataclass(frozen=True)
class Lens:
    """One camera model.

    Attributes:
        names: What its parameters are, in the order of the file formats.
        plane: How directions come to the plane.
        distort: (u, v, coefficients by name) -> (u', v'); None where the lens does not bend.
        centre_is_offset: Whether cx and cy count from the image's centre instead of from its corner.
    """

    names: tuple[str, ...]
    plane: Plane
    distort: Distortion | None = None
    centre_is_offset: bool = False


def _polynomial(r2: Array, *coefficients: float) -> Array:
    """``1 + c0 r^2 + c1 r^4 + …``."""
    total = np.zeros_like(r2)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * r2
    return total + 1.0


def _tangential(u: Array, v: Array, p1: float, p2: float) -> tuple[Array, Array]:
    """Brown's decentring as OpenCV writes it: p1 belongs to y, p2 to x."""
    r2, uv = u * u + v * v, u * v
    return 2.0 * p1 * uv + p2 * (r2 + 2.0 * u * u), 2.0 * p2 * uv + p1 * (r2 + 2.0 * v * v)


def _radial(u: Array, v: Array, k: Coefficients) -> tuple[Array, Array]:
    """SIMPLE_RADIAL (k), RADIAL (k1, k2), OPENCV_FISHEYE (k1-k4): as many coefficients as there are."""
    names = ("k",) if "k" in k else ("k1", "k2", "k3", "k4")
    factor = _polynomial(u * u + v * v, *(k[name] for name in names if name in k))
    return u * factor, v * factor


def _opencv(u: Array, v: Array, k: Coefficients) -> tuple[Array, Array]:
    """OPENCV and THIN_PRISM_FISHEYE."""
    r2 = u * u + v * v
    factor = _polynomial(r2, k["k1"], k["k2"], k.get("k3", 0.0), k.get("k4", 0.0))
    du, dv = _tangential(u, v, k["p1"], k["p2"])
    return u * factor + du + k.get("sx1", 0.0) * r2, v * factor + dv + k.get("sy1", 0.0) * r2


def _full_opencv(u: Array, v: Array, k: Coefficients) -> tuple[Array, Array]:
    r2 = u * u + v * v
    factor = _polynomial(r2, k["k1"], k["k2"], k["k3"]) / _polynomial(r2, k["k4"], k["k5"], k["k6"])
    du, dv = _tangential(u, v, k["p1"], k["p2"])
    return u * factor + du, v * factor + dv


def _rad_tan_thin_prism(u: Array, v: Array, k: Coefficients) -> tuple[Array, Array]:
    """Here decentring and prism act on the radially distorted point, and p0 belongs to x."""
    factor = _polynomial(u * u + v * v, *(k[f"k{i}"] for i in range(6)))
    u, v = u * factor, v * factor
    du, dv = _tangential(u, v, k["p1"], k["p0"])
    r2 = u * u + v * v
    return u + du + (k["s0"] + k["s1"] * r2) * r2, v + dv + (k["s2"] + k["s3"] * r2) * r2


def _atan_over(r2: Array, scale: float) -> Array:
    """``atan(scale r) / r``, with its limit `scale` at r = 0."""
    at_zero = r2 == 0.0
    r = np.sqrt(np.where(at_zero, 1.0, r2))
    return np.where(at_zero, scale, np.arctan(scale * r) / r)


def _fov(u: Array, v: Array, k: Coefficients) -> tuple[Array, Array]:
    """Devernay and Faugeras 2001; omega = 0 is the pinhole."""
    omega = k["omega"]
    factor = _atan_over(u * u + v * v, 2.0 * np.tan(omega / 2.0)) / omega if abs(omega) > 1e-9 else 1.0
    return u * factor, v * factor


def _metashape(u: Array, v: Array, k: Coefficients) -> tuple[Array, Array]:
    """Metashape's p1 belongs to x, p2 to y: the other way round than OpenCV's."""
    r2 = u * u + v * v
    factor = _polynomial(r2, k["k1"], k["k2"], k["k3"], k["k4"])
    du, dv = _tangential(u, v, k["p2"], k["p1"])
    decentring = _polynomial(r2, k["p3"], k["p4"])
    return u * factor + du * decentring, v * factor + dv * decentring


def _opensfm_dual(u: Array, v: Array, k: Coefficients) -> tuple[Array, Array]:
    """A mixture of perspective (transition 1) and equidistant (transition 0), then k1 and k2."""
    factor = k["transition"] + (1.0 - k["transition"]) * _atan_over(u * u + v * v, 1.0)
    return _radial(u * factor, v * factor, {"k1": k["k1"], "k2": k["k2"]})


def _opensfm_fisheye624(u: Array, v: Array, k: Coefficients) -> tuple[Array, Array]:
    """Here decentring and prism act on the undistorted point, unlike in RAD_TAN_THIN_PRISM_FISHEYE."""
    r2 = u * u + v * v
    factor = _polynomial(r2, *(k[f"k{i}"] for i in range(1, 7)))
    du, dv = _tangential(u, v, k["p1"], k["p2"])
    return u * factor + du + (k["s0"] + k["s1"] * r2) * r2, v * factor + dv + (k["s2"] + k["s3"] * r2) * r2


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split())


_METASHAPE = _names("f cx cy k1 k2 k3 k4 p1 p2 p3 p4 b1 b2")

LENSES: Mapping[str, Lens] = {
    "SIMPLE_PINHOLE": Lens(_names("f cx cy"), "perspective"),
    "PINHOLE": Lens(_names("fx fy cx cy"), "perspective"),
    "SIMPLE_RADIAL": Lens(_names("f cx cy k"), "perspective", _radial),
    "RADIAL": Lens(_names("f cx cy k1 k2"), "perspective", _radial),
    "OPENCV": Lens(_names("fx fy cx cy k1 k2 p1 p2"), "perspective", _opencv),
    "FULL_OPENCV": Lens(_names("fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"), "perspective", _full_opencv),
    "FOV": Lens(_names("fx fy cx cy omega"), "perspective", _fov),
    "SIMPLE_FISHEYE": Lens(_names("f cx cy"), "equidistant"),
    "FISHEYE": Lens(_names("fx fy cx cy"), "equidistant"),
    "SIMPLE_RADIAL_FISHEYE": Lens(_names("f cx cy k"), "equidistant", _radial),
    "RADIAL_FISHEYE": Lens(_names("f cx cy k1 k2"), "equidistant", _radial),
    "OPENCV_FISHEYE": Lens(_names("fx fy cx cy k1 k2 k3 k4"), "equidistant", _radial),
    "THIN_PRISM_FISHEYE": Lens(_names("fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"), "equidistant", _opencv),
    "RAD_TAN_THIN_PRISM_FISHEYE": Lens(
        _names("fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3"), "equidistant", _rad_tan_thin_prism
    ),
    "SIMPLE_DIVISION": Lens(_names("f cx cy k"), "division"),
    "DIVISION": Lens(_names("fx fy cx cy k"), "division"),
    "EUCM": Lens(_names("fx fy cx cy alpha beta"), "eucm"),
    "EQUIRECTANGULAR": Lens(_names("w h"), "equirectangular"),
    "METASHAPE_FRAME": Lens(_METASHAPE, "perspective", _metashape, centre_is_offset=True),
    "METASHAPE_FISHEYE": Lens(_METASHAPE, "equidistant", _metashape, centre_is_offset=True),
    "METASHAPE_EQUISOLID": Lens(_METASHAPE, "equisolid", _metashape, centre_is_offset=True),
    "OPENSFM_DUAL": Lens(_names("f cx cy k1 k2 transition"), "perspective", _opensfm_dual),
    "OPENSFM_FISHEYE624": Lens(
        _names("fx fy cx cy k1 k2 k3 k4 k5 k6 p1 p2 s0 s1 s2 s3"), "equidistant", _opensfm_fisheye624
    ),
}
