"""`dbh-studio import`: one's own table taken into a saved plot, tried first, undone later."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import pytest
from tests.threestems import plot_points

from dbh_studio.app.opening import open_plot
from dbh_studio.cli import main
from dbh_studio.core.cloud import PointCloud
from dbh_studio.io.las import write_las


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("plot")
    write_las(folder / "stand.laz", PointCloud.from_points(plot_points()))
    assert main(["run", str(folder / "stand.laz"), "--out", str(folder), "--quiet"]) == 0
    return folder


@pytest.fixture
def saved(made, tmp_path) -> Path:
    shutil.copy(made / "stand.laz", tmp_path)
    return Path(shutil.copytree(made / "stand.dbh", tmp_path / "stand.dbh"))


@pytest.fixture
def table(saved, tmp_path, capsys) -> Path:
    """The plot's inventory as a spreadsheet saves it, with things filled in."""
    assert main(["export", str(saved), "--out", str(tmp_path), "--format", "csv", "--quiet"]) == 0
    with (tmp_path / "stand_inventory.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    rows[0] |= {"species": "oak", "field_tape_cm": "30,4"}
    path = tmp_path / "filled.csv"
    with path.open("w", newline="", encoding="utf-8-sig") as file:
        writer = csv.DictWriter(file, [*rows[0], "bark"], delimiter=";")
        writer.writeheader()
        writer.writerows([row | {"bark": "rough"} for row in rows])
    capsys.readouterr()
    return path


def says(capsys, *arguments: object, status: int = 0) -> str:
    assert main(["import", *map(str, arguments), "--quiet"]) == status
    out, err = capsys.readouterr()
    return out if status == 0 else err


def test_it_is_tried_taken_and_undone(saved, table, capsys):
    tried = says(capsys, saved, table, "--dry-run")
    assert "3 of the 3 stems" in tried and "species of 1" in tried and "New fields: bark" in tried
    taken = json.loads(says(capsys, saved, table, "--json"))
    assert taken["stems"] == 3 and taken["changes"] == {"species": 1, "bark": 3, "tape value": 1}
    assert "nothing that the plot does not say" in says(capsys, saved, table)
    session = open_plot(saved, background_save=False)
    try:
        record = session.document.record(session.document.trunks.ids[0])
        assert record.species == "oak" and record.fields == (("bark", "rough"),)
        assert record.correction("tape") == pytest.approx(30.4)
    finally:
        session.close()
    history = (saved / "history.jsonl").read_text("utf-8")
    assert history.count("Take over filled.csv") == 1


def test_what_does_not_fit_changes_nothing(saved, table, capsys, tmp_path):
    before = (saved / "project.json").read_bytes()
    strange = tmp_path / "strange.csv"
    strange.write_text("stem_id,species\n1,oak\n77,ash\n")
    assert "no stems 77" in says(capsys, saved, strange, status=1)
    assert "no saved plot" in says(capsys, tmp_path / "stand.laz", table, status=2)
    assert "no such file" in says(capsys, saved, tmp_path / "absent.csv", status=1)
    assert (saved / "project.json").read_bytes() == before
    assert "Left out: stems 77" in says(capsys, saved, strange, "--skip-misfits", "--no-fields")
