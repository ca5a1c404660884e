"""The section “Compare with LiDAR” over the real websocket: paths typed, carried over, shown, opened, refused."""

from __future__ import annotations

import numpy as np
import pytest
from fakeclient import FakeClient
from panel import LONG
from tests.transferplot import UNIT_M, write_transfer_plot

from dbh_studio.app import pipeline
from dbh_studio.app.commands import replace_trunks
from dbh_studio.app.opening import open_plot
from dbh_studio.app.transfer_report import WalkPicture
from dbh_studio.core.trunks import TrunkSet
from dbh_studio.ui.transfer_html import walk_svg

START = "Carry the trunks over"


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_transfer_plot(tmp_path_factory.mktemp("ui_transfer"))


@pytest.fixture(scope="module")
def found(files):
    session = open_plot(files.photo, scale=UNIT_M)
    pipeline.segment(session, in_process=True)
    # Four of them are measured sooner than all.
    return TrunkSet(tuple(session.document.trunks)[:4])


def show(studio, session):
    studio.adopt(session)
    client = FakeClient(studio.server.url)
    client.wait(lambda t: session.document.plot_id in t.text(), LONG)
    client.settle()  # the plot is shown: a step chosen before would be overtaken
    client.bridge_send("step", "export")
    client.wait(lambda t: t.has(START), LONG)
    return client


@pytest.fixture
def tab(studio, files, found, tmp_path):
    """A tab in the Export step of a photo plot with trunks."""
    session = open_plot(files.photo, scale=UNIT_M, project_dir=tmp_path / "photo.dbh")
    session.do(replace_trunks(found))
    with show(studio, session) as client:
        assert studio.wait_idle(LONG)
        yield client


def start(tab, studio):
    """Press the button as soon as nothing else runs."""
    assert studio.wait_idle(LONG)
    tab.wait(lambda t: any(e.label == START and not e.props.get("disabled") for e in t.elements.values()), LONG)
    tab.press(START)


def fill(tab, files):
    tab.set("LiDAR cloud", str(files.scan))
    tab.set("Scanner's path", str(files.scanner))
    tab.set("Camera's path", str(files.camera))


def test_trunks_are_carried_compared_and_the_lidar_plot_is_opened(studio, tab, files, tmp_path):
    fill(tab, files)
    tab.set("Fit stems and ground too", False)
    start(tab, studio)
    tab.wait_text("poses of the two walks lie on each other", LONG)
    ids = studio.session.document.trunks.ids
    tab.wait(lambda t: t.html().count("data-carried=") == len(ids))
    assert 'data-poses="' in tab.html() and "Misfit of the poses used" in tab.text()
    assert (tmp_path / "photo_lidar_comparison.csv").exists()
    assert studio.session.document.scale.source == "factor", "the photo plot is as it was"
    # Another tab shows it too.
    with FakeClient(studio.server.url) as other:
        other.settle()  # the plot is shown: a step chosen before would be overtaken
        other.bridge_send("step", "export")
        other.wait(lambda t: "data-carried=" in t.html(), LONG)
    assert studio.wait_idle(LONG)
    tab.wait(lambda t: t.has("Open the LiDAR plot"))
    tab.press("Open the LiDAR plot")
    tab.wait(lambda t: studio.session.document.plot_id == "photo_lidar" and "photo_lidar" in t.text(), LONG)
    assert studio.session.document.trunks.ids == ids


def test_a_plot_without_scale_takes_the_lidars(studio, files, tmp_path):
    session = open_plot(files.photo, project_dir=tmp_path / "photo.dbh")
    with show(studio, session) as tab:
        tab.wait_text("This plot has no scale")
        tab.wait(lambda t: t.value("Take the LiDAR's scale") is True)
        fill(tab, files)
        tab.set("Fit stems and ground too", False)
        start(tab, studio)
        tab.wait(lambda _: len(session.document.trunks) >= 7, LONG)
        assert session.document.scale.source == "lidar"
        assert session.document.scale.metres_per_unit == pytest.approx(UNIT_M, rel=5e-3)
        tab.wait(lambda t: "data-carried=" in t.html() or "data-dbh" in t.html() or "Tree" in t.text(), LONG)


def test_refusals_are_sentences_and_leave_nothing(studio, tab, files, tmp_path):
    start(tab, studio)
    tab.wait_notification("No LiDAR cloud was named")
    fill(tab, files)
    tab.set("Frames per second", "fast")
    start(tab, studio)
    tab.wait_notification("no number of frames per second")
    tab.set("Frames per second", "")
    short = tmp_path / "short.csv"
    short.write_text("\n".join(files.scanner.read_text().splitlines()[:6]))
    tab.set("Scanner's path", str(short))
    tab.set("LiDAR cloud", str(files.photo))
    start(tab, studio)
    note = tab.wait_notification("does not tell how long its unit is", LONG)
    assert "name its saved plot" in note.body and "--" not in note.body
    assert not (tmp_path / "photo_lidar.dbh").exists()


def test_a_running_transfer_is_cancelled(studio, tab, files, tmp_path):
    fill(tab, files)
    start(tab, studio)
    tab.wait_text("Carrying the trunks over", LONG)
    tab.bridge_send("cancel")
    tab.wait_notification("nothing was changed", LONG)
    assert not (tmp_path / "photo_lidar.dbh").exists()
    tab.wait(lambda t: t.has(START))


def test_the_picture_of_the_walks(files):
    walk = files.pair.lidar_walk.xyz[::20]
    kept = np.ones(len(walk), bool)
    kept[3] = False
    off = np.where(kept[:, None], 0.02, 5.0)
    svg = walk_svg(WalkPicture(walk + off, walk, kept))
    assert f'data-poses="{len(walk)}"' in svg and 'data-left-out="1"' in svg
    assert f"median {100 * 0.02 * np.sqrt(3):.1f}" in svg and "nan" not in svg
    nothing = WalkPicture(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool))
    assert walk_svg(nothing) == ""
    still = WalkPicture(np.zeros((4, 3)), np.zeros((4, 3)), np.zeros(4, bool))
    assert "nan" not in walk_svg(still)
