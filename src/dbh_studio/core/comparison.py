"""An evaluation: inventories paired with a reference, every stem accounted for, the table by method and category."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.evaluation import Line, Outcome, Sample, table_lines
from dbh_studio.core.pairing import OUT_OF_AREA, Pairing, pair_stems
from dbh_studio.core.stem_layout import PairingRule
from dbh_studio.core.stem_table import MAIN, StemTable
from dbh_studio.errors import SettingError

NOT_GIVEN = "not given"
BY_INVENTORY = "inventory"
BY_REFERENCE_CM = "reference_cm"
_MOST_CATEGORIES, _MOST_NUMBERED, _MOST_LABELS = 8, 30, 200
# What a wrong unit, or a girth taken for a diameter, makes of a diameter.
_FACTORS = {
    2.54: "inches and centimetres", 1 / 2.54: "inches and centimetres", 10.0: "millimetres and centimetres",
    0.1: "millimetres and centimetres", 100.0: "metres and centimetres", 0.01: "metres and centimetres",
    np.pi: "girths and diameters", 1 / np.pi: "girths and diameters",
}  # fmt: skip
_FACTOR_TOLERANCE = 0.08
# Of two tables of one stand numbered independently R² is about 1/n, and half the diameters are off by a quarter.
_STRANGERS_N, _STRANGERS_R2, _STRANGERS_PCT = 8, 0.3, 12.0


@dataclass(frozen=True)
class Grouping:
    """What stems are told apart by.

    Attributes:
        column: Name of a column of the reference or of the inventories; or ``inventory``, ``reference_cm``.
        edges: Bounds of classes, ascending; empty for the values as they are, or thirds where they are many numbers.
        source: ``reference`` or ``inventory``; empty for the first that has the column.
    """

    column: str
    edges: tuple[float, ...] = ()
    source: str = ""

    @classmethod
    def parse(cls, text: str) -> Grouping:
        """From ``COLUMN``, ``COLUMN:180,270`` (classes), ``reference:COLUMN`` or ``inventory:COLUMN``.

        Raises:
            SettingError: The bounds do not ascend, or no column is named.
        """
        source, column = "", text.strip()
        for word in ("reference", "inventory"):
            if column.startswith(f"{word}:"):
                source, column = word, column.removeprefix(f"{word}:")
        found = re.fullmatch(r"(.*):((?:-?[0-9.]+)(?:,-?[0-9.]+)*)", column)
        edges: tuple[float, ...] = ()
        if found:
            try:
                edges = tuple(float(part) for part in found[2].split(","))
            except ValueError:
                raise SettingError(
                    f"{text}: {found[2]} are no bounds of classes.", "For example dbh:10,20,30."
                ) from None
            column = found[1]
        if not column or any(b <= a for a, b in pairwise(edges)):
            raise SettingError(f"{text}: expected COLUMN, or COLUMN:10,20,30 with ascending bounds.", "")
        return cls(column, edges, source)


@dataclass(frozen=True, eq=False)
class Comparison:
    """What an evaluation found.

    Attributes:
        reference: The table of true diameters.
        inventories: The tables compared with it.
        pairings: How each inventory was paired.
        samples: Every stem under every method.
        categories: Those of each column, in order.
        lines: The table.
        notes: What to know, in plain words.
    """

    reference: StemTable
    inventories: tuple[StemTable, ...]
    pairings: tuple[Pairing, ...]
    samples: tuple[Sample, ...]
    categories: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    lines: tuple[Line, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def methods(self) -> tuple[str, ...]:
        """Those of the table, in order."""
        return tuple(dict.fromkeys(line.method for line in self.lines))


def compare(
    inventories: Sequence[StemTable],
    reference: StemTable,
    *,
    by: Sequence[Grouping] = (),
    rule: PairingRule | None = None,
    pool: bool = False,
) -> Comparison:
    """Evaluate inventories against a reference.

    Args:
        inventories: One or several; each is paired on its own.
        reference: The diameters believed.
        by: What to tell stems apart by, besides the method.
        rule: How stems are paired.
        pool: Take the inventories for samples of one thing (flights, plots), not for rival methods.

    Raises:
        StudioError: An inventory cannot be paired.
        SettingError: No table has such a column.
    """
    inventories = tuple(inventories)
    pairings = tuple(pair_stems(table, reference, rule) for table in inventories)
    samples: list[Sample] = []
    names = _method_names(inventories, pool=pool)
    labels = [_labels(grouping, inventories, reference) for grouping in by]
    for k, (table, pairing) in enumerate(zip(inventories, pairings, strict=True)):
        groups = _Groups(by, [part[0][k] for part in labels], [part[1] for part in labels])
        for method in table.methods:
            samples += _samples(names[k][method], table, reference, pairing, method, groups)
    categories = {grouping.column: part[2] for grouping, part in zip(by, labels, strict=True)}
    notes = [note for table in (reference, *inventories) for note in table.notes]
    for table, pairing in zip(inventories, pairings, strict=True):
        prefix = f"{table.name}: " if len(inventories) > 1 else ""
        notes += [prefix + note for note in (*pairing.notes, *_pairing_notes(table, reference, pairing))]
    lines = table_lines(samples, categories)
    notes += _doubts(samples, reference)
    for named, pairing in zip(names, pairings, strict=True):
        notes += _strangers(lines, next(iter(named.values())), pairing)
    return Comparison(reference, inventories, pairings, tuple(samples), categories, lines, tuple(notes))


def _method_names(tables: Sequence[StemTable], *, pool: bool) -> list[dict[str, str]]:
    """What each method of each table is called in the results."""
    stems = [re.sub(r"\.(csv|tsv|txt)\Z", "", table.name, flags=re.IGNORECASE) for table in tables]
    stems = [name if stems.count(name) == 1 else f"{name} ({k})" for k, name in enumerate(stems, start=1)]
    named = []
    for name, table in zip(stems, tables, strict=True):
        is_alone = len(table.methods) == 1
        prefix = "" if pool or len(tables) == 1 else f"{name} "
        own = name if is_alone and not pool else MAIN
        named.append({m: own if m == MAIN and is_alone else f"{prefix}{m}" for m in table.methods})
    return named


# ---- samples


@dataclass(frozen=True)
class _Groups:
    """Labels by row: of the inventory at hand, and of the reference; None where that table does not have the column."""

    by: Sequence[Grouping]
    inventory: Sequence[Sequence[str] | None]
    reference: Sequence[Sequence[str] | None]

    def of(self, i: int | None, j: int | None) -> dict[str, str]:
        groups = {}
        for grouping, mine, theirs in zip(self.by, self.inventory, self.reference, strict=True):
            if theirs is not None and j is not None:
                groups[grouping.column] = theirs[j]
            elif theirs is None and mine is not None and i is not None:
                groups[grouping.column] = mine[i]
            elif grouping.column == BY_INVENTORY and mine:
                groups[grouping.column] = mine[0]
        return groups


def _samples(
    name: str, table: StemTable, reference: StemTable, pairing: Pairing, method: str, groups: _Groups
) -> list[Sample]:
    """What became of every stem of both tables under one method."""
    main = reference.methods[0]
    truth, truth_problem = reference.diameters_cm[main], reference.problems.get(main)
    given, problem, ends = table.diameters_cm[method], table.problems.get(method), table.intervals_cm.get(method)
    base = Sample(name, table.name, "measured")

    def one(i: int | None, j: int | None, outcome: Outcome, reason: str) -> Sample:
        estimated = _number(given, i)
        low_high = None if ends is None or i is None or not np.isfinite(ends[i]).all() else ends[i]
        return replace(
            base,
            outcome=outcome,
            tree=reference.ids[j] if j is not None else "",
            stem=table.ids[i] if i is not None else "",
            plot=reference.plots[j] if j is not None else table.plots[i] if i is not None else "",
            estimated_cm=estimated,
            reference_cm=_number(truth, j),
            interval_cm=None if low_high is None else (float(low_high[0]), float(low_high[1])),
            reason=reason,
            groups=groups.of(i, j),
        )

    samples = []
    for (i, j), distance, following in zip(
        pairing.rows.tolist(), pairing.distance_m.tolist(), pairing.next_m.tolist(), strict=True
    ):
        outcome: Outcome = "measured"
        reason = ""
        if np.isnan(truth[j]):
            outcome, reason = "unknown", truth_problem[j] if truth_problem else "no diameter in the reference"
        elif np.isnan(given[i]):
            outcome, reason = "refused", (problem[i] if problem else "") or "no diameter in the inventory"
        sample = one(i, j, outcome, reason)
        samples.append(replace(sample, distance_m=_known(distance), next_m=_known(following)))
    for j, reason in sorted(pairing.missed.items()):
        is_unknown = bool(np.isnan(truth[j]))
        samples.append(one(None, j, "unknown" if is_unknown else "missed", reason))
    samples += [one(i, None, "extra", reason) for i, reason in sorted(pairing.extra.items())]
    samples += [one(i, None, "outside", "its plot is not in the reference") for i in pairing.outside_inventory]
    samples += [one(None, j, "outside", "its plot is not in the inventory") for j in pairing.outside_reference]
    return samples


def _number(values: Float64, row: int | None) -> float | None:
    return None if row is None else _known(float(values[row]))


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None


# ---- categories


def _labels(
    grouping: Grouping, inventories: Sequence[StemTable], reference: StemTable
) -> tuple[list[Sequence[str] | None], Sequence[str] | None, tuple[str, ...]]:
    """Labels of each inventory's rows, of the reference's rows, and all labels in order; None where not there."""
    nothing: list[Sequence[str] | None] = [None] * len(inventories)
    if grouping.column == BY_INVENTORY and _column(reference, BY_INVENTORY) is None:
        names = tuple(dict.fromkeys(table.name for table in inventories))
        return [[table.name] * max(len(table), 1) for table in inventories], None, names
    if grouping.column == BY_REFERENCE_CM and _column(reference, BY_REFERENCE_CM) is None:
        numbers = reference.diameters_cm[reference.methods[0]]
        texts, order = _classes(grouping, [f"{v:g}" if np.isfinite(v) else "" for v in numbers.tolist()])
        return nothing, texts, order
    theirs = None if grouping.source == "inventory" else _column(reference, grouping.column)
    if theirs is not None:
        texts, order = _classes(grouping, theirs)
        return nothing, texts, order
    mine = [None if grouping.source == "reference" else _column(table, grouping.column) for table in inventories]
    if all(column is None for column in mine):
        have = sorted({name for table in (reference, *inventories) for name in table.cells})
        raise SettingError(f"No table has a column {grouping.column}.", f"There are {', '.join(have)}.")
    # One set of classes for all inventories.
    texts, order = _classes(grouping, [text for column in mine for text in column or ()])
    labels: list[Sequence[str] | None] = []
    start = 0
    for column, table in zip(mine, inventories, strict=True):
        size = len(column) if column is not None else 0
        labels.append(texts[start : start + size] if column is not None else [NOT_GIVEN] * len(table))
        start += size
    if any(column is None for column in mine):
        order = (*(name for name in order if name != NOT_GIVEN), NOT_GIVEN)
    return labels, None, order


def _column(table: StemTable, wanted: str) -> Sequence[str] | None:
    if wanted in table.cells:
        return table.cells[wanted]
    return next((cells for name, cells in table.cells.items() if name.casefold() == wanted.casefold()), None)


def _classes(grouping: Grouping, cells: Sequence[str]) -> tuple[list[str], tuple[str, ...]]:
    """(N) labels, and all of them in order. Many different numbers become thirds."""
    values = [_as_number(cell) for cell in cells]
    given = [value for value, cell in zip(values, cells, strict=True) if cell.strip()]
    numeric = [value for value in given if value is not None]
    edges = grouping.edges
    is_numeric = bool(given) and len(numeric) >= 0.9 * len(given)
    if edges and not is_numeric:
        raise SettingError(f"{grouping.column} holds no numbers, so it has no classes.", "Leave the bounds away.")
    # Whole numbers may be names: of plots, species, years.
    most = _MOST_NUMBERED if all(value.is_integer() for value in numeric) else _MOST_CATEGORIES
    if not edges and is_numeric and len(set(numeric)) > most:
        thirds = np.percentile(numeric, [100 / 3, 200 / 3])
        edges = tuple(dict.fromkeys(float(f"{edge:.3g}") for edge in thirds))
    if edges:
        names = _class_names(edges)
        labels = [NOT_GIVEN if v is None else names[int(np.searchsorted(edges, v, side="right"))] for v in values]
        wanted: list[str] = names
    else:
        labels = [cell.strip() or NOT_GIVEN for cell in cells]
        wanted = sorted({label for label in labels if label != NOT_GIVEN}, key=_natural)
    if len(wanted) > _MOST_LABELS:
        raise SettingError(
            f"{grouping.column} has {len(wanted):,} different values, which is too many to tell stems apart by.",
            "Choose another column.",
        )
    return labels, tuple(name for name in (*wanted, NOT_GIVEN) if name in set(labels))


def _class_names(edges: Sequence[float]) -> list[str]:
    between = [f"{low:g} to {high:g}" for low, high in pairwise(edges)]
    return [f"below {edges[0]:g}", *between, f"{edges[-1]:g} and over"]


def _as_number(cell: str) -> float | None:
    try:
        value = float(cell.replace(",", "."))
    except ValueError:
        return None
    return value if np.isfinite(value) else None


def _natural(text: str) -> tuple[bool, float, str]:
    value = _as_number(text)
    return value is None, value or 0.0, text


# ---- what to know


def _pairing_notes(table: StemTable, reference: StemTable, pairing: Pairing) -> list[str]:
    notes = []
    truth = reference.diameters_cm[reference.methods[0]]
    thickness = table.diameters_cm[table.methods[0]]
    known = truth[np.isfinite(truth)]
    extra = [i for i in pairing.extra if np.isfinite(thickness[i])]
    if extra and len(known):
        n_thin = int((thickness[extra] < known.min()).sum())
        if n_thin:
            notes.append(
                f"Of {len(pairing.extra)} stems that are only in the inventory, {n_thin} are thinner than the thinnest "
                f"of the reference ({known.min():.1f} cm)."
            )
    n_out = sum(reason == OUT_OF_AREA for reason in pairing.extra.values())
    if n_out:
        n_extra = len(pairing.extra)
        notes.append(f"Of {n_extra} stems that are only in the inventory, {n_out} stand outside the reference's area.")
    n_twice = sum("times in" in reason for reason in (*pairing.missed.values(), *pairing.extra.values()))
    if n_twice:
        notes.append(
            f"{n_twice} rows were left out because their number is there more than once: pair by place, or join the "
            "stems of a tree."
        )
    is_close = pairing.next_m <= 1.25 * pairing.distance_m
    if is_close.any():
        notes.append(
            f"{int(is_close.sum())} of {len(pairing.rows)} pairs have another stem nearly as near, so that they may be "
            "wrong (pairs.csv: next_m)."
        )
    return notes


def _strangers(lines: Sequence[Line], method: str, pairing: Pairing) -> list[str]:
    """Whether equal numbers seem to be those of other trees, where no places were there to tell.

    The pairs stay as they are: diameters choose no pair.
    """
    if pairing.by != "id" or pairing.is_checked:
        return []
    s = next(line.statistics for line in lines if not line.column and line.method == method)
    if s.n < _STRANGERS_N or s.r_squared is None or s.median_rel_err_pct is None:
        return []
    if s.r_squared > _STRANGERS_R2 or s.median_rel_err_pct < _STRANGERS_PCT:
        return []
    return [
        f"{method}: the diameters of equal numbers have next to nothing to do with each other (R² {s.r_squared:.2f}, "
        f"half of them off by over {s.median_rel_err_pct:.0f} %). Were the trees numbered anew? Then a place of each "
        "tree is needed in both tables (columns x and y)."
    ]


def _doubts(samples: Sequence[Sample], reference: StemTable) -> list[str]:
    """A factor between estimates and references that a wrong unit would make."""
    notes = []
    for method in dict.fromkeys(sample.method for sample in samples):
        ratios = [
            s.estimated_cm / s.reference_cm
            for s in samples
            if s.method == method and s.outcome == "measured" and s.estimated_cm and s.reference_cm
        ]
        middle = float(np.median(ratios)) if len(ratios) >= 5 else 1.0
        for factor, what in _FACTORS.items():
            if abs(middle / factor - 1.0) < _FACTOR_TOLERANCE:
                notes.append(
                    f"{method}: the estimates are {middle:.3g} times the diameters of {reference.name} (median): were "
                    f"{what} mixed up? Units can be said: --inventory-unit, --reference-unit, or a heading such as "
                    "dbh_mm."
                )
    return notes
