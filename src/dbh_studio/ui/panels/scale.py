"""Step 2: how long one unit of the file is."""

from __future__ import annotations

from typing import get_args

import viser

from dbh_studio.app import commands
from dbh_studio.app.session import Session
from dbh_studio.core.scale import ScaleEstimate, ScaleSource
from dbh_studio.ui import html
from dbh_studio.ui.panels.base import Panel, set_content, set_value

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
_SOURCES: dict[ScaleSource, str] = {
    "metres": "the file is in metres",
    "feet": "the file is in feet",
    "millimetres": "the file is in millimetres",
    "factor": "as given",
    "marker": "measured on markers",
    "bars": "measured on known distances",
}
assert {source for source, _ in _CHOICES.values()} <= set(get_args(ScaleSource))


class ScalePanel(Panel):
    """The unit by name or by number; one undoable step, correctable at any time."""

    step = "scale"

    def build(self) -> None:
        """Add the inputs."""
        self._state = self.gui.add_html("")
        self._unit = self.gui.add_dropdown(
            "One unit is", tuple(_CHOICES), initial_value="metres", hint="the unit of the coordinates in the file"
        )
        self._factor = self.gui.add_number(
            "Metres per unit",
            1.0,
            min=1e-9,
            max=1e6,
            step=0.00001,
            visible=False,
        )
        self._true = self.gui.add_number(
            "True length (m)", 1.0, min=1e-3, max=1e4, step=0.001, visible=False, hint="of something you measured there"
        )
        self._in_file = self.gui.add_number(
            "Length in file",
            1.0,
            min=1e-9,
            max=1e9,
            step=0.00001,
            visible=False,
            hint="of the same thing",
        )
        self.tab.worker.on_update(self._unit, self._unit_chosen)
        button = self.gui.add_button("Set scale", icon=viser.Icon.RULER_MEASURE, color="green")
        self.tab.worker.on_click(button, self._set)

    def refresh(self) -> None:
        """Say what the scale is and where it came from."""
        session = self.tab.session
        if session is None:
            set_content(self._state, html.message("Open a plot first."))
            return
        scale = session.document.scale
        if not scale.is_known:
            text = "The unit of this file is not known. A reconstruction from photographs has none until it is scaled."
            remedy = (
                "Choose the unit if you know it. Else choose “found from a known distance”, and type the true length "
                "of something in the plot and its length in the file."
            )
            set_content(self._state, html.message(text, level="stop", remedy=remedy) + self._size(session))
            self._suggest(session)
            return
        error = (
            f", standard error {100 * scale.standard_error / scale.metres_per_unit:.2f} %"
            if scale.standard_error
            else ""
        )
        source = _SOURCES.get(scale.source, scale.source)
        text = f"One unit of the file is {scale.metres_per_unit:.6g} m ({source}{error})."
        set_content(self._state, html.message(text, level="ok") + self._size(session))

    def _size(self, session: Session) -> str:
        """How large the plot is: the quickest way to see a wrong scale."""
        check = session.data_check
        if check is None:
            return ""
        scale = session.document.scale
        factor, unit = (scale.metres_per_unit, "m") if scale.is_known else (1.0, "units")
        width, depth, height = (f"{side:.3g}" for side in check.extent_src * factor)
        size = f"{width} × {depth} {unit}, {height} {unit} high"
        return f'<div class="dbh">{html.facts([("The plot is", size)])}</div>'

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

    _suggested_for: object = None

    def _unit_chosen(self, choice: str) -> None:
        for handle, needed_for in (
            (self._factor, _BY_NUMBER),
            (self._true, _BY_DISTANCE),
            (self._in_file, _BY_DISTANCE),
        ):
            handle.visible = choice == needed_for

    def _set(self) -> None:
        session = self.tab.require_session()
        choice = self._unit.value
        source, factor = _CHOICES[choice]
        if choice == _BY_NUMBER:
            factor = float(self._factor.value)
        elif choice == _BY_DISTANCE:
            factor = float(self._true.value) / float(self._in_file.value)
        session.do(commands.set_scale(ScaleEstimate(factor, source)))
        self.tab.go_to_next_step()
