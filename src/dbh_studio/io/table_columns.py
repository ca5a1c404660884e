"""What the columns of a table of trees mean: found by name and magnitude, said in words, and open to correction."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from dbh_studio.core.arrays import Float64, readonly
from dbh_studio.core.stem_table import MAIN, StemTable, id_key
from dbh_studio.errors import FileError, MalformedFileError, SettingError
from dbh_studio.io.table_diameters import (
    CM_PER,
    FIA,
    UNITS,
    Unit,
    diameter_rank,
    diameters_of,
    is_girth,
    problem_notes,
    unit_of,
)
from dbh_studio.io.tables import CellTable, cells_of, is_unknown, numbers, plain_name, read_cells

Role = Literal["id", "plot", "x", "y", "dbh", "low", "high"]
ROLES: tuple[Role, ...] = get_args(Role)
NO_COLUMN = "-"
# A stem cut out into a file of its own goes by the name of the file, wherever it lies.
_FILES = ("file", "filename", "path")
_IDS = (
    "tag", "tree_tag", "treeid", "tree_id", "tree", "tree_no", "tree_nr", "treeno", "treenr", "tree_number", "baum",
    "baumnr", "baum_nr", "arbol", "arbre", "stem_id", "stemid", "stem", "no", "nr", "number", "name", "id", *_FILES,
)  # fmt: skip
_PLOTS = (
    "plot_id", "plotid", "plot", "plot_no", "plot_nr", "plotnr", "plotno", "plot_number", "parcela", "parcelle",
    "placette", "parzelle",
)  # fmt: skip
_LOW, _HIGH = ("dbh_lo_cm", "dbh_low_cm", "dbh_lo", "dbh_low"), ("dbh_hi_cm", "dbh_high_cm", "dbh_hi", "dbh_high")
_METHOD = re.compile(r"dbh_([a-z][a-z0-9]*)_cm\Z|([a-z][a-z0-9]*)_cm\Z")
_CURVES = frozenset(("shrinkage", "circle", "fourier", "ellipse", "bspline"))


@dataclass(frozen=True)
class Reading:
    """How a table is to be read where it is known better than by looking at it.

    Attributes:
        columns: Column by role; ``-`` for none.
        unit: Of the diameters.
        diameters: Columns with the diameters of several methods, in place of the one under ``dbh``.
        by_tree: Take the number of the tree rather than that of the stem, where there are both.
        find_methods: Look for the diameters of several curves, as our own tables have them.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    unit: Unit | None = None
    diameters: tuple[str, ...] = ()
    by_tree: bool = False
    find_methods: bool = False

    def __post_init__(self) -> None:
        for role in self.columns:
            if role not in ROLES:
                raise SettingError(f"A table has no {role!r}.", f"Name one of {', '.join(ROLES)}.")
        if self.unit is not None and self.unit not in UNITS:
            raise SettingError(f"Diameters cannot be in {self.unit!r}.", f"Name one of {', '.join(UNITS)}.")


def read_stem_table(path: Path | str, reading: Reading | None = None, *, name: str = "") -> StemTable:
    """Read an inventory or a reference from a file.

    Raises:
        FileError: It cannot be read, or has no diameters; says what to do.
    """
    return stem_table(read_cells(path), reading or Reading(), name=name)


def stem_table_of(data: bytes, reading: Reading | None = None, *, name: str) -> StemTable:
    """As `read_stem_table`, of a table in memory."""
    return stem_table(cells_of(data, name), reading or Reading(), name=name)


def stem_table(cells: CellTable, reading: Reading, *, name: str = "") -> StemTable:
    """Find out what the columns mean.

    Raises:
        FileError: A column that was named is not there, or there are no diameters.
    """
    name = name or cells.path.name
    roles = _Roles(cells, reading)
    main = roles.diameter_columns()
    notes = [*cells.notes]
    diameters: dict[str, Float64] = {}
    problems: dict[str, tuple[str, ...]] = {}
    intervals: dict[str, Float64] = {}
    said = []
    for method, column in main.items():
        values, texts, unit, why = diameters_of(cells, column, reading.unit, name)
        diameters[method], problems[method] = values, texts
        said.append(f"{column} ({unit}{why})")
        is_main = method == next(iter(main))
        ends = roles.interval(column, unit, is_main=is_main)
        if ends is not None:
            intervals[method] = ends
        if is_main:
            notes += problem_notes(name, column, cells, texts)
    x, y = roles.places()
    number, plot = roles.number(), roles.plot()
    understood = [f"diameters from {', '.join(said)}"]
    understood += [f"{what} from {column}" for what, column in (("numbers", number), ("plots", plot)) if column]
    understood += [f"places from {roles.place_words}"] if roles.place_words else []
    empty = ("",) * len(cells)
    return StemTable(
        name,
        roles.numbers_in(number) if number else empty,
        _without_unknown(cells.columns[plot]) if plot else empty,
        readonly(np.column_stack([x, y])),
        diameters,
        intervals,
        problems,
        cells.columns,
        (f"{name}: {len(cells):,} rows; {'; '.join(understood)}.", *notes, *(f"{name}: {n}" for n in roles.notes)),
    )


def numbered_as_files(table: StemTable, others: Sequence[StemTable]) -> StemTable:
    """A table whose stems go by the files they were cut out into, where the others know them by these names alone."""
    theirs = [{id_key(number) for number in other.ids} - {""} for other in others]
    if not theirs or any({id_key(number) for number in table.ids} & names for names in theirs):
        return table
    for column, cells in table.cells.items():
        files = _last_parts(_without_unknown(cells))
        known = {id_key(number) for number in files}
        if plain_name(column) in _FILES and all(len(known & names) >= 0.5 * len(names) > 0 for names in theirs):
            return replace(table, ids=files, notes=(*table.notes, f"{table.name}: numbers from {column} instead."))
    return table


def _last_parts(paths: Sequence[str]) -> tuple[str, ...]:
    return tuple(re.split(r"[/\\]", path)[-1] for path in paths)


def _without_unknown(cells: Sequence[str]) -> tuple[str, ...]:
    return tuple("" if is_unknown(cell) else cell for cell in cells)


class _Roles:
    """Which column is what. Named columns win; then names, then what is in them."""

    def __init__(self, cells: CellTable, reading: Reading) -> None:
        self.cells, self.reading = cells, reading
        self.names = {column: plain_name(column) for column in cells.columns}
        self.notes: list[str] = []
        self.place_words = ""
        self.is_ours = {"stem_id", "dbh_cm", "dbh_definition"} <= set(self.names.values())

    def named(self, role: Role) -> str | None:
        wanted = self.reading.columns.get(role)
        return None if wanted in (None, NO_COLUMN) else self.column(str(wanted))

    def is_off(self, role: Role) -> bool:
        """Whether somebody said that the table has no such column, whatever its headings look like."""
        return self.reading.columns.get(role) == NO_COLUMN

    def column(self, wanted: str) -> str:
        """The column of that name; case and signs may differ."""
        if wanted in self.cells.columns:
            return wanted
        for column, plain in self.names.items():
            if plain == plain_name(wanted):
                return column
        raise no_such_column(self.cells.path, wanted, tuple(self.cells.columns))

    def first_of(self, wanted: Sequence[str], *, at_least: float = 0.5) -> str | None:
        """The first of these columns in which that share of the cells says something."""
        by_plain = {plain: column for column, plain in reversed(list(self.names.items()))}
        for column in (by_plain[name] for name in wanted if name in by_plain):
            filled = sum(not is_unknown(cell) for cell in self.cells.columns[column])
            if filled >= at_least * len(self.cells):
                return column
        return None

    def diameter_columns(self) -> dict[str, str]:
        if self.reading.diameters:
            columns = [self.column(name) for name in self.reading.diameters]
            return {MAIN: columns[0]} if len(columns) == 1 else {column: column for column in columns}
        main = self.named("dbh") or self._guessed_diameter()
        if main is None:
            raise MalformedFileError(
                self.cells.path,
                f"no column of diameters was found among {', '.join(self.cells.columns)}.",
                "Call it dbh_cm in the table, or name it: --inventory-column or --reference-column dbh=COLUMN.",
            )
        return self._by_method(main) if self.reading.find_methods else {MAIN: main}

    def _by_method(self, main: str) -> dict[str, str]:
        """The main column and those of several curves; the main one by its curve's name where it is one of them."""
        chosen, name = numbers(self.cells.columns[main]), MAIN
        others: dict[str, str] = {}
        for column, plain in self.names.items():
            found = _METHOD.match(plain)
            method = (found[1] or found[2]) if found else ""
            if method not in _CURVES or column == main:
                continue
            values = numbers(self.cells.columns[column])
            if np.array_equal(values, chosen, equal_nan=True):
                name = method
            elif np.isfinite(values).any():
                others[method] = column
        return {name: main} | others

    def _guessed_diameter(self) -> str | None:
        ranked = [(rank, column) for column, plain in self.names.items() if (rank := diameter_rank(plain)) is not None]
        for _, column in sorted(ranked, key=lambda pair: pair[0]):
            if np.isfinite(numbers(self.cells.columns[column])).any():
                return column
        # A table of refusals only is a table of diameters all the same.
        return ranked[0][1] if ranked else None

    def interval(self, column: str, unit: Unit, *, is_main: bool) -> Float64 | None:
        """(N, 2) ends of the interval of the diameters in a column, centimetres; None where the table has none."""
        base = self.names[column].removesuffix("_cm")
        lows, highs = [f"{base}_lo_cm"], [f"{base}_hi_cm"]
        # Ends without a method's name belong to the column without one.
        owners = [each for each, plain in self.names.items() if plain in ("dbh_cm", "dbh")]
        if is_main and (column in owners or not owners):
            lows, highs = [*lows, *_LOW], [*highs, *_HIGH]
        # A share of the stems may have an interval only, so these columns may be nearly empty.
        low = (self.named("low") if is_main else None) or self.first_of(lows, at_least=0.0)
        high = (self.named("high") if is_main else None) or self.first_of(highs, at_least=0.0)
        if low is None or high is None:
            return None
        ends = []
        for end in (low, high):
            factor = CM_PER[unit_of(self.names[end]) or unit]
            values = factor * numbers(self.cells.columns[end])
            ends.append(values / np.pi if is_girth(self.names[column]) else values)
        both = np.column_stack(ends)
        both[both[:, 0] > both[:, 1]] = np.nan
        return readonly(both) if np.isfinite(both).all(axis=1).any() else None

    def number(self) -> str | None:
        named = self.named("id")
        if named is not None or self.is_off("id"):
            return named
        if self.is_ours:
            # Stems measured one by one from files of their own have no other number.
            return self.first_of(("tag", "tree_id" if self.reading.by_tree else "stem_id", *_FILES))
        return self.first_of(_IDS)

    def numbers_in(self, column: str) -> tuple[str, ...]:
        """The numbers of a column that holds them."""
        cells = _without_unknown(self.cells.columns[column])
        return _last_parts(cells) if self.names[column] in _FILES else cells

    def plot(self) -> str | None:
        named = self.named("plot")
        found = named or self.first_of(_PLOTS)
        number = self.number()
        if self.is_off("plot"):
            return None
        if found is not None or number is None or self.names[number] == "id":
            return found
        # A table with the plot under "id" and the tree under "tree", whose numbers begin anew in each plot.
        column = next((c for c, plain in self.names.items() if plain == "id"), None)
        if column is None:
            return None
        plots, trees = self.cells.columns[column], self.cells.columns[number]
        both = set(zip(plots, trees, strict=True))
        if len(both) == len(plots) and len(set(trees)) < len(trees) and len(set(plots)) <= 0.5 * len(plots):
            self.notes.append(f"numbers of {number} begin anew with every {column}, which is taken for the plot.")
            return column
        return None

    def places(self) -> tuple[Float64, Float64]:
        named = self.named("x"), self.named("y")
        if (named[0] is None) != (named[1] is None):
            raise MalformedFileError(self.cells.path, "only one of x and y was named.", "Name both.")
        if named[0] is not None and named[1] is not None:
            return self._said(named[0], named[1])
        if self.is_off("x"):
            return np.full(len(self.cells), np.nan), np.full(len(self.cells), np.nan)
        pairs = [(x, y) for x, y in self._pairs() if self._varies(x) and self._varies(y)]
        if pairs:
            return self._said(*max(pairs, key=self._goodness))
        polar = self.first_of(("dist", "distance", "distance_m", "dist_m")), self.first_of(("azim", "azimuth", "azi"))
        if polar[0] is not None and polar[1] is not None and not set(self.names.values()) >= FIA:
            self.place_words = f"{polar[0]} and {polar[1]} (metres and degrees from north)"
            reach, azimuth = (numbers(self.cells.columns[column]) for column in polar if column)
            return reach * np.sin(np.radians(azimuth)), reach * np.cos(np.radians(azimuth))
        unknown = np.full(len(self.cells), np.nan)
        return unknown, unknown

    def _said(self, x: str, y: str) -> tuple[Float64, Float64]:
        self.place_words = f"{x} and {y}"
        return numbers(self.cells.columns[x]), numbers(self.cells.columns[y])

    def _pairs(self) -> list[tuple[str, str]]:
        by_plain = {plain: column for column, plain in self.names.items()}
        pairs = []
        for column, plain in self.names.items():
            other = plain.replace("easting", "northing") if "easting" in plain else re.sub(r"(^|_)x", r"\1y", plain)
            if other != plain and other in by_plain:
                pairs.append((column, by_plain[other]))
        return pairs

    def _varies(self, column: str) -> bool:
        """A column that says the same for all, such as the middle of the plot, is no place of a stem."""
        values = numbers(self.cells.columns[column])
        known = values[np.isfinite(values)]
        if len(self.cells) == 1:
            return len(known) == 1
        return len(np.unique(known)) > 0.5 * len(known) and len(known) >= 0.5 * len(self.cells)

    def _goodness(self, pair: tuple[str, str]) -> tuple[bool, bool]:
        """Coordinates of a map before those of a plot; then names that say nothing else."""
        values = numbers(self.cells.columns[pair[0]])
        return float(np.nanmax(np.abs(values))) > 10_000.0, self.names[pair[0]] in ("easting", "x", "x_m")


def no_such_column(path: Path | str, wanted: str, columns: Sequence[str]) -> FileError:
    """The error for a column that was named and is not there, with the nearest that is."""
    near = difflib.get_close_matches(wanted.casefold(), [c.casefold() for c in columns], 1, 0.5)
    meant = next((f"Did you mean {c}? " for c in columns if near and c.casefold() == near[0]), "")
    return MalformedFileError(path, f"there is no column {wanted}.", f"{meant}It has {', '.join(columns)}.")
