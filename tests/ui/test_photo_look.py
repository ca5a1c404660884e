"""Which pixel of a photo each pixel of the view shows: exact there and back, at all zooms, over the seam too."""

import numpy as np
import pytest

from dbh_studio.core.camera import CameraModel
from dbh_studio.ui.photo_look import MOST_ZOOM, FlatLook, PanoramaLook, first_look
from dbh_studio.ui.photo_render import PhotoCache, PhotoPixels, jpeg_url

PANORAMA = CameraModel("EQUIRECTANGULAR", 8192, 4096, ())
PHOTO = CameraModel("OPENCV", 4000, 3000, (3000.0, 3010.0, 2005.0, 1490.0, -0.1, 0.02, 0.001, -0.001))
FISHEYE = CameraModel("OPENCV_FISHEYE", 3000, 3000, (900.0, 900.0, 1500.0, 1500.0, 0.0, 0.0, 0.0, 0.0))
UP = (0.05, -0.99, 0.1)


def panorama(*, yaw_deg=0.0, pitch_deg=0.0, zoom=1.0, up=UP, size=(480, 360)):
    x, y, z = up
    look = PanoramaLook(PANORAMA, *size, (x, y, z), np.radians(yaw_deg), np.radians(pitch_deg))
    return look.with_zoom(zoom)


def spots(look, n=60, seed=0):
    return np.random.default_rng(seed).uniform((0, 0), (look.width_px, look.height_px), (n, 2))


@pytest.mark.parametrize("zoom", [0.0, 0.2, 1.0, 4.0, MOST_ZOOM, 1e9])
@pytest.mark.parametrize(("yaw", "pitch"), [(0, 0), (180, 0), (-179.99, 30), (77, -60), (10, 88)])
def test_a_view_of_a_panorama_is_exact_there_and_back(zoom, yaw, pitch):
    look = panorama(yaw_deg=yaw, pitch_deg=pitch, zoom=zoom)
    xy = spots(look)
    uv = look.photo_from_view(xy)
    assert np.isfinite(uv).all()
    back, is_inside = look.view_from_photo(uv)
    assert is_inside.all()
    # In pixels of the photo, of which one is `zoom` of the view.
    assert np.abs(back - xy).max() < 0.01 * min(1.0, look.zoom)
    again = look.photo_from_view(back)
    difference = np.abs(again - uv)
    difference[:, 0] = np.minimum(difference[:, 0], PANORAMA.width_px - difference[:, 0])
    assert difference.max() < 1e-6


def test_a_view_over_the_seam_shows_both_borders():
    look = panorama(yaw_deg=180, up=(0, -1, 0), zoom=1.0)
    u = look.photo_from_view(np.array([[230.0, 180.0], [250.0, 180.0]]))[:, 0]
    assert u[0] == pytest.approx(8192 - 10, abs=0.1) and u[1] == pytest.approx(10, abs=0.1)


@pytest.mark.parametrize("camera", [PHOTO, FISHEYE])
@pytest.mark.parametrize("up", [(0, -1, 0), (1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, 0, 1)])
@pytest.mark.parametrize("zoom", [0.0, 0.5, 8.0, 1e9])
def test_a_view_of_a_flat_photo_is_exact_there_and_back(camera, up, zoom):
    look = FlatLook.whole(camera, 480, 360, up).with_zoom(zoom).centred_on((1234.5, 321.25))
    uv = np.random.default_rng(1).uniform((0, 0), (camera.width_px, camera.height_px), (60, 2))
    xy, _ = look.view_from_photo(uv)
    assert np.abs(look.photo_from_view(xy) - uv).max() < 1e-6
    assert look.zoom <= MOST_ZOOM


def test_beside_a_flat_photo_there_is_nothing():
    look = first_look(PHOTO, 900, 300, (0, -1, 0))
    uv = look.photo_from_view(np.array([[10.0, 150.0], [450.0, 150.0]]))
    assert np.isnan(uv[0]).all()
    assert uv[1] == pytest.approx([2000, 1500])


@pytest.mark.parametrize(
    ("up", "top"),
    [((0, -1, 0), (2000, 0)), ((1, 0, 0), (4000, 1500)), ((0, 1, 0), (2000, 3000)), ((-1, 0, 0), (0, 1500))],
)
def test_a_photo_taken_sideways_is_turned_upright(up, top):
    look = first_look(PHOTO, 480, 360, up)
    xy, _ = look.view_from_photo(np.array([top], float))
    whole = look.view_from_photo(np.array([[0, 0], [4000, 0], [4000, 3000], [0, 3000]], float))[0]
    assert xy[0] == pytest.approx([240, whole[:, 1].min()])
    assert whole.min() >= -1e-9 and np.all(whole <= (480 + 1e-9, 360 + 1e-9))


def test_up_is_up_in_a_panorama():
    up = np.array(UP) / np.linalg.norm(UP)
    look = panorama(yaw_deg=123, pitch_deg=10)
    column = look.rays(np.array([[240.0, 300.0], [240.0, 60.0]]))
    below, above = column @ up
    assert above > below
    # Everything in the middle column stands in one upright plane.
    side = look.rays(np.array([[250.0, 180.0]]))[0] - look.rays(np.array([[230.0, 180.0]]))[0]
    assert abs(side @ up) < 1e-9


@pytest.mark.parametrize("look", [panorama(yaw_deg=175, pitch_deg=20, zoom=0.5), panorama(zoom=8.0)])
def test_what_is_held_stays_under_the_pointer(look):
    held = look.photo_from_view(np.array([[200.0, 150.0]]))
    moved = look.panned((200.0, 150.0), (260.0, 190.0))
    assert moved.view_from_photo(held)[0][0] == pytest.approx([260, 190], abs=1e-3)


@pytest.mark.parametrize(
    "make",
    [
        lambda: panorama(yaw_deg=178, pitch_deg=-30, zoom=0.5),
        lambda: FlatLook.whole(PHOTO, 480, 360, (0, -1, 0)).with_zoom(0.5),
    ],
)
def test_zooming_keeps_what_is_under_the_pointer(make):
    look = make()
    held = look.photo_from_view(np.array([[300.0, 100.0]]))
    nearer = look.zoomed(3.0, (300.0, 100.0))
    assert nearer.zoom == pytest.approx(1.5)
    assert nearer.view_from_photo(held)[0][0] == pytest.approx([300, 100], abs=1e-3)


def test_the_field_of_view_has_limits():
    assert np.degrees(panorama(zoom=1e-9).fov_rad) == pytest.approx(110)
    assert panorama(zoom=1e9).zoom == pytest.approx(MOST_ZOOM)
    look = panorama(pitch_deg=80)
    for _ in range(20):
        look = look.panned((240.0, 100.0), (240.0, 300.0))
    assert abs(np.degrees(look.pitch_rad)) <= 89.0001


def test_a_pixel_can_be_brought_to_the_middle():
    for look in (panorama(), FlatLook.whole(PHOTO, 480, 360, (0, -1, 0)).with_zoom(4.0)):
        centred = look.centred_on((3.5, 1700.0))
        middle = centred.photo_from_view(np.array([[240.0, 180.0]]))[0]
        assert middle == pytest.approx([3.5, 1700.0], abs=1e-6)


def middles(look):
    """The middles of the pixels of a view, row by row."""
    rows, columns = np.indices((look.height_px, look.width_px)).reshape(2, -1)
    return np.column_stack([columns, rows]) + 0.5


@pytest.mark.parametrize(
    "look",
    [
        panorama(yaw_deg=179, pitch_deg=40, zoom=0.2),
        panorama(pitch_deg=89, zoom=0.5),
        panorama(yaw_deg=30, zoom=8.0),
        FlatLook.whole(PHOTO, 480, 360, (1, 0, 0)).with_zoom(0.7).centred_on((3000.0, 100.0)),
        FlatLook.whole(FISHEYE, 480, 360, (0, -1, 0)),
    ],
)
def test_the_picture_is_drawn_from_where_a_click_is_read(look):
    exact = look.photo_from_view(middles(look))
    drawn = np.column_stack([each.ravel() for each in look.maps()])
    is_shown = np.isfinite(exact).all(axis=1)
    difference = np.abs(drawn - exact)[is_shown]
    if isinstance(look, PanoramaLook):
        difference[:, 0] = np.minimum(difference[:, 0], PANORAMA.width_px - difference[:, 0])
        # Near a pole a pixel of the photo is far smaller than one of the view.
        difference[:, 0] *= np.sin(np.pi * exact[:, 1] / PANORAMA.height_px)
    assert difference.max() < 0.01
    beside = drawn[~is_shown]
    assert np.any((beside < 0) | (beside > (look.camera.width_px, look.camera.height_px)), axis=1).all()


def gradient(width, height):
    """Red grows with the column, green with the row."""
    rows, columns = np.indices((height, width))
    return np.stack([255 * columns / width, 255 * rows / height, 0 * rows], axis=2).astype(np.uint8)


@pytest.mark.parametrize("zoom", [0.1, 1.0, 6.0])
def test_the_picture_shows_the_pixels_the_look_says(zoom):
    camera = CameraModel("EQUIRECTANGULAR", 1024, 512, ())
    look = PanoramaLook(camera, 160, 120, UP, 0.4, 0.2).with_zoom(zoom)
    picture = PhotoPixels(gradient(1024, 512), 1024).render(look)
    uv = look.photo_from_view(middles(look)).reshape(120, 160, 2)
    expected = uv / (1024, 512) * 255
    assert np.abs(picture[:, :, :2] - expected).max() < 2.5


def test_a_smaller_photo_shows_the_same():
    """Photos may be smaller than the cameras say; clicks are in the camera's pixels."""
    look = FlatLook.whole(PHOTO, 160, 120, (0, -1, 0))
    large = PhotoPixels(gradient(4000, 3000), 4000).render(look)
    small = PhotoPixels(gradient(400, 300), 4000).render(look)
    assert np.abs(large.astype(int) - small).max() <= 3
    assert jpeg_url(small).startswith("data:image/jpeg;base64,")


def test_the_cache_keeps_the_last_photos_within_its_bound():
    from dbh_studio.core.posed_images import PosedImage
    from dbh_studio.core.transforms import Similarity

    camera, reads = CameraModel("EQUIRECTANGULAR", 64, 32, ()), []

    def read(photo):
        reads.append(photo.name)
        return np.zeros((32, 64, 3), np.uint8)

    cache = PhotoCache(read, most_bytes=2 * 64 * 32 * 4)
    photos = [PosedImage(str(i), camera, Similarity.identity(), path=f"{i}.jpg") for i in range(3)]
    for i in (0, 1, 0, 2, 0, 1):
        cache.pixels(photos[i])
    assert reads == ["0", "1", "2", "1"]
