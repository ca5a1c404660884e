"""Passes that do not fit together: walls that are shifted against each other, with one radius in common.

Who walks round a stem sees it in passes, and each pass may be off as a whole by a centimetre or two. The bark then has
two walls where passes overlap, and one that is out of place where they do not. One curve through all of it follows now
this wall and now that one, and reads too thick or too thin by several per cent. So the points are taken once more as
walls shifted against each other, with one radius and one shape in common (`walls`), and what two walls and three say is
averaged by evidence.

With so much freedom a stem on which passes do fit is measured worse than by one curve. So two regressions on signs that
do not depend on the stem's size (how much of the noise goes away, how much likelier the points become per patch, how
far the passes are apart, how sure the radius is, how thick the walls are) say how likely there are such passes, and how
far to follow: `trust` is the share of the way from the one curve that made the errors least, which is near zero but
where the signs are plain. A third, on what the one curve shows already, tells where hardly anything would be moved, so
that many stems are not looked at. All were found on generated stems with development seeds by
`bench/estimator_passes.py`, which says what each is fitted to. What moves is the size; how much longer a tape is than
the circle of the same area is left to the one curve, which follows finer waves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Float64, readonly
from dbh_studio.core.estimator.prior import StemPrior
from dbh_studio.core.estimator.skew import surface_shift
from dbh_studio.core.estimator.tube import Tube
from dbh_studio.core.estimator.walls import FIRST_SHIFT, FIRST_WAVE, MOST_PASSES, RADIUS, Walls, bark_of, walls_of

_FURTHEST = 0.12  # in the logarithm of the diameter
_MOST_GAP_DEG = 200.0  # of a shorter arc the size hangs on its shape alone
_SUSPECT = 0.08
_DOUBT = 0.05  # trust up to which nothing is moved
_ROUND = 0.003  # ovals below this are alike
_LEAST_SIGMA_M, _MOST_SIGMA_M = 0.002, 0.04
# Intercept, and slopes on the signs in the order of `Passes.signs`; printed by `bench/estimator_passes.py`.
_CHANCE = np.array([-0.298, 11.0, 0.632, -0.473, -0.242, -0.696, -3.18, 2.68, -0.255, -1.16, 1.08])
_TRUST = np.array([-9.3, 5.73, -0.0885, -0.853, -0.759, 2.55, -0.0247, 4.81, -0.133, -0.784, 0.231])
_LOOK = np.array([0.379, 5.57, 0.922, 0.379, 0.305, 0.413])  # the same of `is_suspect`


@dataclass(frozen=True, eq=False)
class Passes:
    """What the section is if the points are of passes that do not fit together.

    Attributes:
        radius_m: Mean radius at breast height, without the shifts.
        waves_m: (4,) a₂, b₂, a₃, b₃ of the outline about it.
        separation_m: Root mean square distance of the passes from their mean, by how many points are of each.
        log_area_m: Logarithm of the diameter of the circle of the same area.
        probability: That there are such passes, where half of all stems were so.
        trust: How far to move the diameter towards this one, 0-1.
        signs: (10,) that both are regressions of.
    """

    radius_m: float
    waves_m: Float64
    separation_m: float
    log_area_m: float
    probability: float
    trust: float
    signs: Float64

    def log_shift(self, log_area_m: float) -> float:
        """How far to move the logarithms of all diameters, given that of the area's by one curve."""
        followed = max(self.trust - _DOUBT, 0.0) / (1.0 - _DOUBT)
        return followed * float(np.clip(self.log_area_m - log_area_m, -_FURTHEST, _FURTHEST))


def passes_of(
    points: Float64,
    tube: Tube,
    prior: StemPrior,
    *,
    gap_deg: float,
    wall_ratio: float,
    oval: float,
    bloat_chance: float = 0.0,
    bloat_m: float = 0.0,
) -> Passes | None:
    """The section as seen in passes that do not fit together; None where too few points are near the tube.

    The result does not depend on the order of the points.

    Args:
        points: (N, 3) points, as the tube was fitted to.
        tube: The likeliest one of one curve.
        prior: Of the stem.
        gap_deg: Largest unseen sector.
        wall_ratio: Of `Evidence`.
        oval: `evidence.oval_of` the tube.
        bloat_chance: Prior probability of bloat, see `skew.surface_shift`.
        bloat_m: Usual bloat.
    """
    bark = bark_of(points, tube, gap_deg)
    if bark is None:
        return None
    walls = walls_of(bark, tube, prior)
    belief = np.exp(walls.evidence[1:] - walls.evidence[1:].max())
    belief /= belief.sum()
    best = 1 + int(belief.argmax())
    radii, waves = tube.radius + walls.found[1:, RADIUS], belief @ walls.found[1:, FIRST_WAVE:FIRST_SHIFT]
    shift, _ = surface_shift(walls.off[best], _inner(walls.off[best]), chance=bloat_chance, usual_m=bloat_m)
    radius = float(belief @ radii)
    variance = float(belief @ (walls.radius_sd[1:] ** 2 + (radii - radius) ** 2))
    separation = _separation(walls, best)
    by_fits = _signs_of(walls, best, separation, radius, float(bark.weight.sum()))
    told = [min(-shift / walls.sigma[best], 1.5), np.log(max(wall_ratio, 1.0)), np.log(oval + _ROUND)]
    told += [max(gap_deg - 30.0, 0.0) / 100.0, 0.5 * np.log(variance / radius**2)]
    signs = np.asarray([*by_fits, *told], np.float64)
    radius = max(radius + shift, 0.5 * tube.radius)
    return Passes(
        radius,
        readonly(waves),
        separation,
        0.5 * float(np.log(4.0 * radius**2 + 2.0 * waves @ waves)),  # waves add half their square to the area's radius
        _logistic(_CHANCE, signs),
        _logistic(_TRUST, signs) if gap_deg <= _MOST_GAP_DEG else 0.0,
        readonly(signs),
    )


def is_suspect(tube: Tube, *, gap_deg: float, wall_ratio: float, oval: float) -> bool:
    """Whether it is worth while to look for passes: without it nothing would be moved, mostly.

    Args:
        tube: The likeliest one of one curve.
        gap_deg: Largest unseen sector.
        wall_ratio: Of `Evidence`.
        oval: `evidence.oval_of` the tube.
    """
    told = [np.log(max(wall_ratio, 1.0)), np.log(oval + _ROUND), np.log(tube.sigma / tube.radius), np.log(tube.radius)]
    told.append(max(gap_deg - 30.0, 0.0) / 100.0)
    return gap_deg <= _MOST_GAP_DEG and _logistic(_LOOK, np.array(told)) > _SUSPECT


def _logistic(coefficients: Float64, signs: Float64) -> float:
    """Probability by an intercept and slopes."""
    return float(1.0 / (1.0 + np.exp(-np.clip(coefficients[0] + coefficients[1:] @ signs, -30.0, 30.0))))


def _separation(walls: Walls, best: int) -> float:
    """Root mean square distance of the passes from their mean."""
    share, at = walls.share[best], walls.found[best, FIRST_SHIFT:].reshape(MOST_PASSES, 2)
    return float(np.sqrt(share @ ((at - share @ at) ** 2).sum(axis=1)))


def _signs_of(walls: Walls, best: int, separation: float, radius: float, n_patches: float) -> list[float]:
    """Of passes that do not fit together, by the fits; bloat, walls, oval, gap and certainty come after them."""
    sigma = float(walls.sigma[best])
    return [
        float(np.log(walls.sigma[0] / sigma)),
        float(np.log(separation / sigma + 0.1)),
        float(np.log(separation / radius + 0.003)),
        float(np.log(sigma / radius)),
        10.0 * float(walls.evidence[best] - walls.evidence[0]) / n_patches,
    ]


def _inner(off: Float64) -> float:
    """Robust width of the noise, from the points inside the surface."""
    inside = -off[off < 0]
    sigma = 1.4826 * float(np.median(inside)) if len(inside) > 5 else _MOST_SIGMA_M
    return float(np.clip(sigma, _LEAST_SIGMA_M, _MOST_SIGMA_M))
