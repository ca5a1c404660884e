"""What a person says of a stem, and of its measurement."""

import pickle
from dataclasses import replace
from types import SimpleNamespace

import pytest

from dbh_studio.core.corrections import CORRECTION_KINDS, Correction, with_correction, without_correction
from dbh_studio.core.inventory import MOVED_CM, review_state
from dbh_studio.core.tree_record import Review, TreeRecord

VALUES = {
    "breast_height": 1.0,
    "base": "uphill",
    "along": "stem",
    "above": "bulge",
    "ground": (1.0, 2.0, 3.0),
    "curve": "circle",
    "least_arc": 72.0,
    "left_out": (4, 9),
    "ring": ((0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (0.0, 1.0, 1.0)),
    "tape": 31.5,
    "tape_height": 1.3,
}


def test_every_kind_of_correction_has_a_value():
    assert tuple(VALUES) == CORRECTION_KINDS
    for kind, value in VALUES.items():
        correction = Correction(kind, value, "Ada", "2026-01-02T03:04:05+00:00", "root flare")
        assert correction.value == value
        assert hash(correction) == hash(pickle.loads(pickle.dumps(correction)))


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("breast_height", 0.0),
        ("breast_height", float("nan")),
        ("breast_height", "high"),
        ("base", "left"),
        ("along", "trunk"),
        ("above", "sea"),
        ("ground", (1.0, 2.0)),
        ("ground", (1.0, 2.0, float("inf"))),
        ("curve", "hexagon"),
        ("least_arc", 361.0),
        ("left_out", ()),
        ("left_out", (-1, 2)),
        ("ring", ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))),
        ("tape", 0.0),
        ("tape", 3100.0),
        ("tape_height", -1.0),
        ("colour", "green"),
    ],
)
def test_what_makes_no_sense_is_refused(kind, value):
    with pytest.raises(ValueError, match=r"\w"):
        Correction(kind, value)


def test_indices_are_sorted_and_arrays_become_numbers():
    import numpy as np

    assert Correction("left_out", np.array([9, 4, 9], np.int32)).value == (4, 9)
    assert Correction("ground", np.array([1, 2, 3], np.float32)).value == (1.0, 2.0, 3.0)
    assert all(type(part) is float for part in Correction("ground", np.ones(3)).value)


def test_one_of_a_kind_in_order():
    corrections = ()
    for kind in reversed(CORRECTION_KINDS):
        corrections = with_correction(corrections, Correction(kind, VALUES[kind]))
    assert [each.kind for each in corrections] == list(CORRECTION_KINDS)
    changed = with_correction(corrections, Correction("tape", 20.0, why="read again"))
    assert len(changed) == len(corrections)
    record = TreeRecord(corrections=changed)
    assert record.correction("tape") == 20.0
    record = replace(record, corrections=without_correction(changed, "tape"))
    assert record.correction("tape") is None
    assert record.correction("curve") == "circle"


def test_corrections_out_of_order_are_no_record():
    tape, curve = Correction("tape", 20.0), Correction("curve", "circle")
    with pytest.raises(ValueError, match="one of a kind"):
        TreeRecord(corrections=(tape, curve))
    with pytest.raises(ValueError, match="one of a kind"):
        TreeRecord(corrections=(tape, tape))


def test_own_fields_are_in_order_and_never_empty():
    record = TreeRecord(fields={"plot corner": "", "Zone": "b", "age": "40"})
    assert record.fields == (("Zone", "b"), ("age", "40"))
    assert replace(record, fields=()) == TreeRecord()
    for wrong in ({" ": "x"}, {"a": 3}, {"a": "\ud800"}):
        with pytest.raises(ValueError, match=r"must be text|needs a name"):
            TreeRecord(fields=wrong)


def test_a_review_is_of_a_diameter_or_of_a_refusal():
    Review("doubtful", None, "small_arc")
    for values in (("seen", 30.0), ("accepted", 0.0), ("accepted", float("nan"))):
        with pytest.raises(ValueError, match="must be"):
            Review(*values)


def test_a_decision_goes_stale_when_its_number_moves():
    refusal = SimpleNamespace(code="small_arc")
    assert review_state(None, refusal) == ""
    assert review_state(Review("accepted", None, "small_arc"), refusal) == "accepted"
    assert review_state(Review("doubtful", None, "small_arc"), refusal) == "doubtful"
    assert review_state(Review("accepted", None, "no_points"), refusal) == "stale"
    assert review_state(Review("accepted", 30.0), refusal) == "stale"


def test_a_diameter_that_moves_by_less_than_the_table_shows_is_the_same(monkeypatch):
    from dbh_studio.core import dbh

    monkeypatch.setattr(dbh, "DbhEstimate", SimpleNamespace)
    review = Review("accepted", 30.0)
    assert review_state(review, SimpleNamespace(dbh_cm=30.0 + 0.9 * MOVED_CM)) == "accepted"
    assert review_state(review, SimpleNamespace(dbh_cm=30.0 - 1.1 * MOVED_CM)) == "stale"
    assert review_state(Review("accepted", None, "small_arc"), SimpleNamespace(dbh_cm=30.0)) == "stale"
