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
            4.969, 0.786, 0.2529, -0.3496, 2.764, 0.4932, 0.1883,
            0.532, -0.7157, 3.831, 0.3308, 1.218, 0.4776, -0.3626,
        ),
        lowest=(
            1.0, -5.676, -5.585, -6.853, 0.0, -5.585, -6.18,
            -2.811, 0.1367, 0.002577, -3.554, 0.0, -3.39, 4.92,
        ),
        highest=(
            1.0, -2.696, -1.981, -3.394, 0.5216, -1.927, -3.69,
            -0.1286, 1.402, 0.9921, -0.01415, 0.9871, -0.0, 7.808,
        ),
        drift=(2.399, 5.684, 1.752)),
    "circle": Calibration(
        coefficients=(
            6.088, 0.597, 0.2371, -0.2418, 2.685, 0.7593, 0.6204,
            0.9592, -3.623, 2.43, -0.4183, 0.0, 0.0, 0.00506,
        ),
        lowest=(
            1.0, -5.676, -5.574, -7.991, 0.0, -5.572, -6.141,
            -2.798, 0.1394, 0.03963, -5.624, 0.0, -0.0, 4.92,
        ),
        highest=(
            1.0, -3.209, -1.984, -3.98, 0.5216, -1.92, -3.305,
            -0.1489, 1.281, 0.9682, -0.2302, 0.0, 0.0, 7.813,
        ),
        drift=(-3.994, 5.783, 0.0)),
    "circle, upright": Calibration(
        coefficients=(
            5.049, 0.1977, -0.2278, 0.5846, 0.1375, 0.5032, 0.5056,
            -0.2812, 0.6745, 0.2947, -0.05074, 0.0, 0.0, -0.2864,
        ),
        lowest=(
            1.0, -5.306, -5.224, -6.973, 0.0, -5.204, -6.112,
            -2.754, 0.0, 0.3254, -4.084, 0.0, -0.0, 3.892,
        ),
        highest=(
            1.0, -2.282, -2.029, -3.005, 0.5216, -1.92, -2.635,
            -0.1277, 1.561, 0.703, -1.89, 0.0, 0.0, 6.868,
        ),
        drift=(-0.729, 1.019, 0.0)),
}
# fmt: on
"""By method, and of the circle about an upright axis; from `bench/estimator_calibrate.py`."""
