"""What the readers of posed images share: numbers checked, rotations made proper, images put in order."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dbh_studio.core.arrays import Float64, UInt8
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import EmptyFileError, FileMissingError, MalformedFileError

_MAX_FILE_BYTES = 4 << 30


@dataclass
class PosedBuilder:
    """Collects images while a file is read, and what is to be said about those left out."""

    path: Path
    source_format: str
    images: list[PosedImage] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    _skipped: dict[str, list[str]] = field(default_factory=dict)
    _names: set[str] = field(default_factory=set)
    n_renamed: int = 0

    def add(self, name: str, camera: CameraModel, cam_from_source: Similarity, time_s: float | None = None) -> None:
        """Keep one image; a second one of the same name gets a number behind it."""
        name = name.replace("\\", "/").strip()
        unique, number = name, 1
        while unique in self._names:
            number += 1
            unique = f"{name}#{number}"
        self.n_renamed += unique != name
        self._names.add(unique)
        self.images.append(PosedImage(unique, camera, cam_from_source, time_s=time_s))

    def skip(self, name: str, why: str) -> None:
        """Leave one image out; `why` completes "3 images were left out: …"."""
        self._skipped.setdefault(why, []).append(name)

    def build(
        self,
        *,
        points: Float64 | None = None,
        rgb: UInt8 | None = None,
        cloud_from_cameras: Similarity | None = None,
        reprojection_error_px: float | None = None,
    ) -> PosedImages:
        """The images in the order of capture.

        Raises:
            EmptyFileError: None is left.
        """
        notes = list(self.notes)
        for why, names in self._skipped.items():
            first = ", ".join(names[:3]) + (", …" if len(names) > 3 else "")
            subject = "1 image was" if len(names) == 1 else f"{len(names):,} images were"
            notes.append(f"{subject} left out: {why} ({first}).")
        if self.n_renamed:
            notes.append(f"{self.n_renamed:,} images have the name of another one; they got a number behind it.")
        if not self.images:
            detail = f" {notes[-1]}" if notes else ""
            raise EmptyFileError(
                self.path, f"No image in it has a known pose.{detail}", "Align the photos first, then export again."
            )
        if points is not None and len(points):
            is_finite = np.isfinite(points).all(axis=1)
            points, rgb = points[is_finite], None if rgb is None else rgb[is_finite]
        return PosedImages(
            in_capture_order(self.images),
            points if points is not None and len(points) else None,
            rgb if points is not None and len(points) else None,
            self.source_format,
            tuple(notes),
            cloud_from_cameras,
            reprojection_error_px,
        )


def in_capture_order(images: Iterable[PosedImage]) -> tuple[PosedImage, ...]:
    """By time where every image has one, else by name with numbers as numbers."""
    images = list(images)
    times = [image.time_s for image in images]
    known = [time for time in times if time is not None]
    if len(known) == len(images) and len(set(known)) > 1:
        images.sort(key=lambda image: (image.time_s or 0.0, natural_key(image.name)))
    else:
        images.sort(key=lambda image: natural_key(image.name))
    return tuple(replace(image, order=order) for order, image in enumerate(images))


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sorts ``frame_2`` before ``frame_10``."""
    parts = re.split(r"(\d+)", name.lower())
    return tuple((1, int(part), part) if part.isdecimal() else (0, 0, part) for part in parts)


def read_bytes(path: Path) -> bytes:
    """A whole file.

    Raises:
        FileMissingError: It cannot be read.
        EmptyFileError: It has no bytes.
        MalformedFileError: It is larger than any such file is.
    """
    try:
        size = path.stat().st_size
        if size > _MAX_FILE_BYTES:
            raise MalformedFileError(path, "It is too large for a list of cameras.", "Choose the right file.")
        data = path.read_bytes()
    except OSError as error:
        raise FileMissingError(path, f"The file cannot be read ({error.strerror}).", "Check the path.") from None
    if not data.strip():
        raise EmptyFileError(path, "The file is empty.", "Export or copy it again.")
    return data


def read_text(path: Path) -> str:
    """A whole text file, UTF-8 or UTF-16 with a mark, else Latin-1 (names of files in old exports)."""
    data = read_bytes(path)
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def numbers(values: Any, count: int | None, *, path: Path, what: str) -> Float64:
    """`values` as (count,) finite float64.

    Raises:
        MalformedFileError: They are not numbers, too few, too many, or not finite.
    """
    try:
        array = np.array([float(value) for value in values], np.float64)
    except (TypeError, ValueError):
        raise MalformedFileError(path, f"{what} is not a list of numbers.", "Export it again.") from None
    if count is not None and len(array) != count:
        raise MalformedFileError(path, f"{what} has {len(array)} numbers instead of {count}.", "Export it again.")
    if not np.isfinite(array).all():
        raise MalformedFileError(path, f"{what} holds a number that is not finite.", "Export it again.")
    return array


def quaternion_to_rotation(quaternion_wxyz: Sequence[float] | Float64) -> Float64:
    """(3, 3) rotation of a quaternion, scalar first, of any length but zero.

    Raises:
        ValueError: It is zero or not finite.
    """
    q = np.asarray(quaternion_wxyz, np.float64)
    largest = np.abs(q).max()
    length = np.linalg.norm(q) if largest < 1e9 else np.inf
    if not np.isfinite(length) or length < 1e-9:
        raise ValueError("a rotation is zero or not finite")
    w, x, y, z = q / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_vector_to_rotation(vector: Sequence[float] | Float64) -> Float64:
    """(3, 3) rotation about `vector` by its length in radians."""
    v = np.asarray(vector, np.float64)
    half = 0.5 * float(np.linalg.norm(v))
    # sinc keeps the limit at no rotation.
    return quaternion_to_rotation(np.concatenate([[np.cos(half)], 0.5 * v * np.sinc(half / np.pi)]))


def nearest_rotation(matrix: Float64) -> Float64:
    """The proper rotation nearest to a matrix that was rounded when it was written.

    Raises:
        ValueError: It is no rotation at all.
    """
    if not np.isfinite(matrix).all():
        raise ValueError("a rotation is not finite")
    u, singular, vt = np.linalg.svd(matrix)
    if np.abs(singular - 1.0).max() > 1e-2 or np.linalg.det(matrix) < 0.0:
        raise ValueError("a rotation matrix is not a rotation")
    return u @ vt


def pose_from_centre(rotation: Float64, centre: Float64) -> Similarity:
    """``cam_from_source`` from its rotation and the camera's centre."""
    return Similarity(rotation, -(rotation @ centre))
