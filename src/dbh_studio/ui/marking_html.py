"""The HTML of marking a known length: what to click, the points so far, and the surroundings of one, enlarged."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence

import numpy as np

from dbh_studio.app.photo_points import Suggestion
from dbh_studio.core.arrays import UInt8
from dbh_studio.core.close_up import CloseUp
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.ui.bridge import call, esc, js
from dbh_studio.ui.point_picks import PointPicks

CLOSE_UP_PX = 260


def start_card(place: str) -> str:
    """The two things that can be marked."""
    where = "in the cloud" if place == "cloud" else "in the photos"
    bar, square = (call("mark", ["start", [kind, place]]) for kind in ("bar", "square"))
    return (
        '<div class="dbh"><div class="dbh-starts">'
        f'<button type="button" data-start="bar" onclick="{bar}">{_BAR_SVG}'
        f"<b>Mark a bar</b><span>2 points {where}</span></button>"
        f'<button type="button" data-start="square" onclick="{square}">{_SQUARE_SVG}'
        f"<b>Mark a marker's corners</b><span>4 points, clockwise</span></button></div></div>"
    )


_BAR_SVG = (
    '<svg viewBox="0 0 90 60" width="90" height="60" aria-hidden="true">'
    '<line x1="14" y1="40" x2="76" y2="20" stroke="#495057" stroke-width="5"/>'
    '<g fill="#e8590c"><circle cx="14" cy="40" r="6"/><circle cx="76" cy="20" r="6"/></g></svg>'
)
_SQUARE_SVG = (
    '<svg viewBox="0 0 90 60" width="90" height="60" aria-hidden="true">'
    '<rect x="23" y="8" width="44" height="44" fill="#212529"/>'
    '<path d="M32 17h9v9h-9zM50 26h9v9h-9zM32 35h9v9h-9z" fill="#fff"/>'
    '<path d="M34 3h22m-5-3 6 3-6 3" stroke="#e8590c" fill="none" stroke-width="1.5"/>'
    '<g fill="#e8590c"><circle cx="23" cy="8" r="6"/><circle cx="67" cy="8" r="6"/>'
    '<circle cx="67" cy="52" r="6"/><circle cx="23" cy="52" r="6"/></g>'
    '<g fill="#fff" font-size="9" font-weight="700" text-anchor="middle"><text x="23" y="11">1</text>'
    '<text x="67" y="11">2</text><text x="67" y="55">3</text><text x="23" y="55">4</text></g></svg>'
)


def marking_card(
    picks: PointPicks,
    *,
    scale: ScaleEstimate,
    typed: str,
    close_up: CloseUp | None,
    cross: tuple[float, float] | None,
    offered: Sequence[Suggestion],
    first_photo: str = "",
) -> str:
    """The points of the length that is being marked.

    Args:
        picks: They.
        scale: For distances in metres.
        typed: What stands in the field of the true length.
        close_up: The surroundings of the chosen point, enlarged.
        cross: Where the chosen point is in them, 0..1.
        offered: Photos that should show the chosen point too.
        first_photo: One to begin with, where none is open.
    """
    dots = "".join(_dot(picks, number) for number in range(len(picks.picks)))
    what = f"Marking {picks.edited}" if picks.edited else "New marker" if picks.kind == "square" else "New bar"
    parts = [
        f'<div class="dbh dbh-marking"><div class="dbh-markhead"><b>{esc(what)}</b>'
        f"{_button('back', None, '&#8630; Last point') if picks.is_begun else ''}"
        f"{_button('stop', None, '&#10005; Cancel (Esc)')}</div>",
        f'<div class="dbh-hint" data-level="busy">{esc(instruction(picks))}</div>',
        f'<div class="dbh-dots2">{dots}</div>',
        _primary("photo", first_photo, "Open a photo") if first_photo and not offered else "",
        _sights(picks, scale) if picks.place == "photos" else "",
        _offers(picks, offered, scale) if picks.place == "photos" else "",
    ]
    if close_up is not None and cross is not None:
        parts.append(close_up_picture(close_up, cross, scale))
    if picks.current.point is not None and picks.place == "cloud":
        parts.append(
            f'<div class="dbh-markrow">{_button("move", picks.chosen, "Click it anew in the cloud")}'
            f"{_button('remove', picks.chosen, 'Remove it')}</div>"
        )
    if picks.is_complete:
        title = "Side of the black square" if picks.kind == "square" else "True length"
        parts.append(
            f'<div class="dbh-keep"><label class="dbh-field"><span>{title}</span><span class="dbh-metres">'
            f'<input type="text" inputmode="decimal" size="6" value="{esc(typed)}" data-field="keep" '
            f'oninput="{_typed()}" '
            'onkeydown="event.stopPropagation();if(event.key===&#39;Enter&#39;)'
            'this.closest(&#39;.dbh-keep&#39;).querySelector(&#39;button&#39;).click()"> m</span></label>'
            f'<button type="button" data-do="keep" onclick="{_keep()}">Keep it</button></div>'
        )
    return "".join(parts) + "</div>"


def _typed() -> str:
    return esc(f"dbh({js('mark')},[{js('typed')},this.value])")


def _keep() -> str:
    return esc(f"dbh({js('mark')},[{js('keep')},this.closest('.dbh-keep').querySelector('input').value])")


def _button(action: str, value: object, title: str) -> str:
    return f'<button type="button" data-do="{action}" onclick="{call("mark", [action, value])}">{title}</button>'


def _primary(action: str, value: object, title: str) -> str:
    return _button(action, value, title).replace("<button ", '<button class="dbh-primary" ', 1)


def instruction(picks: PointPicks) -> str:
    """What to click now."""
    count, name = len(picks.picks), picks.names[picks.chosen]
    if picks.is_moving:
        return f"Click where {name} is."
    following = picks.next_open()
    if picks.place == "cloud":
        if following is None:
            return "All points are marked. Check each one enlarged, give the true length, then press Keep it."
        return f"Click {picks.names[following]} in the cloud ({following + 1} of {count})."
    n_sights = len(picks.current.sights)
    if picks.current.point is not None:
        return (
            "All points are marked. Give the true length, then press Keep it."
            if following is None
            else f"{_capital(name)} is known. Go on to {picks.names[following]}, or mark it in more photos."
        )
    if not n_sights:
        return f"Open a photo and click {name} in it ({picks.chosen + 1} of {count})."
    return f"Now click {name} in another photo."


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _dot(picks: PointPicks, number: int) -> str:
    pick = picks.picks[number]
    kind = "done" if pick.point is not None else "begun" if pick.sights else "open"
    title = _capital(picks.names[number])
    return (
        f'<button type="button" data-point="{number}" data-kind="{kind}" title="{esc(title)}" '
        f'aria-pressed="{"true" if number == picks.chosen else "false"}" onclick="{call("mark", ["choose", number])}">'
        f"{number + 1}{' &#10003;' if kind == 'done' else ''}</button>"
    )


def _sights(picks: PointPicks, scale: ScaleEstimate) -> str:
    """Where the chosen point was marked, and what the photos say together."""
    pick = picks.current
    found = pick.found
    rows = ""
    for number, sight in enumerate(pick.sights):
        off = "" if found is None else f"{found.residuals_px[number]:.1f} px off"
        flaw = found is not None and not found.is_used[number]
        rows += (
            f'<li data-level="{"warn" if flaw else "ok"}"><span>{esc(sight.image)}</span>'
            f"<i>{off}{', left out' if flaw else ''}</i>"
            f"{_button('photo', sight.image, 'Show')}{_button('unsee', sight.image, '&#10005;')}</li>"
        )
    said = ""
    if pick.refusal is not None:
        said = (
            f'<div class="dbh-hint" data-level="stop">{esc(pick.refusal.reason)}'
            f"<br><b>What to do:</b> {esc(pick.refusal.remedy)}</div>"
        )
    elif found is not None:
        unit, factor = ("cm", 100 * scale.metres_per_unit) if scale.is_known else ("units", 1.0)
        weak = " The views are close together: mark it from another side, too." if found.parallax_deg < 5 else ""
        known = f"known to ± {factor * found.point.sigma_src:.2g} {unit}"
        said = f'<div class="muted">Views {found.parallax_deg:.0f}° apart, {known}.{weak}</div>'
    return (f'<ul class="dbh-list dbh-sights">{rows}</ul>' if rows else "") + said


def _offers(picks: PointPicks, offered: Sequence[Suggestion], scale: ScaleEstimate) -> str:
    """The photos to mark the point in next, and the way to the next point."""
    following = picks.next_open()
    onward = ""
    if picks.current.point is not None and following is not None:
        onward = _primary("next", None, f"Next: {esc(picks.names[following])} &#8594;")
    if not offered or not (picks.current.sights or picks.current.point):
        return onward
    factor, unit = (scale.metres_per_unit, "m") if scale.is_known else (1.0, "units")
    buttons = "".join(
        f'<button type="button" data-do="photo" data-image="{esc(each.image)}" '
        f'class="{"dbh-primary" if number == 0 and not onward else ""}" '
        f'onclick="{call("mark", ["photo", each.image])}">{esc(each.image.rsplit("/", 1)[-1])} '
        f"<i>{factor * each.distance_src:.1f} {unit}</i></button>"
        for number, each in enumerate(offered)
    )
    return f'{onward}<div class="dbh-offers"><span class="muted">It should also be in sight in:</span>{buttons}</div>'


def keys_js() -> str:
    """Lets the arrow keys move the enlarged point once it was clicked, until something else is.

    On the window and not on the picture: each move draws the picture anew, and the new one has no focus.
    """
    return f"""
    if (!window.dbhCloseUpKeys) {{
      window.dbhCloseUpKeys = true;
      let meant = false;
      window.addEventListener('pointerdown', (e) => {{
        meant = e.target instanceof Element && !!e.target.closest('.dbh-closeup');
      }}, true);
      window.addEventListener('keydown', (e) => {{
        const picture = document.querySelector('.dbh-closeup');
        if (!picture || !(meant || document.activeElement === picture)) return;
        const s = e.shiftKey ? 5 : 1;
        const k = {{ArrowLeft: [-s, 0], ArrowRight: [s, 0], ArrowUp: [0, -s], ArrowDown: [0, s]}}[e.key];
        if (!k) return;
        e.preventDefault();
        e.stopPropagation();
        dbh({js("mark")}, [{js("nudge")}, k]);
      }}, true);
    }}
    """


def close_up_picture(close_up: CloseUp, cross: tuple[float, float], scale: ScaleEstimate) -> str:
    """The surroundings of a point, enlarged, with the point and a length to go by."""
    x, y = (CLOSE_UP_PX * value for value in cross)
    width = 2 * close_up.half_width
    unit = " cm" if scale.is_known else ""
    ruler = _round_length(0.3 * width * (100 if scale.is_known else 1))
    ruler_px = CLOSE_UP_PX * ruler / (width * (100 if scale.is_known else 1))
    at = esc(
        f"const r=this.getBoundingClientRect();this.focus();dbh({js('mark')},[{js('at')},"
        "[(event.clientX-r.left)/r.width,(event.clientY-r.top)/r.height]])"
    )
    svg = (
        f'<svg viewBox="0 0 {CLOSE_UP_PX} {CLOSE_UP_PX}">'
        f'<g stroke="#fff" stroke-width="3.5" opacity=".8">{_cross(x, y)}</g>'
        f'<g stroke="#e8590c" stroke-width="1.5">{_cross(x, y)}</g>'
        f'<rect x="4" y="{CLOSE_UP_PX - 20}" width="{ruler_px + 52:.0f}" height="16" rx="3" fill="#fff" opacity=".85"/>'
        f'<path d="M8 {CLOSE_UP_PX - 14}v6m0-3h{ruler_px:.1f}m0-3v6" stroke="#212529" stroke-width="1.5" fill="none"/>'
        f'<text x="{ruler_px + 13:.0f}" y="{CLOSE_UP_PX - 8}" font-size="11" fill="#212529">{ruler:g}{unit}</text>'
        "</svg>"
    )
    return (
        '<div class="dbh-zoomed"><div class="dbh-closeup" tabindex="0" role="application" '
        f'aria-label="The point, enlarged" onclick="{at}">'
        f'<img alt="" draggable="false" src="{_png_url(close_up.picture(CLOSE_UP_PX))}">{svg}</div>'
        f'<div class="dbh-zoombar">{_button("zoom", 1, "+")}{_button("zoom", -1, "&#8722;")}'
        '<span class="muted">Click here to move the point. Arrow keys: finer.</span></div></div>'
    )


def _cross(x: float, y: float) -> str:
    return f'<path d="M{x - 14:.1f} {y:.1f}h10m8 0h10M{x:.1f} {y - 14:.1f}v10m0 8v10" fill="none"/>'


def _round_length(about: float) -> float:
    """1, 2 or 5 times a power of ten, not above `about`."""
    power = 10.0 ** np.floor(np.log10(max(about, 1e-12)))
    return float(power * max(step for step in (1, 2, 5) if step * power <= about * (1 + 1e-9)))


def _png_url(picture: UInt8) -> str:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).quantize(128).save(buffer, "PNG")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def banner_js(picks: PointPicks | None) -> str:
    """JavaScript that shows over the picture what to click, or takes it away."""
    content = ""
    if picks is not None:
        content = f"<b>{esc(instruction(picks))}</b>{_button('stop', None, 'Cancel (Esc)')}"
    return (
        f"(()=>{{const c={js(content)};let e=document.getElementById('dbh-banner');if(!c){{if(e)e.remove();return;}}"
        "if(!e){e=document.createElement('div');e.id='dbh-banner';e.className='dbh';document.body.appendChild(e);}"
        "if(e.innerHTML!==c)e.innerHTML=c;})()"
    )
