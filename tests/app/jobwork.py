"""Work for jobs, in a module of its own: a child process must be able to import it."""

from __future__ import annotations

import ctypes
import os
import signal
import tempfile
import time
from pathlib import Path

import numpy as np

from dbh_studio.core.progress import ignore_progress
from dbh_studio.errors import MalformedFileError, StaleResultError


def double(points, *, offset=0, progress=ignore_progress):
    progress(0.5, "half way")
    return {"sum": 2 * points + offset, "is_writeable": points.flags.writeable, "pid": os.getpid()}


def write_into(points, *, progress=ignore_progress):
    points[:] = 7
    return points


def make_large(n, *, progress=ignore_progress):
    return np.arange(n, dtype=np.float64), [np.ones((n, 3), np.float32)[:, ::2], np.empty((0, 3))]


def fail_with_file_error(*, progress=ignore_progress):
    raise MalformedFileError(Path("a/plot.ply"), "It stops in the middle.", "Copy it again.")


def fail_with_stale(*, progress=ignore_progress):
    raise StaleResultError("The scale changed.", "Start again.")


class OddError(Exception):
    def __init__(self, a, b):
        super().__init__(a)


def fail_oddly(*, progress=ignore_progress):
    raise OddError("an error that does not unpickle", 2)


def run_out_of_memory(*, progress=ignore_progress):
    raise MemoryError


def exit_quietly(*, progress=ignore_progress):
    os._exit(3)


def kill_yourself(*, progress=ignore_progress):
    os.kill(os.getpid(), signal.SIGKILL)


def return_unpicklable(*, progress=ignore_progress):
    return lambda: None


def leave_temporary_files_and_wait(folder, *, progress=ignore_progress):
    with tempfile.NamedTemporaryFile(delete=False) as file:
        file.write(b"scratch")
    Path(folder, "pid").write_text(str(os.getpid()))
    progress(0.1, tempfile.gettempdir())
    while True:
        time.sleep(0.05)


def wait_in_native_code(*, progress=ignore_progress):
    progress(0.1, "deep inside")
    # Holds no lock and looks at no flag, as a native library does.
    ctypes.CDLL(None).sleep(600)
