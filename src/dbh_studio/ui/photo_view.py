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
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from dbh_studio.core.arrays import Float64
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
        bridge = tab.bridge
        bridge.run(resources.files("dbh_studio.ui").joinpath("photo.js").read_text(encoding="utf-8"))
        bridge.on("photo-size", self._sized, coalesce=True)
        bridge.on("photo-drag", self._dragged)
        bridge.on("photo-wheel", self._wheeled)
        bridge.on("photo-click", self._clicked)
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
        self.image, self._wanted = name, (at_px, zoom_px)
        if is_other:
            self._look = self._pixels = None
            self._frames.clear()
        set_visible(self._slot, True)
        self._run("open", name, self._position(name), "", self.on_pick is not None)
        if self._pixels is None:
            self._run("say", f"Loading {name} …")
        self._tab.client.flush()
        self._tab.cameras.set_current(name)
        # Behind what the person has asked for since: of several photos only the last is read.
        self._tab.worker.post_latest("photo", self._load)

    def close(self) -> None:
        """Take the photo away."""
        if self.image is None:
            return
        self.image = self._pixels = self._look = self._cameras = self._along_src = None
        self._frames.clear()
        self._run("close")
        set_visible(self._slot, False)
        self._tab.cameras.set_current(None)

    def set_marks(self, marks_of: Callable[[str], Sequence[PhotoMark]]) -> None:
        """Draw what `marks_of(photo)` says over every photo that is shown; it is asked each time."""
        self._marks_of = marks_of
        self.refresh()

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
        names = self._names()
        return f"{names.index(name) + 1} / {len(names)}" if name in names else ""

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
        source = jpeg_url(self._pixels.render(self._look))
        picks = self.on_pick is not None
        self._run("frame", self._n_frames, source, self._shown_marks(), self._hint(), picks)
        self._tab.client.flush()

    def _hint(self) -> str:
        look = self._look
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

    def _stepped(self, payload: Any) -> None:
        names = self._names()
        if self.image not in names or payload not in (-1, 1):
            return
        self.open(names[(names.index(self.image) + int(payload)) % len(names)])


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
