"""What else is in a section: several stems, forks, and heaps that are none."""

from __future__ import annotations

import importlib
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dbh_studio.core.dbh import DbhEstimate, Refusal, measure_stem
from dbh_studio.core.estimator import EstimatorResult, assess_stem, estimate_diameter
from dbh_studio.core.estimator.heap import LIKELY_CLUTTER, signs_of
from dbh_studio.core.estimator.ring_count import stems_of
from dbh_studio.core.estimator.search import search_rings
from dbh_studio.core.estimator.tube import Tube
from dbh_studio.settings import EstimatorSettings, MeasureSettings


@pytest.fixture(scope="module")
def lab():
    """The laboratory in `bench/`, which has none of this package's tests in it."""
    folder = str(Path(__file__).parents[2] / "bench")
    sys.path.insert(0, folder)
    try:
        yield importlib.import_module("estimator_section")
    finally:
        sys.path.remove(folder)


def pipe(x=0.0, y=0.0, radius=0.15, n=2500, arc_deg=360.0, noise=0.004, lean=0.0, z=(0.5, 2.3), seed=0):
    """A stem whose axis passes (x, y) at 1.30 m and leans along x, `lean` metres per metre; its arc looks to -x."""
    rng = np.random.default_rng(seed)
    angle = np.pi + np.radians(rng.uniform(-arc_deg / 2, arc_deg / 2, n))
    height = rng.uniform(*z, n)
    r = radius + noise * rng.standard_normal(n)
    return np.column_stack([x + lean * (height - 1.3) + r * np.cos(angle), y + r * np.sin(angle), height])


def rounded(section):
    """To 0.1 mm, as in a file: sines and products differ from one kind of processor to another in the last bits, and
    which points are drawn from many depends on them all."""
    return replace(section, points_m=np.round(section.points_m, 4))


def codes(result) -> set[str]:
    return {flag.code for flag in result.flags}


class TestTwoStems:
    @pytest.mark.parametrize("gap_m", [0.0, 0.03, 0.10, 0.25])
    @pytest.mark.parametrize("ratio", [0.4, 0.7, 1.0])
    def test_the_one_with_most_points_is_measured_and_both_are_told(self, gap_m, ratio):
        apart = 0.15 * (1 + ratio) + gap_m
        points = np.concatenate([pipe(), pipe(apart, radius=0.15 * ratio, n=1200, seed=1)])
        result = estimate_diameter(points, settings=EstimatorSettings(bark_share=0.0, bloat_m=0.0))
        assert isinstance(result, EstimatorResult), result
        assert result.dbh_cm == pytest.approx(30.0, rel=0.03)
        assert "neighbour" in codes(result)
        assert [ring.radius_m for ring in result.rings] == pytest.approx([0.15, 0.15 * ratio], rel=0.06)
        np.testing.assert_allclose(result.rings[0].centre_m, [0, 0], atol=0.01)
        np.testing.assert_allclose(result.rings[1].centre_m, [apart, 0], atol=0.01)
        assert result.rings[0].n_points > result.rings[1].n_points

    def test_a_seed_given_is_as_good_as_one_in_the_settings(self):
        points = np.concatenate([pipe(arc_deg=200.0, noise=0.01), pipe(0.3, radius=0.11, n=1200, noise=0.01, seed=1)])
        given, set_so = assess_stem(points, seed=7), assess_stem(points, settings=EstimatorSettings(seed=7))
        assert len(given.result.rings) == 2
        for one, other in zip(given.result.rings, set_so.result.rings, strict=True):
            assert (one.radius_m, one.n_points) == (other.radius_m, other.n_points)
        assert given.result.diameters == set_so.result.diameters

    def test_the_words_say_how_far_and_how_thick(self):
        points = np.concatenate([pipe(), pipe(0.45, radius=0.1, n=1000, seed=1)])
        (words,) = [flag.words for flag in estimate_diameter(points).flags if flag.code == "neighbour"]
        assert "20 cm thick" in words
        assert "stands 20 cm beside" in words

    @pytest.mark.parametrize("ratio", [0.6, 1.0])
    def test_none_is_guessed_where_both_may_be_meant(self, ratio):
        points = np.concatenate([pipe(n=2000), pipe(0.33, radius=0.15 * ratio, n=2000, seed=1)])
        refusal = estimate_diameter(points)
        assert isinstance(refusal, Refusal)
        assert refusal.code == "two_rings"
        assert "30" in refusal.reason
        assert "Split" in refusal.remedy
        told = measure_stem(points)
        assert isinstance(told, Refusal)
        assert sorted(ring.radius_m for ring in told.rings) == pytest.approx([0.15 * ratio, 0.15], rel=0.05)
        assert told.section is not None

    def test_a_whole_ring_of_few_points_does_not_win_over_half_a_ring_of_many(self):
        points = np.concatenate([pipe(arc_deg=180, n=3000, noise=0.008), pipe(0.29, radius=0.12, n=900, seed=1)])
        result = estimate_diameter(points)
        assert isinstance(result, EstimatorResult), result
        assert result.dbh_cm == pytest.approx(30.0, rel=0.08)
        assert len(result.rings) == 2

    def test_a_wide_ring_round_two_thin_stems_does_not_win(self):
        points = np.concatenate([pipe(radius=0.05, n=1500, noise=0.006), pipe(0.1, radius=0.05, n=800, noise=0.006)])
        result = estimate_diameter(points)
        assert isinstance(result, EstimatorResult), result
        assert result.dbh_cm == pytest.approx(10.0, rel=0.12)
        assert len(result.rings) == 2

    def test_three(self):
        places = [(0, 0, 2500), (0.32, 0, 1200), (-0.1, 0.35, 1000)]
        points = np.concatenate([pipe(x, y, n=n, seed=k) for k, (x, y, n) in enumerate(places)])
        result = estimate_diameter(points)
        assert isinstance(result, EstimatorResult), result
        assert len(result.rings) == 3
        assert result.dbh_cm == pytest.approx(30.0, rel=0.03)

    def test_the_longer_of_two_is_the_stem_meant(self):
        """A short piece of a log against a stem, of as many points."""
        points = np.concatenate([pipe(n=2000), pipe(0.32, n=2000, z=(1.0, 1.5), seed=1)])
        result = estimate_diameter(points)
        assert isinstance(result, EstimatorResult), result
        np.testing.assert_allclose(result.position_m[:2], [0, 0], atol=0.02)

    def test_order_and_place_do_not_matter(self):
        points = np.concatenate([pipe(), pipe(0.32, n=1200, seed=1)])
        moved = points[::-1] + [400_000.0, 5_000_000.0, 0.0]
        first, second = estimate_diameter(points), estimate_diameter(moved)
        assert second.dbh_cm == pytest.approx(first.dbh_cm, rel=0.01)
        assert len(second.rings) == 2
        assert estimate_diameter(points[::-1]).diameters == first.diameters

    def test_an_oval_stem_is_one(self):
        points = pipe(n=4000)
        points[:, 0] *= 1.25
        assert len(estimate_diameter(points).rings) == 1

    def test_one_stem_has_no_other(self):
        points = pipe() - [0, 0, 1.3]
        tube = Tube(np.zeros(2), np.zeros(2), 0.15, 0.0, np.empty(0), 0.004)
        stems = stems_of(points, tube, widest_m=1.0, seed=0)
        assert stems.others == ()
        assert len(stems.points) == len(points)

    def test_two_rings_gain_where_there_are_two(self):
        one, two = pipe(), np.concatenate([pipe(), pipe(0.31, n=1500, seed=1)])
        gains = [
            search_rings(p - [0, 0, 1.3], widest_m=1.0, taper=0.0, rng=np.random.default_rng(0)) for p in (one, two)
        ]
        assert gains[0].pair is None or gains[0].gain < 0.1
        assert gains[1].pair is not None
        assert gains[1].gain > 0.3

    @pytest.mark.parametrize(("kind", "right", "least"), [("twins", 18, 15), ("fork", 18, 14), ("three stems", 15, 12)])
    def test_made_sections(self, lab, kind, right, least):
        """Of twenty the stem meant, or a refusal that says why; hardly ever one measured that is none of them."""
        verdicts = [lab._verdict(rounded(lab.make_section(kind, seed))) for seed in range(850, 870)]
        assert sum("meant" in words or "refused" in words for words in verdicts) >= right
        assert sum("none" in words for words in verdicts) <= 1
        assert sum("recognised" in words for words in verdicts) >= least


class TestFork:
    def fork(self, n=1200):
        """Two stems that part half a metre above the ground."""
        return np.concatenate([pipe(n=2500), pipe(0.32, radius=0.12, n=n, lean=0.32, z=(0.9, 2.3), seed=1)])

    def test_says_so(self):
        result = estimate_diameter(self.fork())
        assert isinstance(result, EstimatorResult), result
        assert "fork" in codes(result)
        assert "neighbour" not in codes(result)
        assert len(result.rings) == 2

    def test_no_one_of_two_is_meant(self):
        refusal = estimate_diameter(self.fork(n=2800))
        assert isinstance(refusal, Refusal)
        assert refusal.code == "two_rings"
        assert "fork" in refusal.reason
        assert "below the fork" in refusal.remedy


class TestHeaps:
    @pytest.mark.parametrize("method", ["ring", "circle"])
    def test_no_heap_is_a_stem(self, lab, method):
        """Of 55 heaps of eleven kinds; before this was looked at two in three were given a diameter."""
        settings = EstimatorSettings(method=method)
        found = [
            assess_stem(lab.make_heap(kind, seed), settings=settings) for kind in lab.HEAPS for seed in range(850, 855)
        ]
        assert sum(each.refusal is None for each in found) <= 14
        refused = [each.refusal for each in found if each.refusal is not None]
        assert sum(each.code in ("clutter", "no_ring") for each in refused) >= 0.75 * len(refused)

    def test_words(self, lab):
        refusal = assess_stem(lab.make_heap("slash", 851)).refusal
        assert refusal is not None
        assert "heap" in refusal.reason or "fill" in refusal.reason
        assert refusal.remedy.startswith(("Delete it", "Look at"))

    def test_nothing_is_refused_as_clutter_where_the_setting_says_so(self, lab):
        open_to_all = EstimatorSettings(max_clutter=1.0)
        found = [assess_stem(lab.make_heap("crate", seed), settings=open_to_all) for seed in range(850, 860)]
        assert not any(each.refusal is not None and each.refusal.code == "clutter" for each in found)
        flagged = [each.result for each in found if each.result is not None and "clutter" in codes(each.result)]
        assert len(flagged) >= 5

    def test_the_papers_curves_give_their_number_and_warn(self, lab):
        found = [
            measure_stem(lab.make_heap(kind, seed), settings=MeasureSettings.paper(), curves=[])
            for kind in ("many thin stems", "round bush", "boulder")
            for seed in range(850, 856)
        ]
        given = [each for each in found if isinstance(each, DbhEstimate)]
        assert len(given) >= 6
        assert sum("clutter" in each.flag_codes for each in given) >= 0.8 * len(given)

    def test_the_papers_curves_do_not_warn_of_a_stem(self):
        result = measure_stem(pipe(), settings=MeasureSettings.paper(), curves=[])
        assert isinstance(result, DbhEstimate)
        assert "clutter" not in result.flag_codes

    def test_a_stem_in_ferns_is_measured(self, lab):
        errors = []
        for seed in range(850, 862):
            points, tape_cm = lab.make_ferns(seed)
            found = assess_stem(points)
            assert found.refusal is None, (seed, found.refusal)
            assert found.result is not None
            errors.append(abs(found.result.dbh_cm / tape_cm - 1.0))
        assert np.median(errors) < 0.03
        assert max(errors) < 0.15

    def test_a_swelling_is_no_heap(self):
        """A quarter thicker over 40 cm: a graft or a canker, to be flagged and not refused."""
        points = pipe(n=4000)
        points[np.abs(points[:, 2] - 1.37) < 0.2, :2] *= 1.25
        result = estimate_diameter(points)
        assert isinstance(result, EstimatorResult), result
        assert "bulge" in codes(result)
        assert "clutter" not in codes(result)

    def test_a_clean_stem_is_beyond_doubt(self):
        tube = Tube(np.zeros(2), np.zeros(2), 0.15, 0.0, np.zeros(6), 0.004)
        signs = signs_of(pipe() - [0, 0, 1.3], tube)
        assert signs is not None
        assert signs.chance < 0.01

    def test_an_even_filling_is_likely_none(self):
        rng = np.random.default_rng(0)
        points = rng.uniform([-0.4, -0.4, -0.5], [0.4, 0.4, 0.7], (3000, 3))
        signs = signs_of(points, Tube(np.zeros(2), np.zeros(2), 0.3, 0.0, np.zeros(6), 0.04))
        assert signs is not None
        assert signs.chance > LIKELY_CLUTTER
        assert signs.words
        assert signs_of(points + [5, 0, 0], Tube(np.zeros(2), np.zeros(2), 0.3, 0.0, np.zeros(6), 0.04)) is None

    @pytest.mark.parametrize("scenario", ["full, noisy", "arc 140", "clutter", "small", "lidar, partial", "irregular"])
    def test_no_stem_is_refused_for_what_is_beside_it(self, lab, scenario):
        for seed in range(860, 868):
            refusal = assess_stem(lab.make_case(scenario, seed).points_m).refusal
            assert refusal is None or refusal.code not in ("clutter", "two_rings", "no_ring"), (seed, refusal)
