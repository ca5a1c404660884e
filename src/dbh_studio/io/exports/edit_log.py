"""Who did what to the plot and when, and what was decided about each stem: the log that goes with the inventory."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from dbh_studio.core.corrections import Correction, CorrectionKind
from dbh_studio.core.tree_record import TreeRecord
from dbh_studio.io.exports.columns import written_whole
from dbh_studio.io.exports.pages import Words
from dbh_studio.io.history import HistoryEntry
from dbh_studio.io.inventory_csv import defused

EntryKind = Literal["edit", "undo", "redo", "correction", "review"]
EDIT_COLUMNS = ("when", "who", "what", "kind", "stem_id", "value", "why")

_METRIC = Words()
CORRECTION_TITLES: Mapping[CorrectionKind, str] = {
    "breast_height": "Breast height",
    "base": "Height from the",
    "along": "Height along the",
    "above": "Measured above",
    "ground": "Ground",
    "curve": "Curve",
    "least_arc": "Smaller arc accepted",
    "left_out": "Points left out",
    "ring": "Ring drawn by hand",
    "tape": "Tape value",
    "tape_height": "Height of the tape",
}


@dataclass(frozen=True)
class LogEntry:
    """One line of the log.

    Attributes:
        when: ISO 8601, UTC; empty where unknown.
        who: Who did it; empty where nobody signed.
        what: In words.
        kind: ``edit``, ``undo`` and ``redo`` are of the plot's history; ``correction`` and ``review`` are those that
            stand now, one stem each.
        stem_id: Which stem; None where it is not said.
        value: Of a correction or a review.
        why: In the person's words.
    """

    when: str
    who: str
    what: str
    kind: EntryKind = "edit"
    stem_id: int | None = None
    value: str = ""
    why: str = ""


def history_entries(history: Iterable[HistoryEntry]) -> tuple[LogEntry, ...]:
    """What was done to the plot, undo and redo included, the earliest first."""
    kinds: dict[str, EntryKind] = {"do": "edit", "undo": "undo", "redo": "redo"}
    return tuple(LogEntry(each.when, each.who, each.what, kinds[each.kind]) for each in history)


def decisions(trees: Mapping[int, TreeRecord], words: Words = _METRIC) -> tuple[LogEntry, ...]:
    """The corrections and reviews that stand, stem by stem, lengths in the units of `words`."""
    entries = []
    for stem_id, record in sorted(trees.items()):
        for each in record.corrections:
            title = CORRECTION_TITLES.get(each.kind, each.kind)
            entries.append(
                LogEntry(each.when, each.who, title, "correction", stem_id, correction_words(each, words), each.why)
            )
        review = record.review
        if review is not None:
            seen = (
                f"no diameter ({review.refusal})" if review.dbh_cm is None else words.diameter(review.dbh_cm, unit=True)
            )
            entries.append(
                LogEntry(review.when, review.who, "Reviewed", "review", stem_id, f"{review.decision}: {seen}")
            )
    return tuple(entries)


def correction_words(correction: Correction, words: Words = _METRIC) -> str:
    """The value of a correction as a person reads it."""
    value = correction.value
    if correction.kind == "tape":
        return words.diameter(value, unit=True)
    if correction.kind in ("breast_height", "tape_height"):
        return words.height(value, unit=True)
    if correction.kind == "least_arc":
        return f"{value:.0f}°"
    if correction.kind == "left_out":
        return f"{len(value):,} points"
    if correction.kind == "ring":
        return f"{len(value)} corners"
    if correction.kind == "ground":
        return "set at a place chosen by hand"
    return str(value)


def write_edits_csv(path: Path | str, entries: Iterable[LogEntry]) -> Path:
    """Write the log as a table: UTF-8, comma, one header line.

    Raises:
        FileError: It cannot be written.
    """
    path = Path(path)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(EDIT_COLUMNS)
    writer.writerows([defused(str(cell)) if cell is not None else "" for cell in cells(entry)] for entry in entries)
    with written_whole(path) as file:
        file.write(text.getvalue().encode("utf-8", errors="replace"))
    return path


def cells(entry: LogEntry) -> Sequence[Any]:
    """In the order of `EDIT_COLUMNS`."""
    return [getattr(entry, name) for name in EDIT_COLUMNS]
