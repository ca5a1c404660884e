"""What is drawn over the 3D picture, as the page sends it: the way of the pointer and the camera it was drawn in.

The camera comes with the drawing: by the time the server reads it, the page may look elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.picking import View

DrawTool = Literal["rectangle", "lasso", "brush", "line"]
DrawMode = Literal["new", "add", "take"]

_MOST_PLACES = 2000
_MOST_COORDINATE = 1e7
# Of the page's own numbers, which are float32 in parts.
_ORTHONORMAL = 1e-3
# A drawing smaller than this part of the picture is a click.
_CLICK_SIZE = 0.006


@dataclass(frozen=True, eq=False)
class Gesture:
    """One drawing, or a part of one.

    Attributes:
        tool: What it was drawn with.
        mode: In place of what was chosen, added to it or taken from it.
        is_end: Whether the pointer was let go.
        view: The camera.
        path: (M, 2) where the pointer was, 0..1 from the upper left corner; of a rectangle two corners.
    """

    tool: DrawTool
    mode: DrawMode
    is_end: bool
    view: View
    path: Float64

    @property
    def is_click(self) -> bool:
        """Whether the pointer hardly moved."""
        return bool((np.ptp(self.path, axis=0) < _CLICK_SIZE).all())


def gesture_of(payload: Any) -> Gesture | None:
    """The drawing in a message of the page, ``[tool, mode, is the end, camera, [x, y, …]]``; None where it is none."""
    if not isinstance(payload, list) or len(payload) != 5:
        return None
    tool, mode, is_end, camera, path = payload
    if not isinstance(tool, str) or tool not in get_args(DrawTool) or mode not in get_args(DrawMode):
        return None
    view, places = view_of_page(camera), _numbers(path)
    if view is None or places is None or not 2 <= len(places) <= 2 * _MOST_PLACES or len(places) % 2:
        return None
    # Beyond the edge of the picture the pointer may go; very far it cannot.
    path_xy = np.clip(places.reshape(-1, 2), -2.0, 3.0)
    return Gesture(cast(DrawTool, tool), cast(DrawMode, mode), bool(is_end), view, path_xy)


def view_of_page(numbers: Any) -> View | None:
    """The camera as the page says it: place, right, down, forward, field of view, width over height, height in px."""
    values = _numbers(numbers)
    if values is None or len(values) != 15:
        return None
    rotation = values[3:12].reshape(3, 3)
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ORTHONORMAL:
        return None
    fov, aspect, height = (float(value) for value in values[12:])
    if not (0.01 < fov < 3.1 and 0.05 < aspect < 20.0 and 10.0 < height < 20_000.0):
        return None
    return View(values[:3], rotation, fov, aspect, round(height))


def _numbers(payload: Any) -> Float64 | None:
    """Finite numbers of bearable size, or None: a page may say anything."""
    if not isinstance(payload, list) or len(payload) > 2 * _MOST_PLACES:
        return None
    if any(isinstance(value, bool) or not isinstance(value, (int, float)) for value in payload):
        return None
    if not all(abs(value) <= _MOST_COORDINATE for value in payload):  # NaN fails too
        return None
    return np.array(payload, np.float64)
