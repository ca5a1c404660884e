"""What a person says about a stem; nothing here is computed from the stem's points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from dbh_studio.core.corrections import CORRECTION_KINDS, Correction, CorrectionKind
from dbh_studio.core.trunks import MAX_TRUNK_ID

TreeStatus = Literal["live", "dead", "broken", ""]
TREE_STATUSES: tuple[TreeStatus, ...] = ("live", "dead", "broken", "")
ReviewDecision = Literal["accepted", "doubtful"]
_TEXTS = ("species", "note", "tag", "flag", "health", "crown_class")


@dataclass(frozen=True)
class Review:
    """A person has looked at a stem's measurement and decided; what was decided about, so that it can go stale.

    Attributes:
        decision: ``accepted``, or ``doubtful``: to be looked at again.
        dbh_cm: The diameter that was looked at; None where there was none.
        refusal: The code of the refusal that was looked at; empty where there was a diameter.
        who: Who decided.
        when: ISO 8601, UTC.
    """

    decision: ReviewDecision
    dbh_cm: float | None
    refusal: str = ""
    who: str = ""
    when: str = ""

    def __post_init__(self) -> None:
        if self.decision not in ("accepted", "doubtful"):
            raise ValueError(f"decision is {self.decision!r} but must be accepted or doubtful")
        if self.dbh_cm is not None and not (math.isfinite(self.dbh_cm) and self.dbh_cm > 0):
            raise ValueError(f"the diameter looked at is {self.dbh_cm!r} but must be above 0, or None")


@dataclass(frozen=True)
class TreeRecord:
    """What a person says about a stem.

    Attributes:
        species: Name or code as the person writes it.
        status: ``live``, ``dead``, ``broken``, or empty where nobody said.
        note: Free text.
        tag: The number on the tree's tag.
        edited: Whether a person changed the stem's points.
        tree_id: The tree this stem belongs to; None where the stem is a tree of its own.
        flag: What the search that found the stem wants looked at; a person may clear it.
        health: As the person writes it.
        crown_class: As the person writes it; dominant, codominant, intermediate, suppressed are offered.
        fields: Values of fields the person has added, (name, value), in order of name; none is empty.
        corrections: How this stem is measured otherwise than the plot, at most one of a kind.
        review: What was decided when somebody looked at it; None where nobody has.
    """

    species: str = ""
    status: TreeStatus = ""
    note: str = ""
    tag: str = ""
    edited: bool = False
    tree_id: int | None = None
    flag: str = ""
    health: str = ""
    crown_class: str = ""
    fields: tuple[tuple[str, str], ...] = ()
    corrections: tuple[Correction, ...] = ()
    review: Review | None = None

    def __post_init__(self) -> None:
        for name in _TEXTS:
            check_text(name, getattr(self, name))
        if self.status not in TREE_STATUSES:
            raise ValueError(f"status is {self.status!r} but must be one of {TREE_STATUSES}")
        if not isinstance(self.edited, bool):
            raise ValueError(f"edited is {self.edited!r} but must be True or False")
        if self.tree_id is not None:
            is_whole = isinstance(self.tree_id, int) and not isinstance(self.tree_id, bool)
            if not (is_whole and 0 < self.tree_id <= MAX_TRUNK_ID):
                raise ValueError(f"tree id is {self.tree_id!r} but must be a number from 1 to {MAX_TRUNK_ID}")
        object.__setattr__(self, "fields", _checked_fields(self.fields))
        kinds = [correction.kind for correction in self.corrections]
        if kinds != sorted(set(kinds), key=CORRECTION_KINDS.index):
            raise ValueError(f"corrections {kinds} must be one of a kind, in order")

    @property
    def remark(self) -> str:
        """The note, and what is to be looked at."""
        return "; ".join(filter(None, (self.note, self.flag)))

    def correction(self, kind: CorrectionKind) -> Any:
        """The value of the correction of a kind; None where there is none."""
        return next((each.value for each in self.corrections if each.kind == kind), None)


def _checked_fields(given: Any) -> tuple[tuple[str, str], ...]:
    pairs = given.items() if isinstance(given, Mapping) else given
    known: dict[str, str] = {}
    for name, value in pairs:
        check_text("the name of a field", name)
        check_text(name, value)
        if not name.strip():
            raise ValueError("a field needs a name")
        if value:
            known[name] = value
    return tuple(sorted(known.items()))


def check_text(name: str, text: object) -> None:
    """Raise ValueError unless `text` is one that a file can hold: half of a surrogate pair would stop all saving."""
    if not isinstance(text, str):
        raise ValueError(f"{name} is {text!r} but must be text")
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ValueError(f"{name} is {text!r} but must be text that can be written as UTF-8") from None
