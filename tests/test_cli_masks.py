"""`dbh-studio run --masks`: trunks from masks a person brings, on the command line."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import pytest
from tests.maskplot import MaskPlot, coco, save_masks, write_mask_plot
from tests.threestems import STEMS

from dbh_studio.cli import main
from dbh_studio.io.project import read_project

DIAMETERS_CM = [100 * diameter for _, _, diameter in STEMS]
UNIT_M = 0.37


def runs(capsys, arguments: list[object]) -> tuple[str, str]:
    """Standard output and error of a command that succeeds."""
    status = main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    assert status == 0, err
    return out, err


def fails(capsys, arguments: list[object], status: int) -> str:
    assert main([str(argument) for argument in arguments]) == status
    return capsys.readouterr().err


@pytest.fixture(scope="module")
def plot(tmp_path_factory) -> MaskPlot:
    """In an arbitrary unit."""
    return write_mask_plot(tmp_path_factory.mktemp("mask_plot"), unit_m=UNIT_M)


def command(
    plot: MaskPlot, out: Path, *more: object, masks: Path | None = None, scale: object = UNIT_M
) -> list[object]:
    photos = ["--cameras", plot.poses, "--images", plot.folder / "images"]
    scaled = [] if scale is None else ["--scale", scale]
    return ["run", plot.cloud, "--out", out, *photos, *scaled, "--masks", masks or plot.masks, *more]


def diameters(path: Path) -> list[float]:
    with path.open(newline="") as file:
        return [float(row["dbh_cm"]) for row in sorted(csv.DictReader(file), key=lambda row: float(row["x_m"]))]


def test_a_run_finds_trunks_by_masks(plot, tmp_path, capsys):
    look = tmp_path / "look.jpg"
    _, err = runs(capsys, command(plot, tmp_path / "out", "--mask-category", "1-3", "--mask-overlay", look))
    assert "note: Masks of 8 of 8 photos were found" in err and "note: Trunks from 8 masks." in err
    assert look.stat().st_size > 1000
    assert diameters(tmp_path / "out" / "plot.csv") == pytest.approx(DIAMETERS_CM, rel=0.02)
    state = read_project(tmp_path / "out" / "plot.dbh")
    assert state.cameras.path == plot.poses.absolute() and len(state.trunks) == 3
    # On the saved plot, too: its photos are known, but its trunks may hold edits.
    saved = ["run", tmp_path / "out" / "plot.dbh", "--out", tmp_path / "out", "--masks", plot.masks]
    message = fails(capsys, saved, 1)
    assert "3 trunks already" in message and "--overwrite" in message
    out, _ = runs(capsys, [*saved, "--overwrite", "--json"])
    report = json.loads(out)
    assert report["n_stems"] == 4 and "Trunks from 8 masks." in report["notes"]


def test_a_plot_in_metres_by_coco_and_the_papers_rule(tmp_path, capsys):
    plot = write_mask_plot(tmp_path / "plot")
    masks = tmp_path / "trunks.json"
    masks.write_text(json.dumps(coco({1: "trunk", 2: "pole"}, lambda label: 2 if label == 9 else 1)))
    out, _ = runs(capsys, command(plot, tmp_path, "--paper-votes", "--json", masks=masks, scale="metres"))
    notes = " ".join(json.loads(out)["notes"])
    assert (
        "by their names: trunk." in notes and "at least 1 photo calls it trunk; points behind others vote too" in notes
    )


def test_a_scale_is_needed_and_photos_alone_give_none(plot, tmp_path, capsys):
    assert "--marker-side" in fails(capsys, command(plot, tmp_path, scale=None), 3)
    assert "--scale and markers" in fails(capsys, command(plot, tmp_path, "--marker-side", 1), 2)


def test_markers_may_be_looked_for_in_the_same_photos(plot, tmp_path, capsys):
    pytest.importorskip("cv2")
    asked = command(plot, tmp_path, "--marker-side", 1, "--dictionary", "4x4_50", scale=None)
    assert "marker" in fails(capsys, asked, 1).lower()


def test_what_the_masks_mean_is_asked_for(plot, tmp_path, capsys):
    dark = save_masks(tmp_path / "dark", lambda each: 255 * ((each == 0) | (each == 9)))
    message = fails(capsys, command(plot, tmp_path / "out", masks=dark), 2)
    assert "not clear" in message and "--mask-meaning" in message and "trunk-dark" in message
    assert not (tmp_path / "out").exists()
    out, _ = runs(capsys, command(plot, tmp_path, "--mask-meaning", "trunk-dark", "--json", masks=dark))
    assert json.loads(out)["n_stems"] == 3


def test_masks_that_only_ignore(plot, tmp_path, capsys):
    dark = save_masks(tmp_path / "dark", lambda each: 255 * (each == 0))
    _, err = runs(capsys, command(plot, tmp_path, "--mask-meaning", "ignore-dark", masks=dark))
    assert "note: Trunks by geometry alone, because the masks say what to ignore, not what is trunk." in err


def test_wrong_requests(plot, tmp_path, capsys):
    assert "no such file or folder" in fails(capsys, command(plot, tmp_path, masks=tmp_path / "nowhere"), 1)
    (tmp_path / "empty").mkdir()
    assert "no mask for any" in fails(capsys, command(plot, tmp_path, masks=tmp_path / "empty"), 1)
    assert "1-12" in fails(capsys, command(plot, tmp_path, "--mask-category", "oak"), 2)
    assert "naming style" in fails(capsys, command(plot, tmp_path, "--mask-style", "odd"), 2)
    assert "invalid choice" in fails(capsys, command(plot, tmp_path, "--mask-meaning", "trunks"), 2)
    photo = shutil.copy(plot.folder / "images" / "00.jpg", tmp_path)
    assert "no overlay" in fails(capsys, command(plot, tmp_path, "--mask-overlay", photo), 1)
    assert ".jpg" in fails(capsys, command(plot, tmp_path, "--mask-overlay", tmp_path / "look.tif"), 2)
    for lonely in (
        ["--mask-meaning", "labels"],
        ["--mask-category", 1],
        ["--ignore-masks", tmp_path],
        ["--paper-votes"],
    ):
        message = fails(capsys, ["run", plot.cloud, "--out", tmp_path, "--scale", 1, *lonely], 2)
        assert lonely[0] in str(message) and "--masks PATH" in message
    assert not list(tmp_path.rglob("*.csv")) and not list(tmp_path.rglob("project.json"))


def test_photos_that_are_not_there_are_only_needed_to_be_drawn(plot, tmp_path, capsys):
    poses = shutil.copy(plot.poses, tmp_path)
    run = ["run", plot.cloud, "--out", tmp_path / "out", "--cameras", poses, "--scale", UNIT_M, "--masks", plot.masks]
    assert "--images" in fails(capsys, [*run, "--mask-overlay", tmp_path / "look.jpg"], 1)
    out, _ = runs(capsys, [*run, "--json"])
    assert json.loads(out)["n_stems"] == 4


def test_stems_that_masks_do_not_show_are_counted_and_accepted_where_asked_for(plot, tmp_path, capsys):
    _, err = runs(capsys, command(plot, tmp_path / "offered", "--mask-category", "1-2"))
    assert "note: 2 candidates were found" in err
    assert (tmp_path / "offered" / "plot.dbh" / "cache" / "candidates.npz").is_file()
    assert len(read_project(tmp_path / "offered" / "plot.dbh").trunks) == 2
    _, err = runs(capsys, command(plot, tmp_path / "taken", "--mask-category", "1-2", "--accept-candidates"))
    assert "note: 2 candidates were taken as trunks, and flagged." in err
    state = read_project(tmp_path / "taken" / "plot.dbh")
    assert len(state.trunks) == 4 and sum("none calls it trunk" in tree.flag for tree in state.trees.values()) == 2
    with (tmp_path / "taken" / "plot.csv").open(newline="") as file:
        assert sum("no trunk by the masks" in row["reason"] for row in csv.DictReader(file)) == 2
    message = fails(capsys, ["run", plot.cloud, "--out", tmp_path, "--scale", 1, "--accept-candidates"], 2)
    assert "--accept-candidates" in message and "--masks PATH" in message
