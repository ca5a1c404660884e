from __future__ import annotations

import sys

import numpy as np
import pytest
import trimesh

from dbh_studio.core.cloud import PointCloud
from dbh_studio.errors import (
    EmptyFileError,
    FileMissingError,
    MalformedFileError,
    MissingComponentError,
    UnsupportedFormatError,
)
from dbh_studio.io.chunks import CloudBuilder
from dbh_studio.io.las import write_las
from dbh_studio.io.ply import write_ply
from dbh_studio.io.reader import SUPPORTED_SUFFIXES, describe_formats, merge_clouds, read_reconstruction


def _tile(rng, x0, n=200, y0=4_500_000.0):
    points = rng.uniform([x0, y0, 0], [x0 + 10, y0 + 10, 5], (n, 3))
    return PointCloud.from_points(points, name="tile"), points


def test_formats_are_listed():
    assert {".las", ".laz", ".ply", ".pcd", ".e57", ".xyz", ".csv", ".obj", ".glb", ".stl"} <= set(SUPPORTED_SUFFIXES)
    assert all(suffix in describe_formats() for suffix in SUPPORTED_SUFFIXES)


def test_missing(tmp_path):
    with pytest.raises(FileMissingError):
        read_reconstruction(tmp_path / "nothing.las")


@pytest.mark.parametrize("suffix", [".las", ".laz", ".e57", ".ply", ".pcd", ".glb", ".stl"])
def test_text_under_a_binary_name(tmp_path, suffix):
    path = tmp_path / f"plot{suffix}"
    path.write_text("1 2 3\n4 5 6\n")
    with pytest.raises(MalformedFileError, match=r"content is text.*rename it to plot\.txt"):
        read_reconstruction(path)


def test_content_decides_over_the_name(tmp_path, survey_cloud):
    path = tmp_path / "plot.las"
    write_ply(path, survey_cloud)
    reconstruction = read_reconstruction(path)
    assert len(reconstruction.cloud) == 500
    assert reconstruction.provenance.format == "ply"
    assert "named .las but is PLY" in reconstruction.notes[0]


@pytest.mark.parametrize(
    ("head", "what"),
    [(b"PK\x03\x04abc", "ZIP"), (b"\xff\xd8\xff\xe0", "JPEG"), (b"<!DOCTYPE html><html>", "web page"),
     (b"version https://git-lfs.github.com/spec/v1\n", "Git LFS")],
)  # fmt: skip
def test_other_files_are_named(tmp_path, head, what):
    (tmp_path / "plot.laz").write_bytes(head + b"x" * 50)
    with pytest.raises(UnsupportedFormatError, match=what) as caught:
        read_reconstruction(tmp_path / "plot.laz")
    assert caught.value.remedy


@pytest.mark.parametrize("suffix", SUPPORTED_SUFFIXES)
def test_empty_and_random_bytes(tmp_path, suffix):
    path = tmp_path / f"plot{suffix}"
    path.write_bytes(b"")
    with pytest.raises(EmptyFileError):
        read_reconstruction(path)
    path.write_bytes(np.random.default_rng(0).bytes(3000))
    with pytest.raises(MalformedFileError):
        read_reconstruction(path)


def test_folder_with_cloud_and_mesh(tmp_path, survey_cloud):
    write_las(tmp_path / "cloud.laz", survey_cloud)
    box = trimesh.creation.box()
    box.apply_translation([500_010, 4_500_010, 320])
    box.export(tmp_path / "model.obj", digits=3)
    (tmp_path / "cameras.txt").write_text("1 2 3\n")
    (tmp_path / "inventory.csv").write_text("tree,dbh,height\n1,23.4,18\n")
    reconstruction = read_reconstruction(tmp_path)
    assert len(reconstruction.cloud) == 500
    assert [path.name for path in reconstruction.used] == ["cloud.laz", "model.obj"]
    centre = reconstruction.mesh.vertices.mean(axis=0) + reconstruction.cloud.origin
    assert np.abs(centre - [500_010, 4_500_010, 320]).max() < 1e-2
    assert any("inventory.csv" in note for note in reconstruction.notes)


def test_a_damaged_mesh_does_not_stop_the_plot(tmp_path, survey_cloud):
    write_las(tmp_path / "cloud.laz", survey_cloud)
    (tmp_path / "model.obj").write_text("v 1 2 oops\nf 1 2 3\n")
    reconstruction = read_reconstruction(tmp_path)
    assert reconstruction.mesh is None
    assert any("left out" in note for note in reconstruction.notes)


def test_tiles_are_merged(tmp_path, rng):
    parts = []
    for i in range(3):
        cloud, points = _tile(rng, 500_000.0 + 10 * i)
        write_las(tmp_path / f"plot_{i}.laz", cloud)
        parts.append(points)
    reconstruction = read_reconstruction(tmp_path)
    got = reconstruction.cloud.xyz + reconstruction.cloud.origin
    assert np.abs(got - np.vstack(parts)).max() < 1e-3
    assert len(reconstruction.used) == 3
    assert len(read_reconstruction(tmp_path, merge="never").cloud) == 200


def test_two_dates_of_one_plot_are_not_merged(tmp_path, rng):
    for year, n in ((2020, 200), (2021, 300)):
        write_las(tmp_path / f"plot_{year}.laz", _tile(rng, 500_000.0, n)[0])
    reconstruction = read_reconstruction(tmp_path)
    assert len(reconstruction.cloud) == 300
    assert any("plot_2020.laz ignored" in note for note in reconstruction.notes)
    assert len(read_reconstruction(tmp_path, merge="always").cloud) == 500


def test_the_same_cloud_in_two_formats_is_read_once(tmp_path, survey_cloud):
    write_las(tmp_path / "plot.laz", survey_cloud)
    write_ply(tmp_path / "plot.ply", survey_cloud)
    reconstruction = read_reconstruction(tmp_path)
    assert [path.name for path in reconstruction.used] == ["plot.laz"]
    assert any("plot.ply ignored" in note for note in reconstruction.notes)


def test_clouds_in_a_subfolder_are_found(tmp_path, survey_cloud):
    (tmp_path / "a" / "b").mkdir(parents=True)
    write_las(tmp_path / "a" / "b" / "plot.las", survey_cloud)
    assert len(read_reconstruction(tmp_path).cloud) == 500


def test_a_folder_without_clouds(tmp_path):
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8\xff")
    with pytest.raises(EmptyFileError):
        read_reconstruction(tmp_path)


def test_merging_keeps_what_all_have(rng):
    a, pa = _tile(rng, 500_000.0)
    b, pb = _tile(rng, 500_900.0)
    a = PointCloud(a.xyz, a.origin, np.zeros(a.xyz.shape, np.uint8), {"treeID": np.ones(200, np.int32)})
    b = PointCloud(b.xyz, b.origin, None, {"treeID": np.full(200, 2, np.int32), "other": np.zeros(200)})
    merged, _ = merge_clouds([a, b])
    assert np.abs(merged.xyz + merged.origin - np.vstack([pa, pb])).max() < 1e-3
    assert merged.rgb is None
    assert set(merged.attributes) == {"treeID"}


def _tile_of_trees(rng, x0, ids):
    """A tile 10 wide from `x0`, with one upright tree 8 high per id, evenly spaced over it."""
    places = x0 + (np.arange(len(ids)) + 0.5) * 10 / len(ids)
    points = [rng.normal([x, 5.0, 4.0], [0.1, 0.1, 1.5], (100, 3)) for x in places]
    values = {"treeID": np.repeat(np.asarray(ids, np.uint8), 100)}
    return PointCloud.from_points(np.concatenate(points), attributes=values, name="tile")


def test_tiles_that_number_their_trees_alike_keep_them_apart(tmp_path, rng):
    for i in range(3):
        write_las(tmp_path / f"plot_{i}.laz", _tile_of_trees(rng, 12.0 * i, [0, 1, 2, 250]))
    reconstruction = read_reconstruction(tmp_path)
    ids, counts = np.unique(reconstruction.cloud.attributes["treeID"], return_counts=True)
    assert ids.tolist() == [0, 1, 2, 250, 1001, 1002, 1250, 2001, 2002, 2250]
    assert counts.tolist() == [300, *[100] * 9]
    assert any("treeID" in note and "1000" in note for note in reconstruction.notes)


def test_a_tree_cut_by_the_border_of_two_tiles_stays_one(rng):
    whole = rng.normal([10.0, 5.0, 4.0], [0.5, 0.5, 1.5], (400, 3))
    others = [rng.normal([x, 5.0, 4.0], [0.5, 0.5, 1.5], (400, 3)) for x in (4.0, 16.0)]
    clouds = []
    for own, id_, half in ((others[0], 3, whole[whole[:, 0] < 10]), (others[1], 9, whole[whole[:, 0] >= 10])):
        ids = np.repeat([id_, 7], [len(own), len(half)]).astype(np.int32)
        clouds.append(PointCloud.from_points(np.concatenate([own, half]), attributes={"treeID": ids}))
    merged, notes = merge_clouds(clouds)
    assert np.unique(merged.attributes["treeID"]).tolist() == [3, 7, 9]
    assert notes == ()


def test_ids_too_large_to_be_raised_are_counted_anew_in_every_tile(rng):
    tiles = [_tile_of_trees(rng, 12.0 * i, [0, 1, 2]) for i in range(2)]
    large = [
        PointCloud(t.xyz, t.origin, attributes={"treeID": t.attributes["treeID"].astype(np.float64) * 1e12})
        for t in tiles
    ]
    merged, notes = merge_clouds(large)
    assert np.unique(merged.attributes["treeID"]).tolist() == [0, 1, 2, 11, 12]
    assert len(notes) == 1


@pytest.mark.parametrize("header", [b"ply\nformat ascii 1.0\nelement vert", b"ply\nformat ascii 1.0\nelement face x\n"])
def test_a_mesh_with_a_damaged_header_does_not_stop_the_plot(tmp_path, survey_cloud, header):
    write_las(tmp_path / "cloud.laz", survey_cloud)
    (tmp_path / "model.ply").write_bytes(header)
    reconstruction = read_reconstruction(tmp_path)
    assert len(reconstruction.cloud) == 500
    assert any("model.ply" in note for note in reconstruction.notes)


def test_a_mesh_beside_a_cloud_is_left_out_where_its_reader_is_not_installed(tmp_path, survey_cloud, monkeypatch):
    write_las(tmp_path / "cloud.laz", survey_cloud)
    (tmp_path / "model.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    monkeypatch.setitem(sys.modules, "trimesh", None)
    reconstruction = read_reconstruction(tmp_path)
    assert reconstruction.mesh is None
    assert any("model.obj" in note and "trimesh" in note for note in reconstruction.notes)
    with pytest.raises(MissingComponentError):
        read_reconstruction(tmp_path / "model.obj")


@pytest.mark.parametrize("suffix", [".laz", ".e57", ".obj", ".ply", ".xyz"])
def test_too_little_memory_is_not_called_damage(tmp_path, survey_cloud, monkeypatch, suffix):
    path = tmp_path / f"plot{suffix}"
    if suffix == ".laz":
        write_las(path, survey_cloud)
    elif suffix == ".e57":
        pye57 = pytest.importorskip("pye57")
        with pye57.E57(str(path), mode="w") as file:
            axes = zip(("cartesianX", "cartesianY", "cartesianZ"), survey_cloud.xyz.T.astype(np.float64), strict=True)
            file.write_scan_raw({name: column.copy() for name, column in axes})
    elif suffix == ".obj":
        trimesh.creation.box().export(path)
    elif suffix == ".ply":
        write_ply(path, survey_cloud)
    else:
        path.write_text("1 2 3\n" * 50)

    def full(*_, **__):
        raise MemoryError

    monkeypatch.setattr(CloudBuilder, "add", full)
    if suffix == ".obj":
        monkeypatch.setattr(trimesh, "load_scene", full)
    with pytest.raises(MalformedFileError, match="more memory than there is"):
        read_reconstruction(path)


def test_classes_named_like_tree_ids_are_offered_not_taken(tmp_path, rng):
    points = rng.uniform([0, 0, 0], [20, 20, 10], (3000, 3))
    rows = np.column_stack([points, 1 + (points[:, 2] > 1) + (points[:, 2] > 5)])
    np.savetxt(tmp_path / "plot.xyz", rows, fmt="%.3f", header="x y z label", comments="")
    notes = read_reconstruction(tmp_path / "plot.xyz").notes
    assert any("'label'" in note and "treeID" in note for note in notes)
