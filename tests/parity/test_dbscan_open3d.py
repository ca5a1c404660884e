"""Clusters equal Open3D's DBSCAN."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dbh_studio.core.clusters import NOISE, dbscan


@pytest.fixture(scope="module")
def o3d() -> Any:
    try:
        import open3d
    except (ImportError, OSError) as error:
        pytest.skip(f"open3d cannot be imported: {error}")
    return open3d


def test_same_clusters(o3d: Any) -> None:
    rng = np.random.default_rng(0)
    centres = rng.uniform(0, 8, (12, 3)) * [1, 1, 0.2]
    points = np.concatenate(
        [centre + rng.normal(0, 0.08, (200, 3)) for centre in centres] + [rng.uniform(0, 8, (400, 3))]
    )
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    theirs = np.asarray(cloud.cluster_dbscan(eps=0.08, min_points=10, print_progress=False))
    ours = dbscan(points, distance=0.08, min_points=10)
    assert ours.max() >= 8
    assert np.array_equal(ours == NOISE, theirs == NOISE)
    # Border points between two clusters go to the nearer one here and to the first found there; core points agree.
    near = np.linalg.norm(points[:, None] - points[None], axis=2) <= 0.08
    core = near.sum(axis=1) >= 10
    pairs = {(int(a), int(b)) for a, b in zip(ours[core], theirs[core], strict=True)}
    assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})
