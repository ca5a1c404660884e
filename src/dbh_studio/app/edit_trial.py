"""An edit tried out before it is done: its diameters are there the moment it is.

The session tells everybody of an edit, and whoever listens wants the new number: measured first, it is there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

from dbh_studio.app.commands import Command
from dbh_studio.app.document import Document
from dbh_studio.app.session import Change, Session
from dbh_studio.app.threads import map_in_threads
from dbh_studio.core.dbh import DbhEstimate, Refusal
from dbh_studio.core.trunks import Trunk
from dbh_studio.errors import CommandError, StaleResultError

# After a new search every tree is another one; nobody reads their diameters in one sentence.
_MOST_TOLD = 6


@dataclass(frozen=True, eq=False)
class TreeEffect:
    """What became of one tree: its diameter before and after; None where it was, or is, not there or not measured."""

    trunk_id: int
    was_there: bool
    is_there: bool
    before: DbhEstimate | Refusal | None
    after: DbhEstimate | Refusal | None


def do_edit(session: Session, make: Callable[[], Command], *, seen: Document | None = None) -> Change:
    """Make a command for the plot as it is, measure what it changes, and do it.

    Args:
        session: The plot.
        make: Computes the command from the session's document.
        seen: What the person was looking at; an edit of trunks that have become others since is refused.

    Raises:
        CommandError: It cannot be applied, or the trunks were changed meanwhile; nothing has changed.
    """
    document = session.document
    if seen is not None and seen.trunks is not document.trunks:
        raise _changed_meanwhile()
    command = make()
    base = _as_applied(session, document)
    after = command.apply(base)
    if after is base:
        return Change(document, document, command.label)
    _measure_new(session, base, after)
    touched = [each.name for each in fields(Document) if getattr(after, each.name) is not getattr(base, each.name)]

    def apply(now: Document) -> Document:
        if now.trunks.next_id > base.trunks.next_id:  # numbers were given out meanwhile
            return command.apply(now)
        return replace(now, **{name: getattr(after, name) for name in touched})

    try:
        return session.do(Command(command.label, apply), based_on=document, reads=touched)
    except StaleResultError:
        raise _changed_meanwhile() from None


def effects_of(session: Session, change: Change) -> tuple[TreeEffect, ...]:
    """What a change did to the trees, for those whose points or diameters are others now; none where they are many.

    Nothing is measured for it: what is not known yet is left out.
    """
    before, after = change.before, change.after
    if before is after:
        return ()
    ids = [i for i in sorted({*before.trunks.ids, *after.trunks.ids}) if _trunk(before, i) is not _trunk(after, i)]
    if not 0 < len(ids) <= _MOST_TOLD:
        return ()
    waiting = set(session.unmeasured(before)) & set(before.trunks.ids), set(session.unmeasured(after))
    effects = []
    for i in ids:
        results = [
            session.measurement(i, document=document).result if i in document.trunks and i not in missing else None
            for document, missing in zip((before, after), waiting, strict=True)
        ]
        effects.append(TreeEffect(i, i in before.trunks, i in after.trunks, results[0], results[1]))
    return tuple(effects)


def gone_trunks(session: Session) -> list[tuple[int, str, Document]]:
    """Trunks that were there earlier and whose points are free, newest first, as far back as Undo goes.

    Returns:
        (id, what took it away, the plot with it) of each.
    """
    found: list[tuple[int, str, Document]] = []
    later = session.document
    seen: set[int] = set(later.trunks.ids)
    for label, earlier in reversed(session.earlier):
        if earlier.trunks is not later.trunks:
            for trunk in earlier.trunks:
                if trunk.id not in seen:
                    seen.add(trunk.id)
                    if _seems_free(trunk, session.document):
                        found.append((trunk.id, label, earlier))
        later = earlier
    return found


def _seems_free(trunk: Trunk, document: Document) -> bool:
    """Whether some of its points belong to nobody: a look, no proof, which the command itself wants."""
    some = trunk.points[:: max(1, len(trunk) // 8)]
    for other in document.trunks:
        if len(other):
            at = other.points.searchsorted(some).clip(0, len(other) - 1)
            if (other.points[at] == some).any():
                return False
    return len(some) > 0


def _measure_new(session: Session, base: Document, after: Document) -> None:
    """Measure what was not waiting to be measured before; left to the background while there is no ground."""
    if not after.scale.is_known or not session.has_ground():
        return
    waited = set(session.unmeasured(base))
    new = [i for i in session.unmeasured(after) if i not in waited]
    for _ in map_in_threads(lambda i: session.measurement(i, document=after), new):
        pass


def _as_applied(session: Session, document: Document) -> Document:
    """The document that the session would apply a command to: numbers once given out are not given out again."""
    trunks = document.trunks
    if trunks.next_id >= session.next_id:
        return document
    return replace(document, trunks=replace(trunks, next_id=session.next_id))


def _trunk(document: Document, trunk_id: int) -> Trunk | None:
    trunks = document.trunks
    return trunks[trunk_id] if trunk_id in trunks else None  # noqa: SIM401 - no mapping, it has no get


def _changed_meanwhile() -> CommandError:
    return CommandError(
        "The trunks were changed meanwhile, in another tab or by a search, so this was not done.",
        "Look at the tree as it is now, and do it again.",
    )
