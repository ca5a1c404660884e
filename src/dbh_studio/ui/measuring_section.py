"""How the diameters of all trees are measured: height, method, and every setting. A part of Inspect."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args

import viser

from dbh_studio.app import commands
from dbh_studio.core.section_drawing import CURVE_TITLES
from dbh_studio.settings import CurveName, MeasureSettings
from dbh_studio.ui.forms import SettingsForm
from dbh_studio.ui.panels.base import Section, set_value

_BREAST_HEIGHTS = {"1.30 m (Europe, Canada)": 1.30, "1.37 m (USA)": 1.37, "1.40 m (New Zealand)": 1.40}
_OWN_HEIGHT = "own, set below"
_FIRST = (
    "curve", "breast_height_m", "base", "along", "above", "definition", "min_coverage_deg", "max_half_width",
    "band_below_m", "band_above_m",
)  # fmt: skip


class MeasuringSection(Section):
    """What most people choose takes effect at once; the rest is a form with a button."""

    def build(self) -> None:
        """Add the inputs."""
        gui, worker = self.gui, self.tab.worker
        self._height = gui.add_dropdown(
            "Breast height", (*_BREAST_HEIGHTS, _OWN_HEIGHT), hint="of every tree; takes effect at once"
        )
        worker.on_update(self._height, self._height_chosen)
        self._method = gui.add_dropdown(
            "Measured by", tuple(CURVE_TITLES.values()), hint="every tree of the plot; takes effect at once"
        )
        worker.on_update(self._method, self._method_chosen)
        self.tab.bridge.on("curve", self._curve_chosen)
        with gui.add_folder("How diameters are measured", expand_by_default=False):
            first = tuple(name for name in _FIRST if name in MeasureSettings.model_fields)
            self._form = SettingsForm(gui, self.tab.settings().measure, first=first)
            again = gui.add_button("Measure again", icon=viser.Icon.REFRESH, color="green")
            worker.on_click(again, self._measure_again)

    def refresh(self) -> None:
        """Show the settings as they are now."""
        measure = self.tab.settings().measure
        self._form.show(measure)
        known = {metres: title for title, metres in _BREAST_HEIGHTS.items()}
        set_value(self._height, known.get(measure.breast_height_m, _OWN_HEIGHT))
        set_value(self._method, CURVE_TITLES[measure.curve])

    def _measure_again(self) -> None:
        self._change("Change how diameters are measured", **self._form.read().model_dump())

    def _curve_chosen(self, curve: Any) -> None:
        if curve in get_args(CurveName) and curve != self.tab.settings().measure.curve:
            self._change(f"Measure by: {CURVE_TITLES[curve]}", curve=curve)
            # The buttons stand in the card of one tree.
            self.tab.worker.notify(
                f"Every tree is measured by {CURVE_TITLES[curve]} now",
                "Undo takes it back. For one tree alone: Correct this measurement, Method of this tree.",
            )

    def _method_chosen(self, title: str) -> None:
        self._curve_chosen(next(name for name, known in CURVE_TITLES.items() if known == title))

    def _height_chosen(self, title: str) -> None:
        if title in _BREAST_HEIGHTS:
            height = _BREAST_HEIGHTS[title]
            self._change(f"Measure at {height:.2f} m", breast_height_m=height)
        else:
            self.refresh()  # the choice stays what it was until a height is given
            self.tab.worker.notify("Your own breast height", "Open “How diameters are measured” and type it there.")

    def _change(self, label: str, **values: Any) -> None:
        command = commands.change_settings("measure", **values)
        self.tab.require_session().do(replace(command, label=label))
