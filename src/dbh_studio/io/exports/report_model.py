"""What a report says, before it is a page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from dbh_studio.core.inventory import Inventory, InventoryRow
from dbh_studio.core.stand import PlotArea, StandTable
from dbh_studio.core.tree_record import TreeRecord
from dbh_studio.io.exports.columns import Table
from dbh_studio.io.exports.edit_log import LogEntry
from dbh_studio.io.exports.stem_map import North

if TYPE_CHECKING:
    from dbh_studio.core.measured import DbhEstimate, Refusal

Pairs = tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False)
class TreePicture:
    """A photograph of a tree.

    Attributes:
        jpeg: The file.
        words: From where it was taken.
    """

    jpeg: bytes
    words: str


@dataclass(frozen=True, eq=False)
class StemPage:
    """All that is known of one stem.

    Attributes:
        row: Of the inventory.
        result: The measurement, for its section.
        curve: The curve drawn as the chosen one.
        record: What a person said.
        pictures: Photographs, best first.
        picture_note: Why there are none or few; empty where the report has none of any tree.
    """

    row: InventoryRow
    result: DbhEstimate | Refusal
    curve: str
    record: TreeRecord
    pictures: tuple[TreePicture, ...] = ()
    picture_note: str = ""


@dataclass(frozen=True, eq=False)
class Report:
    """What a report says.

    Attributes:
        title: Name of the plot.
        made: When, in words.
        table: The inventory in the units of the report.
        stand: The stand table, in the same units.
        area: Of the plot.
        north: On the map.
        facts: Of the cover: scale, method, protocol.
        pages: A stem each, in order of id.
        log: What was done to the plot, the earliest first.
        settings: By section: name and value of each.
        versions: What it was computed by.
    """

    title: str
    made: str
    table: Table
    stand: StandTable
    area: PlotArea
    north: North
    facts: Pairs
    pages: tuple[StemPage, ...]
    log: tuple[LogEntry, ...]
    settings: tuple[tuple[str, Pairs], ...]
    versions: Pairs

    @property
    def inventory(self) -> Inventory:
        """The stems."""
        return self.table.inventory
