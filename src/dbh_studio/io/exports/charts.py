"""The diameter distribution as SVG: stems of each class, by species."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dbh_studio.core.markup import markup
from dbh_studio.core.stand import StandTable
from dbh_studio.io.exports.pages import Words

# Told apart also by those who see no red or green, and in grey print (after Okabe and Ito).
_COLOURS = ("#2f6f4f", "#e69f00", "#56b4e9", "#b5543c", "#7d6aa8", "#8a8f94")
_OTHERS = "other species"
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _FOOT = 760.0, 280.0, 46.0, 12.0, 12.0, 44.0
_MOST_LABELS = 16


def distribution_svg(stand: StandTable) -> str:
    """Stems per area in each diameter class, species one on another; empty where no stem has a diameter."""
    edges = stand.class_edges
    if len(edges) < 2:
        return ""
    words = Words(stand.units)
    parts, names = _by_species(stand)
    heights = np.array(parts, np.float64)
    top = float(heights.sum(axis=0).max())
    if top <= 0:
        return ""
    step = _nice_step(top / 5)
    n_steps = int(np.ceil(top / step))
    high, wide = _HEIGHT - _TOP - _FOOT, _WIDTH - _LEFT - _RIGHT
    bar = wide / (len(edges) - 1)

    def y(value: float) -> float:
        return _TOP + high * (1 - value / (step * n_steps))

    drawn = [_opening(stand)]
    drawn += [
        f'<path d="M{_LEFT},{y(k * step):.1f}h{wide:.1f}" stroke="{"#888" if k == 0 else "#e3e6e3"}"/>'
        f'<text x="{_LEFT - 6}" y="{y(k * step) + 4:.1f}" text-anchor="end">{k * step:g}</text>'
        for k in range(n_steps + 1)
    ]
    for k in range(len(edges) - 1):
        below = 0.0
        for part, name, colour in zip(heights, names, _colours(names), strict=True):
            if part[k] > 0:
                tip = (
                    f"{edges[k]:g}–{edges[k + 1]:g} {words.diameter_unit}, {name}: {part[k]:.0f} per {words.area_unit}"
                )
                drawn.append(
                    f'<rect x="{_LEFT + k * bar + 0.08 * bar:.1f}" y="{y(below + part[k]):.1f}" '
                    f'width="{0.84 * bar:.1f}" height="{y(below) - y(below + part[k]):.1f}" fill="{colour}">'
                    f"<title>{markup(tip)}</title></rect>"
                )
            below += float(part[k])
    every = max(1, int(np.ceil(len(edges) / _MOST_LABELS)))
    drawn += [
        f'<text x="{_LEFT + k * bar:.1f}" y="{_TOP + high + 16:.1f}" text-anchor="middle">{edge:g}</text>'
        for k, edge in enumerate(edges)
        if k % every == 0
    ]
    drawn.append(
        f'<text x="{_LEFT + wide / 2:.1f}" y="{_HEIGHT - 8}" text-anchor="middle" fill="#555">diameter at breast '
        f"height, {words.diameter_unit}</text></svg>"
    )
    return "".join(drawn) + _legend(names, words)


def _opening(stand: StandTable) -> str:
    return (
        f'<svg class="chart" viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" role="img" aria-label="Diameter distribution: '
        f'{stand.total.n_stems - stand.total.n_refused} stems" font-family="sans-serif" font-size="12" fill="#222">'
    )


def _by_species(stand: StandTable) -> tuple[list[tuple[float, ...]], list[str]]:
    """Stems per area in each class, of the species with most basal area and of all others together."""
    shown = stand.rows[: len(_COLOURS) - 1]
    rest = stand.rows[len(_COLOURS) - 1 :]
    parts = [row.classes for row in shown]
    names = [row.species or "species not said" for row in shown]
    if rest:
        parts.append(tuple(np.sum([row.classes for row in rest], axis=0).tolist()))
        names.append(_OTHERS)
    return parts, names


def _colours(names: Sequence[str]) -> list[str]:
    return [_COLOURS[-1] if name == _OTHERS else _COLOURS[k % len(_COLOURS)] for k, name in enumerate(names)]


def _legend(names: Sequence[str], words: Words) -> str:
    if len(names) == 1:
        return f'<p class="legend">Stems per {words.area_unit} in each class.</p>'
    marks = "".join(
        f'<span><i style="background:{colour}"></i>{markup(name)}</span>'
        for name, colour in zip(names, _colours(names), strict=True)
    )
    return f'<p class="legend">Stems per {words.area_unit} in each class: {marks}</p>'


def _nice_step(value: float) -> float:
    """The next of 1, 2, 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(power * nice for nice in (1, 2, 5, 10) if power * nice >= value))
