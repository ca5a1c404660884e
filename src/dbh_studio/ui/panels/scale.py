"""Step 2: how long one unit of the file is."""

from __future__ import annotations

from typing import get_args

import viser

from dbh_studio.app import commands
from dbh_studio.core.scale import ScaleEstimate, ScaleSource
from dbh_studio.ui import html
from dbh_studio.ui.panels.base import Panel, set_content

_CHOICES: dict[str, tuple[ScaleSource, float]] = {
    "metres": ("metres", 1.0),
    "feet": ("feet", 0.3048),
    "millimetres": ("millimetres", 0.001),
    "another unit": ("factor", 1.0),
}
assert {source for source, _ in _CHOICES.values()} <= set(get_args(ScaleSource))


class ScalePanel(Panel):
    """The unit by name or by number; one undoable step, correctable at any time."""

    step = "scale"

    def build(self) -> None:
        """Add the inputs."""
        self._state = self.gui.add_html("")
        self._unit = self.gui.add_dropdown("One unit of the file is", tuple(_CHOICES), initial_value="metres")
        self._factor = self.gui.add_number(
            "Metres per unit",
            1.0,
            min=1e-9,
            max=1e6,
            step=0.00001,
            visible=False,
            hint="from a known distance: true / in file",
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
            remedy = "Choose the unit, or give metres per unit from a distance you know."
            set_content(self._state, html.message(text, level="stop", remedy=remedy))
            return
        error = (
            f", standard error {100 * scale.standard_error / scale.metres_per_unit:.2f} %"
            if scale.standard_error
            else ""
        )
        text = f"One unit is {scale.metres_per_unit:.6g} m ({scale.source}{error})."
        set_content(self._state, html.message(text, level="ok"))

    def _unit_chosen(self, choice: str) -> None:
        self._factor.visible = _CHOICES[choice][0] == "factor"

    def _set(self) -> None:
        session = self.tab.require_session()
        source, factor = _CHOICES[self._unit.value]
        factor = float(self._factor.value) if source == "factor" else factor
        session.do(commands.set_scale(ScaleEstimate(factor, source)))
        self.tab.go_to_next_step()
