"""The cloud as LAS or LAZ, point for point as its source, with the tree of every point and its height above ground."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.errors import FileError
from dbh_studio.io.exports.columns import unwritten, written_whole
from dbh_studio.io.las import is_noise, write_las

_CHUNK = 1_000_000
# Belongs to no file but the one it describes.
_NOT_COPIED = frozenset({"copc"})


def write_labelled_cloud(
    path: Path | str,
    cloud: PointCloud,
    values: Mapping[str, NDArray[Any]],
    *,
    source: Path | None = None,
    progress: Progress = ignore_progress,
) -> Path:
    """Write the cloud with further values per point.

    Where the source is LAS or LAZ, every point, attribute, scale and record of it is kept as it is, those points too
    that were not read as part of the plot (noise): they get 0, or NaN. Any other cloud is written as LAS 1.4.

    Args:
        path: Ending in ``.laz`` or ``.las``.
        cloud: The plot.
        values: (N,) arrays by name: ``tree_id``, ``height_above_ground``. They replace attributes of that name.
        source: The file the cloud was read from, where it is LAS or LAZ.
        progress: Called between chunks.

    Raises:
        FileError: The source is no longer what was read, or the file cannot be written.
        ValueError: A value has the wrong length.
        CancelledError: From `progress`; nothing is written.
    """
    path = Path(path)
    for name, column in values.items():
        if len(column) != len(cloud):
            raise ValueError(f"{name!r} has {len(column)} values for {len(cloud)} points")
    if source is None or source.suffix.lower() not in (".las", ".laz"):
        kept = {name: column for name, column in cloud.attributes.items() if name not in values}
        bare = PointCloud(cloud.xyz, cloud.origin, cloud.rgb, kept, cloud.crs, cloud.name)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_las(path, bare, attributes=values)
        except OSError as error:
            raise unwritten(path, error) from error
        return path
    if path.exists() and path.samefile(source):
        raise FileError(path, "It is the file the plot is read from.", "Choose another name or folder.")
    _copy_with(path, source, cloud, values, progress)
    return path


def _copy_with(
    path: Path, source: Path, cloud: PointCloud, values: Mapping[str, NDArray[Any]], progress: Progress
) -> None:
    import laspy

    with laspy.open(source) as reader, written_whole(path) as file:
        header = _extended(reader.header, values)
        everything = int(reader.header.point_count) == len(cloud)
        done = 0
        with laspy.open(
            file, mode="w", header=header, do_compress=path.suffix.lower() == ".laz", closefd=False
        ) as writer:
            for points in reader.chunk_iterator(_CHUNK):
                is_kept = np.ones(len(points), bool) if everything else ~is_noise(points, reader.header)
                rows = slice(done, done + int(np.count_nonzero(is_kept)))
                done = rows.stop
                if done > len(cloud):
                    break
                record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
                record.copy_fields_from(points)
                for name, column in values.items():
                    whole = np.full(len(points), np.nan if column.dtype.kind == "f" else 0, column.dtype)
                    whole[is_kept] = column[rows]
                    record[name] = whole
                writer.write_points(record)
                progress(done / max(len(cloud), 1), f"Writing {path.name}")
        if done != len(cloud):
            raise FileError(
                source,
                f"It does not hold the {len(cloud):,} points that were read from it.",
                "It was changed meanwhile: open the plot again, or export the cloud under another format.",
            )


def _extended(header: Any, values: Mapping[str, NDArray[Any]]) -> Any:
    """The header of the source with room for the values."""
    import laspy

    extended = copy.deepcopy(header)
    extended.vlrs = [record for record in header.vlrs if str(record.user_id).strip("\0 ").lower() not in _NOT_COPIED]
    extended.evlrs = [
        record for record in header.evlrs or () if str(record.user_id).strip("\0 ").lower() not in _NOT_COPIED
    ]
    there = set(extended.point_format.extra_dimension_names)
    stale = [name for name in values if name in there]
    if stale:
        extended.remove_extra_dims(stale)
    for name, column in values.items():
        extended.add_extra_dim(laspy.ExtraBytesParams(name=name[:32], type=column.dtype))
    return extended
