"""Step 3: find the trunks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import viser

from dbh_studio.app import commands
from dbh_studio.core.chain_advice import title
from dbh_studio.ui import html
from dbh_studio.ui.candidates_section import CandidatesSection
from dbh_studio.ui.forms import SettingsForm
from dbh_studio.ui.masks_section import MasksSection
from dbh_studio.ui.panels.base import Panel, set_content, set_disabled, set_value, set_visible

_FIRST_GROUND = ("method", "cell_m")
_FIRST_TRUNKS = ("min_diameter_cm", "max_diameter_cm", "min_arc_deg", "trunk_top_m", "use_existing_ids")


class TrunksPanel(Panel):
    """One button; the settings behind it for those who need them."""

    step = "trunks"

    def build(self) -> None:
        """Add the inputs."""
        gui, settings = self.gui, self.tab.settings()
        self._state = gui.add_html("")
        self._filled = gui.add_html("", visible=False)
        self._button = gui.add_button("Find trunks", icon=viser.Icon.TREES, color="green")
        self.tab.worker.on_click(self._button, self._find)
        self.tab.chain.build(self._fill)
        self._masks = MasksSection(self.tab, self._keep_settings)
        self._candidates = CandidatesSection(self.tab)
        with gui.add_folder("Trunk settings", expand_by_default=False):
            self._trunks = SettingsForm(gui, settings.trunks, first=_FIRST_TRUNKS)
        with gui.add_folder("Ground settings", expand_by_default=False):
            self._ground = SettingsForm(gui, settings.ground, first=_FIRST_GROUND)

    def set_busy(self, busy: bool) -> None:
        """One job at a time."""
        set_disabled(self._button, busy)
        self._masks.set_busy(busy)

    def show(self, visible: bool) -> None:
        """Show or hide the step, and the masks in the photo with it."""
        super().show(visible)
        self.tab.masks.set_on(visible)

    def refresh(self) -> None:
        """Say what was found, and bring the settings in step."""
        session = self.tab.session
        self._masks.refresh()
        self._candidates.refresh()
        has_votes = self._masks.has_votes
        label = "Find trunks by geometry" if has_votes else "Find trunks"
        if self._button.label != label:
            self._button.label, self._button.color = label, "gray" if has_votes else "green"
        self.tab.chain.refresh()
        if session is None:
            set_content(self._state, html.message("Open a plot first."))
            return
        settings = session.document.settings
        self._ground.show(settings.ground)
        self._trunks.show(settings.trunks)
        n_trunks = len(session.document.trunks)
        if not session.document.scale.is_known:
            set_content(self._state, html.message("Set the scale first: trunk sizes are in metres.", level="stop"))
        elif n_trunks:
            notes = [("note", note, "") for note in self.tab.studio.segmentation_notes]
            found = html.message(
                f"{n_trunks} trunks found. You may change settings and find them again: a trunk found again keeps its "
                "number, and Undo brings the old ones back.",
                level="ok",
            )
            set_content(self._state, found + html.findings(notes))
        else:
            notes = [("warn", note, "") for note in self.tab.studio.segmentation_notes]
            set_content(self._state, html.findings(notes) if notes else "")

    def _fill(self, changes: Mapping[str, Any]) -> None:
        """Put values into the form, as if they had been typed; nothing is searched yet."""
        for name, value in changes.items():
            set_value(self._trunks.handle(name), value)

        def said(value: Any) -> str:
            return value if isinstance(value, str) else f"{value:,}"

        filled = " and ".join(f"{title(name)}: {said(value)}" for name, value in changes.items())
        set_content(self._filled, html.message(f"Filled in {filled}. Find the trunks again to try it.", level="ok"))
        set_visible(self._filled, True)

    def _find(self) -> None:
        self._keep_settings()
        self.tab.studio.find_trunks()

    def _keep_settings(self) -> None:
        """Take over what the forms say."""
        session = self.tab.require_session()
        ground, trunks = self._ground.read(), self._trunks.read()
        set_visible(self._filled, False)
        session.do(commands.change_settings("ground", **ground.model_dump()))
        session.do(commands.change_settings("trunks", **trunks.model_dump()))
