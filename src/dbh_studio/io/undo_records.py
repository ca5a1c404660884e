"""What the undo log says of one step, as JSON and the points of trunks, and the way back to states of the plot.

A step says what it changed: fields by their saved form (`io.project_model`), trees by number, trunks by a number of the
log's own, under which the points of each trunk stand in the log once, however many states have it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from pydantic import Field

from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.tree_record import TreeRecord
from dbh_studio.core.trunks import Trunk, TrunkSet
from dbh_studio.io.history import HistoryEntry
from dbh_studio.io.project_model import (
    Model,
    PlotState,
    SavedCameras,
    SavedEvidence,
    SavedMasks,
    SavedScale,
    SavedTree,
    Text,
    UnitDirection,
    camera_place,
    saved_cameras,
)
from dbh_studio.settings import Settings

StepKind = Literal["do", "undo", "redo"]
Labelled = tuple[str, PlotState]

LOG_VERSION = 1
_PLAIN_FIELDS = ("plot_id", "up_direction", "north_direction", "origin_src", "settings")


@dataclass(frozen=True)
class UndoStates:
    """A plot and the states Undo and Redo lead to.

    Attributes:
        present: The plot as it is.
        past: What each command was called and the state before it, the latest last.
        future: What each undone command was called and the state after it, the next one last.
        number: How many things were ever done to the plot, Undo and Redo counted.
        next_id: The lowest trunk id never given out, undone commands included.
    """

    present: PlotState
    past: tuple[Labelled, ...] = ()
    future: tuple[Labelled, ...] = ()
    number: int = 0
    next_id: int = 1


class SavedChange(Model):
    """Fields of a plot that a step set; those it left alone are not set here either."""

    plot_id: Text = ""
    up_direction: UnitDirection = (0.0, 0.0, 1.0)
    north_direction: UnitDirection | None = None
    origin_src: tuple[float, float, float] = (0.0, 0.0, 0.0)
    settings: Settings | None = None
    scale: SavedScale | None = None
    evidence: SavedEvidence | None = None
    cameras: SavedCameras | None = None
    masks: SavedMasks | None = None
    # None: nothing is said about that tree any more.
    trees: dict[int, SavedTree | None] = Field(default_factory=dict)

    @classmethod
    def of(cls, before: PlotState | None, after: PlotState, folder: Path) -> SavedChange:
        """What leads from one state to the next; all of it, where there is none before."""
        values: dict[str, Any] = {
            name: getattr(after, name)
            for name in (*_PLAIN_FIELDS, "scale", "evidence", "cameras", "masks")
            if before is None or _differ(getattr(before, name), getattr(after, name))
        }
        if "scale" in values:
            values["scale"] = SavedScale(**asdict(after.scale))
        if "evidence" in values:
            values["evidence"] = SavedEvidence.of(after.evidence)
        if after.cameras is not None and "cameras" in values:
            values["cameras"] = saved_cameras(after.cameras, folder)
        if after.masks is not None and "masks" in values:
            values["masks"] = SavedMasks.of(after.masks, folder)
        trees = _changed_trees({} if before is None else before.trees, after.trees)
        if trees:
            values["trees"] = trees
        return cls(**values)

    def applied(self, state: PlotState, folder: Path) -> PlotState:
        """The state after the step, but for its trunks. Raises ValueError where it contradicts itself."""
        given = self.model_fields_set
        values: dict[str, Any] = {name: getattr(self, name) for name in _PLAIN_FIELDS if name in given}
        if "scale" in given and self.scale is not None:
            values["scale"] = ScaleEstimate(self.scale.metres_per_unit, self.scale.source, self.scale.standard_error)
        if "evidence" in given and self.evidence is not None:
            values["evidence"] = self.evidence.evidence()
        if "cameras" in given:
            values["cameras"] = None if self.cameras is None else camera_place(folder, self.cameras)
        if "masks" in given:
            values["masks"] = None if self.masks is None else self.masks.record(folder)
        if self.trees:
            trees = dict(state.trees)
            for trunk_id, tree in self.trees.items():
                if tree is None:
                    trees.pop(trunk_id, None)
                else:
                    trees[trunk_id] = tree.record()
            # One object for all states that share it: what did not change is told by identity.
            values["trees"] = MappingProxyType(trees)
        return replace(state, **values) if values else state


def _differ(before: Any, after: Any) -> bool:
    return before is not after and bool(before != after)


def _changed_trees(before: Mapping[int, TreeRecord], after: Mapping[int, TreeRecord]) -> dict[int, SavedTree | None]:
    if before is after:
        return {}
    changed: dict[int, SavedTree | None] = {i: None for i in before if i not in after}
    for trunk_id, record in after.items():
        if trunk_id not in before or _differ(before[trunk_id], record):
            changed[trunk_id] = SavedTree(**asdict(record))
    return changed


# ---- writing


@dataclass
class TrunkNumbers:
    """The number under which the log holds each trunk; by identity, for a changed trunk is another one.

    Attributes:
        of: The number of each.
        said: Those whose points the log holds.
        next_number: No trunk of the log ever had it.
    """

    of: dict[Trunk, int] = field(default_factory=dict)
    said: set[Trunk] = field(default_factory=set)
    next_number: int = 1

    def number(self, trunk: Trunk) -> int:
        """Its number, from now on."""
        if trunk not in self.of:
            self.of[trunk] = self.next_number
            self.next_number += 1
        return self.of[trunk]

    def only(self, states: UndoStates) -> TrunkNumbers:
        """Of the trunks of some states, all taken as said; a trunk that comes back later must be said again."""
        labelled = (*states.past, *states.future)
        trunks = {trunk for state in (states.present, *(each for _, each in labelled)) for trunk in state.trunks}
        return TrunkNumbers({trunk: self.number(trunk) for trunk in trunks}, trunks, self.next_number)

    def difference(self, before: Iterable[Trunk], after: Iterable[Trunk]) -> tuple[dict[str, Any], list[bytes]]:
        """What a step says of trunks, and the points of those the log has not held so far, which it does from now."""
        was, now = set(before), set(after)
        new = sorted(now - was - self.said, key=lambda trunk: trunk.id)
        said = {
            "new": [[self.number(trunk), trunk.id, trunk.origin, len(trunk)] for trunk in new],
            "came": sorted(self.number(trunk) for trunk in now - was),
            "gone": sorted(self.number(trunk) for trunk in was - now),
        }
        self.said.update(new)
        points = [trunk.points.astype("<i4", copy=False).tobytes() for trunk in new]
        return {name: value for name, value in said.items() if value}, points


def step_record(
    kind: StepKind,
    entry: HistoryEntry,
    before: PlotState,
    after: PlotState,
    *,
    next_id: int,
    folder: Path,
    numbers: TrunkNumbers,
) -> tuple[dict[str, Any], list[bytes]]:
    """What the log says of a step, and the points of the trunks it made.

    Args:
        kind: Undo and Redo need no more than their name.
        entry: Who did what and when, and its number in the plot.
        before: The state it led from.
        after: The state it led to.
        next_id: The lowest trunk id never given out, after it.
        folder: Of the plot.
        numbers: Of the trunks in the log.
    """
    about = {**asdict(entry), "kind": kind, "next_id": next_id}
    if kind != "do":
        return about, []
    change, points = _difference(before, after, folder, numbers)
    return {**about, **change}, points


def _difference(
    before: PlotState | None, after: PlotState, folder: Path, numbers: TrunkNumbers
) -> tuple[dict[str, Any], list[bytes]]:
    said: dict[str, Any] = {}
    changes = SavedChange.of(before, after, folder)
    if changes.model_fields_set:
        # Not `exclude_unset`, which would leave out of the settings what is as by default today.
        said["change"] = changes.model_dump(mode="json", include=changes.model_fields_set)
    if before is None or before.trunks is not after.trunks:
        trunks, points = numbers.difference(() if before is None else before.trunks, after.trunks)
        said["trunks"] = {**trunks, "next_id": after.trunks.next_id}
        return said, points
    return said, []


def records_of(
    states: UndoStates, folder: Path, numbers: TrunkNumbers, about: Mapping[str, Any]
) -> Iterable[tuple[dict[str, Any], list[bytes]]]:
    """A whole log: where it begins, the steps to the end of Redo, as many back, and a mark with the number."""
    # From the first state on; those of Redo stand the next one last.
    ahead = states.future[::-1]
    line = [state for _, state in states.past] + [states.present] + [state for _, state in ahead]
    labels = [label for label, _ in (*states.past, *ahead)]
    change, points = _difference(None, line[0], folder, numbers)
    yield {**about, "kind": "begin", "version": LOG_VERSION, **change}, points
    for label, before, after in zip(labels, line, line[1:], strict=False):
        change, points = _difference(before, after, folder, numbers)
        yield {"kind": "do", "what": label, **change}, points
    yield from (({"kind": "undo"}, []) for _ in ahead)
    yield {"kind": "mark", "number": states.number, "next_id": states.next_id}, []


# ---- reading


class Replay:
    """Follows the records of a log; `apply` each, in their order.

    Args:
        base: A state of the plot, for what the log does not say: where the cloud is.
        folder: Of the plot.
    """

    def __init__(self, base: PlotState, folder: Path) -> None:
        self._folder = folder
        self._base = base
        self._trunks: dict[int, Trunk] = {}
        self.present = base
        self.past: list[Labelled] = []
        self.future: list[Labelled] = []
        self.number = 0
        self.next_id = 1
        # What was done since the log was written anew, with its number.
        self.entries: list[HistoryEntry] = []

    def apply(self, record: Mapping[str, Any], points: memoryview) -> None:
        """Take one step. Raises ValueError, KeyError or TypeError where the record makes no sense."""
        kind = record["kind"]
        if kind == "begin":
            nothing = replace(self._base, trunks=TrunkSet(), trees=MappingProxyType({}))
            self.present = self._after(nothing, record, points)
        elif kind == "do":
            self.past.append((str(record["what"]), self.present))
            self.future.clear()
            self.present = self._after(self.present, record, points)
        elif kind == "undo":
            label, earlier = self.past.pop()
            self.future.append((label, self.present))
            self.present = earlier
        elif kind == "redo":
            label, later = self.future.pop()
            self.past.append((label, self.present))
            self.present = later
        elif kind != "mark":
            raise ValueError(f"it has a step of the kind {kind!r}")
        if "number" in record:
            number = int(record["number"])
            if kind != "mark" and number != self.number + 1:
                raise ValueError(f"step {number} follows step {self.number}")
            self.number = number
            self.next_id = max(self.next_id, int(record["next_id"]))
            entry = entry_of(record)
            if entry is not None:
                self.entries.append(entry)

    def numbers(self) -> TrunkNumbers:
        """Of the trunks, to go on writing the log."""
        trunks = {trunk: number for number, trunk in self._trunks.items()}
        return TrunkNumbers(trunks, set(trunks), max(self._trunks, default=0) + 1)

    def states(self) -> UndoStates:
        """Where it led to."""
        return UndoStates(self.present, tuple(self.past), tuple(self.future), self.number, self.next_id)

    def _after(self, state: PlotState, record: Mapping[str, Any], points: memoryview) -> PlotState:
        if "change" in record:
            state = SavedChange.model_validate(record["change"]).applied(state, self._folder)
        if "trunks" in record:
            state = replace(state, trunks=self._trunks_after(state.trunks, record["trunks"], points))
        if not set(state.trees) <= set(state.trunks.ids):
            raise ValueError("it describes trees that have no trunk")
        return state

    def _trunks_after(self, before: TrunkSet, said: Mapping[str, Any], points: memoryview) -> TrunkSet:
        self._take_new(said.get("new", ()), points)
        gone = {self._trunks[number] for number in said.get("gone", ())}
        came = [self._trunks[number] for number in said.get("came", ())]
        return TrunkSet((*(trunk for trunk in before if trunk not in gone), *came), int(said["next_id"]))

    def _take_new(self, new: Sequence[Any], points: memoryview) -> None:
        start = 0
        for number, trunk_id, origin, n in new:
            part = np.frombuffer(points, "<i4", int(n), start).astype(np.int32)
            start += 4 * int(n)
            if not len(part) or part[0] < 0 or part[-1] >= self._base.n_points:
                raise ValueError("it speaks of points the cloud does not have")
            self._trunks[int(number)] = Trunk(int(trunk_id), part, str(origin))


def entry_of(record: Mapping[str, Any]) -> HistoryEntry | None:
    """Who did what and when, of a step with a number; None of any other record."""
    number = record.get("number")
    if record["kind"] == "mark" or not isinstance(number, int):
        return None
    when, who, what = (str(record.get(name, "")) for name in ("when", "who", "what"))
    return HistoryEntry(when, who, what, number)


def within(states: UndoStates, *, max_steps: int, max_bytes: int) -> UndoStates:
    """The same plot with as many of its latest steps as fit: in number, and with the points of all their trunks."""
    seen: set[Trunk] = set()

    def n_new_bytes(state: PlotState) -> int:
        new = set(state.trunks) - seen
        seen.update(new)
        return sum(4 * len(trunk) for trunk in new)

    # What is and what can be redone stays, whatever it takes.
    n_bytes = sum(n_new_bytes(state) for state in (states.present, *(state for _, state in states.future)))
    kept = 0
    for _, state in states.past[::-1][:max_steps]:
        n_bytes += n_new_bytes(state)
        if n_bytes > max_bytes:
            break
        kept += 1
    return replace(states, past=states.past[len(states.past) - kept :])
