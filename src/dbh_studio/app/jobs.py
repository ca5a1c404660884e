"""Long work in a child process: it reports, it can be cancelled at any moment, and its crash is not the studio's.

Arrays do not go through the pipe. A call and its result are pickled (protocol 5) into a file, buffers beside it;
the child maps the file, so that a cloud is neither sent in pieces nor held twice, and no shared memory is needed (a
container often has 64 MB of it). The files are in a temporary folder that goes with the job; TMPDIR says where.
"""

from __future__ import annotations

import contextlib
import logging
import mmap
import multiprocessing
import os
import pickle
import shutil
import signal
import struct
import tempfile
import threading
import traceback
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.errors import CancelledError, StudioError

_log = logging.getLogger(__name__)

Result = TypeVar("Result")

# Never fork: a fork of a process with threads may inherit a lock that nobody will release.
_context = multiprocessing.get_context("spawn")

# A cache line; enough for any vector instruction.
_ALIGNMENT = 64
_LENGTHS = struct.Struct("<QQ")

_NO_MEMORY = StudioError(
    "There is not enough memory for this step.", "Close other programs, or work on a thinner or smaller cloud."
)


# ---- values in files


def _padding(position: int) -> int:
    return -position % _ALIGNMENT


def write_value(path: Path, value: Any) -> None:
    """Pickle `value` into a file with its buffers (arrays) beside the pickle, aligned and uncopied.

    Raises:
        OSError: The disk is full or not writable.
    """
    buffers: list[pickle.PickleBuffer] = []
    stream = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    views = [buffer.raw() for buffer in buffers]
    with path.open("wb") as file:
        file.write(_LENGTHS.pack(len(stream), len(views)))
        file.write(struct.pack(f"<{len(views)}Q", *(view.nbytes for view in views)))
        file.write(stream)
        for view in views:
            file.write(bytes(_padding(file.tell())))
            file.write(view)


def read_value(path: Path, *, mapped: bool) -> Any:
    """The value in a file of `write_value`; only for files this program has just written itself.

    Args:
        mapped: Let the arrays be views of the file, which on Windows must then stay until they are gone. Otherwise they
            are in memory.
    """
    with path.open("rb") as file:
        if mapped:
            # A private copy: what is written to is copied, page by page, and the file stays as it is.
            content = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY))
        else:
            content = memoryview(bytearray(path.stat().st_size))
            file.readinto(content)
    stream_length, n_buffers = _LENGTHS.unpack_from(content)
    lengths = struct.unpack_from(f"<{n_buffers}Q", content, _LENGTHS.size)
    position = _LENGTHS.size + 8 * n_buffers
    stream = content[position : position + stream_length]
    position += stream_length
    buffers = []
    for length in lengths:
        position += _padding(position)
        buffers.append(content[position : position + length])
        position += length
    return pickle.loads(stream, buffers=buffers)


# ---- in the child


def _die_with_parent(folder: str) -> None:
    """End this process when the studio ends, however it ends, and take the job's files along."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    parent.join()
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


def _child(connection: Connection, folder: str) -> None:
    """Run the call in `folder`; everything that happens goes through the pipe."""
    # Ctrl+C reaches every process of the terminal; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_die_with_parent, args=(folder,), daemon=True).start()
    # What the work itself puts into temporary files goes with the job, also when it is killed.
    tempfile.tempdir = folder

    def report(fraction: float, message: str = "") -> None:
        connection.send(("progress", float(fraction), str(message)))

    try:
        function, arguments, options = read_value(Path(folder, "call"), mapped=True)
        result = function(*arguments, progress=report, **options)
        try:
            write_value(Path(folder, "result"), result)
        except OSError as error:
            raise _scratch_error(error) from error
        connection.send(("done",))
    except BaseException as error:  # noqa: BLE001  (whatever it is, the parent must hear of it)
        connection.send(("error", _portable(error), traceback.format_exc()))


def _portable(error: BaseException) -> StudioError:
    """The error as one that survives the pipe: a StudioError as it is, anything else in words."""
    if isinstance(error, StudioError):
        with contextlib.suppress(Exception):
            pickle.loads(pickle.dumps(error))
            return error
        return StudioError(error.problem, error.remedy)
    if isinstance(error, MemoryError):
        return _NO_MEMORY
    return _unexpected(f"{type(error).__name__}: {error}")


def _unexpected(what: str) -> StudioError:
    return StudioError(f"The work stopped unexpectedly ({what}).", "Nothing was changed. The log tells more.")


# ---- in the studio


class Job:
    """One call ``function(*args, progress=…, **options)`` in a child process.

    `on_done` or `on_error` is called, once, on the job's own thread. `function` and its arguments must be
    picklable, and `function` importable by name. Make the job before showing a Cancel button and start it afterwards: a
    cancel in between counts.

    Args:
        function: The work.
        args: Its arguments; arrays arrive read-only where they are so here.
        options: Its keyword arguments.
        on_progress: Told of progress; may raise CancelledError to cancel.
        on_done: Gets the result. A StudioError it raises goes to `on_error`.
        on_error: Gets the child's StudioError, a CancelledError, or a StudioError that tells of a crash.
    """

    def __init__(
        self,
        function: Callable[..., Result],
        args: tuple[Any, ...] = (),
        options: Mapping[str, Any] = MappingProxyType({}),
        *,
        on_progress: Progress = ignore_progress,
        on_done: Callable[[Result], object],
        on_error: Callable[[StudioError], object],
    ) -> None:
        self._call: tuple[Any, ...] | None = (function, args, dict(options))
        self._on_progress = on_progress
        self._on_done = on_done
        self._on_error = on_error
        self._lock = threading.Lock()
        self._is_cancelled = False
        self._process: multiprocessing.process.BaseProcess | None = None
        self._thread = threading.Thread(target=self._run, name="job", daemon=True)

    def start(self) -> Job:
        """Begin; returns at once."""
        self._thread.start()
        return self

    def cancel(self) -> None:
        """Stop, at once and whatever the work is doing. No effect on a job that is done."""
        with self._lock:
            self._is_cancelled = True
            if self._process is not None:
                self._process.kill()

    def join(self, timeout_s: float | None = None) -> None:
        """Wait until the job has ended and its callback has returned."""
        self._thread.join(timeout_s)

    @property
    def is_running(self) -> bool:
        """Whether it was started and has not ended."""
        return self._thread.is_alive()

    @property
    def is_cancelled(self) -> bool:
        """Whether `cancel` was called."""
        return self._is_cancelled

    def _run(self) -> None:
        try:
            self._on_done(self._outcome())
        except StudioError as error:
            self._on_error(error)
        except Exception as error:  # noqa: BLE001 - the caller waits for exactly one answer
            _log.exception("A job failed in the studio itself")
            self._on_error(_portable(error))

    def _outcome(self) -> Any:
        """Run the child to its end and return its result, or raise the StudioError that says why there is none."""
        self._raise_if_cancelled()
        with tempfile.TemporaryDirectory(prefix="dbh-studio-job-", ignore_cleanup_errors=True) as name:
            folder = Path(name)
            try:
                write_value(folder / "call", self._call)
            except OSError as error:
                raise _scratch_error(error) from error
            self._call = None  # the arguments may be large, and are in the file now
            receiver, sender = _context.Pipe(duplex=False)
            with receiver:
                process = self._spawn(sender, folder)
                try:
                    self._follow(receiver, process)
                finally:
                    # Also where a callback raised: no child outlives its job.
                    process.kill()
                    process.join()
                    self._forget_process()
            return read_value(folder / "result", mapped=False)

    def _spawn(self, sender: Connection, folder: Path) -> multiprocessing.process.BaseProcess:
        with sender, self._lock:
            # Under the lock: a cancel comes either before, and is seen here, or after, and finds a process to kill.
            if self._is_cancelled:
                raise CancelledError
            process = _context.Process(target=_child, args=(sender, str(folder)), name="dbh-studio job", daemon=True)
            process.start()
            self._process = process
            return process

    def _follow(self, receiver: Connection, process: multiprocessing.process.BaseProcess) -> None:
        """Pass on progress until the child is done; raise if it fails, dies or is cancelled."""
        while True:
            try:
                message = receiver.recv()
            except (EOFError, OSError):
                process.join()
                self._raise_if_cancelled()
                raise _crash(process.exitcode) from None
            if message[0] == "progress":
                self._raise_if_cancelled()
                self._on_progress(message[1], message[2])
            elif message[0] == "done":
                self._raise_if_cancelled()
                return
            else:
                self._raise_if_cancelled()
                if type(message[1]) is StudioError:
                    _log.error("A job failed:\n%s", message[2])
                raise message[1]

    def _forget_process(self) -> None:
        with self._lock:
            self._process = None

    def _raise_if_cancelled(self) -> None:
        if self._is_cancelled:
            raise CancelledError


def _crash(exit_code: int | None) -> StudioError:
    if exit_code == -getattr(signal, "SIGKILL", 9):
        return StudioError(
            "The system stopped the work, most likely because the memory ran out.",
            "Nothing was changed. Close other programs, or work on a thinner or smaller cloud.",
        )
    if exit_code is not None and exit_code < 0:
        return _unexpected(f"signal {-exit_code}")
    return _unexpected(f"exit status {exit_code}")


def _scratch_error(error: OSError) -> StudioError:
    return StudioError(
        f"The temporary folder {tempfile.gettempdir()} cannot take the data of this step ({error.strerror or error}).",
        "Make room there, or set the environment variable TMPDIR to a folder on a larger disk.",
    )


def run_job(
    function: Callable[..., Result],
    *args: Any,
    progress: Progress = ignore_progress,
    in_process: bool = False,
    started: Callable[[Job], object] | None = None,
    **options: Any,
) -> Result:
    """Run ``function(*args, progress=progress, **options)`` in a child process and wait for it.

    Args:
        progress: Called in this process; cancels by raising CancelledError.
        in_process: Run it here instead, for scripts that are a process of their own.
        started: Given the job, so that another thread can cancel it at once, whether or not it reports progress.

    Raises:
        StudioError: As the child raised it, or telling of its crash.
        CancelledError: `progress` cancelled.
    """
    if in_process:
        return function(*args, progress=progress, **options)
    results: list[Result] = []
    errors: list[StudioError] = []
    job = Job(function, args, options, on_progress=progress, on_done=results.append, on_error=errors.append)
    job.start()
    if started is not None:
        started(job)
    try:
        job.join()
    except BaseException:  # Ctrl+C
        job.cancel()
        job.join()
        raise
    if errors:
        raise errors[0]
    return results[0]
