"""How many stems are in a section, and which points are whose: twins, forks, neighbours in one cluster.

A second stem is looked for twice: as one of two rings that together explain all points better than any one ring does
(`search.search_rings`), so that a wide ring round both does not win; and in what the first stem leaves over.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from dbh_studio.core.arrays import Float64, Int64
from dbh_studio.core.estimator.heap import LIKELY_CLUTTER, signs_of
from dbh_studio.core.estimator.search import Rings, Search, find_rings
from dbh_studio.core.estimator.tube import Tube
from dbh_studio.core.medians import quantiles
from dbh_studio.core.section import ring_coverage

Beside = Literal["", "neighbour", "fork"]

_LEAST_GAIN = 0.15  # of log-likelihood per point; stems alone, clutter about them included, reach 0.1
MOST_STEMS = 4
"""More are not looked for."""

_BLURRED = 2.0
_FORK_DEPTH_M = 1.0  # below breast height
_ARC_DEG = 100.0
_NEIGHBOURHOOD_M = 1.0
_LEAST_POINTS = 40
_LEAST_REST = 0.12  # of all points
_CLEAN_SHARE = 0.85
_ON, _OWN, _INSIDE = 2.5, 3.5, 3.0  # standard deviations
_THICK, _THICK_THIN = 0.15, 0.25  # standard deviation over radius: more is no bark; of thin stems seen half round
_LEAST_STRETCH = 0.5  # of the first stem's: less is a whorl or a stub
_NEAR = 0.8  # of the sum of the radii; nearer it is the same stem again
_TELLS_APART = 0.8  # of the points of the stem that is measured; with more it may as well be the other one


@dataclass(frozen=True, eq=False)
class OtherStem:
    """Another stem in the section.

    Attributes:
        tube: A round one, heights from breast height.
        n_points: On it.
        claim: Of it to be the stem meant, relative to the first one: points times the stretch they are seen over.
        kind: ``fork`` where its axis meets the first one's within a metre below breast height.
        gap_m: Bark to bark.
    """

    tube: Tube
    n_points: int
    claim: float
    kind: Beside
    gap_m: float

    @property
    def may_be_meant(self) -> bool:
        """Whether it is about as likely the stem meant as the first one."""
        return self.claim >= _TELLS_APART


@dataclass(frozen=True, eq=False)
class Stems:
    """The stems in a section.

    Attributes:
        main: The one to be measured: most of the points are its.
        others: The others, that with most points first.
        points: (N, 3) the points that are none of the others'.
    """

    main: Tube
    others: tuple[OtherStem, ...]
    points: Float64


def stems_of(points: Float64, first: Tube, *, widest_m: float, seed: int, most: int = MOST_STEMS) -> Stems:
    """The stem that a search began with, and those beside it; the one with most points is the one meant.

    Args:
        points: (N, 3) points, z from breast height, x and y near zero.
        first: From the search.
        widest_m: Largest radius considered.
        seed: Of the random samples.
        most: Stems that are looked for.
    """
    known = [first]
    while len(known) < most:
        found = _one_more(points, known, widest_m, seed)
        if found is None:
            break
        known.append(found)
    if len(known) == 1:
        return Stems(first, (), points)
    owner = _owners(points, known)
    claims = np.array([_claim(points[owner == k, 2]) for k in range(len(known))])
    order = np.argsort(-claims, kind="stable")
    main = known[int(order[0])]
    others = tuple(_other(known[k], int((owner == k).sum()), claims[k] / claims[order[0]], main) for k in order[1:])
    taken = np.isin(owner, order[1:])
    return Stems(main, others, points[~taken])


def first_of(search: Search) -> Tube:
    """The ring to begin with: the likeliest, or where two explain the points much better than it, the likelier of them.

    Only that one: the other was found among the points of both, and is found again among what the first leaves over.
    If the likelier is much less sharp, it is a wide one through what it shares with the other, and the other is begun
    with.
    """
    if search.pair is None or search.gain < _LEAST_GAIN:
        return tube_of(search.rings, 0)
    one, other = sorted(search.pair)
    sigma = search.rings.sigma
    return tube_of(search.rings, other if sigma[one] > _BLURRED * sigma[other] else one)


def tube_of(rings: Rings, row: int) -> Tube:
    """One of the rings of a search, as a round tube."""
    middle = rings.middles()[row]
    return Tube(middle, rings.slope[row], float(rings.radius[row]), 0.0, np.empty(0), float(rings.sigma[row]))


def _one_more(points: Float64, known: list[Tube], widest_m: float, seed: int) -> Tube | None:
    """Another clean ring among the points that none of the known tubes explains, beside the first; None without one."""
    left = np.ones(len(points), bool)
    near = np.zeros(len(points), bool)
    for tube in known:
        error = _error(tube, points)
        left &= error > 3.0 * tube.sigma
        near |= error < _NEIGHBOURHOOD_M
    rest = points[left & near]
    if len(rest) < max(_LEAST_POINTS, _LEAST_REST * len(points)):
        return None
    rings, _ = find_rings(rest, widest_m=widest_m, taper=0.0, rng=np.random.default_rng([seed, 203]))
    if not len(rings.radius):
        return None
    found = tube_of(rings, 0)
    return found if _is_stem(found, rest, known, points) else None


def _is_stem(found: Tube, rest: Float64, known: list[Tube], points: Float64) -> bool:
    """Whether a ring is apart from the known ones, hollow and clean, of bark's thickness, and as tall."""
    for tube in known:
        apart = float(np.hypot(*(found.centre - tube.centre)))
        if apart < _NEAR * (found.radius + tube.radius):
            return False
    at = found.polar(rest)
    error = at.distance - found.radius
    on = np.abs(error) < _ON * found.sigma
    around = error < 0.5 * found.radius
    if on.sum() < max(_LEAST_POINTS, _CLEAN_SHARE * around.sum()):
        return False
    arc_deg, _ = ring_coverage(at.angle()[on])
    if found.sigma > (_THICK if arc_deg < 180.0 else _THICK_THIN) * found.radius:
        return False
    signs = signs_of(rest, found)
    if signs is None or signs.chance > LIKELY_CLUTTER:
        return False
    first = np.abs(_error(known[0], points)) < 3.0 * known[0].sigma
    return arc_deg >= _ARC_DEG and _stretch(rest[on, 2]) >= _LEAST_STRETCH * _stretch(points[first, 2])


def _error(tube: Tube, points: Float64) -> Float64:
    return np.asarray(tube.polar(points).distance - tube.radius)


def _owners(points: Float64, known: list[Tube]) -> Int64:
    """(N,) which tube each point is on, the nearest in its standard deviations; -1 for none."""
    away = np.stack([_away(_error(tube, points), tube.sigma) for tube in known])
    nearest = away.argmin(axis=0)
    return np.asarray(np.where(away.min(axis=0) < _OWN, nearest, -1), np.int64)


def _away(error: Float64, sigma: float) -> Float64:
    """(N,) distance in standard deviations; what is inside belongs to a stem unless it is on another one's bark."""
    away = np.abs(error) / sigma
    return np.where(error < 0.0, np.minimum(away, _INSIDE), away)


def _claim(heights: Float64) -> float:
    return len(heights) * max(_stretch(heights), 1e-3)


def _stretch(heights: Float64) -> float:
    """Length of stem over which points are seen."""
    if len(heights) < 2:
        return 0.0
    low, high = quantiles(heights, (0.05, 0.95))
    return high - low


def _other(tube: Tube, n_points: int, claim: float, main: Tube) -> OtherStem:
    away = tube.centre - main.centre
    apart = float(np.hypot(*away))
    closer_per_m = float((tube.slope - main.slope) @ away) / max(apart, 1e-9)
    meets = apart - _FORK_DEPTH_M * closer_per_m < 0.5 * max(tube.radius, main.radius)
    kind: Beside = "fork" if meets else "neighbour"
    return OtherStem(tube, n_points, float(claim), kind, max(apart - tube.radius - main.radius, 0.0))
