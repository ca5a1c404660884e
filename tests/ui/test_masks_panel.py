"""Masks in the studio, over the real websocket: brought, asked about, painted, judged, made, voted with."""

import base64
import hashlib
import io
import json
import shutil
from pathlib import Path

import mask_plots
import numpy as np
import pytest
from fakeclient import FakeClient
from panel import LONG, idle
from PIL import Image
from tests import maskplot

from dbh_studio.app.brought_masks import MaskRequest, read_masks
from dbh_studio.app.plot_masks import take_over_brought
from dbh_studio.io.masks import MEANING_TITLES, MaskStore
from dbh_studio.io.models import ModelStore
from dbh_studio.settings import VoteSettings
from dbh_studio.ui.server import start_server
from dbh_studio.ui.studio import Studio

NAMES = [photo.name for photo in maskplot.photos()]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The plot's files; tests do not change them."""
    return mask_plots.write(tmp_path_factory.mktemp("mask_plot") / "plot")


@pytest.fixture
def plot(files, tmp_path, studio):
    """It, open in the studio; no model is on this computer."""
    studio.masks.use_models(ModelStore(folder=tmp_path / "no models", offline=True))
    studio.adopt(mask_plots.open_session(files, tmp_path / "plot.dbh"))
    return files


@pytest.fixture
def tab(plot, studio):
    with FakeClient(studio.server.url) as client:
        go_to_trunks(client)
        yield client


@pytest.fixture
def masked(studio, files, tmp_path):
    """A tab on the plot whose photos have their masks."""
    studio.masks.use_models(ModelStore(folder=tmp_path / "no models", offline=True))
    session = mask_plots.open_session(files, tmp_path / "plot.dbh")
    take_over_brought(session, read_masks(MaskRequest(files.masks), session.cameras.posed), session.cameras.posed)
    studio.adopt(session)
    with FakeClient(studio.server.url) as client:
        go_to_trunks(client)
        client.wait(lambda t: t.has("Find trunks from the masks"), LONG)
        yield client


def go_to_trunks(client):
    client.wait(lambda t: "/cameras" in t.scene, LONG)
    client.settle()
    client.bridge_send("step", "trunks")
    client.wait_text("Masks of the photos", LONG)


def kept(studio):
    """The masks beside the plot as they are on the disk now."""
    return MaskStore(studio.session.saver.folder / "masks")


def look_at(client, path, **also):
    for label, value in {"Masks in": str(path), **also}.items():
        client.set(label, value)
    client.press("Look at them")
    client.wait_text("What do these masks mean?", LONG)
    client.settle()


def frames(client):
    """(number, (H, W, 3) picture, how far it is painted) of the frames of the photo."""
    found = []
    for script in mask_plots.calls(client, "frame"):
        number, url, *_, painted = json.loads(f"[{script[len('dbhPhoto.frame(') : -1]}]")
        found.append((number, url, painted))
    return found


def picture(client):
    data = base64.b64decode(frames(client)[-1][1].split(",")[1])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def row(client):
    """What the row of buttons under the photo's title shows."""
    shown = mask_plots.calls(client, "masks")
    return json.loads(shown[-1][len("dbhPhoto.masks(") : -1]) if shown else None


def open_photo(client, studio, name):
    n_frames = len(frames(client))
    tab = studio._tabs[max(studio._tabs)]
    tab.worker.post(tab.photos.open, name)
    client.wait(lambda t: len(frames(t)) > n_frames, LONG)
    client.settle()
    return tab


def middle_of(name, label):
    """A pixel of the photo in the middle of a stem."""
    rows, columns = np.nonzero(maskplot.labels()[name] == label)
    assert np.ptp(columns) < 100, "it lies over the seam"
    return float(np.median(columns)) + 0.5, float(np.median(rows)) + 0.5


def look_to(client, shown, name, at_px, zoom):
    """Turn the photo so that a pixel of it is in the middle of the view."""
    n_frames = len(frames(client))
    shown.worker.post(lambda: shown.photos.open(name, at_px=at_px, zoom_px=zoom))
    client.wait(lambda t: len(frames(t)) > n_frames, LONG)
    client.settle()


def paint(client, points, *, radius=20.0, part=3, number=1):
    """One stroke in the frame that is shown, and the frame that has it."""
    flat = [float(value) for point in points for value in point]
    client.bridge_send("photo-paint", [frames(client)[-1][0], number, part, radius, flat])
    client.wait(lambda t: frames(t)[-1][2] >= number, LONG)


# ---- nothing yet


def test_a_plot_without_photos_says_what_photos_would_bring(studio, files, tmp_path):
    from dbh_studio.app.opening import open_plot

    studio.adopt(open_plot(files.cloud, project_dir=tmp_path / "alone.dbh", scale=1.0))
    with FakeClient(studio.server.url) as client:
        client.settle()  # the plot is shown: a step chosen before would be overtaken
        client.bridge_send("step", "trunks")
        client.wait_text("add photos in step 2", LONG)
        assert not client.has("Look at them") and not client.has("Find trunks from the masks")
        assert client.has("Find trunks")


def test_without_models_the_way_that_is_taken_is_told_and_what_the_others_need(tab):
    tab.wait_text("Trunks by geometry alone")
    text = tab.text()
    assert "No detector and no segmenter is on this computer." in text
    assert "dbh-studio models add FOLDER" in text and "All ways and what they cost" in text
    assert "--" not in text.replace("---", "")
    # What gets the models stands with the ways that need them, not with the masks a person brings.
    assert text.index("dbh-studio models add") < text.index("Masks you bring:") < text.index("Name their folder")
    assert not tab.has("Make masks") and not tab.has("Find trunks from the masks")


# ---- brought


def test_masks_are_looked_at_before_they_are_used_and_copied_beside_the_plot(tab, studio, plot):
    look_at(tab, plot.masks)
    assert 'src="data:image/jpeg;base64,' in tab.html()
    assert MEANING_TITLES["labels"] in tab.text() and not len(kept(studio))
    tab.press("Use these masks")
    tab.wait_text("8 of 8 photos have a mask.", LONG)
    tab.wait(lambda t: not t.has("Use these masks") and t.has("Find trunks by geometry"))
    assert sorted(entry.image for entry in kept(studio).entries) == NAMES
    assert (kept(studio).get(NAMES[2]).labels == maskplot.labels()[NAMES[2]]).all()


def test_a_mask_made_for_structure_from_motion_is_never_used_as_trunk(tab, studio, tmp_path):
    def walker(labels):
        return np.where(np.indices(labels.shape)[0] > 0.8 * labels.shape[0], 0, 255)

    folder = maskplot.save_masks(tmp_path / "sfm", walker)
    look_at(tab, folder)
    assert "ignore" in tab.text() and tab.has("Keep as areas to ignore")
    assert not tab.has("Use these masks")
    tab.press("Keep as areas to ignore")
    tab.wait_notification("Now name the masks of trunks", LONG)
    tab.wait(lambda t: t.value("Also ignore") == str(folder) and not t.has("Keep as areas to ignore"))
    assert not len(kept(studio))


def test_what_is_not_clear_is_asked_and_confirmed_in_the_panel(tab, studio, tmp_path):
    """Dark trunks may also be masks for structure from motion."""
    folder = maskplot.save_masks(tmp_path / "dark", lambda labels: np.where((labels > 0) & (labels < 9), 0, 255))
    look_at(tab, folder)
    assert "say what they mean" in tab.text() and "--mask" not in tab.text()
    tab.set("They mean", MEANING_TITLES["trunk_bright"])
    idle(tab, studio)
    tab.set("They mean", MEANING_TITLES["trunk_dark"])
    idle(tab, studio)
    tab.press("Use these masks")
    tab.wait_text("8 of 8 photos have a mask.", LONG)
    idle(tab, studio)
    labels = maskplot.labels()[NAMES[0]]
    assert ((kept(studio).get(NAMES[0]).labels > 0) == ((labels > 0) & (labels < 9))).all()


def test_a_guess_is_confirmed_by_one_press(tab, studio, tmp_path):
    folder = maskplot.save_masks(tmp_path / "dark", lambda labels: np.where((labels > 0) & (labels < 9), 0, 255))
    look_at(tab, folder)
    assert MEANING_TITLES["trunk_dark"] in tab.text()
    tab.press("Yes, use them so")
    tab.wait_text("8 of 8 photos have a mask.", LONG)
    idle(tab, studio)
    labels = maskplot.labels()[NAMES[0]]
    assert ((kept(studio).get(NAMES[0]).labels > 0) == ((labels > 0) & (labels < 9))).all()


def test_numbers_that_are_no_trunks_are_left_out(tab, studio, plot):
    look_at(tab, plot.masks)
    tab.set("Which are trunks", "1-3")
    tab.press("Show them read so")
    idle(tab, studio)
    tab.press("Use these masks")
    tab.wait_text("8 of 8 photos have a mask.", LONG)
    idle(tab, studio)
    assert set(np.unique(kept(studio).get(NAMES[0]).labels)) <= {0, 1, 2, 3}


def test_a_coco_file_whose_categories_have_other_names_asks_which_are_trunks(tab, studio, tmp_path):
    path = tmp_path / "outlines.json"
    path.write_text(json.dumps(maskplot.coco({1: "alpha", 2: "beta"}, lambda label: 2 if label == 9 else 1)))
    look_at(tab, path)
    assert "alpha" in tab.text() and tab.props("Yes, use them so")["disabled"]
    assert not tab.has("They mean")
    tab.set("Which are trunks", "alpha")
    tab.press("Show them read so")
    tab.press("Use these masks")
    tab.wait_text("8 of 8 photos have a mask.", LONG)


def test_masks_can_be_declined_and_what_is_wrong_is_told(tab, studio, plot, tmp_path):
    tab.press("Look at them")
    tab.wait_notification("No masks were named.", LONG)
    tab.set("Masks in", str(tmp_path / "nowhere"))
    tab.press("Look at them")
    tab.wait_notification("there is no such file or folder", LONG)
    (tmp_path / "empty").mkdir()
    tab.set("Masks in", str(tmp_path / "empty"))
    tab.press("Look at them")
    note = tab.wait_notification("no mask for any", LONG)
    assert "--" not in note.title + note.body
    idle(tab, studio)
    look_at(tab, plot.masks)
    tab.press("Do not use them")
    tab.wait(lambda t: not t.has("Use these masks"))
    assert not len(kept(studio))


# ---- looked through


def test_masks_are_accepted_and_rejected_one_after_the_other(masked, studio, files):
    masked.press("Look through the masks")
    masked.wait(lambda t: frames(t) and row(t) is not None and row(t)["has_mask"], LONG)
    masked.wait(lambda t: row(t)["status"] == "4 trunks · brought")
    masked.bridge_send("mask-do", ["accept", None])
    masked.wait(lambda t: any(NAMES[1] in script for script in mask_plots.calls(t, "open")), LONG)
    masked.settle()
    masked.bridge_send("mask-do", ["reject", None])
    masked.wait(lambda t: any(NAMES[2] in script for script in mask_plots.calls(t, "open")), LONG)
    masked.wait_text("1 accepted, 1 rejected", LONG)
    reviews = {entry.image: entry.review for entry in kept(studio).entries}
    assert reviews[NAMES[0]] == "accepted" and reviews[NAMES[1]] == "rejected" and reviews[NAMES[2]] == ""
    # Back to it: said again it is taken back.
    masked.bridge_send("photo-step", -1)
    masked.wait(lambda t: row(t)["review"] == "rejected", LONG)
    masked.bridge_send("mask-do", ["reject", None])
    masked.wait(lambda t: row(t)["review"] == "", LONG)
    masked.wait(lambda _: kept(studio).entry(NAMES[1]).review == "")


def test_the_mask_is_drawn_over_the_photo_as_strongly_as_wanted(masked, studio, files):
    look_to(masked, open_photo(masked, studio, NAMES[0]), NAMES[0], middle_of(NAMES[0], 1), 1.0)
    with_mask = picture(masked).astype(int)
    n_frames = len(frames(masked))
    masked.bridge_send("mask-do", ["on", False])
    masked.wait(lambda t: len(frames(t)) > n_frames and not row(t)["on"])
    without = picture(masked).astype(int)
    assert np.abs(with_mask - without).max() > 60
    n_frames = len(frames(masked))
    masked.bridge_send("mask-do", ["on", True])
    masked.bridge_send("mask-do", ["opacity", 100])
    masked.wait(lambda t: len(frames(t)) >= n_frames + 2 and row(t)["opacity"] == 100)
    assert np.abs(picture(masked).astype(int) - without).sum() > 1.2 * np.abs(with_mask - without).sum()


def test_in_other_steps_photos_have_no_masks(masked, studio, files):
    open_photo(masked, studio, NAMES[0])
    assert row(masked) is not None
    masked.bridge_send("step", "scale")
    masked.wait(lambda t: row(t) is None, LONG)


# ---- painted


def digest(folder):
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(Path(folder).iterdir())}


def test_a_stroke_is_saved_as_soon_as_it_is_done_and_no_brought_file_is_written(masked, studio, files):
    before = digest(files.masks)
    shown = open_photo(masked, studio, NAMES[3])
    masked.bridge_send("mask-do", ["paint", None])
    masked.wait(lambda t: row(t)["tool"] == "add", LONG)
    masked.settle()
    look = shown.photos._look
    paint(masked, [(60.0, 40.0), (100.0, 60.0)], number=7)
    # Nothing is closed, nothing waited for but the file: so it is after a kill, too.
    masked.wait(lambda _: kept(studio).entry(NAMES[3]).review == "repainted", LONG)
    mask, truth = kept(studio).get(NAMES[3]), maskplot.labels()[NAMES[3]]
    u, v = look.photo_from_view(np.array([[80.0, 50.0]]))[0]
    assert mask.labels[int(v), int(u)] == 10  # a new one beside 1, 2, 3 and 9
    assert ((mask.labels == truth) | (mask.labels == 10)).all()
    assert digest(files.masks) == before
    masked.wait(lambda t: "painted, saved" in row(t)["status"])

    # Taken back with Undo, stroke by stroke; the plot's own Undo is not touched.
    n_steps = studio.session.undo_label
    masked.bridge_send("undo")
    masked.wait(lambda _: (kept(studio).get(NAMES[3]).labels == truth).all(), LONG)
    assert studio.session.undo_label == n_steps
    masked.bridge_send("mask-do", ["done", None])
    masked.wait(lambda t: row(t)["tool"] == "")


def test_erasing_takes_the_trunk_away_under_the_brush_only(masked, studio, files):
    shown = open_photo(masked, studio, NAMES[0])
    truth = maskplot.labels()[NAMES[0]]
    look_to(masked, shown, NAMES[0], middle_of(NAMES[0], 9), 2.0)
    masked.bridge_send("mask-do", ["paint", None])
    masked.bridge_send("mask-do", ["tool", "erase"])
    masked.wait(lambda t: row(t)["tool"] == "erase", LONG)
    masked.settle()
    look = shown.photos._look
    paint(masked, [(look.width_px / 2, look.height_px / 2)], radius=8.0)
    masked.wait(lambda _: kept(studio).entry(NAMES[0]).review == "repainted", LONG)
    labels = kept(studio).get(NAMES[0]).labels
    gone = (truth == 9) & (labels == 0)
    assert 0 < gone.sum() < (truth == 9).sum() and (labels[~gone] == truth[~gone]).all()


def test_two_tabs_paint_one_mask(masked, studio, files):
    open_photo(masked, studio, NAMES[0])
    with FakeClient(studio.server.url) as other:
        go_to_trunks(other)
        open_photo(other, studio, NAMES[0])
        for client in (masked, other):
            client.bridge_send("mask-do", ["paint", None])
            client.wait(lambda t: row(t)["tool"] == "add", LONG)
            client.settle()
        n_frames = len(frames(other))
        paint(masked, [(40.0, 300.0)], number=1)
        other.wait(lambda t: len(frames(t)) > n_frames, LONG)  # it sees it without asking
        other.settle()
        paint(other, [(440.0, 300.0)], number=1)
        masked.wait(lambda _: set(kept(studio).get(NAMES[0]).numbers) == {1, 2, 3, 9, 10, 11}, LONG)


def test_a_photo_without_a_mask_gets_one_that_says_nothing_elsewhere(tab, studio, plot, tmp_path):
    some = tmp_path / "some"
    some.mkdir()
    for name in NAMES[:2]:
        shutil.copy(plot.masks / f"{Path(name).stem}.png", some)
    look_at(tab, some)
    tab.press("Use these masks")
    tab.wait_text("2 of 8 photos have a mask.", LONG)
    idle(tab, studio)
    open_photo(tab, studio, NAMES[5])
    assert not row(tab)["has_mask"] and row(tab)["status"] == "no mask"
    tab.bridge_send("mask-do", ["paint", None])
    tab.wait(lambda t: row(t)["tool"] == "add", LONG)
    tab.settle()
    paint(tab, [(200.0, 100.0), (200.0, 200.0)])
    tab.wait(lambda _: kept(studio).entry(NAMES[5]) is not None, LONG)
    mask = kept(studio).get(NAMES[5])
    assert mask.numbers == (1,) and np.array_equal(mask.ignored, mask.labels == 0)
    # Photos with masks are stepped through; this one is among them now.
    tab.bridge_send("mask-do", ["done", None])
    tab.bridge_send("photo-step", 1)
    tab.wait(lambda t: f'"{NAMES[0]}","1 / 3"' in mask_plots.calls(t, "open")[-1], LONG)


MADE_UP = [
    None,
    [],
    [1, 2, 3],
    [1, 1, 3, 10.0, "xy"],
    [1, 1, 3, 10.0, [1.0]],
    [1, 1, 3, 10.0, [None, 2.0]],
    [1, 1, 3, 1e300, [1.0, 2.0]],
    [10**9, 1, 3, 10.0, [1.0, 2.0]],
    [1, 1, 3, 10.0, [0.0] * 10_000],
]


def test_what_a_page_makes_up_paints_nothing(masked, studio, files):
    open_photo(masked, studio, NAMES[0])
    masked.bridge_send("mask-do", ["paint", None])
    for payload in MADE_UP:
        masked.bridge_send("photo-paint", payload)
        masked.bridge_send("photo-box", payload)
    for made_up in (None, [], ["tool", 3], ["tool", "box2"], ["opacity", "x"], [[], []], ["accept"]):
        masked.bridge_send("mask-do", made_up)
    masked.settle()
    assert not [note for note in masked.notifications if "Unexpected" in note.title]
    assert all(entry.review == "" for entry in kept(studio).entries)


def test_a_plot_open_for_reading_only_is_looked_at_and_not_painted(files, studio, tmp_path):
    from dbh_studio.app.opening import open_plot

    mask_plots.open_session(files, tmp_path / "plot.dbh").close()
    session = open_plot(tmp_path / "plot.dbh", read_only=True)
    from dbh_studio.app.cameras import cloud_sample, read_cameras

    session.remember_cameras(read_cameras(session.document.cameras, cloud_sample(session.cloud)))
    studio.adopt(session)
    with FakeClient(studio.server.url) as client:
        go_to_trunks(client)
        open_photo(client, studio, NAMES[0])
        assert row(client)["can_paint"] is False
        client.bridge_send("mask-do", ["paint", None])
        client.wait_notification("The mask cannot be changed.", LONG)


# ---- voted with


def test_trunks_are_found_from_masks_and_the_cloud_shows_the_label_counts(masked, studio, files, tmp_path):
    masked.press("Find trunks from the masks")
    masked.wait(lambda _: len(studio.session.document.trunks) == 4, LONG)
    idle(masked, studio)
    assert "from 8 masks" in studio.session.undo_label
    assert studio.session.document.masks is not None
    assert any("Label count" in script for script in masked.javascript)
    masked.bridge_send("colours", "Label count")
    masked.wait(lambda t: "/count/low/0" in t.scene and t.scene["/count"].visible, LONG)
    assert not masked.scene["/rgb"].visible
    assert any("Masks that call a point trunk" in script for script in masked.javascript)
    counts = studio.masks.label_counts()
    assert len(np.unique(counts.colours, axis=0)) > 4

    # Undo takes the trunks and what is said of them; Redo brings both back.
    studio.session.undo()
    masked.wait(lambda t: t.scene["/rgb"].visible, LONG)
    studio.session.redo()
    idle(masked, studio)
    assert studio.masks.label_counts() is not None

    # The plot closed and opened again has them too.
    folder = studio.session.saver.folder
    again = Studio(start_server(port=0), uploads_folder=tmp_path / "uploads2")
    try:
        studio.session.flush()
        studio.session.close()
        again.adopt(mask_plots.open_session(files, folder))
        with FakeClient(again.server.url) as client:
            client.wait(lambda t: any("Label count" in script for script in t.javascript), LONG)
            client.bridge_send("colours", "Label count")
            client.wait(lambda t: "/count/low/0" in t.scene, LONG)
    finally:
        again.close()


def test_who_paints_is_not_taken_away_when_the_first_trunks_are_found(masked, studio, files):
    shown = open_photo(masked, studio, NAMES[0])
    masked.bridge_send("mask-do", ["paint", None])
    masked.wait(lambda t: row(t)["tool"] == "add", LONG)
    studio.mask_jobs.find_trunks(VoteSettings())
    masked.wait(lambda _: len(studio.session.document.trunks) == 4, LONG)
    idle(masked, studio)
    assert (shown.view.step, row(masked)["tool"]) == ("trunks", "add")


def test_rejected_masks_do_not_vote(masked, studio, files):
    for name in NAMES:
        studio.masks.review(name, "rejected")
    masked.wait_text("8 rejected", LONG)
    masked.wait(lambda t: not t.has("Find trunks from the masks") and t.has("Find trunks"))


# ---- made


def test_masks_are_made_by_models_stopped_and_gone_on_with(tab, studio, plot, tmp_path):
    studio.masks.use_models(mask_plots.tiny_models(tmp_path / "tiny", detector=True))
    with FakeClient(studio.server.url) as client:
        go_to_trunks(client)
        client.wait_text("Trunks by detector and SAM", LONG)
        client.set("Photos", "all")
        client.set("Panoramas", "whole")
        client.set("Longest side of a mask (px)", 1024)
        client.press("Make masks")
        client.wait(lambda _: len(kept(studio)) >= 1, LONG)
        client.bridge_send("cancel")
        client.wait_notification("what was made until then is kept", LONG)
        idle(client, studio)
        made = len(kept(studio))
        if made < len(NAMES):
            client.wait_text(f"{made} of 8 masks are made.", LONG)
            client.press("Go on making masks")
        client.wait(lambda _: len(kept(studio)) == len(NAMES), LONG)
        idle(client, studio)
        client.wait_text("8 of 8 photos have a mask.", LONG)
        assert studio.masks.why_not() == ""
    found = [kept(studio).get(name) for name in NAMES]
    assert sum(len(mask.numbers) for mask in found) > 0


def test_another_plot_opened_while_masks_are_made_hears_nothing_of_them(tab, studio, plot, tmp_path):
    studio.masks.use_models(mask_plots.tiny_models(tmp_path / "tiny", detector=True))
    with FakeClient(studio.server.url) as client:
        go_to_trunks(client)
        client.wait(lambda t: t.has("Make masks"), LONG)
        client.set("Photos", "all")
        client.press("Make masks")
        client.wait(lambda _: studio.masks.writing, LONG)
        studio.adopt(mask_plots.open_session(plot, tmp_path / "other.dbh"))
        idle(client, studio)
        assert (studio.mask_jobs.undone, studio.mask_jobs.said, studio.masks.why_not()) == (None, (), "")


def test_what_is_half_typed_about_making_is_told_only_when_it_is_used(tab, studio, plot, tmp_path):
    studio.masks.use_models(mask_plots.tiny_models(tmp_path / "tiny", detector=True))
    with FakeClient(studio.server.url) as client:
        go_to_trunks(client)
        client.wait(lambda t: t.has("Make masks"), LONG)
        client.set("Photos", "many")
        client.settle()
        assert not client.notifications
        client.press("Make masks")
        client.wait_notification("is no number of photos", LONG)


def test_a_click_outlines_the_trunk_under_it(masked, studio, files, tmp_path):
    studio.masks.use_models(mask_plots.tiny_models(tmp_path / "tiny", detector=False))
    name, truth = NAMES[1], maskplot.labels()[NAMES[1]]
    shown = open_photo(masked, studio, name)
    look_to(masked, shown, name, middle_of(name, 2), 3.0)
    masked.bridge_send("mask-do", ["paint", None])
    masked.wait(lambda t: row(t)["tool"] == "add" and row(t)["can_click"], LONG)
    masked.bridge_send("mask-do", ["tool", "box"])
    masked.wait(lambda t: row(t)["tool"] == "box", LONG)
    masked.settle()
    look = shown.photos._look
    x, y = look.width_px / 2, look.height_px / 2
    masked.bridge_send("photo-box", [frames(masked)[-1][0], x, y, x, y])
    masked.wait(lambda _: kept(studio).entry(name).review == "repainted", LONG)
    labels = kept(studio).get(name).labels
    outlined = labels == 10
    assert outlined.sum() > 50 and (truth[outlined] == 2).mean() > 0.7
    # It is one stroke.
    masked.bridge_send("mask-do", ["undo", None])
    masked.wait(lambda _: (kept(studio).get(name).labels == truth).all(), LONG)
