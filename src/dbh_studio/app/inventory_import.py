"""One's own inventory read back: what was said of each stem is restored, as one command that can be undone.

Stems are told by `stem_id`. Diameters are never touched. Whatever does not fit is said before anything is changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from dbh_studio.app.commands import Command, existing_trunk, with_records
from dbh_studio.app.document import Document
from dbh_studio.app.import_places import misplaced_stems
from dbh_studio.app.import_table import MOST_LISTED, SAME_TAPE, TEXTS, ImportOptions, ImportTable, StemSaid
from dbh_studio.app.session import Session
from dbh_studio.core.corrections import Correction, CorrectionKind, with_correction, without_correction
from dbh_studio.core.tree_record import TreeRecord
from dbh_studio.errors import CommandError, MisfitError
from dbh_studio.io.inventory_csv import defused, undefused
from dbh_studio.io.tables import read_cells

__all__ = ["ImportOptions", "ImportPlan", "apply_import", "import_inventory", "plan_import"]

_TAPE_WORDS: Mapping[CorrectionKind, str] = {"tape": "tape value", "tape_height": "tape height"}


@dataclass(frozen=True)
class ImportPlan:
    """What a table would change.

    Attributes:
        path: The table.
        said: By id of the stem, those only that the plot has.
        changes: How many stems would say something else, by what: ``species``, ``note``, …
        n_changed: How many stems in all.
        notes: What was odd, and what is not taken over, in plain words.
        command: The edit; None where nothing would change.
    """

    path: Path
    said: Mapping[int, StemSaid]
    changes: Mapping[str, int]
    n_changed: int
    notes: tuple[str, ...] = ()
    command: Command | None = field(default=None, repr=False)

    @property
    def words(self) -> str:
        """What would change, in a sentence."""
        if not self.n_changed:
            return f"{self.path.name} says nothing that the plot does not say already."
        parts = ", ".join(f"{name} of {count}" for name, count in self.changes.items())
        return f"{self.n_changed} of the {len(self.said)} stems in {self.path.name} change: {parts}."


def plan_import(session: Session, path: Path, options: ImportOptions | None = None) -> ImportPlan:
    """Read a table and say what it would change; nothing is changed.

    Raises:
        FileError: The table cannot be read, has no `stem_id`, or cells that cannot be understood; says which lines.
        MisfitError: It speaks of stems the plot has not, or that stand elsewhere (unless they are to be left out).
        CommandError: It is of another plot.
        UnscaledCloudError: The plot has no scale, so the stems' places cannot be compared.
    """
    options = options or ImportOptions()
    document = session.document
    table = ImportTable(read_cells(path), document)
    ids = table.stem_ids()
    known = [i in document.trunks for i in ids]
    if not any(known):
        there = _listed(document.trunks.ids) or "none"
        raise CommandError(
            f"None of the stems in {path.name} is in this plot.",
            f"The plot has {there}; the table has {_listed(ids)}. Is it of another plot?",
        )
    session.require_scale(document)
    inventory = session.inventory(document=document)
    wrong, moved = misplaced_stems(table.cells, ids, inventory, path)
    strangers = [i for i, is_known in zip(ids, known, strict=True) if not is_known]
    _check_misfits(path, strangers, wrong, options)
    said = table.said(ids, options)
    taken = {i: each for i, each in said.items() if i in document.trunks and i not in wrong}
    command = _command(path, taken, session.author)
    changes, n_changed = _changes(document, command.apply(document), taken)
    notes = [*table.cells.notes, *moved, *table.notes(options, inventory)]
    if strangers or wrong:
        notes.append(f"Left out: stems {_listed(sorted({*strangers, *wrong}))}.")
    return ImportPlan(path, taken, changes, n_changed, tuple(notes), command if n_changed else None)


def import_inventory(session: Session, path: Path, options: ImportOptions | None = None) -> ImportPlan:
    """Take a table over, as one command.

    Raises:
        FileError: As `plan_import`.
        CommandError: As `plan_import`; nothing has changed.
        UnscaledCloudError: As `plan_import`.
    """
    document = session.document
    plan = plan_import(session, path, options)
    apply_import(session, document, plan)
    return plan


def apply_import(session: Session, document: Document, plan: ImportPlan) -> None:
    """Do what was planned for `document`.

    Raises:
        StaleResultError: The trunks are others by now.
        CommandError: The plot is open for reading only.
    """
    if plan.command is not None:
        session.do(plan.command, based_on=document, reads=("trunks",))


# ---- the command


def _command(path: Path, said: Mapping[int, StemSaid], who: str) -> Command:
    when = datetime.now(timezone.utc).isoformat(timespec="seconds")
    source = f"from {path.name}"

    def apply(document: Document) -> Document:
        trees = _trees(document, said)
        records = {}
        for stem_id, each in said.items():
            existing_trunk(document, stem_id)
            try:
                records[stem_id] = _told(document.record(stem_id), each, (who, when, source))
                records[stem_id] = replace(records[stem_id], tree_id=trees[stem_id])
            except ValueError as error:
                raise CommandError(f"This cannot be said about trunk {stem_id}: {error}.") from None
        return with_records(document, records)

    return Command(f"Take over {path.name}", apply)


def _told(record: TreeRecord, said: StemSaid, signed: tuple[str, str, str]) -> TreeRecord:
    corrections = record.corrections
    for kind, value in said.tapes.items():
        before = record.correction(kind)
        if np.isnan(value):
            corrections = without_correction(corrections, kind)
        elif before is None or abs(before - value) > SAME_TAPE[kind]:
            corrections = with_correction(corrections, Correction(kind, value, *signed))
    texts: dict[str, Any] = {
        name: text for name, text in said.texts.items() if not _is_same(getattr(record, name), text)
    }
    own = dict(record.fields)
    own |= {name: text for name, text in said.fields.items() if not _is_same(own.get(name, ""), text)}
    return replace(record, **texts, fields=tuple(own.items()), corrections=corrections)


def _is_same(before: str, text: str) -> bool:
    """Whether a text went out and came back as it was: tables do not keep blanks at the ends, nor some line ends."""
    return before == text or undefused(defused(before).strip()).strip() == text


def _trees(document: Document, said: Mapping[int, StemSaid]) -> dict[int, int | None]:
    """The tree of each stem, as a record says it: None for one that is a tree of its own."""
    after = {i: document.record(i).tree_id or i for i in document.trunks.ids}
    after |= {i: each.tree_id for i, each in said.items() if each.tree_id is not None}
    n_stems: dict[int, int] = {}
    for tree in after.values():
        n_stems[tree] = n_stems.get(tree, 0) + 1
    trees: dict[int, int | None] = {}
    for i, each in said.items():
        is_alone = after[i] == i and n_stems[i] == 1
        trees[i] = document.record(i).tree_id if each.tree_id is None else None if is_alone else after[i]
    return trees


def _changes(before: Document, after: Document, said: Mapping[int, StemSaid]) -> tuple[dict[str, int], int]:
    """How many stems say something else, by what."""
    counts: dict[str, int] = {}
    n_changed = 0
    for stem_id in said:
        one, other = before.record(stem_id), after.record(stem_id)
        names = [name.replace("_", " ") for name in TEXTS if getattr(one, name) != getattr(other, name)]
        names += ["tree"] if one.tree_id != other.tree_id else []
        own, new = dict(one.fields), dict(other.fields)
        names += [name for name in {**own, **new} if own.get(name) != new.get(name)]
        for kind, words in _TAPE_WORDS.items():
            if one.correction(kind) != other.correction(kind):
                names.append(words)
        n_changed += bool(names)
        for name in names:
            counts[name] = counts.get(name, 0) + 1
    return counts, n_changed


def _check_misfits(path: Path, strangers: Sequence[int], wrong: Sequence[int], options: ImportOptions) -> None:
    """Raise MisfitError where stems do not fit and nobody said that they may be left out."""
    if options.skip_misfits or not (strangers or wrong):
        return
    parts = []
    if strangers:
        parts.append(f"the plot has no stems {_listed(strangers)}: they were merged, split or deleted since")
    if wrong:
        parts.append(f"stems {_listed(sorted(wrong))} stand elsewhere than the table says")
    raise MisfitError(
        f"{path.name} does not fit this plot: {'; '.join(parts)}.",
        "Nothing was changed. Correct the table, or say that these stems may be left out.",
    )


def _listed(ids: Sequence[int]) -> str:
    shown = ", ".join(map(str, ids[:MOST_LISTED]))
    return f"{shown} and {len(ids) - MOST_LISTED} more" if len(ids) > MOST_LISTED else shown
