"""What a person says about one stem's measurement reaches its diameter, and nobody else's."""

from __future__ import annotations

import numpy as np
import pytest
from tests.app.plots import make_session
from tests.threestems import STEMS, plot_cloud

from dbh_studio.app import commands
from dbh_studio.app.derived import stem_setup_of
from dbh_studio.app.document import Document, SourceInfo
from dbh_studio.app.pipeline import measure_stems, measurement_call
from dbh_studio.app.session import Session
from dbh_studio.core.corrections import Correction
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.trunks import TrunkSet

STEM_POINTS = [np.arange(30_000 + 12_000 * i, 42_000 + 12_000 * i) for i in range(3)]
ALL_VALUES = {
    "breast_height": 1.5,
    "base": "uphill",
    "along": "stem",
    "above": "bulge",
    "ground": (1.5, 2.0, 0.4),
    "curve": "circle",
    "left_out": tuple(range(30_000, 30_100)),
    "ring": ((1.3, 1.8, 1.3), (1.7, 1.8, 1.3), (1.7, 2.2, 1.3), (1.3, 2.2, 1.3)),
}


def plot(*, unit_m: float = 1.0) -> Session:
    cloud = plot_cloud(unit_m=unit_m)
    document = Document(
        "plot",
        SourceInfo.of(cloud, "plot.ply"),
        scale=ScaleEstimate(unit_m, "factor"),
        trunks=TrunkSet.from_point_sets(STEM_POINTS),
    )
    return Session(cloud, document)


def correct(session: Session, trunk_id: int, kind, value, **said) -> None:
    session.do(commands.correct_measurement(trunk_id, Correction(kind, value, **said)))


def circle(session: Session, trunk_id: int, *, z_m: float, diameter_m: float, n: int = 72, tilt: float = 0.0):
    """A ring around a stem, in the source's frame."""
    x, y, _ = STEMS[trunk_id - 1]
    angle = np.arange(n) * (2 * np.pi / n)
    world = np.column_stack([x + diameter_m / 2 * np.cos(angle), y + diameter_m / 2 * np.sin(angle), np.full(n, z_m)])
    world[:, 2] += tilt * (world[:, 0] - x)
    document = session.document
    offset = session.cloud.origin * document.scale.metres_per_unit
    return tuple(map(tuple, document.world_from_source.inverse().apply(world - offset)))


@pytest.mark.parametrize("kind", ALL_VALUES)
def test_only_the_corrected_stem_is_measured_again_and_undo_measures_none(kind):
    session, stages = make_session(n_points=100_000, n_trunks=40)
    calls = []
    inner = stages.measure_trunk

    def measure_trunk(*arguments, z_ground_m=None, ring_m=None, **options):
        calls.append(options["trunk_id"])
        return inner(*arguments, **options)

    session._derived._measure_trunk = measure_trunk
    session.inventory()
    calls.clear()
    correct(session, 7, kind, ALL_VALUES[kind])
    assert session.unmeasured() == (7,)
    session.inventory()
    assert calls == [7]
    session.undo()
    session.inventory()
    session.redo()
    row = session.inventory().rows[6]
    assert calls == [7]
    # Refused here, as every stem of these stand-ins: what was said of it stays.
    assert row.quality == "refused" and row.corrections == kind


@pytest.mark.parametrize(
    ("kind", "value"),
    [("tape", 31.5), ("tape_height", 1.3), ("breast_height", 1.30), ("base", "midpoint"), ("curve", "shrinkage")],
)
def test_a_tape_and_what_the_plot_does_anyhow_measure_nothing_again(kind, value):
    session, stages = make_session(n_trunks=3)
    session.inventory()
    stages.measured.clear()
    correct(session, 2, kind, value)
    assert session.unmeasured() == ()
    session.inventory()
    assert stages.measured == []


def test_who_when_and_why_measure_nothing_again():
    session, stages = make_session(n_trunks=3)
    correct(session, 2, "breast_height", 1.5, who="A", why="bulge")
    session.inventory()
    stages.measured.clear()
    session.do(commands.withdraw_correction(2, "breast_height"))
    correct(session, 2, "breast_height", 1.5, who="B", when="2026-01-01T00:00:00Z", why="scar")
    session.inventory()
    assert stages.measured == []


def test_a_stem_that_is_measured_otherwise_does_not_follow_the_plots_setting():
    session, stages = make_session(n_trunks=3)
    correct(session, 2, "curve", "ellipse")
    session.inventory()
    stages.measured.clear()
    session.do(commands.change_settings("measure", curve="ellipse"))
    session.inventory()
    assert sorted(stages.measured) == [1, 3]  # two threads, in either order


def test_own_height_ground_and_curve():
    session = plot()
    before = session.inventory().rows
    correct(session, 1, "breast_height", 2.1)
    correct(session, 2, "ground", (4.0, 5.5, 0.4))
    correct(session, 3, "curve", "ellipse")
    one, two, three = session.inventory().rows
    assert one.hom_m == pytest.approx(2.1) and two.hom_m == pytest.approx(1.3)
    assert one.corrections == "breast_height" and two.corrections == "ground"
    # The ground is the height of the place in the world, whose origin is the cloud's first floats here.
    ground_m = session.document.world_from_source.apply(np.array([[4.0, 5.5, 0.4]]))[0, 2]
    assert two.z_ground_m == pytest.approx(ground_m) and two.z_ground_m != pytest.approx(before[1].z_ground_m, abs=0.2)
    assert three.dbh_method == "ellipse" and three.dbh_lo_cm is None and before[2].dbh_method == "shrinkage"
    for row, (_, _, diameter) in zip((one, two, three), STEMS, strict=True):
        assert row.dbh_cm == pytest.approx(100 * diameter, rel=0.012)


def test_points_left_out_are_not_measured_and_the_others_keep_their_places():
    session = plot()
    trunk = session.document.trunks[1]
    xyz = session.cloud.xyz[trunk.points]
    away = trunk.points[xyz[:, 0] > np.median(xyz[:, 0]) + 0.05]
    correct(session, 1, "left_out", tuple(away.tolist()))
    stem = session.measurement(1)
    section = stem.result.section
    assert stem.n_points == len(trunk)
    assert stem.result.section.coverage_deg < 300
    assert not np.isin(trunk.points[section.indices], away).any()
    used = session.points_world()[trunk.points[section.indices], :2]
    middle = stem.result.section.stem_from_section.apply(np.column_stack([section.uv_m, np.zeros(len(section.uv_m))]))
    np.testing.assert_allclose(used, middle[:, :2], atol=0.02)
    full = [point.arc_deg for point in session.profile(1) if point.arc_deg is not None]
    assert max(full) < 300


def test_a_ring_drawn_in_the_picture_of_the_papers_band_lies_where_it_should():
    session = plot()
    correct(session, 2, "curve", "fourier")
    at = session.measurement(2).result.hom_m
    assert at == pytest.approx(1.37, abs=0.01)  # the middle of 1.22 to 1.52 m
    correct(session, 2, "ring", circle(session, 2, z_m=at, diameter_m=0.26))
    assert session.measurement(2).result.flag_codes == ("drawn",)


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_a_drawn_ring_is_the_diameter_at_its_own_height(tilt):
    session = plot()
    plain = session.measurement(2)
    correct(session, 2, "ring", circle(session, 2, z_m=1.7, diameter_m=0.26, tilt=tilt))
    stem = session.measurement(2)
    assert stem.result.curve == "drawn" and stem.result.interval is None
    assert stem.result.quality == "fair"
    for diameter in stem.result.diameters.values():
        assert diameter.value_cm == pytest.approx(26.0, rel=0.004)
    assert stem.result.hom_m == pytest.approx(1.7, abs=0.02)
    assert stem.result.flag_codes == ("drawn", "not_at_height")
    np.testing.assert_allclose(stem.xy_m, plain.xy_m, atol=0.01)
    row = session.inventory().rows[1]
    assert (row.dbh_method, row.dbh_lo_cm, row.quality) == ("drawn", None, "fair")


def test_a_ring_in_the_sections_plane_keeps_the_curves_to_compare_with():
    session = plot()
    hom = session.measurement(3).result.hom_m + session.measurement(3).z_ground_m
    at = float(hom + session.cloud.origin[2])
    correct(session, 3, "ring", circle(session, 3, z_m=at, diameter_m=0.40))
    compared = session.compared(3).result
    assert {"drawn", "shrinkage", "fourier", "ellipse"} <= set(compared.fits)
    assert compared.flag_codes == ("drawn",) and compared.dbh_cm == pytest.approx(40.0, rel=0.004)


def test_a_new_scale_leaves_a_ring_where_it_was_drawn():
    session = plot(unit_m=0.5)
    correct(session, 1, "ring", circle(session, 1, z_m=1.3, diameter_m=0.32))
    before = session.measurement(1)
    session.do(commands.set_scale(ScaleEstimate(1.0, "factor")))
    after = session.measurement(1)
    assert after.result.dbh_cm == pytest.approx(2 * before.result.dbh_cm, rel=1e-5)
    assert after.result.hom_m == pytest.approx(2 * before.result.hom_m, abs=0.03)
    np.testing.assert_allclose(after.xy_m, 2 * before.xy_m, atol=1e-3)


@pytest.mark.parametrize(
    ("ring", "word"),
    [
        ([(1.3, 1.8, 1.3), (1.7, 2.2, 1.3), (1.7, 1.8, 1.3), (1.3, 2.2, 1.3)], "crosses itself"),
        ([(1.3, 1.8, 1.3), (1.7, 1.8, 1.3), (1.5, 1.801, 1.3)], "a line"),
        ([(1.5, 2.0, 1.3), (1.505, 2.0, 1.3), (1.5, 2.005, 1.3)], "outside"),
        (2 * [(1.3, 1.8, 1.3), (1.7, 1.8, 1.3), (1.7, 2.2, 1.3), (1.3, 2.2, 1.3)], "more than once"),
        ([(4.3, 1.8, 1.3), (4.7, 1.8, 1.3), (4.7, 2.2, 1.3), (4.3, 2.2, 1.3)], "beside the stem"),
    ],
)
def test_a_ring_that_is_no_stem_is_refused_and_stays_said(ring, word):
    session = plot()
    correct(session, 1, "ring", tuple(ring))
    result = session.measurement(1).result
    assert not result and word in result.reason and ("again" in result.remedy or "own points" in result.remedy)
    assert session.inventory().rows[0].corrections == "ring"


def test_a_ring_gives_a_diameter_where_there_are_no_points():
    session = plot()
    points = session.document.trunks[1].points
    low = points[session.points_world()[points, 2] + session.cloud.origin[2] < 3.0]
    correct(session, 1, "left_out", tuple(low.tolist()))
    assert session.measurement(1).result.code == "no_band"
    correct(session, 1, "ring", circle(session, 1, z_m=1.3, diameter_m=0.30))
    result = session.measurement(1).result
    assert result.dbh_cm == pytest.approx(30.0, rel=0.004)
    assert result.quality == "poor" and result.section.coverage_deg == 0
    row = session.inventory().rows[0]
    assert row.rmse_mm is None and row.n_points == 0 and row.corrections == "left_out;ring"


def test_a_ring_round_the_second_stem_of_a_trunk_is_measured():
    session = plot()
    both = TrunkSet.from_point_sets([np.concatenate(STEM_POINTS[:2]), STEM_POINTS[2]])
    session.do(commands.replace_trunks(both))
    trunk_id = max(session.document.trunks, key=len).id
    for stem, (_, _, diameter_m) in enumerate(STEMS[:2], 1):
        correct(session, trunk_id, "ring", circle(session, stem, z_m=1.3, diameter_m=diameter_m))
        assert session.measurement(trunk_id).result.dbh_cm == pytest.approx(100 * diameter_m, rel=0.01)


def test_a_ring_of_a_stem_without_any_point_is_refused_with_what_to_do():
    session = plot()
    correct(session, 1, "left_out", tuple(session.document.trunks[1].points.tolist()))
    correct(session, 1, "ring", circle(session, 1, z_m=1.3, diameter_m=0.30))
    result = session.measurement(1).result
    assert result.code == "no_points" and "left out by hand" in result.reason and "Withdraw" in result.remedy
    row = session.inventory().rows[0]
    assert row.dbh_cm is None and row.quality == "refused"


def half_seen() -> Session:
    """The plot, which asks for more of a ring than was seen of the first stem."""
    session = plot()
    trunk = session.document.trunks[1]
    away = trunk.points[session.cloud.xyz[trunk.points, 0] > np.median(session.cloud.xyz[trunk.points, 0]) + 0.02]
    correct(session, 1, "left_out", tuple(away.tolist()))
    session.do(commands.change_settings("measure", min_coverage_deg=250.0))
    return session


def test_an_arc_that_a_person_accepts_gives_a_diameter_that_says_so():
    session = half_seen()
    assert session.measurement(1).result.code == "small_arc"
    others = [session.measurement(i).result.flag_codes for i in (2, 3)]
    correct(session, 1, "least_arc", 120.0)
    result = session.measurement(1).result
    assert result.dbh_cm == pytest.approx(30.0, rel=0.03) and result.interval is not None
    assert result.flag_codes[-1] == "arc_accepted" and "by hand" in result.flags[-1]
    assert [session.measurement(i).result.flag_codes for i in (2, 3)] == others
    row = session.inventory().rows[0]
    assert row.corrections == "least_arc;left_out" and "arc_accepted" in row.flags
    # A plot that is content with less needs nobody's word for it.
    session.do(commands.change_settings("measure", min_coverage_deg=90.0))
    assert "arc_accepted" not in session.measurement(1).result.flag_codes
    session.do(commands.withdraw_correction(1, "least_arc"))
    session.do(commands.change_settings("measure", min_coverage_deg=250.0))
    assert session.measurement(1).result.code == "small_arc"


def test_an_arc_that_was_accepted_is_measured_in_a_job_as_here():
    session = half_seen()
    correct(session, 1, "least_arc", 120.0)
    here = session.measurement(1).result
    other = Session(session.cloud, session.document)
    other.remember_measurements(other.document, measure_stems(*measurement_call(other, other.document)))
    assert other.unmeasured() == () and other.measurement(1).result.flag_codes == here.flag_codes


def test_a_job_measures_as_the_session_does():
    session = plot()
    correct(session, 1, "breast_height", 1.8)
    correct(session, 2, "ring", circle(session, 2, z_m=1.3, diameter_m=0.25))
    correct(session, 3, "left_out", tuple(STEM_POINTS[2][::2].tolist()))
    here = [stem.result.dbh_cm for stem in session.measurements()]
    other = Session(session.cloud, session.document)
    other.remember_measurements(other.document, measure_stems(*measurement_call(other, other.document)))
    assert other.unmeasured() == ()
    assert [stem.result.dbh_cm for stem in other.measurements()] == here


def test_a_tape_is_carried_and_never_mixed():
    session = plot()
    before = session.inventory().rows[0]
    correct(session, 1, "tape", 35.0)
    after = session.inventory().rows[0]
    assert (after.field_tape_cm, before.field_tape_cm) == (35.0, None)
    assert after.dbh_cm == before.dbh_cm and after.corrections == ""


def test_an_own_height_is_not_moved_by_the_plots_rule_for_swollen_stems():
    session = plot()
    session.do(commands.change_settings("measure", above="buttress"))
    correct(session, 1, "breast_height", 1.5)
    assert stem_setup_of(session.document, 1).settings.above == "nothing"
    correct(session, 1, "above", "bulge")
    assert stem_setup_of(session.document, 1).settings.above == "bulge"
    assert stem_setup_of(session.document, 2).settings.above == "buttress"
