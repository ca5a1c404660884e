"""Circles in many sets at once, against circles that were drawn."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.rings import Rings, find_rings, refit_rings

OPTIONS = {"radius_min": 0.025, "radius_max": 1.0, "tolerance": 0.02}


def ring(
    x: float, y: float, radius: float, *, arc_deg: float = 360.0, n: int = 150, noise: float = 0.004
) -> np.ndarray:
    rng = np.random.default_rng(int(1000 * radius))
    angle, r = np.radians(rng.uniform(0, arc_deg, n)), radius + rng.normal(0, noise, n)
    return np.column_stack([x + r * np.cos(angle), y + r * np.sin(angle)]).astype(np.float32)


def best(rings: Rings, group: int) -> Rings:
    rows = np.flatnonzero(rings.group == group)
    return rings.subset(rows[[rings.n_on[rows].argmax()]])


@pytest.mark.parametrize("shift", [0.0, 900.0])
def test_every_set_gets_its_circle(shift: float) -> None:
    truth = [(0.0, 0.0, 0.05, 360.0), (3.0, 1.0, 0.2, 360.0), (6.0, -2.0, 0.6, 360.0), (9.0, 4.0, 0.25, 170.0)]
    sets = [ring(x + shift, y, r, arc_deg=arc) for x, y, r, arc in truth]
    rings = find_rings(np.concatenate(sets), np.repeat(np.arange(4), 150), **OPTIONS)
    for k, (x, y, radius, arc) in enumerate(truth):
        found = best(rings, k)
        assert np.hypot(*(found.xy[0] - [x + shift, y])) < 0.01 + 0.03 * radius
        assert found.radius[0] == pytest.approx(radius, abs=0.005 + 0.04 * radius)
        assert found.coverage_deg[0] == pytest.approx(arc, abs=25.0)
        assert found.inside_share[0] < 0.05


def test_two_touching_stems_in_one_set_are_two_circles() -> None:
    points = np.concatenate([ring(0, 0, 0.15), ring(0.31, 0, 0.16)])
    rings = find_rings(points, np.zeros(len(points), int), **OPTIONS)
    assert len(rings) == 2
    assert sorted(rings.xy[:, 0].round(1)) == [0.0, 0.3]


def test_foliage_is_not_hollow() -> None:
    cloud = np.random.default_rng(0).normal(0, 0.25, (400, 2)).astype(np.float32)
    found = best(find_rings(cloud, np.zeros(400, int), **OPTIONS), 0)
    stem = best(find_rings(ring(0, 0, 0.2), np.zeros(150, int), **OPTIONS), 0)
    assert found.inside_share[0] + found.clutter_share[0] > 0.5 > stem.inside_share[0] + stem.clutter_share[0]


def test_refit_starts_from_a_guess_and_measures_the_scatter() -> None:
    points = np.concatenate([ring(1, 1, 0.2, noise=0.01), ring(4, 0, 0.1, noise=0.002)])
    rings, scatter = refit_rings(
        points, np.repeat([0, 1], 150), np.array([[1.03, 0.98], [4.0, 0.02]]), np.array([0.22, 0.09]), tolerance=0.03
    )
    assert np.allclose(rings.xy, [[1, 1], [4, 0]], atol=0.005)
    assert np.allclose(rings.radius, [0.2, 0.1], atol=0.005)
    assert 1.4826 * scatter[0] == pytest.approx(0.01, rel=0.35)
    assert scatter[1] < 0.5 * scatter[0]


def test_too_few_points_give_no_circle() -> None:
    assert len(find_rings(np.empty((0, 2)), np.empty(0, int), **OPTIONS)) == 0
    assert len(find_rings(np.zeros((3, 2), np.float32), np.zeros(3, int), **OPTIONS)) == 0
