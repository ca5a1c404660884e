"""Points as they are marked, one after another, without a page."""

import numpy as np
import pytest

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.scale_evidence import MarkedPoint, MarkerSquare, ScaleBar, Sight
from dbh_studio.core.transforms import Similarity
from dbh_studio.ui.point_picks import PointPicks

SQUARE = np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
CENTRES = {"a": (3.0, 0, 1.5), "b": (0, 3.0, 1.5), "c": (-3.0, 0, 1.5)}
POSED = PosedImages(
    tuple(
        PosedImage(name, CameraModel("EQUIRECTANGULAR", 4096, 2048, ()), Similarity(LEVEL, -LEVEL @ centre), "x.jpg")
        for name, centre in CENTRES.items()
    )
)


def put_all(picks, points, *, eye=None):
    for number, point in enumerate(points):
        picks.put(number, MarkedPoint(tuple(point), 0.01), seen_from_src=eye)


def sight(name, point, off_px=0.0):
    u, v = POSED.by_name(name).project(np.array([point]))[0][0]
    return Sight(name, float(u) + off_px, float(v))


def nowhere(_):
    return None


def test_clicks_in_the_cloud_fill_one_point_after_the_other():
    picks = PointPicks("bar", "cloud")
    assert picks.target_of_click() == 0 and not picks.is_begun
    picks.put(0, MarkedPoint((0, 0, 0)))
    assert picks.target_of_click() == 1 and picks.is_begun and not picks.is_complete
    picks.put(1, MarkedPoint((3, 0, 0)))
    assert picks.target_of_click() is None and picks.is_complete
    made = picks.length("Bar 1", 1.5)
    assert isinstance(made, ScaleBar) and made.length_m == 1.5
    assert [end.xyz_src for end in made.ends] == [(0, 0, 0), (3, 0, 0)]


def test_a_point_can_be_moved_and_removed():
    picks = PointPicks("bar", "cloud")
    put_all(picks, [(0, 0, 0), (3, 0, 0)])
    picks.choose(0)
    picks.is_moving = True
    assert picks.target_of_click() == 0
    picks.put(0, MarkedPoint((1, 0, 0)))
    assert not picks.is_moving and picks.picks[0].point.xyz_src == (1, 0, 0)
    picks.remove(0)
    assert picks.target_of_click() == 0 and not picks.is_complete


def test_the_last_point_is_taken_back_until_none_is_left():
    picks = PointPicks("square", "cloud")
    put_all(picks, SQUARE[:2])
    assert [picks.remove_last(), picks.remove_last(), picks.remove_last()] == [True, True, False]
    assert not picks.is_begun


def test_no_length_without_all_points():
    with pytest.raises(ValueError, match="missing"):
        PointPicks("bar", "cloud").length("Bar 1", 1.0)


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [0, 3, 2, 1]])
def test_a_marker_faces_whoever_marked_it_whichever_way_round_they_went(order):
    picks = PointPicks("square", "cloud")
    put_all(picks, SQUARE[order], eye=np.array([0.3, -2.0, 5.0]))
    made = picks.length("Marker 1", 1.0)
    assert isinstance(made, MarkerSquare)
    np.testing.assert_allclose(made.corners_src, SQUARE)
    np.testing.assert_allclose(made.frame()[0], (0, 0, 1), atol=1e-12)


def test_sights_in_two_photos_make_a_point():
    picks, point = PointPicks("bar", "photos"), (0.2, 0.3, 0.1)
    picks.put_sight(sight("a", point), POSED, lambda _: (9.0, 9.0, 9.0))
    assert picks.current.point is None and picks.current.place_src == (9.0, 9.0, 9.0)
    picks.put_sight(sight("b", point), POSED, nowhere)
    np.testing.assert_allclose(picks.current.point.xyz_src, point, atol=1e-6)
    assert max(picks.current.found.residuals_px) < 1e-3
    assert [each.image for each in picks.offered(POSED)] == ["c"]
    np.testing.assert_allclose(picks.seen_from_src, CENTRES["a"])


def test_the_same_photo_again_moves_the_sight():
    picks, point = PointPicks("bar", "photos"), (0.2, 0.3, 0.1)
    for off_px in (300.0, 0.0):
        picks.put_sight(sight("a", point, off_px), POSED, nowhere)
    picks.put_sight(sight("b", point), POSED, nowhere)
    assert len(picks.current.sights) == 2
    np.testing.assert_allclose(picks.current.point.xyz_src, point, atol=1e-6)


def test_sights_of_two_points_are_refused_until_one_is_taken_out():
    picks, point = PointPicks("bar", "photos"), (0.2, 0.3, 0.1)
    picks.put_sight(sight("a", point), POSED, nowhere)
    picks.put_sight(Sight("b", sight("b", point).u_px, 1900.0), POSED, nowhere)
    assert picks.current.point is None and picks.current.refusal.reason
    picks.remove_sight("b", POSED, nowhere)
    assert picks.current.refusal is None and len(picks.current.sights) == 1
    picks.put_sight(sight("c", point), POSED, nowhere)
    # Opposite photos look along one line, but meet in the point.
    assert picks.current.point is not None


def test_points_of_a_length_are_marked_anew_and_the_rest_of_it_stays():
    bar = ScaleBar("Pole", (MarkedPoint((0, 0, 0)), MarkedPoint((2, 0, 0))), 1.0, 0.004, "check")
    picks = PointPicks.of(bar)
    assert (picks.kind, picks.place, picks.edited) == ("bar", "cloud", "Pole") and picks.is_complete
    picks.put(1, MarkedPoint((4, 0, 0)))
    made = picks.length("", 1.2, bar)
    assert (made.name, made.length_m, made.length_se_m, made.role) == ("Pole", 1.2, 0.004, "check")
    assert made.ends[1].xyz_src == (4, 0, 0)


def test_a_found_marker_whose_corners_were_moved_is_no_longer_found():
    points = tuple(MarkedPoint(tuple(corner), 0.001, (Sight("a", 1, 1),)) for corner in SQUARE)
    found = MarkerSquare("D 7", points, 1.0, marker=("D", 7), n_views=5, side_sigma_src=1e-4, systematic_src=1e-4)
    picks = PointPicks.of(found)
    assert picks.place == "photos"
    picks.put(0, MarkedPoint((-1.1, 1.0, 0.0), 0.01))
    made = picks.length("", 1.0, found)
    assert (made.name, made.marker, made.n_views, made.systematic_src) == ("D 7", None, None, 0.0)
    assert made.sigma_src == pytest.approx(np.sqrt(0.125 * (3 * 1e-6 + 1e-4)))
