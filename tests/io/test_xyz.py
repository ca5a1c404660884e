from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.errors import EmptyFileError, MalformedFileError, TruncatedFileError
from dbh_studio.io.xyz import read_xyz, sniff_layout


def _absolute(cloud):
    return cloud.xyz.astype(np.float64) + cloud.origin


def _lines(points, join=" ", *others):
    rows = [*points.T.tolist(), *others]
    return "".join(
        join.join(f"{value:.4f}" if isinstance(value, float) else str(value) for value in row) + "\n"
        for row in zip(*rows, strict=True)
    )


@pytest.mark.parametrize(
    ("join", "header"),
    [(" ", ""), (",", ""), (",", "X,Y,Z\n"), (";", '"x";"y";"z"\n'), ("\t", "# made here\nEasting\tNorthing\tHeight\n"),
     ("  ", "//X Y Z\n500\n"), (" ", "500\n"), (", ", "x, y, z\n")],
)  # fmt: skip
def test_separators_and_headers(tmp_path, survey_points, join, header):
    path = tmp_path / "plot.txt"
    path.write_text(header + _lines(survey_points, join))
    cloud = read_xyz(path).cloud
    assert np.abs(_absolute(cloud) - survey_points).max() < 0.0001


def test_crlf_bom_and_blank_lines(tmp_path, survey_points):
    path = tmp_path / "plot.csv"
    text = "x,y,z\n" + _lines(survey_points, ",").replace("\n", "\n\n", 3) + "\n"
    path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert len(read_xyz(path).cloud) == 500


@pytest.mark.parametrize("join", [";", " ", "\t"])
def test_decimal_commas(tmp_path, survey_points, join):
    path = tmp_path / "plot.csv"
    path.write_text(_lines(survey_points, join).replace(".", ","))
    assert np.abs(_absolute(read_xyz(path).cloud) - survey_points).max() < 0.0001


def test_columns_in_any_order_with_names(tmp_path, survey_points, rng):
    ids, rgb = rng.integers(0, 9, 500), rng.integers(0, 256, (500, 3))
    path = tmp_path / "plot.csv"
    rows = zip(ids, *rgb.T, *survey_points.T, strict=True)
    path.write_text("tree_id,Red,Green,Blue,X,Y,Z\n" + "".join(",".join(map(str, row)) + "\n" for row in rows))
    cloud = read_xyz(path).cloud
    assert np.abs(_absolute(cloud) - survey_points).max() < 5e-5
    assert (cloud.rgb == rgb).all()
    assert (cloud.attributes["tree_id"] == ids).all()


@pytest.mark.parametrize("full", [1.0, 255, 65535])
def test_colours_of_any_scale(tmp_path, survey_points, rng, full):
    rgb = rng.integers(0, 256, (500, 3))
    rgb[0] = 255
    written = rgb / 255 if full == 1.0 else rgb * (full // 255)
    path = tmp_path / "plot.xyz"
    path.write_text(_lines(survey_points, " ", *written.T.tolist()))
    assert np.abs(read_xyz(path).cloud.rgb.astype(int) - rgb).max() <= 1


def test_normals_are_no_colours(tmp_path, survey_points, rng):
    normals = rng.normal(size=(500, 3))
    (tmp_path / "plot.xyz").write_text(_lines(survey_points, " ", *normals.T.tolist()))
    assert read_xyz(tmp_path / "plot.xyz").cloud.rgb is None


def test_pts_has_intensity_before_colours(tmp_path, survey_points):
    grey, red = [-800] * 500, list(range(1, 251)) * 2
    (tmp_path / "scan.pts").write_text("500\n" + _lines(survey_points, " ", grey, red, red, red))
    assert (read_xyz(tmp_path / "scan.pts").cloud.rgb[:, 0] == red).all()


def test_text_columns_and_missing_ids(tmp_path, survey_points):
    ids = ["NA" if i % 5 == 0 else str(i % 5) for i in range(500)]
    rows = zip(survey_points.tolist(), ids, strict=True)
    text = "x,y,z,treeID,species\n" + "".join(f"{p[0]},{p[1]},{p[2]},{i},pine tree\n" for p, i in rows)
    (tmp_path / "plot.csv").write_text(text)
    cloud = read_xyz(tmp_path / "plot.csv").cloud
    assert len(cloud) == 500
    assert np.isnan(cloud.attributes["treeID"]).sum() == 100


def test_a_table_without_coordinates_is_refused(tmp_path):
    (tmp_path / "inventory.csv").write_text("tree,dbh,height\n1,23.4,18\n2,30.1,20\n")
    with pytest.raises(MalformedFileError, match="dbh"):
        read_xyz(tmp_path / "inventory.csv")


def test_a_bad_line_is_named(tmp_path, survey_points):
    lines = _lines(survey_points).splitlines()
    lines[250] = "here there be dragons"
    (tmp_path / "plot.xyz").write_text("\n".join(lines) + "\n")
    with pytest.raises(MalformedFileError, match=r"line 251.*dragons"):
        read_xyz(tmp_path / "plot.xyz")


def test_cut_off_last_line(tmp_path, survey_points):
    (tmp_path / "plot.xyz").write_text(_lines(survey_points)[:-20])
    with pytest.raises(TruncatedFileError):
        read_xyz(tmp_path / "plot.xyz")


@pytest.mark.parametrize("text", ["", "\n\n", "hello\nworld\n", "1 2\n3 4\n"])
def test_nothing_in_it(tmp_path, text):
    (tmp_path / "plot.txt").write_text(text)
    with pytest.raises(EmptyFileError):
        read_xyz(tmp_path / "plot.txt")


def test_only_nan(tmp_path):
    (tmp_path / "plot.txt").write_text("nan nan nan\n" * 5)
    with pytest.raises(EmptyFileError, match="5 points"):
        read_xyz(tmp_path / "plot.txt")


def test_utf16_is_named(tmp_path):
    (tmp_path / "plot.txt").write_bytes("1 2 3\n".encode("utf-16"))
    with pytest.raises(MalformedFileError, match="UTF-16"):
        read_xyz(tmp_path / "plot.txt")


def test_row_numbers_of_r(tmp_path, survey_points):
    rows = "".join(f'"{i}" {p[0]} {p[1]} {p[2]}\n' for i, p in enumerate(survey_points.tolist(), start=1))
    (tmp_path / "plot.txt").write_text('"x" "y" "z"\n' + rows)
    assert sniff_layout(tmp_path / "plot.txt").coordinates == (1, 2, 3)
    assert np.abs(_absolute(read_xyz(tmp_path / "plot.txt").cloud) - survey_points).max() < 5e-5


def test_blocks_join(tmp_path, survey_points, monkeypatch):
    monkeypatch.setattr("dbh_studio.io.xyz._BLOCK_BYTES", 2000)
    (tmp_path / "plot.xyz").write_text(_lines(survey_points))
    assert np.abs(_absolute(read_xyz(tmp_path / "plot.xyz").cloud) - survey_points).max() < 0.0001


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "cp1252"])
@pytest.mark.parametrize("comment", ["# Åbo plot…", "# a\x0bb", "# a\x0cb"])
def test_a_comment_that_looks_like_two_lines_costs_no_point(tmp_path, survey_points, encoding, comment):
    text = comment.encode(encoding, "replace") + b"\n" + _lines(survey_points).encode()
    (tmp_path / "plot.xyz").write_bytes(text)
    assert len(read_xyz(tmp_path / "plot.xyz").cloud) == 500


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_letters_beyond_ascii_shift_no_column(tmp_path, survey_points, encoding):
    rows = "".join(f"{x} {y} {z} Åasp\xe9n {i}\n" for i, (x, y, z) in enumerate(survey_points.tolist()))
    (tmp_path / "plot.xyz").write_bytes(f"x y z Återväxt treeID\n{rows}".encode(encoding))
    cloud = read_xyz(tmp_path / "plot.xyz").cloud
    assert len(cloud) == 500
    assert (cloud.attributes["treeID"] == np.arange(500)).all()


def test_carriage_returns_alone_are_named(tmp_path, survey_points):
    (tmp_path / "plot.xyz").write_bytes(_lines(survey_points).replace("\n", "\r").encode())
    with pytest.raises(MalformedFileError, match="carriage return") as caught:
        read_xyz(tmp_path / "plot.xyz")
    assert caught.value.remedy
