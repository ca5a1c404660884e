"""How far a tape lies outside the fitted curve: the relief of the bark, as far as the points show it.

The curve runs through the middle of the bark, the tape over its ridges. How rough bark is differs from beech to pine by
a factor of ten, so one number for all is wrong for nearly every stem. Ridges run up the stem and repeat round it: what
two points of neighbouring narrow strips have in common, and points a few degrees away have not, is relief. Noise of
single points is shared by nobody, and the smooth errors of matching and the shape of the section are shared over more
than a few degrees; both drop out.

    x = mean of e·e' over pairs at most 3.4° apart - the same 4.5-12.4° apart        ≈ κ (q R)²

with q the ridges' root mean square height over the radius R. κ is what strips of finite width leave of it. A prior
(half a normal distribution) and the sampling error of x give the posterior of q. Many precise points on smooth bark say
that there is nothing for a tape to lie on; where the noise drowns the bark, the prior's mean remains.
"""

from __future__ import annotations

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.estimator.fit import CUT, near_surface
from dbh_studio.core.estimator.tube import Tube

_STRIPS, _LAYER_M = 160, 0.20
_NEAR, _FAR = slice(0, 2), slice(3, 6)  # strips apart
_KAPPA = 0.8
_TAPE_OVER_RMS = 1.1  # of what a tape over ridges reads too much, relative, and their root mean square height
_CORRELATED = 2.0  # pairs share points
_LEAST_PAIRS = 20.0
_ROUGHNESS = np.linspace(0.0, 0.04, 81)
_HALF_NORMAL = 1.2533  # standard deviation of the normal distribution of which half has mean 1


def bark_share(points: Float64, tube: Tube, *, expected: float) -> tuple[float, float]:
    """By how much the tape exceeds the curve, relative to the diameter, and the standard deviation of that.

    Args:
        points: (N, 3) points, as the tube was fitted to.
        tube: The fit.
        expected: Mean of the prior; 0 for things without bark.
    """
    if expected <= 0:
        return 0.0, 0.0
    relief, relief_sd = _relief(points, tube)
    scaled = _ROUGHNESS * _TAPE_OVER_RMS / (_HALF_NORMAL * expected)
    log_belief = -0.5 * scaled**2
    if np.isfinite(relief_sd):
        log_belief -= 0.5 * ((relief - _KAPPA * (_ROUGHNESS * tube.radius) ** 2) / relief_sd) ** 2
    belief = np.exp(log_belief - log_belief.max())
    belief /= belief.sum()
    mean = float(belief @ _ROUGHNESS)
    spread = float(np.sqrt(belief @ (_ROUGHNESS - mean) ** 2))
    return _TAPE_OVER_RMS * mean, _TAPE_OVER_RMS * spread


def _relief(points: Float64, tube: Tube) -> tuple[float, float]:
    """What neighbouring points share that those a few degrees away do not, m², and its standard deviation."""
    near = near_surface(points, tube)
    if near is None:
        return 0.0, np.inf
    on = np.abs(near.error) < CUT * tube.sigma
    if not on.any():
        return 0.0, np.inf
    at, error = near.at.part(on), near.error[on]
    error = error - error.mean()
    strip = np.floor((at.angle() + np.pi) * (_STRIPS / (2 * np.pi))).astype(np.int64) % _STRIPS
    layer = np.floor(at.along / _LAYER_M).astype(np.int64)
    layer -= layer.min()
    key, shape = layer * _STRIPS + strip, (int(layer.max()) + 1, _STRIPS)
    size = shape[0] * shape[1]
    total = np.bincount(key, error, size).reshape(shape)
    count = np.bincount(key, minlength=size).reshape(shape).astype(np.float64)
    shared = [0.5 * float((total**2).sum() - (error**2).sum())]
    pairs = [0.5 * float((count**2).sum() - count.sum())]
    for apart in range(1, _FAR.stop):
        shared.append(float((total * np.roll(total, apart, axis=1)).sum()))
        pairs.append(float((count * np.roll(count, apart, axis=1)).sum()))
    n_near, n_far = sum(pairs[_NEAR]), sum(pairs[_FAR])
    if min(n_near, n_far) < _LEAST_PAIRS:
        return 0.0, np.inf
    relief = sum(shared[_NEAR]) / n_near - sum(shared[_FAR]) / n_far
    variance = _CORRELATED * float((error**2).mean()) ** 2 * (1.0 / n_near + 1.0 / n_far)
    return relief, float(np.sqrt(max(variance, 1e-16)))
