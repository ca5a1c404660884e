"""What is drawn in a section, in the frame of the source; tape values as people type them."""

import re

import numpy as np
import plots
import pytest

from dbh_studio.app.commands import correct_measurement
from dbh_studio.app.section_edits import (
    drawn_points,
    drawn_polygon,
    moved_words,
    other_heights,
    ring_in_source,
    tape_cm,
)
from dbh_studio.core.corrections import Correction
from dbh_studio.core.dbh import DbhEstimate, Refusal
from dbh_studio.core.interval_methods import estimator_settings
from dbh_studio.core.measured import Diameter
from dbh_studio.core.polygons import inside_polygon
from dbh_studio.core.stem_profile import ProfilePoint
from dbh_studio.core.tree_record import TreeRecord
from dbh_studio.errors import CommandError
from dbh_studio.ui.correction_html import corrections_html
from dbh_studio.ui.profile_svg import profile_svg


@pytest.mark.parametrize(
    ("text", "expected_cm"),
    [("31.5", 31.5), ("31,5 cm", 31.5), ("315 mm", 31.5), ("12.4 in", 31.496), ('12.4"', 31.496), (" 0.315 m", 31.5)],
)
def test_a_tape_value_is_read_in_the_unit_it_has(text, expected_cm):
    assert tape_cm(text) == pytest.approx(expected_cm)


@pytest.mark.parametrize("text", ["", "thick", "-3", "0", "nan", "inf", "3 ells"])
def test_what_is_no_tape_value_is_told(text):
    with pytest.raises(CommandError):
        tape_cm(text)


def test_points_inside_a_polygon_are_those_inside_a_circle():
    rng = np.random.default_rng(3)
    uv = rng.uniform(-2, 2, (5000, 2))
    angle = np.linspace(0, 2 * np.pi, 900, endpoint=False)
    inside = inside_polygon(uv, np.column_stack([np.cos(angle), np.sin(angle)]))
    radius = np.hypot(*uv.T)
    clear = np.abs(radius - 1) > 0.01
    assert np.array_equal(inside[clear], radius[clear] < 1)


def test_a_polygon_that_crosses_itself_follows_the_even_odd_rule():
    bow = np.array([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
    assert inside_polygon(np.array([[0.1, 0.5], [0.9, 0.5], [0.5, 0.9]]), bow).tolist() == [True, True, False]


@pytest.mark.parametrize(
    "payload",
    [None, "a", [], [[0, 0], [1, 1]], [[0, 0, 0]] * 4, [[0, 1], [2]], [[0, 0], [1, 1], [2, 2]],
     [[0, 0], [1, 0], [0, 1e9]], [[0, 0], [1, 0], [0, float("nan")]], [[0.0, 1.0]] * 5000],
)  # fmt: skip
def test_what_a_page_sends_is_a_polygon_or_refused(payload):
    with pytest.raises(CommandError):
        drawn_polygon(payload, at_least=3)


@pytest.mark.parametrize(("height_m", "anchor"), [(1.0, "start"), (2.0, "middle"), (3.0, "end")])
def test_the_height_in_the_picture_of_the_stem_keeps_clear_of_its_axis_and_edge(height_m, anchor):
    profile = tuple(ProfilePoint(1.0 + 0.1 * k, Diameter(30.0 - k, 29.0 - k, 31.0 - k), 360.0) for k in range(21))
    svg = profile_svg(profile, height_m=height_m, tree_id=3)
    (found,) = re.findall(rf'<text x="([0-9.]+)" y="[0-9.]+" text-anchor="(\w+)"[^>]*>{height_m:.2f} m</text>', svg)
    assert found[1] == anchor
    width = 48  # of "1.00 m", 12 px high, and the axis' "31 cm" ends at 40
    left = float(found[0]) - {"start": 0, "middle": width / 2, "end": width}[anchor]
    assert left >= 40 and left + width <= 340


def test_along_the_stem_the_line_is_dashed_where_nothing_was_measured():
    size = Diameter(30.0, 29.0, 31.0)
    seen = (0.5, 0.6, 0.7, 2.0, 3.0, 3.1)  # 2.0 alone
    profile = tuple(ProfilePoint(k / 10, size if k / 10 in seen else None, 90.0) for k in range(5, 32))
    svg = profile_svg(profile, height_m=1.3, tree_id=3)
    (solid,) = re.findall(r'data-profile d="([^"]+)"', svg)
    (dashed,) = re.findall(r'data-profile-unseen d="([^"]+)"[^>]*stroke-dasharray', svg)
    assert [part.count("L") for part in solid.split("M")[1:]] == [2, 0, 1]
    assert dashed.count("M") == dashed.count("L") == 2
    whole = profile_svg([ProfilePoint(h, size, 360.0) for h in seen[:3]], height_m=0.6, tree_id=3)
    assert 'data-profile-unseen d=""' in whole


def test_that_height_is_counted_along_the_stem_is_said_in_words():
    record = TreeRecord(corrections=(Correction("along", "stem", "", "", ""),))
    said = re.sub("<[^>]*>", "", corrections_html(record, Refusal("no_ring", "why", "what"), ""))
    assert "Height of a leaning stem along the stem" in said


def test_other_heights_are_the_nearest_that_have_a_diameter():
    size = Diameter(30.0, 29.0, 31.0)
    profile = tuple(ProfilePoint(h, size if h != 1.3 else None, 360.0) for h in (0.5, 1.0, 1.2, 1.3, 1.5, 3.0))
    assert [point.height_m for point in other_heights(profile, 1.3)] == [1.2, 1.5, 1.0]


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return plots.measured_session(tmp_path_factory.mktemp("plot"))


def test_the_last_points_of_a_section_are_not_left_out_in_two_strokes_either(session):
    document = session.document
    trunk_id = document.trunks.ids[0]
    section = session.measurement(trunk_id).result.section
    right, left = ([[0.0, -5.0], [s * 5.0, -5.0], [s * 5.0, 5.0], [0.0, 5.0]] for s in (1, -1))
    out = drawn_points(session, document, trunk_id, section, right)
    half = correct_measurement(trunk_id, Correction("left_out", tuple(out.tolist()))).apply(document)
    with pytest.raises(CommandError, match="no point of the section would be left"):
        drawn_points(session, half, trunk_id, section, left)
    with pytest.raises(CommandError, match="No point of the section lies there"):
        drawn_points(session, half, trunk_id, section, right)


def test_what_is_drawn_round_are_the_points_of_that_side(session):
    document = session.document
    trunk = document.trunks[document.trunks.ids[0]]
    stem = session.measurement(trunk.id)
    assert isinstance(stem.result, DbhEstimate)
    section = stem.result.section
    right = [[0.0, -5.0], [5.0, -5.0], [5.0, 5.0], [0.0, 5.0]]
    out = drawn_points(session, document, trunk.id, section, right)
    left = drawn_points(session, document, trunk.id, section, right, keep=True)
    assert not set(out) & set(left) and set(out) | set(left) <= set(trunk.points.tolist())
    shown = trunk.points[section.indices]
    assert set(shown[section.uv_m[:, 0] > 1e-6]) <= set(out)
    assert set(shown[section.uv_m[:, 0] < -1e-6]) <= set(left)


def test_what_is_left_out_goes_from_all_of_the_stem_that_is_measured(session):
    document = session.document
    trunk = document.trunks[document.trunks.ids[0]]
    stem = session.measurement(trunk.id)
    section, measured = stem.result.section, estimator_settings(document.settings.measure, "shrinkage")
    right = [[0.0, -5.0], [5.0, -5.0], [5.0, 5.0], [0.0, 5.0]]
    both = [drawn_points(session, document, trunk.id, section, right, keep=keep) for keep in (False, True)]
    points = session.points_world(document)[trunk.points]
    above_m = points[:, 2] - stem.z_ground_m - section.hom_m
    # Not those at its very ends: a millionth of a metre decides.
    inside = (above_m > 1e-5 - measured.below_m) & (above_m < measured.above_m - 1e-5)
    outside = (above_m < -1e-5 - measured.below_m) | (above_m > measured.above_m + 1e-5)
    assert inside.sum() > 500
    assert np.isin(trunk.points[inside], np.concatenate(both)).all()
    assert not np.isin(trunk.points[outside], np.concatenate(both)).any()


def test_to_leave_out_nothing_or_all_is_refused(session):
    document = session.document
    trunk_id = document.trunks.ids[0]
    section = session.measurement(trunk_id).result.section
    far, all_of_it = [[3, 3], [4, 3], [4, 4]], [[-9, -9], [9, -9], [9, 9], [-9, 9]]
    for polygon in (far, all_of_it):
        with pytest.raises(CommandError):
            drawn_points(session, document, trunk_id, section, polygon)


def test_a_ring_drawn_in_the_section_stands_there_in_the_source(session):
    document = session.document
    trunk_id = document.trunks.ids[0]
    stem = session.measurement(trunk_id)
    section = stem.result.section
    ring = np.array([[0.1, 0.0], [0.0, 0.1], [-0.1, 0.0], [0.0, -0.1]])
    world = document.world_from_source.apply(np.array(ring_in_source(session, document, trunk_id, section, ring)))
    back = section.stem_from_section.inverse().apply(world - [0.0, 0.0, stem.z_ground_m])
    assert np.allclose(back[:, :2], ring, atol=1e-5) and np.allclose(back[:, 2], 0.0, atol=1e-5)


def test_a_number_that_did_not_move_says_nothing(session):
    result = session.measurement(session.document.trunks.ids[0]).result
    assert moved_words(result, result) == ""
    assert moved_words(None, result) == f"no diameter → {result.dbh_cm:.1f} cm"
