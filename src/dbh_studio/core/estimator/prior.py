"""What is known of stems before one is looked at. All of it is weak: it decides only where the points do not."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from dbh_studio.core.arrays import Float64, readonly
from dbh_studio.core.estimator.tube import N_PLACE
from dbh_studio.settings import EstimatorSettings

_LEAN_SD = 0.12
_WAVE_POWER = 1.4
_FULL_TAPER_M = 0.15
_LN_RADIUS_M, _LN_RADIUS_SD = float(np.log(0.19)), 0.75


@dataclass(frozen=True)
class StemPrior:
    """Normal priors of a tube's parameters.

    Attributes:
        roundness: Standard deviation of a₂ and b₂ relative to the radius; higher waves have less, as (2 / k)^1.4.
        taper: Mean loss of radius of stems thicker than 30 cm, metres per metre; thinner ones have less in proportion.
        taper_sd: Its standard deviation.
        highest: The last wave of the final curve.
    """

    roundness: float
    taper: float
    taper_sd: float
    highest: int

    @classmethod
    def from_settings(cls, settings: EstimatorSettings) -> StemPrior:
        """As the settings say."""
        return cls(settings.roundness, settings.taper, settings.taper_sd, settings.waves)

    def mean_taper(self, radius: float | Float64) -> Float64:
        """Expected taper of stems of that radius."""
        return np.asarray(self.taper * np.minimum(1.0, np.asarray(radius) / _FULL_TAPER_M))

    def precision(self, radius: float, highest: int) -> Float64:
        """(4 + 2 highest,) inverse variances of shift, tilt, radius, taper and waves; 0 where nothing is known."""
        precision = np.zeros(N_PLACE + 2 * highest)
        precision[2:4] = _LEAN_SD**-2
        precision[5] = self.taper_sd**-2
        precision[6:] = _wave_precision(highest) * (self.roundness * radius) ** -2.0
        return precision

    @staticmethod
    def log_density(radius: Float64) -> Float64:
        """Of the logarithm of the radius: half of all stems measured are 23-63 cm thick, 2 % thinner than 8 cm."""
        density: Float64 = -0.5 * ((np.log(radius) - _LN_RADIUS_M) / _LN_RADIUS_SD) ** 2
        return density


@lru_cache(maxsize=16)
def _wave_precision(highest: int) -> Float64:
    """(2 (highest - 1),) inverse variances of the waves, relative to those of the second."""
    order = np.repeat(np.arange(2, highest + 1), 2)
    return readonly((2.0 / order) ** (-2.0 * _WAVE_POWER))
