"""What a synthetic plot is made from, and what is true of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from dbh_studio.core.arrays import Float64, Int32
from dbh_studio.core.cloud import PointCloud
from dbh_studio.errors import SettingError

# Raised when the same recipe starts to give other points, so that cached plots are made anew.
GENERATOR_VERSION = 1

# Lower and upper bound of every number in a recipe.
_BOUNDS: dict[str, tuple[float, float]] = {
    "seed": (0, 2**31 - 1),
    "n_trees": (0, 2000),
    "n_thin": (0, 2000),
    "n_big": (0, 2000),
    "n_twins": (0, 1000),
    "n_hidden": (0, 100),
    "n_dead": (0, 2000),
    "n_logs": (0, 500),
    "side_m": (4.0, 500.0),
    "points": (1000, 100_000_000),
    "slope_deg": (0.0, 45.0),
    "relief_m": (0.0, 5.0),
    "dbh_min_cm": (5.0, 200.0),
    "dbh_max_cm": (5.0, 200.0),
    "lean_max_deg": (0.0, 25.0),
    "irregularity": (0.0, 3.0),
    "noise": (0.0, 20.0),
    "understorey": (0.0, 5.0),
    "crowns": (0.0, 3.0),
    "lane_m": (2.0, 50.0),
    "ground": (0.0, 5.0),
}


@dataclass(frozen=True)
class PlotRecipe:
    """Everything a plot is made from: the same recipe gives the same points.

    Attributes:
        name: What the cloud is called.
        seed: Of all random numbers. Development uses seeds below 1000, benchmarks 10 000 and up.
        n_trees: Stems of all kinds, each half of a twin counted.
        n_thin: How many of them are 8-12 cm thick.
        n_big: How many of them are 60-90 cm thick.
        n_twins: Pairs forked below breast height; a pair is two of `n_trees`.
        n_hidden: Stems in a thicket that leaves less than a sixth of the ring in sight.
        n_dead: How many are standing dead: grey, and without a crown.
        n_logs: Stems lying on the ground; none of `n_trees`.
        side_m: Side of the square plot.
        points: About how many points there are in all.
        slope_deg: Mean slope.
        relief_m: Height of the hollows and humps on it.
        dbh_min_cm: Of the stems that are neither thin nor big.
        dbh_max_cm: Likewise.
        lean_max_deg: The strongest lean.
        irregularity: 0 makes every section a circle, 1 is what forests have.
        noise: 0 puts the points on the surfaces, 1 is a careful 360° video.
        understorey: Share of ferns, shrubs and grass; 0 for none.
        crowns: Share of branches and leaves above; 0 for none.
        ground: Share of the forest floor; 0 for none, as where somebody has removed it.
        capture: ``walk``: seen from a camera carried along lanes, with occlusion; ``all_round``: from everywhere.
        lane_m: Distance between the lanes of the walk.
    """

    name: str = "synthetic plot"
    seed: int = 1
    n_trees: int = 24
    n_thin: int = 0
    n_big: int = 0
    n_twins: int = 0
    n_hidden: int = 0
    n_dead: int = 0
    n_logs: int = 0
    side_m: float = 30.0
    points: int = 1_200_000
    slope_deg: float = 8.0
    relief_m: float = 0.4
    dbh_min_cm: float = 12.0
    dbh_max_cm: float = 60.0
    lean_max_deg: float = 6.0
    irregularity: float = 1.0
    noise: float = 1.0
    understorey: float = 1.0
    crowns: float = 1.0
    ground: float = 1.0
    capture: str = "walk"
    lane_m: float = 9.0

    def __post_init__(self) -> None:
        for name, (low, high) in _BOUNDS.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
                raise SettingError(f"Plot recipe: {name} is {value!r}.", f"It must lie between {low:g} and {high:g}.")
        for field in fields(self):
            if field.type == "int" and not isinstance(getattr(self, field.name), int):
                raise SettingError(f"Plot recipe: {field.name} must be a whole number.")
        if self.capture not in ("walk", "all_round"):
            raise SettingError(f"Plot recipe: capture is {self.capture!r}.", "It must be walk or all_round.")
        if self.dbh_min_cm > self.dbh_max_cm:
            raise SettingError("Plot recipe: dbh_min_cm is larger than dbh_max_cm.")
        if self.n_thin + self.n_big + 2 * self.n_twins + self.n_hidden > self.n_trees:
            raise SettingError("Plot recipe: there are more thin, big, twin and hidden stems than n_trees.")

    @classmethod
    def simple(cls, **values: Any) -> PlotRecipe:
        """A small, quick plot for tests: a few stems seen all round, with little understorey and no crowns."""
        small: dict[str, Any] = {
            "name": "simple plot",
            "n_trees": 5,
            "side_m": 12.0,
            "points": 100_000,
            "slope_deg": 5.0,
            "relief_m": 0.1,
            "dbh_max_cm": 45.0,
            "understorey": 0.3,
            "crowns": 0.0,
            "capture": "all_round",
        }
        return cls.from_dict({**small, **values})

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> PlotRecipe:
        """A recipe from plain values, as in a JSON file. Raises SettingError on an unknown name or a bad value."""
        if not isinstance(values, Mapping):
            raise SettingError("Plot recipe: it must be a set of names and values.")
        unknown = sorted(set(values) - {field.name for field in fields(cls)})
        if unknown:
            raise SettingError(f"Plot recipe: {', '.join(unknown)} is not known.")
        return cls(**values)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for a JSON file."""
        return asdict(self)

    def changed(self, **values: Any) -> PlotRecipe:
        """A copy with some values changed and checked."""
        return replace(self, **values)


@dataclass(frozen=True, eq=False)
class TreeTruth:
    """What is known of one stem, exactly.

    The sections are taken across the stem's own axis, where the axis is at the given height above the mean ground
    around the stem.

    Attributes:
        tree_id: 1, 2, … as in `SyntheticPlot.tree_ids`.
        x_m: Centre of the stem at 1.30 m.
        y_m: Likewise.
        z_ground_m: Mean height of the ground around the stem.
        lean_deg: Angle between the axis at 1.30 m and the vertical.
        lean_azimuth_deg: Where it leans to, clockwise from +y.
        height_m: Of the tree.
        species: Common English name.
        status: ``live``, ``dead`` or ``twin`` (one of two stems forked below breast height).
        seen_arc_deg: How much of the ring has points between 1.22 and 1.52 m.
        n_points: Points of the stem.
        n_points_band: Those between 1.22 and 1.52 m.
        heights_m: (H,) heights above ground of the diameters below.
        tape_cm: (H,) convex girth / π, over the bark's ridges: what a tape reads.
        curve_cm: (H,) girth / π of the outline without bark ridges: what a curve through the points reads.
        area_cm: (H,) of the circle with the area of that outline.
    """

    tree_id: int
    x_m: float
    y_m: float
    z_ground_m: float
    lean_deg: float
    lean_azimuth_deg: float
    height_m: float
    species: str
    status: str
    seen_arc_deg: float
    n_points: int
    n_points_band: int
    heights_m: Float64
    tape_cm: Float64
    curve_cm: Float64
    area_cm: Float64

    def diameter_cm(self, definition: str = "tape", *, height_m: float = 1.3) -> float:
        """The true diameter: ``tape``, ``curve`` or ``area``. Between the table's heights it is interpolated.

        Raises:
            ValueError: The definition is unknown, or the height is outside the table.
        """
        tables = {"tape": self.tape_cm, "curve": self.curve_cm, "area": self.area_cm}
        if definition not in tables:
            raise ValueError(f"definition {definition!r} is none of {', '.join(tables)}")
        if not self.heights_m[0] <= height_m <= self.heights_m[-1]:
            raise ValueError(f"height {height_m} m is outside {self.heights_m[0]}..{self.heights_m[-1]} m")
        return float(np.interp(height_m, self.heights_m, tables[definition]))


@dataclass(frozen=True, eq=False)
class SyntheticPlot:
    """A made-up plot and the truth about it.

    Attributes:
        cloud: In metres, z up, coloured; its attributes do not give the truth away.
        tree_ids: (N,) which stem each point was drawn from, flying points included; 0 for all else.
        trees: In order of id.
        cameras_m: (C, 3) where the walk's camera stood; empty where `capture` is ``all_round``.
    """

    cloud: PointCloud
    tree_ids: Int32
    trees: tuple[TreeTruth, ...]
    cameras_m: Float64
