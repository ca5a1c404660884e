"""XYZ, ASC, TXT, CSV and PTS: one point per line, with whatever separator, header and columns."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.reconstruction import Provenance
from dbh_studio.errors import EmptyFileError, FileError, MalformedFileError, TruncatedFileError
from dbh_studio.io.chunks import Attributes, CloudBuilder, LoadedCloud, is_wanted

_SAMPLE_BYTES = 1 << 16
_BLOCK_BYTES = 1 << 24
_SAMPLE_ROWS = 200
_COMMENTS = ("#", "//", "%", "!")
_AXES = (
    ("x", "xm", "easting", "east", "xcoord", "xcoordinate", "coordx", "pointsx", "points0", "posx", "px"),
    ("y", "ym", "northing", "north", "ycoord", "ycoordinate", "coordy", "pointsy", "points1", "posy", "py"),
    ("z", "zm", "elevation", "height", "zcoord", "zcoordinate", "coordz", "pointsz", "points2", "posz", "pz"),
)
_COLOURS = (("r", "red", "rf"), ("g", "green", "gf"), ("b", "blue", "bf"))
# Stands for letters in text columns: read as Latin-1, the bytes of some count as white space, which shifts columns.
_WITHOUT_LETTERS = bytes(range(128)) + b"?" * 128
_MISSING = re.compile(rb"(?<![\w.])(?:NA|N/A|NULL|null|None)(?![\w.])")


@dataclass(frozen=True)
class TextLayout:
    """How a text cloud is laid out.

    Attributes:
        skip_lines: Lines before the first point.
        delimiter: None for any white space.
        decimal_comma: Whether 1,5 means one and a half.
        n_columns: Fields per line.
        names: Column names; made up as ``column_4`` … where the file names none.
        coordinates: Columns of x, y, z.
        colours: Columns of red, green, blue, or None.
        line_bytes: Mean length of a line.
        last_comment: The comment before the data, which may say what wrote the file.
    """

    skip_lines: int
    delimiter: str | None
    decimal_comma: bool
    n_columns: int
    names: tuple[str, ...]
    coordinates: tuple[int, ...]
    colours: tuple[int, ...] | None
    line_bytes: float
    last_comment: str = ""


def read_numbers(file: BinaryIO, n_rows: int, n_columns: int, path: Path) -> Float64:
    """(≤ n_rows, n_columns) numbers from the next lines; fewer rows only where the file ends.

    Raises:
        MalformedFileError: A line is not made of that many numbers.
        TruncatedFileError: So is the last line, and it has no line end.
    """
    lines = list(islice(file, n_rows))
    return _parse(lines, 0, path, n_columns=n_columns)


def _parse(
    lines: list[bytes],
    first_line: int,
    path: Path,
    *,
    n_columns: int,
    delimiter: str | None = None,
    columns: list[int] | None = None,
) -> Float64:
    """(rows, columns) numbers of some lines; `first_line` is for messages."""
    if not any(map(bytes.strip, lines)):
        return np.zeros((0, len(columns or range(n_columns))))
    try:
        rows = np.loadtxt(
            lines, delimiter=delimiter, usecols=columns, ndmin=2, comments="#", encoding="latin-1", quotechar='"'
        )
    except (ValueError, IndexError) as error:
        raise _line_error(str(error), lines, first_line, path) from None
    if columns is None and rows.size and rows.shape[1] != n_columns:
        raise MalformedFileError(
            path, f"A point has {rows.shape[1]} values but {n_columns} are promised.", "Export the cloud again."
        )
    return rows


def _line_error(message: str, lines: list[bytes], first_line: int, path: Path) -> FileError:
    """Which line is wrong; a bad last line without a line end is a file cut short."""
    match = re.search(r"row (\d+)", message)
    row = min(int(match.group(1)), len(lines) - 1) if match else 0
    if row >= len(lines) - 2 and not lines[-1].endswith((b"\n", b"\r")):
        return TruncatedFileError(path, "The file ends in the middle of a line.", "Copy or download it again.")
    shown = lines[row].decode("latin-1").strip()[:60]
    return MalformedFileError(
        path, f"Near line {first_line + row + 1} there is no point: {shown!r}.", "Remove or repair that line."
    )


def sniff_layout(path: Path) -> TextLayout:
    """Find separator, header and columns from the start of a text file.

    Raises:
        EmptyFileError: There is no line of numbers.
        MalformedFileError: There are numbers, but no x, y and z; or the text is not in lines that can be read.
    """
    with open(path, "rb") as file:
        data = file.read(_SAMPLE_BYTES)
        complete = not file.read(1)
    if data.startswith((b"\xff\xfe", b"\xfe\xff")) or b"\0" in data[:1024]:
        raise MalformedFileError(
            path, "The text is not plain (it looks like UTF-16).", "Save it as UTF-8 or plain text."
        )
    lines = _sample_lines(data, complete, path)
    header: list[str] = []
    comment = ""
    for number, line in enumerate(lines):
        text = line.strip()
        is_comment = text.startswith(_COMMENTS)
        delimiter, decimal_comma = _separator(text)
        fields = _fields(text, delimiter, decimal_comma)
        if not is_comment and sum(map(_is_number, fields)) >= 3:
            sample = lines[number : number + _SAMPLE_ROWS]
            mean = sum(map(len, sample)) / len(sample) + 1
            return _layout(path, number, delimiter, decimal_comma, fields, header, sample, mean, comment)
        words = re.split(r"[,;\t]" if re.search(r"[,;\t]", text) else r"\s+", text.lstrip("#/%! ").strip(";, \t"))
        if is_comment:
            comment = text
        if len(words) >= 3 and not (is_comment and header and len(words) > 20):
            header = [word.strip().strip('"') for word in words]
    raise EmptyFileError(path, "There is no line with three numbers in it.", "Export the cloud as x y z lines.")


def _sample_lines(data: bytes, complete: bool, path: Path) -> list[str]:
    """The lines of the beginning of a file, as the reader counts them: only line feeds end one."""
    if b"\r" in data and b"\n" not in data:
        raise MalformedFileError(
            path,
            "The lines end with carriage returns alone, as on very old Macs.",
            "Save it with the line ends of Unix or Windows.",
        )
    lines = data.removeprefix(b"\xef\xbb\xbf").split(b"\n")
    if len(lines) > 1 and (not complete or not lines[-1]):
        del lines[-1]  # cut in the middle, or what follows the last line feed
    try:
        text = b"\n".join(lines).decode()
    except UnicodeDecodeError:
        text = b"\n".join(lines).decode("cp1252", "replace")
    return text.split("\n")


def _separator(text: str) -> tuple[str | None, bool]:
    """The delimiter of a line (None for white space), and whether its commas are decimal."""
    if ";" in text:
        return ";", bool(re.search(r"\d,\d", text))
    tokens = text.split()
    if "," in text and len(tokens) >= 3 and all(re.fullmatch(r"[-+]?\d+(,\d+)?", token) for token in tokens):
        return None, True
    return ("," if "," in text else None), False


def _fields(text: str, delimiter: str | None, decimal_comma: bool) -> list[str]:
    text = text.replace(",", ".") if decimal_comma else text
    return [field.strip().strip('"') for field in text.split(delimiter)]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word


def _layout(
    path: Path,
    skip: int,
    delimiter: str | None,
    decimal_comma: bool,
    fields: list[str],
    header: list[str],
    sample: list[str],
    line_bytes: float,
    comment: str,
) -> TextLayout:
    n_columns = len(fields)
    if len(header) == n_columns - 1 and not any(map(_is_number, header)):
        header = ["row", *header]  # R leaves the name of the row numbers out.
    if len(header) == n_columns and not any(map(_is_number, header)):
        plain = [re.sub(r"[^a-z0-9]", "", re.sub(r"\[.*?\]|\(.*?\)", "", name.lower())) for name in header]
        xyz = _named(plain, _AXES)
        if xyz is None:
            raise MalformedFileError(
                path, f"There are no columns x, y and z; the columns are {', '.join(header[:12])}.", "Rename them."
            )
        return TextLayout(
            skip, delimiter, decimal_comma, n_columns, tuple(header), xyz, _named(plain, _COLOURS), line_bytes, comment
        )
    rows = [_fields(line.strip(), delimiter, decimal_comma) for line in sample]
    values = [[float(f) if _is_number(f) else np.nan for f in row] for row in rows if len(row) == n_columns]
    names = ("x", "y", "z", *(f"column_{i + 1}" for i in range(3, n_columns)))
    colours = _guess_colours(np.array(values), prefer_last=path.suffix.lower() == ".pts")
    return TextLayout(skip, delimiter, decimal_comma, n_columns, names, (0, 1, 2), colours, line_bytes, comment)


def _named(plain: list[str], wanted: tuple[tuple[str, ...], ...]) -> tuple[int, ...] | None:
    """The column of each wanted quantity, by the first of its names that occurs; None unless all are there."""
    found = [next((plain.index(name) for name in names if name in plain), None) for names in wanted]
    return None if None in found else tuple(column for column in found if column is not None)


def _guess_colours(values: Float64, *, prefer_last: bool) -> tuple[int, ...] | None:
    """Three neighbouring columns that look like colours in a file without a header."""
    n_columns = values.shape[1]
    starts = [4, 3] if prefer_last else [3, 4]
    for start in starts:
        if start + 3 > n_columns:
            continue
        rgb = values[:, start : start + 3]
        whole = bool((rgb == np.round(rgb)).all())
        if (
            np.isfinite(rgb).all()
            and rgb.min() >= 0
            and rgb.max() <= (65535 if whole else 1)
            and (rgb.max() > 1 or not whole)
        ):
            return start, start + 1, start + 2
    return None


def read_xyz(path: Path, *, progress: Progress = ignore_progress, attributes: Attributes = "needed") -> LoadedCloud:
    """Read a text cloud.

    Raises:
        FileError: `EmptyFileError`, `MalformedFileError` or `TruncatedFileError`, with the line.
    """
    layout = sniff_layout(path)
    taken = {*layout.coordinates, *(layout.colours or ())}
    extra = [i for i, name in enumerate(layout.names) if i not in taken and name and is_wanted(name, attributes)]
    columns = [*layout.coordinates, *(layout.colours or ()), *extra]
    n_colours = len(layout.colours or ())
    size = os.path.getsize(path)
    builder = CloudBuilder(
        path,
        capacity=int(size / layout.line_bytes * 1.05) + 1,
        colour_dtype=np.float64 if n_colours else None,
        attribute_dtypes={layout.names[i]: np.float64 for i in extra},
    )
    clean = _cleaner(layout)
    with open(path, "rb") as file:
        list(islice(file, layout.skip_lines))
        line = layout.skip_lines
        while lines := file.readlines(_BLOCK_BYTES // 2):
            try:
                rows = _parse(
                    clean(lines), line, path, n_columns=layout.n_columns, delimiter=layout.delimiter, columns=columns
                )
            except MalformedFileError:
                repaired = _MISSING.sub(b"nan", b"".join(lines))
                if repaired == b"".join(lines):
                    raise
                lines = repaired.splitlines(keepends=True)
                rows = _parse(
                    clean(lines), line, path, n_columns=layout.n_columns, delimiter=layout.delimiter, columns=columns
                )
            line += len(lines)
            others = {layout.names[i]: rows[:, 3 + n_colours + k] for k, i in enumerate(extra)}
            builder.add(rows[:, :3], rows[:, 3 : 3 + n_colours] if n_colours else None, others)
            progress(min(1.0, file.tell() / max(size, 1)), f"Reading {path.name}")
    cloud, notes = builder.finish(name=path.name)
    return LoadedCloud(cloud, (*_describe(layout), *notes), Provenance("xyz", layout.last_comment[:200]))


def _cleaner(layout: TextLayout) -> Callable[[list[bytes]], list[bytes]]:
    """Turn decimal commas into points, where there are any, and replace what is not ASCII."""

    def clean(lines: list[bytes]) -> list[bytes]:
        if layout.decimal_comma:
            lines = b"".join(lines).replace(b",", b".").splitlines(keepends=True)
        if not all(map(bytes.isascii, lines)):
            lines = [line.translate(_WITHOUT_LETTERS) for line in lines]
        return lines

    return clean


def _describe(layout: TextLayout) -> tuple[str, ...]:
    unnamed = [name for name in layout.names if name.startswith("column_")]
    unnamed = [name for name in unnamed if not layout.colours or layout.names.index(name) not in layout.colours]
    if not unnamed:
        return ()
    return (f"The columns have no names: the first three were taken for x, y, z; {', '.join(unnamed)} not used.",)
