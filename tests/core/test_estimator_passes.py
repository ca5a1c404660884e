"""Walls of passes that do not fit together: the radius they have in common, and stems that are to be left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dbh_studio.core.estimator import EstimatorResult, estimate, estimate_diameter
from dbh_studio.core.estimator.evidence import evidence_of, oval_of
from dbh_studio.core.estimator.fit import fit_tube
from dbh_studio.core.estimator.passes import Passes, is_suspect, passes_of
from dbh_studio.core.estimator.prior import StemPrior
from dbh_studio.core.estimator.tube import Tube
from dbh_studio.settings import EstimatorSettings

RADIUS_M = 0.2
NOISE_M = 0.004
BREAST = np.array([0.0, 0.0, 1.3])
SETTINGS = EstimatorSettings(bark_share=0.0, max_half_width=1.0)
PRIOR = StemPrior.from_settings(EstimatorSettings())
Shifts = tuple[tuple[float, float], ...]
NONE: Shifts = ((0.0, 0.0),) * 3
# Degrees of the ring that are seen, and shifts of three passes in metres.
DRIFTED: list[tuple[float, Shifts]] = [
    (360.0, ((0.030, -0.036), (0.034, -0.001), (-0.016, -0.016))),
    (360.0, ((0.027, 0.024), (-0.010, -0.006), (-0.011, 0.011))),
    (360.0, ((0.015, 0.023), (0.015, 0.029), (0.0, -0.028))),
    (260.0, ((-0.003, 0.033), (0.013, -0.033), (0.0, -0.012))),
    (260.0, ((-0.024, -0.026), (-0.012, 0.029), (-0.032, 0.019))),
]


def cylinder(
    seed: int, *, shifts_m: Shifts = NONE, oval: float = 0.0, arc_deg: float = 360.0, n_points: int = 2400
) -> np.ndarray:
    """(N, 3) points about breast height; each third of the ring is a pass, shifted as a whole."""
    rng = np.random.default_rng(seed)
    at = rng.uniform(0.0, 1.0, n_points)
    angle = np.radians(arc_deg) * (at - 0.5)
    radius = RADIUS_M * (1.0 + oval * np.cos(2 * angle)) + rng.normal(0.0, NOISE_M, n_points)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-0.5, 0.7, n_points)])
    which = np.floor(3.0 * at + rng.normal(0.0, 0.3, n_points)).astype(np.int64) % 3
    points[:, :2] += np.array(shifts_m)[which]
    return points


def one_curve(points: np.ndarray) -> Tube:
    start = Tube(np.zeros(2), np.zeros(2), RADIUS_M, 0.0, np.empty(0), 0.01)
    tube = fit_tube(points, start, PRIOR)
    assert tube is not None
    return tube


def look(points: np.ndarray) -> tuple[Tube, Passes]:
    tube = one_curve(points)
    evidence = evidence_of(points, tube)
    assert evidence is not None
    passes = passes_of(
        points, tube, PRIOR, gap_deg=evidence.gap_deg, wall_ratio=evidence.wall_ratio, oval=oval_of(tube)
    )
    assert passes is not None
    return tube, passes


@pytest.mark.parametrize(("arc_deg", "shifts_m"), DRIFTED)
@pytest.mark.parametrize("seed", [1, 2])
class TestDrift:
    def test_the_common_radius_is_found_where_one_curve_misses_it(self, arc_deg, shifts_m, seed):
        tube, passes = look(cylinder(seed, shifts_m=shifts_m, arc_deg=arc_deg))
        assert abs(tube.radius / RADIUS_M - 1.0) > 0.04
        assert abs(passes.radius_m / RADIUS_M - 1.0) < min(0.035, 0.6 * abs(tube.radius / RADIUS_M - 1.0))

    def test_passes_are_seen_and_believed(self, arc_deg, shifts_m, seed):
        points = cylinder(seed, shifts_m=shifts_m, arc_deg=arc_deg)
        tube, passes = look(points)
        evidence = evidence_of(points, tube)
        assert is_suspect(tube, gap_deg=evidence.gap_deg, wall_ratio=evidence.wall_ratio, oval=oval_of(tube))
        assert passes.probability > 0.7
        assert passes.trust > 0.8
        apart = np.array(shifts_m) - np.mean(shifts_m, axis=0)
        assert passes.separation_m == pytest.approx(np.sqrt((apart**2).sum(axis=1).mean()), rel=0.35)

    def test_the_diameter_is_moved(self, arc_deg, shifts_m, seed):
        result = estimate_diameter(cylinder(seed, shifts_m=shifts_m, arc_deg=arc_deg) + BREAST, settings=SETTINGS)
        assert isinstance(result, EstimatorResult)
        assert result.diameters["area"].value_cm == pytest.approx(200.0 * RADIUS_M, rel=0.03)


@pytest.mark.parametrize("oval", [0.0, 0.02, 0.04])
@pytest.mark.parametrize("arc_deg", [360.0, 260.0])
class TestNoDrift:
    """A round stem and an oval one, all passes in place."""

    def test_passes_are_not_believed(self, oval, arc_deg):
        tube, passes = look(cylinder(3, oval=oval, arc_deg=arc_deg))
        assert passes.probability < 0.45
        assert passes.trust < 0.1  # of which a twentieth counts as none
        assert passes.radius_m == pytest.approx(tube.radius, rel=0.02)

    def test_the_diameter_stays(self, oval, arc_deg, monkeypatch):
        points = cylinder(3, oval=oval, arc_deg=arc_deg) + BREAST
        result = estimate_diameter(points, settings=SETTINGS)
        monkeypatch.setattr(estimate, "is_suspect", lambda *_, **__: False)
        without = estimate_diameter(points, settings=SETTINGS)
        assert isinstance(result, EstimatorResult)
        assert isinstance(without, EstimatorResult)
        for name, diameter in without.diameters.items():
            assert result.diameters[name].value_cm == pytest.approx(diameter.value_cm, rel=5e-4)


class TestPasses:
    def test_the_order_of_points_does_not_matter(self):
        arc_deg, shifts_m = DRIFTED[0]
        points = cylinder(4, shifts_m=shifts_m, arc_deg=arc_deg)
        tube = one_curve(points)
        mixed = points[np.random.default_rng(9).permutation(len(points))]
        first, second = (
            passes_of(each, tube, PRIOR, gap_deg=0.0, wall_ratio=2.0, oval=0.02) for each in (points, mixed)
        )
        assert first.radius_m == second.radius_m
        assert first.separation_m == second.separation_m
        assert first.probability == second.probability
        np.testing.assert_array_equal(first.waves_m, second.waves_m)

    def test_a_round_tube_will_do_to_start_from(self):
        points = cylinder(5)
        tube = Tube(np.zeros(2), np.zeros(2), RADIUS_M, 0.0, np.empty(0), 0.006)
        passes = passes_of(points, tube, PRIOR, gap_deg=0.0, wall_ratio=1.0, oval=0.0)
        assert passes.radius_m == pytest.approx(RADIUS_M, rel=0.01)

    def test_too_few_points(self):
        points = cylinder(6, n_points=40)
        tube = Tube(np.zeros(2), np.zeros(2), RADIUS_M, 0.0, np.empty(0), 0.006)
        assert passes_of(points, tube, PRIOR, gap_deg=0.0, wall_ratio=1.0, oval=0.0) is None

    def test_where_most_of_the_ring_is_not_seen_nothing_is_moved(self):
        arc_deg, shifts_m = DRIFTED[3]
        points = cylinder(1, shifts_m=shifts_m, arc_deg=arc_deg)
        tube = one_curve(points)
        assert not is_suspect(tube, gap_deg=220.0, wall_ratio=3.0, oval=0.05)
        passes = passes_of(points, tube, PRIOR, gap_deg=220.0, wall_ratio=3.0, oval=0.05)
        assert passes.trust == 0.0
        assert passes.log_shift(np.log(0.5)) == 0.0

    def test_the_shift_is_what_is_trusted_of_the_way_and_never_far(self):
        passes = Passes(0.2, np.zeros(4), 0.02, np.log(0.4), 0.9, 0.5, np.zeros(10))
        followed = 0.45 / 0.95  # what is beyond the doubt
        assert passes.log_shift(np.log(0.4) - 0.02) == pytest.approx(0.02 * followed)
        assert passes.log_shift(np.log(0.4) + 1.0) == pytest.approx(-0.12 * followed)
        assert replace(passes, trust=0.04).log_shift(np.log(0.3)) == 0.0
