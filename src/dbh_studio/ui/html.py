"""The HTML the panels show. Every text that comes from a file or a person goes through `esc`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources

from dbh_studio.core.dbh import DbhEstimate, Refusal
from dbh_studio.ui.bridge import call, esc, js
from dbh_studio.ui.steps import STEP_TITLES, PlotStatus, StepName

# Each table column: key, heading, tooltip, whether it is text.
TABLE_COLUMNS: tuple[tuple[str, str, str, bool], ...] = (
    ("id", "Tree", "Tree number", False),
    ("dbh", "DBH cm", "Diameter at breast height", False),
    ("quality", "Quality", "From the arc seen, the residual and the agreement of the curves", True),
    ("arc", "Arc °", "How much of the ring was seen", False),
    ("remark", "Remark", "Species, note, or why there is no diameter", True),
)


def style_js() -> str:
    """JavaScript that adds the style sheet to the page once."""
    style = resources.files("dbh_studio.ui").joinpath("style.css").read_text(encoding="utf-8")
    return (
        "if(!document.getElementById('dbh-style')){const s=document.createElement('style');s.id='dbh-style';"
        f"s.textContent={js(style)};document.head.appendChild(s);}}"
    )


def header(plot_name: str, status: PlotStatus, active: StepName, *, saved: str, undo: str, redo: str) -> str:
    """Plot name, where it is saved, Undo and Redo, the five steps, and the sentence that says what to do now.

    Args:
        plot_name: As the person calls it.
        status: What is done.
        active: The step on screen.
        saved: Where the plot is saved, or that it is not.
        undo: What Undo would undo; empty where nothing.
        redo: What Redo would do again; empty where nothing.
    """
    done = status.done()
    buttons = "".join(
        f'<button type="button" data-step="{name}" data-state="{"done" if name in done else "open"}" '
        f'data-active="{"true" if name == active else "false"}" onclick="{call("step", name)}">'
        f"{'&#10003; ' if name in done else f'{number} '}{title}</button>"
        for number, (name, title) in enumerate(STEP_TITLES.items(), start=1)
    )
    level = "ok" if done >= set(STEP_TITLES) else "todo"
    return (
        f'<div class="dbh"><div class="dbh-top"><h3>{esc(plot_name or "No plot open")}</h3>'
        f"{_history_button('undo', '&#8630; Undo', undo)}{_history_button('redo', '&#8631; Redo', redo)}</div>"
        f'<div class="muted">{esc(saved)}</div>'
        f'<div class="dbh-steps">{buttons}</div>'
        f'<div class="dbh-hint" data-level="{level}">{esc(status.hint())}</div></div>'
    )


def _history_button(kind: str, title: str, label: str) -> str:
    state = "" if label else " disabled"
    return f'<button type="button" data-do="{kind}" title="{esc(label)}" onclick="{call(kind)}"{state}>{title}</button>'


def message(text: str, *, level: str = "todo", remedy: str = "") -> str:
    """A coloured box with a sentence, and what to do about it."""
    more = f"<br><b>What to do:</b> {esc(remedy)}" if remedy else ""
    return f'<div class="dbh"><div class="dbh-hint" data-level="{esc(level)}">{esc(text)}{more}</div></div>'


def findings(items: Sequence[tuple[str, str, str]]) -> str:
    """A list of (level, message, remedy) with a mark for each level ``ok``, ``note``, ``warn``, ``stop``."""
    rows = "".join(
        f'<li data-level="{esc(level)}">{esc(text)}{f" <span class=muted>{esc(remedy)}</span>" if remedy else ""}</li>'
        for level, text, remedy in items
    )
    return f'<div class="dbh"><ul class="dbh-list">{rows}</ul></div>'


def facts(pairs: Sequence[tuple[str, str]]) -> str:
    """A two-column list of names and values."""
    rows = "".join(f"<dt>{esc(name)}</dt><dd>{esc(value)}</dd>" for name, value in pairs)
    return f'<dl class="dbh-facts">{rows}</dl>'


DEFINITION_TITLES = {"curve": "perimeter / π", "tape": "tape: convex girth / π", "area": "equal-area circle"}


def tree_card(tree_id: int, result: DbhEstimate | Refusal, *, curve_title: str) -> str:
    """What the forester reads after clicking a trunk."""
    if isinstance(result, Refusal):
        return (
            f'<div class="dbh dbh-card" data-tree="{tree_id}"><h3>Tree {tree_id}</h3>'
            f'<div class="dbh-number" style="font-size:24px">no diameter '
            f'<span class="dbh-badge" data-quality="none">not measured</span></div>'
            f'<div class="dbh-hint" data-level="stop">{esc(result.reason)}'
            f"<br><b>What to do:</b> {esc(result.remedy)}</div></div>"
        )
    section = result.section
    low, high = section.band_m
    pairs = [
        ("Measured at", f"{low:.2f}–{high:.2f} m, middle {section.hom_m:.2f} m"),
        ("Curve", f"{curve_title}, {DEFINITION_TITLES.get(result.definition, result.definition)}"),
        ("Ring seen", f"{section.coverage_deg:.0f}°, largest gap {section.max_gap_deg:.0f}°"),
        ("Residual", f"{result.rmse_mm:.1f} mm over {result.n_points:,} points"),
        ("Lean", f"{section.lean_deg:.0f}°"),
    ]
    flags = "".join(f'<li data-level="warn">{esc(flag)}</li>' for flag in result.flags)
    return (
        f'<div class="dbh dbh-card" data-tree="{tree_id}" data-dbh="{result.dbh_cm:.1f}"><h3>Tree {tree_id}</h3>'
        f'<div class="dbh-number">{result.dbh_cm:.1f}<small> cm DBH</small> '
        f'<span class="dbh-badge" data-quality="{esc(result.quality)}">{esc(result.quality)}</span></div>'
        f"{facts(pairs)}{f'<ul class=dbh-list>{flags}</ul>' if flags else ''}</div>"
    )


@dataclass(frozen=True)
class TableRow:
    """One line of the table of trees."""

    id: int
    dbh_cm: float | None
    quality: str
    arc_deg: float | None
    remark: str

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
        }
        value = keys.get(column, float(self.id))
        return (value is None, 0.0 if value is None else value)


def sort_rows(rows: Sequence[TableRow], column: str, *, descending: bool) -> list[TableRow]:
    """Rows by one column; rows without a value stay at the end either way."""
    known = [row for row in rows if not row.sort_key(column)[0]]
    unknown = [row for row in rows if row.sort_key(column)[0]]
    return sorted(known, key=lambda row: row.sort_key(column)[1], reverse=descending) + unknown


def tree_table(rows: Sequence[TableRow], *, selected: int | None, column: str, descending: bool) -> str:
    """The table of all trees. Choosing a row or a heading sends ``row`` or ``sort`` to the server."""
    arrow = " &#9660;" if descending else " &#9650;"
    heads = "".join(
        f'<th class="{"text" if is_text else ""}" title="{esc(tip)}" onclick="{call("sort", key)}">'
        f"{esc(title)}{arrow if key == column else ''}</th>"
        for key, title, tip, is_text in TABLE_COLUMNS
    )
    body = "".join(
        f'<tr data-id="{row.id}" data-selected="{"true" if row.id == selected else "false"}" '
        f'onclick="{call("row", row.id)}">'
        + "".join(
            f'<td class="{"text" if is_text else ""}">{esc(cell)}</td>'
            for cell, (_, _, _, is_text) in zip(row.cells(), TABLE_COLUMNS, strict=True)
        )
        + "</tr>"
        for row in sort_rows(rows, column, descending=descending)
    )
    if not rows:
        return message("No trunks yet. Press Find trunks in step 3.")
    return (
        '<div class="dbh"><div class="dbh-scroll" tabindex="0"><table class="dbh-table">'
        f"<thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div></div>"
    )


def select_row_js(tree_id: int | None) -> str:
    """JavaScript that moves the table's highlight without replacing the table, so that its scroll position stays."""
    wanted = js(None if tree_id is None else str(tree_id))
    return (
        f"(()=>{{const id={wanted};document.querySelectorAll('.dbh-table tr[data-id]').forEach(r=>{{"
        "const on=r.dataset.id===id;r.dataset.selected=on;"
        "if(on)r.scrollIntoView({block:'nearest'});});})()"
    )
