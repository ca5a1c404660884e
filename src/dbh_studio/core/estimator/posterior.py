"""How sure the curve is: the posterior of the girth, given the bark's patches.

The mean radius and the place of the axis hold each other up where only one side is seen, and not in a straight line. So
the radius is taken at several values; at each one everything else is fitted and integrated by Laplace's approximation,
for each of three widths of the roundness prior. The evidence of each then says how much it counts: on a stem of which
enough is seen the waves that are there are followed, and where nothing is seen the curve stays a circle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from dbh_studio.core.arrays import Float64, readonly
from dbh_studio.core.estimator.fit import CUT, DRIFT, near_surface
from dbh_studio.core.estimator.prior import StemPrior
from dbh_studio.core.estimator.skew import surface_shift
from dbh_studio.core.estimator.tube import Tube, cells_of, tukey, wave_basis
from dbh_studio.core.estimator.viewing import on_bark, viewing_of
from dbh_studio.core.medians import median

N_OUTLINE = 72
"""Angles of the outline."""

_NODES = 15
_DRAWS = 4
_WIDTHS = np.array([0.5, 1.0, 2.0])
_FLOOR_M = 0.0015
_CORRELATED = 2.0  # neighbouring patches share errors too
_DEGREES_OF_FREEDOM = 4.0
_ANGLE = np.arange(N_OUTLINE) * (2 * np.pi / N_OUTLINE)
# Half the sum over 36 directions of 72 discrete angles falls short of a circle's girth by this.
_DISCRETE = 1.00016


@dataclass(frozen=True, eq=False)
class Patches:
    """The bark as seen, patch by patch.

    Attributes:
        position: (C, 3) weighted mean of a patch's points.
        variance: (C,) of its distance to the surface, m².
        scatter_m: What differs from patch to patch beyond the noise of points: smooth errors, unmodelled shape.
        shift_m: How far they were drawn in (negative), because the surface is bloated.
    """

    position: Float64
    variance: Float64
    scatter_m: float
    shift_m: float


@dataclass(frozen=True, eq=False)
class Posterior:
    """What is believed of the section at breast height; diameters in metres.

    Attributes:
        quantiles: Of the natural logarithm of each diameter (``tape``, ``curve``, ``area``): 5 %, 50 %, 95 %.
        tube: The likeliest one.
        outline_sd_m: (72,) standard deviation of the outline's radius.
    """

    quantiles: dict[str, tuple[float, float, float]]
    tube: Tube
    outline_sd_m: Float64


def patches_of(points: Float64, tube: Tube, *, bloat_chance: float = 0.0, bloat_m: float = 0.0) -> Patches | None:
    """The points on the tube as patches, drawn in where the bark is bloated; None with too few points or patches.

    Args:
        points: (N, 3) points, as the tube was fitted to.
        tube: The fit.
        bloat_chance: Prior probability of more bloat than usual, see `skew.surface_shift`.
        bloat_m: The usual one.
    """
    near = near_surface(points, tube)
    if near is None:
        return None
    bark = on_bark(near.at, near.error, tube, viewing_of(near.at, near.error, near.sigma))
    weight = tukey(bark.error, CUT * tube.sigma * np.sqrt(bark.variance))
    on = weight > 0.02
    if on.sum() < 15:
        return None
    at, error, weight = bark.at.part(on), bark.error[on], weight[on]
    angle = at.angle()
    cell, n_cells = cells_of(angle, at.along, tube.radius, len(weight))
    total = np.bincount(cell, weight, n_cells)
    used = total > 0.3
    if used.sum() < 6:
        return None
    shift, _ = surface_shift(near.error, tube.sigma, chance=bloat_chance, usual_m=bloat_m)
    parts = np.stack([at.cos, at.sin, at.distance + shift, at.along])
    mean = np.stack([np.bincount(cell, weight * row, n_cells) for row in parts])[:, used] / total[used]
    off = np.bincount(cell, weight * error, n_cells)[used] / total[used]
    noise = tube.sigma**2 * np.bincount(cell, weight * bark.variance[on], n_cells)[used] / total[used] ** 2
    spread = (1.4826 * median(np.abs(off - median(off)))) ** 2
    scatter = max(spread - median(noise), _FLOOR_M**2)
    variance = _CORRELATED * (scatter + noise + (DRIFT * tube.radius * mean[3]) ** 2)
    # A whole patch of something else: Student's t in place of the normal distribution.
    variance = variance * (_DEGREES_OF_FREEDOM + off**2 / variance) / (_DEGREES_OF_FREEDOM + 1.0)
    u, v, w = tube.frame()
    origin = np.array([*tube.centre, 0.0])
    # Direction and distance, not x and y: the mean place of an arc's points lies on its chord side.
    mean[:2] *= mean[2] / np.hypot(mean[0], mean[1])
    position = origin + mean[[0, 1, 3]].T @ np.stack([u, v, w])
    return Patches(position, variance, float(np.sqrt(scatter)), shift)


def posterior_of(patches: Patches, tube: Tube, prior: StemPrior, *, seed: int) -> Posterior:
    """The posterior of the section's diameters.

    Args:
        patches: Of the bark.
        tube: The fit they were taken from.
        prior: Of the stem.
        seed: Of the draws of the waves.
    """
    tube = replace(tube, radius=tube.radius + patches.shift_m)
    radii = _radius_nodes(patches, tube, prior)
    fitted = _at_nodes(patches, tube, prior, radii)
    precision = np.stack([fitted.precision] * len(_WIDTHS))  # (W, M, P)
    precision[:, :, 5:] *= _WIDTHS[:, None, None] ** -2.0
    normal = fitted.normal + precision[..., None] * np.eye(precision.shape[-1])
    target = fitted.target + precision * fitted.mean
    best = np.asarray(np.linalg.solve(normal, target[..., None])[..., 0], np.float64)
    misfit = fitted.square - 2 * (best * fitted.target).sum(-1)
    misfit = misfit + np.einsum("wmi,mij,wmj->wm", best, fitted.normal, best)
    misfit = misfit + (precision * (best - fitted.mean) ** 2).sum(-1)
    evidence = -0.5 * misfit - 0.5 * np.linalg.slogdet(normal)[1] + 0.5 * np.log(precision[..., 5:]).sum(-1)
    evidence = evidence + prior.log_density(radii) + np.log(np.gradient(np.log(radii)))
    belief = np.exp(evidence - evidence.max())
    belief /= belief.sum()
    inverse = np.linalg.inv(normal)
    root: Float64 = np.linalg.cholesky(0.5 * (inverse + np.swapaxes(inverse, -1, -2)))
    diameters, outline_sd = _diameters(radii, best, root, belief, seed)
    width_at, node_at = np.unravel_index(int(belief.argmax()), belief.shape)
    found = best[width_at, node_at]
    centre, slope = fitted.place.moved(best[width_at])
    likeliest = Tube(centre[node_at], slope[node_at], float(radii[node_at]), float(found[4]), found[5:], tube.sigma)
    return Posterior(diameters, likeliest, outline_sd)


@dataclass(frozen=True, eq=False)
class _Places:
    """M axes: (M, 2) centres and slopes, of M radii."""

    centre: Float64
    slope: Float64
    radius: Float64

    def frames(self) -> tuple[Float64, Float64, Float64]:
        """(M, 3) unit vectors u, v, w, as `Tube.frame`."""
        a, b = self.slope.T
        wz = 1.0 / np.sqrt(a * a + b * b + 1.0)
        wx, wy = a * wz, b * wz
        ux = np.sqrt(1.0 - wx * wx)
        uy, uz = -wx * wy / ux, -wx * wz / ux
        v = (wy * uz - wz * uy, wz * ux - wx * uz, wx * uy - wy * ux)
        return np.stack([ux, uy, uz], axis=1), np.stack(v, axis=1), np.stack([wx, wy, wz], axis=1)

    def polar(self, points: Float64) -> tuple[Float64, Float64, Float64, Float64]:
        """(M, C) cosine, sine, distance and position along, as `Tube.polar`."""
        u, v, w = self.frames()
        height = points[:, 2]
        across = points[:, 0] - self.centre[:, :1] - self.slope[:, :1] * height
        up = points[:, 1] - self.centre[:, 1:] - self.slope[:, 1:] * height
        x, y = across * u[:, :1] + up * u[:, 1:2], across * v[:, :1] + up * v[:, 1:2]
        distance = np.sqrt(x * x + y * y) + 1e-9
        along = height / w[:, 2:] + across * w[:, :1] + up * w[:, 1:2]
        return x / distance, y / distance, distance, along

    def moved(self, found: Float64) -> tuple[Float64, Float64]:
        """Centres and slopes after the shifts and tilts in the first four columns of (M, P) parameters."""
        u, v, _ = self.frames()
        length = np.hypot(found[:, 0], found[:, 1]) + 1e-12
        shift = found[:, :2] * np.minimum(1.0, 0.5 * self.radius / length)[:, None]
        tilt = np.clip(found[:, 2:4], -0.2, 0.2)
        centre = self.centre + shift[:, :1] * u[:, :2] + shift[:, 1:] * v[:, :2]
        return centre, np.clip(self.slope + tilt[:, :1] * u[:, :2] + tilt[:, 1:] * v[:, :2], -0.6, 0.6)


@dataclass(frozen=True, eq=False)
class _Fitted:
    """The least-squares problems at M radii, P parameters each: all but the radius.

    Attributes:
        place: The axes they are linear about.
        normal: (M, P, P) normal matrices of the data.
        target: (M, P) their right sides.
        square: (M,) weighted square of the data.
        precision: (M, P) of the prior.
        mean: (M, P) of the prior.
    """

    place: _Places
    normal: Float64
    target: Float64
    square: Float64
    precision: Float64
    mean: Float64


def _radius_nodes(patches: Patches, tube: Tube, prior: StemPrior) -> Float64:
    """(15,) radii over +-3.2 standard deviations: even in the logarithm, or in the curvature where that is wide."""
    at = tube.polar(patches.position)
    design = at.design(prior.highest)
    normal = (design / patches.variance) @ design.T
    normal.flat[:: len(normal) + 1] += prior.precision(tube.radius, prior.highest) + 1e-6
    sd = np.sqrt(np.linalg.inv(normal)[4, 4]) / tube.radius
    sd = float(np.clip(np.hypot(sd, 0.003), 0.003, 0.35))
    step = np.linspace(-3.2, 3.2, _NODES)
    radii = np.exp(step * sd) if sd < 0.1 else 1.0 / np.clip(1.0 - 0.9 * step * sd, 0.25, 4.0)
    # Where both ends are cut off, the nodes must still be apart.
    return np.asarray(tube.radius * radii * np.exp(1e-6 * step))


def _at_nodes(patches: Patches, tube: Tube, prior: StemPrior, radii: Float64) -> _Fitted:
    """All but the radius fitted at each radius, by three Gauss-Newton steps of all nodes at once."""
    points, weight = patches.position, 1.0 / patches.variance
    at = tube.polar(points)
    seen_from = np.array([(at.cos * weight).sum(), (at.sin * weight).sum()]) / weight.sum()
    u, v, _ = tube.frame()
    away = (radii - tube.radius)[:, None]
    centre = tube.centre - away * (seen_from[0] * u[:2] + seen_from[1] * v[:2])
    places = _Places(centre, np.repeat(tube.slope[None], len(radii), axis=0), radii)
    precision = np.stack([prior.precision(float(radius), prior.highest) for radius in radii])
    precision = np.delete(precision, 4, axis=1) + 1e-6
    fitted = _linear(points, weight, places, precision, prior)
    for _ in range(2):
        normal = fitted.normal + precision[..., None] * np.eye(precision.shape[1])
        found = np.linalg.solve(normal, (fitted.target + precision * fitted.mean)[..., None])[..., 0]
        places = _Places(*places.moved(np.asarray(found, np.float64)), radii)
        fitted = _linear(points, weight, places, precision, prior)
    return fitted


def _linear(points: Float64, weight: Float64, places: _Places, precision: Float64, prior: StemPrior) -> _Fitted:
    cos, sin, distance, along = places.polar(points)
    parts = np.empty((precision.shape[1], *cos.shape))
    parts[0], parts[1] = cos, sin
    np.multiply(along, parts[:2], out=parts[2:4])
    np.negative(along, out=parts[4])
    wave_basis(cos, sin, prior.highest, out=parts[5:])
    design = parts.transpose(1, 0, 2)  # (M, P, C)
    target = distance - places.radius[:, None]
    weighted = design * weight
    u, v, _ = places.frames()
    mean = np.zeros_like(precision)
    mean[:, 2], mean[:, 3] = -(places.slope * u[:, :2]).sum(1), -(places.slope * v[:, :2]).sum(1)
    mean[:, 4] = prior.mean_taper(places.radius)
    return _Fitted(
        places,
        np.matmul(weighted, design.transpose(0, 2, 1)),
        np.matmul(weighted, target[..., None])[..., 0],
        (weight * target**2).sum(axis=1),
        precision,
        mean,
    )


def _diameters(
    radii: Float64, best: Float64, root: Float64, belief: Float64, seed: int
) -> tuple[dict[str, tuple[float, float, float]], Float64]:
    """Quantiles of the diameters over draws of the waves, and (72,) the outline's standard deviation."""
    n_widths, n_nodes, n_params = best.shape
    draws = _normal_draws(seed, n_widths, n_nodes, n_params)
    waves = (best[:, :, None] + np.matmul(draws, np.swapaxes(root, -1, -2)))[..., 5:]
    highest = 1 + waves.shape[-1] // 2
    basis = wave_basis(np.cos(_ANGLE), np.sin(_ANGLE), highest)
    outline = radii[None, :, None, None] + waves @ basis
    outline = np.maximum(outline, 0.2 * radii[None, :, None, None]).reshape(-1, N_OUTLINE)
    count = np.repeat(belief.ravel() / _DRAWS, _DRAWS)
    keep = count > 3e-4 * count.max()
    outline, count = outline[keep], count[keep] / count[keep].sum()
    square = outline * outline
    around = np.concatenate([outline[:, -1:], outline, outline[:, :1]], axis=1)
    slope = (around[:, 2:] - around[:, :-2]) * (0.5 / _ANGLE[1])
    lengths = {
        "tape": _reach(outline).mean(axis=1) * 2.0 * _DISCRETE,
        "curve": np.sqrt(square + slope * slope).mean(axis=1) * 2.0,
        "area": np.sqrt(square.mean(axis=1)) * 2.0,
    }
    mean = count @ outline
    spread = np.sqrt(np.maximum(count @ (outline - mean) ** 2, 0.0))
    return {name: _quantiles(np.log(values), count) for name, values in lengths.items()}, spread


@lru_cache(maxsize=8)
def _normal_draws(seed: int, n_widths: int, n_nodes: int, n_params: int) -> Float64:
    """(W, M, 4, P) antithetic draws: the same for every stem."""
    half = np.random.default_rng([seed, 205]).standard_normal((n_widths, n_nodes, _DRAWS // 2, n_params))
    return readonly(np.concatenate([half, -half], axis=2))


def _reach(outline: Float64) -> Float64:
    """(H, 36) how far (H, 72) outlines reach in every second direction, from the axis: where a tape would touch.

    It touches near that direction: further round even the largest radius reaches less far than the smallest does there.
    """
    steps = int(np.arccos(outline.min() / outline.max()) / _ANGLE[1]) + 1
    around = np.concatenate([outline[:, -steps:], outline, outline[:, :steps]], axis=1)
    reach = outline[:, ::2]
    for step in range(1, steps + 1):
        one, other = (around[:, first : first + N_OUTLINE : 2] for first in (steps - step, steps + step))
        reach = np.maximum(reach, np.maximum(one, other) * np.cos(_ANGLE[step]))
    return reach


def _quantiles(values: Float64, weight: Float64) -> tuple[float, float, float]:
    # Rounded: draws of one radius are often equal, and the last digit of a sum must not order them.
    order = np.argsort(np.round(values, 12), kind="stable")
    middle = np.cumsum(weight[order]) - 0.5 * weight[order]
    low, centre, high = np.interp([0.05, 0.5, 0.95], middle, values[order])
    return float(low), float(centre), float(high)
