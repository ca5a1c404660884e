"""Labels from a photogrammetric cloud to a laser scan of the same plot: alignment, refusals, carrying, trunks."""

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
from dbh_studio.core.transforms import Similarity
from dbh_studio.stages.transfer import (
    Survey,
    align_as_given,
    align_by_pairs,
    align_by_stems,
    carried_trunks,
    carry_labels,
    refined,
    survey,
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


@pytest.mark.parametrize(("rivals", "precision"), [(True, 0.97), (False, 0.93)])
def test_labels_arrive_on_the_right_points(rivals, precision):
    source, labels, target, truth = plots()
    carried = carry_labels(source, labels, target, aligned().target_from_source, rivals=rivals)
    marked = carried.labels > 0
    assert (carried.labels[marked] == truth[marked]).mean() > precision
    there = np.isin(truth, np.unique(labels[labels > 0]))
    assert (carried.labels == truth)[there].mean() > 0.8
    assert set(carried.trunk_ids) | set(carried.lost) == set(np.unique(labels[labels > 0]).tolist())


def test_what_is_beyond_the_reach_or_nearer_to_something_else_gets_no_label():
    source = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 0.1, 0]])
    target = np.array([[0.15, 0, 0], [0.25, 0, 0], [1.0, 0.09, 0], [1.0, 0.04, 0], [9.0, 0, 0]])
    same = Similarity.identity()
    labels = np.array([4, 7, 0])
    assert carry_labels(source, labels, target, same).labels.tolist() == [4, 0, 0, 7, 0]
    assert carry_labels(source, labels, target, same, rivals=False).labels.tolist() == [4, 0, 7, 7, 0]
    far = carry_labels(source, labels, target + 100.0, same)
    assert far.trunk_ids == () and far.lost == (4, 7) and not far.labels.any()


def test_nothing_to_carry_is_no_error():
    empty = carry_labels(np.zeros((0, 3)), np.zeros(0, np.int32), np.zeros((4, 3)), Similarity.identity())
    assert empty.labels.tolist() == [0] * 4
    with pytest.raises(ValueError, match="source_labels"):
        carry_labels(np.zeros((3, 3)), np.zeros(2, np.int32), np.zeros((4, 3)), Similarity.identity())


def test_the_chain_makes_trunks_of_carried_labels_and_keeps_their_names():
    source, labels, target, truth = plots()
    carried = carry_labels(source, labels, target, aligned().target_from_source)
    trunks = carried_trunks(target, fit_ground(target), carried)
    names = [name for name in trunks.source_ids if name]
    assert len(names) == len(set(names)) >= 5
    for rows, name in zip(trunks.result.point_sets, trunks.source_ids, strict=True):
        assert (truth[rows] == name).mean() > 0.9
