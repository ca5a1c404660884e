"""Commands on known lengths, photos and the frame: each one undoable step that touches nothing else."""

from pathlib import Path

import numpy as np
import pytest
from tests.app.plots import contents, make_cloud, make_document, make_session

from dbh_studio.app import commands
from dbh_studio.app.document import CameraSource
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.scale_evidence import MarkedPoint, MarkerSquare, ScaleBar, ScaleEvidence
from dbh_studio.errors import CommandError


def everything(document):
    """All a Document says, comparable."""
    said = (document.evidence, document.cameras, document.north_direction, document.origin_src)
    return (*contents(document), *said)


def bar(name="Bar 1", *, length_m=1.0, **values):
    return ScaleBar(name, (MarkedPoint((0, 0, 0)), MarkedPoint((2, 0, 0))), length_m, **values)


def square(name="Marker 1", **values):
    corners = ((0, 1, 0), (1, 1, 0), (1, 0, 0), (0, 0, 0))
    return MarkerSquare(name, tuple(MarkedPoint(corner) for corner in corners), **{"side_m": 1.0, **values})


EVERY = {
    "add": lambda: commands.add_length(square("Marker 2")),
    "change": lambda: commands.change_length("Bar 1", length_m=2.0),
    "role": lambda: commands.change_length("Marker 1", role="check"),
    "remove": lambda: commands.remove_length("Bar 1"),
    "evidence": lambda: commands.set_evidence(
        ScaleEvidence((bar(),)), label="Find markers", scale=ScaleEstimate(0.7, "marker", 0.001)
    ),
    "cameras": lambda: commands.set_cameras(CameraSource(Path("cameras.xml"))),
    "frame": lambda: commands.set_frame(up="+y", north=(1, 0, 0), origin_src=(1, 2, 3)),
}


@pytest.fixture
def session():
    session = make_session(n_trunks=3)[0]
    session.do(commands.add_length(bar()))
    session.do(commands.add_length(square()))
    return session


@pytest.mark.parametrize("name", EVERY)
def test_it_is_one_step_that_can_be_undone_and_done_again(session, name):
    before = session.document
    session.do(EVERY[name]())
    after = session.document
    assert everything(after) != everything(before)
    session.undo()
    assert everything(session.document) == everything(before)
    session.redo()
    assert everything(session.document) == everything(after)


@pytest.mark.parametrize("name", EVERY)
def test_trunks_trees_and_settings_are_left_alone(session, name):
    before = session.document
    session.do(EVERY[name]())
    after = session.document
    assert after.trunks is before.trunks and after.trees is before.trees and after.settings is before.settings


@pytest.mark.parametrize("name", sorted(set(EVERY) - {"remove"}))  # what is gone cannot be removed again
def test_the_same_again_leaves_no_trace(session, name):
    session.do(EVERY[name]())
    once = session.document
    session.do(EVERY[name]())
    assert everything(session.document) == everything(once)


@pytest.mark.parametrize(
    "command",
    [
        lambda: commands.add_length(bar(length_m=0.0)),
        lambda: commands.add_length(bar(length_m=-1.0)),
        lambda: commands.add_length(bar(length_m=float("nan"))),
        lambda: commands.add_length(bar(length_m=1e9)),
        lambda: commands.add_length(bar(length_se_m=2.0)),
        lambda: commands.add_length(bar(length_se_m=-0.1)),
        lambda: commands.add_length(bar(name=" ")),
        lambda: commands.add_length(bar(name="half a \ud800")),
        lambda: commands.change_length("gone", length_m=1.0),
        lambda: commands.change_length("Bar 1", colour="red"),
        lambda: commands.change_length("Bar 1", length_m=0.0),
        lambda: commands.change_length("Bar 1", name="Marker 1"),
        lambda: commands.remove_length("gone"),
        lambda: commands.set_frame(up=(0, 0, 0)),
        lambda: commands.set_frame(north=(np.nan, 0, 0)),
        lambda: commands.set_frame(origin_src=(np.inf, 0, 0)),
        lambda: commands.set_frame(origin_src=(1, 2)),
    ],
)
def test_nonsense_is_refused_in_words_and_changes_nothing(session, command):
    before = session.document
    with pytest.raises(CommandError) as error:
        session.do(command())
    assert str(error.value)
    assert session.document is before


def test_a_length_keeps_its_place_when_it_is_changed(session):
    session.do(commands.add_length(bar("Bar 2")))
    session.do(commands.change_length("Bar 1", name="Pole", length_m=3.0))
    assert [each.name for each in session.document.evidence] == ["Marker 1", "Pole", "Bar 2"]
    assert session.document.evidence["Pole"].length_m == 3.0


def test_removing_a_length_keeps_the_scale_that_was_taken_from_it(session):
    session.do(commands.set_evidence(session.document.evidence, label="Set", scale=ScaleEstimate(0.5, "bars")))
    session.do(commands.remove_length("Bar 1"))
    assert session.document.scale == ScaleEstimate(0.5, "bars")


def test_markers_and_scale_come_back_together(session):
    before = session.document
    session.do(EVERY["evidence"]())
    assert session.undo_label == "Find markers"
    session.undo()
    assert session.document.scale == before.scale and session.document.evidence == before.evidence


def test_the_frame_puts_points_where_it_says():
    document = make_document(make_cloud(), scale=ScaleEstimate(2.0, "factor"))
    after = commands.set_frame(up="+y", north=(1, 0.5, 0), origin_src=(1, 2, 3)).apply(document)
    to_world = after.world_from_source
    np.testing.assert_allclose(to_world.apply(np.array([[1.0, 2.0, 3.0]])), [[0, 0, 0]], atol=1e-12)
    # Up is up, and the level part of north is +y.
    np.testing.assert_allclose(to_world.apply(np.array([[1.0, 3.0, 3.0]])), [[0, 0, 2]], atol=1e-12)
    np.testing.assert_allclose(to_world.apply(np.array([[2.0, 2.0, 3.0]])), [[0, 2, 0]], atol=1e-12)


def test_a_frame_of_nothing_changes_nothing():
    document = make_document(make_cloud())
    assert commands.set_frame().apply(document) is document
