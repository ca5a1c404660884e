"""The columns of one's own inventory, read back: what each line says of its stem, and what cannot be understood."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dbh_studio.app.document import Document
from dbh_studio.core.corrections import Correction, CorrectionKind
from dbh_studio.core.inventory import COLUMNS, Inventory
from dbh_studio.core.tree_record import TREE_STATUSES
from dbh_studio.core.trunks import MAX_TRUNK_ID
from dbh_studio.errors import MalformedFileError
from dbh_studio.io.column_names import in_units, own_columns, own_field
from dbh_studio.io.inventory_csv import undefused
from dbh_studio.io.tables import CellTable, is_unknown, numbers, plain_name

TEXTS = ("species", "status", "note", "tag", "health", "crown_class")
# Factors to the unit of the correction, by the unit in the heading.
_TAPES: Mapping[CorrectionKind, Mapping[str, float]] = {
    "tape": {"field_tape_cm": 1.0, "field_tape_mm": 0.1, "field_tape_m": 100.0, "field_tape_in": 2.54},
    "tape_height": {"field_tape_height_m": 1.0, "field_tape_height_cm": 0.01, "field_tape_height_ft": 0.3048},
}
# In cm and m: an inventory has them to 0.01 cm and 0.001 m, and what differs by less went out and came back.
SAME_TAPE: Mapping[CorrectionKind, float] = {"tape": 0.006, "tape_height": 0.0006}
_STATUSES = {"alive": "live", "living": "live", "standing dead": "dead", "snag": "broken"}
# What programs write where a text is empty; other signs may be meant.
_EMPTY = frozenset({"", "na", "nan", "null", "none", "#n/a"})
# Columns that map programs add when they save our layer as CSV.
_OF_PROGRAMS = frozenset(
    {"fid", "ogc_fid", "geom", "geometry", "id", "x", "y", "wkt", "wkt_geom", "longitude", "latitude"}
)
_MOST_NEW_FIELDS = 30
MOST_LISTED = 8


@dataclass(frozen=True)
class ImportOptions:
    """How a table is taken over.

    Attributes:
        skip_misfits: Leave out the stems the plot has not, and those that stand elsewhere; without it they stop it.
        clear_empty: An empty cell takes back what was said; without it it says nothing.
        with_fields: Columns of other names become fields of one's own.
    """

    skip_misfits: bool = False
    clear_empty: bool = False
    with_fields: bool = True


@dataclass(frozen=True)
class StemSaid:
    """What a line says of a stem; what it does not say is not in it.

    Attributes:
        texts: By name of the record's field.
        fields: Of one's own, by name.
        tree_id: The tree it belongs to; None where the line does not say.
        tapes: Diameter in cm and height in m, by kind of correction; NaN takes a value back.
    """

    texts: Mapping[str, str]
    fields: Mapping[str, str]
    tree_id: int | None
    tapes: Mapping[CorrectionKind, float]


class ImportTable:
    """A table of stems as cells, and what its columns are."""

    def __init__(self, cells: CellTable, document: Document) -> None:
        self.cells = cells
        self.plain = {plain_name(undefused(column)): column for column in reversed(list(cells.columns))}
        names = sorted({name for record in document.trees.values() for name, _ in record.fields})
        self._known_fields = {column: name for name, column in own_columns(names).items()}
        if "stem_id" not in self.plain:
            raise MalformedFileError(
                cells.path,
                "it has no column stem_id, by which stems are told apart.",
                f"Use an inventory that was exported here. It has {', '.join(cells.columns)}.",
            )

    def stem_ids(self) -> list[int]:
        """The stem of each line.

        Raises:
            FileError: A cell is no stem number, or two lines are of one stem.
        """
        ids = self._whole("stem_id")
        seen: dict[int, int] = {}
        for stem_id, line in zip(ids, self.cells.lines, strict=True):
            if stem_id is None:
                raise MalformedFileError(self.cells.path, f"line {line:,} has no stem_id.", "Fill it in, or delete it.")
            if stem_id in seen:
                raise MalformedFileError(
                    self.cells.path,
                    f"lines {seen[stem_id]:,} and {line:,} are both of stem {stem_id}.",
                    "Delete one of them.",
                )
            seen[stem_id] = line
        return list(seen)

    def said(self, ids: Sequence[int], options: ImportOptions) -> dict[int, StemSaid]:
        """What each line says.

        Raises:
            FileError: Cells that cannot be understood.
        """
        texts = {name: self._texts(self.plain[name]) for name in TEXTS if name in self.plain}
        if "status" in texts:
            texts["status"] = self._statuses(texts["status"])
        fields = {name: self._texts(column) for column, name in self.fields().items()} if options.with_fields else {}
        trees = self._whole("tree_id") if "tree_id" in self.plain else [None] * len(ids)
        tapes = {kind: values for kind in _TAPES if (values := self._tape(kind)) is not None}

        def told(columns: Mapping[str, Sequence[str]], k: int) -> dict[str, str]:
            return {name: cells[k] for name, cells in columns.items() if cells[k] or options.clear_empty}

        return {
            stem_id: StemSaid(
                told(texts, k),
                told(fields, k),
                trees[k],
                {kind: values[k] for kind, values in tapes.items() if options.clear_empty or not np.isnan(values[k])},
            )
            for k, stem_id in enumerate(ids)
        }

    def fields(self) -> dict[str, str]:
        """Field of one's own by column.

        Raises:
            FileError: There are too many to be meant.
        """
        ours = {*COLUMNS, *(in_units(name, "imperial")[0] for name in COLUMNS)}
        ours |= {name for names in _TAPES.values() for name in names} | _OF_PROGRAMS
        fields: dict[str, str] = {}
        for column in self.cells.columns:
            heading = undefused(column)
            name = self._known_fields.get(heading) or own_field(heading)
            is_nameless = column.startswith("column ") and column[7:].isdigit()
            if name != heading or (heading.casefold() not in ours and plain_name(heading) not in ours):
                fields |= {} if is_nameless else {column: name}
        new = [name for name in fields.values() if name not in self._known_fields.values()]
        if len(new) > _MOST_NEW_FIELDS:
            raise MalformedFileError(
                self.cells.path,
                f"it has {len(new)} columns that are no part of an inventory: {', '.join(new[:MOST_LISTED])}, …",
                "Delete those that are not to become fields of the trees, or leave all of them out.",
            )
        return fields

    def notes(self, options: ImportOptions, inventory: Inventory) -> list[str]:
        """What is taken for fields, and whose plot the table says it is."""
        notes = []
        if options.with_fields and (new := [n for n in self.fields().values() if n not in self._known_fields.values()]):
            notes.append(f"New fields: {', '.join(new)}.")
        plots = {undefused(cell) for cell in self.cells.columns.get(self.plain.get("plot_id", ""), ()) if cell}
        if plots and not plots & {row.plot_id for row in inventory}:
            notes.append(f"The table calls the plot {', '.join(sorted(plots)[:3])}.")
        return notes

    def _texts(self, column: str) -> list[str]:
        cells = (undefused(cell).strip() for cell in self.cells.columns[column])
        return ["" if cell.casefold() in _EMPTY else cell for cell in cells]

    def _statuses(self, cells: Sequence[str]) -> list[str]:
        made = [_STATUSES.get(cell.casefold(), cell.casefold()) for cell in cells]
        wrong = [(cell, line) for cell, line in zip(made, self.cells.lines, strict=True) if cell not in TREE_STATUSES]
        if wrong:
            raise MalformedFileError(
                self.cells.path,
                f"line {wrong[0][1]:,} has the status {wrong[0][0]!r}"
                + (f", and {len(wrong) - 1} more lines are like it." if len(wrong) > 1 else "."),
                "Write live, dead or broken, or leave the cell empty.",
            )
        return made

    def _whole(self, name: str) -> list[int | None]:
        """Numbers of stems or trees; spreadsheets make 7.0 of 7."""
        column = self.plain[name]
        made: list[int | None] = []
        for cell, value, line in zip(
            self.cells.columns[column], numbers(self.cells.columns[column]), self.cells.lines, strict=True
        ):
            if is_unknown(cell):
                made.append(None)
            elif not (value == np.floor(value) and 0 < value <= MAX_TRUNK_ID):
                raise MalformedFileError(
                    self.cells.path,
                    f"line {line:,}: {name} is {cell[:40]!r}, which is no number of a stem or tree.",
                    "",
                )
            else:
                made.append(int(value))
        return made

    def _tape(self, kind: CorrectionKind) -> list[float] | None:
        """Values of a correction, by the unit in the heading; NaN where nothing is known.

        A table may have several of them: ours stands there, empty, beside the one that a person has filled in.
        """
        found = [(name, factor) for name, factor in _TAPES[kind].items() if name in self.plain]
        if not found:
            return None
        made = [float("nan")] * len(self.cells)
        said_by = [""] * len(self.cells)
        for name, factor in found:
            cells = self.cells.columns[self.plain[name]]
            for k, (cell, value) in enumerate(zip(cells, (factor * numbers(cells)).tolist(), strict=True)):
                if is_unknown(cell):
                    continue
                self._check_tape(kind, name, cell, value, k)
                if said_by[k] and abs(made[k] - value) > SAME_TAPE[kind]:
                    raise MalformedFileError(
                        self.cells.path,
                        f"line {self.cells.lines[k]:,}: {said_by[k]} and {name} say different things.",
                        "Empty one of the two cells.",
                    )
                if not said_by[k]:
                    made[k], said_by[k] = value, name
        return made

    def _check_tape(self, kind: CorrectionKind, name: str, cell: str, value: float, k: int) -> None:
        problem = "that is no number"
        try:
            if np.isfinite(value):
                Correction(kind, value)
                return
        except ValueError as error:
            problem = str(error)
        raise MalformedFileError(
            self.cells.path,
            f"line {self.cells.lines[k]:,}: {name} is {cell[:40]!r}: {problem}.",
            "Leave it empty if not known.",
        )
