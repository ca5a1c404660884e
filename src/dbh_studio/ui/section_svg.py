"""The cross-section as an inline SVG: points, inliers, the fitted curves, and what was not seen.

SVG because it is on screen in a tenth of the time of the first Plotly figure, and because reports need it too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape

import numpy as np

from dbh_studio.core.arrays import Bool, Float64
from dbh_studio.core.curves.base import hull_outline
from dbh_studio.core.dbh import CurveFit, DbhEstimate, Refusal
from dbh_studio.core.section import CrossSection
from dbh_studio.ui.bridge import call
from dbh_studio.ui.html import CURVE_TITLES

CURVE_COLOURS: Mapping[str, str] = {
    "shrinkage": "#1864ab",
    "circle": "#5f3dc4",
    "fourier": "#d9480f",
    "ellipse": "#0b7285",
    "bspline": "#a61e8c",
}
_USED, _LEFT_OUT, _TAPE = "#2b8a3e", "#868e96", "#e8590c"
_FACTOR = 1.645  # standard deviations to either end of a 90 % interval

_SIZE = 340
_MAX_DOTS = 700


def section_svg(result: DbhEstimate | Refusal, *, curve: str) -> str:
    """The picture of one stem's section with its curves to choose from; empty where there is no section to draw.

    Args:
        result: The estimate or the refusal.
        curve: The chosen curve, drawn thick, and whose inliers are coloured.
    """
    section = result.section
    if section is None or len(section.uv_m) == 0:
        return ""
    fits = {name: fit for name, fit in result.fits.items() if isinstance(fit, CurveFit)}
    frame = _Frame.around(section, fits.get(curve))
    parts = [
        f'<div class="dbh-cut"><svg class="dbh-section" viewBox="0 0 {_SIZE} {_SIZE}" role="img" '
        f'aria-label="Cross-section at {section.hom_m:.2f} m">',
        _grid(frame),
        _band(frame, fits.get(curve)),
        _dots(frame, section, fits.get(curve)),
        *(
            _outline(frame, name, fit, chosen=name == curve)
            for name, fit in sorted(fits.items(), key=lambda f: f[0] == curve)
        ),
        _tape(frame, fits.get(curve), is_given=isinstance(result, DbhEstimate)),
        _scale_bar(frame),
        "</svg>",
        _legend(result, curve),
        "</div>",
    ]
    return "".join(parts)


class _Frame:
    """Section metres to picture pixels."""

    def __init__(self, centre_m: Float64, half_width_m: float) -> None:
        self.centre_m = centre_m
        self.half_width_m = half_width_m

    @classmethod
    def around(cls, section: CrossSection, fit: CurveFit | None) -> _Frame:
        shown = fit.outline_uv_m if fit is not None else section.uv_m
        low, high = np.percentile(shown, [1, 99], axis=0) if fit is None else (shown.min(axis=0), shown.max(axis=0))
        half_width = 0.5 * float(np.max(high - low)) * 1.35
        return cls(0.5 * (low + high), max(half_width, 0.01))

    def pixels(self, uv_m: Float64) -> Float64:
        """(N, 2) picture coordinates, y down."""
        scaled = (uv_m - self.centre_m) / self.half_width_m
        return np.stack([0.5 * _SIZE * (1 + scaled[:, 0]), 0.5 * _SIZE * (1 - scaled[:, 1])], axis=1)

    def length_px(self, length_m: float) -> float:
        return 0.5 * _SIZE * length_m / self.half_width_m


def _dots(frame: _Frame, section: CrossSection, fit: CurveFit | None) -> str:
    step = max(1, math.ceil(len(section.uv_m) / _MAX_DOTS))
    pixels = frame.pixels(section.uv_m)[::step]
    inside = ((pixels > 0) & (pixels < _SIZE)).all(axis=1)
    inlier = np.zeros(len(pixels), bool) if fit is None else fit.inliers[::step]
    groups = ((_LEFT_OUT, inside & ~inlier), (_USED, inside & inlier))
    return "".join(
        f'<path d="{"".join(f"M{x:.1f} {y:.1f}h0" for x, y in pixels[chosen])}" '
        f'stroke="{colour}" stroke-width="3.6" stroke-linecap="round" fill="none" opacity="0.7"/>'
        for colour, chosen in groups
        if chosen.any()
    )


def _outline(frame: _Frame, name: str, fit: CurveFit, *, chosen: bool) -> str:
    """The curve: thick where it is chosen, and then dashed where no points support it."""
    pixels = frame.pixels(fit.outline_uv_m)
    colour = CURVE_COLOURS.get(name, "#495057")
    seen = fit.outline_seen if chosen else None
    width, dash = (4, "") if chosen else (2, ' stroke-dasharray="7 5"')
    if seen is not None and not seen.all():
        width, dash = 3, ' stroke-dasharray="5 6"'
    whole = (
        f'<polygon data-curve="{escape(name)}" points="{_points(pixels)}" fill="none" stroke="{colour}" '
        f'stroke-width="{width}"{dash} stroke-linejoin="round"/>'
    )
    if seen is None or seen.all() or not seen.any():
        return whole
    return f'{whole}<path data-seen d="{_arcs(pixels, seen)}" fill="none" stroke="{colour}" stroke-width="4"/>'


def _arcs(pixels: Float64, seen: Bool) -> str:
    """SVG path of the parts of a closed outline that are seen, each vertex standing for the piece about it."""
    following = np.roll(pixels, -1, axis=0)
    before, after = 0.5 * (np.roll(pixels, 1, axis=0) + pixels), 0.5 * (pixels + following)
    return "".join(
        f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}L{c[0]:.1f} {c[1]:.1f}"
        for a, b, c in zip(before[seen], pixels[seen], after[seen], strict=True)
    )


def _points(pixels: Float64) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)


def _band(frame: _Frame, fit: CurveFit | None) -> str:
    """Where the bark is with a probability of 90 %, as a band about the chosen curve."""
    if fit is None or fit.outline_sd_m is None:
        return ""
    middle = fit.outline_uv_m.mean(axis=0)
    out = fit.outline_uv_m - middle
    distance = np.maximum(np.hypot(out[:, 0], out[:, 1]), 1e-9)
    share = np.minimum(_FACTOR * fit.outline_sd_m / distance, 0.95)[:, None]
    rings = [_points(frame.pixels(middle + out * (1.0 + sign * share))).replace(" ", "L") for sign in (1, -1)]
    path = "".join(f"M{ring}Z" for ring in rings)
    colour = CURVE_COLOURS.get(fit.curve, "#495057")
    return f'<path data-band d="{path}" fill="{colour}" fill-opacity="0.16" fill-rule="evenodd" stroke="none"/>'


def _tape(frame: _Frame, fit: CurveFit | None, *, is_given: bool) -> str:
    """Where a tape would lie about the chosen curve, and what it would read."""
    if fit is None or not is_given:
        return ""
    hull = _points(frame.pixels(hull_outline(fit.outline_uv_m)))
    girth_cm = np.pi * fit.diameter("tape").value_cm
    return (
        f'<polygon data-tape points="{hull}" fill="none" stroke="{_TAPE}" stroke-width="1.2" stroke-dasharray="1.5 3"/>'
        f'<text x="{_SIZE - 10}" y="{_SIZE - 12}" font-size="18" font-family="sans-serif" text-anchor="end" '
        f'fill="{_TAPE}">tape {girth_cm:.1f} cm round</text>'
    )


def _grid(frame: _Frame) -> str:
    centre = 0.5 * _SIZE
    return (
        f'<path d="M{centre} 0V{_SIZE}M0 {centre}H{_SIZE}" stroke="#e9ecef" stroke-width="1"/>'
        f'<rect x="0.5" y="0.5" width="{_SIZE - 1}" height="{_SIZE - 1}" fill="none" stroke="#dee2e6"/>'
    )


def _scale_bar(frame: _Frame) -> str:
    length_m = next((m for m in (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01) if frame.length_px(m) < 0.35 * _SIZE), 0.01)
    width, y = frame.length_px(length_m), _SIZE - 14
    return (
        f'<path d="M12 {y}h{width:.1f}" stroke="#343a40" stroke-width="3"/>'
        f'<text x="12" y="{y - 7}" font-size="18" font-family="sans-serif" fill="#343a40">{100 * length_m:g} cm</text>'
    )


def _legend(result: DbhEstimate | Refusal, curve: str) -> str:
    """One button per method, which makes it the chosen one, and what the dots mean."""
    buttons = []
    for name, title in CURVE_TITLES.items():
        chosen = name == curve
        tip = "This method gives the diameter" if chosen else f"Let “{title}” give the diameter of every tree"
        buttons.append(
            f'<button type="button" data-choose="{escape(name)}" aria-pressed="{"true" if chosen else "false"}" '
            f'title="{escape(tip)}" onclick="{call("curve", name)}">'
            f'<i style="border-top:3px {"solid" if chosen else "dashed"} {CURVE_COLOURS.get(name, "#495057")}"></i>'
            # The first word: the picture leaves little room beside it.
            f"<span>{escape(title.split()[0])}</span><span>{escape(_value(result, name))}</span></button>"
        )
    if len(result.fits) < len(CURVE_TITLES):
        buttons.append(
            f'<button type="button" data-do="compare" title="Measure it by every method, and along the stem" '
            f'onclick="{call("compare")}"><i></i><span>Compare all</span><span></span></button>'
        )
    words = [(_USED, "points used"), (_LEFT_OUT, "left out")]
    fit = result.fits.get(curve)
    if isinstance(fit, CurveFit) and fit.outline_seen is not None:
        words.append((f"{CURVE_COLOURS[curve]}55", "90 % interval"))
    dots = "".join(f'<span><i style="background:{colour}"></i>{text}</span>' for colour, text in words)
    return f'<div class="dbh-legend">{"".join(buttons)}<div class="dbh-dots">{dots}</div></div>'


def _value(result: DbhEstimate | Refusal, name: str) -> str:
    """What stands beside a method: its diameter, where one is given."""
    fit = result.fits.get(name)
    if fit is None:
        return ""
    if not isinstance(fit, CurveFit):
        return "no fit"
    return f"{fit.diameter(result.definition).value_cm:.1f} cm" if isinstance(result, DbhEstimate) else "–"
