"""Tables and lists of poses: every way to write a rotation and a place, and every way to get it wrong."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbh_studio.errors import EmptyFileError, FileError, MalformedFileError, UnsupportedFormatError
from dbh_studio.io.posed import read_posed_images

ROTATION = Rotation.from_rotvec([0.4, -0.7, 1.1])
MATRIX = ROTATION.as_matrix()
CENTRE = np.array([12.0, -3.0, 1.7])
CAMERA = "2000,1000,EQUIRECTANGULAR,"
GUIDE = Path(__file__).parents[2] / "docs" / "guide" / "posed-images.md"


def csv_columns(rotation: str, place: str) -> tuple[str, str]:
    x, y, z, w = ROTATION.as_quat()
    columns = {
        "quaternion": ("qw,qx,qy,qz", [w, x, y, z]),
        "matrix": ("r11,r12,r13,r21,r22,r23,r31,r32,r33", MATRIX.ravel()),
        "translation": ("tx,ty,tz", -MATRIX @ CENTRE),
        "centre": ("x,y,z", CENTRE),
    }
    names = ",".join(columns[part][0] for part in (rotation, place))
    values = ",".join(repr(float(v)) for part in (rotation, place) for v in columns[part][1])
    return f"name,width,height,model,params,{names}", f"{CAMERA},{values}"


@pytest.mark.parametrize("rotation", ["quaternion", "matrix"])
@pytest.mark.parametrize("place", ["translation", "centre"])
@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_every_way_to_write_a_pose(tmp_path, rotation, place, delimiter):
    header, row = csv_columns(rotation, place)
    text = f"# by hand\n{header}\nb.jpg,{row}\n\n# more\na.jpg,{row}\n".replace(",", delimiter)
    (tmp_path / "poses.csv").write_text(text, encoding="utf-8-sig")
    for path in (tmp_path / "poses.csv", tmp_path):
        posed = read_posed_images(path)
        assert posed.source_format == "table"
        assert [image.name for image in posed] == ["a.jpg", "b.jpg"]
        assert np.allclose(posed.images[0].cam_from_source.rotation, MATRIX)
        assert np.allclose(posed.images[0].centre_src, CENTRE)
        assert posed.images[0].camera.is_panorama


def test_omega_phi_kappa_of_an_upright_aerial_camera(tmp_path):
    """With all angles zero a photogrammetric camera looks down, the image's top to the north (+y)."""
    text = "name,width,height,model,params,x,y,z,omega,phi,kappa\n"
    text += "down.jpg,2000,1000,SIMPLE_PINHOLE,1000 1000 500,10,20,100,0,0,0\n"
    text += "turned.jpg,2000,1000,SIMPLE_PINHOLE,1000 1000 500,10,20,100,0,0,90\n"
    text += "north.jpg,2000,1000,SIMPLE_PINHOLE,1000 1000 500,10,20,100,90,0,0\n"
    (tmp_path / "opk.csv").write_text(text)
    posed = read_posed_images(tmp_path / "opk.csv")
    uv, is_visible = posed.by_name("down.jpg").project([[10.0, 20.0, 0.0], [10.0, 40.0, 0.0], [40.0, 20.0, 0.0]])
    assert is_visible.all()
    assert np.allclose(uv, [[1000, 500], [1000, 300], [1300, 500]])
    # Turned counter-clockwise by 90 degrees, the image's right side looks north.
    uv, _ = posed.by_name("turned.jpg").project([[10.0, 40.0, 0.0]])
    assert np.allclose(uv, [[1200, 500]])
    uv, _ = posed.by_name("north.jpg").project([[10.0, 120.0, 100.0], [10.0, 120.0, 110.0], [20.0, 120.0, 100.0]])
    assert np.allclose(uv, [[1000, 500], [1000, 400], [1100, 500]])


def test_json_with_shared_cameras_times_and_points(tmp_path):
    x, y, z, w = ROTATION.as_quat()
    camera = {"width": 2000, "height": 1500, "model": "PINHOLE", "params": [1500, 1500, 1000, 750]}
    content = {
        "cameras": {"wide": camera},
        "images": [
            {"name": "z.jpg", "camera": "wide", "quaternion": [w, x, y, z], "centre": CENTRE.tolist(), "time_s": 5},
            {"name": "a.jpg", **camera, "rotation": MATRIX.tolist(), "translation": (-MATRIX @ CENTRE).tolist(),
             "time_s": 6},
        ],
        "points": [[1, 2, 3], [4, 5, 6]],
    }  # fmt: skip
    (tmp_path / "poses.json").write_text(json.dumps(content))
    posed = read_posed_images(tmp_path)
    assert [image.name for image in posed] == ["z.jpg", "a.jpg"], "by time"
    for image in posed:
        assert np.allclose(image.cam_from_source.rotation, MATRIX) and np.allclose(image.centre_src, CENTRE)
        assert image.camera.params == (1500, 1500, 1000, 750)
    assert posed.sparse_points_src.tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(
    "change,match",
    [
        (("EQUIRECTANGULAR", "PANORAMIC"), "camera kind 'PANORAMIC'"),
        (("2000", "wide"), "image size in line 2"),
        (("2000", ""), "has no width"),
        (("a.jpg", ""), "Line 2 has no name"),
        (("12.0", "nan"), "not finite"),
        (("12.0", "12 m"), "not a list of numbers"),
    ],
)
def test_wrong_values_are_named_with_their_line(tmp_path, change, match):
    header, row = csv_columns("quaternion", "centre")
    text = f"a.jpg,{row}"
    assert change[0] in text
    (tmp_path / "poses.csv").write_text(f"{header}\n{text.replace(*change, 1)}\n")
    with pytest.raises(MalformedFileError, match=match):
        read_posed_images(tmp_path / "poses.csv")


def test_a_rotation_that_is_none_is_refused(tmp_path):
    header, row = csv_columns("matrix", "centre")
    (tmp_path / "poses.csv").write_text(f"{header}\na.jpg,{row.replace(repr(float(MATRIX[0, 0])), '2.0')}\n")
    with pytest.raises(MalformedFileError, match="not a rotation"):
        read_posed_images(tmp_path / "poses.csv")
    header, _ = csv_columns("quaternion", "centre")
    (tmp_path / "poses.csv").write_text(f"{header}\na.jpg,{CAMERA},0,0,0,0,1,2,3\n")
    with pytest.raises(MalformedFileError, match="zero"):
        read_posed_images(tmp_path / "poses.csv")


@pytest.mark.parametrize("drop", ["qw", "tx"])
def test_a_missing_column_is_said(tmp_path, drop):
    header, row = csv_columns("quaternion", "translation")
    (tmp_path / "poses.csv").write_text(f"{header.replace(drop, 'other')}\na.jpg,{row}\n")
    with pytest.raises(MalformedFileError, match=r"has no rotation|has no place"):
        read_posed_images(tmp_path / "poses.csv")


def test_a_header_alone_is_empty(tmp_path):
    (tmp_path / "poses.csv").write_text(csv_columns("quaternion", "centre")[0] + "\n")
    with pytest.raises(EmptyFileError):
        read_posed_images(tmp_path / "poses.csv")


@pytest.mark.parametrize("text", ["x,y,z\n1,2,3\n", "hello\n", "name,dbh\nA,3\n", "1 2 3\n4 5 6\n", "\x00\x01\x02"])
def test_other_text_is_not_taken_for_poses(tmp_path, text):
    (tmp_path / "other.csv").write_text(text)
    with pytest.raises(UnsupportedFormatError):
        read_posed_images(tmp_path / "other.csv")


@pytest.mark.parametrize(
    "content",
    [{"images": [3]}, {"images": [{}]}, {"images": [{"name": "a", "width": [1], "height": 2, "model": "PINHOLE"}]}],
)
def test_wrong_json_is_named(tmp_path, content):
    (tmp_path / "poses.json").write_text(json.dumps(content))
    with pytest.raises(MalformedFileError):
        read_posed_images(tmp_path / "poses.json")


def test_damage_ends_in_a_message_or_finite_values(tmp_path, rng):
    header, row = csv_columns("quaternion", "centre")
    whole = f"{header}\na.jpg,{row}\nb.jpg,{row}\n".encode()
    path = tmp_path / "poses.csv"
    for _ in range(300):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(damaged), 2):
            damaged[at] = rng.integers(0, 256)
        path.write_bytes(damaged)
        try:
            posed = read_posed_images(path)
        except FileError as error:
            assert str(error)
        else:
            assert np.isfinite(posed.centres_src).all()


def test_the_examples_of_the_guide_can_be_read(tmp_path):
    """What the guide shows is what the reader takes."""
    text = GUIDE.read_text(encoding="utf-8")
    blocks = [block.split("```")[0] for block in text.split("```csv\n")[1:]]
    blocks += [block.split("```")[0] for block in text.split("```json\n")[1:]]
    assert len(blocks) >= 3
    for index, block in enumerate(blocks):
        path = tmp_path / f"poses{index}{'.json' if block.startswith('{') else '.csv'}"
        path.write_text(block)
        assert len(read_posed_images(path)) >= 1
