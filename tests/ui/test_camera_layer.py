"""Where the photos were taken, in the scene: laid out in the world, followed, clicked."""

import numpy as np
import photo_plots
import plots
import pytest
from fakeclient import FakeClient
from panel import LONG, idle

from dbh_studio.app import commands
from dbh_studio.app.cameras import Cameras, cloud_sample, read_cameras
from dbh_studio.app.document import CameraSource, Document, SourceInfo
from dbh_studio.app.opening import open_plot
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import FrameFit, PosedImage, PosedImages
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.transforms import Similarity
from dbh_studio.ui.camera_layer import CameraGlyphs, frustum_cam

PINHOLE = CameraModel("PINHOLE", 400, 200, (200.0, 200.0, 200.0, 100.0))
PANORAMA = CameraModel("EQUIRECTANGULAR", 400, 200, ())


def cameras_of(*photos):
    posed = PosedImages(tuple(photos))
    return Cameras(CameraSource.of("nowhere"), posed, FrameFit("fits", "", ""), ())


def photo(name, camera, centre):
    return PosedImage(name, camera, Similarity(np.eye(3), -np.asarray(centre, float)))


@pytest.fixture
def document(tmp_path):
    return Document(
        "plot", SourceInfo.of(plots.plot().cloud, tmp_path / "plot.laz"), scale=ScaleEstimate(2.0, "factor")
    )


def test_frustums_have_the_lens_of_the_photo():
    lines = frustum_cam(PINHOLE)
    corners = lines[:4, 1]
    assert np.allclose(lines[:4, 0], 0)
    # 400 x 200 pixels, focal length 200: 2 wide and 1 high at depth 1.
    assert np.allclose(corners, [[-1, -0.5, 1], [1, -0.5, 1], [1, 0.5, 1], [-1, 0.5, 1]])
    fisheye = frustum_cam(CameraModel("OPENCV_FISHEYE", 3000, 3000, (900.0, 900.0, 1500.0, 1500.0, 0, 0, 0, 0)))
    assert np.allclose(np.linalg.norm(fisheye[:4, 1], axis=1), 1.0)
    assert np.isfinite(fisheye).all()


def test_photos_stand_where_they_were_taken(document):
    origin = np.array([500_000.0, 5_000_000.0, 100.0])
    centres = [origin + [0, 0, 1.0], origin + [1.0, 0, 1.0], origin + [3.0, 0, 1.0]]
    photos = [photo(str(i), PANORAMA if i else PINHOLE, centre) for i, centre in enumerate(centres)]
    glyphs = CameraGlyphs.of(cameras_of(*photos), document, origin, 10.0)
    assert np.allclose(glyphs.centres, [[0, 0, 2], [2, 0, 2], [6, 0, 2]])
    assert glyphs.is_globe.tolist() == [False, True, True]
    assert np.allclose(glyphs.path, [[[0, 0, 2], [2, 0, 2]], [[2, 0, 2], [6, 0, 2]]])
    # The axis of the frustum is the photo's: +z of the camera, which here is the source's.
    middle = glyphs.frustums[:4, 1].mean(axis=0) - glyphs.centres[0]
    assert np.allclose(middle[:2], 0, atol=1e-6) and middle[2] > 0
    assert set(glyphs.frustum_of) == {0}
    assert 0.02 < glyphs.radius < 0.5


def test_a_ray_meets_the_front_photo(document):
    photos = [photo(str(i), PANORAMA, (2.0 * i, 0, 0)) for i in range(4)]
    glyphs = CameraGlyphs.of(cameras_of(*photos), document, np.zeros(3), 10.0)
    along = np.array([1.0, 0.0, 0.0])
    assert glyphs.pick(np.array([-5.0, 0, 0]), along, 1e-3) == (0, pytest.approx(5.0))
    # Standing in a globe it is not in the way.
    assert glyphs.pick(np.array([0.01, 0, 0]), along, 1e-3)[0] == 1
    assert glyphs.pick(np.array([20.0, 0, 0]), along, 1e-3) is None
    assert glyphs.pick(np.array([-5.0, 3.0, 0]), along, 1e-3) is None


def test_five_hundred_photos_are_a_few_objects(document):
    rng = np.random.default_rng(0)
    photos = [photo(str(i), PINHOLE if i % 2 else PANORAMA, rng.uniform(-5, 5, 3)) for i in range(500)]
    glyphs = CameraGlyphs.of(cameras_of(*photos), document, np.zeros(3), 10.0)
    assert glyphs.frustums.shape == (250 * len(frustum_cam(PINHOLE)), 2, 3)
    assert glyphs.path.shape == (499, 2, 3)


@pytest.mark.parametrize("photos", [[], [("a", (0, 0, 0))], [("a", (0, 0, 0)), ("b", (0, 0, 0))]])
def test_one_photo_or_all_at_one_place(document, photos):
    glyphs = CameraGlyphs.of(cameras_of(*(photo(n, PINHOLE, c) for n, c in photos)), document, np.zeros(3), 10.0)
    assert 0 < glyphs.radius < 1 and np.isfinite(glyphs.frustums).all()


# -- in the studio


@pytest.fixture
def shown(studio, tmp_path):
    session = open_plot(plots.write_laz(tmp_path), project_dir=tmp_path / "plot.dbh")
    cameras = read_cameras(CameraSource.of(photo_plots.write_photos(tmp_path / "photos")), cloud_sample(session.cloud))
    session.remember_cameras(cameras)
    session.do(commands.set_cameras(cameras.source))
    studio.adopt(session)
    with FakeClient(studio.server.url) as client:
        client.wait(lambda t: "/cameras/globes" in t.scene and "/cameras/path" in t.scene, LONG)
        yield client


def places(client):
    return np.asarray(client.scene["/cameras/globes"].props["batched_positions"]).reshape(-1, 3)


def test_the_photos_follow_scale_and_undo_and_can_be_hidden(shown, studio):
    expected = photo_plots.centres() - studio.session.cloud.origin
    assert places(shown) == pytest.approx(expected, abs=1e-4)
    studio.session.do(commands.set_scale(ScaleEstimate(2.0, "factor")))
    shown.wait(lambda t: "/cameras/globes" in t.scene and np.allclose(places(t), 2 * expected, atol=1e-3), LONG)
    studio.session.do(commands.set_up("+x"))
    turned = studio.session.document.world_from_source.apply(expected)
    shown.wait(lambda t: "/cameras/globes" in t.scene and np.allclose(places(t), turned, atol=1e-3), LONG)
    shown.set("Show cameras", False)
    shown.wait(lambda t: "/cameras" in t.scene and not t.scene["/cameras"].visible)
    for _ in range(3):
        studio.session.undo()
    shown.wait(lambda t: "/cameras" not in t.scene and not t.has("Show cameras"), LONG)
    assert studio.wait_idle(LONG)


def test_clicking_a_photo_opens_it_and_flies_there(shown, studio):
    (tab,) = studio._tabs.values()
    centre = places(shown)[2].astype(float)
    away = centre + np.array([0.0, 0.0, 4.0])
    shown.look(away + np.array([0.3, 0.3, 0.0]), centre)
    shown.click_scene(centre)
    shown.wait(lambda t: tab.photos.image == photo_plots.name(2), LONG)
    idle(shown, studio)
    assert tab.client.camera.position == pytest.approx(centre, abs=1e-3)
    ahead = np.asarray(tab.client.camera.look_at) - centre
    forward = photo_plots.cam_from_source(2).rotation[2]
    assert ahead / np.linalg.norm(ahead) == pytest.approx(forward, abs=1e-3)
    assert "/cameras/current" in shown.scene
    assert tab.view.selected is None


def test_a_photo_behind_the_cloud_or_hidden_is_not_clicked(shown, studio):
    (tab,) = studio._tabs.values()
    centre = places(shown)[2].astype(float)
    points = studio.display.points
    below = points[np.argmin(np.linalg.norm(points[:, :2] - centre[:2], axis=1) + (points[:, 2] > centre[2]) * 99)]
    shown.look(np.array([*centre[:2], below[2] - 4.0]), centre)
    shown.click_scene(centre)
    idle(shown, studio)
    assert tab.photos.image is None
    shown.set("Show cameras", False)
    shown.look(centre + np.array([0.3, 0.3, 4.0]), centre)
    shown.click_scene(centre)
    idle(shown, studio)
    assert tab.photos.image is None
