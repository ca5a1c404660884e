"""Markers to print: one large sheet for a copy shop, or A4 pages to glue together.

The pattern is drawn as vectors at its true size. Whatever the printer made of it, the side that counts is the one
measured with a ruler on the finished board; every page carries a line of known length to check first.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from dbh_studio.core.arrays import Bool
from dbh_studio.errors import SettingError
from dbh_studio.io.atomic import atomic_file
from dbh_studio.io.marker_codes import known_name, marker_bits
from dbh_studio.io.pdf import PdfPage, pdf_bytes

Paper = Literal["A4", "sheet"]
PAPERS: tuple[Paper, ...] = ("A4", "sheet")

SMALLEST_SIDE_M, LARGEST_SIDE_M = 0.05, 2.0
_A4_MM = (210.0, 297.0)
_MARGIN_MM = 10.0
_GLUE_MM = 10.0
_FOOT_MM = 18.0
_RULER_MM = 100.0


@dataclass(frozen=True)
class MarkerPdf:
    """What was written.

    Attributes:
        path: The file.
        n_pages: Pages, the instructions included.
        rows: Rows of A4 pages; 1 on a sheet.
        columns: Columns of them.
        side_m: Outer edge of the black square.
        rim_mm: White around it.
    """

    path: Path
    n_pages: int
    rows: int
    columns: int
    side_m: float
    rim_mm: float


@dataclass(frozen=True, eq=False)
class _Drawing:
    """The marker with its rim, in millimetres from the rim's top-left corner."""

    name: str
    bits: Bool
    side_mm: float
    rim_mm: float

    @property
    def whole_mm(self) -> float:
        return self.side_mm + 2 * self.rim_mm

    def draw(self, page: PdfPage, left_mm: float, top_mm: float, scale: float = 1.0) -> None:
        """One black square, and the white cells on it as one path."""
        cell = self.side_mm * scale / self.bits.shape[0]
        x, y = left_mm + self.rim_mm * scale, top_mm + self.rim_mm * scale
        page.rectangles([(x, y, self.side_mm * scale, self.side_mm * scale)], 0.0)
        white = [(x + c * cell, y + r * cell, cell, cell) for r, c in np.argwhere(self.bits)]
        page.rectangles(white, 1.0)

    @property
    def check_text(self) -> str:
        return (
            f"Black square: {self.side_mm:.0f} mm on each side, {self.side_mm * np.sqrt(2):.1f} mm across. "
            "Measure the finished board and give the program what you measured."
        )


def write_marker_pdf(
    path: Path | str, *, dictionary: str, marker_id: int, side_m: float, paper: Paper = "A4"
) -> MarkerPdf:
    """Write a marker to print.

    Args:
        path: Of the PDF; replaced where it exists.
        dictionary: Such as ``DICT_4X4_50``.
        marker_id: Its number.
        side_m: Outer edge of the black square.
        paper: ``A4``: pages to glue (one page where the marker fits); ``sheet``: one page of the size needed.

    Raises:
        SettingError: There is no such marker, or the side or paper cannot be.
        MissingComponentError: OpenCV is absent.
        OSError: The folder cannot be written, or the disk is full.
    """
    if paper not in PAPERS:
        raise SettingError(f"There is no paper {paper!r}.", f"Choose one of: {', '.join(PAPERS)}.")
    if not SMALLEST_SIDE_M <= side_m <= LARGEST_SIDE_M:
        raise SettingError(
            f"A side of {side_m:g} m cannot be printed.", f"Choose {SMALLEST_SIDE_M:g} to {LARGEST_SIDE_M:g} m."
        )
    bits = marker_bits(dictionary, marker_id)
    side_mm = 1000.0 * side_m
    # The detector needs white around the square; on glued pages each centimetre of it may cost a row of paper.
    rim_mm = min(side_mm / bits.shape[0], (0.038 if paper == "A4" else 0.12) * side_mm)
    drawing = _Drawing(f"{known_name(dictionary)}, number {marker_id}", bits, side_mm, rim_mm)
    pages, rows, columns = _tiled(drawing) if paper == "A4" else _one_sheet(drawing)
    content = pdf_bytes(pages, title=f"{drawing.name}, {side_mm:.0f} mm")
    target = Path(path)
    with atomic_file(target) as file:
        file.write(content)
    return MarkerPdf(target, len(pages), rows, columns, side_m, rim_mm)


def _ruler(page: PdfPage, left_mm: float, y_mm: float) -> None:
    """A line of known length with end ticks."""
    page.line(left_mm, y_mm, left_mm + _RULER_MM, y_mm, width_mm=0.2)
    for x in (left_mm, left_mm + _RULER_MM):
        page.line(x, y_mm - 1.5, x, y_mm + 1.5, width_mm=0.2)
    page.text(
        left_mm + _RULER_MM + 3, y_mm + 1, f"{_RULER_MM:.0f} mm: print at 100 %, not fitted to the page", size_mm=2.8
    )


def _one_sheet(drawing: _Drawing) -> tuple[list[PdfPage], int, int]:
    whole = drawing.whole_mm
    page = PdfPage(max(whole, 215.0), whole + _FOOT_MM)
    drawing.draw(page, 0, 0)
    page.text(5, whole + 5, f"{drawing.name} - DBH Studio. {drawing.check_text}", size_mm=2.8)
    _ruler(page, 5, whole + 11)
    return [page], 1, 1


def _tile_counts(whole_mm: float, window_mm: tuple[float, float]) -> tuple[int, int]:
    """Columns and rows of windows that overlap by the glue strip."""
    counts = [int(np.ceil(max(whole_mm - _GLUE_MM, 1.0) / (size - _GLUE_MM) - 1e-9)) for size in window_mm]
    return max(counts[0], 1), max(counts[1], 1)


def _tiled(drawing: _Drawing) -> tuple[list[PdfPage], int, int]:
    window = (_A4_MM[0] - 2 * _MARGIN_MM, _A4_MM[1] - 2 * _MARGIN_MM)
    if drawing.whole_mm <= min(window[0], window[1] - _FOOT_MM):
        page = PdfPage(*_A4_MM)
        drawing.draw(page, (_A4_MM[0] - drawing.whole_mm) / 2, _MARGIN_MM)
        foot = _A4_MM[1] - _MARGIN_MM - _FOOT_MM
        page.text(_MARGIN_MM, foot + 5, f"{drawing.name} - DBH Studio", size_mm=3)
        page.text(_MARGIN_MM, foot + 9, drawing.check_text, size_mm=2.8)
        _ruler(page, _MARGIN_MM, foot + 14)
        return [page], 1, 1
    columns, rows = _tile_counts(drawing.whole_mm, window)
    pages = [_instructions(drawing, rows, columns, window)]
    for row in range(rows):
        pages += [_tile(drawing, row, column, rows, columns, window) for column in range(columns)]
    return pages, rows, columns


def _tile_name(row: int, column: int) -> str:
    return f"{'ABCDEFGHIJKLMNOPQRSTUVWXYZ'[row]}{column + 1}"


def _tile_start(
    drawing: _Drawing, row: int, column: int, rows: int, columns: int, window: tuple[float, float]
) -> tuple[float, float]:
    """Where a page's window begins on the drawing; the drawing stands in the middle of all pages."""
    steps = window[0] - _GLUE_MM, window[1] - _GLUE_MM
    left = (drawing.whole_mm - columns * steps[0] - _GLUE_MM) / 2 + column * steps[0]
    return left, (drawing.whole_mm - rows * steps[1] - _GLUE_MM) / 2 + row * steps[1]


def _tile(drawing: _Drawing, row: int, column: int, rows: int, columns: int, window: tuple[float, float]) -> PdfPage:
    page = PdfPage(*_A4_MM)
    left, top = _tile_start(drawing, row, column, rows, columns, window)
    page.clip(_MARGIN_MM, _MARGIN_MM, *window)
    drawing.draw(page, _MARGIN_MM - left, _MARGIN_MM - top)
    page.unclip()
    # Marks stand in the margin only: the pattern stays as it is.
    for x in (_MARGIN_MM, _A4_MM[0] - _MARGIN_MM):
        for a, b in ((3.0, 9.0), (_A4_MM[1] - 9.0, _A4_MM[1] - 3.0)):
            page.line(x, a, x, b)
    for y in (_MARGIN_MM, _A4_MM[1] - _MARGIN_MM):
        for a, b in ((3.0, 9.0), (_A4_MM[0] - 9.0, _A4_MM[0] - 3.0)):
            page.line(a, y, b, y)
    if column + 1 < columns:
        x = _A4_MM[0] - _MARGIN_MM - _GLUE_MM
        for a in (6.0, _A4_MM[1] - 9.0):
            page.line(x, a, x, a + 3, width_mm=0.4)
        page.text(x + 0.8, 7.5, "glue", size_mm=2.4)
    if row + 1 < rows:
        y = _A4_MM[1] - _MARGIN_MM - _GLUE_MM
        for a in (6.0, _A4_MM[0] - 9.0):
            page.line(a, y, a + 3, y, width_mm=0.4)
        page.text(2.5, y + 5.5, "glue", size_mm=2.4)
    page.text(
        22,
        7,
        f"{_tile_name(row, column)}   {drawing.name}   row {row + 1} of {rows}, column {column + 1} of {columns}",
        size_mm=3,
    )
    _ruler(page, 22, _A4_MM[1] - 5)
    return page


def _instructions(drawing: _Drawing, rows: int, columns: int, window: tuple[float, float]) -> PdfPage:
    page = PdfPage(*_A4_MM)
    page.text(20, 25, f"Marker {drawing.name}, {drawing.side_mm:.0f} mm", size_mm=6)
    lines = (
        "1. Print all pages at 100 % (no scaling), on matt paper. Check the 100 mm line on each with a ruler.",
        "2. Cut off the left and the top margin of each page along the thin marks at its corners.",
        "3. Page A1 first. Lay A2 over the strip marked 'glue' at the right of A1, up to the thick marks, and so on.",
        "4. Glue the rows together in the same way, each over the strip at the bottom of the one above.",
        "5. Glue the whole onto a stiff, flat board. A marker that bends gives a wrong scale.",
        f"6. Measure the black square on the board: {drawing.side_mm:.0f} mm on each of its four sides,",
        f"    {drawing.side_mm * np.sqrt(2):.1f} mm across both diagonals. Give the program what you measured.",
        "7. Do not cover it, and leave the white rim around it free.",
    )
    for number, line in enumerate(lines):
        page.text(20, 38 + 7 * number, line, size_mm=3.6)
    scale = min(150 / drawing.whole_mm, 150.0 / (rows * window[1]))
    left, top = 30.0, 105.0
    drawing.draw(page, left, top, scale)
    for row in range(rows):
        for column in range(columns):
            x, y = _tile_start(drawing, row, column, rows, columns, window)
            _outline(page, left + x * scale, top + y * scale, window[0] * scale, window[1] * scale)
            page.rectangles([(left + (x + 12) * scale, top + (y + 14) * scale, 8, 5)], 1.0)
            page.text(left + (x + 12) * scale + 1, top + (y + 14) * scale + 4, _tile_name(row, column), size_mm=4)
    _ruler(page, 22, _A4_MM[1] - 12)
    return page


def _outline(page: PdfPage, left: float, top: float, width: float, height: float) -> None:
    page.line(left, top, left + width, top)
    page.line(left, top + height, left + width, top + height)
    page.line(left, top, left, top + height)
    page.line(left + width, top, left + width, top + height)
