"""`dbh-studio evaluate`: diameters against those measured in the field."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dbh_studio.cli.common import finite_number, path_argument, plain
from dbh_studio.errors import SettingError, StudioError

if TYPE_CHECKING:
    from dbh_studio.app.evaluation import EvaluationRequest
    from dbh_studio.core.comparison import Comparison
    from dbh_studio.core.evaluation_figures import SectionPicture
    from dbh_studio.io.table_columns import Reading

_UNITS = ("cm", "m", "mm", "in")


def add_commands(commands: Any) -> None:
    """Register the command."""
    evaluate = commands.add_parser(
        "evaluate",
        help="compare inventories with diameters measured in the field",
        description="Compare inventories with a reference: bias, scatter, relative error, what was missed and refused, "
        "for each method and category, as a table and figures. Any table of trees will do (CSV, semicolons, tabs): "
        "columns, units and frames are found out and told, and can be named where the guess is wrong. Stems are paired "
        "by number or by place.",
    )
    evaluate.add_argument(
        "tables", type=path_argument, nargs="+", metavar="TABLE", help="one or more inventories, and last the reference"
    )
    evaluate.add_argument(
        "--out", type=path_argument, metavar="DIR", help="write table, pairs and figures there; else only print"
    )
    evaluate.add_argument(
        "--by",
        action="append",
        default=[],
        metavar="COLUMN",
        help="also tell stems apart by a column of the reference or the inventory; COLUMN:180,270 makes classes; "
        "inventory is the file, reference_cm the reference diameter; may be given several times",
    )
    evaluate.add_argument(
        "--pool",
        action="store_true",
        help="take several inventories for samples of one thing, such as flights, not for rival methods",
    )
    pairing = evaluate.add_argument_group("pairing")
    pairing.add_argument(
        "--match",
        choices=("auto", "id", "position"),
        default="auto",
        help="pair stems by number or by place; by default by number where the places agree with it, else by place",
    )
    pairing.add_argument(
        "--distance", type=finite_number, default=1.0, metavar="M", help="stems farther apart are never the same (1 m)"
    )
    pairing.add_argument(
        "--same-frame", action="store_true", help="take the places as they are: never turn or shift one table"
    )
    pairing.add_argument(
        "--combine-stems", action="store_true", help="join stems with one number into a tree of √Σd², in all tables"
    )
    reading = evaluate.add_argument_group("reading the tables")
    for which, what in (("inventory", "the inventories"), ("reference", "the reference")):
        reading.add_argument(
            f"--{which}-column",
            action="append",
            default=[],
            metavar="ROLE=NAME",
            help=f"column of {what}; roles are id, plot, x, y, dbh, low and high (ends of an interval); - "
            "is no column" + ("; dbh may be given several times, for several methods" if which == "inventory" else ""),
        )
        reading.add_argument(f"--{which}-unit", choices=_UNITS, help=f"unit of the diameters of {what}")
    evaluate.add_argument(
        "--plot", type=path_argument, metavar="NAME.dbh", help="the saved plot of the inventory, to draw cross-sections"
    )
    evaluate.add_argument("--overwrite", action="store_true", help="replace files of others in --out")
    evaluate.add_argument("--json", action="store_true", help="print JSON")
    evaluate.set_defaults(command=evaluate_tables)


def evaluate_tables(options: argparse.Namespace) -> int:
    """Read, pair, print, write."""
    from dbh_studio.app.evaluation import evaluate_files, record, write_report

    request = _request(options)
    comparison = evaluate_files(request)
    pictures = _pictures(options, comparison)
    if options.out is not None:
        write_report(comparison, options.out, pictures=pictures, sources=options.tables, overwrite=options.overwrite)
    if options.json:
        print(json.dumps(record(comparison), indent=2, allow_nan=False))
        return 0
    _print(comparison)
    if options.out is not None:
        print(plain(f"\nTable, pairs and figures: {options.out} (begin with report.md)"))
    return 0


def _request(options: argparse.Namespace) -> EvaluationRequest:
    from dbh_studio.app.evaluation import EvaluationRequest
    from dbh_studio.core.comparison import Grouping
    from dbh_studio.core.stem_layout import PairingRule

    if len(options.tables) < 2:
        raise SettingError("One table is not enough.", "Name the inventories first and the reference last.")
    if options.distance <= 0:
        raise SettingError(f"--distance {options.distance:g}: it must be above zero.", "")
    if options.plot is not None and options.out is None:
        raise SettingError("--plot was given without --out.", "Say where the cross-sections shall go: --out DIR.")
    by = tuple(dict.fromkeys(Grouping.parse(text) for text in options.by))
    if len({grouping.column for grouping in by}) < len(by):
        raise SettingError("--by names a column twice.", "Give each column once.")
    return EvaluationRequest(
        options.tables[-1],
        tuple(options.tables[:-1]),
        by,
        PairingRule(options.match, options.distance, "never" if options.same_frame else "auto"),
        _reading(options.inventory_column, options.inventory_unit, by_tree=options.combine_stems, find_methods=True),
        _reading(options.reference_column, options.reference_unit, by_tree=options.combine_stems),
        combine_stems=options.combine_stems,
        pool=options.pool,
    )


def _reading(assignments: list[str], unit: Any, *, by_tree: bool, find_methods: bool = False) -> Reading:
    from dbh_studio.io.table_columns import Reading

    columns: dict[str, str] = {}
    diameters: list[str] = []
    for assignment in assignments:
        role, equals, name = assignment.partition("=")
        if not equals or not name.strip():
            raise SettingError(f"{assignment}: expected ROLE=NAME.", "For example dbh=DIA.")
        if role == "dbh" and find_methods:
            diameters.append(name)
        else:
            columns[role] = name
    return Reading(columns, unit, tuple(diameters), by_tree, find_methods)


def _pictures(options: argparse.Namespace, comparison: Comparison) -> tuple[SectionPicture, ...]:
    if options.plot is None:
        return ()
    from dbh_studio.app.evaluation import section_pictures
    from dbh_studio.app.opening import open_plot

    session = open_plot(Path(options.plot), read_only=True)
    try:
        pictures = section_pictures(session, comparison)
    finally:
        session.close()
    if not pictures:
        raise StudioError(
            f"{options.plot.name} has no measured stem of this inventory.", "Name the saved plot it was exported from."
        )
    return pictures


def _print(comparison: Comparison) -> None:
    from dbh_studio.io.evaluation_report import coverage_text, data_name, rounded

    heads = ("", "method", "n", "bias cm", "MAD cm", "rCV %", "R²", "rel. %", "90th %", "RMSE cm", "found", "refused")
    rows: list[tuple[str, ...]] = [heads]
    for line in comparison.lines:
        s = line.statistics
        shown = (
            (s.median_bias_cm, 2), (s.mad_cm, 2), (s.rcv_pct, 2), (s.r_squared, 2), (s.median_rel_err_pct, 1),
            (s.p90_rel_err_pct, 1), (s.rmse_cm, 2),
        )  # fmt: skip
        found = f"{line.n_measured + line.n_refused}/{line.n_reference}" if line.n_reference else "-"
        numbers = [rounded(value, digits, nothing="-") for value, digits in shown]
        rows.append((data_name(line), line.method, str(s.n), *numbers, found, str(line.n_refused)))
    widths = [max(len(row[k]) for row in rows) for k in range(len(heads))]
    for row in rows:
        cells = [cell.ljust(w) if k < 2 else cell.rjust(w) for k, (cell, w) in enumerate(zip(row, widths, strict=True))]
        print(plain("  ".join(cells).rstrip()))
    for line in comparison.lines:
        if not line.column and line.statistics.n_intervals:
            print(plain(f"{line.method}: the interval holds the reference in {coverage_text(line)}"))
    print()
    for note in comparison.notes:
        print(plain(note))
