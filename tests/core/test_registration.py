"""Fine registration: a known small motion undone, outliers ignored, and what surfaces leave open left alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbh_studio.core.registration import refine
from dbh_studio.core.transforms import Similarity


def stand(seed: int, noise: float = 0.0) -> np.ndarray:
    """A rough floor and six stems."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-6, 6, (9000, 2))
    floor = np.column_stack([xy, 0.2 * np.sin(xy[:, 0]) + 0.1 * xy[:, 1]])
    parts = [floor]
    for x, y, r in [(-4, -3, 0.2), (-1, 4, 0.3), (3, 3, 0.15), (4, -4, 0.25), (0, -1, 0.4), (-5, 2, 0.2)]:
        angle, h = rng.uniform(0, 2 * np.pi, 1500), rng.uniform(0.0, 3.0, 1500)
        parts.append(np.column_stack([x + r * np.cos(angle), y + r * np.sin(angle), h]))
    points = np.concatenate(parts)
    return points + rng.normal(0, noise, points.shape)


@pytest.mark.parametrize("with_scale", [False, True])
def test_a_small_motion_is_undone(with_scale):
    source, target = stand(1, 0.004), stand(2, 0.004)
    scale = 1.015 if with_scale else 1.0
    wrong = Similarity(Rotation.from_rotvec([0.01, -0.012, 0.02]).as_matrix(), np.array([0.08, -0.1, 0.06]), scale)
    found = refine(source, target, wrong, with_scale=with_scale)
    left = found.target_from_source.apply(source) - source
    assert np.linalg.norm(left, axis=1).max() < 0.004
    assert found.n_free == (7 if with_scale else 6)
    assert found.settled and found.rms_m < 0.01 and found.share_near > 0.7


def test_a_third_of_strangers_and_half_of_an_overlap_do_not_pull_it_away():
    rng = np.random.default_rng(3)
    source, target = stand(1, 0.004), stand(2, 0.004)
    source = np.vstack([source[source[:, 0] < 2.0], rng.uniform([-6, -6, 0], [6, 6, 3], (6000, 3))])
    target = target[target[:, 0] > -4.5]
    wrong = Similarity(Rotation.from_rotvec([0.0, 0.01, -0.015]).as_matrix(), np.array([-0.07, 0.05, 0.04]))
    found = refine(source, target, wrong, with_scale=False)
    check = stand(5)
    assert np.linalg.norm(found.target_from_source.apply(check) - check, axis=1).max() < 0.012


def test_what_a_bare_plane_leaves_open_stays_as_it_was():
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-5, 5, (5000, 2)), np.zeros(5000)])
    other = np.column_stack([rng.uniform(-5, 5, (5000, 2)), np.zeros(5000)])
    found = refine(flat, other, Similarity(np.eye(3), np.array([0.2, -0.3, 0.1])), with_scale=False)
    assert found.n_free == 3
    np.testing.assert_allclose(found.target_from_source.translation, [0.2, -0.3, 0.0], atol=2e-3)


def test_nothing_near_leaves_the_start_and_says_so():
    found = refine(stand(1), stand(2), Similarity(np.eye(3), np.array([100.0, 0, 0])), with_scale=False)
    assert found.share_near == 0.0 and np.isnan(found.rms_m) and not found.settled
    np.testing.assert_array_equal(found.target_from_source.translation, [100.0, 0, 0])


def test_too_few_points_are_refused():
    with pytest.raises(ValueError, match="at least ten"):
        refine(np.zeros((5, 3)), stand(1), Similarity.identity(), with_scale=False)
