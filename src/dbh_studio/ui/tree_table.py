"""The table of all trees, sorted and filtered by the server; which rows are chosen is marked in the page."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from dbh_studio.core.dbh import DbhEstimate, Refusal
from dbh_studio.core.review_queue import QueueEntry
from dbh_studio.core.tree_record import TreeRecord
from dbh_studio.ui.bridge import call, esc, js
from dbh_studio.ui.html import NOW_AND_ONCE_DRAWN, message, plain

# Each column: key, heading, tooltip, whether it is text.
TABLE_COLUMNS: tuple[tuple[str, str, str, bool], ...] = (
    ("id", "Tree", "Tree number", False),
    ("dbh", "DBH cm", "Diameter at breast height", False),
    (
        "quality",
        "Quality",
        "From the width of the interval; of the paper's curves from arc, residual and agreement",
        True,
    ),
    ("arc", "Arc °", "How much of the ring was seen", False),
    ("remark", "Remark", "Species, note, what to look at, or why there is no diameter", True),
)
_TAPE_COLUMN = ("tape", "Tape", "Diameter read with a tape in the field, cm; it is never mixed with DBH", False)
SORT_KEYS = (*(column[0] for column in TABLE_COLUMNS), "tape", "worst")
_UNDECIDED = "not looked at yet"
_DECIDED = {
    "accepted": "accepted",
    "doubtful": "to be looked at again",
    "stale": "the number has moved since it was decided about",
}


@dataclass(frozen=True)
class TableRow:
    """One line of the table of trees.

    Attributes:
        id: The tree's number.
        dbh_cm: Its diameter; None where there is none.
        quality: Of the diameter; empty where there is none.
        arc_deg: How much of the ring was seen.
        remark: What there is to say.
        review: What was decided, see `core.review_queue.QueueEntry.state`.
        rank: Its place in the queue of review, the worst first.
        tape_cm: What a tape read.
    """

    id: int
    dbh_cm: float | None
    quality: str
    arc_deg: float | None
    remark: str
    review: str = ""
    rank: int = 0
    tape_cm: float | None = None

    def cells(self) -> tuple[str, ...]:
        """The texts shown; an unknown diameter is a dash, never 0."""
        return (
            str(self.id),
            "–" if self.dbh_cm is None else f"{self.dbh_cm:.1f}",
            self.quality or "–",
            "–" if self.arc_deg is None else f"{self.arc_deg:.0f}",
            self.remark,
        )

    def sort_key(self, column: str) -> tuple[bool, float | str]:
        """Unknown values last, whatever the column."""
        order = {"good": 0.0, "fair": 1.0, "poor": 2.0, "": 3.0}
        keys: dict[str, float | str | None] = {
            "id": float(self.id),
            "dbh": self.dbh_cm,
            "quality": order.get(self.quality, 3.0),
            "arc": self.arc_deg,
            "remark": self.remark.lower(),
            "tape": self.tape_cm,
            "worst": float(self.rank),
        }
        value = keys.get(column, float(self.id))
        return (value is None, 0.0 if value is None else value)


def row_of(
    trunk_id: int, result: DbhEstimate | Refusal, record: TreeRecord, *, entry: QueueEntry | None = None, rank: int = 0
) -> TableRow:
    """A table row of one measured stem.

    Args:
        trunk_id: Its number.
        result: Its diameter, or why there is none.
        record: What a person said about it.
        entry: Its place in the queue of review, if it has one.
        rank: Which that is.
    """
    said = ", ".join(text for text in (record.species, record.remark) if text)
    review, tape = entry.state if entry is not None else "", record.correction("tape")
    if isinstance(result, DbhEstimate):
        remark = said or plain("; ".join(result.flags))
        arc = result.section.coverage_deg
        return TableRow(trunk_id, result.dbh_cm, result.quality, arc, remark, review, rank, tape)
    remark = ", ".join(text for text in (said, plain(result.reason)) if text)
    return TableRow(trunk_id, None, "", None, remark, review, rank, tape)


def sort_rows(rows: Sequence[TableRow], column: str, *, descending: bool) -> list[TableRow]:
    """Rows by one column; rows without a value stay at the end either way."""
    known = [row for row in rows if not row.sort_key(column)[0]]
    unknown = [row for row in rows if row.sort_key(column)[0]]
    return sorted(known, key=lambda row: row.sort_key(column)[1], reverse=descending) + unknown


def tree_table(
    rows: Sequence[TableRow],
    *,
    selected: int | None,
    column: str,
    descending: bool,
    several: Collection[int] = (),
    empty: str = "No trunks yet. Press Find trunks in step 3.",
) -> str:
    """The table of all trees.

    Choosing a row or a heading sends ``row`` or ``sort`` to the server; with Ctrl held a row sends ``row-add``, with
    Shift ``row-range``.

    Args:
        rows: Of the trees that are shown.
        selected: The chosen one.
        column: By which it is sorted.
        descending: Which way.
        several: All that are chosen, where there are several.
        empty: What stands in place of a table without rows.
    """
    if not rows:
        return message(empty)
    columns = list(TABLE_COLUMNS)
    has_tape = any(row.tape_cm is not None for row in rows)
    if has_tape:
        columns.insert(2, _TAPE_COLUMN)
    arrow = " &#9660;" if descending else " &#9650;"
    heads = "".join(
        f'<th class="{"text" if is_text else ""}" data-head="{key}" title="{esc(tip)}" onclick="{call("sort", key)}">'
        f"{esc(title)}{arrow if key == column else ''}</th>"
        for key, title, tip, is_text in columns
    )
    body = "".join(
        _row_html(row, columns, is_selected=row.id == selected, is_chosen=row.id in several)
        for row in sort_rows(rows, column, descending=descending)
    )
    return (
        f'<div class="dbh dbh-trees"><div class="dbh-scroll" tabindex="0"><table class="dbh-table"'
        f"{' data-tape' if has_tape else ''}>"
        f"<thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div></div>"
    )


def _row_html(
    row: TableRow, columns: Sequence[tuple[str, str, str, bool]], *, is_selected: bool, is_chosen: bool
) -> str:
    texts = dict(zip((column[0] for column in TABLE_COLUMNS), row.cells(), strict=True))
    texts["tape"] = "" if row.tape_cm is None else f"{row.tape_cm:.1f}"
    tips = {"remark": texts["remark"], "id": _DECIDED.get(row.review, _UNDECIDED)}
    cells = "".join(
        f'<td class="{"text" if is_text else ""}" data-column="{key}"'
        f'{f""" title="{esc(tips[key])}" """ if key in tips else ""}>{esc(texts[key])}</td>'
        for key, _, _, is_text in columns
    )
    which = "event.shiftKey?'row-range':event.ctrlKey||event.metaKey?'row-add':'row'"
    return (
        f'<tr data-id="{row.id}" data-selected="{"true" if is_selected else "false"}" '
        f'data-chosen="{"true" if is_chosen else "false"}" data-review="{esc(row.review or "open")}" '
        f'data-quality="{esc(row.quality or "none")}" onclick="{esc(f"dbh({which},{row.id})")}">{cells}</tr>'
    )


def select_row_js(tree_id: int | None, several: Collection[int] = ()) -> str:
    """JavaScript that moves the table's highlight without replacing the table, so that its scroll position stays.

    Only the table scrolls to the row: the panel around it stays where the person left it.
    """
    wanted, chosen = js(None if tree_id is None else str(tree_id)), js([str(i) for i in sorted(several)])
    return (
        f"(()=>{{const id={wanted},all={chosen},f=()=>{{document.querySelectorAll('.dbh-table tr[data-id]')"
        ".forEach(r=>{r.dataset.chosen=all.includes(r.dataset.id);"
        "const on=r.dataset.id===id;r.dataset.selected=on;if(!on)return;"
        "const box=r.closest('.dbh-scroll'),head=box.querySelector('thead').offsetHeight;"
        "if(r.offsetTop<box.scrollTop+head)box.scrollTop=r.offsetTop-head;"
        "else if(r.offsetTop+r.offsetHeight>box.scrollTop+box.clientHeight)"
        f"box.scrollTop=r.offsetTop+r.offsetHeight-box.clientHeight;}});}};{NOW_AND_ONCE_DRAWN}}})()"
    )
