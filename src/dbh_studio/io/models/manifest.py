"""The list of models the studio can run: `assets/models.json`."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

from dbh_studio.errors import MalformedFileError, MissingComponentError, ModelError

Purpose = Literal["detector", "segmenter", "tokenizer"]
_PURPOSES = ("detector", "segmenter", "tokenizer")
_ROLES = ("model", "encoder", "decoder", "data", "vocabulary")
_VERSION = 1
_LOOPBACK = ("127.0.0.1", "localhost", "::1")


@dataclass(frozen=True)
class Tensor:
    """One input or output of a graph.

    Attributes:
        name: As in the graph.
        dtype: ``float`` (32 or 16 bits), ``int64``, …
        shape: Its lengths; None is any.
        is_fixed: Whether the graph itself must fix the lengths, because it is wrong at others without saying so.
    """

    name: str
    dtype: str
    shape: tuple[int | None, ...]
    is_fixed: bool = False


@dataclass(frozen=True)
class Signature:
    """What a graph takes and gives."""

    name: str
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]


@dataclass(frozen=True)
class ModelFile:
    """One file of a model.

    Attributes:
        name: Its name in the cache; data files must keep theirs, for the graph names them.
        role: ``model``, ``encoder``, ``decoder``, ``data`` (weights beside a graph) or ``vocabulary``.
        url: Where it is published.
        n_bytes: Its size; None where nobody states it.
        sha256: Its hash; None where nobody states it: then the first download decides.
        hash_seen_in: In how many public projects this hash was found.
        signature: What the graph must take and give; None for what is no graph.
    """

    name: str
    role: str
    url: str
    n_bytes: int | None
    sha256: str | None
    hash_seen_in: int
    signature: Signature | None


@dataclass(frozen=True)
class ModelSpec:
    """One model of the list.

    Attributes:
        name: What it is called on the command line, and its folder in the cache.
        title: What it is called in the studio.
        purpose: What it does.
        family: How it is run: ``gdino``, ``sam-meta``, ``sam2``, ``wordpiece``.
        precision: ``float32``, ``float16``, ``int8`` or empty.
        licence: Short name of the licence.
        licence_url: Its text.
        source: The page it is published on.
        revision: The version of that page.
        needs: Names of models it does not run without.
        is_default: Whether it is the one offered first for its purpose.
        note: What the person should know.
        files: What it is made of.
    """

    name: str
    title: str
    purpose: Purpose
    family: str
    precision: str
    licence: str
    licence_url: str
    source: str
    revision: str
    needs: tuple[str, ...]
    is_default: bool
    note: str
    files: tuple[ModelFile, ...]

    @property
    def n_bytes(self) -> int:
        """How much is downloaded, as far as it is known."""
        return sum(file.n_bytes or 0 for file in self.files)

    @property
    def size_text(self) -> str:
        """``45 MB``, ``232 kB``, or a question mark where nobody states it."""
        if any(file.n_bytes is None for file in self.files):
            return "? MB"
        return f"{self.n_bytes / 1e6:,.0f} MB" if self.n_bytes >= 1e6 else f"{self.n_bytes / 1e3:,.0f} kB"


@dataclass(frozen=True)
class Manifest:
    """All models, in the order in which they are offered."""

    models: tuple[ModelSpec, ...]

    def get(self, name: str) -> ModelSpec:
        """The model of this name.

        Raises:
            ModelError: There is none.
        """
        for model in self.models:
            if model.name == name:
                return model
        known = ", ".join(model.name for model in self.models)
        raise ModelError(f"There is no model {name!r}.", f"Known are {known}.")

    def with_needs(self, names: tuple[str, ...] | list[str]) -> tuple[ModelSpec, ...]:
        """These models and what they need, each once, the needed first.

        Raises:
            ModelError: A name is unknown.
        """
        chosen: dict[str, ModelSpec] = {}
        for name in names:
            model = self.get(name)
            for need in model.needs:
                chosen[need] = self.get(need)
            chosen[name] = model
        return tuple(chosen.values())

    @property
    def defaults(self) -> tuple[str, ...]:
        """Names of the models offered first: one for each purpose."""
        return tuple(model.name for model in self.models if model.is_default)


def read_manifest(path: Path | None = None) -> Manifest:
    """Read the list that ships with the program, or another.

    Raises:
        MissingComponentError: The list is not where the program was installed.
        MalformedFileError: It is no such list, or an address in it is not encrypted.
    """
    path = _shipped() if path is None else Path(path)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["version"] != _VERSION:
            raise ValueError(f"version {data['version']}")
        signatures = {name: _signature(name, entry) for name, entry in data["signatures"].items()}
        models = tuple(_model(entry, signatures) for entry in data["models"])
        names = [model.name for model in models]
        if len(set(names)) != len(names):
            raise ValueError("two models have the same name")
        manifest = Manifest(models)
        manifest.with_needs(names)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ModelError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise MalformedFileError(path, f"This is no list of models ({reason}).", "Install DBH Studio again.") from error
    return manifest


def _shipped() -> Path:
    package = Path(__file__).resolve().parents[2]
    for assets in (package / "assets", package.parents[1] / "assets"):
        if (assets / "models.json").is_file():
            return assets / "models.json"
    raise MissingComponentError("The list of models (models.json) is missing.", "Install DBH Studio again.")


def _signature(name: str, entry: Mapping[str, Any]) -> Signature:
    def tensors(key: str) -> tuple[Tensor, ...]:
        return tuple(
            Tensor(str(t["name"]), str(t["dtype"]), tuple(t["shape"]), bool(t.get("fixed", False))) for t in entry[key]
        )

    return Signature(name, tensors("inputs"), tensors("outputs"))


def _model(entry: Mapping[str, Any], signatures: Mapping[str, Signature]) -> ModelSpec:
    files = tuple(_file(file, signatures) for file in entry["files"])
    if entry["purpose"] not in _PURPOSES:
        raise ValueError(f"unknown purpose {entry['purpose']!r}")
    if not files or len({file.name for file in files}) != len(files):
        raise ValueError(f"{entry['name']} has no files, or two of one name")
    if not entry["licence"]:
        raise ValueError(f"{entry['name']} has no licence")
    texts = ("title", "purpose", "family", "precision", "licence", "licence_url", "source", "revision", "note")
    return ModelSpec(
        name=_safe_name(entry["name"]),
        needs=tuple(entry["needs"]),
        is_default=bool(entry["is_default"]),
        files=files,
        **{key: str(entry[key]) for key in texts},  # type: ignore[arg-type]
    )


def _file(entry: Mapping[str, Any], signatures: Mapping[str, Signature]) -> ModelFile:
    url, digest, size = str(entry["url"]), entry["sha256"], entry["bytes"]
    parts = urlsplit(url)
    # A hash vouches for the content; without encryption others would still see who fetches what.
    if parts.scheme != "https" and not (parts.scheme == "http" and parts.hostname in _LOOPBACK):
        raise ValueError(f"{url} is not an https address")
    if digest is not None and not re.fullmatch(r"[0-9a-f]{64}", digest):
        raise ValueError(f"{digest!r} is no sha256")
    if size is not None and (not isinstance(size, int) or size <= 0):
        raise ValueError(f"{size!r} is no size")
    if entry["role"] not in _ROLES:
        raise ValueError(f"unknown role {entry['role']!r}")
    signature = signatures[entry["signature"]] if entry.get("signature") else None
    seen = int(entry.get("hash_seen_in", 0))
    return ModelFile(_safe_name(entry["name"]), str(entry["role"]), url, size, digest, seen, signature)


def _safe_name(name: str) -> str:
    """A name that stays in the folder it is put in."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name):
        raise ValueError(f"{name!r} is no name for a file")
    return name
