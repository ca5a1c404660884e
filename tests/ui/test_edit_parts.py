"""The parts of correcting trunks that need no page: what a drawing is, the plane, the words, the keys."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.app.edit_trial import TreeEffect
from dbh_studio.core.dbh import Refusal
from dbh_studio.core.picking import View
from dbh_studio.ui.bind import CAMERA_KEYS
from dbh_studio.ui.edit_gesture import gesture_of, view_of_page
from dbh_studio.ui.edit_keys import _COMMANDS
from dbh_studio.ui.edit_plane import CutPlane
from dbh_studio.ui.edit_words import KEYS, TOOLS, count_words, effect_words, tool_hint, trees_words

VIEW = View.looking_at((1.0, -5.0, 2.0), (0.0, 0.0, 1.0), fov_rad=0.9, aspect=1.5, height_px=700)
CAMERA = [*VIEW.origin.tolist(), *VIEW.rotation.ravel().tolist(), 0.9, 1.5, 700.0]


def test_a_drawing_comes_with_its_camera():
    gesture = gesture_of(["lasso", "add", True, CAMERA, [0.1, 0.2, 0.5, 0.2, 0.5, 0.9]])
    assert gesture is not None
    assert (gesture.tool, gesture.mode, gesture.is_end, gesture.is_click) == ("lasso", "add", True, False)
    assert gesture.path.tolist() == [[0.1, 0.2], [0.5, 0.2], [0.5, 0.9]]
    points = np.random.default_rng(0).random((20, 3))
    assert np.allclose(gesture.view.project(points), VIEW.project(points))
    click = gesture_of(["line", "new", True, CAMERA, [0.5, 0.5, 0.502, 0.501]])
    assert click is not None and click.is_click
    far = gesture_of(["brush", "new", False, CAMERA, [9e5, -9e5]])
    assert far is not None and np.abs(far.path).max() <= 3.0


@pytest.mark.parametrize(
    "payload",
    [
        None,
        [],
        ["lasso", "add", True, CAMERA],
        ["axe", "add", True, CAMERA, [0.1, 0.2]],
        ["click", "add", True, CAMERA, [0.1, 0.2]],
        [["lasso"], "add", True, CAMERA, [0.1, 0.2]],
        ["lasso", "more", True, CAMERA, [0.1, 0.2]],
        ["lasso", [], True, CAMERA, [0.1, 0.2]],
        ["lasso", "add", True, CAMERA, []],
        ["lasso", "add", True, CAMERA, [0.1, 0.2, 0.3]],
        ["lasso", "add", True, CAMERA, [0.1, float("nan")]],
        ["lasso", "add", True, CAMERA, [0.1, True]],
        ["lasso", "add", True, CAMERA, [0.1] * 4002],
        ["lasso", "add", True, CAMERA[:-1], [0.1, 0.2]],
        ["lasso", "add", True, [1e9, *CAMERA[1:]], [0.1, 0.2]],
    ],
)
def test_anything_else_is_no_drawing(payload):
    assert gesture_of(payload) is None


@pytest.mark.parametrize("at, value", [(3, 5.0), (12, 0.0), (12, 3.2), (13, 0.0), (14, 1.0), (14, 1e6)])
def test_a_camera_that_cannot_be_is_none(at, value):
    numbers = list(CAMERA)
    numbers[at] = value
    assert view_of_page(numbers) is None


def stem(n: int = 4000) -> np.ndarray:
    """(N, 3) points of a stem of 40 cm and 6 m about (10, 20), its foot at 100."""
    rng = np.random.default_rng(1)
    angle, z = rng.uniform(0, 2 * np.pi, n), rng.uniform(0, 6, n)
    return np.c_[10 + 0.2 * np.cos(angle), 20 + 0.2 * np.sin(angle), 100 + z].astype(np.float32)


def test_a_plane_is_laid_along_the_line_of_sight_and_cuts_the_stem_in_halves():
    plane, points = CutPlane(), stem()
    plane.lay(points, 100.0, np.array([1.0, 1.0, -0.3]))
    assert plane.degrees == pytest.approx(45.0)
    assert plane.beyond(points).mean() == pytest.approx(0.5, abs=0.03)
    # It is seen edge-on: the line of sight lies in it.
    assert abs(plane.normal @ np.array([1.0, 1.0, -0.3])) < 1e-9
    plane.set("degrees", 0.0)  # runs north: the east side is beyond
    assert points[plane.beyond(points), 0].min() > 9.99
    plane.set("shift", 0.1)
    assert points[plane.beyond(points), 0].min() > 10.09
    plane.set("shift", 50.0)
    assert plane.shift == plane.limits()["shift"] and not plane.beyond(points).any()
    plane.set("degrees", 270.0)
    assert plane.degrees == 90.0


def test_a_level_plane_is_at_a_height_above_the_ground():
    plane, points = CutPlane(), stem()
    plane.lay(points, 100.0, np.array([0.0, 0.0, -1.0]))
    plane.set("level", 1)
    assert plane.height == pytest.approx(3.0, abs=0.1)
    plane.set("height", 1.5)
    assert points[plane.beyond(points), 2].min() > 101.499
    assert points[~plane.beyond(points), 2].max() <= 101.5
    assert np.allclose(plane.corners()[:, 2], 101.5)
    plane.set("level", 0)
    corners = plane.corners()
    assert np.ptp(corners[:, 2]) == pytest.approx(6.0, abs=0.2)
    assert np.abs((corners - plane.through) @ plane.normal).max() < 1e-5


def effect(trunk_id, before, after, *, was=True, now=True):
    return TreeEffect(trunk_id, was, now, before, after)


def test_effects_are_told_in_words():
    refusal = Refusal("few", "Too few points at breast height.", "")
    assert effect_words([]) == ""
    assert effect_words([effect(5, refusal, refusal)]) == "Tree 5: still no diameter (too few points at breast height)"
    assert effect_words([effect(7, refusal, None, now=False)]) == "Tree 7 is gone"
    assert effect_words([effect(8, None, None, was=False)]) == "New tree 8: not measured yet"


def test_counts_and_names():
    assert (count_words(1), count_words(12345)) == ("1 point", "12,345 points")
    assert [trees_words(ids) for ids in ([], [3], [3, 5, 8])] == ["No tree", "Tree 3", "Trees 3, 5 and 8"]
    for tool in TOOLS:
        for selected in (None, 4):
            hint = tool_hint(tool, selected, only_own=True)
            assert hint.endswith(".") and (("tree 4" in hint) <= (selected == 4))


def test_no_key_moves_the_camera_and_each_is_told():
    keys = [(key, modifier) for _, key, modifier, _ in _COMMANDS if key] + [(key, None) for _, key, _ in TOOLS.values()]
    assert len(set(keys)) == len(keys)
    assert not {key.upper() for key, _ in keys} & CAMERA_KEYS
    told = {key for key, _ in KEYS}
    for key, modifier in keys:
        words = {"delete": "Delete", "enter": "Enter", "escape": "Esc"}.get(key, key)
        assert (f"Shift+{words}" if modifier == "shift" else words) in told
