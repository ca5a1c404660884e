"""Tables of trees as people keep them: comma, semicolon, tab or bar; decimal point or comma; any usual encoding.

`read_cells` gives the cells as text; `io.table_columns` finds out what they mean.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.errors import EmptyFileError, FileError, FileMissingError, MalformedFileError, UnsupportedFormatError

_MOST_BYTES = 256 * 2**20
_DELIMITERS = ",;\t|"
_LINES_TRIED = 30
# What programs and people write for "not known". A minus alone too.
_UNKNOWN = frozenset(
    ("", "na", "n/a", "#n/a", "#na", "nan", "null", "none", "nil", "-", "--", "–", ".", "?", "#value!", "inf", "-inf")
)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\Z")
# A comma that can be nothing but the decimal sign; and what could be thousands.
_DECIMAL_COMMA = re.compile(r"[+-]?(\d*,(\d{1,2}|\d{4,})|\d{1,3}(\.\d{3})+,\d+|0,\d+)\Z")
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}([.,]\d{3})+\Z")
_EXPORT = "Export it as CSV (UTF-8) with one header line."


@dataclass(frozen=True, eq=False)
class CellTable:
    """A table as text.

    Attributes:
        path: Where it is from.
        columns: Cells by heading, without surrounding blanks, all of one length.
        lines: Line of the file each row begins on, counted from 1.
        notes: What was odd about the file, in plain words.
    """

    path: Path
    columns: Mapping[str, tuple[str, ...]]
    lines: tuple[int, ...]
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.lines)


def read_cells(path: Path | str) -> CellTable:
    """Read a table.

    Raises:
        FileError: It is absent, no text, has no header line, or a row has more cells than the header; says where.
    """
    path = Path(path)
    return cells_of(_bytes(path), path)


def cells_of(data: bytes, path: Path | str) -> CellTable:
    """A table that is in memory; `path` is what it is called.

    Raises:
        FileError: As `read_cells`.
    """
    path = Path(path)
    text, notes = _text(data, path)
    rows = _rows(text, path)
    if not rows:
        raise EmptyFileError(path, "the table is empty.", "It needs a header line and a line for each stem.")
    header = [cell.strip() for cell in rows[0][1]]
    _check_header(header, path)
    names = _distinct(header)
    body = rows[1:]
    for line, cells in body:
        if any(cell.strip() for cell in cells[len(names) :]):
            raise MalformedFileError(
                path,
                f"line {line:,} has {len(cells)} cells and the header line {len(names)}.",
                "Is the decimal sign a comma? Then divide the columns by semicolons, or put the numbers in quotes.",
            )
    if not body:
        raise EmptyFileError(path, "the table has a header line and nothing else.", "")
    n_short = sum(len(cells) < len(names) for _, cells in body)
    if n_short:
        notes.append(f"{path.name}: {n_short} lines end early; the cells they lack count as empty.")
    # By column at once: some databases have two hundred.
    by_column = zip_longest(*(cells for _, cells in body), fillvalue="")
    columns = {name: tuple(map(str.strip, cells)) for name, cells in zip(names, by_column, strict=False)}
    columns |= {name: ("",) * len(body) for name in names[len(columns) :]}
    return CellTable(path, columns, tuple(line for line, _ in body), tuple(notes))


def _bytes(path: Path) -> bytes:
    try:
        if path.is_dir():
            raise UnsupportedFormatError(path, "this is a folder.", "Name the table in it.")
        if path.stat().st_size > _MOST_BYTES:
            raise UnsupportedFormatError(path, "this is too large for a table of trees (over 256 MB).", "")
        return path.read_bytes()
    except FileNotFoundError:
        raise FileMissingError(path, "there is no such file.", "Check the path.") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FileError(path, f"the file cannot be read ({reason}).", "Check the path and its permissions.") from None


def _text(data: bytes, path: Path) -> tuple[str, list[str]]:
    if data.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0")):
        raise UnsupportedFormatError(path, "this is a workbook, not a text table.", "Save the sheet as CSV first.")
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", errors="replace"), []
    if b"\x00" in data[:65_536]:
        raise UnsupportedFormatError(path, "this is no text.", _EXPORT)
    try:
        return data.decode("utf-8-sig"), []
    except UnicodeDecodeError:
        # Every byte means something in cp1252 or Latin-1; diameters are digits in all of them.
        return data.decode("latin-1"), [f"{path.name}: this is not UTF-8; accents may be read wrongly."]


def _rows(text: str, path: Path) -> list[tuple[int, list[str]]]:
    """(line, cells) of all rows that are neither blank nor, before the header, a comment."""
    best: list[tuple[int, list[str]]] = []
    line = 1
    try:
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=_delimiter(text), skipinitialspace=True)
        for cells in reader:
            is_comment = not best and bool(cells) and cells[0].lstrip().startswith("#")
            if any(cell.strip() for cell in cells) and not is_comment:
                best.append((line, cells))
            line = reader.line_num + 1
    except csv.Error as error:
        raise MalformedFileError(path, f"line {line:,} cannot be read ({error}).", _EXPORT) from None
    return best


def _delimiter(text: str) -> str:
    """The sign under which most lines have as many cells as the first, and more than one."""
    lines = [line for line in text[:200_000].splitlines() if line.strip() and not line.startswith("#")]
    tried = lines[:_LINES_TRIED]
    scores = {}
    for delimiter in _DELIMITERS:
        counts = [len(row) for row in csv.reader(tried, delimiter=delimiter)]
        first = counts[0] if counts else 1
        same = sum(n == first for n in counts)
        scores[delimiter] = (same / max(len(counts), 1) >= 0.5 and first > 1, first, same)
    return max(_DELIMITERS, key=lambda d: scores[d])


def _check_header(header: Sequence[str], path: Path) -> None:
    numeric = [_NUMBER.match(cell.replace(",", ".")) is not None for cell in header if cell]
    if len(numeric) > 1 and all(numeric):
        raise MalformedFileError(path, "the first line holds numbers and no names of columns.", "Add a header line.")


def _distinct(header: Sequence[str]) -> list[str]:
    """Headings, the second of two equal ones as ``name (2)``; a nameless column as ``column 3``."""
    names: list[str] = []
    for k, cell in enumerate(header, start=1):
        name = cell or f"column {k}"
        count = 2
        while name in names:
            name, count = f"{cell or f'column {k}'} ({count})", count + 1
        names.append(name)
    return names


def is_unknown(cell: str) -> bool:
    """Whether a cell says that nothing is known."""
    return cell.strip().casefold() in _UNKNOWN


def numbers(cells: Sequence[str]) -> Float64:
    """(N,) numbers of a column; NaN for cells that say nothing and for those that are no number.

    Of point and comma the last one in a cell is the decimal sign (``1.234,5``, ``1,234.5``). ``1,234`` is one and a
    bit, unless other cells of the column have a decimal point; so is ``1.234``, unless others have a decimal comma.
    """
    has_comma = any(_DECIMAL_COMMA.match(cell) for cell in cells)
    has_point = any("." in cell and cell.rfind(".") > cell.rfind(",") for cell in cells) and not has_comma
    return np.array([_number(cell, has_comma, has_point) for cell in cells], np.float64)


def _number(cell: str, has_comma: bool, has_point: bool) -> float:
    text = cell.strip().replace("−", "-").replace("\u00a0", "").replace("'", "")
    point, comma = text.rfind("."), text.rfind(",")
    is_grouped = _GROUPED.match(text) is not None
    if comma > point:
        is_decimal = text.count(",") == 1 and not (is_grouped and has_point)
        text = text.replace(".", "").replace(",", "." if is_decimal else "")
    elif text.count(".") > 1 or (is_grouped and has_comma):
        text = text.replace(".", "")
    else:
        text = text.replace(",", "")
    return float(text) if _NUMBER.match(text) else float("nan")


def plain_name(column: str) -> str:
    """A heading in lower case, words joined by underscores: ``DBH (cm)`` is ``dbh_cm``."""
    return re.sub(r"[^a-z0-9]+", "_", column.casefold()).strip("_")
