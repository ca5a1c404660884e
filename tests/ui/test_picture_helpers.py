"""Colours of a marked trunk, and where to stand to see it."""

import numpy as np
import pytest

from dbh_studio.ui.shade import shaded
from dbh_studio.ui.viewpoint import clear_side

RED = (214, 40, 40)


def trunk(x=0.0, y=0.0, *, radius=0.15, n=2000, lean=0.0):
    rng = np.random.default_rng(3)
    angle, height = rng.uniform(0, 2 * np.pi, n), rng.uniform(0, 6, n)
    columns = [x + radius * np.cos(angle) + lean * height, y + radius * np.sin(angle), height]
    return np.column_stack(columns).astype(np.float32)


@pytest.mark.parametrize("lean", [0.0, 0.4])
def test_a_marked_trunk_is_lit_from_one_side_but_keeps_its_hue(lean):
    points = trunk(lean=lean)
    colours = shaded(points, RED, None).astype(float)
    axis = np.column_stack([lean * points[:, 2], np.zeros(len(points))])
    towards_light = (points[:, :2] - axis) @ [-0.5, -0.87] > 0
    assert colours[towards_light, 0].mean() > 1.15 * colours[~towards_light, 0].mean()
    np.testing.assert_allclose(colours[:, 1] / colours[:, 0], RED[1] / RED[0], atol=0.02)


def test_dark_bark_stays_darker_than_light_bark():
    points = trunk()
    rgb = np.full((len(points), 3), 60, np.uint8)
    rgb[::2] = 140
    colours = shaded(points, RED, rgb).astype(float)
    assert colours[::2, 0].mean() > 1.4 * colours[1::2, 0].mean()


def test_shading_of_nothing_and_of_a_single_point():
    assert shaded(np.zeros((0, 3), np.float32), RED, None).shape == (0, 3)
    assert shaded(np.zeros((1, 3), np.float32), RED, np.zeros((1, 3), np.uint8)).shape == (1, 3)


TARGET = np.array([0.0, 0.0, 1.3])
SOUTH = np.array([0.0, -1.0, 0.0])


def test_the_camera_stays_on_its_side_where_nothing_is_in_the_way():
    points = np.vstack([trunk(), trunk(0.0, 4.0), trunk(5.0, 0.0), trunk(0.0, -9.0)])
    np.testing.assert_array_equal(clear_side(points, TARGET, SOUTH, 6.0), SOUTH)


def test_the_camera_goes_round_a_trunk_that_hides_the_tree():
    hiding = np.array([0.0, -3.0])
    points = np.vstack([trunk(), trunk(*hiding)])
    direction = clear_side(points, TARGET, SOUTH, 6.0)
    assert np.linalg.norm(direction) == pytest.approx(1.0)
    # The line of sight passes the hiding trunk well outside its bark, on a side near to the old one.
    assert abs(direction[0] * hiding[1] - direction[1] * hiding[0]) > 0.5
    assert direction @ SOUTH > 0.5


def test_hidden_from_all_sides_the_clearest_is_taken():
    angles = np.arange(0, 360, 5)
    wall = [trunk(3 * np.cos(np.deg2rad(a)), 3 * np.sin(np.deg2rad(a)), n=100 if 75 < a < 105 else 800) for a in angles]
    direction = clear_side(np.vstack([trunk(), *wall]), TARGET, SOUTH, 6.0)
    assert direction @ -SOUTH > 0.95
