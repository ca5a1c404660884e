"""The saved plot: a folder ``NAME.dbh`` that is at any instant, crash or not, one whole state.

    project.json    everything but the points of the trunks; the one file that counts
    trunks-7.npz    the trunks project.json speaks of; an older or newer one is what a crash left, and is removed
    undo.log        every step: what Undo and Redo lead to, and what was done since project.json was written
    history.jsonl   what was done, by whom and when; for people, and for export
    history-1.jsonl the history of a plot that this one has replaced
    lock            held by the process that writes the plot
    cache/          may be deleted at any time
    masks/          masks of the photos, see `io.masks.store`; not part of a save

Each save writes a new trunks file (where trunks changed), then project.json in one step, then removes the old trunks. A
command is first noted in undo.log, which is soon done; the plot itself is saved at leisure. Reading takes up both.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import IO

import numpy as np

from dbh_studio.core.trunks import TrunkSet
from dbh_studio.errors import ProjectError, ProjectUnwritableError
from dbh_studio.io.atomic import atomic_file, sync_folder
from dbh_studio.io.history import HISTORY_FILE, HistoryEntry, append_history, put_history_aside, read_history
from dbh_studio.io.lock import lock_file
from dbh_studio.io.project_model import SCHEMA_VERSION, TRUNKS_FILE, CameraPlace, PlotState, SavedUndo, saved_project
from dbh_studio.io.project_read import FOLDER_SUFFIX, PROJECT_FILE, SavedPlot, is_project, read_plot, read_project
from dbh_studio.io.undo_log import UNDO_FILE, UndoLog, put_log_aside
from dbh_studio.io.undo_records import UndoStates, within

__all__ = [
    "FOLDER_SUFFIX",
    "HISTORY_FILE",
    "LOCK_FILE",
    "PROJECT_FILE",
    "SCHEMA_VERSION",
    "UNDO_FILE",
    "CameraPlace",
    "HistoryEntry",
    "PlotState",
    "ProjectWriter",
    "SavedPlot",
    "SavedUndo",
    "UndoStates",
    "is_project",
    "read_history",
    "read_plot",
    "read_project",
    "within",
]

LOCK_FILE = "lock"


class ProjectWriter:
    """The right to write one saved plot, from the moment it is made until it is closed.

    Args:
        folder: The plot's folder; made where it does not exist.

    Raises:
        ProjectLockedError: Another process writes it, or this one already does.
        ProjectUnwritableError: The folder cannot be made, locked or written.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder).absolute()
        self._saved: tuple[TrunkSet, str] | None = None
        self.undo_log = UndoLog(self.folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            # Files that are there already might be written in a folder that takes no new ones; a save needs both.
            if not os.access(self.folder, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            self._lock: IO[str] | None = lock_file(self.folder / LOCK_FILE)
        except OSError as error:
            raise ProjectUnwritableError(
                f"The folder {self.folder} cannot be written ({error.strerror or error}).", "Choose another folder."
            ) from error
        self._next_number = 1 + max((number for number, _ in self._trunk_files()), default=0)

    def adopt(self, plot: SavedPlot) -> None:
        """Say that `plot` was just read from the folder: its trunks need not be written again, its log goes on.

        A log that can be read but not written (a link, a file for reading only) is not gone on with: `undo_log` is not
        open then, and a new one can take its place.
        """
        trunks, followed = plot.saved_trunks, plot.log
        if plot.is_at_hand and followed is not None:
            # The same trunks, told by identity.
            trunks = plot.states.present.trunks
        self._saved = trunks, plot.trunks_file
        if followed is not None:
            with contextlib.suppress(OSError):
                self.undo_log.adopt(followed.log_id, followed.replay, followed.end)

    def save(self, state: PlotState, *, next_id: int = 1, undo: SavedUndo | None = None) -> None:
        """Make the folder hold `state`. Whatever goes wrong, it then holds either that or what it held before.

        Args:
            next_id: Lower bound of the next id, where ids were given out that no trunk has any more.
            undo: Which undo log goes with it; None for none.

        Raises:
            ProjectError: It cannot be written (disk full, …).
            ValueError: The writer is closed.
        """
        if self._lock is None:
            raise ValueError("the writer is closed")
        try:
            trunks_file = self._save_trunks(state.trunks)
            content = saved_project(state, self.folder, trunks_file, next_id, undo).model_dump_json(indent=1).encode()
            with atomic_file(self.folder / PROJECT_FILE) as file:
                file.write(content)
            sync_folder(self.folder)
        except OSError as error:
            raise ProjectError(
                f"The plot could not be saved in {self.folder} ({error.strerror or error}).",
                "What was saved before is intact. Make room on the disk; it is tried again every few seconds.",
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

    def put_log_aside(self) -> None:
        """Keep an undo log that cannot be followed under another name.

        Raises:
            ProjectError: It cannot be renamed.
        """
        try:
            put_log_aside(self.folder)
        except OSError as error:
            raise ProjectError(f"{UNDO_FILE} could not be put aside ({error.strerror or error}).") from error

    def close(self) -> None:
        """Give the plot free for others. The lock file stays: removing it would race with the next writer."""
        self.undo_log.close()
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
        sync_folder(self.folder)
        return name

    def _remove_leftovers(self, trunks_file: str) -> None:
        """Remove what project.json does not name: it is written, so nothing else is needed any more."""
        old = [path for _, path in self._trunk_files() if path.name != trunks_file]
        for path in [*old, *self.folder.glob(".*.part")]:
            with contextlib.suppress(OSError):
                path.unlink()


def _write_trunks(file: IO[bytes], trunks: TrunkSet) -> None:
    points = [trunk.points for trunk in trunks]
    np.savez(
        file,
        ids=np.array(trunks.ids, np.int32),
        ends=np.cumsum([len(part) for part in points], dtype=np.int64),
        points=np.concatenate([np.empty(0, np.int32), *points]),
        origins=np.array([trunk.origin for trunk in trunks], np.str_),
    )
