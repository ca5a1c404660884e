"""Crops of every lens: upright, in the right place, with ring and outline where geometry says they are."""

import numpy as np
import pytest
from tests.treescene import FISHEYE, PANORAMA, PERSPECTIVE, PORTRAIT, Stem, facing, photo, turned

from dbh_studio.core.tree_crop import dashes, outline_px, ring_px, runs, tree_crop

TREE = Stem(1.0, 5.0, 0.4)
SIZE = (480, 640)
TURNS = [{}, {"pitch_deg": 12, "roll_deg": 25}, {"pitch_deg": -10, "roll_deg": 90}, {"roll_deg": 180}]


def crop_of(camera=PANORAMA, place=(0.0, 0.0, 1.6), stem=TREE, tall=3.4, **turn):
    return tree_crop(facing("a.jpg", camera, place, stem, **turn), stem.line, tall=tall, foot=0.0, size_px=SIZE)


@pytest.mark.parametrize("camera", [PANORAMA, PERSPECTIVE, PORTRAIT, FISHEYE])
@pytest.mark.parametrize("turn", TURNS)
def test_what_is_upright_in_the_plot_is_upright_in_the_picture(camera, turn):
    crop = crop_of(camera, **turn)
    for x, y in ((1.0, 5.0), (1.6, 5.0), (0.3, 5.3)):
        uv, _ = crop.view.project(np.array([[x, y, 0.3], [x, y, 2.5]]))
        across, up = uv[1] - uv[0]
        assert up < 0
        assert abs(np.degrees(np.arctan2(across, -up))) < 0.01


@pytest.mark.parametrize("height", [-6.0, 9.0])
def test_far_above_or_below_it_is_upright_in_the_middle(height):
    crop = crop_of(place=(0.0, 0.0, height))
    uv, _ = crop.view.project(np.array([[1.0, 5.0, 0.6], [1.0, 5.0, 2.0]]))
    across, up = uv[1] - uv[0]
    assert up < 0 and abs(np.degrees(np.arctan2(across, -up))) < 0.5
    assert uv[:, 0] == pytest.approx([240.0, 240.0], abs=1.0)


@pytest.mark.parametrize("camera", [PANORAMA, PERSPECTIVE, PORTRAIT, FISHEYE])
@pytest.mark.parametrize("turn", TURNS)
def test_pixels_of_the_picture_are_those_of_the_photo(camera, turn):
    crop = crop_of(camera, **turn)
    rng = np.random.default_rng(2)
    xy = rng.integers([60, 60], [420, 580], (40, 2))
    origin, rays = crop.view.ray(xy + 0.5)
    uv, seen = crop.photo.project(origin + 4.0 * rays)
    columns, rows = crop.maps()
    found = np.column_stack([columns[xy[:, 1], xy[:, 0]], rows[xy[:, 1], xy[:, 0]]])
    assert seen.mean() > 0.5
    assert found[seen] == pytest.approx(uv[seen], abs=0.02)
    assert np.isnan(found[~seen]).all()


def test_across_the_seam_and_at_the_poles():
    away = np.degrees(np.arctan2(TREE.x, TREE.y))
    for rotation in (
        turned(yaw_deg=away + 180),
        turned(yaw_deg=away, pitch_deg=90),
        turned(yaw_deg=away, pitch_deg=-88),
    ):
        crop = tree_crop(photo("a", PANORAMA, (0, 0, 1.6), rotation), TREE.line, tall=3.4, foot=0.0, size_px=SIZE)
        columns, rows = crop.maps()
        assert np.isfinite(columns).all() and np.isfinite(rows).all()
        rays = crop.photo.camera.rays(np.column_stack([columns.ravel(), rows.ravel()]))
        # Neighbouring pixels look in neighbouring directions, the seam and the pole among them.
        steps = np.linalg.norm(np.diff(rays.reshape(640, 480, 3), axis=1), axis=2)
        assert steps.max() < 0.01


def test_the_whole_stretch_is_in_the_picture_with_the_ring_in_it():
    crop = crop_of()
    _, inside = crop.view.project(np.array([[1.0, 5.0, -0.15], [1.0, 5.0, 1.3], [1.0, 5.0, 3.0]]))
    assert inside.all()
    assert crop.units_per_px == pytest.approx(3.4 / 640)
    span = crop.view.project(np.array([[1.0, 5.0, 1.0], [1.0, 5.0, 2.0]]))[0]
    assert span[0, 1] - span[1, 1] == pytest.approx(1.0 / crop.units_per_px, rel=0.01)


@pytest.mark.parametrize("tall", [0.9, 1.7, 6.0])
def test_closer_and_wider_keep_breast_height_in_the_picture(tall):
    crop = crop_of(tall=tall)
    _, inside = crop.view.project(TREE.ring())
    assert inside.all()
    assert crop.units_per_px * 640 == pytest.approx(max(tall, 3.0 * 0.2 * 640 / 480), rel=1e-6)


def test_near_a_tree_less_of_it_is_shown_and_all_of_its_girth():
    crop = crop_of(place=(0.3, 4.4, 1.6))
    assert crop.units_per_px * 640 < 1.7
    big = Stem(0.0, 2.0, 1.6)
    uv, _ = crop_of(stem=big, place=(0.0, 0.0, 1.6)).view.project(big.points())
    assert np.isfinite(uv).all()


def test_a_photo_that_does_not_reach_so_far_gives_a_smaller_part():
    far = crop_of(PERSPECTIVE, place=(0.0, -1.0, 1.6))
    assert far.covered == 1.0
    near = crop_of(PERSPECTIVE, place=(0.5, 3.0, 1.6))
    assert near.covered > 0.9
    assert near.units_per_px < far.units_per_px
    assert near.view.project(TREE.ring())[1].all()


@pytest.mark.parametrize("camera", [PANORAMA, PERSPECTIVE, FISHEYE])
@pytest.mark.parametrize("turn", TURNS[:3])
def test_the_outline_is_where_lines_of_sight_touch_the_stem(camera, turn):
    place = np.array([0.0, 0.0, 1.6])
    crop = crop_of(camera, place=place, **turn)
    left, right = outline_px(crop.view, TREE.points(0.01))
    assert len(left) == len(right) >= 30
    away = np.array([TREE.x, TREE.y]) - place[:2]
    distance, radius = np.hypot(*away), TREE.diameter / 2
    along = away * (1 - radius**2 / distance**2)
    aside = np.array([away[1], -away[0]]) / distance * radius * np.sqrt(1 - radius**2 / distance**2)
    for edge, touch in ((left, along - aside), (right, along + aside)):
        uv, _ = crop.view.project(np.array([[*touch, 1.0]]))
        # The outermost points of a trunk are left out: they may be a twig.
        assert np.abs(edge[:, 0] - uv[0, 0]).max() < 2.5


def test_an_outline_breaks_where_the_trunk_has_a_gap_and_ends_where_it_was_cut_aslant():
    points = TREE.points(0.01)
    kept = ((points[:, 2] < 1.5) | (points[:, 2] > 2.2)) & (points[:, 2] > 0.3 + 1.0 * (points[:, 0] - 0.8))
    crop = crop_of()
    left, right = outline_px(crop.view, points[kept])
    assert np.isnan(left).any() and np.isnan(right).any()
    width = (right - left)[:, 0]
    assert np.nanmin(width) > 0.85 * np.nanmax(width)
    assert len(outline_px(crop.view, points[:3])[0]) == 0
    assert len(outline_px(crop.view, points + [0, -20, 0])[0]) == 0


def test_the_ring_is_seen_in_front_and_hidden_behind():
    crop = crop_of()
    uv, seen = ring_px(crop.view, TREE.ring())
    assert uv.shape == (91, 2) and uv[0] == pytest.approx(uv[-1])
    assert 0.4 < seen.mean() < 0.55
    # From above, the near side of a level ring is the lower one.
    assert uv[seen, 1].mean() > uv[~seen, 1].mean()
    _, covered = ring_px(crop.view, TREE.ring(), np.ones(90, bool))
    assert not covered.any()


def test_lines_in_runs_and_dashes():
    line = np.column_stack([np.arange(10.0), np.zeros(10)])
    line[4] = np.nan
    kinds = np.array([1, 1, 1, 0, 0, 0, 0, 1, 1, 1], bool)
    found = [(piece[0, 0], piece[-1, 0], one) for piece, one in runs(line, kinds)]
    assert found == [(0, 2, True), (2, 3, False), (5, 7, False), (7, 9, True)]
    assert list(runs(line[:1], kinds[:1])) == []
    pieces = dashes(np.array([[0.0, 0.0], [13.0, 0.0], [20.0, 0.0]]), on_px=6, off_px=4)
    assert [(piece[0, 0], piece[-1, 0]) for piece in pieces] == [(0.0, 6.0), (10.0, 16.0)]
    assert pieces[1][1, 0] == 13.0
    assert dashes(np.zeros((2, 2))) == []
