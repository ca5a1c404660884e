"""Ferns, grass, shrubs, branches and leaves: what stands between the camera and the stems, and above them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float, Float32, Float64, UInt8
from dbh_studio.core.synthetic.fields import Terrain
from dbh_studio.core.synthetic.recipe import PlotRecipe
from dbh_studio.core.synthetic.stems import Stem

SUN = np.array([0.35, -0.45, 0.82]) / np.linalg.norm([0.35, -0.45, 0.82])


def paint(base: NDArray[Any], shade: NDArray[Any]) -> UInt8:
    """(N, 3) colours: a base colour, or one per point, times a shade per point."""
    lit = np.asarray(base, np.float32) * np.asarray(shade, np.float32)[:, None]
    colours: UInt8 = np.clip(lit, 0, 255).astype(np.uint8)
    return colours


@dataclass(frozen=True, eq=False)
class Painted:
    """Some coloured points: (N, 3) float32 and (N, 3) uint8."""

    xyz: Float32
    rgb: UInt8

    @classmethod
    def empty(cls) -> Painted:
        """No points."""
        return cls(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))

    @classmethod
    def join(cls, parts: list[Painted]) -> Painted:
        """All points of `parts`, in order."""
        return cls(np.concatenate([part.xyz for part in parts]), np.concatenate([part.rgb for part in parts]))


def leaves(
    rng: np.random.Generator, centres: Float, n_points: int, *, size_m: float, rgb: NDArray[Any], flat: float = 0.5
) -> Painted:
    """Points on small elliptic discs of random tilt.

    Args:
        centres: (L, 3) where the leaves are.
        size_m: Half length of a leaf.
        rgb: (L, 3) colour of each leaf.
        flat: 0 leaves hang anyhow, 1 they lie level.
    """
    n_leaves = len(centres)
    if not n_leaves or n_points <= 0:
        return Painted.empty()
    normal = rng.normal(size=(n_leaves, 3)) * (1 - flat) + np.array([0, 0, 1.0]) * flat
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    length = np.cross(normal, rng.normal(size=(n_leaves, 3)))
    length /= np.linalg.norm(length, axis=1, keepdims=True)
    width = np.cross(normal, length) * 0.55
    leaf = rng.integers(0, n_leaves, n_points)
    radius, angle = size_m * np.sqrt(rng.random(n_points)), rng.uniform(0, 2 * np.pi, n_points)
    a, b = (radius * np.cos(angle))[:, None], (radius * np.sin(angle))[:, None]
    xyz = centres[leaf] + a * length[leaf] + b * width[leaf]
    shade = 0.62 + 0.45 * np.abs(normal @ SUN) * rng.uniform(0.7, 1.2, n_leaves)
    return Painted(xyz.astype(np.float32), paint(rgb[leaf], shade[leaf]))


def _spread(rng: np.random.Generator, rgb: tuple[int, int, int], n: int, amount: float = 0.16) -> Float64:
    """(n, 3) colours about one colour: lighter and darker, yellower and bluer."""
    light = 1 + amount * rng.normal(size=(n, 1))
    tint = 1 + 0.35 * amount * rng.normal(size=(n, 3)) * np.array([1.6, 0.5, 1.2])
    colours: Float64 = np.clip(np.array(rgb) * light * tint, 8, 250)
    return colours


def ferns(rng: np.random.Generator, places: Float64, terrain: Terrain, n_points: int) -> Painted:
    """Rosettes of arching fronds at (P, 2) places."""
    n_plants, n_fronds = len(places), 11
    if not n_plants:
        return Painted.empty()
    size = rng.uniform(0.35, 0.85, n_plants)
    frond = rng.integers(0, n_plants * n_fronds, n_points)
    plant = frond // n_fronds
    heading = rng.uniform(0, 2 * np.pi, n_plants * n_fronds)
    reach = np.repeat(size, n_fronds) * rng.uniform(0.75, 1.2, n_plants * n_fronds)
    rise = rng.uniform(0.55, 1.0, n_plants * n_fronds)
    along = rng.beta(1.3, 1.1, n_points)
    # Pinnae stand in pairs with gaps between them, and shorten towards the tip.
    along = (np.floor(along * 16) + 0.65 * rng.random(n_points)) / 16
    side = rng.uniform(-1, 1, n_points) * 0.17 * (1 - along) ** 0.7 * np.minimum(1, 5 * along + 0.15)
    length = reach[frond]
    out, across = length * along * (1 - 0.12 * along), length * side
    up = length * rise[frond] * (1.45 * along - 1.25 * along**2) - 0.25 * np.abs(across)
    cos, sin = np.cos(heading[frond]), np.sin(heading[frond])
    xy = places[plant] + np.stack([out * cos - across * sin, out * sin + across * cos], axis=1)
    xyz = np.column_stack([xy, terrain.z(places)[plant] + 0.03 + up])
    colour = _spread(rng, (112, 152, 62), n_plants * n_fronds)
    brown = rng.random(n_plants * n_fronds) < 0.08
    colour[brown] = _spread(rng, (150, 112, 62), int(brown.sum()))
    shade = 0.55 + 0.5 * along + 0.1 * rng.normal(size=n_points)
    return Painted(xyz.astype(np.float32), paint(colour[frond], shade))


def grass(rng: np.random.Generator, places: Float64, terrain: Terrain, n_points: int) -> Painted:
    """Tufts of bent blades at (P, 2) places."""
    n_tufts, n_blades = len(places), 26
    if not n_tufts:
        return Painted.empty()
    n = n_tufts * n_blades
    root = np.repeat(places, n_blades, axis=0) + rng.normal(0, 0.05, (n, 2))
    heading, length, bend = rng.uniform(0, 2 * np.pi, n), rng.uniform(0.12, 0.42, n), rng.uniform(0.1, 0.8, n)
    blade, along = rng.integers(0, n, n_points), rng.random(n_points)
    out = (length * bend)[blade] * along**1.8
    up = length[blade] * along * (1 - 0.45 * bend[blade] * along)
    xy = root[blade] + np.stack([out * np.cos(heading[blade]), out * np.sin(heading[blade])], axis=1)
    colour = _spread(rng, (136, 150, 78), n)
    xyz = np.column_stack([xy, terrain.z(places)[blade // n_blades] + up])
    return Painted(xyz.astype(np.float32), paint(colour[blade], 0.6 + 0.45 * along))


def shrubs(rng: np.random.Generator, places: Float64, heights_m: Float64, terrain: Terrain, n_points: int) -> Painted:
    """Bushes of many thin stems with leaves at their ends, at (P, 2) places."""
    n_plants, n_twigs = len(places), 16
    if not n_plants:
        return Painted.empty()
    n = n_plants * n_twigs
    base = np.column_stack([places, terrain.z(places)])
    heading, spread = rng.uniform(0, 2 * np.pi, n), np.sqrt(rng.random(n)) * 0.55
    height = np.repeat(heights_m, n_twigs) * rng.uniform(0.55, 1.0, n)
    reach = np.stack([spread * np.cos(heading), spread * np.sin(heading)], axis=1) * height[:, None]
    n_wood = n_points // 8
    twig, along = rng.integers(0, n, n_wood), rng.random(n_wood)
    wood = base[twig // n_twigs].copy()
    wood[:, :2] += reach[twig] * along[:, None] ** 0.8
    wood[:, 2] += height[twig] * along
    wood += rng.normal(0, 0.004, wood.shape)
    n_leaves = max(1, n_points // 14)
    twig, where = rng.integers(0, n, n_leaves), rng.beta(2.2, 1.0, n_leaves)
    centres = base[twig // n_twigs].copy()
    centres[:, :2] += reach[twig] * where[:, None]
    centres[:, 2] += height[twig] * where
    centres += rng.normal(0, 0.07, centres.shape)
    green = leaves(rng, centres, n_points - n_wood, size_m=0.035, rgb=_spread(rng, (98, 134, 62), n_leaves))
    bark = paint(_spread(rng, (112, 92, 70), n_wood), np.ones(n_wood))
    return Painted.join([Painted(wood.astype(np.float32), bark), green])


def crown(rng: np.random.Generator, stem: Stem, n_points: int) -> Painted:
    """Branches and leaves of one tree; a dead one keeps only bare branches."""
    base, top = stem.species.crown_base * stem.height_m, stem.height_m
    spread = (0.9 + 9.0 * stem.radius_m) * (0.75 if stem.species.conifer else 1.15)
    n_branches = int(np.clip((top - base) * (5.5 if stem.species.conifer else 3.0), 10, 90))
    share = rng.beta(1.0, 1.5, n_branches)
    if stem.species.conifer:
        share = (np.floor(share * n_branches / 5) + 0.15 * rng.random(n_branches)) * 5 / n_branches
        reach, rise = spread * (1.05 - share) ** 0.8, rng.normal(-0.12, 0.1, n_branches) + 0.45 * share
    else:
        reach = spread * np.sqrt(np.clip(1 - (1.6 * share - 0.55) ** 2 / 1.4, 0.1, 1))
        rise = rng.normal(0.55, 0.2, n_branches)
    reach *= rng.uniform(0.65, 1.1, n_branches)
    root = stem.axis(base + share * (top - base) * 0.97)
    heading = rng.uniform(0, 2 * np.pi, n_branches)

    def along(branch: NDArray[np.intp], t: Float) -> Float64:
        flat = reach[branch] * t
        up = flat * rise[branch] + 0.12 * flat * (t if not stem.species.conifer else -t)
        return root[branch] + np.column_stack([flat * np.cos(heading[branch]), flat * np.sin(heading[branch]), up])

    n_wood = n_points if stem.status == "dead" else n_points // 7
    branch, t = rng.integers(0, n_branches, n_wood), rng.random(n_wood) ** 1.3
    thick = (0.10 * stem.radius_m + 0.008) * (1.05 - t)
    wood = along(branch, t) + rng.normal(size=(n_wood, 3)) * thick[:, None]
    bark = paint(_spread(rng, stem.species.bark_rgb, n_wood, 0.07), np.full(n_wood, 0.72))
    if stem.status == "dead":
        return Painted(wood.astype(np.float32), bark)
    n_sprays = max(1, (n_points - n_wood) // 6)
    branch, t = rng.integers(0, n_branches, n_sprays), rng.beta(2.4, 1.0, n_sprays)
    centres = along(branch, t)
    tangle = (0.10 + 0.13 * reach[branch] * (1.1 - 0.4 * t))[:, None]
    centres += rng.normal(size=(n_sprays, 3)) * tangle * np.array([1, 1, 0.45 if stem.species.conifer else 0.8])
    colour = _spread(rng, stem.species.leaf_rgb, n_sprays) * (0.8 + 0.3 * rng.random((n_sprays, 1)))
    green = leaves(rng, centres, n_points - n_wood, size_m=0.08, rgb=colour, flat=0.4)
    return Painted.join([Painted(wood.astype(np.float32), bark), green])


def stubs(rng: np.random.Generator, stem: Stem, n_points: int) -> Painted:
    """Dead branch stubs on the bole of a conifer, from above head height to the crown."""
    top = stem.species.crown_base * stem.height_m
    if not stem.species.conifer or n_points <= 0 or top < 2.6:
        return Painted.empty()
    n = int(4 + 2.5 * (top - 2.2))
    height, heading = rng.uniform(2.2, top, n), rng.uniform(0, 2 * np.pi, n)
    length, droop = rng.uniform(0.15, 0.9, n), rng.normal(0.0, 0.2, n)
    which, t = rng.integers(0, n, n_points), rng.random(n_points)
    out = stem.mean_radius(height)[which] + length[which] * t
    xyz = stem.axis(height)[which]
    xyz += np.column_stack([out * np.cos(heading[which]), out * np.sin(heading[which]), out * droop[which]])
    xyz += rng.normal(size=xyz.shape) * (0.009 * (1.1 - t))[:, None]
    return Painted(xyz.astype(np.float32), paint(_spread(rng, (128, 116, 104), n_points, 0.08), np.full(n_points, 0.8)))


def clumps(rng: np.random.Generator, recipe: PlotRecipe, n: int, *, n_per_clump: float, spread_m: float) -> Float64:
    """(n, 2) places inside the plot, gathered in clumps as plants are."""
    n_clumps = max(1, round(n / n_per_clump))
    middles = rng.uniform(0, recipe.side_m, (n_clumps, 2))
    places = middles[rng.integers(0, n_clumps, n)] + rng.normal(0, spread_m, (n, 2))
    inside: Float64 = np.clip(places, 0.3, recipe.side_m - 0.3)
    return inside


def thicket(rng: np.random.Generator, stem: Stem) -> tuple[Float64, Float64]:
    """(P, 2) places and (P,) heights of the shrubs that leave one sector of a stem in sight."""
    assert stem.hidden_azimuth is not None
    angle = stem.hidden_azimuth + np.linspace(0.7, 2 * np.pi - 0.7, 13) + rng.normal(0, 0.06, 13)
    distance = stem.radius_m + rng.uniform(1.0, 1.7, 13)
    places = stem.base[:2] + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return places, rng.uniform(1.9, 2.7, 13)
