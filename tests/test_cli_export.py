"""`dbh-studio export`: one table in every format, read back by GDAL and laspy, and nothing overwritten unasked."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import laspy
import numpy as np
import pyogrio
import pytest
from tests.threestems import STEMS, plot_points

from dbh_studio.cli import main
from dbh_studio.core.cloud import PointCloud
from dbh_studio.io.las import write_las

DIAMETERS_CM = [100 * diameter for _, _, diameter in STEMS]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with a cloud in a map system, and the plot a run made of it."""
    folder = tmp_path_factory.mktemp("plot")
    cloud = PointCloud.from_points(plot_points() + [500_000.0, 4_500_000.0, 300.0], crs="EPSG:32633")
    write_las(folder / "stand.laz", cloud)
    assert main(["run", str(folder / "stand.laz"), "--out", str(folder), "--quiet"]) == 0
    return folder


@pytest.fixture
def saved(made: Path, tmp_path: Path) -> Path:
    shutil.copy(made / "stand.laz", tmp_path)
    return Path(shutil.copytree(made / "stand.dbh", tmp_path / "stand.dbh"))


def succeeds(capsys, *arguments: object) -> str:
    status = main(["export", *map(str, arguments), "--quiet"])
    out, err = capsys.readouterr()
    assert status == 0, err
    return out


def fails(capsys, *arguments: object, status: int = 1) -> str:
    assert main(["export", *map(str, arguments), "--quiet"]) == status
    return capsys.readouterr().err


def test_all_formats_have_the_same_stems(saved, tmp_path, capsys):
    out = tmp_path / "hand in"
    every = [
        part for kind in ("csv", "gpkg", "geojson", "xlsx", "svg", "dxf", "laz", "las") for part in ("--format", kind)
    ]
    printed = succeeds(capsys, saved, *every, "--out", out, "--json", "--circle", 500_004, 4_500_003, 30)
    files = [Path(name) for name in json.loads(printed)["files"]]
    assert [path.suffix for path in files] == [".csv", ".gpkg", ".geojson", ".xlsx", ".svg", ".dxf", ".laz", ".las"]
    assert sorted(path.name for path in out.iterdir()) == sorted(path.name for path in files)
    with files[0].open(newline="") as file:
        rows = list(csv.DictReader(file))
    expected = {int(row["stem_id"]): float(row["dbh_cm"]) for row in rows}
    assert sorted(expected.values()) == pytest.approx(sorted(DIAMETERS_CM), rel=0.02)
    for path, layer in ((files[1], None), (files[2], None), (files[3], "Stems")):
        meta, _, _, columns = pyogrio.raw.read(path, layer=layer)
        columns = dict(zip(meta["fields"].tolist(), columns, strict=True))
        found = dict(zip(columns["stem_id"].tolist(), columns["dbh_cm"].tolist(), strict=True))
        assert found == pytest.approx(expected, abs=0.006), path.name
    labelled = laspy.read(files[6])
    assert np.array_equal(labelled.X, laspy.read(saved.parent / "stand.laz").X)
    ids = np.asarray(labelled["tree_id"])
    assert set(np.unique(ids).tolist()) == {0, *expected}
    height = np.asarray(labelled["height_above_ground"])
    assert abs(np.median(height[:30_000])) < 0.02  # the ground
    assert height[ids > 0].max() == pytest.approx(5.0, abs=0.05)
    for stem_id in expected:
        assert f">{stem_id}</text>" in files[4].read_text("utf-8")


def test_three_formats_where_none_is_named_and_imperial_where_asked(saved, tmp_path, capsys):
    printed = succeeds(capsys, saved, "--out", tmp_path / "out", "--imperial")
    assert [Path(line).suffix for line in printed.split("\n") if line] == [".csv", ".gpkg", ".xlsx"]
    meta, _, _, columns = pyogrio.raw.read(tmp_path / "out" / "stand.gpkg")
    inches = dict(zip(meta["fields"].tolist(), columns, strict=True))["dbh_in"]
    assert sorted(inches) == pytest.approx(sorted(d / 2.54 for d in DIAMETERS_CM), rel=0.02)
    meta, _, _, columns = pyogrio.raw.read(tmp_path / "out" / "stand.xlsx", layer="Stand", max_features=2)
    assert "stems/acre" in meta["fields"].tolist()


def test_nothing_is_overwritten_unasked_and_the_source_never(saved, tmp_path, capsys):
    out = tmp_path / "out"
    succeeds(capsys, saved, "--out", out, "--format", "gpkg")
    before = (out / "stand.gpkg").read_bytes()
    assert "already" in fails(capsys, saved, "--out", out, "--format", "csv", "--format", "gpkg")
    assert (out / "stand.gpkg").read_bytes() == before and not (out / "stand_inventory.csv").exists()
    succeeds(capsys, saved, "--out", out, "--format", "gpkg", "--overwrite")
    shutil.copy(saved.parent / "stand.laz", saved.parent / "stand_trees.laz")
    source = saved.parent / "stand_trees.laz"
    assert main(["run", str(source), "--out", str(tmp_path / "again"), "--name", "stand", "--quiet"]) == 0
    content = source.read_bytes()
    message = fails(capsys, tmp_path / "again" / "stand.dbh", "--out", source.parent, "--format", "laz", "--overwrite")
    assert "read from" in message and source.read_bytes() == content


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["--circle", 0, 0, 0], 2, "radius"),
        (["--circle", 0, 0, 5, "--polygon", "corners.txt"], 2, "either"),
        (["--polygon", "corners.txt"], 1, "corners.txt"),
        (["--class-width", 0], 2, "wider"),
        (["--class-width", 1e-5], 2, "1,000 are the most"),
        (["--format", "shp"], 2, "shp"),
    ],
)
def test_what_makes_no_sense_is_refused_in_words(saved, tmp_path, capsys, arguments, status, said):
    assert said in fails(capsys, saved, "--out", tmp_path / "out", *arguments, status=status)
    assert not (tmp_path / "out").exists()


def test_a_file_is_no_folder_and_thin_stems_are_told(saved, tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    assert "out: This is a file and no folder" in fails(capsys, saved, "--out", tmp_path / "out")
    succeeds(capsys, saved, "--out", tmp_path / "thin", "--format", "report", "--least-dbh", 90)
    text = (tmp_path / "thin" / "stand_report.html").read_text("utf-8")
    assert f"Stems thinner than 90.0 cm are not in this table: {len(STEMS)} of those inside" in text
    assert "<td>command line</td>" in text  # who made the plot: not whoever is signed in to the computer
    assert f"<dt>Counted</dt><dd>0 of {len(STEMS)} stems" in text


def test_a_polygon_comes_from_a_file(saved, tmp_path, capsys):
    corners = tmp_path / "corners.csv"
    corners.write_text("x;y\n-1000;-1000\n1000;-1000\n1000;1000\n-1000;1000\n")
    succeeds(capsys, saved, "--out", tmp_path / "a", "--format", "xlsx", "--polygon", corners)
    text = pyogrio.raw.read(tmp_path / "a" / "stand.xlsx", layer="About", force_2d=False)[3]
    assert any("4,000,000.0 m² (polygon)" in str(value) for column in text for value in column)
    corners.write_text("0 0\n1 0\nhere\n")
    assert "Line 3" in fails(capsys, saved, "--out", tmp_path / "b", "--polygon", corners)


def test_corners_between_semicolons_may_have_decimal_commas(saved, tmp_path, capsys):
    corners = tmp_path / "corners.csv"
    corners.write_text("x;y\n-0,5;-0,5\n99,5;-0,5\n99,5;99,5\n-0,5;99,5\n")
    succeeds(capsys, saved, "--out", tmp_path / "a", "--format", "xlsx", "--polygon", corners)
    text = pyogrio.raw.read(tmp_path / "a" / "stand.xlsx", layer="About", force_2d=False)[3]
    assert any("10,000.0 m² (polygon)" in str(value) for column in text for value in column)


def test_a_cloud_is_no_plot(made, tmp_path, capsys):
    assert "no saved plot" in fails(capsys, made / "stand.laz", "--out", tmp_path, status=2)
