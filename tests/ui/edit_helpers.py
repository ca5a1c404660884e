"""What a person does with the tools for correcting trunks, for tests with a `FakeClient`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from fakeclient import FakeClient

from dbh_studio.ui.studio import Studio

_SHOWN, _EFFECT = "dbhEdit.show(", "dbhEdit.effect("


def bar(tab: FakeClient) -> dict[str, Any]:
    """What the bar over the picture shows; empty where there is none."""
    state: dict[str, Any] = {}
    for source in list(tab.javascript):
        if source.startswith(_SHOWN):
            state = json.loads(source[len(_SHOWN) : -1])
        elif source.startswith(_EFFECT):
            state = {**state, "effect": json.loads(source[len(_EFFECT) : -1])}
    return state


def offered(tab: FakeClient) -> list[str]:
    """The actions that have a button."""
    return [button[0] for button in bar(tab).get("buttons", ())]


def ask(tab: FakeClient, action: str, value: Any = None) -> None:
    """Press a button of the bar."""
    tab.bridge_send("edit", [action, value])


def camera_numbers(tab: FakeClient) -> list[float]:
    """The camera as the page's script sends it."""
    width, height = tab.size
    return [*map(float, tab.position), *map(float, tab.rotation.ravel()), tab.fov_rad, width / height, float(height)]


def draw(tab: FakeClient, tool: str, path: Any, *, mode: str = "new", is_end: bool = True) -> None:
    """Draw over the picture; `path` is (M, 2), 0..1."""
    places = [float(value) for value in np.asarray(path, float).ravel()]
    tab.bridge_send("edit-draw", [tool, mode, is_end, camera_numbers(tab), places])


def box_about(tab: FakeClient, points: np.ndarray, margin: float = 0.02) -> np.ndarray:
    """(4, 2) corners on the screen of a box about world points."""
    seen = np.array([tab.screen(point) for point in points])
    (x0, y0), (x1, y1) = seen.min(axis=0) - margin, seen.max(axis=0) + margin
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def points_of(studio: Studio, trunk_id: int) -> np.ndarray:
    """(N, 3) world points of a trunk."""
    assert studio.session is not None
    return studio.session.points_world()[studio.session.document.trunks[trunk_id].points].astype(float)


def stand_before(tab: FakeClient, studio: Studio, trunk_id: int, *, away: Sequence[float] = (0.0, -4.0, 0.3)) -> None:
    """Look at a trunk's middle from a place beside it."""
    middle = np.median(points_of(studio, trunk_id), axis=0)
    tab.look(middle + np.asarray(away), middle)
