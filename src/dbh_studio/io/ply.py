"""PLY: ASCII and both binary byte orders, clouds and meshes."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Int32
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.reconstruction import Provenance
from dbh_studio.errors import MalformedFileError, TruncatedFileError
from dbh_studio.io.atomic import atomic_file
from dbh_studio.io.chunks import (
    CHUNK_POINTS,
    Attributes,
    CloudBuilder,
    LoadedCloud,
    is_wanted,
    record_chunks,
    truncated,
)
from dbh_studio.io.xyz import read_numbers

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8", "long": "i8", "ulong": "u8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER_LIMIT = 1 << 20
_RGB_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_FACE_NAMES = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class Property:
    """One value of an element, or a list where `count_type` is set."""

    name: str
    type: str
    count_type: str | None = None


@dataclass(frozen=True)
class Element:
    """`count` records of the same properties."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        """Whether its records differ in size."""
        return any(item.count_type for item in self.properties)

    def dtype(self, order: str, counts: tuple[int, ...] = ()) -> np.dtype[Any]:
        """The record's type, with each list of the given length."""
        fields: list[Any] = []
        lengths = iter(counts)
        for item in self.properties:
            if item.count_type is None:
                fields.append((item.name, order + item.type))
            else:
                fields += [(item.name + " count", order + item.count_type)]
                fields += [(item.name, order + item.type, (next(lengths),))]
        return np.dtype(fields)


@dataclass(frozen=True)
class PlyHeader:
    """What comes before the data. `start` is the byte the data starts at; `order` is empty for ASCII."""

    order: str
    elements: tuple[Element, ...]
    comments: tuple[str, ...]
    start: int

    def count(self, name: str) -> int:
        """How many records element `name` has; 0 where there is no such element."""
        return next((element.count for element in self.elements if element.name == name), 0)


def read_header(path: Path) -> PlyHeader:
    """Parse the header of a PLY file.

    Raises:
        MalformedFileError: It is not a PLY header, or one of unknown types.
        TruncatedFileError: There is no end of header.
    """
    with open(path, "rb") as file:
        head = file.read(_HEADER_LIMIT)
    end = re.search(rb"(?:^|[\r\n])end_header[ \t]*(\r\n|\n|\r)", head)
    if not head.startswith(b"ply"):
        raise MalformedFileError(
            path, "This is not a PLY file: its first word is not 'ply'.", "Export the cloud again."
        )
    if end is None:
        raise TruncatedFileError(path, "The PLY header has no end.", "Copy or download the file again.")
    order: str | None = None
    comments: list[str] = []
    elements: list[tuple[str, int, list[Property]]] = []
    for number, line in enumerate(re.split(r"\r\n|\n|\r", head[: end.start()].decode("latin-1")), start=1):
        words = line.split()
        try:
            if words[:1] == ["format"]:
                order = _ORDERS[words[1]]
            elif words[:1] in (["comment"], ["obj_info"]):
                comments.append(line)
            elif words[:1] == ["element"]:
                elements.append((words[1], _natural(words[2]), []))
            elif words[:2] == ["property", "list"]:
                elements[-1][2].append(Property(words[4], _TYPES[words[3]], _integer_type(words[2])))
            elif words[:1] == ["property"]:
                elements[-1][2].append(Property(words[2], _TYPES[words[1]]))
        except (KeyError, IndexError, ValueError):
            raise MalformedFileError(
                path, f"Line {number} of the PLY header, {line[:60]!r}, is not valid.", "Export the cloud again."
            ) from None
    if order is None:
        raise MalformedFileError(path, "The PLY header names no format.", "Export the cloud again.")
    return PlyHeader(order, _checked(path, elements), tuple(comments), end.end())


def _natural(word: str) -> int:
    value = int(word)
    if value < 0:
        raise ValueError(word)
    return value


def _integer_type(word: str) -> str:
    kind = _TYPES[word]
    if kind[0] == "f":
        raise ValueError(word)
    return kind


def _checked(path: Path, elements: list[tuple[str, int, list[Property]]]) -> tuple[Element, ...]:
    for name, _, properties in elements:
        names = [item.name for item in properties]
        if len(set(names)) != len(names) or (not names and name == "vertex"):
            raise MalformedFileError(
                path, f"Element {name!r} repeats a property or has none.", "Export the cloud again."
            )
    return tuple(
        Element(name, count, tuple(properties)) for name, count, properties in elements if properties or count == 0
    )


def read_ply(path: Path, *, progress: Progress = ignore_progress, attributes: Attributes = "needed") -> LoadedCloud:
    """Read the vertices of a PLY file.

    Raises:
        FileError: `MalformedFileError`, `TruncatedFileError` or `EmptyFileError`.
    """
    header = read_header(path)
    vertex = next((element for element in header.elements if element.name == "vertex"), None)
    names = {item.name.lower(): item.name for item in vertex.properties} if vertex else {}
    if vertex is None or not {"x", "y", "z"} <= set(names):
        raise MalformedFileError(path, "The PLY has no vertices with x, y and z.", "Export it as a point cloud.")
    if vertex.has_lists:
        raise MalformedFileError(
            path, "The PLY's vertices hold lists, which no point cloud needs.", "Export it plainly."
        )
    coordinates = [names[axis] for axis in "xyz"]
    colours = next(([names[c] for c in rgb] for rgb in _RGB_NAMES if set(rgb) <= set(names)), None)
    others = [
        p for p in vertex.properties if p.name not in (*coordinates, *(colours or ())) and is_wanted(p.name, attributes)
    ]
    kinds = {item.name: item.type for item in vertex.properties}
    with open(path, "rb") as file:
        _skip_to_vertices(file, header, path)
        _check_size(file, header, vertex, path)
        builder = CloudBuilder(
            path,
            capacity=vertex.count,
            colour_dtype=kinds[colours[0]] if colours else None,
            attribute_dtypes={item.name: item.type for item in others},
        )
        done = 0
        for records in _vertex_chunks(file, header, vertex, path):
            points = np.stack([records[axis] for axis in coordinates], axis=1)
            rgb = np.stack([records[c] for c in colours], axis=1) if colours else None
            builder.add(points, rgb, {item.name: records[item.name] for item in others})
            done += len(records)
            progress(done / vertex.count, f"Reading {path.name}")
    cloud, notes = builder.finish(name=path.name)
    return LoadedCloud(cloud, notes, Provenance("ply", " ".join(header.comments)[:500]))


def _check_size(file: BinaryIO, header: PlyHeader, vertex: Element, path: Path) -> None:
    """Refuse a count that the rest of the file has no room for, before anything is allocated."""
    room = os.fstat(file.fileno()).st_size - file.tell()
    smallest = vertex.dtype(header.order).itemsize if header.order else 2 * len(vertex.properties)
    if vertex.count * smallest > room + 1:  # The last line of an ASCII file may lack its line end.
        raise truncated(path, room // smallest, vertex.count)


def _vertex_chunks(file: BinaryIO, header: PlyHeader, vertex: Element, path: Path) -> Any:
    dtype = vertex.dtype(header.order or "<")
    if header.order:
        yield from record_chunks(file, dtype, vertex.count, path)
        return
    done = 0
    while done < vertex.count:
        n = min(CHUNK_POINTS // 4, vertex.count - done)
        rows = read_numbers(file, n, len(vertex.properties), path)
        if len(rows) < n:
            raise truncated(path, done + len(rows), vertex.count)
        records = np.empty(n, dtype)
        for column, item in enumerate(vertex.properties):
            with np.errstate(invalid="ignore", over="ignore"):
                records[item.name] = rows[:, column]
        yield records
        done += n


def _skip_to_vertices(file: BinaryIO, header: PlyHeader, path: Path) -> None:
    file.seek(header.start)
    for element in header.elements:
        if element.name == "vertex":
            return
        _skip(file, header, element, path)


def _skip(file: BinaryIO, header: PlyHeader, element: Element, path: Path) -> None:
    """Move `file` behind one element."""
    if not header.order:
        for _ in range(element.count):
            if not file.readline():
                raise TruncatedFileError(path, f"The file ends within its {element.name!r} element.", "Copy it again.")
    elif element.has_lists:
        start = file.tell()
        _, used = _list_runs(file.read(), element, header.order, path)
        file.seek(start + used)
    else:
        file.seek(element.count * element.dtype(header.order).itemsize, os.SEEK_CUR)


def read_faces(path: Path, n_vertices: int) -> Int32:
    """(F, 3) triangles of a PLY; polygons are cut into fans, and polygons with unknown vertices are left out.

    Raises:
        FileError: `MalformedFileError` or `TruncatedFileError`.
    """
    header = read_header(path)
    face = next((element for element in header.elements if element.name == "face"), None)
    name = next((p.name for p in face.properties if p.count_type and p.name in _FACE_NAMES), None) if face else None
    if face is None or name is None or not face.count:
        return np.zeros((0, 3), np.int32)
    with open(path, "rb") as file:
        file.seek(header.start)
        for element in header.elements:
            if element.name == "face":
                break
            _skip(file, header, element, path)
        runs = (
            _ascii_runs(file, face, path) if not header.order else _list_runs(file.read(), face, header.order, path)[0]
        )
    polygons = [run[name].astype(np.int64) for run in runs]
    triangles = [_fans(polygon) for polygon in polygons if polygon.shape[1] >= 3]
    faces = np.concatenate(triangles) if triangles else np.zeros((0, 3), np.int64)
    inside = ((faces >= 0) & (faces < n_vertices)).all(axis=1)
    return np.ascontiguousarray(faces[inside], np.int32)


def _fans(polygons: NDArray[Any]) -> NDArray[Any]:
    """((k-2)·n, 3) triangles of (n, k) polygons."""
    return np.concatenate([polygons[:, [0, i, i + 1]] for i in range(1, polygons.shape[1] - 1)])


def _list_runs(data: bytes, element: Element, order: str, path: Path) -> tuple[list[NDArray[Any]], int]:
    """Decode records with lists, as runs of records that have the same list lengths; also the bytes used.

    Exporters write long runs (all triangles, or quads then triangles), so a run is decoded at once, with a look-ahead
    that doubles while the run goes on.
    """
    runs: list[NDArray[Any]] = []
    position, done, window = 0, 0, 1024
    while done < element.count:
        dtype = element.dtype(order, _list_lengths(data, position, element, order, path))
        n = min(element.count - done, window, (len(data) - position) // dtype.itemsize)
        if n <= 0:
            raise TruncatedFileError(path, f"The file ends within its {element.name!r} element.", "Copy it again.")
        records = np.frombuffer(data, dtype, n, position)
        same = np.ones(n, bool)
        for item in element.properties:
            if item.count_type:
                count = records[item.name + " count"]
                same &= count == count[0]
        n_same = n if same.all() else int(np.argmin(same))
        runs.append(records[:n_same])
        window = window * 2 if n_same == n else max(1024, n_same)
        position += n_same * dtype.itemsize
        done += n_same
    return runs, position


def _list_lengths(data: bytes, position: int, element: Element, order: str, path: Path) -> tuple[int, ...]:
    """The list lengths of the record at `position`."""
    lengths: list[int] = []
    for item in element.properties:
        size = np.dtype(item.count_type or item.type).itemsize
        if position + size > len(data):
            raise TruncatedFileError(path, f"The file ends within its {element.name!r} element.", "Copy it again.")
        if item.count_type:
            length = int(np.frombuffer(data, order + item.count_type, 1, position)[0])
            if not 0 <= length * np.dtype(item.type).itemsize <= len(data) - position:
                raise TruncatedFileError(path, f"The file ends within its {element.name!r} element.", "Copy it again.")
            lengths.append(length)
            position += length * np.dtype(item.type).itemsize
        position += size
    return tuple(lengths)


def _ascii_runs(file: BinaryIO, face: Element, path: Path) -> list[NDArray[Any]]:
    """ASCII faces, through the binary decoder: every number becomes a double."""
    words = file.read().split()
    try:
        numbers = np.array(words, dtype=np.float64)
    except ValueError:
        raise MalformedFileError(path, "A face is not made of numbers.", "Export the mesh again.") from None
    counts = tuple(Property(p.name, "f8", "f8" if p.count_type else None) for p in face.properties)
    return _list_runs(numbers.tobytes(), Element(face.name, face.count, counts), "=", path)[0]


def write_ply(path: Path, cloud: PointCloud) -> None:
    """Write a binary little-endian PLY, complete or not at all.

    Coordinates are absolute; they are doubles where the origin is too large for floats.
    """
    wide = bool(np.abs(cloud.origin).max() > 0)
    fields: list[tuple[str, str]] = [(axis, "<f8" if wide else "<f4") for axis in "xyz"]
    if cloud.rgb is not None:
        fields += [(c, "u1") for c in ("red", "green", "blue")]
    names = {np.dtype(code).str[1:]: name for name, code in reversed(_TYPES.items()) if not name[-1].isdigit()}
    others = {re.sub(r"\s+", "_", name): _storable(values) for name, values in cloud.attributes.items()}
    fields += [(name, values.dtype.newbyteorder("<").str) for name, values in others.items()]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(cloud)}"]
    lines += [f"property {names[np.dtype(code).str[1:]]} {name}" for name, code in fields]
    with atomic_file(path) as file:
        file.write("\n".join([*lines, "end_header", ""]).encode("ascii", "replace"))
        for start in range(0, len(cloud), CHUNK_POINTS):
            part = slice(start, start + CHUNK_POINTS)
            records = np.empty(len(cloud.xyz[part]), fields)
            for axis, name in enumerate("xyz"):
                records[name] = (
                    cloud.xyz[part, axis].astype(np.float64) + cloud.origin[axis] if wide else cloud.xyz[part, axis]
                )
            if cloud.rgb is not None:
                for channel, name in enumerate(("red", "green", "blue")):
                    records[name] = cloud.rgb[part, channel]
            for name, values in others.items():
                records[name] = values[part]
            file.write(records.tobytes())


def _storable(values: NDArray[Any]) -> NDArray[Any]:
    """Values of a type PLY has: 64-bit integers and booleans become the nearest one."""
    if values.dtype == np.bool_:
        return values.astype(np.uint8)
    if values.dtype.kind in "iu" and values.dtype.itemsize == 8:
        fits = not len(values) or (values.min() >= -(2**31) and values.max() < 2**31)
        return values.astype(np.int32 if fits else np.float64)
    return values.astype(np.float32) if values.dtype == np.float16 else values
