"""An evaluation on paper: the table as CSV, Markdown and LaTeX (as the paper's Table II), and every pair as CSV."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from decimal import ROUND_HALF_UP, Decimal
from typing import Any

from dbh_studio.core.evaluation import ALL, MIN_N, MIN_N_R2, MIN_N_TAIL, Line, Sample, Statistics
from dbh_studio.io.inventory_csv import defused

TABLE_COLUMNS = (
    "by", "category", "method", "n_reference", "n_measured", "n_refused", "n_missed", "n_extra", "found_pct",
    "median_bias_cm", "mad_cm", "rcv_pct", "r_squared", "median_rel_err_pct", "p90_rel_err_pct", "mean_bias_cm",
    "rmse_cm", "n_intervals", "n_covered", "coverage_pct",
)  # fmt: skip
PAIR_COLUMNS = (
    "inventory", "method", "plot", "outcome", "tree", "stem", "estimated_cm", "reference_cm", "error_cm", "error_pct",
    "lo_cm", "hi_cm", "distance_m", "next_m", "reason",
)  # fmt: skip
_STATISTICS = TABLE_COLUMNS[9:]
# Decimals of what a person reads, on paper and in the studio; the CSV has more.
_SHOWN_DECIMALS = {
    "median_bias_cm": 2, "mad_cm": 2, "rcv_pct": 2, "r_squared": 2, "median_rel_err_pct": 1, "p90_rel_err_pct": 1,
    "mean_bias_cm": 2, "rmse_cm": 2, "estimated_cm": 2, "reference_cm": 2, "error_cm": 2, "error_pct": 1,
}  # fmt: skip
_DECIMAL_UP_TO = 1e15
_PAPERS_STATISTICS = ("median_bias_cm", "mad_cm", "rcv_pct", "r_squared")
_MARKDOWN_STATISTICS = (*_PAPERS_STATISTICS, "median_rel_err_pct", "p90_rel_err_pct", "mean_bias_cm", "rmse_cm")
_ORDER = ("measured", "refused", "missed", "extra", "unknown", "outside")


def table_csv(lines: Sequence[Line]) -> bytes:
    """Every line with every number; an empty cell for what too few stems say."""
    return _csv(TABLE_COLUMNS, [_numbers(line) for line in lines])


def line_values(line: Line) -> dict[str, Any]:
    """One line of the table by `TABLE_COLUMNS`; None for what is not known."""
    values: dict[str, Any] = {
        "by": line.column,
        "category": line.category,
        "method": line.method,
        "found_pct": line.found_pct,
    }
    values |= {name: getattr(line, name) for name in TABLE_COLUMNS[3:8]}
    return values | {name: getattr(line.statistics, name) for name in _STATISTICS}


def _numbers(line: Line) -> dict[str, str]:
    digits = {"r_squared": 4, "found_pct": 1, "coverage_pct": 1}
    return {
        name: defused(value) if isinstance(value, str) else rounded(value, digits.get(name, 3))
        for name, value in line_values(line).items()
    }


def rounded(value: float | int | None, digits: int, *, nothing: str = "") -> str:
    """A number as text; `nothing` for None, and no minus before a zero.

    Halves go away from zero as on paper, and it is the number as it is written that counts: 40.05, which is read from a
    table and is a little less in binary, is 40.1 with one decimal.
    """
    if value is None:
        return nothing
    if isinstance(value, int):
        return str(value)
    if not abs(value) < _DECIMAL_UP_TO:
        return f"{value:.{digits}f}"
    text = f"{Decimal(repr(float(value))).quantize(Decimal(1).scaleb(-digits), ROUND_HALF_UP):f}"
    return text.removeprefix("-") if float(text) == 0 else text


def shown(values: Statistics | Sample, name: str, *, nothing: str = "–", with_sign: bool = False) -> str:
    """One of `values` as it is shown to a person: the same text in every table, in the studio and in a report.

    Args:
        values: Of a line, or of a pair.
        name: Which of them: a column of `TABLE_COLUMNS` or `PAIR_COLUMNS`.
        nothing: For what is not known.
        with_sign: A plus before what is more than zero.
    """
    value = getattr(values, name)
    text = rounded(value, _SHOWN_DECIMALS[name], nothing=nothing)
    return f"+{text}" if with_sign and value is not None and value > 0 and float(text) != 0 else text


def pairs_csv(samples: Sequence[Sample], columns: Sequence[str] = ()) -> bytes:
    """Every stem under every method, and what became of it; measured ones first.

    Args:
        samples: Of an evaluation.
        columns: Of `Sample.groups`, to be put behind.
    """
    rows = []
    for sample in sorted(samples, key=lambda s: _ORDER.index(s.outcome)):
        low, high = sample.interval_cm or (None, None)
        row = {name: getattr(sample, name) for name in PAIR_COLUMNS if hasattr(sample, name)}
        row |= {"lo_cm": low, "hi_cm": high} | {f"by {name}": sample.groups.get(name, "") for name in columns}
        rows.append({k: defused(v) if isinstance(v, str) else rounded(v, 3) for k, v in row.items()})
    return _csv((*PAIR_COLUMNS, *(f"by {name}" for name in columns)), rows)


def _csv(columns: Sequence[str], rows: Sequence[dict[str, str]]) -> bytes:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writerow({name: defused(name) for name in columns})
    writer.writerows(rows)
    return text.getvalue().encode("utf-8", errors="replace")


# ---- Markdown


def table_markdown(lines: Sequence[Line]) -> str:
    """The table with what foresters ask; a dash for what too few stems say."""
    with_intervals = any(line.statistics.n_intervals for line in lines)
    heads = [
        "Data", "Method", "n", "Median bias (cm)", "MAD (cm)", "rCV (%)", "R²", "Median rel. error (%)",
        "90th pct. (%)", "Mean bias (cm)", "RMSE (cm)", "Found", "Refused", "Extra",
    ]  # fmt: skip
    if with_intervals:
        heads.append("Interval holds")
    rows = [heads, ["---", "---", *["---:"] * (len(heads) - 2)]]
    for line in lines:
        s = line.statistics
        found = line.n_measured + line.n_refused
        row = [
            markdown_text(data_name(line)),
            markdown_text(line.method),
            str(s.n),
            *(shown(s, name) for name in _MARKDOWN_STATISTICS),
            f"{found} of {line.n_reference}" if line.n_reference else "–",
            str(line.n_refused),
            rounded(line.n_extra, 0, nothing="–"),
        ]
        if with_intervals:
            row.append(coverage_text(line))
        rows.append(row)
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def coverage_text(line: Line) -> str:
    """How many intervals hold the reference."""
    s = line.statistics
    share = f" ({s.coverage_pct:.0f} %)" if s.coverage_pct is not None else ""
    return f"{s.n_covered} of {s.n_intervals}{share}" if s.n_intervals else "–"


def data_name(line: Line) -> str:
    """What a line is about: ``All``, or the column and its category."""
    return line.category if not line.column else f"{line.column}: {line.category}"


def markdown_text(text: str) -> str:
    """Text that means nothing to Markdown or HTML."""
    flat = re.sub(r"[\x00-\x1f\x7f]+", " ", text)
    marked = re.sub(r"([\\`*_\[\]|~])", r"\\\1", flat)
    return marked.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


REMARKS = (
    f"Bias, MAD, rCV, relative error and RMSE from {MIN_N} pairs, R² from {MIN_N_R2}, the 90th percentile and the "
    f"share of intervals from {MIN_N_TAIL}; a dash where there are fewer. R² is that of a straight line, which does "
    "not see a constant bias."
)


# ---- LaTeX


def table_latex(lines: Sequence[Line]) -> str:
    r"""The paper's Table II, with n; needs ``\usepackage{booktabs,multirow}``."""
    blocks: list[tuple[str, str, list[Line]]] = []
    for line in lines:
        if blocks and blocks[-1][:2] == (line.column, line.category):
            blocks[-1][2].append(line)
        else:
            blocks.append((line.column, line.category, [line]))
    body = []
    for k, (column, category, members) in enumerate(blocks):
        if k and blocks[k - 1][0] != column:
            body.append(r"\midrule")
        name = latex_text(ALL if not column else f"{column}: {category}")
        for row, line in enumerate(members):
            first = name if len(members) == 1 else rf"\multirow{{{len(members)}}}{{*}}{{{name}}}"
            s = line.statistics
            cells = [latex_text(line.method), str(s.n), *(shown(s, name, nothing="--") for name in _PAPERS_STATISTICS)]
            body.append(f"{'' if row else first} & {' & '.join(cells)} \\\\")
    return "\n".join(
        [
            r"% Needs \usepackage{booktabs,multirow}.",
            r"\begin{table}",
            r"\caption{DBH estimation metrics.}",
            r"\centering",
            r"\begin{tabular}{l l r r r r r}",
            r"\toprule",
            r"Data & Method & $n$ & Median bias (cm) & MAD (cm) & rCV (\%) & $R^2$ \\",
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )


_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "|": r"\textbar{}", "[": "{[}", "]": "{]}", "*": "{*}",
}  # fmt: skip


def latex_text(text: str) -> str:
    """Text that means nothing to LaTeX, nor to the end of the row before it: it takes stars and brackets as its own."""
    flat = re.sub(r"[\x00-\x1f\x7f]+", " ", text)
    return "".join(_LATEX.get(letter, letter) for letter in flat)
