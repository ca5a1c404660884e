"""The stem's diameters over height as an inline SVG: values, their 90 % intervals, and breast height."""

from __future__ import annotations

from collections.abc import Sequence

from dbh_studio.core.stem_profile import STEP_M, ProfilePoint

_WIDTH, _HEIGHT = 340, 170
_LEFT, _RIGHT, _TOP, _BOTTOM = 40, 10, 10, 26
_HALF_WORD = 24  # of the height beside the line
_CURVE, _HERE = "#1864ab", "#2b8a3e"


def profile_svg(profile: Sequence[ProfilePoint], *, height_m: float, tree_id: int | None = None) -> str:
    """The picture; empty with fewer than two diameters.

    Args:
        profile: From `core.stem_profile.stem_profile`.
        height_m: Breast height, which is marked.
        tree_id: Whose it is: breast height may then be dragged, see `section_tools.js`.
    """
    rows = [(point.height_m, point.diameter) for point in profile if point.diameter is not None]
    if len(rows) < 2:
        return ""
    ends = [end for _, diameter in rows for end in (diameter.low_cm, diameter.high_cm) if end is not None]
    values = [diameter.value_cm for _, diameter in rows]
    # An end of a hardly seen height must not squeeze all others.
    low, high = max(min([*ends, *values]), 0.6 * min(values)), min(max([*ends, *values]), 1.5 * max(values))
    bottom, top = min(rows[0][0], height_m), max(rows[-1][0], height_m)

    def x(height: float) -> float:
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * (height - bottom) / max(top - bottom, 0.1)

    def y(value_cm: float) -> float:
        inside = min(max(value_cm, low), high)
        return _HEIGHT - _BOTTOM - (_HEIGHT - _TOP - _BOTTOM) * (inside - low) / max(high - low, 0.1)

    bars = "".join(
        f"M{x(height):.1f} {y(diameter.low_cm):.1f}V{y(diameter.high_cm):.1f}"
        for height, diameter in rows
        if diameter.low_cm is not None and diameter.high_cm is not None
    )
    solid, dashed = _lines([height for height, _ in rows], [(x(h), y(diameter.value_cm)) for h, diameter in rows])
    text = 'font-size="12" font-family="sans-serif" fill="#495057"'
    return (
        f'<svg class="dbh-profile" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="Diameters along the stem">'
        f'<path data-intervals d="{bars}" stroke="{_CURVE}" stroke-width="3" opacity="0.35"/>'
        f'<path data-profile-unseen d="{dashed}" fill="none" stroke="{_CURVE}" stroke-dasharray="2 4"/>'
        f'<path data-profile d="{solid}" fill="none" stroke="{_CURVE}" stroke-width="2" stroke-linecap="round"/>'
        f"{_breast_height(x(height_m), height_m, f'{bottom:.4f} {top:.4f}', tree_id)}"
        f'<text x="2" y="{_TOP + 10}" {text}>{high:.0f} cm</text>'
        f'<text x="2" y="{_HEIGHT - _BOTTOM}" {text}>{low:.0f} cm</text>'
        f'<text x="{_LEFT}" y="{_HEIGHT - 8}" {text}>{bottom:.1f} m</text>'
        f'<text x="{_WIDTH - _RIGHT}" y="{_HEIGHT - 8}" text-anchor="end" {text}>{top:.1f} m above ground</text>'
        "</svg>"
    )


def _lines(heights_m: Sequence[float], pixels: Sequence[tuple[float, float]]) -> tuple[str, str]:
    """SVG paths of what was measured, a dot where that is one height alone, and of what is between: no diameter."""
    solid, dashed = "M{:.1f} {:.1f}h0".format(*pixels[0]), ""
    for k in range(1, len(pixels)):
        before, here = ("{:.1f} {:.1f}".format(*pixels[end]) for end in (k - 1, k))
        if heights_m[k] - heights_m[k - 1] < 1.5 * STEP_M:
            solid += f"L{here}"
        else:
            solid += f"M{here}h0"
            dashed += f"M{before}L{here}"
    return solid, dashed


def _breast_height(x_px: float, height_m: float, ends_m: str, tree_id: int | None) -> str:
    """The line at breast height; with a grip where it may be dragged."""
    below_words = _TOP + 6
    line = f'<path d="M{x_px:.1f} {below_words}V{_HEIGHT - _BOTTOM}" stroke="{_HERE}" stroke-dasharray="4 3"/>'
    if tree_id is None:
        return line
    # At an end its words would lie on those of the axis, or beyond the picture.
    near_left, near_right = x_px < _LEFT + _HALF_WORD, x_px > _WIDTH - _RIGHT - _HALF_WORD
    anchor, x_words = ("start", x_px + 4) if near_left else ("end", x_px - 4) if near_right else ("middle", x_px)
    return (
        f'<g data-height-grip data-tree="{tree_id}" data-height="{height_m:.3f}" data-x="{x_px:.1f}" '
        f'data-scale="{_LEFT} {_WIDTH - _RIGHT} {ends_m}" style="cursor:ew-resize"><title>Drag breast height of this '
        f'tree</title><path d="M{x_px:.1f} {_TOP}V{_HEIGHT - _BOTTOM}" stroke="#fff" stroke-opacity="0" '
        f'stroke-width="22"/>{line}<circle cx="{x_px:.1f}" cy="{_HEIGHT - _BOTTOM}" r="7" fill="{_HERE}"/>'
        f'<text x="{x_words:.1f}" y="{_TOP + 2}" text-anchor="{anchor}" font-size="12" font-family="sans-serif" '
        f'fill="{_HERE}">{height_m:.2f} m</text></g>'
    )
