"""The last search for trunks, step by step: remembered in the session, and beside the plot so that a reload has it."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dbh_studio.app.commands import Command
from dbh_studio.app.document import Document
from dbh_studio.app.kept import read_kept
from dbh_studio.core.arrays import UInt8, readonly
from dbh_studio.core.chain_steps import ChainSteps, Cluster, NearMiss, Step
from dbh_studio.errors import StudioError
from dbh_studio.io.atomic import atomic_file
from dbh_studio.settings import GroundSettings, TrunkSettings

if TYPE_CHECKING:
    from dbh_studio.app.session import Session

log = logging.getLogger(__name__)

_FILE = Path("cache") / "search.npz"
_VERSION = 1


@dataclass(frozen=True, eq=False)
class LastSearch:
    """One search for trunks in a plot.

    Attributes:
        steps: What became of every point and every cluster.
        when: When its result came into the plot.
        n_trunks: It found.
        ground: The ground settings it had.
        frame: Where the cloud lay: scale, rotation and shift of `world_from_source`, 13 numbers.
    """

    steps: ChainSteps
    when: datetime
    n_trunks: int
    ground: GroundSettings
    frame: tuple[float, ...]

    def remarks(self, document: Document) -> tuple[str, ...]:
        """In what the plot is no longer what was searched, in plain words; empty where it still is."""
        remarks = []
        if self.frame != _frame(document):
            remarks.append("The cloud was scaled or turned since: heights and widths here are those of the search.")
        if (self.steps.settings, self.ground) != (document.settings.trunks, document.settings.ground):
            remarks.append("Settings have changed since: find the trunks again to see what that does.")
        if self.n_trunks != len(document.trunks):
            remarks.append(f"It found {self.n_trunks} trunks; the plot has {len(document.trunks)} now.")
        elif self.steps.from_masks != (document.masks is not None):
            how = "masks" if self.steps.from_masks else "geometry"
            remarks.append(f"It looked for trunks by {how}; those of the plot now were found another way.")
        return tuple(remarks)


def apply_search(
    session: Session,
    document: Document,
    command: Command,
    steps: ChainSteps | None,
    *,
    n_trunks: int,
    reads: Iterable[str],
) -> None:
    """Put the trunks of a search, run for `document`, into the plot, and remember how it went.

    Args:
        session: The plot.
        document: The state that was searched.
        command: Puts the trunks in.
        steps: How it went; None where nothing was searched: then nothing is remembered, either.
        n_trunks: That were found.
        reads: Fields of `document` that it was computed from.

    Raises:
        StaleResultError: One of them has changed meanwhile; what was remembered stays.
    """
    before = session.last_search
    # First, for those who are told of the new trunks look at it.
    session.last_search = None if steps is None else _search_of(document, steps, n_trunks)
    try:
        session.do(command, based_on=document, reads=reads)
    except StudioError:
        session.last_search = before
        raise
    if steps is not None:
        log.debug("Points by step: %s", {step.name.lower(): n for step, n in zip(Step, steps.counts, strict=True)})
    if session.saver is not None:
        keep_search(session.saver.folder, session)


def _search_of(document: Document, steps: ChainSteps, n_trunks: int) -> LastSearch:
    now = datetime.now(timezone.utc).replace(microsecond=0)
    return LastSearch(steps, now, n_trunks, document.settings.ground, _frame(document))


def _frame(document: Document) -> tuple[float, ...]:
    move = document.world_from_source
    return (move.scale, *move.rotation.ravel().tolist(), *move.translation.tolist())


# ---- beside the plot


def keep_search(folder: Path, session: Session) -> None:
    """Write it into the folder of a saved plot. That it cannot be written is no loss, and only logged."""
    search, path = session.last_search, folder / _FILE
    try:
        if search is None:
            path.unlink(missing_ok=True)
            return
        path.parent.mkdir(exist_ok=True)
        with atomic_file(path) as file:
            np.savez(file, **_arrays(search, session.document.source.fingerprint))
    except OSError as error:
        log.warning("The steps of the search for trunks were not kept: %s", error.strerror or error)


def kept_search(folder: Path, document: Document) -> LastSearch | None:
    """What `keep_search` wrote for the same cloud; None where there is nothing that can be used."""
    what = "The steps of the last search for trunks"
    return read_kept(folder / _FILE, document, _search_from, version=_VERSION, what=what)


_ROWS: dict[str, type[Cluster] | type[NearMiss]] = {"clusters": Cluster, "near_misses": NearMiss}


def _arrays(search: LastSearch, fingerprint: str) -> dict[str, Any]:
    steps = search.steps
    about = {
        "version": _VERSION,
        "fingerprint": fingerprint,
        "n_points": steps.n_points,
        "when": search.when.isoformat(),
        "n_trunks": search.n_trunks,
        "ground": search.ground.model_dump(),
        "frame": search.frame,
        "trunks": steps.settings.model_dump(),
        "from_masks": steps.from_masks,
        "joined_from": steps.joined_from,
        "size_threshold": _json_number(steps.size_threshold),
        "spacing_m": _json_number(steps.spacing_m),
        "n_stems_detected": steps.n_stems_detected,
    } | {name: _table(getattr(steps, name)) for name in _ROWS}
    return {
        "about": json.dumps(about, allow_nan=False),
        # Eight steps need no byte each; compressing would take ten times as long.
        "labels": _packed(steps.labels),
        "dropped_cluster": steps.dropped_cluster,
        "tilt_deg": steps.tilt_deg,
    }


def _search_from(about: dict[str, Any], saved: Any) -> LastSearch:
    """Raises what comes of a file that is not as `_arrays` made it."""
    labels = _unpacked(saved["labels"], about["n_points"])
    tables = {name: tuple(_row(kind, row) for row in about[name]) for name, kind in _ROWS.items()}
    steps = ChainSteps(
        labels=readonly(labels),
        dropped_cluster=readonly(saved["dropped_cluster"].astype(np.int32)),
        tilt_deg=readonly(saved["tilt_deg"].astype(np.uint8)),
        joined_from=tuple(int(n) for n in about["joined_from"]),
        size_threshold=_number(about["size_threshold"]),
        settings=TrunkSettings().changed(**about["trunks"]),
        from_masks=bool(about["from_masks"]),
        n_stems_detected=int(about["n_stems_detected"]),
        spacing_m=_number(about["spacing_m"]),
        **tables,
    )
    fits = (
        len(steps.joined_from) == len(Step),
        len(steps.dropped_cluster) == steps.counts[Step.DROPPED],
        len(steps.tilt_deg) == steps.counts[Step.NOT_SIDEWAYS],
        0 <= steps.dropped_cluster.min(initial=0) <= steps.dropped_cluster.max(initial=0) < max(len(steps.clusters), 1),
        all(0 <= cluster.point < steps.n_points for cluster in steps.clusters),
    )
    if not all(fits):
        raise ValueError("its parts do not fit together")
    frame = tuple(float(x) for x in about["frame"])
    when = datetime.fromisoformat(about["when"])
    return LastSearch(steps, when, int(about["n_trunks"]), GroundSettings().changed(**about["ground"]), frame)


def _table(rows: Iterable[Cluster | NearMiss]) -> list[list[Any]]:
    return [[_json_number(getattr(row, field.name)) for field in fields(row)] for row in rows]


def _row(kind: type[Any], values: list[Any]) -> Any:
    names = [field.name for field in fields(kind)]
    row = kind(**dict(zip(names, values, strict=True)))
    unknown = {name: float("nan") for name, value in zip(names, values, strict=True) if value is None}
    return replace(row, **unknown, **({"reasons": tuple(row.reasons)} if kind is NearMiss else {}))


def _json_number(value: Any) -> Any:
    """JSON knows no NaN."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def _packed(labels: UInt8) -> UInt8:
    """Two of (N,) labels below 16 in one byte."""
    even = labels if len(labels) % 2 == 0 else np.append(labels, np.uint8(0))
    return even[0::2] | (even[1::2] << np.uint8(4))


def _unpacked(packed: UInt8, n_labels: int) -> UInt8:
    labels = np.empty(2 * len(packed), np.uint8)
    labels[0::2], labels[1::2] = packed & 15, packed >> 4
    if not 0 <= len(labels) - n_labels <= 1 or packed.dtype != np.uint8 or labels.max(initial=0) >= len(Step):
        raise ValueError("it is about another number of points")
    return labels[:n_labels]
