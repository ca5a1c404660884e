"""Commands that say something about trees and about how they are measured."""

import numpy as np
import pytest
from tests.app.plots import contents, make_cloud, make_document

from dbh_studio.app import commands, edits
from dbh_studio.app.document import Document
from dbh_studio.app.saved_states import document_from_state, state_from_document
from dbh_studio.core.corrections import Correction
from dbh_studio.core.tree_record import Review, TreeRecord
from dbh_studio.errors import CommandError
from dbh_studio.io.project import ProjectWriter, read_project

TAPE = Correction("tape", 31.5, "Ada", "2026-01-02T03:04:05+00:00", "read twice")
LEFT_OUT = Correction("left_out", (3, 5), why="fern")


@pytest.fixture
def document() -> Document:
    return make_document(make_cloud(), n_trunks=3)


@pytest.mark.parametrize(
    "command",
    [
        commands.describe_trees([1, 9], species="oak"),
        commands.set_tree_fields([1, 9], age="40"),
        commands.set_tree_fields([1], **{" ": "40"}),
        commands.correct_measurement(9, TAPE),
        commands.correct_measurement(1, Correction("left_out", (5, 1000))),
        commands.withdraw_correction(9, "tape"),
        commands.review_trees({9: Review("accepted", 30.0)}),
        commands.describe_trees([1], crown_class=3),
    ],
    ids=lambda command: command.label,
)
def test_an_illegal_command_is_refused_in_words_and_changes_nothing(document, command):
    before = contents(document)
    with pytest.raises(CommandError) as caught:
        command.apply(document)
    assert len(caught.value.problem) > 10
    assert contents(document) == before


def test_the_same_is_said_about_several_trees(document):
    after = commands.describe_trees([1, 3], species="oak", health="thin crown").apply(document)
    assert dict(after.trees) == dict.fromkeys((1, 3), TreeRecord(species="oak", health="thin crown"))
    assert after.trunks is document.trunks
    assert commands.describe_trees([3, 1], species="oak").apply(after) is after


def test_an_own_field_leaves_the_others(document):
    after = commands.set_tree_fields([1, 2], age="40").apply(document)
    after = commands.set_tree_fields([1], zone="b").apply(after)
    assert after.trees[1].fields == (("age", "40"), ("zone", "b"))
    after = commands.set_tree_fields([1, 2], age="").apply(after)
    assert after.trees[1].fields == (("zone", "b"),)
    assert 2 not in after.trees


def test_a_correction_is_put_in_place_of_the_one_of_its_kind_and_withdrawn(document):
    after = commands.correct_measurement(2, TAPE).apply(document)
    after = commands.correct_measurement(2, Correction("curve", "circle")).apply(after)
    assert [each.kind for each in after.trees[2].corrections] == ["curve", "tape"]
    # Said again, it is no news, whoever says it.
    assert commands.correct_measurement(2, Correction("tape", 31.5, "Bo")).apply(after) is after
    after = commands.withdraw_correction(2, "curve").apply(after)
    assert after.trees[2].corrections == (TAPE,)
    assert commands.withdraw_correction(2, "curve").apply(after) is after
    assert dict(commands.withdraw_correction(2, "tape").apply(after).trees) == {}


def test_reviews_are_kept_and_taken_back(document):
    review = Review("accepted", 30.0, who="Ada")
    after = commands.review_trees({1: review, 2: review}).apply(document)
    assert after.trees[1].review == after.trees[2].review == review
    assert dict(commands.review_trees({1: None, 2: None}).apply(after).trees) == {}


def test_a_split_off_part_was_not_looked_at_and_is_measured_as_the_plot(document):
    said = commands.describe_trees([1], species="oak", health="good", review=Review("accepted", 30.0)).apply(document)
    said = commands.correct_measurement(1, LEFT_OUT).apply(said)
    points = said.trunks[1].points
    after = edits.split_trunk(1, [points[:4], points[4:]]).apply(said)
    assert after.trees[1].corrections == (LEFT_OUT,)
    assert after.trees[4] == TreeRecord(species="oak", health="good", edited=True)


def test_merging_fills_up_what_is_not_said(document):
    said = commands.describe_trees([1], fields={"age": "40"}).apply(document)
    said = commands.describe_trees([2], fields={"age": "50", "zone": "b"}, crown_class="dominant").apply(said)
    after = edits.merge_trunks([1, 2]).apply(said)
    assert after.trees[1] == TreeRecord(fields=(("age", "40"), ("zone", "b")), crown_class="dominant", edited=True)


def test_all_of_it_is_saved(document, tmp_path):
    said = commands.describe_trees([2], species="oak", status="broken", fields={"age": "40"}).apply(document)
    corners = np.random.default_rng(0).normal(size=(5, 3))
    for correction in (TAPE, LEFT_OUT, Correction("ring", corners), Correction("ground", (1.0, 2.0, 0.1 + 0.2))):
        said = commands.correct_measurement(2, correction).apply(said)
    said = commands.review_trees({2: Review("doubtful", None, "small_arc", "Ada", "2026-01-02")}).apply(said)
    writer = ProjectWriter(tmp_path / "plot.dbh")
    writer.save(state_from_document(said))
    writer.close()
    again = document_from_state(read_project(tmp_path / "plot.dbh"), said.source)
    assert dict(again.trees) == dict(said.trees)
