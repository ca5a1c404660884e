"""Names of the columns of what is handed in: our own in the units asked for, and those of fields a person has added."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from dbh_studio.core.inventory import COLUMNS
from dbh_studio.core.markup import without_controls
from dbh_studio.core.stand import CM_PER_INCH, Units

M_PER_FOOT = 0.3048
OWN_SUFFIX = "_own"
"""Behind the name of a field of one's own that is called as one of our columns."""

# Coordinates stay in the unit of their frame: a map position in feet would be another place.
_PLACES = frozenset({"x_m", "y_m", "z_ground_m"})
_IMPERIAL = (
    ("_cm_per_m", "_in_per_ft", M_PER_FOOT / CM_PER_INCH),
    ("_cm", "_in", 1 / CM_PER_INCH),
    ("_m", "_ft", 1 / M_PER_FOOT),
)
# Names that GDAL and its users give to what is no column.
_RESERVED = ("fid", "ogc_fid", "geom", "geometry", "id")
_LONGEST_NAME = 60


def in_units(name: str, units: Units) -> tuple[str, Callable[[Any], Any]]:
    """The name a column has in these units, and what turns its cells."""
    if units == "metric" or name in _PLACES:
        return name, lambda value: value
    for suffix, other, factor in _IMPERIAL:
        if name.endswith(suffix):
            return name.removesuffix(suffix) + other, lambda value, by=factor: None if value is None else value * by
    return name, lambda value: value


def own_columns(names: Iterable[str]) -> dict[str, str]:
    """The column of each field the person has added, by its name; no two are alike in any format.

    Those called as a column of ours, in whatever case or unit, end in `OWN_SUFFIX`.
    """
    ours = {*_RESERVED, *COLUMNS, *(in_units(name, "imperial")[0] for name in COLUMNS)}
    taken = {name.casefold() for name in ours}
    columns: dict[str, str] = {}
    for name in names:
        base = " ".join(without_controls(name).split())[:_LONGEST_NAME] or "field"
        column = f"{base}{OWN_SUFFIX}" if base.casefold() in taken else base
        count = 2
        while column.casefold() in taken:
            column, count = f"{base}{OWN_SUFFIX}_{count}", count + 1
        taken.add(column.casefold())
        columns[name] = column
    return columns


def own_field(column: str) -> str:
    """The name of the field a column is of: `own_columns` backwards, where that is possible."""
    base = column.removesuffix(OWN_SUFFIX)
    return base if base != column and own_columns([base])[base] == column else column
