"""Two recordings of one walk: clocks, rates, outliers, and what must be refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbh_studio.core.trajectories import Trajectory, common_poses, fit_trajectories
from dbh_studio.core.transforms import Similarity

TRUTH = Similarity(Rotation.from_rotvec([0.3, -0.2, 1.4]).as_matrix(), np.array([12.0, -5.0, 2.0]), 1.7)


def place(t: np.ndarray) -> np.ndarray:
    """A walk that never repeats itself."""
    return np.column_stack(
        [8 * np.sin(0.05 * t) + 2 * np.sin(0.31 * t), 6 * np.cos(0.083 * t) + 0.04 * t, 0.3 * np.sin(0.21 * t)]
    )


def pair(*, offset: float = 0.0, noise: float = 0.01, outliers: float = 0.0, seed: int = 0, rates=(2.0, 10.0)):
    """A camera at 2 Hz and a scanner at 10 Hz with another clock, which started earlier and stopped earlier."""
    rng = np.random.default_rng(seed)
    mine, theirs = np.arange(0.0, 120.0, 1.0 / rates[0]), np.arange(-15.0, 105.0, 1.0 / rates[1])
    target = TRUTH.apply(place(theirs)) + rng.normal(0, noise, (len(theirs), 3))
    source = place(mine)
    lost = rng.random(len(mine)) < outliers
    source[lost] += rng.normal(0, 3.0, (int(lost.sum()), 3))
    return Trajectory(mine, source), Trajectory(theirs + offset, target)


def error(fit) -> float:
    points = place(np.linspace(0, 120, 50))
    return float(np.linalg.norm(fit.target_from_source.apply(points) - TRUTH.apply(points), axis=1).max())


def test_with_one_clock():
    fit = fit_trajectories(*pair())
    assert fit and error(fit) < 0.02 and fit.rms_m < 0.04
    assert fit.target_from_source.scale == pytest.approx(1.7, rel=1e-3)


@pytest.mark.parametrize("offset", [0.0, 3.37, -41.2, 1_700_000_000.25])
def test_the_clocks_offset_is_found(offset):
    fit = fit_trajectories(*pair(offset=offset), offset_s=None)
    assert fit, fit
    assert fit.offset_s == pytest.approx(offset, abs=0.05)
    assert error(fit) < 0.06


def test_a_fifth_of_lost_poses_does_no_harm():
    fit = fit_trajectories(*pair(outliers=0.2))
    assert fit and error(fit) < 0.03 and fit.n_used < fit.n_poses


@pytest.mark.parametrize("rates", [(0.5, 20.0), (10.0, 1.0), (7.0, 3.0)])
def test_rates_may_differ(rates):
    fit = fit_trajectories(*pair(offset=8.5, rates=rates), offset_s=None)
    assert fit and fit.offset_s == pytest.approx(8.5, abs=0.05)
    assert error(fit) < 0.06


def test_a_lost_track_that_shifts_a_third_of_the_walk_is_left_out():
    source, target = pair(noise=0.02)
    places = source.xyz.copy()
    places[80:150] += [9.0, -4.0, 2.0]
    fit = fit_trajectories(Trajectory(source.time_s, places), target, offset_s=None)
    assert fit and error(fit) < 0.05 and fit.n_poses - fit.n_used == pytest.approx(70, abs=3)
    assert fit.residuals is not None and np.median(fit.residuals.distance_m[~fit.residuals.kept]) > 5.0


def test_a_pause_of_the_recording_is_not_bridged():
    source, target = pair()
    gone = (target.time_s > 30.0) & (target.time_s < 60.0)
    broken = Trajectory(target.time_s[~gone], target.xyz[~gone])
    inside = broken.at(np.array([29.0, 45.0, 59.0, 61.0]))[1]
    assert inside.tolist() == [True, False, False, True]
    fit = fit_trajectories(source, broken)
    assert fit and error(fit) < 0.02 and fit.n_used == fit.n_poses
    assert common_poses(source, broken, 0.0) == fit.n_poses


def test_how_sure_it_is_fits_how_wrong_it_is():
    points = place(np.linspace(0, 120, 50))
    ratios, scales = [], []
    for seed in range(12):
        fit = fit_trajectories(*pair(noise=0.1, seed=seed))
        wrong = np.sqrt(
            (np.linalg.norm(fit.target_from_source.apply(points) - TRUTH.apply(points), axis=1) ** 2).mean()
        )
        ratios.append(wrong / fit.error_at(points))
        scales.append((fit.target_from_source.scale / TRUTH.scale - 1.0) / fit.scale_error)
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.6
    assert 0.4 < np.sqrt(np.mean(np.square(scales))) < 2.0


def test_a_rigid_fit_keeps_the_scale():
    fit = fit_trajectories(*pair(), with_scale=False)
    assert fit is not None and fit.target_from_source.scale == 1.0
    assert not fit and "differ" in fit.reason


def test_a_straight_walk_is_refused():
    t = np.arange(0.0, 60.0, 0.5)
    line = np.column_stack([t, 0.5 * t, np.zeros_like(t)]) + np.random.default_rng(0).normal(0, 0.01, (len(t), 3))
    fit = fit_trajectories(Trajectory(t, line), Trajectory(t, line + 3.0))
    assert fit is not None and not fit and "straight" in fit.reason and fit.code == "straight"


def test_a_nearly_straight_walk_is_one_too():
    t = np.arange(0.0, 60.0, 0.5)
    sway = np.column_stack([t, 0.3 * np.sin(0.4 * t), np.zeros_like(t)])
    rng = np.random.default_rng(0)
    noisy = [Trajectory(t, sway + rng.normal(0, 0.05, sway.shape)) for _ in range(2)]
    fit = fit_trajectories(*noisy)
    assert fit is not None and fit.code == "straight"


def test_a_straight_walk_between_upright_frames_leaves_nothing_open():
    t = np.arange(0.0, 60.0, 0.5)
    line = np.column_stack([t + np.sin(0.3 * t), 0.5 * t, np.zeros_like(t)])
    truth = Similarity(Rotation.from_rotvec([0, 0, 1.4]).as_matrix(), np.array([12.0, -5.0, 2.0]), 1.7)
    noise = np.random.default_rng(0).normal(0, 0.01, line.shape)
    fit = fit_trajectories(Trajectory(t, line), Trajectory(t, truth.apply(line) + noise), upright=True)
    beside = line + [0.0, 10.0, 0.0]
    assert fit and np.abs(fit.target_from_source.apply(beside) - truth.apply(beside)).max() < 0.02
    up = np.column_stack([np.zeros_like(t), np.zeros_like(t), t])
    pole = fit_trajectories(Trajectory(t, up + noise), Trajectory(t, up), upright=True)
    assert pole is None or pole.code == "straight"


def test_a_walk_round_and_round_has_no_one_offset():
    t = np.arange(0.0, 100.0, 0.25)
    rounds = np.column_stack([5 * np.cos(0.6 * t), 5 * np.sin(0.6 * t), np.zeros_like(t)])
    fit = fit_trajectories(Trajectory(t, rounds), Trajectory(t, rounds), offset_s=None)
    assert fit is not None and not fit and fit.code == "several_offsets"


def test_two_different_walks_do_not_fit():
    source, target = pair()
    other = Trajectory(target.time_s, TRUTH.apply(place(1.7 * target.time_s + 300.0) * [1.0, -1.0, 3.0]))
    fit = fit_trajectories(source, other)
    assert fit is not None and fit.code in ("differ", "few_fit")


def test_no_common_time_and_too_few_poses_give_nothing():
    source, target = pair(offset=10_000.0)
    assert fit_trajectories(source, target) is None
    assert fit_trajectories(Trajectory(source.time_s[:5], source.xyz[:5]), source) is None


@pytest.mark.parametrize("time", [[0.0, 1.0, 1.0], [0.0, np.nan, 2.0], [0.0, 1.0]])
def test_bad_times_are_refused(time):
    with pytest.raises(ValueError, match=r"ascend|equally many"):
        Trajectory(np.array(time), np.zeros((3, 3)))
