"""The cross-section in the panel: its drawing, and a button per method."""

from __future__ import annotations

from html import escape

from dbh_studio.core.arrays import Float64
from dbh_studio.core.dbh import CurveFit, DbhEstimate, Refusal
from dbh_studio.core.section_drawing import (
    CROSSED_COLOUR,
    CURVE_COLOURS,
    CURVE_TITLES,
    LEFT_OUT_COLOUR,
    USED_COLOUR,
    fits_to_draw,
    section_drawing,
)
from dbh_studio.ui.bridge import call

__all__ = ["CURVE_COLOURS", "section_svg"]


def section_svg(result: DbhEstimate | Refusal, *, curve: str, crossed_uv_m: Float64 | None = None) -> str:
    """The picture of one stem's section with its curves to choose from; empty where there is no section to draw.

    Args:
        result: The estimate or the refusal.
        curve: The chosen curve, drawn thick, and whose inliers are coloured.
        crossed_uv_m: (N, 2) points that a person has left out.
    """
    picture = section_drawing(result, curve=curve, crossed_uv_m=crossed_uv_m)
    has_crossed = crossed_uv_m is not None and len(crossed_uv_m) > 0
    return f'<div class="dbh-cut">{picture}{_legend(result, curve, has_crossed)}</div>' if picture else ""


def _legend(result: DbhEstimate | Refusal, curve: str, has_crossed: bool) -> str:
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
    words = [(USED_COLOUR, "points used"), (LEFT_OUT_COLOUR, "left out")]
    if has_crossed:
        words.append((CROSSED_COLOUR, "left out by hand"))
    fit = fits_to_draw(result).get(curve)
    if fit is not None and fit.outline_sd_m is not None:
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
