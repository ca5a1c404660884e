"""Lengths as people type them."""

from __future__ import annotations

import re

from dbh_studio.errors import CommandError

_SHORTEST_M, _LONGEST_M = 0.001, 10_000.0
_UNITS_M = {"": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254}
_LENGTH = re.compile(r"([+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+))\s*([a-z]*)", re.ASCII | re.IGNORECASE)


def metres_from_text(text: str, what: str) -> float:
    """A length: ``1.37``, ``1,37``, ``137 cm``, ``4 ft``; metres where no unit is given.

    Raises:
        CommandError: It is no length, or none that can be; `what` says of what.
    """
    match = _LENGTH.fullmatch(text.strip())
    if match is None or match[2].lower() not in _UNITS_M:
        shown = text.strip()[:40]
        problem = f"{what} was not understood: {shown!r}." if shown else f"{what} is missing."
        raise CommandError(problem, "Type it in metres, such as 1.00 or 1,37.")
    value_m = float(match[1].replace(",", ".")) * _UNITS_M[match[2].lower()]
    check_length(value_m, what)
    return value_m


def check_length(value_m: float, what: str) -> None:
    """Raise CommandError unless a length on a plot can be `value_m`; `what` says of what, with an article."""
    if not _SHORTEST_M <= value_m <= _LONGEST_M:
        raise CommandError(f"{what} cannot be {value_m:g} m.", "Give it in metres, above 0.")
