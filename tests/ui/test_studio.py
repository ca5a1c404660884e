"""The studio as a person uses it, over the real websocket, without a browser."""

import csv
import dataclasses
import io
import json

import endless
import numpy as np
import plots
import pytest
from fakeclient import FakeClient
from panel import LONG, find_trunks, idle, open_by_path, table_ids

from dbh_studio.app import commands
from dbh_studio.app.opening import open_plot
from dbh_studio.core.reconstruction import TriangleMesh
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.ui.server import start_server
from dbh_studio.ui.studio import Studio


@pytest.fixture
def tab(studio):
    with FakeClient(studio.server.url) as client:
        yield client


@pytest.fixture
def plot_path(tmp_path):
    return plots.write_laz(tmp_path)


def test_from_an_empty_studio_to_the_inventory(tab, studio, plot_path):
    measured = tab
    open_by_path(tab, plot_path)
    find_trunks(tab, studio)
    ids = table_ids(tab)
    assert len(ids) == len(plots.plot().trees)
    measured.bridge_send("row", ids[0])
    measured.wait_text(f"Tree {ids[0]}")
    measured.wait_text("Ring seen")
    measured.bridge_send("step", "export")
    measured.press("Download the inventory (CSV)")
    measured.wait(lambda t: t.downloads, LONG)
    ((name, content),) = measured.downloads.items()
    assert name == "plot_inventory.csv"
    rows = list(csv.DictReader(io.StringIO(content.decode())))
    assert sorted(float(row["dbh_cm"]) for row in rows) == pytest.approx(plots.true_diameters_cm(), rel=0.04)
    measured.wait_text("The inventory has been exported")


def test_the_number_on_the_card_is_the_number_in_the_session(measured, studio):
    trunk_id = table_ids(measured)[0]
    measured.bridge_send("row", trunk_id)
    measured.wait_text(f"Tree {trunk_id}")
    expected = studio.session.measurement(trunk_id).result.dbh_cm
    measured.wait(lambda t: f'data-dbh="{expected:.1f}"' in t.html())


def test_clicking_each_trunk_in_the_scene_selects_it(measured, studio):
    points = studio.session.points_world()
    for trunk in studio.session.document.trunks:
        stem = points[trunk.points]
        middle = np.median(stem[np.abs(stem[:, 2] - np.median(stem[:, 2])) < 0.5], axis=0).astype(float)
        measured.look(middle + np.array([2.5, -1.0, 0.3]), middle)
        measured.click_scene(middle)
        measured.wait_text(f"Tree {trunk.id}")
        measured.wait(lambda t: "/highlight" in t.scene)


def test_clicking_the_ground_selects_nothing(measured, studio):
    trunk_id = table_ids(measured)[0]
    measured.bridge_send("row", trunk_id)
    measured.wait_text(f"Tree {trunk_id}")
    measured.wait(lambda t: "/highlight" in t.scene)
    display = studio.display
    ground = display.points[np.argmin(display.points[:, 2])].astype(float)
    measured.look(ground + np.array([0.5, 0.5, 6.0]), ground)
    measured.click_scene(ground)
    measured.wait(lambda t: "/highlight" not in t.scene)


def test_undo_and_redo_of_a_deleted_trunk(measured, studio):
    ids = table_ids(measured)
    measured.bridge_send("row", ids[1])
    measured.wait_text(f"Tree {ids[1]}")
    measured.press("Delete this trunk")
    measured.wait(lambda t: table_ids(t) == [i for i in ids if i != ids[1]] and f"/red/{ids[1]}" not in t.scene)
    measured.bridge_send("undo")
    measured.wait(lambda t: table_ids(t) == ids and f"/red/{ids[1]}" in t.scene)
    measured.command("Redo")
    measured.wait(lambda t: ids[1] not in table_ids(t))


def test_a_double_click_on_find_trunks_runs_once(tab, studio, plot_path):
    open_by_path(tab, plot_path)
    tab.press("Find trunks", force=True)
    tab.press("Find trunks", force=True)
    tab.wait_text("trunks found", LONG)
    idle(tab, studio)
    assert studio.session.undo_label.startswith("Find")
    studio.session.undo()
    assert not studio.session.can_undo


def test_cancel_leaves_the_plot_as_it_was(tab, studio, plot_path, monkeypatch):
    open_by_path(tab, plot_path)
    before = studio.session.document
    with monkeypatch.context() as patch:
        patch.setattr("dbh_studio.app.pipeline.segment_plot", endless.work)
        tab.press("Find trunks")
        tab.wait(lambda t: "Finding trunks" in t.text() and "Cancel" in t.text())
        tab.wait(lambda t: not t.enabled("Find trunks"))
        tab.bridge_send("cancel")
        tab.wait_notification("Cancelled", LONG)
    tab.wait(lambda t: "Cancel" not in t.text() and t.enabled("Find trunks"))
    assert studio.session.document is before
    # And it can be started again.
    find_trunks(tab, studio)


def test_cancelled_measuring_is_taken_up_again(tab, studio, plot_path, monkeypatch):
    open_by_path(tab, plot_path)
    with monkeypatch.context() as patch:
        patch.setattr("dbh_studio.app.pipeline.measure_stems", endless.work)
        tab.press("Find trunks")
        tab.wait_text("Measuring", LONG)
        tab.bridge_send("cancel")
        tab.wait_notification("Cancelled", LONG)
        idle(tab, studio)
    assert studio.session.unmeasured()
    tab.wait_text("not measured yet")
    tab.wait(lambda t: 'data-do="measure"' in t.html())
    tab.bridge_send("measure")
    tab.wait(lambda t: not studio.session.unmeasured() and "not measured yet" not in t.text(), LONG)


def test_an_unscaled_cloud_is_not_measured_until_it_has_a_scale(tab, studio, tmp_path):
    path = plots.write_unscaled_ply(tmp_path, metres_per_unit=1.7)
    tab.wait_text("Open a point cloud")
    tab.set("File or folder", str(path))
    tab.press("Open")
    tab.wait_text("This cloud has no scale yet", LONG)
    tab.settle()
    tab.bridge_send("step", "trunks")
    tab.press("Find trunks")
    tab.wait_notification("no scale")
    assert len(studio.session.document.trunks) == 0
    tab.bridge_send("step", "scale")
    tab.bridge_send("scale-way", "number")
    tab.set("One unit is", "another unit")
    tab.set("Metres per unit", 1.7)
    tab.press("Set scale")
    tab.wait(lambda t: t.has("Find trunks"))
    find_trunks(tab, studio)
    found = [row.dbh_cm for row in studio.session.inventory()]
    assert np.sort(found) == pytest.approx(plots.true_diameters_cm(), rel=0.04)


def test_changing_the_scale_afterwards_changes_the_diameters_and_keeps_the_trunks(measured, studio):
    before = {row.stem_id: row.dbh_cm for row in studio.session.inventory()}
    trunks = studio.session.document.trunks
    measured.bridge_send("step", "scale")
    measured.set("One unit is", "another unit")
    measured.set("Metres per unit", 1.02)
    measured.press("Set scale")
    measured.wait(lambda t: studio.session.document.scale.metres_per_unit == 1.02)
    idle(measured, studio)
    assert studio.session.document.trunks is trunks
    after = {row.stem_id: row.dbh_cm for row in studio.session.inventory()}
    # The band moves with the scale as well, so the taper adds a little.
    assert all(after[i] == pytest.approx(1.02 * before[i], rel=0.03) for i in before)


def test_choosing_another_curve_measures_again(measured, studio):
    trunk_id = table_ids(measured)[0]
    measured.bridge_send("row", trunk_id)
    measured.wait_text("Shrinkage curve, tape")
    measured.set("Method", "ellipse")
    measured.press("Measure again")
    measured.wait_text("Ellipse, tape", LONG)
    assert studio.session.measurement(trunk_id).result.curve == "ellipse"
    measured.bridge_send("undo")
    measured.wait_text("Shrinkage curve, tape", LONG)
    measured.wait(lambda t: t.value("Method") == "shrinkage")


def test_the_method_is_chosen_for_the_plot_and_the_card_says_the_interval(measured, studio):
    trunk_id = table_ids(measured)[0]
    measured.bridge_send("row", trunk_id)
    measured.wait_text("Shrinkage curve, tape")
    low, high = studio.session.measurement(trunk_id).result.interval
    measured.wait_text(f"cm ({low:.1f}–{high:.1f})")
    measured.set("Measured by", "Circle")
    measured.wait_text("Circle, tape", LONG)
    measured.set("Measured by", "Fourier")
    measured.wait_text("none: this method has none", LONG)
    assert studio.session.document.settings.measure.curve == "fourier"


def test_comparing_shows_every_method_of_the_chosen_tree_and_changes_nothing(measured, studio):
    trunk_id = table_ids(measured)[0]
    measured.bridge_send("row", trunk_id)
    measured.wait_text("Compare all")
    before, shown = studio.session.document, studio.session.measurement(trunk_id)
    measured.bridge_send("compare", None)
    measured.wait(lambda t: "Compare all" not in t.text(), LONG)
    measured.wait(lambda t: "data-profile" in t.html())
    assert studio.session.document is before and studio.session.measurement(trunk_id) is shown


def test_colour_modes_switch_by_visibility_only(measured):
    def shown():
        return {name for name in ("/rgb", "/height", "/red", "/tree") if measured.scene[name].visible}

    for mode, expected in (
        ("Original", {"/rgb"}),
        ("Segmentation (red)", {"/rgb", "/red"}),
        ("Segmentation (by tree)", {"/rgb", "/tree"}),
        ("Height", {"/height"}),
    ):
        measured.settle()
        n_before = len(measured.messages)
        measured.bridge_send("colours", mode)
        measured.wait(lambda _, expected=expected: shown() == expected)
        measured.settle()
        sent = {message["type"] for message in measured.messages[n_before:]}
        assert not any("PointCloud" in kind for kind in sent)


def test_the_cloud_arrives_coarse_first_and_within_the_budget(tmp_path, plot_path):
    studio = Studio(start_server(port=0), uploads_folder=tmp_path, display_points=70_000)
    try:
        studio.adopt(open_plot(plot_path, project_dir=tmp_path / "x.dbh"))
        with FakeClient(studio.server.url) as tab:

            def sizes(t):
                names = [n for n in t.scene if n.startswith("/rgb/") and n.rsplit("/", 1)[1].isdigit()]
                return [len(t.scene[name].props["points"]) for name in names]

            tab.wait(lambda t: sum(sizes(t)) == 70_000, LONG)
            assert sizes(tab)[0] == 60_000
    finally:
        studio.close()


def test_two_tabs_see_the_same_plot(measured, studio):
    ids = table_ids(measured)
    with FakeClient(studio.server.url) as other:
        other.wait(lambda t: table_ids(t) == ids, LONG)
        measured.bridge_send("row", ids[0])
        measured.wait_text(f"Tree {ids[0]}")
        measured.press("Delete this trunk")
        other.wait(lambda t: table_ids(t) == ids[1:])
        # Selection is each tab's own.
        other.settle()
        assert f"Tree {ids[0]}" not in other.text()


def test_a_reload_shows_the_plot_again(measured, studio):
    ids = table_ids(measured)
    measured.close()
    with FakeClient(studio.server.url) as again:
        again.wait(lambda t: table_ids(t) == ids, LONG)


def test_the_plot_is_saved_beside_its_source_and_opens_as_it_was(measured, studio, tmp_path):
    ids = table_ids(measured)
    measured.bridge_send("row", ids[0])
    measured.wait_text(f"Tree {ids[0]}")
    measured.wait(lambda t: t.has("Species"))
    measured.set("Species", "Quercus alba")
    measured.set("Status", "dead")
    measured.press("Keep")
    measured.wait(lambda t: studio.session.document.record(ids[0]).species == "Quercus alba")
    expected = [(row.stem_id, row.dbh_cm, row.species, row.status) for row in studio.session.inventory()]
    studio.close()
    reopened = open_plot(tmp_path / "plot.dbh", read_only=True)
    found = [(row.stem_id, pytest.approx(row.dbh_cm), row.species, row.status) for row in reopened.inventory()]
    assert expected == found
    assert ("Quercus alba", "dead") in [row[2:] for row in expected]


def test_a_hostile_species_name_is_text(measured):
    trunk_id = table_ids(measured)[0]
    measured.bridge_send("row", trunk_id)
    measured.wait_text(f"Tree {trunk_id}")
    measured.wait(lambda t: t.has("Species"))
    measured.set("Species", "<img src=x onerror=alert(1)>")
    measured.press("Keep")
    measured.wait(lambda t: "&lt;img" in t.html())
    shown = [element.props.get("content") or "" for element in list(measured.elements.values())]
    assert any("&lt;img" in content for content in shown)
    assert not any("<img" in content for content in shown)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("empty.ply", b"", "empty"),
        ("text.laz", b"x y z\n1 2 3\n", "text"),
        ("broken.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 1000\nproperty float x\n"
         b"property float y\nproperty float z\nend_header\n" + b"\0" * 24, ""),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_read_is_named_and_the_open_plot_stays(measured, studio, tmp_path, name, content, words):
    path = tmp_path / name
    path.write_bytes(content)
    before = studio.session
    measured.bridge_send("step", "open")
    measured.set("File or folder", str(path))
    measured.press("Open")
    note = measured.wait_notification(name, LONG)
    assert words in (note.title + note.body).lower()
    idle(measured, studio)
    assert studio.session is before
    measured.bridge_send("step", "inspect")
    measured.wait(table_ids)


def test_a_path_that_does_not_exist(tab):
    tab.wait_text("Open a point cloud")
    tab.set("File or folder", "/no/such/file.laz")
    tab.press("Open")
    tab.wait_notification("no such file")
    tab.set("File or folder", "   ")
    tab.press("Open")
    tab.wait_notification("No file was named")


def test_upload_through_the_browser(tab, studio, tmp_path, plot_path):
    tab.wait_text("Open a point cloud")
    tab.upload("Upload a cloud", "mine.laz", plot_path.read_bytes())
    tab.wait(lambda t: "mine" in t.text() and "Press Find trunks" in t.text(), LONG)
    assert (tmp_path / "uploads" / "mine.laz").exists()
    assert len(studio.session.cloud) == len(plots.plot().cloud)


def test_the_number_is_shown_before_the_picture_turns(measured, studio):
    """Text first: a slow graphics card must not delay what is read."""
    trunk_id = table_ids(measured)[-1]
    measured.settle()
    n_before = len(measured.messages)
    measured.bridge_send("row", trunk_id)
    measured.wait(lambda t: "/highlight" in t.scene)
    kinds = [
        (i, message["type"], str(message.get("updates", ""))) for i, message in enumerate(measured.messages[n_before:])
    ]
    text = next(i for i, kind, updates in kinds if kind == "GuiUpdateMessage" and f"Tree {trunk_id}" in updates)
    cloud = next(i for i, kind, _ in kinds if kind == "PointCloudMessage")
    assert text < cloud


def test_from_click_to_number_is_answered_from_memory(measured, studio, monkeypatch):
    """After the background measurement no click measures anything."""
    import dbh_studio.stages.measure as stage

    def never(*_, **__):
        raise AssertionError("measured again")

    monkeypatch.setattr(stage, "measure_trunk", never)
    for trunk_id in table_ids(measured):
        measured.bridge_send("row", trunk_id)
        measured.wait_text(f"Tree {trunk_id}")


def test_next_and_previous_tree_by_key(measured):
    ids = table_ids(measured)
    measured.command("Next tree")
    measured.wait_text(f"Tree {ids[0]}")
    measured.command("Previous tree")
    measured.wait_text(f"Tree {ids[-1]}")


def test_a_half_typed_setting_changes_nothing(measured, studio):
    before = studio.session.document
    measured.bridge_send("step", "trunks")
    measured.set("Thinnest trunk (cm)", 20.0)
    measured.settle()
    assert studio.session.document is before


def test_turning_a_y_up_cloud(tab, studio, plot_path):
    open_by_path(tab, plot_path)
    tab.bridge_send("step", "open")
    tab.set("Up in the file", "+y")
    tab.wait(lambda _: studio.session.document.up_direction == (0.0, 1.0, 0.0))
    idle(tab, studio)
    np.testing.assert_array_equal(studio.display.points, studio.session.points_world()[studio.display.indices])


def test_a_click_on_a_curve_in_the_legend_measures_all_trees_by_it(measured, studio):
    trunk_id = table_ids(measured)[0]
    measured.bridge_send("row", trunk_id)
    measured.wait_text("Shrinkage curve, tape")
    before = studio.session.document
    measured.bridge_send("curve", "ellipse")
    measured.wait_text("Ellipse, tape", LONG)
    idle(measured, studio)
    assert {row.dbh_method for row in studio.session.inventory() if row.dbh_cm} == {"ellipse"}
    assert studio.session.undo_label == "Measure by: Ellipse"
    studio.session.undo()
    assert studio.session.document is before


@pytest.mark.parametrize("payload", ["square", None, ["fourier"], {"curve": "ellipse"}, 3])
def test_what_is_no_curve_changes_nothing(measured, studio, payload):
    before = studio.session.document
    measured.bridge_send("curve", payload)
    measured.settle()
    assert studio.session.document is before
    assert not measured.notifications


def test_breast_height_of_another_country_takes_effect_at_once(measured, studio):
    trunk_id = table_ids(measured)[0]
    measured.bridge_send("row", trunk_id)
    measured.wait_text("the stretch from 1.15")
    assert measured.value("Breast height") == "1.30 m (Europe, Canada)"
    measured.set("Breast height", "1.37 m (USA)")
    measured.wait_text("the stretch from 1.22", LONG)
    assert studio.session.document.settings.measure.breast_height_m == 1.37
    measured.bridge_send("undo")
    measured.wait(lambda t: t.value("Breast height") == "1.30 m (Europe, Canada)", LONG)


def test_an_own_breast_height_is_typed_and_then_shown_as_own(measured, studio):
    before = studio.session.document
    measured.set("Breast height", "own, set below")
    measured.wait_notification("own breast height")
    measured.wait(lambda t: t.value("Breast height") == "1.30 m (Europe, Canada)")
    assert studio.session.document is before
    measured.set("Breast height (m)", 1.0)
    measured.press("Measure again")
    measured.wait(lambda t: t.value("Breast height") == "own, set below", LONG)
    assert studio.session.document.settings.measure.breast_height_m == 1.0


def test_settings_in_sight_and_those_under_more_settings_are_both_used(tab, studio, plot_path):
    open_by_path(tab, plot_path)
    tab.set("Thinnest trunk (cm)", 7.0)
    tab.set("Cluster neighbours", 12)
    tab.set("Terrain cell (m)", 0.6)
    find_trunks(tab, studio)
    settings = studio.session.document.settings
    assert (settings.trunks.min_diameter_cm, settings.trunks.cluster_min_points) == (7.0, 12)
    assert settings.ground.cell_m == 0.6


def test_scale_from_a_known_distance(tab, studio, tmp_path):
    path = plots.write_unscaled_ply(tmp_path)
    tab.wait_text("Open a point cloud")
    tab.set("File or folder", str(path))
    tab.press("Open")
    tab.wait_text("This cloud has no scale yet", LONG)
    tab.settle()
    tab.bridge_send("step", "scale")
    tab.bridge_send("scale-way", "number")
    tab.set("One unit is", "found from a known distance")
    tab.wait(lambda t: t.has("True length (m)") and not t.has("Metres per unit"))
    tab.set("True length (m)", 3.4)
    tab.set("Length in file", 2.0)
    tab.press("Set scale")
    tab.wait(lambda _: studio.session.document.scale.metres_per_unit == pytest.approx(1.7))


def test_the_unit_that_the_numbers_look_like_is_offered_and_not_taken(studio, tmp_path):
    session = open_plot(plots.write_unscaled_ply(tmp_path), project_dir=tmp_path / "x.dbh")
    session.data_check = dataclasses.replace(session.data_check, suggested_metres_per_unit=0.3048)
    studio.adopt(session)
    with FakeClient(studio.server.url) as tab:
        tab.wait(lambda t: t.has("Set scale"), LONG)
        tab.wait(lambda t: t.value("One unit is") == "feet")
        tab.settle()
        assert not session.document.scale.is_known


def test_a_doubt_about_the_file_is_read_before_anything_is_pressed(tab, studio, plot_path):
    """The test plot is sparse, which the data check warns of."""
    tab.wait_text("Open a point cloud")
    tab.set("File or folder", str(plot_path))
    tab.press("Open")
    tab.wait_text("Data check: look at the lines marked !", LONG)
    tab.wait(lambda t: 'data-do="next"' in t.html())


def test_the_empty_picture_says_what_to_do_until_a_plot_is_open(tab, studio, plot_path):
    tab.wait(lambda t: {"/floor", "/word"} <= set(t.scene))
    open_by_path(tab, plot_path)
    tab.wait(lambda t: not {"/floor", "/word"} & set(t.scene))


def test_a_plot_with_trunks_is_opened_with_its_trunks_in_red(measured):
    measured.wait(lambda t: t.scene["/red"].visible)
    measured.settle()
    bar = next(script for script in reversed(measured.javascript) if "dbh-view" in script)
    assert 'data-mode=\\"Segmentation (red)\\" aria-pressed=\\"true\\"' in bar


def test_the_arrows_on_the_card_go_from_tree_to_tree(measured):
    ids = table_ids(measured)
    measured.bridge_send("row", ids[0])
    measured.wait_text(f"Tree {ids[0]}")
    measured.bridge_send("neighbour", 1)
    measured.wait_text(f"Tree {ids[1]}")
    measured.bridge_send("neighbour", -1)
    measured.wait_text(f"Tree {ids[0]}")


def test_no_mesh_no_checkbox(measured):
    measured.settle()
    assert not measured.has("Mesh")


def test_a_mesh_is_shown_where_the_cloud_is_and_only_when_asked_for(studio, tmp_path):
    session = plots.measured_session(tmp_path)
    session.do(commands.set_scale(ScaleEstimate(2.0, "factor")))
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.5]], np.float32)
    colours = np.array([[255, 0, 0], [0, 255, 0], [128, 128, 255]], np.uint8)
    session.mesh = TriangleMesh(triangle, np.array([[0, 1, 2]], np.int32), colours)
    studio.adopt(session)
    with FakeClient(studio.server.url) as tab:
        tab.wait(lambda t: t.has("Mesh"), LONG)
        tab.settle()
        assert "/mesh" not in tab.scene
        tab.set("Mesh", True)
        tab.wait(lambda t: "/mesh" in t.scene and not t.scene["/rgb"].visible)  # points would show through
        corners, shown, extensions = mesh_of(tab)
        np.testing.assert_allclose(corners, 2.0 * triangle, atol=1e-6)
        # Linear light: half of the brightness seen is a fifth of the light.
        linear = [[255, 0, 0], [0, 255, 0], [56, 56, 255]]
        np.testing.assert_allclose(shown.astype(int), linear, atol=1)
        assert "KHR_materials_unlit" in extensions  # the daylight is in the colours already
        tab.set("Mesh", False)
        tab.wait(lambda t: not t.scene["/mesh"].visible and t.scene["/rgb"].visible)
        tab.set("Mesh", True)
        tab.wait(lambda t: t.scene["/mesh"].visible)
        # It follows the cloud when the scale is corrected.
        session.do(commands.set_scale(ScaleEstimate(3.0, "factor")))
        tab.wait(lambda t: "/mesh" in t.scene and mesh_of(t)[0].max() > 2.5, LONG)
        np.testing.assert_allclose(mesh_of(tab)[0], 3.0 * triangle, atol=1e-6)


def mesh_of(tab):
    """Corners and colours of the surface as the page gets it: a GLB of one part."""
    content = bytes(tab.scene["/mesh"].props["glb_data"])
    size = int.from_bytes(content[12:16], "little")
    tree, buffer = json.loads(content[20 : 20 + size]), content[28 + size :]
    (primitive,) = tree["meshes"][0]["primitives"]

    def values(name, dtype):
        accessor = tree["accessors"][primitive["attributes"][name]]
        start = tree["bufferViews"][accessor["bufferView"]]["byteOffset"]
        width = int(accessor["type"].removeprefix("VEC"))
        return np.frombuffer(buffer, dtype, accessor["count"] * width, start).reshape(-1, width)

    return values("POSITION", np.float32), values("COLOR_0", np.uint8)[:, :3], tree["materials"][0]["extensions"]


def test_a_mesh_too_large_for_a_browser_is_not_sent(studio, tmp_path, monkeypatch):
    monkeypatch.setattr("dbh_studio.ui.view_controls.MOST_FACES", 0)
    session = plots.measured_session(tmp_path)
    session.mesh = TriangleMesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
    studio.adopt(session)
    with FakeClient(studio.server.url) as tab:
        tab.wait(lambda t: t.has("Mesh"), LONG)
        tab.set("Mesh", True)
        tab.wait_notification("too many for a browser")
        tab.wait(lambda t: t.value("Mesh") is False)
        tab.settle()
        assert "/mesh" not in tab.scene


def test_a_mesh_without_colours_is_lit(studio, tmp_path):
    session = plots.measured_session(tmp_path)
    session.mesh = TriangleMesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
    studio.adopt(session)
    with FakeClient(studio.server.url) as tab:
        tab.wait(lambda t: t.has("Mesh"), LONG)
        tab.set("Mesh", True)
        tab.wait(lambda t: "/mesh" in t.scene)
        assert b"KHR_materials_unlit" not in bytes(tab.scene["/mesh"].props["glb_data"])
