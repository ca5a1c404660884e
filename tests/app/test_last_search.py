"""The last search is remembered with its result, saved beside the plot, and says what has changed since."""

from __future__ import annotations

import csv
import io
import json
import shutil

import numpy as np
import pytest
from tests.stages.small_forest import STAND, forest

from dbh_studio.app import commands
from dbh_studio.app.last_search import LastSearch, kept_search
from dbh_studio.app.opening import open_plot, save_as
from dbh_studio.app.pipeline import (
    apply_segmentation,
    segment,
    segment_plot,
    segmentation_call,
)
from dbh_studio.app.plot_run import run_plot
from dbh_studio.app.search_report import check_report, search_report, write_search_report
from dbh_studio.cli import main
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.trunks import TrunkSet
from dbh_studio.errors import CommandError, FileError, SettingError, StaleResultError
from dbh_studio.io.las import write_las

SETTINGS = {"trunks": {"small_clusters": "otsu", "min_arc_deg": 200.0}}
KEPT = "cache/search.npz"


@pytest.fixture(scope="module")
def las(tmp_path_factory):
    points, labels = forest(STAND, spacing=0.04, n_shrubs=4)
    path = tmp_path_factory.mktemp("cloud") / "stand.las"
    write_las(path, PointCloud(points, np.zeros(3), attributes={"treeID": np.asarray(labels, np.int32)}))
    return path


@pytest.fixture(scope="module")
def saved(las, tmp_path_factory):
    """A plot run and closed, and the search it had in memory."""
    settings = {"trunks": {**SETTINGS["trunks"], "use_existing_ids": False}}
    result = run_plot(las, tmp_path_factory.mktemp("out"), settings=settings)
    search = result.session.last_search
    result.session.close()
    return result.project_dir, search


@pytest.fixture
def folder(saved, tmp_path):
    return shutil.copytree(saved[0], tmp_path / "plot.dbh", ignore=shutil.ignore_patterns("lock"))


def check_same(kept: LastSearch, search: LastSearch) -> None:
    for name in ("labels", "dropped_cluster", "tilt_deg"):
        assert np.array_equal(getattr(kept.steps, name), getattr(search.steps, name))
        assert not getattr(kept.steps, name).flags.writeable
    for name in ("joined_from", "clusters", "near_misses", "settings", "from_masks", "n_stems_detected", "counts"):
        assert getattr(kept.steps, name) == getattr(search.steps, name)
    assert kept.steps.size_threshold == search.steps.size_threshold and kept.steps.spacing_m == search.steps.spacing_m
    assert (kept.when, kept.n_trunks, kept.ground, kept.frame) == (
        search.when,
        search.n_trunks,
        search.ground,
        search.frame,
    )


def test_a_reopened_plot_has_the_search_it_was_saved_with(saved, folder):
    search = saved[1]
    assert search is not None and search.steps.dropped and search.steps.near_misses
    for read_only in (True, False):
        session = open_plot(folder, read_only=read_only)
        assert session.last_search is not None
        check_same(session.last_search, search)
        assert session.last_search.remarks(session.document) == ()
        session.close()


def test_what_has_changed_since_is_said(folder):
    session = open_plot(folder)
    search = session.last_search
    session.do(commands.change_settings("trunks", min_arc_deg=150.0))
    assert search.remarks(session.document)[0].startswith("Settings have changed")
    session.undo()
    session.do(commands.change_settings("measure", curve="ellipse"))
    assert search.remarks(session.document) == ()
    session.do(commands.delete_trunk(session.document.trunks.ids[0]))
    n_trunks = len(session.document.trunks)
    assert search.remarks(session.document) == (f"It found {n_trunks + 1} trunks; the plot has {n_trunks} now.",)
    session.undo()
    session.do(commands.set_scale(ScaleEstimate(1.1, "factor")))
    assert "scaled or turned" in search.remarks(session.document)[0]
    session.close()


def test_a_new_search_takes_the_place_of_the_last(las, tmp_path):
    session = open_plot(las)
    assert session.last_search is None
    session.do(commands.change_settings("trunks", use_existing_ids=False))
    segment(session, in_process=True)
    first = session.last_search
    assert first is not None and first.n_trunks == len(session.document.trunks)
    plot = tmp_path / "later.dbh"
    save_as(session, plot)
    check_same(kept_search(plot, session.document), first)
    # A result that comes too late changes nothing.
    document = session.document
    late = segment_plot(*segmentation_call(session, document))
    session.do(commands.change_settings("trunks", small_clusters="otsu"))
    with pytest.raises(StaleResultError):
        apply_segmentation(session, document, late)
    assert session.last_search is first
    apply_segmentation(session, session.document, segment_plot(*segmentation_call(session, session.document)))
    assert session.last_search.steps.settings.small_clusters == "otsu"
    check_same(kept_search(plot, session.document), session.last_search)
    # Trees taken over from the file were not searched for.
    session.do(commands.change_settings("trunks", use_existing_ids=True))
    segment(session, in_process=True)
    assert session.last_search is None and not (plot / KEPT).exists()
    session.close()


def changed(folder, **values):
    """The kept search with parts changed: arrays, or fields of what is said about it."""
    with np.load(folder / KEPT) as kept:
        arrays = dict(kept)
    about = json.loads(str(arrays["about"]))
    for name, value in values.items():
        (arrays if name in arrays else about)[name] = value
    np.savez(folder / KEPT, **{**arrays, "about": json.dumps(about)})


@pytest.mark.parametrize(
    "values",
    [
        {"version": 99},
        {"fingerprint": "of another cloud"},
        {"n_points": 3},
        {"labels": np.zeros(5, np.uint8)},
        {"labels": "no numbers"},
        {"dropped_cluster": np.zeros(2, np.int32)},
        {"clusters": []},
        {"clusters": [[1, 2]]},
        {"trunks": {"min_arc_deg": -5.0}},
        {"trunks": {"no_such_setting": 1}},
        {"when": "yesterday"},
        {"joined_from": [1, 2]},
        {"near_misses": 7},
    ],
    ids=lambda values: "-".join(values),
)
def test_a_kept_search_that_cannot_be_used_is_left_alone(folder, values):
    changed(folder, **values)
    session = open_plot(folder)
    assert session.last_search is None
    session.close()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 torn", None], ids=["empty", "torn", "missing"])
def test_the_cache_may_be_damaged_or_deleted(folder, content):
    if content is None:
        shutil.rmtree(folder / "cache")
    else:
        (folder / KEPT).write_bytes(content)
    session = open_plot(folder)
    assert session.last_search is None
    session.close()


def test_a_pickle_in_the_cache_is_not_run(folder):
    class Planted:
        def __reduce__(self):
            return (folder.joinpath("planted").touch, ())

    buffer = io.BytesIO()
    np.savez(buffer, about=np.array([Planted()], object))
    (folder / KEPT).write_bytes(buffer.getvalue())
    (folder / "planted").unlink(missing_ok=True)
    session = open_plot(folder)
    assert session.last_search is None and not (folder / "planted").exists()
    session.close()


def test_a_folder_that_cannot_be_written_loses_nothing_but_the_cache(las, tmp_path):
    session = open_plot(las, project_dir=tmp_path / "plot.dbh")
    session.do(commands.change_settings("trunks", use_existing_ids=False))
    (tmp_path / "plot.dbh" / "cache").write_text("a file where the folder should be")
    segment(session, in_process=True)
    assert session.last_search is not None and len(session.document.trunks) == len(STAND)
    session.close()


# ---- as a file


def test_the_report_has_every_cluster_and_why_it_was_dropped(folder, tmp_path):
    session = open_plot(folder, read_only=True)
    steps = session.last_search.steps
    write_search_report(tmp_path / "steps.json", session)
    report = json.loads((tmp_path / "steps.json").read_text(encoding="utf-8"))
    assert sum(report["points_by_last_step"].values()) == report["points"]["all"] == len(session.cloud)
    assert report["points"]["in_trunks"] == sum(len(trunk.points) for trunk in session.document.trunks)
    assert [c["n_points"] for c in report["clusters"]] == [c.n_points for c in steps.clusters]
    dropped = [c for c in report["clusters"] if not c["kept"]]
    assert len(dropped) == len(steps.dropped) > 0
    assert all("fewer than" in c["why"] and c["advice"][0]["changes"] for c in dropped)
    assert len(report["near_misses"]) == len(steps.near_misses) > 0
    write_search_report(tmp_path / "steps.csv", session)
    with (tmp_path / "steps.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["n_points"]) for row in rows] == [c.n_points for c in steps.clusters]
    place = session.points_world()[steps.clusters[0].point]
    assert [float(rows[0][name]) for name in ("x_m", "y_m", "z_m")] == pytest.approx(list(place), abs=1e-3)


def test_a_report_that_cannot_be_written_is_told_before_the_work(tmp_path):
    with pytest.raises(SettingError, match=r"steps\.txt"):
        check_report(tmp_path / "steps.txt", overwrite=False)
    with pytest.raises(FileError, match="no such folder"):
        check_report(tmp_path / "nowhere" / "steps.json", overwrite=False)
    (tmp_path / "steps.json").touch()
    with pytest.raises(FileError, match="already"):
        check_report(tmp_path / "steps.json", overwrite=False)
    check_report(tmp_path / "steps.json", overwrite=True)


def test_a_plot_that_was_not_searched_has_no_report(las):
    with pytest.raises(CommandError, match="not searched"):
        search_report(open_plot(las))


def test_the_command_line_writes_it_beside_the_inventory(las, tmp_path, capsys):
    out = tmp_path / "steps.json"
    arguments = ["run", str(las), "--out", str(tmp_path), "--steps", str(out), "--quiet"]
    assert main([*arguments, "--set", "trunks.use_existing_ids=false", "--set", "trunks.small_clusters=otsu"]) == 0
    assert json.loads(out.read_text(encoding="utf-8"))["settings"]["trunks"]["small_clusters"] == "otsu"
    assert main([*arguments, "--name", "again"]) == 1
    assert "already" in capsys.readouterr().err


def test_steps_of_a_plot_that_was_never_searched_are_refused_before_the_work(las, tmp_path, capsys, monkeypatch):
    session = open_plot(las, project_dir=tmp_path / "plot.dbh")
    session.do(commands.replace_trunks(TrunkSet.from_point_sets([np.arange(500)])))
    session.close()

    def no_work(*_, **__):
        raise AssertionError("trees are measured all the same")

    monkeypatch.setattr("dbh_studio.app.session.Session.inventory", no_work)
    arguments = ["run", "--out", str(tmp_path), "--steps", str(tmp_path / "steps.json"), "--quiet"]
    assert main([*arguments, str(tmp_path / "plot.dbh")]) == 1
    told = capsys.readouterr().err
    assert "not searched for" in told and "dbh-studio run" in told
    # Trees that the file itself tells apart are not searched for, either.
    assert main([*arguments, str(las), "--name", "again"]) == 1
    assert "trunks.use_existing_ids=false" in capsys.readouterr().err
    assert not (tmp_path / "steps.json").exists() and not (tmp_path / "again.dbh").exists()
