"""Tiles of panoramas and the masks over them: analytic directions, the seam, the poles, overlaps."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.mask_views import ImageMask, TileMasks, near_edges
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.core.tiles import TileSet, sample, up_in_camera, view_rotation
from dbh_studio.core.transforms import Similarity

PANORAMA = CameraModel("EQUIRECTANGULAR", 512, 256, ())


def directions(n: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def smooth_panorama(width: int) -> np.ndarray:
    """A picture whose value is a known smooth function of direction, so that seam and poles are nothing special."""
    camera = CameraModel("EQUIRECTANGULAR", width, width // 2, ())
    across, down = np.meshgrid(np.arange(width) + 0.5, np.arange(width // 2) + 0.5)
    rays = camera.rays(np.column_stack([across.ravel(), down.ravel()])).reshape(width // 2, width, 3)
    return np.rint(127.5 + 120.0 * rays).astype(np.uint8)


def test_the_middle_of_a_tile_looks_where_its_yaw_and_pitch_say():
    tiles = TileSet.ring(PANORAMA, count=4, fov_deg=100.0, size_px=64, pitches_deg=(0.0, 30.0), zenith=True, nadir=True)
    assert len(tiles) == 10
    for tile in tiles.tiles:
        yaw, pitch = np.radians([tile.yaw_deg, tile.pitch_deg])
        wanted = [np.cos(pitch) * np.sin(yaw), -np.sin(pitch), np.cos(pitch) * np.cos(yaw)]
        np.testing.assert_allclose(tile.rays([[32.0, 32.0]])[0], wanted, atol=1e-12)
        # +y of a level tile points down; the horizon is level in it.
        assert tile.tile_from_cam[0, 1] == pytest.approx(0.0, abs=1e-12)


def test_with_the_up_direction_verticals_are_upright_in_every_tile():
    up = np.array([0.2, -0.9, 0.3])
    up /= np.linalg.norm(up)
    tiles = TileSet.ring(PANORAMA, up_cam=up, size_px=200)
    for tile in tiles.tiles:
        foot = tile.tile_from_cam[2] * 5.0 + np.cross(up, tile.tile_from_cam[2]) * 1.3
        uv, seen = tile.project(np.array([foot, foot + up, foot - up]))
        assert seen.all()
        assert np.ptp(uv[:, 0]) < 1e-9
        assert uv[1, 1] < uv[0, 1] < uv[2, 1]


def test_upside_down_cameras_are_turned_too():
    tile = TileSet.ring(PANORAMA, up_cam=(0.0, 1.0, 0.0)).tiles[0]
    np.testing.assert_allclose(tile.tile_from_cam @ [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], atol=1e-12)


def test_up_in_camera_is_the_poses_view_of_up():
    turn = view_rotation(np.array([0.3, 0.2, 0.9]))
    photo = PosedImage("a", PANORAMA, Similarity(turn, np.array([1.0, 2.0, 3.0])))
    np.testing.assert_allclose(up_in_camera(photo, (0.0, 0.0, 2.0)), turn[:, 2], atol=1e-12)


def test_a_ring_with_gaps_is_refused():
    with pytest.raises(ValueError, match="gaps"):
        TileSet.ring(PANORAMA, count=4, fov_deg=90.0)


def test_ring_zenith_and_nadir_show_every_direction_and_say_where():
    tiles = TileSet.ring(PANORAMA, count=5, fov_deg=100.0, size_px=80, zenith=True, nadir=True)
    points = directions(20_000) * np.random.default_rng(1).uniform(0.5, 30.0, (20_000, 1))
    index, uv, central = tiles.look_up(points)
    assert (index >= 0).all() and (central >= 0).all() and (central <= 1).all()
    for k, tile in enumerate(tiles.tiles):
        mine = index == k
        back = tile.rays(uv[mine])
        cosine = (back * points[mine]).sum(axis=1) / np.linalg.norm(points[mine], axis=1)
        assert cosine.min() > 1 - 1e-9


def test_a_ring_alone_leaves_the_poles_out():
    tiles = TileSet.ring(PANORAMA, size_px=64)
    index, uv, _ = tiles.look_up(np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    assert index.tolist() == [-1, -1, 0]
    assert np.isnan(uv[:2]).all()


def test_sampling_maps_take_tile_pixels_to_the_panorama():
    tiles = TileSet.ring(PANORAMA, size_px=40, zenith=True)
    for index, tile in enumerate(tiles.tiles):
        spots = tiles.sampling_map(index)
        rays = tile.rays([[10.5, 3.5], [39.5, 0.5]])
        np.testing.assert_allclose(spots[[3, 0], [10, 39]], PANORAMA.project(rays)[0], atol=1e-3)


@pytest.mark.parametrize(("width", "size"), [(512, 96), (2048, 64)])
def test_rendered_tiles_show_no_seam_and_no_pole(width, size):
    picture = smooth_panorama(width)
    tiles = TileSet.ring(
        CameraModel("EQUIRECTANGULAR", width, width // 2, ()), size_px=size, zenith=True, nadir=True, fov_deg=95.0
    )
    across, down = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    for index, tile in enumerate(tiles.tiles):
        wanted = 127.5 + 120.0 * tile.rays(np.column_stack([across.ravel(), down.ravel()])).reshape(size, size, 3)
        np.testing.assert_allclose(tiles.render(picture, index), wanted, atol=1.6)


def test_a_smaller_copy_of_the_photo_gives_the_same_tile():
    big, small = smooth_panorama(1024), smooth_panorama(512)
    tiles = TileSet.ring(CameraModel("EQUIRECTANGULAR", 1024, 512, ()), size_px=64)
    difference = tiles.render(big, 3).astype(int) - tiles.render(small, 3)
    assert np.abs(difference).max() <= 2


def test_bilinear_values_are_those_of_a_plane_inside_and_wrap_at_the_seam():
    row, column = np.mgrid[:8, :16]
    spots = np.array([[3.25, 2.5], [7.5, 4.0]])
    np.testing.assert_allclose(sample(2.0 * row + column, spots, wraps=False), [2.75 + 4.0, 7.0 + 7.0], rtol=1e-6)
    picture = np.zeros((8, 16))
    picture[:, 0], picture[:, 15] = 10.0, 20.0
    np.testing.assert_allclose(sample(picture, np.array([[0.0, 4.0], [16.0, 4.0]]), wraps=True), 15.0)
    assert sample(picture, np.array([[np.nan, 1.0]]), wraps=True)[0] == 0.0


def test_beyond_a_pole_lies_the_row_on_the_other_side():
    picture = np.zeros((4, 8))
    picture[0] = np.arange(8)
    # Straight above the first pixel's middle, half a pixel from the pole: between columns 0 and 4.
    assert sample(picture, np.array([[0.5, 0.0]]), wraps=True)[0] == pytest.approx(2.0)


def test_a_fisheye_gets_only_the_tiles_it_reaches():
    camera = CameraModel("SIMPLE_FISHEYE", 400, 400, (120.0, 200.0, 200.0))
    tiles = TileSet.rows(camera, [(0.0, 8)], fov_deg=60.0, size_px=48, least_share=0.1)
    assert 0 < len(tiles) < 8
    assert 180.0 not in [tile.yaw_deg for tile in tiles.tiles]
    across, down = np.meshgrid(np.arange(400) + 0.5, np.arange(400) + 0.5)
    rays = camera.rays(np.column_stack([across.ravel(), down.ravel()])).reshape(400, 400, 3)
    picture = np.rint(127.5 + 120.0 * np.nan_to_num(rays)).astype(np.uint8)
    view = tiles.render(picture, 0)
    wanted = 127.5 + 120.0 * tiles.tiles[0].rays([[24.5, 24.5]])[0]
    np.testing.assert_allclose(view[24, 24], wanted, atol=1.6)


def test_a_tile_is_a_photo_of_its_own():
    photo = PosedImage("p", PANORAMA, Similarity(view_rotation(np.array([1.0, 0.2, -0.4])), np.array([0.5, 1.0, 2.0])))
    tile = TileSet.ring(PANORAMA).tiles[2]
    alone = tile.posed(photo, "p/2")
    np.testing.assert_allclose(alone.centre_src, photo.centre_src, atol=1e-12)
    point = photo.centre_src + tile.rays([[300.0, 420.0]])[0] @ photo.cam_from_source.rotation * 7.0
    np.testing.assert_allclose(alone.project(point[None])[0], [[300.0, 420.0]], atol=1e-8)


# --- masks ---


def stripe(tiles: TileSet, azimuths_deg: list[tuple[float, float]]) -> list[np.ndarray]:
    """Masks of trunks between two azimuths each, numbered anew in every tile."""
    masks = []
    for tile in tiles.tiles:
        n = tile.size_px
        across, down = np.meshgrid(np.arange(n) + 0.5, np.arange(n) + 0.5)
        rays = tile.rays(np.column_stack([across.ravel(), down.ravel()]))
        azimuth = np.degrees(np.arctan2(rays[:, 0], rays[:, 2]))
        label, number = np.zeros(n * n, np.int32), 1
        for low, high in azimuths_deg:
            inside = (azimuth - low) % 360.0 <= high - low
            if inside.any():
                label[inside] = number
                number += 1
        masks.append(label.reshape(n, n))
    return masks


def ring_points(azimuths_deg: np.ndarray) -> np.ndarray:
    azimuth = np.radians(azimuths_deg)
    return np.stack([np.sin(azimuth), np.zeros_like(azimuth), np.cos(azimuth)], axis=1)


def test_a_trunk_in_several_tiles_is_one_and_neighbours_stay_apart():
    tiles = TileSet.ring(PANORAMA, size_px=300)
    # The first lies across the seam of the panorama, the second across a border between tiles, the third beside it.
    masks = TileMasks(tiles, stripe(tiles, [(175.0, 186.0), (30.0, 42.0), (45.0, 50.0)]), has_instances=True)
    azimuths = np.array([176.0, -178.0, -175.0, 31.0, 36.0, 41.0, 46.0, 49.0, 10.0, 100.0, 43.5])
    labels, known = masks.look_up(ring_points(azimuths))
    assert known.all()
    first, second, third = labels[0], labels[3], labels[6]
    assert len({first, second, third, 0}) == 4
    assert labels.tolist() == [first] * 3 + [second] * 3 + [third] * 2 + [0] * 3


def test_back_in_the_panorama_a_trunk_is_neither_cut_nor_doubled_nor_widened():
    tiles = TileSet.ring(PANORAMA, size_px=400)
    whole = TileMasks(tiles, stripe(tiles, [(170.0, 200.0), (20.0, 60.0)]), has_instances=True).panorama()
    azimuth = (np.arange(512) + 0.5) / 512 * 360.0 - 180.0
    row = whole[128]
    for low, high in ((170.0, 200.0), (20.0, 60.0)):
        depth = np.minimum((azimuth - low) % 360.0, (high - azimuth) % 360.0)
        inside = ((azimuth - low) % 360.0) <= high - low
        assert len(set(row[inside & (depth > 0.4)])) == 1
    outside = np.ones(512, bool)
    for low, high in ((169.6, 200.4), (19.6, 60.4)):
        outside &= (azimuth - low) % 360.0 > high - low
    assert (row[outside] == 0).all() and outside.sum() > 300
    assert len(np.unique(whole)) == 3


def test_a_trunk_missed_in_the_tile_that_shows_it_best_is_not_cut():
    tiles = TileSet.ring(PANORAMA, size_px=300)
    masks = stripe(tiles, [(33.0, 40.0)])
    # It lies between tiles 0 (0°) and 1 (72°); tile 0, in which 33° to 36° is the more central, did not find it.
    masks[0] = np.zeros_like(masks[0])
    labels, _ = TileMasks(tiles, masks).look_up(ring_points(np.array([34.0, 39.0, 30.0])))
    assert labels.tolist() == [1, 1, 0]


def test_a_mask_over_two_trunks_in_one_tile_does_not_make_them_one():
    tiles = TileSet.ring(PANORAMA, size_px=300)
    right = stripe(tiles, [(30.0, 31.0), (33.0, 39.0)])
    merged = stripe(tiles, [(30.0, 39.0)])
    masks = TileMasks(tiles, [right[0], merged[1], *right[2:]], has_instances=True)
    labels, _ = masks.look_up(ring_points(np.array([30.5, 34.0, 34.5])))
    assert 0 not in labels[:2] and labels[0] != labels[1] == labels[2]


def test_tiles_not_looked_at_say_nothing():
    tiles = TileSet.ring(PANORAMA, size_px=100)
    masks: list[np.ndarray | None] = [np.ones((100, 100), bool), None, None, None, None]
    labels, known = TileMasks(tiles, masks).look_up(ring_points(np.array([0.0, 180.0])))
    assert labels.tolist() == [1, 0] and known.tolist() == [True, False]


def test_masks_of_tiles_may_be_smaller_than_the_tiles():
    tiles = TileSet.ring(PANORAMA, size_px=800)
    small = TileSet.ring(PANORAMA, size_px=200)
    labels, _ = TileMasks(tiles, stripe(small, [(20.0, 30.0)])).look_up(ring_points(np.array([25.0, 18.0, 32.0])))
    assert labels.tolist() == [1, 0, 0]


def test_a_mask_over_a_photo_answers_by_pixel_and_may_be_smaller():
    mask = np.zeros((128, 256), np.uint8)
    mask[64, 128] = 7
    view = ImageMask(PANORAMA, mask, has_instances=True)
    at = PANORAMA.rays([[257.0, 129.0], [254.9, 129.0], [257.0, 131.0]]) * 9.0
    labels, known = view.look_up(at)
    assert labels.tolist() == [7, 0, 0] and known.all()


def test_ignored_pixels_and_silent_edges_say_nothing():
    mask = np.zeros((256, 512), bool)
    mask[:, 100:120] = True
    ignored = np.zeros_like(mask)
    ignored[200:] = True
    view = ImageMask(PANORAMA, mask, ignored, edge_px=2)
    pixels = np.array([[110.5, 100.5], [101.5, 100.5], [98.5, 100.5], [97.5, 100.5], [102.5, 100.5], [110.5, 220.5]])
    labels, known = view.look_up(PANORAMA.rays(pixels))
    assert known.tolist() == [True, False, False, True, True, False]
    assert labels[[0, 3, 4]].tolist() == [1, 0, 1]


def test_edges_are_found_across_the_seam_of_a_panorama():
    mask = np.zeros((8, 16), np.uint8)
    mask[:, 0] = 1
    assert near_edges(mask, 1, wraps=True)[4].nonzero()[0].tolist() == [0, 1, 15]
    assert near_edges(mask, 1, wraps=False)[4].nonzero()[0].tolist() == [0, 1]


@pytest.mark.parametrize(
    "bad", [np.zeros((10, 10, 3), np.uint8), np.zeros((10, 20)), np.full((10, 20), -1), np.zeros((10, 10), bool)]
)
def test_what_is_no_mask_of_the_photo_is_refused(bad):
    with pytest.raises(ValueError, match="mask"):
        ImageMask(PANORAMA, bad)


def test_wrong_numbers_of_masks_are_refused():
    with pytest.raises(ValueError, match="2 masks for 5 tiles"):
        TileMasks(TileSet.ring(PANORAMA), [None, None])
