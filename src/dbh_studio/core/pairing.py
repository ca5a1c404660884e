"""Which stem of an inventory is which stem of a reference: by number, or by place where the frames may differ.

Diameters are never looked at: pairs chosen by how well they agree would make every evaluation look better than it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from dbh_studio.core.arrays import Bool, Float64, Int64, readonly
from dbh_studio.core.stem_layout import FrameFit, PairingRule, lay_on
from dbh_studio.core.stem_table import StemTable, id_key
from dbh_studio.errors import StudioError

# Numbers are believed if the places of this many stems of equal number fit together.
_MIN_IDS = 4
OUT_OF_AREA = "it stands outside the area of the reference"


@dataclass(frozen=True, eq=False)
class Pairing:
    """The pairs, and what became of every other row.

    Attributes:
        by: What they were paired by: ``id`` or ``position``.
        rows: (P, 2) row of the inventory, row of the reference.
        distance_m: (P,) between the two, once laid on each other; NaN where unknown.
        next_m: (P,) from the reference stem to the nearest other stem of the inventory; NaN where there is none.
        missed: Why, by row of the reference.
        extra: Why, by row of the inventory.
        outside_inventory: Rows of the inventory in plots the reference does not have.
        outside_reference: Rows of the reference in plots the inventory does not have.
        frames: One for each plot that was paired by place.
        notes: What to know about it, in plain words.
        is_checked: Whether the places of equal numbers were seen to agree.
    """

    by: Literal["id", "position"]
    rows: Int64
    distance_m: Float64
    next_m: Float64
    missed: Mapping[int, str] = field(default_factory=dict)
    extra: Mapping[int, str] = field(default_factory=dict)
    outside_inventory: tuple[int, ...] = ()
    outside_reference: tuple[int, ...] = ()
    frames: tuple[FrameFit, ...] = ()
    notes: tuple[str, ...] = ()
    is_checked: bool = False


@dataclass(frozen=True, eq=False)
class _Part:
    """One plot, or everything where plots are not named: rows of both tables."""

    plot: str
    inventory: Int64
    reference: Int64


@dataclass(eq=False)
class _Found:
    rows: list[tuple[int, int]] = field(default_factory=list)
    distance: list[float] = field(default_factory=list)
    following: list[float] = field(default_factory=list)
    missed: dict[int, str] = field(default_factory=dict)
    extra: dict[int, str] = field(default_factory=dict)
    frames: list[FrameFit] = field(default_factory=list)


def pair_stems(inventory: StemTable, reference: StemTable, rule: PairingRule | None = None) -> Pairing:
    """Pair the stems of two tables, one to one, plot by plot.

    Raises:
        StudioError: They cannot be paired that way; says why and what to do.
    """
    rule = rule or PairingRule()
    parts, outside, notes = _parts(inventory, reference)
    by, more = _way(inventory, reference, parts, rule)
    found = _paired(inventory, reference, parts, rule, by)
    if rule.by == "auto" and by == "id" and inventory.has_positions and reference.has_positions:
        # Tags that are missing, or there twice, are no reason to lose a stem that stands where it should.
        by_place = _paired(inventory, reference, parts, rule, "position")
        if len(by_place.rows) > len(found.rows):
            more = [f"Paired by place: {len(by_place.rows)} pairs, of which the numbers give {len(found.rows)}."]
            by, found = "position", by_place
    if not found.rows:
        reasons = [frame.reason for frame in found.frames if frame.reason]
        raise StudioError(
            f"No stem of {inventory.name} could be paired with one of {reference.name}"
            + (f": {reasons[0]}." if reasons else f" by {'number' if by == 'id' else 'place'}."),
            "Say how: by number or by place, which columns hold them, and how far apart two records of a stem may be.",
        )
    return Pairing(
        by,
        readonly(np.array(found.rows, np.int64).reshape(-1, 2)),
        readonly(np.array(found.distance, np.float64)),
        readonly(np.array(found.following, np.float64)),
        found.missed,
        found.extra,
        *outside,
        frames=tuple(found.frames),
        notes=(*notes, *more, *_frame_notes(found.frames)),
        is_checked=by == "id" and rule.by == "auto" and inventory.has_positions and reference.has_positions,
    )


def _paired(
    inventory: StemTable, reference: StemTable, parts: list[_Part], rule: PairingRule, by: Literal["id", "position"]
) -> _Found:
    found = _Found()
    for part in parts:
        if by == "id":
            _by_id(inventory, reference, part, found)
        else:
            _by_position(inventory, reference, part, rule, found)
    return found


# ---- plots


def _parts(a: StemTable, b: StemTable) -> tuple[list[_Part], tuple[tuple[int, ...], tuple[int, ...]], list[str]]:
    """The plots both tables have; the rows of the others; what to know about it."""
    mine, theirs = [id_key(p) for p in a.plots], [id_key(p) for p in b.plots]
    have = set(mine)
    common = [plot for plot in dict.fromkeys(theirs) if plot in have]
    everything = [_Part("", np.arange(len(a)), np.arange(len(b)))]
    if not (a.has_plots and b.has_plots):
        return everything, ((), ()), []
    if not common:
        if len(set(mine)) == len(set(theirs)) == 1:
            return everything, ((), ()), [f"Plot {a.plots[0]} of {a.name} is taken to be plot {b.plots[0]}."]
        raise StudioError(
            f"{a.name} and {b.name} have no plot in common ({_some(a.plots)} against {_some(b.plots)}).",
            "Name the plots alike, name the column they stand in, or say that one table has no plots.",
        )
    shown = {key: plot for key, plot in zip(theirs, b.plots, strict=True)}
    my_rows, their_rows = _rows_by_plot(mine), _rows_by_plot(theirs)
    parts = [_Part(shown[p], np.array(my_rows[p], np.int64), np.array(their_rows[p], np.int64)) for p in common]
    outside = (
        tuple(i for i, plot in enumerate(mine) if plot not in their_rows),
        tuple(i for i, plot in enumerate(theirs) if plot not in my_rows),
    )
    notes = [
        f"{len(rows)} stems of {table.name} are of plots that {other.name} does not have, and are not counted."
        for rows, table, other in ((outside[0], a, b), (outside[1], b, a))
        if rows
    ]
    return parts, outside, notes


def _rows_by_plot(plots: list[str]) -> dict[str, list[int]]:
    rows: dict[str, list[int]] = {}
    for row, plot in enumerate(plots):
        rows.setdefault(plot, []).append(row)
    return rows


def _some(names: tuple[str, ...]) -> str:
    distinct = list(dict.fromkeys(name or "unnamed" for name in names))
    return ", ".join(distinct[:3]) + (", …" if len(distinct) > 3 else "")


# ---- by number or by place


def _way(
    a: StemTable, b: StemTable, parts: list[_Part], rule: PairingRule
) -> tuple[Literal["id", "position"], list[str]]:
    can_id, can_place = a.has_ids and b.has_ids, a.has_positions and b.has_positions
    wanted = rule.by
    if wanted == "id" or (wanted == "auto" and not can_place):
        if not can_id:
            lacking = a if not a.has_ids else b
            what = "numbers" if wanted == "id" else "numbers and no places that both tables have"
            raise StudioError(
                f"{lacking.name} has no {what}.", "Name the columns that hold numbers (id) or places (x and y)."
            )
        told = "" if wanted == "id" else " There are no places in both tables to check them by."
        return "id", [f"Paired by number.{told}"]
    if wanted == "position":
        if not can_place:
            lacking = a if not a.has_positions else b
            raise StudioError(f"{lacking.name} has no places.", "Name its columns x and y, or pair by number.")
        return "position", ["Paired by place."]
    agree = _ids_agree(a, b, parts, rule) if can_id else False
    if agree:
        return "id", ["Paired by number: stems of equal number stand in the same places."]
    said = " Equal numbers stand in other places, so they are not the same trees." if agree is False and can_id else ""
    return "position", [f"Paired by place.{said}"]


def _ids_agree(a: StemTable, b: StemTable, parts: list[_Part], rule: PairingRule) -> bool | None:
    """Whether stems of equal number have equal places, up to a turn and a shift; None where too few are common."""
    votes = []
    for part in parts:
        rows = _equal_ids(a, b, part)[0]
        xy, target = a.xy_m[rows[:, 0]], b.xy_m[rows[:, 1]]
        known = np.isfinite(xy).all(axis=1) & np.isfinite(target).all(axis=1)
        if known.sum() >= _MIN_IDS:
            left = _left_over(xy[known], target[known])
            votes.append(bool(np.median(left) <= rule.max_distance_m))
    return sum(votes) > 0.5 * len(votes) if votes else None


def _left_over(xy: Float64, target: Float64) -> Float64:
    """(N,) distances after the best turn and shift of the better half; one wrong tag must not hide the others."""
    kept = np.ones(len(xy), bool)
    left = np.zeros(len(xy))
    for _ in range(6):
        a, b = xy[:, 0] + 1j * xy[:, 1], target[:, 0] + 1j * target[:, 1]
        a, b = a - a[kept].mean(), b - b[kept].mean()
        turn = (np.conj(a[kept]) * b[kept]).sum()
        left = np.abs(b - a * turn / max(abs(turn), 1e-300))
        kept = left <= np.median(left)
    return left


def _equal_ids(a: StemTable, b: StemTable, part: _Part) -> tuple[Int64, dict[int, str], dict[int, str]]:
    """(P, 2) rows of equal number, and why each other row has no partner."""
    mine, theirs = _by_key(a, part.inventory), _by_key(b, part.reference)
    rows: list[tuple[int, int]] = []
    extra: dict[int, str] = {}
    missed: dict[int, str] = {}
    for table, keys, others, name, into in ((a, mine, theirs, b.name, extra), (b, theirs, mine, a.name, missed)):
        for key, members in keys.items():
            if not key:
                reason = f"it has no number in {table.name}"
            elif len(members) > 1:
                reason = f"number {table.ids[members[0]]} is there {len(members)} times in {table.name}"
            elif len(others.get(key, ())) > 1:
                reason = f"number {table.ids[members[0]]} is there {len(others[key])} times in {name}"
            elif key not in others:
                reason = f"{name} has no number {table.ids[members[0]]}"
            else:
                continue
            into.update(dict.fromkeys(members, reason))
    for key, members in mine.items():
        if key and len(members) == 1 and len(theirs.get(key, ())) == 1:
            rows.append((members[0], theirs[key][0]))
    return np.array(rows, np.int64).reshape(-1, 2), extra, missed


def _by_key(table: StemTable, rows: Int64) -> dict[str, list[int]]:
    keys: dict[str, list[int]] = {}
    for row in rows.tolist():
        keys.setdefault(id_key(table.ids[row]), []).append(row)
    return keys


def _by_id(a: StemTable, b: StemTable, part: _Part, found: _Found) -> None:
    rows, extra, missed = _equal_ids(a, b, part)
    found.rows += [(int(i), int(j)) for i, j in rows]
    found.distance += [float("nan")] * len(rows)
    found.following += [float("nan")] * len(rows)
    found.extra.update(extra)
    found.missed.update(missed)


def _by_position(a: StemTable, b: StemTable, part: _Part, rule: PairingRule, found: _Found) -> None:
    mine, theirs = _with_place(a, part.inventory), _with_place(b, part.reference)
    frame, pairs, distance, following = lay_on(a.xy_m[mine], b.xy_m[theirs], rule=rule, plot=part.plot)
    found.frames.append(frame)
    paired = [(int(mine[i]), int(theirs[j])) for i, j in pairs]
    found.rows += paired
    found.distance += distance.tolist()
    found.following += following.tolist()
    beyond = set(mine[_beyond(frame, a.xy_m[mine], b.xy_m[theirs], rule.max_distance_m)].tolist())
    for table, rows, placed, taken, other, into in (
        (a, part.inventory, mine, {i for i, _ in paired}, b, found.extra),
        (b, part.reference, theirs, {j for _, j in paired}, a, found.missed),
    ):
        has_place = set(placed.tolist())
        for row in rows.tolist():
            if row not in has_place:
                into[row] = f"it has no place in {table.name}"
            elif row not in taken:
                alone = f"no stem of {other.name} within {rule.max_distance_m:g} m that is not taken"
                into[row] = frame.reason or (OUT_OF_AREA if into is found.extra and row in beyond else alone)


def _beyond(frame: FrameFit, xy_m: Float64, target_m: Float64, margin_m: float) -> Bool:
    """(N,) which stems of the inventory stand farther out than any of the reference."""
    if not len(target_m):
        return np.zeros(len(xy_m), bool)
    middle = target_m.mean(axis=0)
    reach = np.linalg.norm(target_m - middle, axis=1).max() + margin_m
    return np.asarray(np.linalg.norm(frame.target_from_source.apply(xy_m) - middle, axis=1) > reach)


def _with_place(table: StemTable, rows: Int64) -> Int64:
    return np.asarray(rows[np.isfinite(table.xy_m[rows]).all(axis=1)], np.int64)


def _frame_notes(frames: list[FrameFit]) -> list[str]:
    """How the maps lie on each other, plot by plot where there are few."""
    notes = []
    moved = [frame for frame in frames if frame.is_moved and frame.n_pairs]
    if len(moved) == 1:
        frame = moved[0]
        notes.append(
            f"The frames differ: the inventory was turned by {frame.turn_deg:+.1f}° and moved by {frame.moved_m:,.2f} "
            f"m; {frame.n_pairs} pairs are then {100 * frame.rms_m:.0f} cm apart (root mean square)."
        )
    elif moved:
        turns, shifts = [f.turn_deg for f in moved], [f.moved_m for f in moved]
        notes.append(
            f"The frames differ in {len(moved)} of {len(frames)} plots: they were turned by {min(turns):+.1f}° to "
            f"{max(turns):+.1f}° and moved by {min(shifts):.2f} to {max(shifts):.2f} m; the pairs are then "
            f"{100 * np.median([f.rms_m for f in moved]):.0f} cm apart (root mean square, median plot)."
        )
    failed = [frame for frame in frames if frame.reason]
    return notes + [f"{_plot(frame)}: nothing was paired: {frame.reason}." for frame in failed]


def _plot(frame: FrameFit) -> str:
    return f"Plot {frame.plot}" if frame.plot else "All stems"
