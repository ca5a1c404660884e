"""Stems of an inventory or of a reference, whatever table they came from: who, where, how thick."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from dbh_studio.core.arrays import Float64, readonly

MAIN = "dbh"
"""The method of a table that has one diameter only."""


@dataclass(frozen=True, eq=False)
class StemTable:
    """N stems. What is not known is NaN or an empty text.

    Attributes:
        name: What the table is called.
        ids: (N) number or tag of each, as written.
        plots: (N) the plot of each; all empty where the table names none.
        xy_m: (N, 2) in plan, metres, in a frame of the table's own.
        diameters_cm: (N,) by method; the first method is the table's main one.
        intervals_cm: (N, 2) ends of the interval, for methods that have one.
        problems: (N) why there is no diameter, by method; empty texts where there is one.
        cells: (N) texts of every column of the file.
        notes: How the file was understood, in plain words.
    """

    name: str
    ids: tuple[str, ...]
    plots: tuple[str, ...]
    xy_m: Float64
    diameters_cm: Mapping[str, Float64]
    intervals_cm: Mapping[str, Float64] = field(default_factory=dict)
    problems: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    cells: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.ids)
        lengths = {len(self.plots), len(self.xy_m), *(len(v) for v in self.diameters_cm.values())}
        lengths |= {len(v) for part in (self.intervals_cm, self.problems, self.cells) for v in part.values()}
        if lengths - {n} or self.xy_m.shape[1:] != (2,):
            raise ValueError(f"the parts of table {self.name!r} do not all have {n} stems")
        if not self.diameters_cm:
            raise ValueError(f"table {self.name!r} has no diameters")

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods that diameters are there of, the main one first."""
        return tuple(self.diameters_cm)

    @property
    def has_positions(self) -> bool:
        """Whether any stem has a place."""
        return bool(np.isfinite(self.xy_m).all(axis=1).any())

    @property
    def has_ids(self) -> bool:
        """Whether any stem has a number."""
        return any(self.ids)

    @property
    def has_plots(self) -> bool:
        """Whether the table names plots."""
        return any(self.plots)


def combined(table: StemTable) -> StemTable:
    """One row for each tree: stems of one plot with the same number become one of √Σd², at their mean place.

    A tree with a stem that has no diameter has none. The interval of a sum of stems is not known and is left out.
    Stems without a number stay as they are.
    """
    groups: dict[tuple[str, str], list[int]] = {}
    for row, (plot, number) in enumerate(zip(table.plots, table.ids, strict=True)):
        groups.setdefault((plot, id_key(number) or f"\0{row}"), []).append(row)
    rows = list(groups.values())
    if all(len(group) == 1 for group in rows):
        return table
    first = [group[0] for group in rows]
    diameters = {m: np.array([_root_sum(values[g]) for g in rows]) for m, values in table.diameters_cm.items()}
    intervals = {
        m: np.array([ends[g[0]] if len(g) == 1 else (np.nan, np.nan) for g in rows]).reshape(-1, 2)
        for m, ends in table.intervals_cm.items()
    }
    problems = {m: tuple(_joint_problem(texts, g) for g in rows) for m, texts in table.problems.items()}
    n_joined = sum(len(g) for g in rows if len(g) > 1)
    n_trees = sum(len(g) > 1 for g in rows)
    return StemTable(
        table.name,
        tuple(table.ids[i] for i in first),
        tuple(table.plots[i] for i in first),
        readonly(np.array([table.xy_m[g].mean(axis=0) for g in rows]).reshape(-1, 2)),
        {m: readonly(values) for m, values in diameters.items()},
        {m: readonly(ends) for m, ends in intervals.items()},
        problems,
        {name: tuple(texts[i] for i in first) for name, texts in table.cells.items()},
        (*table.notes, f"{table.name}: {n_joined} stems were joined into {n_trees} trees (√Σd²)."),
    )


def id_key(number: str) -> str:
    """Equal where two numbers mean the same: ``007``, ``7`` and ``7.0`` do; case does not count."""
    text = number.strip().casefold()
    whole = text.removesuffix(".0")
    return str(int(whole)) if whole.isascii() and whole.isdigit() else text


def _root_sum(values: Float64) -> float:
    return float(values[0]) if len(values) == 1 else float(np.sqrt((values**2).sum()))


def _joint_problem(texts: tuple[str, ...], rows: list[int]) -> str:
    told = [texts[i] for i in rows if texts[i]]
    if not told or len(rows) == 1:
        return told[0] if told else ""
    return f"one of its {len(rows)} stems has no diameter: {told[0]}"
