"""A scale by number: the unit, a factor, a known distance, or, where nothing else exists, something weak."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import viser

from dbh_studio.app import commands
from dbh_studio.app.cameras import Cameras, require_fit
from dbh_studio.app.lengths import metres_from_text
from dbh_studio.app.scaling import scale_from_baseline, scale_from_camera_height
from dbh_studio.app.session import Session
from dbh_studio.core.scale import ScaleEstimate, ScaleSource
from dbh_studio.errors import StudioError
from dbh_studio.ui import html
from dbh_studio.ui.panels.base import set_value, set_visible

if TYPE_CHECKING:
    from dbh_studio.ui.tab import Tab

_CHOICES: dict[str, tuple[ScaleSource, float]] = {
    "metres": ("metres", 1.0),
    "feet": ("feet", 0.3048),
    "US survey feet": ("feet", 1200 / 3937),
    "centimetres": ("factor", 0.01),
    "millimetres": ("millimetres", 0.001),
    "another unit": ("factor", 1.0),
    "found from a known distance": ("factor", 1.0),
}
_BY_NUMBER, _BY_DISTANCE = "another unit", "found from a known distance"
_BY_HEIGHT, _BY_BASELINE = "weak: from the camera's height", "weak: from two photos"
_WEAK = "Weak: use it only where nothing else exists. Diameters get an error of several per cent."


class NumberSection:
    """The inputs, built at the GUI's current place."""

    def __init__(self, tab: Tab) -> None:
        self._tab = tab
        self._cameras: Cameras | None = None
        self._suggested_for: object = None
        gui = tab.client.gui
        self._unit = gui.add_dropdown(
            "One unit is", tuple(_CHOICES), initial_value="metres", hint="the unit of the coordinates in the file"
        )
        self._factor = gui.add_number("Metres per unit", 1.0, min=1e-9, max=1e6, step=0.00001, visible=False)
        self._true = gui.add_number(
            "True length (m)", 1.0, min=1e-3, max=1e4, step=0.001, visible=False, hint="of something you measured there"
        )
        self._in_file = gui.add_number(
            "Length in file", 1.0, min=1e-9, max=1e9, step=0.00001, visible=False, hint="of the same thing"
        )
        self._height = gui.add_text(
            "Camera height (m)", "", visible=False, hint="from the ground to the lens, as it was carried"
        )
        self._first = gui.add_dropdown("First photo", ("–",), visible=False)
        self._second = gui.add_dropdown("Second photo", ("–",), visible=False)
        self._apart = gui.add_text("Metres apart", "", visible=False, hint="between the places of the two photos")
        self._weak = gui.add_html(html.message(_WEAK), visible=False)
        tab.worker.on_update(self._unit, self._unit_chosen)
        button = gui.add_button("Set scale", icon=viser.Icon.RULER_MEASURE, color="green")
        tab.worker.on_click(button, self._set)

    def refresh(self, session: Session) -> None:
        """Offer what can be used with this plot."""
        self._offer_photos(session.cameras)
        if not session.document.scale.is_known:
            self._suggest(session)

    def _offer_photos(self, cameras: Cameras | None) -> None:
        if cameras is self._cameras:
            return
        self._cameras = cameras
        weak = (_BY_HEIGHT, _BY_BASELINE) if cameras is not None else ()
        chosen = self._unit.value
        self._unit.options = (*_CHOICES, *weak)
        set_value(self._unit, chosen if chosen in self._unit.options else "metres")
        names = tuple(photo.name for photo in cameras.posed) if cameras is not None else ("–",)
        for handle, name in ((self._first, names[0]), (self._second, names[-1])):
            handle.options = names
            set_value(handle, name)
        self._unit_chosen(self._unit.value)

    def _suggest(self, session: Session) -> None:
        """Offer what the numbers look like, once per plot; the person decides."""
        factor = session.data_check.suggested_metres_per_unit if session.data_check is not None else None
        if factor is None or self._suggested_for is session:
            return
        self._suggested_for = session
        choice = next((name for name, (_, metres) in _CHOICES.items() if abs(metres - factor) < 1e-6), _BY_NUMBER)
        set_value(self._unit, choice)
        if choice == _BY_NUMBER:
            set_value(self._factor, factor)
        self._unit_chosen(choice)

    def _unit_chosen(self, choice: str) -> None:
        for handle, needed_for in (
            (self._factor, _BY_NUMBER),
            (self._true, _BY_DISTANCE),
            (self._in_file, _BY_DISTANCE),
            (self._height, _BY_HEIGHT),
            (self._first, _BY_BASELINE),
            (self._second, _BY_BASELINE),
            (self._apart, _BY_BASELINE),
        ):
            set_visible(handle, choice == needed_for)
        set_visible(self._weak, choice in (_BY_HEIGHT, _BY_BASELINE))

    def _set(self) -> None:
        session = self._tab.require_session()
        session.do(commands.set_scale(self._estimate(session, self._unit.value)))
        self._tab.go_to_next_step()

    def _estimate(self, session: Session, choice: str) -> ScaleEstimate:
        if choice in (_BY_HEIGHT, _BY_BASELINE):
            return self._weak_estimate(session, choice)
        source, factor = _CHOICES[choice]
        if choice == _BY_NUMBER:
            factor = float(self._factor.value)
        elif choice == _BY_DISTANCE:
            factor = float(self._true.value) / float(self._in_file.value)
        return ScaleEstimate(factor, source)

    def _weak_estimate(self, session: Session, choice: str) -> ScaleEstimate:
        cameras = session.cameras
        if cameras is None:
            raise StudioError("This plot has no photos.", "Choose another way.")
        require_fit(cameras)
        if choice == _BY_HEIGHT:
            height_m = metres_from_text(self._height.value, "The height of the camera")
            up = np.array(session.document.up_direction)
            return scale_from_camera_height(cameras.posed, session.cloud, up, height_m)
        apart_m = metres_from_text(self._apart.value, "The distance between the two photos")
        return scale_from_baseline(cameras.posed, self._first.value, self._second.value, apart_m)
