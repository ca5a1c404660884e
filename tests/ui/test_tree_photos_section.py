"""The pictures of the chosen tree in the panel, over the real websocket."""

import re
import threading

import mask_plots
import numpy as np
import pytest
from fakeclient import FakeClient
from panel import LONG, choose, idle
from tests import maskplot
from tests.app.gridplot import grid_session
from tests.treescene import write_plot

from dbh_studio.app import commands
from dbh_studio.app.tree_photos import TreePhoto, TreePhotos
from dbh_studio.core.trunks import TrunkSet
from dbh_studio.stages.tree_pictures import TrunkDrawing
from dbh_studio.ui import tree_photos_section
from dbh_studio.ui.tree_photos_section import TreePhotosSection, busy_html, caption, has_north, photos_html, wind

N_GROUND, N_STEM = 30_000, 12_000


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The plot's files; tests do not change them."""
    return write_plot(tmp_path_factory.mktemp("tree_photos") / "plot")


@pytest.fixture
def plot(files, tmp_path, studio):
    """It, open in the studio with three trunks."""
    session = mask_plots.open_session(files, tmp_path / "plot.dbh")
    rows = [np.arange(N_GROUND + k * N_STEM, N_GROUND + (k + 1) * N_STEM) for k in range(3)]
    low = session.cloud.xyz[:N_GROUND, 2].min()
    stems = [each[session.cloud.xyz[each, 2] - low > 0.15] for each in rows]
    session.do(commands.replace_trunks(TrunkSet.from_point_sets(stems)))
    session.measurements()
    studio.adopt(session)
    return session


@pytest.fixture
def tab(plot, studio):
    with FakeClient(studio.server.url) as client:
        client.wait(lambda t: "/labels" in t.scene, LONG)
        yield client


def shots(state, trunk_id):
    """Whether the box is in a state for a tree."""
    return lambda t: f'data-state="{state}" data-tree="{trunk_id}"' in t.html()


def section_of(running):
    (found,) = [each for each in running.panels[3].sections if isinstance(each, TreePhotosSection)]
    return found


def addresses(tab):
    return re.findall(r'src="(data:image/jpeg;base64,[^"]+)"', tab.html())


def test_choosing_a_tree_shows_its_pictures(tab):
    assert "dbh-shots" not in tab.html() or not addresses(tab)
    choose(tab, 1)
    tab.wait(shots("shown", 1), LONG)
    assert 2 <= len(addresses(tab)) <= 4
    first = addresses(tab)
    choose(tab, 2)
    tab.wait(shots("shown", 2), LONG)
    assert set(addresses(tab)).isdisjoint(first)


def test_the_diameter_does_not_wait_for_the_pictures(tab, monkeypatch):
    may_go_on = threading.Event()
    real = tree_photos_section.tree_photos

    def slow(*args, **how):
        assert may_go_on.wait(LONG)
        return real(*args, **how)

    monkeypatch.setattr(tree_photos_section, "tree_photos", slow)
    try:
        for trunk_id in (1, 2, 3):
            choose(tab, trunk_id)
            tab.wait(lambda t, i=trunk_id: f'data-tree="{i}" data-dbh="' in t.html(), LONG)
            tab.wait(shots("busy", trunk_id), LONG)
    finally:
        may_go_on.set()
    tab.wait(shots("shown", 3), LONG)
    assert not shots("shown", 1)(tab)


def test_closer_and_wider(tab):
    choose(tab, 1)
    tab.wait(shots("shown", 1), LONG)
    seen = [addresses(tab)]
    for step in (1, 1, -1, -1, -1, -1):
        tab.bridge_send("tree-photo-zoom", step)
        tab.wait(lambda t, known=seen[-1]: addresses(t) and addresses(t) != known, LONG)
        seen.append(addresses(tab))
    assert 'data-do="tree-photo-wider"' in tab.html()
    assert re.search(r'data-do="tree-photo-wider"[^>]*disabled', tab.html())
    assert not re.search(r'data-do="tree-photo-closer"[^>]*disabled', tab.html())
    # Back where one has been: the pictures are the same ones.
    assert seen[3] == seen[1] and seen[4] == seen[0]
    tab.bridge_send("tree-photo-zoom", "in")
    tab.settle()
    assert addresses(tab) == seen[-1]


def test_a_picture_leads_to_its_photo(tab, studio):
    choose(tab, 3)
    tab.wait(shots("shown", 3), LONG)
    (running,) = studio._tabs.values()
    shown = section_of(running)._shown
    tab.bridge_send("tree-photo-open", 1)
    tab.wait(lambda t: running.photos.image == shown[1].name and running.photos._wanted == (None, None), LONG)
    look = running.photos._look
    xy, inside = look.view_from_photo(np.array([shown[1].at_px]))
    assert inside.all()
    assert xy[0] == pytest.approx([look.width_px / 2, look.height_px / 2], abs=2.0)
    for nonsense in (7, -1, "1", None, True):
        tab.bridge_send("tree-photo-open", nonsense)
    tab.wait(lambda t: [n.title for n in t.notifications].count("This picture is not there any more.") == 5, LONG)
    assert running.photos.image == shown[1].name


def test_it_follows_the_plot(tab, plot):
    choose(tab, 1)
    tab.wait(shots("shown", 1), LONG)
    before = addresses(tab)
    plot.do(commands.change_settings("measure", breast_height_m=1.0))
    tab.wait(lambda t: addresses(t) and addresses(t) != before, LONG)
    plot.undo()
    tab.wait(lambda t: addresses(t) == before, LONG)
    plot.do(commands.set_cameras(None))
    tab.wait_text("This plot has no photos", LONG)
    assert not addresses(tab)


def test_photos_that_are_read_later_bring_the_pictures(tab, plot, studio):
    source = plot.document.cameras
    choose(tab, 1)
    tab.wait(shots("shown", 1), LONG)
    plot.do(commands.set_cameras(None))
    tab.wait_text("This plot has no photos", LONG)
    plot.do(commands.set_cameras(source))
    idle(tab, studio)
    tab.wait(shots("shown", 1), LONG)


def test_why_there_are_none(tab, monkeypatch):
    words = "This tree is hidden in every photo that was taken near it."
    monkeypatch.setattr(tree_photos_section, "tree_photos", lambda *_, **__: TreePhotos((), words))
    choose(tab, 2)
    tab.wait_text(words, LONG)
    tab.wait(shots("none", 2), LONG)


def test_what_goes_wrong_is_told_and_the_next_tree_works(tab, monkeypatch, caplog):
    real = tree_photos_section.tree_photos

    def fails_for_one(session, trunk_id, **how):
        if trunk_id == 1:
            raise RuntimeError("out of order")
        return real(session, trunk_id, **how)

    monkeypatch.setattr(tree_photos_section, "tree_photos", fails_for_one)
    choose(tab, 1)
    tab.wait(lambda t: "out of order" in caplog.text, LONG)
    choose(tab, 2)
    tab.wait(shots("shown", 2), LONG)


# ---- the words


def picture(**values):
    made = {
        "image": np.zeros((64, 48, 3), np.uint8), "name": "a.jpg", "distance_m": 3.24, "bearing_deg": 92.0, "seen": 1.0,
        "metres_per_pixel": 0.01, "at_px": (10.0, 10.0), "photo_px_per_px": 1.0, "_drawing": TrunkDrawing(),
    }  # fmt: skip
    return TreePhoto(**(made | values))


def test_captions():
    assert caption(picture()) == "3.2 m from E"
    assert caption(picture(), has_north=False) == "3.2 m"
    assert caption(picture(seen=0.5)) == "3.2 m from E, 50 % seen"
    assert caption(picture(distance_m=float("nan"))) == "from E"
    assert caption(picture(distance_m=float("nan")), has_north=False) == "a.jpg"


def test_winds():
    assert [wind(bearing) for bearing in (0, 22, 23, 180, 315, 338, 359.9)] == ["N", "N", "NE", "S", "NW", "N", "N"]


def test_names_from_files_are_text():
    content = photos_html(1, TreePhotos((picture(name='<b onload="x">'),), "<i>note</i>"))
    assert "<b onload" not in content and "<i>note" not in content
    assert content.count("<figure") == content.count("<img") == 1
    assert busy_html(4, 3).count("<figure") == 3
    assert maskplot.N_PHOTOS == 8


@pytest.mark.parametrize(
    ("crs", "frame", "is_known"),
    [
        ("EPSG:32633", {}, True),
        ("EPSG:4326", {}, False),
        (None, {}, False),
        ("EPSG:32633", {"up": (0.0, 1.0, 0.0)}, False),
        (None, {"north": (0.0, 1.0, 0.0)}, True),
    ],
)
def test_sides_have_names_where_the_report_has_them(crs, frame, is_known):
    session = grid_session(crs=crs)
    if frame:
        session.do(commands.set_frame(**frame))
    assert has_north(session, session.document) is is_known
