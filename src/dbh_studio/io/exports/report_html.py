"""The report: one HTML file that needs nothing beside it, reads without scripts and prints on A4."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from importlib import resources
from pathlib import Path

from dbh_studio.core.inventory import InventoryRow
from dbh_studio.core.markup import markup
from dbh_studio.core.stand import ACRE_M2, HECTARE_M2, StandTable
from dbh_studio.io.exports.charts import distribution_svg
from dbh_studio.io.exports.columns import written_whole
from dbh_studio.io.exports.pages import NOT_KNOWN, Words, document, facts, html_table
from dbh_studio.io.exports.report_model import Report
from dbh_studio.io.exports.report_stems import badge, stem_pages
from dbh_studio.io.exports.stem_map import stem_map_svg

# The whole log goes beside the report; a page holds about fifty lines of it.
_MOST_LOG_LINES = 400
_REVIEWS = (("accepted", "accepted"), ("doubtful", "doubtful"), ("stale", "to be looked at again"))


def write_report_html(path: Path | str, report: Report) -> Path:
    """Write the report.

    Raises:
        FileError: It cannot be written.
    """
    path = Path(path)
    with written_whole(path) as file:
        file.write(report_html(report).encode("utf-8", errors="replace"))
    return path


def report_html(report: Report) -> str:
    """The whole page."""
    style = resources.files("dbh_studio.io.exports").joinpath("report.css").read_text(encoding="utf-8")
    words = Words(report.table.units)
    parts = [
        _cover(report, words),
        _map(report),
        _stand(report, words),
        _inventory(report, words),
        _refused(report),
        stem_pages(report, words),
        _log(report),
        _method(report),
    ]
    return document(f"{report.title} – stem inventory", style, "".join(filter(None, parts)))


def _section(name: str, title: str, body: str, *, on_new_page: bool = True) -> str:
    kind = ' class="page"' if on_new_page else ""
    return f'<section{kind} id="{name}"><h2>{title}</h2>{body}</section>\n'


def _cover(report: Report, words: Words) -> str:
    inventory, total = report.inventory, report.stand.total
    n_trees = len({row.tree_id for row in inventory})
    tiles = [
        (str(len(inventory)), "stems" + (f" of {n_trees} trees" if n_trees != len(inventory) else "")),
        (f"{total.stems_per_area:,.0f}", f"stems per {words.area_unit}"),
        (_number(total.basal_area), f"{words.basal_unit} basal area"),
        (_number(total.qmd), f"{words.diameter_unit} quadratic mean diameter"),
    ]
    boxes = "".join(f"<div><b>{value}</b><span>{name}</span></div>" for value, name in tiles)
    links = " ".join(
        f'<a href="#{name}">{title}</a>'
        for name, title in (
            ("map", "Stem map"), ("stand", "Stand table"), ("inventory", "Inventory"), ("stems", "Stems"),
            ("log", "Edit log"), ("method", "How it was computed"),
        )
    )  # fmt: skip
    counts = [
        ("Measured", f"{inventory.n_measured} of {len(inventory)} stems"),
        ("Without a diameter", _refused_words(inventory.n_refused)),
        ("Reviewed", _reviewed(report)),
        ("Plot area", area_words(report)),
        # The figures per area above are of these.
        ("Counted", "" if total.n_stems == len(inventory) else f"{total.n_stems} of {len(inventory)} stems, see below"),
    ]
    return (
        f'<section><p class="over">Stem inventory</p><h1>{markup(report.title)}</h1>'
        f'<p class="soft">{markup(report.made)}</p><div class="tiles">{boxes}</div>'
        f"{facts([*counts, *report.facts])}<nav>{links}</nav></section>\n"
    )


def _number(value: float | None) -> str:
    return NOT_KNOWN if value is None else f"{value:,.1f}"


def _refused_words(n_refused: int) -> str:
    return "none" if not n_refused else f"{n_refused}; each is listed with the reason and a remedy"


def _reviewed(report: Report) -> str:
    states = Counter(row.review for row in report.inventory)
    n_reviewed = sum(states[state] for state, _ in _REVIEWS)
    if not n_reviewed:
        return "none yet"
    parts = [f"{states[state]} {words}" for state, words in _REVIEWS if states[state]]
    return f"{n_reviewed} of {len(report.inventory)}: {', '.join(parts)}"


def area_words(report: Report) -> str:
    """The area of the plot, and how it was given."""
    area = report.area
    kinds = {
        "circle": "circle",
        "polygon": "polygon",
        "extent": "rectangle around the cloud: mostly more than the plot that was laid out",
    }
    kind = kinds[area.kind]
    if area.radius_m is not None:
        kind += f", radius {Words(report.table.units).height(area.radius_m, unit=True)}"
    if report.table.units == "metric":
        return f"{area.area_m2:,.0f} m² = {area.area_m2 / HECTARE_M2:.4f} ha, horizontal ({kind})"
    return f"{area.area_m2 / ACRE_M2:.4f} acre, horizontal ({kind})"


def _map(report: Report) -> str:
    drawn = stem_map_svg(report.table, area=report.area, north=report.north, links=True)
    words = markup(f"Each stem with its number; {report.north.words}. Stems outside the outline are not in the stand.")
    return _section("map", "Stem map", f'<div class="map">{drawn}</div><p class="soft">{words}</p>')


def _stand(report: Report, words: Words) -> str:
    stand = report.stand
    if not stand.total.n_stems:
        return _section("stand", "Stand table", "<p>No stem of the plot is counted.</p>" + _stand_notes(stand, words))
    return _section("stand", "Stand table", _sums(stand, words) + _stand_notes(stand, words) + _classes(stand, words))


def _sums(stand: StandTable, words: Words) -> str:
    per, unit = words.area_unit, words.diameter_unit
    head = (
        "Species", "Trees", "Stems", "Without diameter", f"Stems/{per}", f"Basal area {words.basal_unit}",
        f"Quadratic mean {unit}", f"Mean {unit}", f"Smallest {unit}", f"Largest {unit}",
    )  # fmt: skip
    rows = []
    for row in (*stand.rows, stand.total):
        name = "All" if row is stand.total else markup(row.species) or "not said"
        sums = (row.basal_area, row.qmd, row.mean, row.least, row.greatest)
        counts = (row.n_trees, row.n_stems, row.n_refused)
        rows.append([name, *map(str, counts), f"{row.stems_per_area:,.0f}", *map(_number, sums)])
    return f'<div class="wide">{html_table(head, rows, numeric=range(1, 10), kind="total")}</div>'


def _classes(stand: StandTable, words: Words) -> str:
    picture = distribution_svg(stand)
    if not picture:
        return "<p>No stem of the plot has a diameter.</p>"
    names = [row.species or "not said" for row in stand.rows]
    head = [f"Class {words.diameter_unit}", *(markup(name) for name in names), "All"]
    rows = [
        [f"{low:g}–{high:g}", *(f"{row.classes[k]:,.0f}" for row in (*stand.rows, stand.total))]
        for k, (low, high) in enumerate(zip(stand.class_edges, stand.class_edges[1:], strict=False))
    ]
    table = html_table(head, rows, numeric=range(1, len(head)))
    return (
        f"<h3>Diameter distribution</h3>{picture}"
        f'<h3>Stems per {words.area_unit} in each class</h3><div class="wide">{table}</div>'
    )


def _stand_notes(stand: StandTable, words: Words) -> str:
    total = stand.total
    notes = [
        "A stem belongs to the plot if its centre at breast height does. Area is horizontal. Classes hold their lower "
        "end and not their upper.",
    ]
    if total.n_refused:
        notes.append(
            f"{total.n_refused} of {total.n_stems} stems have no diameter: they count among the stems; basal area and "
            "mean diameters are those of the others."
        )
    if stand.least_dbh_cm > 0:
        least = words.diameter(stand.least_dbh_cm, unit=True)
        notes.append(f"Stems thinner than {least} are not in this table: {stand.n_thin} of those inside the plot.")
    if stand.n_outside:
        notes.append(f"{stand.n_outside} stems stand outside the plot or have no place; they are not in this table.")
    return "".join(f'<p class="soft">{note}</p>' for note in notes)


def _inventory(report: Report, words: Words) -> str:
    rows = list(report.inventory)
    has_trees = any(row.tree_id != row.stem_id for row in rows)
    has_tags, has_tape = any(row.tag for row in rows), any(row.field_tape_cm is not None for row in rows)
    has_reviews = any(row.review for row in rows)
    # Each column: heading, whether it is right-aligned, whether the table has it, its cells.
    columns: list[tuple[str, bool, bool, Callable[[InventoryRow], str]]] = [
        ("Stem", True, True, lambda row: f'<a href="#stem-{row.stem_id}">{row.stem_id}</a>'),
        ("Tree", True, has_trees, lambda row: str(row.tree_id)),
        ("Tag", False, has_tags, lambda row: markup(row.tag)),
        ("Species", False, any(row.species for row in rows), lambda row: markup(row.species)),
        ("Status", False, any(row.status for row in rows), lambda row: markup(row.status)),
        (f"DBH {words.diameter_unit}", True, True, lambda row: words.diameter(row.dbh_cm)),
        ("90 % interval", True, True, lambda row: f'<span class="whole">{words.interval(row)}</span>'),
        (f"Tape {words.diameter_unit}", True, has_tape, lambda row: words.diameter(row.field_tape_cm)),
        (f"Height {words.height_unit}", True, True, lambda row: words.height(row.hom_m)),
        ("Arc °", True, True, lambda row: NOT_KNOWN if row.coverage_deg is None else f"{row.coverage_deg:.0f}"),
        ("Quality", False, True, lambda row: badge(row.quality)),
        ("Reviewed", False, has_reviews, lambda row: badge(row.review)),
        ("Remarks", False, True, _remarks),
    ]
    shown = [column for column in columns if column[2]]
    numeric = [k for k, (_, is_number, _, _) in enumerate(shown) if is_number]
    cells = [[cell(row) for _, _, _, cell in shown] for row in rows]
    table = html_table([name for name, _, _, _ in shown], cells, numeric=numeric, kind="many")
    return _section("inventory", "Inventory", f'<div class="wide">{table}</div>')


def _remarks(row: InventoryRow) -> str:
    said = [row.note, "measured otherwise" if row.corrections else "", "" if row.dbh_cm is None else row.reason]
    return markup("; ".join(filter(None, said)))


def _refused(report: Report) -> str:
    refused = [row for row in report.inventory if row.dbh_cm is None]
    if not refused:
        return ""
    rows = [
        [f'<a href="#stem-{row.stem_id}">{row.stem_id}</a>', markup(row.reason), markup(row.remedy)] for row in refused
    ]
    table = html_table(("Stem", "Why there is no diameter", "What would give one"), rows, numeric=(0,))
    return _section("refused", "Stems without a diameter", table, on_new_page=False)


def _log(report: Report) -> str:
    if not report.log:
        return _section("log", "Edit log", "<p>Nothing was noted about this plot.</p>")
    shown = report.log[-_MOST_LOG_LINES:]
    rows = [
        [
            markup(entry.when.replace("T", " ").replace("+00:00", "")),
            markup(entry.who),
            markup(entry.what) if entry.stem_id is None else _about_stem(entry.stem_id, entry.what),
            markup("; ".join(filter(None, (entry.value, entry.why)))),
        ]
        for entry in shown
    ]
    more = ""
    if len(shown) < len(report.log):
        more = f"<p>The last {len(shown):,} of {len(report.log):,} entries; the table of edits has all.</p>"
    table = html_table(("When (UTC)", "Who", "What", "Value, reason"), rows)
    return _section("log", "Edit log", more + table)


def _about_stem(stem_id: int, what: str) -> str:
    return f'{markup(what)}, stem <a href="#stem-{stem_id}">{stem_id}</a>'


def _method(report: Report) -> str:
    parts = [facts(report.versions)]
    for title, pairs in report.settings:
        table = html_table(("Setting", "Value"), [[markup(name), markup(value)] for name, value in pairs])
        parts.append(f"<h3>{markup(title)}</h3>{table}")
    return _section("method", "How it was computed", "".join(parts))
