"""The plots that are measured: two real ones, and generated and synthetic ones whose truth is known.

Seeds: development and tests use seeds below 1000; the seeds here begin at 10 000 and are used for nothing else.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

from bench_cylinders import CylinderRecipe, make
from bench_match import Table, read_table

from dbh_studio.app.demo import demo_plot
from dbh_studio.core.synthetic import PlotRecipe

HERE = Path(__file__).resolve().parent
REAL_FOLDER = HERE.parents[1] / "shared" / "data" / "plots"
DATA_FOLDER = HERE / "data"
FIRST_SEED = 10_000


@dataclass(frozen=True)
class Plot:
    """One plot to measure.

    Attributes:
        name: Short, and the key in the baseline.
        path: The file; None where it is absent.
        truth: What is true of its trees; None where nobody knows.
        has_ground: Whether the ground is in the cloud.
        n_points: How many there are; 0 where unknown.
        note: For the reader of the table.
    """

    name: str
    path: Path | None
    truth: Table | None = None
    has_ground: bool = True
    n_points: int = 0
    note: str = ""


_RECIPES = {
    "generated_0.3M": PlotRecipe(
        name="generated_0.3M", seed=FIRST_SEED + 1, n_trees=6, side_m=14.0, points=300_000, lane_m=7.0
    ),
    "generated_1.7M": PlotRecipe(
        name="generated_1.7M",
        seed=FIRST_SEED + 2,
        n_trees=16,
        n_thin=2,
        n_big=1,
        side_m=22.0,
        points=1_700_000,
        n_logs=3,
    ),
    "generated_10M": PlotRecipe(
        name="generated_10M",
        seed=FIRST_SEED + 3,
        n_trees=60,
        n_thin=6,
        n_big=4,
        side_m=45.0,
        points=10_000_000,
        n_logs=8,
    ),
}
_CYLINDERS = CylinderRecipe(seed=FIRST_SEED + 4)


def real_plots() -> list[Plot]:
    """Real plots, from the folder beside the project; absent ones have no path."""
    plots = [
        Plot("pine_plot", REAL_FOLDER / "pine_plot.laz", n_points=114_024, note="TLS pines, real, no truth"),
        Plot(
            "LPine1_demo",
            REAL_FOLDER / "LPine1_demo.laz",
            has_ground=False,
            n_points=1_544_202,
            note="TLS lodgepole pine, real, ground removed, no truth",
        ),
    ]
    return [
        plot if plot.path is not None and plot.path.is_file() else Plot(plot.name, None, note="the file is absent")
        for plot in plots
    ]


def generated_plot(name: str) -> Plot:
    """A generated plot, made on first use and kept in bench/data."""
    recipe = _RECIPES[name]
    made = demo_plot(DATA_FOLDER, recipe=recipe)
    truth = read_table(made.truth_csv, dbh="dbh_tape_cm")
    note = f"synthetic, seed {recipe.seed}, {recipe.n_trees} stems, tape truth"
    return Plot(name, made.path, truth, n_points=recipe.points, note=note)


def cylinder_plot() -> Plot:
    """Plain round stems, densely covered; made on first use and kept in bench/data."""
    # The recipe is in the name, so that another one is not taken for it.
    path = DATA_FOLDER / f"cylinders_{zlib.crc32(repr(_CYLINDERS).encode()):08x}.laz"
    truth = make(_CYLINDERS, path)
    note = f"cylinders of 12-60 cm every 8 mm, seed {_CYLINDERS.seed}, {len(truth.names)} stems, exact truth"
    return Plot("cylinders_1.7M", path, truth, n_points=1_700_000, note=note)


def plots(*, quick: bool) -> list[Plot]:
    """All plots, or the two small ones."""
    if quick:
        return [real_plots()[0], generated_plot("generated_0.3M")]
    return [*real_plots(), *(generated_plot(name) for name in _RECIPES), cylinder_plot()]
