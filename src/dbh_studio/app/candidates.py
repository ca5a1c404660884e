"""Stems that masks did not make trunks, offered to a person: listed, accepted as a trunk, or dismissed.

    for offer in open_offers(session): …
    accept_candidate(session, offer.candidate)      one command; Undo puts it back on the list

They are kept beside the Document, for they decide nothing, and beside the plot so that a reload has them.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from dbh_studio.app.commands import Command
from dbh_studio.app.document import Document
from dbh_studio.app.edits import LEAST_POINTS, add_trunk
from dbh_studio.app.kept import read_kept
from dbh_studio.core.candidates import CandidateKind, CandidateTrunk
from dbh_studio.core.inventory import TreeRecord
from dbh_studio.errors import CommandError
from dbh_studio.io.atomic import atomic_file

if TYPE_CHECKING:
    from dbh_studio.app.session import Session

log = logging.getLogger(__name__)

_FILE = Path("cache") / "candidates.npz"
_VERSION = 1
# A candidate is no longer offered where trunks have so much of it.
_TAKEN = 0.5


@dataclass(frozen=True, eq=False)
class Offers:
    """The candidates of the last search by masks.

    Attributes:
        candidates: From west to east.
        metres_per_unit: The scale their lengths were taken with.
        dismissed: Numbers of those a person does not want to see again.
    """

    candidates: tuple[CandidateTrunk, ...]
    metres_per_unit: float = 1.0
    dismissed: frozenset[int] = frozenset()


@dataclass(frozen=True, eq=False)
class Offer:
    """A candidate as the plot is now.

    Attributes:
        number: Its place in the list of all, from 1: it stays the same while others are accepted or dismissed.
        candidate: The candidate.
        xyz_m: (3,) the middle of its points in the world frame.
        diameter_m: A guess, by its rings.
    """

    number: int
    candidate: CandidateTrunk
    xyz_m: tuple[float, float, float]
    diameter_m: float

    @property
    def reason(self) -> str:
        """Why it is only a candidate."""
        return self.candidate.reason


@contextmanager
def offering(session: Session, document: Document, candidates: Sequence[CandidateTrunk]) -> Iterator[None]:
    """Offer what a search run for `document` found, in place of what was offered before; not where the block fails.

    Before its trunks come into the plot, for those who are told of these look at the candidates too.
    """
    before = session.offers
    session.offers = Offers(tuple(candidates), document.scale.metres_per_unit if document.scale.is_known else 1.0)
    try:
        yield
    except BaseException:
        session.offers = before
        raise
    _keep(session)


def open_offers(session: Session) -> tuple[Offer, ...]:
    """The candidates that are neither dismissed nor, by now, part of trunks.

    None where no trunk of the plot is by masks: the search they belong to was undone.
    """
    offers, document = session.offers, session.document
    if offers is None or not any(trunk.origin == "masks" for trunk in document.trunks):
        return ()
    owned = np.zeros(len(session.cloud), bool)
    for trunk in document.trunks:
        owned[trunk.points] = True
    ratio = document.scale.metres_per_unit / offers.metres_per_unit if document.scale.is_known else 1.0
    points_world = session.points_world(document)
    found = []
    for number, candidate in enumerate(offers.candidates, start=1):
        if number in offers.dismissed or owned[candidate.points].mean() >= _TAKEN:
            continue
        x, y, z = np.median(points_world[candidate.points], axis=0).tolist()
        found.append(Offer(number, candidate, (x, y, z), ratio * candidate.diameter_m))
    return tuple(found)


def add_candidates(candidates: Sequence[CandidateTrunk]) -> Command:
    """Make trunks of candidates, flagged with the reason. Points that trunks have stay with these.

    The command raises CommandError where nothing of a candidate is left.
    """

    def apply(document: Document) -> Document:
        for candidate in candidates:
            before = set(document.trunks.ids)
            added = add_trunk(candidate.points).apply(document)
            (new_id,) = set(added.trunks.ids) - before
            trunks = added.trunks.with_trunk(replace(added.trunks[new_id], origin="geometry"))
            what = "accepted though low" if candidate.kind == "low" else "no trunk by the masks"
            record = TreeRecord(flag=f"{what}: {candidate.reason}")
            document = replace(added, trunks=trunks, trees={**added.trees, new_id: record})
        return document

    return Command("Accept a candidate" if len(candidates) == 1 else f"Accept {len(candidates)} candidates", apply)


def accept_candidate(session: Session, candidate: CandidateTrunk) -> int:
    """Make a trunk of a candidate: one command, with a number of its own that is never given to another.

    Returns:
        The id of the trunk.

    Raises:
        CommandError: Other trunks have all of its points.
    """
    change = session.do(add_candidates([candidate]))
    (new_id,) = set(change.after.trunks.ids) - set(change.before.trunks.ids)
    return new_id


def accept_all(session: Session) -> int:
    """Make trunks of all candidates that are open and stems by their shape, in one command; how many."""
    stems = [offer.candidate for offer in open_offers(session) if offer.candidate.kind != "low"]
    if stems:
        session.do(add_candidates(stems))
    return len(stems)


def dismiss_candidate(session: Session, number: int) -> None:
    """Do not offer a candidate any more; `bring_back` does again.

    Raises:
        CommandError: There is none of this number, or the plot is open for reading only.
    """
    offers = session.offers
    if offers is None or not 0 < number <= len(offers.candidates):
        raise CommandError(f"There is no candidate {number}.")
    if session.is_read_only:
        raise CommandError("The plot is open for reading only.", "Open it for writing to change it.")
    session.offers = replace(offers, dismissed=offers.dismissed | {number})
    _keep(session)


def bring_back(session: Session) -> None:
    """Offer again what was dismissed."""
    if session.offers is not None and session.offers.dismissed and not session.is_read_only:
        session.offers = replace(session.offers, dismissed=frozenset())
        _keep(session)


# ---- beside the plot


def _keep(session: Session) -> None:
    if session.saver is not None:
        keep_offers(session.saver.folder, session)


def keep_offers(folder: Path, session: Session) -> None:
    """Write them into the folder of a saved plot. That they cannot be written is no loss, and only logged."""
    offers, path = session.offers, folder / _FILE
    try:
        if offers is None:
            path.unlink(missing_ok=True)
            return
        about = {
            "version": _VERSION,
            "fingerprint": session.document.source.fingerprint,
            "n_points": len(session.cloud),
            "metres_per_unit": offers.metres_per_unit,
            "dismissed": sorted(offers.dismissed),
            "candidates": [
                [*each.xy_m, each.diameter_m, each.kind, each.reason, each.n_seen, each.n_called]
                for each in offers.candidates
            ],
        }
        path.parent.mkdir(exist_ok=True)
        with atomic_file(path) as file:
            np.savez(
                file,
                about=json.dumps(about, allow_nan=False),
                ends=np.cumsum([len(each) for each in offers.candidates], dtype=np.int64),
                points=np.concatenate([np.empty(0, np.int32), *(each.points for each in offers.candidates)]),
            )
    except (OSError, ValueError) as error:
        log.warning("The candidates for trunks were not kept: %s", error)


def kept_offers(folder: Path, document: Document) -> Offers | None:
    """What `keep_offers` wrote for the same cloud; None where there is nothing that can be used."""
    what = "The candidates for trunks"
    return read_kept(folder / _FILE, document, _offers_from, version=_VERSION, what=what)


def _offers_from(about: dict[str, Any], saved: Mapping[str, Any]) -> Offers:
    """Raises what comes of a file that is not as `keep_offers` made it."""
    points, ends = saved["points"].astype(np.int32), saved["ends"].astype(np.int64)
    point_sets = np.split(points, ends[:-1]) if len(ends) else []
    candidates = []
    for points, row in zip(point_sets, about["candidates"], strict=True):
        x, y, diameter, kind, reason, n_seen, n_called = row
        if kind not in get_args(CandidateKind) or len(points) < LEAST_POINTS or points[-1] >= about["n_points"]:
            raise ValueError("a candidate in it cannot be")
        numbers = (float(x), float(y)), float(diameter)
        candidates.append(CandidateTrunk(points, *numbers, kind, str(reason), int(n_seen), int(n_called)))
    dismissed = frozenset(int(number) for number in about["dismissed"])
    return Offers(tuple(candidates), float(about["metres_per_unit"]), dismissed)
