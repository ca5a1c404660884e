"""One's own inventory taken back into the plot: first what would change, then the change. A part of the Export step."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import viser

from dbh_studio.app.inventory_import import ImportOptions, ImportPlan, apply_import, plan_import
from dbh_studio.errors import MisfitError, StaleResultError, StudioError
from dbh_studio.ui import html
from dbh_studio.ui.panels.base import set_content, set_disabled, set_value, set_visible, typed_path

if TYPE_CHECKING:
    from pathlib import Path

    from dbh_studio.app.document import Document
    from dbh_studio.app.jobs import Job
    from dbh_studio.app.session import Session
    from dbh_studio.core.progress import Progress
    from dbh_studio.ui.tab import Tab


class ImportSection:
    """Built at the GUI's current place, in a panel that brings it in step with the plot."""

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        self._shown_for: Session | None = None
        self._plan: tuple[Document, ImportPlan] | None = None
        self._said = ""
        gui, worker = tab.client.gui, tab.worker
        self._folder = gui.add_folder("Bring in my own table", expand_by_default=False, visible=False)
        with self._folder:
            self._path = gui.add_text(
                "Table (CSV)",
                "",
                hint="on the computer the studio runs on: an inventory that was exported here. Species, notes, tags, "
                "tape values and own columns are taken, diameters never",
            )
            self._skip = gui.add_checkbox("Leave out stems that do not fit", False)
            self._clear = gui.add_checkbox(
                "Empty cells clear", False, hint="an empty cell takes back what was said; else it says nothing"
            )
            self._look = gui.add_button("What would change?", icon=viser.Icon.TABLE_IMPORT, color="gray")
            worker.on_click(self._look, self._look_pressed)
            self._state = gui.add_html("")
            self._take = gui.add_button("Take it over", icon=viser.Icon.CHECK, color="green", visible=False)
            worker.on_click(self._take, self._take_pressed)
            for field in (self._path, self._skip, self._clear):
                worker.on_update(field, lambda _: self._forget())

    def refresh(self) -> None:
        """Show what was found, as long as it is of this plot."""
        session = self.tab.session
        set_visible(self._folder, session is not None and len(session.document.trunks) > 0)
        if session is not self._shown_for:
            self._shown_for, self._plan, self._said = session, None, ""
            set_value(self._path, "")
        set_visible(self._take, self._plan is not None and self._plan[1].command is not None)
        set_content(self._state, self._said)

    def set_busy(self, busy: bool) -> None:
        """One job at a time."""
        set_disabled(self._look, busy)
        set_disabled(self._take, busy)

    def _forget(self) -> None:
        """What was found is of another table, or was asked otherwise."""
        self._plan, self._said = None, ""
        self.refresh()

    def _look_pressed(self) -> None:
        session, path = self.tab.require_session(), typed_path(self._path.value)
        if path is None:
            raise StudioError("No table was named.", "Type the path of an inventory that was exported here.")
        options = ImportOptions(skip_misfits=bool(self._skip.value), clear_empty=bool(self._clear.value))
        document = session.document
        table: Path = path

        def work(_: Progress, __: Callable[[Job], object]) -> ImportPlan | MisfitError:
            try:
                return plan_import(session, table, options)
            except MisfitError as error:
                return error

        def done(found: ImportPlan | MisfitError) -> None:
            # It is called on the thread of the work; the page belongs to the tab's.
            self.tab.worker.post(self._found, document, found)

        self._plan, self._said = None, ""
        self.tab.studio.start_work("Reading the table", work, session, done)

    def _found(self, document: Document, found: ImportPlan | MisfitError) -> None:
        if isinstance(found, MisfitError):
            remedy = "Nothing was changed. Correct the table, or tick “Leave out stems that do not fit”."
            self._plan, self._said = None, html.message(found.problem, level="stop", remedy=remedy)
        else:
            notes = html.findings([("note", note, "") for note in found.notes])
            self._plan, self._said = (document, found), html.message(found.words) + (notes if found.notes else "")
        self.refresh()

    def _take_pressed(self) -> None:
        if self._plan is None:
            raise StudioError("Nothing was read yet.", "Press “What would change?” first.")
        (document, plan), self._plan = self._plan, None
        try:
            apply_import(self.tab.require_session(), document, plan)
        except StaleResultError as error:
            self._said = html.message(error.problem, level="stop", remedy="Press “What would change?” again.")
            self.refresh()
            return
        self._said = html.message(f"Taken over: {plan.n_changed} stems. Undo takes it back.", level="ok")
        self.refresh()
        self.tab.worker.notify("Table taken over", plan.words, "success")
