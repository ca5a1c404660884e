"""The inventory as an Excel workbook: the stems, the stand table, the profiles, the edits, and how it was measured."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dbh_studio.core.markup import without_controls
from dbh_studio.core.stand import StandTable
from dbh_studio.errors import MissingComponentError
from dbh_studio.io.exports.columns import Table, written_whole
from dbh_studio.io.exports.edit_log import EDIT_COLUMNS, LogEntry, cells
from dbh_studio.io.exports.pages import Words

_WIDEST = 60
_EDIT_WIDTHS = (26, 14, 44, 11, 9, 32, 44)
# What Excel takes: XlsxWriter leaves out a text that is longer.
_LONGEST_CELL, _MOST_ROWS = 32_767, 1_000_000
_FORMATS = {"_cm": "0.00", "_in": "0.00", "_m": "0.000", "_ft": "0.00", "_deg": "0.0", "_mm": "0.0", "_pct": "0.00"}


def write_xlsx(
    path: Path | str,
    table: Table,
    stand: StandTable | None = None,
    *,
    about: Mapping[str, str] | None = None,
    log: Sequence[LogEntry] = (),
    profiles: Table | None = None,
) -> Path:
    """Write a workbook with the sheets Stems, Stand (where it is given), Stem profiles, Edits and About (likewise).

    Text is written as text: nothing in a note becomes a formula or a link.

    Args:
        path: Of the workbook.
        table: The stems.
        stand: The stand table.
        about: Facts to go with it, such as how breast height was taken.
        log: What was done to the plot.
        profiles: Diameters along the stems (`profile_table`).

    Raises:
        FileError: It cannot be written.
        MissingComponentError: XlsxWriter is absent.
    """
    try:
        import xlsxwriter
    except ImportError as error:
        raise MissingComponentError(
            "Workbooks need XlsxWriter, which is not installed.", "Install it, or export the CSV, which Excel opens."
        ) from error
    path = Path(path)
    content = io.BytesIO()
    options = {"in_memory": True, "strings_to_formulas": False, "strings_to_urls": False, "strings_to_numbers": False}
    with xlsxwriter.Workbook(content, options) as book:
        head = book.add_format({"bold": True, "bottom": 1, "text_wrap": True, "valign": "top"})
        _table(book, "Stems", table, head, n_fixed=3)
        if stand is not None:
            _stand(book, stand, head)
        if profiles is not None:
            _table(book, "Stem profiles", profiles, head, n_fixed=4)
        if log:
            _edits(book, log, head)
        if about:
            sheet = book.add_worksheet("About")
            sheet.set_column(0, 0, 28)
            sheet.set_column(1, 1, _WIDEST)
            for row, (name, text) in enumerate(about.items()):
                sheet.write_string(row, 0, name, book.add_format({"bold": True}))
                sheet.write_string(row, 1, without_controls(text)[:_LONGEST_CELL])
    with written_whole(path) as file:
        file.write(content.getvalue())
    return path


def _table(book: Any, name: str, table: Table, head: Any, *, n_fixed: int) -> None:
    """A sheet with a table, whose first columns stay in sight."""
    sheet = book.add_worksheet(name)
    sheet.freeze_panes(1, n_fixed)
    rows = table.rows[:_MOST_ROWS]
    formats = {suffix: book.add_format({"num_format": text}) for suffix, text in _FORMATS.items()}
    for index, column in enumerate(table.columns):
        sheet.write_string(0, index, column.name, head)
        shown = next((made for suffix, made in formats.items() if column.name.endswith(suffix)), None)
        cells = [row[index] for row in rows]
        longest = max([len(str(cell)) for cell in cells if isinstance(cell, str)], default=8)
        sheet.set_column(index, index, min(max(8, len(column.name), longest), _WIDEST))
        for number, cell in enumerate(cells, start=1):
            _write(sheet, number, index, cell, shown)
    if rows:
        sheet.autofilter(0, 0, len(rows), len(table.columns) - 1)


def _stand(book: Any, stand: StandTable, head: Any) -> None:
    sheet = book.add_worksheet("Stand")
    metric = stand.units == "metric"
    per, basal, unit = ("ha", "m²/ha", "cm") if metric else ("acre", "ft²/acre", "in")
    number = book.add_format({"num_format": "0.0"})
    classes = [
        f"{low:g}-{high:g} {unit}, stems/{per}"
        for low, high in zip(stand.class_edges, stand.class_edges[1:], strict=False)
    ]
    names = [
        "species", "trees", "stems", "stems without a diameter", f"stems/{per}", f"basal area, {basal}",
        f"quadratic mean diameter, {unit}", f"mean diameter, {unit}", f"smallest, {unit}", f"largest, {unit}", *classes,
    ]  # fmt: skip
    sheet.set_column(0, len(names), 14)
    for index, name in enumerate(names):
        sheet.write_string(0, index, name, head)
    for at, row in enumerate([*stand.rows, stand.total], start=1):
        name = "all" if at > len(stand.rows) else row.species or "(not said)"
        cells = [
            name, row.n_trees, row.n_stems, row.n_refused, row.stems_per_area, row.basal_area, row.qmd, row.mean,
            row.least, row.greatest, *row.classes,
        ]  # fmt: skip
        for index, cell in enumerate(cells):
            _write(sheet, at, index, cell, number if isinstance(cell, float) else None)
    below = len(stand.rows) + 3
    sheet.write_string(below, 0, f"Horizontal area of the plot: {stand.area_m2:,.1f} m²")
    sheet.write_string(below + 1, 0, f"Stems outside the plot or without a place: {stand.n_outside}")
    sheet.write_string(below + 2, 0, "Basal area and mean diameters are those of the stems with a diameter.")
    if stand.least_dbh_cm > 0:
        least = Words(stand.units).diameter(stand.least_dbh_cm, unit=True)
        sheet.write_string(below + 3, 0, f"Stems thinner than {least}, which are left out: {stand.n_thin}")


def _edits(book: Any, log: Sequence[LogEntry], head: Any) -> None:
    sheet = book.add_worksheet("Edits")
    sheet.freeze_panes(1, 0)
    for index, (name, width) in enumerate(zip(EDIT_COLUMNS, _EDIT_WIDTHS, strict=True)):
        sheet.write_string(0, index, name, head)
        sheet.set_column(index, index, width)
    for at, entry in enumerate(log[-_MOST_ROWS:], start=1):
        for index, cell in enumerate(cells(entry)):
            _write(sheet, at, index, cell, None)


def _write(sheet: Any, row: int, column: int, cell: Any, shown: Any) -> None:
    """A cell as what it is; nothing where nothing is known."""
    if isinstance(cell, bool):
        sheet.write_boolean(row, column, cell)
    elif isinstance(cell, (int, float)):
        sheet.write_number(row, column, cell, shown)
    elif cell:
        sheet.write_string(row, column, without_controls(str(cell))[:_LONGEST_CELL])
