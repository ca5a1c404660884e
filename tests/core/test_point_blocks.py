"""Blocks of a cloud: whatever is asked, the answer is what a look at all points gives."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core import point_blocks
from dbh_studio.core.picking import PickCloud, View
from dbh_studio.core.point_blocks import PointBlocks


@pytest.fixture(params=[7, 1_000_000])
def blocks(request, monkeypatch) -> PointBlocks:
    """In one piece, and in many: a plot with clumps, stray points far away and points that are nowhere."""
    monkeypatch.setattr(point_blocks, "_PIECE", 4001 if request.param == 7 else 1_000_000)
    rng = np.random.default_rng(request.param)
    plot = rng.random((20_000, 3)) * [40.0, 30.0, 12.0] + [500.0, -200.0, 80.0]
    clump = rng.normal([510.0, -190.0, 82.0], 0.2, (5_000, 3))
    strays = np.array([[9e4, 0.0, 0.0], [-9e4, 3.0, 1e5], [np.nan, 1.0, 2.0], [np.inf, -np.inf, 0.0]])
    return PointBlocks(rng.permutation(np.concatenate([plot, clump, strays])).astype(np.float32))


def test_a_box_finds_what_lies_in_it(blocks):
    for lower, upper in (
        ([509, -191, 81], [511, -189, 83]),
        ([500, -200, 80], [540, -170, 92]),
        ([1e5, 1e5, 1e5], [2e5, 2e5, 2e5]),
        ([-np.inf, -191, -np.inf], [np.inf, -189, np.inf]),
        ([511, -189, 83], [509, -191, 81]),
    ):
        with np.errstate(invalid="ignore"):
            inside = ((blocks.xyz >= np.float32(lower)) & (blocks.xyz <= np.float32(upper))).all(axis=1)
        assert np.array_equal(blocks.in_box(lower, upper), np.flatnonzero(inside))
    everything = np.isfinite(blocks.xyz).all(axis=1)
    assert np.array_equal(blocks.in_box([-1e6] * 3, [1e6] * 3), np.flatnonzero(everything))


def test_no_point_of_a_part_of_the_screen_is_missed_and_few_others_are_found(blocks):
    view = View.looking_at((510.0, -215.0, 83.0), (510.0, -190.0, 82.0))
    for corners in ([[0.45, 0.4], [0.55, 0.6]], [[0.0, 0.0], [1.0, 1.0]], [[0.55, 0.6], [0.45, 0.4]]):
        found = blocks.perhaps_in_view(view, corners)
        assert np.isin(PickCloud(blocks.xyz).rectangle(view, *corners), found).all()
    narrow = blocks.perhaps_in_view(view, [[0.45, 0.4], [0.55, 0.6]])
    assert len(narrow) < 0.5 * len(blocks.xyz)
    depth = (blocks.xyz[narrow] - view.origin) @ view.rotation[2]
    shallow = blocks.perhaps_in_view(view, [[0.45, 0.4], [0.55, 0.6]], nearest=20.0, farthest=30.0)
    assert np.isin(narrow[(depth >= 20.0) & (depth <= 30.0)], shallow).all()
    assert len(shallow) < len(narrow)
    behind = View.looking_at((510.0, -260.0, 83.0), (510.0, -300.0, 83.0))
    near = np.linalg.norm(blocks.xyz[blocks.perhaps_in_view(behind, [[0, 0], [1, 1]])], axis=1)
    assert len(near) < 10  # the strays' blocks at most


def test_it_is_small_and_holds_every_point_once(blocks):
    assert sorted(blocks._order.tolist()) == list(range(len(blocks.xyz)))
    assert blocks.n_bytes < 40 * len(blocks.xyz)
    assert len(blocks) > 100


@pytest.mark.parametrize("n", [0, 1, 2])
def test_hardly_any_points(n):
    blocks = PointBlocks(np.zeros((n, 3), np.float32))
    assert blocks.in_box([-1, -1, -1], [1, 1, 1]).tolist() == list(range(n))
    view = View.looking_at((0, -5, 0), (0, 0, 0))
    assert blocks.perhaps_in_view(view, [[0, 0], [1, 1]]).tolist() == list(range(n))


def test_points_that_are_all_nowhere_are_never_found():
    blocks = PointBlocks(np.full((5, 3), np.nan, np.float32))
    assert len(blocks.in_box([-np.inf] * 3, [np.inf] * 3)) == 0


def test_the_work_can_be_given_up():
    with pytest.raises(InterruptedError):
        PointBlocks(np.zeros((10, 3), np.float32), is_stopped=lambda: True)
