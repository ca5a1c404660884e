"""How much each photo may say about a marker's size: near photos are believed, far ones as far as they agree with them.

Every photo shows the marker at some size. Noise differs from photo to photo and averages out. What blur, ink, glare and
reduced copies of a picture do to the edges does not: it is alike in photos of like distance, and grows with the size of
a pixel on the marker. The sizes are therefore modelled as the true one, plus noise, plus a drift that starts at nothing
for a camera at the marker and wanders off with distance, as far as the photos themselves show. Its best linear estimate
weighs every photo without a limit to be chosen: where far photos agree with near ones all count, where they do not the
near ones do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Float64, readonly

_DRIFT_STEPS = np.geomspace(1.0, 32.0, 11)
_NOISE_STEPS = np.array([0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0])
# Factors of e by which drift and noise are believed to differ from what is usual, before looking.
_LOG_DRIFT_SIGMA = 3.0
_LOG_NOISE_SIGMA = 0.7
_STUDENT_FREEDOM = 4.0
_ROBUST_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class SizeWeights:
    """What the photos' sizes say together.

    Attributes:
        share: (V,) weight of each photo; not negative, sums to 1.
        drift: Standard error of the weighted mean from the drift, as a share of the size.
        noise: Standard error of it from the photos' noise, as a share of the size.
        steepness: How many times larger than usual the drift is.
    """

    share: Float64
    drift: float
    noise: float
    steepness: float


def weigh_sizes(sizes: Float64, noise: Float64, footprint: Float64, usual_drift: float) -> SizeWeights:
    """Weights for the mean size.

    Args:
        sizes: (V,) logarithm of the size each photo shows, about any common size.
        noise: (V,) its standard error from what differs between photos.
        footprint: (V,) size of a pixel on the marker, any unit.
        usual_drift: Standard error of the size per unit of `footprint`, where nothing else is known.
    """
    noise = np.maximum(noise, 1e-7)
    shared = np.minimum.outer(footprint, footprint) ** 2
    own, steepness, factor = noise**2, 1.0, 1.0
    for _ in range(_ROBUST_ROUNDS):
        steepness, factor = _most_likely(sizes, own, shared * usual_drift**2)
        drift = shared * (usual_drift * steepness) ** 2
        left = _left_over(sizes, own * factor**2, drift) / (noise * factor)
        # As with Student's distribution: a photo with a twig before the marker is off by many of its sigmas.
        own = noise**2 * (_STUDENT_FREEDOM + left**2) / (_STUDENT_FREEDOM + 1)
    total = drift + np.diag(own * factor**2)
    share = np.linalg.solve(total, np.ones(len(sizes)))
    share = np.maximum(share, 0.0)
    share /= share.sum()
    return SizeWeights(
        readonly(share),
        float(np.sqrt(share @ drift @ share)),
        float(np.sqrt((share**2 * own).sum()) * factor),
        float(steepness),
    )


def _most_likely(sizes: Float64, own: Float64, drift: Float64) -> tuple[float, float]:
    """How much steeper than usual the drift and how much larger than thought the noise is.

    The likelihood is that of the differences between the sizes: their mean is free.
    """
    scale = 1 / np.sqrt(own)
    # In the drift's own axes both covariances are diagonal, for every steepness and factor at once.
    spread, axes = np.linalg.eigh(scale[:, None] * drift * scale)
    ones, seen = axes.T @ scale, axes.T @ (scale * sizes)
    steepness, factor = (grid.ravel() for grid in np.meshgrid(_DRIFT_STEPS, _NOISE_STEPS, indexing="ij"))
    variance = steepness[:, None] ** 2 * np.maximum(spread, 0.0) + factor[:, None] ** 2
    information = (ones**2 / variance).sum(axis=1)
    mean = (ones * seen / variance).sum(axis=1) / information
    misfit = ((seen - mean[:, None] * ones) ** 2 / variance).sum(axis=1)
    belief = (np.log(steepness) / _LOG_DRIFT_SIGMA) ** 2 + (np.log(factor) / _LOG_NOISE_SIGMA) ** 2
    best = int(np.argmin(np.log(variance).sum(axis=1) + np.log(information) + misfit + belief))
    return float(steepness[best]), float(factor[best])


def _left_over(sizes: Float64, own: Float64, drift: Float64) -> Float64:
    """(V,) what neither the mean nor the drift explains."""
    inverse = np.linalg.inv(drift + np.diag(own))
    mean = float((inverse @ sizes).sum() / inverse.sum())
    return np.asarray(own * (inverse @ (sizes - mean)))
