"""`dbh-studio masks` and `run --masks auto|stored`, with graphs of a few kilobytes that find what is brown."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tests.makeplot import copied, fill_store, write_graphs, write_make_plot
from tests.maskplot import MaskPlot

from dbh_studio.cli import main
from dbh_studio.io.masks import MaskStore
from dbh_studio.io.models import ModelStore
from dbh_studio.io.project import read_project

# One look at each photo, on one core: the graphs are too small to share.
QUICK = ("--panorama", "whole", "--threads", 1)


def runs(capsys, *arguments: object) -> tuple[str, str]:
    status = main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    assert status == 0, err
    return out, err


def fails(capsys, status: int, *arguments: object) -> str:
    assert main([str(argument) for argument in arguments]) == status
    return capsys.readouterr().err


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """A cache with the models; what is kept for plots that are not saved is there, too."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DBH_STUDIO_CACHE", str(folder))
        patch.setenv("DBH_STUDIO_OFFLINE", "1")
        fill_store(ModelStore(), write_graphs(tmp_path_factory.mktemp("graphs")))
        yield folder


@pytest.fixture
def without_models(tmp_path, monkeypatch):
    monkeypatch.setenv("DBH_STUDIO_CACHE", str(tmp_path / "empty"))


@pytest.fixture(scope="module")
def plot(tmp_path_factory) -> MaskPlot:
    return write_make_plot(tmp_path_factory.mktemp("plot") / "plot", unit_m=0.37)


@pytest.fixture(scope="module")
def saved_once(plot, tmp_path_factory) -> Path:
    """A saved plot that knows its photos, with two masks."""
    from dbh_studio.app.opening import open_plot
    from dbh_studio.app.photo_scale import PhotoRequest, add_photos

    folder = tmp_path_factory.mktemp("saved") / "plot.dbh"
    session = open_plot(plot.cloud, scale=0.37, project_dir=folder, background_save=False)
    add_photos(session, PhotoRequest(plot.poses, plot.folder / "images"))
    session.close()
    assert main(["masks", "make", str(folder), "--keyframes", "2", *map(str, QUICK), "--quiet"]) == 0
    return folder


@pytest.fixture
def saved(saved_once, tmp_path) -> Path:
    """The same, to be changed."""
    return Path(shutil.copytree(saved_once, tmp_path / "plot.dbh"))


def listed(capsys, plot: Path) -> dict[str, dict]:
    out, _ = runs(capsys, "masks", "list", plot, "--json")
    return {row["photo"]: row for row in json.loads(out)["photos"]}


# ---- make, list, show, review


def test_masks_are_made_listed_shown_and_reviewed(saved, tmp_path, capsys):
    rows = listed(capsys, saved)
    made = [name for name, row in rows.items() if row["has_mask"]]
    assert len(rows) == 8 and len(made) == 2
    assert all(rows[name]["origin"] == "detector" and rows[name]["votes"] and rows[name]["n_trunks"] for name in made)
    out, _ = runs(capsys, "masks", "list", saved)
    assert "2 with a mask that votes, 6 without a mask" in out and made[0] in out
    # The next ones; those that are there stay.
    out, err = runs(capsys, "masks", "make", saved, "--keyframes", 3, *QUICK)
    assert "note: Masks of 1 of 8 photos" in err and "(2 more are there already)" in err
    assert "1 mask made" in out and "--masks stored" in out
    plan = runs(capsys, "masks", "make", saved, "--keyframes", 3, *QUICK, "--dry-run", "--json")[0]
    report = json.loads(plan)
    assert report["photos"] == [] and report["n_kept"] == 3 and report["ladder"]["chosen"] == "detector"
    picture = tmp_path / "look.jpg"
    out, _ = runs(capsys, "masks", "show", saved, made[0], picture)
    assert picture.stat().st_size > 1000 and "trunks, drawn in" in out
    runs(capsys, "masks", "show", saved, made[1], picture)  # an overlay may take the place of an overlay
    runs(capsys, "masks", "review", saved, *made, "reject")
    rows = listed(capsys, saved)
    assert [rows[name]["review"] for name in made] == ["rejected"] * 2 and not rows[made[0]]["votes"]
    out, _ = runs(capsys, "masks", "review", saved, made[0], "accept", "--json")
    assert json.loads(out)[0]["review"] == "accepted"
    runs(capsys, "masks", "review", saved, made[0], "clear")
    assert listed(capsys, saved)[made[0]]["review"] == ""


def test_requests_that_cannot_be(saved, plot, tmp_path, capsys):
    assert "no kept mask" in fails(capsys, 1, "masks", "review", saved, "nowhere.jpg", "reject")
    assert "no kept mask" in fails(capsys, 1, "masks", "show", saved, "nowhere.jpg", tmp_path / "a.jpg")
    assert ".jpg" in fails(capsys, 2, "masks", "show", saved, "00.jpg", tmp_path / "a.tif")
    photo = shutil.copy(plot.folder / "images" / "00.jpg", tmp_path)
    assert "no overlay" in fails(capsys, 1, "masks", "show", saved, "00.jpg", photo)
    assert "neither a number" in fails(capsys, 2, "masks", "make", saved, "--keyframes", "some")
    assert "Box threshold" in fails(capsys, 2, "masks", "make", saved, "--box-threshold", 3)
    assert "no photo nowhere.jpg" in fails(capsys, 1, "masks", "make", saved, "--photo", "nowhere.jpg")
    assert "tile_fov_deg" in fails(capsys, 2, "masks", "make", saved, "--tiles", 3)
    assert "precision int8" in fails(capsys, 1, "masks", "make", saved, "--precision", "int8")
    assert "no model 'nothing'" in fails(capsys, 1, "masks", "make", saved, "--detector", "nothing")
    (tmp_path / "no.dbh").mkdir()
    for action in (["make"], ["list"]):
        assert "not a saved plot" in fails(capsys, 1, "masks", *action, tmp_path / "no.dbh")
        assert "no such" in fails(capsys, 1, "masks", *action, tmp_path / "no.ply").lower()


def test_without_models_photos_or_scale(saved, plot, tmp_path, capsys, without_models):
    message = fails(capsys, 1, "masks", "make", saved)
    assert ": No segmenter is on this computer." in message and "models add FOLDER" in message
    message = fails(capsys, 1, "masks", "make", saved, "--fetch", "--offline")
    assert "Downloads are switched off" in message
    message = fails(capsys, 1, "masks", "make", saved, "--rung", "detector")
    assert "No detector and no segmenter" in message
    alone = tmp_path / "alone"
    alone.mkdir()
    shutil.copy(plot.cloud, alone)
    assert "--scale" in fails(capsys, 3, "masks", "make", alone / "plot.ply")
    assert "alone" in fails(capsys, 1, "masks", "make", alone / "plot.ply", "--scale", 0.37)
    shutil.copy(plot.poses, alone)
    message = fails(capsys, 1, "masks", "make", alone / "plot.ply", "--scale", 0.37)
    assert "models add FOLDER" in message or "None of the 8 photos" in message


def test_a_plot_that_is_open_elsewhere_is_not_written(saved, capsys):
    from dbh_studio.io.project import ProjectWriter

    name = MaskStore(saved / "masks").entries[0].image
    writer = ProjectWriter(saved)
    try:
        assert listed(capsys, saved)[name]["has_mask"]
        fails(capsys, 1, "masks", "review", saved, name, "reject")
        fails(capsys, 1, "masks", "make", saved)
    finally:
        writer.close()
    assert listed(capsys, saved)[name]["review"] == ""


# Imported by every Python that is started with it on its path, the job's among them: the third mask is long in coming.
STUCK_AFTER_TWO = """
import time
from dbh_studio.io.masks.store import MaskStore
put = MaskStore.put
def slow(self, *arguments, **options):
    if len(self) == 2:
        time.sleep(600)
    return put(self, *arguments, **options)
MaskStore.put = slow
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of Windows are others")
def test_interrupted_it_ends_politely_and_goes_on_later(plot, tmp_path, capsys):
    elsewhere = copied(plot, tmp_path / "copy")
    out = tmp_path / "p.dbh"
    runs(capsys, "run", elsewhere.cloud, "--out", tmp_path / "out", "--scale", 0.37, "--name", "p")
    out = tmp_path / "out" / "p.dbh"
    command = ["masks", "make", out, "--cameras", elsewhere.poses, "--images", elsewhere.folder / "images"]
    command += ["--keyframes", "all", *QUICK]
    (tmp_path / "sitecustomize.py").write_text(STUCK_AFTER_TWO)
    process = subprocess.Popen(
        [sys.executable, "-m", "dbh_studio", *map(str, command)],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    index = out / "masks" / "index.jsonl"
    # A head and two masks. No limit of time: on a loaded computer it may take long.
    while process.poll() is None and not (index.is_file() and index.read_text().count("\n") > 2):
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    err = process.communicate()[1]
    n_made = len(MaskStore(out / "masks"))
    assert process.returncode == 130 and "of 8 are made and kept." in err and "interrupted" in err
    assert n_made == 2
    assert not list(out.rglob("*.part"))
    _, err = runs(capsys, *command)
    assert f"note: Masks of {8 - n_made} of 8 photos" in err and len(MaskStore(out / "masks")) == 8


# ---- run --masks


def test_a_run_goes_on_where_the_cache_cannot_be_written(plot, cache, tmp_path, capsys, monkeypatch, caplog):
    # In the place of the folder for masks is a file: nobody can write there, whoever runs the tests.
    nowhere = tmp_path / "cache"
    nowhere.mkdir()
    shutil.copytree(cache / "models", nowhere / "models")
    (nowhere / "unsaved-masks").touch()
    (nowhere / "unsaved-votes").touch()
    monkeypatch.setenv("DBH_STUDIO_CACHE", str(nowhere))
    photos = ["--cameras", plot.poses, "--images", plot.folder / "images", "--scale", 0.37]
    making = ["--keyframes", 3, "--tiles", 4, "--threads", 1]
    out, _ = runs(capsys, "run", plot.cloud, "--out", tmp_path, *photos, "--masks", "auto", *making, "--json")
    assert any(note.startswith("Masks made: 3, ") for note in json.loads(out)["notes"])
    assert sum("masks are kept for this run only" in record.message for record in caplog.records) == 1
    assert len(MaskStore(tmp_path / "plot.dbh" / "masks")) == 3


def test_a_run_takes_the_ladder_and_the_next_one_what_is_kept(plot, tmp_path, capsys):
    photos = ["--cameras", plot.poses, "--images", plot.folder / "images", "--scale", 0.37]
    making = ["--keyframes", 3, "--tiles", 4, "--threads", 1]
    out, _ = runs(capsys, "run", plot.cloud, "--out", tmp_path, *photos, "--masks", "auto", *making, "--json")
    report = json.loads(out)
    assert report["notes"][0].startswith("Trunks by detector and SAM (rung 1 of 4): 3 of 8 photos, about ")
    assert any(note.startswith("Masks made: 3, ") for note in report["notes"])
    assert "Trunks from 3 masks." in report["notes"] and report["n_stems"] >= 3
    state = read_project(tmp_path / "plot.dbh")
    assert state.masks.rung == "detector" and state.masks.n_masks == 3 and len(state.masks.models) == 2
    assert len(MaskStore(tmp_path / "plot.dbh" / "masks")) == 3
    # Over the earlier run: its masks are used again, for photos and recipe are the same.
    again = ["run", plot.cloud, "--out", tmp_path, *photos, "--masks", "auto", *making, "--overwrite", "--json"]
    notes = json.loads(runs(capsys, *again)[0])["notes"]
    assert "3 masks are kept; nothing to do" in notes[0] and "Masks made: 0; there before: 3." in notes
    # On the saved plot, whose trunks may hold edits.
    stored = ["run", tmp_path / "plot.dbh", "--out", tmp_path, "--masks", "stored"]
    assert "--overwrite" in fails(capsys, 1, *stored)
    notes = json.loads(runs(capsys, *stored, "--overwrite", "--json")[0])["notes"]
    assert "3 masks of 8 photos are kept beside the plot and vote." in notes and "Trunks from 3 masks." in notes
    for name in MaskStore(tmp_path / "plot.dbh" / "masks").entries:
        runs(capsys, "masks", "review", tmp_path / "plot.dbh", name.image, "reject")
    message = fails(capsys, 1, *stored, "--overwrite")
    assert "No kept mask can vote" in message and "3 were rejected" in message


def test_masks_made_since_an_earlier_run_are_not_replaced_by_its_masks(plot, tmp_path, capsys):
    photos = ["--cameras", plot.poses, "--images", plot.folder / "images", "--scale", 0.37]
    run = ["run", plot.cloud, "--out", tmp_path, *photos, "--quiet"]
    runs(capsys, *run, "--masks", "auto", "--keyframes", 2, *QUICK)
    (first, second) = (entry.image for entry in MaskStore(tmp_path / "plot.dbh" / "masks").entries)
    named = ["--photo", first, "--box-threshold", 0.4]
    out, _ = runs(capsys, "masks", "make", plot.cloud, *photos, *QUICK, *named, "--json")
    report = json.loads(out)
    assert report["n_made"] == 1 and len(set(report["notes"])) == len(report["notes"])
    runs(capsys, *run, "--masks", "stored", "--overwrite")
    kept = MaskStore(tmp_path / "plot.dbh" / "masks")
    thresholds = {entry.image: entry.recipe["options"]["box_threshold"] for entry in kept.entries}
    assert thresholds == {first: 0.4, second: 0.3}


def test_a_damaged_mask_is_told_as_such(saved, tmp_path, capsys):
    entry = MaskStore(saved / "masks").entries[0]
    (saved / "masks" / entry.file).write_bytes(b"half")
    assert "cannot be read" in fails(capsys, 1, "masks", "show", saved, entry.image, tmp_path / "a.jpg")


def test_photos_that_are_missing_are_told_once(plot, tmp_path, capsys):
    own = copied(plot, tmp_path / "own")
    (own.folder / "images" / "03.jpg").unlink()
    photos = ["--cameras", own.poses, "--images", own.folder / "images", "--scale", 0.37]
    out, _ = runs(capsys, "masks", "make", own.cloud, *photos, "--keyframes", 1, *QUICK, "--json")
    assert sum("not on this computer" in note for note in json.loads(out)["notes"]) == 1


def test_a_run_without_models_says_why_it_is_geometry_alone(plot, tmp_path, capsys, without_models):
    photos = ["--cameras", plot.poses, "--images", plot.folder / "images", "--scale", 0.37]
    _, err = runs(capsys, "run", plot.cloud, "--out", tmp_path, *photos, "--masks", "auto")
    assert "note: Trunks by geometry alone (rung 4 of 4)" in err
    assert "note: Not by detector and SAM: No detector and no segmenter is on this computer." in err
    assert read_project(tmp_path / "plot.dbh").masks is None and len(read_project(tmp_path / "plot.dbh").trunks) == 4
    asked = ["--masks", "auto", "--rung", "prompted", "--overwrite"]
    assert "No segmenter" in fails(capsys, 1, "run", plot.cloud, "--out", tmp_path, *photos, *asked)


def test_options_of_other_masks_are_refused(plot, tmp_path, capsys):
    run = ["run", plot.cloud, "--out", tmp_path, "--scale", 0.37]
    assert "--masks auto" in fails(capsys, 2, *run, "--masks", "stored", "--keyframes", 3)
    assert "--masks auto" in fails(capsys, 2, *run, "--masks", plot.masks, "--prompt", "pole")
    assert "--masks auto" in fails(capsys, 2, *run, "--rung", "prompted")
    assert "brought" in fails(capsys, 2, *run, "--masks", "auto", "--mask-meaning", "labels")
