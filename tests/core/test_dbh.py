"""The diameter: right on shapes with a known perimeter, refused with a reason where it cannot be given."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ellipe

from dbh_studio.core import dbh
from dbh_studio.core.curves import CURVES
from dbh_studio.core.dbh import CurveFit, DbhEstimate, Refusal
from dbh_studio.core.quality import disagreement_of
from dbh_studio.settings import MeasureSettings


def paper(**values) -> MeasureSettings:
    """The paper's Fourier curve and perimeter/π, with some settings changed: what these tests are about."""
    return MeasureSettings(**{"curve": "fourier", "definition": "curve", **values})


def measure_stem(points, *, settings=None, **others):
    """As `dbh.measure_stem`, by Fourier where nothing else is said."""
    return dbh.measure_stem(points, settings=paper() if settings is None else settings, **others)


DATA = Path(__file__).parents[2].parent / "shared" / "data"


def stem(outline, n=4000, lean_deg=0.0, z=(0.3, 3.0), noise=0.002, arc_deg=360.0, seed=0):
    """A leaning prism: `outline` gives (N, 2) of (N,) angles."""
    rng = np.random.default_rng(seed)
    t, w = rng.uniform(0, np.radians(arc_deg), n), rng.uniform(*z, n)
    uv = outline(t)
    uv = uv * (1 + noise * rng.standard_normal((n, 1)) / np.hypot(uv[:, :1], uv[:, 1:]))
    lean = np.radians(lean_deg)
    tilt = np.array([[np.cos(lean), 0, np.sin(lean)], [0, 1, 0], [-np.sin(lean), 0, np.cos(lean)]])
    return np.column_stack([uv, w]) @ tilt.T


def ellipse(a, b):
    return lambda t: np.stack([a * np.cos(t), b * np.sin(t)], axis=1)


def circle(radius=0.2):
    return ellipse(radius, radius)


def wavy(t):
    r = 0.2 * (1 + 0.05 * np.cos(2 * t + 0.4))
    return np.stack([r * np.cos(t), r * np.sin(t)], axis=1)


def polygon_perimeter(outline):
    uv = outline(np.linspace(0, 2 * np.pi, 20001))
    return np.hypot(*np.diff(uv, axis=0).T).sum()


def diameters_cm(result):
    return {name: 100 * fit.diameter_m("curve") for name, fit in result.fits.items() if isinstance(fit, CurveFit)}


TOLERANCE = {"fourier": 0.004, "ellipse": 0.004, "bspline": 0.04}


class TestTruth:
    @pytest.mark.parametrize("name", CURVES)
    @pytest.mark.parametrize("radius", [0.06, 0.2, 0.6])
    def test_circle(self, name, radius):
        result = measure_stem(stem(circle(radius)), settings=paper(curve=name))
        assert isinstance(result, DbhEstimate)
        assert result.dbh_cm == pytest.approx(200 * radius, rel=TOLERANCE[name] * max(1.0, 0.2 / radius))
        assert result.curve == name

    @pytest.mark.parametrize("name", ["fourier", "ellipse"])
    @pytest.mark.parametrize("b", [0.18, 0.15])
    def test_ellipse(self, name, b):
        truth = 100 * 4 * 0.2 * ellipe(1 - (b / 0.2) ** 2) / np.pi
        result = measure_stem(stem(ellipse(0.2, b)), settings=paper(curve=name))
        assert result.dbh_cm == pytest.approx(truth, rel=0.004)

    def test_fourier_shape(self):
        assert measure_stem(stem(wavy)).dbh_cm == pytest.approx(100 * polygon_perimeter(wavy) / np.pi, rel=0.003)

    @pytest.mark.parametrize("name", ["fourier", "ellipse"])
    @pytest.mark.parametrize("lean_deg", [5.0, 20.0, 40.0])
    def test_leaning_stem_is_measured_across_itself(self, name, lean_deg):
        """A horizontal section of a 20° lean would read 3 % more, of 40° 15 %."""
        result = measure_stem(stem(circle(), lean_deg=lean_deg), settings=paper(curve=name))
        assert result.dbh_cm == pytest.approx(40.0, rel=0.004)
        assert any("leans" in flag for flag in result.flags) == (lean_deg > 10)

    def test_upright_axis_reads_a_leaning_stem_too_thick(self):
        result = measure_stem(stem(circle(), lean_deg=30.0), settings=paper(axis="vertical"))
        assert result.dbh_cm > 41.0

    def test_definitions(self):
        points = stem(ellipse(0.2, 0.12))
        found = {d: measure_stem(points, settings=paper(definition=d)).dbh_cm for d in ("curve", "tape", "area")}
        assert found["area"] == pytest.approx(200 * np.sqrt(0.2 * 0.12), rel=0.01)
        assert found["area"] < found["tape"] <= found["curve"] * (1 + 1e-9)

    def test_tape_bridges_a_hollow(self):
        def peanut(t):
            r = 0.2 * (1 + 0.3 * np.cos(2 * t))
            return np.stack([r * np.cos(t), r * np.sin(t)], axis=1)

        loose = paper(ring_gate=0.0, ransac_tolerance_m=0.1, tolerance_share=0.0)
        fit = measure_stem(stem(peanut), settings=loose).fits["fourier"]
        assert fit.diameter_m("tape") < 0.999 * fit.diameter_m("curve")

    def test_unknown_definition(self):
        fit = measure_stem(stem(circle())).fits["fourier"]
        with pytest.raises(ValueError, match="girth"):
            fit.diameter_m("girth")

    def test_position_is_the_ring_at_the_height_of_measurement(self):
        result = measure_stem(stem(circle(), lean_deg=20.0) + np.array([5, 6, 0]))
        np.testing.assert_allclose(result.position_m, [5 + 1.37 * np.tan(np.radians(20)), 6, 1.37], atol=0.005)

    def test_outline_and_inliers_belong_to_the_section(self):
        result = measure_stem(stem(circle()))
        for fit in result.fits.values():
            assert fit.inliers.shape == (len(result.section.uv_m),)
            assert np.hypot(*fit.outline_uv_m.T).mean() == pytest.approx(0.2, rel=0.03)
        assert result.n_points == result.fits["fourier"].inliers.sum()
        assert result.rmse_mm == pytest.approx(2.0, rel=0.2)


class TestHardInput:
    def test_shifted_far(self):
        near, far = stem(circle()), stem(circle()) + np.array([1e5, -2e5, 0])
        assert measure_stem(far).dbh_cm == pytest.approx(measure_stem(near).dbh_cm, rel=1e-3)

    def test_float32(self):
        points = stem(circle())
        result = measure_stem(points.astype(np.float32))
        assert result.dbh_cm == pytest.approx(measure_stem(points).dbh_cm, rel=2e-3)

    def test_nan_points_are_left_out(self):
        points = stem(circle())
        spoilt = np.concatenate([np.full((50, 3), np.nan), points, [[np.inf, 0, 1.3], [0, 0, -np.inf]]])
        result = measure_stem(spoilt)
        assert result.dbh_cm == pytest.approx(measure_stem(points).dbh_cm, rel=1e-9)
        assert result.section.indices.min() >= 50

    def test_duplicates(self):
        points = stem(circle())
        assert measure_stem(np.repeat(points, 3, axis=0)).dbh_cm == pytest.approx(40.0, rel=0.004)

    def test_clutter(self):
        """Ferns, a branch stub and a neighbour make up a third of the band."""
        rng = np.random.default_rng(3)
        fern = rng.uniform([-0.6, -0.6, 0.3], [0.6, 0.6, 1.6], (800, 3))
        stub = rng.uniform([0.2, -0.03, 1.35], [0.45, 0.03, 1.42], (80, 3))
        neighbour = stem(circle(0.06), n=400, seed=4) + np.array([0.34, 0.2, 0])
        result = measure_stem(np.concatenate([stem(circle(), noise=0.005), fern, stub, neighbour]))
        assert result.dbh_cm == pytest.approx(40.0, rel=0.03)

    def test_integers_are_points_too(self):
        assert not measure_stem(np.zeros((5, 3), int))

    def test_wrong_shape(self):
        with pytest.raises(ValueError, match=r"\(5, 2\)"):
            measure_stem(np.zeros((5, 2)))

    def test_unknown_curve(self):
        with pytest.raises(ValueError, match="hexagon"):
            measure_stem(stem(circle()), curves=("hexagon",))

    def test_crowded_band(self):
        result = measure_stem(stem(circle(), n=60_000, z=(1.0, 1.7), noise=0.01))
        assert len(result.section.uv_m) > 20_000
        assert result.dbh_cm == pytest.approx(40.0, rel=0.01)


def refused(points, **options):
    result = measure_stem(points, settings=paper(**options))
    assert isinstance(result, Refusal)
    assert not result
    assert result.reason.endswith(".")
    assert result.remedy.endswith(".")
    return result


class TestRefusals:
    def test_no_points(self):
        assert refused(np.empty((0, 3))).code == "no_points"

    def test_only_nan(self):
        assert refused(np.full((100, 3), np.nan)).code == "no_points"

    @pytest.mark.parametrize(
        ("z", "words"), [((1.8, 6.0), "above it, from 1.8"), ((0.1, 1.0), "below it, from 0.1")], ids=["above", "below"]
    )
    def test_band_not_seen_says_where_the_stem_is(self, z, words):
        refusal = refused(stem(circle(), z=z))
        assert refusal.code == "no_band"
        assert words in refusal.reason

    def test_band_hidden_between(self):
        points = stem(circle())
        refusal = refused(points[(points[:, 2] < 1.2) | (points[:, 2] > 1.6)])
        assert refusal.code == "no_band"
        assert "below and above" in refusal.reason

    def test_too_few_points(self):
        refusal = refused(stem(circle(), n=100, z=(0.3, 3)))
        assert refusal.code == "too_few_points"
        assert "30 are needed" in refusal.reason

    @pytest.mark.parametrize(
        "band",
        [
            np.tile([0.0, 0.0, 1.3], (200, 1)),
            np.stack([np.linspace(0, 1, 200), np.zeros(200), np.full(200, 1.3)], axis=1),
            np.array([[0, 0, 1.3], [0.2, 0, 1.3], [0, 0.2, 1.3]] * 40),
        ],
        ids=["one spot", "line", "three points"],
    )
    def test_no_ring(self, band):
        assert refused(band).code in {"no_ring", "small_arc", "no_curve", "implausible"}

    def test_small_arc(self):
        refusal = refused(stem(circle(), arc_deg=70))
        assert refusal.code == "small_arc"
        assert "90° are needed" in refusal.reason
        assert refusal.section is not None
        assert refusal.section.coverage_deg < 90

    def test_arc_of_90_degrees_is_at_best_poor(self):
        result = measure_stem(stem(circle(), arc_deg=90, noise=0.004), settings=paper(min_coverage_deg=60))
        assert not result or result.quality == "poor"

    def test_diameter_beyond_the_limits(self):
        refusal = refused(stem(circle(0.06)), min_diameter_cm=20.0)
        assert refusal.code == "implausible"
        assert "outside 20 to 300 cm" in refusal.reason
        assert set(refusal.fits) == set(CURVES)

    def test_curve_far_from_the_ring(self):
        """A Fourier series is free where nothing was seen; an ellipse hugs a short arc."""
        refusal = refused(stem(circle(), arc_deg=60, noise=0.006), min_coverage_deg=0)
        assert refusal.code == "implausible"
        assert "where a circle gives" in refusal.reason
        assert "does not go round" in refusal.fits["ellipse"].reason

    def test_heap(self):
        heap = np.random.default_rng(0).uniform(-1, 1, (3000, 3)) * [1, 1, 0.15] + [0, 0, 1.37]
        result = measure_stem(heap)
        assert not result or result.quality == "poor"


class TestQuality:
    def test_good(self):
        result = measure_stem(stem(circle()))
        assert result.quality == "good"
        assert result.flags == ()

    def test_half_seen_is_poor_and_says_so(self):
        result = measure_stem(stem(circle(), arc_deg=180))
        assert result.quality == "poor"
        assert any(flag.startswith("only 1") and flag.endswith("° of the ring seen") for flag in result.flags)

    def test_two_thirds_seen_is_fair(self):
        assert measure_stem(stem(circle(), arc_deg=265)).quality == "fair"

    def test_few_points(self):
        result = measure_stem(stem(circle(), n=700))
        assert any(flag.startswith("few points") for flag in result.flags)
        assert result.quality == "fair"

    def test_thick_ring(self):
        result = measure_stem(stem(circle(), noise=0.03))
        assert any("thick ring" in flag for flag in result.flags)
        assert result.quality != "good"

    def test_upright_for_want_of_stem(self):
        result = measure_stem(stem(circle(), z=(1.1, 1.6)))
        assert result.section.axis_source == "vertical"
        assert any("taken as upright" in flag for flag in result.flags)

    def test_ground_note_is_passed_on(self):
        assert "no ground" in measure_stem(stem(circle()), ground_note="no ground").flags

    def test_disagreement_is_with_the_middle_of_the_others(self):
        assert disagreement_of(1.0, [1.0, 1.0, 1.4]) == 0.0
        assert disagreement_of(0.9, [1.0, 1.0, 1.4]) == pytest.approx(0.1)

    def test_disagreement_is_flagged(self):
        result = measure_stem(stem(circle(), noise=0.02), settings=paper(curve="bspline"))
        (flag,) = (flag for flag in result.flags if flag.startswith("curves disagree by"))
        assert "Fourier" in flag and "B-spline" in flag and "ellipse" in flag


class TestChoices:
    def test_only_the_chosen_curve_on_request_and_the_same_diameter(self):
        points = stem(circle(), noise=0.01)
        alone = measure_stem(points, curves=())
        assert set(alone.fits) == {"fourier"}
        assert alone.dbh_cm == measure_stem(points).dbh_cm

    def test_all_by_default(self):
        assert list(measure_stem(stem(circle()), settings=paper(curve="ellipse")).fits) == [
            "ellipse", "fourier", "bspline",
        ]  # fmt: skip

    def test_paper_exactly(self):
        """No gate, fixed tolerance: on a clean ring the departures change nothing."""
        points = stem(circle())
        assert measure_stem(points, settings=MeasureSettings.paper()).dbh_cm == pytest.approx(40.0, rel=0.003)

    def test_polar_origin_at_the_centroid_reads_half_a_noisy_ring_less_well(self):
        ring, centroid = (
            np.median([
                abs(measure_stem(points, settings=paper(polar_origin=origin), curves=()).dbh_cm - 40.0)
                for points in (stem(circle(), n=12_000, arc_deg=180, noise=0.02, seed=seed) for seed in range(8))
            ])
            for origin in ("ring", "centroid")
        )  # fmt: skip
        assert ring < 0.85 * centroid

    def test_gate_keeps_the_neighbour_out(self):
        points = np.concatenate([stem(circle(), n=3000), stem(circle(0.15), n=2500, seed=1) + np.array([0.55, 0, 0])])
        assert measure_stem(points).dbh_cm == pytest.approx(40.0, rel=0.02)

    def test_seed_repeats(self):
        points = stem(circle(), noise=0.02)
        assert measure_stem(points, seed=5).dbh_cm == measure_stem(points, seed=5).dbh_cm
        assert measure_stem(points, seed=5).dbh_cm == pytest.approx(measure_stem(points, seed=6).dbh_cm, rel=0.01)


class TestProperties:
    @settings(max_examples=10, deadline=None)
    @given(seed=st.integers(0, 2**16))
    def test_order_of_points_does_not_matter(self, seed):
        points = stem(wavy, n=2000, noise=0.01)
        shuffled = np.random.default_rng(seed).permutation(points)
        assert diameters_cm(measure_stem(shuffled)) == diameters_cm(measure_stem(points))

    @settings(max_examples=10, deadline=None)
    @given(angle=st.floats(-np.pi, np.pi), lean_deg=st.floats(0, 25))
    def test_rotation_about_the_vertical_does_not_matter(self, angle, lean_deg):
        points = stem(wavy, n=3000, noise=0.005, lean_deg=lean_deg)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        assert measure_stem(points @ turn.T).dbh_cm == pytest.approx(measure_stem(points).dbh_cm, rel=0.003)

    @settings(max_examples=10, deadline=None)
    @given(scale=st.floats(0.4, 3.0))
    def test_diameter_is_linear_in_scale(self, scale):
        base = paper()
        scaled = paper(
            breast_height_m=1.3 * scale, band_below_m=0.08 * scale, band_above_m=0.22 * scale,
            ransac_tolerance_m=0.05 * scale,
        )  # fmt: skip
        points = stem(wavy, n=3000, noise=0.005)
        expected = scale * measure_stem(points, settings=base).dbh_cm
        assert measure_stem(scale * points, settings=scaled).dbh_cm == pytest.approx(expected, rel=0.002)

    @settings(max_examples=25, deadline=None)
    @given(points=st.lists(st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(1.22, 1.52)), max_size=60))
    def test_never_zero_and_never_an_exception(self, points):
        result = measure_stem(np.array(points, float).reshape(-1, 3), settings=paper(min_points=8))
        if result:
            assert 2.0 <= result.dbh_cm <= 300.0
            assert np.isfinite(result.position_m).all()
        else:
            assert result.reason


def test_field_tape_of_eight_real_stems():
    folder = DATA / "treescope_trunk_slices"
    if not folder.is_dir():
        pytest.skip(f"the real stems are not at {folder.name} beside the repository")
    errors = []
    for row in csv.DictReader((folder / "reference.csv").read_text().splitlines()):
        raw = (folder / row["file"]).read_bytes()
        points = np.frombuffer(raw[raw.index(b"DATA binary\n") + 12 :], "<f4").reshape(-1, 3)
        result = measure_stem(points, curves=())
        assert isinstance(result, DbhEstimate)
        errors.append(result.dbh_cm - float(row["dbh_cm"]))
    assert np.sqrt(np.mean(np.square(errors))) < 1.5
    assert len(errors) == 8


def test_a_curve_beside_the_chosen_one_has_the_scales_error_and_its_own_points():
    points = stem(circle(), noise=0.01)
    points[:, :2] += [3.0, -2.0]
    chosen = MeasureSettings(curve="shrinkage")
    sure, unsure = (
        dbh.measure_stem(points, settings=chosen, curves=["circle"], scale_sd=sd).fits["circle"] for sd in (0.0, 0.05)
    )
    assert unsure.diameter("tape").half_width > 2.0 * sure.diameter("tape").half_width
    assert unsure.diameter("tape").value_cm == sure.diameter("tape").value_cm
    alone = dbh.measure_stem(points, settings=MeasureSettings(curve="circle"), curves=[]).fits["circle"]
    assert abs(int(sure.inliers.sum()) - int(alone.inliers.sum())) <= 0.01 * len(points)


def test_a_paper_curve_is_compared_with_the_scales_error_too():
    fits = [measure_stem(stem(circle()), curves=["shrinkage"], scale_sd=sd).fits["shrinkage"] for sd in (0.0, 0.05)]
    assert fits[1].diameter("tape").half_width > 2.0 * fits[0].diameter("tape").half_width
