"""Markers in rendered and in real photos. The thirty-plot study is bench/marker_accuracy.py."""

import builtins
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.synthetic.marker_plot import marker_plot, world_rays
from dbh_studio.core.synthetic.marker_scene import MarkerBoard, MarkerScene, noise_texture, render
from dbh_studio.core.synthetic.picture_flaws import PictureFlaws
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import CancelledError, FileMissingError, MissingComponentError, SettingError
from dbh_studio.io.marker_codes import FAMILIES, known_name, marker_bits, smallest_dictionary
from dbh_studio.settings import MarkerSettings
from dbh_studio.stages.marker_fit import fit_marker
from dbh_studio.stages.markers import (
    Detection,
    check_marker,
    find_markers,
    frame_from_marker,
    measure_scale,
    scale_from_markers,
    triangulate_markers,
)

pytest.importorskip("cv2")

FLAT, UPRIGHT = ("DICT_4X4_50", 7), ("DICT_APRILTAG_36h11", 3)
SIDES_M = {FLAT: 1.0, UPRIGHT: 0.5}
NAMED = MarkerSettings(dictionaries=(FLAT[0], UPRIGHT[0]))
PHOTOS = Path(__file__).parents[2].parent / "shared" / "data" / "aruco_photo"
UPRIGHT_CAMERA = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@pytest.fixture(scope="module", params=[101, 103])
def walk(request):
    codes = [(key, marker_bits(*key), SIDES_M[key]) for key in (FLAT, UPRIGHT)]
    plot = marker_plot(request.param, codes, n_photos=7, width_px=1536, reach_m=(1.8, 3.5))
    detections = find_markers(plot.posed, settings=NAMED, read_image=plot.read)
    return plot, detections, triangulate_markers(detections, plot.posed, settings=NAMED)


def test_the_scale_of_a_plot(walk):
    plot, detections, markers = walk
    assert {d.key for d in detections} <= set(SIDES_M)
    assert FLAT in {m.key for m in markers}
    for chosen in ([m for m in markers if m.key == FLAT], markers):
        report = scale_from_markers(chosen, SIDES_M)
        relative = report.estimate.metres_per_unit / plot.metres_per_unit - 1
        assert abs(relative) < 0.003
        assert abs(relative) < 2.5 * report.estimate.standard_error / plot.metres_per_unit
        assert report.estimate.standard_error / plot.metres_per_unit < 0.004
        assert report.estimate.source == "marker"
        names = {residual.name for residual in report.residuals}
        assert report.n_views == min(len(m.views_used) for m in chosen if m.name in names)


def test_up_origin_and_north_come_from_the_flat_marker(walk):
    plot, _, markers = walk
    board = plot.scene.boards[0]
    up, origin, north = frame_from_marker(next(m for m in markers if m.key == FLAT))
    world = plot.source_from_world_rotation
    assert up @ world @ np.cross(board.down, board.right) > np.cos(np.radians(0.5))
    assert north @ world @ -board.down > np.cos(np.radians(0.5))
    assert abs(up @ north) < 1e-12
    assert np.linalg.norm(origin - world @ board.centre_m / plot.metres_per_unit) * plot.metres_per_unit < 0.01


def test_a_crop_and_a_confidence_come_with_each_sight(walk):
    _, detections, _ = walk
    for detection in detections:
        assert detection.crop.shape == (96, 96, 3) and detection.crop.dtype == np.uint8
        bits = np.pad(marker_bits(*detection.key), 1, constant_values=True)
        cells = np.linspace(0.14 * 96, 0.86 * 96, len(bits) - 1)
        middle = np.round((cells[1:] + cells[:-1]) / 2).astype(int)
        seen = detection.crop[np.ix_(middle, middle)].mean(axis=2)
        assert np.corrcoef(seen.ravel(), bits[1:-1, 1:-1].ravel())[0, 1] > 0.7
        assert 0.8 <= detection.confidence <= 1.0


def test_a_wrong_pose_is_left_out_whole(walk):
    plot, detections, markers = walk
    before = next(m for m in markers if m.key == FLAT)
    victim = before.views_used[0]
    turned = Rotation.from_rotvec([0.0, 0.05, 0.0]).as_matrix()
    images = tuple(
        PosedImage(
            image.name,
            image.camera,
            Similarity(turned @ image.cam_from_source.rotation, turned @ image.cam_from_source.translation)
            if image.name == victim
            else image.cam_from_source,
        )
        for image in plot.posed
    )
    after = next(m for m in triangulate_markers(detections, PosedImages(images)) if m.key == FLAT)
    assert victim in after.views_rejected
    assert after.side_src == pytest.approx(before.side_src, rel=0.003)


def test_what_the_person_hears_when_it_cannot_be(walk):
    plot, detections, markers = walk
    flat = next(m for m in markers if m.key == FLAT)
    assert scale_from_markers([]).verdict.code == "no_marker"
    assert scale_from_markers(markers, {FLAT: 0.0}).verdict.code == "no_length"
    assert scale_from_markers(markers, {FLAT: float("nan")}).verdict.code == "no_length"
    one = [d for d in detections if d.key == FLAT][:1]
    assert triangulate_markers(one, plot.posed) == ()
    alone = scale_from_markers([], seen_once=[FLAT])
    assert alone.verdict.code == "one_view" and "DICT_4X4_50 7" in alone.verdict.message
    assert check_marker(flat) is None


def test_mirrored_poses_are_refused(walk):
    plot, detections, _ = walk
    # A reconstruction in a left-handed frame, its cameras turned to match.
    flip = np.diag([1.0, 1.0, -1.0])
    mirrored = [
        Detection(
            d.image,
            d.dictionary,
            d.marker_id,
            np.column_stack([plot.posed.images[0].camera.width_px - d.corners_px[:, 0], d.corners_px[:, 1]]),
            d.confidence,
            d.crop,
            d.sigma_px,
            d.pixel_rad,
            d.blur_px,
        )
        for d in detections
        if d.key == FLAT
    ]
    images = []
    across = np.diag([-1.0, 1.0, 1.0])
    for image in plot.posed:
        rotation = across @ image.cam_from_source.rotation @ flip
        images.append(
            PosedImage(image.name, image.camera, Similarity(rotation, -(rotation @ (flip @ image.centre_src))))
        )
    report = scale_from_markers(triangulate_markers(mirrored, PosedImages(tuple(images))))
    assert report.estimate is None
    assert report.verdict.code == "mirrored"


def exact_sights(corners_m, n=8, wrong=()):
    """Detections of given corners in true panoramas round them."""
    camera = CameraModel("EQUIRECTANGULAR", 4096, 2048, ())
    images, detections = [], []
    for number in range(n):
        angle = 2 * np.pi * number / n
        centre = np.array([3 * np.cos(angle), 3 * np.sin(angle), 2.0])
        image = PosedImage(f"{number}.jpg", camera, Similarity(UPRIGHT_CAMERA, -(UPRIGHT_CAMERA @ centre)))
        uv, _ = image.project(np.asarray(corners_m, float))
        images.append(image)
        crop = np.zeros((2, 2, 3), np.uint8)
        detections.append(Detection(image.name, *FLAT, uv, 1.0, crop, 0.02, 2 * np.pi / 4096, 0.6))
    return detections, PosedImages(tuple(images))


SQUARE = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])


def test_exact_corners_give_the_exact_side_and_frame():
    (marker,) = triangulate_markers(*exact_sights(SQUARE))
    assert np.abs(marker.corners_src - SQUARE).max() < 1e-9
    assert marker.sides_src == pytest.approx([1, 1, 1, 1])
    assert marker.diagonals_src == pytest.approx([2**0.5, 2**0.5])
    up, origin, north = frame_from_marker(marker)
    assert np.allclose(up, [0, 0, 1]) and np.allclose(north, [0, 1, 0]) and np.allclose(origin, 0, atol=1e-9)
    report = scale_from_markers([marker], {FLAT: 2.5})
    assert report.estimate.metres_per_unit == pytest.approx(2.5)
    # Nothing is exact: what blur leaves and the ruler's half millimetre stay.
    assert report.estimate.standard_error / 2.5 >= 0.0002


@pytest.mark.parametrize("bent", [[0.1, 0, 0, 0], [0.05, -0.05, 0.05, -0.05]])
def test_a_marker_bent_round_a_trunk_is_refused(bent):
    (marker,) = triangulate_markers(*exact_sights(SQUARE + np.column_stack([np.zeros((4, 2)), bent])))
    assert check_marker(marker).code == "bent"
    assert scale_from_markers([marker]).estimate is None


def test_a_rectangle_is_no_marker():
    (marker,) = triangulate_markers(*exact_sights(SQUARE * (1.0, 0.9, 1.0)))
    assert check_marker(marker).code == "bent"


def test_one_number_at_two_places_gives_two_markers_and_a_warning():
    here, posed = exact_sights(SQUARE)
    there, _ = exact_sights(SQUARE + (1.5, 0.3, 0))
    markers = triangulate_markers(here + there, posed)
    assert len(markers) == 2
    assert scale_from_markers(markers).verdict.code == "twice"


def test_photos_from_one_place_give_no_marker():
    detections, posed = exact_sights(SQUARE, n=1)
    twin = PosedImage("again.jpg", posed.images[0].camera, posed.images[0].cam_from_source)
    first = detections[0]
    again = Detection("again.jpg", *FLAT, first.corners_px, 1.0, first.crop, 0.02, first.pixel_rad, 0.6)
    assert triangulate_markers([first, again], PosedImages((posed.images[0], twin))) == ()


def board(key, side_m, centre, right, down):
    return MarkerBoard(
        key, marker_bits(*key), side_m, np.array(centre, float), np.array(right, float), np.array(down, float)
    )


def test_neither_the_seam_nor_a_pole_loses_a_marker():
    rng = np.random.default_rng(0)
    scene = MarkerScene(
        (
            board(FLAT, 1.0, [0.1, -0.1, 0.01], [1, 0, 0], [0, -1, 0]),
            board(UPRIGHT, 0.5, [0.0, -2.0, 1.5], [-1, 0, 0], [0, 0, -1]),
            board(("DICT_5X5_50", 4), 0.6, [0.1, 0.0, 3.2], [1, 0, 0], [0, 1, 0]),
        ),
        np.zeros((0, 3)),
        np.zeros(2),
        noise_texture(rng, 256),
    )
    camera = CameraModel("EQUIRECTANGULAR", 1536, 768, ())
    centre = np.array([0.0, 0.0, 1.7])
    picture = render(scene, world_rays(camera, UPRIGHT_CAMERA), centre, (1536, 768), PictureFlaws(), wraps=True)
    photo = PosedImage("a.jpg", camera, Similarity(UPRIGHT_CAMERA, -(UPRIGHT_CAMERA @ centre)))
    settings = MarkerSettings(dictionaries=(FLAT[0], UPRIGHT[0], "DICT_5X5_50"))
    found = {d.key: d for d in find_markers(PosedImages((photo,)), settings=settings, read_image=lambda _: picture)}
    assert set(found) == {b.key for b in scene.boards}
    for one in scene.boards:
        origin, rays = photo.ray(found[one.key].corners_px)
        towards = one.corners_m - origin
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        off_px = np.linalg.norm(rays - towards, axis=1) / (2 * np.pi / 1536)
        assert off_px.max() < 0.15


def test_a_number_that_the_first_look_lacks_is_found_all_the_same():
    """Of thirteen photos all but the last but one are looked at first; in these, DICT_4X4_50 would be enough."""
    camera = CameraModel("PINHOLE", 320, 320, (300.0, 300.0, 160.0, 160.0))
    shown = {f"{number}.jpg": np.full((320, 320, 3), 128, np.uint8) for number in range(13)}
    expected = [("0.jpg", FLAT), ("11.jpg", ("DICT_4X4_250", 201))]
    for name, key in expected:
        one = board(key, 1.0, [0.0, 0.0, 4.0], [1, 0, 0], [0, 1, 0])
        scene = MarkerScene((one,), np.zeros((0, 3)), np.zeros(2), noise_texture(np.random.default_rng(0), 64))
        rays = world_rays(camera, np.eye(3))
        shown[name] = render(scene, rays, np.zeros(3), (320, 320), PictureFlaws(), wraps=False)
    posed = PosedImages(tuple(PosedImage(name, camera, Similarity.identity()) for name in shown))
    found = find_markers(posed, read_image=lambda photo: shown[photo.name])
    assert [(d.image, d.key) for d in found] == expected


@pytest.mark.parametrize("linear_light", [True, False])
@pytest.mark.parametrize("blur_px", [0.4, 1.2])
def test_blur_does_not_move_the_corners_inwards(linear_light, blur_px):
    camera = CameraModel("PINHOLE", 320, 320, (300.0, 300.0, 160.0, 160.0))
    turn = Rotation.from_euler("xy", [35, 20], degrees=True).as_matrix()
    one = board(UPRIGHT, 1.0, [0.0, 0.0, 4.0], turn[:, 0], turn[:, 1])
    scene = MarkerScene((one,), np.zeros((0, 3)), np.zeros(2), noise_texture(np.random.default_rng(0), 64))
    flaws = PictureFlaws(blur_px=blur_px, linear_light=linear_light, noise=1.5, jpeg_quality=92)
    picture = render(scene, world_rays(camera, np.eye(3)), np.zeros(3), (320, 320), flaws, wraps=False)
    true, _ = camera.project(one.corners_m)
    fit = fit_marker(picture[:, :, 0], camera, true + (0.8, -0.6), one.bits)
    from_middle = true - true.mean(axis=0)
    too_large = ((fit.corners_px - true) * from_middle).sum() / (from_middle**2).sum()
    assert abs(too_large) < 0.002
    assert np.linalg.norm(fit.corners_px - true, axis=1).max() < 0.12
    assert fit.correlation > 0.98


def test_another_code_does_not_match():
    camera = CameraModel("PINHOLE", 320, 320, (300.0, 300.0, 160.0, 160.0))
    one = board(FLAT, 1.0, [0.0, 0.0, 4.0], [1, 0, 0], [0, 1, 0])
    scene = MarkerScene((one,), np.zeros((0, 3)), np.zeros(2), noise_texture(np.random.default_rng(0), 64))
    picture = render(scene, world_rays(camera, np.eye(3)), np.zeros(3), (320, 320), PictureFlaws(), wraps=False)
    true, _ = camera.project(one.corners_m)
    wrong = [fit_marker(picture[:, :, 0], camera, true, marker_bits(FLAT[0], i)) for i in range(8, 14)]
    assert all(fit is None or fit.correlation < 0.8 for fit in wrong)


def real_photo(name):
    path = PHOTOS / name
    if not path.exists():
        pytest.skip("the photo is not in shared/data/aruco_photo")
    from PIL import Image

    picture = np.array(Image.open(path).convert("RGB"))
    height, width = picture.shape[:2]
    camera = CameraModel("SIMPLE_PINHOLE", width, height, (1.2 * max(width, height), width / 2, height / 2))
    return PosedImages((PosedImage(name, camera, Similarity.identity()),)), picture


@pytest.mark.parametrize("dictionaries", [("DICT_4X4_50",), ()])
def test_the_real_marker_is_found(dictionaries):
    posed, picture = real_photo("acuro_36.jpg")
    settings = MarkerSettings(dictionaries=dictionaries)
    found = find_markers(posed, settings=settings, read_image=lambda _: picture)
    assert [d.key for d in found] == [("DICT_4X4_50", 36)]
    report = measure_scale(posed, settings=settings, read_image=lambda _: picture).report
    assert report.verdict.code == "one_view"


def test_a_photo_without_a_marker_has_none():
    posed, picture = real_photo("tree_02.jpg")
    result = measure_scale(posed, read_image=lambda _: picture)
    assert result.detections == ()
    assert result.report.verdict.code == "no_marker"


def test_a_resized_picture_gives_corners_of_the_photo():
    posed, picture = real_photo("acuro_36.jpg")
    half = np.ascontiguousarray(picture[::2, ::2])
    settings = MarkerSettings(dictionaries=("DICT_4X4_50",))
    (whole,) = find_markers(posed, settings=settings, read_image=lambda _: picture)
    (small,) = find_markers(posed, settings=settings, read_image=lambda _: half)
    assert np.abs(small.corners_px - whole.corners_px).max() < 2.0
    with pytest.raises(ValueError, match="no resized"):
        find_markers(posed, settings=settings, read_image=lambda _: picture[:100])


def one_blank_photo():
    camera = CameraModel("SIMPLE_PINHOLE", 64, 64, (60.0, 32.0, 32.0))
    images = [PosedImage(f"{i}.jpg", camera, Similarity.identity()) for i in range(3)]
    return PosedImages(tuple(images)), np.full((64, 64, 3), 128, np.uint8)


def test_lost_photos_and_cancelling():
    posed, picture = one_blank_photo()

    def lost(photo):
        raise FileMissingError(photo.name, "gone")

    with pytest.raises(FileMissingError):
        find_markers(posed, read_image=lost, settings=NAMED)
    calls = []
    assert find_markers(posed, settings=NAMED, read_image=lambda p: picture if p.name != "1.jpg" else lost(p)) == ()
    find_markers(posed, settings=NAMED, read_image=lambda _: picture, progress=lambda f, m="": calls.append(f))
    assert calls == sorted(calls) and calls[-1] == 1.0

    def cancel(fraction, message=""):
        raise CancelledError

    with pytest.raises(CancelledError):
        find_markers(posed, settings=NAMED, read_image=lambda _: picture, progress=cancel)
    assert measure_scale(PosedImages(()), read_image=lost).report.verdict.code == "no_marker"


def test_names_of_dictionaries():
    assert known_name("4x4_50") == "DICT_4X4_50" and known_name("dict_apriltag_36H11") == "DICT_APRILTAG_36h11"
    assert smallest_dictionary("DICT_4X4_1000", 36) == "DICT_4X4_50"
    assert smallest_dictionary("DICT_4X4_1000", 120) == "DICT_4X4_250"
    assert smallest_dictionary("DICT_APRILTAG_36h11", 3) == "DICT_APRILTAG_36h11"
    for family in FAMILIES:
        for name in family:
            assert np.array_equal(marker_bits(name, 11), marker_bits(family[0], 11))
    with pytest.raises(SettingError, match="no marker dictionary"):
        marker_bits("DICT_9X9", 0)
    with pytest.raises(SettingError, match="0 to 49"):
        marker_bits("DICT_4X4_50", 50)


def test_without_opencv_the_line_to_install_it_is_given(monkeypatch):
    posed, picture = one_blank_photo()
    original = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "cv2":
            raise ImportError(name)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingComponentError, match="pip install opencv-python-headless"):
        find_markers(posed, settings=NAMED, read_image=lambda _: picture)
