"""Pictures of trees are cut out where geometry says, and drawn on without hiding anything."""

import cv2
import numpy as np
import pytest
from tests.treescene import FISHEYE, PANORAMA, PERSPECTIVE, Stem, facing, is_brown, is_ring, photo, picture, turned

from dbh_studio.core.tree_crop import outline_px, ring_px, tree_crop
from dbh_studio.stages.tree_pictures import OUTSIDE_RGB, TrunkDrawing, cut_out, drawn, jpeg

TREE = Stem(1.0, 3.5, 0.45)
SIZE = (360, 480)


def taken(camera, rotation=None, **turn):
    if rotation is None:
        return facing("a.jpg", camera, (0.0, 0.0, 1.6), TREE, **turn)
    return photo("a.jpg", camera, (0.0, 0.0, 1.6), rotation)


def cut(source, pixels=None, tall=3.2):
    crop = tree_crop(source, TREE.line, tall=tall, foot=0.0, size_px=SIZE)
    return crop, cut_out(picture(source, [TREE]) if pixels is None else pixels, crop)


AWAY = float(np.degrees(np.arctan2(TREE.x, TREE.y)))
WAYS = {
    "panorama": (PANORAMA, None, {}),
    "panorama held aslant": (PANORAMA, None, {"pitch_deg": 25, "roll_deg": 40}),
    "across the seam": (PANORAMA, turned(yaw_deg=AWAY + 180), {}),
    "at the zenith": (PANORAMA, turned(yaw_deg=AWAY, pitch_deg=88), {}),
    "at the nadir": (PANORAMA, turned(yaw_deg=AWAY, pitch_deg=-91), {}),
    "perspective": (PERSPECTIVE, None, {}),
    "perspective on its side": (PERSPECTIVE, None, {"roll_deg": 90}),
    "fisheye": (FISHEYE, None, {"pitch_deg": 10, "roll_deg": 15}),
}


@pytest.mark.parametrize("way", WAYS)
def test_the_ring_sits_on_the_stem(way):
    camera, rotation, turn = WAYS[way]
    crop, image = cut(taken(camera, rotation, **turn))
    assert image.shape == (480, 360, 3) and image.dtype == np.uint8
    brown = is_brown(image)
    ring, seen = ring_px(crop.view, TREE.ring())
    marked = is_ring(drawn(image, TrunkDrawing((), ring, seen)))
    middle = round(float(ring[seen, 1].mean()))
    across = np.flatnonzero(brown[middle])
    found = np.flatnonzero(marked.any(axis=0))
    assert abs(found[0] - across[0]) <= 3 and abs(found[-1] - across[-1]) <= 3
    # Nothing is beside the stem, and it is where breast height is: 1.3 m above the stem's foot.
    assert (marked & ~brown).sum() < 0.15 * marked.sum()
    foot, _ = crop.view.project(np.array([[TREE.x, TREE.y, 0.0]]))
    assert (foot[0, 1] - middle) * crop.units_per_px == pytest.approx(1.3, abs=0.06)


@pytest.mark.parametrize("way", ["panorama held aslant", "perspective on its side", "fisheye"])
def test_the_stem_is_upright(way):
    camera, rotation, turn = WAYS[way]
    _, image = cut(taken(camera, rotation, **turn))
    rows = np.flatnonzero(is_brown(image).sum(axis=1) > 10)
    middles = np.array([np.flatnonzero(is_brown(image)[row]).mean() for row in rows])
    slope = np.polyfit(rows, middles, 1)[0]
    assert len(rows) > 150
    assert abs(np.degrees(np.arctan(slope))) < 0.5


def test_a_smaller_copy_of_the_photo_shows_the_same():
    source = taken(PANORAMA)
    whole = picture(source, [TREE])
    _, fine = cut(source, whole)
    _, coarse = cut(source, cv2.resize(whole, (1024, 512), interpolation=cv2.INTER_AREA))
    both = is_brown(fine) & is_brown(coarse)
    assert both.sum() > 0.85 * is_brown(fine).sum()
    across = [np.flatnonzero(is_brown(image)[240]).mean() for image in (fine, coarse)]
    assert across[0] == pytest.approx(across[1], abs=1.5)


def test_where_the_photo_ends_it_is_grey():
    narrow = facing("a.jpg", PERSPECTIVE, (0.0, 0.0, 1.6), TREE, aside_deg=38)
    crop, image = cut(narrow)
    outside = np.isnan(crop.maps()[0])
    assert outside.any()
    assert (image[outside] == OUTSIDE_RGB).all()
    assert (image[~outside] == OUTSIDE_RGB).all(axis=1).mean() < 0.01


def test_only_lines_are_drawn_and_the_picture_itself_stays():
    crop, image = cut(taken(PANORAMA))
    before = image.copy()
    ring, seen = ring_px(crop.view, TREE.ring())
    edges = outline_px(crop.view, TREE.points(0.01))
    result = drawn(image, TrunkDrawing(edges, ring, seen))
    assert (image == before).all()
    changed = (result != image).any(axis=2)
    assert 0.005 < changed.mean() < 0.06
    assert (drawn(image, TrunkDrawing()) == image).all()


def test_hidden_parts_are_dashed():
    crop, image = cut(taken(PANORAMA), tall=1.6)
    ring, seen = ring_px(crop.view, TREE.ring())
    through = is_ring(drawn(image, TrunkDrawing((), ring, np.ones(len(seen), bool)))).sum()
    both = is_ring(drawn(image, TrunkDrawing((), ring, seen))).sum()
    dashed = is_ring(drawn(image, TrunkDrawing((), ring, np.zeros(len(seen), bool)))).sum()
    assert through > both > dashed > 0.05 * through


def test_a_jpeg_that_others_read():
    _, image = cut(taken(PANORAMA))
    read = cv2.imdecode(np.frombuffer(jpeg(image), np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
    assert read.shape == image.shape
    assert np.abs(read.astype(int) - image).mean() < 4
    assert len(jpeg(image, 30)) < len(jpeg(image, 95))
