"""The masks kept beside a plot, `NAME.dbh/masks/`: small, written photo by photo, used again only if nothing changed.

`index.jsonl` says in one line per mask what it was made from; the last line of a photo counts. A line is appended only
after its picture is complete, so after a kill at any moment each photo is either done or to be done again. The picture
is a PNG: 1 bit where there is one number only, else 8 or 16 bits with a number per trunk, the highest level "ignored".
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
from collections.abc import Container, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from dbh_studio.errors import FileError, UnsupportedFormatError
from dbh_studio.io.atomic import atomic_file
from dbh_studio.io.masks.meaning import TrunkMask
from dbh_studio.io.masks.picture import MAX_PIXELS
from dbh_studio.io.ownfile import open_own_file
from dbh_studio.io.photos import open_picture

Review = Literal["", "accepted", "rejected", "repainted"]
_INDEX = "index.jsonl"
_HEADER = {"format": "dbh-studio masks", "version": 1}
# Above so many superseded lines the index is written anew when the store is opened.
_MAX_STALE = 2_000
_MAX_INDEX_BYTES = 500_000_000


@dataclass(frozen=True)
class MaskRecipe:
    """All that decides what a mask looks like, besides the photo.

    Attributes:
        method: ``grounded_sam``, ``prompted_sam``, ``imported``, ``painted``, …
        models: Model name → sha256 of its files.
        prompt: The text looked for.
        options: Thresholds and settings, plain JSON values.
    """

    method: str
    models: Mapping[str, str] = field(default_factory=dict)
    prompt: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """The same for the same recipe, whatever the order in which it was written down."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class StoredMask:
    """One line of the index.

    Attributes:
        image: The photo's name.
        file: The picture's name in the folder.
        sha256: Of the picture's bytes.
        width_px: The mask's width.
        height_px: Its height.
        has_instances: As in `TrunkMask`.
        has_ignored: Whether the highest level means ignored.
        n_trunks: How many trunks, or 1 where they are not told apart; 0 where there is none.
        scores: As in `TrunkMask`, the numbers as text.
        photo: The photo's ``bytes``, ``mtime_ns`` and ``sha256`` when it was made.
        recipe: As a dictionary.
        key: The recipe's key.
        review: What a person said about it.
    """

    image: str
    file: str
    sha256: str
    width_px: int
    height_px: int
    has_instances: bool
    has_ignored: bool
    n_trunks: int
    scores: Mapping[str, float]
    photo: Mapping[str, Any]
    recipe: Mapping[str, Any]
    key: str
    review: Review = ""

    @property
    def is_painted(self) -> bool:
        """Whether a person painted it, rejected since or not: it must not be made anew."""
        return self.review == "repainted" or self.recipe.get("method") == "painted"


class MaskStore:
    """The masks of one plot. One process writes at a time: the plot's lock, or the one job it started.

    Args:
        folder: `NAME.dbh/masks`; made when the first mask is stored.

    Raises:
        FileError: The index cannot be read, or is a newer program's.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        self._entries: dict[str, StoredMask] = {}
        self._load()

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def entries(self) -> tuple[StoredMask, ...]:
        """What is stored, in the order it was; whether the photos are still the same is asked for each."""
        return tuple(self._entries.values())

    def entry(self, image: str) -> StoredMask | None:
        """What is stored for a photo, whatever it was made from."""
        return self._entries.get(image)

    def put(self, image: str, photo: Path, mask: TrunkMask, recipe: MaskRecipe, *, review: Review = "") -> StoredMask:
        """Store the mask of one photo; when this returns, it is on the disk.

        Raises:
            FileError: The folder cannot be written, or the photo cannot be read.
        """
        if review not in get_args(Review):
            raise ValueError(f"unknown review {review!r}")
        data, has_ignored = _to_png(mask)
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", Path(image).stem)[:40].strip("_") or "photo"
        name = f"{stem}-{hashlib.sha256(image.encode()).hexdigest()[:12]}.png"
        entry = StoredMask(
            image=image,
            file=name,
            sha256=hashlib.sha256(data).hexdigest(),
            width_px=mask.size[0],
            height_px=mask.size[1],
            has_instances=mask.has_instances,
            has_ignored=has_ignored,
            n_trunks=len(mask.numbers),
            scores={str(number): round(float(score), 4) for number, score in (mask.scores or {}).items()},
            photo=_photo_state(photo, with_digest=True),
            recipe=asdict(recipe),
            key=recipe.key,
            review=review,
        )
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with atomic_file(self.folder / name) as file:
                file.write(data)
            self._append(entry)
        except OSError as error:
            raise self._cannot_write(error) from error
        return entry

    def set_review(self, image: str, review: Review) -> None:
        """Note what a person said about a mask.

        Raises:
            KeyError: There is none.
            FileError: The folder cannot be written.
        """
        try:
            self._append(replace(self._entries[image], review=review))
        except OSError as error:
            raise self._cannot_write(error) from error

    def get(self, image: str, photo: Path | None = None, recipe: MaskRecipe | None = None) -> TrunkMask | None:
        """The mask of a photo; None where there is none, it is damaged, or what it was made from has changed.

        A damaged one is forgotten, so that it is made again.

        Args:
            image: The photo's name.
            photo: The file now; None does not ask whether it changed.
            recipe: What it would be made with now; None takes any. What a person painted is always taken.
        """
        entry = self._entries.get(image)
        if entry is None or not self._is_current(entry, photo, recipe):
            return None
        try:
            if not self._is_whole(entry):
                raise ValueError("the picture is not what was written")
            return _from_png(self.folder / entry.file, entry)
        except (OSError, ValueError, SyntaxError):
            del self._entries[image]
            return None

    def is_of(self, image: str, photo: Path | str | None) -> bool:
        """Whether there is a mask of a photo as the photo is now; a photo that is not on this computer has not changed.

        Its picture is not read: `get` and `read_stored` tell whether that is whole.
        """
        entry = self._entries.get(image)
        return entry is not None and self._is_current(entry, None if photo is None else Path(photo), None)

    def take(self, other: MaskStore, images: Container[str] | None = None) -> None:
        """Copy masks of another store, with what a person said of them; of a photo that both have, the other's.

        Each is either here or not, whenever this is interrupted.

        Args:
            other: The store.
            images: Only of these photos; None takes all.

        Raises:
            FileError: A picture cannot be read, or the folder cannot be written.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            for entry in other.entries:
                if images is not None and entry.image not in images:
                    continue
                try:
                    data = (other.folder / entry.file).read_bytes()
                except FileNotFoundError:
                    continue  # it would be made anew there, too
                with atomic_file(self.folder / entry.file) as file:
                    file.write(data)
                self._append(entry)
        except OSError as error:
            raise self._cannot_write(error) from error

    def to_do(self, photos: Mapping[str, Path], recipe: MaskRecipe) -> tuple[str, ...]:
        """Names of the photos whose mask is missing, damaged or made from something else, in the order given."""
        entries = ((image, self._entries.get(image)) for image in photos)
        return tuple(
            image
            for image, entry in entries
            if entry is None or not self._is_current(entry, photos[image], recipe) or not self._is_whole(entry)
        )

    def remove(self, images: Iterable[str] | None = None) -> None:
        """Forget the masks of some photos, or all, and delete their pictures.

        Raises:
            FileError: The folder cannot be written.
        """
        names = list(self._entries) if images is None else [name for name in images if name in self._entries]
        files = [self._entries.pop(name).file for name in names]
        try:
            self._rewrite()
            for file in files:
                (self.folder / file).unlink(missing_ok=True)
        except OSError as error:
            raise self._cannot_write(error) from error

    @property
    def n_bytes(self) -> int:
        """How much the pictures take on the disk."""
        paths = [self.folder / entry.file for entry in self._entries.values()]
        return sum(path.stat().st_size for path in paths if path.is_file())

    def _is_whole(self, entry: StoredMask) -> bool:
        try:
            return hashlib.sha256((self.folder / entry.file).read_bytes()).hexdigest() == entry.sha256
        except OSError:
            return False

    def _is_current(self, entry: StoredMask, photo: Path | None, recipe: MaskRecipe | None) -> bool:
        if recipe is not None and entry.key != recipe.key and not entry.is_painted:
            return False
        return photo is None or _is_same_photo(photo, entry.photo)

    def _append(self, entry: StoredMask) -> None:
        line = json.dumps(asdict(entry), ensure_ascii=False) + "\n"
        path = self.folder / _INDEX
        if not path.exists():
            self._rewrite()
        descriptor = open_own_file(path, os.O_RDWR | os.O_APPEND)
        with open(descriptor, "r+b") as file:
            # What a kill left of a line must not spoil the next one.
            if file.seek(0, os.SEEK_END) and (file.seek(-1, os.SEEK_END), file.read(1))[1] != b"\n":
                line = "\n" + line
            file.write(line.encode())
            file.flush()
            os.fsync(file.fileno())
        self._entries.pop(entry.image, None)
        self._entries[entry.image] = entry

    def _rewrite(self) -> None:
        if not self._entries and not self.folder.is_dir():
            return
        lines = [_HEADER, *(asdict(entry) for entry in self._entries.values())]
        with atomic_file(self.folder / _INDEX) as file:
            file.write("".join(json.dumps(line, ensure_ascii=False) + "\n" for line in lines).encode())

    def _load(self) -> None:
        path = self.folder / _INDEX
        try:
            if path.stat().st_size > _MAX_INDEX_BYTES:
                raise FileError(path, "The list of masks is too large.", "Delete it; the masks are then made again.")
            lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
        except FileNotFoundError:
            return
        except OSError as error:
            raise FileError(path, f"The list of masks cannot be read ({error.strerror}).") from error
        header = _json_object(lines[0]) if lines else None
        if header is not None and header.get("version", 1) != _HEADER["version"]:
            raise UnsupportedFormatError(path, "The masks were stored by another version.", "Use that one.")
        n_lines = 0
        for line in lines[1:]:
            entry = _entry_from(_json_object(line))
            if entry is not None:
                n_lines += 1
                self._entries.pop(entry.image, None)
                self._entries[entry.image] = entry
        if n_lines - len(self._entries) > _MAX_STALE:
            try:
                self._rewrite()
            except OSError as error:
                raise self._cannot_write(error) from error

    def _cannot_write(self, error: OSError) -> FileError:
        reason = error.strerror or str(error)
        return FileError(self.folder, f"The masks cannot be stored: {reason}.", "Make room, or allow writing there.")


def read_stored(folder: Path, entry: StoredMask) -> TrunkMask:
    """The mask of a line of the index, without the store it is from; for jobs that only read.

    Raises:
        FileError: The picture is missing or damaged.
    """
    path = folder / entry.file
    try:
        if hashlib.sha256(path.read_bytes()).hexdigest() != entry.sha256:
            raise ValueError("it is not what was written")
        return _from_png(path, entry)
    except (OSError, ValueError, SyntaxError) as error:
        raise FileError(
            path, f"The mask cannot be read ({error}).", "Make it anew: `dbh-studio masks make`."
        ) from error


def _json_object(line: str) -> dict[str, Any] | None:
    try:
        value = json.loads(line)
    except ValueError:
        return None
    return value if isinstance(value, dict) else None


def _entry_from(data: dict[str, Any] | None) -> StoredMask | None:
    """None for what is no whole entry: a mask that is made again is better than one that is not this photo's."""
    if data is None:
        return None
    try:
        entry = StoredMask(**data)
    except TypeError:
        return None
    texts = (entry.image, entry.file, entry.sha256, entry.key)
    is_sound = (
        all(isinstance(text, str) for text in texts)
        and re.fullmatch(r"[A-Za-z0-9_-]+\.png", entry.file) is not None
        and all(isinstance(n, int) and n > 0 for n in (entry.width_px, entry.height_px))
        and all(isinstance(part, dict) for part in (entry.scores, entry.photo, entry.recipe))
        and entry.review in get_args(Review)
        and isinstance(entry.n_trunks, int)
        and all(isinstance(score, (int, float)) for score in entry.scores.values())
        and isinstance(entry.recipe.get("method"), str)
    )
    return entry if is_sound else None


def _photo_state(photo: Path, *, with_digest: bool) -> dict[str, Any]:
    try:
        status = Path(photo).stat()
        state: dict[str, Any] = {"bytes": status.st_size, "mtime_ns": status.st_mtime_ns}
        if with_digest:
            state["sha256"] = _digest(str(Path(photo).absolute()), status.st_size, status.st_mtime_ns)
        return state
    except OSError as error:
        raise FileError(photo, f"The photo cannot be read ({error.strerror or error}).", "Copy it again.") from error


@lru_cache(maxsize=10_000)
def _digest(photo: str, _n_bytes: int, _mtime_ns: int) -> str:
    """Of a file as it is at this size and time: of a copied folder, all photos are asked for at every look."""
    digest = hashlib.sha256()
    with open(photo, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _is_same_photo(photo: Path, then: Mapping[str, Any]) -> bool:
    """Size and time, and where only the time differs (a copied folder) the content."""
    try:
        now = _photo_state(photo, with_digest=False)
        if now["bytes"] != then.get("bytes"):
            return False
        if now["mtime_ns"] == then.get("mtime_ns"):
            return True
        return bool(_photo_state(photo, with_digest=True)["sha256"] == then.get("sha256"))
    except FileError:
        return False


def _to_png(mask: TrunkMask) -> tuple[bytes, bool]:
    from PIL import Image

    labels, has_ignored = np.asarray(mask.labels), mask.ignored is not None and bool(mask.ignored.any())
    highest = int(labels.max(initial=0))
    if highest <= 1 and not has_ignored:
        picture = Image.fromarray(labels.astype(bool))
    else:
        kind, ignored_level = (np.uint8, 255) if highest < 255 else (np.uint16, 65535)
        levels = labels.astype(kind)
        if mask.ignored is not None and has_ignored:
            levels[mask.ignored] = ignored_level
        picture = Image.fromarray(levels)
    buffer = io.BytesIO()
    picture.save(buffer, "PNG")
    return buffer.getvalue(), has_ignored


def _from_png(path: Path, entry: StoredMask) -> TrunkMask:
    with open_picture(path) as picture:
        if picture.size != (entry.width_px, entry.height_px):
            raise ValueError("the picture has another size than the index says")
        if entry.width_px * entry.height_px > MAX_PIXELS:
            raise ValueError("the picture is too large")
        is_wide = picture.mode.startswith("I")
        labels = np.asarray(picture).astype(np.uint16)
    ignored = None
    if entry.has_ignored:
        ignored = labels == (65535 if is_wide else 255)
        labels[ignored] = 0
    scores = {int(number): float(score) for number, score in entry.scores.items()}
    return TrunkMask(labels, ignored, entry.has_instances, scores)
