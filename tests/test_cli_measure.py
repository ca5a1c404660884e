"""`dbh-studio measure` and `run`: protocols on the command line, and the corrections of a saved plot."""

from __future__ import annotations

import csv
import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from tests.threestems import STEMS, plot_cloud, stem_points

from dbh_studio.app import commands
from dbh_studio.app.document import Document, SourceInfo
from dbh_studio.app.opening import open_plot, save_as
from dbh_studio.app.session import Session
from dbh_studio.cli import main
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.corrections import Correction
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.trunks import TrunkSet
from dbh_studio.io.las import write_las


@pytest.fixture(scope="module")
def swollen(tmp_path_factory) -> Path:
    """A stem of 30 cm with a collar from 1.2 to 1.5 m."""
    points = stem_points(0.30)
    points[np.abs(points[:, 2] - 1.35) < 0.15, :2] *= 1.2
    path = tmp_path_factory.mktemp("stem") / "stem.las"
    write_las(path, PointCloud.from_points(points))
    return path


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    """The plot of three stems, of which two are measured otherwise."""
    folder = tmp_path_factory.mktemp("plot")
    path = folder / "plot.las"
    write_las(path, plot_cloud())
    session = open_plot(path, background_save=False)
    first = len(plot_cloud()) - 36_000
    point_sets = [np.arange(first + 12_000 * i, first + 12_000 * (i + 1)) for i in range(3)]
    document = Document(
        "plot",
        SourceInfo.of(session.cloud, path),
        scale=ScaleEstimate(1.0, "metres"),
        trunks=TrunkSet.from_point_sets(point_sets),
    )
    session = Session(session.cloud, document)
    session.do(commands.correct_measurement(1, Correction("breast_height", 2.0)))
    session.do(commands.correct_measurement(2, Correction("curve", "ellipse")))
    session.do(commands.correct_measurement(2, Correction("tape", 24.5)))
    save_as(session, folder / "plot.dbh", background=False)
    session.close()
    return folder / "plot.dbh"


def table(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def measured(capsys, *arguments) -> list[dict[str, str]]:
    capsys.readouterr()
    assert main(["measure", *map(str, arguments), "--quiet"]) == 0
    return table(capsys.readouterr().out)


def test_a_named_protocol_and_what_goes_before_it(swollen, capsys):
    (row,) = measured(capsys, swollen, "--protocol", "fia")
    assert (row["breast_height_m"], row["along"], row["above"]) == ("1.3716", "stem", "buttress")
    assert row["flags"].endswith("above_bulge") and float(row["hom_m"]) > 1.5
    assert float(row["dbh_cm"]) == pytest.approx(30, rel=0.015)
    (row,) = measured(capsys, swollen, "--protocol", "fia", "--above", "nothing", "--breast-height", "1.4")
    assert (row["breast_height_m"], row["above"], row["hom_m"]) == ("1.4", "nothing", "1.4")
    assert main(["measure", str(swollen), "--json", "--quiet"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert (row["base"], row["along"], row["above"]) == ("stem", "vertical", "nothing")


def test_an_unknown_protocol_is_wrong_usage(swollen, capsys):
    assert main(["measure", str(swollen), "--protocol", "nobody"]) == 2
    assert "fia" in capsys.readouterr().err


def test_measure_on_a_saved_plot_measures_each_stem_as_was_said_of_it(saved, capsys):
    before = (saved / "project.json").read_bytes()
    one, two, three = measured(capsys, saved)
    assert [row["stem_id"] for row in (one, two, three)] == ["1", "2", "3"]
    assert (one["corrections"], two["corrections"], three["corrections"]) == ("breast_height", "curve", "")
    assert float(one["hom_m"]) == pytest.approx(2.0) and float(three["hom_m"]) == pytest.approx(1.3)
    assert (two["dbh_method"], three["dbh_method"]) == ("ellipse", "shrinkage")
    for row, (_, _, diameter) in zip((one, two, three), STEMS, strict=True):
        assert float(row["dbh_cm"]) == pytest.approx(100 * diameter, rel=0.015)
        assert row["base"] == "midpoint" and row["circle_cm"]
    one, two, _ = measured(capsys, saved, "--base", "uphill", "--curve", "circle")
    assert one["base"] == "uphill" and (one["dbh_method"], two["dbh_method"]) == ("circle", "ellipse")
    assert (saved / "project.json").read_bytes() == before


def test_the_table_of_a_plot_says_where_each_stem_stands(saved, capsys):
    """Without that it cannot be compared with a field table that has numbers of its own."""
    rows = measured(capsys, saved)
    assert [(float(row["x_m"]), float(row["y_m"])) for row in rows] == [
        pytest.approx((x, y), abs=4.5) for x, y, _ in STEMS
    ]
    apart = np.diff([[float(row["x_m"]), float(row["y_m"])] for row in rows], axis=0)
    assert apart == pytest.approx(np.diff([[x, y] for x, y, _ in STEMS], axis=0), abs=0.02)


def test_a_stem_that_is_refused_has_no_diameter_by_any_method(tmp_path, capsys):
    points = stem_points(0.30)
    points = points[np.abs(np.arctan2(points[:, 1], points[:, 0])) < np.radians(25)]
    write_las(tmp_path / "arc.las", PointCloud.from_points(points))
    (row,) = measured(capsys, tmp_path / "arc.las")
    assert row["quality"] == "refused" and row["remedy"]
    assert [name for name, cell in row.items() if name.endswith("_cm") and cell] == []


def test_the_profiles_of_a_saved_plot(saved, tmp_path, capsys):
    measured(capsys, saved, "--profile", tmp_path / "profile.csv")
    rows = table((tmp_path / "profile.csv").read_text())
    assert {row["stem_id"] for row in rows} == {"1", "2", "3"}
    assert main(["measure", str(saved), "--ground-z", "0"]) == 1
    assert "its own ground" in capsys.readouterr().err


def test_run_writes_the_rules_and_measures_by_them(saved, tmp_path, capsys):
    shutil.copytree(saved, tmp_path / "plot.dbh")
    assert main(["run", str(tmp_path / "plot.dbh"), "--out", str(tmp_path), "--quiet", "--protocol", "nz"]) == 0
    rows = table((tmp_path / "plot.csv").read_text())
    assert [row["breast_height_m"] for row in rows] == ["2.000", "1.400", "1.400"]
    assert [(row["base"], row["along"], row["above"]) for row in rows] == [
        ("uphill", "vertical", "nothing"),
        ("uphill", "vertical", "nothing"),
        ("uphill", "vertical", "nothing"),
    ]
    assert [row["corrections"] for row in rows] == ["breast_height", "curve", ""]
    assert [row["field_tape_cm"] for row in rows] == ["", "24.50", ""]
