"""Files that come from the browser: limited, named safely, and written to disk part by part.

viser itself keeps an upload in memory twice, without limit and under the name the page gives. Here the parts go
straight to a temporary file, so a large cloud costs no memory, and only to buttons that were given a rule.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import unicodedata
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from dbh_studio.errors import EmptyFileError, FileError, UnsupportedFormatError

DEFAULT_MAX_UPLOAD_BYTES = 1 << 30
MAX_TRANSFERS_PER_TAB = 2
_SPARE_DISK_BYTES = 256 << 20
_MAX_NAME_BYTES = 120
_RESERVED = {"con", "prn", "aux", "nul", *(f"{kind}{i}" for kind in ("com", "lpt") for i in range(1, 10))}
_RULE = "studio_upload_rule"


@dataclass(frozen=True)
class UploadedFile:
    """A file that has arrived completely.

    Attributes:
        name: Safe as a file name.
        path: Where it lies for now; it is deleted when the upload's handler returns. Keep it with `receive`.
        size_bytes: Length.
    """

    name: str
    path: Path
    size_bytes: int

    def discard(self) -> None:
        """Delete the temporary file, if `receive` has not taken it."""
        self.path.unlink(missing_ok=True)


@dataclass(frozen=True)
class UploadRule:
    """What one upload button accepts, and whom to tell. The callbacks run on the event loop and must only enqueue.

    Attributes:
        suffixes: Lower case, with the dot: ``(".ply", ".las")``.
        max_bytes: Of one file; the server's own limit holds as well.
        on_done: Called with the complete file; whoever takes it discards it.
        on_refused: Called with the reason.
        on_progress: Called with the bytes received and the total.
    """

    suffixes: tuple[str, ...]
    max_bytes: int
    on_done: Callable[[UploadedFile], None]
    on_refused: Callable[[FileError], None]
    on_progress: Callable[[int, int], Any] | None = None


def set_rule(upload_button: Any, rule: UploadRule | None) -> None:
    """Let a viser upload button accept files; without a rule it accepts none."""
    setattr(upload_button._impl, _RULE, rule)


def rule_of(upload_button: Any) -> UploadRule | None:
    """The rule given to a viser upload button."""
    rule = getattr(upload_button._impl, _RULE, None)
    return rule if isinstance(rule, UploadRule) else None


def safe_name(name: str) -> str:
    """The last part of `name`, without anything that a file system reads as more than a name; never empty."""
    name = unicodedata.normalize("NFC", name).replace("\\", "/").rsplit("/", 1)[-1]
    name = "".join(c for c in name if c.isprintable())
    name = re.sub(r'[<>:"|?*]', "_", name).strip(" .")
    stem, dot, suffix = name.rpartition(".")
    if not dot:
        stem, suffix = suffix, ""
    stem, suffix = stem.strip(" ."), suffix[:20].strip()
    if not stem or stem.split(".")[0].lower() in _RESERVED:
        stem = f"upload_{stem}".rstrip("_")
    while len(f"{stem}.{suffix}".encode()) > _MAX_NAME_BYTES:
        stem = stem[:-1].rstrip(" .")
    return f"{stem}.{suffix}" if suffix else stem


def receive(uploaded_file: UploadedFile, folder: Path, *, allowed_suffixes: tuple[str, ...]) -> Path:
    """Move an uploaded file into `folder` under its own name; a taken name gets a number.

    Raises:
        UnsupportedFormatError: The name does not end in one of `allowed_suffixes`.
        FileError: It cannot be written there.
    """
    check_suffix(uploaded_file.name, allowed_suffixes)
    name = Path(safe_name(uploaded_file.name))
    number, target = 1, folder / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
        while True:
            try:
                os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644))
                break
            except FileExistsError:
                number += 1
                target = folder / f"{name.stem} ({number}){name.suffix}"
        try:
            shutil.move(uploaded_file.path, target)
        except OSError:
            target.unlink(missing_ok=True)
            raise
    except OSError as error:
        reason = error.strerror or str(error)
        raise FileError(
            name, f"The upload could not be kept: {reason}.", "Is there space, and may the folder be written?"
        ) from None
    return target


def check_suffix(name: str, suffixes: tuple[str, ...]) -> None:
    """Raise UnsupportedFormatError where `name` ends in none of `suffixes`."""
    if not name.lower().endswith(tuple(suffixes)):
        raise UnsupportedFormatError(name, "This kind of file is not accepted here.", f"Use {', '.join(suffixes)}.")


@dataclass
class _Transfer:
    rule: UploadRule
    name: str
    path: Path
    file: BinaryIO
    n_parts: int
    n_bytes: int
    next_part: int = 0
    received: int = 0


class UploadDesk:
    """The transfers under way on one server. All methods run on its event loop.

    Args:
        max_bytes: No upload may be larger.
    """

    def __init__(self, max_bytes: int = DEFAULT_MAX_UPLOAD_BYTES) -> None:
        self._max_bytes = max_bytes
        self._folder: Path | None = None
        self._transfers: dict[tuple[int, str], _Transfer] = {}

    def start(self, tab: int, transfer: str, rule: UploadRule, name: str, n_parts: int, n_bytes: int) -> bool:
        """Accept an announced file or tell the rule why not. Returns whether parts may come."""
        name = safe_name(name)
        try:
            self._check(tab, transfer, rule, name, n_parts, n_bytes)
            path = self._own_folder() / uuid.uuid4().hex
            file = path.open("xb")
        except FileError as error:
            rule.on_refused(error)
            return False
        except OSError as error:
            rule.on_refused(
                FileError(name, f"The upload could not be kept: {error.strerror}.", "Free some disk space.")
            )
            return False
        self._transfers[tab, transfer] = _Transfer(rule, name, path, file, n_parts, n_bytes)
        return True

    def _check(self, tab: int, transfer: str, rule: UploadRule, name: str, n_parts: int, n_bytes: int) -> None:
        check_suffix(name, rule.suffixes)
        limit = min(rule.max_bytes, self._max_bytes)
        if n_bytes > limit:
            raise FileError(
                name,
                f"The file has {n_bytes / 2**20:.0f} MB but an upload may have {limit / 2**20:.0f} MB.",
                "Open it by its path instead: the server reads it without a copy.",
            )
        if n_bytes <= 0 or n_parts <= 0:
            raise EmptyFileError(name, "The file is empty.", "Choose another file.")
        busy = sum(owner == tab for owner, _ in self._transfers)
        if (tab, transfer) in self._transfers or busy >= MAX_TRANSFERS_PER_TAB:
            raise FileError(name, "Another upload is still running.", "Wait for it to finish.")
        if shutil.disk_usage(self._own_folder()).free < n_bytes + _SPARE_DISK_BYTES:
            raise FileError(
                name, "The disk is too full for this upload.", "Free some space or open the file by its path."
            )

    def part(self, tab: int, transfer: str, index: int, content: bytes) -> tuple[int, int] | None:
        """Append one part. Returns bytes received and total, or None where it belongs to no accepted file.

        A page sends its parts in order; anything else ends the transfer.
        """
        state = self._transfers.get((tab, transfer))
        if state is None:
            return None
        received = state.received + len(content)
        if index != state.next_part or received > state.n_bytes or not content:
            self._refuse(tab, transfer, "The upload was damaged on its way.")
            return None
        try:
            state.file.write(content)
        except OSError as error:
            self._refuse(tab, transfer, f"The upload could not be kept: {error.strerror}.")
            return None
        state.next_part, state.received = index + 1, received
        if state.rule.on_progress is not None:
            state.rule.on_progress(received, state.n_bytes)
        if state.next_part == state.n_parts:
            self._finish(tab, transfer)
        return received, state.n_bytes

    def _finish(self, tab: int, transfer: str) -> None:
        state = self._transfers[tab, transfer]
        if state.received != state.n_bytes:
            self._refuse(tab, transfer, "The upload is incomplete.")
            return
        del self._transfers[tab, transfer]
        state.file.close()
        state.rule.on_done(UploadedFile(state.name, state.path, state.n_bytes))

    def _refuse(self, tab: int, transfer: str, problem: str) -> None:
        state = self._drop(tab, transfer)
        state.rule.on_refused(FileError(state.name, problem, "Try again, or open the file by its path."))

    def _drop(self, tab: int, transfer: str) -> _Transfer:
        state = self._transfers.pop((tab, transfer))
        state.file.close()
        state.path.unlink(missing_ok=True)
        return state

    def drop_tab(self, tab: int) -> None:
        """Forget what a closed tab was sending."""
        for owner, transfer in [key for key in self._transfers if key[0] == tab]:
            self._drop(owner, transfer)

    def close(self) -> None:
        """Forget everything and delete the temporary folder."""
        for tab, transfer in list(self._transfers):
            self._drop(tab, transfer)
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    def _own_folder(self) -> Path:
        if self._folder is None or not self._folder.is_dir():  # systems sweep their temporary folders
            self._folder = Path(tempfile.mkdtemp(prefix="dbh-studio-uploads-"))
        return self._folder
