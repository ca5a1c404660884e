"""OpenSfM and OpenDroneMap: every projection against OpenSfM's own formulas, the layouts of files, real ones."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbh_studio.errors import EmptyFileError, FileError, MalformedFileError, UnsupportedFormatError
from dbh_studio.io.posed import read_posed_images

WIDTH, HEIGHT = 4000, 3000
ONE = {"focal": 0.8, "k1": -0.05, "k2": 0.01}
TWO = {"focal_x": 0.8, "focal_y": 0.81, "c_x": 0.01, "c_y": -0.02}
FISHEYE = {"k1": -0.02, "k2": 0.003, "k3": -0.001, "k4": 0.0005}
CAMERAS = {
    "perspective": ONE,
    "fisheye": ONE,
    "dual": {**ONE, "transition": 0.3},
    "brown": {**TWO, "k1": -0.05, "k2": 0.01, "k3": 0.002, "p1": 0.001, "p2": -0.002},
    "fisheye_opencv": {**TWO, **FISHEYE},
    "fisheye62": {**TWO, **FISHEYE, "k5": 1e-4, "k6": -1e-5, "p1": 0.001, "p2": -0.002},
    "fisheye624": {**TWO, **FISHEYE, "k5": 1e-4, "p1": 0.001, "p2": -0.002, "s0": 1e-3, "s1": 2e-4,
                   "s2": -1e-3, "s3": 3e-4},
    "radial": {**TWO, "k1": -0.05, "k2": 0.01},
    "simple_radial": {**TWO, "k1": -0.05},
    "spherical": {},
    "equirectangular": {},
}  # fmt: skip


def opensfm_pixel(kind: str, p: dict, point: np.ndarray, width: int, height: int) -> np.ndarray:
    """OpenSfM's normalised coordinates, one point at a time, then its pixels counted from the outer corner."""
    x, y, z = point
    size = max(width, height)
    if kind in ("spherical", "equirectangular"):
        u, v = np.arctan2(x, z) / (2 * np.pi), -np.arctan2(-y, np.hypot(x, z)) / (2 * np.pi)
        return np.array([u * size + width / 2, v * size + height / 2])
    r = np.hypot(x, y)
    theta = np.arctan2(r, z)
    flat = np.array([x / z, y / z])
    round_ = np.array([x, y]) * theta / r
    t = p.get("transition", 0.0)
    a, b = flat if not kind.startswith("fisheye") else round_
    if kind == "dual":
        a, b = t * flat + (1 - t) * round_
    r2 = a * a + b * b
    if kind in ("perspective", "fisheye", "dual", "radial", "simple_radial", "brown"):
        radial = 1 + p["k1"] * r2 + p.get("k2", 0) * r2**2 + p.get("k3", 0) * r2**3
    else:
        radial = 1 + sum(p.get(f"k{i}", 0) * r2**i for i in range(1, 7))
    p1, p2 = p.get("p1", 0), p.get("p2", 0)
    da = 2 * p1 * a * b + p2 * (r2 + 2 * a * a) + p.get("s0", 0) * r2 + p.get("s1", 0) * r2**2
    db = 2 * p2 * a * b + p1 * (r2 + 2 * b * b) + p.get("s2", 0) * r2 + p.get("s3", 0) * r2**2
    bent = np.array([a * radial + da, b * radial + db])
    focal = np.array([p.get("focal", p.get("focal_x")), p.get("focal", p.get("focal_y"))])
    centre = np.array([p.get("c_x", 0), p.get("c_y", 0)])
    return size * (focal * bent + centre) + np.array([width, height]) / 2


def reconstruction(kind: str = "perspective", n: int = 3, **more) -> dict:
    width, height = (4000, 2000) if kind in ("spherical", "equirectangular") else (WIDTH, HEIGHT)
    shots = {
        f"{10 - index}.jpg": {
            "camera": "c", "rotation": [0.3, -0.2, 0.1 * index], "translation": [index, 2.0, 3.0],
            "capture_time": 1000.0 + index, "orientation": 1,
        }
        for index in range(n)
    }  # fmt: skip
    camera = {"projection_type": kind, "width": width, "height": height, **CAMERAS[kind]}
    points = {"5": {"coordinates": [1.0, 2.0, 3.0], "color": [1.0, 2.0, 255.0]}}
    return {"cameras": {"c": camera}, "shots": shots, "points": points, **more}


@pytest.fixture
def write(tmp_path):
    def save(content):
        path = tmp_path / "reconstruction.json"
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return path

    return save


@pytest.mark.parametrize("kind", CAMERAS)
def test_pixels_follow_opensfm(write, kind):
    part = reconstruction(kind)
    posed = read_posed_images(write([part]))
    image = posed.by_name("10.jpg")
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.0]).as_matrix()
    assert np.allclose(image.cam_from_source.rotation, rotation)
    rng = np.random.default_rng(0)
    in_cam = np.column_stack([rng.uniform(-0.35, 0.35, (50, 2)), np.ones(50)]) * rng.uniform(1, 9, (50, 1))
    uv, is_visible = image.project((in_cam - [0.0, 2.0, 3.0]) @ rotation)
    camera = part["cameras"]["c"]
    expected = [opensfm_pixel(kind, camera, point, camera["width"], camera["height"]) for point in in_cam]
    assert is_visible.all()
    assert np.abs(uv - expected).max() < 1e-8


def test_order_is_that_of_the_capture(write):
    posed = read_posed_images(write([reconstruction(n=4)]))
    assert [image.name for image in posed] == ["10.jpg", "9.jpg", "8.jpg", "7.jpg"]
    assert [image.time_s for image in posed] == [1000.0, 1001.0, 1002.0, 1003.0]
    assert posed.sparse_points_src.tolist() == [[1.0, 2.0, 3.0]] and posed.sparse_rgb.tolist() == [[1, 2, 255]]


def test_without_times_the_order_is_that_of_the_names(write):
    part = reconstruction(n=4)
    part["shots"]["8.jpg"]["capture_time"] = 0.0
    posed = read_posed_images(write([part]))
    assert [image.name for image in posed] == ["7.jpg", "8.jpg", "9.jpg", "10.jpg"]
    assert posed.by_name("8.jpg").time_s is None


def test_of_several_parts_the_largest_is_read_and_said(write):
    posed = read_posed_images(write([reconstruction(n=1), reconstruction(n=3)]))
    assert len(posed) == 3
    assert "2 separate reconstructions of 1, 3 images" in posed.notes[0]


def test_a_single_part_need_not_be_in_a_list(write):
    assert len(read_posed_images(write(reconstruction()))) == 3


def test_shots_written_only_as_members_of_a_rig(write):
    part = reconstruction(n=2)
    for shot in part["shots"].values():
        del shot["rotation"], shot["translation"]
    part["rig_cameras"] = {
        "a": {"rotation": [0, 0, 0], "translation": [0, 0, 0]},
        "b": {"rotation": [0.0, 0.5, 0.0], "translation": [0.1, 0.0, 0.0]},
    }
    part["rig_instances"] = {
        "i": {
            "rotation": [0.1, 0.2, 0.3],
            "translation": [1.0, 2.0, 3.0],
            "rig_camera_ids": {"10.jpg": "a", "9.jpg": "b"},
        }
    }
    posed = read_posed_images(write([part]))
    rig = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    assert np.allclose(posed.by_name("10.jpg").centre_src, -rig.T @ [1.0, 2.0, 3.0])
    second = posed.by_name("9.jpg").cam_from_source
    turn = Rotation.from_rotvec([0.0, 0.5, 0.0]).as_matrix()
    assert np.allclose(second.rotation, turn @ rig)
    assert np.allclose(second.translation, turn @ [1.0, 2.0, 3.0] + [0.1, 0.0, 0.0])


def test_images_without_pose_or_camera_are_counted(write):
    part = reconstruction()
    del part["shots"]["10.jpg"]["rotation"]
    part["shots"]["9.jpg"]["camera"] = "another"
    posed = read_posed_images(write([part]))
    assert [image.name for image in posed] == ["8.jpg"]
    assert any("not aligned (10.jpg)" in note for note in posed.notes)
    assert any("not in the file (9.jpg)" in note for note in posed.notes)


@pytest.mark.parametrize(
    "change,match",
    [
        ({"width": 0}, "no image size"),
        ({"projection_type": "insect"}, "'insect' is not known"),
        ({"projection_type": "spherical"}, "whole sphere"),
        ({"focal": 0.0}, "not positive"),
    ],
)
def test_unusable_cameras_are_said(write, change, match):
    part = reconstruction()
    part["cameras"]["c"].update(change)
    with pytest.raises(EmptyFileError, match=match):
        read_posed_images(write([part]))


def odm_project(tmp_path, *, georeferenced: bool):
    project = tmp_path / "project"
    for folder in ("opensfm/undistorted", "odm_georeferencing", "images"):
        (project / folder).mkdir(parents=True)
    (project / "opensfm/reconstruction.json").write_text(json.dumps([reconstruction()]))
    (project / "opensfm/undistorted/reconstruction.json").write_text(json.dumps([reconstruction(n=1)]))
    (project / "odm_georeferencing/coords.txt").write_text("WGS84 UTM 33N\n448000 5411000\n0 0 0\n")
    if georeferenced:
        (project / "opensfm/reconstruction.topocentric.json").write_text(json.dumps([reconstruction(n=2)]))
    return project


def test_a_whole_odm_project(tmp_path):
    posed = read_posed_images(odm_project(tmp_path, georeferenced=True))
    assert len(posed) == 3, "the distorted originals, not the undistorted copies"
    assert np.allclose(posed.cloud_from_cameras.translation, [448_000.0, 5_411_000.0, 0.0])
    assert posed.cloud_from_cameras.scale == 1.0
    assert any("448,000 m east" in note for note in posed.notes)


def test_an_odm_project_that_was_not_georeferenced_is_not_moved(tmp_path):
    assert read_posed_images(odm_project(tmp_path, georeferenced=False)).cloud_from_cameras is None


@pytest.mark.parametrize("text", ["", "   \n"])
def test_an_empty_file_is_said(write, text):
    with pytest.raises(EmptyFileError):
        read_posed_images(write(text))


@pytest.mark.parametrize("text", ["[]", '{"a": 1}', "[1, 2]", '{"type": "FeatureCollection", "features": []}'])
def test_other_json_is_not_taken_for_cameras(write, text):
    with pytest.raises(UnsupportedFormatError):
        read_posed_images(write(text))


@pytest.mark.parametrize("text", ["[" * 100_000, '[{"cameras": {}, "shots"', '{"cameras": 1, "shots": 2}'])
def test_broken_json_is_named(write, text):
    with pytest.raises(MalformedFileError):
        read_posed_images(write(text))


@pytest.mark.parametrize(
    "path,value",
    [
        (("shots", "10.jpg", "rotation"), [1, 2]),
        (("shots", "10.jpg", "rotation"), "left"),
        (("shots", "10.jpg", "translation"), [1, 2, float("nan")]),
        (("shots", "10.jpg"), 7),
        (("points", "5", "coordinates"), [1, 2]),
        (("points", "5"), {"color": [1, 2, 3]}),
        (("cameras", "c", "focal"), "long"),
        (("cameras", "c"), None),
    ],
)
def test_wrong_values_are_named(write, path, value):
    part = reconstruction()
    place = part
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    with pytest.raises(MalformedFileError):
        read_posed_images(write([part]))


def test_a_file_cut_anywhere_ends_in_a_message(write):
    whole = json.dumps([reconstruction()])
    for length in range(0, len(whole), 23):
        with pytest.raises(FileError):
            read_posed_images(write(whole[:length]))


# -- real files ----------------------------------------------------------------------------------------------------


def test_berlin_points_lie_in_its_photos(shared_data):
    posed = read_posed_images(shared_data / "sfm/opensfm/berlin")
    assert [image.name for image in posed] == ["01.jpg", "02.jpg", "03.jpg"]
    assert all(image.path for image in posed), "found in images/, not among the masks of the same name"
    assert len(posed.sparse_points_src) == 1430
    seen = [image.project(posed.sparse_points_src)[1].mean() for image in posed]
    assert min(seen) > 0.5


def test_berlin_tracks_reproject(shared_data):
    """OpenSfM keeps what each photo saw of each point in a separate file; its coordinates are normalised."""
    folder = shared_data / "sfm/opensfm/berlin"
    content = json.loads((folder / "reconstruction_example.json").read_text())[0]["points"]
    posed = read_posed_images(folder)
    away = []
    for line in (folder / "tracks_example.csv").read_text().splitlines()[1:]:
        name, track, _, x, y = line.split("\t")[:5]
        if track in content:
            image = posed.by_name(name)
            size = max(image.camera.width_px, image.camera.height_px)
            uv, _ = image.project(np.array([content[track]["coordinates"]]))
            centre = np.array([image.camera.width_px, image.camera.height_px]) / 2
            away.append(np.linalg.norm(uv[0] - size * np.array([float(x), float(y)]) - centre))
    assert len(away) > 1000
    assert np.median(away) < 3.0, "of 3264 pixels"


def test_old_and_odm_layouts(shared_data):
    folder = shared_data / "sfm/opensfm/old_format"
    posed = read_posed_images(folder)
    assert posed.source_format == "opensfm" and len(posed) == 1
    assert any("separate reconstructions" in note for note in posed.notes)
    assert (posed.images[0].camera.width_px, posed.images[0].camera.height_px) == (1920, 1080)
    with pytest.raises(EmptyFileError, match="No image"):
        read_posed_images(shared_data / "sfm/odm_test_assets/reconstruction.json")


def test_a_folder_of_photos_alone_has_no_poses(shared_data):
    with pytest.raises(UnsupportedFormatError, match="no camera poses"):
        read_posed_images(shared_data / "sfm/opensfm/lund")
