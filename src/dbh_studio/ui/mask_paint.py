"""The masks in the photo of one tab: looked through, accepted or rejected, and mended with a brush or by clicking."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from dbh_studio.app.mask_click import box_about
from dbh_studio.core.arrays import Float64, UInt8
from dbh_studio.errors import StudioError
from dbh_studio.ui import mask_html
from dbh_studio.ui.photo_look import Look

if TYPE_CHECKING:
    from dbh_studio.io.masks import Review
    from dbh_studio.ui.mask_desk import MaskDesk
    from dbh_studio.ui.tab import Tab

Mode = Literal["", "add", "erase", "box"]
_OPACITY = 45
_HOW_TO_MOVE = "wheel zooms; right button, or Space held, looks around."
_HINTS: dict[Mode, str] = {
    "": "",
    "add": f"Drag to paint; {_HOW_TO_MOVE}",
    "erase": f"Drag to erase; {_HOW_TO_MOVE}",
    "box": f"Click a trunk, or drag a box round it; {_HOW_TO_MOVE}",
}
# The segmenter looks at about so many pixels each way.
_CLICK_SIDE_PX = 1024


class MaskTools:
    """Draws masks over the tab's photo and takes what is painted there; for the tab's own thread.

    Attributes:
        is_on: Whether masks are shown at all: in the step that is about them.
    """

    def __init__(self, tab: Tab) -> None:
        self.is_on = False
        self._tab = tab
        self._is_drawn, self._opacity = True, _OPACITY
        self._mode: Mode = ""
        self._number = 0
        self._drawn: tuple[str, int] | None = None
        tab.bridge.on("mask-do", self._act)
        tab.worker.on_close(self._closed)

    @property
    def _desk(self) -> MaskDesk:
        return self._tab.studio.masks

    @property
    def mode(self) -> Mode:
        """The tool in hand; empty while masks are only looked at."""
        return self._mode

    def set_on(self, on: bool) -> None:
        """Show masks over the photo, or not; what was painted is saved."""
        if on == self.is_on:
            return
        self.is_on = on
        if not on:
            self._mode = ""
            self._tab.worker.attempt(self._desk.save)
        self._tab.photos.set_overlay(self if on else None)

    def look_through(self) -> None:
        """Open the first photo whose mask nobody has judged, or the first with a mask."""
        states = self._desk.states()
        names = self._desk.with_masks()
        if not names:
            raise StudioError("No photo has a mask yet.", "Bring masks, or make them.")
        name = next((name for name in names if not states[name].review), names[0])
        canvas = self._desk.canvas(name)
        # A panorama might begin with a view that has no trunk in it.
        at_px = canvas.largest() if canvas is not None and canvas.camera.is_panorama else None
        self._tab.photos.open(name, at_px=at_px)

    def changed(self, *names: str) -> None:
        """Show masks that have changed: painted or judged in this tab or another; all where none is named."""
        shown = self._tab.photos.image
        if self.is_on and shown is not None and (not names or shown in names):
            if self._mode and self._desk.why_not():
                self._mode = ""
            canvas = self._desk.canvas(shown)
            if canvas is not None and self._drawn == (shown, canvas.version) and names:
                self._tab.photos.show_row()  # saved or judged: the picture is the same
            else:
                self._tab.photos.redraw()
        self._tab.refresh()

    def offer_counts(self) -> None:
        """Offer the colours of the label counts, where masks have voted."""
        counts = self._desk.label_counts()
        self._tab.controls.offer("Label count", None if counts is None else counts.colours)

    def show_legend(self) -> None:
        """Say what the colours mean while the cloud is coloured by label count."""
        counts = self._desk.label_counts() if self._tab.view.mode == "Label count" else None
        self._tab.bridge.run(mask_html.legend_js("" if counts is None else mask_html.legend(counts.legend)))

    def take_back(self) -> bool:
        """Take the last stroke back; False where nothing is painted in this tab."""
        name = self._tab.photos.image
        if not self.is_on or not self._mode or name is None or self._desk.why_not():
            return False
        canvas = self._desk.canvas(name)
        if canvas is not None and canvas.undo():
            self._painted()
            self._tab.photos.redraw()
        return True

    # ---- PhotoOverlay

    def draw(self, name: str, look: Look, view: UInt8) -> UInt8:
        """See `PhotoOverlay`."""
        canvas = self._desk.canvas(name) if self._is_drawn else None
        self._drawn = None if canvas is None else (name, canvas.version)
        return view if canvas is None else canvas.draw(look, view, self._opacity / 100)

    def row(self, name: str) -> dict[str, Any] | None:
        """See `PhotoOverlay`."""
        state = self._desk.state(name)
        if state is None:
            return None
        canvas = self._desk.canvas(name)
        # A mask of a photo that has changed is not shown; painting makes a new one.
        text, level = mask_html.mask_state(state, None if canvas is None else canvas)
        return {
            "on": self._is_drawn,
            "opacity": self._opacity,
            "status": text,
            "level": level,
            "review": state.review,
            "has_mask": state.has_mask,
            "tool": self._mode,
            "can_paint": not self._desk.why_not() and state.has_photo,
            "can_click": self._mode != "" and self._desk.segmenter().is_available,
            "can_undo": canvas is not None and canvas.can_undo,
            "busy": not self._tab.photos.has_pixels,
        }

    def hint(self) -> str:
        """See `PhotoOverlay`."""
        return _HINTS[self._mode] if self._is_drawn else ""

    def names(self, names: list[str]) -> list[str]:
        """See `PhotoOverlay`: those with masks; all while none has one."""
        states = self._desk.states()
        return [name for name in names if name in states and states[name].has_mask] or names

    def paint(self, name: str, look: Look, points_xy: Float64, radius_px: float, *, begins: bool, ends: bool) -> None:
        """See `PhotoOverlay`."""
        if self._mode not in ("add", "erase") or not self._is_drawn:
            return
        self._desk.check_writable()
        canvas = self._desk.canvas(name, new=True)
        if canvas is None or not len(points_xy):
            return
        if begins:
            canvas.begin()
            first = (float(points_xy[0, 0]), float(points_xy[0, 1]))
            self._number = canvas.number_for(self._mode, look, first)
        canvas.paint(look, points_xy, radius_px, self._number)
        if ends:
            self._painted()
            self._tab.photos.show_row()

    def box(self, name: str, look: Look, corners_xy: Float64) -> None:
        """See `PhotoOverlay`."""
        if self._mode != "box" or not self._is_drawn:
            return
        self._desk.check_writable()
        canvas = self._desk.canvas(name, new=True)
        if canvas is None:
            return
        finer = look.finer(_CLICK_SIDE_PX / max(look.width_px, look.height_px))
        corners = np.clip(corners_xy, 0.0, (look.width_px, look.height_px)) * (finer.width_px / look.width_px)
        self._tab.bridge.run("dbhPhoto.wait(true)")
        self._tab.client.flush()
        try:
            view = self._tab.photos.view_of(finer)
            if view is None:
                return
            picture: UInt8 = view
            shape = self._desk.segmenter().outline(
                lambda: picture, (name, finer_key(finer)), box_about(corners, finer.width_px, finer.height_px)
            )
            canvas.begin()
            canvas.fill(look, shape, canvas.new_number())
            self._painted()
        finally:
            self._tab.bridge.run("dbhPhoto.wait(false)")
        self._tab.photos.redraw()

    def left(self, name: str) -> None:
        """See `PhotoOverlay`: nothing painted is lost. Where it cannot be saved it is told, and kept to try again."""
        self._tab.worker.attempt(self._desk.save)

    # ---- what the page says

    def _act(self, payload: Any) -> None:
        name = self._tab.photos.image
        if not isinstance(payload, list) or len(payload) != 2 or name is None or not self.is_on:
            return
        what, value = payload
        if what == "on" and isinstance(value, bool):
            self._is_drawn = value
        elif what == "opacity" and isinstance(value, (int, float)) and not isinstance(value, bool):
            self._opacity = int(min(max(value, 10), 100))
        elif what in ("accept", "reject"):
            self._judge(name, "accepted" if what == "accept" else "rejected")
            return
        elif what == "paint":
            self._begin(name)
        elif what == "tool" and value in ("add", "erase", "box") and self._mode:
            self._mode = value
        elif what == "undo":
            self.take_back()
            return
        elif what == "done":
            self._mode = ""
            self._desk.save()
        else:
            return
        self._tab.photos.redraw()

    def _begin(self, name: str) -> None:
        self._desk.check_writable()
        self._tab.marking.stop()
        self._mode, self._is_drawn = "add", True
        self._desk.canvas(name, new=True)

    def _judge(self, name: str, review: Review) -> None:
        """Say what a mask is worth, and go on to the next that nobody has judged; said twice it is taken back."""
        state = self._desk.state(name)
        if state is None or not state.has_mask:
            return
        if state.review == review:
            self._desk.review(name, "")
            return
        self._desk.review(name, review)
        states, names = self._desk.states(), self._desk.with_masks()
        at = names.index(name)
        following = next((each for each in names[at + 1 :] + names[:at] if not states[each].review), None)
        if following is not None:
            self._tab.photos.open(following)

    def _painted(self) -> None:
        """Save behind what waits: while strokes come quickly, only the last of them."""
        self._tab.worker.post_latest("mask-save", self._desk.save)

    def _closed(self) -> None:
        """The tab goes: what it painted is saved in whatever thread tells so."""
        if self._mode:
            with contextlib.suppress(StudioError):  # nobody is there to be told; the next save tries again
                self._desk.save()


def finer_key(look: Look) -> tuple[bytes, ...]:
    """The same for looks that show the same."""
    corners = np.array([[0.0, 0.0], [look.width_px, 0.0], [look.width_px, look.height_px], [0.0, look.height_px]])
    middle = np.array([[look.width_px / 2, look.height_px / 2]])
    shown = look.photo_from_view(np.concatenate([corners, middle]))
    return np.round(shown, 3).tobytes(), str(look.zoom).encode()
