"""Where a sensor was, from files: TUM, KITTI, tables with a header or without, and the poses of photos.

    TUM      time x y z qx qy qz qw                        one pose a line, spaces; Faster-LIO, FAST-LIO, evo write it
    KITTI    the twelve numbers of a 3 x 4 pose             times in a second file, or a constant rate
    table    a header that names a time and x, y, z        commas, semicolons, tabs or spaces; ROS' names too
    photos   COLMAP, Metashape, OpenSfM, table of poses    see `io.posed`

The formats are described, with examples, in ``docs/guide/lidar-transfer.md``.
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.core.arrays import Float64, readonly
from dbh_studio.errors import EmptyFileError, FileError, FileMissingError, MalformedFileError, UnsupportedFormatError
from dbh_studio.io.posed.common import read_text
from dbh_studio.io.posed.table import is_table_header

if TYPE_CHECKING:
    from dbh_studio.core.posed_images import PosedImages

TRAJECTORY_FORMATS = (
    "TUM (time x y z qx qy qz qw, one pose a line)\n"
    "KITTI (twelve numbers a line), with a file of times or a rate\n"
    "Table (.csv, .txt) with a header that names a time and x, y, z\n"
    "Poses of photos (COLMAP, Metashape, OpenSfM, table of poses)"
)
_REMEDY = f"The studio reads:\n{TRAJECTORY_FORMATS}"
# What programs call the columns, without units and punctuation; the first that is there counts.
_TIME_NAMES = ("time", "timestamp", "times", "t", "sec", "secs", "seconds", "gpstime", "gpsseconds", "unixtime",
               "stamp", "headerstamp", "fieldheaderstamp", "utctime", "datetime", "posixtime", "epoch")  # fmt: skip
_NANO_NAMES = ("nsec", "nsecs", "nanosec", "nanoseconds")
_AXIS_NAMES = tuple(
    (axis, f"t{axis}", f"p{axis}", f"pos{axis}", f"position{axis}", f"poseposition{axis}",
     f"poseposeposition{axis}", f"fieldposeposeposition{axis}", f"fieldposeposition{axis}", f"translation{axis}",
     *other)
    for axis, other in (("x", ("easting", "east", "e")), ("y", ("northing", "north", "n")),
                        ("z", ("height", "altitude", "elevation", "up", "h", "u")))
)  # fmt: skip
_UNITS_S = {"ns": 1e-9, "nsec": 1e-9, "us": 1e-6, "µs": 1e-6, "usec": 1e-6, "ms": 1e-3, "msec": 1e-3, "s": 1.0,
            "sec": 1.0, "secs": 1.0, "seconds": 1.0}  # fmt: skip
# Seconds since 1970 are 1.7e9 now; the same in smaller units is larger by thousands.
_LARGEST_S, _LARGEST_MS, _LARGEST_US = 1e11, 1e14, 1e17
_MOST_BAD_SHARE = 0.5
# Beyond nanoseconds since 1970: sums of squares of larger numbers overflow.
_BEYOND_REASON = 1e20


@dataclass(frozen=True, eq=False)
class RecordedTrajectory:
    """What a file says of where a sensor was.

    Attributes:
        path: The file.
        xyz: (N, 3) float64 places in the file's frame, in order of time.
        time_s: (N,) ascending seconds of the file's clock; None where the file tells no times.
        file_format: ``tum``, ``kitti``, ``table`` or that of `PosedImages.source_format`.
        notes: What was left out or assumed, in plain words.
        posed: The photos, where the file holds their poses.
    """

    path: Path
    xyz: Float64
    time_s: Float64 | None
    file_format: str
    notes: tuple[str, ...] = ()
    posed: PosedImages | None = None

    def __len__(self) -> int:
        return len(self.xyz)


def read_trajectory(
    path: Path | str, *, times: Path | str | None = None, rate_hz: float | None = None
) -> RecordedTrajectory:
    """Read a trajectory of any format the studio knows.

    Args:
        path: A file, or the folder of a reconstruction from photos.
        times: A file with one time a line, for formats without; ``times.txt`` beside a KITTI file is found by itself.
        rate_hz: Poses or frames a second, where there are no times: numbers in the names of photos count frames.

    Raises:
        FileError: Names the file, what is wrong and what to do.
        ValueError: The rate is not positive.
    """
    path = Path(path)
    if rate_hz is not None and not (np.isfinite(rate_hz) and rate_hz > 0):
        raise ValueError(f"the rate is {rate_hz} but must be positive")
    if holds_photos(path):
        read = _from_photos(path, rate_hz)
    else:
        read = _from_text(path, rate_hz if times is None else None)
    if times is None and read.file_format == "kitti" and rate_hz is None:
        beside = path.with_name("times.txt")
        times = beside if beside.is_file() else None
    return read if times is None else with_times(read, Path(times))


def trajectory_of_photos(posed: PosedImages, path: Path, *, rate_hz: float | None = None) -> RecordedTrajectory:
    """Where the camera was, from photos that are read already; see `read_trajectory`."""
    times = [image.time_s for image in posed]
    known = [time for time in times if time is not None]
    centres = posed.centres_src
    if rate_hz is not None:
        return _ordered(path, centres, _frame_numbers(posed) / rate_hz, posed.source_format, posed.notes, posed)
    if len(known) < max(2, len(times) // 2) or len(set(known)) < 2:
        return RecordedTrajectory(path, readonly(centres), None, posed.source_format, posed.notes, posed)
    has = np.array([time is not None for time in times])
    notes = posed.notes
    if not has.all():
        notes += (f"{int((~has).sum())} photos have no time and were left out.",)
    return _ordered(path, centres[has], np.array(known, np.float64), posed.source_format, notes, posed)


def holds_photos(path: Path) -> bool:
    """Whether a path is for `io.posed`, poses of photos and not of a sensor alone: by its name and beginning."""
    if path.is_dir():
        return True
    if path.suffix.lower() in (".xml", ".json", ".bin") or path.name in ("images.txt", "cameras.txt"):
        return True
    try:
        with path.open("rb") as file:
            head = file.read(4096).decode("utf-8", errors="replace")
    except OSError:
        return False
    first = next((line for line in head.splitlines() if line.strip() and not line.startswith("#")), "")
    columns = {_plain(part) for part in re.split(r"[,;\t]", first)}
    # A table of poses knows the lens; a trajectory with a column of names does not.
    return is_table_header(first) and "width" in columns


def _from_photos(path: Path, rate_hz: float | None) -> RecordedTrajectory:
    from dbh_studio.io.posed import read_posed_images

    posed = read_posed_images(path)
    if not len(posed):
        raise EmptyFileError(path, "It knows the pose of no photo.", "Export the cameras after they were aligned.")
    return trajectory_of_photos(posed, path, rate_hz=rate_hz)


def _frame_numbers(posed: PosedImages) -> Float64:
    """(N,) the last number in each photo's name where these ascend in the order of capture, else their count."""
    found = [re.findall(r"\d+", Path(image.name).stem) for image in posed]
    if all(found):
        values = np.array([float(digits[-1]) for digits in found])
        if (np.diff(values) > 0).all():
            return values
    return np.arange(len(posed), dtype=np.float64)


def _from_text(path: Path, rate_hz: float | None) -> RecordedTrajectory:
    try:
        text = read_text(path)
    except FileMissingError as error:
        raise FileMissingError(path, error.problem, "Check the path of the trajectory.") from None
    lines = [line.strip() for line in text.splitlines()]
    filled = [line for line in lines if line]
    rows = [line for line in filled if line[0] not in "#%"]
    if not rows:
        raise EmptyFileError(path, "It holds no pose.", "Export the trajectory again.")
    delimiter = max(",;\t", key=rows[0].count)
    delimiter = delimiter if delimiter in rows[0] else " "
    header = _cells(rows[0], delimiter)
    if not _is_number(header[0]) and not _is_date(header[0]):
        return _from_table(path, rows, header, delimiter, rate_hz)
    comment = filled[0].lstrip("#% ") if filled[0][0] in "#%" else ""
    cells = _cells(comment, delimiter if delimiter in comment else " ") if comment else []
    if len(cells) == len(header) and _column(cells, _AXIS_NAMES[0]) is not None:
        return _from_table(path, [comment, *rows], cells, delimiter, rate_hz)
    return _from_bare_numbers(path, rows, delimiter, rate_hz)


def _from_bare_numbers(path: Path, rows: list[str], delimiter: str, rate_hz: float | None) -> RecordedTrajectory:
    """TUM or KITTI, told apart by how many numbers a line has; or time, x, y, z alone."""
    width = len(_cells(rows[0], delimiter))
    table, notes = _numbers(path, rows, delimiter, width, first_line=1)
    if width == 12:
        xyz = table[:, [3, 7, 11]]
        pose = table.reshape(-1, 3, 4)[:, :, :3]
        if not (np.abs(np.linalg.norm(pose, axis=2) - 1.0) < 0.02).all():
            raise MalformedFileError(path, "It has twelve numbers a line, but they are no KITTI poses.", _REMEDY)
        time = None if rate_hz is None else np.arange(len(xyz)) / rate_hz
        return _ordered(path, xyz, time, "kitti", notes)
    if width in (4, 7, 8):
        return _ordered(path, table[:, 1:4], _seconds(table[:, 0], ""), "tum" if width == 8 else "table", notes)
    raise UnsupportedFormatError(path, f"It has {width} numbers a line, which is no trajectory known here.", _REMEDY)


def _from_table(
    path: Path, rows: list[str], header: list[str], delimiter: str, rate_hz: float | None
) -> RecordedTrajectory:
    """A table whose header names the columns."""
    axes = [_column(header, names) for names in _AXIS_NAMES]
    if any(axis is None for axis in axes):
        named = ", ".join(cell for cell in header if cell)[:120]
        raise UnsupportedFormatError(path, f"Its header names no x, y and z: {named}.", _REMEDY)
    at = [axis for axis in axes if axis is not None]
    clock, nano = _column(header, _TIME_NAMES), _column(header, _NANO_NAMES)
    wanted = at if clock is None else [*at, clock]
    if nano is not None and clock is not None:
        wanted = [*wanted, nano]
    table, notes = _numbers(path, rows[1:], delimiter, len(header), first_line=2, wanted=wanted)
    time: Float64 | None = None
    if clock is not None:
        time = _seconds(table[:, 3], header[clock])
        if nano is not None:
            time = time + 1e-9 * table[:, 4]
    elif rate_hz is not None:
        time = np.arange(len(table)) / rate_hz
    return _ordered(path, table[:, :3], time, "table", notes)


def with_times(read: RecordedTrajectory, path: Path) -> RecordedTrajectory:
    """The trajectory with the times of another file, one a line.

    Raises:
        FileError: There is not one time for each pose.
    """
    rows = [line for line in (line.strip() for line in read_text(path).splitlines()) if line and line[0] not in "#%"]
    if rows and not _is_number(re.split(r"[,;\s]+", rows[0])[0]):
        rows = rows[1:]
    try:
        times = np.array([float(re.split(r"[,;\s]+", row)[0]) for row in rows])
    except ValueError:
        raise MalformedFileError(path, "It is no list of times, one a line.", "Give one time a line.") from None
    if not (np.abs(times) < _BEYOND_REASON).all():
        raise MalformedFileError(path, "Some of its times are no numbers.", "Give one time a line.")
    if len(times) != len(read):
        raise MalformedFileError(
            path,
            f"It has {len(times):,} times for the {len(read):,} poses of {read.path.name}.",
            "Give one time for each pose.",
        )
    return _ordered(read.path, read.xyz, _seconds(times, ""), read.file_format, read.notes, read.posed)


# ---- cells and columns


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter))]
    except csv.Error:  # a quotation that never ends, or a byte no table has: no pose
        return [line]


def _plain(text: str) -> str:
    """A column's name without its unit, case and punctuation: ``Pos. X [m]`` is ``posx``."""
    return re.sub(r"[^a-zµ]", "", re.sub(r"[\[(].*?[\])]", "", text.lower()))


def _column(header: list[str], names: tuple[str, ...]) -> int | None:
    plain = [_plain(cell) for cell in header]
    # ``time_s`` and ``x_m`` are names with units.
    bare = [_plain(re.sub(r"_(m|s|ns|us|ms|sec|nsec)$", "", cell.strip().lower())) for cell in header]
    for name in names:
        for known in (plain, bare):
            if name in known:
                return known.index(name)
    return None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _is_date(text: str) -> bool:
    return not np.isnan(_number(text))


def _number(text: str) -> float:
    """A number, or a date and time as seconds since 1970; NaN where it is neither."""
    try:
        return float(text)
    except ValueError:
        pass
    try:
        date = datetime.fromisoformat(text.strip().replace("Z", "+00:00"))
    except ValueError:
        return float("nan")
    return (date if date.tzinfo is not None else date.replace(tzinfo=timezone.utc)).timestamp()


def _numbers(
    path: Path, rows: list[str], delimiter: str, width: int, *, first_line: int, wanted: list[int] | None = None
) -> tuple[Float64, tuple[str, ...]]:
    """(N, K) the wanted columns of the rows that can be read, and a note on the others.

    Raises:
        EmptyFileError: There is no row.
        MalformedFileError: More than half of them cannot be read; names the first.
    """
    columns = list(range(width)) if wanted is None else wanted
    values = np.full((len(rows), len(columns)), np.nan)
    for index, row in enumerate(rows):
        cells = _cells(row, delimiter)
        if len(cells) > max(columns) and (wanted is not None or len(cells) == width):
            values[index] = [_number(cells[column]) for column in columns]
    good = (np.abs(values) < _BEYOND_REASON).all(axis=1)
    if not len(rows):
        raise EmptyFileError(path, "It holds no pose.", "Export the trajectory again.")
    n_bad = int((~good).sum())
    if n_bad > _MOST_BAD_SHARE * len(rows):
        first = int(np.flatnonzero(~good)[0])
        raise MalformedFileError(
            path, f"{n_bad:,} of its {len(rows):,} lines are no poses, the first near line {first + first_line:,}: "
            f"{rows[first][:60]}", _REMEDY
        )  # fmt: skip
    notes = (f"{n_bad:,} of {len(rows):,} lines of {path.name} are no poses and were left out.",) if n_bad else ()
    return values[good], notes


def _seconds(time: Float64, name: str) -> Float64:
    """Times as seconds: by the unit in the column's name, else by their size where it can only be one."""
    unit = re.search(r"[\[(_]\s*(ns|nsec|us|µs|usec|ms|msec|secs?|seconds|s)\s*[\])]?$", name.strip().lower())
    if unit is not None:
        return time * _UNITS_S[unit.group(1)]
    largest = float(np.abs(time).max()) if len(time) else 0.0
    if largest < _LARGEST_S:
        return time
    return time * (1e-3 if largest < _LARGEST_MS else 1e-6 if largest < _LARGEST_US else 1e-9)


def _ordered(
    path: Path,
    xyz: Float64,
    time: Float64 | None,
    file_format: str,
    notes: tuple[str, ...],
    posed: PosedImages | None = None,
) -> RecordedTrajectory:
    """With ascending times: sorted, and one pose for each."""
    xyz = np.asarray(xyz, np.float64)
    if time is None:
        return RecordedTrajectory(path, readonly(xyz), None, file_format, notes, posed)
    kept, first = np.unique(time, return_index=True)
    if len(kept) < len(time):
        n = len(time) - len(kept)
        notes += (f"{n:,} poses of {path.name} have the time of another one and were left out.",)
    if len(kept) < 2:
        raise FileError(path, "All its poses have one time.", "Export it with the time of each pose.")
    return RecordedTrajectory(path, readonly(xyz[first]), readonly(kept), file_format, notes, posed)
