"""What the pointer does to the picture while trunks are corrected: clicks that choose, drawings that select and cut."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dbh_studio.app.edit_pool import Pool, pool_in_view
from dbh_studio.core.arrays import Float64, Int64
from dbh_studio.core.picking import View
from dbh_studio.errors import CommandError
from dbh_studio.ui.bind import SceneClick
from dbh_studio.ui.edit_gesture import Gesture, gesture_of
from dbh_studio.ui.edit_words import DRAWN

if TYPE_CHECKING:
    from dbh_studio.ui.edit_desk import EditDesk
    from dbh_studio.ui.tab import Tab

# About what is drawn with no tree chosen, parts of the picture.
_MARGIN = 0.05


class EditGestures:
    """Takes them for the desk of a tab. Only the tab's own worker thread calls it."""

    def __init__(self, desk: EditDesk, tab: Tab) -> None:
        self._desk = desk
        self._tab = tab
        tab.bridge.on("edit-draw", self._drawn)
        for modifier in ("cmd/ctrl", "shift"):
            tab.worker.on_scene_click(tab.client, self._also_clicked, modifier=modifier)

    def scene_clicked(self, click: SceneClick) -> bool:
        """Take a click in the picture; False where it may choose a tree as it always does."""
        if not self._desk.is_visible:
            return False
        if self._desk.tool == "add" and not self._desk.is_giving:
            self._add_at(click)
            return True
        if not (self._desk.focus.is_alone or self._desk.is_giving):
            return False
        tree = self._trunk_at(click)
        if tree is not None:
            self._tree_clicked(tree)
        return True

    def tree_clicked(self, tree: int) -> bool:
        """Take a click on a row of the table; False where it may choose the tree."""
        if not (self._desk.is_visible and self._desk.is_giving):
            return False
        self._tree_clicked(tree)
        return True

    def _tree_clicked(self, tree: int) -> None:
        if not self._desk.is_giving:
            self._desk.choose(tree)
        elif tree == self._desk.selected:
            raise CommandError("They are to go to another tree.", "Click that one, or press Esc.")
        else:
            self._desk.act.give_to(tree)

    def _trunk_at(self, click: SceneClick) -> int | None:
        """The tree under the cursor, of those that are not hidden."""
        session = self._desk.session
        display = self._tab.studio.display
        if not self._desk.focus.is_alone or self._desk.selected is None:
            if display is None:
                return None
            hit = display.picking.pick(click.ray_origin, click.ray_direction, click.view.pixel_angle_rad)
            return None if hit is None else display.trunk_under(hit, session.document.trunks)
        pool = self._desk.focus.seen(session, session.document, self._desk.selected)
        hit = pool.picking.pick(click.ray_origin, click.ray_direction, click.view.pixel_angle_rad)
        if hit is None:
            return None
        surface = Pool(pool.rows[hit.surface], pool.points[hit.surface])
        ids, counts = np.unique(surface.owners(session.document.trunks, session), return_counts=True)
        tree = int(ids[counts.argmax()])
        return tree or None

    def _also_clicked(self, click: SceneClick) -> None:
        if self._tab.view.step == "inspect" and self._tab.session is not None:
            tree = self._trunk_at(click)
            if tree is not None:
                self._also(tree)

    def _also(self, tree: int) -> None:
        """Choose a further tree, or no longer."""
        ids = {*self._desk.chosen} ^ {tree}
        current = self._desk.selected if self._desk.selected in ids else min(ids, default=None)
        self._tab.select(current, several=frozenset(ids) if len(ids) > 1 else frozenset())
        self._desk.open()

    def _add_at(self, click: SceneClick) -> None:
        display = self._tab.studio.display
        if display is None:
            return
        hit = display.picking.pick(click.ray_origin, click.ray_direction, click.view.pixel_angle_rad)
        if hit is None:
            raise CommandError("There is no point of the cloud there.", "Click on the stem itself.")
        self._desk.act.add_at(click.ray_origin + hit.depth * click.ray_direction)

    def _drawn(self, payload: Any) -> None:
        gesture, tool = gesture_of(payload), self._desk.tool
        if gesture is None or not self._desk.is_visible or tool not in DRAWN or gesture.tool != tool:
            self._tab.bridge.run("dbhEdit.taken()")
            return
        try:
            self._use(gesture)
        finally:
            self._tab.bridge.run("dbhEdit.taken()")
            self._tab.client.flush()

    def _use(self, gesture: Gesture) -> None:
        if gesture.tool == "brush":
            self._brushed(gesture)
        elif gesture.is_click:
            self._tab.click_scene(_click_of(gesture))
        elif gesture.tool == "line":
            self._desk.act.cut_by_line(gesture.view, gesture.path[0], gesture.path[-1])
        else:
            pool = self._pool(gesture.view, gesture.path)
            if gesture.tool == "lasso":
                found = pool.lasso(gesture.view, gesture.path)
            else:
                found = pool.rectangle(gesture.view, gesture.path[0], gesture.path[-1])
            self._combine(found, gesture)

    def _brushed(self, gesture: Gesture) -> None:
        unit = 1.0 if self._desk.session.document.scale.is_known else self._unit()
        pool = self._pool(gesture.view, gesture.path)
        self._combine(pool.brushed(gesture.view, gesture.path, self._desk.brush_m * unit), gesture)

    def _unit(self) -> float:
        """What counts as a metre in a cloud without a scale: a tenth of the width of the plot."""
        display = self._tab.studio.display
        return 0.1 if display is None else 0.1 * display.centre_and_radius()[1]

    def _pool(self, view: View, path: Float64) -> Pool:
        session, tree = self._desk.session, self._desk.selected
        document = session.document
        if tree is not None:
            return self._desk.focus.pool(session, document, tree)
        corners = np.stack([path.min(axis=0) - _MARGIN, path.max(axis=0) + _MARGIN])
        return pool_in_view(session, document, view, corners)

    def _combine(self, found: Int64, gesture: Gesture) -> None:
        """Take found points in place of those selected, to them, or from them."""
        before = self._desk.points
        if gesture.mode == "take":
            self._desk.take_points(np.setdiff1d(before, found, assume_unique=True))
        elif gesture.mode == "add" or gesture.tool == "brush":
            self._desk.take_points(np.union1d(before, found))
        else:
            self._desk.take_points(found)
        self._desk.note = self._desk.effect = ""
        if not len(self._desk.points) and gesture.is_end:
            own = self._desk.selected is not None and self._desk.focus.only_own
            self._desk.note = f"No points of tree {self._desk.selected} were there." if own else "No points were there."
            if own:
                self._desk.note += " Turn off “Only this tree” to select others too."
        self._desk.changed()


def _click_of(gesture: Gesture) -> SceneClick:
    xy = gesture.path[0]
    return SceneClick(gesture.view.origin, gesture.view.ray(xy), (float(xy[0]), float(xy[1])), None, gesture.view)
