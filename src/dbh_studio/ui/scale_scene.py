"""The marked points and known lengths in the 3D picture of one tab."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from dbh_studio.core.arrays import Float64
from dbh_studio.ui.bind import TabWorker

_CONTROL, _CHECK, _OPEN = (25, 113, 194), (134, 142, 150), (232, 89, 12)


@dataclass(frozen=True, eq=False)
class LengthMark:
    """One length as drawn.

    Attributes:
        name: Beside it.
        points: (N, 3) world; joined in order, four of them as a square.
        is_control: Whether the scale comes from it.
    """

    name: str
    points: Float64
    is_control: bool

    def segments(self) -> Float64:
        """(M, 2, 3) its edges."""
        ends = np.roll(self.points, -1, axis=0)
        joined = np.stack([self.points, ends], axis=1)
        return joined if len(self.points) == 4 else joined[:-1]


@dataclass(frozen=True, eq=False)
class PointMark:
    """One point of the length that is being marked: its label, (3,) `xyz` in the world, and whether it is chosen."""

    label: str
    xyz: Float64
    is_chosen: bool


class ScaleScene:
    """Draws them; `dragged` is called with (3,) world when the chosen point was dragged."""

    def __init__(self, worker: TabWorker, dragged: Callable[[Float64], Any]) -> None:
        self._worker = worker
        self._scene: viser.SceneApi = worker.client.scene
        self._dragged = dragged
        self._handles: list[Any] = []
        self._shown: Any = None

    def show(self, lengths: Sequence[LengthMark], points: Sequence[PointMark], *, size: float, reach: float) -> None:
        """Draw these in place of those drawn before; the same again is not sent twice.

        Args:
            lengths: The known lengths.
            points: Of the length that is being marked.
            size: Radius of a point, world.
            reach: Length of the arrows that drag the chosen point, world.
        """
        wanted = (
            [(mark.name, mark.points.tolist(), mark.is_control) for mark in lengths],
            [(mark.label, mark.xyz.tolist(), mark.is_chosen) for mark in points],
            size,
            reach if points else 0.0,
        )
        if wanted == self._shown:
            return
        self._shown = wanted
        with self._worker.client.atomic():
            for handle in self._handles:
                handle.remove()
            self._handles = []
            for number, length in enumerate(lengths):
                self._draw_length(f"/marks/length{number}", length, size)
            for number, point in enumerate(points):
                self._draw_point(f"/marks/point{number}", point, size, reach)

    def clear(self) -> None:
        """Draw nothing."""
        self.show((), (), size=0.0, reach=0.0)

    def _draw_length(self, name: str, length: LengthMark, size: float) -> None:
        # Removing it takes everything under it along.
        self._handles.append(self._scene.add_frame(name, show_axes=False))
        colour = _CONTROL if length.is_control else _CHECK
        self._scene.add_line_segments(
            f"{name}/line", length.segments().astype(np.float32), colour, thickness=3.0, thickness_units="screen"
        )
        self._scene.add_point_cloud(
            f"{name}/ends",
            length.points.astype(np.float32),
            np.array(colour, np.uint8),
            point_size=1.2 * size,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )
        middle = tuple(length.points.mean(axis=0))
        self._scene.add_label(
            f"{name}/name", length.name, position=middle, anchor="bottom-center", font_screen_scale=0.8
        )

    def _draw_point(self, name: str, point: PointMark, size: float, reach: float) -> None:
        self._handles.append(self._scene.add_frame(name, show_axes=False))
        place = tuple(point.xyz)
        self._scene.add_icosphere(
            f"{name}/ball", size, _OPEN, subdivisions=2, position=place, cast_shadow=False, receive_shadow=False
        )
        self._scene.add_label(f"{name}/label", point.label, position=place, anchor="bottom-center")
        if point.is_chosen:
            arrows = self._scene.add_transform_controls(
                f"{name}/arrows",
                reach,
                disable_sliders=True,
                disable_rotations=True,
                depth_test=False,
                opacity=0.8,
                position=place,
            )
            self._worker.on_dragged(arrows, self._dragged)
