"""Scale from photos, clicks and numbers, against scenes that are known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.app.plots import make_cloud, make_document

from dbh_studio.app import found_markers
from dbh_studio.app.commands import add_length, change_length
from dbh_studio.app.found_markers import change_side, strike_out, use_marker
from dbh_studio.app.lengths import metres_from_text
from dbh_studio.app.photo_points import photos_of_point, point_from_sights
from dbh_studio.app.scaling import frame_from_square, scale_from_baseline, scale_from_camera_height, scale_from_evidence
from dbh_studio.core.bars import refused_scale
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.dbh import Refusal
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.scale_evidence import MarkedPoint, MarkerSquare, ScaleBar, ScaleEvidence, Sight
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import CommandError
from dbh_studio.settings import MarkerSettings

PANORAMA = CameraModel("EQUIRECTANGULAR", 4096, 2048, ())
PINHOLE = CameraModel("PINHOLE", 1000, 800, (900.0, 900.0, 500.0, 400.0))
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
KEY = ("DICT_4X4_50", 7)


def photo(name, centre, camera=PANORAMA, *, rotation=LEVEL, path="x.jpg"):
    centre = np.asarray(centre, float)
    return PosedImage(name, camera, Similarity(rotation, -(rotation @ centre)), path)


def walk(n=8, *, radius=3.0, height=2.0, offset=(0.0, 0.0, 0.0)):
    angles = 2 * np.pi * np.arange(n) / n
    centres = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.full(n, height)]) + offset
    return PosedImages(tuple(photo(f"{i}.jpg", centre) for i, centre in enumerate(centres)))


def sights_of(point, posed, names, *, noise_px=0.0, seed=0):
    rng = np.random.default_rng(seed)
    found = []
    for name in names:
        uv = posed.by_name(name).project(np.array([point]))[0][0] + rng.normal(0, noise_px, 2)
        found.append(Sight(name, float(uv[0]), float(uv[1])))
    return found


def bar(length_src=2.0, length_m=1.0, name="Bar 1", **values):
    return ScaleBar(name, (MarkedPoint((0, 0, 0)), MarkedPoint((length_src, 0, 0))), length_m, **values)


def square(name="DICT_4X4_50 7", *, side_src=2.0, side_m=1.0, marker=KEY):
    flat = side_src / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]])
    return MarkerSquare(name, tuple(MarkedPoint(tuple(corner)) for corner in flat), side_m, marker=marker)


# ---- points in photos


@pytest.mark.parametrize("offset", [(0, 0, 0), (500_000.0, 4_500_000.0, 100.0)])
def test_a_point_marked_in_two_panoramas_is_where_it_is(offset):
    posed, point = walk(offset=offset), np.array([0.4, -0.2, 0.1]) + offset
    result = point_from_sights(sights_of(point, posed, ["0.jpg", "2.jpg"]), posed)
    np.testing.assert_allclose(result.point.xyz_src, point, atol=1e-6)
    assert max(result.residuals_px) < 1e-3 and all(result.is_used)
    assert [sight.image for sight in result.point.sights] == ["0.jpg", "2.jpg"]
    np.testing.assert_allclose(
        result.distances_src, [np.linalg.norm(point - posed.by_name(n).centre_src) for n in ("0.jpg", "2.jpg")]
    )


def test_the_error_of_a_point_is_the_scatter_of_its_clicks():
    posed, point = walk(), np.array([0.4, -0.2, 0.1])
    names = ["0.jpg", "2.jpg", "4.jpg", "6.jpg"]
    found = [point_from_sights(sights_of(point, posed, names, noise_px=1.0, seed=s), posed) for s in range(80)]
    off = np.array([result.point.xyz_src for result in found]) - point
    said = np.sqrt(np.mean([result.point.sigma_src**2 for result in found]))
    # A click's error goes one way at a time in the estimate, both ways in this test.
    assert 0.6 < said / off.std() < 2.0


def test_a_sight_of_another_point_is_left_out_and_said():
    posed, point = walk(), np.array([0.4, -0.2, 0.1])
    sights = sights_of(point, posed, ["0.jpg", "1.jpg", "2.jpg", "3.jpg"], noise_px=0.3)
    sights[3] = replace(sights[3], u_px=sights[3].u_px + 200)
    result = point_from_sights(sights, posed)
    assert result.is_used == (True, True, True, False)
    assert result.residuals_px[3] == pytest.approx(200, rel=0.2)
    assert np.linalg.norm(np.array(result.point.xyz_src) - point) < 0.02


def test_what_photos_cannot_say_is_refused_in_words():
    posed, point = walk(), np.array([0.4, -0.2, 0.1])
    beside = PosedImages((photo("a", (3, 0, 2)), photo("b", (3.001, 0, 2))))
    same = PosedImages((photo("a", (3, 0, 2)), photo("b", (3, 0, 2))))
    lens = PosedImages((photo("a", (3, 0, 2), PINHOLE), photo("b", (0, 3, 2), PINHOLE)))
    for sights, photos, code in (
        ([], posed, "one_view"),
        (sights_of(point, posed, ["0.jpg"]), posed, "one_view"),
        (sights_of(point, beside, ["a", "b"]), beside, "parallel"),
        (sights_of(point, same, ["a", "b"]), same, "parallel"),
        ([Sight("gone.jpg", 1.0, 1.0)], posed, "no_photo"),
        ([Sight("a", np.nan, 1.0), Sight("b", 1.0, 1.0)], lens, "bad_ray"),
    ):
        result = point_from_sights(sights, photos)
        assert isinstance(result, Refusal) and result.code == code
        assert result.reason.endswith(".") and result.remedy.endswith(".")


def test_photos_that_show_a_point_are_offered_nearest_first():
    posed, point = walk(), np.array([1.5, 0.0, 0.1])
    offered = photos_of_point(point, posed)
    assert len(offered) == 8
    assert [each.distance_src for each in offered] == sorted(each.distance_src for each in offered)
    assert offered[0].image == "0.jpg"
    for each in offered:
        uv = posed.by_name(each.image).project(point[None])[0][0]
        np.testing.assert_allclose((each.u_px, each.v_px), uv)
    assert len(photos_of_point(point, posed, at_most=3)) == 3


def test_photos_from_the_same_side_come_last():
    near, twin, other = photo("near", (0, -2, 1)), photo("twin", (0, -2.1, 1)), photo("other", (3, 0, 1))
    offered = photos_of_point(np.zeros(3), PosedImages((near, twin, other)), without=["near"])
    assert [each.image for each in offered] == ["other", "twin"]


def test_photos_that_are_lost_or_look_away_are_not_offered():
    lost = photo("lost", (0, -2, 0), path=None)
    ahead, away = photo("ahead", (0, -2, 0), PINHOLE), photo("away", (0, 2, 0), PINHOLE)
    assert [each.image for each in photos_of_point(np.zeros(3), PosedImages((lost, ahead, away)))] == ["ahead"]


# ---- from known lengths


def test_the_scale_is_taken_from_the_control_lengths():
    document = add_length(bar()).apply(make_document(make_cloud(), scale=ScaleEstimate()))
    after = scale_from_evidence(document).apply(document)
    assert after.scale.metres_per_unit == pytest.approx(0.5)
    assert after.scale.source == "bars"
    with pytest.raises(CommandError, match="control"):
        scale_from_evidence(make_document(make_cloud(), evidence=ScaleEvidence((bar(role="check"),))))


def search_result(*squares):
    evidence = ScaleEvidence((), squares)
    report = evidence.report() if squares else refused_scale("no_marker", "No marker was found.", "Look again.")
    return found_markers.MarkerSearch((), squares, report, ())


def test_a_search_sets_markers_and_scale_in_one_step():
    document = add_length(bar(name="by hand", role="check")).apply(make_document(make_cloud(), scale=ScaleEstimate()))
    after = found_markers.apply_search(document, search_result(square())).apply(document)
    assert after.scale.metres_per_unit == pytest.approx(0.5) and after.scale.source == "marker"
    assert {each.name for each in after.evidence} == {"DICT_4X4_50 7", "by hand"}


def test_a_search_without_a_marker_says_so_and_changes_nothing():
    document = make_document(make_cloud())
    with pytest.raises(CommandError, match="No marker was found"):
        found_markers.apply_search(document, search_result())


def test_the_side_of_all_markers_changes_in_one_step():
    mine = square("mine", marker=None)
    odd = square("DICT_4X4_50 9", side_m=0.5, marker=("DICT_4X4_50", 9))
    document = make_document(make_cloud(), evidence=ScaleEvidence((), (square(), odd, mine)))
    after = change_side(document, 1.0, 0.8).apply(document)
    assert [each.side_m for each in after.evidence.squares] == [0.8, 0.5, 1.0]
    assert change_side(document, 3.0, 0.8).apply(document) is document
    for nothing in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(CommandError, match="cannot be"):
            change_side(document, 1.0, nothing)


@pytest.fixture
def placed(monkeypatch):
    """In place of `place_markers`: the square measures 2 units with all finds, 2.2 with one left out, none with two."""

    def place(detections, posed, sides_m=None, struck=(), settings=None, checks=()):
        left_out = {each for each in struck if each[0] in {d.image for d in detections}}
        squares = {0: (square(),), 1: (square(side_src=2.2),)}.get(len(left_out), ())
        return search_result(*(replace(each, side_m=(sides_m or {}).get(KEY, 1.0)) for each in squares))

    monkeypatch.setattr(found_markers, "place_markers", place)
    return [SimpleNamespace(image=name) for name in ("a.jpg", "b.jpg")]


def test_striking_out_places_the_markers_anew_and_takes_the_scale(placed):
    start = make_document(
        make_cloud(), scale=ScaleEstimate(0.5, "marker"), evidence=ScaleEvidence((), (square(side_m=0.9),))
    )
    sight = ("a.jpg", *KEY)
    struck = strike_out(start, placed, PosedImages(()), sight).apply(start)
    assert struck.evidence.struck == (sight,)
    # The side that was typed stays.
    assert struck.scale.metres_per_unit == pytest.approx(0.9 / 2.2)
    again = strike_out(struck, placed, PosedImages(()), sight, struck=False).apply(struck)
    assert again.evidence.struck == ()
    assert again.scale.metres_per_unit == pytest.approx(0.9 / 2.0)


def test_striking_out_the_last_find_keeps_the_scale(placed):
    start = make_document(
        make_cloud(),
        scale=ScaleEstimate(0.5, "marker"),
        evidence=ScaleEvidence((), (square(),), (("b.jpg", *KEY),)),
    )
    after = strike_out(start, placed, PosedImages(()), ("a.jpg", *KEY)).apply(start)
    assert not len(after.evidence) and len(after.evidence.struck) == 2
    assert after.scale == start.scale


def test_striking_out_leaves_a_scale_by_number_alone(placed):
    start = make_document(make_cloud(), evidence=ScaleEvidence((), (square(),)))
    after = strike_out(start, placed, PosedImages(()), ("a.jpg", *KEY)).apply(start)
    assert after.scale == start.scale and after.evidence != start.evidence


# ---- finds of a program


def finds_of(key, side_src, x_src, posed, images=None):
    """What is detected of a flat marker with this side, `x_src` from the middle."""
    from dbh_studio.stages.marker_detect import Detection

    flat = side_src / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]]) + (x_src, 0.0, 0.0)
    crop = np.zeros((2, 2, 3), np.uint8)
    return [
        Detection(photo.name, *key, photo.project(flat)[0], 1.0, crop, 0.02, 2 * np.pi / 4096, 0.6)
        for photo in posed
        if images is None or photo.name in images
    ]


OTHER, THIRD = ("DICT_4X4_50", 13), ("DICT_4X4_50", 21)


def test_the_side_of_a_marker_counts_by_whatever_name_of_its_dictionary():
    posed = walk()
    finds = finds_of(KEY, 1.0, 0.0, posed)
    for name in ("DICT_4X4_50", "DICT_4X4_250", "4x4_1000"):
        search = found_markers.place_markers(finds, posed, {(name, KEY[1]): 0.5})
        assert search.report.estimate.metres_per_unit == pytest.approx(0.5, rel=1e-3), name
        assert search.squares[0].side_m == 0.5


def test_turned_photos_are_told_from_a_marker_that_was_seen_once():
    posed = walk()
    finds = []
    for number, find in enumerate(finds_of(KEY, 1.0, 0.0, posed)):
        turned = find.corners_px + [PANORAMA.width_px * (number % 4) / 4, 0.0]
        finds.append(replace(find, corners_px=turned % PANORAMA.width_px))
    search = found_markers.place_markers(finds, posed)
    assert search.report.verdict.code == "poses_disagree"
    assert found_markers.place_markers(finds[:1], posed).report.verdict.code == "one_view"


def test_a_marker_of_another_size_is_kept_as_a_check_that_fails_until_its_side_is_right():
    posed = walk()
    finds = [f for key, side, x in ((KEY, 1.0, -1.0), (THIRD, 1.0, 1.0), (OTHER, 0.5, 0.0))
             for f in finds_of(key, side, x, posed)]  # fmt: skip
    start = make_document(make_cloud(), scale=ScaleEstimate())
    after = found_markers.apply_search(start, found_markers.place_markers(finds, posed)).apply(start)
    assert after.scale.metres_per_unit == pytest.approx(1.0, rel=1e-3)
    assert [(s.marker[1], s.role) for s in after.evidence.squares] == [(7, "control"), (13, "check"), (21, "control")]
    verdict = after.evidence.report().verdict
    assert verdict.code == "check_failed" and "DICT_4X4_50 13 measures 0.500 m instead of 1.000 m" in verdict.message
    # Whatever places the markers anew, it stays a check, and its side is its own.
    told = change_length("DICT_4X4_50 13", side_m=0.5).apply(after)
    assert told.evidence.report().verdict.code == "agrees"
    struck = strike_out(told, finds, posed, ("0.jpg", *KEY)).apply(told)
    assert [(s.side_m, s.role) for s in struck.evidence.squares] == [(1.0, "control"), (0.5, "check"), (1.0, "control")]
    assert struck.scale.metres_per_unit == pytest.approx(1.0, rel=1e-3)


def test_two_sizes_and_no_side_named_give_no_scale_until_a_person_names_one():
    posed = walk()
    finds = finds_of(KEY, 1.0, -1.0, posed) + finds_of(OTHER, 0.5, 1.0, posed)
    start = make_document(make_cloud(), scale=ScaleEstimate())
    search = found_markers.place_markers(finds, posed)
    assert search.report.verdict.code == "contradict" and search.squares == ()
    with pytest.raises(CommandError, match="contradict"):
        found_markers.apply_search(start, search)
    after = use_marker(start, finds, posed, OTHER, 0.5).apply(start)
    assert after.scale.metres_per_unit == pytest.approx(1.0, rel=1e-3)
    assert after.evidence.report().verdict.code == "agrees"


def test_a_find_is_struck_out_with_the_side_of_the_search():
    posed = walk()
    finds = finds_of(KEY, 1.0, -1.0, posed) + finds_of(OTHER, 1.3, 1.0, posed, images=("0.jpg", "2.jpg"))
    start = make_document(make_cloud(), scale=ScaleEstimate())
    after = strike_out(start, finds, posed, ("0.jpg", *OTHER), settings=MarkerSettings(side_m=0.5)).apply(start)
    assert after.scale.metres_per_unit == pytest.approx(0.5, rel=1e-3)


def test_a_cloud_in_metres_keeps_its_unit_where_that_is_wanted():
    in_metres = make_document(make_cloud(), scale=ScaleEstimate(1.0, "metres"))
    search = search_result(square())
    kept = found_markers.apply_search(in_metres, search, keep_number=True).apply(in_metres)
    assert kept.scale == in_metres.scale and len(kept.evidence) == 1
    asked = found_markers.apply_search(in_metres, search).apply(in_metres)
    assert asked.scale.metres_per_unit == pytest.approx(0.5)
    weak = make_document(make_cloud(), scale=ScaleEstimate(0.7, "baseline", 0.1))
    assert found_markers.apply_search(weak, search, keep_number=True).apply(weak).scale.source == "marker"


# ---- where nothing else exists


def test_the_distance_of_two_photos():
    posed = walk(4, radius=2.0)
    estimate = scale_from_baseline(posed, "0.jpg", "2.jpg", 6.0)
    assert estimate.metres_per_unit == pytest.approx(1.5)
    assert estimate.is_weak and estimate.standard_error > 0.01 * estimate.metres_per_unit
    for first, second, distance, why in (
        ("0.jpg", "0.jpg", 6.0, "one place"),
        ("0.jpg", "gone", 6.0, "no photo gone"),
        ("0.jpg", "2.jpg", 0.0, "cannot be 0 m"),
        ("0.jpg", "2.jpg", float("nan"), "cannot be nan m"),
    ):
        with pytest.raises(CommandError, match=why):
            scale_from_baseline(posed, first, second, distance)


def ground(n=40_000, *, slope=0.0):
    rng = np.random.default_rng(0)
    xy = rng.uniform(-5, 5, (n, 2))
    bushes = rng.random(n) < 0.3
    z = slope * xy[:, 0] + np.where(bushes, rng.uniform(0, 0.8, n), 0.0)
    return PointCloud(np.column_stack([xy, z]).astype(np.float32), np.array([1000.0, 2000.0, 300.0]))


@pytest.mark.parametrize("up", ["+z", "tilted"])
def test_the_height_of_the_camera(up):
    cloud, posed = ground(), walk(12, height=0.8, offset=(1000.0, 2000.0, 300.0))
    direction = np.array([0.0, 0.0, 1.0])
    if up == "tilted":
        turn = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
        cloud = PointCloud((cloud.xyz @ turn.T).astype(np.float32), turn @ cloud.origin)
        posed = posed.moved(Similarity(turn, np.zeros(3)))
        direction = turn @ direction
    estimate = scale_from_camera_height(posed, cloud, direction, 2.0)
    assert estimate.metres_per_unit == pytest.approx(2.5, rel=0.03)
    assert estimate.is_weak and estimate.standard_error >= 0.05 * estimate.metres_per_unit


def test_cameras_without_ground_under_them_say_nothing():
    with pytest.raises(CommandError, match="too few"):
        scale_from_camera_height(walk(12), ground(), np.array([0.0, 0, 1]), 2.0)  # far from that cloud's origin
    with pytest.raises(CommandError, match="too few"):
        posed = walk(12, height=0.8, offset=(1000.0, 2000.0, 300.0))
        scale_from_camera_height(posed, ground(), np.array([0.0, 0, -1]), 2.0)  # upside down
    with pytest.raises(CommandError, match="cannot be"):
        scale_from_camera_height(walk(12), ground(), np.array([0.0, 0, 1]), -1.0)


# ---- up, origin and north


def test_a_marker_sets_up_origin_and_north():
    cloud = make_cloud()
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # up is +x, north +z
    flat = square(marker=None)
    moved = replace(
        flat,
        corners=tuple(MarkedPoint(tuple(turn @ np.array(c.xyz_src) + cloud.origin + (1, 2, 3))) for c in flat.corners),
    )
    document = make_document(cloud)
    after = frame_from_square(moved, cloud).apply(document)
    world = after.world_from_source.apply(np.array([corner.xyz_src for corner in moved.corners]) - cloud.origin)
    np.testing.assert_allclose(world, [[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], atol=1e-6)
    only_up = frame_from_square(moved, cloud, origin=False, north=False).apply(document)
    assert only_up.up_direction == pytest.approx(after.up_direction)
    assert only_up.origin_src == document.origin_src and only_up.north_direction is None


def test_a_marker_without_a_plane_gives_no_directions():
    point = MarkedPoint((0.0, 0.0, 0.0))
    with pytest.raises(CommandError, match="no directions"):
        frame_from_square(replace(square(), corners=(point,) * 4), make_cloud())


# ---- lengths as typed


@pytest.mark.parametrize(
    ("text", "length_m"),
    [("1.37", 1.37), ("1,37", 1.37), (" 2 m", 2.0), ("137cm", 1.37), ("500 mm", 0.5), ("1 FT", 0.3048), (".5", 0.5)],
)
def test_a_length_is_understood_as_people_type_it(text, length_m):
    assert metres_from_text(text, "The side") == pytest.approx(length_m)


@pytest.mark.parametrize(
    "text", ["", "  ", "one", "1 2", "1.2.3", "1e5", "nan", "inf", "1 mile", "٣", "1m; drop", "--1"]
)
def test_what_is_no_length_is_said_in_words(text):
    with pytest.raises(CommandError, match=r"The side (was not understood|is missing)") as error:
        metres_from_text(text, "The side")
    assert "metres" in error.value.remedy


@pytest.mark.parametrize("text", ["0", "0.00", "-1", "0.0001", "99999", "0 cm"])
def test_a_length_that_cannot_be_is_said_in_words(text):
    with pytest.raises(CommandError, match="The side cannot be"):
        metres_from_text(text, "The side")
