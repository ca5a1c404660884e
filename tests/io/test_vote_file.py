"""Votes on disk: the same again, and nothing where they are damaged or about something else."""

from __future__ import annotations

import numpy as np

from dbh_studio.core.votes import PhotoVotes, VoteCounter
from dbh_studio.io.vote_file import load_votes, save_votes


def counter() -> VoteCounter:
    made = VoteCounter(1000, "key")
    rows = np.arange(0, 1000, 3, dtype=np.int32)
    made.add(PhotoVotes("ä/1.jpg", rows, (rows % 2).astype(np.int32), np.full(len(rows), 0.25, np.float32)))
    made.skip("2.jpg")
    return made


def test_votes_come_back_as_they_were(tmp_path):
    path = tmp_path / "votes.npz"
    save_votes(path, counter())
    back = load_votes(path, n_voters=1000, key="key")
    assert back is not None and back.done == {"ä/1.jpg", "2.jpg"}
    for name in ("n_seen", "n_trunk", "weight_seen", "weight_trunk"):
        np.testing.assert_array_equal(getattr(back.votes(), name), getattr(counter().votes(), name))
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_not_there_damaged_or_of_something_else_is_not_taken(tmp_path):
    path = tmp_path / "votes.npz"
    assert load_votes(path, n_voters=1000, key="key") is None
    save_votes(path, counter())
    assert load_votes(path, n_voters=999, key="key") is None
    assert load_votes(path, n_voters=1000, key="other") is None
    whole = path.read_bytes()
    for damaged in (b"", b"nonsense", whole[: len(whole) // 2], whole[:300] + bytes(200) + whole[500:]):
        path.write_bytes(damaged)
        assert load_votes(path, n_voters=1000, key="key") is None
    np.savez(path, done=np.array(["x"]))
    assert load_votes(path, n_voters=1000, key="key") is None
