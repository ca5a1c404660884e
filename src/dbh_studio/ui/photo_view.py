"""One photo in the panel of a tab: looked at, looked around in, and clicked into with its own pixels as the answer.

The server renders what is seen, so the pixel under a click is known exactly: the page shows a picture and says where on
it the pointer was. A click is read in the very picture it was made on, though a newer one may be on its way.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

from dbh_studio.core.arrays import Float64, UInt8
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.core.tiles import up_in_camera
from dbh_studio.errors import StudioError
from dbh_studio.ui.bridge import js
from dbh_studio.ui.panels.base import set_visible
from dbh_studio.ui.photo_look import Look, PanoramaLook, first_look
from dbh_studio.ui.photo_render import PhotoPixels, jpeg_url

if TYPE_CHECKING:
    from dbh_studio.app.cameras import Cameras
    from dbh_studio.ui.tab import Tab

_FIRST_SIZE = (480, 360)
_LEAST_PX, _MOST_PX = 50, 2000
# Farther out no pointer is, and so many frames no tab shows.
_MOST_NUMBER, _MOST_STEPS = 1e8, 20.0
_PER_STEP = 1.25
_FRAMES_KEPT = 16
_MOST_PATH, _MOST_BRUSH_PX = 4000, 200.0
_HINT_PANORAMA = "Drag to look around, wheel to zoom."
_HINT_FLAT = "Wheel to zoom, drag to move."


@dataclass(frozen=True)
class PhotoMark:
    """Something drawn on a photo.

    Attributes:
        u_px: Pixel of the photo, (0, 0) its outer top-left corner.
        v_px: As `u_px`, downwards.
        label: A few characters beside it.
        kind: ``mark``: set by the person; ``hint``: where something should be; ``other``: anything else.
    """

    u_px: float
    v_px: float
    label: str
    kind: Literal["mark", "hint", "other"] = "mark"


class PhotoOverlay(Protocol):
    """Something drawn over the photo of a tab pixel by pixel, and painted in it."""

    def draw(self, name: str, look: Look, view: UInt8) -> UInt8:
        """(h, w, 3) the view with the overlay."""

    def row(self, name: str) -> dict[str, Any] | None:
        """What the row of buttons under the title shows; None for no row."""

    def hint(self) -> str:
        """What the pointer does; empty where it looks around."""

    def names(self, names: list[str]) -> list[str]:
        """Which of the photos are stepped through."""

    def paint(self, name: str, look: Look, points_xy: Float64, radius_px: float, *, begins: bool, ends: bool) -> None:
        """Part of a stroke: (K, 2) pixels of the view."""

    def box(self, name: str, look: Look, corners_xy: Float64) -> None:
        """A box was drawn, (2, 2) pixels of the view; both corners the same where it was a click."""

    def left(self, name: str) -> None:
        """Another photo is shown, or none."""


class PhotoView:
    """The photo of one tab. Everything but `on_pick` is for the tab's own thread.

    Attributes:
        image: Name of the photo that is shown; None while none is.
        on_pick: Told (photo, u_px, v_px) of a click into the photo, on the tab's thread; None while none is wanted.
    """

    def __init__(self, tab: Tab) -> None:
        self.image: str | None = None
        self.on_pick: Callable[[str, float, float], None] | None = None
        self._tab = tab
        self._marks_of: Callable[[str], Sequence[PhotoMark]] = lambda _: ()
        self._slot = tab.client.gui.add_html('<div class="dbh-photo-slot"></div>', visible=False)
        self._size = _FIRST_SIZE
        self._cameras: Cameras | None = None
        self._up: tuple[float, float, float] | None = None
        self._pixels: PhotoPixels | None = None
        self._look: Look | None = None
        self._wanted: tuple[tuple[float, float] | None, float | None] = (None, None)
        self._along_src: Float64 | None = None
        self._frames: OrderedDict[int, tuple[str, Look]] = OrderedDict()
        self._n_frames = 0
        self._overlay: PhotoOverlay | None = None
        self._painted_to = 0
        bridge = tab.bridge
        for script in ("mask_tools.js", "photo.js"):
            bridge.run(resources.files("dbh_studio.ui").joinpath(script).read_text(encoding="utf-8"))
        bridge.on("photo-size", self._sized, coalesce=True)
        bridge.on("photo-drag", self._dragged)
        bridge.on("photo-wheel", self._wheeled)
        bridge.on("photo-click", self._clicked)
        bridge.on("photo-paint", self._painted)
        bridge.on("photo-box", self._boxed)
        bridge.on("photo-step", self._stepped)
        bridge.on("photo-fly", lambda _: self.fly())
        bridge.on("photo-close", lambda _: self.close())

    # ---- for the panels

    def open(self, name: str, *, at_px: tuple[float, float] | None = None, zoom_px: float | None = None) -> None:
        """Show a photo; it appears as soon as it has been read.

        Args:
            name: As the reconstruction calls it.
            at_px: Pixel of the photo to bring to the middle.
            zoom_px: How many pixels of the view one pixel of the photo takes.
        """
        photo = self._photo(name)
        if photo is None:
            raise StudioError(f"There is no photo {name} in this plot.", "Choose another one.")
        self._keep_direction()
        self._cameras = self._tab.session.cameras if self._tab.session is not None else None
        is_other = name != self.image
        if is_other:
            self._leave()
        self.image, self._wanted = name, (at_px, zoom_px)
        if is_other:
            self._look = self._pixels = None
            self._frames.clear()
        set_visible(self._slot, True)
        self._run("open", name, self._position(name), "", self.on_pick is not None)
        if self._pixels is None:
            self._run("say", f"Loading {name} …")
        self.show_row()
        self._tab.client.flush()
        self._tab.cameras.set_current(name)
        # Behind what the person has asked for since: of several photos only the last is read.
        self._tab.worker.post_latest("photo", self._load)

    def close(self) -> None:
        """Take the photo away."""
        if self.image is None:
            return
        self._leave()
        self.image = self._pixels = self._look = self._cameras = self._along_src = None
        self._frames.clear()
        self._run("close")
        set_visible(self._slot, False)
        self._tab.cameras.set_current(None)

    def set_marks(self, marks_of: Callable[[str], Sequence[PhotoMark]]) -> None:
        """Draw what `marks_of(photo)` says over every photo that is shown; it is asked each time."""
        self._marks_of = marks_of
        self.refresh()

    def set_overlay(self, overlay: PhotoOverlay | None) -> None:
        """Draw something over every photo that is shown, or nothing."""
        if overlay is not self._overlay:
            self._leave()
            self._overlay = overlay
            if self.image is not None:
                self._run("title", self._position(self.image))
            self.redraw()

    @property
    def has_pixels(self) -> bool:
        """Whether the photo that is open has been read."""
        return self._pixels is not None

    def view_of(self, look: Look) -> UInt8 | None:
        """(h, w, 3) the open photo as a look shows it, without anything over it; None while it is being read."""
        return None if self._pixels is None else self._pixels.render(look)

    def redraw(self) -> None:
        """Draw the photo and its row of buttons again: what is over it has changed."""
        if self.image is not None:
            self.show_row()
            self._draw()

    def show_row(self) -> None:
        """Bring the row of buttons in step."""
        row = None if self._overlay is None or self.image is None else self._overlay.row(self.image)
        self._run("masks", row)

    def _leave(self) -> None:
        if self._overlay is not None and self.image is not None:
            self._overlay.left(self.image)

    def refresh(self) -> None:
        """Show the photo as things are now: marks, up direction, the photos of the plot."""
        if self.image is None:
            return
        session = self._tab.session
        cameras = session.cameras if session is not None else None
        if cameras is None or self._photo(self.image) is None:
            self.close()
        elif cameras is not self._cameras:  # the same name, but it may lie in another folder now
            self._pixels = self._look = None
            self.open(self.image)
        else:
            if session is not None and self._look is not None and session.document.up_direction != self._up:
                self._first_look()
            self._draw()

    def fly(self) -> None:
        """Look at the cloud from where the photo was taken, in the direction one looks in it."""
        if self.image is not None:
            self._tab.cameras.fly_to(self.image, self._direction())

    # ---- showing

    def _photo(self, name: str) -> PosedImage | None:
        session = self._tab.session
        cameras = session.cameras if session is not None else None
        try:
            return None if cameras is None else cameras.posed.by_name(name)
        except KeyError:
            return None

    def _position(self, name: str) -> str:
        names = self._stepped_names()
        return f"{names.index(name) + 1} / {len(names)}" if name in names else ""

    def _stepped_names(self) -> list[str]:
        """The photos that ◀ and ▶ go through."""
        names = self._names()
        return names if self._overlay is None else self._overlay.names(names)

    def _names(self) -> list[str]:
        session = self._tab.session
        cameras = session.cameras if session is not None else None
        return [photo.name for photo in cameras.posed] if cameras is not None else []

    def _load(self) -> None:
        """Read the photo that is wanted now, and show it."""
        name = self.image
        photo = None if name is None else self._photo(name)
        if photo is None:
            return
        if self._pixels is None:
            try:
                self._pixels = self._tab.studio.photo_cache.pixels(photo)
            except StudioError as error:
                self._run("say", f"{error.problem} {error.remedy}")
                return
        if self._look is None:
            self._first_look()
        at_px, zoom_px = self._wanted
        if self._look is not None and zoom_px is not None:
            self._look = self._look.with_zoom(zoom_px)
        if self._look is not None and at_px is not None:
            self._look = self._look.centred_on(at_px)
        self._wanted = (None, None)
        self._draw()

    def _first_look(self) -> None:
        photo = None if self.image is None else self._photo(self.image)
        session = self._tab.session
        if photo is None or session is None:
            return
        self._up = session.document.up_direction
        look = first_look(photo.camera, *self._size, up_in_camera(photo, np.array(self._up)))
        if isinstance(look, PanoramaLook) and self._along_src is not None:
            # Going from photo to photo one keeps looking the same way.
            look = look.looking_along(photo.cam_from_source.rotation @ self._along_src)
        self._look = look

    def _keep_direction(self) -> None:
        direction = self._direction()
        if direction is not None:
            self._along_src = direction

    def _direction(self) -> Float64 | None:
        """(3,) where one looks in the photo, source coordinates; None while nothing is shown."""
        photo = None if self.image is None else self._photo(self.image)
        if photo is None:
            return None
        look = self._look
        middle = (photo.camera.width_px / 2, photo.camera.height_px / 2)
        uv = np.array([middle])
        if isinstance(look, PanoramaLook):
            uv = look.photo_from_view(np.array([[look.width_px / 2, look.height_px / 2]]))
        direction: Float64 = photo.ray(uv)[1][0]
        return direction if np.isfinite(direction).all() else None

    def _draw(self) -> None:
        if self.image is None or self._look is None or self._pixels is None:
            return
        self._n_frames += 1
        self._frames[self._n_frames] = (self.image, self._look)
        while len(self._frames) > _FRAMES_KEPT:
            self._frames.popitem(last=False)
        view = self._pixels.render(self._look)
        if self._overlay is not None:
            view = self._overlay.draw(self.image, self._look, view)
        picks = self.on_pick is not None
        self._run("frame", self._n_frames, jpeg_url(view), self._shown_marks(), self._hint(), picks, self._painted_to)
        self._tab.client.flush()

    def _hint(self) -> str:
        look = self._look
        if self._overlay is not None and (hint := self._overlay.hint()):
            return hint
        text = _HINT_PANORAMA if isinstance(look, PanoramaLook) else _HINT_FLAT
        return f"{text} Click to mark." if self.on_pick is not None else text

    def _shown_marks(self) -> list[list[Any]]:
        """[x, y, label, kind] of the marks inside the view, pixels of the view."""
        if self.image is None or self._look is None:
            return []
        marks = list(self._marks_of(self.image))
        if not marks:
            return []
        xy, is_inside = self._look.view_from_photo(np.array([[mark.u_px, mark.v_px] for mark in marks]))
        return [
            [round(float(x), 2), round(float(y), 2), mark.label, mark.kind]
            for mark, (x, y), inside in zip(marks, xy, is_inside, strict=True)
            if inside
        ]

    def _run(self, action: str, *values: Any) -> None:
        self._tab.bridge.run(f"dbhPhoto.{action}({','.join(js(value) for value in values)})")

    # ---- what the page says

    def _sized(self, payload: Any) -> None:
        numbers = _numbers(payload, 2)
        if numbers is None:
            return
        width, height = (int(min(max(side, _LEAST_PX), _MOST_PX)) for side in numbers)
        self._size = (width, height)
        if self._look is not None and (self._look.width_px, self._look.height_px) != self._size:
            self._look = self._look.resized(width, height)
            self._draw()

    def _dragged(self, payload: Any) -> None:
        numbers = _numbers(payload, 4)
        if self._look is not None and numbers is not None:
            x0, y0, x1, y1 = numbers
            self._look = self._look.panned((x0, y0), (x1, y1))
        self._draw()

    def _wheeled(self, payload: Any) -> None:
        numbers = _numbers(payload, 3)
        if self._look is not None and numbers is not None:
            x, y, steps = numbers
            self._look = self._look.zoomed(_PER_STEP ** max(-_MOST_STEPS, min(_MOST_STEPS, steps)), (x, y))
        self._draw()

    def _clicked(self, payload: Any) -> None:
        numbers = _numbers(payload, 3)
        if self.on_pick is None or numbers is None:
            return
        name, look = self._frames.get(int(numbers[0]), (None, None))
        if name is None or look is None or name != self.image:
            return
        u, v = (float(value) for value in look.photo_from_view(np.array([numbers[1:]]))[0])
        if math.isfinite(u) and math.isfinite(v):
            self.on_pick(name, u, v)

    def _painted(self, payload: Any) -> None:
        """Part of a stroke: [frame, its number, 0 begins 1 goes on 2 ends 3 both, radius, [x, y, x, y, …]]."""
        if not isinstance(payload, list) or len(payload) != 5 or not isinstance(payload[4], list):
            return
        head, path = _numbers(payload[:4], 4), _numbers(payload[4], len(payload[4]))
        if head is None or path is None or len(path) % 2 or len(path) > _MOST_PATH:
            return
        self._painted_to = int(head[1])
        name, look = self._frames.get(int(head[0]), (None, None))
        if self._overlay is not None and name is not None and look is not None and name == self.image:
            radius = min(max(head[3], 0.5), _MOST_BRUSH_PX)
            # Farther out than a pointer can be: it would only take long.
            points = np.clip(np.array(path).reshape(-1, 2), -_MOST_PX, 2 * _MOST_PX)
            part = int(head[2])
            self._overlay.paint(name, look, points, radius, begins=part in (0, 3), ends=part in (2, 3))
            if part < 2 and self._tab.worker.is_behind:
                return  # the next part is here already
        self._draw()

    def _boxed(self, payload: Any) -> None:
        numbers = _numbers(payload, 5)
        if numbers is None or self._overlay is None:
            return
        name, look = self._frames.get(int(numbers[0]), (None, None))
        if name is not None and look is not None and name == self.image:
            self._overlay.box(name, look, np.array(numbers[1:]).reshape(2, 2))

    def _stepped(self, payload: Any) -> None:
        if payload in (-1, 1):
            self.step(int(payload))

    def step(self, by: int) -> None:
        """Show the next or the one before of the photos that are stepped through."""
        every, names = self._names(), self._stepped_names()
        if self.image not in every or not names:
            return
        if self.image in names:
            self.open(names[(names.index(self.image) + by) % len(names)])
            return
        place = {name: index for index, name in enumerate(every)}
        here = place[self.image]
        ahead = [name for name in names if (place[name] > here) == (by > 0)]
        self.open((ahead or names)[0 if by > 0 else -1])


def _numbers(payload: Any, count: int) -> list[float] | None:
    """So many finite numbers of bearable size, or None: a page may say anything."""
    if not isinstance(payload, list) or len(payload) != count:
        return None
    if any(isinstance(value, bool) or not isinstance(value, (int, float)) for value in payload):
        return None
    # An integer of JSON may be too large for a float.
    if not all(-_MOST_NUMBER <= value <= _MOST_NUMBER for value in payload):
        return None
    return [float(value) for value in payload]
