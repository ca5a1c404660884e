"""Votes put aside: an unfinished round of photos, taken up again where it stopped."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np

from dbh_studio.core.votes import VoteCounter
from dbh_studio.io.atomic import atomic_file


def save_votes(path: Path | str, counter: VoteCounter) -> None:
    """Write the counter as .npz; the file before it stays until the new one is complete.

    Raises:
        OSError: The folder cannot be written, or the disk is full.
    """
    with atomic_file(Path(path)) as file:
        np.savez_compressed(file, **counter.state())  # type: ignore[arg-type]  # the keys are no option of savez


def load_votes(path: Path | str, *, n_voters: int, key: str) -> VoteCounter | None:
    """What was put aside, if it is about the same points, poses and settings.

    Args:
        path: As given to `save_votes`.
        n_voters: How many voters there are now.
        key: Of a new counter for them.

    Returns:
        None where there is no such file, it is damaged, or about something else: the photos are then asked anew, which
        costs time and nothing more.
    """
    try:
        # Opened here: of a damaged file numpy leaves the handle open.
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as stored:
            state = {name: stored[name] for name in stored.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error):
        return None
    return VoteCounter.from_state(state, n_voters=n_voters, key=key)
