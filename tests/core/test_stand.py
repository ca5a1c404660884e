"""The stand table against numbers worked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dbh_studio.core.inventory import Inventory, TreeRecord, inventory_row
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.stand import PlotArea, stand_table

METRES = ScaleEstimate(1.0, "metres")


def rows(*stems):
    """(dbh_cm or None, x, y, species, tree) each."""
    from dbh_studio.core.dbh import Refusal

    made = []
    for number, (dbh_cm, x, y, species, tree) in enumerate(stems, start=1):
        row = inventory_row(
            Refusal("few", "few points", "walk closer"),
            plot_id="p",
            stem_id=number,
            record=TreeRecord(species=species, tree_id=tree),
            xy_m=np.array([x, y], float),
            z_ground_m=0.0,
            scale=METRES,
        )
        # A stem that was measured: the figures of the table use nothing of the row but its diameter.
        made.append(type(row)(**{**{f: getattr(row, f) for f in row.__dataclass_fields__}, "dbh_cm": dbh_cm}))
    return Inventory.of(made)


STEMS = rows(
    (20.0, 0, 0, "oak", None),
    (40.0, 3, 4, "oak", None),  # exactly on a circle of 5 m
    (None, 1, 1, "oak", None),
    (30.0, -2, 1, "", None),
    (10.0, 2, -1, "ash", 5),
    (10.0, 2, -2, "ash", 5),
    (90.0, 5, 4, "oak", None),  # outside
    (25.0, math.nan, math.nan, "oak", None),  # nowhere
)


def test_a_circular_plot_by_hand():
    table = stand_table(STEMS, PlotArea.circle((0, 0), 5.0))
    area = math.pi * 25
    assert table.area_m2 == pytest.approx(area)
    total = table.total
    assert (total.n_stems, total.n_trees, total.n_refused, table.n_outside) == (6, 5, 1, 2)
    assert total.stems_per_area == pytest.approx(6 * 10_000 / area)
    # Basal area: π/4 (0.2² + 0.4² + 0.3² + 0.1² + 0.1²) = π/4 · 0.31 m².
    assert total.basal_area == pytest.approx(math.pi / 4 * 0.31 * 10_000 / area)
    # √((400 + 1600 + 900 + 100 + 100) / 5) = √620 cm; the mean is 110 / 5.
    assert total.qmd == pytest.approx(math.sqrt(620)) and total.mean == pytest.approx(22)
    assert (total.least, total.greatest) == (10, 40)
    assert [row.species for row in table.rows] == ["oak", "", "ash"]  # by basal area
    oak = table.rows[0]
    assert (oak.n_stems, oak.n_refused, oak.n_trees) == (3, 1, 3) and oak.qmd == pytest.approx(math.sqrt(1000))
    assert table.rows[2].n_trees == 1 and table.rows[2].n_stems == 2


def test_a_diameter_on_an_edge_belongs_to_the_class_above():
    table = stand_table(STEMS, PlotArea.circle((0, 0), 5.0))
    per_stem = 10_000 / table.area_m2
    assert table.class_edges == (10, 15, 20, 25, 30, 35, 40, 45)
    assert table.total.classes == pytest.approx([2 * per_stem, 0, per_stem, 0, per_stem, 0, per_stem])
    assert sum(table.total.classes) == pytest.approx(5 * per_stem)


def test_imperial_is_the_same_stand():
    plot = PlotArea.polygon([(-4, -4), (-4, 4.5), (4, 4.5), (4, -4)])
    metric, imperial = stand_table(STEMS, plot), stand_table(STEMS, plot, units="imperial")
    assert imperial.total.qmd == pytest.approx(metric.total.qmd / 2.54)
    # 1 m²/ha = 4.356 ft²/acre; 1 hectare = 2.471 acres.
    assert imperial.total.basal_area / metric.total.basal_area == pytest.approx(4.356, rel=1e-3)
    assert metric.total.stems_per_area / imperial.total.stems_per_area == pytest.approx(2.4711, rel=1e-4)
    assert np.diff(imperial.class_edges) == pytest.approx(2)


def test_thin_stems_may_be_left_out_but_those_without_a_number_are_counted():
    table = stand_table(STEMS, PlotArea.circle((0, 0), 5.0), least_dbh_cm=12)
    assert (table.total.n_stems, table.total.n_refused) == (4, 1)
    assert (table.least_dbh_cm, table.n_thin) == (
        12,
        stand_table(STEMS, PlotArea.circle((0, 0), 5.0)).total.n_stems - 4,
    )


def test_polygons_hold_what_is_inside_also_far_from_the_origin():
    corners = np.array([(0, 0), (10, 0), (10, 10), (5, 2), (0, 10)]) + [500_000.0, 4_500_000.0]
    plot = PlotArea.polygon(corners)
    assert plot.area_m2 == pytest.approx(100 - 40)
    inside = plot.contains(np.array([(5, 1), (5, 5), (1, 7), (11, 1), (np.nan, 1)]) + [500_000.0, 4_500_000.0])
    assert inside.tolist() == [True, False, True, False, False]
    assert PlotArea.extent(corners).area_m2 == pytest.approx(100) and PlotArea.extent(corners).kind == "extent"


@pytest.mark.parametrize(
    "make",
    [
        lambda: PlotArea.circle((0, 0), 0),
        lambda: PlotArea.circle((0, math.nan), 1),
        lambda: PlotArea.polygon([(0, 0), (1, 1)]),
        lambda: PlotArea.polygon([(0, 0), (1, 1), (1, 0), (0, 1)]),
        lambda: PlotArea.polygon([(0, 0), (1, 1), (2, 2)]),
        lambda: PlotArea.extent(np.full((3, 2), math.nan)),
        lambda: stand_table(STEMS, PlotArea.circle((0, 0), 1), class_width=0),
        lambda: stand_table(STEMS, PlotArea.circle((0, 0), 5), class_width=1e-4),
    ],
)
def test_a_plot_that_is_none_is_refused(make):
    with pytest.raises(ValueError, match=r"\w+ \w+"):
        make()


def test_a_plot_without_stems_has_no_means():
    table = stand_table(Inventory(), PlotArea.circle((0, 0), 5.0))
    assert table.rows == () and table.total.qmd is None and table.total.stems_per_area == 0
    assert table.class_edges == () and table.total.classes == ()
    only_refused = stand_table(rows((None, 0, 0, "", None)), PlotArea.circle((0, 0), 5.0))
    assert (
        only_refused.total.n_refused == 1 and only_refused.total.mean is None and only_refused.total.basal_area is None
    )


def test_per_tree_a_multi_stem_tree_counts_once_with_its_own_diameter():
    """10² + 10² = 14.14² cm; the basal area is that of the stems."""
    plot = PlotArea.circle((0, 0), 5.0)
    stems, trees = stand_table(STEMS, plot), stand_table(STEMS, plot, per="tree")
    assert (stems.per, trees.per) == ("stem", "tree")
    assert (trees.total.n_trees, trees.total.n_stems, trees.total.n_refused, trees.n_outside) == (5, 6, 1, 2)
    assert trees.total.stems_per_area == pytest.approx(stems.total.stems_per_area * 5 / 6)
    assert trees.total.basal_area == pytest.approx(stems.total.basal_area)
    assert trees.total.qmd == pytest.approx(math.sqrt((400 + 1600 + 900 + 200) / 4))
    assert trees.total.least == pytest.approx(math.sqrt(200))
    ash = next(row for row in trees.rows if row.species == "ash")
    assert (ash.n_trees, ash.n_stems) == (1, 2) and sum(ash.classes) == pytest.approx(ash.stems_per_area)


def test_per_tree_a_stem_without_a_diameter_leaves_its_tree_without():
    inventory = rows((30.0, 0, 0, "", 4), (None, 1, 0, "oak", 4), (20.0, 2, 0, "ash", None))
    table = stand_table(inventory, PlotArea.circle((0, 0), 5.0), per="tree")
    assert (table.total.n_trees, table.total.n_stems, table.total.n_refused) == (2, 3, 1)
    assert table.total.greatest == 20.0
    assert [row.species for row in table.rows] == ["ash", "oak"]


def test_per_tree_the_place_is_the_mean_of_the_stems():
    inventory = rows((30.0, 0, 0, "", 1), (30.0, 4, 0, "", 1))
    assert stand_table(inventory, PlotArea.circle((0, 0), 3.0), per="tree").total.n_trees == 1
    assert stand_table(inventory, PlotArea.circle((0, 0), 1.0), per="tree").n_outside == 1
