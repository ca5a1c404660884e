"""The bar over the picture with which trunks are corrected: tells the page's script what to show."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dbh_studio.ui.edit_words import DRAWN, KEYS, TOOLS, count_words, tool_hint, trees_words

if TYPE_CHECKING:
    from dbh_studio.ui.edit_desk import EditDesk

# A button: what it sends, its title, what it does.
Button = tuple[str, str, str]
_ON_POINTS: tuple[Button, ...] = (
    ("off", "Take off", "Take these points off the tree (Delete)"),
    ("keep", "Keep only these", "Take all other points off the tree (Shift+Delete)"),
    ("give", "Give to …", "Give these points to another tree: click it (G)"),
    ("new", "New trunk", "Make these points a trunk of their own (Enter)"),
    ("escape", "Clear", "Select nothing (Esc)"),
)
_ON_FREE_POINTS: tuple[Button, ...] = (
    ("new", "New trunk", "Make these points a trunk (Enter)"),
    ("give", "Give to …", "Give these points to a tree: click it (G)"),
    ("off", "Take off", "Take these points off whichever tree they belong to (Delete)"),
    ("escape", "Clear", "Select nothing (Esc)"),
)
_ON_TREES: tuple[Button, ...] = (
    ("merge", "Merge", "Make one trunk of these (M)"),
    ("group", "Group as one tree", "Stems of one tree, each with its own diameter (Shift+M)"),
    ("ungroup", "Ungroup", "Each a tree of its own (Shift+U)"),
    ("delete", "Delete", "Delete these trunks (Delete)"),
)
_ON_TREE: tuple[Button, ...] = (
    ("split", "Split automatically", "Into the stems that are seen in it (Shift+X)"),
    ("grow", "Grow", "Take in free points within 3 cm (+)"),
    ("shrink", "Shrink", "Take its rim off (−)"),
    ("ungroup", "Ungroup", "No longer a stem of that tree (Shift+U)"),
    ("delete", "Delete", "Delete this trunk (Delete)"),
)
_ON_PLANE: tuple[Button, ...] = (
    ("enter", "Cut here", "Cut the trunk in two (Enter)"),
    ("escape", "Cancel", "Put the plane away (Esc)"),
)


class EditBar:
    """Shows the state of a desk in the page; the same again is not sent twice."""

    def __init__(self, desk: EditDesk) -> None:
        self._desk = desk
        self._shown: dict[str, Any] | None = None

    def show(self) -> None:
        """Bring the bar in step."""
        state = self.state()
        if state != self._shown:
            self._shown = state
            self._desk.run("show", state)

    def show_effect(self) -> None:
        """Show what an edit did, before the rest."""
        self._desk.run("effect", self._desk.effect)
        if self._shown is not None:
            self._shown = {**self._shown, "effect": self._desk.effect}

    def state(self) -> dict[str, Any]:
        """What the page's script is told; empty where there is no bar."""
        desk = self._desk
        if not desk.is_visible:
            return {}
        what, buttons = self._chosen()
        focus, plane = desk.focus, desk.plane
        return {
            "tool": desk.tool,
            "tools": [[tool, title, key, tip] for tool, (title, key, tip) in TOOLS.items()],
            "draws": desk.tool in DRAWN and not desk.is_giving,
            "chosen": what,
            "buttons": [list(button) for button in buttons],
            "effect": desk.effect,
            "note": desk.note,
            "hint": self._hint(),
            "only": focus.only_own,
            "others": focus.hides_others,
            "slice": focus.is_slice,
            "sliceCm": round(100 * focus.slice_m),
            "brushCm": round(100 * desk.brush_m, 1),
            "hasTree": desk.selected is not None,
            "at": desk.at() if desk.tool == "brush" else None,
            "plane": None
            if desk.tool != "plane" or desk.selected is None
            else {
                "level": plane.is_level,
                "degrees": round(plane.degrees),
                "shift": round(plane.shift, 3),
                "height": round(plane.height, 2),
                "shift_limit": round(plane.limits()["shift"], 3),
                "low": round(plane.limits()["low"], 3),
                "high": round(plane.limits()["high"], 3),
            },
            "keys": [list(each) for each in KEYS],
        }

    def _hint(self) -> str:
        desk = self._desk
        if desk.is_giving:
            return "Click the tree that is to get the selected points, in the picture or in the table. Esc stops."
        return tool_hint(desk.tool, desk.selected, only_own=desk.focus.only_own)

    def _chosen(self) -> tuple[str, tuple[Button, ...]]:
        desk = self._desk
        selected, n_points = desk.selected, len(desk.points)
        if desk.tool == "plane" and selected is not None:
            n_own = len(desk.session.document.trunks[selected])
            return f"{n_points:,} of {count_words(n_own)} of tree {selected} on the pink side", _ON_PLANE
        if n_points:
            whose = f" · tree {selected}" if selected is not None else ""
            return f"{count_words(n_points)} selected{whose}", _ON_FREE_POINTS if selected is None else _ON_POINTS
        if len(desk.chosen) > 1:
            return trees_words(desk.chosen), _ON_TREES
        if selected is not None:
            is_grouped = self._is_grouped(selected)
            return trees_words([selected]), tuple(each for each in _ON_TREE if is_grouped or each[0] != "ungroup")
        return "No tree chosen", ()

    def _is_grouped(self, tree: int) -> bool:
        """Whether it goes with other stems as one tree."""
        document = self._desk.session.document
        head = document.record(tree).tree_id
        return head is not None or any(record.tree_id == tree for record in document.trees.values())
