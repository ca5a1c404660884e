"""The HTML the panels show. Every text that comes from a file or a person goes through `esc`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from itertools import zip_longest

import numpy as np

from dbh_studio.core.dbh import DbhEstimate, Diameter, Refusal
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.ui.bridge import call, esc, js
from dbh_studio.ui.steps import STEP_TITLES, PlotStatus, StepName

# Each table column: key, heading, tooltip, whether it is text.
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
# A script may arrive together with the HTML it is about, and the page draws that a moment later.
_NOW_AND_ONCE_DRAWN = "f();setTimeout(f,80);"
CURVE_TITLES: Mapping[str, str] = {
    "shrinkage": "Shrinkage curve",
    "circle": "Circle",
    "fourier": "Fourier",
    "ellipse": "Ellipse",
    "bspline": "B-spline",
}


def style_js() -> str:
    """JavaScript that adds the style sheet to the page once."""
    style = resources.files("dbh_studio.ui").joinpath("style.css").read_text(encoding="utf-8")
    return (
        "if(!document.getElementById('dbh-style')){const s=document.createElement('style');s.id='dbh-style';"
        f"s.textContent={js(style)};document.head.appendChild(s);}}"
    )


def plain(text: str) -> str:
    """A reason or a flag as a sentence: a capital first."""
    return text[:1].upper() + text[1:]


def header(
    plot_name: str,
    status: PlotStatus,
    active: StepName,
    *,
    saved: str,
    undo: str,
    redo: str,
    problem: str = "",
    is_busy: bool = False,
) -> str:
    """Plot name, where it is saved, Undo and Redo, the five steps, and the sentence that says what to do now.

    Args:
        plot_name: As the person calls it.
        status: What is done.
        active: The step on screen.
        saved: Where the plot is saved.
        undo: What Undo would undo; empty where nothing.
        redo: What Redo would do again; empty where nothing.
        problem: Why it is not saved; in red, and in full.
        is_busy: A job runs: its box stands where the sentence would, so that nothing jumps.
    """
    done = status.done()
    place = f'<div class="muted dbh-saved">{esc(saved)}</div>'
    if problem:
        place = message(f"NOT SAVED. {problem}", level="stop")
    buttons = "".join(
        f'<button type="button" data-step="{name}" data-state="{"done" if name in done else "open"}" '
        f'data-active="{"true" if name == active else "false"}" onclick="{call("step", name)}">'
        f"{'&#10003;' if name in done else number} {title}</button>"
        for number, (name, title) in enumerate(STEP_TITLES.items(), start=1)
    )
    return (
        f'<div class="dbh"><div class="dbh-top"><h3 title="{esc(plot_name)}">{esc(plot_name or "No plot open")}</h3>'
        f"{_history_button('undo', '&#8630; Undo', undo)}{_history_button('redo', '&#8631; Redo', redo)}</div>"
        f"{place}"
        f'<div class="dbh-steps">{buttons}</div>'
        f"{'' if is_busy else _hint(status, active)}</div>"
    )


def _hint(status: PlotStatus, active: StepName) -> str:
    """What to do now, with a button where that is done in another step than the one on screen."""
    following, all_done = status.next_step(), status.done() >= set(STEP_TITLES)
    button = ""
    if status.n_waiting:  # the measuring was cancelled
        button = f'<button type="button" data-do="measure" onclick="{call("measure")}">Measure</button>'
    elif following != active and not all_done:
        number = list(STEP_TITLES).index(following) + 1
        title = f"{number} {STEP_TITLES[following]} &#8594;"
        button = f'<button type="button" data-do="next" onclick="{call("step", following)}">{title}</button>'
    level = "ok" if all_done else "todo"
    return f'<div class="dbh-hint dbh-row" data-level="{level}"><span>{esc(status.hint())}</span>{button}</div>'


def _history_button(kind: str, title: str, label: str) -> str:
    state = "" if label else " disabled"
    tip = f"{kind.capitalize()}: {label}" if label else ""
    return f'<button type="button" data-do="{kind}" title="{esc(tip)}" onclick="{call(kind)}"{state}>{title}</button>'


def job_box(title: str) -> str:
    """What runs, how far it is (see `job_js`), and Cancel.

    It is put on the page once for each job: a button that is replaced with every per cent cannot be pressed.
    """
    return (
        f'<div class="dbh"><div class="dbh-hint dbh-row dbh-job" data-level="busy"><span>{esc(title)}'
        f'<span class="dbh-job-text"></span><div class="dbh-bar"><div></div></div></span>'
        f'<button type="button" data-do="cancel" onclick="{call("cancel")}">&#10005; Cancel</button></div></div>'
    )


def job_js(fraction: float, message: str) -> str:
    """JavaScript that moves the bar of `job_box`."""
    width, text = js(f"{100 * min(max(fraction, 0.0), 1.0):.0f}%"), js(f": {message}" if message else " …")
    return (
        "(()=>{const f=()=>{const b=document.querySelector('.dbh-job');if(!b)return;"
        f"b.querySelector('.dbh-bar div').style.width={width};b.querySelector('.dbh-job-text').textContent={text};}};"
        f"{_NOW_AND_ONCE_DRAWN}}})()"
    )


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


def no_tree_card() -> str:
    """In place of a card while no tree is chosen."""
    return '<div class="dbh muted dbh-empty">No tree is chosen.</div>'


def waiting_card(tree_id: int) -> str:
    """The card of a tree that is yet to be measured."""
    return (
        f'<div class="dbh dbh-card" data-tree="{tree_id}"><div class="dbh-number">{_card_title(tree_id)}</div>'
        '<div class="muted">Not measured yet.</div></div>'
    )


def _card_title(tree_id: int) -> str:
    """The tree's number, and the arrows to its neighbours."""
    before, after = (
        f'<button type="button" data-do="{tip}" title="{tip} tree ({key})" '
        f'onclick="{call("neighbour", n)}">{arrow}</button>'
        for tip, key, n, arrow in (("Previous", "P", -1, "&#9664;"), ("Next", "N", 1, "&#9654;"))
    )
    return f'<h3>Tree {tree_id}</h3><span class="dbh-neighbours">{before}{after}</span>'


def tree_card(tree_id: int, result: DbhEstimate | Refusal, *, section: str = "", scale: str = "") -> str:
    """What the forester reads after clicking a trunk.

    Args:
        tree_id: Its number.
        result: The diameter, or why there is none.
        section: The picture of the cross-section, see `section_svg`.
        scale: What of the scale's error is in the interval, see `scale_words`.
    """
    title = _card_title(tree_id)
    if isinstance(result, Refusal):
        return (
            f'<div class="dbh dbh-card" data-tree="{tree_id}"><div class="dbh-number">{title}'
            f'<b class="none">no diameter</b></div>'
            f'<div class="dbh-hint" data-level="stop">{esc(plain(result.reason))}'
            f"<br><b>What to do:</b> {esc(plain(result.remedy))}</div>{section}</div>"
        )
    flags = "".join(
        f'<li data-level="warn" data-flag="{esc(code)}">{esc(plain(flag))}</li>'
        for code, flag in zip_longest(result.flag_codes, result.flags, fillvalue="")
    )
    tip = "in 9 of 10 cases the tape reads within these" if result.interval else "this method gives no interval"
    interval = f" {_range(result.diameters[result.definition])}" if result.interval else ""
    return (
        f'<div class="dbh dbh-card" data-tree="{tree_id}" data-dbh="{result.dbh_cm:.1f}"><div class="dbh-number">'
        f'{title}<b>{result.dbh_cm:.1f}</b><small title="{tip}">cm{interval}</small>'
        f'<span class="dbh-badge" data-quality="{esc(result.quality)}">{esc(result.quality)}</span></div>'
        f"{section}{f'<ul class=dbh-list>{flags}</ul>' if flags else ''}{facts(_card_facts(result))}"
        f"<details><summary>How it was measured</summary>{facts(_measuring_facts(result, scale))}</details></div>"
    )


def _card_facts(result: DbhEstimate) -> list[tuple[str, str]]:
    """What one compares with the tree in the forest."""
    cut, girth = result.section, result.diameters["tape"]
    round_cm = [np.pi * value for value in (girth.value_cm, girth.low_cm, girth.high_cm) if value is not None]
    pairs = [
        ("Measured at", f"{cut.hom_m:.2f} m"),
        ("Tape round it", _in_brackets(round_cm) + " cm"),
        ("Ring seen", f"{cut.coverage_deg:.0f}°, largest gap {cut.max_gap_deg:.0f}°"),
        ("Lean", f"{cut.lean_deg:.0f}°"),
    ]
    if result.taper_cm_per_m is not None:
        pairs.append(("Taper", f"{result.taper_cm_per_m:.1f} cm per metre"))
    return pairs


def _measuring_facts(result: DbhEstimate, scale: str) -> list[tuple[str, str]]:
    """How the diameter was read, and what it would be by another definition."""
    low, high = result.section.band_m
    others = [f"{DEFINITION_TITLES[name]} {_with_range(diameter)}" for name, diameter in result.diameters.items()]
    return [
        ("Read from", f"{CURVE_TITLES.get(result.curve, result.curve)}, {_definition(result)}"),
        ("Interval", f"90 %{scale}" if result.interval else "none: this method has none that is honest"),
        ("By definition", ", ".join(others)),
        ("Scatter", f"{result.rmse_mm:.1f} mm about the curve, {result.n_points:,} points"),
        ("Shown", f"the stretch from {low:.2f} to {high:.2f} m"),
    ]


def scale_words(scale: ScaleEstimate) -> str:
    """What of the scale's error is in the interval, to follow “90 %”."""
    if scale.standard_error:
        return f", the ±{100 * scale.relative_sd:.2g} % of the scale included"
    exact = scale.source in ("metres", "feet", "millimetres") or scale.standard_error == 0
    return "" if exact else ", without the error of the scale, which is not known"


def _with_range(diameter: Diameter) -> str:
    ends = [diameter.value_cm, diameter.low_cm, diameter.high_cm]
    return _in_brackets([value for value in ends if value is not None])


def _range(diameter: Diameter) -> str:
    return f"({diameter.low_cm:.1f}–{diameter.high_cm:.1f})"


def _in_brackets(values: Sequence[float]) -> str:
    return f"{values[0]:.1f}" + (f" ({values[1]:.1f}–{values[2]:.1f})" if len(values) == 3 else "")


def _definition(result: DbhEstimate) -> str:
    return DEFINITION_TITLES.get(result.definition, result.definition)


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
        f'data-quality="{esc(row.quality or "none")}" onclick="{call("row", row.id)}">'
        + "".join(
            f'<td class="{"text" if is_text else ""}" data-column="{key}"'
            f"{f' title={chr(34)}{esc(cell)}{chr(34)}' if key == 'remark' else ''}>{esc(cell)}</td>"
            for cell, (key, _, _, is_text) in zip(row.cells(), TABLE_COLUMNS, strict=True)
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
    """JavaScript that moves the table's highlight without replacing the table, so that its scroll position stays.

    Only the table scrolls to the row: the panel around it stays where the person left it.
    """
    wanted = js(None if tree_id is None else str(tree_id))
    return (
        f"(()=>{{const id={wanted},f=()=>{{document.querySelectorAll('.dbh-table tr[data-id]').forEach(r=>{{"
        "const on=r.dataset.id===id;r.dataset.selected=on;if(!on)return;"
        "const box=r.closest('.dbh-scroll'),head=box.querySelector('thead').offsetHeight;"
        "if(r.offsetTop<box.scrollTop+head)box.scrollTop=r.offsetTop-head;"
        "else if(r.offsetTop+r.offsetHeight>box.scrollTop+box.clientHeight)"
        f"box.scrollTop=r.offsetTop+r.offsetHeight-box.clientHeight;}});}};{_NOW_AND_ONCE_DRAWN}}})()"
    )


def view_bar_js(modes: Sequence[tuple[str, str]], mode: str, looks: Sequence[tuple[str, str, str]]) -> str:
    """JavaScript that puts the bar with colours and views into the corner of the picture, in place of an older one.

    Args:
        modes: (value, title) of each colour mode.
        mode: The one that is on.
        looks: (value, title, tooltip) of each place to look from.
    """
    colours = "".join(
        f'<button type="button" data-mode="{esc(value)}" aria-pressed="{"true" if value == mode else "false"}" '
        f'onclick="{call("colours", value)}">{esc(title)}</button>'
        for value, title in modes
    )
    views = "".join(
        f'<button type="button" data-look="{esc(value)}" title="{esc(tip)}" '
        f'onclick="{call("look", value)}">{esc(title)}</button>'
        for value, title, tip in looks
    )
    content = f"<span><i>Colours</i>{colours}</span><span><i>Look at</i>{views}</span>"
    return (
        "(()=>{let e=document.getElementById('dbh-view');if(!e){e=document.createElement('div');e.id='dbh-view';"
        f"e.className='dbh';document.body.appendChild(e);}}e.innerHTML={js(content)};}})()"
    )
