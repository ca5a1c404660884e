"""The two diameters of each tree side by side, and what a transfer has to show: values, a table, a picture's points."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dbh_studio.app.session import Session
from dbh_studio.core.arrays import Bool, Float64
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import FileError
from dbh_studio.io.atomic import atomic_file
from dbh_studio.io.inventory_csv import defused

if TYPE_CHECKING:
    from dbh_studio.app.transfer_plot import TransferReport
    from dbh_studio.core.inventory import InventoryRow
    from dbh_studio.core.scale import ScaleEstimate
    from dbh_studio.core.trajectories import TrajectoryFit

COMPARISON_DIGITS = {
    "dbh_photo_cm": 2,
    "dbh_lidar_cm": 2,
    "difference_cm": 2,
    "difference_pct": 2,
    "centres_apart_cm": 1,
}


@dataclass(frozen=True)
class TreeComparison:
    """One tree in both plots; the columns of the table.

    Attributes:
        stem_id: In both.
        dbh_photo_cm: None where it was refused.
        dbh_lidar_cm: None where it was refused, or the tree did not come over.
        difference_cm: Photo less LiDAR.
        difference_pct: Of the LiDAR's.
        centres_apart_cm: Between the stems' centres at breast height, in plan, with the clouds laid on each other.
        n_points_photo: Of the trunk in the photo plot.
        n_points_carried: LiDAR points that took its label.
        n_points_lidar: Of the trunk in the LiDAR plot, after it was tidied up.
        quality_photo: As in the inventory.
        quality_lidar: Likewise.
        remark: Why a diameter is missing.
    """

    stem_id: int
    dbh_photo_cm: float | None
    dbh_lidar_cm: float | None
    difference_cm: float | None
    difference_pct: float | None
    centres_apart_cm: float | None
    n_points_photo: int
    n_points_carried: int
    n_points_lidar: int
    quality_photo: str
    quality_lidar: str
    remark: str


COMPARISON_COLUMNS: tuple[str, ...] = tuple(field.name for field in fields(TreeComparison))


@dataclass(frozen=True)
class ComparisonSummary:
    """All trees with both diameters.

    Attributes:
        n: How many.
        bias_cm: Mean of photo less LiDAR; None for no tree.
        rmse_cm: Root mean square of it.
        median_cm: Median of it.
        median_abs_pct: Median of its size, in per cent of the LiDAR's diameter.
    """

    n: int
    bias_cm: float | None
    rmse_cm: float | None
    median_cm: float | None
    median_abs_pct: float | None


@dataclass(frozen=True, eq=False)
class WalkPicture:
    """What a picture of the residuals shows; at most some hundred poses.

    Attributes:
        placed_m: (K, 3) the camera's places, brought to the LiDAR plot's world.
        target_m: (K, 3) the scanner's at the same times.
        kept: (K,) whether the fit rests on it.
    """

    placed_m: Float64
    target_m: Float64
    kept: Bool

    @property
    def distance_m(self) -> Float64:
        """(K,) between the two."""
        return np.asarray(np.linalg.norm(self.placed_m - self.target_m, axis=1))

    @classmethod
    def of(cls, fit: TrajectoryFit | None) -> WalkPicture | None:
        """Of a fit; None where there is none."""
        residuals = None if fit is None else fit.residuals
        return None if residuals is None else cls(residuals.placed, residuals.target, residuals.kept)


def compare_trees(
    photo: Session,
    lidar: Session,
    lidar_from_photo: Similarity,
    n_carried: Mapping[int, int],
    *,
    progress: Progress = ignore_progress,
) -> tuple[TreeComparison, ...]:
    """Measure both plots and put the trees side by side, in order of id.

    Args:
        photo: With a scale.
        lidar: With trunks of the same ids.
        lidar_from_photo: World to world.
        n_carried: Points that took each label.
        progress: Called for each stem.
    """
    before = {row.stem_id: row for row in photo.inventory(subprogress(progress, 0.0, 0.5))}
    after = {row.stem_id: row for row in lidar.inventory(subprogress(progress, 0.5, 1.0))}
    breast_m = photo.document.settings.measure.breast_height_m
    trees = []
    for i, row in before.items():
        other = after.get(i)
        lidar_trunks = lidar.document.trunks
        mine, theirs = row.dbh_cm, other.dbh_cm if other is not None else None
        difference = None if mine is None or theirs is None else mine - theirs
        trees.append(
            TreeComparison(
                stem_id=i,
                dbh_photo_cm=mine,
                dbh_lidar_cm=theirs,
                difference_cm=difference,
                difference_pct=None if difference is None or not theirs else 100.0 * difference / theirs,
                centres_apart_cm=_apart_cm(row, other, lidar_from_photo, breast_m),
                n_points_photo=len(photo.document.trunks[i]),
                n_points_carried=n_carried.get(i, 0),
                n_points_lidar=len(lidar_trunks[i]) if i in lidar_trunks else 0,
                quality_photo=row.quality,
                quality_lidar=other.quality if other is not None else "",
                remark=_remark(row, other),
            )
        )
    return tuple(trees)


def summary_of(trees: Sequence[TreeComparison]) -> ComparisonSummary:
    """Bias, RMSE and medians over the trees with both diameters."""
    differences = np.array([tree.difference_cm for tree in trees if tree.difference_cm is not None])
    shares = np.array([tree.difference_pct for tree in trees if tree.difference_pct is not None])
    if not len(differences):
        return ComparisonSummary(0, None, None, None, None)
    return ComparisonSummary(
        len(differences),
        float(differences.mean()),
        float(np.sqrt((differences**2).mean())),
        float(np.median(differences)),
        float(np.median(np.abs(shares))) if len(shares) else None,
    )


def _apart_cm(
    row: InventoryRow, other: InventoryRow | None, lidar_from_photo: Similarity, breast_m: float
) -> float | None:
    if other is None or None in (row.x_m, row.y_m, row.z_ground_m, other.x_m, other.y_m):
        return None
    mine = np.array([[row.x_m, row.y_m, float(row.z_ground_m or 0.0) + breast_m]], np.float64)
    placed = np.asarray(lidar_from_photo.apply(mine), np.float64)[0]
    theirs = np.array([other.x_m, other.y_m], np.float64)
    return 100.0 * float(np.linalg.norm(placed[:2] - theirs))


def _remark(row: InventoryRow, other: InventoryRow | None) -> str:
    if other is None:
        return "not in the LiDAR cloud"
    parts = [f"{whose}: {each.reason}" for whose, each in (("photo", row), ("LiDAR", other)) if each.dbh_cm is None]
    return "; ".join(parts)


def comparison_csv(trees: Sequence[TreeComparison]) -> bytes:
    """The table, as the inventory is written: UTF-8, commas, an empty cell for what is not known."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COMPARISON_COLUMNS)
    writer.writerows([_cell(name, getattr(tree, name)) for name in COMPARISON_COLUMNS] for tree in trees)
    return text.getvalue().encode("utf-8", errors="replace")


def _cell(column: str, value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.{COMPARISON_DIGITS[column]}f}"
    return defused(value) if isinstance(value, str) else str(value)


def write_comparison(path: Path, trees: Sequence[TreeComparison]) -> None:
    """Write the table; `path` is replaced whole or stays as it was.

    Raises:
        FileError: It cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as file:
            file.write(comparison_csv(trees))
    except OSError as error:
        raise FileError(
            path,
            f"The table could not be written ({error.strerror or error}).",
            "Close it where it is open, make room on the disk, or choose another folder.",
        ) from error


# ---- in words


def fit_text(report: TransferReport) -> str:
    """How well the clouds lie on each other, in one or two sentences."""
    if report.method == "trajectories":
        text = f"{report.n_pairs} poses of the two walks lie on each other within {100 * report.rms_m:.1f} cm (rms)."
    else:
        text = f"{report.n_pairs} stems lie on each other within {100 * report.rms_m:.1f} cm (rms)."
    if np.isfinite(report.surface_rms_m):
        text += f" Stems and ground were then fitted: {1000 * report.surface_rms_m:.1f} mm apart."
    elif np.isfinite(report.error_m):
        text += f" At the trunks that is sure to {100 * report.error_m:.1f} cm."
    return f"{text} {100 * report.covered:.0f} % of the trunks' points have a LiDAR point in reach."


def scale_text(scale: ScaleEstimate, change: float | None) -> str:
    """The photo cloud's scale as the LiDAR has it, in one sentence."""
    error = scale.standard_error
    sure = "" if error is None else f" ± {100 * error / scale.metres_per_unit:.2f} %"
    text = f"By the LiDAR one unit of the photo cloud is {scale.metres_per_unit:.6g} m{sure}"
    return f"{text}." if change is None else f"{text}, {100 * change:+.2f} % from the scale the photo plot has."


def summary_text(summary: ComparisonSummary) -> str:
    """All trees in one sentence."""
    if not summary.n or summary.bias_cm is None or summary.rmse_cm is None or summary.median_cm is None:
        return "No tree has a diameter in both plots."
    trees = "1 tree" if summary.n == 1 else f"{summary.n} trees"
    share = "" if summary.median_abs_pct is None else f", median size {summary.median_abs_pct:.1f} %"
    return (
        f"Photo less LiDAR over {trees} with both diameters: bias {summary.bias_cm:+.2f} cm, RMSE "
        f"{summary.rmse_cm:.2f} cm, median {summary.median_cm:+.2f} cm{share}."
    )
