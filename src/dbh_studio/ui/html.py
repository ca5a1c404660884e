"""The HTML the panels show. Every text that comes from a file or a person goes through `esc`."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources

from dbh_studio.core.section_drawing import CURVE_TITLES as CURVE_TITLES
from dbh_studio.ui.bridge import call, esc, js
from dbh_studio.ui.steps import STEP_TITLES, PlotStatus, StepName

# A script may arrive together with the HTML it is about, and the page draws that a moment later.
NOW_AND_ONCE_DRAWN = "f();setTimeout(f,80);"


def style_js(name: str = "style") -> str:
    """JavaScript that adds a style sheet of this package to the page once."""
    style = resources.files("dbh_studio.ui").joinpath(f"{name}.css").read_text(encoding="utf-8")
    return (
        f"if(!document.getElementById('dbh-{name}')){{const s=document.createElement('style');s.id='dbh-{name}';"
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
    is_read_only: bool = False,
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
        is_read_only: Nothing can be undone or done again, and the two say why.
    """
    done = status.done()
    locked = _READ_ONLY if is_read_only else ""
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
        f"{_history_button('undo', '&#8630; Undo', undo, locked)}"
        f"{_history_button('redo', '&#8631; Redo', redo, locked)}</div>"
        f"{place}"
        f'<div class="dbh-steps">{buttons}</div>'
        f"{'' if is_busy else _hint(status, active)}</div>"
    )


_READ_ONLY = "The plot is open for reading only. To change it, save a copy in step 1."


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


def _history_button(kind: str, title: str, label: str, locked: str) -> str:
    state = "" if label and not locked else " disabled"
    tip = locked or (f"{kind.capitalize()}: {label}" if label else "")
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
        f"{NOW_AND_ONCE_DRAWN}}})()"
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
