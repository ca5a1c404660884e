"""What the person hears where markers give no scale, or a doubtful one; and the pictures shown of each find."""

import weakref
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.synthetic.marker_plot import world_rays
from dbh_studio.core.synthetic.marker_scene import MarkerBoard, MarkerScene, WrappedMarker, noise_texture, render
from dbh_studio.core.synthetic.picture_flaws import PictureFlaws
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import CancelledError
from dbh_studio.io.marker_codes import marker_bits
from dbh_studio.settings import MarkerSettings
from dbh_studio.stages.markers import (
    Detection,
    detection_crop,
    find_markers,
    measure_scale,
    scale_from_detections,
    scale_from_markers,
    triangulate_markers,
)

pytest.importorskip("cv2")

LEVEL = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
PANORAMA = CameraModel("EQUIRECTANGULAR", 4096, 2048, ())
FIRST, SECOND, THIRD = ("DICT_4X4_50", 7), ("DICT_4X4_50", 8), ("DICT_APRILTAG_36h11", 3)
SQUARE = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])


def photos(n=8):
    """Panoramas round the origin, at heights that differ."""
    images = []
    for number in range(n):
        angle = 2 * np.pi * number / n
        centre = np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.7 + 0.1 * (number % 4)])
        images.append(PosedImage(f"{number}.jpg", PANORAMA, Similarity(LEVEL, -(LEVEL @ centre))))
    return PosedImages(tuple(images))


def sights(key, corners_m, posed):
    """What is detected of a marker with these corners."""
    crop = np.zeros((2, 2, 3), np.uint8)
    return [
        Detection(image.name, *key, image.project(corners_m)[0], 1.0, crop, 0.02, 2 * np.pi / 4096, 0.6)
        for image in posed
    ]


def moved(side_m, x_m):
    return SQUARE * side_m + (x_m, 0.0, 0.0)


def test_nothing_found_and_seen_once():
    posed = photos()
    assert scale_from_detections((), posed).report.verdict.code == "no_marker"
    once = scale_from_detections(sights(FIRST, SQUARE, posed)[:1], posed).report
    assert once.estimate is None
    assert once.verdict.code == "one_view" and "DICT_4X4_50 7" in once.verdict.message and once.verdict.remedy


def test_two_markers_of_different_size_given_one_side():
    posed = photos()
    found = sights(FIRST, moved(1.0, -0.8), posed) + sights(SECOND, moved(0.5, 0.8), posed)
    report = scale_from_detections(found, posed).report
    assert report.estimate is None
    assert (report.verdict.level, report.verdict.code) == ("refused", "contradict")
    for said in ("DICT_4X4_50 7", "DICT_4X4_50 8", "0.500 m"):
        assert said in report.verdict.message
    right = scale_from_detections(found, posed, {SECOND: 0.5}).report
    assert right.estimate.metres_per_unit == pytest.approx(1.0, rel=1e-3)


def test_two_markers_that_differ_a_little_give_a_wide_error():
    posed = photos()
    found = sights(FIRST, moved(1.0, -0.8), posed) + sights(SECOND, moved(0.5, 0.8), posed)
    report = scale_from_detections(found, posed, {FIRST: 1.0, SECOND: 0.515}).report
    assert (report.verdict.level, report.verdict.code) == ("caution", "inconsistent")
    assert report.estimate.standard_error / report.estimate.metres_per_unit > 0.005


def test_among_three_the_one_of_another_size_is_named_and_left_out():
    posed = photos()
    found = sights(FIRST, moved(1.0, -1.3), posed) + sights(SECOND, moved(0.4, 0.0), posed)
    found += sights(THIRD, moved(1.0, 1.3), posed)
    report = scale_from_detections(found, posed).report
    assert report.estimate.metres_per_unit == pytest.approx(1.0, rel=1e-3)
    assert (report.verdict.level, report.verdict.code) == ("caution", "other_size")
    assert "DICT_4X4_50 8 measures 0.400 m" in report.verdict.message
    assert [residual.name for residual in report.residuals] == ["DICT_4X4_50 7", "DICT_APRILTAG_36h11 3"]


def test_a_marker_whose_side_was_given_wins_over_one_that_nobody_named():
    posed = photos()
    found = sights(FIRST, moved(1.0, -0.8), posed) + sights(SECOND, moved(0.5, 0.8), posed)
    report = scale_from_detections(found, posed, {SECOND: 0.25}).report
    assert report.estimate.metres_per_unit == pytest.approx(0.5, rel=1e-3)
    assert report.verdict.code == "other_size" and "DICT_4X4_50 7" in report.verdict.message


def test_a_marker_without_a_side_of_its_own_is_used_with_a_warning_or_not_at_all():
    posed = photos()
    found = sights(FIRST, SQUARE, posed)
    report = scale_from_detections(found, posed, {SECOND: 0.5}).report
    assert report.estimate.metres_per_unit == pytest.approx(1.0, rel=1e-3)
    assert (report.verdict.level, report.verdict.code) == ("caution", "default_side")
    strict = scale_from_detections(found, posed, {SECOND: 0.5}, only_named=True).report
    assert strict.estimate is None and strict.verdict.code == "no_marker"


def test_a_marker_known_far_worse_than_another_is_not_used():
    posed = photos()
    good = sights(FIRST, moved(1.0, -0.8), posed)
    poor = [replace(d, sigma_px=3.0) for d in sights(SECOND, moved(1.02, 0.8), posed)]
    report = scale_from_detections(good + poor, posed).report
    assert [residual.name for residual in report.residuals] == ["DICT_4X4_50 7"]


@pytest.mark.parametrize(
    ("side_m", "code"),
    [
        (0.0, "no_length"),
        (-1.0, "no_length"),
        (float("nan"), "no_length"),
        (float("inf"), "no_length"),
        (0.001, "absurd_length"),
        (100.0, "absurd_length"),
    ],
)
def test_a_side_that_cannot_be(side_m, code):
    posed = photos(4)
    report = scale_from_detections(sights(FIRST, SQUARE, posed), posed, {FIRST: side_m}).report
    assert report.estimate is None
    assert report.verdict.code == code
    assert "DICT_4X4_50 7" in report.verdict.message and "black square" in report.verdict.remedy


@pytest.mark.parametrize(("side_m", "radius_m"), [(0.4, 0.2), (0.4, 0.35), (0.2, 0.15)])
def test_a_marker_bent_round_a_trunk(side_m, radius_m):
    chord = radius_m * np.sin(side_m / 2 / radius_m)
    corners = np.array([[-chord, 0, 1], [chord, 0, 1], [chord, 0, -1], [-chord, 0, -1]])
    corners = corners * (1, 1, side_m / 2) + (0, 0, 1.2)
    posed = PosedImages(tuple(image for image in photos(24) if image.centre_src[1] < -1))
    report = scale_from_detections(sights(FIRST, corners, posed), posed).report
    assert report.estimate is None
    assert report.verdict.code == "bent" and "trunk" in report.verdict.remedy


@pytest.mark.parametrize("axis", [[0, np.pi / 2, 0], [np.pi / 2, 0, 0], [0, 0, np.pi / 2]])
def test_cameras_turned_by_a_right_angle(axis):
    posed = photos(10)
    found = sights(FIRST, moved(1.0, 0.4), posed)
    turn = Rotation.from_rotvec(axis).as_matrix()
    wrong = []
    for image in posed:
        rotation = turn @ image.cam_from_source.rotation
        wrong.append(PosedImage(image.name, PANORAMA, Similarity(rotation, -(rotation @ image.centre_src))))
    report = scale_from_detections(found, PosedImages(tuple(wrong))).report
    assert report.estimate is None
    assert report.verdict.code == "poses_disagree"
    assert "camera model" in report.verdict.remedy


def test_sights_and_markers_are_struck_out():
    posed = photos()
    found = sights(FIRST, moved(1.0, -0.8), posed) + sights(SECOND, moved(0.5, 0.8), posed)
    struck = [("0.jpg", *FIRST), ("3.jpg", *FIRST)]
    first, second = triangulate_markers(found, posed, left_out=struck)
    seen = {*first.views_used, *first.views_far, *first.views_rejected}
    assert seen.isdisjoint({"0.jpg", "3.jpg"}) and len(seen) == 6
    assert len({*second.views_used, *second.views_far, *second.views_rejected}) == 8
    alone = scale_from_markers([first, second], left_out=[SECOND])
    assert [residual.name for residual in alone.residuals] == ["DICT_4X4_50 7"]
    whole = [(image.name, *SECOND) for image in posed]
    result = scale_from_detections(found, posed, left_out=whole)
    assert [marker.key for marker in result.markers] == [FIRST]
    assert len(result.detections) == 16


def pinhole_photo(key=FIRST, mirrored=False):
    camera = CameraModel("PINHOLE", 320, 320, (300.0, 300.0, 160.0, 160.0))
    board = MarkerBoard(key, marker_bits(*key), 1.0, np.array([0.2, 0.0, 4.0]), np.eye(3)[0], np.eye(3)[1])
    scene = MarkerScene((board,), np.zeros((0, 3)), np.zeros(2), noise_texture(np.random.default_rng(0), 64))
    picture = render(scene, world_rays(camera, np.eye(3)), np.zeros(3), (320, 320), PictureFlaws(), wraps=False)
    if mirrored:
        picture = np.ascontiguousarray(picture[:, ::-1])
    images = tuple(PosedImage(f"{number}.jpg", camera, Similarity.identity()) for number in range(3))
    return PosedImages(images), picture


def test_mirrored_photos_are_said():
    posed, picture = pinhole_photo(mirrored=True)
    settings = MarkerSettings(dictionaries=(FIRST[0],))
    assert find_markers(posed, settings=settings, read_image=lambda _: picture) == ()
    report = measure_scale(posed, settings=settings, read_image=lambda _: picture).report
    assert report.estimate is None
    assert report.verdict.code == "mirrored_photos"


def test_a_marker_of_another_dictionary_is_said():
    posed, picture = pinhole_photo()
    settings = MarkerSettings(dictionaries=("DICT_5X5_50",))
    report = measure_scale(posed, settings=settings, read_image=lambda _: picture).report
    assert report.verdict.code == "other_markers" and "DICT_4X4_50 7" in report.verdict.message


def test_one_photo_is_held_at_a_time_and_cancelling_is_heard_between_them():
    posed, picture = pinhole_photo()
    settings = MarkerSettings(dictionaries=(FIRST[0],))
    held = []

    def read(_):
        assert all(reference() is None for reference in held)
        copy = picture.copy()
        held.append(weakref.ref(copy))
        return copy

    assert len(find_markers(posed, settings=settings, read_image=read)) == 3
    assert len(held) == 3
    read_so_far = []

    def stop_at_the_second(fraction, message=""):
        if fraction > 0.3:
            raise CancelledError

    with pytest.raises(CancelledError):
        find_markers(
            posed,
            settings=settings,
            read_image=lambda photo: read_so_far.append(photo) or picture,
            progress=stop_at_the_second,
        )
    assert len(read_so_far) == 1


def test_wrong_prints_are_not_taken_for_the_marker():
    """Mirrored, without its black frame, and bent round a stem: none may pass for a flat DICT_4X4_50."""
    bits = marker_bits(*FIRST)
    frameless = bits.copy()
    frameless[[0, -1], :] = frameless[:, [0, -1]] = True
    right, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])
    boards = tuple(
        MarkerBoard(("wrong", number), wrong, 0.6, np.array([x, 2.5, 1.5]), right, down)
        for number, (wrong, x) in enumerate([(bits[:, ::-1], -0.6), (frameless, 0.4)])
    )
    stems = np.array([[1.6, 2.5, 0.12]])
    sheet = WrappedMarker(bits, 0.5, 0, -np.pi / 2, 1.5)
    scene = MarkerScene(boards, stems, np.zeros(2), noise_texture(np.random.default_rng(2), 256), (sheet,))
    camera, centre = CameraModel("EQUIRECTANGULAR", 1536, 768, ()), np.array([0.0, 0.0, 1.7])
    picture = render(scene, world_rays(camera, LEVEL), centre, (1536, 768), PictureFlaws(), wraps=True)
    photo = PosedImage("a.jpg", camera, Similarity(LEVEL, -(LEVEL @ centre)))
    settings = MarkerSettings(dictionaries=(FIRST[0],))
    assert find_markers(PosedImages((photo,)), settings=settings, read_image=lambda _: picture) == ()


def test_a_crop_shows_the_marker_upright_and_outlined_wherever_it_is_in_the_panorama():
    camera = CameraModel("EQUIRECTANGULAR", 1024, 512, ())
    rows, columns = np.indices((512, 1024))
    colours = [80 + 60 * np.sin(columns * 2 * np.pi / 128), 90 + 40 * np.cos(rows / 20), np.full((512, 1024), 60)]
    picture = np.stack(colours, axis=2).astype(np.uint8)
    corners = np.array([[480.0, 230.0], [560.0, 232.0], [556.0, 300.0], [484.0, 296.0]])
    crop = detection_crop(picture, camera, corners)
    assert crop.shape == (160, 160, 3) and crop.dtype == np.uint8
    yellow = (crop[:, :, 0] > 200) & (crop[:, :, 2] < 40)
    found = np.argwhere(yellow)
    # The outline fills most of the picture, about its middle.
    assert np.abs(found.mean(axis=0) - 80).max() < 12
    assert 60 < np.ptp(found[:, 0]) < 130 and 60 < np.ptp(found[:, 1]) < 130
    # Half a panorama farther the same marker is cut by the seam.
    across = np.column_stack([(corners[:, 0] + 512) % 1024, corners[:, 1]])
    seam = detection_crop(np.roll(picture, 512, axis=1), camera, across)
    assert np.abs(seam.astype(int) - crop).max() <= 3
    small = detection_crop(np.ascontiguousarray(picture[::2, ::2]), camera, corners, size_px=80)
    assert small.shape == (80, 80, 3)


def test_a_crop_needs_four_corners_in_the_photo():
    posed, picture = pinhole_photo()
    camera = posed.images[0].camera
    with pytest.raises(ValueError, match=r"\(4, 2\)"):
        detection_crop(picture, camera, np.zeros((3, 2)))
    with pytest.raises(ValueError, match="outside"):
        detection_crop(picture, camera, np.full((4, 2), np.nan))
