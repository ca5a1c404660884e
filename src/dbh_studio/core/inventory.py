"""The inventory: one row per stem, with everything needed to judge and to repeat its number.

What is not known is None, never 0. Column names carry their units. `io.inventory_csv` writes it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.protocols import Protocol, measured_by
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.tree_record import TREE_STATUSES, Review, TreeRecord, TreeStatus, check_text

# `core.dbh` needs scipy, which takes a second to import; the saved plot needs only `TreeRecord` from here.
if TYPE_CHECKING:
    from dbh_studio.core.dbh import CurveFit, DbhEstimate, Refusal

__all__ = [
    "COLUMNS",
    "TREE_STATUSES",
    "Inventory",
    "InventoryRow",
    "MapPosition",
    "TreeRecord",
    "TreeStatus",
    "check_text",
    "inventory_row",
    "review_state",
]


# A diameter that moves by more is another one than was looked at; less is not seen in a table.
MOVED_CM = 0.05


@dataclass(frozen=True)
class MapPosition:
    """Where a stem stands in the source's coordinate reference system, in that system's unit."""

    easting: float
    northing: float
    epsg: int | None = None


@dataclass(frozen=True)
class InventoryRow:
    """One stem. The fields are the columns, in their order.

    Attributes:
        tree_id: The tree the stem belongs to; `stem_id` is unique in the plot.
        dbh_cm: By `dbh_method` and `dbh_definition`; `dbh_lo_cm` and `dbh_hi_cm` are its 90 % interval, None where the
            method has none (the paper's curves).
        dbh_tape_cm: Convex girth/π, with its interval; `dbh_curve_cm` is perimeter/π, `dbh_area_cm` 2√(A/π). `dbh_cm`
            is one of the three.
        taper_cm_per_m: Loss of diameter per metre of stem.
        flags: Short names of what to look at, see `core.measured.Flag`; `reason` says it in words.
        tree_dbh_cm: Of the whole tree: √Σd² of its stems, the same in each of their rows; None where one of them has no
            diameter. Of a tree of one stem its `dbh_cm`.
        hom_m: Height of measurement above the base, vertically.
        breast_height_m: The height that was looked for; with `base`, `along` and `above` the rules by which it was, see
            `core.protocols.Protocol`.
        n_points: Points of the section that support the curve; all of the section where there is no diameter.
        lean_deg: None where the axis was assumed vertical for want of stem.
        quality: ``good``, ``fair``, ``poor``, or ``refused`` where `dbh_cm` is None.
        reason: Why it is refused, or what to look at; `remedy` says what would help.
        x_m: With `y_m` and `z_ground_m`, in the world frame: metres about the plot's local origin, z up.
        scale_err_pct: Standard error of the scale. The intervals have it in them; every other length has it on top of
            its own error.
        field_tape_cm: What a tape read in the field, as a person entered it; never mixed with the estimate.
        corrections: Kinds of `core.corrections.Correction` that the measurement rests on.
        review: ``accepted`` or ``doubtful``, ``stale`` where the number has moved since, empty where nobody looked.
        easting: With `northing`, in the source's coordinate reference system, where it has one.
    """

    plot_id: str
    tree_id: int
    stem_id: int
    tag: str
    status: str
    species: str
    dbh_cm: float | None
    dbh_lo_cm: float | None
    dbh_hi_cm: float | None
    dbh_method: str
    dbh_definition: str
    dbh_tape_cm: float | None
    dbh_tape_lo_cm: float | None
    dbh_tape_hi_cm: float | None
    dbh_curve_cm: float | None
    dbh_curve_lo_cm: float | None
    dbh_curve_hi_cm: float | None
    dbh_area_cm: float | None
    dbh_area_lo_cm: float | None
    dbh_area_hi_cm: float | None
    tree_dbh_cm: float | None
    hom_m: float | None
    breast_height_m: float | None
    base: str
    along: str
    above: str
    coverage_deg: float | None
    max_gap_deg: float | None
    rmse_mm: float | None
    n_points: int | None
    lean_deg: float | None
    taper_cm_per_m: float | None
    quality: str
    flags: str
    reason: str
    remedy: str
    edited: bool
    x_m: float | None
    y_m: float | None
    z_ground_m: float | None
    scale_source: str
    scale_err_pct: float | None
    note: str
    health: str
    crown_class: str
    field_tape_cm: float | None
    field_tape_height_m: float | None
    corrections: str
    review: str
    easting: float | None
    northing: float | None
    epsg: int | None


COLUMNS: tuple[str, ...] = tuple(column.name for column in fields(InventoryRow))
_DIAMETER_COLUMNS = tuple(name for name in COLUMNS if name.startswith("dbh_") and name.endswith("_cm"))


@dataclass(frozen=True)
class Inventory:
    """The rows in order of stem id. A table to read; it is never edited.

    Attributes:
        rows: One per stem.
        own: Fields the person has added, as (stem id, ((name, value), …)); stems without any are not in it.
    """

    rows: tuple[InventoryRow, ...] = ()
    own: tuple[tuple[int, tuple[tuple[str, str], ...]], ...] = ()

    @classmethod
    def of(
        cls, rows: Iterable[InventoryRow], own: Mapping[int, tuple[tuple[str, str], ...]] | None = None
    ) -> Inventory:
        """Put rows in order of stem id, with the fields the person has added, and with the diameters of whole trees.

        Raises:
            ValueError: Two rows have the same stem id.
        """
        ordered = tuple(sorted(rows, key=lambda row: row.stem_id))
        if len({row.stem_id for row in ordered}) != len(ordered):
            raise ValueError("two rows have the same stem id")
        return cls(
            _with_tree_diameters(ordered), tuple(sorted((i, pairs) for i, pairs in (own or {}).items() if pairs))
        )

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[InventoryRow]:
        return iter(self.rows)

    @property
    def own_names(self) -> tuple[str, ...]:
        """Names of the fields the person has added, in order."""
        return tuple(sorted({name for _, pairs in self.own for name, _ in pairs}))

    @property
    def n_measured(self) -> int:
        """How many stems have a diameter."""
        return sum(row.dbh_cm is not None for row in self.rows)

    @property
    def n_refused(self) -> int:
        """How many stems have none."""
        return len(self.rows) - self.n_measured


def _with_tree_diameters(rows: tuple[InventoryRow, ...]) -> tuple[InventoryRow, ...]:
    """The rows with √Σd² of each tree's stems, and words where a stem without a diameter leaves the tree without."""
    stems: dict[int, list[InventoryRow]] = {}
    for row in rows:
        stems.setdefault(row.tree_id, []).append(row)
    told: dict[int, InventoryRow] = {}
    for tree_id, group in stems.items():
        known = [row.dbh_cm for row in group if row.dbh_cm is not None]
        if len(known) in (0, len(group)):
            tree_cm = known[0] if len(known) == 1 else float(np.sqrt(np.sum(np.square(known)))) if known else None
            told.update((row.stem_id, replace(row, tree_dbh_cm=tree_cm)) for row in group if row.tree_dbh_cm != tree_cm)
            continue
        missing = ", ".join(str(row.stem_id) for row in group if row.dbh_cm is None)
        words = f"tree {tree_id} has no diameter as a whole, because stem {missing} has none"
        for row in group:
            reason = row.reason if row.dbh_cm is None else "; ".join(filter(None, (row.reason, words)))
            told[row.stem_id] = replace(row, tree_dbh_cm=None, reason=reason)
    return tuple(told.get(row.stem_id, row) for row in rows)


def _known(value: float | None) -> float | None:
    """`value` where it is a number; NaN and infinity are not known."""
    return None if value is None or not np.isfinite(value) else float(value)


def _chosen_fit(result: DbhEstimate | Refusal) -> CurveFit | None:
    from dbh_studio.core.dbh import CurveFit, DbhEstimate

    fit = result.fits.get(result.curve) if isinstance(result, DbhEstimate) else None
    return fit if isinstance(fit, CurveFit) else None


def inventory_row(
    result: DbhEstimate | Refusal,
    *,
    plot_id: str,
    stem_id: int,
    record: TreeRecord,
    xy_m: Float64,
    z_ground_m: float,
    scale: ScaleEstimate,
    edited: bool = False,
    position: MapPosition | None = None,
    protocol: Protocol | None = None,
) -> InventoryRow:
    """The row of one stem.

    Args:
        result: Its diameter, or why there is none.
        record: What a person said about it.
        xy_m: (2,) position in the world frame; NaN where unknown.
        edited: Whether a person made or changed the stem's points (besides `record.edited`).
        position: In the source's coordinate reference system, where it has one.
        protocol: By which rules it was measured; None where it was not.
    """
    section, fit = result.section, _chosen_fit(result)
    # An assumed axis tells nothing about the lean.
    lean_deg = section.lean_deg if section is not None and section.axis_source == "stem" else None
    error_pct = 100.0 * scale.standard_error / scale.metres_per_unit if scale.standard_error is not None else None
    return InventoryRow(
        plot_id=plot_id,
        tree_id=record.tree_id or stem_id,
        stem_id=stem_id,
        tag=record.tag,
        status=record.status,
        species=record.species,
        **_result_cells(result, record.flag),
        hom_m=_known(section.hom_m) if section else None,
        breast_height_m=_known(protocol.breast_height_m) if protocol else None,
        base=protocol.base if protocol else "",
        along=protocol.along if protocol else "",
        above=protocol.above if protocol else "",
        coverage_deg=_known(section.coverage_deg) if section else None,
        max_gap_deg=_known(section.max_gap_deg) if section else None,
        rmse_mm=_known(1000.0 * fit.rmse_m) if fit else None,
        n_points=int(fit.inliers.sum()) if fit else len(section.indices) if section else None,
        lean_deg=_known(lean_deg),
        edited=edited or record.edited,
        x_m=_known(float(xy_m[0])),
        y_m=_known(float(xy_m[1])),
        z_ground_m=_known(z_ground_m),
        scale_source=scale.source,
        scale_err_pct=_known(error_pct),
        note=record.note,
        health=record.health,
        crown_class=record.crown_class,
        field_tape_cm=_known(record.correction("tape")),
        field_tape_height_m=_known(record.correction("tape_height")),
        corrections=";".join(measured_by(record.corrections)),
        review=review_state(record.review, result),
        easting=_known(position.easting) if position else None,
        northing=_known(position.northing) if position else None,
        epsg=position.epsg if position else None,
    )


def review_state(review: Review | None, result: DbhEstimate | Refusal) -> str:
    """The decision as it stands: ``accepted``, ``doubtful``, ``stale`` where the number has moved since, or empty."""
    from dbh_studio.core.dbh import DbhEstimate

    if review is None:
        return ""
    if isinstance(result, DbhEstimate):
        is_same = review.dbh_cm is not None and abs(result.dbh_cm - review.dbh_cm) <= MOVED_CM
    else:
        is_same = review.dbh_cm is None and review.refusal == result.code
    return review.decision if is_same else "stale"


def _result_cells(result: DbhEstimate | Refusal, flag: str = "") -> dict[str, Any]:
    """The columns that an estimate and a refusal fill differently; `flag` is one more thing to look at."""
    from dbh_studio.core.dbh import DbhEstimate

    if isinstance(result, DbhEstimate):
        low, high = result.interval or (None, None)
        cells: dict[str, Any] = {"dbh_cm": _known(result.dbh_cm), "dbh_lo_cm": _known(low), "dbh_hi_cm": _known(high)}
        for name, diameter in result.diameters.items():
            cells[f"dbh_{name}_cm"] = _known(diameter.value_cm)
            cells[f"dbh_{name}_lo_cm"] = _known(diameter.low_cm)
            cells[f"dbh_{name}_hi_cm"] = _known(diameter.high_cm)
        return {
            **cells,
            "tree_dbh_cm": cells["dbh_cm"],
            "dbh_method": result.curve,
            "dbh_definition": result.definition,
            "taper_cm_per_m": _known(result.taper_cm_per_m),
            "quality": result.quality,
            "flags": ";".join(result.flag_codes),
            "reason": "; ".join(filter(None, (*result.flags, flag))),
            "remedy": "",
        }
    return {
        **dict.fromkeys(_DIAMETER_COLUMNS),
        "tree_dbh_cm": None,
        "dbh_method": "",
        "dbh_definition": "",
        "taper_cm_per_m": None,
        "quality": "refused",
        "flags": result.code,
        "reason": "; ".join(filter(None, (result.reason, flag))),
        "remedy": result.remedy,
    }
