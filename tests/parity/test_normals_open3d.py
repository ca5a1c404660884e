"""Normals equal Open3D's hybrid search."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dbh_studio.core.neighbours import surface_normals


@pytest.fixture(scope="module")
def o3d() -> Any:
    try:
        import open3d
    except (ImportError, OSError) as error:
        pytest.skip(f"open3d cannot be imported: {error}")
    return open3d


def test_same_normals(o3d: Any) -> None:
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, 2 * np.pi, 4000), rng.uniform(0, 1.5, 4000)
    radius = 0.25 + rng.normal(0, 0.004, 4000)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=0.08, max_nn=20), fast_normal_computation=False)
    theirs = np.asarray(cloud.normals)
    ours = surface_normals(points, radius=0.08, max_neighbours=20)[0]
    angle_between = np.degrees(np.arccos(np.clip(np.abs((ours * theirs).sum(axis=1)), 0, 1)))
    # A neighbour exactly on the rim may be counted by one and not by the other.
    assert np.quantile(angle_between, 0.999) < 0.1
