"""The saved plot: a folder ``NAME.dbh`` that is at any instant, crash or not, one whole state.

    project.json    everything but the points of the trunks; the one file that counts
    trunks-7.npz    the trunks project.json speaks of; an older or newer one is what a crash left, and is removed
    history.jsonl   what was done, by whom and when; for the record, never read by the program
    history-1.jsonl the history of a plot that this one has replaced
    lock            held by the process that writes the plot
    cache/          may be deleted at any time
    masks/          masks of the photos, see `io.masks.store`; not part of a save

Each save writes a new trunks file (where trunks changed), then project.json in one step, then removes the old trunks.
"""

from __future__ import annotations

import contextlib
import json
import os
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.scale_evidence import ScaleEvidence
from dbh_studio.core.tree_record import TreeRecord
from dbh_studio.core.trunks import Trunk, TrunkSet
from dbh_studio.errors import ProjectError, ProjectVersionError
from dbh_studio.io.atomic import atomic_file
from dbh_studio.io.history import HISTORY_FILE, HistoryEntry, append_history, put_history_aside, read_history
from dbh_studio.io.lock import lock_file
from dbh_studio.io.project_model import (
    SCHEMA_VERSION,
    TRUNKS_FILE,
    CameraPlace,
    PlotState,
    SavedEvidence,
    SavedProject,
    SavedTree,
    camera_place,
    locate,
    migrated,
    saved_project,
)

__all__ = [
    "FOLDER_SUFFIX",
    "HISTORY_FILE",
    "LOCK_FILE",
    "PROJECT_FILE",
    "SCHEMA_VERSION",
    "CameraPlace",
    "HistoryEntry",
    "PlotState",
    "ProjectWriter",
    "is_project",
    "read_history",
    "read_project",
]

FOLDER_SUFFIX = ".dbh"
PROJECT_FILE = "project.json"
LOCK_FILE = "lock"

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


def read_project(folder: Path | str) -> PlotState:
    """Read a saved plot, which another process may be writing. Nothing is written, whatever is found.

    Raises:
        ProjectVersionError: It was saved by a newer program.
        ProjectError: A file is missing or damaged; says which.
    """
    folder = Path(folder).absolute()
    saved, trunks = _read_whole(folder)
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


# ---- writing


class ProjectWriter:
    """The right to write one saved plot, from the moment it is made until it is closed.

    Args:
        folder: The plot's folder; made where it does not exist.

    Raises:
        ProjectLockedError: Another process writes it, or this one already does.
        ProjectError: The folder cannot be made or locked.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder).absolute()
        self._saved: tuple[TrunkSet, str] | None = None
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock: IO[str] | None = lock_file(self.folder / LOCK_FILE)
        except OSError as error:
            raise ProjectError(
                f"The folder {self.folder} cannot be written ({error.strerror or error}).", "Choose another folder."
            ) from error
        self._next_number = 1 + max((number for number, _ in self._trunk_files()), default=0)

    def adopt(self, state: PlotState) -> None:
        """Say that `state` was just read from the folder, so that its trunks need not be written again."""
        saved = _parse(self.folder / PROJECT_FILE)
        self._saved = state.trunks, saved.trunks_file

    def save(self, state: PlotState, *, next_id: int = 1) -> None:
        """Make the folder hold `state`. Whatever goes wrong, it then holds either that or what it held before.

        Args:
            next_id: Lower bound of the next id, where ids were given out that no trunk has any more.

        Raises:
            ProjectError: It cannot be written (disk full, …).
            ValueError: The writer is closed.
        """
        if self._lock is None:
            raise ValueError("the writer is closed")
        try:
            trunks_file = self._save_trunks(state.trunks)
            content = saved_project(state, self.folder, trunks_file, next_id).model_dump_json(indent=1).encode()
            with atomic_file(self.folder / PROJECT_FILE) as file:
                file.write(content)
            _sync_folder(self.folder)
        except OSError as error:
            raise ProjectError(
                f"The plot could not be saved in {self.folder} ({error.strerror or error}).",
                "What was saved before is intact. Make room on the disk; the next change saves everything.",
            ) from error
        self._saved = state.trunks, trunks_file
        self._remove_leftovers(trunks_file)

    def log(self, entries: Iterable[HistoryEntry]) -> None:
        """Append to the history.

        Raises:
            ProjectError: It cannot be written.
        """
        append_history(self.folder, entries)

    def put_history_aside(self) -> None:
        """Begin a new history, where another plot is to be saved in place of the one that is there.

        Raises:
            ProjectError: It cannot be renamed.
        """
        put_history_aside(self.folder)

    def close(self) -> None:
        """Give the plot free for others. The lock file stays: removing it would race with the next writer."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _trunk_files(self) -> Sequence[tuple[int, Path]]:
        found = [(TRUNKS_FILE.fullmatch(path.name), path) for path in self.folder.iterdir()]
        return [(int(match.group(1)), path) for match, path in found if match]

    def _save_trunks(self, trunks: TrunkSet) -> str:
        """The name of a file that holds `trunks`, written unless the last save wrote them."""
        if self._saved is not None and self._saved[0].trunks == trunks.trunks:
            return self._saved[1]
        name = f"trunks-{self._next_number}.npz"
        self._next_number += 1
        with atomic_file(self.folder / name) as file:
            _write_trunks(file, trunks)
        # Durable before project.json can name it.
        _sync_folder(self.folder)
        return name

    def _remove_leftovers(self, trunks_file: str) -> None:
        """Remove what project.json does not name: it is written, so nothing else is needed any more."""
        old = [path for _, path in self._trunk_files() if path.name != trunks_file]
        for path in [*old, *self.folder.glob(".*.part")]:
            with contextlib.suppress(OSError):
                path.unlink()


def _sync_folder(folder: Path) -> None:
    """Make the names in a folder durable. Windows has no such call and needs none."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _write_trunks(file: IO[bytes], trunks: TrunkSet) -> None:
    points = [trunk.points for trunk in trunks]
    np.savez(
        file,
        ids=np.array(trunks.ids, np.int32),
        ends=np.cumsum([len(part) for part in points], dtype=np.int64),
        points=np.concatenate([np.empty(0, np.int32), *points]),
        origins=np.array([trunk.origin for trunk in trunks], np.str_),
    )
