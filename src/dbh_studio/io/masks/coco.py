"""Masks in a COCO JSON file: polygons and run lengths, several instances to a photo, categories to choose from."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from dbh_studio.core.arrays import Bool
from dbh_studio.core.posed_images import PosedImages
from dbh_studio.errors import EmptyFileError, FileMissingError, MalformedFileError, TruncatedFileError
from dbh_studio.io.masks.match import MaskMatch
from dbh_studio.io.masks.meaning import MAX_INSTANCES, TrunkMask
from dbh_studio.io.masks.picture import MAX_PIXELS
from dbh_studio.io.masks.rle import decode_counts, decode_text, fill_polygons
from dbh_studio.io.posed.images import match_names

_MAX_BYTES = 2_000_000_000
# What people call a stem; the whole tree is only taken where nothing says trunk.
_TRUNK_WORDS = re.compile(r"trunk|stem|bole|stamm|tronc|tronco|runko|pie[nń]")


@dataclass(frozen=True, eq=False)
class CocoImage:
    """One photo of the file: its name, (width, height), and its annotations as they stand there."""

    name: str
    size: tuple[int, int]
    annotations: tuple[Mapping[str, Any], ...]


@dataclass(frozen=True, eq=False)
class CocoMasks:
    """A COCO file; masks are made one photo at a time, when asked for.

    Attributes:
        path: The file.
        categories: Id → name.
        images: Name → what is known of it. A photo without annotations was looked at and shows no trunk.
    """

    path: Path
    categories: Mapping[int, str]
    images: Mapping[str, CocoImage]

    @cached_property
    def counts(self) -> dict[int, int]:
        """Category id → how many annotations."""
        counts = dict.fromkeys(self.categories, 0)
        for image in self.images.values():
            for annotation in image.annotations:
                counts[annotation["category_id"]] = counts.get(annotation["category_id"], 0) + 1
        return counts

    def likely_trunks(self) -> tuple[int, ...]:
        """Ids of the categories that are trunks by their names; to be offered, not to be taken unasked."""
        names = {key: name.lower() for key, name in self.categories.items()}
        stems = tuple(key for key, name in names.items() if _TRUNK_WORDS.search(name))
        trees = tuple(key for key, name in names.items() if "tree" in re.split(r"[\s_-]+", name))
        return stems or trees or (tuple(names) if len(names) == 1 else ())

    def match(self, posed: PosedImages) -> MaskMatch:
        """Which photos have a mask here, by name; `found` has the name in this file as its path."""
        # Windows programs write backslashes.
        files = [Path(PurePosixPath(name.replace("\\", "/"))) for name in self.images]
        matched, renamed, ambiguous = match_names([image.name for image in posed], [Path()], files)
        original = dict(zip(files, self.images, strict=True))
        wrong = {}
        for image in posed:
            path = matched.get(image.name)
            size = self.images[original[path]].size if path is not None else None
            if size is not None and not image.camera.has_aspect_of(*size):
                has, needs = f"{size[0]} x {size[1]}", f"{image.camera.width_px} x {image.camera.height_px}"
                wrong[image.name] = f"its masks are for {has} pixels, the photo has {needs}."
        found = {name: Path(original[path]) for name, path in matched.items() if name not in wrong}
        missing = tuple(image.name for image in posed if image.name not in matched)
        others = {name: path for name, path in renamed.items() if name in found}
        return MaskMatch("coco", found, missing, wrong, others, ambiguous, len(files) - len(matched))

    def mask(self, name: str, categories: Collection[int] | None = None) -> TrunkMask:
        """The mask of one photo; each annotation is one instance, and where two overlap the smaller one is on top.

        Args:
            name: As in `images`.
            categories: Ids of those that are trunks; None takes `likely_trunks`. Annotations marked as crowds are not
                one trunk: they are ignored areas.

        Raises:
            KeyError: The file knows no such photo.
            MalformedFileError: A run length or polygon is damaged.
        """
        image = self.images[name]
        wanted = set(self.likely_trunks() if categories is None else categories)
        width, height = image.size
        labels = np.zeros((height, width), np.uint16)
        ignored = np.zeros((height, width), bool)
        parts: list[tuple[int, tuple[slice, slice], Bool, float]] = []
        for annotation in image.annotations:
            if annotation["category_id"] not in wanted:
                continue
            area = self._area(image, annotation)
            if annotation.get("iscrowd"):
                ignored |= area
            else:
                window = _window(area)
                # A window, not the whole picture: there may be hundreds of them.
                parts.append((int(np.count_nonzero(area)), window, area[window].copy(), _score(annotation)))
        if len(parts) > MAX_INSTANCES:
            raise MalformedFileError(self.path, f"{name} has {len(parts)} annotations.", "Use fewer per photo.")
        parts.sort(key=lambda part: -part[0])
        scores = {}
        for number, (_, window, part, score) in enumerate(parts, start=1):
            labels[window][part] = number
            if score >= 0:
                scores[number] = score
        ignored &= labels == 0
        return TrunkMask(labels, ignored if ignored.any() else None, has_instances=True, scores=scores)

    def _area(self, image: CocoImage, annotation: Mapping[str, Any]) -> Bool:
        width, height = image.size
        shape = annotation.get("segmentation")
        where = f"annotation {annotation.get('id', '?')} of {image.name}"
        try:
            if isinstance(shape, Mapping):
                rows, columns = (int(n) for n in shape["size"])
                if (columns, rows) != image.size:
                    raise ValueError(f"it is for {columns} x {rows} pixels, its photo has {width} x {height}")
                counts = shape["counts"]
                return decode_counts(decode_text(counts) if isinstance(counts, str) else counts, rows, columns)
            return fill_polygons(shape or [], height, width)
        except (ValueError, TypeError, KeyError, OverflowError) as error:
            raise MalformedFileError(
                self.path, f"The {where} is damaged ({error}).", "Export the masks again."
            ) from None


def read_coco(path: Path | str) -> CocoMasks:
    """Read a COCO file ("instances"); no mask is made yet.

    Raises:
        FileError: The file is missing, no JSON, or not as COCO describes.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise MalformedFileError(path, "It has more than 2 GB.", "Split it.")
        data = json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise FileMissingError(path, "There is no such file.") from None
    except (ValueError, RecursionError) as error:
        raise TruncatedFileError(path, f"It is no complete JSON file ({error}).", "Export the masks again.") from None
    except OSError as error:
        raise FileMissingError(path, f"It cannot be read ({error.strerror or error}).") from None
    if not isinstance(data, dict) or not isinstance(data.get("images"), list):
        raise MalformedFileError(path, "It has no list of images.", "Export the annotations as COCO instances.")
    try:
        return _parsed(path, data)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise MalformedFileError(path, f"It is not as COCO files are ({reason}).", "Export it again.") from None


def _parsed(path: Path, data: Mapping[str, Any]) -> CocoMasks:
    categories = {int(entry["id"]): str(entry["name"]) for entry in data.get("categories") or []}
    by_image: dict[Any, list[Mapping[str, Any]]] = {}
    for annotation in data.get("annotations") or []:
        category = int(annotation.get("category_id", 0))
        categories.setdefault(category, f"category {category}")
        # A bounding box alone is no mask.
        if annotation.get("segmentation"):
            by_image.setdefault(annotation["image_id"], []).append({**annotation, "category_id": category})
    images = {}
    for entry in data["images"]:
        size = int(entry["width"]), int(entry["height"])
        if min(size) <= 0 or size[0] * size[1] > MAX_PIXELS:
            raise ValueError(f"{entry['file_name']} has {size[0]} x {size[1]} pixels")
        name = str(entry["file_name"])
        images[name] = CocoImage(name, size, tuple(by_image.pop(entry["id"], ())))
    if by_image:
        raise ValueError(f"annotations of unknown images: {list(by_image)[:3]}")
    if not any(image.annotations for image in images.values()):
        raise EmptyFileError(path, "It has no outlines and no run lengths.", "Export masks, not boxes only.")
    return CocoMasks(path, categories, images)


def _window(area: Bool) -> tuple[slice, slice]:
    """The smallest window with all of it."""
    rows, columns = np.flatnonzero(area.any(axis=1)), np.flatnonzero(area.any(axis=0))
    if not rows.size:
        return slice(0, 0), slice(0, 0)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _score(annotation: Mapping[str, Any]) -> float:
    score = annotation.get("score", annotation.get("confidence", -1.0))
    return float(score) if isinstance(score, (int, float)) and 0 <= score <= 1 else -1.0
