"""Where a stem is measured: on slopes, along a lean, above what is swollen; against stems known by formula."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.corrections import Correction
from dbh_studio.core.dbh import DbhEstimate, measure_stem
from dbh_studio.core.inventory import TreeRecord, inventory_row
from dbh_studio.core.measured import Diameter
from dbh_studio.core.protocol_measure import measure_by_protocol
from dbh_studio.core.protocols import PROTOCOLS, Protocol, own_settings
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.stem_course import stem_course
from dbh_studio.core.swelling import profile_flag
from dbh_studio.core.transforms import Similarity
from dbh_studio.settings import MeasureSettings

SMOOTH = MeasureSettings(bark_share=0.0, bloat_m=0.0)
ANGLE = np.arange(72) * (2 * np.pi / 72)


def stem(radius=lambda z: 0.2 - 0.005 * z, *, z=(0.3, 5.0), n=20_000, arc_deg=360.0, lean_deg=0.0, noise=0.003, seed=0):
    """(N, 3) points of a stem whose radius is a function of its height, z above the ground."""
    rng = np.random.default_rng(seed)
    t, w = np.radians(rng.uniform(0, arc_deg, n)), rng.uniform(*z, n)
    r = radius(w) + noise * rng.standard_normal(n)
    lean = np.radians(lean_deg)
    tilt = np.array([[np.cos(lean), 0, np.sin(lean)], [0, 1, 0], [-np.sin(lean), 0, np.cos(lean)]])
    return np.column_stack([r * np.cos(t), r * np.sin(t), w]) @ tilt.T


def collar(z):
    """20 % thicker from 1.15 to 1.55 m, as of ivy."""
    return (0.2 - 0.005 * z) * np.where(np.abs(z - 1.35) < 0.2, 1.2, 1.0)


def whorl(z):
    return (0.2 - 0.005 * z) * (1.0 + 0.12 * np.exp(-(((z - 1.25) / 0.12) ** 2)))


def buttressed(z):
    """A cone up to 2 m on a stem that tapers by 2 cm of diameter per metre."""
    return 0.25 - 0.01 * z + np.maximum(0.0, 0.2 * (2.0 - z))


class TestCourse:
    @pytest.mark.parametrize(("arc_deg", "lean_deg", "dtype"), [(360, 0, "f8"), (170, 0, "f4"), (360, 15, "f8")])
    def test_sizes_are_those_of_the_formula(self, arc_deg, lean_deg, dtype):
        points = stem(arc_deg=arc_deg, lean_deg=lean_deg).astype(dtype)
        result = measure_stem(points, settings=SMOOTH)
        outline = result.fits["shrinkage"].outline_uv_m
        course = stem_course(points, result.section.stem_from_section, outline)
        along = course.height_m / np.cos(np.radians(lean_deg))
        hom = 1.3 / np.cos(np.radians(lean_deg))
        expected = np.log((0.2 - 0.005 * along) / (0.2 - 0.005 * hom))
        inner = course.seen & (np.abs(course.height_m - 1.3) < 0.9)
        assert inner.sum() >= 17
        np.testing.assert_allclose(course.log_size[inner], expected[inner], atol=0.012 if arc_deg == 360 else 0.03)

    def test_the_order_of_points_does_not_matter(self):
        points = stem()
        circle = 0.1935 * np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=1)
        frame = Similarity(np.eye(3), np.array([0.0, 0.0, 1.3]))
        one, other = (stem_course(each, frame, circle) for each in (points, points[::-1].copy()))
        np.testing.assert_allclose(one.log_size, other.log_size, atol=1e-9)

    @pytest.mark.parametrize("column", [0, 1, 2])
    def test_points_without_a_coordinate_change_nothing(self, column):
        points = stem(n=2000)
        circle = 0.1935 * np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=1)
        frame = Similarity(np.eye(3), np.array([0.0, 0.0, 1.3]))
        strange = points[:200].copy()
        strange[:, column] = np.nan
        one, other = (stem_course(each, frame, circle) for each in (points, np.vstack([strange, points])))
        np.testing.assert_allclose(one.log_size, other.log_size, atol=1e-9)

    def test_nothing_seen_is_no_size(self):
        circle = 0.2 * np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=1)
        frame = Similarity(np.eye(3), np.array([0.0, 0.0, 1.3]))
        for points in (np.empty((0, 3)), np.full((50, 3), np.nan), stem(z=(6.0, 7.0))):
            assert not stem_course(points, frame, circle).seen.any()
        hidden = stem()
        hidden = hidden[(hidden[:, 2] < 1.5) | (hidden[:, 2] > 2.0)]
        course = stem_course(hidden, frame, circle)
        assert not course.seen[(course.height_m > 1.55) & (course.height_m < 1.95)].any()
        assert course.seen[course.height_m < 1.45].all()


class TestAbove:
    @pytest.mark.parametrize("above", ["nothing", "bulge", "buttress"])
    @pytest.mark.parametrize(
        "points",
        [
            stem(),
            stem(lambda z: 0.05 - 0.006 * z, n=6000),
            stem(lambda z: 0.45 - 0.012 * z),
            stem(noise=0.015, n=4000),
            stem(arc_deg=200),
            stem(z=(0.9, 1.9)),
        ],
        ids=["plain", "thin", "thick", "noisy", "arc", "short"],
    )
    def test_a_regular_stem_is_measured_at_breast_height(self, points, above):
        result = measure_by_protocol(points, settings=SMOOTH.changed(above=above))
        assert result.hom_m == pytest.approx(1.30)
        assert not {"profile", "above_bulge", "above_buttress"} & set(result.flag_codes)

    @pytest.mark.parametrize("above", ["bulge", "buttress"])
    @pytest.mark.parametrize(("shape", "clear_m"), [(collar, 1.55), (whorl, 1.45)])
    def test_above_a_bulge(self, shape, clear_m, above):
        result = measure_by_protocol(stem(shape), settings=SMOOTH.changed(above=above))
        assert clear_m <= result.hom_m <= clear_m + 0.25
        assert result.dbh_cm == pytest.approx(200 * (0.2 - 0.005 * result.hom_m), rel=0.012)
        assert result.flag_codes[-1] == "above_bulge"
        assert f"measured at {result.hom_m:.2f} m, above a bulge" in result.flags[-1]
        assert "at 1.30 m it is" in result.flags[-1] and "thicker" in result.flags[-1]

    def test_above_a_buttress_and_clear_of_it(self):
        result = measure_by_protocol(stem(buttressed), settings=SMOOTH.changed(above="buttress"))
        assert 2.0 + 0.25 <= result.hom_m <= 2.45
        assert result.dbh_cm == pytest.approx(200 * (0.25 - 0.01 * result.hom_m), rel=0.012)
        assert result.flag_codes[-1] == "above_buttress"

    def test_a_buttress_is_no_bulge_and_a_plot_that_measures_above_nothing_measures_there(self):
        for above in ("nothing", "bulge"):
            result = measure_by_protocol(stem(buttressed), settings=SMOOTH.changed(above=above))
            assert result.hom_m == pytest.approx(1.30) and "buttress" in result.flag_codes
        assert measure_by_protocol(stem(whorl), settings=SMOOTH).hom_m == pytest.approx(1.30)

    def test_a_buttress_with_nothing_regular_above_is_refused(self):
        result = measure_by_protocol(stem(buttressed, z=(0.3, 1.9)), settings=SMOOTH.changed(above="buttress"))
        assert result.code == "not_regular"
        assert "buttress" in result.reason and "1.9 m" in result.reason and "by hand" in result.remedy
        assert result.section is not None and result.fits
        (ring,) = result.rings
        assert ring.radius_m == pytest.approx(result.section.ring_radius_m, rel=0.1)

    @pytest.mark.parametrize("curve", ["circle", "fourier"])
    def test_whichever_method(self, curve):
        settings = SMOOTH.changed(above="bulge", curve=curve, band_below_m=0.05, band_above_m=0.05)
        result = measure_by_protocol(stem(collar), settings=settings)
        assert result.curve == curve and result.hom_m > 1.54
        assert result.dbh_cm == pytest.approx(200 * (0.2 - 0.005 * result.hom_m), rel=0.02)


class TestAlong:
    @pytest.mark.parametrize("lean_deg", [10.0, 25.0])
    def test_breast_height_along_a_leaning_stem(self, lean_deg):
        points = stem(lambda z: 0.25 - 0.03 * z, lean_deg=lean_deg)
        upright = measure_by_protocol(points, settings=SMOOTH)
        along = measure_by_protocol(points, settings=SMOOTH.changed(along="stem"))
        cosine = np.cos(np.radians(lean_deg))
        assert upright.hom_m == pytest.approx(1.30)
        assert along.hom_m == pytest.approx(1.30 * cosine, abs=0.004)
        assert along.dbh_cm == pytest.approx(200 * (0.25 - 0.03 * 1.30), rel=0.006)
        assert upright.dbh_cm == pytest.approx(200 * (0.25 - 0.03 * 1.30 / cosine), rel=0.006)

    def test_the_lowest_height_a_person_may_ask_for(self):
        """Along the stem it is lower than that above the base, which must not stop a plot from being measured."""
        settings = own_settings([Correction("breast_height", 0.1), Correction("along", "stem")], SMOOTH)
        result = measure_by_protocol(stem(lean_deg=25.0, z=(0.0, 4.0)), settings=settings)
        assert result.hom_m == pytest.approx(0.1 * np.cos(np.radians(25.0)), abs=0.001)
        assert result.dbh_cm == pytest.approx(200 * (0.2 - 0.005 * 0.1), rel=0.02)

    def test_an_upright_stem_is_measured_the_same(self):
        one = measure_by_protocol(stem(), settings=SMOOTH)
        other = measure_by_protocol(stem(), settings=SMOOTH.changed(along="stem"))
        assert one.dbh_cm == pytest.approx(other.dbh_cm, rel=1e-4)
        assert other.hom_m == pytest.approx(1.30, abs=0.002)


class TestAssumedAxis:
    """What was not measured is not told as measured, nor as 0."""

    @pytest.mark.parametrize(
        ("points", "options", "source"),
        [
            (stem(), {"curve": "circle", "axis": "vertical"}, "vertical"),
            (stem(z=(1.2, 1.45)), {}, "prior"),
            (stem(), {}, "stem"),
            (stem(), {"curve": "circle"}, "stem"),
        ],
        ids=["vertical", "short", "shrinkage", "circle"],
    )
    def test_lean_and_taper_are_of_the_stem_or_unknown(self, points, options, source):
        result = measure_stem(points, settings=SMOOTH.changed(**options))
        row = inventory_row(
            result,
            plot_id="plot",
            stem_id=1,
            record=TreeRecord(),
            xy_m=np.zeros(2),
            z_ground_m=0.0,
            scale=ScaleEstimate(1.0, "factor"),
        )
        assert result.section.axis_source == source
        if source == "stem":
            assert row.lean_deg == pytest.approx(0.0, abs=0.3) and row.taper_cm_per_m == pytest.approx(1.0, abs=0.4)
        else:
            assert (row.lean_deg, row.taper_cm_per_m) == (None, None)


class TestProfile:
    def test_a_wrong_section_is_caught_without_asking(self):
        """A collar that a curve in a band believes."""
        result = measure_by_protocol(stem(collar), settings=SMOOTH.changed(curve="fourier"))
        assert isinstance(result, DbhEstimate) and result.dbh_cm > 45
        assert "profile" in result.flag_codes
        assert any("thicker than the stem above and below says" in words for words in result.flags)

    def test_the_scale_is_no_excuse_and_a_wide_interval_is(self):
        points = stem(collar)
        result = measure_stem(points, settings=SMOOTH.changed(curve="fourier"))
        course = stem_course(points, result.section.stem_from_section, result.fits["fourier"].outline_uv_m)
        value = result.dbh_cm
        wide = Diameter(value, 0.7 * value, 1.3 * value)
        assert profile_flag(course, result.hom_m, wide) is None
        assert profile_flag(course, result.hom_m, wide, scale_sd=0.18) is not None

    def test_with_the_stem_seen_on_one_side_of_breast_height_nothing_is_said(self):
        points = stem(collar)
        result = measure_by_protocol(points[points[:, 2] > 1.1], settings=SMOOTH.changed(curve="fourier"))
        assert "profile" not in result.flag_codes


def test_named_protocols_are_settings():
    for name, values in PROTOCOLS.items():
        settings = MeasureSettings().changed(**values)
        assert Protocol.of(settings).breast_height_m == values["breast_height_m"], name
    assert Protocol.of(MeasureSettings().changed(**PROTOCOLS["fia"])) == Protocol(1.3716, "uphill", "stem", "buttress")
    assert MeasureSettings().changed(**PROTOCOLS["paper"]) == MeasureSettings()
