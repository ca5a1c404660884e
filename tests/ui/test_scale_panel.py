"""The Scale step over the real websocket: by number, by clicks in the cloud and in photos, by markers, and undone."""

import re
from dataclasses import replace

import endless
import numpy as np
import pytest
import scale_plots
from fakeclient import FakeClient
from panel import LONG, idle
from scipy.spatial import cKDTree

from dbh_studio.app import commands
from dbh_studio.app.found_markers import apply_search
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.scale_evidence import MarkedPoint, ScaleBar, ScaleEvidence
from dbh_studio.ui import scale_html

CORNERS = 4


@pytest.fixture
def session(tmp_path):
    return scale_plots.session_of(tmp_path)


@pytest.fixture
def tab(studio, session):
    """A tab in the Scale step of the plot with photos."""
    studio.adopt(session)
    with FakeClient(studio.server.url) as client:
        client.wait(lambda t: t.has("Find markers in the photos") or "Data check" in t.text(), LONG)
        client.settle()  # the plot is shown: a step chosen before would be overtaken
        client.bridge_send("step", "scale")
        client.wait(lambda t: t.has("Find markers in the photos"), LONG)
        client.wait(lambda t: "/cameras" in t.scene, LONG)
        yield client


def tab_of(studio):
    (tab,) = studio._tabs.values()
    return tab


def way(tab, name):
    tab.bridge_send("scale-way", name)
    tab.wait(lambda t: f'data-way="{name}"' in t.html())


def bar(name="Pole", length_src=2.0, length_m=1.0, **values):
    return ScaleBar(name, (MarkedPoint((0, 0, 0)), MarkedPoint((length_src, 0, 0))), length_m, **values)


def n_marked(tab):
    return len(re.findall(r'data-kind="done"', tab.html()))


def click_corners(tab, corners):
    """Look at the marker from above, aslant, and click its corners."""
    centre = corners.mean(axis=0)
    side = np.linalg.norm(corners[1] - corners[0])
    tab.look(centre + side * np.array([0.2, -0.9, 1.4]), centre)
    before = n_marked(tab)
    for number, corner in enumerate(corners, start=1):
        tab.click_scene(corner)
        tab.wait(lambda t, n=number: n_marked(t) == before + n)


# ---- in the cloud


def test_four_corners_clicked_in_the_cloud_give_the_scale(tab, session):
    truth = scale_plots.plot()
    way(tab, "cloud")
    tab.bridge_send("mark", ["start", ["square", "cloud"]])
    tab.wait_text("Click the top-left corner in the cloud (1 of 4)")
    tab.wait(lambda t: any("dbh-banner" in script and "top-left" in script for script in t.javascript))
    click_corners(tab, truth.corners())
    tab.bridge_send("mark", ["keep", "1,00"])
    tab.wait(lambda t: t.has("Set the scale from the known lengths"))
    assert not session.document.scale.is_known
    tab.wait_text("Not applied yet")
    tab.press("Set the scale from the known lengths")
    tab.wait_text("Applied")
    scale = session.document.scale
    assert scale.source == "marker"
    assert scale.metres_per_unit == pytest.approx(truth.metres_per_unit, rel=0.01)
    assert abs(scale.metres_per_unit - truth.metres_per_unit) < 4 * scale.standard_error
    tab.bridge_send("undo")
    tab.wait_text("Not applied yet")
    assert not session.document.scale.is_known and len(session.document.evidence) == 1
    tab.bridge_send("undo")
    tab.wait(lambda _: len(session.document.evidence) == 0)
    tab.bridge_send("redo")
    tab.bridge_send("redo")
    tab.wait(lambda _: session.document.scale == scale)


def test_a_click_while_marking_chooses_no_tree_and_escape_ends_it(tab, session):
    way(tab, "cloud")
    tab.bridge_send("mark", ["start", ["bar", "cloud"]])
    tab.wait_text("Click one end in the cloud (1 of 2)")
    tab.look((0, 0, 8), (0.01, 0, 0))
    tab.click_scene((0.5, 0.5, 0.0))
    tab.wait_text("Click the other end in the cloud (2 of 2)")
    tab.wait(lambda t: any(name.startswith("/marks/point0") for name in t.scene))
    tab.command("Stop marking")
    tab.wait(lambda t: "Click the other end" not in t.text())
    tab.wait(lambda t: not any(name.startswith("/marks/point") for name in t.scene))
    assert len(session.document.evidence) == 0


def test_undo_while_marking_takes_the_last_point_back(tab, session):
    label = session.undo_label
    tab.bridge_send("mark", ["start", ["bar", "cloud"]])
    tab.look((0, 0, 8), (0.01, 0, 0))
    tab.click_scene((0.5, 0.5, 0.0))
    tab.wait_text("(2 of 2)")
    tab.command("Undo")
    tab.wait_text("(1 of 2)")
    assert session.undo_label == label


def test_a_click_beside_the_cloud_is_answered(tab):
    tab.bridge_send("mark", ["start", ["bar", "cloud"]])
    tab.wait_text("(1 of 2)")
    tab.look((0, 0, 8), (0.01, 0, 0))
    tab.click_scene((3000.0, 0.0, 0.0))
    assert tab.wait_notification("no point of the cloud there").body
    tab.wait_text("(1 of 2)")


def test_the_close_up_moves_a_point_by_a_click_by_keys_and_by_arrows(tab, studio):
    corner = scale_plots.plot().corners()[0]
    tab.bridge_send("mark", ["start", ["bar", "cloud"]])
    tab.look(corner + [0.3, -2.0, 3.0], corner)
    tab.click_scene(corner)
    tab.wait(lambda t: "dbh-closeup" in t.html())
    marking = tab_of(studio).marking
    place = marking.picks.picks[0].point
    width = 2 * marking.close_up.half_width
    tab.bridge_send("mark", ["at", [0.6, 0.5]])
    tab.wait(lambda _: marking.picks.picks[0].point != place)
    moved = np.array(marking.picks.picks[0].point.xyz_src)
    # To the right by a tenth of the picture.
    assert np.linalg.norm(moved - place.xyz_src) == pytest.approx(0.1 * width, rel=0.25)
    tab.bridge_send("mark", ["nudge", [3, 0]])
    tab.wait(lambda _: not np.array_equal(marking.picks.picks[0].point.xyz_src, moved))
    step = np.linalg.norm(np.array(marking.picks.picks[0].point.xyz_src) - moved)
    assert step == pytest.approx(3 / 260 * width, rel=0.25)
    tab.bridge_send("mark", ["zoom", 1])
    tab.wait(lambda _: marking.close_up.half_width == pytest.approx(width / 4))
    tab_of(studio).worker.post(marking._dragged, np.array([1.0, 2.0, 0.0]))
    tab.wait(lambda _: np.allclose(marking.picks.picks[0].point.xyz_src, [1, 2, 0], atol=1e-9))
    tab.bridge_send("mark", ["remove", 0])
    tab.wait_text("(1 of 2)")


def test_a_click_between_the_points_of_a_sparse_part_marks_its_surface(tab, studio):
    """Around the marker the ground has a fortieth of the points of the marker."""
    points = scale_plots.plot().cloud.xyz
    ground = points[(np.abs(points[:, 2]) < 0.02) & (np.linalg.norm(points[:, :2], axis=1) > 6.0)]
    tree = cKDTree(ground)
    places = np.random.default_rng(0).uniform(-9, 9, (4000, 3)) * [1, 1, 0]
    places = places[np.linalg.norm(places[:, :2], axis=1) > 7.0]
    gap = tree.query(places)[0]
    place = places[np.argmax(np.where(gap < np.quantile(gap, 0.99), gap, 0))]  # the middle of a gap
    tab.bridge_send("mark", ["start", ["bar", "cloud"]])
    tab.wait_text("(1 of 2)")
    tab.look(place + [0.3, -1.0, 1.5], place)
    assert tab_of(studio).studio.display.picking.spacing * 3 < gap.max()
    tab.click_scene(place)
    tab.wait(lambda t: n_marked(t) == 1)
    found = np.array(tab_of(studio).marking.picks.picks[0].point.xyz_src)
    np.testing.assert_allclose(found, place, atol=0.05)


def test_what_was_typed_outlives_the_points_that_are_moved_after_it(tab, studio, session):
    tab.bridge_send("mark", ["start", ["bar", "cloud"]])
    tab.look((0, 0, 8), (0.01, 0, 0))
    for x in (0.5, 2.0):
        before = n_marked(tab)
        tab.click_scene((x, 0.5, 0.0))
        tab.wait(lambda t, n=before: n_marked(t) == n + 1)
    tab.bridge_send("mark", ["typed", '0.9"'])
    tab.bridge_send("mark", ["nudge", [3, 0]])
    tab.wait(lambda t: 'value="0.9&quot;"' in t.html())


@pytest.mark.parametrize("text", ["0", "-1", "one", "", "1e400", "nan", "<b>1</b>", "99999999"])
def test_a_length_that_cannot_be_is_answered_in_words_and_nothing_is_kept(tab, session, text):
    tab.bridge_send("mark", ["start", ["bar", "cloud"]])
    tab.look((0, 0, 8), (0.01, 0, 0))
    for x in (0.5, 2.0):
        before = n_marked(tab)
        tab.click_scene((x, 0.5, 0.0))
        tab.wait(lambda t, n=before: n_marked(t) == n + 1)
    tab.bridge_send("mark", ["keep", text])
    note = tab.wait_notification("The length of the bar")
    assert note.body
    tab.settle()
    assert len(session.document.evidence) == 0 and n_marked(tab) == 2


JUNK = (
    None,
    [],
    "start",
    ["start", ["cube", "cloud"]],
    ["start", [[], {}]],
    ["choose", -1],
    ["choose", True],
    ["choose", 99],
    ["move", "0"],
    ["remove", None],
    ["at", [None, 1]],
    ["at", [1e300, 1]],
    ["nudge", [1]],
    ["zoom", 99],
    ["photo", "../../etc/passwd"],
    ["photo", 3],
    ["unsee", "gone"],
    ["edit", "gone"],
    ["keep", 3],
    [["keep"], "1"],
)


def test_junk_from_the_page_does_nothing(tab, session, studio):
    tab.bridge_send("mark", ["start", ["bar", "cloud"]])
    tab.wait_text("(1 of 2)")
    before = session.document
    for junk in JUNK:
        tab.bridge_send("mark", junk)
    for kind in ("scale-way", "length-open", "length-true", "length-role", "length-remove", "length-frame", "strike",
                 "use-marker", "marker-side"):  # fmt: skip
        for junk in (
            None,
            3,
            ["gone", "1"],
            ["gone", "1", True, False],
            [["a", "b", 1], "yes"],
            {"a": 1},
            [[1, 2, 3], True],
        ):
            tab.bridge_send(kind, junk)
    tab.bridge_send("mark", ["choose", 1])
    tab.wait(lambda _: tab_of(studio).marking.picks.chosen == 1)
    tab.settle()
    assert session.document is before
    assert not [note for note in tab.notifications if "Unexpected" in note.title]


# ---- in photos


def sight(name, point):
    u, v = scale_plots.plot().posed.by_name(name).project(np.array([point]))[0][0]
    return name, float(u), float(v)


def test_a_bar_clicked_in_photos(tab, studio, session):
    truth, marking, worker = scale_plots.plot(), tab_of(studio).marking, tab_of(studio).worker
    ends = truth.corners()[[0, 1]]
    way(tab, "photos")
    tab.bridge_send("mark", ["start", ["bar", "photos"]])
    tab.wait_text("Open a photo and click one end in it")
    names = [photo.name for photo in truth.posed]
    for number, end in enumerate(ends):
        tab.wait(lambda _, n=number: marking.picks.chosen == n)
        worker.post(marking.photo_clicked, *sight(names[0], end))
        tab.settle()
        assert len(marking.picks.current.sights) == 1
        offered = re.findall(r'data-image="([^"]+)"', tab.html())
        assert names[0] not in offered and offered
        # One sight and the cloud say about where it is.
        assert np.linalg.norm(np.array(marking.picks.current.rough_src) - end) < 0.1
        tab.bridge_send("mark", ["photo", offered[0]])
        tab.wait(lambda _, name=offered[0]: tab_of(studio).photos.image == name)
        worker.post(marking.photo_clicked, *sight(offered[0], end))
        tab.wait(lambda t, n=number: n_marked(t) == n + 1)
        np.testing.assert_allclose(marking.picks.current.point.xyz_src, end, atol=1e-4)
        tab.wait_text("0.0 px off")
        tab.bridge_send("mark", ["next", None])
    tab.bridge_send("mark", ["keep", "1 m"])
    tab.wait(lambda _: len(session.document.evidence) == 1)
    assert session.document.evidence["Bar 1"].ends[0].sights
    tab.press("Set the scale from the known lengths")
    tab.wait(lambda _: session.document.scale.is_known)
    assert session.document.scale.metres_per_unit == pytest.approx(truth.metres_per_unit, rel=1e-3)
    assert session.document.scale.source == "bars"


def test_sights_that_do_not_meet_are_refused_in_words_and_can_be_taken_out(tab, studio):
    truth, marking, worker = scale_plots.plot(), tab_of(studio).marking, tab_of(studio).worker
    corners, names = truth.corners(), [photo.name for photo in truth.posed]
    tab.bridge_send("mark", ["start", ["square", "photos"]])
    tab.wait_text("Open a photo")
    worker.post(marking.photo_clicked, *sight(names[0], corners[0]))
    worker.post(marking.photo_clicked, *sight(names[2], corners[0] + [0, 0, 3.0]))
    tab.wait_text("What to do")
    assert n_marked(tab) == 0
    tab.bridge_send("mark", ["unsee", names[2]])
    tab.wait(lambda t: len(marking.picks.current.sights) == 1 and "What to do" not in t.text())


def test_marks_are_drawn_into_the_photos(tab, studio, session):
    truth, marking, worker = scale_plots.plot(), tab_of(studio).marking, tab_of(studio).worker
    corners, names = truth.corners(), [photo.name for photo in truth.posed]
    session.do(commands.add_length(bar()))
    tab.bridge_send("mark", ["start", ["bar", "photos"]])
    tab.wait(lambda _: marking.picks is not None)
    worker.post(marking.photo_clicked, *sight(names[0], corners[0]))
    tab.settle()
    assert marking.picks.current.rough_src is not None
    kinds = [(mark.kind, mark.label) for mark in marking._marks_of(names[0])]
    assert ("mark", "1") in kinds and kinds.count(("other", "")) == 2
    hint = next(mark for mark in marking._marks_of(names[1]) if mark.kind == "hint")
    assert np.hypot(hint.u_px - sight(names[1], corners[0])[1], hint.v_px - sight(names[1], corners[0])[2]) < 30
    assert marking._marks_of("gone.jpg") == []


# ---- markers found


def test_markers_are_found_shown_struck_out_and_undone(tab, studio, session, tmp_path):
    truth = scale_plots.plot()
    tab.press("Find markers in the photos")
    tab.wait(lambda _: session.document.scale.is_known, LONG)
    idle(tab, studio)
    assert session.undo_label == "Set the scale by markers"
    assert session.document.scale.metres_per_unit == pytest.approx(truth.metres_per_unit, rel=0.003)
    name = f"{scale_plots.FLAT[0]} {scale_plots.FLAT[1]}"
    tab.wait(lambda t: name in t.text() and t.has("Find the markers again"))
    tab.bridge_send("length-open", name)
    tab.wait(lambda t: 'data-kind="used"' in t.html())
    pictures = re.findall(r'<figure data-kind="(\w+)".*?src="data:image/jpeg;base64,', tab.html(), re.DOTALL)
    assert len(pictures) >= 4 and "used" in pictures
    assert len(tab.html()) < 400_000
    first = session.document.evidence[name].corners[0].sights[0].image
    before = session.document
    tab.bridge_send("strike", [[first, *scale_plots.FLAT], True])
    tab.wait(lambda _: session.document.evidence.struck == ((first, *scale_plots.FLAT),))
    assert session.document.scale != before.scale
    used = {sight.image for corner in session.document.evidence[name].corners for sight in corner.sights}
    assert first not in used
    tab.wait(lambda t: 'data-kind="struck"' in t.html())
    tab.bridge_send("undo")
    tab.wait(lambda _: session.document.evidence == before.evidence and session.document.scale == before.scale)
    # Another tab, or this one after a reload, has the pictures from the disk.
    assert (tmp_path / "plot.dbh" / "cache" / "markers.npz").is_file()
    studio.markers._session = None
    assert len(studio.markers.of(session)) >= 4


def test_the_side_is_asked_and_changes_what_was_found(tab, session):
    tab.bridge_send("marker-side", "0")
    assert tab.wait_notification("The side of the black square cannot be 0 m")
    tab.bridge_send("marker-side", "50 cm")
    tab.wait(lambda t: 'value="0.50"' in t.html())
    session.do(apply_search(session.document, scale_plots.search(0.5)))
    name = f"{scale_plots.FLAT[0]} {scale_plots.FLAT[1]}"
    half = session.document.scale.metres_per_unit
    tab.bridge_send("length-true", [name, "1.00"])
    tab.wait_text("That is not applied")
    tab.press("Set the scale from the known lengths")
    tab.wait(lambda _: session.document.scale.metres_per_unit == pytest.approx(2 * half))


def test_a_marker_that_few_photos_show_is_left_out_until_a_person_says_so(tab, studio, session):
    found = scale_plots.search(1.0)
    name = f"{scale_plots.UPRIGHT[0]} {scale_plots.UPRIGHT[1]}"
    n_photos = sum(find.key == scale_plots.UPRIGHT for find in found.detections)
    if n_photos not in (2, 3):
        pytest.fail(f"the plot is to show the upright marker in 2 or 3 photos, not in {n_photos}")
    tab_of(studio).worker.post(studio.markers._searched, session, session.document, found)
    tab.wait_text(f"not used: seen in {n_photos} photos")
    assert name not in session.document.evidence
    tab.bridge_send("use-marker", [*scale_plots.UPRIGHT, "1.00"])
    tab.wait_notification("contradict")  # it is no metre
    tab.bridge_send("use-marker", [*scale_plots.UPRIGHT, "50 cm"])
    tab.wait(lambda _: name in session.document.evidence)
    tab.wait(lambda t: "not used: seen in" not in t.text())
    tab.wait_text("2 known lengths agree")
    assert session.document.evidence[name].side_m == 0.5
    assert session.document.scale.metres_per_unit == pytest.approx(scale_plots.plot().metres_per_unit, rel=0.003)


def test_markers_of_two_sizes_are_both_shown_with_a_field_and_one_side_lets_the_person_go_on(tab, studio, session):
    found = scale_plots.two_sizes()
    names = [f"{dictionary} {number}" for dictionary, number in (scale_plots.FLAT, scale_plots.UPRIGHT)]
    tab_of(studio).worker.post(studio.markers._searched, session, session.document, found)
    tab.wait_notification("contradict each other")
    tab.wait_text("contradict each other")
    tab.settle()
    for name in names:
        row = re.search(rf"<b>{name}</b> not used.*?</div>(.*?</figure>)", tab.html(), re.DOTALL)
        assert row and "<img" in row[1], name
        assert f'aria-label="Side of {name}"' in tab.html()
    assert not session.document.scale.is_known and not len(session.document.evidence)
    tab.bridge_send("use-marker", [*scale_plots.UPRIGHT, "50 cm"])
    tab.wait(lambda _: session.document.scale.is_known)
    tab.wait(lambda t: "contradict each other" not in t.text())
    truth = scale_plots.plot().metres_per_unit
    assert session.document.scale.metres_per_unit == pytest.approx(truth, rel=0.01)
    # The first one has the side of all, which is right; where it were not, it would be in the list to be corrected.
    assert {each.name for each in session.document.evidence} == set(names)


def test_the_field_of_the_side_follows_what_the_markers_have(tab, session):
    session.do(apply_search(session.document, scale_plots.search(1.0)))
    tab.wait_text("Known lengths")
    tab.bridge_send("marker-side", "50 cm")
    tab.wait(lambda _: {square.side_m for square in session.document.evidence.squares} == {0.5})
    field = re.compile(r'value="([0-9.]+)"[^>]*data-field="marker-side"')
    tab.wait(lambda t: field.findall(t.html()) == ["0.50"])
    tab.bridge_send("undo")
    tab.wait(lambda t: field.findall(t.html()) == ["1.00"])
    tab.bridge_send("marker-side", "0.8")
    tab.wait(lambda _: {square.side_m for square in session.document.evidence.squares} == {0.8})


def test_a_search_leaves_the_unit_of_the_file_alone_and_says_what_the_markers_say(tab, studio, session):
    session.do(commands.set_scale(ScaleEstimate(2.0, "factor")))
    tab_of(studio).worker.post(studio.markers._searched, session, session.document, scale_plots.search(1.0))
    tab.bridge_send("scale-way", "markers")
    tab.wait_text("That is not applied")
    assert session.document.scale == ScaleEstimate(2.0, "factor") and session.undo_label == "Find markers"
    tab.press("Set the scale from the known lengths")
    tab.wait(lambda _: session.document.scale.source == "marker")


def test_photos_that_do_not_belong_to_the_cloud_give_no_scale(tab, studio, session):
    fit = replace(session.cameras.fit, status="moved", message="They lie elsewhere.", remedy="Export both alike.")
    session.remember_cameras(replace(session.cameras, fit=fit))
    tab_of(studio).worker.post(tab_of(studio).photos_changed)
    tab.wait_text("They lie elsewhere.")
    ways = (
        lambda: tab.press("Find markers in the photos"),
        lambda: tab.bridge_send("mark", ["start", ["bar", "photos"]]),
    )
    for number, use in enumerate(ways, start=1):
        use()
        tab.wait(lambda t, n=number: sum("They lie elsewhere." in note.title for note in t.notifications) == n)
    tab.settle()
    assert not tab_of(studio).marking.is_on and studio._job is None
    assert not session.document.scale.is_known


def test_a_search_can_be_cancelled(tab, session, studio, monkeypatch):
    monkeypatch.setattr("dbh_studio.ui.marker_search.search_markers", endless.work)
    before = session.document
    tab.press("Find markers in the photos")
    tab.wait_text("Finding markers")
    tab.bridge_send("cancel")
    tab.wait_notification("Cancelled", LONG)
    idle(tab, studio)
    assert session.document is before


# ---- the list


@pytest.fixture
def listed(tab, session):
    session.do(commands.add_length(bar()))
    session.do(commands.add_length(bar("<i>Check</i>", 4.1, 2.0, role="check")))
    tab.wait_text("Known lengths")
    return tab.settle()


def test_names_are_shown_as_text(listed):
    assert "&lt;i&gt;Check&lt;/i&gt;" in listed.html() and "<i>Check" not in listed.html()


def test_lengths_are_changed_in_the_list(listed, session):
    listed.wait_text("+5.0 cm (+2.50 %)")
    listed.bridge_send("length-true", ["Pole", "1,5"])
    listed.wait(lambda _: session.document.evidence["Pole"].length_m == 1.5)
    listed.bridge_send("length-role", ["<i>Check</i>", "control"])
    listed.wait(lambda _: session.document.evidence["<i>Check</i>"].role == "control")
    listed.bridge_send("length-remove", "<i>Check</i>")
    listed.wait(lambda _: len(session.document.evidence) == 1)
    for _ in range(3):
        listed.bridge_send("undo")
    listed.wait(lambda _: session.document.evidence["Pole"].length_m == 1.0 and len(session.document.evidence) == 2)


def test_a_wrong_length_in_the_list_is_answered_in_words(listed, session):
    before = session.document
    for text, why in (("0", "cannot be 0 m"), ("long", "not understood"), ("", "is missing")):
        listed.bridge_send("length-true", ["Pole", text])
        listed.wait_notification(why)
    assert session.document is before


def test_what_stands_against_the_lengths_is_said_before_they_are_applied():
    odd = bar("Tape", 4.0, 3.0)
    report = ScaleEvidence((bar(), odd)).report()
    for scale in (ScaleEstimate(), ScaleEstimate(0.7, "factor")):
        assert "contradict each other" in scale_html.state(scale, report, "")
        alone = scale_html.state(scale, ScaleEvidence((bar(),)).report(), "")
        assert "contradict" not in alone and "nothing checks" not in alone


def test_without_a_control_the_button_is_gone_and_why_is_said(listed):
    listed.bridge_send("length-role", ["Pole", "check"])
    listed.wait(lambda t: not t.has("Set the scale from the known lengths"))
    listed.wait_text("Mark at least one known distance as control")


def test_points_of_a_kept_length_are_marked_anew(listed, session):
    listed.bridge_send("mark", ["edit", "Pole"])
    listed.wait_text("Marking Pole")
    listed.look((0, 0, 8), (0.01, 0, 0))
    listed.bridge_send("mark", ["move", 1])
    listed.wait_text("Click where the other end is")
    place = scale_plots.plot().corners()[2]  # where the cloud is dense
    listed.click_scene(place)
    listed.wait(lambda t: "Click where" not in t.text())
    listed.bridge_send("mark", ["keep", "1.00"])
    listed.wait(lambda _: session.document.evidence["Pole"].ends[1].xyz_src != (2.0, 0.0, 0.0))
    assert len(session.document.evidence) == 2
    end = np.array(session.document.evidence["Pole"].ends[1].xyz_src)
    assert np.linalg.norm(end - place) < 0.05
    assert session.document.evidence["Pole"].ends[1].sigma_src > 0


def test_a_marker_sets_up_origin_and_north(tab, session):
    tab.bridge_send("mark", ["start", ["square", "cloud"]])
    tab.wait_text("(1 of 4)")
    click_corners(tab, scale_plots.plot().corners())
    tab.bridge_send("mark", ["keep", "1"])
    tab.wait(lambda _: "Marker 1" in session.document.evidence)
    tab.bridge_send("length-frame", ["Marker 1", True, True, True])
    tab.wait(lambda _: session.document.north_direction is not None)
    corners = session.document.evidence["Marker 1"].corners_src - session.cloud.origin
    world = session.document.world_from_source.apply(corners)
    np.testing.assert_allclose(world.mean(axis=0), 0, atol=1e-5)
    assert world[0, 0] < 0 < world[0, 1]  # the top-left corner lies north-west
    before = session.document
    tab.bridge_send("undo")
    tab.wait(lambda _: session.document is not before and session.document.north_direction is None)


# ---- by number


def test_weak_ways_are_offered_with_photos_and_called_weak(tab, session):
    way(tab, "number")
    tab.wait(lambda t: "weak: from two photos" in t.props("One unit is")["options"])
    tab.set("One unit is", "weak: from two photos")
    tab.wait_text("Weak: use it only where nothing else exists")
    names = [photo.name for photo in scale_plots.plot().posed]
    tab.set("Second photo", names[2])
    tab.set("Metres apart", "far")
    tab.press("Set scale")
    tab.wait_notification("was not understood")
    assert not session.document.scale.is_known
    gap = np.linalg.norm(np.subtract(*(scale_plots.plot().posed.by_name(n).centre_src for n in (names[0], names[2]))))
    tab.set("Metres apart", "2,0")
    tab.press("Set scale")
    tab.wait(lambda _: session.document.scale.source == "baseline")
    assert session.document.scale.metres_per_unit == pytest.approx(2.0 / gap)
    tab.bridge_send("step", "scale")
    tab.wait_text("Weak: use it only")


def test_the_height_of_the_camera_by_number(tab, session):
    way(tab, "number")
    tab.set("One unit is", "weak: from the camera's height")
    tab.set("Camera height (m)", "1.9")
    tab.press("Set scale")
    tab.wait(lambda _: session.document.scale.source == "camera_height", LONG)
    # The walk was carried at 1.5 to 2.3 m.
    assert session.document.scale.metres_per_unit == pytest.approx(scale_plots.plot().metres_per_unit, rel=0.25)


# ---- without photos


@pytest.fixture
def bare(studio, tmp_path):
    """A tab in the Scale step of the plot without photos."""
    session = scale_plots.session_of(tmp_path, photos=False)
    studio.adopt(session)
    with FakeClient(studio.server.url) as client:
        client.wait_text("no scale yet", LONG)
        client.settle()  # the plot is shown: a step chosen before would be overtaken
        client.bridge_send("step", "scale")
        client.wait_text("Mark a bar")
        yield client.settle(), session


def test_without_photos_the_cloud_is_clicked_first_and_photos_are_asked_for(bare):
    tab, _ = bare
    assert not tab.has("Find markers in the photos") and not tab.has("Set scale")
    way(tab, "markers")
    tab.wait_text("This needs the photos")
    tab.wait(lambda t: t.has("Add photos"))
    tab.settle()
    assert not tab.has("Find markers in the photos")
    tab.bridge_send("mark", ["start", ["bar", "photos"]])
    tab.wait_notification("no photos yet")


def test_a_scaled_cloud_shows_its_unit_first(studio, bare):
    tab, session = bare
    session.do(commands.set_scale(ScaleEstimate(0.5, "factor")))
    tab.wait(lambda t: t.has("Set scale"))
    tab.wait_text("1 unit = 0.5 m")
    tab.bridge_send("scale-way", "cloud")
    tab.wait_text("Mark a bar")


def test_another_plot_ends_the_marking(studio, bare, tmp_path):
    tab, _ = bare
    tab.bridge_send("mark", ["start", ["bar", "cloud"]])
    tab.wait_text("(1 of 2)")
    (tmp_path / "other").mkdir()
    studio.adopt(scale_plots.session_of(tmp_path / "other", photos=False))
    tab.wait(lambda t: "(1 of 2)" not in t.text(), LONG)
    tab.settle()
    assert not tab_of(studio).marking.is_on
