"""From a posterior to an interval that holds the truth nine times in ten.

The posterior knows the noise and the arc, not what the model leaves out: errors that a whole side shares, walls that do
not meet, bark a tape bridges. How far the logarithm of the diameter D is really off follows from what a fit shows of
itself (`Spread.terms`): its posterior's width, the noise, how uncertain the outline is, the gap, how deep the seen arc
is beside its noise, by how much patches of bark differ, the size, and whether passes of the camera or scanner fit
together. The logarithm of the interval's half width is a linear function of these,

    ln h = c₀ + Σ cᵢ tᵢ,     each tᵢ held within what the stems showed that the coefficients were found on,

and never less than the posterior's own. A product in place of a sum of squares can also say where an interval may be
*narrower*: the terms that make one stem uncertain are small on many that look alike otherwise. A swelling just at
breast height, and the uncertainty of the scale and of passes if it is known from elsewhere, are added as variances.

The coefficients were found on generated stems with development seeds (`bench/estimator_calibrate.py`): quantile
regression in which every scenario counts alike and what is asked for is nine in ten in each of them, not on the whole.

Passes that are off by more than their noise and hardly overlap show neither two walls nor an odd section. No estimator
can see that in the points of one stem; who knows how well the passes fit together has to say so (`drift_m`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Float64

TERMS = (
    "one",
    "posterior",
    "noise",
    "outline",
    "gap",
    "depth",
    "scatter",
    "size",
    "walls",
    "drift",
    "drift_waves",
    "passes",
    "passes_apart",
    "points",
)
"""What the coefficients are multiplied with, in this order; see `Spread.terms`."""

HALF_90 = 1.645
"""Standard deviations to either end of a 90 % interval."""

_LEAST_WAVE = 0.003
_LEAST_SD = 0.003
_LEAST = 1e-6


@dataclass(frozen=True)
class Spread:
    """What the width of an interval rests on.

    Attributes:
        posterior: Standard deviation of ln D by the posterior.
        sigma_m: Noise of points across the bark.
        outline_m: Mean standard deviation of the outline's radius by the posterior.
        scatter_m: By how much patches of bark differ beyond the noise of their points.
        n_points: On the bark.
        gap: Largest unseen sector as a share of the ring, 0-1.
        waves: Root mean square of the outline's second and third wave, relative to its radius.
        wall_ratio: How many times thicker the layer of points is on its thick sides than on its thin ones.
        diameter_m: D.
        passes: Probability of passes that do not fit together by the walls they leave (`passes`); 0 where none was
            looked for.
        apart: How far they are apart, relative to D.
        bulge: By how much of its radius the stem is surely thicker or narrower just there, which the curve, fitted to a
            taller stretch of stem, does not follow; 0 mostly.
    """

    posterior: float
    sigma_m: float
    outline_m: float
    scatter_m: float
    n_points: int
    gap: float
    waves: float
    wall_ratio: float
    diameter_m: float
    passes: float = 0.0
    apart: float = 0.0
    bulge: float = 0.0

    @property
    def depth_noise(self) -> float:
        """Noise of points over the depth (sagitta) of the arc seen."""
        seen = np.pi * (1.0 - min(self.gap, 0.97))
        return float(self.sigma_m / (0.5 * self.diameter_m * (1.0 - np.cos(seen))))

    def terms(self, drift: float) -> Float64:
        """(14,) what the coefficients are multiplied with, `TERMS`.

        Args:
            drift: Probability that passes do not fit together.
        """
        lengths = np.array([self.sigma_m, self.outline_m, self.scatter_m]) / self.diameter_m
        noise, outline, scatter = np.log(np.maximum(lengths, _LEAST))
        return np.array(
            [
                1.0,
                np.log(self.posterior + _LEAST_SD),
                noise,
                outline,
                self.gap**2,
                np.log(max(self.depth_noise, _LEAST)),
                scatter,
                np.log(self.diameter_m),
                np.log(max(self.wall_ratio, 1.0)),
                drift,
                drift * np.log(self.waves + _LEAST_WAVE),
                self.passes,
                self.passes * np.log(self.apart + _LEAST_WAVE),
                np.log(max(self.n_points, 1)),
            ]
        )


@dataclass(frozen=True)
class Calibration:
    """How much each term counts.

    Attributes:
        coefficients: (14,) of `TERMS`.
        lowest: (14,) of each term, on the stems that the coefficients were found on.
        highest: (14,) the same.
        drift: Logistic regression of "passes do not fit together": intercept, and slopes on the logarithms of the
            walls' ratio and of the waves.
    """

    coefficients: tuple[float, ...]
    lowest: tuple[float, ...]
    highest: tuple[float, ...]
    drift: tuple[float, float, float]

    def drift_chance(self, spread: Spread) -> float:
        """Probability that passes do not fit together, where half of all stems were so."""
        start, by_walls, by_waves = self.drift
        odds = start + by_walls * np.log(max(spread.wall_ratio, 1.0)) + by_waves * np.log(spread.waves + _LEAST_WAVE)
        return float(1.0 / (1.0 + np.exp(-np.clip(odds, -30.0, 30.0))))

    def log_sd(self, spread: Spread, *, scale_sd: float = 0.0, drift_m: float = 0.0) -> float:
        """Standard deviation of ln D.

        Args:
            spread: What is known of the fit.
            scale_sd: Relative standard error of the scale.
            drift_m: How far passes are off, standard deviation per axis. Three passes that see a third of the ring
                each move the radius by half of that, so the diameter by all of it.
        """
        terms = np.clip(spread.terms(self.drift_chance(spread)), self.lowest, self.highest)
        own = max(float(np.exp(terms @ np.array(self.coefficients))) / HALF_90, spread.posterior)
        swollen = spread.bulge / HALF_90
        return float(np.sqrt(own**2 + swollen**2 + scale_sd**2 + (drift_m / spread.diameter_m) ** 2))


# fmt: off
CALIBRATIONS = {
    "ring": Calibration(
        coefficients=(
            6.875, 0.439, 0.2368, -0.1492, 3.088, 0.5485, 0.5141,
            0.6298, -1.177, 4.963, 0.7474, 0.8833, 0.163, -0.4234,
        ),
        lowest=(
            1.0, -5.656, -5.587, -6.908, 0.0, -5.587, -6.244,
            -2.786, 0.0, 0.003026, -3.57, 0.0, -3.31, 4.605,
        ),
        highest=(
            1.0, -2.591, -1.951, -3.28, 0.5216, -1.923, -3.711,
            -0.09252, 1.395, 0.9869, -0.01672, 0.9878, -0.0, 7.806,
        ),
        drift=(1.903, 5.131, 1.474)),
    "circle": Calibration(
        coefficients=(
            4.218, -0.2006, 0.5182, 0.03333, 3.924, 0.6181, 0.4353,
            0.6139, -4.297, 3.017, -0.5193, 0.0, 0.0, -0.1801,
        ),
        lowest=(
            1.0, -5.674, -5.589, -8.057, 0.0, -5.589, -6.142,
            -2.793, 0.0, 0.02251, -5.622, 0.0, -0.0, 4.615,
        ),
        highest=(
            1.0, -2.958, -1.962, -3.744, 0.5216, -1.928, -3.357,
            -0.106, 1.323, 0.9677, -0.1308, 0.0, 0.0, 7.809,
        ),
        drift=(-3.771, 5.422, 0.0)),
    "circle, upright": Calibration(
        coefficients=(
            5.7, 0.2739, -0.3223, 0.5122, -0.554, 0.005239, 0.559,
            0.007209, -0.09153, -0.8849, 0.1523, 0.0, 0.0, -0.2698,
        ),
        lowest=(
            1.0, -5.428, -5.234, -7.228, 0.0, -5.16, -6.05,
            -2.788, 0.0, 0.4111, -3.44, 0.0, -0.0, 4.477,
        ),
        highest=(
            1.0, -2.406, -1.968, -3.108, 0.5017, -1.915, -2.349,
            -0.1052, 1.617, 0.5922, -2.388, 0.0, 0.0, 7.794,
        ),
        drift=(-0.3594, 0.4529, 0.0)),
}
# fmt: on
"""By method, and of the circle about an upright axis; from `bench/estimator_calibrate.py`."""
