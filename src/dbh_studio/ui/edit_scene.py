"""What correcting trunks adds to the 3D picture of one tab: the chosen points, further chosen trees, one tree alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from dbh_studio.core.arrays import Float32, Int32, UInt8
from dbh_studio.core.display import HIGHLIGHT_YELLOW, sample_for_display, tree_colour
from dbh_studio.ui.shade import shaded

CHOSEN_MAGENTA = (232, 0, 168)
ALSO_ORANGE = (255, 128, 0)
_PLANE_COLOUR = (20, 60, 190)
_FREE_GREY = (150, 156, 162)
# In one message; more and the next click waits for it.
_MOST_CHOSEN, _MOST_ALONE, _MOST_ALSO = 80_000, 250_000, 25_000
# In sizes of the cloud's points.
_CHOSEN_SIZE, _ALSO_SIZE, _ALONE_SIZE, _LEAST_SIZE = 1.7, 1.35, 0.8, 0.1
# Of one tree alone, in spacings of its points.
_ALONE_SPACINGS = 2.0


class EditScene:
    """Draws it. All positions are in the world frame.

    Args:
        client: The tab.
    """

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._scene = client.scene
        self._handles: dict[str, Any] = {}
        self._size = 0.02

    def set_point_size(self, size: float) -> None:
        """The size of the cloud's points, world."""
        self._size = size

    def clear(self) -> None:
        """Draw nothing."""
        with self._client.atomic():
            for name in list(self._handles):
                self._remove(name)

    def show_chosen(self, points: Float32) -> None:
        """Draw the chosen points, (N, 3), in place of those before."""
        self._points("/edit/chosen", points, CHOSEN_MAGENTA, _CHOSEN_SIZE, _MOST_CHOSEN)

    def show_also(self, trees: dict[int, Float32]) -> None:
        """Draw further chosen trees, (N, 3) points of each by number."""
        with self._client.atomic():
            for name in [name for name in self._handles if name.startswith("/edit/also/")]:
                if int(name.rsplit("/", 1)[1]) not in trees:
                    self._remove(name)
            for trunk_id, points in trees.items():
                self._points(f"/edit/also/{trunk_id}", points, ALSO_ORANGE, _ALSO_SIZE, _MOST_ALSO)

    def show_alone(self, points: Float32, owners: Int32, own_id: int, rgb: UInt8 | None, *, spacing: float) -> None:
        """Draw one tree and what is about it, for which the rest of the plot is hidden.

        Args:
            points: (N, 3).
            owners: (N,) whose they are, 0 nobody's.
            own_id: The tree.
            rgb: (N, 3) the cloud's own colours, or None.
            spacing: Between neighbouring points; all of them are drawn, which are closer together than the sample.
        """
        thinned = max(1.0, len(points) / _MOST_ALONE) ** 0.5
        size = min(_ALONE_SPACINGS * spacing * thinned / self._size, _ALONE_SIZE) if self._size > 0 else _ALONE_SIZE
        kept = np.sort(sample_for_display(len(points), _MOST_ALONE))
        points, owners = points[kept], owners[kept]
        colours = np.empty((len(points), 3), np.uint8)
        colours[:] = _FREE_GREY if rgb is None else rgb[kept]
        for trunk_id in np.unique(owners[owners > 0]):
            whose = owners == trunk_id
            colour = HIGHLIGHT_YELLOW if trunk_id == own_id else tree_colour(int(trunk_id))
            colours[whose] = shaded(points[whose], colour, None if rgb is None else rgb[kept][whose])
        self._points("/edit/alone", points, colours, max(size, _LEAST_SIZE), _MOST_ALONE)

    def hide_alone(self) -> None:
        """The plot is shown again."""
        self._remove("/edit/alone")

    def show_plane(self, corners: Float32 | None) -> None:
        """Draw the outline of a plane, (4, 3), or none."""
        self._remove("/edit/plane")
        if corners is not None:
            segments = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
            self._handles["/edit/plane"] = self._scene.add_line_segments(
                "/edit/plane", segments.astype(np.float32), _PLANE_COLOUR, thickness=3.0, thickness_units="screen"
            )

    def _points(self, name: str, points: Float32, colours: Any, size: float, most: int) -> None:
        self._remove(name)
        if not len(points):
            return
        if len(points) > most:
            points = points[np.sort(sample_for_display(len(points), most))]
        self._handles[name] = self._scene.add_point_cloud(
            name,
            points=points,
            colors=colours,
            point_size=size * self._size,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )

    def _remove(self, name: str) -> None:
        handle = self._handles.pop(name, None)
        if handle is not None:
            handle.remove()
