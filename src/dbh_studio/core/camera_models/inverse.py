"""Undoing a lens distortion, and knowing how far out it can be undone.

A distortion polynomial is a fit: beyond the image it may turn back, and a point far outside the field of view would
land inside the image. `DistortionDomain` finds the radius at which the map first folds; nothing beyond counts as seen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, Float64

BoundDistortion = Callable[[NDArray[Any], NDArray[Any]], tuple[NDArray[Any], NDArray[Any]]]

_STEP = 1e-30
_N_DIRECTIONS = 16
_MAX_ITERATIONS = 25
_CONVERGED = 1e-12


def with_jacobian(distort: BoundDistortion, u: Float64, v: Float64) -> tuple[Float64, Float64, Float64]:
    """The distorted (u', v') and the (2, 2, N) Jacobian, exact to rounding: a complex step has no cancellation."""
    along_u = distort(u + 1j * _STEP, v.astype(np.complex128))
    along_v = distort(u.astype(np.complex128), v + 1j * _STEP)
    jacobian = np.array([[along_u[0].imag, along_v[0].imag], [along_u[1].imag, along_v[1].imag]]) / _STEP
    return along_u[0].real, along_u[1].real, jacobian


@dataclass(frozen=True, eq=False)
class DistortionDomain:
    """Where a distortion is one-to-one.

    Attributes:
        fold_radius: The map is one-to-one up to this radius of the undistorted plane.
        radii: (M,) undistorted radii, 0 first, up to the fold.
        distorted_radii: (M,) their mean distorted radii, not decreasing.
    """

    fold_radius: float
    radii: Float64
    distorted_radii: Float64

    @classmethod
    def of(cls, distort: BoundDistortion, radii: Float64) -> DistortionDomain:
        """Follow the map outwards along 16 directions until it first stops growing.

        Args:
            distort: The distortion with its coefficients.
            radii: (M,) increasing radii to look at, 0 first.
        """
        angles = np.arange(_N_DIRECTIONS) * (2.0 * np.pi / _N_DIRECTIONS)
        u = np.outer(np.cos(angles), radii).ravel()
        v = np.outer(np.sin(angles), radii).ravel()
        with np.errstate(all="ignore"):
            du, dv, jacobian = with_jacobian(distort, u, v)
            determinant = jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]
            profile = np.hypot(du, dv).reshape(_N_DIRECTIONS, -1)
            # The fold can also be a sign change of both factors (a pole): then the point jumps to the other side.
            outward = du * u + dv * v >= 0.0
            is_good = (determinant > 0.0) & outward & np.isfinite(du) & np.isfinite(dv)
        good = is_good.reshape(_N_DIRECTIONS, -1).all(axis=0)
        n_good = len(radii) if good.all() else max(int(np.argmin(good)), 1)
        distorted = np.maximum.accumulate(profile[:, :n_good].mean(axis=0))
        return cls(float(radii[n_good - 1]), radii[:n_good], distorted)

    def undistort(self, distort: BoundDistortion, u: Float64, v: Float64) -> tuple[Float64, Float64, Bool]:
        """Newton's method from the radial table.

        Args:
            distort: The distortion with its coefficients.
            u: (N,) distorted.
            v: (N,) distorted.

        Returns:
            (N,) undistorted u and v, and where they exist: the map reaches (u, v) from inside the fold.
        """
        target = np.hypot(u, v)
        start = np.interp(target, self.distorted_radii, self.radii)
        factor = np.divide(start, target, out=np.ones_like(target), where=target > 0.0)
        x, y = u * factor, v * factor
        is_done = np.zeros(len(u), bool)
        active = np.arange(len(u))
        with np.errstate(all="ignore"):
            for _ in range(_MAX_ITERATIONS):
                du, dv, ((a, b), (c, d)) = with_jacobian(distort, x[active], y[active])
                eu, ev = du - u[active], dv - v[active]
                determinant = a * d - b * c
                step_x, step_y = (d * eu - b * ev) / determinant, (a * ev - c * eu) / determinant
                # A step longer than half the way to the centre comes from a Jacobian near the fold.
                length, reach = np.hypot(step_x, step_y), 0.5 * (np.hypot(x[active], y[active]) + 0.01)
                shorten = np.minimum(1.0, reach / np.maximum(length, 1e-300))
                x[active] -= shorten * step_x
                y[active] -= shorten * step_y
                converged = length <= _CONVERGED * (1.0 + np.hypot(x[active], y[active]))
                is_done[active[converged]] = True
                active = active[~converged & np.isfinite(length)]
                if not len(active):
                    break
            is_done &= np.hypot(x, y) <= self.fold_radius
        return x, y, is_done
