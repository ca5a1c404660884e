"""Painting a mask through a look: every pixel whose middle is under the brush and no other, over seam and poles too."""

import numpy as np
import pytest

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.votes import Votes
from dbh_studio.io.masks import TrunkMask
from dbh_studio.ui.label_counts import UNSEEN, LabelCounts, most_shown
from dbh_studio.ui.mask_canvas import IGNORED, MaskCanvas, colours
from dbh_studio.ui.photo_look import FlatLook, PanoramaLook

PANORAMA = CameraModel("EQUIRECTANGULAR", 512, 256, ())
PHOTO = CameraModel("OPENCV", 400, 300, (300.0, 301.0, 205.0, 149.0, -0.1, 0.02, 0.001, -0.001))
TILTED = (0.08, -0.98, 0.12)


def panorama(yaw_deg=0.0, pitch_deg=0.0, zoom=1.0, up=TILTED):
    look = PanoramaLook(PANORAMA, 240, 180, up, np.radians(yaw_deg), np.radians(pitch_deg))
    return look.with_zoom(zoom)


LOOKS = {
    "middle": panorama(),
    "seam": panorama(180.0, 5.0, up=(0.0, -1.0, 0.0)),
    "seam, near": panorama(179.0, -10.0, 6.0),
    "zenith": panorama(30.0, 88.0),
    "nadir": panorama(-100.0, -89.0, 2.0),
    "wide": panorama(170.0, 60.0, 0.01),
    "whole photo": FlatLook.whole(PHOTO, 240, 180, (0, -1, 0)),
    "turned photo": FlatLook.whole(PHOTO, 240, 180, (1, 0, 0)).with_zoom(2.5).centred_on((390.0, 20.0)),
}
STROKES = {
    "dab": [(120.3, 88.7)],
    "line": [(60.0, 40.0), (110.5, 95.0), (108.0, 130.0)],
    "over the border": [(228.0, 100.0), (260.0, 60.0)],
}


def empty(camera, size=None):
    width, height = size or (camera.width_px, camera.height_px)
    return MaskCanvas(TrunkMask(np.zeros((height, width), np.uint16), has_instances=True), camera)


def under(look, canvas, points, radius):
    """(H, W) what must be painted, each pixel of the mask asked by itself."""
    width, height = canvas.size
    v, u = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    scale = np.array([look.camera.width_px / width, look.camera.height_px / height])
    xy, _ = look.view_from_photo(np.stack([u.ravel(), v.ravel()], axis=1) * scale)
    points = np.asarray(points, float)
    near = np.zeros(len(xy), bool)
    for a, b in zip(points, points[1:] if len(points) > 1 else points, strict=False):
        long = max(float(np.linalg.norm(b - a)), 1e-12)
        along, across = (xy - a) @ (b - a) / long, np.abs((xy - a) @ [b[1] - a[1], a[0] - b[0]]) / long
        near |= (along >= 0) & (along <= long) & (across <= radius) & (long > 1e-9)
        near |= (np.hypot(*(xy - a).T) <= radius) | (np.hypot(*(xy - b).T) <= radius)
    wanted = near.reshape(height, width)
    uv = look.photo_from_view(points)
    for u0, v0 in uv[np.isfinite(uv).all(axis=1)] / scale:
        wanted[min(int(v0), height - 1), min(int(u0), width - 1)] = True
    return wanted


@pytest.mark.parametrize("look", LOOKS.values(), ids=LOOKS)
@pytest.mark.parametrize("radius", [0.4, 9.0])
@pytest.mark.parametrize("points", STROKES.values(), ids=STROKES)
def test_what_is_under_the_brush_is_painted_and_nothing_else(look, points, radius):
    canvas = empty(look.camera)
    canvas.begin()
    n_changed = canvas.paint(look, points, radius, 5)
    painted = canvas.mask().labels == 5
    assert n_changed == painted.sum() > 0
    assert np.array_equal(painted, under(look, canvas, points, radius))
    assert canvas.undo() and not canvas.mask().labels.any() and not canvas.can_undo


def test_a_stroke_over_the_seam_paints_both_borders():
    look = LOOKS["seam"]
    canvas = empty(PANORAMA)
    canvas.paint(look, [(120.0, 90.0)], 12.0, 1)
    columns = np.flatnonzero((canvas.mask().labels == 1).any(axis=0))
    assert columns[0] == 0 and columns[-1] == 511 and len(columns) < 60


def test_at_the_zenith_the_brush_goes_all_round():
    canvas = empty(PANORAMA)
    look = panorama(0.0, 89.0, up=(0.0, -1.0, 0.0))
    pole, _ = look.view_from_photo(np.array([[0.0, 0.0]]))
    canvas.paint(look, pole, 20.0, 1)
    labels = canvas.mask().labels
    assert (labels[0] == 1).all() and not labels[100:].any()


def test_the_middle_of_a_mask_pixel_decides_also_where_the_mask_is_coarser_than_the_photo():
    look, points = LOOKS["seam"], STROKES["line"]
    canvas = empty(PANORAMA, (256, 128))
    canvas.paint(look, points, 11.0, 3)
    assert np.array_equal(canvas.mask().labels == 3, under(look, canvas, points, 11.0))


@pytest.mark.parametrize("look", LOOKS.values(), ids=LOOKS)
def test_everything_within_an_outline_is_within_its_reach(look):
    rng = np.random.default_rng(3)
    for _ in range(20):
        corner, size = rng.uniform((0, 0), (200, 150)), rng.uniform(2, 60, 2)
        outline = corner + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size
        parts, (v0, v1) = look.reach(outline)
        uv = look.photo_from_view(corner + rng.uniform(0, 1, (200, 2)) * size)
        uv = uv[np.isfinite(uv).all(axis=1)]
        inside = np.zeros(len(uv), bool)
        for u0, u1 in parts:
            inside |= (uv[:, 0] >= u0 - 1e-6) & (uv[:, 0] <= u1 + 1e-6)
        assert inside.all() and (uv[:, 1] >= v0 - 1e-6).all() and (uv[:, 1] <= v1 + 1e-6).all()


def test_a_finer_look_shows_the_same():
    for look in LOOKS.values():
        finer = look.finer(3.0)
        xy = np.array([[0.0, 0.0], [50.0, 170.0], [239.0, 3.0]])
        scale = np.array([finer.width_px / look.width_px, finer.height_px / look.height_px])
        assert np.allclose(finer.photo_from_view(xy * scale), look.photo_from_view(xy), atol=1e-6, equal_nan=True)


def test_a_shape_of_the_view_is_painted_where_the_view_shows_it():
    look = LOOKS["seam, near"]
    shape = np.zeros((360, 480), bool)  # twice as fine as the view
    shape[100:200, 150:170] = True
    canvas = empty(PANORAMA)
    assert canvas.fill(look, shape, 7) > 0
    width, height = canvas.size
    v, u = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    xy, _ = look.view_from_photo(np.stack([u.ravel(), v.ravel()], axis=1))
    with np.errstate(invalid="ignore"):
        wanted = np.all((xy * 2 >= (150, 100)) & (xy * 2 < (170, 200)), axis=1).reshape(height, width)
    assert np.array_equal(canvas.mask().labels == 7, wanted)
    assert canvas.fill(look, np.zeros((180, 240), bool), 7) == 0


# ---- which trunk, and what is erased


def two_trunks(ignored=None):
    labels = np.zeros((300, 400), np.uint16)
    labels[:, 100:120], labels[:, 200:220] = 3, 8
    return TrunkMask(labels, ignored, has_instances=True, scores={3: 0.5})


def test_a_stroke_that_begins_on_a_trunk_grows_it_and_one_beside_all_is_a_new_one():
    canvas, look = MaskCanvas(two_trunks(), PHOTO), LOOKS["whole photo"]
    on, _ = look.view_from_photo(np.array([[110.0, 150.0], [160.0, 150.0]]))
    assert canvas.number_for("add", look, tuple(on[0])) == 3
    assert canvas.number_for("add", look, tuple(on[1])) == 9
    assert canvas.number_for("erase", look, tuple(on[0])) == 0
    canvas.begin()
    canvas.paint(look, on, 5.0, 3)
    assert canvas.numbers() == (3, 8)
    assert canvas.mask().labels[150, 160] == 3 and canvas.mask().scores == {3: 0.5}


def test_a_mask_that_does_not_tell_trunks_apart_stays_so():
    labels = (two_trunks().labels > 0).astype(np.uint16)
    canvas = MaskCanvas(TrunkMask(labels), PHOTO)
    assert canvas.number_for("add", LOOKS["whole photo"], (1.0, 1.0)) == 1
    assert not canvas.mask().has_instances


def test_strokes_are_taken_back_one_by_one_and_a_stroke_in_parts_at_once():
    canvas, look = MaskCanvas(two_trunks(), PHOTO), LOOKS["whole photo"]
    before = canvas.mask().labels.copy()
    canvas.begin()
    canvas.paint(look, [(20.0, 20.0), (200.0, 20.0)], 6.0, 9)
    first = canvas.mask().labels.copy()
    canvas.begin()
    canvas.paint(look, [(20.0, 60.0), (100.0, 60.0)], 6.0, 0)
    canvas.paint(look, [(100.0, 60.0), (100.0, 10.0)], 6.0, 0)
    assert not np.array_equal(canvas.mask().labels, first)
    version = canvas.version
    assert canvas.undo() and np.array_equal(canvas.mask().labels, first) and canvas.version > version
    assert canvas.undo() and np.array_equal(canvas.mask().labels, before)
    assert not canvas.undo()


def test_what_is_ignored_stays_ignored_under_the_eraser_and_gives_way_to_a_trunk():
    ignored = np.zeros((300, 400), bool)
    ignored[200:] = True
    canvas, look = MaskCanvas(two_trunks(ignored), PHOTO), LOOKS["whole photo"]
    stroke, _ = look.view_from_photo(np.array([[30.0, 250.0], [300.0, 250.0]]))
    canvas.paint(look, stroke, 8.0, 0)
    assert np.array_equal(canvas.mask().ignored, ignored) and not canvas.is_silent
    canvas.paint(look, stroke, 8.0, 5)
    mask = canvas.mask()
    assert mask.labels[250, 50] == 5 and not mask.ignored[250, 50] and mask.ignored[250, 390]


def test_a_mask_begun_on_nothing_says_nothing_but_what_is_painted():
    big = CameraModel("EQUIRECTANGULAR", 8192, 4096, ())
    canvas = MaskCanvas(None, big)
    assert canvas.size == (4096, 2048) and canvas.is_silent
    look = PanoramaLook(big, 240, 180)
    number = canvas.number_for("add", look, (120.0, 90.0))
    canvas.paint(look, [(120.0, 90.0)], 10.0, number)
    mask = canvas.mask()
    assert mask.ignored is not None and np.array_equal(mask.ignored, mask.labels == 0) and mask.numbers == (1,)
    # Read again it is the same: what is erased says nothing again.
    again = MaskCanvas(mask, big)
    again.paint(look, [(120.0, 90.0)], 20.0, again.number_for("erase", look, (120.0, 90.0)))
    assert again.mask().ignored.all()


def test_the_middle_of_the_largest_trunk_is_on_it():
    assert MaskCanvas(two_trunks(), PHOTO).largest() == pytest.approx((110, 150), abs=1.5)
    labels = np.zeros((128, 256), np.uint16)
    labels[40:80, :9], labels[40:80, 250:], labels[60:, 100:103] = 4, 4, 2
    u, v = MaskCanvas(TrunkMask(labels, has_instances=True), PANORAMA).largest()  # of a photo twice as large
    assert labels[int(v / 2), int(u / 2)] == 4 and v == pytest.approx(120, abs=3)
    assert empty(PHOTO).largest() is None and MaskCanvas(None, PHOTO).largest() is None


# ---- showing


@pytest.mark.parametrize("look", LOOKS.values(), ids=LOOKS)
def test_each_pixel_of_the_view_shows_the_mask_pixel_under_its_middle(look):
    width, height = look.camera.width_px, look.camera.height_px
    labels = np.random.default_rng(0).integers(0, 9, (height, width)).astype(np.uint16)
    canvas = MaskCanvas(TrunkMask(labels, has_instances=True), look.camera)
    y, x = np.indices((look.height_px, look.width_px))
    uv = look.photo_from_view(np.stack([x.ravel(), y.ravel()], axis=1) + 0.5)
    shown = canvas.seen(look).ravel()
    # Looks are drawn to a hundredth of a pixel.
    with np.errstate(invalid="ignore"):
        sure = np.all(np.abs(uv - np.round(uv)) > 0.02, axis=1)
    at = np.minimum(uv[sure].astype(int), (width - 1, height - 1))
    assert sure.sum() > 1000 and np.array_equal(shown[sure], labels[at[:, 1], at[:, 0]])
    assert not shown[~np.isfinite(uv).all(axis=1)].any()


def test_the_picture_has_the_trunks_colours_and_is_untouched_elsewhere():
    canvas, look = MaskCanvas(two_trunks(), PHOTO), LOOKS["whole photo"]
    view = np.full((180, 240, 3), 100, np.uint8)
    picture, seen = canvas.draw(look, view, 0.5), canvas.seen(look)
    middle, _ = look.view_from_photo(np.array([[110.0, 150.0]]))
    x, y = middle[0].astype(int)
    assert seen[y, x] == 3
    assert picture[y, x] == pytest.approx(50 + 0.5 * colours(np.array([3]))[0], abs=1)
    assert (picture[seen == 0] == 100).all()
    assert not np.array_equal(colours(np.array([3])), colours(np.array([8])))


def test_what_is_ignored_is_darker():
    ignored = np.zeros((300, 400), bool)
    ignored[:, 300:] = True
    canvas, look = MaskCanvas(two_trunks(ignored), PHOTO), LOOKS["whole photo"]
    picture = canvas.draw(look, np.full((180, 240, 3), 100, np.uint8), 0.5)
    hidden = canvas.seen(look) == IGNORED
    assert hidden.any() and (picture[hidden] < 90).all()


# ---- label counts


def counted(n_seen, n_trunk):
    seen, trunk = np.array(n_seen, np.uint16), np.array(n_trunk, np.uint16)
    return Votes(seen, trunk, seen.astype(np.float32), trunk.astype(np.float32))


def test_label_counts_are_coloured_from_pale_to_dark_and_the_unseen_grey():
    counts = LabelCounts(counted([0, 4, 4, 4, 4], [0, 0, 1, 2, 4]), np.array([4, 3, 2, 1, 0]))
    assert tuple(counts.colours[4]) == UNSEEN
    brightness = counts.colours[:4].astype(int).sum(axis=1)
    assert (np.diff(brightness) > 0).all()
    assert [text for text, _ in counts.legend] == ["0", "1", "2", "3", "4"]
    assert counts.legend[-1][1] == "#{:02x}{:02x}{:02x}".format(*counts.colours[0])


def test_a_few_points_with_very_many_votes_do_not_take_the_colours_from_the_others():
    votes = counted(np.full(1000, 99), [*range(0, 5)] * 199 + [90] * 5)
    assert most_shown(votes) == 4
    legend = LabelCounts(votes, np.arange(1000)).legend
    assert legend[-1][0] == "4+" and legend[0][0] == "0"


def test_no_votes_at_all_have_a_legend_too():
    assert [text for text, _ in LabelCounts(counted([3, 3], [0, 0]), np.arange(2)).legend] == ["0", "1"]
