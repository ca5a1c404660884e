"""Whole panoramas are looked up in float32, in pieces: the pixel is that of the exact projection."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.mask_views import ImageMask

WIDTH, HEIGHT = 1024, 512
CAMERA = CameraModel("EQUIRECTANGULAR", WIDTH, HEIGHT, (float(WIDTH), float(HEIGHT)))
LABELS = (np.arange(WIDTH * HEIGHT) % 60_000).reshape(HEIGHT, WIDTH).astype(np.uint16)


def directions(n: int = 200_000) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(n, 3))


def test_every_point_gets_the_pixel_the_camera_gives_it():
    points = directions() * np.random.default_rng(1).uniform(0.3, 40.0, (200_000, 1))
    uv, _ = CAMERA.project(points)
    # Where float32 may fall on either side of a pixel's edge the next one is as right.
    clear = (np.abs(uv - np.round(uv)) > 2e-3).all(axis=1)
    assert clear.mean() > 0.98
    expected = LABELS[np.minimum(uv[:, 1].astype(int), HEIGHT - 1), np.minimum(uv[:, 0].astype(int), WIDTH - 1)]
    found, is_seen = ImageMask(CAMERA, LABELS).look_up(points)
    assert is_seen.all()
    np.testing.assert_array_equal(found[clear], expected[clear])


def test_a_mask_of_another_size_is_asked_at_the_same_place():
    points = directions(20_000)
    half, _ = ImageMask(CAMERA, LABELS[::2, ::2]).look_up(points)
    uv, _ = CAMERA.project(points)
    clear = (np.abs(uv / 2 - np.round(uv / 2)) > 2e-3).all(axis=1)
    column, row = (uv[clear] / 2).astype(int).T
    np.testing.assert_array_equal(half[clear], LABELS[::2, ::2][np.minimum(row, 255), np.minimum(column, 511)])


def test_seam_and_poles_are_in_the_picture():
    # Straight up, straight down, straight back from both sides of the seam.
    points = np.array([[0, -1, 0], [0, 1, 0], [0.0, 0, -1], [-0.0, 0, -1], [1e-9, 0, -1], [-1e-9, 0, -1]])
    found, is_seen = ImageMask(CAMERA, LABELS).look_up(points)
    assert is_seen.all()
    assert found[0] in LABELS[0] and found[1] in LABELS[-1]
    middle = LABELS[HEIGHT // 2]
    assert set(found[2:]) <= {middle[0], middle[-1]}


def test_what_has_no_direction_is_not_seen():
    points = np.array([[0.0, 0, 0], [np.nan, 1, 1], [1, np.inf, np.nan], [1, 1, 1]])
    found, is_seen = ImageMask(CAMERA, LABELS + 1).look_up(points)
    assert is_seen.tolist() == [False, False, False, True] and found[:3].tolist() == [0, 0, 0]
    assert [len(each) for each in ImageMask(CAMERA, LABELS).look_up(np.empty((0, 3)))] == [0, 0]


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int32])
def test_ignored_pixels_say_nothing_whatever_labels_are(dtype):
    labels = np.ones((HEIGHT, WIDTH), dtype)
    ignored = np.zeros((HEIGHT, WIDTH), bool)
    ignored[:, WIDTH // 2 :] = True
    points = directions(5000)
    found, is_seen = ImageMask(CAMERA, labels, ignored).look_up(points)
    np.testing.assert_array_equal(is_seen, np.arctan2(points[:, 0], points[:, 2]) < 0)
    assert found.dtype == np.int32 and (found == 1).all()
