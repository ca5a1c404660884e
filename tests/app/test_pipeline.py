"""From a file to the table, with the real reader, checks and stages."""

from __future__ import annotations

import csv
import functools
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from tests.app.plots import contents

from dbh_studio.app import commands
from dbh_studio.app.opening import open_plot, save_as, scale_from
from dbh_studio.app.pipeline import (
    apply_segmentation,
    measure_stems,
    measurement_call,
    segment,
    segment_plot,
    segmentation_call,
)
from dbh_studio.app.plot_run import run_plot
from dbh_studio.app.session import Session
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.errors import (
    CommandError,
    FileError,
    FileMissingError,
    ProjectError,
    ProjectLockedError,
    SettingError,
    StaleResultError,
    UnscaledCloudError,
)
from dbh_studio.io.las import write_las
from dbh_studio.io.ply import write_ply
from dbh_studio.io.project import read_project
from dbh_studio.settings import Settings

DATA = Path(__file__).parents[2].parent / "shared" / "data"

# Centre x and y, diameter, metres; from west to east.
STEMS = np.array([(1.5, 2.0, 0.30), (4.0, 5.5, 0.24), (6.5, 1.5, 0.40)])
ORIGIN = np.array([500_000.0, 4_500_000.0, 100.0])


@functools.cache
def stems_and_ground() -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) points of three upright cylinders on flat ground, 2 mm noise, and the tree of each (0: ground)."""
    rng = np.random.default_rng(0)
    ground = np.c_[rng.uniform(0, 8, (30_000, 2)), rng.normal(0, 0.005, 30_000)]
    parts, ids = [ground], [np.zeros(len(ground), np.int32)]
    for i, (x, y, diameter) in enumerate(STEMS):
        angle, z = rng.uniform(0, 2 * np.pi, 12_000), rng.uniform(0, 5, 12_000)
        radius = diameter / 2 + rng.normal(0, 0.002, 12_000)
        parts.append(np.c_[x + radius * np.cos(angle), y + radius * np.sin(angle), z])
        ids.append(np.full(12_000, 10 * (i + 1), np.int32))
    return np.concatenate(parts), np.concatenate(ids)


def make_cloud(*, unit_m: float = 1.0, with_ids: bool = False) -> PointCloud:
    points, ids = stems_and_ground()
    attributes = {"treeID": ids} if with_ids else {}
    return PointCloud.from_points(points / unit_m + ORIGIN, attributes=attributes)


@pytest.fixture
def las(tmp_path) -> Path:
    write_las(tmp_path / "plot.las", make_cloud())
    return tmp_path / "plot.las"


@pytest.fixture
def ply(tmp_path) -> Path:
    """In units of 0.25 m, and not saying so."""
    write_ply(tmp_path / "scan.ply", make_cloud(unit_m=0.25))
    return tmp_path / "scan.ply"


def table(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def check_diameters(rows: list[dict[str, str]], session: Session, *, unit_m: float = 1.0) -> None:
    """Every stem has its diameter and its place; the world's origin is the cloud's."""
    shift = (ORIGIN - session.cloud.origin) * unit_m
    assert len(rows) == len(STEMS)
    for row, (x, y, diameter) in zip(rows, STEMS, strict=True):
        assert float(row["dbh_cm"]) == pytest.approx(100 * diameter, rel=0.02)
        place = [float(row[name]) for name in ("x_m", "y_m", "z_ground_m")]
        assert place == pytest.approx(np.array([x, y, 0.0]) + shift, abs=0.03)


def test_from_a_file_to_the_table_and_the_saved_plot(las, tmp_path):
    seen = []
    out = tmp_path / "out"
    result = run_plot(las, out, progress=lambda fraction, message="": seen.append(fraction))
    assert result.csv_path == out / "plot.csv" and result.project_dir == out / "plot.dbh"
    rows = table(result.csv_path)
    check_diameters(rows, result.session)
    assert [row["stem_id"] for row in rows] == ["1", "2", "3"] and rows[0]["plot_id"] == "plot"
    assert rows[0]["scale_source"] == "metres" and rows[0]["remedy"] == ""
    assert seen == sorted(seen) and seen[-1] == 1.0
    assert {"read", "ground and trunks", "diameters", "write"} == set(result.timings_s)
    result.session.close()

    # The same file gives the same bytes, and an earlier plot is not overwritten unless one says so.
    before = result.csv_path.read_bytes()
    with pytest.raises(ProjectError, match="earlier run"):
        run_plot(las, out)
    run_plot(las, out, overwrite=True).session.close()
    assert result.csv_path.read_bytes() == before

    # On the saved plot itself it measures the trunks that are there.
    session = open_plot(out / "plot.dbh", background_save=False)
    session.do(commands.delete_trunk(2))
    session.close()
    settings = Settings(measure=Settings().measure.changed(curve="ellipse"))
    again = run_plot(out / "plot.dbh", tmp_path / "again", settings=settings)
    again.session.close()
    rows = table(again.csv_path)
    assert [(row["stem_id"], row["dbh_method"]) for row in rows] == [("1", "ellipse"), ("3", "ellipse")]


def test_a_table_never_takes_the_place_of_the_cloud(tmp_path):
    points, _ = stems_and_ground()
    cloud = tmp_path / "plot.csv"
    np.savetxt(cloud, points[::20], fmt="%.3f", delimiter=",")
    before = cloud.read_bytes()
    for overwrite in (False, True):
        with pytest.raises(FileError, match="read from it"):
            run_plot(cloud, tmp_path, scale="metres", overwrite=overwrite)
    tiles = tmp_path / "tiles"
    tiles.mkdir()
    shutil.copy(cloud, tiles / "tiles.csv")
    with pytest.raises(FileError, match="read from it"):
        run_plot(tiles, tiles, scale="metres", overwrite=True)
    session = open_plot(cloud, scale="metres", project_dir=tmp_path / "plot.dbh")
    session.close()
    for overwrite in (False, True):
        with pytest.raises(FileError):
            run_plot(tmp_path / "plot.dbh", tmp_path, overwrite=overwrite)
    assert cloud.read_bytes() == before == (tiles / "tiles.csv").read_bytes()


def test_a_table_somebody_made_is_kept_unless_one_says_so(las, tmp_path):
    out = tmp_path / "out"
    run_plot(las, out).session.close()
    table_path = out / "plot.csv"
    own = table_path.read_bytes()
    # Again from the saved plot: the table is its own.
    run_plot(out / "plot.dbh", out).session.close()
    assert table_path.read_bytes() == own
    edited = own.replace(b"plot_id", b"stand", 1)
    table_path.write_bytes(edited)
    with pytest.raises(FileError, match="already"):
        run_plot(out / "plot.dbh", out)
    assert table_path.read_bytes() == edited
    # A plot that is made anew did not write any table that is there.
    shutil.rmtree(out / "plot.dbh")
    table_path.write_bytes(own)
    with pytest.raises(FileError, match="already"):
        run_plot(las, out)
    assert not (out / "plot.dbh").exists()
    table_path.write_bytes(edited)
    run_plot(las, out, overwrite=True).session.close()
    assert table_path.read_bytes() == own


def test_a_file_of_the_same_name_beside_a_moved_plot_does_not_hide_its_cloud(las, tmp_path):
    folder, elsewhere = tmp_path / "plot.dbh", tmp_path / "elsewhere"
    open_plot(las, project_dir=folder).close()
    elsewhere.mkdir()
    shutil.move(folder, elsewhere / "plot.dbh")
    cloud = make_cloud()
    write_las(elsewhere / "plot.las", cloud.subset(np.arange(len(cloud) - 1)))
    session = open_plot(elsewhere / "plot.dbh")
    assert session.document.source.path == las
    session.close()
    assert read_project(elsewhere / "plot.dbh").source_path == las
    las.unlink()
    with pytest.raises(FileMissingError):
        open_plot(elsewhere / "plot.dbh")
    with pytest.raises(ProjectError, match="not the cloud"):
        open_plot(elsewhere / "plot.dbh", relocate=elsewhere / "plot.las")


def test_a_cloud_without_a_unit_needs_a_scale_and_leaves_nothing_behind_until_it_has_one(ply, tmp_path):
    with pytest.raises(UnscaledCloudError) as caught:
        run_plot(ply, tmp_path / "out")
    assert caught.value.remedy and not (tmp_path / "out").exists()
    session = open_plot(ply)
    assert not session.document.scale.is_known and session.data_check.needs_scale
    with pytest.raises(UnscaledCloudError):
        segment(session, in_process=True)
    result = run_plot(ply, tmp_path / "out", scale=0.25, plot_id="Stand: 4/b")
    assert result.csv_path.name == "Stand_ 4_b.csv"
    rows = table(result.csv_path)
    check_diameters(rows, result.session, unit_m=0.25)
    assert rows[0]["scale_source"] == "factor" and rows[0]["plot_id"] == "Stand: 4/b"
    result.session.close()


def test_a_cloud_lying_on_its_side_is_turned_as_told(tmp_path):
    points, _ = stems_and_ground()
    write_ply(tmp_path / "side.ply", PointCloud.from_points(points[:, [0, 2, 1]] * [1, 1, -1]))
    result = run_plot(tmp_path / "side.ply", tmp_path / "out", scale="m", up="+y")
    rows = table(result.csv_path)
    assert sorted(float(row["dbh_cm"]) for row in rows) == pytest.approx([24, 30, 40], rel=0.02)
    assert result.session.document.up_direction == (0.0, 1.0, 0.0)
    result.session.close()


def test_the_files_own_tree_ids_are_taken_over_unless_told_otherwise(tmp_path):
    cloud = make_cloud(with_ids=True)
    ids = cloud.attributes["treeID"].copy()
    ids[:5] = 77
    path = tmp_path / "ids.las"
    write_las(path, PointCloud(cloud.xyz, cloud.origin, attributes={"treeID": ids}))
    session = open_plot(path)
    notes = segment(session, in_process=True)
    assert session.document.trunks.ids == (10, 20, 30)
    assert {trunk.origin for trunk in session.document.trunks} == {"file"}
    assert any("3 trees were taken over" in note for note in notes)
    assert any("1 trees of the file have fewer than 30 points" in note for note in notes)
    session.undo()
    session.do(commands.change_settings("trunks", use_existing_ids=False))
    segment(session, in_process=True)
    assert [trunk.origin for trunk in session.document.trunks] == ["geometry"] * 3


def test_ids_too_large_for_a_trunk_are_numbered_anew():
    points, ids = stems_and_ground()
    large = np.where(ids > 0, ids.astype(np.int64) + 2**40, 0)
    found = segment_plot(points.astype(np.float32), Settings(), large)
    trunks, notes = found.trunks, found.notes
    assert trunks.ids == (1, 2, 3) and any("anew" in note for note in notes)


def test_a_child_process_finds_and_measures_the_same_as_this_one(las):
    session = open_plot(las)
    segment(session, in_process=True)
    here = [trunk.points.tobytes() for trunk in session.document.trunks]
    numbers = [row.dbh_cm for row in session.inventory()]
    session.undo()
    segment(session)
    assert [trunk.points.tobytes() for trunk in session.document.trunks] == here
    assert session.has_ground() and session.unmeasured() == session.document.trunks.ids
    document = session.document
    session.remember_measurements(document, measure_stems(*measurement_call(session, document)))
    assert session.unmeasured() == ()
    assert [row.dbh_cm for row in session.inventory()] == numbers


def test_a_segmentation_of_another_scale_is_refused(las):
    session = open_plot(las)
    document = session.document
    result = segment_plot(*segmentation_call(session, document))
    session.do(commands.rename_plot("renamed meanwhile"))
    session.do(commands.set_scale(ScaleEstimate(0.9, "factor")))
    with pytest.raises(StaleResultError, match="scale"):
        apply_segmentation(session, document, result)
    session.undo()
    apply_segmentation(session, document, result)
    assert session.document.plot_id == "renamed meanwhile" and len(session.document.trunks) == 3


# ---- the saved plot


def test_a_saved_plot_opens_as_it_was_left(las, tmp_path):
    folder = tmp_path / "plot.dbh"
    session = open_plot(las, project_dir=folder)
    session.do(commands.set_scale(ScaleEstimate(1.01, "bars", 0.002)))
    segment(session, in_process=True)
    session.do(commands.set_tree_record(2, species="Weißtanne", status="dead"))
    with pytest.raises(ProjectLockedError):
        open_plot(folder)
    open_plot(folder, read_only=True).close()
    session.close()
    for again in ({"path": folder}, {"path": las, "project_dir": folder}):
        reopened = open_plot(**again)
        assert contents(reopened.document) == contents(session.document)
        assert reopened.saver.status.state == "saved" and reopened.undo_label == "Describe trunk 2"
        reopened.close()
    watched = open_plot(folder, read_only=True)
    with pytest.raises(CommandError):
        watched.do(commands.delete_trunk(1))
    other_scale = open_plot(folder, scale="metres", up="-z")
    assert other_scale.document.scale == ScaleEstimate(1.0, "metres") and other_scale.can_undo
    other_scale.close()


def test_a_moved_cloud_is_asked_for_and_found(las, tmp_path):
    folder = tmp_path / "saved" / "plot.dbh"
    open_plot(las, project_dir=folder).close()
    elsewhere = tmp_path / "elsewhere.las"
    shutil.move(las, elsewhere)
    with pytest.raises(FileMissingError) as caught:
        open_plot(folder)
    assert caught.value.path == las and "not there any more" in str(caught.value) and caught.value.remedy
    session = open_plot(folder, relocate=elsewhere)
    session.do(commands.rename_plot("found"))
    session.close()
    assert read_project(folder).source_path == elsewhere
    open_plot(folder).close()


def test_trunks_are_never_put_on_another_cloud(las, tmp_path):
    folder = tmp_path / "plot.dbh"
    session = open_plot(las, project_dir=folder)
    segment(session, in_process=True)
    session.close()
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != "lock"}
    cloud = make_cloud()
    for other in (cloud.subset(np.arange(len(cloud))[::-1]), cloud.subset(np.arange(len(cloud) - 1))):
        write_las(las, other)
        with pytest.raises(ProjectError, match="not the cloud") as caught:
            open_plot(folder)
        assert caught.value.remedy
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != "lock"} == before
    write_las(las, cloud)
    open_plot(folder).close()


def test_a_damaged_plot_is_left_alone_and_its_lock_is_free(las, tmp_path):
    folder = tmp_path / "plot.dbh"
    open_plot(las, project_dir=folder).close()
    (folder / "project.json").write_text("{")
    for _ in range(2):
        with pytest.raises(ProjectError, match=r"project\.json"):
            open_plot(folder)
    assert (folder / "project.json").read_text() == "{"


def test_what_cannot_be_opened_leaves_no_folder(tmp_path):
    with pytest.raises(FileMissingError):
        open_plot(tmp_path / "nothing.las", project_dir=tmp_path / "plot.dbh")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "empty.dbh").mkdir()
    with pytest.raises(ProjectError, match="not a saved plot"):
        open_plot(tmp_path / "empty.dbh")
    assert list((tmp_path / "empty.dbh").iterdir()) == []


def test_save_as_leaves_the_old_plot_and_does_not_overwrite(las, tmp_path):
    session = open_plot(las, project_dir=tmp_path / "a.dbh")
    save_as(session, tmp_path / "b.dbh")
    session.do(commands.rename_plot("b"))
    session.close()
    assert read_project(tmp_path / "a.dbh").plot_id == "plot" and read_project(tmp_path / "b.dbh").plot_id == "b"
    session = open_plot(las)
    with pytest.raises(ProjectError, match="already"):
        save_as(session, tmp_path / "b.dbh")
    assert json.loads((tmp_path / "b.dbh" / "project.json").read_text())["schema_version"] == 3


@pytest.mark.parametrize(
    ("given", "metres_per_unit", "source"),
    [
        ("metres", 1.0, "metres"),
        ("Feet", 0.3048, "feet"),
        ("mm", 0.001, "millimetres"),
        ("cm", 0.01, "factor"),
        ("us-feet", 1200 / 3937, "feet"),
        (1.33231, 1.33231, "factor"),
        ("1.5", 1.5, "factor"),
        (None, 1.0, "unknown"),
        ("unknown", 1.0, "unknown"),
    ],
)
def test_scales_as_people_give_them(given, metres_per_unit, source):
    assert scale_from(given) == ScaleEstimate(metres_per_unit, source)


@pytest.mark.parametrize("given", ["furlongs", -1.0, 0, "nan", "inf", ""])
def test_a_scale_that_is_none_is_refused_in_words(given):
    with pytest.raises(SettingError) as caught:
        scale_from(given)
    assert "metres" in caught.value.remedy


def test_an_up_direction_that_is_none_is_refused_before_anything_is_read(tmp_path):
    with pytest.raises(SettingError, match="up direction"):
        open_plot(tmp_path / "nothing.las", up="sideways")


def test_a_real_plot(tmp_path):
    path = DATA / "plots" / "pine_plot.laz"
    if not path.exists():
        pytest.skip("the real plot ../shared/data/plots/pine_plot.laz is not there")
    result = run_plot(path, tmp_path)
    result.session.close()
    rows = table(result.csv_path)
    assert 11 <= len(rows) <= 16
    measured = [float(row["dbh_cm"]) for row in rows if row["dbh_cm"]]
    assert len(measured) >= 10 and 10 < np.median(measured) < 30
    assert all(row["reason"] and row["remedy"] for row in rows if not row["dbh_cm"])


@pytest.mark.parametrize("given", ["1e30", "1e300", 1e-300, 2e4, 1e-7, ScaleEstimate(1e5, "factor")])
def test_a_scale_beyond_reason_is_refused_before_anything_is_read(given, tmp_path):
    with pytest.raises(SettingError, match="metres per unit") as caught:
        open_plot(tmp_path / "nothing.las", scale=given)
    assert "metres" in caught.value.remedy


def test_the_scale_makes_no_metres_of_degrees(tmp_path):
    pytest.importorskip("pyproj")
    points, _ = stems_and_ground()
    path = tmp_path / "degrees.las"
    write_las(path, PointCloud.from_points(points * [1e-5, 1e-5, 1.0] + [15.0, 45.0, 100.0], crs="EPSG:4326"))
    for scale in ("metres", 0.3048, ScaleEstimate(111_000.0 / 1e5, "bars")):
        with pytest.raises(SettingError, match="degrees") as caught:
            open_plot(path, scale=scale)
        assert "projected" in caught.value.remedy
    with pytest.raises(SettingError, match="degrees"):
        run_plot(path, tmp_path / "out", scale="metres")
    assert not (tmp_path / "out").exists()
    # It can be looked at, without a scale.
    assert not open_plot(path).document.scale.is_known
