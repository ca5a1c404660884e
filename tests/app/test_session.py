from __future__ import annotations

import itertools
import threading

import numpy as np
import pytest
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from tests.app.plots import make_cloud, make_document, make_session, make_trunks, trunk

from dbh_studio.app import commands
from dbh_studio.app.commands import Command
from dbh_studio.app.session import Session
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.trunks import TrunkSet
from dbh_studio.errors import CommandError, SettingError, StaleResultError, UnscaledCloudError

FEET = ScaleEstimate(0.3048, "feet")


def test_undo_returns_the_very_document_and_redo_the_later_one():
    session, _ = make_session()
    first = session.document
    assert not session.can_undo and not session.can_redo and session.undo_label == session.redo_label == ""
    session.do(commands.delete_trunk(2))
    second = session.document
    assert session.undo_label == "Delete trunk 2"
    session.do(commands.rename_plot("Stand 4"))
    assert (session.undo().after, session.undo().after) == (second, first)
    assert session.document is first and session.redo_label == "Delete trunk 2"
    session.redo()
    assert session.document is second
    session.do(commands.delete_trunk(3))
    assert not session.can_redo
    with pytest.raises(CommandError):
        session.redo()


def test_undoing_nothing_says_so():
    session, _ = make_session()
    with pytest.raises(CommandError, match="nothing to undo"):
        session.undo()


def test_a_refused_or_empty_command_leaves_no_trace():
    session, _ = make_session()
    heard = []
    session.subscribe(heard.append)
    with pytest.raises(CommandError):
        session.do(commands.delete_trunk(99))
    session.do(commands.rename_plot("plot"))
    assert not session.can_undo and heard == []


@pytest.mark.parametrize("metres_per_unit", [1e-9, 9.9e-7, 1.1e4, 1e300])
def test_a_scale_beyond_reason_is_refused_wherever_it_comes_from(metres_per_unit):
    session, _ = make_session()
    before = session.document
    with pytest.raises(SettingError, match="beyond reason"):
        session.do(commands.set_scale(ScaleEstimate(metres_per_unit, "factor")))
    assert session.document is before and not session.can_undo
    for least_or_most in (1e-6, 1e4):
        session.do(commands.set_scale(ScaleEstimate(least_or_most, "factor")))


def test_degrees_are_given_no_scale_but_everything_else_may_be_done():
    cloud = make_cloud()
    session = Session(cloud, make_document(cloud), is_geographic=True)
    before = session.document
    with pytest.raises(SettingError, match="degrees of longitude and latitude, which no scale turns into metres"):
        session.do(commands.set_scale(FEET))
    assert session.document is before
    with pytest.raises(SettingError, match="degrees"):
        session.require_scale()
    session.do(commands.rename_plot("somewhere"))
    session.do(commands.set_scale(ScaleEstimate()))
    with pytest.raises(UnscaledCloudError):
        session.require_scale()


@pytest.mark.parametrize(
    ("command", "moves"),
    [
        (commands.set_scale(FEET), True),
        (commands.set_up("+y"), True),
        (commands.set_frame(north=(1.0, 1.0, 0.0)), True),
        (commands.set_frame(origin_src=(1.0, 0.0, 0.0)), True),
        (commands.delete_trunk(2), False),
        (commands.change_settings("measure", curve="ellipse"), False),
        (commands.rename_plot("other"), False),
    ],
    ids=lambda value: getattr(value, "label", ""),
)
def test_a_change_says_whether_points_lie_elsewhere(command, moves):
    session, _ = make_session()
    assert session.do(command).moves_points is moves
    assert session.undo().moves_points is moves


def test_history_is_capped():
    session, _ = make_session(history_limit=3)
    for i in range(5):
        session.do(commands.rename_plot(f"name {i}"))
    for _ in range(3):
        session.undo()
    assert not session.can_undo and session.document.plot_id == "name 1"


def test_ids_are_not_reused_even_after_undo():
    session, _ = make_session(n_trunks=0)
    session.do(commands.replace_trunks(make_trunks(3)))
    session.undo()
    untouched = session.document.trunks
    session.do(commands.rename_plot("other"))
    assert session.document.trunks is untouched
    session.do(commands.replace_trunks(make_trunks(2)))
    assert session.document.trunks.ids == (4, 5)
    session.undo()
    assert session.document.trunks is untouched


def test_a_result_is_refused_when_what_it_read_has_changed_and_other_edits_are_kept():
    session, _ = make_session()
    then = session.document
    session.do(commands.rename_plot("renamed"))
    session.do(commands.set_tree_record(1, species="oak"))
    result = commands.replace_trunks(make_trunks(2))
    session.do(result, based_on=then, reads=("scale", "trunks", "settings.trunks"))
    assert session.document.plot_id == "renamed" and len(session.document.trunks) == 2
    session.undo()

    session.do(commands.change_settings("measure", curve="ellipse"))
    session.do(result, based_on=then, reads=("settings.trunks",))
    session.undo()
    for change, field in [
        (commands.set_scale(FEET), "scale"),
        (commands.set_up("+y"), "up_direction"),
        (commands.delete_trunk(3), "trunks"),
        (commands.change_settings("trunks", max_diameter_cm=150.0), "settings.trunks"),
        (commands.change_settings("ground", method="plane"), "settings"),
    ]:
        then = session.document
        session.do(change)
        now = session.document
        with pytest.raises(StaleResultError) as caught:
            session.do(result, based_on=then, reads=("plot_id", field))
        assert "changed" in caught.value.problem
        assert session.document is now
    with pytest.raises(ValueError, match="not a field"):
        session.do(result, based_on=then, reads=("colour",))


def test_a_result_that_names_nothing_it_read_is_stale_after_any_change():
    session, _ = make_session()
    then = session.document
    session.do(commands.rename_plot("renamed"))
    with pytest.raises(StaleResultError, match="name of the plot"):
        session.do(commands.delete_trunk(1), based_on=then)
    session.undo()
    session.do(commands.delete_trunk(1), based_on=then)


def test_listeners_hear_every_change_in_order_and_survive_each_other():
    session, _ = make_session()
    heard: list[str] = []

    def broken(change):
        raise RuntimeError("a listener's own fault")

    def meddling(change):
        if change.label == "Delete trunk 1":
            session.do(commands.rename_plot("meddled"))

    session.subscribe(broken)
    session.subscribe(meddling)
    unsubscribe = session.subscribe(lambda change: heard.append(change.label))
    session.do(commands.delete_trunk(1))
    session.undo()
    session.redo()
    unsubscribe()
    unsubscribe()
    session.undo()
    rename = "Rename the plot to meddled"
    assert heard == ["Delete trunk 1", rename, f"Undo: {rename}", f"Redo: {rename}"]


def test_many_threads_lose_no_edit():
    session, _ = make_session(n_trunks=40)
    heard = []
    session.subscribe(heard.append)
    threads = [
        threading.Thread(target=lambda ids=range(k, 41, 4): [session.do(commands.delete_trunk(i)) for i in ids])
        for k in range(1, 5)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(session.document.trunks) == 0 and len(heard) == 40
    assert all(a.after is b.before for a, b in itertools.pairwise(heard))


def test_a_read_only_session_refuses_every_change():
    session, _ = make_session(read_only=True)
    for change in (lambda: session.do(commands.delete_trunk(1)), session.undo, session.redo):
        with pytest.raises(CommandError, match="reading only"):
            change()


def test_a_document_of_another_cloud_is_a_programmers_mistake():
    with pytest.raises(ValueError, match="1000 points"):
        Session(make_cloud(999), make_document(make_cloud(1000)))


def test_an_unscaled_plot_is_measured_and_segmented_only_after_it_has_a_scale():
    session, stages = make_session(scale=ScaleEstimate())
    stem = session.measurement(1)
    assert not stem.result and stem.result.code == "unscaled" and "scale" in stem.result.remedy
    row = session.inventory().rows[0]
    assert row.dbh_cm is None and row.quality == "refused" and row.x_m is None
    with pytest.raises(UnscaledCloudError) as caught:
        session.require_scale()
    assert caught.value.remedy
    assert stages.measured == [] and stages.n_grounds == 0 and session.unmeasured() == ()
    session.do(commands.set_scale(FEET))
    session.require_scale()
    assert session.measurement(1).result.code == "too_few_points"


class Model(RuleBasedStateMachine):
    """Random edits against a list of documents: the plainest model of undo there is."""

    @initialize()
    def begin(self):
        self.session, _ = make_session(n_points=60, n_trunks=0)
        self.past = []
        self.future = []
        self.ids_before: set[int] = set()

    def _do(self, command: Command) -> None:
        before = self.session.document
        try:
            after = self.session.do(command).after
        except CommandError:
            assert self.session.document is before
            return
        if after is before:
            return
        self.past.append(before)
        self.future.clear()
        new = set(after.trunks.ids) - set(before.trunks.ids)
        if not command.label.startswith("Restore"):
            assert not new & self.ids_before, "an id was given out twice"
        self.ids_before |= new

    @rule(starts=st.lists(st.integers(0, 65), max_size=6), size=st.integers(1, 9))
    def replace_trunks(self, starts, size):
        sets = [trunk(i + 1, *range(start, start + size)) for i, start in enumerate(starts)]
        self._do(commands.replace_trunks(TrunkSet(tuple(sets))))

    @rule(trunk_id=st.integers(1, 12))
    def delete(self, trunk_id):
        self._do(commands.delete_trunk(trunk_id))

    @precondition(lambda self: self.past)
    @rule(trunk_id=st.integers(1, 12), data=st.data())
    def restore(self, trunk_id, data):
        self._do(commands.restore_trunk(data.draw(st.sampled_from(self.past)), trunk_id))

    @rule(trunk_id=st.integers(1, 12), species=st.sampled_from(["", "oak", "beech"]))
    def describe(self, trunk_id, species):
        self._do(commands.set_tree_record(trunk_id, species=species))

    @rule(factor=st.floats(0.1, 10))
    def scale(self, factor):
        self._do(commands.set_scale(ScaleEstimate(factor, "factor")))

    @rule(curve=st.sampled_from(["fourier", "ellipse", "bspline", "square"]))
    def settings(self, curve):
        self._do(commands.change_settings("measure", curve=curve))

    @rule()
    def undo(self):
        if not self.past:
            with pytest.raises(CommandError):
                self.session.undo()
            return
        self.future.append(self.session.document)
        self.session.undo()
        assert self.session.document is self.past.pop()

    @rule()
    def redo(self):
        if not self.future:
            with pytest.raises(CommandError):
                self.session.redo()
            return
        self.past.append(self.session.document)
        self.session.redo()
        assert self.session.document is self.future.pop()

    @invariant()
    def document_is_sound(self):
        document = self.session.document
        points = np.concatenate([np.empty(0, np.int32), *(t.points for t in document.trunks)])
        assert len(np.unique(points)) == len(points)
        assert set(document.trees) <= set(document.trunks.ids)
        assert self.session.next_id > max(self.ids_before, default=0)
        assert self.session.can_undo == bool(self.past) and self.session.can_redo == bool(self.future)


TestModel = Model.TestCase
TestModel.settings = hypothesis_settings(max_examples=60, stateful_step_count=25, deadline=None)
