"""Step 4: one tree at a time: its number, its section, and the table of all."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, get_args

import viser

from dbh_studio.app import commands
from dbh_studio.app.document import Document
from dbh_studio.app.session import Session
from dbh_studio.core.dbh import DbhEstimate, Refusal
from dbh_studio.core.inventory import TREE_STATUSES, TreeRecord
from dbh_studio.core.stem_profile import ProfilePoint, breast_height_flag
from dbh_studio.errors import CommandError
from dbh_studio.settings import CurveName
from dbh_studio.ui import html
from dbh_studio.ui.candidates_section import flag_html
from dbh_studio.ui.forms import SettingsForm
from dbh_studio.ui.panels.base import Panel, set_content, set_value, set_visible
from dbh_studio.ui.profile_svg import profile_svg
from dbh_studio.ui.section_svg import section_svg

_STATUS_TITLES = {"": "not said", "live": "live", "dead": "dead"}
_BREAST_HEIGHTS = {"1.30 m (Europe, Canada)": 1.30, "1.37 m (USA)": 1.37, "1.40 m (New Zealand)": 1.40}
_OWN_HEIGHT = "own, set below"
_FIRST = (
    "curve", "breast_height_m", "definition", "min_coverage_deg", "max_half_width", "band_below_m", "band_above_m",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Compared:
    """One tree looked at more closely, in one state of the plot."""

    document: Document
    trunk_id: int
    result: DbhEstimate | Refusal
    profile: tuple[ProfilePoint, ...]
    height_m: float


class InspectPanel(Panel):
    """The table, the card of the chosen tree, what a person says about it, and how it is measured.

    The table comes first and keeps its height, so that nothing jumps while one goes from tree to tree.
    """

    step = "inspect"

    def build(self) -> None:
        """Add the inputs."""
        gui, worker = self.gui, self.tab.worker
        self._table = gui.add_html("")
        self._card = gui.add_html("")
        self._height = gui.add_dropdown(
            "Breast height", (*_BREAST_HEIGHTS, _OWN_HEIGHT), hint="of every tree; takes effect at once"
        )
        worker.on_update(self._height, self._height_chosen)
        self._method = gui.add_dropdown(
            "Measured by", tuple(html.CURVE_TITLES.values()), hint="every tree of the plot; takes effect at once"
        )
        worker.on_update(self._method, self._method_chosen)
        self.tab.bridge.on("curve", self._curve_chosen)
        self.tab.bridge.on("compare", self._compare)
        with gui.add_folder("About this tree", expand_by_default=False, visible=False) as self._about:
            self._species = gui.add_text("Species", "")
            self._status = gui.add_dropdown("Status", tuple(_STATUS_TITLES[status] for status in TREE_STATUSES))
            self._note = gui.add_text("Note", "")
            worker.on_click(gui.add_button("Keep", icon=viser.Icon.CHECK, color="green"), self._keep_record)
            delete = gui.add_button("Delete this trunk", icon=viser.Icon.TRASH, color="red", hint="Undo brings it back")
            worker.on_click(delete, self._delete)
        with gui.add_folder("How diameters are measured", expand_by_default=False):
            self._form = SettingsForm(gui, self.tab.settings().measure, first=_FIRST)
            again = gui.add_button("Measure again", icon=viser.Icon.REFRESH, color="green")
            worker.on_click(again, self._measure_again)

    def refresh(self) -> None:
        """Show the chosen tree and all trees as they are now."""
        measure = self.tab.settings().measure
        self._form.show(measure)
        known = {metres: title for title, metres in _BREAST_HEIGHTS.items()}
        set_value(self._height, known.get(measure.breast_height_m, _OWN_HEIGHT))
        set_value(self._method, html.CURVE_TITLES[measure.curve])
        self.refresh_card()
        self.refresh_table()

    def refresh_card(self) -> None:
        """Show the chosen tree: text first, so that it is there before the picture has turned."""
        session, selected = self.tab.session, self.tab.view.selected
        document = session.document if session is not None else None
        if document is None or selected is None or selected not in document.trunks:
            set_visible(self._about, False)
            set_content(self._card, html.no_tree_card() if document and len(document.trunks) else "")
            self._record_shown = None
            return
        stem = self.tab.stem(document, selected)
        if stem is None:
            set_content(self._card, html.waiting_card(selected))
        else:
            compared = self._compared
            result, profile = stem.result, ""
            if compared is not None and compared.document is document and compared.trunk_id == selected:
                result, profile = compared.result, profile_svg(compared.profile, height_m=compared.height_m)
            picture = section_svg(result, curve=document.settings.measure.curve) + profile
            scale = html.scale_words(document.scale)
            card = html.tree_card(selected, result, section=picture, scale=scale)
            set_content(self._card, card + flag_html(selected, document.record(selected).flag))
        self._show_record(document, selected)

    def refresh_table(self) -> None:
        """Show all trees; those not measured yet are left for the next refresh."""
        view = self.tab.view
        rows = self.tab.table_rows()
        if self._rows_shown != (rows, view.sort_column, view.sort_descending):
            self._rows_shown = (rows, view.sort_column, view.sort_descending)
            self._table.content = html.tree_table(
                rows, selected=view.selected, column=view.sort_column, descending=view.sort_descending
            )
        self.tab.bridge.run(html.select_row_js(view.selected))

    def _compare(self, _: Any = None) -> None:
        """Measure the chosen tree by every method and all along the stem, for the pictures."""
        session, selected = self.tab.require_session(), self._selected()
        document = session.document
        if not document.scale.is_known or selected not in document.trunks:
            return
        result = session.compared(selected, document=document).result
        profile = session.profile(selected, document=document)
        height_m = document.settings.measure.breast_height_m
        if isinstance(result, DbhEstimate):
            flag = breast_height_flag(profile, height_m, result.diameters[result.definition])
            if flag is not None:
                result = replace(result, flags=(*result.flags, flag.words), flag_codes=(*result.flag_codes, flag.code))
        self._compared = _Compared(document, selected, result, profile, height_m)
        self.refresh_card()

    _compared: _Compared | None = None
    _rows_shown: object = None
    _record_shown: tuple[Session, int, TreeRecord] | None = None

    def _show_record(self, document: Document, trunk_id: int) -> None:
        """Show what is said about a tree, unless it is there: a refresh must not take what is being typed."""
        shown = (self.tab.require_session(), trunk_id, document.record(trunk_id))
        set_visible(self._about, True)
        if shown == self._record_shown:
            return
        self._record_shown = shown
        record = shown[2]
        for handle, value in (
            (self._species, record.species),
            (self._status, _STATUS_TITLES[record.status]),
            (self._note, record.note),
        ):
            set_value(handle, value)

    def leave_tree(self) -> None:
        """Keep what was typed about the tree that was on screen, as the button Keep does."""
        session, shown = self.tab.session, self._record_shown
        if session is None or shown is None:
            return
        shown_session, trunk_id, record = shown
        is_same_plot = shown_session is session and trunk_id in session.document.trunks
        if is_same_plot and not session.is_read_only and replace(record, **self._typed()) != record:
            session.do(commands.set_tree_record(trunk_id, **self._typed()))

    def _selected(self) -> int:
        if self.tab.view.selected is None:
            raise CommandError("No tree is chosen.", "Click a trunk first.")
        return self.tab.view.selected

    def _typed(self) -> dict[str, Any]:
        status = next(key for key, title in _STATUS_TITLES.items() if title == self._status.value)
        return {"species": self._species.value.strip(), "status": status, "note": self._note.value.strip()}

    def _keep_record(self) -> None:
        self.tab.require_session().do(commands.set_tree_record(self._selected(), **self._typed()))

    def _delete(self) -> None:
        self.tab.require_session().do(commands.delete_trunk(self._selected()))

    def _measure_again(self) -> None:
        self._change("Change how diameters are measured", **self._form.read().model_dump())

    def _curve_chosen(self, curve: Any) -> None:
        if curve in get_args(CurveName):
            self._change(f"Measure by: {html.CURVE_TITLES[curve]}", curve=curve)

    def _method_chosen(self, title: str) -> None:
        self._curve_chosen(next(name for name, known in html.CURVE_TITLES.items() if known == title))

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


def row_of(trunk_id: int, result: object, *, species: str, note: str) -> html.TableRow:
    """A table row of one measured stem."""
    said = ", ".join(text for text in (species, note) if text)
    if isinstance(result, DbhEstimate):
        remark = said or html.plain("; ".join(result.flags))
        return html.TableRow(trunk_id, result.dbh_cm, result.quality, result.section.coverage_deg, remark)
    reason = getattr(result, "reason", "")
    return html.TableRow(trunk_id, None, "", None, ", ".join(text for text in (said, html.plain(reason)) if text))
