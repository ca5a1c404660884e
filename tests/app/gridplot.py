"""A plot whose stems stand on a grid, each a heap of ten points: its places are known, its stems are all refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tests.app.plots import METRES, CountingStages, make_trunks

from dbh_studio.app.derived import Derived
from dbh_studio.app.document import Document, SourceInfo
from dbh_studio.app.session import Session
from dbh_studio.core.cloud import PointCloud

SPACING_M = 4.0


def grid_session(n_trunks: int = 9, *, crs: str | None = None, seed: int = 0, spacing_m: float = SPACING_M) -> Session:
    """Stems 1 to n, by rows of three; the heaps are irregular, so that no motion lays the plot on itself."""
    rng = np.random.default_rng(seed)
    places = spacing_m * np.array([divmod(k, 3) for k in range(n_trunks)], float) + rng.uniform(-1, 1, (n_trunks, 2))
    points = np.repeat(np.column_stack([places, np.full(n_trunks, 1.3)]), 10, axis=0)
    points += rng.uniform(-0.05, 0.05, points.shape)
    points = np.concatenate([points, rng.uniform(-2, 3 * spacing_m, (200, 3)) * [1, 1, 0]])
    cloud = PointCloud(points.astype(np.float32), np.array([500_000.0, 4_500_000.0, 100.0]), name="grid.ply", crs=crs)
    stages = CountingStages()
    derived = Derived(cloud, fit_ground=stages.fit_ground, measure_trunk=stages.measure_trunk)
    document = Document("grid", SourceInfo.of(cloud, Path("grid.ply")), scale=METRES, trunks=make_trunks(n_trunks))
    return Session(cloud, document, derived=derived)
