"""In the card of a tree: what was corrected about its measurement, and what helps where it is refused, as HTML."""

from __future__ import annotations

from collections.abc import Sequence

from dbh_studio.core.corrections import Correction, CorrectionKind
from dbh_studio.core.dbh import DbhEstimate, Refusal
from dbh_studio.core.section_drawing import CURVE_TITLES
from dbh_studio.core.stem_profile import ProfilePoint
from dbh_studio.core.tree_record import TreeRecord
from dbh_studio.ui.bridge import call, esc, js
from dbh_studio.ui.signed import signed_words

# Refusals of stems that two trees in one may have brought about.
_MAY_BE_TWO = ("two_rings", "no_ring", "no_curve", "implausible", "too_uncertain", "small_arc")
_TITLES: dict[CorrectionKind, str] = {
    "breast_height": "Breast height",
    "base": "Base on a slope",
    "along": "Height of a leaning stem",
    "above": "Measured above",
    "ground": "Ground",
    "curve": "Method",
    "least_arc": "Smaller arc accepted",
    "left_out": "Points left out",
    "ring": "Ring",
    "tape": "Tape",
}


def corrections_html(record: TreeRecord, result: DbhEstimate | Refusal, moved: str) -> str:
    """HTML: each thing that was said about the measurement, with who, when and why, and a cross that withdraws it.

    Args:
        record: Of the tree.
        result: As it is measured now.
        moved: What the last correction did to the number, see `app.section_edits.moved_words`; may be empty.
    """
    lines = [f'<div class="dbh-moved" data-moved>{esc(moved)}</div>'] if moved else []
    lines += [_line(each, _value(each, record, result)) for each in record.corrections if each.kind != "tape_height"]
    return f'<div class="dbh-corrections">{"".join(lines)}</div>' if lines else ""


def _line(correction: Correction, value: str) -> str:
    signed = signed_words(correction.who, correction.when)
    why = f" “{esc(correction.why)}”" if correction.why else ""
    title = _TITLES.get(correction.kind, correction.kind)
    return (
        f'<div data-correction="{esc(correction.kind)}"><span><b>{esc(title)}</b> {esc(value)}{why} '
        f'<span class="muted">{esc(signed)}</span></span><button type="button" title="Withdraw it" '
        f'data-withdraw="{esc(correction.kind)}" onclick="{call("withdraw", correction.kind)}">&#10005;</button></div>'
    )


def _value(correction: Correction, record: TreeRecord, result: DbhEstimate | Refusal) -> str:
    value = correction.value
    if correction.kind == "tape":
        at = record.correction("tape_height")
        height = f" at {at:.2f} m" if at is not None else ""
        off = f" (DBH {result.dbh_cm - value:+.1f} cm)" if isinstance(result, DbhEstimate) else ""
        return f"{value:.1f} cm{height}{off}"
    if correction.kind == "breast_height":
        return f"{value:.2f} m"
    if correction.kind == "least_arc":
        return f"{value:.0f}°"
    if correction.kind == "left_out":
        return f"{len(value):,}"
    if correction.kind == "ring":
        return f"drawn by hand, {len(value)} corners"
    if correction.kind == "ground":
        return "placed by hand"
    if correction.kind == "along":
        return "along the stem" if value == "stem" else str(value)
    return CURVE_TITLES.get(value, str(value)) if correction.kind == "curve" else str(value)


def picture_tools(tree_id: int, serial: int, *, has_left_out: bool) -> str:
    """HTML under the section: what can be drawn in it.

    Args:
        tree_id: Whose section it is.
        serial: Of the picture; what is drawn in an older one is refused.
        has_left_out: Whether points were left out, which can be had back.
    """

    def button(kind: str, title: str, tip: str) -> str:
        action = esc(f"dbhSection.begin({js(kind)},{js(tree_id)},{js(serial)})")
        return (
            f'<button type="button" data-draw="{kind}" aria-pressed="false" title="{tip}" '
            f'onclick="{action}">{title}</button>'
        )

    back = ""
    if has_left_out:
        back = f'<button type="button" data-do="restore" onclick="{call("withdraw", "left_out")}">All points</button>'
    return (
        '<div class="dbh-cut-tools dbh-chips">'
        + button("out", "Leave out", "Draw round points that are not bark of this stem")
        + button("keep", "Keep only", "Draw round the points to measure; the others are left out")
        + button("ring", "Draw the ring", "Click the corners of the stem's outline")
        + f'{back}</div><div class="dbh-cut-hint"></div>'
    )


def remedies_html(tree_id: int, refusal: Refusal, heights: Sequence[ProfilePoint] | None, *, serial: int) -> str:
    """HTML in the card of a refused tree: buttons that do what the program can do about it.

    Args:
        tree_id: Which tree.
        refusal: Why it has no diameter.
        heights: Where else along the stem a diameter can be had; None where nobody has looked.
        serial: Of the picture of its section.
    """
    if refusal.code == "unscaled":
        scale = f'<button type="button" onclick="{call("step", "scale")}">2 Scale</button>'
        return f'<div class="dbh-remedies">{scale}</div>'
    parts = []
    if heights is None:
        parts.append(
            f'<button type="button" data-do="look-along" onclick="{call("compare")}">Look along the stem</button>'
        )
    elif not heights:
        parts.append("<span>No diameter can be had along the stem either.</span>")
    for point in heights or ():
        assert point.diameter is not None
        title = f"Measure at {point.height_m:.2f} m ({point.diameter.value_cm:.0f} cm there)"
        parts.append(
            f'<button type="button" data-height="{point.height_m:.2f}" '
            f'onclick="{call("height-set", [tree_id, point.height_m])}">{title}</button>'
        )
    if refusal.section is not None and len(refusal.section.uv_m):
        action = esc(f"dbhSection.begin('ring',{js(tree_id)},{js(serial)})")
        parts.append(f'<button type="button" data-do="draw-ring" onclick="{action}">Draw the ring</button>')
    if refusal.code == "small_arc" and refusal.section is not None:
        arc = f"{refusal.section.coverage_deg:.0f}°"
        parts.append(
            f'<button type="button" data-do="accept-arc" title="A diameter from what was seen, if it gives one; its '
            f'flags say that it was accepted" onclick="{call("accept-arc", tree_id)}">Accept an arc of {arc}</button>'
        )
    if refusal.code in _MAY_BE_TWO:
        parts.append(
            f'<button type="button" data-do="split" title="Where two stems are seen in it" '
            f'onclick="{call("split-stems", tree_id)}">Split it by its stems</button>'
        )
    sent = esc(f"dbh('tape',[{js(tree_id)},this.previousElementSibling.value])")
    entered = "if(event.key==='Enter')this.nextElementSibling.click()"
    parts.append(
        f'<span class="dbh-tape"><input type="text" size="8" placeholder="Tape, cm" aria-label="Tape value" '
        f'onkeydown="{esc(entered)}"><button type="button" data-do="tape" onclick="{sent}">Keep</button></span>'
    )
    return f'<div class="dbh-remedies">{"".join(parts)}</div>'
