"""Is it a stem at all? Leaves, shrubs, slash, boulders, crates and people have rings laid through them as well.

A stem is one thin surface, hollow inside, the same ring one above the other, and round. So a fitted tube is judged by

- the share of patches of bark in which a surface stands out from the layers beside it, and how much it does in all;
- how far the patches lie off it, and how much the radius differs from layer to layer: what is no stem does not stack;
- its waves from the fourth on: corners;
- how thick the surface is, how wide the ring, and how much of what is near lies on it.

The odds are a logistic regression of made stems (of all scenarios of the laboratory, whole, cut short, thinned, and
uneven in height) against eleven kinds of heaps: `bench/estimator_section.py --calibrate`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Float64, Int64
from dbh_studio.core.estimator.fit import fit_tube
from dbh_studio.core.estimator.prior import StemPrior
from dbh_studio.core.estimator.tube import Polar, Tube, cells_of, tukey
from dbh_studio.core.measured import Flag

LIKELY_CLUTTER = 0.65
"""Probability from which on a warning is given."""

_ON, _BESIDE, _CUT = 1.5, 4.5, 3.0  # standard deviations
_LAYER_M = 0.2
_LAYER_POINTS = 20
_CELL_WEIGHT = 2.0
_UNSURE_M = 0.002
_ALIKE, _LEAST_ALIKE = 0.06, 3  # difference in radii, layers
_CLEARLY_A_STEM = 0.2  # chance of being no stem
_THICK_STEM_M = 0.35  # radius from which on being wider is no sign, and unevenness counts relative to the radius
_NAMES = ("patches", "contrast", "uneven", "stacked", "corners", "thick", "wide", "near")
_WORDS = {
    "patches": "points lie beside the ring as densely as on it",
    "contrast": "points lie beside the ring as densely as on it",
    "uneven": "they lie unevenly about it",
    "stacked": "it is of another size at every height",
    "corners": "it has corners",
    "thick": "they form no thin surface",
    "wide": "it is too wide for how little is on it",
    "near": "most points near it are not on it",
}
# Medians of made stems: what a term says against a stem is counted from there.
_USUAL = np.array([-2.46, -1.58, -5.39, -4.84, -4.36, -2.9, -1.87, -2.6])
_START, _SLOPES = 37.3, np.array([1.03, 1.23, 1.31, 0.279, 3.11, 2.84, 2.32, 1.26])


@dataclass(frozen=True, eq=False)
class HeapSigns:
    """What speaks for a heap in place of a stem.

    Attributes:
        terms: (8,) that the regression is of, each about 0-5; see `signs_of`.
    """

    terms: Float64

    @property
    def chance(self) -> float:
        """Probability that it is no stem, where half of all that is looked at were none."""
        return float(1.0 / (1.0 + np.exp(-np.clip(_START + _SLOPES @ self.terms, -30.0, 30.0))))

    @property
    def words(self) -> str:
        """What speaks most against a stem."""
        return _WORDS[_NAMES[int(np.argmax(_SLOPES * (self.terms - _USUAL)))]]


def clutter_flag(signs: HeapSigns) -> Flag:
    """What to say where a heap is likely."""
    return Flag("clutter", f"may be a shrub, a heap or a thing and no stem: {signs.words}")


def signs_of(points: Float64, tube: Tube) -> HeapSigns | None:
    """How a tube agrees with (N, 3) points as the bark of a stem would; None where hardly any are on it."""
    at = tube.polar(points)
    error = at.distance - tube.surface(at)
    away = np.abs(error) / tube.sigma
    on = away < _CUT
    if on.sum() < 10:
        return None
    radius = tube.radius
    patches, contrast = _patches_and_contrast(at, away, radius)
    near = max(int(np.count_nonzero(at.distance < 2.0 * radius + 0.1)), 1)
    weight = tukey(error, _CUT * tube.sigma)
    beyond = max(float(np.log(radius / _THICK_STEM_M)), 0.0)
    corners = float(np.sqrt(0.5 * (tube.waves[4:] ** 2).sum())) / radius
    terms = [
        np.log(1.02 - patches),
        np.log(1.1 - contrast),
        np.log(_off_patches(at, error, weight, radius) + _UNSURE_M) - beyond,
        np.log(_off_layers(at, error, tube.sigma) / radius + _UNSURE_M),
        np.log(corners + 0.01),
        np.log(tube.sigma / radius),
        np.log(radius) - beyond,
        np.log(1.02 - min(float(on.sum()) / near, 1.0)),
    ]
    return HeapSigns(np.array(terms, np.float64))


def _patches_and_contrast(at: Polar, away: Float64, radius: float) -> tuple[float, float]:
    """Share of patches in which the surface stands out, and how much denser it is than the layers beside it."""
    around = away < _BESIDE
    surface = away[around] < _ON
    cell, n_cells = cells_of(at.part(around).angle(), at.along[around], radius, around.sum() / 3.0)
    on = np.bincount(cell[surface], minlength=n_cells)
    beside = np.bincount(cell[~surface], minlength=n_cells)
    contrast = 1.0 - 0.5 * float((~surface).sum()) / max(float(surface.sum()), 1.0)
    return float((on > beside).mean()), max(contrast, -1.0)


def _off_patches(at: Polar, error: Float64, weight: Float64, radius: float) -> float:
    """Root mean square of the patches' mean distances to the surface, metres."""
    on = weight > 0.02
    cell, n_cells = cells_of(at.part(on).angle(), at.along[on], radius, on.sum())
    total = np.bincount(cell, weight[on], n_cells)
    known = total > _CELL_WEIGHT
    if known.sum() < 4:
        return 0.3 * radius
    off = np.bincount(cell, weight[on] * error[on], n_cells)[known] / total[known]
    return float(np.sqrt(np.average(off**2, weights=total[known])))


def _off_layers(at: Polar, error: Float64, sigma: float) -> float:
    """Standard deviation of the radius from layer to layer, metres."""
    _, off = _layers(at, error, sigma)
    known = np.isfinite(off)
    return float(off[known].std()) if known.sum() > 1 else 0.0


def _layers(at: Polar, error: Float64, sigma: float) -> tuple[Int64, Float64]:
    """(N,) which layer of 20 cm a point is in, and (L,) how much larger each is about its own centre, or NaN."""
    weight = tukey(error, _BESIDE * sigma)
    layer = np.floor(at.along / _LAYER_M + 0.5).astype(np.int64)
    layer -= layer.min(initial=0)
    n_layers = int(layer.max(initial=0)) + 1
    rows = (np.ones_like(error), at.cos, at.sin)
    normal, pull = np.empty((n_layers, 3, 3)), np.empty((n_layers, 3))
    for i in range(3):
        weighted = weight * rows[i]
        pull[:, i] = np.bincount(layer, weighted * error, n_layers)
        for j in range(i, 3):
            normal[:, i, j] = normal[:, j, i] = np.bincount(layer, weighted * rows[j], n_layers)
    count = np.bincount(layer[weight > 0], minlength=n_layers)
    full = count >= _LAYER_POINTS
    off = np.full(n_layers, np.nan)
    if full.any():
        # A ridge, so that a layer seen from one side is not moved far.
        normal[full] += count[full, None, None] * np.diag([5e-4, 0.05, 0.05])
        off[full] = np.linalg.solve(normal[full], pull[full][..., None])[:, 0, 0]
    return layer, off


def heap_signs_of(points: Float64, tube: Tube, prior: StemPrior) -> HeapSigns | None:
    """As `signs_of`; None also where a swelling is what speaks against a stem."""
    signs = signs_of(points, tube)
    if signs is not None and signs.chance > LIKELY_CLUTTER and is_swollen(points, tube, prior):
        return None
    return signs


def is_swollen(points: Float64, tube: Tube, prior: StemPrior) -> bool:
    """Whether most layers are one clean stem and the others a swelling of it: a whorl, a canker, a graft.

    Args:
        points: (N, 3) points.
        tube: As fitted to all of them.
        prior: Of the stem.
    """
    at = tube.polar(points)
    layer, off = _layers(at, at.distance - tube.surface(at), tube.sigma)
    known = np.isfinite(off)
    if known.sum() <= _LEAST_ALIKE:
        return False
    alike = np.abs(off - np.median(off[known])) < _ALIKE * tube.radius
    if not _LEAST_ALIKE <= alike.sum() < known.sum():
        return False
    rest = points[alike[layer]]
    curve = fit_tube(rest, tube, prior)
    signs = None if curve is None else signs_of(rest, curve)
    return signs is not None and signs.chance < _CLEARLY_A_STEM
