"""Bloated bark: where the surface is under a layer of points that lie too far out.

Dense matching smears bark outwards: the distances of points to the surface are then symmetric noise plus an
exponential error. The mean of that is off by the exponential's mean, the weighted fit by about half of it. So the shape
of the distribution is compared with tables of exactly that: normal or heavy-tailed noise (Student's t, three degrees of
freedom) convolved with an exponential, over a floor of clutter. The surface is the posterior mean of where the noise is
centred.

Bloat far below the noise leaves no trace in the shape. There the prior decides: most surfaces are bloated by a
millimetre or so, exponentially distributed, and some are smeared by as much as their noise or more.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from dbh_studio.core.arrays import Float64

_RATIOS = np.array([0.0, 0.1, 0.2, 0.35, 0.5, 1.0, 1.5, 2.0, 3.0, 4.5])  # mean of the exponential over the noise
_EDGES = np.append(0.5 * (_RATIOS[1:] + _RATIOS[:-1]), np.inf)
_SMEARED = np.array([0.0, 0.0, 0.0, 0.0, 0.24, 0.2, 0.18, 0.16, 0.12, 0.1])  # prior where bloat is more than usual
_SCALES = np.array([0.5, 0.65, 0.8, 1.0, 1.25])  # noise over the width of the inner half
_SHIFTS = np.linspace(-2.5, 0.75, 27)
_LOWEST, _BIN, _N_BINS = -5.0, 0.25, 52
_CLUTTER = 0.05
_TOLD = 600.0  # points share their errors: more of them tell no more
_FINE = 0.05


def surface_shift(error: Float64, sigma: float, *, chance: float, usual_m: float = 0.0) -> tuple[float, float]:
    """How far the surface is from where the fit put it (negative: inwards), and the standard deviation of that.

    Args:
        error: (N,) distances of points to the fitted surface, outwards positive.
        sigma: Width of the inner half of them.
        chance: Prior probability that the surface is bloated by far more than usual.
        usual_m: Mean of the usual bloat. With 0 for both there is no shift.
    """
    at = error / sigma
    bins = np.floor((at - _LOWEST) / _BIN).astype(np.int64)
    count = np.bincount(bins[(bins >= 0) & (bins < _N_BINS)], minlength=_N_BINS).astype(np.float64)
    total = float(count.sum())
    if total <= 0 or (chance <= 0 and usual_m <= 0):
        return 0.0, 0.0
    told = min(_TOLD, 0.3 * len(error))
    score = _log_tables() @ (count * (told / total))
    prior = (1.0 - chance) * _usual(usual_m / sigma) + chance * _SMEARED
    score = score + np.log(np.maximum(prior, 1e-12))[:, None, None]
    belief = np.exp(score - score.max()).sum(axis=0)
    belief /= belief.sum()
    # Symmetric noise is the null hypothesis: it is also centred, by the fit, so only the difference to it counts.
    centred = belief[0].sum(axis=0)
    smeared = belief[1:].sum(axis=(0, 1))
    bloated = float(smeared.sum())
    if bloated < 1e-3:
        return 0.0, 0.0
    off = float(smeared @ _SHIFTS) / bloated - float(centred @ _SHIFTS) / max(float(centred.sum()), 1e-12)
    shift = min(bloated * off, 0.0)
    spread = float(smeared @ (_SHIFTS - smeared @ _SHIFTS / bloated) ** 2) + bloated * (1.0 - bloated) * off**2
    return shift * sigma, float(np.sqrt(spread)) * sigma


def _usual(ratio: float) -> Float64:
    """(R,) how often an exponential bloat, of that mean relative to the noise, is nearest to each of the ratios."""
    below = 1.0 - np.exp(-_EDGES / max(ratio, 1e-9))
    return np.diff(below, prepend=0.0)


@lru_cache(maxsize=1)
def _log_tables() -> Float64:
    """(2, ratios, scales, shifts, bins) logarithms of the bins' probabilities: heavy-tailed and normal noise."""
    fine = np.arange(-40.0, 40.0, _FINE)
    middles = _LOWEST + _BIN * (np.arange(_N_BINS) + 0.5)
    density = np.empty((2, len(_RATIOS), len(_SCALES), len(_SHIFTS), _N_BINS))
    # Half of Student's t with three degrees of freedom is within 0.765: 1.134 by the robust rule; of the normal, 1.
    kinds = (((1.0 + fine**2 / 3.0) ** -2.0, 1.134), (np.exp(-0.5 * fine**2), 1.0))
    for kind, (shape, width) in enumerate(kinds):
        noise = shape / shape.sum()
        for row, ratio in enumerate(_RATIOS):
            smeared = noise
            if ratio > 0:
                tail = np.exp(-np.arange(0.0, 40.0, _FINE) / (ratio * width))
                smeared = np.convolve(noise, tail / tail.sum())[: len(fine)]
            for column, scale in enumerate(_SCALES):
                at = (middles - _SHIFTS[:, None]) * (width / scale)
                density[kind, row, column] = np.interp(at, fine, smeared, left=0.0, right=0.0)
    density /= density.sum(axis=-1, keepdims=True)
    logs: Float64 = np.log((1.0 - _CLUTTER) * density + _CLUTTER / _N_BINS)
    return logs
