"""Spacing and normals against surfaces whose normals are known."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.neighbours import point_spacing, surface_normals
from dbh_studio.errors import CancelledError


def grid(spacing: float, n: int = 60) -> np.ndarray:
    x, y = np.meshgrid(np.arange(n) * spacing, np.arange(n) * spacing)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)])


@pytest.mark.parametrize("spacing", [0.01, 0.05, 0.3])
def test_spacing_of_a_square_grid(spacing: float) -> None:
    assert point_spacing(grid(spacing)) == pytest.approx(spacing, rel=0.05)


def test_spacing_needs_neighbours() -> None:
    assert np.isnan(point_spacing(np.zeros((6, 3))))


def test_normals_of_a_tilted_plane_far_from_the_origin() -> None:
    normal = np.array([0.3, -0.5, 0.8])
    normal /= np.linalg.norm(normal)
    points = grid(0.02)
    points[:, 2] = -(points[:, :2] @ normal[:2]) / normal[2]
    normals, variation = surface_normals(points + 1e5, radius=0.06)
    assert np.abs(normals @ normal).min() > 1 - 1e-6
    assert variation.max() < 1e-6


def test_normals_of_a_cylinder_point_at_its_axis() -> None:
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 90, endpoint=False), np.arange(0, 1, 0.02))
    points = np.column_stack([0.3 * np.cos(angle.ravel()), 0.3 * np.sin(angle.ravel()), height.ravel()])
    normals, variation = surface_normals(points, radius=0.06)
    outward = points[:, :2] / 0.3
    assert np.abs((normals[:, :2] * outward).sum(axis=1)).min() > 0.99
    assert np.abs(normals[:, 2]).max() < 0.05
    assert np.median(variation) < 0.02


def test_no_normal_without_neighbours_or_on_a_line() -> None:
    line = np.column_stack([np.arange(50) * 0.01, np.zeros(50), np.zeros(50)])
    lonely = np.array([[10.0, 0, 0], [20.0, 0, 0]])
    normals, variation = surface_normals(np.concatenate([line, lonely]), radius=0.05)
    assert np.isnan(normals).all()
    assert np.isnan(variation).all()
    assert surface_normals(np.empty((0, 3)), radius=1.0)[0].shape == (0, 3)


def test_cancel_stops_the_work() -> None:
    def cancel(fraction: float, message: str = "") -> None:
        raise CancelledError

    with pytest.raises(CancelledError):
        surface_normals(grid(0.02), radius=0.06, progress=cancel)
