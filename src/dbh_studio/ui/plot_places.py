"""Where plots are saved: beside what they are made from, or elsewhere."""

from __future__ import annotations

import hashlib
import itertools
import os
from pathlib import Path

from dbh_studio.app.names import file_name
from dbh_studio.app.opening import plot_name
from dbh_studio.errors import FileError
from dbh_studio.io.project import FOLDER_SUFFIX

# Bytes of a saved plot's name; file systems allow 255 with the suffix.
_LONGEST_NAME = 200


def place_for_copy(name: str, folder: Path) -> Path:
    """Where a copy of a plot of this name may be saved in `folder`: what is not there yet."""
    name = file_name(name)
    names = (f"{name}{'' if n == 1 else f' ({n})'}{FOLDER_SUFFIX}" for n in itertools.count(1))
    return next(path for path in (folder / each for each in names) if not os.path.lexists(path))


def project_dir_for(path: Path, fallback: Path) -> Path:
    """Where the plot of a source file is saved: beside it, or in `fallback` where that folder is not writable.

    Raises:
        FileError: `fallback` cannot be made.
    """
    absolute = path.absolute()
    # Two plots of one name in two read-only folders, or of one long beginning, must not share a saved plot.
    digest = hashlib.blake2b(str(absolute).encode("utf-8", "replace"), digest_size=4).hexdigest()
    encoded = plot_name(path).encode("utf-8", "replace")
    name = encoded[:_LONGEST_NAME].decode("utf-8", "ignore")
    with_digest = f"{name}-{digest}{FOLDER_SUFFIX}"
    beside = absolute.parent / (with_digest if len(encoded) > _LONGEST_NAME else f"{name}{FOLDER_SUFFIX}")
    if beside.exists() or os.access(beside.parent, os.W_OK):
        return beside
    try:
        fallback.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(
            path, f"There is no place to save its plot: {error.strerror or error}.", f"Make {fallback} writable."
        ) from None
    return fallback / with_digest
