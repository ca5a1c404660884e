"""From gestures to edits, on a plot of known stems: selections at full resolution, cuts, growth, a click on a stem."""

from __future__ import annotations

import numpy as np
import pytest
from tests.threestems import STEMS, plot_cloud, stem_points

from dbh_studio.app import edits
from dbh_studio.app.document import Document, SourceInfo
from dbh_studio.app.edit_pool import pool_about, pool_of
from dbh_studio.app.editing import (
    add_by_click,
    grow_trunk,
    shrink_trunk,
    split_by_line,
    split_by_plane,
    split_by_stems,
)
from dbh_studio.app.session import Session
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.picking import View
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.trunks import TrunkSet
from dbh_studio.errors import CommandError, UnscaledCloudError

FIRST = np.arange(30_000, 42_000)
SECOND = FIRST + 12_000


@pytest.fixture
def session() -> Session:
    """The first stem is trunk 1, the two others are, wrongly, trunk 2."""
    cloud = plot_cloud()
    others = np.concatenate([SECOND, SECOND + 12_000])
    trunks = TrunkSet.from_point_sets([FIRST, others])
    return Session(
        cloud, Document("plot", SourceInfo.of(cloud, "plot.ply"), scale=ScaleEstimate(1.0, "metres"), trunks=trunks)
    )


def test_a_selection_is_taken_among_all_points_or_within_a_trunk(session):
    x, y, _ = STEMS[0]
    view = View.looking_at((x, y - 10, 2.0), (x, y, 2.0))
    around = np.array([[0.4, 0.0], [0.6, 0.0], [0.6, 1.0], [0.4, 1.0]])
    document = session.document
    everything = pool_about(session, document, 1).lasso(view, around)
    own = pool_of(session, document, [1]).lasso(view, around)
    assert np.isin(own, FIRST).all() and len(own) > 11_000
    assert set(own) < set(everything) and (everything < 30_000).any()
    same = pool_of(session, document, [1]).rectangle(view, (0.4, 0.0), (0.6, 1.0))
    assert np.array_equal(same, own)
    brushed = pool_of(session, document, [1, 2]).brushed(view, [(0.5, 0.5)], 0.2)
    assert np.isin(brushed, FIRST).all() and len(brushed) > 100
    assert len(pool_of(session, document, []).lasso(view, around)) == 0
    with pytest.raises(CommandError):
        pool_of(session, document, [9])


def test_a_line_drawn_between_two_stems_parts_them(session):
    middle = np.array([(STEMS[1][0] + STEMS[2][0]) / 2, (STEMS[1][1] + STEMS[2][1]) / 2])
    view = View.looking_at((*middle, 20.0), (*middle, 0.0), up=(0, 1, 0))
    apart = np.array(STEMS[2][:2]) - STEMS[1][:2]
    across = np.array([-apart[1], apart[0]]) / np.linalg.norm(apart)
    ends = view.project(np.array([[*(middle + 2 * across), 1.0], [*(middle - 2 * across), 1.0]]))
    session.do(split_by_line(session, 2, view, *ends))
    assert sorted(len(trunk) for trunk in session.document.trunks) == [12_000] * 3
    assert {frozenset(each.points.tolist()) for each in session.document.trunks} == {
        frozenset(FIRST + 12_000 * i) for i in range(3)
    }
    with pytest.raises(CommandError, match="too short"):
        split_by_line(session, 1, view, (0.5, 0.5), (0.5, 0.5))
    with pytest.raises(CommandError, match="one side"):
        session.do(split_by_plane(session, 1, (-50.0, 0, 0), (1.0, 0, 0)))
    with pytest.raises(CommandError, match="no trunk 9"):
        split_by_plane(session, 9, (0, 0, 0), (1, 0, 0))


@pytest.mark.parametrize(
    ("first", "last"), [((0.6, -1.0), (1.6, 1.0)), ((0.6, 1.5), (1.6, 1.5)), ((-3.0, -1.0), (-0.6, 1.0))]
)
def test_a_line_drawn_beside_a_stem_does_not_cut_it(session, first, last):
    x, y, _ = STEMS[0]
    view = View.looking_at((x, y - 10, 2.0), (x, y, 2.0))

    def ends(low: tuple[float, float], high: tuple[float, float]) -> np.ndarray:
        return view.project(np.array([[x + across, y, 2.0 + up] for across, up in (low, high)]))

    document = session.document
    for line in (ends(first, last), ends(last, first)):
        with pytest.raises(CommandError, match="does not cross trunk 1"):
            split_by_line(session, 1, view, *line)
    assert session.document is document
    # On across the stem, to the other side, it cuts.
    session.do(split_by_line(session, 1, view, *ends((-0.6, -0.3), (0.6, 0.3))))
    assert len(session.document.trunks) == 3


def test_stems_are_parted_and_measured_apart(session):
    session.do(split_by_stems(session, 2))
    found = {}
    for trunk_id in session.document.trunks.ids:
        result = session.measurement(trunk_id).result
        found[trunk_id] = result.dbh_cm
    assert sorted(found.values()) == pytest.approx(sorted(100 * d for *_, d in STEMS), rel=0.02)
    with pytest.raises(CommandError, match="Only one stem"):
        split_by_stems(session, 1)


def test_a_click_on_a_stem_makes_a_trunk_of_it(session):
    session.do(edits.delete_trunks([1]))
    x, y, diameter = STEMS[0]
    command, note = add_by_click(session, (x - diameter / 2, y, 1.2))
    assert note == ""
    session.do(command)
    assert session.document.trunks.ids == (2, 3)
    assert session.measurement(3).result.dbh_cm == pytest.approx(30, rel=0.02)
    with pytest.raises(CommandError):
        add_by_click(session, (x - diameter / 2, y, 1.2))  # it belongs to a trunk now
    with pytest.raises(CommandError):
        add_by_click(session, (100.0, 100.0, 1.2))


def test_a_trunk_grows_into_what_is_free_and_shrinks_from_what_is_not():
    points = np.concatenate([stem_points(0.3), stem_points(0.2, seed=1) + [1.0, 0, 0]])
    cloud = PointCloud.from_points(points)
    half = np.flatnonzero((points[:12_000, 2] > 1.0) & (points[:12_000, 2] < 2.0))
    document = Document(
        "plot",
        SourceInfo.of(cloud, "plot.ply"),
        scale=ScaleEstimate(1.0, "metres"),
        trunks=TrunkSet.from_point_sets([half, np.arange(12_000, 24_000)]),
    )
    session = Session(cloud, document)
    session.do(grow_trunk(session, 1, 0.1))
    grown = session.document.trunks[1].points
    heights = cloud.xyz[grown, 2] + cloud.origin[2]
    assert len(grown) > 1.15 * len(half) and heights.min() > 0.9 - 1e-3 and heights.max() < 2.1 + 1e-3
    assert grown.max() < 12_000
    session.do(shrink_trunk(session, 1, 0.1))
    left = session.document.trunks[1].points
    heights = cloud.xyz[left, 2] + cloud.origin[2]
    assert len(left) < len(grown) and 0.95 < heights.min() < 1.05 and 1.95 < heights.max() < 2.05
    with pytest.raises(CommandError, match="Nothing"):
        shrink_trunk(session, 1, 2.0)


def test_an_unscaled_plot_says_what_is_needed_first():
    cloud = plot_cloud(unit_m=1.3)
    session = Session(
        cloud, Document("plot", SourceInfo.of(cloud, "plot.ply"), trunks=TrunkSet.from_point_sets([FIRST]))
    )
    for call in (lambda: split_by_stems(session, 1), lambda: add_by_click(session, (1, 1, 1))):
        with pytest.raises(UnscaledCloudError):
            call()
