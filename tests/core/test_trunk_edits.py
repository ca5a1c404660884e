"""Which points an edit concerns: planes, drawn lines, growing, shrinking, owners, selections without a copy."""

from __future__ import annotations

import numpy as np
import pytest
from tests.app.plots import trunk

from dbh_studio.core.picking import PickCloud, View
from dbh_studio.core.trunk_edits import beyond_plane, grown, in_order, n_beside_line, owners, plane_of_line, shrunk

FAR = np.array([500_000.0, 4_500_000.0, 100.0])


def test_a_plane_parts_points_by_its_side_to_the_millimetre_also_far_from_the_origin():
    points = np.array([[0.0, 0, 1], [0.001, 0, 1], [-0.001, 0, 1], [np.nan, 0, 0]]) + FAR
    assert beyond_plane(points, FAR, (2.0, 0, 0)).tolist() == [False, True, False, False]
    for normal in ((0, 0, 0), (np.nan, 0, 1)):
        with pytest.raises(ValueError, match="normal"):
            beyond_plane(points, FAR, normal)


def test_a_drawn_line_cuts_where_it_is_seen():
    view = View.looking_at((0, -5, 1.5), (0, 0, 1.5))
    rng = np.random.default_rng(1)
    points = rng.uniform((-1, -1, 0), (1, 1, 3), (500, 3))
    ends = np.array([[0.45, 0.9], [0.55, 0.1]])
    through, normal = plane_of_line(view, *ends)
    beyond = beyond_plane(points, through, normal)
    seen = view.project(points)
    along, off = ends[1] - ends[0], seen - ends[0]
    # Screen y points down, so what lies right of the way up the line has a positive cross product.
    right = along[0] * off[:, 1] - along[1] * off[:, 0] > 0
    assert 50 < right.sum() < 450
    assert (beyond == right).all()
    with pytest.raises(ValueError, match="short"):
        plane_of_line(view, (0.5, 0.5), (0.5, 0.5))


def test_what_is_beside_a_line_is_counted_between_its_ends_only():
    view = View.looking_at((0, -5, 0), (0, 0, 0), aspect=1.6)
    # Along a line that goes up to the right at 45 degrees; the last point is behind the camera.
    places = np.array([[0.1, 0, -0.1], [-0.1, 0, 0.1], [-0.1, 0, 0.2], [2.0, 0, 1.9], [-2.0, 0, -1.9], [0, -9, 0]])
    ends = view.project(np.array([[-1.0, 0, -1.0], [1.0, 0, 1.0]]))
    assert sorted(n_beside_line(view, places, *ends)) == [1, 2]
    assert n_beside_line(view, places, *ends) == n_beside_line(view, places, *ends[::-1])[::-1]
    steep = view.project(np.array([[1.4, 0, 0.4], [0.4, 0, 1.4]]))  # square to it, beyond all but one of them
    assert sorted(n_beside_line(view, places, *steep)) == [1, 4]
    short = view.project(np.array([[1.0, 0, 0.5], [1.1, 0, 0.6]]))  # points at them from beside
    assert n_beside_line(view, places, *short) == (0, 0)


def test_growing_takes_what_is_free_and_near():
    points = np.column_stack([np.arange(10) * 0.02, np.zeros(10), np.zeros(10)])
    assert grown(points, [3, 4], [0, 1, 2, 6], 0.025).tolist() == [2]
    assert grown(points, [3, 4], [0, 1, 2, 5, 6], 0.045).tolist() == [1, 2, 5, 6]
    for members, free, distance in (([], [1], 1.0), ([1], [], 1.0), ([1], [2], 0.0)):
        assert len(grown(points, members, free, distance)) == 0


def test_shrinking_drops_the_rim_beside_others_and_what_is_alone():
    plane = np.stack(np.meshgrid(np.arange(20), np.arange(10)), axis=-1).reshape(-1, 2) * 0.01
    points = np.column_stack([plane, np.zeros(len(plane))])
    points = np.vstack([points, [[5.0, 5.0, 0.0]]])
    members = np.flatnonzero((points[:, 0] < 0.0999) | (points[:, 0] > 1))
    others = np.setdiff1d(np.arange(len(points)), members)
    left = shrunk(points, members, others, 0.0201, least=4)
    assert points[left, 0].max() == pytest.approx(0.07)  # 8 and 9 cm are within 2 cm of the others
    assert len(points) - 1 not in left  # nothing around it
    assert len(left) == 8 * 10
    assert shrunk(points, members, others, 0.0).tolist() == members.tolist()
    assert shrunk(points, [], others, 0.01).tolist() == []


def test_owners_are_named_with_their_share():
    trunks = [trunk(3, 1, 2, 5), trunk(7, 8, 9)]
    found = owners(trunks, np.array([2, 5, 6]), 10)
    assert {i: rows.tolist() for i, rows in found.items()} == {3: [2, 5]}
    assert owners(trunks, np.array([0]), 10) == {}


def test_a_selection_over_points_that_are_not_copied_is_the_same():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (300_000, 3)).astype(np.float32)
    points[7] = np.nan
    view = View.looking_at((0, -5, 0), (0, 0, 0))
    lasso = np.array([[0.3, 0.3], [0.7, 0.35], [0.5, 0.8]])
    copied, over = PickCloud(points), PickCloud.over(points)
    assert len(over) == len(points)
    assert len(copied.lasso(view, lasso)) > 1000
    assert np.array_equal(over.lasso(view, lasso), copied.lasso(view, lasso))
    assert np.array_equal(over.rectangle(view, (0.2, 0.2), (0.4, 0.9)), copied.rectangle(view, (0.2, 0.2), (0.4, 0.9)))


def test_a_ball_holds_what_is_within_its_radius():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (200_000, 3)).astype(np.float32)
    points[11] = np.nan
    inside = PickCloud.over(points).ball((0.2, 0.1, -0.3), 0.25)
    gap = np.linalg.norm(points.astype(float) - [0.2, 0.1, -0.3], axis=1)
    sure = np.flatnonzero(gap < 0.2499)
    assert np.isin(sure, inside).all() and (gap[inside] < 0.2501).all() and len(inside) > 1000
    assert (np.diff(inside) > 0).all()


def test_indices_of_all_parts_stand_in_order_and_once():
    rng = np.random.default_rng(0)
    parts = [rng.integers(0, 5000, n) for n in (0, 1, 700, 900)]
    found = in_order(*parts)
    assert found.dtype == np.int32
    assert np.array_equal(found, np.unique(np.concatenate(parts)))
    assert np.array_equal(in_order(found), found)
    assert len(in_order()) == len(in_order([])) == 0
