"""Step 4: one tree at a time: its number, its section, and the table of all."""

from __future__ import annotations

from typing import Any

from dbh_studio.app.document import Document
from dbh_studio.ui.attributes_section import AttributesSection
from dbh_studio.ui.card_section import CardSection
from dbh_studio.ui.correction_section import CorrectionSection
from dbh_studio.ui.edit_section import EditSection
from dbh_studio.ui.html import style_js
from dbh_studio.ui.measuring_section import MeasuringSection
from dbh_studio.ui.panels.base import Panel, Section
from dbh_studio.ui.review_section import ReviewSection
from dbh_studio.ui.tree_photos_section import TreePhotosSection
from dbh_studio.ui.tree_table import SORT_KEYS, TableRow, row_of, select_row_js, sort_rows, tree_table

_NONE_SHOWN = "No tree is of this kind. Press All above."


class InspectPanel(Panel):
    """The queue, the table, the card of the chosen tree, what a person says about it, and how it is measured.

    The table comes first and keeps its height, so that nothing jumps while one goes from tree to tree.
    """

    step = "inspect"

    def build(self) -> None:
        """Add the sections, in the order in which they stand."""
        tab = self.tab
        tab.bridge.run(style_js("inspect"))
        self.review = ReviewSection(tab)
        self._table = self.gui.add_html("")
        self._rows_shown: object = None
        self.card = CardSection(tab, self.review)
        self.correction = self.card.correction = CorrectionSection(tab)
        self.sections: tuple[Section, ...] = (
            self.review,
            self.card,
            self.correction,
            TreePhotosSection(tab),
            EditSection(tab),
            AttributesSection(tab),
            MeasuringSection(tab),
        )
        tab.bridge.on("row-add", self._row_added)
        tab.bridge.on("row-range", self._range_chosen)
        tab.bridge.on("sort", self._sort_chosen)

    def refresh(self) -> None:
        """Show the chosen tree and all trees as they are now."""
        for section in self.sections:
            section.refresh()
        self._refresh_table()

    def set_busy(self, busy: bool) -> None:
        """Lock what cannot be started while a job runs."""
        for section in self.sections:
            section.set_busy(busy)

    def leave_tree(self) -> None:
        """Keep what was typed about the tree that was on screen."""
        for section in self.sections:
            section.leave_tree()

    def _refresh_table(self) -> None:
        """Show all trees; those not measured yet are left for the next refresh."""
        view, rows = self.tab.view, self.rows()
        shown = (rows, view.sort_column, view.sort_descending, view.review_filter)
        if self._rows_shown != shown:
            self._rows_shown = shown
            self._table.content = tree_table(
                rows,
                selected=view.selected,
                column=view.sort_column,
                descending=view.sort_descending,
                several=view.several,
                **({} if view.review_filter == "all" else {"empty": _NONE_SHOWN}),
            )
        self.tab.bridge.run(select_row_js(view.selected, view.several))

    def rows(self) -> list[TableRow]:
        """A row for each tree that the filter lets through."""
        session = self.tab.session
        if session is None:
            return []
        document = session.document
        queue = {entry.tree_id: (rank, entry) for rank, entry in enumerate(self.review.queue())}
        waiting, rows = set(session.unmeasured(document)), []
        is_all = self.tab.view.review_filter == "all" or not queue  # without a queue there is nothing to press
        for trunk_id in document.trunks.ids:
            if trunk_id in waiting:
                rows.append(TableRow(trunk_id, None, "", None, "not measured yet", rank=len(queue)))
                continue
            rank, entry = queue.get(trunk_id, (0, None))
            if is_all or (entry is not None and self.review.is_shown(entry)):
                result = session.measurement(trunk_id, document=document).result
                rows.append(row_of(trunk_id, result, document.record(trunk_id), entry=entry, rank=rank))
        return rows

    # ---- choosing several

    def _row_added(self, payload: Any) -> None:
        document = self._document_with(payload)
        if document is None:
            return
        several = set(self.tab.view.chosen) ^ {payload}
        last = payload if payload in several else min(several, default=payload)
        self._choose(several or {payload}, last)

    def _range_chosen(self, payload: Any) -> None:
        document, view = self._document_with(payload), self.tab.view
        if document is None:
            return
        ids = [row.id for row in sort_rows(self.rows(), view.sort_column, descending=view.sort_descending)]
        if view.selected not in ids or payload not in ids:
            self._choose({payload}, payload)
            return
        first, last = sorted((ids.index(view.selected), ids.index(payload)))
        self._choose(set(ids[first : last + 1]), view.selected)

    def _choose(self, ids: set[int], current: int) -> None:
        self.tab.select(current, several=frozenset(ids) if len(ids) > 1 else frozenset())

    def _document_with(self, trunk_id: Any) -> Document | None:
        session = self.tab.session
        is_there = session is not None and isinstance(trunk_id, int) and trunk_id in session.document.trunks
        return session.document if session is not None and is_there else None

    def _sort_chosen(self, payload: Any) -> None:
        view = self.tab.view
        if payload not in SORT_KEYS:
            return
        if payload == view.sort_column:
            view.sort_descending = not view.sort_descending
        else:
            view.sort_column, view.sort_descending = payload, False
        self.tab.refresh()
