"""Corrections of trunks as commands: ids stay stable, no point is lost or owned twice, records follow."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from tests.app.plots import contents, make_cloud, make_document, make_session, trunk

from dbh_studio.app import commands, edits
from dbh_studio.app.document import Document
from dbh_studio.core.inventory import TreeRecord
from dbh_studio.core.trunks import MAX_TRUNK_ID, TrunkSet
from dbh_studio.errors import CommandError


@pytest.fixture
def document() -> Document:
    """Trunks 1, 2, 3 of points 0-9, 10-19, 20-29."""
    return make_document(make_cloud(), n_trunks=3)


def points_of(document: Document, trunk_id: int) -> list[int]:
    return document.trunks[trunk_id].points.tolist()


@pytest.mark.parametrize(
    "command",
    [
        edits.merge_trunks([1]),
        edits.merge_trunks([]),
        edits.merge_trunks([1, 9]),
        edits.merge_trunks([1, 2], into=3),
        edits.split_trunk(9, [[1, 2, 3], [4, 5, 6]]),
        edits.split_trunk(1, [[0, 1, 2]]),
        edits.split_trunk(1, []),
        edits.split_trunk(1, [[0, 1, 2], [2, 3, 4]]),
        edits.split_trunk(1, [[0, 1, 2], [3, 4, 15]]),
        edits.split_trunk(1, [[0, 1, 2], [3, 4]]),
        edits.add_trunk(np.arange(10)),
        edits.add_trunk(np.array([], int)),
        edits.add_trunk(np.array([998, 999, 1000])),
        edits.assign_points(np.array([-1, 50]), 1),
        edits.assign_points(np.array([50]), 9),
        edits.drop_points(np.array([1]), 9),
        edits.keep_only(np.array([1]), 9),
        edits.delete_trunks([1, 9]),
        edits.renumber_trunk(9, 10),
        edits.renumber_trunk(1, 2),
        edits.renumber_trunk(1, 0),
        edits.renumber_trunk(1, MAX_TRUNK_ID + 1),
        edits.group_stems([1]),
        edits.group_stems([1, 9]),
        edits.ungroup_stems([9]),
    ],
    ids=lambda command: command.label,
)
def test_an_edit_that_makes_no_sense_is_refused_in_words(document, command):
    before = contents(document)
    with pytest.raises(CommandError) as caught:
        command.apply(document)
    assert len(caught.value.problem) > 10
    assert contents(document) == before


def test_merging_keeps_one_id_and_fills_up_what_was_said():
    trees = {
        1: TreeRecord(note="leans"),
        2: TreeRecord(species="oak", tag="17", note="twin"),
        3: TreeRecord(species="beech"),
    }
    document = make_document(make_cloud(), n_trunks=3, trees=trees)
    after = edits.merge_trunks([3, 2, 1]).apply(document)
    assert after.trunks.ids == (1,) and points_of(after, 1) == list(range(30))
    assert after.trees[1] == TreeRecord(species="oak", tag="17", note="leans; twin", edited=True)
    into = edits.merge_trunks([1, 2], into=2).apply(document)
    assert into.trunks.ids == (2, 3) and into.trees[2].note == "twin; leans"
    assert edits.add_trunk(np.arange(50, 60)).apply(after).trunks.ids == (1, 4)  # 2 and 3 are not given out again


def test_the_larger_part_keeps_the_id_and_the_tag():
    record = TreeRecord(species="oak", tag="17", note="forked", status="live")
    document = make_document(make_cloud(), n_trunks=1, trees={1: record})
    after = edits.split_trunk(1, [[0, 1, 2], [3, 4, 5, 6], [7, 8, 9]]).apply(document)
    assert points_of(after, 1) == [3, 4, 5, 6] and points_of(after, 2) == [0, 1, 2] and points_of(after, 3) == [7, 8, 9]
    assert after.trees[1].tag == "17" and after.trees[1].edited
    assert after.trees[2] == TreeRecord(species="oak", status="live", edited=True)
    assert after.trunks[2].origin == "hand"


def test_what_is_in_no_part_is_set_free(document):
    after = edits.split_trunk(1, [[0, 1, 2], [3, 4, 5]]).apply(document)
    assert (after.trunks.labels(1000)[6:10] == 0).all()


def test_a_new_trunk_leaves_others_alone_unless_it_may_take(document):
    after = edits.add_trunk(np.arange(25, 40)).apply(document)
    assert points_of(after, 4) == list(range(30, 40)) and len(after.trunks[3]) == 10
    taking = edits.add_trunk(np.arange(25, 40), may_take=True).apply(document)
    assert points_of(taking, 4) == list(range(25, 40)) and points_of(taking, 3) == list(range(20, 25))
    assert taking.trees[3].edited and taking.trees[4].edited
    swallowed = edits.add_trunk(np.arange(18, 40), may_take=True).apply(document)
    assert swallowed.trunks.ids == (1, 2, 4)  # nothing of 3 was left


def test_points_change_hands(document):
    after = edits.assign_points(np.array([15, 16, 500]), 1).apply(document)
    assert points_of(after, 1) == [*range(10), 15, 16, 500]
    assert points_of(after, 2) == [10, 11, 12, 13, 14, 17, 18, 19]
    assert edits.assign_points(np.array([3, 4]), 1).apply(document) is document
    gone = edits.assign_points(np.arange(10, 19), 1).apply(document)
    assert gone.trunks.ids == (1, 3)


def test_points_are_taken_off(document):
    after = edits.drop_points(np.array([3, 4, 15, 700])).apply(document)
    assert len(after.trunks[1]) == 8 and len(after.trunks[2]) == 9
    assert len(edits.drop_points(np.array([3, 15]), 1).apply(document).trunks[2]) == 10
    assert edits.drop_points(np.array([700])).apply(document) is document
    assert edits.drop_points(np.arange(9), 1).apply(document).trunks.ids == (2, 3)
    assert points_of(edits.keep_only(np.array([1, 2, 3, 15]), 1).apply(document), 1) == [1, 2, 3]
    assert edits.keep_only(np.arange(10), 1).apply(document) is document


def test_a_new_number_takes_record_and_group_along():
    trees = {1: TreeRecord(species="oak", tree_id=1), 2: TreeRecord(tree_id=1)}
    document = make_document(make_cloud(), n_trunks=3, trees=trees)
    after = edits.renumber_trunk(1, 12).apply(document)
    assert after.trunks.ids == (2, 3, 12) and points_of(after, 12) == list(range(10))
    assert after.trees[12] == TreeRecord(species="oak", tree_id=12) and after.trees[2].tree_id == 12
    assert edits.renumber_trunk(1, 1).apply(document) is document


def test_stems_are_grouped_and_ungrouped(document):
    grouped = edits.group_stems([3, 2]).apply(document)
    assert grouped.record(2).tree_id == grouped.record(3).tree_id == 2 and grouped.record(1).tree_id is None
    assert edits.group_stems([2, 3]).apply(grouped) is grouped
    assert dict(edits.ungroup_stems([2, 3]).apply(grouped).trees) == {}
    assert edits.ungroup_stems([1]).apply(document) is document


def test_a_stem_that_gave_its_number_to_a_tree_leaves_it():
    trees = {1: TreeRecord(tree_id=1), 2: TreeRecord(tree_id=1), 3: TreeRecord(tree_id=1, species="oak")}
    document = make_document(make_cloud(), n_trunks=3, trees=trees)
    after = edits.ungroup_stems([1]).apply(document)
    assert dict(after.trees) == {2: TreeRecord(tree_id=2), 3: TreeRecord(tree_id=2, species="oak")}
    # One that is left alone is a tree of its own.
    assert dict(edits.ungroup_stems([1, 2]).apply(document).trees) == {3: TreeRecord(species="oak")}
    assert dict(edits.ungroup_stems([3]).apply(document).trees) == {
        1: TreeRecord(tree_id=1),
        2: TreeRecord(tree_id=1),
        3: TreeRecord(species="oak"),
    }


def test_a_number_that_other_stems_have_as_their_tree_is_not_free():
    trees = {2: TreeRecord(tree_id=7), 3: TreeRecord(tree_id=7)}
    document = make_document(make_cloud(), n_trunks=3, trees=trees)
    with pytest.raises(CommandError, match="tree number 7"):
        edits.renumber_trunk(1, 7).apply(document)
    assert edits.renumber_trunk(1, 8).apply(document).trunks.ids == (2, 3, 8)


def test_deleting_several_is_one_step():
    session, _ = make_session()
    session.do(edits.delete_trunks([4, 2]))
    assert session.document.trunks.ids == (1, 3, 5) and session.undo_label == "Delete trunks 2 and 4"
    session.undo()
    assert session.document.trunks.ids == (1, 2, 3, 4, 5)


def test_only_what_was_edited_is_measured_again():
    session, stages = make_session()
    session.measurements()
    stages.measured.clear()
    session.do(edits.assign_points(np.array([15]), 1))
    session.measurements()
    assert sorted(stages.measured) == [1, 2]


class Editing(RuleBasedStateMachine):
    """Random edits and undos against a plain list of labels, one per point."""

    @initialize()
    def begin(self):
        self.session, _ = make_session(n_points=60, n_trunks=0)
        self.past: list[tuple] = []
        sets = [trunk(i + 1, *range(12 * i, 12 * i + 8)) for i in range(4)]
        self.session.do(commands.replace_trunks(TrunkSet(tuple(sets))))
        self.given_out = {1, 2, 3, 4}

    def _do(self, command) -> None:
        before = self.session.document
        try:
            after = self.session.do(command).after
        except CommandError:
            assert self.session.document is before
            return
        if after is not before:
            self.past.append(before)
            new = set(after.trunks.ids) - set(before.trunks.ids)
            if not command.label.startswith("Call"):
                assert not new & self.given_out, "an id was given out twice"
            self.given_out |= new

    chosen = st.lists(st.integers(0, 59), min_size=1, max_size=20)
    some_id = st.integers(1, 9)

    @rule(ids=st.lists(some_id, max_size=3))
    def merge(self, ids):
        self._do(edits.merge_trunks(ids))

    @rule(trunk_id=some_id, seed=st.integers(0, 99))
    def split(self, trunk_id, seed):
        if trunk_id in self.session.document.trunks:
            points = self.session.document.trunks[trunk_id].points
            part = np.random.default_rng(seed).integers(0, 2, len(points))
            self._do(edits.split_trunk(trunk_id, [points[part == 0], points[part == 1]]))

    @rule(points=chosen, may_take=st.booleans())
    def add(self, points, may_take):
        self._do(edits.add_trunk(np.array(points), may_take=may_take))

    @rule(points=chosen, trunk_id=some_id)
    def assign(self, points, trunk_id):
        before = self.session.document
        self._do(edits.assign_points(np.array(points), trunk_id))
        if trunk_id in before.trunks:
            assert (self.session.document.trunks.labels(60)[points] == trunk_id).all()

    @rule(points=chosen)
    def drop(self, points):
        self._do(edits.drop_points(np.array(points)))
        assert (self.session.document.trunks.labels(60)[points] == 0).all()

    @rule(ids=st.lists(some_id, min_size=1, max_size=2))
    def delete(self, ids):
        self._do(edits.delete_trunks(ids))

    @rule(old=some_id, new=st.integers(1, 40))
    def renumber(self, old, new):
        self._do(edits.renumber_trunk(old, new))

    @rule(ids=st.lists(some_id, max_size=3))
    def group(self, ids):
        self._do(edits.group_stems(ids))

    @rule()
    def undo(self):
        if self.past:
            assert self.session.undo().after is self.past.pop()

    @invariant()
    def no_point_is_owned_twice(self):
        document = self.session.document
        owned = np.concatenate([each.points for each in document.trunks] or [np.empty(0, np.int32)])
        assert len(np.unique(owned)) == len(owned)
        assert set(document.trees) <= set(document.trunks.ids)
        assert all(len(each) >= edits.LEAST_POINTS for each in document.trunks)


TestEditing = Editing.TestCase
TestEditing.settings = hypothesis_settings(max_examples=40, stateful_step_count=25, deadline=None)
