from __future__ import annotations

import json
import struct

import numpy as np
import pytest
import trimesh

from dbh_studio.errors import FileError, MalformedFileError, TruncatedFileError
from dbh_studio.io.mesh import read_mesh, sample_surface
from dbh_studio.io.reader import read_reconstruction


@pytest.fixture
def cylinder():
    return trimesh.creation.cylinder(radius=0.2, height=3.0, sections=64)


@pytest.mark.parametrize("kind", ["obj", "glb", "stl", "ply"])
def test_a_mesh_is_shown_and_sampled(tmp_path, cylinder, kind):
    path = tmp_path / f"stem.{kind}"
    cylinder.export(path)
    reconstruction = read_reconstruction(path)
    assert reconstruction.mesh is not None
    assert len(reconstruction.mesh.faces) == len(cylinder.faces)
    assert reconstruction.provenance.format == kind
    assert "sampled" in reconstruction.notes[-1]
    points = reconstruction.cloud.xyz + reconstruction.cloud.origin
    up = 1 if np.ptp(points[:, 1]) > 1 else 2
    radial = np.linalg.norm(np.delete(points, up, axis=1), axis=1)
    wall = np.abs(points[:, up]) < 1.49
    # Facets of a 64-sided prism lie between r cos(π/64) and r.
    assert radial[wall].min() > 0.2 * np.cos(np.pi / 64) - 1e-4
    assert radial.max() < 0.2 + 1e-4


def test_samples_follow_area(tmp_path):
    # Two squares, one nine times as large: it gets nine tenths of the points.
    corners = [[0, 0], [1, 0], [1, 1], [0, 1], [10, 0], [13, 0], [13, 3], [10, 3]]
    lines = [f"v {x} {y} 0" for x, y in corners] + ["f 1 2 3", "f 1 3 4", "f 5 6 7", "f 5 7 8"]
    (tmp_path / "a.obj").write_text("\n".join(lines) + "\n")
    mesh = read_mesh(tmp_path / "a.obj", kind="obj")
    cloud = sample_surface(mesh, tmp_path, n_points=20_000)
    assert (cloud.xyz[:, 0] >= 10).mean() == pytest.approx(0.9, abs=0.01)
    assert (cloud.xyz == sample_surface(mesh, tmp_path, n_points=20_000).xyz).all()


def test_vertex_colours_are_mixed(tmp_path, cylinder):
    cylinder.visual.vertex_colors = np.tile([10, 200, 30, 255], (len(cylinder.vertices), 1))
    cylinder.export(tmp_path / "a.ply")
    reconstruction = read_reconstruction(tmp_path / "a.ply")
    assert (reconstruction.cloud.rgb == [10, 200, 30]).all()
    assert (reconstruction.mesh.vertex_rgb == [10, 200, 30]).all()


def test_large_coordinates(tmp_path, cylinder):
    cylinder.apply_translation([500_000, 4_500_000, 100])
    cylinder.export(tmp_path / "a.obj", digits=4)
    reconstruction = read_reconstruction(tmp_path / "a.obj")
    vertices = reconstruction.mesh.vertices + reconstruction.cloud.origin
    assert np.abs(vertices.mean(axis=0) - [500_000, 4_500_000, 100]).max() < 1e-3


def test_an_obj_without_faces_is_a_cloud(tmp_path, rng):
    points = rng.normal(size=(50, 3))
    (tmp_path / "a.obj").write_text("".join(f"v {x} {y} {z}\n" for x, y, z in points.tolist()))
    reconstruction = read_reconstruction(tmp_path / "a.obj")
    assert reconstruction.mesh is None
    assert np.abs(reconstruction.cloud.xyz - points).max() < 1e-6


def test_claims_of_a_glb_are_checked(tmp_path, cylinder):
    cylinder.export(tmp_path / "a.glb")
    data = (tmp_path / "a.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + length])
    tree["accessors"][0]["count"] = 10**12
    text = json.dumps(tree).encode()
    body = data[20 + length :]
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(body), len(text), 0x4E4F534A)
    (tmp_path / "b.glb").write_bytes(head + text + body)
    with pytest.raises(MalformedFileError, match="more values"):
        read_reconstruction(tmp_path / "b.glb")
    (tmp_path / "c.glb").write_bytes(data[:-100])
    with pytest.raises(TruncatedFileError):
        read_reconstruction(tmp_path / "c.glb")


def test_damaged_obj(tmp_path):
    (tmp_path / "a.obj").write_text("v 1 2 3\nv 1 2 oops\nf 1 2 9\n")
    with pytest.raises(FileError):
        read_reconstruction(tmp_path / "a.obj")
