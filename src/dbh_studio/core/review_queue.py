"""In which order the stems of a plot are looked through, and why: what is worst comes first.

Nothing here knows of a screen: stems come in with what was measured and what was decided, and leave in order.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from dbh_studio.core.inventory import review_state
from dbh_studio.core.measured import DbhEstimate, Refusal
from dbh_studio.core.tree_record import Review

Concern = Literal[
    "refused", "uncertain", "small_arc", "neighbour", "drift", "profile", "search", "stale", "other", "nothing"
]
CONCERNS: tuple[Concern, ...] = get_args(Concern)
"""Worst first."""

QueueFilter = Literal["all", "open", "doubtful", "stale", "refused"]
FILTERS: tuple[QueueFilter, ...] = get_args(QueueFilter)

_OF_FLAG: Mapping[str, Concern] = {
    "wide_interval": "uncertain",
    "fallback": "uncertain",
    "clutter": "uncertain",
    "partial_arc": "small_arc",
    "arc_accepted": "small_arc",
    "gap": "small_arc",
    "neighbour": "neighbour",
    "not_round": "neighbour",
    "fork": "neighbour",
    "double_wall": "drift",
    "thick_ring": "drift",
    "profile": "profile",
    "bulge": "profile",
    "buttress": "profile",
    "not_at_height": "profile",
}
# Poor by the rule of grades, though no flag says why.
_POOR = "the diameter is poor by its grade"


@dataclass(frozen=True)
class QueueEntry:
    """One stem in the queue.

    Attributes:
        tree_id: Which stem.
        state: ``accepted``, ``doubtful``, ``stale``, or empty where nobody has looked.
        concern: The worst that is to be said about it.
        reasons: Why it is where it is, in words, worst first; empty where nothing stands out.
        quality: Of the diameter; ``refused`` where there is none.
    """

    tree_id: int
    state: str
    concern: Concern
    reasons: tuple[str, ...]
    quality: str

    @property
    def is_open(self) -> bool:
        """Whether it waits for a decision: nobody has looked, or the number has moved since."""
        return self.state in ("", "stale")

    @property
    def is_good(self) -> bool:
        """Whether it may be accepted unseen: a good diameter about which nothing stands out and nobody has decided."""
        return self.quality == "good" and self.concern == "nothing" and self.state == ""


@dataclass(frozen=True)
class ReviewProgress:
    """How far a plot has been looked through.

    Attributes:
        n_all: Stems.
        n_reviewed: Accepted or put off, and the number has not moved since.
        n_doubtful: Of these, put off.
        n_stale: Decided once; the number has moved since.
        n_refused: Stems without a diameter.
        n_good: Stems that may be accepted unseen.
    """

    n_all: int
    n_reviewed: int
    n_doubtful: int
    n_stale: int
    n_refused: int
    n_good: int


def queue_entry(
    tree_id: int, result: DbhEstimate | Refusal, *, search_flag: str = "", review: Review | None = None
) -> QueueEntry:
    """What is to be said about one stem.

    Args:
        tree_id: Its number.
        result: The diameter, or why there is none.
        search_flag: What the search that found the stem wants looked at.
        review: What was decided about it.
    """
    state = review_state(review, result)
    said: list[tuple[int, str]] = []

    def say(concern: Concern, words: str) -> None:
        said.append((CONCERNS.index(concern), words))

    if isinstance(result, Refusal):
        say("refused", result.reason)
    else:
        for code, words in zip(result.flag_codes, result.flags, strict=False):
            say(_OF_FLAG.get(code, "other"), words)
        if result.quality == "poor" and not said:
            say("uncertain", _POOR)
    if search_flag:
        say("search", search_flag)
    if state == "stale" and review is not None:
        say("stale", moved_words(review, result))
    said.sort(key=lambda each: each[0])
    concern = CONCERNS[said[0][0]] if said else "nothing"
    quality = "refused" if isinstance(result, Refusal) else result.quality
    return QueueEntry(tree_id, state, concern, tuple(words for _, words in said), quality)


def moved_words(review: Review, result: DbhEstimate | Refusal) -> str:
    """How a number has moved since it was decided about: ``was 31.2 cm when accepted, now 29.8 cm``."""
    decided = "accepted" if review.decision == "accepted" else "put off"
    was = f"was {review.dbh_cm:.1f} cm" if review.dbh_cm is not None else "had no diameter"
    now = "without a diameter" if isinstance(result, Refusal) else f"{result.dbh_cm:.1f} cm"
    if review.dbh_cm is None and isinstance(result, Refusal):
        return f"was refused for another reason when {decided}"
    return f"{was} when {decided}, now {now}"


def review_queue(
    stems: Iterable[tuple[QueueEntry, DbhEstimate | Refusal]],
) -> tuple[QueueEntry, ...]:
    """The stems, worst first: by concern, then by how bad it is in that respect, then by number."""

    def order(stem: tuple[QueueEntry, DbhEstimate | Refusal]) -> tuple[int, float, int, int]:
        entry, result = stem
        return CONCERNS.index(entry.concern), -_badness(entry, result), -len(entry.reasons), entry.tree_id

    return tuple(entry for entry, _ in sorted(stems, key=order))


def _badness(entry: QueueEntry, result: DbhEstimate | Refusal) -> float:
    if isinstance(result, Refusal):
        return 0.0
    measures: dict[Concern, Callable[[], float]] = {
        "uncertain": lambda: _half_width(result),
        "small_arc": lambda: 360.0 - result.section.coverage_deg,
    }
    return measures.get(entry.concern, lambda: 0.0)()


def _half_width(result: DbhEstimate) -> float:
    half_width = result.diameters[result.definition].half_width
    # A method without an interval says nothing about it, which is not the same as the worst.
    return half_width if half_width != float("inf") else 0.0


def review_progress(queue: Collection[QueueEntry], *, n_waiting: int = 0) -> ReviewProgress:
    """How far one is; `n_waiting` stems are not measured yet."""
    return ReviewProgress(
        n_all=len(queue) + n_waiting,
        n_reviewed=sum(entry.state in ("accepted", "doubtful") for entry in queue),
        n_doubtful=sum(entry.state == "doubtful" for entry in queue),
        n_stale=sum(entry.state == "stale" for entry in queue),
        n_refused=sum(entry.quality == "refused" for entry in queue),
        n_good=sum(entry.is_good for entry in queue),
    )


def in_filter(entry: QueueEntry, wanted: QueueFilter) -> bool:
    """Whether a stem is among those that are shown."""
    return {
        "all": True,
        "open": entry.is_open,
        "doubtful": entry.state == "doubtful",
        "stale": entry.state == "stale",
        "refused": entry.quality == "refused",
    }[wanted]


def next_to_review(
    queue: Sequence[QueueEntry], current: int | None, *, wanted: QueueFilter = "all", decided: Collection[int] = ()
) -> int | None:
    """The stem to look at after `current`: the next in order that waits for a decision, then from the beginning.

    Among those put off it is the next of them, whatever was decided about it. None where nothing is left.

    Args:
        queue: In order.
        current: The stem on screen.
        wanted: What is gone through.
        decided: Stems about which a decision was made just now, which the queue does not know of.
    """
    ids = [entry.tree_id for entry in queue]
    at = ids.index(current) + 1 if current in ids else 0
    for entry in (*queue[at:], *queue[:at]):
        is_due = entry.is_open or wanted == "doubtful"
        if entry.tree_id != current and entry.tree_id not in decided and is_due and in_filter(entry, wanted):
            return entry.tree_id
    return None
