"""Fit when passes are looked for and how far they are followed: the coefficients in `core/estimator/passes.py`.

    OPENBLAS_NUM_THREADS=1 python bench/estimator_passes.py [-n 200] [--first 16000] [--jobs 2]

Stems of every scenario of the laboratory, development seeds only (those of `estimator_lab.py` are 10 000-14 999), each
measured as the studio does by the shrinkage curve, with nothing moved; passes are looked for on every stem, not only
where the look tells that it is worth while. Where a scenario has an arc of exactly so many degrees, arcs about it are
drawn, as in `estimator_calibrate.py`; stems of which more than 200° are unseen are left out, since nothing is moved
there. Three logistic regressions follow, in each of which every scenario counts alike but where it is said:

* `_CHANCE`, how likely there are passes that do not fit together: fitted to whether the scenario has several passes.
  Scenarios that have some and those that have none count half each.
* `_TRUST`, how far to go from the one curve's size to that of the walls: fitted to the error that is left, of the
  area's diameter and of the tape's, relative to the scenario's median error by the one curve. Its power 0.7 is summed,
  so that the worst stems do not decide alone. The scenario "drift" counts several times over: it is the only one where
  passes are the main error, and among two dozen others it would be given up.
* `_LOOK`, whether to look at all: fitted to whether `_TRUST` would move a stem by more than 0.3 %.

What is printed goes into `passes.py`; half of the stems by turns are kept out once to tell what it is worth.
The interval rests on it: `estimator_calibrate.py` is to be run after it.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

import numpy as np
from estimator_calibrate import AROUND_DEG
from estimator_stems import SCENARIOS, make_case
from scipy.optimize import minimize

from dbh_studio.core.estimator import assess_stem, estimate, passes
from dbh_studio.core.interval_methods import estimator_settings
from dbh_studio.settings import MeasureSettings

_IN_PASSES = tuple(name for name, made in SCENARIOS.items() if made.passes > 1)
_SEVERAL_TIMES = {"drift": 8.0}
_LEAST_SHARE = 0.25  # of the most stems a scenario has left: of fewer, single stems would count much
_WORTH = 0.003
_POWER = 0.7
_SMOOTH = 0.2  # of the power at zero, in median errors
_RIDGE, _RIDGE_TRUST = 1e-3, 3e-4
_STEEPNESSES = (0.0, 0.3, 1.0, 2.0)  # of the chance, to start from
Loss = Callable[[np.ndarray], tuple[float, np.ndarray]]
"""Of the regression's logits: what is to be least, and its derivatives."""


@dataclass(frozen=True)
class Row:
    """One stem by one curve and by walls; logarithms of metres."""

    scenario: str
    seed: int
    true: np.ndarray  # (2,) of the circle of the same area, tape
    by_curve: np.ndarray  # (2,) the same
    way: float  # from the one curve to the walls, as far as may be moved at all
    signs: np.ndarray  # (10,) of `passes_of`
    cheap_signs: np.ndarray  # (5,) of `is_suspect`


def measured(task: tuple[str, int]) -> Row | None:
    """The row of a scenario and a seed; None where it is refused or nothing would be moved anyhow."""
    scenario, seed = task
    made = SCENARIOS[scenario]
    if scenario in AROUND_DEG:
        made = replace(made, arc_deg=AROUND_DEG[scenario])
    case = make_case(scenario, seed, made)
    settings = estimator_settings(MeasureSettings(), "shrinkage")
    seen: dict[str, Any] = {}

    def is_suspect(tube: Any, **told: float) -> bool:
        with patch.object(passes, "_logistic", return_value=1.0) as logistic:
            suspect = passes.is_suspect(tube, **told)
            seen["cheap_signs"] = logistic.call_args.args[1] if suspect else None
        return suspect

    def passes_of(*given: Any, **told: float) -> None:  # so that what comes out is by one curve
        seen["passes"] = passes.passes_of(*given, **told)

    with patch.object(estimate, "is_suspect", is_suspect), patch.object(estimate, "passes_of", passes_of):
        found = assess_stem(case.points_m, settings=settings.model_copy(update={"max_half_width": 2.0}))
    if found.refusal is not None or found.result is None or found.result.method != settings.method:
        return None
    if seen.get("passes") is None:
        return None
    true = np.log([case.area_cm / 100.0, case.tape_cm / 100.0])
    by_curve = np.log([found.result.diameters[name].value_cm / 100.0 for name in ("area", "tape")])
    way = replace(seen["passes"], trust=1.0).log_shift(by_curve[0])
    return Row(scenario, seed, true, by_curve, way, seen["passes"].signs, seen["cheap_signs"])


@dataclass(frozen=True)
class Fit:
    """Intercepts and slopes as in `passes.py`."""

    chance: np.ndarray
    trust: np.ndarray
    look: np.ndarray

    def moved(self, rows: Sequence[Row]) -> np.ndarray:
        """(N,) how far each stem's logarithms are moved."""
        table = Table(rows)
        looked = _logistic(self.look, table.cheap_signs) > passes._SUSPECT
        return np.where(looked, _logistic(self.trust, table.signs) * table.way, 0.0)


class Table:
    """Rows as arrays."""

    def __init__(self, rows: Sequence[Row]) -> None:
        self.scenario = np.array([row.scenario for row in rows])
        self.signs = np.stack([row.signs for row in rows])
        self.cheap_signs = np.stack([row.cheap_signs for row in rows])
        self.error = np.stack([row.by_curve - row.true for row in rows])
        self.way = np.array([row.way for row in rows])
        self.weight = np.zeros(len(rows))
        for part in self.parts():
            self.weight[part] = 1.0 / len(part)

    def parts(self) -> Iterator[np.ndarray]:
        """Of each scenario the rows."""
        for name in dict.fromkeys(self.scenario):
            yield np.flatnonzero(self.scenario == name)


def fit(rows: Sequence[Row]) -> Fit:
    """All three."""
    counts = {name: sum(row.scenario == name for row in rows) for name in SCENARIOS}
    least = _LEAST_SHARE * max(counts.values())
    table = Table([row for row in rows if counts[row.scenario] >= least])
    in_passes = np.isin(table.scenario, _IN_PASSES)
    halves = np.where(in_passes, table.weight[in_passes].sum(), table.weight[~in_passes].sum())
    chance = _fitted(table.signs, _unlikelihood(in_passes, 0.5 * table.weight / halves), _RIDGE)
    trust = _fitted(table.signs, _error_left(table), _RIDGE_TRUST, about=chance)
    is_moved = np.abs(_logistic(trust, table.signs) * table.way) > _WORTH
    look = _fitted(table.cheap_signs, _unlikelihood(is_moved, table.weight / table.weight.sum()), _RIDGE)
    return Fit(_rounded(chance), _rounded(trust), _rounded(look))


def _fitted(signs: np.ndarray, loss: Loss, ridge: float, about: np.ndarray | None = None) -> np.ndarray:
    """Intercept and slopes of the least loss; from several starts along `about`, where one is given."""
    middle, size = signs.mean(axis=0), signs.std(axis=0)
    design = np.column_stack([np.ones(len(signs)), (signs - middle) / size])

    def total(slopes: np.ndarray) -> tuple[float, np.ndarray]:
        value, by_logit = loss(design @ slopes)
        held = np.append(0.0, slopes[1:])
        return value + ridge * float(held @ held), by_logit @ design + 2.0 * ridge * held

    starts = [np.zeros(design.shape[1])]
    if about is not None:
        near = np.append(about[0] + about[1:] @ middle, about[1:] * size)
        starts = [steepness * near - np.append(2.0, np.zeros(len(size))) for steepness in _STEEPNESSES]
    best = min((minimize(total, start, jac=True) for start in starts), key=lambda found: float(found.fun)).x
    slopes = best[1:] / size
    return np.append(best[0] - slopes @ middle, slopes)


def _unlikelihood(is_so: np.ndarray, weight: np.ndarray) -> Loss:
    def loss(logit: np.ndarray) -> tuple[float, np.ndarray]:
        return float(weight @ (np.logaddexp(0.0, logit) - is_so * logit)), weight * (_sigmoid(logit) - is_so)

    return loss


def _error_left(table: Table) -> Loss:
    usual = np.empty_like(table.error)
    for part in table.parts():
        usual[part] = np.median(np.abs(table.error[part]), axis=0)
    weight = table.weight * [_SEVERAL_TIMES.get(name, 1.0) for name in table.scenario]
    weight = weight[:, None] / weight.sum()

    def loss(logit: np.ndarray) -> tuple[float, np.ndarray]:
        share = _sigmoid(logit)
        error = table.error + (share * table.way)[:, None]
        left = np.hypot(error / usual, _SMOOTH)
        by_error = weight * _POWER * left ** (_POWER - 2.0) * error / usual**2
        return float((weight * left**_POWER).sum()), by_error.sum(axis=1) * table.way * share * (1.0 - share)

    return loss


def _logistic(coefficients: np.ndarray, signs: np.ndarray) -> np.ndarray:
    return _sigmoid(coefficients[0] + signs @ coefficients[1:])


def _sigmoid(logit: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-np.clip(logit, -30.0, 30.0)))


def _rounded(values: np.ndarray) -> np.ndarray:
    return np.array([float(f"{value:.3g}") for value in values])


def _told(rows: Sequence[Row], found: Fit) -> Iterator[str]:
    """A table of what is gained in the tape's diameter."""
    table, moved = Table(rows), found.moved(rows)
    yield "| odd seeds by even ones | stems | moved % | chance | median % | by passes | 90th % | by passes |"
    yield "|---|--:|--:|--:|--:|--:|--:|--:|"
    chance = _logistic(found.chance, table.signs)
    for part in table.parts():
        before = 100.0 * np.quantile(np.abs(table.error[part, 1]), (0.5, 0.9))
        after = 100.0 * np.quantile(np.abs(table.error[part, 1] + moved[part]), (0.5, 0.9))
        share = 100.0 * float((np.abs(moved[part]) > _WORTH).mean())
        line = f"| {table.scenario[part[0]]} | {len(part)} | {share:.0f} | {np.median(chance[part]):.2f}"
        yield f"{line} | {before[0]:.2f} | {after[0]:.2f} | {before[1]:.1f} | {after[1]:.1f} |"


def main() -> None:
    """Measure, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=200, help="stems per scenario")
    parser.add_argument("--first", type=int, default=16_000)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    if options.first < 15_000 and options.first + options.n > 10_000:
        parser.error("seeds 10 000-14 999 are for the benchmark, and choose nothing")
    warnings.simplefilter("error")
    tasks = [(name, options.first + i) for i in range(options.n) for name in SCENARIOS]
    with multiprocessing.Pool(options.jobs) as pool:
        rows = [row for row in pool.map(measured, tasks, chunksize=26) if row is not None]
    print(f"{len(rows)} of {len(tasks)} stems looked at", file=sys.stderr)
    by_even = fit([row for row in rows if not row.seed % 2])
    print("\n".join(_told([row for row in rows if row.seed % 2], by_even)), end="\n\n")
    found = fit(rows)
    for name in ("chance", "trust", "look"):
        print(f"_{name.upper()} = np.array({getattr(found, name).tolist()})")


if __name__ == "__main__":
    main()
