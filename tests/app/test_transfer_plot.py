"""Trunks of a photo plot on a LiDAR cloud, from files to the saved plot: transform, labels, scale, refusals."""

from __future__ import annotations

import csv
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.transferplot import UNIT_M, straightened, write_transfer_plot, write_tum

from dbh_studio.app import commands, pipeline
from dbh_studio.app.opening import open_plot, save_as
from dbh_studio.app.transfer_plot import TransferRequest, apply_scale, output_paths, photo_side, transfer_plot
from dbh_studio.app.transfer_report import COMPARISON_COLUMNS, ComparisonSummary, comparison_csv, summary_of
from dbh_studio.app.transfer_walks import WalkFile
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import (
    AlignmentError,
    CancelledError,
    CommandError,
    FileError,
    ProjectExistsError,
    SettingError,
    UnscaledCloudError,
)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_transfer_plot(tmp_path_factory.mktemp("transfer"))


@pytest.fixture(scope="module")
def photo(files):
    """The photo plot with its true scale and trunks, in memory."""
    session = open_plot(files.photo, scale=UNIT_M)
    pipeline.segment(session, in_process=True)
    first, second = session.document.trunks.ids[:2]
    session.do(commands.set_tree_record(first, species="Quercus robur", tag="A7"))
    session.do(commands.delete_trunk(second))
    return session


def request(files, out, **values):
    walks = {"photo_walk": WalkFile(files.camera), "lidar_walk": WalkFile(files.scanner)}
    return TransferRequest(files.scan, out, "photo", **{**walks, **values})


@pytest.fixture(scope="module")
def done(files, photo, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    return transfer_plot(*photo_side(photo), request(files, out))


def tree_of(files, trunk):
    """The true tree of a trunk of the photo plot."""
    names, counts = np.unique(files.pair.photo_tree_ids[trunk.points], return_counts=True)
    return int(names[counts.argmax()])


def transform_error(files, session, report, metres_per_unit=UNIT_M):
    """Root mean square distance between where photo points come to lie and where they belong, metres."""
    lidar = open_plot(report.project_dir, read_only=True)
    world = replace(session.document, scale=ScaleEstimate(metres_per_unit, "factor")).world_from_source
    points = files.pair.photo_xyz[::50].astype(float)
    placed = report.lidar_from_photo.apply(world.apply(points - session.cloud.origin))
    truth = lidar.document.world_from_source.apply(files.pair.lidar_from_photo.apply(points) - lidar.cloud.origin)
    lidar.close()
    return float(np.sqrt((np.linalg.norm(placed - truth, axis=1) ** 2).mean()))


def test_the_clouds_lie_on_each_other_and_the_clocks_are_found(files, photo, done):
    assert done.method == "trajectories" and done.clock_offset_s == pytest.approx(37.5, abs=0.1)
    assert transform_error(files, photo, done) < 0.03
    assert 0.001 < done.error_m < 0.03 and done.rms_m < 0.06 and done.covered > 0.9
    assert done.walk is not None and done.walk.kept.sum() == done.n_pairs
    assert np.median(done.walk.distance_m[done.walk.kept]) < 0.06
    pickle.loads(pickle.dumps(done))


def test_the_lidar_plot_has_the_same_trees_under_the_same_numbers(files, photo, done):
    lidar = open_plot(done.project_dir, read_only=True)
    document = lidar.document
    assert document.trunks.ids == photo.document.trunks.ids and document.plot_id == "photo_lidar"
    assert document.trunks.next_id == photo.document.trunks.next_id, "no number means two trees"
    assert document.settings == photo.document.settings and document.source.path == files.scan
    first = document.trunks.ids[0]
    assert (document.record(first).species, document.record(first).tag) == ("Quercus robur", "A7")
    truth, height = files.pair.lidar_tree_ids, lidar.ground().height_above(lidar.points_world())
    breast = (height > 1.0) & (height < 2.0)
    for trunk in document.trunks:
        tree = tree_of(files, photo.document.trunks[trunk.id])
        assert (truth[trunk.points] == tree).mean() > 0.97
        there = np.flatnonzero((truth == tree) & breast)
        assert np.isin(there, trunk.points).mean() > 0.9
    lidar.close()


def test_both_diameters_stand_side_by_side(files, photo, done):
    with done.csv_path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COMPARISON_COLUMNS
    assert [int(row["stem_id"]) for row in rows] == list(photo.document.trunks.ids)
    heights = 1.3
    for tree, row in zip(done.trees, rows, strict=True):
        true_cm = files.pair.trees[tree_of(files, photo.document.trunks[tree.stem_id]) - 1].diameter_cm(
            "curve", height_m=heights
        )
        assert float(row["dbh_lidar_cm"]) == pytest.approx(true_cm, rel=0.05)
        assert float(row["dbh_photo_cm"]) == pytest.approx(true_cm, rel=0.12)
        assert tree.difference_cm == pytest.approx(tree.dbh_photo_cm - tree.dbh_lidar_cm)
        assert tree.difference_pct == pytest.approx(100 * tree.difference_cm / tree.dbh_lidar_cm)
        assert tree.centres_apart_cm < 5.0 and tree.n_points_lidar > 100 and tree.n_points_carried > 100
    summary = summary_of(done.trees)
    assert summary.n == len(rows) and abs(summary.bias_cm) <= summary.rmse_cm < 3.0


def test_the_summary_of_known_differences():
    assert summary_of(()) == ComparisonSummary(0, None, None, None, None)


def test_a_row_without_a_diameter_is_empty_and_says_why(done):
    missing = replace(done.trees[0], dbh_lidar_cm=None, difference_cm=None, difference_pct=None, remark="=cmd()")
    header, row = comparison_csv([missing]).decode().splitlines()
    cells = dict(zip(header.split(","), row.split(","), strict=True))
    assert cells["dbh_lidar_cm"] == cells["difference_cm"] == "" and cells["remark"] == "'=cmd()"
    known = [replace(done.trees[0], difference_cm=d, difference_pct=10 * d) for d in (-1.0, 2.0, 5.0)]
    assert summary_of([*known, missing]) == ComparisonSummary(3, 2.0, pytest.approx(np.sqrt(10.0)), 2.0, 20.0)


def test_refined_it_lies_closer_and_the_scale_is_told_with_its_error(files, photo, done, tmp_path):
    wrong = UNIT_M * 1.02
    session = open_plot(files.photo, scale=wrong)
    session.do(commands.replace_trunks(photo.document.trunks))
    report = transfer_plot(*photo_side(session), request(files, tmp_path, refine=True))
    assert np.isfinite(report.surface_rms_m) and np.isnan(report.error_m)
    assert transform_error(files, session, report, wrong) < 0.005 < transform_error(files, photo, done)
    assert report.photo_scale == "own" and report.scale_change == pytest.approx(1 / 1.02 - 1, abs=2e-3)
    off = report.scale.metres_per_unit / UNIT_M - 1
    assert abs(off) < 4 * report.scale.standard_error / UNIT_M < 0.01 and report.scale.source == "lidar"
    assert session.document.scale.metres_per_unit == wrong, "nothing of the photo plot was changed"


def test_a_plot_without_scale_and_trunks_gets_both(files, tmp_path):
    session = open_plot(files.photo)
    assert not session.document.scale.is_known
    with pytest.raises(CommandError, match="no trunks") as told:
        transfer_plot(*photo_side(session), request(files, tmp_path))
    assert "--set-scale" in told.value.remedy
    report = transfer_plot(*photo_side(session), request(files, tmp_path, set_scale=True))
    assert report.photo_scale == "lidar" and report.scale_change is None and len(report.found_trunks) >= 7
    assert transform_error(files, session, report, report.scale.metres_per_unit) < 0.03
    apply_scale(session, report)
    assert session.document.scale == report.scale
    assert report.scale.metres_per_unit == pytest.approx(UNIT_M, rel=5e-3)
    assert session.document.trunks.ids == tuple(tree.stem_id for tree in report.trees)
    session.undo()
    session.undo()
    assert not session.document.scale.is_known and not len(session.document.trunks)


def test_without_trajectories_the_stems_do_and_say_how_sure(files, photo, tmp_path):
    report = transfer_plot(*photo_side(photo), request(files, tmp_path, lidar_walk=None, with_scale=False))
    assert report.method == "stems" and report.n_pairs >= 5 and report.scale is None
    assert transform_error(files, photo, report) < 0.02
    assert any("stems stand on one of the LiDAR's" in note for note in report.notes)
    assert any("there is no trajectory of the scanner" in note for note in report.notes)


def straight_walks(files, folder):
    pair = files.pair
    level = straightened(pair.lidar_walk.moved(pair.lidar_from_photo.inverse()))
    mine = replace(level, time_s=level.time_s - pair.offset_s)
    camera = write_tum(folder / "straight_camera.txt", mine)
    scanner = write_tum(folder / "straight_scanner.txt", level.moved(pair.lidar_from_photo))
    return {"photo_walk": WalkFile(camera), "lidar_walk": WalkFile(scanner)}


def test_a_straight_walk_is_helped_by_verticals_and_stems(files, photo, tmp_path):
    walks = straight_walks(files, tmp_path)
    report = transfer_plot(*photo_side(photo), request(files, tmp_path, clock_offset_s=37.5, **walks))
    assert report.method == "trajectories" and transform_error(files, photo, report) < 0.02
    assert any("straight line" in note and "confirm" in note for note in report.notes)


def few_trunks(photo, n):
    """The photo plot with so many of its trunks."""
    cloud, document = photo_side(photo)
    kept = tuple(document.trunks)[:n]
    return cloud, replace(document, trunks=replace(document.trunks, trunks=kept), trees={})


def test_a_straight_walk_past_too_few_stems_is_refused_in_words(files, photo, tmp_path):
    walks = straight_walks(files, tmp_path)
    with pytest.raises(AlignmentError, match="straight line") as told:
        transfer_plot(*few_trunks(photo, 2), request(files, tmp_path, clock_offset_s=37.5, **walks))
    assert "bend" in told.value.remedy
    assert not output_paths(request(files, tmp_path))[0].exists()


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda walk: replace(walk, time_s=walk.time_s[:6], xyz=walk.xyz[:6]), "has 6 poses"),
        (lambda walk: replace(walk, time_s=walk.time_s * 1e-3), "at no offset of their clocks"),
        (lambda walk: replace(walk, xyz=np.cumsum(np.random.default_rng(1).normal(size=walk.xyz.shape), axis=0)),
         "The walks do not tell"),
    ],
)  # fmt: skip
def test_walks_that_do_not_fit_are_refused_where_stems_cannot_help(files, photo, tmp_path, spoil, says):
    scanner = write_tum(tmp_path / "spoiled.txt", spoil(files.pair.lidar_walk))
    with pytest.raises(AlignmentError, match=says) as told:
        transfer_plot(*few_trunks(photo, 2), request(files, tmp_path, lidar_walk=WalkFile(scanner)))
    assert "too few" in str(told.value) or "stems" in str(told.value)
    assert told.value.remedy


def test_clouds_of_two_places_are_refused(files, photo, tmp_path):
    away = Similarity(Rotation.from_rotvec([0, 0, 0.4]).as_matrix(), np.array([300.0, 50.0, 0.0]))
    scanner = write_tum(tmp_path / "elsewhere.txt", files.pair.lidar_walk.moved(away))
    with pytest.raises(AlignmentError, match="do not lie on each other: only 0%") as told:
        transfer_plot(*photo_side(photo), request(files, tmp_path, lidar_walk=WalkFile(scanner)))
    assert "frame of its cloud" in told.value.remedy


def test_nothing_is_overwritten_unasked(files, photo, done):
    again = request(files, done.project_dir.parent)
    with pytest.raises(ProjectExistsError, match="earlier transfer"):
        transfer_plot(*photo_side(photo), again)
    shutil.rmtree(done.project_dir)
    with pytest.raises(FileError, match="such a file already"):
        transfer_plot(*photo_side(photo), again)
    once_more = transfer_plot(*photo_side(photo), replace(again, overwrite=True))
    assert once_more.project_dir.exists()
    # Also by another way there.
    around = once_more.project_dir / ".." / once_more.project_dir.name
    with pytest.raises(ProjectExistsError, match="would be overwritten"):
        transfer_plot(*photo_side(photo), replace(again, lidar=around, overwrite=True))


def test_what_makes_no_sense_is_told(files, photo, tmp_path):
    with pytest.raises(SettingError, match="0 m far"):
        transfer_plot(*photo_side(photo), request(files, tmp_path, reach_m=0.0))
    unscaled = open_plot(files.photo)
    with pytest.raises(CommandError, match="rigid"):
        transfer_plot(
            unscaled.cloud,
            replace(photo.document, scale=ScaleEstimate()),
            request(files, tmp_path, with_scale=False),
        )
    with pytest.raises(UnscaledCloudError, match="lidar-scale"):
        transfer_plot(*photo_side(photo), replace(request(files, tmp_path), lidar=files.photo))
    saved = tmp_path / "scan.dbh"
    save_as(open_plot(files.scan), saved, background=False).close()
    with pytest.raises(SettingError, match="saved plot"):
        transfer_plot(*photo_side(photo), replace(request(files, tmp_path), lidar=saved, lidar_scale="feet"))


def test_poses_of_photos_without_times_are_told(files, photo, tmp_path):
    poses = tmp_path / "kitti.txt"
    walk = files.pair.photo_walk
    poses.write_text("\n".join(f"1 0 0 {x} 0 1 0 {y} 0 0 1 {z}" for x, y, z in walk.xyz))
    report = transfer_plot(*photo_side(photo), request(files, tmp_path, photo_walk=WalkFile(poses)))
    assert report.method == "stems" and any("--photo-rate" in note for note in report.notes)
    timed = request(files, tmp_path / "timed", photo_walk=WalkFile(poses, rate_hz=2.0))
    assert transfer_plot(*photo_side(photo), timed).method == "trajectories"


def test_cancelled_nothing_is_left(files, photo, tmp_path):
    def cancel(fraction, message=""):
        if fraction > 0.7:
            raise CancelledError

    with pytest.raises(CancelledError):
        transfer_plot(*photo_side(photo), request(files, tmp_path), progress=cancel)
    assert not list(tmp_path.iterdir())
