"""The diameters along each stem, every 10 cm: as CSV, metric, so that it can be read back, and as a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dbh_studio.core.inventory import Inventory
from dbh_studio.core.stand import Units
from dbh_studio.io.column_names import in_units
from dbh_studio.io.exports.columns import Column, Kind, Table, written_whole
from dbh_studio.io.inventory_csv import defused

# It measures, with all that takes; a table of it needs none of that.
if TYPE_CHECKING:
    from dbh_studio.core.stem_profile import ProfilePoint

HEIGHT_COLUMNS = ("height_m", "dbh_cm", "dbh_lo_cm", "dbh_hi_cm", "coverage_deg", "reason")
PROFILE_COLUMNS = ("plot_id", "tree_id", "stem_id", "tag", *HEIGHT_COLUMNS)
_KINDS: dict[str, Kind] = {
    "plot_id": "text", "tree_id": "integer", "stem_id": "integer", "tag": "text", "reason": "text",
}  # fmt: skip


def _ends_cm(point: ProfilePoint) -> tuple[float | None, float | None, float | None]:
    """Diameter and interval."""
    diameter = point.diameter
    return (None, None, None) if diameter is None else (diameter.value_cm, diameter.low_cm, diameter.high_cm)


def height_cells(point: ProfilePoint) -> dict[str, str]:
    """One height of a stem by `HEIGHT_COLUMNS`; an empty cell for what is not known."""
    arc = "" if point.arc_deg is None else f"{point.arc_deg:.1f}"
    cells = dict.fromkeys(HEIGHT_COLUMNS, "") | {
        "height_m": f"{point.height_m:.2f}",
        "coverage_deg": arc,
        "reason": point.reason,
    }
    texts = ("" if end is None else f"{end:.2f}" for end in _ends_cm(point))
    return cells | dict(zip(HEIGHT_COLUMNS[1:4], texts, strict=True))


def profile_table(
    inventory: Inventory, profiles: Iterable[tuple[int, Sequence[ProfilePoint]]], units: Units = "metric"
) -> Table:
    """The profiles of stems as a table: `PROFILE_COLUMNS` in these units, a row per height; None is not known.

    Args:
        inventory: The plot's, for what the stems are called.
        profiles: By number of the stem.
        units: Of diameters and heights.
    """
    named = {name: in_units(name, units) for name in PROFILE_COLUMNS}
    about = {row.stem_id: (row.plot_id, row.tree_id, row.stem_id, row.tag) for row in inventory}
    cells = (
        (*about[stem_id], point.height_m, *_ends_cm(point), point.arc_deg, point.reason)
        for stem_id, profile in profiles
        for point in profile
    )
    columns = tuple(Column(name, _KINDS.get(key, "real")) for key, (name, _) in named.items())
    turned = [turn for _, turn in named.values()]
    rows = tuple(tuple(turn(cell) for turn, cell in zip(turned, row, strict=True)) for row in cells)
    return Table(columns, rows, inventory, units)


def write_profiles_csv(
    path: Path, inventory: Inventory, profiles: Iterable[tuple[int, Sequence[ProfilePoint]]]
) -> Path:
    """Write the profiles of stems; `path` is replaced whole or stays as it was.

    Args:
        path: The file.
        inventory: The plot's, for what the stems are called.
        profiles: By number of the stem.

    Raises:
        FileError: The file cannot be written.
    """
    rows = {row.stem_id: row for row in inventory}
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, PROFILE_COLUMNS, lineterminator="\n")
    writer.writeheader()
    for stem_id, profile in profiles:
        row = rows[stem_id]
        about = {"plot_id": row.plot_id, "tree_id": str(row.tree_id), "stem_id": str(stem_id), "tag": row.tag}
        for point in profile:
            writer.writerow({name: defused(cell) for name, cell in (about | height_cells(point)).items()})
    with written_whole(path) as file:
        file.write(text.getvalue().encode("utf-8", errors="replace"))
    return path
