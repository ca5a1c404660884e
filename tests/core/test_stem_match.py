"""Maps of stems on each other: any turn, shift and scale, stems missed on both sides, rows that fit in many ways."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.stem_match import match_stems


def plan(xy: np.ndarray, scale: float, angle: float, shift: tuple[float, float]) -> np.ndarray:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return scale * xy @ turn.T + np.array(shift)


def maps(seed: int, *, scale: float, n: int = 30, kept: float = 0.75, noise: float = 0.03, strangers: int = 3):
    """Two maps of a random stand, and which rows are the same stem."""
    rng = np.random.default_rng(seed)
    xy, angle = rng.uniform(0, 30, (n, 2)), rng.uniform(-3, 3)
    target = plan(xy, scale, angle, (410_000.0, -25.0))
    a, b = np.flatnonzero(rng.random(n) < kept), np.flatnonzero(rng.random(n) < kept)
    source = np.vstack([xy[a] + rng.normal(0, noise / scale, (len(a), 2)), rng.uniform(0, 30, (strangers, 2))])
    others = rng.uniform(target.min(axis=0), target.max(axis=0), (strangers, 2))
    same = {(int(np.flatnonzero(a == stem)[0]), int(np.flatnonzero(b == stem)[0])) for stem in np.intersect1d(a, b)}
    return source, np.vstack([target[b] + rng.normal(0, noise, (len(b), 2)), others]), same, xy, target, angle


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("known", [True, False])
def test_the_similarity_and_the_pairs_are_found(seed, known):
    scale = 1.0 if known else float(np.random.default_rng(seed + 50).uniform(0.3, 3.0))
    source, target, same, xy, moved, angle = maps(seed, scale=scale)
    match = match_stems(source, target, scale=scale if known else None)
    assert match, "no match" if match is None else match.reason
    assert match.target_from_source.scale == pytest.approx(scale, rel=1e-9 if known else 0.01)
    turned = np.angle(np.exp(1j * (match.target_from_source.angle_rad - angle)))
    assert abs(turned) < 0.01
    assert np.abs(match.target_from_source.apply(xy) - moved).max() < 0.25
    pairs = {(int(a), int(b)) for a, b in match.pairs}
    # A stranger may happen to stand nearer than the stem itself.
    assert len(same - pairs) <= 1
    assert match.rms_m < 0.2


def test_a_mirrored_stand_is_not_taken():
    source, target, *_ = maps(3, scale=1.0, kept=1.0, strangers=0)
    match = match_stems(source * [-1.0, 1.0], target, scale=1.0)
    assert not match


@pytest.mark.parametrize("scale", [1.0, None])
def test_a_plantation_in_rows_is_ambiguous(scale):
    rng = np.random.default_rng(0)
    rows = np.stack(np.meshgrid(np.arange(6) * 3.0, np.arange(6) * 2.0), axis=-1).reshape(-1, 2)
    source = rows[rng.random(36) < 0.8]
    target = plan(rows[rng.random(36) < 0.8], 1.0, 0.7, (5.0, 5.0)) + rng.normal(0, 0.02, (1, 2))
    match = match_stems(source, target, scale=scale)
    assert match is not None and not match
    assert "another" in match.reason and match.rival_pairs > 3


def test_other_stands_do_not_match():
    rng = np.random.default_rng(9)
    match = match_stems(rng.uniform(0, 30, (25, 2)), rng.uniform(0, 30, (25, 2)), scale=1.0)
    assert not match


def test_thickness_keeps_different_stems_apart():
    source, target, *_ = maps(5, scale=1.0, kept=1.0, strangers=0, noise=0.0)
    thin, thick = np.full(len(source), 0.05), np.full(len(target), 0.5)
    assert match_stems(source, target, scale=1.0)
    assert not match_stems(source, target, source_radius=thin, target_radius=thick, scale=1.0)


def test_too_few_stems_give_nothing_and_wrong_shapes_are_refused():
    three = np.random.default_rng(0).uniform(0, 9, (3, 2))
    assert match_stems(three, three) is None
    with pytest.raises(ValueError, match="source_xy"):
        match_stems(np.zeros((5, 3)), three)
    with pytest.raises(ValueError, match="radii"):
        match_stems(np.zeros((5, 2)), np.zeros((5, 2)), source_radius=np.ones(4))


def test_stems_all_in_one_place_or_one_line_do_no_harm():
    assert not match_stems(np.zeros((6, 2)), np.ones((6, 2)))
    line = np.column_stack([np.arange(8.0), np.zeros(8)])
    assert not match_stems(line, line + 3.0, scale=1.0)
