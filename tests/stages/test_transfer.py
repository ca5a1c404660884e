"""Labels from a photogrammetric cloud to a laser scan of the same plot: ways to align them, and refusals."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbh_studio.core.dbh import Refusal
from dbh_studio.core.ground import fit_ground
from dbh_studio.core.synthetic.plot import make_plot
from dbh_studio.core.synthetic.recipe import PlotRecipe
from dbh_studio.core.trajectories import Trajectory
from dbh_studio.core.transforms import Similarity
from dbh_studio.stages.measure import measure_trunk
from dbh_studio.stages.transfer import (
    Survey,
    align_as_given,
    align_by_pairs,
    align_by_stems,
    align_by_trajectories,
    refined,
    scale_error_of_surfaces,
    stems_together,
    survey,
    survey_of_stems,
)

TRUTH = Similarity(Rotation.from_rotvec([0.012, -0.008, 2.0]).as_matrix(), np.array([30.0, -12.0, 4.0]))
UNIT = 0.91


@cache
def plots():
    """The same plot as noisy photogrammetry, a third of it missing and in a unit of its own, and as a scan."""
    base = {"seed": 31, "n_trees": 10, "side_m": 15.0, "understorey": 0.4}
    photo = make_plot(PlotRecipe.simple(**base, points=120_000, noise=2.0, capture="walk"))
    scan = make_plot(PlotRecipe.simple(**base, points=150_000, noise=0.3))
    there = photo.cloud.xyz[:, 0] < 11.0
    source = (photo.cloud.xyz[there] * UNIT).astype(np.float32)
    target = TRUTH.apply(scan.cloud.xyz.astype(np.float64)).astype(np.float32)
    return source, photo.tree_ids[there], target, scan.tree_ids


@cache
def surveys() -> tuple[Survey, Survey]:
    source, _, target, _ = plots()
    return survey(source, fit_ground(source)), survey(target, fit_ground(target))


def worst_error(alignment) -> float:
    source = plots()[0].astype(np.float64)
    return float(np.linalg.norm(alignment.target_from_source.apply(source) - TRUTH.apply(source / UNIT), axis=1).max())


@cache
def aligned():
    return align_by_stems(*surveys(), scale=None)


def test_stems_align_the_clouds_and_surfaces_refine_it():
    alignment = aligned()
    assert alignment, alignment
    coarse = align_by_stems(*surveys(), scale=None, with_refinement=False)
    assert coarse and np.isnan(coarse.surface_rms_m)
    assert coarse.n_pairs >= 5 and coarse.rms_m < 0.1
    # The two frames differ by 0.8° of tilt, which stems in plan cannot know and surfaces do.
    assert worst_error(alignment) < 0.02 < worst_error(coarse)
    assert alignment.target_from_source.scale == pytest.approx(1.0 / UNIT, rel=1e-3)
    assert 0.3 < alignment.share_near <= 1.0 and alignment.surface_rms_m < 0.03
    assert alignment.stem_pairs.shape == (alignment.n_pairs, 2)


def test_a_wrong_scale_is_refused_not_forced():
    source, target = surveys()
    refusal = align_by_stems(source.scaled(1.6), target, scale=1.0)
    assert isinstance(refusal, Refusal) and refusal.code == "ambiguous" and refusal.remedy


def test_two_stems_are_too_few():
    source, target = surveys()
    few = replace(source, xy_m=source.xy_m[:2], radius_m=source.radius_m[:2], base_m=source.base_m[:2])
    refusal = align_by_stems(few, target)
    assert isinstance(refusal, Refusal) and refusal.code == "too_few_stems" and "2 and" in refusal.reason


def test_picked_pairs_give_the_similarity_and_its_residual():
    rng = np.random.default_rng(0)
    picked = rng.uniform(0, 12, (6, 3))
    alignment = align_by_pairs(picked * UNIT, TRUTH.apply(picked) + rng.normal(0, 0.01, (6, 3)))
    assert alignment and alignment.n_pairs == 6 and 0.002 < alignment.rms_m < 0.03
    assert worst_error(alignment) < 0.1
    better = refined(alignment, *surveys(), with_scale=True)
    assert better and better.method == "picked"
    assert worst_error(better) < 0.02


def test_pairs_that_do_not_determine_it_are_refused():
    line = np.linspace(0, 5, 4)[:, None] * [1.0, 2.0, 0.5]
    refusal = align_by_pairs(line, line)
    assert isinstance(refusal, Refusal) and refusal.code == "in_line"
    assert align_by_pairs(line[:2], line[:2]).code == "too_few_pairs"
    three = align_by_pairs(np.eye(3), np.eye(3))
    assert three and "fourth" in three.notes[0]


def test_a_given_transform_is_taken_and_a_wrong_one_shows_when_refined():
    known = align_as_given(Similarity(TRUTH.rotation, TRUTH.translation, 1.0 / UNIT))
    better = refined(known, *surveys(), with_scale=True)
    assert better and worst_error(better) < 0.02
    wrong = align_as_given(Similarity(np.eye(3), np.array([500.0, 0.0, 0.0])))
    refusal = refined(wrong, *surveys(), with_scale=False)
    assert isinstance(refusal, Refusal) and refusal.code == "no_overlap"


# ---- by the walks


def walk(t):
    """(N, 3) metres through the plot, never twice the same."""
    return np.column_stack([6 + 5 * np.sin(0.11 * t), 7 + 6 * np.cos(0.073 * t), 1.6 + 0.1 * np.sin(0.4 * t)])


def walks(*, offset=12.5, n=120):
    rng = np.random.default_rng(3)
    mine, theirs = np.linspace(4, 90, n), np.linspace(0, 86, 500)
    source = Trajectory(mine, (walk(mine) + rng.normal(0, 0.02, (n, 3))) * UNIT)
    return source, Trajectory(theirs + offset, TRUTH.apply(walk(theirs) + rng.normal(0, 0.01, (500, 3))))


def test_walks_align_the_clouds_and_tell_the_clocks_and_how_sure_that_is():
    alignment = align_by_trajectories(*walks())
    assert alignment and alignment.method == "trajectories" and alignment.walk is not None
    assert alignment.walk.offset_s == pytest.approx(12.5, abs=0.05)
    assert worst_error(alignment) < 0.08
    scale = alignment.target_from_source.scale
    assert abs(scale * UNIT - 1.0) < 4 * alignment.scale_error < 0.02
    assert any("clock" in note for note in alignment.notes)
    better = refined(alignment, *surveys(), with_scale=True)
    assert better and worst_error(better) < 0.02
    share = scale_error_of_surfaces(*surveys(), better)
    assert 0.0 < share < 0.003 and abs(better.target_from_source.scale * UNIT - 1.0) < 5 * share + 5e-4


def test_stems_stand_on_stems_where_the_clouds_lie_right():
    source, target = surveys()
    known = Similarity(TRUTH.rotation, TRUTH.translation, 1.0 / UNIT)
    n = stems_together(source, target, known)
    assert n >= 5
    off = Similarity(TRUTH.rotation, TRUTH.translation + [1.7, -1.1, 0.0], 1.0 / UNIT)
    assert stems_together(source, target, off) < n / 2
    sunk = Similarity(TRUTH.rotation, TRUTH.translation + [0.0, 0.0, 3.0], 1.0 / UNIT)
    assert stems_together(source, target, sunk) == 0


def straight(trajectory, direction):
    along = np.linspace(0, 30, len(trajectory)) + 0.5 * np.sin(np.linspace(0, 9, len(trajectory)))
    return Trajectory(trajectory.time_s, along[:, None] * direction)


@pytest.mark.parametrize(
    ("spoil", "code", "says"),
    [
        (lambda a, b: (Trajectory(a.time_s[:6], a.xyz[:6]), b, None), "too_few_poses", "the camera has 6 poses"),
        (lambda a, b: (a, b, 5000.0), "no_common_time", "0 poses fall together"),
        (lambda a, b: (a, Trajectory(b.time_s / 1000, b.xyz), None), "no_common_time", "86 and 0 s"),
        (lambda a, b: (straight(a, [1.0, 0.2, 0]), straight(b, [0.3, 1.0, 0]), 12.5), "straight", "straight line"),
        (lambda a, b: (a, Trajectory(b.time_s, walk(3.1 * b.time_s + 40)), 12.5), "other_walk", "differ by"),
    ],
)
def test_walks_that_do_not_determine_it_are_refused(spoil, code, says):
    source, target, offset = spoil(*walks())
    refusal = align_by_trajectories(source, target, offset_s=offset)
    assert isinstance(refusal, Refusal) and refusal.code == code
    assert says in refusal.reason and refusal.remedy


def test_a_survey_of_known_stems_is_like_one_that_looked_for_them():
    _, _, target, truth = plots()
    ground = fit_ground(target)
    rows = [np.flatnonzero(truth == i).astype(np.int32) for i in (1, 2, 3)]
    stems = [(part, measure_trunk(target[part], trunk_id=i, ground=ground)) for i, part in enumerate(rows, 1)]
    known, seen = survey_of_stems(target, stems, ground), surveys()[1]
    apart = np.linalg.norm(known.xy_m[:, None] - seen.xy_m[None], axis=2)
    assert apart.min(axis=1).max() < 0.05
    nearest = apart.argmin(axis=1)
    assert known.radius_m == pytest.approx(seen.radius_m[nearest], rel=0.15)
    assert known.base_m == pytest.approx(seen.base_m[nearest], abs=0.05)
