"""The command line's ways to a scale: markers in photos, known lengths, a number; and markers to print."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import pytest
from tests.photoplot import MIDDLE_M, SIDES_M, PhotoPlot
from tests.threestems import STEMS

from dbh_studio.cli import main
from dbh_studio.io.project import read_project

pytest.importorskip("cv2")

DIAMETERS_CM = [100 * diameter for _, _, diameter in STEMS]


def succeeds(capsys, arguments: list[object]) -> str:
    status = main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    assert status == 0, err
    return out


def fails(capsys, arguments: list[object], status: int = 1) -> str:
    assert main([str(argument) for argument in arguments]) == status
    return capsys.readouterr().err


@pytest.fixture(scope="module")
def measured(photo_plot: PhotoPlot, tmp_path_factory) -> Path:
    """The folder of a run that took its scale from the markers."""
    out = tmp_path_factory.mktemp("out")
    arguments = ["run", photo_plot.cloud, "--cameras", photo_plot.poses, "--marker-side", 1, "--marker", "3=0.5"]
    assert main([str(each) for each in (*arguments, "--out", out, "--quiet")]) == 0
    return out


@pytest.fixture
def saved(measured: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(measured / "cloud.dbh", tmp_path / "cloud.dbh"))


# ---- markers in photos


def test_a_run_takes_its_scale_from_markers_on_the_way(photo_plot, measured):
    state = read_project(measured / "cloud.dbh")
    assert state.scale.source == "marker"
    relative = state.scale.metres_per_unit / photo_plot.metres_per_unit - 1
    assert abs(relative) < 0.003
    assert abs(relative) < 2.5 * state.scale.standard_error / state.scale.metres_per_unit
    assert {square.marker: square.side_m for square in state.evidence.squares} == SIDES_M
    assert state.cameras.path == photo_plot.poses.absolute()
    with open(measured / "cloud.csv", newline="") as file:
        rows = sorted(csv.DictReader(file), key=lambda row: float(row["x_m"]))
    assert [float(row["dbh_cm"]) for row in rows] == pytest.approx(DIAMETERS_CM, rel=0.01)
    assert {row["scale_source"] for row in rows} == {"marker"}
    assert 0 < float(rows[0]["scale_err_pct"]) < 0.4


def test_the_report_of_a_saved_plot(photo_plot, measured, capsys):
    report = json.loads(succeeds(capsys, ["scale", measured / "cloud.dbh", "--json"]))
    assert report["metres_per_unit"] == pytest.approx(photo_plot.metres_per_unit, rel=0.003)
    assert report["verdict"]["level"] == "good" and report["scale_source"] == "marker"
    names = {photo.name for photo in photo_plot.posed}
    for length in report["lengths"]:
        assert length["kind"] == "marker" and len(length["points_src"]) == 4
        assert set(length["views"]) <= names and len(length["views"]) == length["n_views"] >= 2
    text = succeeds(capsys, ["scale", measured / "cloud.dbh"])
    assert "DICT_4X4_50 7 (control): 1 m" in text and "(marker)" in text


def test_markers_of_two_sizes_under_one_side_stop_the_run(photo_plot, tmp_path, capsys):
    message = fails(capsys, ["run", photo_plot.cloud, "--marker-side", 1, "--out", tmp_path, "--quiet"])
    assert "DICT_4X4_50 7" in message and "DICT_APRILTAG_36h11 3" in message and "contradict" in message
    assert not list(tmp_path.rglob("*.csv")) and not list(tmp_path.rglob("project.json"))


def test_only_the_marker_that_is_named_counts(photo_plot, capsys):
    command = ["scale", photo_plot.cloud, "--dictionary", "4x4_50", "--dictionary", "apriltag_36h11"]
    report = json.loads(succeeds(capsys, [*command, "--marker", "DICT_4X4_250:7=2", "--json"]))
    assert [length["name"] for length in report["lengths"]] == ["DICT_4X4_50 7"]
    assert report["metres_per_unit"] == pytest.approx(2 * photo_plot.metres_per_unit, rel=0.003)


def test_wrong_requests_are_told_before_anything_is_searched(photo_plot, tmp_path, capsys):
    run = ["run", photo_plot.cloud, "--out", tmp_path, "--quiet"]
    assert "more than" in fails(capsys, ["scale", photo_plot.cloud, "--factor", 2, "--marker-side", 1], 2)
    assert "--scale" in fails(capsys, [*run, "--scale", 2, "--marker-side", 1], 2)
    assert "side" in fails(capsys, [*run, "--marker-side", 0], 2).lower()
    assert "12=0.5" in fails(capsys, [*run, "--marker", "7"], 2)
    assert "12=0.5" in fails(capsys, [*run, "--marker", "7=-1"], 2)
    assert "DICT_4X4_50" in fails(capsys, [*run, "--dictionary", "DICT_9X9"], 2)


def test_photos_that_are_not_there(photo_plot, tmp_path, capsys):
    poses = Path(shutil.copy(photo_plot.poses, tmp_path / "poses.json"))
    run = ["run", photo_plot.cloud, "--cameras", poses, "--out", tmp_path / "out", "--quiet"]
    assert "--images" in fails(capsys, run)
    assert "no such folder" in fails(capsys, [*run, "--images", tmp_path / "nowhere"]).lower()
    (tmp_path / "alone").mkdir()
    cloud = shutil.copy(photo_plot.cloud, tmp_path / "alone")
    message = fails(capsys, ["run", cloud, "--marker-side", 1, "--out", tmp_path / "out", "--quiet"])
    assert "camera poses" in message


def test_photos_of_another_plot(photo_plot, tmp_path, capsys):
    content = json.loads(photo_plot.poses.read_text())
    for image in content["images"]:
        image["x"] += 500.0
    poses = tmp_path / "poses.json"
    poses.write_text(json.dumps(content))
    run = ["run", photo_plot.cloud, "--cameras", poses, "--images", photo_plot.folder / "images", "--out", tmp_path]
    assert "do not fit the cloud" in fails(capsys, [*run, "--quiet"])


def test_a_marker_nobody_saw(photo_plot, tmp_path, capsys):
    run = ["run", photo_plot.cloud, "--dictionary", "4x4_50", "--marker", "9=1", "--out", tmp_path, "--quiet"]
    assert "Seen: DICT_4X4_50 7." in fails(capsys, run, 2)


def test_a_dictionary_that_the_photos_do_not_show(photo_plot, capsys):
    message = fails(capsys, ["scale", photo_plot.cloud, "--dictionary", "6x6_50"])
    assert "was not looked for" in message and "DICT_" in message


# ---- known lengths and numbers


def bar(metres_per_unit: float, first: int, second: int, said_m: float | None = None) -> list[float]:
    """Two stems' feet and the distance between them."""
    ends_m = [[*STEMS[number][:2], 0.0] - MIDDLE_M for number in (first, second)]
    length_m = float(((ends_m[1] - ends_m[0]) ** 2).sum() ** 0.5)
    return [*(ends_m[0] / metres_per_unit), *(ends_m[1] / metres_per_unit), said_m or length_m]


def test_bars_set_and_test_the_scale(photo_plot, tmp_path, capsys):
    truth = photo_plot.metres_per_unit
    command = ["scale", photo_plot.cloud, "--json", "--bar", *bar(truth, 0, 1), "--check-bar", *bar(truth, 0, 2)]
    report = json.loads(succeeds(capsys, command))
    assert report["metres_per_unit"] == pytest.approx(truth, rel=1e-9) and report["scale_source"] == "bars"
    assert [length["role"] for length in report["lengths"]] == ["control", "check"]
    assert report["verdict"]["level"] == "good"
    wrong = [*command[:3], *command[3:11], "--check-bar", *bar(truth, 0, 2, said_m=6.0)]
    report = json.loads(succeeds(capsys, wrong))
    assert report["verdict"]["code"] == "check_failed"
    assert report["metres_per_unit"] == pytest.approx(truth, rel=1e-9)
    assert "0 m" in fails(capsys, ["scale", photo_plot.cloud, "--bar", *bar(truth, 0, 1)[:6], 0])
    assert "one place" in fails(capsys, ["scale", photo_plot.cloud, "--bar", 1, 2, 3, 1, 2, 3, 1])
    assert not list(photo_plot.folder.glob("*.dbh"))


def test_a_saved_plot_keeps_its_lengths_and_forgets_them(photo_plot, saved, capsys):
    before = read_project(saved)
    succeeds(capsys, ["scale", saved, "--check-bar", *bar(photo_plot.metres_per_unit, 1, 2)])
    after = read_project(saved)
    assert [each.name for each in after.evidence.bars] == ["Check bar 1"]
    assert after.scale.metres_per_unit == pytest.approx(before.scale.metres_per_unit, rel=1e-6)
    assert [trunk.id for trunk in after.trunks] == [trunk.id for trunk in before.trunks]
    succeeds(capsys, ["scale", saved, "--forget", "DICT_APRILTAG_36h11 3", "--forget", "Check bar 1"])
    assert [each.name for each in read_project(saved).evidence.squares] == ["DICT_4X4_50 7"]
    assert "no known length Nobody" in fails(capsys, ["scale", saved, "--forget", "Nobody"])


def test_a_dry_run_changes_nothing(saved, capsys):
    before = (saved / "project.json").read_bytes()
    report = json.loads(succeeds(capsys, ["scale", saved, "--factor", 3, "--dry-run", "--json"]))
    assert report["metres_per_unit"] == 3 and (saved / "project.json").read_bytes() == before


def test_a_new_factor_needs_no_new_trunks(photo_plot, saved, tmp_path, capsys):
    succeeds(capsys, ["scale", saved, "--factor", photo_plot.metres_per_unit * 1.1])
    succeeds(capsys, ["run", saved, "--out", tmp_path / "again", "--quiet"])
    with open(tmp_path / "again" / "cloud.csv", newline="") as file:
        rows = sorted(csv.DictReader(file), key=lambda row: float(row["x_m"]))
    assert [float(row["dbh_cm"]) for row in rows] == pytest.approx([1.1 * d for d in DIAMETERS_CM], rel=0.01)


def test_weak_scales_say_so(photo_plot, capsys):
    names = [photo.name for photo in photo_plot.posed]
    gap_src = float(((photo_plot.posed.centres_src[0] - photo_plot.posed.centres_src[3]) ** 2).sum() ** 0.5)
    command = ["scale", photo_plot.cloud, "--json", "--baseline", names[0], names[3], 2.0]
    report = json.loads(succeeds(capsys, command))
    assert report["is_weak"] and report["scale_source"] == "baseline"
    assert report["metres_per_unit"] == pytest.approx(2.0 / gap_src)
    assert "no photo" in fails(capsys, ["scale", photo_plot.cloud, "--baseline", "x.jpg", names[0], 2], 2)
    text = succeeds(capsys, ["scale", photo_plot.cloud, "--baseline", names[0], names[3], 2.0])
    assert "weak" in text


def test_a_lying_marker_gives_up_north_and_origin(saved, capsys):
    succeeds(capsys, ["scale", saved, "--frame-from", "DICT_4X4_50 7"])
    state = read_project(saved)
    square = next(each for each in state.evidence.squares if each.marker == ("DICT_4X4_50", 7))
    assert state.origin_src == pytest.approx(tuple(square.corners_src.mean(axis=0)), abs=1e-6)
    assert state.north_direction is not None and state.up_direction[2] > 0.99
    assert "Known: DICT_4X4_50 7" in fails(capsys, ["scale", saved, "--frame-from", "Nobody"], 2)


# ---- markers to print


def test_a_marker_to_print(tmp_path, capsys):
    path = tmp_path / "marker.pdf"
    written = json.loads(succeeds(capsys, ["marker", "--out", path, "--side", 0.15, "--id", 7, "--json"]))
    assert path.read_bytes().startswith(b"%PDF") and written["n_pages"] >= 1 and written["side_m"] == 0.15
    before = path.read_bytes()
    assert "--overwrite" in fails(capsys, ["marker", "--out", path, "--side", 0.2])
    assert path.read_bytes() == before
    succeeds(capsys, ["marker", "--out", path, "--side", 0.2, "--overwrite"])
    assert path.read_bytes() != before
    assert "DICT_4X4_50" in fails(capsys, ["marker", "--out", tmp_path / "b.pdf", "--dictionary", "nothing"], 2)
    assert not (tmp_path / "b.pdf").exists()
