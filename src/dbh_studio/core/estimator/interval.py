"""From a posterior to an interval that holds the truth nine times in ten.

The posterior knows the noise and the arc, not what the model leaves out: errors that a whole side shares, walls that do
not meet, bark a tape bridges. So the standard deviation of the logarithm of the diameter D is taken as

    s² = c₀² + (c₁ h)² + (c₂ σ/D)² + c₃² (g / (1 - g))³ + (c₄ b/D)² + p² ((c₅ v)² + (c₆ q/D)² + c₇²) + (c₈ (τ - σ/D))²
         + s_scale² + (drift/D)²

with h the posterior's own (half of its 5-95 % range over 1.645), σ the noise of points, g the largest gap as a share of
the ring, b the bloat taken off with its uncertainty, and τ the noise relative to how deep the seen arc is
(`depth_noise`: once that is no longer small, an arc of any curvature agrees with the points; of a whole ring it is σ/D,
so the term counts what the arc adds). p is the probability that passes do not fit together, from how much thicker the
bark's layer is on some sides (q) and from the size of the outline's waves (v).

The coefficients were found on generated stems with development seeds (`bench/estimator_lab.py --calibrate`): quantile
regression in which every scenario counts alike and what is asked for is nine in ten in each of them, not on the whole.

Passes that are off by more than their noise and hardly overlap show neither two walls nor an odd section. No estimator
can see that in the points of one stem; who knows how well the passes fit together has to say so (`drift_m`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Float64

_LEAST_WAVE = 0.003


@dataclass(frozen=True)
class Spread:
    """What the width of an interval rests on.

    Attributes:
        posterior: Standard deviation of ln D by the posterior.
        sigma_m: Noise of points across the bark.
        gap: Largest unseen sector as a share of the ring, 0-1.
        bloat_m: How far the surface was drawn in, and how uncertain that is.
        waves: Root mean square of the outline's second and third wave, relative to its radius.
        wall_ratio: How many times thicker the layer of points is on its thick sides than on its thin ones.
        wall_m: By how much.
        diameter_m: D.
    """

    posterior: float
    sigma_m: float
    gap: float
    bloat_m: float
    waves: float
    wall_ratio: float
    wall_m: float
    diameter_m: float

    @property
    def depth_noise(self) -> float:
        """Noise of points over the depth (sagitta) of the arc seen."""
        seen = np.pi * (1.0 - min(self.gap, 0.97))
        return float(self.sigma_m / (0.5 * self.diameter_m * (1.0 - np.cos(seen))))

    def terms(self, drift: float) -> Float64:
        """(9,) what the coefficients are multiplied with, given the probability that passes do not fit together."""
        gap = min(self.gap, 0.95)
        return np.array(
            [
                1.0,
                self.posterior,
                self.sigma_m / self.diameter_m,
                (gap / (1.0 - gap)) ** 1.5,
                self.bloat_m / self.diameter_m,
                drift * self.waves,
                drift * self.wall_m / self.diameter_m,
                drift,
                max(self.depth_noise - self.sigma_m / self.diameter_m, 0.0),
            ]
        )


@dataclass(frozen=True)
class Calibration:
    """How much each term counts.

    Attributes:
        coefficients: (9,) c₀ … c₈.
        drift: Logistic regression of "passes do not fit together": intercept, and slopes on the logarithms of the
            walls' ratio and of the waves.
        factor: Standard deviations to either end of the 90 % interval.
    """

    coefficients: tuple[float, ...]
    drift: tuple[float, float, float]
    factor: float = 1.645

    def drift_chance(self, spread: Spread) -> float:
        """Probability that passes do not fit together, where half of all stems were so."""
        start, by_walls, by_waves = self.drift
        odds = start + by_walls * np.log(spread.wall_ratio) + by_waves * np.log(spread.waves + _LEAST_WAVE)
        return float(1.0 / (1.0 + np.exp(-np.clip(odds, -30.0, 30.0))))

    def log_sd(self, spread: Spread, *, scale_sd: float = 0.0, drift_m: float = 0.0) -> float:
        """Standard deviation of ln D.

        Args:
            spread: What is known of the fit.
            scale_sd: Relative standard error of the scale.
            drift_m: How far passes are off, standard deviation per axis. Three passes that see a third of the ring
                each move the radius by half of that, so the diameter by all of it.
        """
        told = scale_sd**2 + (drift_m / spread.diameter_m) ** 2
        terms = spread.terms(self.drift_chance(spread))
        return float(np.sqrt(((np.array(self.coefficients) * terms) ** 2).sum() + told))


CALIBRATIONS = {
    "ring": Calibration((0.00578, 1.4, 0.189, 0.0104, 0.551, 1.97, 0.462, 0.0174, 1.27), (1.62, 5.65, 1.52)),
    "circle": Calibration((0.00482, 2.68, 0.0549, 0.0165, 2.11, 0.0, 0.711, 0.01, 2.95), (-4.08, 5.9, 0.0)),
}
"""By method."""
