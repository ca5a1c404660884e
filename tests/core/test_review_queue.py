"""The queue of review: what is worst comes first, with its reason; a decision goes stale when its number moves."""

from dataclasses import replace

import numpy as np
import pytest

from dbh_studio.core.dbh import CurveFit, DbhEstimate, Diameter, Refusal
from dbh_studio.core.review_queue import (
    CONCERNS,
    FILTERS,
    QueueEntry,
    in_filter,
    moved_words,
    next_to_review,
    queue_entry,
    review_progress,
    review_queue,
)
from dbh_studio.core.section import CrossSection
from dbh_studio.core.transforms import Similarity
from dbh_studio.core.tree_record import Review


def estimate(dbh_cm=30.0, *, flags=(), quality="good", half_width=0.03, coverage_deg=350.0):
    section = CrossSection(
        np.zeros((1, 2)), np.zeros(1, int), Similarity(np.eye(3), np.zeros(3)), (1.15, 1.45), 1.3, 0.0, "stem",
        coverage_deg, 360.0 - coverage_deg,
    )  # fmt: skip
    size = Diameter(dbh_cm, dbh_cm * (1 - half_width), dbh_cm * (1 + half_width))
    fit = CurveFit("shrinkage", np.zeros((3, 2)), 1.0, 1.0, 1.0, np.ones(1, bool), 0.001, {"tape": size})
    codes = tuple(flags)
    return DbhEstimate(
        dbh_cm, "shrinkage", "tape", section, {"shrinkage": fit}, quality, tuple(f"about {c}" for c in codes),
        np.zeros(3), codes,
    )  # fmt: skip


REFUSED = Refusal("small_arc", "only 70° of the ring seen", "walk round it")
# In the order in which they are to come.
WORST_FIRST = [
    ("refused", REFUSED, {}),
    ("uncertain", estimate(flags=("wide_interval",), quality="poor", half_width=0.3), {}),
    ("uncertain", estimate(flags=("wide_interval",), quality="poor", half_width=0.2), {}),
    ("small_arc", estimate(flags=("partial_arc",), coverage_deg=150.0), {}),
    ("small_arc", estimate(flags=("partial_arc",), coverage_deg=250.0), {}),
    ("neighbour", estimate(flags=("neighbour",)), {}),
    ("drift", estimate(flags=("double_wall",)), {}),
    ("profile", estimate(flags=("profile",)), {}),
    ("search", estimate(), {"search_flag": "no mask shows it"}),
    ("stale", estimate(29.8), {"review": Review("accepted", 31.2)}),
    ("other", estimate(flags=("lean",)), {}),
    ("nothing", estimate(), {}),
]


def queue_of(stems):
    return review_queue([(queue_entry(i, result, **said), result) for i, (_, result, said) in enumerate(stems)])


@pytest.mark.parametrize("seed", range(5))
def test_the_worst_comes_first_in_whatever_order_the_stems_come(seed):
    order = np.random.default_rng(seed).permutation(len(WORST_FIRST))
    entries = [(queue_entry(int(i), WORST_FIRST[i][1], **WORST_FIRST[i][2]), WORST_FIRST[i][1]) for i in order]
    queue = review_queue(entries)
    assert [entry.tree_id for entry in queue] == list(range(len(WORST_FIRST)))
    assert [entry.concern for entry in queue] == [concern for concern, _, _ in WORST_FIRST]


def test_a_concern_stands_for_each_word_of_the_list():
    assert {concern for concern, _, _ in WORST_FIRST} == set(CONCERNS)


def test_every_reason_is_told_the_worst_first():
    entry = queue_entry(1, estimate(flags=("lean", "neighbour")), search_flag="a candidate")
    assert entry.reasons == ("about neighbour", "a candidate", "about lean")


def test_a_poor_grade_without_a_flag_is_a_reason():
    entry = queue_entry(1, estimate(quality="poor"))
    assert entry.concern == "uncertain" and entry.reasons


@pytest.mark.parametrize(
    ("review", "result", "state"),
    [
        (None, estimate(30.0), ""),
        (Review("accepted", 30.0), estimate(30.0), "accepted"),
        (Review("accepted", 30.0), estimate(30.04), "accepted"),
        (Review("accepted", 30.0), estimate(30.2), "stale"),
        (Review("doubtful", 30.0), estimate(29.0), "stale"),
        (Review("doubtful", 30.0), estimate(30.0), "doubtful"),
        (Review("accepted", 30.0), REFUSED, "stale"),
        (Review("accepted", None, "small_arc"), REFUSED, "accepted"),
        (Review("accepted", None, "no_ring"), REFUSED, "stale"),
        (Review("accepted", None, "small_arc"), estimate(30.0), "stale"),
    ],
)
def test_a_decision_is_stale_once_its_number_has_moved(review, result, state):
    entry = queue_entry(1, result, review=review)
    assert entry.state == state
    assert entry.is_open == (state in ("", "stale"))


@pytest.mark.parametrize(
    ("review", "result", "words"),
    [
        (Review("accepted", 31.2), estimate(29.8), "was 31.2 cm when accepted, now 29.8 cm"),
        (Review("doubtful", 31.2), REFUSED, "was 31.2 cm when put off, now without a diameter"),
        (Review("accepted", None, "small_arc"), estimate(29.8), "had no diameter when accepted, now 29.8 cm"),
    ],
)
def test_it_is_said_how_the_number_has_moved(review, result, words):
    assert moved_words(review, result) == words
    assert words in queue_entry(1, result, review=review).reasons


def entries(*states):
    return [QueueEntry(i, state, "nothing", (), "good") for i, state in enumerate(states, start=1)]


def test_the_next_is_the_following_one_that_waits_and_then_the_first():
    queue = entries("", "accepted", "stale", "doubtful", "")
    assert next_to_review(queue, None) == 1
    assert next_to_review(queue, 1, decided=[1]) == 3
    assert next_to_review(queue, 3, decided=[3]) == 5
    assert next_to_review(queue, 5, decided=[5]) == 1
    assert next_to_review(queue, 5, decided=[1, 3, 5]) is None


def test_of_those_put_off_the_next_is_one_put_off():
    queue = entries("doubtful", "", "doubtful")
    assert next_to_review(queue, 1, wanted="doubtful", decided=[1]) == 3
    assert next_to_review(queue, 3, wanted="doubtful", decided=[1, 3]) is None


def test_progress_counts_what_was_decided_and_still_holds():
    stems = [estimate(), estimate(), REFUSED, estimate(), estimate(flags=("lean",))]
    reviews = [Review("accepted", 30.0), Review("accepted", 33.0), Review("doubtful", None, "small_arc"), None, None]
    queue = [queue_entry(i, s, review=r) for i, (s, r) in enumerate(zip(stems, reviews, strict=True))]
    progress = review_progress(queue)
    assert (progress.n_all, progress.n_reviewed, progress.n_doubtful, progress.n_stale) == (5, 2, 1, 1)
    assert (progress.n_refused, progress.n_good) == (1, 1)


@pytest.mark.parametrize("quality", ["fair", "poor"])
def test_only_a_good_one_that_nobody_decided_about_may_be_accepted_unseen(quality):
    good = queue_entry(1, estimate())
    assert good.is_good
    assert not queue_entry(1, estimate(quality=quality)).is_good
    assert not queue_entry(1, estimate(), review=Review("doubtful", 30.0)).is_good
    assert not replace(good, state="stale").is_good


def test_every_filter_lets_through_what_its_name_says():
    stems = {"": estimate(), "refused": REFUSED}
    queue = [queue_entry(1, stems[""]), queue_entry(2, stems["refused"], review=Review("doubtful", None, "small_arc"))]
    shown = {name: [entry.tree_id for entry in queue if in_filter(entry, name)] for name in FILTERS}
    assert shown == {"all": [1, 2], "open": [1], "doubtful": [2], "stale": [], "refused": [2]}
