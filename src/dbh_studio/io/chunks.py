"""Collecting points chunk by chunk into one float32 cloud, with about one copy in memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float64, UInt8
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.reconstruction import Provenance
from dbh_studio.core.treeids import is_tree_id_name
from dbh_studio.errors import EmptyFileError, TruncatedFileError

Attributes = Literal["all", "needed"]
CHUNK_POINTS = 1_000_000
_FAR = 1000.0
_LARGEST = 1e12


@dataclass(frozen=True, eq=False)
class LoadedCloud:
    """One file's points, what to tell the person, and what the file says about itself."""

    cloud: PointCloud
    notes: tuple[str, ...]
    provenance: Provenance


def is_wanted(name: str, attributes: Attributes) -> bool:
    """Whether an attribute is kept: all of them, or only tree ids and the classification."""
    return attributes == "all" or is_tree_id_name(name) or name.lower().split("scalar_")[-1] == "classification"


class _Column:
    """A growing array. Growing moves pages, not bytes, where the system can."""

    def __init__(self, capacity: int, n_columns: int, dtype: Any) -> None:
        self._n_columns = n_columns
        self._data = np.empty((max(capacity, 1), n_columns), dtype)
        self.size = 0

    def extend(self, values: NDArray[Any]) -> None:
        """Append (n,) or (n, columns) values."""
        needed = self.size + len(values)
        if needed > len(self._data):
            self._data.resize((max(needed, len(self._data) * 3 // 2), self._n_columns), refcheck=False)
        self._data[self.size : needed] = values.reshape(len(values), self._n_columns)
        self.size = needed

    @property
    def filled(self) -> NDArray[Any]:
        """What was written, as a view; not to be kept while extending."""
        return self._data[: self.size]

    def finish(self) -> NDArray[Any]:
        """The array, cut to size; the column is spent."""
        data = self._data
        self._data = np.empty((0, self._n_columns), data.dtype)
        if self.size < len(data):
            data.resize((self.size, self._n_columns), refcheck=False)
        return data if self._n_columns > 1 else data.reshape(-1)


class ColourScale:
    """Finds out whether colours run to 1, 255 or 65 535, while they are being read.

    LAS stores 16 bits, but many programs put 8-bit values there; text files hold any of the three. The first values
    decide; a later value that contradicts raises the scale and rescales what was stored, so order does not matter.
    """

    def __init__(self, dtype: Any) -> None:
        self._is_float = np.issubdtype(np.dtype(dtype), np.floating)
        self.full = 1.0 if self._is_float else 255.0
        self._fixed = np.dtype(dtype) == np.uint8

    def to_uint8(self, rgb: NDArray[Any], stored: NDArray[Any]) -> UInt8:
        """(n, 3) uint8 of `rgb`; `stored` is corrected in place where the scale turns out to be larger."""
        if self._fixed:
            return rgb.astype(np.uint8, copy=False)
        largest = float(np.nanmax(rgb, initial=0.0))
        wanted = 1.0 if largest <= 1.0 and self._is_float else 255.0 if largest <= 255.0 else 65535.0
        if wanted > self.full:
            if len(stored):
                stored[...] = np.floor(stored / (wanted / self.full))
            self.full = wanted
        if self.full == 65535.0 and not self._is_float:
            return (rgb.astype(np.uint16, copy=False) >> 8).astype(np.uint8)
        scaled = np.nan_to_num(rgb * (255.0 / self.full), nan=0.0, posinf=255.0, neginf=0.0)
        return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


class CloudBuilder:
    """Takes chunks of absolute coordinates and ends as a `PointCloud`.

    Points with a coordinate that is not finite (or beyond 10¹², which no survey uses) are dropped and counted. The
    origin is the first chunk's rounded-down median on the axes where coordinates are large: a stray point at 0, 0, 0
    does not pull it away from the plot.

    Args:
        path: For messages.
        capacity: How many points to expect; a bound from the file's size, never an unchecked claim of its header.
        colour_dtype: Type of the colours that will come, or None.
        attribute_dtypes: Name and type of each attribute that will come with every chunk.
    """

    def __init__(
        self,
        path: Path,
        *,
        capacity: int,
        colour_dtype: Any = None,
        attribute_dtypes: Mapping[str, Any] | None = None,
    ) -> None:
        self._path = path
        self._origin: Float64 | None = None
        self._xyz = _Column(capacity, 3, np.float32)
        self._rgb = None if colour_dtype is None else _Column(capacity, 3, np.uint8)
        self._scale = None if colour_dtype is None else ColourScale(colour_dtype)
        self._attributes = {name: _Column(capacity, 1, dtype) for name, dtype in (attribute_dtypes or {}).items()}
        self.n_dropped = 0

    def __len__(self) -> int:
        return self._xyz.size

    def add(
        self,
        points_src: NDArray[Any],
        rgb: NDArray[Any] | None = None,
        attributes: Mapping[str, NDArray[Any]] | None = None,
    ) -> None:
        """Append (n, 3) absolute float coordinates with their (n, 3) colours and (n,) attributes."""
        good = _usable(points_src)
        n_good = int(np.count_nonzero(good))
        self.n_dropped += len(points_src) - n_good
        if not n_good:
            return
        every = n_good == len(points_src)
        points = points_src if every else points_src[good]
        if self._origin is None:
            median = np.array([np.median(points[:, axis]) for axis in range(points.shape[1])], np.float64)
            self._origin = np.where(np.abs(median) < _FAR, 0.0, np.floor(median))
        self._xyz.extend(points if not self._origin.any() else points - self._origin)
        if self._rgb is not None and self._scale is not None and rgb is not None:
            self._rgb.extend(self._scale.to_uint8(rgb if every else rgb[good], self._rgb.filled))
        for name, column in self._attributes.items():
            values = np.asarray((attributes or {})[name])
            column.extend(values if every else values[good])

    def finish(self, *, name: str, crs: str | None = None) -> tuple[PointCloud, tuple[str, ...]]:
        """The cloud and notes on what was dropped; the builder is spent.

        Raises:
            EmptyFileError: No usable point came.
        """
        if not len(self) or self._origin is None:
            detail = (
                f"all {self.n_dropped:,} points have unusable coordinates" if self.n_dropped else "it has no points"
            )
            raise EmptyFileError(self._path, f"There is nothing to measure: {detail}.", "Export the cloud again.")
        notes = []
        if self.n_dropped:
            notes.append(f"{self.n_dropped:,} points without finite coordinates were dropped.")
        rgb = None if self._rgb is None else self._rgb.finish()
        if rgb is not None and not rgb.any():
            rgb = None  # LAS point formats 2, 3, 5, 7, 8 and 10 always hold colour, used or not.
        values = {key: column.finish() for key, column in self._attributes.items()}
        return PointCloud(self._xyz.finish(), self._origin, rgb, values, crs, name), tuple(notes)


def _usable(points_src: NDArray[Any]) -> NDArray[np.bool_]:
    """(n,) which of (n, 3) points have three coordinates that are finite and no larger than any survey's."""
    columns = [points_src[:, axis] for axis in range(points_src.shape[1])]
    # Nearly always all of them; NaN fails every comparison.
    if len(points_src) and all(column.min() >= -_LARGEST and column.max() <= _LARGEST for column in columns):
        return np.ones(len(points_src), bool)
    with np.errstate(invalid="ignore"):
        good: NDArray[np.bool_] = (np.abs(points_src) <= _LARGEST).all(axis=1)
    return good


def record_chunks(
    file: BinaryIO, dtype: np.dtype[Any], count: int, path: Path, *, chunk: int = CHUNK_POINTS
) -> Iterator[NDArray[Any]]:
    """Read `count` fixed-size records from where `file` stands, `chunk` at a time.

    Raises:
        TruncatedFileError: The file ends first.
    """
    done = 0
    while done < count:
        n = min(chunk, count - done)
        data = file.read(n * dtype.itemsize)
        if len(data) < n * dtype.itemsize:
            raise truncated(path, done + len(data) // dtype.itemsize, count)
        yield np.frombuffer(data, dtype, n)
        done += n


def truncated(path: Path, found: int, promised: int) -> TruncatedFileError:
    """The error of a file that holds fewer points than its header promises."""
    return TruncatedFileError(
        path,
        f"The file ends too early: its header promises {promised:,} points but there is room for {found:,}.",
        "Copy or download it again.",
    )
