"""What the pages that are handed in share: a document that fetches nothing, and numbers in the units asked for."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from dbh_studio.core.inventory import InventoryRow
from dbh_studio.core.markup import markup
from dbh_studio.core.stand import CM_PER_INCH, Units
from dbh_studio.io.column_names import M_PER_FOOT

NOT_KNOWN = "–"


@dataclass(frozen=True)
class Words:
    """Lengths as words, in one system of units."""

    units: Units = "metric"

    @property
    def diameter_unit(self) -> str:
        """Of diameters."""
        return "cm" if self.units == "metric" else "in"

    @property
    def height_unit(self) -> str:
        """Of heights."""
        return "m" if self.units == "metric" else "ft"

    @property
    def area_unit(self) -> str:
        """Of the plot."""
        return "ha" if self.units == "metric" else "acre"

    @property
    def basal_unit(self) -> str:
        """Of basal area."""
        return "m²/ha" if self.units == "metric" else "ft²/acre"

    def diameter(self, value_cm: float | None, *, unit: bool = False) -> str:
        """A diameter to a millimetre, or a hundredth of an inch; a dash where it is not known."""
        if value_cm is None:
            return NOT_KNOWN
        text = f"{value_cm:.1f}" if self.units == "metric" else f"{value_cm / CM_PER_INCH:.2f}"
        return f"{text} {self.diameter_unit}" if unit else text

    def interval(self, row: InventoryRow) -> str:
        """The 90 % interval; a dash where there is none."""
        if row.dbh_lo_cm is None or row.dbh_hi_cm is None:
            return NOT_KNOWN
        return f"{self.diameter(row.dbh_lo_cm)}–{self.diameter(row.dbh_hi_cm)}"

    def height(self, value_m: float | None, *, unit: bool = False) -> str:
        """A height to a centimetre, or a hundredth of a foot; a dash where it is not known."""
        if value_m is None:
            return NOT_KNOWN
        text = f"{value_m:.2f}" if self.units == "metric" else f"{value_m / M_PER_FOOT:.2f}"
        return f"{text} {self.height_unit}" if unit else text


def document(title: str, style: str, body: str, *, script: str = "") -> str:
    """An HTML page that fetches nothing from anywhere and, without `script`, runs nothing.

    Args:
        title: As text.
        style: CSS of ours.
        body: HTML, escaped already.
        script: JavaScript of ours.
    """
    scripts = "script-src 'unsafe-inline'; " if script else ""
    policy = (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; {scripts}base-uri 'none'; form-action 'none'"
    )
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{markup(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n{body}\n"
        + (f"<script>\n{script}</script>\n" if script else "")
        + "</body>\n</html>\n"
    )


def data_block(name: str, value: Any) -> str:
    """A value for a script of the page, under the id `name`; nothing in it can end the element."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{text}</script>'


def html_table(
    head: Sequence[str], rows: Iterable[Sequence[str]], *, numeric: Iterable[int] = (), kind: str = ""
) -> str:
    """A table; its cells are HTML already."""
    right = set(numeric)

    def line(cells: Sequence[str], tag: str) -> str:
        made = (f"<{tag}{' class=n' if k in right else ''}>{cell}</{tag}>" for k, cell in enumerate(cells))
        return f"<tr>{''.join(made)}</tr>"

    body = "".join(line(cells, "td") for cells in rows)
    return f'<table class="{kind}"><thead>{line(head, "th")}</thead><tbody>{body}</tbody></table>'


def facts(pairs: Iterable[tuple[str, str]]) -> str:
    """Names and values one below the other; the values are text."""
    made = "".join(f"<dt>{markup(name)}</dt><dd>{markup(value)}</dd>" for name, value in pairs if value)
    return f"<dl>{made}</dl>" if made else ""
