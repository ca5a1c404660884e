"""What a forester reads of one tree: the number or why there is none, how far to trust it, and how it was measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import zip_longest

import numpy as np

from dbh_studio.core.axis import middle_m
from dbh_studio.core.dbh import DbhEstimate, Diameter, Refusal
from dbh_studio.core.drawn_ring import DRAWN
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.section_drawing import CURVE_TITLES
from dbh_studio.settings import MeasureSettings
from dbh_studio.ui.bridge import call, esc
from dbh_studio.ui.html import facts, plain

_AS_GOOD_AS_THERE_M = 0.05  # leans found twice differ a little, and with them heights along the stem
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


def tree_card(
    tree_id: int,
    result: DbhEstimate | Refusal,
    *,
    section: str = "",
    scale: str = "",
    said: str = "",
    actions: str = "",
    plot_height_m: float | None = None,
) -> str:
    """What the forester reads after clicking a trunk.

    Args:
        tree_id: Its number.
        result: The diameter, or why there is none.
        section: The picture of the cross-section, see `section_svg`.
        scale: What of the scale's error is in the interval, see `scale_words`.
        said: HTML under the number: what is to be decided, what a person said of it.
        actions: HTML of buttons that do what the remedy of a refusal says.
        plot_height_m: From `height_of_plot_m`: a diameter of another height says so.
    """
    title = _card_title(tree_id)
    if isinstance(result, Refusal):
        return (
            f'<div class="dbh dbh-card" data-tree="{tree_id}"><div class="dbh-number">{title}'
            f'<b class="none">no diameter</b></div>{said}'
            f'<div class="dbh-hint" data-level="stop">{esc(plain(result.reason))}'
            f"<br><b>What to do:</b> {esc(plain(result.remedy))}{actions}</div>{section}</div>"
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
        f"{said}{section}{f'<ul class=dbh-list>{flags}</ul>' if flags else ''}"
        f"{facts(_card_facts(result, plot_height_m))}"
        f"<details><summary>How it was measured</summary>{facts(_measuring_facts(result, scale))}</details></div>"
    )


def height_of_plot_m(result: DbhEstimate | Refusal, rules: MeasureSettings) -> float | None:
    """Where a plot's rules have this stem measured; None of a stem that has no diameter."""
    if isinstance(result, Refusal):
        return None
    curve = rules.curve if result.curve == DRAWN else result.curve
    height_m = middle_m(rules, curve)
    if rules.along == "stem":  # that is lower, counted vertically
        height_m -= rules.breast_height_m * (1.0 - math.cos(math.radians(result.section.lean_deg)))
    return height_m


def _card_facts(result: DbhEstimate, plot_height_m: float | None) -> list[tuple[str, str]]:
    """What one compares with the tree in the forest."""
    cut, girth = result.section, result.diameters["tape"]
    round_cm = [np.pi * value for value in (girth.value_cm, girth.low_cm, girth.high_cm) if value is not None]
    is_elsewhere = plot_height_m is not None and abs(cut.hom_m - plot_height_m) > _AS_GOOD_AS_THERE_M
    pairs = [
        ("Measured at", f"{cut.hom_m:.2f} m" + (f", not {plot_height_m:.2f} m as the plot" if is_elsewhere else "")),
        ("Tape round it", _in_brackets(round_cm) + " cm"),
        ("Ring seen", f"{cut.coverage_deg:.0f}°, largest gap {cut.max_gap_deg:.0f}°"),
    ]
    # An assumed axis tells nothing about the lean.
    if cut.axis_source == "stem":
        pairs.append(("Lean", f"{cut.lean_deg:.0f}°"))
    if result.taper_cm_per_m is not None:
        pairs.append(("Taper", f"{result.taper_cm_per_m:.1f} cm per metre"))
    return pairs


def _measuring_facts(result: DbhEstimate, scale: str) -> list[tuple[str, str]]:
    """How the diameter was read, and what it would be by another definition."""
    low, high = result.section.band_m
    method = "Ring drawn by hand" if result.curve == DRAWN else CURVE_TITLES.get(result.curve, result.curve)
    scatter = f"{result.rmse_mm:.1f} mm about the curve, " if np.isfinite(result.rmse_mm) else ""
    others = [f"{DEFINITION_TITLES[name]} {_with_range(diameter)}" for name, diameter in result.diameters.items()]
    return [
        ("Read from", f"{method}, {_definition(result)}"),
        ("Interval", f"90 %{scale}" if result.interval else "none: this method has none that is honest"),
        ("By definition", ", ".join(others)),
        ("Scatter", f"{scatter}{result.n_points:,} points"),
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
