"""What the studio says while trunks are corrected: what to do with a tool, what is chosen, what an edit did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from dbh_studio.app.edit_trial import TreeEffect
from dbh_studio.core.dbh import DbhEstimate, Refusal
from dbh_studio.ui import keys

EditTool = Literal["click", "rectangle", "lasso", "brush", "line", "plane", "add"]

# Tool → its name, its key, what it is for.
TOOLS: Mapping[EditTool, tuple[str, str, str]] = {
    "click": ("Click", "1", "Choose a trunk; Ctrl-click chooses further ones"),
    "rectangle": ("Rectangle", "2", "Select points by dragging a rectangle"),
    "lasso": ("Lasso", "3", "Select points by drawing round them"),
    "brush": ("Brush", "4", "Select points by painting over them"),
    "line": ("Cut by a line", "5", "Cut the trunk in two along a line you draw"),
    "plane": ("Cut by a plane", "6", "Cut the trunk in two by a plane you turn and move"),
    "add": ("Add a trunk", "7", "Click a stem that has no number yet"),
}
DRAWN: frozenset[EditTool] = frozenset({"rectangle", "lasso", "brush", "line"})
# The list of keys: (key, what it does), in the order in which they are learnt.
KEYS: tuple[tuple[str, str], ...] = (
    *((key, title) for title, key, _ in TOOLS.values()),
    ("Ctrl-click", "Choose a further trunk, or no longer"),
    ("Shift, Alt + draw", "Add to the selected points, take from them"),
    ("[  ]", "Smaller, larger brush"),
    ("I", "Only this tree, or also what is about it"),
    ("O", "Hide the others"),
    ("U", "Slice at breast height"),
    ("Delete", "Take the selected points off; with the tool Click and none selected, delete the trunk"),
    ("Shift+Delete", "Keep only the selected points"),
    ("Enter", "Make the selected points a new trunk; cut by the plane"),
    ("G", "Give the selected points to another tree: click it"),
    ("M", "Merge the chosen trunks"),
    ("Shift+M", "Group the chosen stems as one tree"),
    ("Shift+U", "Ungroup"),
    ("Shift+X", "Split automatically into the stems that are seen"),
    ("+  −", "Grow, shrink by 3 cm"),
    ("Shift+R", "Call the tree by another number"),
    ("Shift+B", "Bring back the trunk deleted last"),
    *keys.KEYS,
    ("Esc", "Clear the selection; put the tool away"),
)


def tool_hint(tool: EditTool, selected: int | None, *, only_own: bool) -> str:
    """What to do next with a tool."""
    if tool == "click":
        return (
            "Click the trunk to correct." if selected is None else "Ctrl-click a second trunk to merge or group them."
        )
    if tool == "add":
        return "Click a stem that has no number yet, about breast height."
    if tool in ("line", "plane") and selected is None:
        return "Click the trunk to cut first."
    turn = " The right mouse button turns the view."
    if tool == "line":
        return f"Draw a line through tree {selected} where it is to be cut.{turn}"
    if tool == "plane":
        return f"Turn and move the plane; the pink side of tree {selected} becomes a trunk of its own."
    whose = f"points of tree {selected}" if only_own and selected is not None else "points"
    how = {"rectangle": "Drag a rectangle round", "lasso": "Draw round", "brush": "Paint over"}[tool]
    return f"{how} {whose}. Shift adds, Alt takes away.{turn}"


def count_words(n_points: int) -> str:
    """``1 point``, ``12,345 points``."""
    return "1 point" if n_points == 1 else f"{n_points:,} points"


def trees_words(ids: Sequence[int]) -> str:
    """``Tree 3``, ``Trees 3, 5 and 8``."""
    if len(ids) == 1:
        return f"Tree {ids[0]}"
    return f"Trees {', '.join(map(str, ids[:-1]))} and {ids[-1]}" if ids else "No tree"


def effect_words(effects: Sequence[TreeEffect]) -> str:
    """What an edit did to the diameters: ``Tree 5: 31.2 → 29.8 cm``; empty where there is nothing to say."""
    return " · ".join(_of_tree(effect) for effect in effects)


def _of_tree(effect: TreeEffect) -> str:
    if not effect.is_there:
        was = f" (it was {_cm(effect.before)})" if isinstance(effect.before, DbhEstimate) else ""
        return f"Tree {effect.trunk_id} is gone{was}"
    if not effect.was_there:
        return f"New tree {effect.trunk_id}: {_cm(effect.after)}"
    before, after = effect.before, effect.after
    if isinstance(before, DbhEstimate) and isinstance(after, DbhEstimate):
        if f"{before.dbh_cm:.1f}" == f"{after.dbh_cm:.1f}":
            return f"Tree {effect.trunk_id}: still {_cm(after)}"
        return f"Tree {effect.trunk_id}: {before.dbh_cm:.1f} → {_cm(after)}"
    if isinstance(before, Refusal) and isinstance(after, Refusal):
        return f"Tree {effect.trunk_id}: still {_cm(after)}"
    return f"Tree {effect.trunk_id}: {_cm(before)} → {_cm(after)}"


def _cm(result: DbhEstimate | Refusal | None) -> str:
    if isinstance(result, DbhEstimate):
        return f"{result.dbh_cm:.1f} cm"
    if isinstance(result, Refusal):
        reason = result.reason.rstrip(".")
        return f"no diameter ({reason[:1].lower()}{reason[1:]})"
    return "not measured yet"
