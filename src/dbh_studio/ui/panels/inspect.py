"""Step 4: one tree at a time: its number, its section, and the table of all."""

from __future__ import annotations

import viser

from dbh_studio.app import commands
from dbh_studio.core.dbh import DbhEstimate
from dbh_studio.core.inventory import TREE_STATUSES
from dbh_studio.errors import CommandError
from dbh_studio.ui import html
from dbh_studio.ui.forms import SettingsForm
from dbh_studio.ui.panels.base import Panel, set_content, set_value
from dbh_studio.ui.section_svg import CURVE_TITLES, section_svg

_STATUS_TITLES = {"": "not said", "live": "live", "dead": "dead"}


class InspectPanel(Panel):
    """The card of the chosen tree, what a person says about it, how it is measured, and the table."""

    step = "inspect"

    def build(self) -> None:
        """Add the inputs."""
        gui, worker = self.gui, self.tab.worker
        self._card = gui.add_html("")
        self._section = gui.add_html("")
        with gui.add_folder("About this tree", expand_by_default=False, visible=False) as self._about:
            self._species = gui.add_text("Species", "")
            self._status = gui.add_dropdown("Status", tuple(_STATUS_TITLES[status] for status in TREE_STATUSES))
            self._note = gui.add_text("Note", "")
            worker.on_click(gui.add_button("Keep", icon=viser.Icon.CHECK), self._keep_record)
            delete = gui.add_button("Delete this trunk", icon=viser.Icon.TRASH, color="red", hint="Undo brings it back")
            worker.on_click(delete, self._delete)
        self._table = gui.add_html("")
        with gui.add_folder("How diameters are measured", expand_by_default=False):
            self._form = SettingsForm(gui, self.tab.settings().measure)
            worker.on_click(gui.add_button("Measure again", icon=viser.Icon.REFRESH), self._measure_again)

    def refresh(self) -> None:
        """Show the chosen tree and all trees as they are now."""
        session = self.tab.session
        if session is not None:
            self._form.show(session.document.settings.measure)
        self.refresh_card()
        self.refresh_table()

    def refresh_card(self) -> None:
        """Show the chosen tree: text first, so that it is there before the picture has turned."""
        session, selected = self.tab.session, self.tab.view.selected
        if session is None or selected is None or selected not in session.document.trunks:
            self._about.visible = False
            set_content(self._card, html.message("Click a trunk in the picture, or a row below.") if session else "")
            set_content(self._section, "")
            return
        settings = session.document.settings.measure
        result = session.measurement(selected).result
        title = CURVE_TITLES.get(settings.curve, settings.curve)
        set_content(self._card, html.tree_card(selected, result, curve_title=title))
        picture = section_svg(result, curve=settings.curve)
        set_content(self._section, f'<div class="dbh">{picture}</div>' if picture else "")
        self._show_record(selected)

    def refresh_table(self) -> None:
        """Show all trees; those not measured yet are left for the next refresh."""
        view = self.tab.view
        rows = self.tab.table_rows()
        table = html.tree_table(rows, selected=view.selected, column=view.sort_column, descending=view.sort_descending)
        if self._rows_shown != (rows, view.sort_column, view.sort_descending):
            self._rows_shown = (rows, view.sort_column, view.sort_descending)
            self._table.content = table
        self.tab.bridge.run(html.select_row_js(view.selected))

    _rows_shown: object = None

    def _show_record(self, trunk_id: int) -> None:
        record = self.tab.require_session().document.record(trunk_id)
        self._about.visible = True
        for handle, value in (
            (self._species, record.species),
            (self._status, _STATUS_TITLES[record.status]),
            (self._note, record.note),
        ):
            set_value(handle, value)

    def _selected(self) -> int:
        if self.tab.view.selected is None:
            raise CommandError("No tree is chosen.", "Click a trunk first.")
        return self.tab.view.selected

    def _keep_record(self) -> None:
        status = next(key for key, title in _STATUS_TITLES.items() if title == self._status.value)
        values = {"species": self._species.value.strip(), "status": status, "note": self._note.value.strip()}
        self.tab.require_session().do(commands.set_tree_record(self._selected(), **values))

    def _delete(self) -> None:
        self.tab.require_session().do(commands.delete_trunk(self._selected()))

    def _measure_again(self) -> None:
        values = self._form.read().model_dump()
        self.tab.require_session().do(commands.change_settings("measure", **values))


def row_of(trunk_id: int, result: object, *, species: str, note: str) -> html.TableRow:
    """A table row of one measured stem."""
    said = ", ".join(text for text in (species, note) if text)
    if isinstance(result, DbhEstimate):
        remark = said or "; ".join(result.flags)
        return html.TableRow(trunk_id, result.dbh_cm, result.quality, result.section.coverage_deg, remark)
    reason = getattr(result, "reason", "")
    return html.TableRow(trunk_id, None, "", None, ", ".join(text for text in (said, reason) if text))
