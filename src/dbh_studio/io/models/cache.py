"""What can be said of the model files on this computer, and where they lie."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from platformdirs import user_cache_dir

from dbh_studio.core.progress import Progress
from dbh_studio.errors import FileMissingError
from dbh_studio.io.models.manifest import ModelFile, ModelSpec

CACHE_VARIABLE, OFFLINE_VARIABLE = "DBH_STUDIO_CACHE", "DBH_STUDIO_OFFLINE"
FileState = Literal["ready", "unchecked", "partial", "absent", "damaged"]
# How a file came to be trusted.
Origin = Literal["pinned", "first use", "added"]
_YES = ("1", "true", "yes", "on")


@dataclass(frozen=True)
class InstalledFile:
    """One file of a model, as it is on this computer.

    Attributes:
        file: What it should be.
        path: Where it lies or would lie.
        state: ``ready``; ``unchecked``: there, but not hashed yet; ``partial``: a download broke off; ``absent``;
            ``damaged``: its content is not what was accepted.
        n_bytes: How much of it is there.
        sha256: The hash it was accepted with; empty where it was not.
        origin: ``pinned``: the hash of the list; ``first use``: there was none in the list, and this one was recorded;
            ``added``: a person brought another file of the same signature; empty where it was not accepted.
    """

    file: ModelFile
    path: Path
    state: FileState
    n_bytes: int
    sha256: str
    origin: str


@dataclass(frozen=True)
class ModelState:
    """One model, as it is on this computer."""

    spec: ModelSpec
    files: tuple[InstalledFile, ...]

    @property
    def state(self) -> FileState:
        """``ready`` where all files are, else what is worst."""
        states = {file.state for file in self.files}
        if states == {"absent"}:
            return "absent"
        for state in ("damaged", "partial", "absent", "unchecked"):
            if state in states:
                return "partial" if state == "absent" else state
        return "ready"

    @property
    def origin(self) -> str:
        """The weakest of the files' origins."""
        origins = {file.origin for file in self.files}
        return next((origin for origin in ("", "added", "first use", "pinned") if origin in origins), "")


def models_folder(folder: Path | None = None) -> Path:
    """The given folder, else ``models`` in the folder DBH_STUDIO_CACHE names, else in the user's cache."""
    if folder is not None:
        return Path(folder)
    named = os.environ.get(CACHE_VARIABLE)
    return (Path(named) if named else Path(user_cache_dir("dbh-studio", appauthor=False))) / "models"


def is_offline() -> bool:
    """Whether DBH_STUDIO_OFFLINE forbids downloads."""
    return os.environ.get(OFFLINE_VARIABLE, "").strip().lower() in _YES


def sha256_of(path: Path, progress: Progress) -> str:
    """The hash of a file; `progress` may stop it.

    Raises:
        OSError: It cannot be read.
    """
    digest, done, size = hashlib.sha256(), 0, max(path.stat().st_size, 1)
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
            done += len(block)
            progress(min(done / size, 1.0), f"Checking {path.name}")
    return digest.hexdigest()


def files_of(paths: Sequence[Path]) -> list[Path]:
    """The files themselves, those in the folders, and the weights beside a graph.

    Raises:
        FileMissingError: There is no such file or folder.
    """
    files: dict[Path, None] = {}
    for path in paths:
        if path.is_dir():
            files.update(dict.fromkeys(sorted(entry for entry in path.iterdir() if entry.is_file())))
        elif path.is_file():
            files[path] = None
            data = path.with_name(f"{path.name}_data")
            if path.suffix == ".onnx" and data.is_file():
                files[data] = None
        else:
            raise FileMissingError(path, "There is no such file.", "Give the path of a model's file or folder.")
    return list(files)
