"""From a posterior to an interval that holds the truth nine times in ten.

The posterior knows the noise and the arc, not what the model leaves out: errors that a whole side shares, walls that do
not meet, bark a tape bridges. So the standard deviation of the logarithm of the diameter D is taken as

    s² = c₀² + (c₁/D)² + (c₂ h)² + (c₃ σ/D)² + (c₄ q/D)² + (c₅ g² σ/D)² + c₆² (g / (1 - g))³
         + (c₇ b/D)² + (c₈ d/D)² + (c₉ v)² + s_scale² + (drift/D)²

with h the posterior's own (half of its 5-95 % range over 1.645), σ the noise of points, q the scatter of patches, g the
largest gap as a share of the ring, b the bloat taken off with its uncertainty, d the distance of double walls, and v
the size of the outline's waves relative to the radius (passes that do not fit together look like an odd section). The
coefficients were found by quantile regression on generated stems with development seeds
(`bench/estimator_lab.py --calibrate`), c₀ at least 0.005, since bark under a tape alone differs by as much.

Passes that are off by more than their noise and hardly overlap show neither two walls nor an odd section. No estimator
can see that in the points of one stem; who knows how well the passes fit together has to say so (`drift_m`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Float64


@dataclass(frozen=True)
class Spread:
    """What the width of an interval rests on.

    Attributes:
        posterior: Standard deviation of ln D by the posterior.
        sigma_m: Noise of points across the bark.
        scatter_m: Scatter of patches beyond it.
        gap: Largest unseen sector as a share of the ring, 0-1.
        bloat_m: How far the surface was drawn in, and how uncertain that is.
        walls_m: Distance of double walls.
        waves: Root mean square of the outline's waves, relative to its radius.
        diameter_m: D.
    """

    posterior: float
    sigma_m: float
    scatter_m: float
    gap: float
    bloat_m: float
    walls_m: float
    waves: float
    diameter_m: float

    def terms(self) -> Float64:
        """(10,) what the coefficients are multiplied with."""
        noise = self.sigma_m / self.diameter_m
        gap = min(self.gap, 0.95)
        return np.array(
            [
                1.0,
                1.0 / self.diameter_m,
                self.posterior,
                noise,
                self.scatter_m / self.diameter_m,
                self.gap**2 * noise,
                (gap / (1.0 - gap)) ** 1.5,
                self.bloat_m / self.diameter_m,
                self.walls_m / self.diameter_m,
                self.waves,
            ]
        )


@dataclass(frozen=True)
class Calibration:
    """How much each term counts.

    Attributes:
        coefficients: (10,) c₀ … c₉; c₁ in metres.
        factor: Standard deviations to either end of the 90 % interval.
    """

    coefficients: tuple[float, ...]
    factor: float

    def log_sd(self, spread: Spread, *, scale_sd: float = 0.0, drift_m: float = 0.0) -> float:
        """Standard deviation of ln D.

        Args:
            spread: What is known of the fit.
            scale_sd: Relative standard error of the scale.
            drift_m: How far passes are off, standard deviation per axis. Three passes that see a third of the ring
                each move the radius by half of that, so the diameter by all of it.
        """
        told = scale_sd**2 + (drift_m / spread.diameter_m) ** 2
        return float(np.sqrt(((np.array(self.coefficients) * spread.terms()) ** 2).sum() + told))


CALIBRATIONS = {
    "ring": Calibration((0.005, 0.0, 1.55, 0.358, 0.0, 7.14, 0.0166, 0.683, 0.692, 0.425), 1.645),
    "circle": Calibration((0.005, 0.0, 1.7, 0.383, 0.983, 7.99, 0.0253, 1.21, 0.645, 0.0), 1.645),
}
"""By method."""
