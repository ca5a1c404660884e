"""Photos in the studio, over the real websocket: offered, added, refused, opened, looked around in, clicked into."""

import base64
import io
import json
import re
import shutil

import numpy as np
import photo_plots
import plots
import pytest
from fakeclient import FakeClient
from panel import LONG, idle
from PIL import Image

from dbh_studio.app import commands
from dbh_studio.app.cameras import cloud_sample, read_cameras
from dbh_studio.app.document import CameraSource
from dbh_studio.app.opening import open_plot
from dbh_studio.core.camera import CameraModel
from dbh_studio.ui.photo_look import first_look
from dbh_studio.ui.photo_view import PhotoMark
from dbh_studio.ui.server import start_server
from dbh_studio.ui.studio import Studio

SIZE = (480, 360)
PANORAMA = CameraModel("EQUIRECTANGULAR", photo_plots.WIDTH, photo_plots.HEIGHT, ())


@pytest.fixture
def session(tmp_path):
    return open_plot(plots.write_laz(tmp_path), project_dir=tmp_path / "plot.dbh")


@pytest.fixture(scope="module")
def plot_with_photos(tmp_path_factory):
    """A studio on a plot that has photos, for tests that change neither."""
    folder = tmp_path_factory.mktemp("plot")
    running = Studio(start_server(port=0), uploads_folder=folder / "uploads")
    open_with_photos(running, folder)
    yield running
    running.close()


@pytest.fixture
def shown(plot_with_photos):
    """A tab of it."""
    with FakeClient(plot_with_photos.server.url) as client:
        client.wait(lambda t: "/cameras" in t.scene, LONG)
        yield client


@pytest.fixture
def own(studio, tmp_path):
    """A tab on a plot of its own that has photos."""
    open_with_photos(studio, tmp_path)
    with FakeClient(studio.server.url) as client:
        client.wait(lambda t: "/cameras" in t.scene, LONG)
        yield client


def open_with_photos(studio, folder):
    session = open_plot(plots.write_laz(folder), project_dir=folder / "plot.dbh")
    add_photos(session, photo_plots.write_photos(folder / "photos"))
    studio.adopt(session)


def add_photos(session, folder):
    cameras = read_cameras(CameraSource.of(folder), cloud_sample(session.cloud))
    session.remember_cameras(cameras)
    session.do(commands.set_cameras(cameras.source))


def go_to_scale(client):
    client.wait_text("Data check", LONG)
    client.settle()
    client.bridge_send("step", "scale")
    client.bridge_send("scale-way", "markers")


def tab_of(studio):
    """The tab that was opened last; one before it may not have gone yet."""
    return studio._tabs[max(studio._tabs)]


def on_worker(tab, fn, *args, **options):
    tab.worker.post(lambda: fn(*args, **options))
    assert tab.worker.join(LONG)


def calls(client, action):
    """The arguments of each call of the photo's script in the page, in order."""
    found = []
    for script in client.javascript:
        match = re.fullmatch(rf"dbhPhoto\.{action}\((.*)\)", script, re.DOTALL)
        if match:
            found.append(json.loads(f"[{match[1]}]"))
    return found


def last_frame(client):
    """(number, (H, W, 3) picture, marks) of the frame shown last."""
    number, url, marks = calls(client, "frame")[-1][:3]
    picture = Image.open(io.BytesIO(base64.b64decode(url.split(",")[1])))
    return number, np.asarray(picture.convert("RGB")), marks


def open_photo(studio, client, index, **options):
    n_before = len(calls(client, "frame"))
    on_worker(tab_of(studio), tab_of(studio).photos.open, photo_plots.name(index), **options)
    client.wait(lambda t: len(calls(t, "frame")) > n_before, LONG)
    client.settle()


def next_frame(client, kind, payload):
    n_before = len(calls(client, "frame"))
    client.bridge_send(kind, payload)
    client.wait(lambda t: len(calls(t, "frame")) > n_before, LONG)
    client.settle()


def dot_in(picture):
    """(x, y) of the middle of the white dot."""
    rows, columns = np.nonzero(picture.min(axis=2) > 140)
    assert len(rows)
    return float(columns.mean()) + 0.5, float(rows.mean()) + 0.5


def test_photos_beside_the_cloud_are_offered_and_not_taken(studio, session, tmp_path):
    photo_plots.write_photos(tmp_path / "photos")
    studio.adopt(session)
    with FakeClient(studio.server.url) as client:
        go_to_scale(client)
        client.wait_text("6 photos found beside the cloud (COLMAP)", LONG)
        assert session.document.cameras is None and "/cameras" not in client.scene
        client.press("Show them")
        client.wait_text("6 photos", LONG)
        client.bridge_send("photos-open")
        client.wait_text("6 photos (COLMAP), all on disk. They fit the cloud", LONG)
        client.wait(lambda t: "/cameras/globes" in t.scene, LONG)
        assert session.can_undo
        session.undo()
        client.wait(lambda t: "/cameras" not in t.scene, LONG)
        client.wait_text("found beside the cloud")
        session.redo()
        client.wait(lambda t: "/cameras/globes" in t.scene, LONG)


def test_adding_photos_by_path(studio, session, tmp_path):
    elsewhere = photo_plots.write_photos(tmp_path / "a" / "model", photos=False)
    shutil.move(elsewhere, tmp_path / "model")
    images = photo_plots.write_pictures(tmp_path / "pictures")
    (tmp_path / "cloud").mkdir()
    studio.adopt(session)
    with FakeClient(studio.server.url) as client:
        go_to_scale(client)
        client.press("Add photos")
        client.wait(lambda t: any("No file was named" in n.title for n in t.notifications))
        client.set("Cameras", str(tmp_path / "nothing"))
        client.press("Add photos")
        client.wait(lambda t: any("no such file" in n.title for n in t.notifications))
        client.set("Cameras", str(tmp_path / "model"))
        client.press("Add photos")
        client.wait_text("6 of 6 photos were not found: pano_00.jpg, pano_01.jpg, pano_02.jpg, …", LONG)
        client.wait_text("Type the folder they are in")
        client.set("Photos in", str(images))
        client.press("Read the photos again")
        client.wait(lambda t: "not found" not in t.text(), LONG)
        client.bridge_send("photos-open")
        client.wait_text("6 photos (COLMAP), all on disk", LONG)
        assert session.document.cameras.images_dir == images
        assert studio.wait_idle(LONG)


def test_photos_that_do_not_fit_are_said_so(studio, session, tmp_path):
    folder = photo_plots.write_photos(tmp_path / "photos", shift=500.0)
    add_photos(session, folder)
    studio.adopt(session)
    with FakeClient(studio.server.url) as client:
        go_to_scale(client)
        client.wait_text("The photos do not fit the cloud", LONG)
        client.wait_text("Export the cloud and the cameras from the same project")


def test_a_reopened_plot_reads_its_photos_again_and_says_when_they_are_gone(studio, session, tmp_path):
    folder = photo_plots.write_photos(tmp_path / "photos")
    add_photos(session, folder)
    session.close()
    studio.adopt(open_plot(tmp_path / "plot.dbh"))
    with FakeClient(studio.server.url) as client:
        client.wait(lambda t: "/cameras/globes" in t.scene, LONG)
    assert studio.wait_idle(LONG)
    studio.session.close()
    shutil.rmtree(folder)
    studio.adopt(open_plot(tmp_path / "plot.dbh"))
    with FakeClient(studio.server.url) as client:
        go_to_scale(client)
        client.wait_text("The photos of this plot cannot be shown", LONG)
        client.wait_text("There is no such file or folder")
        client.wait_text("If they were moved, type where they are now")
        assert "/cameras" not in client.scene


def test_a_photo_is_opened_and_its_pixels_are_the_photos(shown, plot_with_photos):
    open_photo(plot_with_photos, shown, 2)
    number, picture, marks = last_frame(shown)
    assert picture.shape == (SIZE[1], SIZE[0], 3) and marks == []
    picked = []
    on_worker(
        tab_of(plot_with_photos), setattr, tab_of(plot_with_photos).photos, "on_pick", lambda *pick: picked.append(pick)
    )
    shown.bridge_send("photo-click", [number, *dot_in(last_frame(shown)[1])])
    shown.wait(lambda t: picked)
    ((name, u, v),) = picked
    assert name == photo_plots.name(2)
    assert (u, v) == pytest.approx(photo_plots.DOT, abs=0.5)


def test_looking_around_and_zooming_keep_the_pixel_under_the_pointer(shown, plot_with_photos):
    picked = []
    tab = tab_of(plot_with_photos)
    on_worker(tab, setattr, tab.photos, "on_pick", lambda *pick: picked.append(pick))
    open_photo(plot_with_photos, shown, 0)
    x, y = dot_in(last_frame(shown)[1])
    next_frame(shown, "photo-drag", [x, y, 300, 200])
    assert dot_in(last_frame(shown)[1]) == pytest.approx((300, 200), abs=1.0)
    for _ in range(2):
        next_frame(shown, "photo-wheel", [300, 200, 5])
    assert dot_in(last_frame(shown)[1]) == pytest.approx((300, 200), abs=4.0)
    number, picture, _ = last_frame(shown)
    shown.bridge_send("photo-click", [number, *dot_in(picture)])
    shown.wait(lambda t: picked)
    assert picked[0][1:] == pytest.approx(photo_plots.DOT, abs=0.25)


def test_a_click_is_read_in_the_picture_it_was_made_on(shown, plot_with_photos):
    picked = []
    tab = tab_of(plot_with_photos)
    on_worker(tab, setattr, tab.photos, "on_pick", lambda *pick: picked.append(pick))
    open_photo(plot_with_photos, shown, 0)
    number, picture, _ = last_frame(shown)
    next_frame(shown, "photo-drag", [100, 100, 300, 150])
    shown.bridge_send("photo-click", [number, *dot_in(picture)])
    shown.wait(lambda t: picked)
    assert picked[0][1:] == pytest.approx(photo_plots.DOT, abs=0.5)


def test_a_photo_is_opened_at_a_pixel_with_marks(shown, plot_with_photos):
    tab = tab_of(plot_with_photos)
    marks = [PhotoMark(*photo_plots.DOT, "<b>1</b>"), PhotoMark(5.0, 5.0, "far away", "hint")]
    on_worker(tab, tab.photos.set_marks, lambda name: marks if name == photo_plots.name(1) else [])
    open_photo(plot_with_photos, shown, 1, at_px=photo_plots.DOT, zoom_px=8.0)
    _, picture, drawn = last_frame(shown)
    assert dot_in(picture) == pytest.approx((SIZE[0] / 2, SIZE[1] / 2), abs=1.0)
    assert drawn == [[240.0, 180.0, "<b>1</b>", "mark"]]
    # The white dot is 8 pixels of the photo wide.
    assert np.ptp(np.nonzero(picture.min(axis=2) > 140)[1]) == pytest.approx(8 * 8, abs=6)
    next_frame(shown, "photo-step", 1)
    assert tab.photos.image == photo_plots.name(2) and last_frame(shown)[2] == []

    # One keeps looking the same way in the plot, though the photos are turned by 60 degrees from one to the next.
    def direction(index):
        ray = PANORAMA.rays(np.array([photo_plots.DOT]))[0]
        return photo_plots.cam_from_source(index).rotation.T @ ray

    look = tab.photos._look
    middle = PANORAMA.rays(look.photo_from_view(np.array([[look.width_px / 2, look.height_px / 2]])))[0]
    assert photo_plots.cam_from_source(2).rotation.T @ middle == pytest.approx(direction(1), abs=1e-3)


def test_before_and_after_go_round_and_close_takes_the_photo_away(shown, plot_with_photos):
    tab = tab_of(plot_with_photos)
    open_photo(plot_with_photos, shown, 0)
    assert calls(shown, "open")[-1][:2] == [photo_plots.name(0), "1 / 6"]
    assert "/cameras/current" in shown.scene
    next_frame(shown, "photo-step", -1)
    assert tab.photos.image == photo_plots.name(5)
    shown.bridge_send("photo-close")
    shown.wait(lambda t: "/cameras/current" not in t.scene)
    assert tab.photos.image is None and calls(shown, "close")


def test_the_size_of_the_view_follows_the_page(shown, plot_with_photos):
    open_photo(plot_with_photos, shown, 0)
    next_frame(shown, "photo-size", [700, 500])
    assert last_frame(shown)[1].shape == (500, 700, 3)
    next_frame(shown, "photo-size", [1e7, 3])
    assert last_frame(shown)[1].shape == (50, 2000, 3)


def test_a_page_may_say_anything(shown, plot_with_photos):
    tab = tab_of(plot_with_photos)
    picked = []
    on_worker(tab, setattr, tab.photos, "on_pick", lambda *pick: picked.append(pick))
    open_photo(plot_with_photos, shown, 0)
    look = tab.photos._look
    for payload in (None, 5, "x", [], [1], [1, 2, "3", 4], [True, 1, 1, 1], [1e300, 1, 1, 1], {"a": 1}, [10**400, 1]):
        for kind in ("photo-drag", "photo-wheel", "photo-click", "photo-size", "photo-step"):
            shown.bridge_send(kind, payload)
    shown.bridge_send("photo-click", [999, 10, 10])
    shown.bridge_send("photo-click", [0.5, 10, 10])
    idle(shown, plot_with_photos)
    assert tab.photos._look is look and tab.photos.image == photo_plots.name(0) and picked == []
    assert shown.notifications == []


def test_without_anybody_who_wants_it_a_click_does_nothing(shown, plot_with_photos):
    open_photo(plot_with_photos, shown, 0)
    number, _, _ = last_frame(shown)
    shown.bridge_send("photo-click", [number, 240, 180])
    idle(shown, plot_with_photos)
    assert shown.notifications == []


def test_a_missing_and_a_broken_photo_say_so_in_place_of_the_picture(own, studio, tmp_path):
    tab, images = tab_of(studio), tmp_path / "photos" / "images"
    (images / photo_plots.name(3)).unlink()
    (images / photo_plots.name(4)).write_bytes(b"no picture")
    for index, problem in ((3, "There is no such file"), (4, "cannot be read as an image")):
        on_worker(tab, tab.photos.open, photo_plots.name(index))
        own.wait(lambda t, problem=problem: any(problem in said for (said,) in calls(t, "say")), LONG)
    open_photo(studio, own, 0)
    assert own.notifications == []


def test_a_name_that_is_none_is_refused(shown, plot_with_photos):
    tab = tab_of(plot_with_photos)
    on_worker(tab, tab.photos.open, "<none>")
    shown.wait(lambda t: any("There is no photo <none>" in n.title for n in t.notifications))
    assert tab.photos.image is None


def test_another_plot_takes_the_photo_away(own, studio, tmp_path):
    open_photo(studio, own, 0)
    (tmp_path / "other").mkdir()
    path = plots.write_laz(tmp_path / "other", "other.laz")
    studio.adopt(open_plot(path, project_dir=tmp_path / "other" / "other.dbh"))
    own.wait(lambda t: "/cameras" not in t.scene and calls(t, "close"), LONG)
    idle(own, studio)
    assert tab_of(studio).photos.image is None


def test_a_new_up_direction_turns_the_photo(own, studio):
    open_photo(studio, own, 0)
    before = tab_of(studio).photos._look
    studio.session.do(commands.set_up("+x"))
    own.wait(lambda t: tab_of(studio).photos._look is not before, LONG)
    assert tab_of(studio).photos._look.up_cam == pytest.approx(
        tuple(photo_plots.cam_from_source(0).rotation @ [1.0, 0.0, 0.0]), abs=1e-9
    )


def test_a_look_at_a_photo_is_of_its_kind():
    assert type(first_look(CameraModel("PINHOLE", 100, 80, (90, 90, 50, 40)), *SIZE, (0, -1, 0))).__name__ == "FlatLook"
