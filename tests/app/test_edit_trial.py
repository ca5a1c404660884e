"""Edits tried out before they are done, what they did, what can be brought back, and what a gesture chooses from."""

from __future__ import annotations

import numpy as np
import pytest
from tests.threestems import STEMS, plot_cloud

from dbh_studio.app import commands, edits
from dbh_studio.app.commands import Command
from dbh_studio.app.document import Document, SourceInfo
from dbh_studio.app.edit_pool import ABOUT_M, blocks_of, middle_of, pool_about, pool_in_view, pool_of, prepare
from dbh_studio.app.edit_trial import do_edit, effects_of, gone_trunks
from dbh_studio.app.session import Session
from dbh_studio.core.dbh import DbhEstimate
from dbh_studio.core.picking import View
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.trunks import TrunkSet
from dbh_studio.errors import CommandError

FIRST = np.arange(30_000, 42_000)
SECOND, THIRD = FIRST + 12_000, FIRST + 24_000
# Height of the ground in the world: its origin is the cloud's, a whole number of metres below the lowest point.
GROUND = 1.0


@pytest.fixture
def session() -> Session:
    cloud = plot_cloud()
    trunks = TrunkSet.from_point_sets([FIRST, SECOND, THIRD])
    return Session(
        cloud, Document("plot", SourceInfo.of(cloud, "plot.ply"), scale=ScaleEstimate(1.0, "metres"), trunks=trunks)
    )


# ---- trying out


def test_what_an_edit_changes_is_measured_when_listeners_hear_of_it(session):
    session.measurements()
    waiting = []
    session.subscribe(lambda change: waiting.append(session.unmeasured()))
    upper = FIRST[session.points_world()[FIRST][:, 2] > GROUND + 2.5]
    change = do_edit(session, lambda: edits.split_trunk(1, [upper, np.setdiff1d(FIRST, upper)]))
    assert waiting == [()]
    effects = {effect.trunk_id: effect for effect in effects_of(session, change)}
    assert set(effects) == {1, 4}
    assert (effects[4].was_there, effects[4].is_there, effects[4].before) == (False, True, None)
    assert isinstance(effects[1].before, DbhEstimate)
    assert effects[1].before.dbh_cm == pytest.approx(100 * STEMS[0][2], rel=0.02)
    session.undo()
    assert waiting == [(), ()]


def test_nothing_is_measured_while_there_is_no_ground(session):
    do_edit(session, lambda: edits.merge_trunks([1, 2]))
    assert not session.has_ground()
    assert session.unmeasured() == (1, 3)
    assert session.document.trunks.ids == (1, 3)


def test_an_edit_of_what_the_person_did_not_see_is_refused(session):
    seen = session.document
    session.do(commands.delete_trunk(3))
    now = session.document
    with pytest.raises(CommandError, match="changed meanwhile"):
        do_edit(session, lambda: edits.delete_trunks([1]), seen=seen)
    assert session.document is now

    def make_while_another_tab_edits() -> Command:
        session.do(commands.delete_trunk(2))
        return edits.delete_trunks([1])

    with pytest.raises(CommandError, match="changed meanwhile"):
        do_edit(session, make_while_another_tab_edits, seen=now)
    assert session.document.trunks.ids == (1,)


def test_what_others_say_of_trees_or_of_the_plot_meanwhile_is_kept(session):
    def make() -> Command:
        session.do(commands.rename_plot("north"))
        return edits.merge_trunks([1, 2])

    do_edit(session, make)
    assert session.document.plot_id == "north" and session.document.trunks.ids == (1, 3)

    def while_somebody_writes() -> Command:
        session.do(commands.set_tree_record(3, note="leans"))
        return edits.delete_trunks([3])

    with pytest.raises(CommandError, match="changed meanwhile"):
        do_edit(session, while_somebody_writes)
    assert session.document.record(3).note == "leans"


def test_numbers_once_given_out_are_not_given_out_again(session):
    do_edit(session, lambda: edits.add_trunk(np.arange(100)))
    assert session.document.trunks.ids == (1, 2, 3, 4)
    session.undo()
    do_edit(session, lambda: edits.add_trunk(np.arange(100)))
    assert session.document.trunks.ids == (1, 2, 3, 5)


def test_an_edit_that_changes_nothing_leaves_no_trace(session):
    change = do_edit(session, lambda: edits.drop_points(np.arange(10), 1))
    assert change.before is change.after and not session.can_undo
    assert effects_of(session, change) == ()
    with pytest.raises(CommandError):
        do_edit(session, lambda: edits.delete_trunks([9]))


def test_of_many_changed_trees_nothing_is_told(session):
    sets = [np.arange(1000 * i, 1000 * i + 500) for i in range(8)]
    change = session.do(commands.replace_trunks(TrunkSet.from_point_sets(sets)))
    assert effects_of(session, change) == ()


# ---- bringing back


def test_deleted_trunks_are_listed_until_their_points_are_taken(session):
    assert gone_trunks(session) == []
    session.do(edits.delete_trunks([2]))
    session.do(edits.delete_trunks([1]))
    assert [(i, label) for i, label, _ in gone_trunks(session)] == [(1, "Delete trunk 1"), (2, "Delete trunk 2")]
    trunk_id, _, earlier = gone_trunks(session)[1]
    session.do(commands.restore_trunk(earlier, trunk_id))
    assert [i for i, _, _ in gone_trunks(session)] == [1]
    assert np.array_equal(session.document.trunks[2].points, SECOND)
    session.do(edits.assign_points(FIRST, 2))
    assert gone_trunks(session) == []


def test_what_was_merged_is_not_offered(session):
    session.do(edits.merge_trunks([1, 2]))
    assert gone_trunks(session) == []


# ---- what there is to choose from


def test_the_pool_about_a_trunk_is_all_within_a_metre_of_its_box(session):
    document, points = session.document, session.points_world()
    pool = pool_about(session, document, 1)
    own = points[FIRST]
    inside = ((points >= own.min(axis=0) - ABOUT_M) & (points <= own.max(axis=0) + ABOUT_M)).all(axis=1)
    assert np.array_equal(pool.rows, np.flatnonzero(inside))
    assert np.array_equal(pool.points, points[pool.rows])
    owners = pool.owners(document.trunks, session)
    assert (owners[np.isin(pool.rows, FIRST)] == 1).all() and (owners[pool.rows < 30_000] == 0).all()
    assert np.array_equal(pool_of(session, document, [3, 1]).rows, np.concatenate([FIRST, THIRD]))
    assert middle_of(session, document, 1) == pytest.approx([STEMS[0][0], STEMS[0][1], GROUND + 2.5], abs=0.05)
    sliced = pool.between(GROUND + 1.2, GROUND + 1.4)
    assert 0 < len(sliced) < 0.1 * len(pool)
    assert np.abs(sliced.points[:, 2] - GROUND - 1.3).max() <= 0.1001
    with pytest.raises(CommandError):
        pool_about(session, document, 9)


def test_without_a_scale_what_is_about_a_trunk_comes_from_its_size():
    cloud = plot_cloud(unit_m=0.01)
    trunks = TrunkSet.from_point_sets([FIRST])
    session = Session(cloud, Document("plot", SourceInfo.of(cloud, "plot.ply"), trunks=trunks))
    pool = pool_about(session, session.document, 1)
    assert len(FIRST) < len(pool) < 0.5 * len(cloud)


def test_gestures_choose_what_they_touch(session):
    x, y, diameter = STEMS[0]
    view = View.looking_at((x, y - 5.0, GROUND + 1.3), (x, y, GROUND + 1.3))
    pool = pool_about(session, session.document, 1)
    corners = np.array([[0.4, 0.4], [0.6, 0.6]])
    box = pool.rectangle(view, *corners)
    polygon = corners[[0, 1, 1, 0]][:, [0, 1]].copy()
    polygon[1] = [0.6, 0.4]
    polygon[3] = [0.4, 0.6]
    assert np.array_equal(box, pool.lasso(view, polygon)) and len(box) > 500
    path = view.project(np.array([[x, y - diameter / 2, GROUND + z] for z in np.linspace(0.8, 1.8, 60)]))
    brushed = pool.brushed(view, path, 0.1)
    place = session.points_world()[brushed] - [0.0, 0.0, GROUND]
    assert place[:, 2].min() > 0.65 and place[:, 2].max() < 1.95 and np.ptp(place[:, 2]) > 1.0
    assert place[:, 1].max() < y  # of the side one sees
    assert len(pool.brushed(view, np.empty((0, 2)), 0.1)) == 0
    assert len(pool.brushed(view, [[0.01, 0.01]], 0.1)) == 0


def test_a_view_gives_what_is_about_as_far_away_as_its_middle(session):
    # From the north-west the first stem hides nothing of the second one, 4 m behind it.
    one, two = (np.array([*stem[:2], GROUND + 1.3]) for stem in STEMS[:2])
    away = (one - two) / np.linalg.norm(one - two)
    view = View.looking_at(one + 4.0 * away, one)
    pool = pool_in_view(session, session.document, view, [[0.3, 0.2], [0.7, 0.8]])
    assert np.isin(FIRST, pool.rows).mean() > 0.3
    assert not np.isin(SECOND, pool.rows).any()
    empty = pool_in_view(
        session, session.document, View.looking_at((0, 0, 50), (0, 0, 90), up=(0, 1, 0)), [[0, 0], [1, 1]]
    )
    assert len(empty) < 10


def test_the_blocks_are_made_once_and_anew_when_the_plot_is_turned(session):
    blocks = blocks_of(session)
    prepare(session)
    assert blocks_of(session) is blocks and blocks.xyz is session.points_world()
    session.do(commands.set_scale(ScaleEstimate(2.0, "by hand")))
    assert blocks_of(session) is not blocks
    assert blocks_of(session).xyz is session.points_world()
