"""The open plot against field diameters by every method at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.threestems import STEMS, plot_cloud, stem_points

from dbh_studio.app import commands
from dbh_studio.app.document import Document, SourceInfo
from dbh_studio.app.evaluation import AS_MEASURED, EvaluationRequest, evaluate_plot
from dbh_studio.app.session import Session
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.corrections import Correction
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.trunks import TrunkSet

METHODS = {"shrinkage", "circle", "fourier", "ellipse", "bspline"}


@pytest.fixture
def field(tmp_path: Path) -> Path:
    path = tmp_path / "field.csv"
    path.write_text("tree,dbh_cm\n" + "".join(f"{k},{100 * d}\n" for k, (_, _, d) in enumerate((*STEMS, STEMS[0]), 1)))
    return path


@pytest.fixture(scope="module")
def session() -> Session:
    """Three stems, and one of which next to nothing is seen."""
    cloud = plot_cloud()
    sliver = stem_points(0.30, seed=9)
    sliver = sliver[np.abs(np.arctan2(sliver[:, 1], sliver[:, 0])) < np.radians(15)] + [2.0, 6.5, 0.0]
    first = len(cloud) - 36_000
    cloud = PointCloud.from_points(np.concatenate([cloud.xyz + cloud.origin, sliver]))
    point_sets = [np.arange(first + 12_000 * i, first + 12_000 * (i + 1)) for i in range(3)]
    point_sets.append(np.arange(first + 36_000, len(cloud)))
    source = SourceInfo.of(cloud, Path("plot.las"))
    trunks = TrunkSet.from_point_sets(point_sets)
    return Session(cloud, Document("plot", source, scale=ScaleEstimate(1.0, "metres"), trunks=trunks))


def test_every_method_is_a_line_and_a_refused_stem_is_refused_by_all(session, field):
    comparison = evaluate_plot(session, EvaluationRequest(field, every_method=True))
    assert comparison.methods[0] == "shrinkage" and set(comparison.methods) == METHODS
    for line in comparison.lines:
        assert (line.n_reference, line.n_measured, line.n_refused) == (4, 3, 1)
        assert abs(line.statistics.median_bias_cm) < (1.5 if line.method == "bspline" else 0.4)
        assert line.statistics.n_intervals == (3 if line.method in ("shrinkage", "circle") else 0)
    (why,) = {s.reason for s in comparison.samples if s.outcome == "refused"}
    assert "of the ring seen" in why
    # The plot's own line is what it is without the others.
    alone = evaluate_plot(session, EvaluationRequest(field))
    assert alone.lines[0].statistics == comparison.lines[0].statistics


def test_the_plots_diameters_have_no_methods_name_where_trees_have_their_own(session, field):
    session.do(commands.correct_measurement(2, Correction("curve", "ellipse")))
    try:
        comparison = evaluate_plot(session, EvaluationRequest(field, every_method=True))
    finally:
        session.undo()
    assert comparison.methods[0] == AS_MEASURED and set(comparison.methods) == METHODS | {AS_MEASURED}
    given = {(s.method, s.stem): s.estimated_cm for s in comparison.samples if s.outcome == "measured"}
    assert given[AS_MEASURED, "2"] == pytest.approx(given["ellipse", "2"], abs=0.006)
    assert given[AS_MEASURED, "1"] == pytest.approx(given["shrinkage", "1"], abs=0.006)
    assert given["shrinkage", "2"] != pytest.approx(given["ellipse", "2"], abs=0.001)
