"""Compare what a program found with what is true."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

NEAR_M = 0.5


@dataclass(frozen=True)
class Table:
    """Trees of a table: (N,) names, (N, 2) places in metres and (N,) diameters in cm, NaN where none is given."""

    names: tuple[str, ...]
    xy_m: np.ndarray
    dbh_cm: np.ndarray


@dataclass(frozen=True)
class Score:
    """How a table of found trees compares with the truth.

    Attributes:
        n_true: Trees there are.
        n_found: Trees the program lists.
        n_dbh: Of those, how many with a diameter.
        n_matched: Found trees that are within reach of a true one.
        n_compared: Matched trees with a diameter.
        bias_cm: Mean error; None where nothing is compared.
        rmse_cm: Root mean square error.
        worst_cm: The error furthest from zero.
    """

    n_true: int
    n_found: int
    n_dbh: int
    n_matched: int
    n_compared: int
    bias_cm: float | None
    rmse_cm: float | None
    worst_cm: float | None


def number(text: str | None) -> float:
    """A cell as a number; NaN where it is empty or says something else."""
    try:
        return float(text or "nan")
    except ValueError:
        return float("nan")


def read_table(path: Path, *, name: str = "tree_id", x: str = "x_m", y: str = "y_m", dbh: str = "dbh_cm") -> Table:
    """Trees from a CSV file with these columns; a byte order mark is skipped."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.DictReader(file)
        missing = {name, x, y, dbh} - set(reader.fieldnames or [])
        if missing:
            raise SystemExit(f"{path.name}: the columns {', '.join(sorted(missing))} are missing.")
        rows = list(reader)
    places = np.array([[number(row[x]), number(row[y])] for row in rows]).reshape(-1, 2)
    diameters = np.array([number(row[dbh]) for row in rows])
    # A diameter of zero is how some programs say that they have none.
    diameters[diameters <= 0] = np.nan
    return Table(tuple(row[name] for row in rows), places, diameters)


def pair(found_m: np.ndarray, true_m: np.ndarray, *, near_m: float = NEAR_M) -> np.ndarray:
    """(K, 2) index pairs (found, true) with the least sum of distances, none further apart than `near_m`."""
    if not len(found_m) or not len(true_m):
        return np.zeros((0, 2), int)
    distance = np.linalg.norm(found_m[:, None] - true_m, axis=2)
    distance[np.isnan(distance)] = 1e6
    # Beyond reach all is equally bad, so that one far pair does not push near ones apart.
    rows, columns = linear_sum_assignment(np.minimum(distance, 10 * near_m))
    near = distance[rows, columns] <= near_m
    return np.stack([rows[near], columns[near]], axis=1)


def register(found_m: np.ndarray, true_m: np.ndarray, *, near_m: float = NEAR_M) -> np.ndarray:
    """`found_m` turned and moved (not scaled) so that as many places as possible meet the true ones.

    For programs that lay out the plot in a frame of their own. Every pair of found trees is laid on every pair of true
    trees as far apart; the motion with the most matches wins and is refined on them.
    """
    best, best_score = found_m, (-1, 0.0)
    starts, ends = np.nonzero(~np.eye(len(true_m), dtype=bool))
    spans = true_m[ends] - true_m[starts]
    for i, j in _some_pairs(found_m, near_m):
        span = found_m[j] - found_m[i]
        alike = np.abs(np.hypot(*spans.T) - np.hypot(*span)) < near_m / 2
        turns = np.arctan2(spans[alike, 1], spans[alike, 0]) - np.arctan2(span[1], span[0])
        for turn, place in zip(turns, true_m[starts[alike]], strict=True):
            rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            moved = (found_m - found_m[i]) @ rotation.T + place
            distance = np.linalg.norm(moved[:, None] - true_m, axis=2).min(axis=1)
            score = (int((distance < near_m).sum()), -float(np.minimum(distance, near_m).sum()))
            if score > best_score:
                best, best_score = moved, score
    return _refined(best, true_m, near_m)


def _some_pairs(places_m: np.ndarray, near_m: float) -> list[tuple[int, int]]:
    """At most 200 index pairs of places that are well apart."""
    pairs = [
        (i, j) for i, j in combinations(range(len(places_m)), 2) if np.hypot(*(places_m[j] - places_m[i])) > 4 * near_m
    ]
    np.random.default_rng(0).shuffle(pairs)
    return [(int(i), int(j)) for i, j in pairs[:200]]


def _refined(found_m: np.ndarray, true_m: np.ndarray, near_m: float) -> np.ndarray:
    """Least-squares turn and shift on the pairs there are."""
    for _ in range(3):
        pairs = pair(found_m, true_m, near_m=near_m)
        if len(pairs) < 2:
            return found_m
        source, target = found_m[pairs[:, 0]], true_m[pairs[:, 1]]
        u, _, vt = np.linalg.svd((target - target.mean(axis=0)).T @ (source - source.mean(axis=0)))
        rotation = u @ np.diag([1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
        found_m = (found_m - source.mean(axis=0)) @ rotation.T + target.mean(axis=0)
    return found_m


def aligned(found: Table, truth: Table) -> Table:
    """`found` as it is where its places agree with the truth, else registered to it."""
    if len(pair(found.xy_m, truth.xy_m)) * 2 >= min(len(found.names), len(truth.names)):
        return found
    return Table(found.names, register(found.xy_m, truth.xy_m), found.dbh_cm)


def score(found: Table, truth: Table) -> Score:
    """Counts and errors of `found` against `truth`, matched by place."""
    pairs = pair(aligned(found, truth).xy_m, truth.xy_m)
    error = found.dbh_cm[pairs[:, 0]] - truth.dbh_cm[pairs[:, 1]]
    error = error[np.isfinite(error)]
    n_dbh = int(np.isfinite(found.dbh_cm).sum())
    counts = (len(truth.names), len(found.names), n_dbh, len(pairs), len(error))
    if not len(error):
        return Score(*counts, None, None, None)
    worst = float(error[np.abs(error).argmax()])
    return Score(*counts, float(error.mean()), float(np.sqrt((error**2).mean())), worst)


def count(found: Table) -> Score:
    """What was found, where the truth is unknown."""
    return Score(0, len(found.names), int(np.isfinite(found.dbh_cm).sum()), 0, 0, None, None, None)
