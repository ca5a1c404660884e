"""COLMAP models: written here byte by byte, written by pycolmap, and real ones."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbh_studio.core.camera import CAMERA_KINDS
from dbh_studio.core.camera_models.lenses import LENSES
from dbh_studio.core.posed_images import fit_check
from dbh_studio.core.similarity_fit import fit_similarity
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import EmptyFileError, FileError, MalformedFileError, TruncatedFileError
from dbh_studio.io.posed import read_posed_images

QUATERNION = (0.5, -0.5, 0.5, 0.5)
NAMES = ("plot/frame_10.jpg", "plot/frame_9.jpg", "plot/frame_2.jpg")


def camera_line() -> tuple[str, int, int, tuple[float, ...]]:
    return "OPENCV", 2000, 1500, (1500.0, 1510.0, 1001.0, 749.0, -0.1, 0.02, 0.001, -0.001)


def write_binary(folder: Path, *, n_points: int = 3) -> Path:
    """One camera, three images, a few points."""
    folder.mkdir(parents=True, exist_ok=True)
    _, width, height, params = camera_line()
    cameras = struct.pack("<QIiQQ", 1, 7, 4, width, height) + struct.pack("<8d", *params)
    images = struct.pack("<Q", len(NAMES))
    for index, name in enumerate(NAMES):
        images += struct.pack("<I7dI", index + 1, *QUATERNION, index, 2.0, 3.0, 7) + name.encode() + b"\0"
        images += struct.pack("<Q", index) + struct.pack("<ddQ", 1.0, 2.0, 3) * index
    points = struct.pack("<Q", n_points)
    for index in range(n_points):
        points += struct.pack("<Q3d3Bd", index + 1, index, 2.0 * index, -1.0, 10, 20, 30 + index, 0.5 + index)
        points += struct.pack("<Q", index) + struct.pack("<II", 1, 0) * index
    for name, data in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.bin").write_bytes(data)
    return folder


def write_text(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    kind, width, height, params = camera_line()
    values = " ".join(map(str, params))
    (folder / "cameras.txt").write_text(f"# Camera list\n7 {kind} {width} {height} {values}\n")
    lines = ["# Image list with two lines of data per image:"]
    for index, name in enumerate(NAMES):
        pose = " ".join(map(str, (*QUATERNION, index, 2.0, 3.0)))
        lines += [f"{index + 1} {pose} 7 {name}", " ".join(["1.0 2.0 3"] * index)]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    points = [f"{i + 1} {i} {2.0 * i} -1.0 10 20 {30 + i} {0.5 + i}" + " 1 0" * i for i in range(3)]
    (folder / "points3D.txt").write_text("# 3D point list\n" + "\n".join(points) + "\n")
    return folder


@pytest.mark.parametrize("write", [write_binary, write_text])
def test_values_of_a_small_model(tmp_path, write):
    posed = read_posed_images(write(tmp_path / "sparse"))
    assert posed.source_format == "colmap" and posed.notes == ()
    assert [image.name for image in posed] == ["plot/frame_2.jpg", "plot/frame_9.jpg", "plot/frame_10.jpg"]
    assert [image.order for image in posed] == [0, 1, 2]
    image = posed.by_name("plot/frame_9.jpg")
    assert image.camera.kind == "OPENCV" and image.camera.params == camera_line()[3]
    expected = Rotation.from_quat([-0.5, 0.5, 0.5, 0.5]).as_matrix()
    assert np.allclose(image.cam_from_source.rotation, expected)
    assert np.allclose(image.cam_from_source.translation, [1.0, 2.0, 3.0])
    assert np.allclose(image.centre_src, -expected.T @ [1.0, 2.0, 3.0])
    assert np.allclose(posed.sparse_points_src, [[0, 0, -1], [1, 2, -1], [2, 4, -1]])
    assert posed.sparse_rgb.tolist() == [[10, 20, 30], [10, 20, 31], [10, 20, 32]]
    assert posed.reprojection_error_px == pytest.approx(1.5)
    with pytest.raises(KeyError):
        posed.by_name("plot/frame_1.jpg")


@pytest.mark.parametrize("write", [write_binary, write_text])
@pytest.mark.parametrize("below", ["", "sparse/0", "project/colmap/sparse/0"])
def test_the_folder_above_is_enough(tmp_path, write, below):
    write(tmp_path / below)
    assert len(read_posed_images(tmp_path)) == 3


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_any_file_of_the_model_is_enough(tmp_path, name):
    write_binary(tmp_path)
    assert len(read_posed_images(tmp_path / f"{name}.bin")) == 3


def test_the_model_with_the_most_images_is_read_and_said(tmp_path):
    write_binary(tmp_path / "sparse/0")
    small = write_binary(tmp_path / "sparse/1")
    data = (small / "images.bin").read_bytes()
    second = data.index(b"frame_10.jpg\0") + len(b"frame_10.jpg\0") + 8
    (small / "images.bin").write_bytes(struct.pack("<Q", 1) + data[8:second])
    assert len(read_posed_images(small)) == 1
    posed = read_posed_images(tmp_path)
    assert len(posed) == 3
    assert "sparse/1" in posed.notes[0]


def test_points_are_not_needed(tmp_path):
    folder = write_binary(tmp_path)
    (folder / "points3D.bin").unlink()
    posed = read_posed_images(folder)
    assert posed.sparse_points_src is None and posed.reprojection_error_px is None
    assert "points3D.bin" in posed.notes[0]
    write_binary(tmp_path, n_points=0)
    assert read_posed_images(folder).sparse_points_src is None


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_file_cut_anywhere_is_named(tmp_path, name):
    folder = write_binary(tmp_path)
    whole = (folder / name).read_bytes()
    for length in range(1, len(whole)):
        (folder / name).write_bytes(whole[:length])
        with pytest.raises(MalformedFileError) as caught:
            read_posed_images(folder)
        assert caught.value.path.name == name
    (folder / name).write_bytes(b"")
    with pytest.raises(EmptyFileError):
        read_posed_images(folder)


@pytest.mark.parametrize("write,suffix", [(write_binary, ".bin"), (write_text, ".txt")])
def test_damaged_bytes_end_in_a_message_or_in_finite_values(tmp_path, write, suffix, rng):
    folder = write(tmp_path)
    for name in ("cameras", "images", "points3D"):
        path = folder / f"{name}{suffix}"
        whole = bytearray(path.read_bytes())
        for _ in range(150):
            damaged = bytearray(whole)
            for at in rng.integers(0, len(damaged), 3):
                damaged[at] = rng.integers(0, 256)
            path.write_bytes(damaged)
            try:
                posed = read_posed_images(folder)
            except FileError as error:
                assert str(error)
            else:
                assert np.isfinite(posed.centres_src).all()
        path.write_bytes(whole)


def test_a_huge_count_is_refused_before_memory_is_asked_for(tmp_path):
    folder = write_binary(tmp_path)
    data = (folder / "points3D.bin").read_bytes()
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 1 << 60) + data[8:])
    with pytest.raises(TruncatedFileError, match="promises"):
        read_posed_images(folder)


@pytest.mark.parametrize(
    "name,text",
    [
        ("cameras.txt", "7 OPENCV wide 1500 1 2 3\n"),
        ("images.txt", "1 0.5 0.5 0.5\n\n"),
        ("points3D.txt", "1 2 3\n"),
        ("points3D.txt", "1 a b c 1 2 3 0.1\n"),
    ],
)
def test_a_bad_line_is_named(tmp_path, name, text):
    folder = write_text(tmp_path)
    (folder / name).write_text("# comment\n" + text)
    with pytest.raises(MalformedFileError, match="Line 2") as caught:
        read_posed_images(folder)
    assert caught.value.path.name == name


def test_images_of_an_unusable_camera_are_left_out_and_counted(tmp_path):
    folder = write_text(tmp_path)
    (folder / "cameras.txt").write_text("7 FISHEYE_OF_TOMORROW 10 10 1 2 3\n")
    with pytest.raises(EmptyFileError, match="3 images were left out: the camera model FISHEYE_OF_TOMORROW"):
        read_posed_images(folder)
    (folder / "cameras.txt").write_text("8 PINHOLE 10 10 1 2 3 4\n")
    with pytest.raises(EmptyFileError, match="not in the file"):
        read_posed_images(folder)


def test_an_unknown_binary_model_is_an_error(tmp_path):
    folder = write_binary(tmp_path)
    data = bytearray((folder / "cameras.bin").read_bytes())
    data[12:16] = struct.pack("<i", 99)
    (folder / "cameras.bin").write_bytes(data)
    with pytest.raises(MalformedFileError, match="99"):
        read_posed_images(folder)


# -- written by pycolmap -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pycolmap():
    module = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    if not hasattr(module, "Rig"):
        pytest.skip("this pycolmap has no rigs")
    return module


def rig_reconstruction(pycolmap):
    """Two cameras on a rig, three frames, and a lone camera."""
    model = pycolmap.Reconstruction()
    rng = np.random.default_rng(5)

    def rigid():
        return pycolmap.Rigid3d(pycolmap.Rotation3d(Rotation.random(random_state=rng).as_quat()), rng.normal(size=3))

    for camera_id, kind in ((1, "EQUIRECTANGULAR"), (2, "OPENCV_FISHEYE")):
        model.add_camera(pycolmap.Camera.create_from_model_name(camera_id, kind, 500.0, 2000, 1000))
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1))
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2), rigid())
    model.add_rig(rig)
    for frame_id in (1, 2, 3):
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=1)
        frame.rig_from_world = rigid()
        images = []
        for camera_id in (1, 2):
            image_id = 10 * frame_id + camera_id
            image = pycolmap.Image(image_id=image_id, camera_id=camera_id, name=f"cam{camera_id}/{frame_id}.jpg")
            image.frame_id = frame_id
            frame.add_data_id(image.data_id)
            images.append(image)
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(frame_id)
    model.add_point3D(np.array([1.0, 2.0, 3.0]), pycolmap.Track(), np.array([1, 2, 3], np.uint8))
    return model


@pytest.mark.parametrize("write", ["write_binary", "write_text"])
def test_rigs_and_frames_as_pycolmap_writes_them(pycolmap, tmp_path, write):
    model = rig_reconstruction(pycolmap)
    getattr(model, write)(str(tmp_path))
    posed = read_posed_images(tmp_path)
    assert len(posed) == 6
    for image in model.images.values():
        expected = image.cam_from_world()
        ours = posed.by_name(image.name)
        assert np.allclose(ours.cam_from_source.rotation, expected.rotation.matrix(), atol=1e-12)
        assert np.allclose(ours.cam_from_source.translation, expected.translation, atol=1e-12)
        assert ours.camera.kind == model.cameras[image.camera_id].model.name
    assert np.allclose(posed.sparse_points_src, [[1.0, 2.0, 3.0]])


def test_frames_decide_over_the_poses_beside_the_names(pycolmap, tmp_path):
    """As in COLMAP: where there are frames, the pose in the image's own line is not used; without frames it is."""
    rig_reconstruction(pycolmap).write_text(str(tmp_path))
    with_rigs = read_posed_images(tmp_path)
    lines = (tmp_path / "images.txt").read_text().splitlines()
    for index, line in enumerate(lines):
        fields = line.split()
        if line.endswith(".jpg"):
            lines[index] = " ".join([fields[0], "1 0 0 0 7 8 9", *fields[8:]])
    (tmp_path / "images.txt").write_text("\n".join(lines) + "\n")
    for image in read_posed_images(tmp_path):
        assert np.allclose(image.centre_src, with_rigs.by_name(image.name).centre_src, atol=1e-12)
    (tmp_path / "frames.txt").unlink()
    for image in read_posed_images(tmp_path):
        assert np.allclose(image.centre_src, [-7.0, -8.0, -9.0])


@pytest.mark.parametrize("kind", [kind for kind in CAMERA_KINDS if not kind.startswith(("METASHAPE", "OPENSFM"))])
@pytest.mark.parametrize("write", ["write_binary", "write_text"])
def test_every_camera_model_as_pycolmap_writes_it(pycolmap, tmp_path, kind, write):
    if kind not in pycolmap.CameraModelId.__members__:
        pytest.skip(f"this pycolmap does not know {kind}")
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, kind, 700.0, 1600, 800)
    model.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image(image_id=1, camera_id=1, name="a.jpg")
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    getattr(model, write)(str(tmp_path))
    ours = read_posed_images(tmp_path).by_name("a.jpg").camera
    assert ours.kind == kind and len(ours.params) == len(LENSES[kind].names)
    assert np.allclose(ours.params, camera.params, rtol=1e-15)


# -- real files ----------------------------------------------------------------------------------------------------

SCEAUX = {
    "colmap_example_model_bin": (0.0, 1e-9),
    "colmap_example_model_txt": (1e-6, 1e-4),
    "colmap_example_model_not_shared_txt": (3e-3, 0.3),
    "OpenSfM_example_meshed.json": (5e-3, 1.5),
}


def largest_angle_deg(a, b):
    turns = [x.cam_from_source.rotation @ b.by_name(x.name).cam_from_source.rotation.T for x in a]
    return max(np.degrees(Rotation.from_matrix(turn).magnitude()) for turn in turns)


@pytest.mark.parametrize("name", SCEAUX)
def test_sceaux_is_the_same_scene_in_every_format(shared_data, name):
    """Text is rounded to six digits; the other two are separate solutions of the same photos, with their own focal."""
    relative, angle_deg = SCEAUX[name]
    folder = shared_data / "sfm/sceaux_castle"
    reference = read_posed_images(folder / "colmap_example_model_bin")
    posed = read_posed_images(folder / name)
    assert [image.name for image in posed] == [image.name for image in reference]
    assert all(image.path and Path(image.path).is_file() for image in posed)
    to_reference, rms = fit_similarity(posed.centres_src, reference.centres_src)
    extent = np.linalg.norm(np.ptp(reference.centres_src, axis=0))
    assert rms <= relative * extent + 1e-12
    assert largest_angle_deg(posed.moved(to_reference), reference) <= angle_deg + 1e-5
    points = to_reference.apply(posed.sparse_points_src)
    middle = np.median(reference.sparse_points_src, axis=0)
    assert np.linalg.norm(np.median(points, axis=0) - middle) < 0.05 * extent


@pytest.mark.parametrize(
    "model",
    [
        "sfm/sceaux_castle/colmap_example_model_bin",
        "sfm/sceaux_castle/colmap_example_model_not_shared_txt",
        "synthetic_360/colmap_equirectangular",
    ],
)
def test_every_point_reprojects_with_the_error_its_file_states(pycolmap, shared_data, model):
    """The observations come from pycolmap, poses and pixels from here; the file holds each point's mean error."""
    theirs = pycolmap.Reconstruction(str(shared_data / model))
    posed = read_posed_images(shared_data / model)
    errors: dict[int, list[float]] = {}
    for image in theirs.images.values():
        seen = [point for point in image.points2D if point.has_point3D()]
        points = np.array([theirs.points3D[point.point3D_id].xyz for point in seen])
        ours = posed.by_name(image.name)
        observed = np.array([point.xy for point in seen])
        pixels, is_visible = ours.project(points)
        assert is_visible.all()
        away = np.linalg.norm(pixels - observed, axis=1)
        if ours.camera.is_panorama:
            # COLMAP states a panorama's error as an angle, in pixels at the horizon.
            chord = np.linalg.norm(ours.ray(pixels)[1] - ours.ray(observed)[1], axis=1)
            away = 2.0 * np.arcsin(chord / 2.0) * ours.camera.width_px / (2.0 * np.pi)
        for point, error in zip(seen, away, strict=True):
            errors.setdefault(point.point3D_id, []).append(float(error))
    found = np.array([np.mean(values) for values in errors.values()])
    stated = np.array([theirs.points3D[point_id].error for point_id in errors])
    # Text files and old versions of COLMAP state six digits; the coordinates of a text file have as many.
    tolerance = 0.02 if model.endswith("txt") else 1e-4
    assert np.quantile(np.abs(found - stated), 0.999) < tolerance
    assert posed.reprojection_error_px == pytest.approx(stated.mean(), rel=1e-6)
    assert posed.reprojection_error_px == pytest.approx(theirs.compute_mean_reprojection_error(), rel=1e-6)


@pytest.fixture(scope="module")
def world_from_model(request):
    folder = Path(__file__).parents[2].parent / "shared" / "data" / "synthetic_360"
    if not folder.is_dir():
        pytest.skip("the folder shared/data with real files is not beside the project")
    truth = json.loads((folder / "world_from_model.json").read_text())
    rotation = Rotation.from_quat(truth["rotation_xyzw"]).as_matrix()
    return Similarity(rotation, np.array(truth["translation"]), truth["metres_per_unit"])


def test_panoramas_stand_where_they_were_rendered(shared_data, world_from_model):
    folder = shared_data / "synthetic_360"
    posed = read_posed_images(folder).moved(world_from_model)
    truth = {Path(f["file"]).name: f for f in json.loads((folder / "poses_gt.json").read_text())["frames"]}
    assert len(posed) == 64 and set(truth) >= {image.name for image in posed}
    off_m = np.array([np.linalg.norm(image.centre_src - truth[image.name]["C"]) for image in posed])
    assert off_m.max() < 0.01 and np.sqrt((off_m**2).mean()) < 0.004
    turned = [
        Rotation.from_matrix(np.array(truth[i.name]["R_wc"]) @ i.cam_from_source.rotation).magnitude() for i in posed
    ]
    assert np.degrees(max(turned)) < 0.1


def test_marker_corners_appear_where_the_truth_says(shared_data, world_from_model):
    """The corners' true pixels from the true poses, against ours from the model's own frame: rays included."""
    folder = shared_data / "synthetic_360"
    posed = read_posed_images(folder)
    truth = json.loads((folder / "poses_gt.json").read_text())
    true_poses = {Path(f["file"]).name: f for f in truth["frames"]}
    corners = np.concatenate(
        [np.array(marker["corners_TL_TR_BR_BL"], float).reshape(-1, 3) for marker in truth["markers"]]
    )
    in_model = world_from_model.inverse().apply(corners)
    worst = []
    for image in posed:
        frame = true_poses[image.name]
        expected, _ = image.camera.project((corners - frame["C"]) @ np.array(frame["R_wc"]))
        pixels, _ = image.project(in_model)
        away = np.abs(pixels - expected)
        worst.append(np.minimum(away[:, 0], image.camera.width_px - away[:, 0]).max())
        origin, directions = image.ray(pixels)
        along = in_model - origin
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        assert np.abs(along - directions).max() < 1e-9
    assert np.median(worst) < 2.0, "a pixel is 0.18 degrees; the poses are good to 3 mm and 0.06 degrees"


def test_the_dense_cloud_fits_its_photos_and_not_when_moved(shared_data, world_from_model):
    from dbh_studio.io.reader import read_reconstruction

    folder = shared_data / "synthetic_360"
    posed = read_posed_images(folder)
    cloud = read_reconstruction(folder / "dense_unscaled.ply").cloud
    sample = cloud.xyz[::40] + cloud.origin
    assert fit_check(sample, posed).status == "fits"
    plot = sample[(np.abs(sample - np.median(sample, axis=0)) < 1.5).all(axis=1)]
    assert fit_check(plot, posed).status == "fits", "a plot cut out of the cloud"
    assert fit_check(world_from_model.apply(sample), posed).status == "moved"
    assert fit_check(world_from_model.apply(sample), posed.moved(world_from_model)).status == "fits"
    for axis in np.eye(3):
        assert fit_check(sample + 0.1 * axis, posed).status == "moved", "0.1 units are 13 cm"
        assert fit_check(sample - 0.1 * axis, posed).status == "moved"
    assert fit_check(1.02 * sample, posed).status == "moved"
