"""Heaps without a stem, through which a ring can be laid all the same: leaves, shrubs, slash, boulders, people."""

from __future__ import annotations

import zlib
from collections.abc import Callable

import numpy as np

from dbh_studio.core.synthetic.fields import WaveField

Rng = np.random.Generator
_TOP_M = 3.0


def _box(rng: Rng, n: int) -> np.ndarray:
    """A block of leaves, evenly filled."""
    width = rng.uniform(0.15, 1.5)
    return np.column_stack([rng.uniform(-width / 2, width / 2, (n, 2)), rng.uniform(0, _TOP_M, n)])


def _cloud(rng: Rng, n: int) -> np.ndarray:
    """A cloud that thins outwards."""
    return np.column_stack([rng.normal(0, rng.uniform(0.15, 1.5) / 4, (n, 2)), rng.uniform(0, _TOP_M, n)])


def _directions(rng: Rng, n: int) -> np.ndarray:
    towards = rng.standard_normal((n, 3))
    return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True))


def _dome(rng: Rng, n: int) -> np.ndarray:
    """A heap of leaves, filled."""
    inside = _directions(rng, n) * (rng.random(n) ** (1 / 3))[:, None]
    inside[:, 2] = np.abs(inside[:, 2])
    return inside * _dome_size(rng)


def _dome_size(rng: Rng) -> np.ndarray:
    across = rng.uniform(0.2, 0.9)
    return np.array([across, across * rng.uniform(0.6, 1.0), rng.uniform(1.4, 2.6)])


def _lumpy(rng: Rng, towards: np.ndarray, rough: float) -> np.ndarray:
    """(N,) how far a rough surface lies out, relative."""
    field = WaveField.random(rng, n_dims=3, wavelengths_m=(0.3, 1.5), amplitude=rough)
    return np.asarray(1.0 + field(towards))


def _one_sided(rng: Rng, points: np.ndarray) -> np.ndarray:
    """What can be seen from a sector, as in a walk past it."""
    half = np.radians(rng.uniform(120, 420) / 2)
    middle = rng.uniform(0, 2 * np.pi)
    off = np.abs((np.arctan2(points[:, 1], points[:, 0]) - middle + np.pi) % (2 * np.pi) - np.pi)
    return points[off <= half]


def _shell(rng: Rng, n: int) -> np.ndarray:
    """The same heap as cameras see it: its outside."""
    towards = _directions(rng, n)
    towards[:, 2] = np.abs(towards[:, 2])
    out = _lumpy(rng, towards, rng.uniform(0.05, 0.2))
    points = towards * out[:, None] * _dome_size(rng)
    return _one_sided(rng, points + rng.normal(0, rng.uniform(0.01, 0.04), points.shape))


def _ball(rng: Rng, n: int) -> np.ndarray:
    """A round bush: leaves that grow thinner inwards."""
    towards = _directions(rng, n)
    radius = rng.uniform(0.2, 0.9)
    out = _lumpy(rng, towards, rng.uniform(0.05, 0.2)) - rng.exponential(rng.uniform(0.1, 0.4), n)
    size = radius * np.array([1.0, rng.uniform(0.7, 1.0), rng.uniform(0.8, 2.0)])
    return _one_sided(rng, towards * np.maximum(out, 0.0)[:, None] * size + [0, 0, rng.uniform(0.9, 1.7)])


def _bush(rng: Rng, n: int) -> np.ndarray:
    """Many thin stems from one foot, with leaves."""
    n_stems = int(rng.integers(6, 25))
    which = rng.integers(0, n_stems, n)
    foot, lean = rng.normal(0, 0.1, (n_stems, 2)), rng.normal(0, 0.25, (n_stems, 2))
    height = rng.uniform(0, 2.5, n)
    angle, radius = rng.uniform(0, 2 * np.pi, n), rng.uniform(0.004, 0.02, n_stems)[which]
    across = foot[which] + lean[which] * height[:, None]
    across += radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]) + rng.normal(0, 0.006, (n, 2))
    is_leaf = rng.random(n) < rng.uniform(0.2, 0.8)
    across[is_leaf] += rng.normal(0, rng.uniform(0.05, 0.25), (int(is_leaf.sum()), 2))
    return np.column_stack([across, height])


def _slash(rng: Rng, n: int) -> np.ndarray:
    """Branches and poles thrown on a heap, lying every way."""
    n_poles = int(rng.integers(10, 40))
    which = rng.integers(0, n_poles, n)
    along = rng.normal(0, [1.0, 1.0, 0.35], (n_poles, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    middle = rng.normal(0, [0.35, 0.35, 0.0], (n_poles, 3)) + np.column_stack(
        [np.zeros((n_poles, 2)), rng.uniform(0.1, rng.uniform(1.5, 2.5), n_poles)]
    )
    radius = rng.uniform(0.01, 0.08, n_poles)[which]
    across = np.cross(along[which], _directions(rng, n))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    length = rng.uniform(0.4, 1.2, n_poles)[which] * rng.uniform(-1, 1, n)
    return middle[which] + length[:, None] * along[which] + radius[:, None] * across + rng.normal(0, 0.008, (n, 3))


def _boulder(rng: Rng, n: int) -> np.ndarray:
    """A boulder, bare: a sharp surface, but one that closes towards the top and has corners."""
    towards = _directions(rng, n)
    towards[:, 2] = np.abs(towards[:, 2])
    corners = rng.uniform(2.0, 5.0)
    out = (np.abs(towards) ** corners).sum(axis=1) ** (-1 / corners) * _lumpy(rng, towards, rng.uniform(0.02, 0.1))
    size = [rng.uniform(0.3, 1.0), rng.uniform(0.3, 1.0), rng.uniform(1.4, 2.4)]
    return _one_sided(rng, towards * out[:, None] * size + rng.normal(0, rng.uniform(0.004, 0.015), (n, 3)))


def _crate(rng: Rng, n: int) -> np.ndarray:
    """Upright faces: a crate, a sign, a pile of sawn timber."""
    side = rng.uniform(0.15, 1.2, 2)
    place, face = rng.uniform(-1, 1, n), rng.integers(0, 4, n)
    sign = np.where(face % 2, 1.0, -1.0)
    x, y = np.where(face < 2, sign, place) * side[0] / 2, np.where(face < 2, place, sign) * side[1] / 2
    points = np.column_stack([x, y, rng.uniform(0, rng.uniform(1.5, 2.5), n)])
    return _one_sided(rng, points + rng.normal(0, rng.uniform(0.004, 0.015), (n, 3)))


def _person(rng: Rng, n: int) -> np.ndarray:
    """Somebody who stood still: legs, trunk, arms, head, each an upright oval."""
    tall = rng.uniform(1.55, 1.95)
    half_width, half_depth = rng.uniform(0.15, 0.22), rng.uniform(0.09, 0.15)
    low = np.array([0.0, 0.0, 0.48, 0.45, 0.45, 0.86]) * tall
    high = np.array([0.48, 0.48, 0.84, 0.82, 0.82, 1.0]) * tall
    x0 = np.array([-0.1, 0.1, 0.0, -half_width - 0.05, half_width + 0.05, 0.0])
    a, b = np.array([0.08, 0.08, half_width, 0.05, 0.05, 0.08]), np.array([0.09, 0.09, half_depth, 0.05, 0.05, 0.1])
    part = rng.choice(6, n, p=[0.15, 0.15, 0.4, 0.1, 0.1, 0.1])
    angle, height = rng.uniform(0, 2 * np.pi, n), rng.uniform(0, 1, n)
    wide = 1.0 - 0.15 * np.sin(3 * height) * (part == 2)
    x, y = x0[part] + a[part] * wide * np.cos(angle), b[part] * wide * np.sin(angle)
    points = np.column_stack([x, y, low[part] + height * (high - low)[part]])
    return _one_sided(rng, points + rng.normal(0, rng.uniform(0.006, 0.02), (n, 3)))


def _fern(rng: Rng, n: int) -> np.ndarray:
    """Fronds that rise from one foot and bend over."""
    n_fronds = int(rng.integers(8, 30))
    which = rng.integers(0, n_fronds, n)
    turn, reach = rng.uniform(0, 2 * np.pi, n_fronds)[which], rng.uniform(0.3, 1.0, n_fronds)[which]
    top, along = rng.uniform(1.0, 2.2, n_fronds)[which], rng.random(n)
    out = reach * along**1.5
    points = np.column_stack([out * np.cos(turn), out * np.sin(turn), top * (1.5 * along - 0.6 * along**2)])
    return points + rng.normal(0, rng.uniform(0.01, 0.06), (n, 3))


HEAPS: dict[str, Callable[[Rng, int], np.ndarray]] = {
    "box of leaves": _box,
    "cloud of leaves": _cloud,
    "dome, filled": _dome,
    "dome, its outside": _shell,
    "round bush": _ball,
    "many thin stems": _bush,
    "slash": _slash,
    "boulder": _boulder,
    "crate": _crate,
    "person": _person,
    "fern": _fern,
}


def make_heap(kind: str, seed: int) -> np.ndarray:
    """(N, 3) points of a heap, z above ground."""
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode())])
    n = int(np.exp(rng.uniform(np.log(400), np.log(9000))))
    points = HEAPS[kind](rng, n)
    return points[points[:, 2] > 0.0]
