"""Correcting trunks in one tab: the tool in hand, the chosen trees and points, and the bar in the picture."""

from __future__ import annotations

from collections.abc import Callable
from importlib import resources
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from dbh_studio.app.document import Document
from dbh_studio.app.edit_pool import middle_of, pool_of, prepare
from dbh_studio.app.edit_trial import effects_of
from dbh_studio.app.session import Change, Session
from dbh_studio.core.arrays import Int64
from dbh_studio.errors import CommandError
from dbh_studio.ui.bind import view_of
from dbh_studio.ui.bridge import js
from dbh_studio.ui.edit_actions import EditActions
from dbh_studio.ui.edit_bar import EditBar
from dbh_studio.ui.edit_focus import SLICE_M, EditFocus
from dbh_studio.ui.edit_plane import CutPlane
from dbh_studio.ui.edit_pointer import EditGestures
from dbh_studio.ui.edit_scene import EditScene
from dbh_studio.ui.edit_words import EditTool, effect_words

if TYPE_CHECKING:
    from dbh_studio.ui.tab import Tab

_NO_POINTS: Int64 = np.empty(0, np.int64)
BRUSH_M = (0.01, 1.0)
_BRUSH_STEP = 1.25


class EditDesk:
    """Only the tab's own worker thread calls it.

    Attributes:
        is_on: Whether the bar is open.
        tool: In hand.
        points: (K,) sorted indices of the selected points.
        is_giving: Whether the next tree that is clicked gets them.
        seen: The plot as this tab shows it.
        brush_m: Radius of the brush.
        effect: What the last edit did.
        note: What to look at, or what went wrong.
        on_change: Called when any of this is others now.
    """

    def __init__(self, tab: Tab) -> None:
        self._tab = tab
        self.scene = EditScene(tab.client)
        self.focus = EditFocus(tab, self.scene)
        self.act = EditActions(self)
        self.plane = CutPlane()
        self.is_on = False
        self.tool: EditTool = "click"
        self.points: Int64 = _NO_POINTS
        self.is_giving = False
        self.seen: Document | None = None
        self.brush_m = 0.1
        self.effect, self.note = "", ""
        self.on_change: Callable[[], None] = lambda: None
        self._tree: int | None = None
        self._told: Change | None = None
        self.bar = EditBar(self)
        bridge = tab.bridge
        files = resources.files("dbh_studio.ui")
        bridge.run(files.joinpath("edit_tools.js").read_text(encoding="utf-8"))
        self.run("style", files.joinpath("edit_style.css").read_text(encoding="utf-8"))
        bridge.on("edit", self._asked)
        bridge.on("edit-set", self._set, coalesce=True)
        self.gestures = EditGestures(self, tab)

    # ---- what the rest of the tab tells

    def plot_opened(self) -> None:
        """Another plot is shown, or none."""
        session = self._tab.session
        self.seen = session.document if session is not None else None
        self.is_on, self.tool, self.is_giving = False, "click", False
        self.points, self.effect, self.note = _NO_POINTS, "", ""
        self.focus.hides_others = self.focus.is_slice = False
        self.focus.forget()

    def plot_sent(self) -> None:
        """The picture was made anew."""
        self.scene.clear()
        self.focus.forget()
        if self._tab.studio.display is not None:
            self.scene.set_point_size(self._tab.studio.display.point_size)

    def follow(self, change: Change) -> None:
        """Say what a change did, whoever made it, before anything else is shown anew."""
        self.seen = change.after
        if change.before.trunks is change.after.trunks and change.before.trees is change.after.trees:
            return
        if change is not self._told and self.is_on:
            self._tell(change, "")
        if self._tree is None or not _is_same(change, self._tree):
            self.take_points(_NO_POINTS)

    def show(self) -> None:
        """Bring the bar in step; cheap where nothing changed."""
        selected = self.selected
        if selected != self._tree:
            self._tree = selected
            self.points, self.is_giving = _NO_POINTS, False
        self.bar.show()

    def draw(self) -> None:
        """Bring the picture in step: what is chosen, and what is hidden."""
        session = self._tab.session
        if session is None or self._tab.studio.display is None:
            return
        document = session.document
        points = session.points_world(document)
        visible = self.is_visible
        self.focus.draw(session, document, self.selected if visible else None)
        self.scene.show_chosen(points.take(self.points if visible else _NO_POINTS, axis=0))
        self.scene.show_also({i: points[document.trunks[i].points] for i in (self.chosen[1:] if visible else [])})
        has_plane = visible and self.tool == "plane" and self.selected is not None
        self.scene.show_plane(self.plane.corners() if has_plane else None)

    # ---- the state

    @property
    def session(self) -> Session:
        """The open plot; StudioError where none is."""
        return self._tab.require_session()

    @property
    def selected(self) -> int | None:
        """The chosen tree, if it is there."""
        session, selected = self._tab.session, self._tab.view.selected
        return selected if session is not None and selected in session.document.trunks else None

    @property
    def chosen(self) -> list[int]:
        """All chosen trees, the one whose card is shown in front."""
        selected = self.selected
        if selected is None:
            return []
        trunks = self.session.document.trunks
        return [selected, *(i for i in self._tab.view.chosen if i != selected and i in trunks)]

    @property
    def n_choices(self) -> int:
        """How often a tree was chosen in this tab, be it the same again."""
        return self._tab.view.n_inspected

    @property
    def is_visible(self) -> bool:
        """Whether the bar is in the picture."""
        return self.is_on and self._tab.view.step == "inspect" and self._tab.session is not None

    def choose(self, tree: int | None) -> None:
        """Choose a tree of the plot."""
        self._tab.select(tree)

    def open(self, tool: EditTool | None = None) -> None:
        """Open the bar, and take a tool in hand."""
        if not self.is_on:
            self.is_on, self.effect, self.note = True, "", ""
            prepare(self.session)
        if tool is not None:
            self._take(tool)
        self.changed()

    def close(self) -> None:
        """Close the bar; the plot is shown as it was."""
        self.is_on, self.tool, self.is_giving = False, "click", False
        self.points = _NO_POINTS
        self.focus.set(hides_others=False, is_slice=False)
        self.changed()

    def _take(self, tool: EditTool) -> None:
        was, self.tool = self.tool, tool
        self.is_giving, self.note, self.effect = False, "", ""
        if was == "plane" != tool:
            self.points = _NO_POINTS
        if tool == "plane":
            self._lay_plane()

    def step_back(self) -> None:
        """Escape: forget what was begun last."""
        if not self.is_visible:
            return
        if self.is_giving:
            self.is_giving = False
        elif len(self.points) and self.tool != "plane":
            self.points = _NO_POINTS
        elif len(self.chosen) > 1:
            self.choose(self.selected)
        elif self.tool != "click":
            self._take("click")
        else:
            self.close()
            return
        self.changed()

    def take_points(self, points: Int64) -> None:
        """Select these and no others."""
        self.points, self.is_giving = points, False

    def changed(self) -> None:
        """Show it: words first."""
        self.show()
        self.on_change()
        self._tab.client.flush()
        self.draw()

    # ---- what an edit did

    def done(self, change: Change, told: str) -> None:
        """Show at once what an edit of this tab did; all else follows when the session tells of it."""
        self.seen, self._told = change.after, change
        self.take_points(_NO_POINTS)
        self._tell(change, told)

    def _tell(self, change: Change, told: str) -> None:
        words = told or effect_words(effects_of(self.session, change)) or change.label
        done, _, rest = change.label.partition(": ")
        if rest and done in _WENT:
            words = f"{_WENT[done]} {words}" if words != change.label else f"{_WENT[done]} {rest}"
        self.effect, self.note = words, ""
        self.bar.show_effect()
        self._tab.client.flush()

    def add_note(self, note: str) -> None:
        """Say what must be looked at after an edit."""
        self.note = f"{note[:1].upper()}{note[1:]}."
        self.bar.show()

    # ---- what the page asks

    def _asked(self, payload: Any) -> None:
        """``[action, value]``, from a browser: anything may stand in it."""
        if not isinstance(payload, list) or len(payload) != 2 or not isinstance(payload[0], str):
            return
        self.do(payload[0], payload[1])

    def do(self, action: str, value: Any = None) -> None:
        """Do what a button or a key stands for; what is not possible now is said."""
        if self._tab.view.step != "inspect" or self._tab.session is None:
            return
        if action == "tool" and value in get_args(EditTool):
            self.open(value)
        elif action == "open":
            self.open()
        elif not self.is_on:
            return
        elif action == "close":
            self.close()
        elif action == "escape":
            self.step_back()
        elif action == "give":
            self._give()
        elif action == "enter":
            self._enter()
        elif action == "above":
            self._look_down()
        elif action == "number":
            self.run("type_number", self.selected)
        elif action == "call" and (number := _whole_number(value)) is not None:
            self.act.call(number)
        elif action == "restore" and (value is None or type(value) is int):
            self.act.restore(value)
        elif action in ("only", "others", "slice"):
            self._look(action)
        elif action in ("wider", "narrower"):
            self._resize(_BRUSH_STEP if action == "wider" else 1 / _BRUSH_STEP)
        elif action in _SIMPLE:
            getattr(self.act, _SIMPLE[action])()

    def _enter(self) -> None:
        if self.tool == "plane":
            self.act.cut_by_plane((self.plane.through, self.plane.normal))
            self.tool = "click"  # not `_take`, which forgets what was just said
            self.changed()
        else:
            self.act.make_new()

    def _give(self) -> None:
        if not len(self.points):
            raise CommandError("No points are selected.", "Draw round them with the lasso, or paint over them.")
        self.is_giving = True
        self.changed()

    def _look(self, action: str) -> None:
        if action == "only":
            self.focus.only_own = not self.focus.only_own
        elif action == "others":
            self.focus.set(hides_others=not self.focus.hides_others)
        else:
            self.focus.set(is_slice=not self.focus.is_slice)
        self.changed()

    def _look_down(self) -> None:
        """From so near that what is shown of the tree fills the picture."""
        session, tree = self.session, self.selected
        if tree is None:
            raise CommandError("No tree is chosen.", "Click a trunk first.")
        pool = self.focus.seen(session, session.document, tree)
        if len(pool):
            low, high = pool.points.min(axis=0).astype(float), pool.points.max(axis=0).astype(float)
            middle = (low + high) / 2
            wide, tall = float((high - low)[:2].max()), float(high[2] - low[2])
            least = 0.8 if session.document.scale.is_known else 0.0
            self._tab.scene.look_down(middle, max(2.0 * wide, least) + tall / 2)

    def _resize(self, factor: float) -> None:
        self.brush_m = float(np.clip(self.brush_m * factor, *BRUSH_M))
        self.changed()

    def _set(self, payload: Any) -> None:
        """``[what, value]`` of a slider."""
        if not isinstance(payload, list) or len(payload) != 2 or not isinstance(payload[1], (int, float, bool)):
            return
        what, value = payload[0], float(payload[1])
        if not self.is_visible or not abs(value) < 1e6:
            return
        if what == "brush":
            self.brush_m = float(np.clip(value / 100, *BRUSH_M))
        elif what == "slice":
            self.focus.slice_m = float(np.clip(value / 100, *SLICE_M))
        elif what in ("level", "degrees", "shift", "height") and self.tool == "plane":
            self.plane.set(what, value)
            self._select_beyond_plane()
        self.changed()

    # ---- planes

    def _lay_plane(self) -> None:
        """Through the middle of the chosen tree, along the line of sight: it is then seen as an upright line."""
        session, tree = self._tab.session, self.selected
        self.points = _NO_POINTS
        if session is None or tree is None:
            return
        document = session.document
        own = pool_of(session, document, [tree]).points
        stem = self._tab.stem(document, tree)
        ground = stem.z_ground_m if stem is not None and np.isfinite(stem.z_ground_m) else float(own[:, 2].min())
        self.plane.lay(own, ground, view_of(self._tab.client.camera).rotation[2])
        self._select_beyond_plane()

    def _select_beyond_plane(self) -> None:
        if self.selected is not None:
            pool = pool_of(self.session, self.session.document, [self.selected])
            self.points = pool.rows[self.plane.beyond(pool.points)]

    def at(self) -> list[float] | None:
        """(3,) where the chosen tree is, for the size of the brush on the screen."""
        if self._tab.session is None or self.selected is None:
            return None
        return [round(float(part), 3) for part in middle_of(self.session, self.session.document, self.selected)]

    def run(self, name: str, value: Any) -> None:
        """Call a function of the page's script."""
        self._tab.bridge.run(f"dbhEdit.{name}({js(value)})")


# How the session's labels of going back and forth begin → what is said of it.
_WENT = {"Undo": "Undone.", "Redo": "Done again."}
# What the page asks for → the action of the same meaning.
_SIMPLE = {
    "off": "take_off",
    "keep": "keep_only",
    "new": "make_new",
    "merge": "merge",
    "group": "group",
    "ungroup": "ungroup",
    "delete": "delete",
    "delete-key": "delete_by_key",
    "split": "split",
    "grow": "grow",
    "shrink": "shrink",
}


def _is_same(change: Change, tree: int) -> bool:
    """Whether a tree has the same points as before."""
    before, after = change.before.trunks, change.after.trunks
    return tree in before and tree in after and before[tree] is after[tree]


def _whole_number(value: Any) -> int | None:
    """The number typed for a tree; None where nothing was sent.

    Raises:
        CommandError: It is no number.
    """
    if isinstance(value, bool) or not isinstance(value, (str, int)):
        return None
    try:
        return int(str(value).strip()[:12])
    except ValueError:
        raise CommandError("That is no tree number.", "Type a whole number from 1.") from None
