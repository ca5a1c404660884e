"""LAS and LAZ 1.0-1.4, and COPC (which is a LAZ)."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float64
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.reconstruction import Provenance
from dbh_studio.errors import FileError, MalformedFileError, MissingComponentError, StudioError, TruncatedFileError
from dbh_studio.io.atomic import atomic_file
from dbh_studio.io.chunks import CHUNK_POINTS, Attributes, CloudBuilder, LoadedCloud, is_wanted, truncated

_HEADER = struct.Struct("<4s20xBB64xHHHIIBHI")
_CHUNK_BYTES = 1 << 26
_AGAIN = "Copy or download the file again."
_STANDARD = {
    "intensity",
    "classification",
    "return_number",
    "number_of_returns",
    "gps_time",
    "point_source_id",
    "user_data",
}
# "Low point" in every LAS, "high noise" in the point formats of LAS 1.4, where older ones leave 18 open.
_NOISE = (7,)
_NOISE_SINCE_14 = (7, 18)
# More "noise" than this is no noise: somebody's own classes happen to have its number.
_MOST_NOISE = 0.25
# What LAS calls the same thing in its older point formats or what nobody measures with.
_DULL = {"X", "Y", "Z", "red", "green", "blue", "bit_fields", "raw_classification", "classification_flags"}


def read_las(path: Path, *, progress: Progress = ignore_progress, attributes: Attributes = "needed") -> LoadedCloud:
    """Read LAS or LAZ in chunks.

    Points that are classified as noise are left out, with a note; unless they are more than a quarter, which says that
    the numbers of the classes mean something else.

    Raises:
        FileError: `MalformedFileError`, `TruncatedFileError` or `EmptyFileError`.
    """
    _check_header(path)
    try:
        return _read(path, progress, attributes)
    except (StudioError, OSError, MemoryError, KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # The LAZ decoder's panics are no subclass of Exception.
        raise _named(path, error) from error


def _named(path: Path, error: BaseException) -> FileError:
    """What laspy or the LAZ decoder said, as an error that names the file."""
    text = re.sub(r"\s+", " ", str(error))[:160]
    if any(
        sign in text.lower() for sign in ("fill whole buffer", "unexpected eof", "end of file", "buffer is smaller")
    ):
        return TruncatedFileError(path, "The file ends before its points do.", _AGAIN)
    return MalformedFileError(path, f"The LAS content is damaged ({type(error).__name__}: {text}).", _AGAIN)


def _check_header(path: Path) -> None:
    """Compare what the header claims with the file's size, before anything is allocated for it."""
    size = os.path.getsize(path)
    with open(path, "rb") as file:
        head = file.read(375)
    if not head.startswith(b"LASF"):
        raise MalformedFileError(
            path, "This is not a LAS file: it does not begin with LASF.", "Export the cloud again."
        )
    if len(head) < 227:
        raise TruncatedFileError(path, "The file ends within its LAS header.", _AGAIN)
    _, major, minor, _, _, header_size, offset, n_vlrs, format_id, record, count = _HEADER.unpack_from(head)
    if major != 1 or minor > 4:
        raise MalformedFileError(path, f"LAS version {major}.{minor} does not exist (1.0 to 1.4 do).", _AGAIN)
    if minor == 4 and len(head) >= 255:
        count = struct.unpack_from("<Q", head, 247)[0]
    if offset > size or header_size > offset or n_vlrs * 54 > offset:
        raise TruncatedFileError(path, "The file ends before its points begin, or its header is damaged.", _AGAIN)
    compressed = bool(format_id & 0xC0)
    if record < 20 or (not compressed and count * record > size - offset):
        raise truncated(path, (size - offset) // max(record, 1), count)
    if compressed:
        _check_chunk_table(path, size, offset)
    if minor == 4 and len(head) >= 247:
        start, n_evlrs = struct.unpack_from("<QI", head, 235)
        if n_evlrs and (start > size or n_evlrs * 60 > size - start):
            raise TruncatedFileError(path, "The file ends before its extended records.", _AGAIN)


def _check_chunk_table(path: Path, size: int, offset: int) -> None:
    """A damaged chunk table makes the decoder reserve what it claims; every chunk takes at least a byte of file."""
    with open(path, "rb") as file:
        file.seek(offset)
        pointer = file.read(8)
        table = struct.unpack("<q", pointer)[0] if len(pointer) == 8 else size
        if table == -1:  # Written by a stream that could not go back; the table's place is in the last 8 bytes.
            file.seek(-8, os.SEEK_END)
            table = struct.unpack("<q", file.read(8))[0]
        if not offset + 8 <= table <= size - 8:
            raise TruncatedFileError(path, "The file ends before the list of its compressed chunks.", _AGAIN)
        file.seek(table)
        _, n_chunks = struct.unpack("<II", file.read(8))
    if n_chunks > size:
        raise MalformedFileError(path, f"The file claims {n_chunks:,} compressed chunks.", _AGAIN)


def _read(path: Path, progress: Progress, attributes: Attributes, *, keep_noise: bool = False) -> LoadedCloud:
    import laspy

    selection = laspy.DecompressionSelection.all() if attributes == "all" else _needed_layers(laspy)
    with laspy.open(path, decompression_selection=selection) as reader:
        header = reader.header
        crs, notes, metres_per_unit, geographic = _coordinate_system(header)
        names = list(header.point_format.dimension_names)
        kept = [name for name in names if name not in _DULL and is_wanted(name, attributes)]
        empty = laspy.ScaleAwarePointRecord.empty(header=header)
        dtypes = {name: np.asarray(empty[name]).dtype for name in kept if np.asarray(empty[name]).ndim == 1}
        coloured = {"red", "green", "blue"} <= set(names)
        count = int(header.point_count)
        # The header's count is a claim. LAZ rarely goes below a byte per point; where it does, the builder grows.
        builder = CloudBuilder(
            path,
            capacity=min(count, os.path.getsize(path)),
            colour_dtype=np.uint16 if coloured else None,
            attribute_dtypes=dtypes,
        )
        done = n_noise = 0
        chunk = max(1, min(CHUNK_POINTS, _CHUNK_BYTES // header.point_format.size))
        for points in _one_ahead(reader.chunk_iterator(chunk)):
            xyz = _coordinates(points, header)
            rgb = np.stack([points.red, points.green, points.blue], axis=1) if coloured else None
            values = {name: np.asarray(points[name]) for name in dtypes}
            is_good = ~is_noise(points, header)
            n_noise += len(is_good) - int(np.count_nonzero(is_good))
            if not keep_noise and not is_good.all():
                xyz, rgb = xyz[is_good], None if rgb is None else rgb[is_good]
                values = {name: column[is_good] for name, column in values.items()}
            builder.add(xyz, rgb, values)
            done += len(points)
            progress(min(1.0, done / max(count, 1)), f"Reading {path.name}")
        if done < count:
            raise truncated(path, done, count)
        software = " ".join(map(_text, (header.generating_software, header.system_identifier))).strip()
        kind = "laz" if header.are_points_compressed else "las"
    if n_noise > _MOST_NOISE * count and not keep_noise:
        return _read(path, progress, attributes, keep_noise=True)
    cloud, dropped = builder.finish(name=path.name, crs=crs)
    return LoadedCloud(
        cloud,
        (*notes, *_noise_note(n_noise, keep_noise), *dropped),
        Provenance(kind, software, metres_per_unit, geographic),
    )


def is_noise(points: Any, header: Any) -> NDArray[np.bool_]:
    """(n,) which points of a chunk the file classifies as noise."""
    noise = _NOISE_SINCE_14 if header.point_format.id >= 6 else _NOISE
    return np.isin(np.asarray(points.classification), noise)


def _one_ahead(chunks: Iterator[Any]) -> Iterator[Any]:
    """The same chunks; the next one is decompressed on a thread of its own while this one is worked on."""
    with ThreadPoolExecutor(1) as pool:
        following = pool.submit(next, chunks, None)
        while (chunk := following.result()) is not None:
            following = pool.submit(next, chunks, None)
            yield chunk


def _coordinates(points: Any, header: Any) -> Float64:
    """(n, 3) absolute coordinates of a chunk; each coordinate lies in one piece, which is quicker all the way."""
    xyz = np.empty((3, len(points))).T
    for axis, raw in enumerate((points.X, points.Y, points.Z)):
        np.multiply(raw, float(header.scales[axis]), out=xyz[:, axis])
        xyz[:, axis] += float(header.offsets[axis])
    return xyz


def _noise_note(n_noise: int, kept: bool) -> tuple[str, ...]:
    if not n_noise:
        return ()
    if kept:
        return (f"{n_noise:,} points have the class number of noise; that is too many for noise, so they were kept.",)
    return (f"{n_noise:,} points that the file classifies as noise were left out.",)


def _text(value: str | bytes | None) -> str:
    """laspy hands over bytes where a name is not UTF-8."""
    text = value.decode("latin-1") if isinstance(value, bytes) else value or ""
    return text.replace("\0", "")


def _needed_layers(laspy: Any) -> Any:
    """Point formats 6-10 store each value in its own layer; what is not needed is not unpacked."""
    selection = laspy.DecompressionSelection
    return (
        selection.XY_RETURNS_CHANNEL
        | selection.Z
        | selection.CLASSIFICATION
        | selection.RGB
        | selection.ALL_EXTRA_BYTES
    )


def _coordinate_system(header: Any) -> tuple[str | None, tuple[str, ...], float | None, bool]:
    """CRS name or WKT, notes, metres per unit, and whether the coordinates are degrees."""
    records = [*header.vlrs, *(header.evlrs or ())]
    wkt = (
        next((str(r.string).strip("\0 ") for r in records if type(r).__name__ == "WktCoordinateSystemVlr"), "") or None
    )
    has_keys = any(type(r).__name__ == "GeoKeyDirectoryVlr" for r in records)
    if wkt is None and not has_keys:
        return None, (), None, False
    try:
        import pyproj  # noqa: F401 - laspy needs it to make sense of the records.
    except ImportError:
        return wkt, ("The coordinate system was not looked up, because pyproj is not installed.",), None, False
    try:
        crs = header.parse_crs()
        if crs is None:
            return wkt, (), None, False
        if crs.is_bound and crs.source_crs is not None:
            crs = crs.source_crs  # The datum shift that a TOWGS84 entry adds is no part of the system's identity.
        code = crs.to_epsg()
        unit = crs.axis_info[0].unit_conversion_factor if crs.axis_info else None
    except Exception:  # noqa: BLE001 - whatever is wrong with its name, the points are still good.
        remark = "The coordinate system in the file could not be understood; the coordinates are used as they are."
        return wkt, (remark,), None, False
    name = f"EPSG:{code}" if code is not None else crs.to_wkt()
    if crs.is_geographic:
        return name, (), None, True
    if "engineering" in crs.type_name.lower():
        return name, (), None, False  # "Local coordinates (m)" is written for reconstructions without a scale, too.
    return name, (), float(unit) if unit else None, False


def write_las(path: Path, cloud: PointCloud, *, attributes: Mapping[str, NDArray[Any]] | None = None) -> None:
    """Write LAS 1.4 (compressed where `path` ends in .laz), complete or not at all.

    Args:
        path: Where to.
        cloud: Its own attributes are written too; standard LAS names go to their place, others become extra dimensions.
        attributes: More (N,) values by name, such as the ids of the trunks found.

    Raises:
        ValueError: An attribute has the wrong length.
        MissingComponentError: The cloud has a coordinate system and pyproj is absent.
    """
    values = {**cloud.attributes, **(attributes or {})}
    for name, column in values.items():
        if len(column) != len(cloud):
            raise ValueError(f"attribute {name!r} has {len(column)} values for {len(cloud)} points")
    values = {
        name: np.asarray(column, np.uint8) if column.dtype == np.bool_ else column for name, column in values.items()
    }
    header = _new_header(cloud, values)
    with atomic_file(path) as file:
        _write_points(file, header, cloud, values, compress=Path(path).suffix.lower() == ".laz")


def _new_header(cloud: PointCloud, values: Mapping[str, NDArray[Any]]) -> Any:
    import laspy

    header = laspy.LasHeader(point_format=6 if cloud.rgb is None else 7, version="1.4")
    reach = float(np.abs(cloud.xyz).max()) if len(cloud) else 1.0
    # A tenth of a millimetre, or finer for small units; 32-bit integers must still reach the farthest point.
    header.scales = np.full(
        3,
        max(
            10.0 ** np.ceil(np.log10(max(reach, 1e-6) / 2e9)),
            min(1e-4, 10.0 ** np.floor(np.log10(max(reach, 1e-6)) - 6)),
        ),
    )
    header.offsets = cloud.origin
    header.generating_software = "DBH Studio"
    for name, column in values.items():
        if name not in _STANDARD:
            header.add_extra_dim(laspy.ExtraBytesParams(name=name[:32], type=column.dtype))
    if cloud.crs:
        try:
            import pyproj
        except ImportError:
            raise MissingComponentError("pyproj is needed to write the coordinate system.", "Install pyproj.") from None
        header.add_crs(pyproj.CRS.from_user_input(cloud.crs))
    return header


def _write_points(
    file: BinaryIO, header: Any, cloud: PointCloud, values: Mapping[str, NDArray[Any]], *, compress: bool
) -> None:
    import laspy

    with laspy.open(file, mode="w", header=header, do_compress=compress, closefd=False) as writer:
        for start in range(0, len(cloud), CHUNK_POINTS):
            part = slice(start, start + CHUNK_POINTS)
            points = laspy.ScaleAwarePointRecord.zeros(len(cloud.xyz[part]), header=header)
            raw = np.rint(cloud.xyz[part].astype(np.float64) / header.scales).astype(np.int32)
            points.X, points.Y, points.Z = raw.T
            if cloud.rgb is not None:
                points.red, points.green, points.blue = cloud.rgb[part].T.astype(np.uint16) * 257
            for name, column in values.items():
                points[name if name in _STANDARD else name[:32]] = column[part]
            writer.write_points(points)
