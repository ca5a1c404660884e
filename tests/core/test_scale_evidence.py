"""Known lengths against figures worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from dbh_studio.core.scale_evidence import MarkedPoint, MarkerSquare, ScaleBar, ScaleEvidence, Sight

FAR = np.array([500_000.0, 4_500_000.0, 100.0])


def bar(name="Bar 1", *, length_src=2.0, length_m=1.0, direction=(1.0, 0.0, 0.0), sigma_src=0.0, **values):
    end = FAR + length_src * np.asarray(direction)
    points = (MarkedPoint(tuple(FAR), sigma_src), MarkedPoint(tuple(end), sigma_src))
    return ScaleBar(name, points, length_m, **values)


def square(name="Marker 1", *, side_src=2.0, side_m=1.0, sigma_src=0.0, **values):
    flat = side_src / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    corners = tuple(MarkedPoint(tuple(FAR + corner), sigma_src) for corner in flat)
    return MarkerSquare(name, corners, side_m, **values)


def test_a_point_that_is_nowhere_is_refused():
    for xyz, sigma in (((np.nan, 0, 0), 0.0), ((0, 0), 0.0), ((0, 0, 0), -1.0), ((0, 0, 0), np.inf)):
        with pytest.raises(ValueError, match="nowhere"):
            MarkedPoint(xyz, sigma)


def test_one_bar_gives_its_scale():
    report = ScaleEvidence((bar(),)).report()
    assert report.estimate.metres_per_unit == pytest.approx(0.5, rel=1e-9)
    assert report.estimate.source == "bars"
    assert report.verdict.code == "unchecked"


def test_the_error_of_a_bar_is_that_of_its_ends_and_of_the_tape():
    report = ScaleEvidence((bar(sigma_src=0.01, length_se_m=0.002),)).report()
    relative = report.estimate.standard_error / report.estimate.metres_per_unit
    # sqrt((0.01 * sqrt 2 / 2)^2 + 0.002^2 + 0.0005^2), shares of the length.
    assert relative == pytest.approx(np.sqrt(0.00005 + 4e-6 + 2.5e-7), rel=0.01)


def test_a_square_measures_its_side_and_diagonals():
    one = square(sigma_src=0.01)
    assert one.measured_src == pytest.approx(2.0, rel=1e-12)
    # Each corner pulls two sides and a diagonal; checked by moving the corners at random.
    rng = np.random.default_rng(0)
    sides = []
    for _ in range(4000):
        moved = tuple(MarkedPoint(tuple(c.xyz_src + rng.normal(0, 0.01, 3))) for c in one.corners)
        sides.append(replace(one, corners=moved).measured_src)
    assert one.sigma_src == pytest.approx(np.std(sides), rel=0.1)


def test_a_marker_alone_is_called_a_marker_and_says_in_how_many_photos():
    report = ScaleEvidence((), (square(n_views=5), square("Marker 2", n_views=3))).report()
    assert report.estimate.source == "marker"
    assert report.n_views == 3
    assert ScaleEvidence((bar(),), (square(role="check"),)).report().estimate.source == "bars"


def test_markers_in_few_photos_are_doubted_however_well_they_agree():
    found = {"marker": ("DICT_4X4_50", 7), "side_sigma_src": 1e-4}
    for others in ((), (square("Marker 2", n_views=3),)):
        report = ScaleEvidence((), (square(n_views=3, **found), *others)).report()
        assert (report.verdict.level, report.verdict.code) == ("caution", "few_views")
        assert "3 photos" in report.verdict.message and report.verdict.remedy
    for better in (square("Marker 2", n_views=4), square("by hand", role="check")):
        assert ScaleEvidence((), (square(n_views=3, **found), better)).report().verdict.code == "agrees"
    off = ScaleEvidence((), (square(n_views=3, **found), square("Marker 2", side_m=1.1, role="check")))
    assert off.report().verdict.code == "check_failed"


def test_one_number_at_two_places_is_doubted():
    twins = [square(name, marker=("DICT_4X4_50", 7), n_views=9) for name in ("DICT_4X4_50 7", "DICT_4X4_50 7 (2)")]
    assert ScaleEvidence((), tuple(twins)).report().verdict.code == "twice"


def test_a_check_does_not_move_the_scale_and_its_residual_is_said():
    controls = ScaleEvidence((bar(),))
    both = controls.with_length(bar("Check", length_src=2.02, role="check"))
    assert both.report().estimate.metres_per_unit == controls.report().estimate.metres_per_unit
    residual = next(each for each in both.report().residuals if each.name == "Check")
    assert residual.residual_pct == pytest.approx(1.0, abs=1e-6)
    assert residual.residual_m == pytest.approx(0.01, abs=1e-8)


def test_lying_and_standing_bars_are_told_apart_by_the_up_direction():
    evidence = ScaleEvidence((bar("lies"), bar("stands", direction=(0, 0, 1.0), length_src=2.1)))
    report = evidence.report(np.array([0.0, 0.0, 1.0]))
    assert {each.name: each.lie for each in report.residuals} == {"lies": "horizontal", "stands": "vertical"}
    assert report.horizontal_over_vertical == pytest.approx(2.0 / 2.1, rel=1e-6)
    assert {each.lie for each in evidence.report().residuals} == {"unknown"}


def test_corners_in_the_wrong_order_are_no_square():
    corners = square().corners
    crossed = replace(square(), corners=(corners[0], corners[2], corners[1], corners[3]))
    assert crossed.is_uneven and not square().is_uneven
    assert ScaleEvidence((), (crossed,)).report().verdict.code == "bent"


def test_a_square_of_which_a_corner_lies_off_the_plane_is_bent():
    corners = list(square().corners)
    corners[0] = MarkedPoint(tuple(np.array(corners[0].xyz_src) + [0, 0, 0.4]))
    assert replace(square(), corners=tuple(corners)).is_uneven


def test_four_corners_at_one_place_are_refused_and_not_a_division_by_zero():
    point = MarkedPoint(tuple(FAR))
    nothing = replace(square(), corners=(point,) * 4)
    assert nothing.unevenness == np.inf
    assert ScaleEvidence((), (nothing,)).report().verdict.level == "refused"
    with pytest.raises(ValueError, match="line"):
        nothing.frame()


def test_the_frame_of_a_square_that_lies_flat():
    up, middle, north = square().frame()
    np.testing.assert_allclose(up, (0, 0, 1), atol=1e-9)
    np.testing.assert_allclose(middle, FAR)
    np.testing.assert_allclose(north, (0, 1, 0), atol=1e-9)


def test_three_corners_are_no_square():
    with pytest.raises(ValueError, match="4 corners"):
        replace(square(), corners=square().corners[:3])


def test_names_are_unique():
    with pytest.raises(ValueError, match="same name"):
        ScaleEvidence((bar("A"),), (square("A"),))
    evidence = ScaleEvidence((bar("Bar 1"), bar("Bar 3")))
    assert evidence.free_name("Bar") == "Bar 2"
    assert "Bar 1" in evidence and "Bar 2" not in evidence
    with pytest.raises(KeyError):
        evidence["Bar 2"]


def test_a_length_is_replaced_in_its_place():
    evidence = ScaleEvidence((bar("A"), bar("B")), (square("C"),))
    changed = evidence.with_length(bar("A", length_m=3.0))
    assert [each.name for each in changed] == ["C", "A", "B"]
    assert changed["A"].length_m == 3.0
    # A square of a bar's name takes its place in the other list.
    assert [each.name for each in evidence.with_length(square("A"))] == ["C", "A", "B"]
    assert [each.name for each in evidence.without("A")] == ["C", "B"]
    assert [each.name for each in evidence.with_changed("B", bar("D"))] == ["C", "A", "D"]


def test_a_marker_found_again_keeps_what_a_person_said_of_it():
    key = ("DICT_4X4_50", 7)
    before = ScaleEvidence((), (square("D 7", marker=key, side_m=0.8, role="check"), square("mine")))
    after = before.with_found([square("D 7", marker=key, side_src=2.2)])
    assert (after["D 7"].side_m, after["D 7"].role) == (0.8, "check")
    assert after["D 7"].measured_src == pytest.approx(2.2)
    assert "mine" in after
    assert [each.name for each in before.with_found([])] == ["mine"]


def test_the_same_number_at_two_places_keeps_two_roles():
    key = ("D", 7)
    twins = [square("D 7", marker=key), square("D 7 (2)", marker=key, role="check")]
    after = ScaleEvidence((), tuple(twins)).with_found([replace(each, role="control") for each in twins])
    assert [each.role for each in after.squares] == ["control", "check"]


def test_a_found_marker_with_the_name_of_a_length_marked_by_hand_gets_another():
    after = ScaleEvidence((bar("D 7"),)).with_found([square("D 7", marker=("D", 7))])
    assert {each.name for each in after} == {"D 7", "D 7 (found)"}


def test_without_a_control_there_is_no_scale_and_why_is_said():
    report = ScaleEvidence((bar(role="check"),)).report()
    assert report.estimate is None and report.verdict.code == "no_control"


def test_evidence_is_a_value():
    sight = Sight("a.jpg", 1.5, 2.5)
    assert MarkedPoint((0, 0, 0), sights=[sight]).sights == (sight,)
    assert bar() == bar() and hash(bar()) == hash(bar())
    assert ScaleEvidence((bar(),)) == ScaleEvidence((bar(),))
