"""The columns every export shares, in metric or imperial units."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import IO, Any, Literal

from dbh_studio.core.inventory import Inventory, InventoryRow
from dbh_studio.core.markup import without_controls
from dbh_studio.core.stand import Units
from dbh_studio.errors import FileError
from dbh_studio.io.atomic import atomic_file
from dbh_studio.io.column_names import in_units, own_columns

Kind = Literal["text", "integer", "real", "boolean"]

_KINDS: dict[str, Kind] = {"str": "text", "int": "integer", "float": "real", "bool": "boolean"}


@dataclass(frozen=True)
class Column:
    """A column.

    Attributes:
        name: With the unit as suffix: ``dbh_cm``, or ``dbh_in``.
        kind: What its cells are.
    """

    name: str
    kind: Kind


@dataclass(frozen=True)
class Table:
    """An inventory as rows of plain cells.

    Attributes:
        columns: In order.
        rows: A cell per column; None is not known.
        inventory: What they were made of.
        units: Of diameters and heights.
    """

    columns: tuple[Column, ...]
    rows: tuple[tuple[Any, ...], ...]
    inventory: Inventory
    units: Units

    def records(self) -> Iterator[dict[str, Any]]:
        """The rows by name of column."""
        names = [column.name for column in self.columns]
        return (dict(zip(names, row, strict=True)) for row in self.rows)


def table_of(inventory: Inventory, units: Units = "metric") -> Table:
    """The table of an inventory; with ``imperial`` diameters are inches and heights feet, under names that say so.

    Fields the person has added stand behind our columns.
    """
    columns, readers = [], []
    for each in fields(InventoryRow):
        name, convert = in_units(each.name, units)
        kind = _KINDS[str(each.type).removesuffix(" | None")]
        columns.append(Column(name, kind))
        readers.append((each.name, convert))
    own = own_columns(inventory.own_names)
    columns += [Column(name, "text") for name in own.values()]
    said = {stem_id: dict(pairs) for stem_id, pairs in inventory.own}
    rows = tuple(
        (
            *(_clean(convert(getattr(row, name))) for name, convert in readers),
            *(_clean(said.get(row.stem_id, {}).get(name, "")) for name in own),
        )
        for row in inventory
    )
    return Table(tuple(columns), rows, inventory, units)


def _clean(cell: Any) -> Any:
    """Text as every format can hold it: XML forbids control characters, and SQLite's readers stop at a NUL."""
    return without_controls(cell) if isinstance(cell, str) else cell


@contextmanager
def written_whole(path: Path) -> Iterator[IO[bytes]]:
    """A file that replaces `path` when it is complete, and leaves it as it was when it cannot be.

    Raises:
        FileError: It cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as file:
            yield file
    except OSError as error:
        raise unwritten(path, error) from error


def unwritten(path: Path, error: OSError) -> FileError:
    """What the system said, as an error that names the file and what to do."""
    return FileError(
        path,
        f"It could not be written ({error.strerror or error}).",
        "Close it where it is open, make room on the disk, or choose another folder.",
    )
