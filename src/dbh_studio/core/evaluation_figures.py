"""The figures of an evaluation as SVG: estimated against reference, Tukey boxes of relative error, cross-sections.

Text that comes from a file is escaped. The pictures need no fonts, scripts or styles from elsewhere.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from dbh_studio.core.arrays import Bool, Float64
from dbh_studio.core.evaluation import Sample, TukeyBox, measured_arrays, relative_error_pct, tukey_box

# Told apart also by the colour-blind, and in print by their shapes.
_COLOURS = ("#d9480f", "#0b7285", "#a61e8c", "#2b8a3e", "#364fc7", "#5c3d2e", "#868e96")
_INK, _FAINT, _GRID = "#212529", "#868e96", "#e9ecef"
_PANEL, _LEFT, _BOTTOM, _TOP, _GAP = 300.0, 58.0, 48.0, 30.0, 26.0
_PER_ROW, _LEAST_BOX = 4, 46.0
_LEGEND = 22.0
_FONT = "system-ui,-apple-system,'Segoe UI',Roboto,'DejaVu Sans',sans-serif"
_MAX_DOTS = 900

Marks = Callable[[Sample], str]
"""Further attributes of a point, for pages in which it can be pressed; they are put in as they are."""


def scatter_svg(
    panels: Mapping[str, Sequence[Sample]],
    methods: Sequence[str],
    *,
    marks: Marks | None = None,
    is_fluid: bool = False,
) -> str:
    """Estimated against reference diameter with the 1:1 line, one panel for each category.

    Args:
        panels: Samples by title; only measured ones are drawn.
        methods: In the order of their colours.
        marks: See `Marks`.
        is_fluid: Leave its size to the page it is put in.
    """
    values = [v for samples in panels.values() for part in measured_arrays(samples)[:2] for v in part.tolist()]
    top = _nice_top(max(values, default=1.0))
    cells = []
    for k, (title, samples) in enumerate(panels.items()):
        frame = _Frame(*_place(k), (0.0, top), (0.0, top))
        measured = [s for s in samples if s.outcome == "measured"]
        body = [
            frame.axes(title, "Reference DBH (cm)", "Estimated DBH (cm)" if k % _PER_ROW == 0 else ""),
            f'<path d="M{frame.x(0):.1f} {frame.y(0):.1f}L{frame.x(top):.1f} {frame.y(top):.1f}" '
            f'stroke="{_INK}" stroke-dasharray="5 4" fill="none"/>',
            *(_interval_bar(frame, s, _colour(methods, s.method)) for s in measured if s.interval_cm),
            *(_dot(frame, s, methods, marks) for s in measured),
        ]
        cells.append("".join(body))
    return _document(cells, methods, "Estimated against reference diameter", is_fluid=is_fluid)


def boxes_svg(panels: Mapping[str, Sequence[Sample]], methods: Sequence[str]) -> str:
    """Tukey boxes of the relative error without sign, one panel for each category, one box for each method."""
    boxes = {title: _boxes(samples, methods) for title, samples in panels.items()}
    ends = [max((b.whiskers[1], *b.outliers)) for row in boxes.values() for b in row if b is not None]
    # A few wild values must not press all boxes flat; what lies above is counted at the edge.
    whiskers = [b.whiskers[1] for row in boxes.values() for b in row if b is not None]
    # An axis from 0 to 0 is none: where all errors are 0, as of a table against itself, it ends at 1 %.
    top = max(_nice_top(min(max(ends, default=10.0), 2.5 * max(whiskers, default=10.0))), 1.0)
    # So wide that what stands under a box does not run into that of the next.
    width = max(_PANEL, _LEAST_BOX * len(methods))
    cells = []
    for k, (title, row) in enumerate(boxes.items()):
        frame = _Frame(*_place(k, width), (0.0, float(len(methods))), (0.0, top), width)
        label = "Relative error (%)" if k % _PER_ROW == 0 else ""
        body = [frame.axes(title, "", label, x_ticks=False)]
        for column, (method, box) in enumerate(zip(methods, row, strict=True)):
            n = sum(s.method == method and s.outcome == "measured" for s in panels[title])
            body.append(_box(frame, column + 0.5, box, n, _colour(methods, method)))
        cells.append("".join(body))
    return _document(cells, methods, "Relative error", panel_px=width)


@dataclass(frozen=True, eq=False)
class SectionPicture:
    """One stem's cross-section with what was measured and what the reference says.

    Attributes:
        title: Whose.
        uv_m: (N, 2) points.
        inliers: (N,) those that support the chosen curve.
        outlines_uv_m: (M, 2) closed outlines by curve; the first is the chosen one.
        reference_cm: Diameter of the circle drawn for comparison.
    """

    title: str
    uv_m: Float64
    inliers: Bool
    outlines_uv_m: Mapping[str, Float64]
    reference_cm: float


def sections_svg(pictures: Sequence[SectionPicture]) -> str:
    """Cross-sections side by side: points, curves, and dashed a circle with the reference's diameter."""
    curves = tuple(dict.fromkeys(name for picture in pictures for name in picture.outlines_uv_m))
    cells = [_section(picture, k, curves) for k, picture in enumerate(pictures)]
    return _document(cells, curves, "Cross-sections", more=("reference",))


def _section(picture: SectionPicture, k: int, curves: Sequence[str]) -> str:
    chosen = next(iter(picture.outlines_uv_m.values()), picture.uv_m)
    centre = 0.5 * (chosen.min(axis=0) + chosen.max(axis=0))
    radius_m = picture.reference_cm / 200.0
    half = 1.25 * max(radius_m, 0.5 * float(np.ptp(chosen, axis=0).max()))
    frame = _Frame(*_place(k), (-100.0 * half, 100.0 * half), (-100.0 * half, 100.0 * half))
    step = max(1, math.ceil(len(picture.uv_m) / _MAX_DOTS))
    uv_cm, inliers = 100.0 * (picture.uv_m - centre)[::step], picture.inliers[::step]
    inside = (np.abs(uv_cm) < 100.0 * half).all(axis=1)
    # A curve that ran away is cut off at the edge, as every inner picture is.
    inner = f"{frame.left:.1f} {frame.top:.1f} {_PANEL:.0f} {_PANEL:.0f}"
    body = [
        frame.axes(picture.title, "cm", "", ticks=5),
        f'<svg x="{frame.left:.1f}" y="{frame.top:.1f}" width="{_PANEL:.0f}" height="{_PANEL:.0f}" viewBox="{inner}">',
    ]
    for colour, some in ((_FAINT, inside & ~inliers), ("#2b8a3e", inside & inliers)):
        dots = "".join(f"M{frame.x(u):.1f} {frame.y(v):.1f}h0" for u, v in uv_cm[some])
        body.append(f'<path d="{dots}" stroke="{colour}" stroke-width="2.4" stroke-linecap="round" opacity="0.6"/>')
    for name, outline in picture.outlines_uv_m.items():
        points = " ".join(f"{frame.x(u):.1f},{frame.y(v):.1f}" for u, v in 100.0 * (outline - centre))
        body.append(f'<polygon points="{points}" fill="none" stroke="{_colour(curves, name)}" stroke-width="2"/>')
    body.append(
        f'<circle cx="{frame.x(0):.1f}" cy="{frame.y(0):.1f}" r="{frame.x(100 * radius_m) - frame.x(0):.1f}" '
        f'fill="none" stroke="{_INK}" stroke-dasharray="5 4"/></svg>'
    )
    return "".join(body)


# ---- parts


@dataclass(frozen=True)
class _Frame:
    """A panel with its left upper corner at (left, top), and the numbers its edges stand for."""

    left: float
    top: float
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    width: float = _PANEL

    def x(self, value: float) -> float:
        low, high = self.x_range
        return self.left + self.width * (value - low) / (high - low)

    def y(self, value: float) -> float:
        low, high = self.y_range
        return self.top + _PANEL * (1.0 - (value - low) / (high - low))

    def axes(self, title: str, x_label: str, y_label: str, *, x_ticks: bool = True, ticks: int = 6) -> str:
        middle, bottom = self.left + 0.5 * self.width, self.top + _PANEL
        parts = [
            f'<rect x="{self.left:.1f}" y="{self.top:.1f}" width="{self.width:.0f}" height="{_PANEL:.0f}" fill="#fff" '
            f'stroke="{_FAINT}"/>',
            _text(middle, self.top - 9, title, size=14, weight=600),
            _text(middle, bottom + 38, x_label, size=12),
        ]
        if y_label:
            at = f"{self.left - 42:.1f} {self.top + 0.5 * _PANEL:.1f}"
            parts.append(f'<g transform="translate({at}) rotate(-90)">{_text(0, 0, y_label, size=12)}</g>')
        for value in _ticks(self.y_range, ticks):
            parts.append(self._rule(f"M{self.left:.1f} {self.y(value):.1f}h{self.width:.0f}"))
            parts.append(_text(self.left - 6, self.y(value) + 4, f"{value:g}", size=11, anchor="end"))
        for value in _ticks(self.x_range, ticks) if x_ticks else ():
            parts.append(self._rule(f"M{self.x(value):.1f} {self.top:.1f}v{_PANEL:.0f}"))
            parts.append(_text(self.x(value), bottom + 16, f"{value:g}", size=11))
        return "".join(parts)

    @staticmethod
    def _rule(path: str) -> str:
        return f'<path d="{path}" stroke="{_GRID}"/>'


def _place(k: int, width: float = _PANEL) -> tuple[float, float]:
    """Left upper corner of panel number k."""
    row, column = divmod(k, _PER_ROW)
    return _LEFT + column * (width + _GAP + 20.0), _LEGEND + _TOP + row * (_PANEL + _TOP + _BOTTOM)


def _document(
    cells: Sequence[str],
    names: Sequence[str],
    title: str,
    *,
    more: Sequence[str] = (),
    is_fluid: bool = False,
    panel_px: float = _PANEL,
) -> str:
    n_columns, n_rows = min(max(len(cells), 1), _PER_ROW), max(math.ceil(len(cells) / _PER_ROW), 1)
    width = _LEFT + n_columns * (panel_px + _GAP + 20.0) - 20.0
    height = _LEGEND + n_rows * (_PANEL + _TOP + _BOTTOM)
    legend, at = [], _LEFT
    for name in (*names, *more):
        shown = name if len(name) <= 40 else f"{name[:38]}…"
        colour = _colour(names, name) if name in names else _INK
        legend.append(f'<rect x="{at:.1f}" y="6" width="11" height="11" rx="2" fill="{colour}"/>')
        legend.append(_text(at + 16, 16, shown, size=12, anchor="start"))
        at += 34.0 + 7.0 * len(shown)
    width = max(width, at)
    size = "" if is_fluid else f'width="{width:.0f}" height="{height:.0f}" '
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" {size}role="img" '
        f'aria-label="{_clean(title)}" font-family="{_FONT}">'
        f'<rect width="100%" height="100%" fill="#fff"/>{"".join(legend)}{"".join(cells)}</svg>\n'
    )


def _dot(frame: _Frame, sample: Sample, methods: Sequence[str], marks: Marks | None) -> str:
    assert sample.reference_cm is not None and sample.estimated_cm is not None
    x, y, colour = frame.x(sample.reference_cm), frame.y(sample.estimated_cm), _colour(methods, sample.method)
    more = f" {marks(sample)}" if marks is not None else ""
    return (
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}" fill-opacity="0.65" stroke="#fff" '
        f'stroke-width="0.6"{more}><title>{_clean(sample_title(sample, with_method=len(methods) > 1))}</title></circle>'
    )


def sample_title(sample: Sample, *, with_method: bool = False) -> str:
    """One stem in a line: its numbers, both diameters and the error."""
    name = f"tree {sample.tree}" if sample.tree else "tree without number"
    stem = f" (stem {sample.stem})" if sample.stem and sample.stem != sample.tree else ""
    plot = f"plot {sample.plot}, " if sample.plot else ""
    method = f"{sample.method}: " if with_method else ""
    given = f"{sample.estimated_cm:.1f}" if sample.estimated_cm is not None else "no diameter"
    truth = f"{sample.reference_cm:.1f} cm" if sample.reference_cm is not None else "unknown"
    error = f", {sample.error_cm:+.1f} cm" if sample.error_cm is not None else ""
    return f"{method}{plot}{name}{stem}: {given} for {truth}{error}"


def _interval_bar(frame: _Frame, sample: Sample, colour: str) -> str:
    assert sample.interval_cm is not None and sample.reference_cm is not None
    low, high = (float(np.clip(end, *frame.y_range)) for end in sample.interval_cm)
    x = frame.x(sample.reference_cm)
    return f'<path d="M{x:.1f} {frame.y(low):.1f}V{frame.y(high):.1f}" stroke="{colour}" opacity="0.4"/>'


def _boxes(samples: Sequence[Sample], methods: Sequence[str]) -> list[TukeyBox | None]:
    boxes = []
    for method in methods:
        estimated, reference, _ = measured_arrays([s for s in samples if s.method == method])
        boxes.append(tukey_box(relative_error_pct(estimated, reference)))
    return boxes


def _box(frame: _Frame, column: float, box: TukeyBox | None, n: int, colour: str) -> str:
    centre = frame.x(column)
    half = 0.3 * (frame.x(1.0) - frame.x(0.0))
    half = min(half, 45.0)
    label = _text(centre, frame.y(0.0) + 16, f"n = {n}", size=11)
    if box is None:
        return label + _text(centre, frame.y(0.0) - 8, "too few", size=11, colour=_FAINT)
    top = frame.y_range[1]
    low, high, middle = (frame.y(min(v, top)) for v in (*box.quartiles, box.median))
    ends = [frame.y(min(v, top)) for v in box.whiskers]
    parts = [
        f'<path d="M{centre:.1f} {ends[0]:.1f}V{low:.1f}M{centre:.1f} {high:.1f}V{ends[1]:.1f}'
        f'M{centre - 0.5 * half:.1f} {ends[0]:.1f}h{half:.1f}M{centre - 0.5 * half:.1f} {ends[1]:.1f}h{half:.1f}" '
        f'stroke="{_INK}" fill="none"/>',
        f'<rect x="{centre - half:.1f}" y="{high:.1f}" width="{2 * half:.1f}" height="{max(low - high, 0.5):.1f}" '
        f'fill="{colour}" fill-opacity="0.35" stroke="{_INK}"><title>median {box.median:.1f} %, box '
        f"{box.quartiles[0]:.1f} to {box.quartiles[1]:.1f} %, whiskers {box.whiskers[0]:.1f} to "
        f"{box.whiskers[1]:.1f} %, {len(box.outliers)} beyond</title></rect>",
        f'<path d="M{centre - half:.1f} {middle:.1f}h{2 * half:.1f}" stroke="{_INK}" stroke-width="2.5"/>',
    ]
    seen = [value for value in box.outliers if value <= top]
    parts += [
        f'<circle cx="{centre:.1f}" cy="{frame.y(value):.1f}" r="2.6" fill="none" stroke="{colour}"/>' for value in seen
    ]
    if len(seen) < len(box.outliers):
        hidden = len(box.outliers) - len(seen)
        # Beside many others there is room for the farthest alone.
        told = f"▲ {hidden} more, up to " if frame.x(1.0) - frame.x(0.0) > 120.0 else "▲ "
        parts.append(_text(centre, frame.top + 13, f"{told}{box.outliers[-1]:.0f}", size=10))
    return label + "".join(parts)


def _colour(names: Sequence[str], name: str) -> str:
    return _COLOURS[list(names).index(name) % len(_COLOURS)]


def _text(
    x: float, y: float, text: str, *, size: int, anchor: str = "middle", weight: int = 400, colour: str = _INK
) -> str:
    if not text:
        return ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" font-weight="{weight}" text-anchor="{anchor}" '
        f'fill="{colour}">{_clean(text if len(text) <= 48 else text[:46] + "…")}</text>'
    )


def _clean(text: str) -> str:
    """Escaped, and without the characters that no XML may hold."""
    return escape(re.sub(r"[^\t\n\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "?", text), quote=True)


def _nice_step(span: float, count: int) -> float:
    raw = max(span, 1e-9) / count
    power = 10.0 ** math.floor(math.log10(raw))
    return next(m for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * power >= raw * (1 - 1e-9)) * power


def _nice_top(value: float) -> float:
    step = _nice_step(1.05 * value, 6)
    return step * math.ceil(1.05 * value / step)


def _ticks(limits: tuple[float, float], count: int) -> list[float]:
    low, high = limits
    step = _nice_step(high - low, count)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 10) + 0.0 for k in range(first, math.floor(high / step + 1e-9) + 1)]
