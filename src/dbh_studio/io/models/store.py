"""The model files on this computer: where they lie, whether they are whole, and how they get there.

Each model has a folder `models/NAME` in the cache. `installed.json` in it says of each file with which hash, size and
time it was accepted, so that 700 MB are hashed once and not at every start; a file that differs from its record, or has
none, is hashed before it is used.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.errors import MalformedFileError, ModelError, ProjectLockedError
from dbh_studio.io.atomic import atomic_file
from dbh_studio.io.lock import lock_file
from dbh_studio.io.models.cache import (
    CACHE_VARIABLE,
    OFFLINE_VARIABLE,
    FileState,
    InstalledFile,
    ModelState,
    Origin,
    files_of,
    is_offline,
    models_folder,
    sha256_of,
)
from dbh_studio.io.models.download import download
from dbh_studio.io.models.manifest import Manifest, ModelFile, ModelSpec, read_manifest
from dbh_studio.io.models.signature import open_graph, signature_problems

_RECORD = "installed.json"


class ModelStore:
    """The models in the cache. Making one reads the list and nothing else; it downloads only when `fetch` is called.

    Args:
        manifest: The list of models; the one that ships with the program where None.
        folder: See `models_folder`.
        offline: Whether downloads are forbidden; None asks the environment.
    """

    def __init__(
        self, manifest: Manifest | None = None, folder: Path | None = None, *, offline: bool | None = None
    ) -> None:
        self.manifest = read_manifest() if manifest is None else manifest
        self.folder = models_folder(folder)
        self.offline = is_offline() if offline is None else offline

    def state(self, name: str) -> ModelState:
        """What is there of a model, by sizes and times, without hashing.

        Raises:
            ModelError: There is no such model.
        """
        spec = self.manifest.get(name)
        record = self._record(spec)
        return ModelState(spec, tuple(self._file_state(spec, file, record) for file in spec.files))

    def states(self) -> tuple[ModelState, ...]:
        """`state` of every model of the list."""
        return tuple(self.state(spec.name) for spec in self.manifest.models)

    def ready(self, purpose: str) -> tuple[ModelSpec, ...]:
        """Models of a purpose that can be used now with all they need, the default first, then in the list's order."""
        usable = ("ready", "unchecked")
        found = [
            spec
            for spec in self.manifest.models
            if spec.purpose == purpose and all(self.state(name).state in usable for name in (spec.name, *spec.needs))
        ]
        return tuple(sorted(found, key=lambda spec: not spec.is_default))

    def paths(self, name: str, *, progress: Progress = ignore_progress) -> dict[str, Path]:
        """Role → path of the model's files and of those it needs, each checked before it is handed out.

        Raises:
            ModelError: A file is absent or not what it should be.
        """
        paths: dict[str, Path] = {}
        for spec in self.manifest.with_needs([name]):
            for file in self._accepted(spec, progress):
                if file.file.role != "data":
                    paths[file.file.role] = file.path
        return paths

    def rehash(self, name: str, *, progress: Progress = ignore_progress) -> None:
        """Read every byte of a model's files again and compare, whatever was noted of them.

        Raises:
            ModelError: A file is absent or not what it should be.
        """
        spec = self.manifest.get(name)
        for installed in self._accepted(spec, progress):
            if sha256_of(installed.path, progress) != installed.sha256:
                self._forget(spec, installed.file)
                raise self._damaged(spec, installed)

    def identity(self, name: str) -> str:
        """One sha256 for all files of a model that is ready, to be kept with what it made.

        Raises:
            ModelError: It is not ready.
        """
        digest = hashlib.sha256()
        for file in self._accepted(self.manifest.get(name), ignore_progress):
            digest.update(f"{file.file.name} {file.sha256}\n".encode())
        return digest.hexdigest()

    def fetch(self, names: Sequence[str] = (), *, progress: Progress = ignore_progress) -> tuple[ModelState, ...]:
        """Download what is missing of these models and of what they need; of the defaults where none is named.

        Whoever calls this has shown the person the size and the licence.

        Raises:
            ModelError: Downloads are forbidden or impossible, or a file is not what it should be.
            CancelledError: Raised by `progress`; what is there stays for the next time.
        """
        specs = self.manifest.with_needs(list(names or self.manifest.defaults))
        missing = [(spec, file.file) for spec in specs for file in self.state(spec.name).files if file.state != "ready"]
        if missing and self.offline:
            raise ModelError(f"Downloads are switched off ({OFFLINE_VARIABLE} or --offline).", self._by_hand(missing))
        weights = [file.n_bytes or 0 for _, file in missing]
        done, whole = 0, max(sum(weights), 1)
        for (spec, file), weight in zip(missing, weights, strict=True):
            part = subprogress(progress, done / whole, (done + weight) / whole)
            self._fetch_file(spec, file, part)
            done += weight
        progress(1.0, "The models are here.")
        return tuple(self.state(spec.name) for spec in specs)

    def add(
        self,
        paths: Sequence[Path],
        *,
        name: str | None = None,
        link: bool = False,
        progress: Progress = ignore_progress,
    ) -> tuple[ModelState, ...]:
        """Take files that were got by other means: known by their hash, or, where a model is named, by their signature.

        Args:
            paths: Files, or folders whose files are looked at.
            name: The model they are, for files whose hash is not in the list: an export of one's own. Their graphs must
                have that model's signature.
            link: Link to the files instead of copying them; they must then stay where they are.
            progress: Called while files are hashed.

        Returns:
            The models that got files, each as it is now.

        Raises:
            FileError: A file is missing or no graph.
            ModelError: No file belongs to a model, or one is not of the model's signature.
        """
        files = files_of(paths)
        specs = self.manifest.models if name is None else (self.manifest.get(name),)
        changed: dict[str, None] = {}
        left: list[tuple[Path, str]] = []
        done: set[str] = set()
        for index, path in enumerate(files):
            digest = sha256_of(path, subprogress(progress, index / len(files), (index + 1) / len(files)))
            owners = [(spec, file) for spec in specs for file in spec.files if file.sha256 == digest]
            for spec, file in owners:
                self._put(spec, file, path, digest, "pinned", link)
                changed[spec.name] = None
                done.add(file.name)
            if not owners:
                left.append((path, digest))
        if name is not None:
            self._add_unpinned(
                specs[0], [file for file in specs[0].files if file.name not in done], left, link, changed
            )
        if not changed:
            hashes = "; ".join(f"{path.name}: sha256 {digest}" for path, digest in left) or "no files"
            raise ModelError(
                f"None of the files is one of the list ({hashes}).",
                "Name the model they are with --as NAME; its signature is then checked instead of the hash.",
            )
        return tuple(self.state(one) for one in changed)

    # --- inside ---

    def _add_unpinned(
        self,
        spec: ModelSpec,
        wanted: Sequence[ModelFile],
        left: Sequence[tuple[Path, str]],
        link: bool,
        changed: dict[str, None],
    ) -> None:
        """By name, or by signature where there is one candidate."""
        for file in wanted:
            named = [(path, digest) for path, digest in left if path.name == file.name]
            chosen = named or ([left[0]] if len(left) == len(wanted) == 1 else [])
            if not chosen and file.signature is not None:
                graphs = [pair for pair in left if pair[0].suffix == ".onnx"]
                chosen = [pair for pair in graphs if not self._graph_problems(pair[0], file)]
            if len(chosen) != 1:
                continue
            path, digest = chosen[0]
            problems = self._graph_problems(path, file)
            if problems:
                raise ModelError(
                    f"{path.name} is not a {spec.title} file: {'; '.join(problems)}.",
                    "Use an export with the signature `dbh-studio models list --json` shows.",
                )
            self._put(spec, file, path, digest, "added", link)
            changed[spec.name] = None

    def _graph_problems(self, path: Path, file: ModelFile) -> tuple[str, ...]:
        if file.signature is None:
            return ()
        return signature_problems(open_graph(path, optimise=False), file.signature)

    def _put(self, spec: ModelSpec, file: ModelFile, source: Path, digest: str, origin: Origin, link: bool) -> None:
        target = self._path(spec, file)
        with self._writing(spec):
            if source.resolve() != target.resolve():
                if link:
                    target.unlink(missing_ok=True)
                    target.symlink_to(source.resolve())
                else:
                    with atomic_file(target) as copy, source.open("rb") as original:
                        shutil.copyfileobj(original, copy, 1 << 20)
            self._note(spec, file, digest, origin)

    def _fetch_file(self, spec: ModelSpec, file: ModelFile, progress: Progress) -> None:
        target = self._path(spec, file)
        with self._writing(spec):
            if self._accept_present(spec, file, progress):
                return
            part = target.with_name(f"{target.name}.part")
            for is_last in (False, True):
                was_there = part.exists()
                label = f"{spec.title}, {file.name}"
                download(file.url, part, n_bytes=file.n_bytes, progress=progress, label=label)
                digest = sha256_of(part, ignore_progress)
                if file.sha256 in (None, digest):
                    break
                part.unlink()
                # A part from another day may have been of another version of the file.
                if is_last or not was_there:
                    raise ModelError(
                        f"{file.url} is not the expected file: its sha256 is {digest}, not {file.sha256}.",
                        "It was deleted. Try again; if it is the same, it has been changed: update DBH Studio, or get "
                        "the file elsewhere and use `dbh-studio models add`.",
                    )
            os.replace(part, target)
            if file.sha256 is None:
                self._check_first_use(spec, file, target)
            self._note(spec, file, digest, "pinned" if file.sha256 else "first use")

    def _check_first_use(self, spec: ModelSpec, file: ModelFile, target: Path) -> None:
        """Without a hash in the list the signature is all there is to go by."""
        problems: tuple[str, ...] = ()
        try:
            # A graph whose weights come as another file cannot be opened before they are here; `paths` does it.
            if all(self._path(spec, other).exists() for other in spec.files):
                problems = self._graph_problems(target, file)
        except MalformedFileError as error:
            problems = (str(error),)
        if problems:
            target.unlink()
            raise ModelError(f"{file.url} is not a {spec.title} file: {'; '.join(problems)}.", "It was deleted.")

    def _accept_present(self, spec: ModelSpec, file: ModelFile, progress: Progress) -> bool:
        """Whether the right file is there, perhaps put there by hand; a wrong one is deleted."""
        target = self._path(spec, file)
        if not target.exists():
            target.unlink(missing_ok=True)  # a link to what is gone
            return False
        record = self._record(spec).get(file.name, {})
        if self._file_state(spec, file, {file.name: record}).state == "ready":
            return True
        digest = sha256_of(target, progress)
        if digest in (file.sha256, record.get("sha256")):
            self._note(spec, file, digest, record.get("origin") or "pinned")
            return True
        target.unlink()
        return False

    def _accepted(self, spec: ModelSpec, progress: Progress) -> tuple[InstalledFile, ...]:
        accepted = []
        for installed in self.state(spec.name).files:
            if installed.state in ("absent", "partial"):
                what = "was fetched in part only" if installed.state == "partial" else "is not on this computer"
                raise ModelError(
                    f"{spec.title} {what} ({installed.file.name}).",
                    f"`dbh-studio models fetch {spec.name}` fetches it ({spec.size_text}, {spec.licence}).",
                )
            if installed.state == "unchecked":
                installed = self._hash_again(spec, installed, progress)
            if installed.state != "ready":
                raise self._damaged(spec, installed)
            accepted.append(installed)
        return tuple(accepted)

    def _hash_again(self, spec: ModelSpec, installed: InstalledFile, progress: Progress) -> InstalledFile:
        """Ready where the content is what was accepted or what the list says; then it need not be asked again."""
        digest = sha256_of(installed.path, progress)
        file, origin = installed.file, ""
        if digest == installed.sha256:
            origin = installed.origin
        elif digest == file.sha256:
            origin = "pinned"
        elif file.sha256 is None and not installed.sha256 and not self._graph_problems(installed.path, file):
            origin = "first use"
        if not origin:
            return replace(installed, state="damaged")
        with contextlib.suppress(OSError):  # a cache of somebody else's is hashed each time
            self._note(spec, file, digest, origin)
        return replace(installed, state="ready", sha256=digest, origin=origin)

    def _damaged(self, spec: ModelSpec, installed: InstalledFile) -> ModelError:
        return ModelError(
            f"{installed.path} is not the file that was accepted.",
            f"`dbh-studio models fetch {spec.name}` fetches it again.",
        )

    def _file_state(self, spec: ModelSpec, file: ModelFile, record: dict[str, Any]) -> InstalledFile:
        path = self._path(spec, file)
        noted = record.get(file.name) or {}
        digest, origin = str(noted.get("sha256", "")), str(noted.get("origin", ""))
        # A new list may want another file than the one that was right for the old one.
        if origin == "pinned" and file.sha256 is not None and digest != file.sha256:
            digest, origin = "", ""
        try:
            status = path.stat()
        except OSError:
            part = path.with_name(f"{path.name}.part")
            have = part.stat().st_size if part.is_file() else 0
            return InstalledFile(file, path, "partial" if have else "absent", have, "", "")
        if digest and (status.st_size, status.st_mtime_ns) == (noted.get("bytes"), noted.get("mtime_ns")):
            state: FileState = "ready"
        else:
            expected = noted.get("bytes") if digest else file.n_bytes
            state = "unchecked" if expected in (None, status.st_size) else "damaged"
        return InstalledFile(file, path, state, status.st_size, digest, origin)

    def _path(self, spec: ModelSpec, file: ModelFile) -> Path:
        return self.folder / spec.name / file.name

    def _record(self, spec: ModelSpec) -> dict[str, Any]:
        try:
            record = json.loads((self.folder / spec.name / _RECORD).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}  # the files are then hashed again
        sound = isinstance(record, dict) and all(isinstance(entry, dict) for entry in record.values())
        return record if sound else {}

    def _note(self, spec: ModelSpec, file: ModelFile, digest: str, origin: str) -> None:
        status = self._path(spec, file).stat()
        entry = {"sha256": digest, "bytes": status.st_size, "mtime_ns": status.st_mtime_ns, "origin": origin}
        record = {**self._record(spec), file.name: {**entry, "source": file.url if origin != "added" else ""}}
        with atomic_file(self.folder / spec.name / _RECORD) as out:
            out.write(json.dumps(record, indent=2).encode())

    def _forget(self, spec: ModelSpec, file: ModelFile) -> None:
        """The note stays, so that what was accepted is known; but it no longer matches the file's time."""
        record = self._record(spec)
        record[file.name] = {**record.get(file.name, {}), "mtime_ns": -1}
        with atomic_file(self.folder / spec.name / _RECORD) as out:
            out.write(json.dumps(record, indent=2).encode())

    @contextmanager
    def _writing(self, spec: ModelSpec) -> Iterator[None]:
        """One process at a time for each model."""
        folder = self.folder / spec.name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = lock_file(folder / ".lock")
        except ProjectLockedError as error:
            raise ModelError(f"Another process is fetching {spec.title}.", "Wait until it is done.") from error
        except OSError as error:
            raise self._no_folder(error) from error
        try:
            yield
        except OSError as error:
            raise self._no_folder(error) from error
        finally:
            lock.close()

    def _no_folder(self, error: OSError) -> ModelError:
        remedy = f"Make room, or set {CACHE_VARIABLE} to a folder that can be written."
        return ModelError(f"Models cannot be kept in {self.folder} ({error.strerror or error}).", remedy)

    def _by_hand(self, missing: Sequence[tuple[ModelSpec, ModelFile]]) -> str:
        lines = [f"  {file.url}\n    sha256 {file.sha256 or 'not known'}" for _, file in missing]
        return "\n".join(["Fetch these on another computer, and then use `dbh-studio models add`:", *lines])
