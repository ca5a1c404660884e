"""One writer at a time for a saved plot."""

from __future__ import annotations

import contextlib
import os
import socket
from pathlib import Path
from typing import IO

from dbh_studio.errors import ProjectLockedError
from dbh_studio.io.ownfile import open_own_file


def lock_file(path: Path) -> IO[str]:
    """Open and lock a file with the system's own lock, which goes when the process does, even killed.

    The file says who holds it, for the message only. Closing it releases the lock.

    Raises:
        ProjectLockedError: Another process holds it, or this one already does.
        OSError: The file cannot be made, is a link, or its file system has no locks.
    """
    file = os.fdopen(open_own_file(path, os.O_RDWR | os.O_CREAT | os.O_APPEND), "a+", encoding="utf-8")
    try:
        _lock_or_fail(file)
    except BlockingIOError:
        file.seek(0)
        holder = file.read(200).strip() or "another process"
        file.close()
        raise ProjectLockedError(
            f"{path.parent.name} is being written by {holder}.",
            "Close it there, or open it here for reading only.",
        ) from None
    except OSError:
        file.close()
        raise
    with contextlib.suppress(OSError):  # a full disk is no reason not to open a plot
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
    return file


def _lock_or_fail(file: IO[str]) -> None:
    """Lock without waiting; raise BlockingIOError where somebody else has it."""
    if os.name == "nt":
        import msvcrt

        # A byte far behind the text, which others must be able to read.
        file.seek(1 << 30)
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
        except OSError as error:
            raise BlockingIOError(*error.args) from None
        file.seek(0)
    else:
        import fcntl

        # flock, not lockf: that one lets a process lock what it already holds, and drops it when any handle is closed.
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
