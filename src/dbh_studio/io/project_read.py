"""Reading a saved plot, see `io.project`. Nothing is written, whatever is found."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.scale_evidence import ScaleEvidence
from dbh_studio.core.tree_record import TreeRecord
from dbh_studio.core.trunks import Trunk, TrunkSet
from dbh_studio.errors import ProjectError, ProjectVersionError
from dbh_studio.io.history import HistoryEntry
from dbh_studio.io.project_model import (
    SCHEMA_VERSION,
    PlotState,
    SavedEvidence,
    SavedProject,
    SavedTree,
    SavedUndo,
    camera_place,
    locate,
    migrated,
)
from dbh_studio.io.undo_log import UNDO_FILE, ForeignLogError, LogEnd, replayed
from dbh_studio.io.undo_records import Replay, UndoStates

FOLDER_SUFFIX = ".dbh"
PROJECT_FILE = "project.json"

_COMPARED = ("plot_id", "up_direction", "north_direction", "origin_src", "scale", "settings", "evidence")
_TRUNK_ARRAYS = ("ids", "ends", "points", "origins")
# How often a reader beside a busy writer looks again before it gives up.
_N_LOOKS = 10


def is_project(path: Path | str) -> bool:
    """Whether `path` is a saved plot, or looks like one that has lost its project.json."""
    path = Path(path)
    # os.path, not pathlib: that one raises where a name is too long or a folder may not be entered.
    if not os.path.isdir(path):  # noqa: PTH112
        return False
    return path.suffix == FOLDER_SUFFIX or os.path.exists(path / PROJECT_FILE)  # noqa: PTH110


# ---- reading


@dataclass(frozen=True, eq=False)
class SavedPlot:
    """What a saved plot holds, with the states Undo and Redo lead to.

    Attributes:
        states: The plot, its past and its future.
        lost: What cannot be had any more, in plain words; empty where the plot is whole.
        found: What was brought back of a plot that was not closed; while another program writes it, no more than that.
        recovered: Who did what, as far as the undo log says so; the history may lack the last of it.
        is_at_hand: Whether nothing was done after the plot itself was saved last.
        saved_trunks: The trunks the file of the trunks holds.
        trunks_file: Its name.
        log: The undo log as it was followed; None where it cannot be gone on with.
    """

    states: UndoStates
    saved_trunks: TrunkSet
    trunks_file: str
    lost: tuple[str, ...] = ()
    found: tuple[str, ...] = ()
    recovered: tuple[HistoryEntry, ...] = ()
    log: FollowedLog | None = None
    is_at_hand: bool = True

    @property
    def notes(self) -> tuple[str, ...]:
        """All there is to say, in plain words; empty where the plot was closed and is whole."""
        return (*self.found, *self.lost)


@dataclass(frozen=True, eq=False)
class FollowedLog:
    """An undo log that was read: which, what it told, where it ends."""

    log_id: str
    replay: Replay
    end: LogEnd


def read_project(folder: Path | str) -> PlotState:
    """Read a saved plot, which another process may be writing. Nothing is written, whatever is found.

    Raises:
        ProjectVersionError: It was saved by a newer program.
        ProjectError: A file is missing or damaged; says which.
    """
    states = read_plot(folder).states
    present = states.present
    # Of numbers given out and undone only the undo log may know.
    return replace(present, trunks=replace(present.trunks, next_id=max(present.trunks.next_id, states.next_id)))


def read_plot(folder: Path | str) -> SavedPlot:
    """As `read_project`, with what Undo and Redo lead to. A damaged undo log never keeps a plot from being read."""
    folder = Path(folder).absolute()
    saved, trunks = _read_whole(folder)
    state = _state(folder, saved, trunks)
    number = saved.undo.number if saved.undo is not None else 0
    as_saved = SavedPlot(UndoStates(state, number=number, next_id=saved.next_id), trunks, saved.trunks_file)
    return as_saved if saved.undo is None else _with_log(folder, as_saved, saved.undo)


def _with_log(folder: Path, as_saved: SavedPlot, undo: SavedUndo) -> SavedPlot:
    """The plot with all that its undo log says; as it was saved, where that is nothing."""
    state = as_saved.states.present
    try:
        replay, at_save, end = replayed(folder / UNDO_FILE, undo.log, state, undo.number)
        if replay.number < undo.number:
            raise ForeignLogError("it ends before the plot was saved", end.lost)
        if at_save is not None and not _is_same(at_save, state):
            raise ForeignLogError("it tells another story than the plot")
        if replay.number > undo.number and _share_points(replay.present.trunks, state.n_points):
            raise ForeignLogError("it makes two trunks share points", tuple(replay.entries))
    except (OSError, ForeignLogError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        note = f"What was done before cannot be undone any more, because {UNDO_FILE} cannot be used ({reason})."
        lost = error.lost if isinstance(error, ForeignLogError) else ()
        return replace(as_saved, lost=(f"{note} The plot is as it was saved last.{_lost(lost, undo.number)}",))
    states = replay.states()
    return replace(
        as_saved,
        states=replace(states, next_id=max(states.next_id, as_saved.states.next_id)),
        found=_found(replay, end, undo.number),
        lost=_lost_behind(end, undo.number),
        recovered=tuple(replay.entries),
        log=FollowedLog(undo.log, replay, end) if not end.problem else None,
        is_at_hand=replay.number == undo.number,
    )


def _found(replay: Replay, end: LogEnd, n_saved: int) -> tuple[str, ...]:
    notes, n_found = [], replay.number - n_saved
    if n_found:
        what = "the last change is" if n_found == 1 else f"the last {n_found} changes are"
        last = f", up to «{replay.entries[-1].what}»" if replay.entries else ""
        whole = "" if end.problem else " Nothing is lost:"
        notes.append(f"The plot was not closed last time.{whole} {what if whole else what.capitalize()} there{last}.")
    if end.is_cut:
        notes.append("One change was still being written when the program ended; it is not there.")
    return tuple(notes)


def _lost_behind(end: LogEnd, n_saved: int) -> tuple[str, ...]:
    if not end.problem:
        return ()
    lost = _lost(end.lost, n_saved)
    return (f"{UNDO_FILE} cannot be followed to its end ({end.problem}).{lost} The file is kept.",)


def _lost(entries: Sequence[HistoryEntry], number: int) -> str:
    """The sentence about what was done after `number` steps and cannot be brought back."""
    labels = [entry.what for entry in entries if entry.number > number]
    if not labels:
        return ""
    return f" Lost, and to be done again: {_listed(labels)}."


def _listed(labels: Sequence[str], n_most: int = 5) -> str:
    more = f" and {len(labels) - n_most} more" if len(labels) > n_most else ""
    return ", ".join(f"«{label}»" for label in labels[:n_most]) + more


def _is_same(a: PlotState, b: PlotState) -> bool:
    """Whether two states are one; where the cloud, the photos and the masks are now is nothing to compare."""
    return (
        all(getattr(a, name) == getattr(b, name) for name in _COMPARED)
        and len(a.trunks) == len(b.trunks)
        and dict(a.trees) == dict(b.trees)
        and all(
            (one.id, one.origin) == (other.id, other.origin) and np.array_equal(one.points, other.points)
            for one, other in zip(a.trunks, b.trunks, strict=True)
        )
    )


def _state(folder: Path, saved: SavedProject, trunks: TrunkSet) -> PlotState:
    strangers = sorted(set(saved.trees) - set(trunks.ids))
    if strangers:
        raise _damaged(folder / PROJECT_FILE, f"it describes trees {strangers} that have no trunk")
    source_path, other_source_path = locate(folder, saved.source)
    return PlotState(
        plot_id=saved.plot_id,
        source_path=source_path,
        other_source_path=other_source_path,
        source_used=tuple(Path(path) for path in saved.source.used),
        n_points=saved.source.n_points,
        fingerprint=saved.source.fingerprint,
        up_direction=saved.up_direction,
        scale=ScaleEstimate(saved.scale.metres_per_unit, saved.scale.source, saved.scale.standard_error),
        settings=saved.settings,
        trunks=trunks,
        trees=_trees(folder, saved.trees),
        north_direction=saved.north_direction,
        origin_src=saved.origin_src,
        evidence=_evidence(folder, saved.evidence),
        cameras=None if saved.cameras is None else camera_place(folder, saved.cameras),
        masks=None if saved.masks is None else saved.masks.record(folder),
    )


def _trees(folder: Path, saved: Mapping[int, SavedTree]) -> dict[int, TreeRecord]:
    records = {}
    for trunk_id, tree in saved.items():
        try:
            records[trunk_id] = tree.record()
        except (TypeError, ValueError) as error:
            raise _damaged(folder / PROJECT_FILE, f"trees.{trunk_id}: {error}") from None
    return records


def _evidence(folder: Path, saved: SavedEvidence) -> ScaleEvidence:
    try:
        return saved.evidence()
    except ValueError as error:
        raise _damaged(folder / PROJECT_FILE, f"evidence: {error}") from None


def _read_whole(folder: Path) -> tuple[SavedProject, TrunkSet]:
    """project.json and the trunks it names, which a writer removes as soon as it has saved others."""
    saved = _parse(folder / PROJECT_FILE)
    for _ in range(_N_LOOKS):
        try:
            return saved, _read_trunks(folder / saved.trunks_file, saved)
        except FileNotFoundError:
            missing, saved = saved.trunks_file, _parse(folder / PROJECT_FILE)
            if saved.trunks_file == missing:
                break
    raise _damaged(folder / missing, "it is missing")


def _parse(path: Path) -> SavedProject:
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise ProjectError(f"{path.parent.name} is not a saved plot: it has no {PROJECT_FILE}.") from None
    except OSError as error:
        raise ProjectError(f"{path} could not be read ({error.strerror or error}).") from error
    except (ValueError, RecursionError) as error:
        raise _damaged(path, f"it is not JSON: {error}") from None
    version = content.get("schema_version") if isinstance(content, dict) else None
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise _damaged(path, "it has no schema_version")
    if version > SCHEMA_VERSION:
        raise ProjectVersionError(
            f"{path.parent.name} was saved by a newer DBH Studio (schema {version}; this one reads {SCHEMA_VERSION}).",
            "Update DBH Studio to open it.",
        )
    try:
        return SavedProject.model_validate(migrated(content))
    except ValidationError as error:
        first = error.errors()[0]
        raise _damaged(path, f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None


def _damaged(path: Path, problem: str) -> ProjectError:
    return ProjectError(
        f"{path.name} in {path.parent.name} is damaged ({problem}).",
        "Nothing was changed. Restore the folder from a backup, or open the cloud itself to begin anew.",
    )


def _read_trunks(path: Path, saved: SavedProject) -> TrunkSet:
    """Raises FileNotFoundError where there is no such file, and ProjectError whatever else is wrong with it."""
    n_points = saved.source.n_points
    try:
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            if sorted(archive.namelist()) != sorted(f"{name}.npy" for name in _TRUNK_ARRAYS):
                raise ValueError("it holds other things than trunks")
            ids, ends, points, origins = (_read_array(archive, f"{name}.npy", n_points) for name in _TRUNK_ARRAYS)
        _check_trunk_arrays(ids, ends, points, origins, n_points)
        parts = np.split(points, ends)[:-1]
        trunks = tuple(Trunk(int(i), part, str(origin)) for i, part, origin in zip(ids, parts, origins, strict=True))
        return TrunkSet(trunks, saved.next_id)
    except (FileNotFoundError, MemoryError):
        raise
    except Exception as error:
        # Archives and array headers can be damaged in more ways than their readers have names for.
        raise _damaged(path, str(error)) from error


def _read_array(archive: zipfile.ZipFile, name: str, n_most: int) -> NDArray[Any]:
    """One array as `_write_trunks` writes it: not packed, of one dimension.

    `np.load` would make room for as many numbers as the header asks for; here that is `n_most`, and no more than
    there are bytes in the file.
    """
    info = archive.getinfo(name)
    if info.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{name} is packed")
    with archive.open(info) as member:
        if np.lib.format.read_magic(member) != (1, 0):
            raise ValueError(f"{name} is of another version")
        shape, _, dtype = np.lib.format.read_array_header_1_0(member)
        if len(shape) != 1 or not 0 <= shape[0] <= n_most:
            raise ValueError(f"{name} has the shape {shape}")
        content = member.read()
    if dtype.hasobject or len(content) != shape[0] * dtype.itemsize:
        raise ValueError(f"{name} is not what its header says")
    return np.ndarray(shape, dtype, content)


def _share_points(trunks: TrunkSet, n_points: int) -> bool:
    is_taken = np.zeros(n_points, bool)
    for trunk in trunks:
        is_taken[trunk.points] = True
    return np.count_nonzero(is_taken) != sum(len(trunk) for trunk in trunks)


def _check_trunk_arrays(ids: Any, ends: Any, points: Any, origins: Any, n_points: int) -> None:
    """Raise ValueError unless the arrays are what `_write_trunks` writes, and the trunks are disjoint."""
    is_integer = all(array.ndim == 1 and array.dtype.kind in "iu" for array in (ids, ends, points))
    if not is_integer or origins.ndim != 1 or origins.dtype.kind != "U":
        raise ValueError("its arrays are of the wrong kind")
    if not len(ids) == len(ends) == len(origins):
        raise ValueError("its arrays are of different lengths")
    if (np.diff(ends, prepend=0) <= 0).any() or (ends[-1] if len(ends) else 0) != len(points):
        raise ValueError("its trunks do not add up to its points")
    if len(points) and not 0 <= points.min() <= points.max() < n_points:
        raise ValueError("it speaks of points the cloud does not have")
    is_taken = np.zeros(n_points, bool)
    is_taken[points] = True
    if np.count_nonzero(is_taken) != len(points):
        raise ValueError("two of its trunks share points")
