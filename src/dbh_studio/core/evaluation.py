"""How good diameters are: the statistics of the paper's section IV-B and Table II, and what a forester asks besides.

For estimates ŷ and references y of paired stems, with errors e = ŷ − y: median bias = median(e); MAD =
median(|e − median(e)|), not scaled by 1.4826; rCV = MAD / median(y); R² = that of the straight line fitted to ŷ over y,
which is the squared correlation and blind to a constant bias; relative error = |e| / y.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from dbh_studio.core.arrays import Float64

MIN_N = 3
"""With fewer pairs than this no statistic is given."""
MIN_N_R2 = 5
"""Two points always lie on a line; with fewer than this R² says next to nothing."""
MIN_N_TAIL = 10
"""With fewer, a 90th percentile is the largest value, and one interval more or less is over 10 % of the coverage."""

Outcome = Literal["measured", "refused", "missed", "extra", "unknown", "outside"]
ALL = "All"
_COUNTED: tuple[Outcome, ...] = ("refused", "missed", "extra")


@dataclass(frozen=True)
class Statistics:
    """Of the stems that have both diameters. None where there are too few of them to say.

    Attributes:
        n: Pairs with both diameters.
        median_bias_cm: Above zero where the estimates are too large.
        mad_cm: Median absolute deviation of the errors from their median.
        rcv_pct: `mad_cm` as a share of the median reference.
        r_squared: Of the line of least squares; None also where all references or all estimates are equal.
        median_rel_err_pct: Median of |error| / reference.
        p90_rel_err_pct: The 90th percentile of the same.
        mean_bias_cm: Mean error.
        rmse_cm: Root mean square error.
        n_intervals: Pairs whose estimate has an interval.
        n_covered: Those whose interval holds the reference, its ends included.
        coverage_pct: Share of these.
    """

    n: int
    median_bias_cm: float | None = None
    mad_cm: float | None = None
    rcv_pct: float | None = None
    r_squared: float | None = None
    median_rel_err_pct: float | None = None
    p90_rel_err_pct: float | None = None
    mean_bias_cm: float | None = None
    rmse_cm: float | None = None
    n_intervals: int = 0
    n_covered: int = 0
    coverage_pct: float | None = None


def statistics(estimated_cm: Any, reference_cm: Any, interval_cm: Any = None) -> Statistics:
    """The statistics of paired diameters.

    Args:
        estimated_cm: (N,) estimates, finite.
        reference_cm: (N,) references, finite and above zero.
        interval_cm: (N, 2) lower and upper ends; NaN where an estimate has none. None where none has.

    Raises:
        ValueError: The lengths differ, a value is not finite, or a reference is not above zero.
    """
    estimated, reference = _diameters(estimated_cm, reference_cm)
    n = len(reference)
    covered, n_intervals = _coverage(interval_cm, reference)
    coverage_pct = 100.0 * covered / n_intervals if n_intervals >= MIN_N_TAIL else None
    if n < MIN_N:
        return Statistics(n, n_intervals=n_intervals, n_covered=covered, coverage_pct=coverage_pct)
    error = estimated - reference
    relative_pct = relative_error_pct(estimated, reference)
    bias = float(np.median(error))
    mad = float(np.median(np.abs(error - bias)))
    return Statistics(
        n,
        median_bias_cm=bias,
        mad_cm=mad,
        rcv_pct=100.0 * mad / float(np.median(reference)),
        r_squared=_r_squared(estimated, reference) if n >= MIN_N_R2 else None,
        median_rel_err_pct=float(np.median(relative_pct)),
        p90_rel_err_pct=float(np.percentile(relative_pct, 90.0)) if n >= MIN_N_TAIL else None,
        mean_bias_cm=float(error.mean()),
        rmse_cm=float(np.sqrt((error**2).mean())),
        n_intervals=n_intervals,
        n_covered=covered,
        coverage_pct=coverage_pct,
    )


def relative_error_pct(estimated_cm: Any, reference_cm: Any) -> Float64:
    """(N,) |estimate − reference| / reference, per cent: without sign, as in the paper's box plots.

    Raises:
        ValueError: As `statistics`.
    """
    estimated, reference = _diameters(estimated_cm, reference_cm)
    return np.asarray(100.0 * np.abs(estimated - reference) / reference)


def _diameters(estimated_cm: Any, reference_cm: Any) -> tuple[Float64, Float64]:
    estimated, reference = np.asarray(estimated_cm, np.float64), np.asarray(reference_cm, np.float64)
    if estimated.ndim != 1 or estimated.shape != reference.shape:
        raise ValueError(f"diameters have shapes {estimated.shape} and {reference.shape} but both must be (N,)")
    if not (np.isfinite(estimated).all() and np.isfinite(reference).all() and (reference > 0).all()):
        raise ValueError("diameters must be finite, and references above zero: leave out what is not known")
    return estimated, reference


def _r_squared(estimated: Float64, reference: Float64) -> float | None:
    x, y = reference - reference.mean(), estimated - estimated.mean()
    spread = float((x**2).sum() * (y**2).sum())
    # What rounding leaves of equal values is no spread.
    if spread <= (1e-12 * len(x) * float(reference.max() * max(np.abs(estimated).max(), 1e-12))) ** 2:
        return None
    return float((x * y).sum() ** 2 / spread)


def _coverage(interval_cm: Any, reference: Float64) -> tuple[int, int]:
    if interval_cm is None:
        return 0, 0
    interval = np.asarray(interval_cm, np.float64)
    if interval.shape != (len(reference), 2):
        raise ValueError(f"interval_cm has shape {interval.shape} but ({len(reference)}, 2) is needed")
    known = np.asarray(np.isfinite(interval).all(axis=1))
    covered = known & (interval[:, 0] <= reference) & (reference <= interval[:, 1])
    return int(covered.sum()), int(known.sum())


@dataclass(frozen=True)
class TukeyBox:
    """A box plot as Tukey drew it.

    Attributes:
        n: Values.
        median: Middle bar.
        quartiles: Lower and upper edge of the box.
        whiskers: Farthest values within 1.5 interquartile ranges of the box.
        outliers: Values beyond, ascending.
    """

    n: int
    median: float
    quartiles: tuple[float, float]
    whiskers: tuple[float, float]
    outliers: tuple[float, ...]


def tukey_box(values: Any) -> TukeyBox | None:
    """The box of (N,) values; None where there are fewer than `MIN_N`. Quartiles are interpolated linearly."""
    numbers = np.sort(np.asarray(values, np.float64))
    if len(numbers) < MIN_N:
        return None
    low, middle, high = (float(q) for q in np.percentile(numbers, [25.0, 50.0, 75.0]))
    reach = 1.5 * (high - low)
    inside = (numbers >= low - reach) & (numbers <= high + reach)
    ends = numbers[inside]
    return TukeyBox(
        len(numbers), middle, (low, high), (float(ends[0]), float(ends[-1])), tuple(numbers[~inside].tolist())
    )


@dataclass(frozen=True)
class Sample:
    """What became of one stem under one method.

    Attributes:
        method: Whose diameter it is.
        inventory: The table it came from.
        outcome: ``measured``: both diameters are there; ``refused``: found, without a diameter; ``missed``: only in
            the reference; ``extra``: only in the inventory; ``unknown``: found, but the reference has no usable
            diameter; ``outside``: of a plot that the other table does not have.
        tree: Its number in the reference; empty for extras.
        stem: Its number in the inventory; empty where it was not found.
        plot: Where the tables name plots.
        estimated_cm: None where there is none.
        reference_cm: None where there is none.
        interval_cm: Ends of the estimate's interval.
        reason: Why it does not count as measured.
        distance_m: Between the places in both tables, once laid on each other.
        next_m: How far the next stem is that it might have been paired with instead.
        groups: Category by column.
    """

    method: str
    inventory: str
    outcome: Outcome
    tree: str = ""
    stem: str = ""
    plot: str = ""
    estimated_cm: float | None = None
    reference_cm: float | None = None
    interval_cm: tuple[float, float] | None = None
    reason: str = ""
    distance_m: float | None = None
    next_m: float | None = None
    groups: Mapping[str, str] = field(default_factory=dict)

    @property
    def error_cm(self) -> float | None:
        """Estimate − reference; None where one is missing."""
        if self.outcome != "measured" or self.estimated_cm is None or self.reference_cm is None:
            return None
        return self.estimated_cm - self.reference_cm

    @property
    def error_pct(self) -> float | None:
        """Error as a share of the reference, with its sign."""
        error = self.error_cm
        return None if error is None or not self.reference_cm else 100.0 * error / self.reference_cm


@dataclass(frozen=True)
class Line:
    """One line of the table: one method in one category.

    Attributes:
        column: What the samples are told apart by; empty for all of them.
        category: Which of them these are; `ALL` for all.
        method: Whose diameters.
        n_reference: Reference stems with a usable diameter; None in categories of the inventory, which say nothing of
            stems that were not found.
        n_measured: Those that were found and have a diameter: the n of the statistics.
        n_refused: Those that were found and have none.
        n_missed: Those that were not found; None as above.
        n_extra: Stems of the inventory that the reference does not have; None in categories of the reference.
        statistics: Of the measured ones.
    """

    column: str
    category: str
    method: str
    n_reference: int | None
    n_measured: int
    n_refused: int
    n_missed: int | None
    n_extra: int | None
    statistics: Statistics

    @property
    def found_pct(self) -> float | None:
        """Share of the reference stems that were found, with a diameter or without."""
        return 100.0 * (self.n_measured + self.n_refused) / self.n_reference if self.n_reference else None


def table_lines(samples: Sequence[Sample], categories: Mapping[str, Sequence[str]] | None = None) -> tuple[Line, ...]:
    """The table: all samples, then every category of every column, each with every method.

    Args:
        samples: Of all methods.
        categories: The categories of each column in the order wanted; categories without samples are left out.
    """
    methods = tuple(dict.fromkeys(sample.method for sample in samples))
    lines = [_line("", ALL, method, [s for s in samples if s.method == method]) for method in methods]
    for column, names in (categories or {}).items():
        # A stem that only one table has is in no category of the other: its absence there says nothing.
        unplaced = {s.outcome for s in samples if column not in s.groups}
        for name in names:
            for method in methods:
                members = [s for s in samples if s.method == method and s.groups.get(column) == name]
                if members:
                    lines.append(_line(column, name, method, members, unplaced))
    return tuple(lines)


def _line(
    column: str, category: str, method: str, samples: Sequence[Sample], unplaced: Set[Outcome] = frozenset()
) -> Line:
    n_refused, n_missed, n_extra = (sum(s.outcome == outcome for s in samples) for outcome in _COUNTED)
    estimated, reference, interval = measured_arrays(samples)
    n = len(reference)
    return Line(
        column,
        category,
        method,
        n_reference=None if "missed" in unplaced else n + n_refused + n_missed,
        n_measured=n,
        n_refused=n_refused,
        n_missed=None if "missed" in unplaced else n_missed,
        n_extra=None if "extra" in unplaced else n_extra,
        statistics=statistics(estimated, reference, interval),
    )


def measured_arrays(samples: Iterable[Sample]) -> tuple[Float64, Float64, Float64]:
    """(N,) estimates, (N,) references and (N, 2) intervals (NaN where there is none) of the measured samples, cm."""
    measured = [s for s in samples if s.outcome == "measured"]
    nothing = (np.nan, np.nan)
    return (
        np.array([s.estimated_cm for s in measured], np.float64),
        np.array([s.reference_cm for s in measured], np.float64),
        np.array([s.interval_cm or nothing for s in measured], np.float64).reshape(-1, 2),
    )
