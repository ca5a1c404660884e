"""The cross-section as an SVG: points, inliers, the fitted curves, and what was not seen.

SVG because it is on screen in a tenth of the time of the first Plotly figure, and because reports need it too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from html import escape

import numpy as np

from dbh_studio.core.arrays import Bool, Float64
from dbh_studio.core.curves.base import hull_outline
from dbh_studio.core.dbh import CurveFit, DbhEstimate, Refusal
from dbh_studio.core.section import CrossSection

CURVE_TITLES: Mapping[str, str] = {
    "shrinkage": "Shrinkage curve",
    "circle": "Circle",
    "fourier": "Fourier",
    "ellipse": "Ellipse",
    "bspline": "B-spline",
}
CURVE_COLOURS: Mapping[str, str] = {
    "shrinkage": "#1864ab",
    "circle": "#5f3dc4",
    "fourier": "#d9480f",
    "ellipse": "#0b7285",
    "bspline": "#a61e8c",
}
USED_COLOUR, LEFT_OUT_COLOUR, CROSSED_COLOUR = "#2b8a3e", "#868e96", "#e03131"
_TAPE = "#e8590c"
_FACTOR = 1.645  # standard deviations to either end of a 90 % interval

_SIZE = 340
_CM_PER_INCH = 2.54
# Of the scale bar.
_CENTIMETRES, _INCHES = (100, 50, 20, 10, 5, 2, 1), (40, 20, 10, 5, 2, 1, 0.5)
_MAX_DOTS = 700
# Refusals that say there is no ring: what was tried must not look like one that is known to a hair.
_NO_RING = ("no_ring", "clutter")


def section_drawing(
    result: DbhEstimate | Refusal, *, curve: str, inches: bool = False, crossed_uv_m: Float64 | None = None
) -> str:
    """The picture of one stem's section; empty where there is no section to draw.

    Args:
        result: The estimate or the refusal.
        curve: The chosen curve, drawn thick, and whose inliers are coloured.
        crossed_uv_m: (N, 2) points that a person has left out; crossed.
        inches: The unit of the scale bar and the tape; centimetres otherwise.
    """
    section = result.section
    if section is None or len(section.uv_m) == 0:
        return ""
    fits = fits_to_draw(result)
    frame = _Frame.around(section, fits.get(curve))
    parts = [
        f'<svg class="dbh-section" viewBox="0 0 {_SIZE} {_SIZE}" role="img" data-frame="{frame.words()}" '
        f'aria-label="Cross-section at {section.hom_m:.2f} m">',
        _grid(frame),
        _band(frame, fits.get(curve)),
        _dots(frame, section, fits.get(curve)),
        *(
            _outline(frame, name, fit, chosen=name == curve)
            for name, fit in sorted(fits.items(), key=lambda f: f[0] == curve)
        ),
        _tape(frame, fits.get(curve), is_given=isinstance(result, DbhEstimate), inches=inches),
        _crosses(frame, crossed_uv_m),
        _scale_bar(frame, inches=inches),
        "</svg>",
    ]
    return "".join(parts)


def fits_to_draw(result: DbhEstimate | Refusal) -> dict[str, CurveFit]:
    """The curves that were fitted; where no ring stands out, as if nothing was seen of them: dashed, without a band."""
    fits = {name: fit for name, fit in result.fits.items() if isinstance(fit, CurveFit)}
    if not isinstance(result, Refusal) or result.code not in _NO_RING:
        return fits
    return {
        name: replace(fit, outline_seen=np.zeros(len(fit.outline_uv_m), bool), outline_sd_m=None)
        for name, fit in fits.items()
    }


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

    def words(self) -> str:
        """Middle and half width in metres, for whoever draws in the picture."""
        return f"{self.centre_m[0]:.5f} {self.centre_m[1]:.5f} {self.half_width_m:.5f}"

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
    groups = ((LEFT_OUT_COLOUR, inside & ~inlier), (USED_COLOUR, inside & inlier))
    return "".join(
        f'<path d="{"".join(f"M{x:.1f} {y:.1f}h0" for x, y in pixels[chosen])}" '
        f'stroke="{colour}" stroke-width="3.6" stroke-linecap="round" fill="none" opacity="0.7"/>'
        for colour, chosen in groups
        if chosen.any()
    )


def _crosses(frame: _Frame, uv_m: Float64 | None) -> str:
    """A small cross at every point that was left out by hand."""
    if uv_m is None or not len(uv_m):
        return ""
    pixels = frame.pixels(uv_m)[:: max(1, math.ceil(len(uv_m) / _MAX_DOTS))]
    inside = ((pixels > 0) & (pixels < _SIZE)).all(axis=1)
    path = "".join(f"M{x - 2.5:.1f} {y - 2.5:.1f}l5 5m0 -5l-5 5" for x, y in pixels[inside])
    return f'<path data-crossed d="{path}" stroke="{CROSSED_COLOUR}" stroke-width="1.2" fill="none" opacity="0.8"/>'


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


def _tape(frame: _Frame, fit: CurveFit | None, *, is_given: bool, inches: bool) -> str:
    """Where a tape would lie about the chosen curve, and what it would read."""
    if fit is None or not is_given:
        return ""
    hull = _points(frame.pixels(hull_outline(fit.outline_uv_m)))
    girth_cm = np.pi * fit.diameter("tape").value_cm
    girth = f"{girth_cm / _CM_PER_INCH:.1f} in" if inches else f"{girth_cm:.1f} cm"
    return (
        f'<polygon data-tape points="{hull}" fill="none" stroke="{_TAPE}" stroke-width="1.2" stroke-dasharray="1.5 3"/>'
        f'<text x="{_SIZE - 10}" y="{_SIZE - 12}" font-size="18" font-family="sans-serif" text-anchor="end" '
        f'fill="{_TAPE}">tape {girth} round</text>'
    )


def _grid(frame: _Frame) -> str:
    centre = 0.5 * _SIZE
    return (
        f'<path d="M{centre} 0V{_SIZE}M0 {centre}H{_SIZE}" stroke="#e9ecef" stroke-width="1"/>'
        f'<rect x="0.5" y="0.5" width="{_SIZE - 1}" height="{_SIZE - 1}" fill="none" stroke="#dee2e6"/>'
    )


def _scale_bar(frame: _Frame, *, inches: bool) -> str:
    unit, unit_m, sizes = ("in", 0.01 * _CM_PER_INCH, _INCHES) if inches else ("cm", 0.01, _CENTIMETRES)
    length = next((size for size in sizes if frame.length_px(size * unit_m) < 0.35 * _SIZE), sizes[-1])
    width, y = frame.length_px(length * unit_m), _SIZE - 14
    return (
        f'<path d="M12 {y}h{width:.1f}" stroke="#343a40" stroke-width="3"/>'
        f'<text x="12" y="{y - 7}" font-size="18" font-family="sans-serif" fill="#343a40">{length:g} {unit}</text>'
    )
