"""Every way to correct which points are whose, as commands: merge, split, add, assign, take off, renumber, group.

Ids are stable: a merged tree keeps the id it is merged into, the larger part of a split tree keeps its own, new parts
get new ids, and no id is given out twice.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.app.commands import Command, existing_trunk
from dbh_studio.app.document import Document
from dbh_studio.core.arrays import Int32
from dbh_studio.core.inventory import TreeRecord
from dbh_studio.core.trunk_edits import in_order, owners
from dbh_studio.core.trunks import MAX_TRUNK_ID, Trunk, TrunkSet
from dbh_studio.errors import CommandError

# A trunk of fewer points is nothing that could be seen, chosen or measured.
LEAST_POINTS = 3


def merge_trunks(ids: Iterable[int], into: int | None = None) -> Command:
    """Make one trunk of several. What was said of the one that stays is kept, and filled up from the others.

    Args:
        ids: Two or more.
        into: The id that stays; the lowest by default.
    """
    wanted = sorted(set(ids))

    def apply(document: Document) -> Document:
        kept = wanted[0] if into is None and wanted else into
        if len(wanted) < 2 or kept not in wanted:
            raise CommandError("Two or more trunks are needed to merge.", "Choose the trunks that are one stem.")
        trunks = [existing_trunk(document, trunk_id) for trunk_id in wanted]
        target = document.trunks[kept]
        points = in_order(*(trunk.points for trunk in trunks))
        after = document.trunks
        for trunk in trunks:
            after = after.without(trunk.id)
        records = [document.record(kept), *(document.record(i) for i in wanted if i != kept)]
        record = replace(_filled_up(records), edited=True)
        return _with(document, after.with_trunk(Trunk(kept, points, target.origin)), {kept: record})

    return Command(f"Merge trunks {_listed(wanted)}", apply)


def split_trunk(trunk_id: int, parts: Sequence[NDArray[Any]]) -> Command:
    """Make several trunks of one. The largest part keeps the id and what was said of it, the others get new ids.

    Args:
        trunk_id: Which.
        parts: Two or more disjoint sets of the trunk's points, indices into the cloud. Points in none of them are set
            free.
    """
    pieces = [in_order(part) for part in parts]

    def apply(document: Document) -> Document:
        trunk = existing_trunk(document, trunk_id)
        together = in_order(*pieces)
        at = trunk.points.searchsorted(together).clip(0, len(trunk) - 1)
        if len(together) != sum(map(len, pieces)) or not (trunk.points[at] == together).all():
            raise CommandError(
                f"The parts are not parts of trunk {trunk_id} as it is now.", "It was changed meanwhile: cut it again."
            )
        if len(pieces) < 2 or min(len(piece) for piece in pieces) < LEAST_POINTS:
            raise CommandError(
                f"The cut leaves all of trunk {trunk_id} on one side.", "Draw the line through the trunk."
            )
        order = sorted(range(len(pieces)), key=lambda i: (-len(pieces[i]), int(pieces[i][0])))
        after = document.trunks.without(trunk_id)
        after = after.with_trunk(Trunk(trunk_id, pieces[order[0]], trunk.origin))
        records = {trunk_id: replace(document.record(trunk_id), edited=True)}
        for i in order[1:]:
            new_id = _next_id(after)
            after = after.with_trunk(Trunk(new_id, pieces[i], "hand"))
            # A tag hangs on one stem; of which species and which tree it is holds for both.
            record = document.record(trunk_id)
            # What was said of how it is measured, and that it was looked at, was said of another stem.
            records[new_id] = replace(record, tag="", note="", edited=True, corrections=(), review=None)
        return _with(document, after, records)

    return Command(f"Split trunk {trunk_id}", apply)


def add_trunk(points: NDArray[Any], *, may_take: bool = False) -> Command:
    """Make a trunk of points.

    Args:
        points: (K,) indices into the cloud.
        may_take: Take points from other trunks; by default they are left where they are.
    """

    def apply(document: Document) -> Document:
        chosen = _inside(document, points)
        taken = owners(document.trunks, chosen, document.source.n_points)
        if may_take:
            after, records = _taken_from(document, taken)
        else:
            chosen = _minus(chosen, taken)
            after, records = document.trunks, {}
        if len(chosen) < LEAST_POINTS:
            others = f" All of it belongs to trunk {_listed(sorted(taken))}." if taken else ""
            raise CommandError(f"There is no trunk in what was selected.{others}", "Select more of the cloud.")
        new_id = _next_id(after)
        records[new_id] = TreeRecord(edited=True)
        return _with(document, after.with_trunk(Trunk(new_id, chosen, "hand")), records)

    return Command("Add a trunk", apply)


def assign_points(points: NDArray[Any], trunk_id: int) -> Command:
    """Give points to a trunk, whosever they are. A trunk that loses all of its points is gone."""

    def apply(document: Document) -> Document:
        target = existing_trunk(document, trunk_id)
        chosen = _inside(document, points)
        taken = owners(document.trunks, chosen, document.source.n_points)
        if len(taken.pop(trunk_id, ())) == len(chosen):
            return document
        after, records = _taken_from(document, taken)
        grown = Trunk(trunk_id, in_order(target.points, chosen), target.origin)
        records[trunk_id] = replace(document.record(trunk_id), edited=True)
        return _with(document, after.with_trunk(grown), records)

    return Command(f"Give points to trunk {trunk_id}", apply)


def drop_points(points: NDArray[Any], trunk_id: int | None = None) -> Command:
    """Take points off a trunk, or off whichever they belong to. A trunk that loses all of its points is gone."""

    def apply(document: Document) -> Document:
        if trunk_id is not None:
            existing_trunk(document, trunk_id)
        chosen = _inside(document, points)
        taken = owners(document.trunks, chosen, document.source.n_points)
        if trunk_id is not None:
            taken = {i: rows for i, rows in taken.items() if i == trunk_id}
        if not taken:
            return document
        after, records = _taken_from(document, taken)
        return _with(document, after, records)

    whose = f"trunk {trunk_id}" if trunk_id is not None else "trunks"
    return Command(f"Take points off {whose}", apply)


def keep_only(points: NDArray[Any], trunk_id: int) -> Command:
    """Take off a trunk what is not among the given points."""

    def apply(document: Document) -> Document:
        trunk = existing_trunk(document, trunk_id)
        off = np.setdiff1d(trunk.points, np.asarray(points, np.int32))
        return drop_points(off, trunk_id).apply(document) if len(off) else document

    return Command(f"Take points off trunk {trunk_id}", apply)


def delete_trunks(ids: Iterable[int]) -> Command:
    """Take trunks away. Their ids are not given out again."""
    wanted = sorted(set(ids))

    def apply(document: Document) -> Document:
        after = document.trunks
        for trunk_id in wanted:
            existing_trunk(document, trunk_id)
            after = after.without(trunk_id)
        return document if not wanted else _with(document, after, {})

    return Command(f"Delete trunk{'s' if len(wanted) != 1 else ''} {_listed(wanted)}", apply)


def renumber_trunk(trunk_id: int, new_id: int) -> Command:
    """Give a trunk another number, which must be free."""

    def apply(document: Document) -> Document:
        trunk = existing_trunk(document, trunk_id)
        if new_id == trunk_id:
            return document
        if new_id in document.trunks:
            raise CommandError(f"There is a trunk {new_id} already.", "Choose a number that is free.")
        if not 0 < new_id <= MAX_TRUNK_ID:
            raise CommandError(f"A trunk cannot have the number {new_id}.", "Choose a number from 1.")
        if any(i != trunk_id and each.tree_id == new_id for i, each in document.trees.items()):
            raise CommandError(f"Other stems go by the tree number {new_id}.", "Choose another, or group the stems.")
        after = document.trunks.without(trunk_id).with_trunk(replace(trunk, id=new_id))
        # The stems of a tree go by the number of one of them.
        moved = {
            i: replace(record, tree_id=new_id) for i, record in document.trees.items() if record.tree_id == trunk_id
        }
        own = moved.pop(trunk_id, document.record(trunk_id))
        return _with(document, after, {**moved, new_id: own})

    return Command(f"Call trunk {trunk_id} {new_id}", apply)


def group_stems(ids: Iterable[int]) -> Command:
    """Say that stems are of one tree, which goes by the lowest of their numbers."""
    wanted = sorted(set(ids))

    def apply(document: Document) -> Document:
        if len(wanted) < 2:
            raise CommandError("Two or more stems make a multi-stem tree.", "Choose its stems.")
        for trunk_id in wanted:
            existing_trunk(document, trunk_id)
        records = {i: replace(document.record(i), tree_id=wanted[0]) for i in wanted}
        if all(document.record(i) == record for i, record in records.items()):
            return document
        return _with(document, document.trunks, records)

    return Command(f"Group stems {_listed(wanted)} as one tree", apply)


def ungroup_stems(ids: Iterable[int]) -> Command:
    """Say that each stem is a tree of its own."""
    wanted = sorted(set(ids))

    def apply(document: Document) -> Document:
        for trunk_id in wanted:
            existing_trunk(document, trunk_id)
        records = {
            i: replace(document.record(i), tree_id=None) for i in wanted if document.record(i).tree_id is not None
        }
        for head in wanted:
            # A stem alone is the tree of its own number: those that went by it go by another now.
            left = sorted(i for i, each in document.trees.items() if each.tree_id == head and i not in wanted)
            new_head = left[0] if len(left) > 1 else None
            records |= {i: replace(document.record(i), tree_id=new_head) for i in left}
        return _with(document, document.trunks, records) if records else document

    return Command(f"Ungroup stems {_listed(wanted)}", apply)


# ---- parts of commands


def _with(document: Document, trunks: TrunkSet, records: Mapping[int, TreeRecord]) -> Document:
    """The document with other trunks; records of trunks that are gone go with them, empty ones are not kept."""
    trees = {i: record for i, record in {**document.trees, **records}.items() if i in trunks and record != TreeRecord()}
    return replace(document, trunks=trunks, trees=trees)


def _taken_from(document: Document, taken: Mapping[int, Int32]) -> tuple[TrunkSet, dict[int, TreeRecord]]:
    """The trunks without points, id → which, and the records of those that were changed."""
    trunks, records = document.trunks, {}
    for trunk_id, points in taken.items():
        left = np.setdiff1d(trunks[trunk_id].points, points, assume_unique=True)
        if len(left) < LEAST_POINTS:
            trunks = trunks.without(trunk_id)
        else:
            trunks = trunks.with_trunk(replace(trunks[trunk_id], points=left))
            records[trunk_id] = replace(document.record(trunk_id), edited=True)
    return trunks, records


def _filled_up(records: Sequence[TreeRecord]) -> TreeRecord:
    """The first record, with what it does not say taken from the others; notes are put one after another."""
    first, *others = records
    values: dict[str, Any] = {}
    for name in ("species", "status", "tag", "tree_id", "health", "crown_class"):
        if not getattr(first, name):
            values[name] = next((getattr(each, name) for each in others if getattr(each, name)), getattr(first, name))
    notes = dict.fromkeys(each.note for each in records if each.note)
    fields = {name: value for each in reversed(records) for name, value in each.fields}
    return replace(first, **values, note="; ".join(notes), fields=tuple(fields.items()))


def _inside(document: Document, points: NDArray[Any]) -> Int32:
    """Sorted and unique.

    Raises:
        CommandError: One is not of the cloud.
    """
    given = np.asarray(points, np.int64)
    if len(given) and (given.min() < 0 or given.max() >= document.source.n_points):
        raise CommandError("Points were selected that are not in the cloud.", "Select them again.")
    return in_order(given)


def _minus(points: Int32, taken: Mapping[int, Int32]) -> Int32:
    if not taken:
        return points
    return np.setdiff1d(points, np.concatenate(list(taken.values())), assume_unique=True)


def _next_id(trunks: TrunkSet) -> int:
    if trunks.next_id > MAX_TRUNK_ID:
        raise CommandError("There are no numbers left for a new trunk.", "Begin a new plot from the cloud.")
    return trunks.next_id


def _listed(ids: Sequence[int]) -> str:
    """``3``, ``3 and 5``, ``3, 5 and 8``; many are counted."""
    if len(ids) > 4:
        return f"{ids[0]}, {ids[1]} and {len(ids) - 2} more"
    *first, last = map(str, ids) if ids else ("none",)
    return f"{', '.join(first)} and {last}" if first else last
