"""E57: the scans of a terrestrial survey, merged with their poses. Lengths are metres by the standard."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float64
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.reconstruction import Provenance
from dbh_studio.errors import FileError, MalformedFileError, MissingComponentError, StudioError, TruncatedFileError
from dbh_studio.io.chunks import Attributes, CloudBuilder, LoadedCloud

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLOURS = ("colorRed", "colorGreen", "colorBlue")
_BUFFER_POINTS = 500_000
_PAGE_BYTES = 1024
_AGAIN = "Copy or download the file again."


@dataclass(frozen=True, eq=False)
class _Scan:
    """One scan's handle and what is needed to place its points."""

    points: Any
    fields: frozenset[str]
    count: int
    rotation: Float64
    translation: Float64


def read_e57(path: Path, *, progress: Progress = ignore_progress, attributes: Attributes = "needed") -> LoadedCloud:
    """Read all scans of an E57 file into the file's common frame.

    Points that the scanner marked invalid are left out. With ``attributes="all"`` the intensity is kept.

    Raises:
        FileError: `MalformedFileError`, `TruncatedFileError` or `EmptyFileError`.
        MissingComponentError: pye57 is not installed.
    """
    try:
        import pye57
    except ImportError:
        raise MissingComponentError("E57 files need the package pye57.", "Install pye57, or export as LAZ.") from None
    _check_size(path)
    try:
        with pye57.E57(str(path)) as file:
            return _read(file, path, progress, attributes)
    except (StudioError, OSError, MemoryError):
        raise
    except Exception as error:  # The C++ reader raises types of its own for damaged content.
        raise _named(path, error) from error


def _check_size(path: Path) -> None:
    """The header says how long the file is, in pages of 1024 bytes."""
    with open(path, "rb") as file:
        head = file.read(48)
    if not head.startswith(b"ASTM-E57"):
        raise MalformedFileError(path, "This is not an E57 file: it does not begin with ASTM-E57.", "Export it again.")
    if len(head) < 48:
        raise TruncatedFileError(path, "The file ends within its E57 header.", _AGAIN)
    promised = int.from_bytes(head[16:24], "little")
    size = os.path.getsize(path)
    if promised > size or size % _PAGE_BYTES:
        raise TruncatedFileError(path, f"The file has {size:,} bytes but its header promises {promised:,}.", _AGAIN)


def _named(path: Path, error: Exception) -> FileError:
    text = re.sub(r"\s+", " ", str(error))[:160]
    return MalformedFileError(path, f"The E57 content is damaged ({text}).", _AGAIN)


def _read(file: Any, path: Path, progress: Progress, attributes: Attributes) -> LoadedCloud:
    scans = [_scan(file.get_header(index), path) for index in range(file.scan_count)]
    coloured = bool(scans) and all(set(_COLOURS) <= scan.fields for scan in scans)
    intense = attributes == "all" and bool(scans) and all("intensity" in scan.fields for scan in scans)
    total = sum(scan.count for scan in scans)
    builder = CloudBuilder(
        path,
        # A packed record may take less than a byte, so the builder grows where the file's size was no bound.
        capacity=min(total, os.path.getsize(path)),
        colour_dtype=np.uint16 if coloured else None,
        attribute_dtypes={"intensity": np.float32} if intense else {},
    )
    done = invalid = 0
    for number, scan in enumerate(scans, start=1):
        for data in _chunks(file, scan, coloured=coloured, intense=intense):
            valid, points = _points(data, scan)
            invalid += int(len(valid) - np.count_nonzero(valid))
            rgb = np.stack([data[c][valid] for c in _COLOURS], axis=1) if coloured else None
            builder.add(points[valid], rgb, {"intensity": data["intensity"][valid]} if intense else {})
            done += len(points)
            progress(min(1.0, done / max(total, 1)), f"Reading {path.name}, scan {number} of {len(scans)}")
    if done < total:
        raise TruncatedFileError(path, f"The file promises {total:,} points but holds {done:,}.", _AGAIN)
    cloud, notes = builder.finish(name=path.name)
    merged = (f"{len(scans)} scans were merged with their poses.",) if len(scans) > 1 else ()
    left_out = (f"{invalid:,} points marked invalid by the scanner were left out.",) if invalid else ()
    return LoadedCloud(cloud, (*merged, *left_out, *notes), Provenance("e57", metres_per_unit=1.0))


def _scan(header: Any, path: Path) -> _Scan:
    fields = frozenset(header.point_fields)
    if not (set(_CARTESIAN) <= fields or set(_SPHERICAL) <= fields):
        raise MalformedFileError(path, "A scan has neither x, y, z nor range and angles.", "Export it again.")
    rotation, translation = np.eye(3), np.zeros(3)
    if header.has_pose():
        w, x, y, z = np.asarray(header.rotation, np.float64) / (np.linalg.norm(header.rotation) or 1.0)
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        translation = np.asarray(header.translation, np.float64)
    return _Scan(header.points, fields, int(header.point_count), rotation, translation)


def _chunks(file: Any, scan: _Scan, *, coloured: bool, intense: bool) -> Iterator[dict[str, NDArray[Any]]]:
    """The scan's values in blocks; each is valid until the next is asked for."""
    from pye57 import libe57

    kinds: dict[str, Any] = dict.fromkeys(_CARTESIAN if set(_CARTESIAN) <= scan.fields else _SPHERICAL, np.float64)
    kinds |= dict.fromkeys(_COLOURS, np.uint16) if coloured else {}
    kinds |= {"intensity": np.float32} if intense else {}
    kinds |= {name: np.int8 for name in ("cartesianInvalidState", "sphericalInvalidState") if name in scan.fields}
    capacity = max(1, min(scan.count, _BUFFER_POINTS))
    arrays = {name: np.empty(capacity, kind) for name, kind in kinds.items()}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(file.image_file, name, array, capacity, True, True))
    reader = scan.points.reader(buffers)
    try:
        while n := reader.read():
            yield {name: array[:n] for name, array in arrays.items()}
    finally:
        reader.close()


def _points(data: dict[str, NDArray[Any]], scan: _Scan) -> tuple[NDArray[np.bool_], Float64]:
    """(n,) which points are valid, and their (n, 3) coordinates in the file's frame."""
    if _CARTESIAN[0] in data:
        local = np.stack([data[name] for name in _CARTESIAN], axis=1)
    else:
        distance, azimuth, elevation = (data[name] for name in _SPHERICAL)
        flat = distance * np.cos(elevation)
        local = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1)
    valid = np.ones(len(local), bool)
    for name in ("cartesianInvalidState", "sphericalInvalidState"):
        if name in data:
            valid &= data[name] == 0
    with np.errstate(invalid="ignore", over="ignore"):
        return valid, local @ scan.rotation.T + scan.translation
