"""The printed marker, read back by drawing the PDF's own rectangles, and as PDFium draws it."""

import re
import zlib
from pathlib import Path

import numpy as np
import pypdfium2
import pytest

from dbh_studio.errors import SettingError
from dbh_studio.io.marker_codes import marker_bits
from dbh_studio.io.marker_pdf import write_marker_pdf
from dbh_studio.io.pdf import MM, PdfPage, pdf_bytes

cv2 = pytest.importorskip("cv2")


def objects_of(data):
    """Every object by number, found through the cross-reference table."""
    start = int(re.search(rb"startxref\n(\d+)\n%%EOF\n$", data).group(1))
    count = int(re.match(rb"xref\n0 (\d+)\n", data[start:]).group(1))
    rows = data[start:].split(b"\n")[3 : 2 + count]
    bodies = {}
    for number, row in enumerate(rows, start=1):
        offset = int(row[:10])
        assert data[offset:].startswith(b"%d 0 obj\n" % number)
        bodies[number] = data[offset : data.index(b"\nendobj", offset)]
    return bodies


def pages_of(data):
    """(width_mm, height_mm, operators) of each page, in order."""
    bodies = objects_of(data)
    pages = []
    for number in [int(n) for n in re.findall(rb"(\d+) 0 R", re.search(rb"/Kids \[(.*?)\]", bodies[2]).group(1))]:
        width, height = map(float, re.search(rb"/MediaBox \[0 0 (\S+) (\S+)\]", bodies[number]).groups())
        content = bodies[int(re.search(rb"/Contents (\d+)", bodies[number]).group(1))]
        packed = content[content.index(b"stream\n") + 7 : content.index(b"\nendstream")]
        assert len(packed) == int(re.search(rb"/Length (\d+)", content).group(1))
        pages.append((width / MM, height / MM, zlib.decompress(packed).decode("latin-1").split("\n")))
    return pages


def drawn(page, px_per_mm):
    """(H, W) uint8 picture of the page's filled rectangles, clipped as the page says."""
    width, height, operators = page
    picture = np.full((round(height * px_per_mm), round(width * px_per_mm)), 255, np.uint8)
    window, boxes, grey = (slice(None), slice(None)), [], 0.0
    shown = np.zeros_like(picture, bool)
    shown[:] = True

    def area(x, y, w, h):
        left, top = x / MM, height - (y + h) / MM
        rows = slice(max(round(top * px_per_mm), 0), max(round((top + h / MM) * px_per_mm), 0))
        return rows, slice(max(round(left * px_per_mm), 0), max(round((left + w / MM) * px_per_mm), 0))

    for line in operators:
        words = line.split()
        if words[0] == "q":
            window = area(*map(float, words[1:5]))
            shown[:] = False
            shown[window] = True
        elif words == ["Q"]:
            shown[:] = True
        elif words[-1] == "g" and len(words) == 2:
            grey = float(words[0])
        elif words[-1] == "re":
            boxes.append(area(*map(float, words[:4])))
        elif words == ["f"]:
            for box in boxes:
                picture[box] = np.where(shown[box], round(255 * grey), picture[box])
            boxes = []
    return picture


def found(picture, dictionary):
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)))
    framed = np.pad(picture, 40, constant_values=255)
    corners, ids, _ = detector.detectMarkers(framed)
    return [] if ids is None else [(int(i), c.reshape(4, 2) - 40) for i, c in zip(ids.ravel(), corners, strict=True)]


@pytest.mark.parametrize(("dictionary", "marker_id"), [("DICT_4X4_50", 7), ("DICT_APRILTAG_36h11", 3)])
def test_the_sheet_has_the_marker_in_its_true_size(tmp_path, dictionary, marker_id):
    written = write_marker_pdf(
        tmp_path / "m.pdf", dictionary=dictionary, marker_id=marker_id, side_m=1.0, paper="sheet"
    )
    pages = pages_of((tmp_path / "m.pdf").read_bytes())
    assert written.n_pages == len(pages) == 1
    ((number, corners),) = found(drawn(pages[0], 1.0), dictionary)
    assert number == marker_id
    sides = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
    assert np.abs(sides - 1000).max() <= 2
    assert corners[0] == pytest.approx([written.rim_mm] * 2, abs=1.5)


def test_the_a4_pages_glued_as_told_are_the_marker(tmp_path):
    written = write_marker_pdf(tmp_path / "m.pdf", dictionary="DICT_4X4_50", marker_id=7, side_m=1.0)
    pages = pages_of((tmp_path / "m.pdf").read_bytes())
    assert all((w, h) == pytest.approx((210, 297), abs=1e-3) for w, h, _ in pages)
    assert len(pages) == written.n_pages == 1 + written.rows * written.columns == 25
    # Margins of 10 mm cut off, each page over the last 10 mm of the one before.
    board = np.zeros((written.rows * 267 + 10, written.columns * 180 + 10), np.uint8)
    for number, page in enumerate(pages[1:]):
        row, column = divmod(number, written.columns)
        board[row * 267 : row * 267 + 277, column * 180 : column * 180 + 190] = drawn(page, 1.0)[10:287, 10:200]
    ((number, corners),) = found(board, "DICT_4X4_50")
    assert number == 7
    left, top = (round(float(v)) for v in corners[0])
    inside = board[top : top + 1000, left : left + 1000]
    expected = np.kron(marker_bits("DICT_4X4_50", 7), np.ones((167, 167), bool))[:1000, :1000] * 255
    assert np.mean(inside == expected) > 0.985
    sides = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
    assert np.abs(sides - 1000).max() <= 2


def test_each_page_has_a_line_to_check_by_ruler(tmp_path):
    for name, paper, side_m in (("a", "A4", 0.6), ("b", "sheet", 0.6), ("c", "A4", 0.15)):
        write_marker_pdf(tmp_path / name, dictionary="DICT_4X4_50", marker_id=1, side_m=side_m, paper=paper)
        for _, _, operators in pages_of((tmp_path / name).read_bytes()):
            ends = [re.search(r"w (\S+) (\S+) m (\S+) (\S+) l S", line) for line in operators]
            lengths = [abs(float(m[3]) - float(m[1])) / MM for m in ends if m]
            assert any(length == pytest.approx(100.0, abs=1e-3) for length in lengths)
        assert b"/PrintScaling /None" in (tmp_path / name).read_bytes()


def test_a_small_marker_is_one_page_and_the_same_bytes_each_time(tmp_path):
    for name in "ab":
        assert write_marker_pdf(tmp_path / name, dictionary="4x4_50", marker_id=2, side_m=0.15).n_pages == 1
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    ((number, _),) = found(drawn(pages_of((tmp_path / "a").read_bytes())[0], 3.0), "DICT_4X4_50")
    assert number == 2


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"side_m": 0.0}, "side"),
        ({"side_m": -1.0}, "side"),
        ({"side_m": float("nan")}, "side"),
        ({"side_m": 9.0}, "side"),
        ({"paper": "A0"}, "paper"),
        ({"marker_id": 50}, "no marker 50"),
        ({"marker_id": -1}, "no marker -1"),
        ({"dictionary": "DICT_9X9"}, "dictionary"),
    ],
)
def test_what_cannot_be_printed_leaves_no_file(tmp_path, changes, said):
    wanted = {"dictionary": "DICT_4X4_50", "marker_id": 0, "side_m": 1.0, "paper": "A4", **changes}
    with pytest.raises(SettingError, match=said):
        write_marker_pdf(tmp_path / "m.pdf", **wanted)
    assert not list(tmp_path.iterdir())


def test_text_is_escaped_and_a_file_without_pages_is_refused():
    page = PdfPage(100, 50)
    page.text(5, 5, r"(a) \ ü €")
    ((_, _, operators),) = pages_of(pdf_bytes([page], title="x (y)"))
    assert operators[0].endswith(r"(\(a\) \\ ü " + "\x80) Tj ET")
    with pytest.raises(ValueError, match="page"):
        pdf_bytes([], title="")


def test_pdfium_draws_a_marker_that_is_found(tmp_path):
    write_marker_pdf(tmp_path / "m.pdf", dictionary="DICT_APRILTAG_36h11", marker_id=3, side_m=0.15)
    with pypdfium2.PdfDocument(tmp_path / "m.pdf") as document:
        drawn = document[0].render(scale=100 / 72, grayscale=True).to_numpy()
    ((number, corners),) = found(np.squeeze(drawn), "DICT_APRILTAG_36h11")
    assert number == 3
    assert np.linalg.norm(corners[0] - corners[1]) == pytest.approx(150 / 25.4 * 100, abs=2)


def test_the_markers_that_come_along_are_what_the_program_writes(tmp_path):
    folder = Path(__file__).parents[2] / "assets" / "markers"
    files = sorted(folder.glob("*.pdf"))
    assert files
    for file in files:
        dictionary, marker_id, side, paper = re.match(r"(DICT_\w+)_(\d+)_(\d+)mm_(A4|sheet)", file.stem).groups()
        write_marker_pdf(
            tmp_path / "m.pdf", dictionary=dictionary, marker_id=int(marker_id), side_m=int(side) / 1000, paper=paper
        )
        assert pages_of(file.read_bytes()) == pages_of((tmp_path / "m.pdf").read_bytes())
