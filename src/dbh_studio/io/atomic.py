"""Files that appear only when they are complete."""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from dbh_studio.io.ownfile import open_own_file


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Write next to `path` and move over it at the end; on any error `path` is as it was before.

    Who may read and write an existing `path` stays as it was. Of two writers at once, the last to end wins whole.

    Raises:
        OSError: The folder cannot be written, or the disk is full.
    """
    path = Path(path)
    # A name nobody else has or can guess, and O_EXCL: another thread's file, or a planted link, is never written.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")
    descriptor = open_own_file(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL)
    try:
        with open(descriptor, "w+b") as file:
            _copy_mode(path, temporary)
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable. Windows has no such call and needs none. Raises OSError."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _copy_mode(path: Path, temporary: Path) -> None:
    """Before there is anything to read. Some file systems know no modes, which is no reason not to save."""
    with contextlib.suppress(OSError):
        temporary.chmod(stat.S_IMODE(path.stat().st_mode) & 0o777)
