"""The stand table: stems and basal area per hectare, quadratic mean diameter, diameter classes, per species.

Definitions as in forest mensuration (Avery and Burkhart, *Forest Measurements*): basal area is π d² / 4 at breast
height, the quadratic mean diameter is that of the tree of mean basal area. Area is horizontal. A tree on the edge of
the plot belongs to it if its centre does. Stems without a diameter are counted and stated, never taken as 0: basal area
and mean diameter are those of the stems measured.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from dbh_studio.core.arrays import Bool, Float64, readonly
from dbh_studio.core.inventory import InventoryRow
from dbh_studio.core.polygons import crosses_itself, inside_polygon, signed_area

Units = Literal["metric", "imperial"]
Per = Literal["stem", "tree"]

HECTARE_M2 = 10_000.0
ACRE_M2 = 4_046.8564224  # international
CM_PER_INCH = 2.54
FT2_PER_M2 = 1.0 / 0.3048**2
# Widths of diameter classes that are in use: 5 cm, 2 inches.
CLASS_CM, CLASS_INCHES = 5.0, 2.0
# Each is a line or a column of what is handed in.
MOST_CLASSES = 1_000
# Each side is compared with all others: a coast line of a million corners would take hours.
MOST_CORNERS = 10_000


@dataclass(frozen=True, eq=False)
class PlotArea:
    """The ground the stems are counted on, in the world's plan, metres.

    Attributes:
        outline_m: (M, 2) corners of a polygon, or None for a circle.
        centre_m: (2,) of a circle.
        radius_m: Of a circle.
        kind: ``circle``, ``polygon`` or ``extent``, for the table's head.
    """

    outline_m: Float64 | None
    centre_m: Float64 | None = None
    radius_m: float | None = None
    kind: Literal["circle", "polygon", "extent"] = "polygon"

    @classmethod
    def circle(cls, centre_m: Any, radius_m: float) -> PlotArea:
        """A circular plot.

        Raises:
            ValueError: It has no size, or is nowhere.
        """
        centre = np.asarray(centre_m, np.float64)
        if centre.shape != (2,) or not np.isfinite(centre).all():
            raise ValueError("the centre of the plot is nowhere")
        if not (np.isfinite(radius_m) and radius_m > 0):
            raise ValueError(f"the plot's radius is {radius_m:g} m but must be positive")
        return cls(None, readonly(centre), float(radius_m), "circle")

    @classmethod
    def polygon(cls, corners_m: Any, *, kind: Literal["polygon", "extent"] = "polygon") -> PlotArea:
        """A plot between straight sides; the last corner is joined to the first.

        Raises:
            ValueError: Fewer than three corners or more than `MOST_CORNERS`, sides that cross, or no area.
        """
        corners = np.asarray(corners_m, np.float64)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
            raise ValueError("a plot needs three corners or more, each with x and y")
        if len(corners) > MOST_CORNERS:
            raise ValueError(f"it has {len(corners):,} corners: simplify the outline to {MOST_CORNERS:,} or fewer")
        if crosses_itself(corners):
            raise ValueError("the sides of the plot cross: give the corners in order around it")
        if not abs(signed_area(corners)) > 1e-6:
            raise ValueError("the plot has no area")
        return cls(readonly(corners), kind=kind)

    @classmethod
    def extent(cls, xy_m: Float64) -> PlotArea:
        """The rectangle, along x and y, around (N, 2) places.

        Raises:
            ValueError: They have no extent.
        """
        places = np.asarray(xy_m, np.float64).reshape(-1, 2)
        places = places[np.isfinite(places).all(axis=1)]
        if not len(places):
            raise ValueError("nothing says how large the plot is")
        (x0, y0), (x1, y1) = places.min(axis=0), places.max(axis=0)
        return cls.polygon([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], kind="extent")

    @property
    def area_m2(self) -> float:
        """Horizontal area."""
        if self.outline_m is None:
            assert self.radius_m is not None
            return float(np.pi * self.radius_m**2)
        return abs(signed_area(self.outline_m))

    def contains(self, xy_m: Any) -> Bool:
        """(N,) which of (N, 2) places are in it; those exactly on a circle are. NaN is nowhere."""
        xy = np.asarray(xy_m, np.float64).reshape(-1, 2)
        if self.outline_m is None:
            assert self.centre_m is not None and self.radius_m is not None
            return np.asarray(np.hypot(*(xy - self.centre_m).T) <= self.radius_m)
        return inside_polygon(xy, self.outline_m)


@dataclass(frozen=True)
class StandRow:
    """The figures of one species, or of all.

    Attributes:
        species: As the person writes it; empty where nobody said.
        n_trees: Trees; the stems of a multi-stem tree make one.
        n_stems: Stems, those without a diameter included.
        n_refused: Stems without a diameter; of a table per tree, trees without one.
        stems_per_area: Per hectare or acre; trees where the table is per tree, as in `classes`.
        basal_area: m² per hectare or ft² per acre, of the stems measured; None where all of them are refused.
        qmd: Quadratic mean diameter of stems, or of trees by √Σd², cm or inches; None where none is measured.
        mean: Arithmetic mean diameter, likewise.
        least: Smallest diameter, likewise.
        greatest: Largest diameter, likewise.
        classes: Stems per area in each class of the table.
    """

    species: str
    n_trees: int
    n_stems: int
    n_refused: int
    stems_per_area: float
    basal_area: float | None
    qmd: float | None
    mean: float | None
    least: float | None
    greatest: float | None
    classes: tuple[float, ...]


@dataclass(frozen=True)
class StandTable:
    """The stand table of one plot.

    Attributes:
        rows: Per species, by basal area, the largest first.
        total: Of all species.
        area_m2: Horizontal area of the plot.
        units: ``metric``: cm, m², hectares; ``imperial``: inches, ft², acres.
        class_edges: Lower edges of the diameter classes, and the upper edge of the last.
        n_outside: Stems that stand outside the plot, or nowhere; trees where the table is per tree.
        per: What is counted and what the diameters are of.
        least_dbh_cm: Thinner ones are left out.
        n_thin: How many those are of the ones inside the plot.
    """

    rows: tuple[StandRow, ...]
    total: StandRow
    area_m2: float
    units: Units
    class_edges: tuple[float, ...]
    n_outside: int
    per: Per = "stem"
    least_dbh_cm: float = 0.0
    n_thin: int = 0


def stand_table(
    rows: Iterable[InventoryRow],
    area: PlotArea,
    *,
    units: Units = "metric",
    class_width: float | None = None,
    least_dbh_cm: float = 0.0,
    per: Per = "stem",
) -> StandTable:
    """Count and sum the stems of an inventory.

    Args:
        rows: Of the inventory.
        area: Of the plot; a stem whose centre is outside is left out.
        units: Of the table.
        class_width: Of diameter classes, cm or inches; 5 cm or 2 inches by default. Classes begin at multiples of it.
        least_dbh_cm: Thinner stems are left out, as the rules of most inventories have it.
        per: ``tree`` counts the stems of a multi-stem tree once, with the diameter √Σd² (`InventoryRow.tree_dbh_cm`),
            at the mean of their places; a tree of which one stem has no diameter has none.

    Raises:
        ValueError: The class width is not positive, or so small that there are more than `MOST_CLASSES`.
    """
    is_metric = units == "metric"
    width = (CLASS_CM if is_metric else CLASS_INCHES) if class_width is None else class_width
    if not (np.isfinite(width) and width > 0):
        raise ValueError(f"diameter classes are {width:g} wide but must be wider than 0")
    every = list(rows)
    n_stems_of = Counter(row.tree_id for row in every)
    if per == "tree":
        every = _one_per_tree(every)
    places = np.array([[_or_nan(row.x_m), _or_nan(row.y_m)] for row in every], np.float64).reshape(-1, 2)
    is_inside = area.contains(places)
    chosen = [
        row
        for row, inside in zip(every, is_inside, strict=True)
        if inside and (row.dbh_cm is None or row.dbh_cm >= least_dbh_cm)
    ]
    to_unit = 1.0 if is_metric else 1.0 / CM_PER_INCH
    known = np.array([row.dbh_cm * to_unit for row in chosen if row.dbh_cm is not None], np.float64)
    edges = _class_edges(known, width)
    per_area = (HECTARE_M2 if is_metric else ACRE_M2) / area.area_m2
    to_basal = 1.0 if is_metric else FT2_PER_M2

    def of(species: str, part: Sequence[InventoryRow]) -> StandRow:
        dbh_cm = np.array([row.dbh_cm for row in part if row.dbh_cm is not None], np.float64)
        shown = dbh_cm * to_unit
        counts = np.histogram(shown, edges)[0] if len(edges) > 1 else np.empty(0)
        has = len(shown) > 0
        basal_area = float(np.sum(np.pi / 4 * (dbh_cm / 100) ** 2)) * per_area * to_basal
        return StandRow(
            species=species,
            n_trees=len({row.tree_id for row in part}),
            n_stems=len(part) if per == "stem" else sum(n_stems_of[row.tree_id] for row in part),
            n_refused=len(part) - len(dbh_cm),
            stems_per_area=len(part) * per_area,
            basal_area=basal_area if has or not part else None,
            qmd=float(np.sqrt(np.mean(shown**2))) if has else None,
            mean=float(shown.mean()) if has else None,
            least=float(shown.min()) if has else None,
            greatest=float(shown.max()) if has else None,
            classes=tuple(float(count) * per_area for count in counts),
        )

    names = sorted({row.species for row in chosen})
    by_species = [of(name, [row for row in chosen if row.species == name]) for name in names]
    by_species.sort(key=lambda row: (-(row.basal_area or 0.0), row.species))
    return StandTable(
        tuple(by_species),
        of("", chosen),
        area.area_m2,
        units,
        tuple(edges.tolist()),
        int(np.count_nonzero(~is_inside)),
        per,
        least_dbh_cm,
        int(np.count_nonzero(is_inside)) - len(chosen),
    )


def _one_per_tree(rows: Sequence[InventoryRow]) -> list[InventoryRow]:
    """A row per tree: that of its first stem, with the tree's diameter and the mean of its stems' places."""
    stems: dict[int, list[InventoryRow]] = {}
    for row in rows:
        stems.setdefault(row.tree_id, []).append(row)
    trees = []
    for group in stems.values():
        places = [(row.x_m, row.y_m) for row in group if row.x_m is not None and row.y_m is not None]
        x_m, y_m = np.mean(places, axis=0).tolist() if places else (None, None)
        # The first stem's species may be all that is written down; a tree has one.
        species = next((row.species for row in group if row.species), "")
        trees.append(replace(group[0], dbh_cm=group[0].tree_dbh_cm, x_m=x_m, y_m=y_m, species=species))
    return trees


def _class_edges(diameters: Float64, width: float) -> Float64:
    """Edges at multiples of the width around all diameters; none without any."""
    if not len(diameters):
        return np.empty(0)
    # A diameter on an edge belongs to the class above, so the last class reaches beyond it.
    first, last = int(diameters.min() // width), int(diameters.max() // width) + 1
    if last - first > MOST_CLASSES:
        raise ValueError(f"classes {width:g} wide make {last - first:,} of them; {MOST_CLASSES:,} are the most")
    return np.asarray(width * np.arange(first, last + 1), np.float64)


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else value
