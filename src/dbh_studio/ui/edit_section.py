"""Correcting trunks, the part in the panel: opens the tools, gives other numbers, brings deleted trunks back."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dbh_studio.app.document import Document
from dbh_studio.app.edit_trial import gone_trunks
from dbh_studio.ui.bridge import call, esc
from dbh_studio.ui.panels.base import Section, set_content, set_visible

if TYPE_CHECKING:
    from dbh_studio.ui.tab import Tab

_N_GONE = 6
_OPEN = "Correct trunks"
_INPUT = "dbh-call-number"


class EditSection(Section):
    """A folder of the Inspect step."""

    def __init__(self, tab: Tab) -> None:
        self._gone: tuple[Document, list[tuple[int, str]]] | None = None
        super().__init__(tab)

    def build(self) -> None:
        """Add the folder."""
        with self.gui.add_folder(_OPEN, visible=False) as self._folder:
            self._content = self.gui.add_html("")
        self.tab.editing.on_change = self.refresh

    def refresh(self) -> None:
        """Show what can be done now; cheap where nothing changed."""
        session, desk = self.tab.session, self.tab.editing
        set_visible(self._folder, session is not None)
        if session is None:
            return
        if not desk.is_on:
            set_content(self._content, closed_html(desk.selected))
            return
        document = session.document
        if self._gone is None or self._gone[0].trunks is not document.trunks:
            self._gone = document, [(i, label) for i, label, _ in gone_trunks(session)]
        set_content(self._content, open_html(desk.selected, self._gone[1]))


def closed_html(selected: int | None) -> str:
    """A button, and what it is good for."""
    which = "the trunks" if selected is None else f"tree {selected}"
    return (
        '<div class="dbh dbh-correct"><span class="muted">Merge, cut, add or delete trunks, take off what does not '
        f'belong.</span><div class="buttons"><button type="button" class="first" data-do="edit-open" '
        f'onclick="{call("edit", ["open", None])}">Correct {which}</button></div></div>'
    )


def open_html(selected: int | None, gone: list[tuple[int, str]]) -> str:
    """What the bar over the picture has no room for.

    Args:
        selected: The chosen tree.
        gone: (number, what took it away) of the trunks that can be brought back.
    """
    parts = ['<span class="muted">The tools are over the picture. Every step can be undone.</span>']
    if selected is not None:
        send = f"dbh('edit',['call',document.getElementById('{_INPUT}').value])"
        # Enter in the field is meant for it, not for the picture.
        on_enter = f"if(event.key==='Enter'){{event.stopPropagation();{send}}}"
        parts.append(
            f'<div class="buttons"><label for="{_INPUT}">Call tree {selected}</label>'
            f'<input type="number" min="1" step="1" id="{_INPUT}" onkeydown="{esc(on_enter)}">'
            f'<button type="button" data-do="edit-call" onclick="{esc(send)}">Change number</button></div>'
        )
    if gone:
        rows = "".join(
            f'<li><span>Tree {trunk_id} <span class="muted">{esc(label)}</span></span><button type="button" '
            f'data-restore="{trunk_id}" onclick="{call("edit", ["restore", trunk_id])}">Bring back</button></li>'
            for trunk_id, label in gone[:_N_GONE]
        )
        more = f'<span class="muted">and {len(gone) - _N_GONE} more</span>' if len(gone) > _N_GONE else ""
        parts.append(f"<b>Deleted</b><ul>{rows}</ul>{more}")
    return f'<div class="dbh dbh-correct">{"".join(parts)}</div>'
