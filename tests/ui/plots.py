"""A small plot with known trees for the studio's tests, made once per run of the tests."""

from __future__ import annotations

import functools
import time
from pathlib import Path
from typing import Any

import numpy as np

from dbh_studio.app.commands import replace_trunks
from dbh_studio.app.opening import open_plot
from dbh_studio.app.pipeline import Segmentation, segment_plot
from dbh_studio.app.session import Session
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.progress import Progress
from dbh_studio.core.synthetic import PlotRecipe, SyntheticPlot, make_plot
from dbh_studio.io.las import write_las
from dbh_studio.io.ply import write_ply
from dbh_studio.settings import Settings
from dbh_studio.stages.measure import StemMeasurement


@functools.cache
def plot() -> SyntheticPlot:
    """Five stems on gently sloping ground, 80 000 points."""
    return make_plot(PlotRecipe.simple(points=80_000, seed=7))


def write_laz(folder: Path, name: str = "plot.laz") -> Path:
    """The plot as a LAZ file, in metres."""
    path = folder / name
    write_las(path, plot().cloud)
    return path


@functools.cache
def _found() -> Segmentation:
    return segment_plot(plot().cloud.xyz, Settings())


def measured_session(folder: Path) -> Session:
    """The plot opened from a file, with its trunks found and measured; the work is done once per run of the tests."""
    session = open_plot(write_laz(folder), project_dir=folder / "plot.dbh")
    found = _found()
    session.remember_ground(session.document, found.ground)
    session.do(replace_trunks(found.trunks))
    document = session.document
    if not _measurements:
        _measurements.extend(session.measurements())
    session.remember_measurements(document, _measurements)
    return session


_measurements: list[StemMeasurement] = []


def write_unscaled_ply(folder: Path, *, metres_per_unit: float = 1.7) -> Path:
    """The plot as a photogrammetric PLY in an arbitrary unit."""
    cloud = plot().cloud
    path = folder / "unscaled.ply"
    scaled = PointCloud((cloud.xyz / metres_per_unit).astype(np.float32), np.zeros(3), cloud.rgb)
    write_ply(path, scaled)
    return path


def true_diameters_cm() -> np.ndarray:
    """What a tape reads at breast height on the plot's stems, ascending."""
    return np.sort([tree.diameter_cm("tape", height_m=1.30) for tree in plot().trees])


def endless_search(points_world: Any, settings: Settings, existing_ids: Any = None, *, progress: Progress) -> None:
    """In place of `segment_plot`, where a test needs the time to press Cancel."""
    for step in range(4000):
        progress(0.1 + step / 10_000, f"Looking behind tree {step}")
        time.sleep(0.02)


def endless_ground(points_world: Any, settings: Any, *, progress: Progress) -> None:
    """In place of `ground_of`."""
    endless_search(points_world, settings, progress=progress)
