"""`dbh-studio transfer`: what it prints, what it leaves behind, and what it refuses."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import pytest
from tests.transferplot import UNIT_M, write_transfer_plot

from dbh_studio.cli import main
from dbh_studio.io.project import read_project


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_transfer_plot(tmp_path_factory.mktemp("cli_transfer"))


@pytest.fixture(scope="module")
def saved_once(files) -> Path:
    out = files.folder / "saved"
    arguments = ["run", files.photo, "--scale", UNIT_M, "--out", out, "--quiet"]
    assert main([str(each) for each in arguments]) == 0
    return out / "photo.dbh"


@pytest.fixture
def saved(saved_once, tmp_path) -> Path:
    return Path(shutil.copytree(saved_once, tmp_path / "photo.dbh"))


def walks(files) -> list[object]:
    return ["--photo-trajectory", files.camera, "--lidar-trajectory", files.scanner]


def run(capsys, arguments, status: int = 0) -> tuple[str, str]:
    got = main([str(argument) for argument in ("transfer", *arguments)])
    out, err = capsys.readouterr()
    assert got == status, err
    return out, err


def test_it_writes_plot_and_table_beside_the_photo_plot_and_says_what_it_found(capsys, files, saved):
    before = (saved / "project.json").read_bytes()
    out, err = run(capsys, [saved, files.scan, *walks(files)])
    folder = saved.parent
    assert "poses of the two walks lie on each other" in out and "bias" in out and "m per unit" not in out
    assert "The scanner's clock is +37" in err
    with (folder / "photo_lidar_comparison.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    made, photo = read_project(folder / "photo_lidar.dbh"), read_project(saved)
    assert {int(row["stem_id"]) for row in rows} == {trunk.id for trunk in made.trunks} == {t.id for t in photo.trunks}
    assert {trunk.origin for trunk in made.trunks} == {"carried"}
    assert (saved / "project.json").read_bytes() == before
    # A second time it would take the place of the first.
    _, err = run(capsys, [saved, files.scan, *walks(files)], status=1)
    assert "earlier transfer" in err and "--overwrite" in err
    run(capsys, [saved, files.scan, *walks(files), "--overwrite", "--quiet"])


def test_json_and_the_scale_of_a_plot(capsys, files, saved, tmp_path):
    out = tmp_path / "out"
    text, _ = run(
        capsys, [saved, files.scan, *walks(files), "--refine", "--set-scale", "--out", out, "--json", "--quiet"]
    )
    result = json.loads(text)
    assert result["method"] == "trajectories" and result["clock_offset_s"] == pytest.approx(37.5, abs=0.1)
    assert result["scale"]["is_set"] and result["scale"]["metres_per_unit"] == pytest.approx(UNIT_M, rel=3e-3)
    assert result["photo_scale"] == "lidar" and result["error_m"] is None and result["surface_rms_m"] < 0.05
    assert result["summary"]["n"] == len(result["trees"]) >= 7
    state = read_project(saved)
    assert state.scale.source == "lidar" and state.scale.metres_per_unit == result["scale"]["metres_per_unit"]
    assert state.scale.standard_error == result["scale"]["standard_error"]
    assert Path(result["project"]) == out / "photo_lidar.dbh" and Path(result["csv"]).exists()


def test_a_rigid_fit_by_stems_alone(capsys, files, saved):
    out, err = run(capsys, [saved, files.scan, "--rigid"])
    assert "stems lie on each other" in out and "By the LiDAR" not in out
    assert "no trajectory of the camera" in err and "stems stand on one of the LiDAR's" in err


@pytest.mark.parametrize(
    ("arguments", "status", "says"),
    [
        (["--rigid", "--set-scale"], 2, "rigid fit gives no scale"),
        (["--rigid", "--similarity"], 2, "not allowed with"),
        (["--max-distance", "0"], 2, "0 m far"),
        (["--photo-rate", "30"], 2, "--photo-rate was given without a trajectory"),
        (["--lidar-trajectory", "nowhere.txt"], 1, "nowhere.txt"),
        (["--photo-rate", "-2", "--photo-trajectory", "camera.txt"], 2, "poses a second"),
    ],
)
def test_what_makes_no_sense_is_told(capsys, monkeypatch, files, saved, arguments, status, says):
    monkeypatch.chdir(files.folder)
    _, err = run(capsys, [saved, files.scan, *arguments], status=status)
    assert says in err and "Traceback" not in err
    assert not (saved.parent / "photo_lidar.dbh").exists()


def test_the_photo_side_must_be_a_saved_plot(capsys, files):
    _, err = run(capsys, [files.photo, files.scan], status=2)
    assert "no saved plot" in err and "dbh-studio run" in err


def test_a_lidar_cloud_without_a_unit_stops_it(capsys, files, saved):
    _, err = run(capsys, [saved, files.photo, *walks(files)], status=3)
    assert "--lidar-scale" in err


def test_clouds_of_which_one_stands_on_its_head_are_refused(capsys, files, saved):
    _, err = run(capsys, [saved, files.scan, *walks(files), "--lidar-up", "-z"], status=1)
    assert "180° apart" in err and "--lidar-up" in err
