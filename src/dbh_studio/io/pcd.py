"""PCD (Point Cloud Library): ascii, binary, and binary_compressed (LZF)."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.reconstruction import Provenance
from dbh_studio.errors import MalformedFileError, TruncatedFileError
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

_TYPES = {"F": "f", "I": "i", "U": "u"}
_ENCODINGS = ("ascii", "binary", "binary_compressed")
_HEADER_LINES = 100
# A back reference of 3 bytes stands for at most 264, so no honest file expands more.
_LZF_MOST = 88


@dataclass(frozen=True)
class PcdHeader:
    """Fields, types and where the data starts."""

    fields: tuple[str, ...]
    formats: tuple[str, ...]
    counts: tuple[int, ...]
    n_points: int
    encoding: str
    start: int

    @property
    def dtype(self) -> np.dtype[Any]:
        """One point's record. Padding fields all share the name ``_``, so names are made unique."""
        names = [name if name != "_" else f"_{i}" for i, name in enumerate(self.fields)]
        return np.dtype(
            [
                (n, "<" + f, (c,)) if c != 1 else (n, "<" + f)
                for n, f, c in zip(names, self.formats, self.counts, strict=True)
            ]
        )


def read_header(path: Path) -> PcdHeader:
    """Parse the header of a PCD file.

    Raises:
        MalformedFileError: A line is missing or not valid.
        TruncatedFileError: There is no DATA line.
    """
    entries: dict[str, list[str]] = {}
    with open(path, "rb") as file:
        for _ in range(_HEADER_LINES):
            words = file.readline(4096).decode("latin-1").split()
            if not words or words[0].startswith("#"):
                continue
            entries[words[0].upper()] = words[1:]
            if words[0].upper() == "DATA":
                break
        start = file.tell()
    if "DATA" not in entries:
        raise TruncatedFileError(path, "The PCD header has no DATA line.", "Copy or download the file again.")
    try:
        return _header(entries, start)
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise MalformedFileError(path, f"The PCD header is not valid ({error}).", "Export the cloud again.") from None


def _header(entries: dict[str, list[str]], start: int) -> PcdHeader:
    fields = tuple(entries.get("FIELDS") or entries["COLUMNS"])
    sizes = [int(word) for word in entries.get("SIZE", ["4"] * len(fields))]
    kinds = [_TYPES[word.upper()] for word in entries.get("TYPE", ["F"] * len(fields))]
    counts = tuple(int(word) for word in entries.get("COUNT", ["1"] * len(fields)))
    if not len(fields) == len(sizes) == len(kinds) == len(counts):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT differ in length")
    if any(not 1 <= count <= 100_000 for count in counts):
        raise ValueError("COUNT is out of range")
    area = int(entries["WIDTH"][0]) * int(entries["HEIGHT"][0]) if "WIDTH" in entries and "HEIGHT" in entries else 0
    n_points = int(entries["POINTS"][0]) if "POINTS" in entries else area
    encoding = entries["DATA"][0].lower()
    if n_points < 0 or encoding not in _ENCODINGS:
        raise ValueError(f"POINTS {n_points}, DATA {encoding}")
    formats = tuple(f"{kind}{size}" for kind, size in zip(kinds, sizes, strict=True))
    header = PcdHeader(fields, formats, counts, n_points, encoding, start)
    if not {"x", "y", "z"} <= set(header.dtype.names or ()):
        raise ValueError("there are no fields x, y and z")
    if any(header.dtype[axis].shape for axis in "xyz"):
        raise ValueError("x, y and z are not single values")
    return header


def read_pcd(path: Path, *, progress: Progress = ignore_progress, attributes: Attributes = "needed") -> LoadedCloud:
    """Read a PCD file. Organised clouds lose their rows; their missing points (NaN) are dropped.

    Raises:
        FileError: `MalformedFileError`, `TruncatedFileError` or `EmptyFileError`.
    """
    header = read_header(path)
    dtype = header.dtype
    names = dtype.names or ()
    packed = next(
        (name for name in ("rgb", "rgba") if name in names and dtype[name] in (np.dtype("<f4"), np.dtype("<u4"))), None
    )
    plain = [name for name in names if name not in ("x", "y", "z", packed) and not name.startswith("_")]
    others = {name: dtype[name] for name in plain if not dtype[name].shape and is_wanted(name, attributes)}
    with open(path, "rb") as file:
        file.seek(header.start)
        room = os.fstat(file.fileno()).st_size - header.start
        smallest = {
            "ascii": 2 * sum(header.counts),
            "binary": dtype.itemsize,
            "binary_compressed": dtype.itemsize / _LZF_MOST,
        }
        if header.n_points * smallest[header.encoding] > room + 1:
            raise truncated(path, int(room / smallest[header.encoding]), header.n_points)
        builder = CloudBuilder(
            path, capacity=header.n_points, colour_dtype=np.uint8 if packed else None, attribute_dtypes=others
        )
        done = 0
        for records in _chunks(file, header, path):
            points = np.stack([records[axis] for axis in "xyz"], axis=1)
            rgb = _unpacked(records[packed]) if packed else None
            builder.add(
                points.astype(np.float64) if points.dtype.kind != "f" else points, rgb, {n: records[n] for n in others}
            )
            done += len(records)
            progress(done / header.n_points, f"Reading {path.name}")
    cloud, notes = builder.finish(name=path.name)
    return LoadedCloud(cloud, notes, Provenance("pcd"))


def _unpacked(packed: NDArray[Any]) -> NDArray[Any]:
    """(n, 3) colours of 0xAARRGGBB, which PCL also writes as the bits of a float."""
    bits = np.ascontiguousarray(packed).view(np.uint32)
    return np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)


def _chunks(file: BinaryIO, header: PcdHeader, path: Path) -> Iterator[NDArray[Any]]:
    if header.encoding == "binary":
        yield from record_chunks(file, header.dtype, header.n_points, path)
    elif header.encoding == "ascii":
        yield from _ascii_chunks(file, header, path)
    elif header.n_points:
        yield from _compressed_chunks(file, header, path)


def _ascii_chunks(file: BinaryIO, header: PcdHeader, path: Path) -> Iterator[NDArray[Any]]:
    dtype = header.dtype
    n_columns = sum(header.counts)
    done = 0
    while done < header.n_points:
        n = min(CHUNK_POINTS // 4, header.n_points - done)
        rows = read_numbers(file, n, n_columns, path)
        if len(rows) < n:
            raise truncated(path, done + len(rows), header.n_points)
        records = np.empty(n, dtype)
        column = 0
        for name, count in zip(dtype.names or (), header.counts, strict=True):
            values = rows[:, column] if count == 1 else rows[:, column : column + count]
            with np.errstate(invalid="ignore", over="ignore"):
                records[name] = _packed_as_written(values, dtype[name]) if name in ("rgb", "rgba") else values
            column += count
        yield records
        done += n


def _packed_as_written(values: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """A packed colour in text is either the float with these bits, or the whole number itself."""
    if dtype == np.dtype("<f4") and len(values) and bool((values == np.round(values)).all()) and values.max() > 255:
        return np.ascontiguousarray(values.astype(np.uint32)).view(np.float32)
    return values


def _compressed_chunks(file: BinaryIO, header: PcdHeader, path: Path) -> Iterator[NDArray[Any]]:
    """Fields are stored one after the other, so this encoding is decompressed as a whole."""
    sizes = file.read(8)
    if len(sizes) < 8:
        raise truncated(path, 0, header.n_points)
    packed_size, full_size = struct.unpack("<II", sizes)
    expected = header.n_points * header.dtype.itemsize
    if full_size != expected:
        raise MalformedFileError(
            path, f"The data unpacks to {full_size:,} bytes but {expected:,} are promised.", "Export the cloud again."
        )
    packed = file.read(packed_size)
    if len(packed) < packed_size:
        raise TruncatedFileError(path, "The compressed data ends too early.", "Copy or download the file again.")
    try:
        data = lzf_decompress(packed, full_size)
    except ValueError as error:
        raise MalformedFileError(path, f"The compressed data is damaged ({error}).", "Copy the file again.") from None
    columns: dict[str, NDArray[Any]] = {}
    position = 0
    for name in header.dtype.names or ():
        field = header.dtype[name]
        columns[name] = np.frombuffer(data, field, header.n_points, position)
        position += field.itemsize * header.n_points
    for start in range(0, header.n_points, CHUNK_POINTS):
        part = {name: values[start : start + CHUNK_POINTS] for name, values in columns.items()}
        records = np.empty(len(part["x"]), header.dtype)
        for name, values in part.items():
            records[name] = values
        yield records


def lzf_decompress(packed: bytes, full_size: int) -> bytes:
    """Expand LibLZF data: literal runs of 1-32 bytes, and copies of 3-264 bytes from up to 8 KiB back.

    Raises:
        ValueError: The data is damaged or does not give `full_size` bytes.
    """
    out = bytearray()
    position, end = 0, len(packed)
    try:
        while position < end:
            control = packed[position]
            position += 1
            if control < 32:
                out += packed[position : position + control + 1]
                position += control + 1
                continue
            length = (control >> 5) + 2
            if length == 9:
                length += packed[position]
                position += 1
            start = len(out) - ((control & 31) << 8) - packed[position] - 1
            position += 1
            if start < 0:
                raise ValueError("a copy starts before the data")
            if start + length <= len(out):
                out += out[start : start + length]
            else:  # The copy overlaps what it writes: a repeated pattern.
                pattern = bytes(out[start:])
                out += (pattern * (length // len(pattern) + 1))[:length]
            if len(out) > full_size:
                raise ValueError("it is longer than promised")
    except IndexError:
        raise ValueError("it ends within a copy") from None
    if position > end or len(out) != full_size:
        raise ValueError(f"{len(out):,} bytes instead of {full_size:,}")
    return bytes(out)
