"""What the transfer section shows: the residuals of the walks as a picture, and both diameters of each tree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.app.transfer_report import (
    TreeComparison,
    WalkPicture,
    fit_text,
    scale_text,
    summary_of,
    summary_text,
)
from dbh_studio.core.arrays import Float64
from dbh_studio.ui import html
from dbh_studio.ui.bridge import call, esc

if TYPE_CHECKING:
    from dbh_studio.app.transfer_plot import TransferReport

_KEPT, _LEFT_OUT, _PATH = "#2b8a3e", "#c92a2a", "#868e96"
_SIZE, _MARGIN = 340, 16
_BARS, _BARS_HEIGHT = 24, 90
_LENGTHS_M = (100.0, 50.0, 20.0, 10.0, 5.0, 2.0, 1.0, 0.5)


def report_html(report: TransferReport) -> str:
    """How the clouds lie on each other, the scale, the notes, the picture and the table."""
    covered = report.covered
    level = "ok" if covered > 0.5 else "todo"
    parts = [html.message(fit_text(report), level=level)]
    lines = [] if report.scale is None else [("note", scale_text(report.scale, report.scale_change), "")]
    parts.append(html.findings([*lines, *(("note", note, "") for note in report.notes)]))
    if report.walk is not None:
        parts.append(walk_svg(report.walk))
    parts.append(html.message(summary_text(summary_of(report.trees)), level="ok"))
    parts.append(trees_html(report.trees))
    return "".join(parts)


def walk_svg(walk: WalkPicture) -> str:
    """The scanner's walk in plan with the camera's poses brought to it, and how far off these are."""
    target, placed, kept = walk.target_m, walk.placed_m, walk.kept
    if not len(target):
        return ""
    low, high = target[:, :2].min(axis=0), target[:, :2].max(axis=0)
    scale = (_SIZE - 2 * _MARGIN) / max(float((high - low).max()), 0.1)
    middle = 0.5 * (low + high)

    def pixels(points: Float64) -> Float64:
        flat = (points[:, :2] - middle) * scale
        return np.column_stack([0.5 * _SIZE + flat[:, 0], 0.5 * _SIZE - flat[:, 1]])

    path, dots = pixels(target), np.clip(pixels(placed), 0, _SIZE)
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in path)
    off = "".join(f"M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}" for (x, y), (u, v) in zip(path[~kept], dots[~kept], strict=True))
    n_out = int((~kept).sum())
    spots = "".join(
        f'<path d="{"".join(f"M{x:.1f} {y:.1f}h0" for x, y in dots[chosen])}" stroke="{colour}" stroke-width="4.5" '
        f'stroke-linecap="round" fill="none"/>'
        for colour, chosen in ((_LEFT_OUT, ~kept), (_KEPT, kept))
        if chosen.any()
    )
    legend = (
        f'<span><i style="background:{_KEPT}"></i>camera, used ({int(kept.sum())})</span>'
        + (f'<span><i style="background:{_LEFT_OUT}"></i>left out ({n_out})</span>' if n_out else "")
        + f'<span><i style="background:{_PATH}"></i>scanner</span>'
    )
    return (
        f'<div class="dbh"><svg class="dbh-section" data-poses="{len(kept)}" data-left-out="{n_out}" '
        f'viewBox="0 0 {_SIZE} {_SIZE}" role="img" aria-label="The two walks in plan">'
        f'<rect x="0.5" y="0.5" width="{_SIZE - 1}" height="{_SIZE - 1}" fill="none" stroke="#dee2e6"/>'
        f'<polyline points="{line}" fill="none" stroke="{_PATH}" stroke-width="1.5"/>'
        f'<path d="{off}" stroke="{_LEFT_OUT}" stroke-width="1" opacity="0.6"/>{spots}{_ruler(scale)}</svg>'
        f'<div class="dbh-legend"><div class="dbh-dots">{legend}</div></div>'
        f'<div class="muted">Misfit of the poses used, cm</div>{_histogram(100.0 * walk.distance_m[kept])}</div>'
    )


def _ruler(pixels_per_m: float) -> str:
    length_m = next((m for m in _LENGTHS_M if m * pixels_per_m < 0.35 * _SIZE), _LENGTHS_M[-1])
    y = _SIZE - 10
    return (
        f'<path d="M12 {y}h{length_m * pixels_per_m:.1f}" stroke="#343a40" stroke-width="3"/>'
        f'<text x="12" y="{y - 7}" font-size="15" font-family="sans-serif" fill="#343a40">{length_m:g} m</text>'
    )


def _histogram(misfits_cm: Float64) -> str:
    """Bars from 0 to the largest misfit, with the median marked."""
    if not len(misfits_cm):
        return ""
    largest = max(float(misfits_cm.max()), 0.1)
    counts, _ = np.histogram(misfits_cm, bins=_BARS, range=(0.0, largest))
    width, tall = _SIZE / _BARS, _BARS_HEIGHT - 20
    bars = "".join(
        f'<rect x="{i * width + 0.5:.1f}" y="{tall - tall * n / counts.max():.1f}" width="{width - 1:.1f}" '
        f'height="{tall * n / counts.max():.1f}" fill="{_KEPT}" opacity="0.75"/>'
        for i, n in enumerate(counts)
        if n
    )
    median = float(np.median(misfits_cm))
    at = _SIZE * median / largest
    side = "end" if at > 0.6 * _SIZE else "start"
    shift = -5 if side == "end" else 5
    return (
        f'<svg class="dbh-profile" viewBox="0 0 {_SIZE} {_BARS_HEIGHT}" role="img" aria-label="Misfit of the poses">'
        f'{bars}<path d="M{at:.1f} 0V{tall}" stroke="#343a40" stroke-width="1.5"/>'
        f'<text x="{at + shift:.1f}" y="14" font-size="14" font-family="sans-serif" text-anchor="{side}">median '
        f"{median:.1f}</text>"
        f'<text x="0" y="{_BARS_HEIGHT - 4}" font-size="14" font-family="sans-serif">0</text>'
        f'<text x="{_SIZE}" y="{_BARS_HEIGHT - 4}" font-size="14" font-family="sans-serif" text-anchor="end">'
        f"{largest:.1f}</text></svg>"
    )


def trees_html(trees: Sequence[TreeComparison]) -> str:
    """The two diameters side by side; a click on a row chooses the tree."""
    rows = "".join(_row(tree) for tree in trees)
    heads = "".join(f"<th>{text}</th>" for text in ("Tree", "Photo", "LiDAR", "Diff.", "%", "Apart"))
    return (
        '<div class="dbh"><div class="muted">Centimetres; click a row to see the tree.</div>'
        '<div class="dbh-scroll" tabindex="0"><table class="dbh-table" data-columns="even">'
        f"<thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div></div>"
    )


def _row(tree: TreeComparison) -> str:
    cells = (
        str(tree.stem_id),
        _number(tree.dbh_photo_cm, ".1f"),
        _number(tree.dbh_lidar_cm, ".1f"),
        _number(tree.difference_cm, "+.1f"),
        _number(tree.difference_pct, "+.1f"),
        _number(tree.centres_apart_cm, ".1f"),
    )
    shown = "".join(f"<td>{esc(cell)}</td>" for cell in cells)
    choose = call("row", tree.stem_id)
    return f'<tr data-carried="{tree.stem_id}" title="{esc(tree.remark)}" onclick="{choose}">{shown}</tr>'


def _number(value: float | None, form: str) -> str:
    return "–" if value is None or not math.isfinite(value) else format(value, form)
