"""The pages of the stems: section, interval, what to look at, what was said and corrected, and photographs."""

from __future__ import annotations

import base64
from collections.abc import Iterator

from dbh_studio.core.drawn_ring import DRAWN
from dbh_studio.core.inventory import InventoryRow
from dbh_studio.core.markup import markup
from dbh_studio.core.section_drawing import CURVE_TITLES, section_drawing
from dbh_studio.core.tree_record import TreeRecord
from dbh_studio.io.exports.edit_log import CORRECTION_TITLES, correction_words
from dbh_studio.io.exports.pages import Words, facts, html_table
from dbh_studio.io.exports.report_model import Report, StemPage

_REVIEWS = {
    "accepted": "accepted",
    "doubtful": "doubtful: to be looked at again",
    "stale": "its number has moved since it was looked at",
}
_DEFINITIONS = {
    "tape": "as a tape reads it: convex girth / π",
    "curve": "perimeter / π",
    "area": "of the circle of equal area",
}


def badge(state: str) -> str:
    """A quality or a review as a coloured word."""
    return f'<span class="badge {state}">{markup(state)}</span>' if state else ""


def stem_pages(report: Report, words: Words) -> str:
    """The section with all stems."""
    made = "".join(_stem(page, words) for page in report.pages)
    return f'<section class="page" id="stems"><h2>Stems</h2>{made or "<p>There are no stems.</p>"}</section>\n'


def _stem(page: StemPage, words: Words) -> str:
    row = page.row
    names = [f"Stem {row.stem_id}", f"tree {row.tree_id}" if row.tree_id != row.stem_id else "", row.species]
    names.append(f"tag {row.tag}" if row.tag else "")
    title = markup(" · ".join(filter(None, names)))
    ends = words.interval(row)
    if row.dbh_cm is None:
        number = '<span class="dbh warn">no diameter</span>'
    else:
        interval = f" <small>90 %: {ends}</small>" if row.dbh_lo_cm is not None else " <small>no interval</small>"
        number = f'<span class="dbh">{words.diameter(row.dbh_cm, unit=True)}{interval}</span>'
    picture = section_drawing(page.result, curve=page.curve, inches=words.units == "imperial")
    drawn = picture or '<div class="none">There is no cross-section to show.</div>'
    return (
        f'<article class="stem" id="stem-{row.stem_id}"><header><h3>{title}</h3>{badge(row.quality)}'
        f'{badge(row.review)}{number}</header><div class="cols"><div>{drawn}</div><div>'
        f"{facts(stem_facts(page.row, page.record, words))}</div></div>{_corrections(page, words)}{_photos(page)}"
        "</article>\n"
    )


def stem_facts(row: InventoryRow, record: TreeRecord, words: Words) -> Iterator[tuple[str, str]]:
    """What is known of a stem and what was said of it, as names and values; some values are empty."""
    if row.dbh_cm is None:
        yield "Why", row.reason
        yield "What would help", row.remedy
    else:
        is_drawn = row.dbh_method == DRAWN
        curve = "Ring drawn by hand" if is_drawn else CURVE_TITLES.get(row.dbh_method, row.dbh_method)
        yield "Read from", f"{curve}, {_DEFINITIONS.get(row.dbh_definition, row.dbh_definition)}"
        yield "To look at", row.reason
    if row.hom_m is not None:
        yield "Height", f"{words.height(row.hom_m, unit=True)} above the ground"
    if row.coverage_deg is not None:
        gap = f", largest gap {row.max_gap_deg:.0f}°" if row.max_gap_deg is not None else ""
        yield "Seen", f"{row.coverage_deg:.0f}° of the ring{gap}"
    if row.rmse_mm is not None and row.n_points is not None:
        yield "Scatter", f"{row.rmse_mm:.1f} mm about the curve, {row.n_points:,} points"
    if row.lean_deg is not None:
        yield "Lean", f"{row.lean_deg:.0f}°"
    if row.field_tape_cm is not None:
        at = f" at {words.height(row.field_tape_height_m, unit=True)}" if row.field_tape_height_m is not None else ""
        yield "Tape in the field", f"{words.diameter(row.field_tape_cm, unit=True)}{at}"
    yield from (("Status", row.status), ("Health", row.health), ("Crown class", row.crown_class), ("Note", row.note))
    yield from record.fields
    if row.review:
        review = record.review
        who = ", ".join(filter(None, (review.who, _day(review.when)))) if review is not None else ""
        yield "Review", _REVIEWS.get(row.review, row.review) + (f" ({who})" if who else "")
    if row.x_m is not None and row.y_m is not None:
        place = f"x {row.x_m:.2f} m, y {row.y_m:.2f} m"
        if row.easting is not None and row.northing is not None:
            system = f", EPSG:{row.epsg}" if row.epsg is not None else ""
            place += f"\neasting {row.easting:.2f}, northing {row.northing:.2f}{system}"
        yield "Place", place
    if row.edited:
        yield "Points", "changed by hand"


def _corrections(page: StemPage, words: Words) -> str:
    """What was decided about this stem's measurement, by whom, when and why."""
    if not page.record.corrections:
        return ""
    rows = [
        [
            markup(CORRECTION_TITLES.get(each.kind, each.kind)),
            markup(correction_words(each, words)),
            markup(each.who),
            markup(_day(each.when)),
            markup(each.why),
        ]
        for each in page.record.corrections
    ]
    return html_table(("Corrected", "To", "By", "On", "Why"), rows)


def _day(when: str) -> str:
    return when[:16].replace("T", " ")


def _photos(page: StemPage) -> str:
    if not page.pictures:
        return f'<p class="soft">{markup(page.picture_note)}</p>' if page.picture_note else ""
    figures = "".join(
        f'<figure><img alt="Photograph of stem {page.row.stem_id}" src="data:image/jpeg;base64,'
        f'{base64.b64encode(each.jpeg).decode("ascii")}"><figcaption>{markup(each.words)}</figcaption></figure>'
        for each in page.pictures
    )
    return f'<div class="photos">{figures}</div>'
