from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dbh_studio.core.dbh import CurveFit, DbhEstimate, Diameter, Refusal
from dbh_studio.core.inventory import COLUMNS, Inventory, MapPosition, TreeRecord, inventory_row
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.section import CrossSection
from dbh_studio.core.transforms import Similarity

NAN = float("nan")
NOBODY_SPOKE = TreeRecord()


def make_section(**fields) -> CrossSection:
    values = {
        "uv_m": np.zeros((9, 2)),
        "indices": np.arange(9),
        "stem_from_section": Similarity.identity(),
        "band_m": (1.22, 1.52),
        "hom_m": 1.37,
        "lean_deg": 4.25,
        "axis_source": "stem",
        "coverage_deg": 300.0,
        "max_gap_deg": 60.0,
        **fields,
    }
    return CrossSection(**values)


def make_estimate(*, dbh_cm: float = 31.4159, section: CrossSection | None = None, flags=()) -> DbhEstimate:
    inliers = np.array([True] * 7 + [False] * 2)
    fit = CurveFit("fourier", np.zeros((4, 2)), 0.98, 0.07, 0.97, inliers, 0.0042)
    section = section or make_section()
    fits = {"fourier": fit, "ellipse": Refusal("no_curve", "", "")}
    return DbhEstimate(dbh_cm, "fourier", "tape", section, fits, "fair", tuple(flags), np.zeros(3))


def make_row(result, *, stem_id=7, record=NOBODY_SPOKE, **others):
    values = {
        "plot_id": "P1",
        "xy_m": np.array([1.5, -2.25]),
        "z_ground_m": 0.125,
        "scale": ScaleEstimate(2.0, "marker", 0.01),
        **others,
    }
    return inventory_row(result, stem_id=stem_id, record=record, **values)


def test_a_measured_stem_fills_its_row():
    record = TreeRecord("oak", "live", "fork", "A7", True, 3)
    row = make_row(make_estimate(flags=("small arc", "curves differ")), record=record)
    assert (row.plot_id, row.tree_id, row.stem_id, row.tag, row.status, row.species) == (
        "P1",
        3,
        7,
        "A7",
        "live",
        "oak",
    )
    assert (row.dbh_cm, row.dbh_method, row.dbh_definition, row.hom_m) == (31.4159, "fourier", "tape", 1.37)
    assert (row.coverage_deg, row.max_gap_deg, row.n_points, row.lean_deg) == (300.0, 60.0, 7, 4.25)
    assert row.rmse_mm == pytest.approx(4.2)
    assert (row.dbh_lo_cm, row.dbh_hi_cm, row.taper_cm_per_m) == (None, None, None)  # a curve of the paper has none
    assert row.dbh_curve_cm == pytest.approx(98.0 / np.pi) and row.dbh_tape_cm == pytest.approx(97.0 / np.pi)
    assert (row.quality, row.reason, row.remedy, row.edited) == ("fair", "small arc; curves differ", "", True)
    assert (row.x_m, row.y_m, row.z_ground_m, row.note) == (1.5, -2.25, 0.125, "fork")
    assert row.scale_source == "marker" and row.scale_err_pct == pytest.approx(0.5)
    assert (row.easting, row.northing, row.epsg) == (None, None, None)


def test_an_interval_and_the_other_definitions_fill_their_columns():
    fit = make_estimate().fits["fourier"]
    diameters = {
        "tape": Diameter(31.9, 30.8, 33.0),
        "curve": Diameter(31.7, 30.6, 32.8),
        "area": Diameter(31.6, 30.5, NAN),
    }
    estimate = replace(
        make_estimate(dbh_cm=31.9, flags=("only 200° of the ring seen",)),
        curve="shrinkage",
        fits={"shrinkage": replace(fit, curve="shrinkage", diameters=diameters)},
        flag_codes=("partial_arc", "lean"),
        taper_cm_per_m=1.5,
    )
    row = make_row(estimate)
    assert (row.dbh_cm, row.dbh_lo_cm, row.dbh_hi_cm) == (31.9, 30.8, 33.0)
    assert (row.dbh_tape_cm, row.dbh_tape_lo_cm, row.dbh_tape_hi_cm) == (31.9, 30.8, 33.0)
    assert (row.dbh_curve_cm, row.dbh_curve_lo_cm, row.dbh_curve_hi_cm) == (31.7, 30.6, 32.8)
    assert (row.dbh_area_cm, row.dbh_area_lo_cm, row.dbh_area_hi_cm) == (31.6, 30.5, None)
    assert (row.flags, row.taper_cm_per_m, row.dbh_method) == ("partial_arc;lean", 1.5, "shrinkage")


def test_a_refused_stem_has_a_reason_and_a_remedy_and_no_number():
    row = make_row(Refusal("too_few_points", "Only 4 points at 1.3 m.", "Walk closer."))
    numbers = (row.dbh_cm, row.hom_m, row.coverage_deg, row.max_gap_deg, row.rmse_mm, row.lean_deg)
    assert numbers == (None,) * 6
    assert (row.quality, row.reason, row.remedy) == ("refused", "Only 4 points at 1.3 m.", "Walk closer.")
    assert (row.dbh_method, row.dbh_definition, row.n_points) == ("", "", None)
    assert (row.flags, row.dbh_tape_cm, row.dbh_lo_cm, row.taper_cm_per_m) == ("too_few_points", None, None, None)
    with_section = make_row(Refusal("small_arc", "A small arc.", "Walk round it.", make_section(coverage_deg=80.0)))
    assert with_section.dbh_cm is None and with_section.coverage_deg == 80.0 and with_section.hom_m == 1.37
    assert with_section.n_points == 9


def test_what_is_not_known_is_none_and_never_zero():
    row = make_row(
        make_estimate(section=make_section(axis_source="vertical", lean_deg=0.0, max_gap_deg=NAN)),
        xy_m=np.array([NAN, NAN]),
        z_ground_m=NAN,
        scale=ScaleEstimate(1.0, "metres"),
    )
    unknown = (row.lean_deg, row.max_gap_deg, row.x_m, row.y_m, row.z_ground_m, row.scale_err_pct)
    assert unknown == (None,) * 6
    assert row.tree_id == 7


def test_a_map_position_is_taken_over():
    row = make_row(make_estimate(), position=MapPosition(500_001.5, 4_500_000.25, 32633))
    assert (row.easting, row.northing, row.epsg) == (500_001.5, 4_500_000.25, 32633)


def test_an_inventory_is_in_order_and_counts():
    refused = make_row(Refusal("no_band", "", ""), stem_id=2)
    inventory = Inventory.of([make_row(make_estimate(), stem_id=5), refused])
    assert [row.stem_id for row in inventory] == [2, 5] and len(inventory) == 2
    assert (inventory.n_measured, inventory.n_refused) == (1, 1)
    with pytest.raises(ValueError, match="same stem id"):
        Inventory.of([refused, refused])


@pytest.mark.parametrize(
    "fields",
    [
        {"status": "asleep"},
        {"species": 5},
        {"tree_id": 0},
        {"tree_id": 2**31},
        {"tree_id": 1.5},
        {"tree_id": True},
        {"note": None},
        {"note": "\ud800"},
        {"edited": "yes"},
    ],
)
def test_a_record_holds_only_what_it_can(fields):
    with pytest.raises(ValueError, match="must be"):
        TreeRecord(**fields)


def test_columns_are_a_promise():
    assert ",".join(COLUMNS) == (
        "plot_id,tree_id,stem_id,tag,status,species,dbh_cm,dbh_lo_cm,dbh_hi_cm,dbh_method,dbh_definition,"
        "dbh_tape_cm,dbh_tape_lo_cm,dbh_tape_hi_cm,dbh_curve_cm,dbh_curve_lo_cm,dbh_curve_hi_cm,"
        "dbh_area_cm,dbh_area_lo_cm,dbh_area_hi_cm,tree_dbh_cm,hom_m,breast_height_m,base,along,above,coverage_deg,max_gap_deg,"
        "rmse_mm,n_points,lean_deg,taper_cm_per_m,quality,flags,reason,remedy,edited,x_m,y_m,z_ground_m,scale_source,scale_err_pct,note,"
        "health,crown_class,field_tape_cm,field_tape_height_m,corrections,review,easting,northing,epsg"
    )


def grouped(*stems):
    """(dbh_cm or None, tree) each."""
    refusal = Refusal("small_arc", "Only 80° of the ring seen.", "Walk round it.")
    return Inventory.of(
        make_row(refusal if cm is None else make_estimate(dbh_cm=cm), stem_id=i, record=TreeRecord(tree_id=tree))
        for i, (cm, tree) in enumerate(stems, start=1)
    ).rows


def test_the_diameter_of_a_tree_is_the_root_of_the_sum_of_squares_of_its_stems():
    rows = grouped((30.0, 1), (40.0, 1), (25.0, None))
    assert [row.tree_dbh_cm for row in rows] == pytest.approx([50.0, 50.0, 25.0])
    assert [row.reason for row in rows] == ["", "", ""]


def test_a_stem_without_a_diameter_leaves_the_tree_without_one_and_says_so():
    rows = grouped((30.0, 2), (None, 2), (20.0, 2), (None, None))
    assert [row.tree_dbh_cm for row in rows] == [None] * 4
    assert rows[0].dbh_cm == 30.0
    assert rows[0].reason == rows[2].reason == "tree 2 has no diameter as a whole, because stem 2 has none"
    assert rows[1].reason == rows[3].reason == "Only 80° of the ring seen."
