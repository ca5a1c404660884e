"""The cross-section: the stem's own axis, the ring in the band, and how much of it was seen."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.dbh import axis_of_stem, measure_stem
from dbh_studio.core.section import ring_coverage
from dbh_studio.settings import MeasureSettings

FOURIER = MeasureSettings(curve="fourier")


def stem(radius=0.2, n=4000, lean_deg=0.0, toward_deg=0.0, z=(0.3, 3.0), noise=0.003, arc_deg=360.0, taper=0.0, seed=0):
    """A leaning (tapered) cylinder whose axis passes the origin."""
    rng = np.random.default_rng(seed)
    t, w = rng.uniform(0, np.radians(arc_deg), n), rng.uniform(*z, n)
    r = radius - taper * w + noise * rng.standard_normal(n)
    lean, toward = np.radians(lean_deg), np.radians(toward_deg)
    points = np.stack([r * np.cos(t), r * np.sin(t), w], axis=1)
    tilt = np.array([[np.cos(lean), 0, np.sin(lean)], [0, 1, 0], [-np.sin(lean), 0, np.cos(lean)]])
    turn = np.array([[np.cos(toward), -np.sin(toward), 0], [np.sin(toward), np.cos(toward), 0], [0, 0, 1]])
    return points @ tilt.T @ turn.T


class TestAxis:
    @pytest.mark.parametrize("lean_deg", [0.0, 3.0, 20.0, 40.0])
    @pytest.mark.parametrize("toward_deg", [0.0, 130.0])
    def test_lean_and_direction(self, lean_deg, toward_deg):
        axis = axis_of_stem(stem(lean_deg=lean_deg, toward_deg=toward_deg))
        truth = np.array([np.sin(np.radians(lean_deg)), 0, np.cos(np.radians(lean_deg))])
        turn = np.radians(toward_deg)
        truth = np.array([truth[0] * np.cos(turn), truth[0] * np.sin(turn), truth[2]])
        assert axis.source == "stem"
        assert np.degrees(np.arccos(min(1.0, axis.direction @ truth))) < 0.3
        np.testing.assert_allclose(axis.xy_at(0.0), [0, 0], atol=0.005)

    def test_one_sided_stem_does_not_seem_to_lean(self):
        axis = axis_of_stem(stem(arc_deg=150, taper=0.01, noise=0.006))
        assert axis.source == "stem"
        assert axis.lean_deg < 1.0

    def test_branch_and_neighbour_do_not_turn_it(self):
        rng = np.random.default_rng(1)
        branch = np.array([0.2, 0, 2.0]) + rng.uniform(0, 1, (400, 1)) * [0.8, 0.1, 0.3]
        neighbour = stem(0.1, n=1000, seed=2) + np.array([0.55, 0.1, 0])
        axis = axis_of_stem(np.concatenate([stem(), branch, neighbour]))
        assert axis.lean_deg < 0.5
        np.testing.assert_allclose(axis.xy_at(1.3), [0, 0], atol=0.01)

    def test_band_shorter_than_thick_is_taken_as_upright(self):
        """Its first principal axis would lie across the stem."""
        axis = axis_of_stem(stem(z=(1.1, 1.5), lean_deg=5.0))
        assert axis.source == "vertical"
        np.testing.assert_array_equal(axis.direction, [0, 0, 1])

    def test_vertical_by_setting(self):
        assert axis_of_stem(stem(lean_deg=10.0), settings=MeasureSettings(axis="vertical")).source == "vertical"

    def test_heap_has_no_axis_but_does_not_fail(self):
        heap = np.random.default_rng(0).uniform(-1, 1, (500, 3)) + np.array([0, 0, 1.5])
        assert axis_of_stem(heap).lean_deg <= 45.0

    def test_rotation_is_proper_with_u_along_x(self):
        rotation = axis_of_stem(stem(lean_deg=20.0, toward_deg=70.0)).rotation()
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        assert rotation[0, 0] > 0.9

    def test_no_finite_point(self):
        with pytest.raises(ValueError, match="no axis"):
            axis_of_stem(np.full((5, 3), np.nan))


class TestSection:
    def test_frame_band_and_height(self):
        points = stem(lean_deg=20.0, toward_deg=40.0) + np.array([3.0, -2.0, 0.0])
        section = measure_stem(points, settings=FOURIER).section
        assert section.band_m == pytest.approx((1.22, 1.52))
        assert section.hom_m == pytest.approx(1.37)
        assert section.lean_deg == pytest.approx(20.0, abs=0.3)
        back = section.stem_from_section.inverse().apply(points[section.indices])
        np.testing.assert_allclose(back[:, :2], section.uv_m, atol=1e-9)
        centre = section.stem_from_section.translation
        assert centre[2] == pytest.approx(1.37)
        along = 1.37 * np.tan(np.radians(20.0))
        truth = [3 + along * np.cos(np.radians(40)), -2 + along * np.sin(np.radians(40))]
        np.testing.assert_allclose(centre[:2], truth, atol=0.005)

    def test_holds_every_point_of_the_band_and_no_other(self):
        points = stem()
        section = measure_stem(points, settings=FOURIER).section
        inside = (points[:, 2] >= 1.22) & (points[:, 2] <= 1.52)
        assert sorted(section.indices) == np.flatnonzero(inside).tolist()

    @pytest.mark.parametrize("breast_height_m", [1.30, 1.37, 1.40])
    def test_breast_height_moves_the_band(self, breast_height_m):
        section = measure_stem(stem(), settings=FOURIER.changed(breast_height_m=breast_height_m)).section
        assert section.band_m == pytest.approx((breast_height_m - 0.08, breast_height_m + 0.22))
        assert section.hom_m == pytest.approx(breast_height_m + 0.07)

    def test_ring_and_what_is_near_it(self):
        fern = np.random.default_rng(0).uniform([0.5, -0.3, 1.2], [0.8, 0.3, 1.55], (100, 3))
        section = measure_stem(np.concatenate([stem(), fern]), settings=FOURIER).section
        assert section.ring_radius_m == pytest.approx(0.2, rel=0.01)
        assert section.near_ring[section.indices < 4000].all()
        assert not section.near_ring[section.indices >= 4000].any()

    def test_arrays_are_read_only(self):
        section = measure_stem(stem(), settings=FOURIER).section
        for array in (section.uv_m, section.indices, section.near_ring):
            assert not array.flags.writeable


class TestCoverage:
    @pytest.mark.parametrize("n", [200, 3000])
    @pytest.mark.parametrize("arc_deg", [360.0, 270.0, 180.0, 90.0])
    def test_arc(self, arc_deg, n):
        angles = np.radians(20.0) + np.random.default_rng(0).uniform(0, np.radians(arc_deg), n)
        angles = (angles + np.pi) % (2 * np.pi) - np.pi
        coverage_deg, gap_deg = ring_coverage(angles)
        assert coverage_deg == pytest.approx(arc_deg, abs=25 if n < 500 else 10)
        assert gap_deg == pytest.approx(360 - arc_deg, abs=25 if n < 500 else 10)

    def test_two_faces(self):
        t = np.random.default_rng(0).uniform(0, np.radians(60), 2000)
        coverage_deg, gap_deg = ring_coverage(np.concatenate([t, t - np.pi]))
        assert coverage_deg == pytest.approx(120, abs=10)
        assert gap_deg == pytest.approx(120, abs=10)

    def test_stray_points_do_not_make_a_side_seen(self):
        rng = np.random.default_rng(0)
        seen, stray = rng.uniform(-1.5, 1.5, 5000), rng.uniform(-np.pi, np.pi, 60)
        assert ring_coverage(np.concatenate([seen, stray]))[0] < 190

    def test_few_points_all_round(self):
        assert ring_coverage(np.linspace(-np.pi, np.pi, 40, endpoint=False)) == (360.0, 0.0)

    def test_nothing_and_one_point(self):
        assert ring_coverage(np.empty(0)) == (0.0, 360.0)
        assert ring_coverage(np.zeros(1)) == (30.0, 330.0)
