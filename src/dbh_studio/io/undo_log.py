"""The undo log of a saved plot: every step since some state, so that Undo, Redo and the last edit outlive the program.

    undo.log            records, one after another; only ever appended to, or replaced whole in one step
    undo-damaged-1.log  one that could not be followed to its end; kept, never read

A record is a frame (mark, lengths, check sum), a line of JSON, and the points of the trunks it brings. A step is handed
to the system before it counts as done: a program that is killed has lost nothing, and what a full disk or a power cut
leaves of a record is told by its check sum. `io.undo_records` has what the records say.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import os
import secrets
import struct
import threading
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dbh_studio.io.atomic import atomic_file, sync_folder
from dbh_studio.io.history import HistoryEntry
from dbh_studio.io.ownfile import open_own_file
from dbh_studio.io.project_model import PlotState
from dbh_studio.io.undo_records import (
    LOG_VERSION,
    Replay,
    StepKind,
    TrunkNumbers,
    UndoStates,
    entry_of,
    records_of,
    step_record,
)

UNDO_FILE = "undo.log"

_MARK = b"\xdbUnd"
_FRAME = struct.Struct("<4sIQI")
_Record = tuple[dict[str, Any], bytes]


# ---- reading


@dataclass(frozen=True)
class LogEnd:
    """Where a log stops making sense.

    Attributes:
        offset: Bytes that could be followed.
        is_cut: A record was being written when the program ended.
        lost: Later steps that can still be read though the way to them cannot be followed.
        problem: What is wrong; empty where the log is whole, or only its last record is cut off.
    """

    offset: int
    is_cut: bool = False
    lost: tuple[HistoryEntry, ...] = ()
    problem: str = ""


class ForeignLogError(Exception):
    """The log is not that of this plot, or of a program this one does not know; `lost` as of `LogEnd`."""

    def __init__(self, problem: str, lost: tuple[HistoryEntry, ...] = ()) -> None:
        super().__init__(problem)
        self.lost = lost


def replayed(path: Path, log_id: str, base: PlotState, until: int) -> tuple[Replay, PlotState | None, LogEnd]:
    """Follow a log as far as it goes.

    Args:
        path: The log; another process may be writing it.
        log_id: Which log it must be.
        base: A state of the same plot.
        until: A number of steps.

    Returns:
        Where it led to, the state it had after `until` steps (None where it does not pass that number), and its end.

    Raises:
        OSError: It cannot be read.
        ForeignLogError: It is of another plot or version, or not even its beginning can be read.
    """
    content = path.read_bytes()
    replay, at_number = Replay(base, path.parent), None
    end, problem = 0, ""
    for record, points, record_end in _records(memoryview(content)):
        if end == 0:
            _check_begin(record, log_id, base)
        try:
            replay.apply(record, points)
        except (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError) as error:
            problem = f"a step of it makes no sense: {error}"
            break
        end = record_end
        if "number" in record and replay.number == until:
            at_number = replay.present
    lost = tuple(entry for record in _later_records(content, end) if (entry := entry_of(record)) is not None)
    if end == 0:
        raise ForeignLogError("its beginning cannot be read", lost)
    if end == len(content):
        return replay, at_number, LogEnd(end)
    if lost or problem:
        return replay, at_number, LogEnd(end, lost=lost, problem=problem or "a part of it is damaged")
    return replay, at_number, LogEnd(end, is_cut=True)


def _check_begin(record: Mapping[str, Any], log_id: str, base: PlotState) -> None:
    if record.get("kind") != "begin" or record.get("log") != log_id:
        raise ForeignLogError("it is that of another plot, or of another copy of this one")
    if record.get("version") != LOG_VERSION:
        raise ForeignLogError("it was written by another version of the program")
    if (record.get("n_points"), record.get("fingerprint")) != (base.n_points, base.fingerprint):
        raise ForeignLogError("it is about another cloud")


def _records(content: memoryview, start: int = 0) -> Iterator[tuple[dict[str, Any], memoryview, int]]:
    """Each whole record from `start`, its trunks' points and where it ends, up to the first that is not whole."""
    while start + _FRAME.size <= len(content):
        mark, n_json, n_points, check = _FRAME.unpack_from(content, start)
        middle = start + _FRAME.size + n_json
        end = middle + n_points
        if mark != _MARK or end > len(content):
            return
        if zlib.crc32(content[start + _FRAME.size : end], n_json) != check:
            return
        try:
            record = json.loads(bytes(content[start + _FRAME.size : middle]))
        except (ValueError, RecursionError):
            return
        if not isinstance(record, dict) or not isinstance(record.get("kind"), str):
            return
        yield record, content[middle:end], end
        start = end


def _later_records(content: bytes, start: int) -> Iterator[dict[str, Any]]:
    """Whole records behind a damaged place."""
    place = content.find(_MARK, start)
    while place >= 0:
        end = place + 1
        for record, _, record_end in _records(memoryview(content), place):
            yield record
            end = record_end
        place = content.find(_MARK, end)


# ---- writing


def _framed(record: Mapping[str, Any], points: Iterable[bytes]) -> bytes:
    said = json.dumps(record, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    text = said.encode("utf-8", "replace")
    body = b"".join((text, *points))
    return _FRAME.pack(_MARK, len(text), len(body) - len(text), zlib.crc32(body, len(text))) + body


class UndoLog:
    """Appends to the log of one plot. Every method may be called from any thread.

    What cannot be written is kept, in its order, and written with the next `append` or `sync` that succeeds.

    Args:
        folder: The saved plot, which the caller has locked.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.id = ""
        self._path = folder / UNDO_FILE
        self._lock = threading.Lock()
        self._descriptor: int | None = None
        self._numbers = TrunkNumbers()
        self._end = self._n_durable = 0
        self._n_steps = 0
        self._waiting: list[bytes] = []
        # Whether the system has failed to bring to the disk what it had taken.
        self.is_doubtful = False
        # What is appended while the log is written anew.
        self._meanwhile: list[bytes] | None = None

    @property
    def is_open(self) -> bool:
        """Whether there is a log to append to."""
        return self._descriptor is not None

    @property
    def is_behind(self) -> bool:
        """Whether something noted is not on its way to the disk."""
        return self.is_doubtful or bool(self._waiting)

    @property
    def size_bytes(self) -> int:
        """How long it is."""
        return self._end

    @property
    def n_steps(self) -> int:
        """How many records it has about; it is worth writing anew when they are many more than can be undone."""
        return self._n_steps

    def adopt(self, log_id: str, replay: Replay, end: LogEnd) -> None:
        """Go on with a log that was just read. Raises OSError."""
        descriptor = open_own_file(self._path, os.O_RDWR)
        with self._lock:
            self._close_file()
            self._descriptor, self.id = descriptor, log_id
            self._numbers, self._end, self._n_durable = replay.numbers(), end.offset, 0
            self._n_steps = len(replay.entries) + len(replay.past) + len(replay.future)

    def append(self, kind: StepKind, entry: HistoryEntry, before: PlotState, after: PlotState, *, next_id: int) -> bool:
        """Note a step; whatever happens to this program then, it is there. False where there is no log.

        Raises:
            OSError: It could not be written yet.
        """
        with self._lock:
            if self._descriptor is None and self._meanwhile is None:
                return False
            record, points = step_record(
                kind, entry, before, after, next_id=next_id, folder=self.folder, numbers=self._numbers
            )
            content = _framed(record, points)
            if self._meanwhile is not None:
                self._meanwhile.append(content)
            if self._descriptor is None:
                return False
            self._waiting.append(content)
            self._n_steps += 1
            self._write_waiting()
            return True

    def sync(self) -> None:
        """Make everything noted so far outlast a power cut.

        One thread at a time calls this and `write_anew`.

        Raises:
            OSError: It could not be done. Where `is_doubtful` says so, only `write_anew` helps.
        """
        with self._lock:
            if self._descriptor is None or self.is_doubtful:
                raise OSError(errno.EIO, f"{UNDO_FILE} cannot be written")
            self._write_waiting()
            if self._n_durable == self._end:
                return
            descriptor, end = self._descriptor, self._end
        # Without the lock: a step must not wait for the disk.
        try:
            os.fsync(descriptor)
        except OSError:
            # What the system could not bring to the disk it may have dropped, and would not say so again.
            self.is_doubtful = True
            raise
        self._n_durable = end

    def begin_anew(self, states: UndoStates) -> None:
        """Prepare for `write_anew`: keep, besides, what is appended from now on.

        Args:
            states: The plot as it is now; nothing may happen to it during this call.
        """
        with self._lock:
            self._meanwhile = []
            self._numbers = self._numbers.only(states)

    def write_anew(self, states: UndoStates, *, log_id: str = "") -> None:
        """Replace the log by one of the states given to `begin_anew`, and of what followed.

        Args:
            states: As given there.
            log_id: Of the log; a new one where it is empty. That of the log before keeps what project.json says true.

        Raises:
            OSError: It could not be written; the log is as it was.
        """
        log_id = log_id or secrets.token_hex(16)
        present = states.present
        about = {"log": log_id, "n_points": present.n_points, "fingerprint": present.fingerprint}
        # The same numbers, and nothing said so far: it is another file.
        numbers = TrunkNumbers(dict(self._numbers.of), set(), self._numbers.next_number)
        is_locked = False
        try:
            with atomic_file(self._path) as file:
                for record, points in records_of(states, self.folder, numbers, about):
                    file.write(_framed(record, points))
                # The long part, without the lock: nobody's edit waits for it.
                file.flush()
                os.fsync(file.fileno())
                is_locked = self._lock.acquire()
                file.write(b"".join(self._meanwhile or ()))
                n_bytes = file.tell()
                self._close_file()  # Windows replaces no open file
            self.id, self._waiting, self.is_doubtful = log_id, [], False
            self._end = self._n_durable = n_bytes
            self._n_steps = len(states.past) + len(states.future) + len(self._meanwhile or ())
        finally:
            if not is_locked:
                self._lock.acquire()
            self._meanwhile = None
            self._open_again()
            self._lock.release()
        sync_folder(self.folder)

    def close(self) -> None:
        """Let go of the file; what could not be written is lost, unless the plot itself is saved."""
        with self._lock:
            self._close_file()
            self._waiting = []

    def _close_file(self) -> None:
        if self._descriptor is not None:
            with contextlib.suppress(OSError):
                os.close(self._descriptor)
        self._descriptor = None

    def _open_again(self) -> None:
        """The log as it is now, exchanged or not; without one the plot itself is saved after each command."""
        if self._descriptor is None and self.id:
            with contextlib.suppress(OSError):
                self._descriptor = open_own_file(self._path, os.O_RDWR)

    def _write_waiting(self) -> None:
        while self._waiting:
            self._write(self._waiting[0])
            self._end += len(self._waiting[0])
            del self._waiting[0]

    def _write(self, content: bytes) -> None:
        """Write at the end of what counts, over whatever a write that failed has left there."""
        descriptor = self._descriptor
        assert descriptor is not None
        if os.fstat(descriptor).st_size != self._end:
            os.ftruncate(descriptor, self._end)
        os.lseek(descriptor, self._end, os.SEEK_SET)
        rest = memoryview(content)
        while rest:
            rest = rest[os.write(descriptor, rest) :]


def put_log_aside(folder: Path) -> None:
    """Keep a log that cannot be followed under another name. Raises OSError."""
    names = (folder / f"undo-damaged-{number}.log" for number in itertools.count(1))
    with contextlib.suppress(FileNotFoundError):
        os.replace(folder / UNDO_FILE, next(path for path in names if not os.path.lexists(path)))
