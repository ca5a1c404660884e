"""Opening a file to write it, without being led elsewhere.

A saved plot may come from somebody else, and hold links or pipes under the names of the files the program writes.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

# Binary on Windows. A link is not followed, and a pipe is not waited for, where the system can say so.
_FLAGS = sum({getattr(os, name, 0) for name in ("O_BINARY", "O_NOFOLLOW", "O_NONBLOCK")})


def open_own_file(path: Path, flags: int) -> int:
    """A descriptor of the regular file `path`, opened for binary use with `flags`; the caller closes it.

    Raises:
        OSError: It cannot be opened, is a link, or is no regular file.
    """
    # Looked at first for the words, and for Windows; O_NOFOLLOW is for the link that comes a moment later.
    if path.is_symlink():
        raise OSError(errno.ELOOP, f"{path.name} is a link to another file")
    descriptor = os.open(path, flags | _FLAGS, 0o666)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, f"{path.name} is not a regular file")
    return descriptor
