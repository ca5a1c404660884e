"""The HTML of the Scale step. Every text that comes from a file or a person goes through `esc`."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.core.arrays import UInt8
from dbh_studio.core.bars import BarResidual, ScaleReport
from dbh_studio.core.scale import ScaleEstimate, ScaleSource
from dbh_studio.core.scale_evidence import MarkerSquare, ScaleBar, ScaleEvidence
from dbh_studio.ui import html
from dbh_studio.ui.bridge import call, esc, js

if TYPE_CHECKING:
    from dbh_studio.stages.marker_detect import Detection

SOURCES: Mapping[ScaleSource, str] = {
    "metres": "the file is in metres",
    "feet": "the file is in feet",
    "millimetres": "the file is in millimetres",
    "factor": "as given by number",
    "marker": "measured on markers",
    "bars": "measured on known lengths",
    "camera_height": "from the height the camera was carried at",
    "baseline": "from the distance between two photos",
    "lidar": "from the LiDAR cloud of the same plot",
}
WAYS: Mapping[str, tuple[str, str]] = {
    "markers": ("Markers", "Find printed markers in the photos by themselves"),
    "cloud": ("Click in cloud", "Click the ends of something whose length is known"),
    "photos": ("Click in photos", "Click the same point in two or more photos"),
    "number": ("By number", "Give the unit, a factor, or something known"),
}
_LIES = {"horizontal": "lying", "vertical": "standing", "oblique": "slanting", "unknown": ""}
# No more pictures of one marker at a time: the page must stay light.
_MOST_PICTURES = 60
_THUMB_PX = 72


# ---- where one stands


def state(scale: ScaleEstimate, report: ScaleReport | None, size: str) -> str:
    """Metres per unit, from what, how well, and whether what is marked is applied."""
    if not scale.is_known:
        if report is not None and report.estimate is not None:
            return html.message(
                f"Not applied yet. The known lengths say 1 unit = {report.estimate.metres_per_unit:.5g} m"
                f"{_error(report.estimate)}.{_doubt(report)}",
                remedy="Press Set the scale from the known lengths.",
            ) + _facts(size)
        return f'<div class="dbh">{html.facts([("1 unit is", "not known yet"), ("The plot is", size or "–")])}</div>'
    said = f"1 unit = {scale.metres_per_unit:.6g} m{_error(scale)}, {SOURCES.get(scale.source, scale.source)}."
    if scale.is_weak:
        return html.message(said + " Weak: use it only where nothing else exists.") + _facts(size)
    if report is None or report.estimate is None:
        return html.message(said, level="ok") + _facts(size)
    if is_applied(scale, report):
        verdict = report.verdict
        error = "" if "±" in verdict.message else _error(scale)
        text = f"1 unit = {scale.metres_per_unit:.6g} m{error}, {SOURCES.get(scale.source, scale.source)}. Applied. "
        level = "ok" if verdict.level == "good" else "todo"
        return html.message(text + verdict.message, level=level, remedy=verdict.remedy) + _facts(size)
    difference = 100 * (report.estimate.metres_per_unit / scale.metres_per_unit - 1)
    text = (
        f"In use: {said} The known lengths below say {report.estimate.metres_per_unit:.6g} m"
        f"{_error(report.estimate)}, {signed(difference, 2)} %. That is not applied.{_doubt(report)}"
    )
    return html.message(text) + _facts(size)


def is_applied(scale: ScaleEstimate, report: ScaleReport) -> bool:
    """Whether the plot has the scale that the known lengths give."""
    estimate = report.estimate
    return (
        estimate is not None
        and scale.source == estimate.source
        and abs(scale.metres_per_unit / estimate.metres_per_unit - 1) < 1e-9
    )


def _doubt(report: ScaleReport) -> str:
    """What stands against the known lengths, before they are applied."""
    verdict = report.verdict
    is_doubtful = verdict.level == "caution" and verdict.code != "unchecked"
    return f" {verdict.message}" if is_doubtful else ""


def _error(scale: ScaleEstimate) -> str:
    if not scale.standard_error:
        return ""
    return f" ± {100 * scale.standard_error / scale.metres_per_unit:.2g} %"


def signed(value: float, decimals: int) -> str:
    """With its sign, and none where it rounds to nothing."""
    text = f"{value:+.{decimals}f}"
    return text if float(text) else text[1:]


def _facts(size: str) -> str:
    return f'<div class="dbh">{html.facts([("The plot is", size)])}</div>' if size else ""


def ways(active: str, usable: Mapping[str, bool]) -> str:
    """The row of ways to a scale."""
    buttons = "".join(
        f'<button type="button" data-way="{key}" title="{esc(tip)}" '
        f'data-usable="{"true" if usable[key] else "false"}" '
        f'aria-pressed="{"true" if key == active else "false"}" '
        f'onclick="{call("scale-way", key)}">{esc(title)}</button>'
        for key, (title, tip) in WAYS.items()
    )
    return f'<div class="dbh"><div class="dbh-ways">{buttons}</div></div>'


def note(text: str) -> str:
    """A quiet sentence."""
    return f'<div class="dbh muted">{esc(text)}</div>'


def photos_line(n_photos: int, *, is_open: bool) -> str:
    """How many photos there are; pressing it shows more of them."""
    arrow = "&#9662;" if is_open else "&#9656;"
    return (
        f'<div class="dbh"><button type="button" class="dbh-name" aria-expanded="{"true" if is_open else "false"}" '
        f'data-do="photos" onclick="{call("photos-open")}">{arrow} {n_photos:,} photos</button></div>'
    )


def side_input(side_m: float) -> str:
    """The field for the side of the markers."""
    return (
        '<div class="dbh"><label class="dbh-field"><span>Side of the black square</span>'
        f"{_metres(side_m, 'marker-side', None, 'Side of the black square')}</label>"
        '<div class="muted">Outer edge of the black, not of the paper. Measure it with a ruler.</div></div>'
    )


def _metres(value_m: float, kind: str, name: str | None, title: str) -> str:
    """A field for a length; it sends ``[name, text]``, or the text alone, when it is left or Enter is pressed."""
    payload = "this.value" if name is None else f"[{js(name)},this.value]"
    send = esc(f"dbh({js(kind)},{payload})")
    return (
        f'<span class="dbh-metres"><input type="text" inputmode="decimal" size="6" value="{metres(value_m)}" '
        f'aria-label="{esc(title)}" title="{esc(title)}" data-field="{esc(kind)}" '
        f'onkeydown="event.stopPropagation();if(event.key===&#39;Enter&#39;)this.blur()" '
        f'onchange="{send}"> m</span>'
    )


def metres(value_m: float) -> str:
    """A length as it is typed: no fewer than two decimals, and none lost."""
    text = f"{value_m:.6f}".rstrip("0")
    whole, _, decimals = text.partition(".")
    return f"{whole}.{decimals:0<2}"


# ---- the known lengths


def lengths(
    evidence: ScaleEvidence,
    report: ScaleReport | None,
    *,
    opened: str = "",
    details: str = "",
) -> str:
    """The list of known lengths.

    Args:
        evidence: They.
        report: What they say.
        opened: Name of the one whose details are shown.
        details: The details.
    """
    if not len(evidence):
        return ""
    n_controls = sum(length.role == "control" for length in evidence)
    residuals = {residual.name: residual for residual in report.residuals} if report is not None else {}
    rows = "".join(
        _length_row(length, residuals.get(length.name), is_open=length.name == opened, is_alone=n_controls == 1)
        + (details if length.name == opened else "")
        for length in evidence
    )
    return (
        '<div class="dbh"><h4 class="dbh-h4">Known lengths</h4>'
        f'<div class="dbh-lengths">{rows}</div>{_comparison(report)}</div>'
    )


def _length_row(length: ScaleBar | MarkerSquare, residual: BarResidual | None, *, is_open: bool, is_alone: bool) -> str:
    role_tip = "control: sets the scale; check: only tests it"
    roles = "".join(
        f'<option value="{role}"{" selected" if role == length.role else ""}>{role}</option>'
        for role in ("control", "check")
    )
    facts = _kind_of(length)
    if residual is not None and is_alone and length.role == "control":
        off = "<b>sets the scale alone</b>"
    elif residual is not None:
        lie = _LIES.get(residual.lie, "")
        facts += f", {lie}" if lie else ""
        off = (
            f'<b data-off="{"large" if residual.n_sigma > 3 and abs(residual.residual_pct) > 0.2 else "small"}">'
            f"{signed(100 * residual.residual_m, 1)} cm ({signed(residual.residual_pct, 2)} %)</b>"
        )
    else:
        off = "<b>–</b>"
    name = length.name
    set_role = esc(f"dbh({js('length-role')},[{js(name)},this.value])")
    return (
        f'<div class="dbh-length" data-length="{esc(name)}" data-role="{length.role}">'
        f'<button type="button" class="dbh-name" aria-expanded="{"true" if is_open else "false"}" '
        f'title="Show more" onclick="{call("length-open", name)}">'
        f"{'&#9662;' if is_open else '&#9656;'} {esc(name)}</button>"
        f"{_metres(length.length_m, 'length-true', name, f'True length of {name}')}"
        f'<select title="{role_tip}" aria-label="{role_tip}" '
        f'onchange="{set_role}">{roles}</select>'
        f'<button type="button" class="dbh-x" title="Remove {esc(name)}" '
        f'onclick="{call("length-remove", name)}">&#10005;</button>'
        f'<span class="muted dbh-kind">{esc(facts)}</span><span class="dbh-off">{off}</span></div>'
    )


def _kind_of(length: ScaleBar | MarkerSquare) -> str:
    if isinstance(length, ScaleBar):
        n_photos = {len(end.sights) for end in length.ends}
        return "clicked in the cloud" if n_photos == {0} else f"clicked in {max(n_photos)} photos"
    if length.n_views is not None:
        return f"found, {length.n_views} photos"
    n_photos = {len(corner.sights) for corner in length.corners}
    return "corners clicked" if n_photos == {0} else f"corners clicked in {max(n_photos)} photos"


def _comparison(report: ScaleReport | None) -> str:
    """Whether lying and standing lengths agree."""
    if report is None:
        return ""
    if report.estimate is None:
        return (
            f'<div class="dbh-hint" data-level="stop">{esc(report.verdict.message)} {esc(report.verdict.remedy)}</div>'
        )
    text = ""
    if report.horizontal_over_vertical is not None and report.ratio_se is not None:
        off = 100 * (report.horizontal_over_vertical - 1)
        level = "warn" if abs(off) > max(3 * 100 * report.ratio_se, 0.3) else "ok"
        text = (
            f'<ul class="dbh-list"><li data-level="{level}">Lying lengths are {signed(off, 2)} % '
            f"(± {100 * report.ratio_se:.2f} %) against standing ones.</li></ul>"
        )
    return text


def square_details(square: MarkerSquare, pictures: str) -> str:
    """What can be done with a marker: mark its corners anew, take up, origin and north from it; its pictures."""
    boxes = "".join(
        f'<label><input type="checkbox" value="{key}" checked> {title}</label>'
        for key, title in (("up", "up"), ("origin", "origin"), ("north", "north"))
    )
    use = esc(
        f"dbh({js('length-frame')},[{js(square.name)},"
        "...[...this.parentNode.querySelectorAll('input')].map(b=>b.checked)])"
    )
    return (
        f'<div class="dbh-details">{pictures}<div class="dbh-frame"><span>Lies flat? Use it for</span>{boxes}'
        f'<button type="button" data-do="frame" onclick="{use}">Use</button></div>'
        f"{_edit_button(square.name, 'corners')}</div>"
    )


def bar_details(bar: ScaleBar) -> str:
    """What can be done with a bar."""
    return f'<div class="dbh-details">{_edit_button(bar.name, "ends")}</div>'


def _edit_button(name: str, what: str) -> str:
    onclick = call("mark", ["edit", name])
    return f'<button type="button" data-do="edit" onclick="{onclick}">Move its {what} …</button>'


def pictures(detections: Sequence[Detection], struck: Sequence[tuple[str, str, int]], used: Sequence[str]) -> str:
    """The finds of one marker, each with its photo's name and a cross to strike it out."""
    if not detections:
        return '<div class="muted">Its pictures are gone; find the markers again to see them.</div>'
    out, in_use = set(struck), set(used)
    ranked = sorted(detections, key=lambda each: (each.image not in in_use, -each.confidence))
    cells = "".join(
        _picture(each, (each.image, *each.key) in out, each.image in in_use) for each in ranked[:_MOST_PICTURES]
    )
    left = f'<div class="muted">and {len(ranked) - _MOST_PICTURES} more</div>' if len(ranked) > _MOST_PICTURES else ""
    return f'<div class="dbh-thumbs">{cells}</div>{left}'


def _picture(detection: Detection, is_struck: bool, is_used: bool) -> str:
    sight = [detection.image, detection.dictionary, detection.marker_id]
    if is_struck:
        kind, button, tip = "struck", "&#8634;", "Use it again"
    else:
        kind, button, tip = "used" if is_used else "unused", "&#10005;", "Not a marker: leave it out"
    name = detection.image.rsplit("/", 1)[-1]
    return (
        f'<figure data-kind="{kind}" title="{esc(detection.image)}, match {detection.confidence:.2f}'
        f'{"" if is_used or is_struck else ", not needed"}">'
        f'<img alt="{esc(name)}" src="{jpeg_url(detection.crop, _THUMB_PX)}">'
        f'<button type="button" title="{tip}" data-strike="{esc(detection.image)}" '
        f'onclick="{call("strike", [sight, not is_struck])}">{button}</button>'
        f"<figcaption>{esc(name)}</figcaption></figure>"
    )


def left_out(
    key: tuple[str, int], detections: Sequence[Detection], struck: Sequence[tuple[str, str, int]], side_m: float
) -> str:
    """A code that was seen and is not used, with its pictures, and the way to use it all the same."""
    name = f"{key[0]} {key[1]}"
    out = set(struck)
    believed = sum((each.image, *each.key) not in out for each in detections)
    send = esc(
        f"dbh({js('use-marker')},[{js(key[0])},{key[1]},this.closest('.dbh-markrow').querySelector('input').value])"
    )
    use = (
        f'<span class="dbh-metres"><input type="text" inputmode="decimal" size="6" value="{metres(side_m)}" '
        f'aria-label="Side of {esc(name)}" title="Side of its black square" '
        'onkeydown="event.stopPropagation()"> m</span>'
        f'<button type="button" data-do="use" onclick="{send}">Use it</button>'
    )
    return (
        f'<div class="dbh"><div class="dbh-markrow"><span class="dbh-grow"><b>{esc(name)}</b> not used: seen in '
        f"{believed} photo{'' if believed == 1 else 's'}.</span>{use if believed > 1 else ''}</div>"
        f"{pictures(detections, struck, ())}</div>"
    )


def problems(items: Sequence[tuple[str, str, str]]) -> str:
    """Why markers were left out."""
    return html.findings([("warn", reason, remedy) for _, reason, remedy in items[:5]]) if items else ""


def jpeg_url(picture: UInt8, size_px: int) -> str:
    """A small picture as a data URL."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(picture))
    image.thumbnail((size_px, size_px))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=80)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
