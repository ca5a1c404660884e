"""What is done to the trunks of the plot from one tab: each action is one undoable command, and says what it did."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.app import editing, edits
from dbh_studio.app.commands import Command, restore_trunk
from dbh_studio.app.edit_trial import do_edit, gone_trunks
from dbh_studio.app.session import Change, Session
from dbh_studio.core.arrays import Float64, Int64
from dbh_studio.core.picking import View
from dbh_studio.core.trunks import Trunk
from dbh_studio.errors import CommandError

if TYPE_CHECKING:
    from dbh_studio.ui.edit_desk import EditDesk
    from dbh_studio.ui.edit_words import EditTool

Plane = tuple[Float64, Float64]


class EditActions:
    """Only the tab's own worker thread calls it; every method may raise a `CommandError` that says what to do."""

    def __init__(self, desk: EditDesk) -> None:
        self._desk = desk
        # What was chosen, and with which tool, when points were taken off last.
        self._took_off: tuple[Trunk | None, int, EditTool] | None = None

    # ---- on the selected points

    def take_off(self) -> None:
        """Take the selected points off the chosen tree, or off whosever they are."""
        points, tree = self._points(), self._desk.selected
        self._do(lambda _: edits.drop_points(points, tree), unchanged="None of the selected points belongs to it.")
        self._took_off = self._chosen_now()

    def keep_only(self) -> None:
        """Take everything but the selected points off the chosen tree."""
        points, tree = self._points(), self._tree()
        if not np.isin(points, self._desk.session.document.trunks[tree].points).any():
            raise CommandError(
                f"None of the selected points belongs to tree {tree}, so nothing of it would be left.",
                "Select the points of the tree that are right.",
            )
        self._do(lambda _: edits.keep_only(points, tree), unchanged="All of its points are selected.")
        self._took_off = self._chosen_now()

    def make_new(self) -> None:
        """Make a trunk of the selected points, whosever they were, and choose it."""
        points = self._points()
        self._choose_new(self._do(lambda _: edits.add_trunk(points, may_take=True)))

    def give_to(self, tree: int) -> None:
        """Give the selected points to another tree."""
        points = self._points()
        self._do(lambda _: edits.assign_points(points, tree), unchanged=f"They belong to tree {tree} already.")

    # ---- on trees

    def merge(self) -> None:
        """Make one trunk of the chosen ones; it goes by the lowest of their numbers."""
        ids = self._several("merge")
        self._do(lambda _: edits.merge_trunks(ids))
        self._desk.choose(min(ids))

    def group(self) -> None:
        """Say that the chosen stems are one tree."""
        ids = self._several("group")
        self._do(
            lambda _: edits.group_stems(ids),
            unchanged="They are one tree already.",
            told=f"Stems {_and(ids)} are one tree now, which goes by number {min(ids)}.",
        )

    def ungroup(self) -> None:
        """Say that each chosen stem is a tree of its own."""
        ids = self._chosen()
        self._do(
            lambda _: edits.ungroup_stems(ids),
            unchanged="No stems are grouped here.",
            told=f"{'Stem' if len(ids) == 1 else 'Stems'} {_and(ids)}: each a tree of its own now.",
        )

    def delete(self) -> None:
        """Take the chosen trunks away."""
        ids = self._chosen()
        self._do(lambda _: edits.delete_trunks(ids))

    def delete_by_key(self) -> None:
        """Take the selected points off; with none selected, delete the chosen trunks where they must be what is meant.

        With a tool that selects in hand the key is about points, and pressed twice it is pressed once too often.
        """
        desk = self._desk
        if len(desk.points) and desk.tool != "plane":
            self.take_off()
        elif desk.selected is not None and (desk.tool != "click" or self._took_off == self._chosen_now()):
            them = f"tree {desk.selected} itself" if len(desk.chosen) == 1 else "the trees themselves"
            desk.add_note(f"no points are selected. To delete {them}, press the button Delete")
        else:
            self.delete()

    def cut_by_line(self, view: View, first_xy: Float64, last_xy: Float64) -> None:
        """Cut the chosen trunk along a line on the screen."""
        tree = self._tree("Click the trunk to cut first.")
        self._do(lambda session: editing.split_by_line(session, tree, view, first_xy, last_xy))

    def cut_by_plane(self, plane: Plane) -> None:
        """Cut the chosen trunk along a plane: (3,) a point of it and (3,) its normal."""
        tree = self._tree("Click the trunk to cut first.")
        self._do(lambda session: editing.split_by_plane(session, tree, *plane))

    def split(self) -> None:
        """Part the chosen trunk into the stems that are seen in it."""
        tree = self._tree()
        self._do(lambda session: editing.split_by_stems(session, tree))

    def grow(self) -> None:
        """Let the free points next to the chosen trunk join it."""
        tree = self._tree()
        self._desk.session.require_scale()
        self._do(lambda session: editing.grow_trunk(session, tree))

    def shrink(self) -> None:
        """Take its rim off the chosen trunk."""
        tree = self._tree()
        self._desk.session.require_scale()
        self._do(lambda session: editing.shrink_trunk(session, tree), unchanged="It has no rim to take off.")

    def add_at(self, place: Float64) -> None:
        """Follow the stem at a place, (3,) world, and choose it."""
        self._desk.session.require_scale()
        notes: list[str] = []

        def make(session: Session) -> Command:
            command, note = editing.add_by_click(session, place)
            notes.append(note)
            return command

        self._choose_new(self._do(make))
        if notes and notes[0]:
            self._desk.add_note(notes[0])

    def call(self, number: int) -> None:
        """Give the chosen tree another number."""
        tree = self._tree()
        self._do(
            lambda _: edits.renumber_trunk(tree, number),
            unchanged=f"It is tree {number} already.",
            told=f"Tree {tree} is called {number} now.",
        )
        self._desk.choose(number)

    def restore(self, tree: int | None = None) -> None:
        """Bring back a trunk that was deleted; the last one by default."""
        gone = gone_trunks(self._desk.session)
        found = next(((i, earlier) for i, _, earlier in gone if tree is None or i == tree), None)
        if found is None:
            raise CommandError("There is no deleted trunk to bring back.", "Undo takes back the last thing you did.")
        trunk_id, earlier = found
        self._do(lambda _: restore_trunk(earlier, trunk_id))
        self._desk.choose(trunk_id)

    # ---- parts

    def _do(self, make: Callable[[Session], Command], *, unchanged: str = "", told: str = "") -> Change:
        """Do it and tell what it did."""
        session = self._desk.session
        change = do_edit(session, lambda: make(session), seen=self._desk.seen)
        if change.after is change.before:
            raise CommandError(f"Nothing was changed. {unchanged}".strip())
        self._desk.done(change, told)
        return change

    def _choose_new(self, change: Change) -> None:
        new = [i for i in change.after.trunks.ids if i not in change.before.trunks]
        if len(new) == 1:
            self._desk.choose(new[0])

    def _chosen_now(self) -> tuple[Trunk | None, int, EditTool]:
        """Another value once a tree is chosen (again), is changed, or another tool is in hand."""
        desk = self._desk
        trunk = None if desk.selected is None else desk.session.document.trunks[desk.selected]
        return trunk, desk.n_choices, desk.tool

    def _points(self) -> Int64:
        if not len(self._desk.points):
            raise CommandError("No points are selected.", "Draw round them with the lasso, or paint over them.")
        return self._desk.points

    def _tree(self, remedy: str = "Click a trunk first.") -> int:
        if self._desk.selected is None:
            raise CommandError("No tree is chosen.", remedy)
        return self._desk.selected

    def _chosen(self) -> list[int]:
        self._tree()
        return sorted(self._desk.chosen)

    def _several(self, what: str) -> list[int]:
        ids = self._chosen()
        if len(ids) < 2:
            raise CommandError(f"Two or more trunks are needed to {what}.", "Ctrl-click the further ones.")
        return ids


def _and(ids: list[int]) -> str:
    return f"{', '.join(map(str, ids[:-1]))} and {ids[-1]}" if len(ids) > 1 else str(ids[0])
