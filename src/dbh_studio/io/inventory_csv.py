"""The inventory as CSV: UTF-8, comma, one header line, line feeds, an empty cell for what is not known.

The same inventory gives the same bytes on every machine. Text that a spreadsheet would run as a formula is defused.
"""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from dbh_studio.core.inventory import COLUMNS, Inventory, InventoryRow
from dbh_studio.errors import FileError
from dbh_studio.io.atomic import atomic_file
from dbh_studio.io.column_names import own_columns

# Decimals by column: a tape reads millimetres, a scanner no finer than that.
_DECIMALS = {
    **{column: 2 for column in COLUMNS if column.startswith("dbh_") and column.endswith("_cm")},
    "tree_dbh_cm": 2,
    "taper_cm_per_m": 2,
    "hom_m": 3,
    "coverage_deg": 1,
    "max_gap_deg": 1,
    "rmse_mm": 1,
    "lean_deg": 1,
    "x_m": 3,
    "y_m": 3,
    "z_ground_m": 3,
    "scale_err_pct": 3,
    "field_tape_cm": 2,
    "field_tape_height_m": 3,
    "easting": 3,
    "northing": 3,
}

# An inventory of this or an earlier version, and so ours to replace: later versions have more columns between these.
_FIRST_COLUMNS = COLUMNS[:7]
_LAST_COLUMN = "epsg"

# OWASP, "CSV injection": these start a formula in Excel, LibreOffice and Google Sheets, at the start of a cell. Where
# the decimal sign is a comma, a spreadsheet divides at semicolons and takes the quotes around our cell for letters:
# there a cell also starts behind a semicolon, a tab or a line feed, and its own quotes are opened by one in the text.
# Apostrophes that stand there count too, so that ours can be told from theirs and taken away again.
_SIGNS = r"=+\-@＝＋－＠"
_FORMULA_START = re.compile(rf"\A(?='*[{_SIGNS}\t\n])|(?<=[;\t\n|])(?=[\"']*[{_SIGNS}])")
_DEFUSED_START = re.compile(rf"\A'(?='*[{_SIGNS}\t\n])|(?<=[;\t\n|])'(?=[\"']*[{_SIGNS}])")


def _cell(column: str, value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        text = f"{value:.{_DECIMALS.get(column, 3)}f}"
        # -0.000 is a zero that looks like a mistake.
        return text.removeprefix("-") if float(text) == 0 else text
    return defused(str(value))


def defused(text: str) -> str:
    """Text for a cell of any table, with an apostrophe where a spreadsheet would begin to read a formula."""
    # A NUL ends the text for many readers; a lone carriage return is a line end to some and is not quoted by csv.
    text = text.replace("\x00", "").replace("\r\n", "\n").replace("\r", "\n")
    return _FORMULA_START.sub("'", text)


def undefused(text: str) -> str:
    """What `defused` was given."""
    return _DEFUSED_START.sub("", text)


def _cells(row: InventoryRow) -> list[str]:
    return [_cell(column, getattr(row, column)) for column in COLUMNS]


def inventory_csv(inventory: Inventory, *, bom: bool = False) -> bytes:
    """The whole file.

    Args:
        bom: Begin with a byte order mark, which old Excel needs to see UTF-8 and R and older pandas take for text.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    own = own_columns(inventory.own_names)
    said = {stem_id: dict(pairs) for stem_id, pairs in inventory.own}
    writer.writerow([*COLUMNS, *map(defused, own.values())])
    for row in inventory:
        values = said.get(row.stem_id, {})
        writer.writerow([*_cells(row), *(defused(values.get(name, "")) for name in own)])
    return text.getvalue().encode("utf-8-sig" if bom else "utf-8", errors="replace")


def write_inventory_csv(path: Path | str, inventory: Inventory, *, bom: bool = False) -> Path:
    """Write the inventory; `path` is replaced whole or stays as it was.

    Raises:
        FileError: The file cannot be written (disk full, open in a spreadsheet, not permitted).
    """
    path = Path(path)
    content = inventory_csv(inventory, bom=bom)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as file:
            file.write(content)
    except OSError as error:
        raise FileError(
            path,
            f"The table could not be written ({error.strerror or error}).",
            "Close it where it is open, make room on the disk, or choose another folder.",
        ) from error
    return path


def check_not_source(path: Path, sources: Iterable[Path]) -> None:
    """Raise FileError where writing `path` would destroy what a plot is read from.

    Args:
        path: The table to be written.
        sources: Files, and folders whose files are read; they need not be there.
    """
    for source in sources:
        folder_or_file = path.parent if os.path.isdir(source) else path  # noqa: PTH112 - pathlib's raises
        if os.path.exists(path) and os.path.exists(source) and folder_or_file.samefile(source):  # noqa: PTH110
            raise FileError(
                path,
                "The table would overwrite this file, and the plot is read from it.",
                "Choose another name or folder for the table.",
            )


def check_replaceable(path: Path) -> None:
    """Raise FileError where there is a file at `path` that is no inventory, and so cannot be had again."""
    if os.path.lexists(path) and not _is_inventory(path):
        raise _exists(path)


def check_absent(path: Path) -> None:
    """Raise FileError where there is anything at `path`, even an inventory: it is not that of a plot to be made."""
    if os.path.lexists(path):
        raise _exists(path)


def _exists(path: Path) -> FileError:
    return FileError(
        path,
        "There is such a file already, and this plot did not write it.",
        "Move it away, choose another name or folder, or say that it may be overwritten.",
    )


def _is_inventory(path: Path) -> bool:
    """Whether it has the columns of an inventory in every line."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            header, *rows = csv.reader(file, strict=True)
    except (OSError, ValueError, csv.Error):
        return False
    is_ours = tuple(header[: len(_FIRST_COLUMNS)]) == _FIRST_COLUMNS and header[-1] == _LAST_COLUMN
    return is_ours and set(header) <= set(COLUMNS) and all(len(row) == len(header) for row in rows)


def projected_epsg(crs: str | None) -> tuple[bool, int | None]:
    """Whether `crs` is a projected (map) system, and the EPSG code of its horizontal part where it has one.

    A system that cannot be understood, or not without pyproj, is (False, None): no position is better than a wrong one.
    """
    if not crs:
        return False, None
    try:
        import pyproj  # slow to import, and needed only for clouds with a coordinate reference system
    except ImportError:
        return False, None
    try:
        parsed = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError:
        return False, None
    horizontal = parsed.sub_crs_list[0] if parsed.is_compound and parsed.sub_crs_list else parsed
    return bool(horizontal.is_projected), horizontal.to_epsg()
