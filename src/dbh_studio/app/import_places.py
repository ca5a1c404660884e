"""Whether the stems of a table stand where the plot's stems of the same numbers do."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.inventory import Inventory
from dbh_studio.errors import CommandError
from dbh_studio.io.tables import CellTable, numbers, plain_name

# A stem's centre moves by centimetres when its points are edited, and by decimetres where little of it was seen.
_SAME_STEM_M = 1.0
# So many stems tell whether a table fits once the plot's frame has been moved.
_LEAST_FOR_FIT = 4
# With a motion to choose, other plots come near: nearly all stems must fit, and closely.
_FITTED_M, _FITTED_SHARE = 0.3, 0.75
_SCALES = (0.2, 5.0)


def misplaced_stems(
    cells: CellTable, ids: Sequence[int], inventory: Inventory, path: Path
) -> tuple[list[int], list[str]]:
    """The stems of a table that stand elsewhere in the plot, and what is odd about all of them together.

    A plot that was turned, moved or scaled as a whole since is recognised, and is no misfit.

    Args:
        cells: The table.
        ids: The stem of each of its lines.
        inventory: Of the plot.
        path: Of the table, for the words.

    Raises:
        CommandError: The stems as a whole do not fit: it is of another plot.
    """
    theirs, ours, known = _places(cells, ids, inventory)
    if not len(theirs):
        return [], [f"{path.name} does not say where the stems stand, so they are told by their numbers alone."]
    apart = np.hypot(*(theirs - ours).T)
    if np.median(apart) <= _SAME_STEM_M:
        return [i for i, distance in zip(known, apart, strict=True) if distance > _SAME_STEM_M], []
    fitted = _apart_when_laid_on(theirs, ours)
    if fitted is not None and np.mean(fitted <= _FITTED_M) >= _FITTED_SHARE:
        wrong = [i for i, distance in zip(known, fitted, strict=True) if distance > _SAME_STEM_M]
        return wrong, ["The plot's frame has been moved since the table was written; the stems fit nonetheless."]
    raise CommandError(
        f"{path.name} is of another plot: {int((apart > _SAME_STEM_M).sum())} of {len(apart)} stems stand elsewhere, "
        f"by {np.median(apart):.1f} m in the middle.",
        "Nothing was changed. Choose the table that was exported from this plot.",
    )


def _places(cells: CellTable, ids: Sequence[int], inventory: Inventory) -> tuple[Float64, Float64, list[int]]:
    """(N, 2) places in the table and in the plot of the stems both know, and their ids."""
    columns = {plain_name(name): name for name in cells.columns}
    rows = {row.stem_id: row for row in inventory}
    for x, y in (("easting", "northing"), ("x_m", "y_m")):
        if x not in columns or y not in columns:
            continue
        theirs = np.column_stack([numbers(cells.columns[columns[name]]) for name in (x, y)])
        ours = np.array(
            [[_or_nan(getattr(rows.get(i), name, None)) for name in (x, y)] for i in ids], np.float64
        ).reshape(-1, 2)
        both = np.asarray(np.isfinite(theirs).all(axis=1) & np.isfinite(ours).all(axis=1), bool)
        if both.any():
            return theirs[both], ours[both], [i for i, is_known in zip(ids, both, strict=True) if is_known]
    return np.empty((0, 2)), np.empty((0, 2)), []


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else value


def _apart_when_laid_on(theirs: Float64, ours: Float64) -> Float64 | None:
    """(N,) distances after the table was moved, turned and scaled as a whole; None where too few stems could tell.

    The most of the pairs decide: every pair of stems gives a motion, and the best one is refined on what it fits.
    """
    if len(theirs) < _LEAST_FOR_FIT:
        return None
    z, w = theirs @ np.array([1, 1j]), ours @ np.array([1, 1j])
    best: Float64 | None = None
    rng = np.random.default_rng(0)
    for _ in range(60):
        i, j = rng.choice(len(z), 2, replace=False)
        if abs(z[i] - z[j]) < _SAME_STEM_M:
            continue
        turn = (w[i] - w[j]) / (z[i] - z[j])
        if not _SCALES[0] <= abs(turn) <= _SCALES[1]:
            continue
        near = np.abs(turn * (z - z[i]) + w[i] - w) <= _SAME_STEM_M
        if near.sum() >= 3:
            turn, shift = np.linalg.lstsq(np.column_stack([z[near], np.ones(near.sum())]), w[near], rcond=None)[0]
            apart = np.abs(turn * z + shift - w)
            if best is None or np.median(apart) < np.median(best):
                best = np.asarray(apart, np.float64)
    return best
