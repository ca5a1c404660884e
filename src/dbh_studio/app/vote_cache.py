"""The label counts of the last voting, kept so that a reopened plot can be coloured by them. May be deleted any time.

They are used only where the plot's trunks came from that very voting: `MaskRecord.digest` names the masks' content and
how they voted. A threshold may change meanwhile, because it decides after the counting.
"""

from __future__ import annotations

import hashlib
import logging
import shutil
import zipfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.app.cache import cache_folder
from dbh_studio.core.mask_record import MaskRecord
from dbh_studio.core.votes import Votes
from dbh_studio.io.atomic import atomic_file
from dbh_studio.settings import VoteSettings

if TYPE_CHECKING:
    from dbh_studio.app.brought_masks import VotingMasks
    from dbh_studio.app.document import Document
    from dbh_studio.app.session import Session

log = logging.getLogger(__name__)

_VERSION = 1
_FILE = "votes.npz"


def record_of(masks: VotingMasks, n_masks: int, votes: VoteSettings) -> MaskRecord:
    """What is saved with trunks that these masks voted for.

    Args:
        masks: As given to the voting.
        n_masks: How many voted.
        votes: How they voted; rule and thresholds decide afterwards and are not part of the digest.
    """
    record = masks.record()
    rules = votes.model_dump_json(exclude={"rule", "min_share", "min_count"})
    how = hashlib.sha256(rules.encode()).hexdigest()[:8]
    return replace(record, n_masks=n_masks, digest=f"{record.digest}-{how}")


def keep_votes(session: Session, votes: Votes) -> None:
    """Write the votes the plot's trunks came from. That it cannot be written is no loss, and only logged.

    Call it when the trunks are in the plot: the votes are kept under what the Document then says of the masks.
    """
    path = _path(session)
    arrays: dict[str, Any] = {"version": _VERSION, "key": np.array(_key(session.document))}
    arrays |= {"n_seen": _narrow(votes.n_seen), "n_trunk": _narrow(votes.n_trunk)}
    # Weights are the counts, unless a setting says otherwise: of 20 million points that spares 160 MB.
    for name, counts in (("weight_seen", votes.n_seen), ("weight_trunk", votes.n_trunk)):
        if not np.array_equal(getattr(votes, name), counts):
            arrays[name] = getattr(votes, name)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as file:
            # Packing would take 8 s for 20 million points, and they are 40 MB as they are.
            np.savez(file, **arrays)
    except OSError as error:
        log.warning("The label counts of the points were not kept: %s", error.strerror or error)


def kept_votes(session: Session) -> Votes | None:
    """(N,) votes of all points that the plot's trunks came from; None where they are not known any more."""
    document, path = session.document, _path(session)
    if document.masks is None or not path.is_file():
        return None
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as saved:
            if int(saved["version"]) != _VERSION or str(saved["key"]) != _key(document):
                return None
            counts = [saved[name].astype(np.uint16, casting="safe") for name in ("n_seen", "n_trunk")]
            weights = [
                saved[name].astype(np.float32, casting="safe") if name in saved.files else count.astype(np.float32)
                for name, count in zip(("weight_seen", "weight_trunk"), counts, strict=True)
            ]
            votes = Votes(*counts, *weights)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        log.warning("The label counts kept with the plot cannot be used: %s", error)
        return None
    return votes if len(votes) == document.source.n_points else None


def carry_votes(before: Path, after: Path) -> None:
    """Bring the kept votes of one place to another, where there are any; that they cannot be copied is no loss."""
    if before != after and (before / _FILE).is_file():
        with suppress(OSError):
            after.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(before / _FILE, after / _FILE)


def votes_folder(session: Session) -> Path:
    """Where they are kept."""
    folder = session.saver.folder if session.saver is not None else session.read_from
    if folder is not None:
        return folder / "cache"
    return cache_folder() / "unsaved-votes" / session.document.source.fingerprint


def _path(session: Session) -> Path:
    return votes_folder(session) / _FILE


def _narrow(counts: NDArray[np.uint16]) -> NDArray[Any]:
    """In one byte each, where no photo more was counted."""
    return counts.astype(np.uint8) if counts.max(initial=0) < 256 else counts


def _key(document: Document) -> str:
    digest = hashlib.sha256(document.source.fingerprint.encode())
    if document.masks is not None and document.cameras is not None:
        cameras = document.cameras
        digest.update(f"{document.masks.digest} {cameras.frame}".encode())
    return digest.hexdigest()
