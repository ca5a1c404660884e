"""Small plots and stand-ins for the slow stages, for the tests of the app layer."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dbh_studio.app.derived import Derived
from dbh_studio.app.document import Document, SourceInfo
from dbh_studio.app.session import Session
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.dbh import Refusal
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.trunks import Trunk, TrunkSet
from dbh_studio.stages.measure import StemMeasurement

METRES = ScaleEstimate(1.0, "metres")


def make_cloud(n_points: int = 1000, *, seed: int = 0, **others) -> PointCloud:
    xyz = np.random.default_rng(seed).uniform(0, 10, (n_points, 3)).astype(np.float32)
    return PointCloud(xyz, np.array([500_000.0, 4_500_000.0, 100.0]), name="plot.ply", **others)


def make_trunks(n_trunks: int, *, size: int = 10, first: int = 0) -> TrunkSet:
    starts = first + size * np.arange(n_trunks)
    return TrunkSet.from_point_sets([np.arange(start, start + size) for start in starts])


def make_document(cloud: PointCloud, *, n_trunks: int = 0, scale: ScaleEstimate = METRES, **fields) -> Document:
    source = SourceInfo.of(cloud, Path("plot.ply"))
    return Document("plot", source, scale=scale, trunks=make_trunks(n_trunks), **fields)


class FlatGround:
    """Ground at z = 0."""

    kind = "plane"
    notes = ()

    def z_at(self, xy_world):
        return np.zeros(len(xy_world))

    def height_above(self, points_world):
        return points_world[:, 2]


class CountingStages:
    """Counts how often each stage is asked; a measurement is a refusal that carries the mean x of its points."""

    def __init__(self) -> None:
        self.n_grounds = 0
        self.measured: list[int] = []

    def fit_ground(self, points_world, *, settings, progress, seed=0):
        self.n_grounds += 1
        return FlatGround()

    def measure_trunk(self, points_world, *, trunk_id, ground, settings, scale_sd=0.0):
        self.measured.append(trunk_id)
        mean = points_world.mean(axis=0).astype(np.float64)
        result = Refusal("too_few_points", f"{settings.curve} {mean[0]:.6f}", "Walk closer.")
        return StemMeasurement(trunk_id, result, mean[:2], 0.0, len(points_world), ground.kind)


def make_session(*, n_points: int = 1000, n_trunks: int = 5, **options) -> tuple[Session, CountingStages]:
    cloud = make_cloud(n_points)
    document = make_document(cloud, n_trunks=n_trunks, scale=options.pop("scale", METRES))
    stages = CountingStages()
    derived = Derived(cloud, fit_ground=stages.fit_ground, measure_trunk=stages.measure_trunk)
    return Session(cloud, document, derived=derived, **options), stages


def trunk(trunk_id: int, *points: int, origin: str = "geometry") -> Trunk:
    return Trunk(trunk_id, np.array(sorted(points), np.int32), origin)


def contents(document: Document) -> tuple:
    """Everything a Document says, comparable; the next id apart, which only grows."""
    trunks = tuple((t.id, t.origin, t.points.tobytes()) for t in document.trunks)
    fields = (document.plot_id, document.source.fingerprint, document.up_direction, document.scale, document.settings)
    return (*fields, trunks, dict(document.trees))
