"""The same seed gives the same diameters, to the last bit: in whatever order, in whatever company, on however many
threads the trees are measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from tests.threestems import stem_points

from dbh_studio.app import threads
from dbh_studio.app.derived import StemSetup
from dbh_studio.app.pipeline import measure_stems
from dbh_studio.core.ground import fit_ground
from dbh_studio.settings import GroundSettings, MeasureSettings
from dbh_studio.stages.measure import StemMeasurement

# Seven stems, some half seen, some thin, some bulging: what is hard is where chance would show.
N_STEMS = 7


@pytest.fixture(scope="module")
def plot() -> tuple[list[tuple[int, np.ndarray]], Any]:
    rng = np.random.default_rng(5)
    stems = []
    for number in range(N_STEMS):
        points = stem_points(0.12 + 0.06 * number, 4_000, seed=number)
        points[:, :2] += rng.normal(0, 0.004, (len(points), 2))
        angle = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
        points = points[np.abs(angle) < (180, 180, 110, 85, 180, 70, 180)[number]]
        points[np.abs(points[:, 2] - 1.4) < 0.05 * number, :2] *= 1.03
        stems.append((number + 1, (points + [3.0 * number, 0.5 * number, 0.0]).astype(np.float32)))
    ground = np.c_[rng.uniform(-2, 22, (20_000, 2)), rng.normal(0, 0.005, 20_000)]
    return stems, fit_ground(ground.astype(np.float32), settings=GroundSettings())


def measured(
    plot: tuple[list[tuple[int, np.ndarray]], Any], order: Sequence[int], settings: MeasureSettings
) -> dict[int, tuple[Any, ...]]:
    """All that is reported of each stem."""
    stems, ground = plot
    found = measure_stems([(*stems[k], StemSetup(settings)) for k in order], ground)
    return {stem.trunk_id: reported(stem) for stem in found}


def reported(stem: StemMeasurement) -> tuple[Any, ...]:
    result = stem.result
    fits = {name: getattr(fit, "outline_uv_m", np.zeros(0)).tobytes() for name, fit in result.fits.items()}
    numbers = getattr(result, "diameters", None), getattr(result, "flag_codes", None), getattr(result, "code", None)
    return (*numbers, fits, stem.xy_m.tobytes(), stem.z_ground_m)


@pytest.mark.parametrize("curve", ["shrinkage", "circle", "fourier"])
def test_order_company_and_threads_change_nothing(plot, monkeypatch, curve):
    settings = MeasureSettings(curve=curve)
    first = measured(plot, range(N_STEMS), settings)
    assert sum(found[0] is not None for found in first.values()) >= 4
    monkeypatch.setattr(threads, "_LEAST_POINTS", 0)
    for n_threads, order in ((1, (6, 5, 4, 3, 2, 1, 0)), (2, (3, 0, 6, 2, 5, 1, 4)), (5, (0, 6, 1, 5, 2, 4, 3))):
        monkeypatch.setattr(threads, "_N_THREADS", n_threads)
        assert measured(plot, order, settings) == first
    for alone in (0, 3, 6):
        assert measured(plot, (alone,), settings) == {alone + 1: first[alone + 1]}


def test_chance_that_stems_share_would_be_seen(plot, monkeypatch):
    """The test above could not pass if stems drew their samples from one another's dice."""
    settings = MeasureSettings(curve="fourier")
    first = measured(plot, range(N_STEMS), settings)
    dice = np.random.default_rng(1)
    monkeypatch.setattr("dbh_studio.core.curve_fits.np.random.default_rng", lambda *_: dice)
    assert measured(plot, range(N_STEMS), settings) != measured(plot, (6, 5, 4, 3, 2, 1, 0), settings)
    monkeypatch.undo()
    assert measured(plot, range(N_STEMS), settings) == first
    assert measured(plot, range(N_STEMS), settings.changed(seed=settings.seed + 1)) != first
