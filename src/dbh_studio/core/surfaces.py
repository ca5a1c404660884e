"""Smoothing a grid by local planes."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import ndimage

from dbh_studio.core.arrays import Float64

_RIDGE = 1e-7


def local_plane(value: Float64, weight: Float64, sigma: float) -> Float64:
    """(nx, ny) value at each cell of the plane fitted to the cells around it with Gaussian weights.

    A plane, not a mean, so that slopes run on through holes and over the rim. Far from all data it tends to zero.

    Args:
        value: (nx, ny) values; finite also where the weight is zero.
        weight: (nx, ny) non-negative weights.
        sigma: Standard deviation of the Gaussian, in cells.
    """

    def blurred(array: Float64) -> Any:
        return ndimage.gaussian_filter(array, sigma, mode="constant", truncate=3.5)

    x = (np.arange(value.shape[0]) / sigma)[:, None] * np.ones(value.shape)
    y = (np.arange(value.shape[1]) / sigma)[None, :] * np.ones(value.shape)
    w = blurred(weight)
    wx, wy, wv = blurred(weight * x), blurred(weight * y), blurred(weight * value)
    wxx, wyy, wxy = blurred(weight * x * x), blurred(weight * y * y), blurred(weight * x * y)
    wxv, wyv = blurred(weight * x * value), blurred(weight * y * value)
    # Moments about the cell itself.
    mx, my = wx - w * x, wy - w * y
    mxx, myy = wxx - 2 * x * wx + w * x * x, wyy - 2 * y * wy + w * y * y
    mxy = wxy - x * wy - y * wx + w * x * y
    mxv, myv = wxv - x * wv, wyv - y * wv
    # Ridges: towards zero where there is nothing, towards a level plane where the slope is not determined.
    w, mxx, myy = w + _RIDGE, mxx + 0.02 * w + _RIDGE, myy + 0.02 * w + _RIDGE
    determinant = w * (mxx * myy - mxy**2) - mx * (mx * myy - mxy * my) + my * (mx * mxy - mxx * my)
    numerator = wv * (mxx * myy - mxy**2) - mx * (mxv * myy - mxy * myv) + my * (mxv * mxy - mxx * myv)
    return np.asarray(numerator / np.maximum(determinant, _RIDGE**3))
