"""Which stem is which: by number, by place, and by place where the frames differ."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dbh_studio.core.pairing import OUT_OF_AREA, pair_stems
from dbh_studio.core.stem_layout import PairingRule, lay_on, nearest_pairs
from dbh_studio.core.stem_table import StemTable
from dbh_studio.errors import StudioError

UTM = np.array([312_029.5, 5_096_039.4])


def stand(n, *, seed=3, spacing=1.6, size=30.0):
    """(n, 2) places no nearer to each other than `spacing`, as trees are."""
    rng = np.random.default_rng(seed)
    places = []
    while len(places) < n:
        place = rng.uniform(0.0, size, 2)
        if all(np.hypot(*(place - other)) >= spacing for other in places):
            places.append(place)
    return np.array(places)


def turned(xy, degrees, shift):
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return xy @ turn.T + shift


def table(name, xy=None, *, ids=None, plots=None, n=None):
    n = n if n is not None else len(xy)
    return StemTable(
        name,
        tuple(ids) if ids is not None else tuple(str(k) for k in range(n)),
        tuple(plots) if plots is not None else ("",) * n,
        np.full((n, 2), np.nan) if xy is None else np.asarray(xy, float),
        {"dbh": np.full(n, 20.0)},
    )


def ids(table, rows):
    return [table.ids[row] for row in rows]


# ---- by place


def test_frames_that_differ_by_any_turn_and_shift_are_found():
    xy = stand(40)
    noise = np.random.default_rng(1).normal(0.0, 0.1, xy.shape)
    for degrees, shift in ((0.0, [0.6, 0.2]), (137.0, [-50.0, 20.0]), (-8.5, UTM)):
        mine = turned(xy + noise, degrees, np.asarray(shift))
        pairing = pair_stems(table("mine", mine, ids=["x"] * 40), table("field", xy), PairingRule("position"))
        assert {(i, j) for i, j in pairing.rows.tolist()} == {(k, k) for k in range(40)}
        (frame,) = pairing.frames
        assert frame.is_moved
        assert frame.turn_deg == pytest.approx(-degrees, abs=1.0)
        assert pairing.distance_m.max() < 0.6
        assert np.nanmin(pairing.next_m) > 1.0
        assert any("frames differ" in note for note in pairing.notes)


def test_one_frame_is_left_as_it_is():
    xy = stand(40) + UTM
    mine = xy + np.random.default_rng(1).normal(0.0, 0.05, xy.shape)
    pairing = pair_stems(table("mine", mine, ids=["x"] * 40), table("field", xy), PairingRule("position"))
    assert not pairing.frames[0].is_moved
    assert len(pairing.rows) == 40
    assert not any("frames differ" in note for note in pairing.notes)


def test_a_small_shift_in_a_dense_stand_mixes_neighbours_unless_it_is_taken_out():
    xy = stand(120, spacing=0.9, size=16.0)
    mine = table("mine", xy[:80] + np.array([0.8, 0.0]), ids=["x"] * 80)
    field = table("field", xy)
    as_they_are = pair_stems(mine, field, PairingRule("position", align="never"))
    moved = pair_stems(mine, field, PairingRule("position"))
    assert sum(i != j for i, j in as_they_are.rows.tolist()) >= 5
    assert [i == j for i, j in moved.rows.tolist()] == [True] * 80


def test_stems_that_only_one_table_has_are_named():
    xy = stand(30)
    mine = table("mine", turned(np.vstack([xy[:25], [[20.0, -2.0]]]), 20.0, [3.0, 4.0]), ids=["x"] * 26)
    pairing = pair_stems(mine, table("field", xy), PairingRule("position"))
    assert sorted(pairing.missed) == [25, 26, 27, 28, 29]
    assert list(pairing.extra) == [25]
    assert all("within 1 m" in reason for reason in pairing.missed.values())
    assert "within 1 m" in pairing.extra[25]


def test_stems_beyond_the_reference_are_told_apart_from_those_it_should_have():
    xy = stand(30)
    more = np.array([[15.0, 80.0], xy.mean(axis=0) + 50.0])
    pairing = pair_stems(table("mine", np.vstack([xy, more]), ids=["x"] * 32), table("field", xy))
    assert [pairing.extra[row] == OUT_OF_AREA for row in (30, 31)] == [True, True]


def test_stems_without_a_place_are_said_to_have_none():
    xy = stand(12)
    xy[4] = np.nan
    pairing = pair_stems(table("mine", stand(12)), table("field", xy), PairingRule("position"))
    assert "no place in field" in pairing.missed[4]


def test_maps_of_different_stands_are_not_paired():
    for n in (8, 12, 60):
        with pytest.raises(StudioError, match="could be paired"):
            pair_stems(
                table("mine", stand(n, seed=8) + 500.0, ids=["x"] * n),
                table("field", stand(n, seed=9)),
                PairingRule("position"),
            )


def test_by_chance_is_not_enough():
    # Two unrelated dense stands in one frame: a third of the stems stand within a metre of some stem.
    a, b = stand(60, seed=1, size=22.0), stand(60, seed=2, size=22.0)
    assert len(nearest_pairs(a, b, 1.0)) >= 0.3 * 60
    frame, pairs, _, _ = lay_on(a, b, rule=PairingRule())
    assert frame.reason
    assert len(pairs) == 0


def test_three_stems_in_one_frame_are_paired_and_in_two_are_not():
    xy = stand(3)
    assert len(pair_stems(table("mine", xy + 0.1, ids="abc"), table("field", xy), PairingRule("position")).rows) == 3
    with pytest.raises(StudioError, match="too few"):
        pair_stems(table("mine", xy + 50.0, ids="abc"), table("field", xy), PairingRule("position"))


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.integers(1, 25), st.integers(1, 25))
def test_pairs_are_one_to_one_near_and_independent_of_the_order(seed, n, m):
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(0, 6, (n, 2)), rng.uniform(0, 6, (m, 2))
    pairs = nearest_pairs(a, b, 1.0)
    assert len(set(pairs[:, 0])) == len(set(pairs[:, 1])) == len(pairs)
    assert (np.linalg.norm(a[pairs[:, 0]] - b[pairs[:, 1]], axis=1) <= 1.0).all()
    order = rng.permutation(n)
    again = nearest_pairs(a[order], b, 1.0)
    assert {(int(order[i]), int(j)) for i, j in again} == {(int(i), int(j)) for i, j in pairs}
    # No stem is left alone that has a free one within reach.
    alone = np.setdiff1d(np.arange(n), pairs[:, 0]), np.setdiff1d(np.arange(m), pairs[:, 1])
    gaps = np.linalg.norm(a[alone[0]][:, None] - b[alone[1]][None], axis=2)
    assert not gaps.size or gaps.min() > 1.0


def test_the_pairing_has_the_least_total_distance():
    # On a line: a at 0 and 0.8, b at 0.7 and 1.5. Nearest first would pair 0.8 with 0.7 and leave two alone, which
    # costs 0.1 + 1; pairing in order costs 0.7 + 0.7 = 1.4: the former is cheaper. With b at 0.5 and 1.2 it is
    # 0.3 + 1 = 1.3 against 0.5 + 0.4 = 0.9.
    a = np.array([[0.0, 0.0], [0.8, 0.0]])
    assert nearest_pairs(a, np.array([[0.7, 0.0], [1.5, 0.0]]), 1.0).tolist() == [[1, 0]]
    assert nearest_pairs(a, np.array([[0.5, 0.0], [1.2, 0.0]]), 1.0).tolist() == [[0, 0], [1, 1]]


# ---- by number


def test_numbers_are_used_where_the_places_agree_with_them():
    xy = stand(20)
    mine = table("mine", turned(xy, 30.0, [5.0, 5.0])[::-1], ids=[f"T{k:03d}" for k in reversed(range(20))])
    field = table("field", xy, ids=[f"t{k:03d}" for k in range(20)])
    pairing = pair_stems(mine, field)
    assert pairing.by == "id"
    assert all(mine.ids[i].casefold() == field.ids[j] for i, j in pairing.rows.tolist())


def test_tags_that_are_missing_or_there_twice_lose_no_stem_whose_place_is_known():
    xy = stand(20)
    names = [f"T{k}" for k in range(20)]
    tagged = ["T3" if k == 2 else "" if k > 14 else name for k, name in enumerate(names)]
    pairing = pair_stems(table("mine", xy + 30.0, ids=tagged), table("field", xy, ids=names))
    assert pairing.by == "position"
    assert pairing.rows.tolist() == [[k, k] for k in range(20)]
    # Stem 2 and 3 are both T3, and five have no tag: 20 − 2 − 5 numbers are of use.
    assert "20 pairs, of which the numbers give 13" in pairing.notes[0]


def test_one_wrong_tag_among_right_ones_does_not_count_against_all():
    xy = stand(20)
    names = [str(k) for k in range(20)]
    names[0], names[1] = names[1], names[0]
    pairing = pair_stems(table("mine", xy + 30.0, ids=names), table("field", xy))
    assert pairing.by == "id"
    assert len(pairing.rows) == 20


def test_equal_numbers_of_other_trees_are_not_believed():
    xy = stand(30)
    order = np.random.default_rng(2).permutation(30)
    mine = table("mine", xy[order] + 0.05)
    pairing = pair_stems(mine, table("field", xy))
    assert pairing.by == "position"
    assert [order[i] == j for i, j in pairing.rows.tolist()] == [True] * 30
    assert any("not the same trees" in note for note in pairing.notes)


def test_without_places_numbers_are_all_there_is():
    pairing = pair_stems(table("mine", n=3, ids=["1", "2", "9"]), table("field", n=3, ids=["01", "2", "3"]))
    assert pairing.by == "id"
    assert pairing.rows.tolist() == [[0, 0], [1, 1]]
    assert np.isnan(pairing.distance_m).all()
    assert "field has no number 9" in pairing.extra[2]
    assert "mine has no number 3" in pairing.missed[2]


def test_a_number_that_is_there_twice_is_nobodys():
    pairing = pair_stems(table("mine", n=3, ids=["1", "2", "3"]), table("field", n=4, ids=["1", "2", "2", ""]))
    assert pairing.rows.tolist() == [[0, 0]]
    assert "2 times in field" in pairing.missed[1]
    assert "2 times in field" in pairing.extra[1]
    assert "no number in field" in pairing.missed[3]


@pytest.mark.parametrize("by", ["id", "position", "auto"])
def test_what_is_not_there_is_said(by):
    nothing = table("mine", n=2, ids=["", ""])
    with pytest.raises(StudioError, match="mine has no"):
        pair_stems(nothing, table("field", stand(2)), PairingRule(by))


@pytest.mark.parametrize("wrong", [{"by": "size"}, {"max_distance_m": 0.0}, {"align": "perhaps"}])
def test_rules_that_cannot_be(wrong):
    with pytest.raises(ValueError, match=r"must be above zero|no such way"):
        PairingRule(**wrong)


# ---- plots


def test_each_plot_has_a_frame_of_its_own_and_others_are_outside():
    a, b = stand(15, seed=1), stand(15, seed=2)
    field = table("field", np.vstack([a, b, b]), plots=["1"] * 15 + ["2"] * 15 + ["3"] * 15)
    mine = table(
        "mine",
        np.vstack([turned(a, 10.0, [3.0, 0.0]), turned(b, -60.0, [0.0, 9.0]), a[:2]]),
        plots=["01"] * 15 + ["2"] * 15 + ["8"] * 2,
        ids=["x"] * 32,
    )
    pairing = pair_stems(mine, field)
    assert [frame.plot for frame in pairing.frames] == ["1", "2"]
    assert [round(frame.turn_deg) for frame in pairing.frames] == [-10, 60]
    assert len(pairing.rows) == 30
    assert pairing.outside_inventory == (30, 31)
    assert pairing.outside_reference == tuple(range(30, 45))
    assert sum("not counted" in note for note in pairing.notes) == 2


def test_one_plot_each_under_different_names_is_one_plot():
    xy = stand(10)
    pairing = pair_stems(table("mine", xy, plots=["cloud"] * 10), table("field", xy, plots=["PRF025"] * 10))
    assert len(pairing.rows) == 10
    assert any("taken to be plot PRF025" in note for note in pairing.notes)


def test_several_plots_without_a_common_name_are_not_guessed():
    xy = stand(10)
    with pytest.raises(StudioError, match="no plot in common"):
        pair_stems(table("mine", xy, plots=["a"] * 10), table("field", xy, plots=["b"] * 5 + ["c"] * 5))


def test_a_plot_that_does_not_fit_is_told_and_the_others_go_on():
    a = stand(15, seed=1)
    field = table("field", np.vstack([a, stand(15, seed=2)]), plots=["1"] * 15 + ["2"] * 15)
    mine = table("mine", np.vstack([a, stand(15, seed=7) + 99.0]), plots=["1"] * 15 + ["2"] * 15, ids=["x"] * 30)
    pairing = pair_stems(mine, field)
    assert len(pairing.rows) == 15
    assert any(note.startswith("Plot 2: nothing was paired") for note in pairing.notes)
    assert all("do not fit together" in pairing.missed[row] for row in range(15, 30))
