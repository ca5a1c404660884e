from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.cloud import PointCloud
from dbh_studio.errors import CancelledError, EmptyFileError, MalformedFileError, TruncatedFileError
from dbh_studio.io.ply import read_faces, read_header, read_ply, write_ply

_NP = {"<": "<f8", ">": ">f8"}


def _absolute(cloud):
    return cloud.xyz.astype(np.float64) + cloud.origin


def _write(path, points, *, order="ascii", faces=(), before=""):
    """An independent little writer: doubles, uchar colours, optional faces and an element before the vertices."""
    formats = {"ascii": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}
    head = f"ply\nformat {formats[order]} 1.0\ncomment made here\n{before}element vertex {len(points)}\n"
    head += "property double x\nproperty double y\nproperty double z\nproperty uchar red\nproperty uchar green\n"
    head += "property uchar blue\n"
    if faces:
        head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
    head += "end_header\n"
    if order == "ascii":
        body = "".join(f"{x!r} {y!r} {z!r} 1 2 3\n" for x, y, z in points.tolist())
        body += "".join(" ".join(map(str, (len(face), *face))) + "\n" for face in faces)
        path.write_bytes(head.encode() + (b"9 9\n" if before else b"") + body.encode())
        return
    records = np.empty(len(points), [(a, _NP[order]) for a in "xyz"] + [(c, "u1") for c in "rgb"])
    for i, axis in enumerate("xyz"):
        records[axis] = points[:, i]
    for i, colour in enumerate("rgb"):
        records[colour] = i + 1
    body = b"".join(bytes([len(face)]) + np.array(face, order + "i4").tobytes() for face in faces)
    path.write_bytes(
        head.encode() + (np.array([9, 9], order + "i4").tobytes() if before else b"") + records.tobytes() + body
    )


@pytest.mark.parametrize("order", ["ascii", "<", ">"])
@pytest.mark.parametrize("before", ["", "element camera 1\nproperty int a\nproperty int b\n"])
def test_coordinates_survive_at_utm(tmp_path, survey_points, order, before):
    path = tmp_path / "plot.ply"
    _write(path, survey_points, order=order, before=before)
    cloud = read_ply(path).cloud
    assert np.abs(_absolute(cloud) - survey_points).max() < 5e-5
    assert (cloud.rgb == [1, 2, 3]).all()


@pytest.mark.parametrize("order", ["ascii", "<", ">"])
def test_faces_of_mixed_polygons_become_triangles(tmp_path, survey_points, order):
    faces = [(0, 1, 2)] * 1500 + [(0, 1, 2, 3)] * 3 + [(4, 5, 6)] + [(0, 1, 2, 3, 4)] + [(0, 1)]
    path = tmp_path / "mesh.ply"
    _write(path, survey_points[:10], order=order, faces=faces)
    triangles = read_faces(path, 10)
    assert len(triangles) == 1500 + 2 * 3 + 1 + 3
    assert (triangles[:1500] == [0, 1, 2]).all()
    assert {tuple(t) for t in triangles[1500:1506].tolist()} == {(0, 1, 2), (0, 2, 3)}
    assert read_header(path).count("face") == len(faces)


def test_faces_with_unknown_vertices_are_left_out(tmp_path, survey_points):
    path = tmp_path / "mesh.ply"
    _write(path, survey_points[:3], order="<", faces=[(0, 1, 2), (0, 1, 9)])
    assert read_faces(path, 3).tolist() == [[0, 1, 2]]


def test_round_trip_keeps_everything(tmp_path, survey_cloud):
    path = tmp_path / "cloud.ply"
    write_ply(path, survey_cloud)
    cloud = read_ply(path, attributes="all").cloud
    assert np.abs(_absolute(cloud) - _absolute(survey_cloud)).max() < 5e-5
    assert (cloud.rgb == survey_cloud.rgb).all()
    for name in ("treeID", "intensity"):
        assert (cloud.attributes[name] == survey_cloud.attributes[name]).all()
    assert list(tmp_path.iterdir()) == [path]


def test_needed_attributes_only(tmp_path, survey_cloud):
    write_ply(tmp_path / "cloud.ply", survey_cloud)
    assert list(read_ply(tmp_path / "cloud.ply").cloud.attributes) == ["treeID"]


def test_local_coordinates_are_written_as_floats(tmp_path, rng):
    path = tmp_path / "cloud.ply"
    xyz = rng.normal(size=(20, 3)).astype(np.float32)
    write_ply(path, PointCloud(xyz, np.zeros(3)))
    assert b"property float x" in path.read_bytes()
    assert (read_ply(path).cloud.xyz == xyz).all()


def test_a_failed_write_leaves_the_old_file(tmp_path, survey_cloud, monkeypatch):
    path = tmp_path / "cloud.ply"
    path.write_bytes(b"old")
    monkeypatch.setattr("dbh_studio.io.atomic.os.fsync", lambda _: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_ply(path, survey_cloud)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("order", ["ascii", "<"])
def test_truncated(tmp_path, survey_points, order):
    path = tmp_path / "plot.ply"
    _write(path, survey_points, order=order)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(TruncatedFileError) as caught:
        read_ply(path)
    assert caught.value.path == path
    assert caught.value.remedy


@pytest.mark.parametrize("order", ["ascii", "<"])
def test_a_huge_count_is_refused_at_once(tmp_path, survey_points, order):
    path = tmp_path / "plot.ply"
    _write(path, survey_points, order=order)
    path.write_bytes(path.read_bytes().replace(b"vertex 500", b"vertex 1000000000000"))
    with pytest.raises(TruncatedFileError, match="1,000,000,000,000"):
        read_ply(path)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"double x", b"quux x"),
        (b"property double x\n", b""),
        (b"format ascii", b"format fancy"),
        (b"vertex 500", b"vertex -5"),
        (b"double y", b"double x"),
    ],
)
def test_malformed_header(tmp_path, survey_points, old, new):
    path = tmp_path / "plot.ply"
    _write(path, survey_points)
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(MalformedFileError):
        read_ply(path)


def test_a_bad_ascii_line_is_named(tmp_path, survey_points):
    path = tmp_path / "plot.ply"
    _write(path, survey_points)
    lines = path.read_bytes().splitlines(keepends=True)
    lines[100] = b"1 2 oops 1 2 3\n"
    path.write_bytes(b"".join(lines))
    with pytest.raises(MalformedFileError, match="oops"):
        read_ply(path)


def test_points_without_coordinates_are_dropped_and_counted(tmp_path, survey_points):
    points = survey_points.copy()
    points[::10, 1] = np.nan
    points[5] = np.inf
    path = tmp_path / "plot.ply"
    _write(path, points, order="<")
    loaded = read_ply(path)
    assert len(loaded.cloud) == 500 - 50 - 1
    assert any("51 points" in note for note in loaded.notes)


def test_only_nan_or_no_points_is_empty(tmp_path):
    path = tmp_path / "plot.ply"
    for points in (np.full((10, 3), np.nan), np.zeros((0, 3))):
        _write(path, points, order="<")
        with pytest.raises(EmptyFileError):
            read_ply(path)


def test_a_stray_point_does_not_pull_the_origin_away(tmp_path, survey_points):
    points = np.vstack([np.zeros((3, 3)), survey_points])
    path = tmp_path / "plot.ply"
    _write(path, points, order="<")
    assert np.abs(_absolute(read_ply(path).cloud)[3:] - survey_points).max() < 5e-5


def test_cancelling_stops_the_reader(tmp_path, survey_points):
    def cancel(fraction, message=""):
        raise CancelledError

    path = tmp_path / "plot.ply"
    _write(path, survey_points, order="<")
    with pytest.raises(CancelledError):
        read_ply(path, progress=cancel)
