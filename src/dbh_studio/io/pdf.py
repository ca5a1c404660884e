"""A vector PDF of filled rectangles, lines and lines of text: all that a sheet to print and cut out needs.

Millimetres from the top-left corner of the page, y down. The same input gives the same bytes.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence

MM = 72.0 / 25.4


class PdfPage:
    """One page, drawn from top to bottom of the code."""

    def __init__(self, width_mm: float, height_mm: float) -> None:
        if not (width_mm > 0 and height_mm > 0):
            raise ValueError(f"the page is {width_mm} x {height_mm} mm but must have a size")
        self.width_mm = width_mm
        self.height_mm = height_mm
        self._operators: list[str] = []

    def _xy(self, x_mm: float, y_mm: float) -> str:
        return f"{x_mm * MM:.4f} {(self.height_mm - y_mm) * MM:.4f}"

    def rectangles(self, boxes_mm: Sequence[tuple[float, float, float, float]], grey: float) -> None:
        """Fill (left, top, width, height) boxes as one path, so that neighbours leave no hairline."""
        if not boxes_mm:
            return
        path = [
            f"{self._xy(left, top + height)} {width * MM:.4f} {height * MM:.4f} re"
            for left, top, width, height in boxes_mm
        ]
        self._operators += [f"{grey:.3f} g", *path, "f"]

    def line(self, x1_mm: float, y1_mm: float, x2_mm: float, y2_mm: float, *, width_mm: float = 0.1) -> None:
        """A black line."""
        self._operators.append(f"0 G {width_mm * MM:.4f} w {self._xy(x1_mm, y1_mm)} m {self._xy(x2_mm, y2_mm)} l S")

    def text(self, x_mm: float, y_mm: float, text: str, *, size_mm: float = 3.5) -> None:
        """A line of Helvetica; `y_mm` is its baseline."""
        encoded = text.encode("cp1252", "replace").decode("latin-1")
        escaped = encoded.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
        self._operators.append(f"BT 0 g /F1 {size_mm * MM:.3f} Tf {self._xy(x_mm, y_mm)} Td ({escaped}) Tj ET")

    def clip(self, left_mm: float, top_mm: float, width_mm: float, height_mm: float) -> None:
        """Show what follows only inside a box, until `unclip`."""
        corner = self._xy(left_mm, top_mm + height_mm)
        self._operators.append(f"q {corner} {width_mm * MM:.4f} {height_mm * MM:.4f} re W n")

    def unclip(self) -> None:
        """Show everything again."""
        self._operators.append("Q")

    def stream(self) -> bytes:
        """The page's operators."""
        return "\n".join(self._operators).encode("latin-1")


def pdf_bytes(pages: Sequence[PdfPage], *, title: str) -> bytes:
    """The file.

    Raises:
        ValueError: There is no page.
    """
    if not pages:
        raise ValueError("a PDF needs a page")
    kids = " ".join(f"{5 + 2 * number} 0 R" for number in range(len(pages)))
    name = title.encode("latin-1", "replace").decode("latin-1").replace("\\", "").replace("(", "").replace(")", "")
    bodies = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        f"<< /Type /Pages /Kids [{kids}] /Count {len(pages)} >>".encode(),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        f"<< /Title ({name}) /Producer (DBH Studio) >>".encode("latin-1"),
    ]
    for number, page in enumerate(pages):
        box = f"[0 0 {page.width_mm * MM:.4f} {page.height_mm * MM:.4f}]"
        bodies.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents {6 + 2 * number} 0 R "
            "/Resources << /Font << /F1 3 0 R >> >> >>".encode()
        )
        packed = zlib.compress(page.stream(), 9)
        bodies.append(f"<< /Length {len(packed)} /Filter /FlateDecode >>\nstream\n".encode() + packed + b"\nendstream")
    return _assembled(bodies)


def _assembled(bodies: Sequence[bytes]) -> bytes:
    out = bytearray(b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n")
    offsets = []
    for number, body in enumerate(bodies, start=1):
        offsets.append(len(out))
        out += f"{number} 0 obj\n".encode() + body + b"\nendobj\n"
    start = len(out)
    out += f"xref\n0 {len(bodies) + 1}\n0000000000 65535 f \n".encode()
    out += b"".join(f"{offset:010d} 00000 n \n".encode() for offset in offsets)
    out += f"trailer\n<< /Size {len(bodies) + 1} /Root 1 0 R /Info 4 0 R >>\nstartxref\n{start}\n%%EOF\n".encode()
    return bytes(out)
