"""What the masks of a plot are told as: pure text and HTML, every name escaped."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from dbh_studio.io.masks import MEANING_TITLES, Review
from dbh_studio.ui.bridge import esc, js
from dbh_studio.ui.html import findings, message, plain
from dbh_studio.ui.panel_words import reworded

if TYPE_CHECKING:
    from dbh_studio.app.ladder import Ladder
    from dbh_studio.app.plot_masks import MaskState
    from dbh_studio.ui.mask_canvas import MaskCanvas
    from dbh_studio.ui.mask_jobs import MaskLook

_ORIGINS = {"detector": "by the detector", "prompted": "by SAM", "brought": "brought", "painted": "painted"}
_TAKEN = {
    "detector": "Trunks by detector and SAM",
    "prompted": "Trunks by SAM, prompted by geometry",
    "brought": "Trunks by masks",
    "geometry": "Trunks by geometry alone",
}
_REVIEWS: tuple[tuple[Review, str], ...] = (
    ("accepted", "accepted"),
    ("repainted", "painted"),
    ("rejected", "rejected"),
)
_TITLES = {
    "detector": "Detector and SAM",
    "prompted": "SAM on trunks found by geometry",
    "brought": "Masks you bring",
    "geometry": "Geometry alone",
}
WORDS = (
    (" (--masks)", ""),
    (" (--ignore-masks)", ""),
    (" (--images)", " in step 2"),
    (" (--ignore-side)", ""),
    ("Say where they are: --masks FOLDER, or a COCO file.", "Name their folder, or a COCO file, below."),
    ("Say where the reconstruction is: --cameras, or step Scale in the studio.", "Add the photos in step 2."),
    ("as --ignore-masks", "under “Also ignore”"),
    ("--mask-category NAME", "name it under “Which are trunks”"),
    ("--mask-category", "“Which are trunks”"),
    ("--mask-style", "“Named like”"),
    ("--mask-meaning", "“They mean”"),
    ("--ignore-masks", "“Also ignore”"),
)


def mask_state(state: MaskState, canvas: MaskCanvas | None) -> tuple[str, str]:
    """One line about the mask of a photo, and its level: ``ok``, ``stop`` or empty."""
    if canvas is None or (not state.has_mask and not canvas.can_undo):
        return ("made of another photo" if state.is_outdated else "no mask"), ""
    numbers = canvas.numbers()
    if canvas.has_instances:
        count = "no trunk" if not numbers else f"{len(numbers)} trunk{'s' if len(numbers) != 1 else ''}"
    else:
        count = "trunks" if numbers else "no trunk"
    if state.review == "rejected":
        return f"{count} · rejected, does not vote", "stop"
    if state.review == "accepted":
        return f"{count} · accepted", "ok"
    if state.review == "repainted":
        return f"{count} · painted, saved", "ok"
    origin = _ORIGINS.get(state.origin, state.origin)
    return f"{count} · {origin}" if origin else count, ""


def ladder(found: Ladder, there: str = "") -> str:
    """Which way to trunks is taken, why no better one is, and, behind a click, what each costs.

    Args:
        found: The ladder.
        there: What masks there are, one sentence; empty where there are none.
    """
    taken = found.taken
    cost = f"{plain(in_the_studio(taken.cost_text))}."
    if there:
        n_more = taken.cost.n_photos if taken.cost is not None else 0
        cost = f"{n_more:,} more would take {taken.cost.text}." if taken.cost is not None and n_more else ""
    text = " ".join(part for part in (there, cost) if part)
    now = f'<div class="dbh-hint" data-level="ok"><b>{esc(_TAKEN[found.chosen])}</b><div>{esc(text)}</div></div>'
    higher = found.rungs[: [state.rung for state in found.rungs].index(found.chosen)]
    lines = []
    for n, state in enumerate(higher):
        why = plain(in_the_studio(state.why_not)) or "Another way was asked for."
        lines.append(f"<li><b>{esc(_TITLES[state.rung])}:</b> {esc(why)}</li>")
        # Once, below the last of those it mends.
        if state.remedy and state.remedy not in [below.remedy for below in higher[n + 1 :]]:
            lines.append(f'<li class="remedy">{_code(state.remedy)}</li>')
    why_not = f'<div class="muted">Why not a better way:</div><ul>{"".join(lines)}</ul>' if lines else ""
    costs = "".join(
        f"<li><b>{esc(_TITLES[state.rung])}:</b> {esc(plain(in_the_studio(state.cost_text)))}</li>"
        for state in found.rungs
    )
    every = f"<details><summary>All ways and what they cost</summary><ul>{costs}</ul></details>"
    return f'<div class="dbh dbh-ladder" data-rung="{esc(found.chosen)}">{now}{why_not}{every}</div>'


def no_photos() -> str:
    """In place of the ladder while there is nothing to climb."""
    text = "With photos, trunks can be found by their masks: add photos in step 2. Geometry needs none."
    return message(text, level="ok")


def _code(text: str) -> str:
    """Escaped; what stands in backquotes as something to type."""
    parts = in_the_studio(text).split("`")
    return "".join(f"<code>{esc(part)}</code>" if n % 2 else esc(part) for n, part in enumerate(parts))


def in_the_studio(text: str) -> str:
    """A sentence of the program with the panel's names of things in place of the command line's options."""
    return reworded(text, WORDS)


def question(look: MaskLook) -> str:
    """One photo with its mask drawn over it, what was found, and what is to be answered."""
    masks = look.masks
    parts = [f'<div class="dbh-masklook"><img src="{look.picture}" alt=""></div>'] if look.picture else []
    if look.photo:
        parts.append(
            f'<div class="muted">{esc(look.photo)}, its mask read as: {esc(MEANING_TITLES[masks.meaning])}.</div>'
        )
    body = f'<div class="dbh">{"".join(parts)}</div>'
    if masks.unclear:
        body += message(in_the_studio(masks.unclear), remedy="Look at the picture, and say what they mean.")
    elif not masks.finds_trunks:
        body += message(
            "These masks say what to ignore: no trunk can be found by them.",
            remedy="Keep them as areas to ignore, and bring masks of trunks too.",
        )
    notes = [("note", in_the_studio(note), "") for note in (*masks.notes, *look.notes)]
    return body + (findings(notes) if notes else "")


def kept(states: Iterable[MaskState]) -> str:
    """How many masks there are, and what was said of them, one sentence; empty where there are none."""
    every = list(states)
    there = [state for state in every if state.has_mask]
    if not there:
        return ""
    counts = Counter(state.review for state in there)
    parts = [f"{counts[review]:,} {word}" for review, word in _REVIEWS if counts[review]]
    outdated = sum(state.is_outdated for state in every)
    text = f"{len(there):,} of {len(every):,} photos have a mask"
    text += f": {', '.join(parts)}." if parts else "."
    return f"{text} {outdated:,} more are of photos that have changed since." if outdated else text


def legend(counts: Sequence[tuple[str, str]]) -> str:
    """What the colours of the label counts mean: (count, colour) from few to many, and grey."""
    cells = "".join(f'<i style="background:{esc(colour)}"></i>' for _, colour in counts)
    numbers = "".join(f"<span>{esc(count)}</span>" for count, _ in counts)
    return (
        f'<b>Masks that call a point trunk</b><div class="row cells">{cells}</div><div class="row">{numbers}</div>'
        '<div class="unseen"><i></i> seen by no mask</div>'
    )


def legend_js(content: str) -> str:
    """JavaScript that puts a legend over the picture of the cloud, or takes it away where it is empty."""
    return (
        "(()=>{let e=document.getElementById('dbh-counts');"
        f"const c={js(content)};if(!c){{if(e)e.remove();return;}}"
        "if(!e){e=document.createElement('div');e.id='dbh-counts';e.className='dbh';document.body.appendChild(e);}"
        "e.innerHTML=c;})()"
    )
