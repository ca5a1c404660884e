"""What one browser tab sees in 3D. It only shows: nothing here decides or computes a measurement.

Two rules come from measuring viser 1.1.1: the big cloud is sent once and never recoloured (a new colour sends every
position again and draws over the trunks), and a colour mode is a visibility switch on a parent node.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import viser

from dbh_studio.core.arrays import Float32, Float64, UInt8
from dbh_studio.core.display import (
    HIGHLIGHT_YELLOW,
    TRUNK_RED,
    coarse_first_chunks,
    sample_for_display,
    tree_colour,
)
from dbh_studio.core.reconstruction import TriangleMesh
from dbh_studio.core.transforms import Similarity
from dbh_studio.core.trunks import Trunk
from dbh_studio.ui.display_cloud import DisplayCloud
from dbh_studio.ui.shade import shaded
from dbh_studio.ui.surface import glb_of
from dbh_studio.ui.viewpoint import clear_side

log = logging.getLogger(__name__)

ColourMode = Literal["Original", "Segmentation (red)", "Segmentation (by tree)", "Height", "Label count", "Steps"]
COLOUR_MODES: tuple[ColourMode, ...] = get_args(ColourMode)

# A mesh is sent and drawn whole: viser thins nothing.
MOST_FACES = 3_000_000
_OVERLAY_BUDGET = 1_200_000
_PER_TREE = 25_000
# In sizes of the cloud's points: the chosen trunk covers its overlay, which covers the cloud.
_OVERLAY_SIZE, _MARKED_SIZE = 1.25, 1.3
# Narrower than viser's 75 degrees, at which upright stems near the edge look as if they leaned.
_FOV_RAD = np.deg2rad(50.0)
_RING_COLOUR = (20, 60, 190)
# Modes whose colours come with time: a copy of the cloud each, sent when it is first looked at.
_LATER: dict[ColourMode, str] = {"Label count": "/count"}


@dataclass(frozen=True, eq=False)
class TrunkPicture:
    """What is drawn of one trunk.

    Attributes:
        points: (N, 3) world.
        rgb: (N, 3) the cloud's own colours of them, or None.
        anchor: (3,) where its number goes, world.
    """

    points: Float32
    rgb: UInt8 | None
    anchor: Float64


@dataclass(frozen=True, eq=False)
class PointLayer:
    """Points that are switched on and off together.

    Attributes:
        points: (N, 3) world.
        rgb: Their colour.
        size: In sizes of the cloud's points.
        visible: Whether they are on at first.
    """

    points: Float32
    rgb: tuple[int, int, int]
    size: float
    visible: bool


class SceneView:
    """The 3D side of one tab.

    Args:
        client: The tab.
        is_hurried: Whether the person has asked for more already, so that a flight is cut short.
    """

    def __init__(self, client: viser.ClientHandle, *, is_hurried: Callable[[], bool] = lambda: False) -> None:
        self._client = client
        self._is_hurried = is_hurried
        self._scene = client.scene
        self._display: DisplayCloud | None = None
        self._mode: ColourMode = "Original"
        self._labels_on = True
        self._crowns_on = True
        self._others_on = True
        self._point_size, self._size_factor = 0.02, 1.0
        self._clouds: list[Any] = []
        self._later: dict[ColourMode, UInt8] = {}
        self._steps: dict[int, tuple[PointLayer, Any]] = {}
        self._overlays: dict[int, tuple[Trunk, Any, Any]] = {}
        self._label_handles: dict[int, Any] = {}
        self._marked: Any = None
        self._ring: Any = None
        self._frames: dict[str, Any] = {}
        self._empty: list[Any] = []
        self._mesh: Any = None
        self._mesh_on = False
        self._stream_stop = threading.Event()
        self._lock = threading.RLock()

    # ---- the cloud

    def shows(self, display: DisplayCloud) -> bool:
        """Whether this very cloud has been sent."""
        return self._display is display

    def show_plot(self, display: DisplayCloud) -> None:
        """Replace everything by this plot and look at it; the points arrive coarse first, in the background."""
        self.clear()
        for handle in self._empty:
            handle.remove()
        self._empty = []
        self._display = display
        self._point_size = display.point_size * self._size_factor
        for name in (
            "/rgb",
            "/rgb/low",
            "/rgb/crown",
            "/height",
            "/height/low",
            "/height/crown",
            "/red",
            "/tree",
            "/steps",
            "/labels",
        ):
            self._frames[name] = self._scene.add_frame(name, show_axes=False)
        self._apply_visibility()
        self.look_at_plot(animate=False)
        self._stream_stop = threading.Event()
        threading.Thread(target=self._stream, args=(display, self._stream_stop), daemon=True, name="stream").start()

    def clear(self) -> None:
        """Remove the plot from the picture."""
        self._stream_stop.set()
        with self._lock:
            self.highlight(None)
            for handle in self._frames.values():
                if handle.name.count("/") == 1:
                    handle.remove()
            if self._mesh is not None:
                self._mesh.remove()
            self._mesh, self._mesh_on = None, False
            self._frames, self._clouds, self._overlays, self._label_handles = {}, [], {}, {}
            self._later, self._steps = {}, {}
            self._display = None

    def show_nothing_open(self) -> None:
        """A floor and a word in place of a blank page."""
        self.clear()
        if not self._empty:
            floor = self._scene.add_grid(
                "/floor", 40.0, 40.0, cell_size=1.0, section_size=5.0, cell_color=(225, 228, 230),
                section_color=(190, 195, 200), fade_distance=60.0,
            )  # fmt: skip
            word = self._scene.add_label(
                "/word", "Open a point cloud in the panel to begin", position=(0.0, 0.0, 1.5), anchor="center-center",
                font_screen_scale=1.4,
            )  # fmt: skip
            self._empty = [floor, word]

    def stop(self) -> None:
        """Stop sending: the tab is gone."""
        self._stream_stop.set()

    def _stream(self, display: DisplayCloud, stop: threading.Event) -> None:
        """Send the cloud in growing chunks; runs on its own thread until done, replaced, or the tab is gone."""
        order = [("/rgb", display.rgb), ("/height", display.by_height)]
        for parent, colours in order if display.has_rgb else order[:1]:
            self._send(parent, display, colours, stop.is_set)

    def _send(self, parent: str, display: DisplayCloud, colours: UInt8, is_stopped: Callable[[], bool]) -> None:
        for part, is_part in (("low", ~display.is_crown), ("crown", display.is_crown)):
            chosen = np.flatnonzero(is_part)
            for number, chunk in enumerate(coarse_first_chunks(len(chosen))):
                rows = chosen[chunk]
                with self._lock:
                    if is_stopped():
                        return
                    self._clouds.append(
                        self._add_points(
                            f"{parent}/{part}/{number}", display.points[rows], colours[rows], self._point_size
                        )
                    )
                self._client.flush()
                # Room for clicks and text between two chunks on a slow line.
                time.sleep(0.03)

    def set_colours(self, mode: ColourMode, colours: UInt8 | None) -> None:
        """Say how a mode colours the points of the display, or that it cannot any more; see `_LATER`.

        Args:
            mode: One of those that come with time.
            colours: (M, 3) of the points of the display.
        """
        with self._lock:
            if self._later.get(mode) is colours:
                return
            if colours is None:
                del self._later[mode]
            else:
                self._later[mode] = colours
            self._remove_later(mode)
            self._send_later()
            self._apply_visibility()

    def _remove_later(self, mode: ColourMode) -> None:
        parent = _LATER[mode]
        self._clouds = [handle for handle in self._clouds if not handle.name.startswith(f"{parent}/")]
        frame = self._frames.pop(parent, None)
        for name in (f"{parent}/low", f"{parent}/crown"):
            self._frames.pop(name, None)
        if frame is not None:
            frame.remove()

    def _send_later(self) -> None:
        """Send the colours of the mode that is on, where they come with time and have not been sent."""
        parent, colours, display = _LATER.get(self._mode), self._later.get(self._mode), self._display
        if parent is None or colours is None or display is None or parent in self._frames:
            return
        for name in (parent, f"{parent}/low", f"{parent}/crown"):
            self._frames[name] = self._scene.add_frame(name, show_axes=False)
        frame, ended = self._frames[parent], self._stream_stop

        def is_stopped() -> bool:
            return ended.is_set() or self._frames.get(parent) is not frame

        sending = (parent, display, colours, is_stopped)
        threading.Thread(target=self._send, args=sending, daemon=True, name="stream").start()

    def _add_points(self, name: str, points: Float32, colours: Any, size: float, *, visible: bool = True) -> Any:
        return self._scene.add_point_cloud(
            name,
            points=points,
            colors=colours,
            point_size=size,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
            visible=visible,
        )

    # ---- trunks

    def show_trunks(self, trunks: Sequence[Trunk], picture_of: Callable[[Trunk], TrunkPicture]) -> None:
        """Bring the overlays in step with the given trunks; those drawn already are not even looked at."""
        with self._lock, self._client.atomic():
            for trunk_id in set(self._overlays) - {trunk.id for trunk in trunks}:
                self._remove_trunk(trunk_id)
            limit = min(_PER_TREE, _OVERLAY_BUDGET // max(len(trunks), 1))
            for trunk in trunks:
                known = self._overlays.get(trunk.id)
                if known is None or known[0] is not trunk:
                    self._remove_trunk(trunk.id)
                    picture = picture_of(trunk)
                    red = self._add_trunk(f"/red/{trunk.id}", picture, TRUNK_RED, limit, _OVERLAY_SIZE)
                    own = self._add_trunk(f"/tree/{trunk.id}", picture, tree_colour(trunk.id), limit, _OVERLAY_SIZE)
                    self._overlays[trunk.id] = (trunk, red, own)
                    self._label_handles[trunk.id] = self._scene.add_label(
                        f"/labels/{trunk.id}",
                        str(trunk.id),
                        position=tuple(picture.anchor),
                        anchor="bottom-center",
                        font_screen_scale=0.85,
                    )

    def _add_trunk(self, name: str, trunk: TrunkPicture, colour: tuple[int, int, int], limit: int, size: float) -> Any:
        """One trunk over the cloud: thinned, larger by a factor than the cloud's points, so that it covers them."""
        chosen = np.sort(sample_for_display(len(trunk.points), limit))
        shown = trunk.points[chosen]
        colours = shaded(shown, colour, None if trunk.rgb is None else trunk.rgb[chosen])
        return self._add_points(name, shown, colours, size * self._point_size)

    def _remove_trunk(self, trunk_id: int) -> None:
        known = self._overlays.pop(trunk_id, None)
        if known is not None:
            known[1].remove()
            known[2].remove()
        label = self._label_handles.pop(trunk_id, None)
        if label is not None:
            label.remove()

    def highlight(self, trunk: TrunkPicture | None, ring: Float32 | None = None) -> None:
        """Draw one trunk in yellow with its measured ring, or nothing."""
        with self._lock:
            for handle in (self._marked, self._ring):
                if handle is not None:
                    handle.remove()
            self._marked = self._ring = None
            if trunk is not None and len(trunk.points):
                self._marked = self._add_trunk("/highlight", trunk, HIGHLIGHT_YELLOW, 2 * _PER_TREE, _MARKED_SIZE)
                self._marked.visible = self._others_on
            if ring is not None and len(ring) > 2:
                segments = np.stack([ring, np.roll(ring, -1, axis=0)], axis=1)
                self._ring = self._scene.add_line_segments(
                    "/ring", segments, _RING_COLOUR, thickness=5.0, thickness_units="screen"
                )

    # ---- the steps of the search

    def show_steps(self, layers: Mapping[int, PointLayer]) -> None:
        """Put the points of every step in place of those sent before; seen in the mode Steps."""
        with self._lock:
            for _, handle in self._steps.values():
                handle.remove()
            self._steps = {}
            for number, layer in layers.items():
                size = layer.size * self._point_size
                handle = self._add_points(f"/steps/{number}", layer.points, layer.rgb, size, visible=layer.visible)
                self._steps[number] = (layer, handle)
                self._client.flush()
            self._apply_visibility()

    def set_step(self, number: int, on: bool) -> None:
        """Show or hide the points of one step."""
        with self._lock:
            if number in self._steps and self._steps[number][1].visible != on:
                self._steps[number][1].visible = on

    # ---- the mesh

    def show_mesh(self, mesh: TriangleMesh, world_from_source: Similarity, *, on: bool) -> None:
        """Show the surface the cloud came with in place of the cloud, or the cloud; it is sent when first wanted."""
        with self._lock:
            self._mesh_on = on
            content = glb_of(mesh, world_from_source) if self._mesh is None and on else None
            # Together: points in the same place would show through the surface for a moment.
            with self._client.atomic():
                if content is not None:
                    self._mesh = self._scene.add_glb("/mesh", content, cast_shadow=False, receive_shadow=False)
                elif self._mesh is not None:
                    self._mesh.visible = on and self._others_on
                self._apply_visibility()

    # ---- how it looks

    def set_mode(self, mode: ColourMode) -> None:
        """Switch the colours: visibility messages only, whatever the size of the cloud."""
        self._mode = mode
        with self._lock:
            self._send_later()
            self._apply_visibility()

    def set_labels(self, on: bool) -> None:
        """Show or hide the tree numbers."""
        self._labels_on = on
        self._apply_visibility()

    def set_others(self, on: bool) -> None:
        """Show or hide the plot: hidden, only what is drawn of one tree for correcting it is seen, and its ring."""
        with self._lock:
            self._others_on = on
            if self._marked is not None and self._marked.visible != on:
                self._marked.visible = on
            if self._mesh is not None and self._mesh_on:
                self._mesh.visible = on
            self._apply_visibility()

    def set_crowns(self, on: bool) -> None:
        """Show or hide what is higher than the stems' lower part."""
        self._crowns_on = on
        self._apply_visibility()

    def _apply_visibility(self) -> None:
        if not self._frames or self._display is None:
            return
        by_height = self._mode == "Height" and self._display.has_rgb
        by_step = self._mode == "Steps" and bool(self._steps)
        later = _LATER.get(self._mode) if self._mode in self._later else None
        wanted = {
            "/rgb": not by_height and later is None and not by_step and not self._mesh_on,
            "/height": by_height and not self._mesh_on,
            "/rgb/crown": self._crowns_on,
            "/height/crown": self._crowns_on,
            "/red": self._mode == "Segmentation (red)",
            "/tree": self._mode == "Segmentation (by tree)",
            "/steps": by_step and not self._mesh_on,
            "/labels": self._labels_on,
        }
        for parent in _LATER.values():
            if parent in self._frames:
                wanted[parent] = parent == later and not self._mesh_on
                wanted[f"{parent}/crown"] = self._crowns_on
        if not self._others_on:
            wanted = {name: shown and name.count("/") > 1 for name, shown in wanted.items()}
        with self._client.atomic():
            for name, visible in wanted.items():
                if self._frames[name].visible != visible:
                    self._frames[name].visible = visible

    def set_point_size(self, factor: float) -> None:
        """Scale all points by a factor of the size that fits the cloud's spacing."""
        self._size_factor = factor
        if self._display is None:
            return
        with self._lock, self._client.atomic():
            self._point_size = self._display.point_size * factor
            for handle in self._clouds:
                handle.point_size = self._point_size
            for _, red, own in self._overlays.values():
                red.point_size = own.point_size = _OVERLAY_SIZE * self._point_size
            for layer, handle in self._steps.values():
                handle.point_size = layer.size * self._point_size
            if self._marked is not None:
                self._marked.point_size = _MARKED_SIZE * self._point_size

    # ---- the camera

    def look_at_plot(self, *, animate: bool = True) -> None:
        """The whole plot, from a little above the heads: stems are seen, not crowns."""
        if self._display is None:
            return
        centre, radius = self._display.centre_and_radius()
        # The near corners are closer than the middle, hence the third more.
        distance = 1.35 * radius / self._half_width()
        self._move(centre + distance * np.array([0.1, -0.95, 0.28]), centre, animate=animate)

    def look_from_top(self) -> None:
        """Straight down, north up."""
        if self._display is None:
            return
        centre, radius = self._display.centre_and_radius()
        height = 1.1 * radius / min(self._half_width(), float(np.tan(_FOV_RAD / 2))) + 8.0
        self._move(centre + np.array([0.0, -1e-3, height]), centre, up=(0.0, 1.0, 0.0))

    def look_down(self, target: Float64, distance: float) -> None:
        """Straight down on a place, north up."""
        self._move(target + np.array([0.0, -1e-3 * distance, distance]), target, up=(0.0, 1.0, 0.0))

    def look_from_side(self) -> None:
        """Level, from the south, at stem height."""
        if self._display is None:
            return
        centre, radius = self._display.centre_and_radius()
        self._move(centre + np.array([0.0, -1.2 * radius / self._half_width() - radius, 0.05 * radius]), centre)

    def _half_width(self) -> float:
        """Half the width of the picture, one unit in front of the camera."""
        return float(np.tan(_FOV_RAD / 2)) * float(np.clip(self._client.camera.aspect, 0.3, 3.0))

    def fly_to(self, target: Float64, *, distance: float = 6.0) -> None:
        """Stand in front of a point, on the side one is looking from unless something is in the way."""
        away = np.asarray(self._client.camera.position, float) - target
        away[2] = 0.0
        norm = float(np.linalg.norm(away))
        away = away / norm if norm > 1e-6 else np.array([0.0, -1.0, 0.0])
        if self._display is not None:
            away = clear_side(self._display.points, target, away, distance)
        self._move(target + distance * away + np.array([0.0, 0.0, 0.2 * distance]), target)

    def look_along(self, position: Float64, direction: Float64, ahead: float) -> None:
        """Stand at a point and look along a direction; one then turns about a point so far ahead."""
        self._move(position, position + ahead * direction / np.linalg.norm(direction))

    def _move(
        self,
        position: Float64,
        look_at: Float64,
        *,
        up: tuple[float, float, float] = (0.0, 0.0, 1.0),
        animate: bool = True,
    ) -> None:
        camera = self._client.camera
        start, start_look = np.asarray(camera.position, float), np.asarray(camera.look_at, float)
        n_steps = 8 if animate else 1
        camera.up_direction, camera.fov = up, _FOV_RAD
        for step in range(1, n_steps + 1):
            eased = 1.0 if self._is_hurried() else step / n_steps
            eased = eased * eased * (3 - 2 * eased)
            with self._client.atomic():
                # Setting the position moves look_at along, so the order matters.
                camera.position = start + (position - start) * eased
                camera.look_at = start_look + (look_at - start_look) * eased
            self._client.flush()
            if eased == 1.0:
                return
            time.sleep(1 / 25)
