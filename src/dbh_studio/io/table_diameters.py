"""Diameters in a table of trees: their unit by name and size, girths, and what is no diameter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, get_args

import numpy as np

from dbh_studio.core.arrays import Float64, readonly
from dbh_studio.io.tables import CellTable, is_unknown, numbers, plain_name

Unit = Literal["cm", "m", "mm", "in"]
UNITS: tuple[Unit, ...] = get_args(Unit)
CM_PER: Mapping[Unit, float] = {"cm": 1.0, "m": 100.0, "mm": 0.1, "in": 2.54}
_UNIT_WORDS: Mapping[str, Unit] = {
    "cm": "cm", "centimetres": "cm", "centimeters": "cm", "m": "m", "metres": "m", "meters": "m", "mm": "mm",
    "millimetres": "mm", "millimeters": "mm", "in": "in", "inch": "in", "inches": "in",
}  # fmt: skip
_DBH = frozenset(
    ("dbh", "bhd", "dap", "dhp", "d130", "d_130", "d13", "dia", "diam", "diameter", "diametro", "diametre")
)
_GIRTH = frozenset(("girth", "cbh", "gbh", "circumference", "circ", "umfang", "u130", "cap", "c130"))
_NO_DIAMETER = frozenset(
    ("ht", "height", "method", "definition", "lo", "low", "lower", "hi", "high", "upper", "err", "error", "sd", "se",
     "rmse", "hom", "code", "class", "year", "date", "note", "flag", "quality", "n")
)  # fmt: skip
# The database of the US Forest Service, whose diameters are inches and whose distances are from four subplots.
FIA = frozenset(("cn", "plt_cn"))
_THICKEST_CM = 1_500.0
_LINES_NAMED = 5


def unit_of(plain: str) -> Unit | None:
    """The unit in a heading as `plain_name` writes it (``dbh_m_f``); None where it names none."""
    return next((_UNIT_WORDS[token] for token in plain.split("_")[1:] if token in _UNIT_WORDS), None)


def diameter_rank(plain: str) -> int | None:
    """How surely a heading means a diameter or a girth at breast height, 0 the surest."""
    tokens = _without_unit(plain)
    base = "_".join(tokens)
    if plain == "dbh_cm":
        return 0
    if base in _DBH:
        return 1
    if base in _GIRTH:
        return 2
    if set(tokens) & _NO_DIAMETER:
        return None
    if tokens[0] in _DBH or tokens[-1] == "dbh":
        return 3
    return 4 if base == "d" else None


def is_girth(plain: str) -> bool:
    """Whether a heading means a girth."""
    return "_".join(_without_unit(plain)) in _GIRTH


def _without_unit(plain: str) -> list[str]:
    """The words of a heading but its unit."""
    return [token for k, token in enumerate(plain.split("_")) if not (k and token in _UNIT_WORDS)]


def diameters_of(
    cells: CellTable, column: str, unit: Unit | None, name: str
) -> tuple[Float64, tuple[str, ...], Unit, str]:
    """(N,) centimetres with NaN where there is none, why not, the unit, and how it was found."""
    texts = cells.columns[column]
    values = numbers(texts)
    plain = plain_name(column)
    by_girth = is_girth(plain)
    if by_girth:
        values = values / np.pi
    why = ""
    if unit is None:
        unit, why = _unit(values, plain, cells)
    if by_girth:
        why += ", a girth, divided by π"
    diameters = CM_PER[unit] * values
    reasons = _reasons(cells)
    problems = tuple(
        _problem(text, value, reasons[row], name)
        for row, (text, value) in enumerate(zip(texts, diameters.tolist(), strict=True))
    )
    usable = np.array([not problem for problem in problems], bool)
    return readonly(np.where(usable, diameters, np.nan)), problems, unit, why


def _unit(values: Float64, plain: str, cells: CellTable) -> tuple[Unit, str]:
    """By name, else by size: trees are from some centimetres to a few metres thick."""
    named = unit_of(plain)
    if named is not None:
        return named, ""
    if {plain_name(column) for column in cells.columns} >= FIA:
        return "in", ", as in the FIA database"
    known = values[values > 0]
    if not len(known):
        return "cm", ", assumed"
    middle, thick = float(np.median(known)), float(np.percentile(known, 98.0))
    # Shrubs have a median of 2 cm as well, but hardly without one stem over 4 cm among them.
    unit: Unit = "m" if middle < 2.5 and thick < 4.0 else "cm" if middle <= 130.0 else "mm"
    return unit, f", by size: the median is {middle:.3g}"


def _reasons(cells: CellTable) -> Sequence[str]:
    """Why a stem has no diameter, where the table is one of ours."""
    if {"quality", "reason"} <= set(cells.columns):
        return cells.columns["reason"]
    return ("",) * len(cells)


def _problem(text: str, diameter_cm: float, reason: str, name: str) -> str:
    if is_unknown(text):
        return reason or f"no diameter in {name}"
    if not np.isfinite(diameter_cm):
        return f"“{text[:40]}” in {name} is no number"
    if diameter_cm == 0.0:
        return f"0 in {name}, which means unknown"
    if diameter_cm < 0.0:
        return f"{text} in {name} is below zero"
    if diameter_cm > _THICKEST_CM:
        return f"{text} in {name} is {diameter_cm / 100.0:,.0f} m, which is no tree"
    return ""


def problem_notes(name: str, column: str, cells: CellTable, problems: Sequence[str]) -> list[str]:
    """How many diameters cannot be used, and where, for each kind."""
    texts = cells.columns[column]
    kinds: dict[str, list[int]] = {}
    for text, problem, line in zip(texts, problems, cells.lines, strict=True):
        if problem:
            is_zero = "which means unknown" in problem
            kind = "empty" if is_unknown(text) else "0, which means unknown" if is_zero else "not usable"
            kinds.setdefault(kind, []).append(line)
    notes = []
    for kind, lines in kinds.items():
        named = ", ".join(str(line) for line in lines[:_LINES_NAMED]) + (", …" if len(lines) > _LINES_NAMED else "")
        where = f"line {named}" if len(lines) == 1 else f"lines {named}"
        notes.append(f"{name}: {column} is {kind} in {len(lines):,} of {len(texts):,} rows ({where}).")
    return notes
