"""The keys with which trunks are corrected; they are in the page's palette of commands too."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from dbh_studio.ui.edit_words import TOOLS

if TYPE_CHECKING:
    from dbh_studio.ui.bind import TabWorker
    from dbh_studio.ui.edit_desk import EditDesk

# What it does, its key, what is held with it, what the desk is asked. Brackets, + and − are no keys to viser: the
# page's own script takes them.
_COMMANDS: tuple[tuple[str, str | None, str | None, str], ...] = (
    ("Correct: only this tree, or what is about it too", "I", None, "only"),
    ("Correct: hide the others", "O", None, "others"),
    ("Correct: slice at breast height", "U", None, "slice"),
    ("Correct: take the selected points off, or delete the trunk", "delete", None, "delete-key"),
    ("Correct: keep only the selected points", "delete", "shift", "keep"),
    ("Correct: make the selected points a new trunk, or cut by the plane", "enter", None, "enter"),
    ("Correct: give the selected points to another tree", "G", None, "give"),
    ("Correct: merge the chosen trunks", "M", None, "merge"),
    ("Correct: group the chosen stems as one tree", "M", "shift", "group"),
    ("Correct: ungroup", "U", "shift", "ungroup"),
    ("Correct: split automatically", "X", "shift", "split"),
    ("Correct: grow", None, None, "grow"),
    ("Correct: shrink", None, None, "shrink"),
    ("Correct: call the tree by another number", "R", "shift", "number"),
    ("Correct: bring back the trunk deleted last", "B", "shift", "restore"),
    ("Correct: clear the selection, put the tool away", "escape", None, "escape"),
    ("Correct: close the tools", None, None, "close"),
)


def add_edit_commands(worker: TabWorker, desk: EditDesk) -> None:
    """Add them to a tab. They do nothing in the other steps; while the bar is closed only a tool opens it."""
    for tool, (title, key, _) in TOOLS.items():
        _add(worker, f"Correct: {title.lower()}", key, None, partial(desk.do, "tool", tool))
    for label, own_key, modifier, action in _COMMANDS:
        _add(worker, label, own_key, modifier, partial(desk.do, action))


def _add(worker: TabWorker, label: str, key: str | None, modifier: str | None, action: Any) -> None:
    worker.add_command(label, action, hotkey=key, modifier=modifier)
