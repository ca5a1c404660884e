from __future__ import annotations

import csv
import io
import os
import re
import sys
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbh_studio.core.inventory import COLUMNS, Inventory, InventoryRow
from dbh_studio.errors import FileError
from dbh_studio.io.column_names import own_columns, own_field
from dbh_studio.io.inventory_csv import (
    check_absent,
    check_not_source,
    check_replaceable,
    defused,
    inventory_csv,
    projected_epsg,
    undefused,
    write_inventory_csv,
)

MEASURED = InventoryRow(
    plot_id="Stand 4",
    tree_id=1,
    stem_id=1,
    tag="A-7",
    status="live",
    species="Fagus sylvatica",
    dbh_cm=31.41593,
    dbh_lo_cm=30.2,
    dbh_hi_cm=32.65,
    dbh_method="shrinkage",
    dbh_definition="curve",
    dbh_tape_cm=31.7,
    dbh_tape_lo_cm=30.5,
    dbh_tape_hi_cm=32.96,
    dbh_curve_cm=31.41593,
    dbh_curve_lo_cm=30.2,
    dbh_curve_hi_cm=32.65,
    dbh_area_cm=31.3,
    dbh_area_lo_cm=30.1,
    dbh_area_hi_cm=32.5,
    tree_dbh_cm=31.41593,
    hom_m=1.37,
    breast_height_m=1.3,
    base="midpoint",
    along="vertical",
    above="nothing",
    coverage_deg=300.04,
    max_gap_deg=59.96,
    rmse_mm=4.25,
    n_points=812,
    lean_deg=3.14,
    taper_cm_per_m=1.234,
    quality="good",
    flags="",
    reason="",
    remedy="",
    edited=False,
    x_m=1.5,
    y_m=-2.25,
    z_ground_m=-0.0001,
    scale_source="marker",
    scale_err_pct=0.15,
    note='low fork, "twin"',
    health="thin crown",
    crown_class="dominant",
    field_tape_cm=31.9,
    field_tape_height_m=1.3,
    corrections="curve;ground",
    review="accepted",
    easting=500001.5,
    northing=4499997.75,
    epsg=32633,
)
REFUSED = replace(
    MEASURED,
    tree_id=2,
    stem_id=2,
    tag="=HYPERLINK(1)",
    status="",
    species="Weißtanne",
    dbh_cm=None,
    dbh_lo_cm=None,
    dbh_hi_cm=None,
    dbh_tape_cm=None,
    dbh_tape_lo_cm=None,
    dbh_tape_hi_cm=None,
    dbh_curve_cm=None,
    dbh_curve_lo_cm=None,
    dbh_curve_hi_cm=None,
    dbh_area_cm=None,
    dbh_area_lo_cm=None,
    dbh_area_hi_cm=None,
    dbh_method="",
    dbh_definition="",
    tree_dbh_cm=None,
    hom_m=None,
    coverage_deg=None,
    max_gap_deg=None,
    rmse_mm=None,
    n_points=4,
    lean_deg=None,
    taper_cm_per_m=None,
    quality="refused",
    flags="too_few_points",
    reason="Only 4 points at 1.3 m.",
    remedy="Walk closer.",
    edited=True,
    x_m=None,
    y_m=None,
    z_ground_m=None,
    scale_err_pct=None,
    note="",
    health="",
    crown_class="",
    field_tape_cm=None,
    field_tape_height_m=None,
    corrections="",
    review="",
    easting=None,
    northing=None,
    epsg=None,
)

GOLDEN = (
    "plot_id,tree_id,stem_id,tag,status,species,dbh_cm,dbh_lo_cm,dbh_hi_cm,dbh_method,dbh_definition,"
    "dbh_tape_cm,dbh_tape_lo_cm,dbh_tape_hi_cm,dbh_curve_cm,dbh_curve_lo_cm,dbh_curve_hi_cm,"
    "dbh_area_cm,dbh_area_lo_cm,dbh_area_hi_cm,tree_dbh_cm,hom_m,breast_height_m,base,along,above,"
    "coverage_deg,max_gap_deg,rmse_mm,"
    "n_points,lean_deg,taper_cm_per_m,quality,flags,reason,remedy,edited,x_m,y_m,z_ground_m,scale_source,scale_err_pct,"
    "note,health,crown_class,field_tape_cm,field_tape_height_m,corrections,review,easting,northing,epsg\n"
    "Stand 4,1,1,A-7,live,Fagus sylvatica,31.42,30.20,32.65,shrinkage,curve,31.70,30.50,32.96,31.42,30.20,32.65,"
    "31.30,30.10,32.50,31.42,1.370,1.300,midpoint,vertical,nothing,300.0,60.0,4.2,812,3.1,1.23,good,,,,false,"
    "1.500,-2.250,"
    '0.000,marker,0.150,"low fork, ""twin""",thin crown,dominant,31.90,1.300,curve;ground,accepted,500001.500,'
    "4499997.750,32633\n"
    "Stand 4,2,2,'=HYPERLINK(1),,Weißtanne,,,,,,,,,,,,,,,,,1.300,midpoint,vertical,nothing,,,,4,,,refused,"
    "too_few_points,Only 4 points at 1.3 m.,"
    "Walk closer.,true,,,,marker,,,,,,,,,,,\n"
).encode()


def test_the_bytes_are_golden():
    assert inventory_csv(Inventory.of([REFUSED, MEASURED])) == GOLDEN
    assert inventory_csv(Inventory.of([REFUSED, MEASURED]), bom=True) == b"\xef\xbb\xbf" + GOLDEN


def test_an_empty_inventory_is_a_header():
    assert inventory_csv(Inventory()) == GOLDEN.split(b"\n")[0] + b"\n"


@given(st.text(max_size=30))
def test_any_text_comes_back_and_never_starts_a_formula(text):
    row = replace(MEASURED, note=text, species=text)
    rows = list(csv.reader(io.StringIO(inventory_csv(Inventory((row,))).decode(), newline=""), strict=True))
    assert len(rows) == 2 and len(rows[1]) == len(COLUMNS)
    cell = rows[1][COLUMNS.index("note")]
    assert not cell.startswith(("=", "+", "-", "@", "\t", "\r", "\n"))
    encodable = text.encode(errors="replace").decode().replace("\0", "").replace("\r\n", "\n").replace("\r", "\n")
    # Nothing is lost: apostrophes are put in where a formula could start, and that is all.
    assert cell.replace("'", "") == encodable.replace("'", "")


@pytest.mark.parametrize("start", ["=", "+", "-", "@", "\t", "\r"])
def test_formulas_are_defused_and_negative_numbers_are_not(start):
    row = replace(MEASURED, note=start + "1+1", x_m=-3.0)
    cells = next(csv.DictReader(io.StringIO(inventory_csv(Inventory((row,))).decode(), newline="")))
    assert cells["note"] == "'" + start.replace("\r", "\n") + "1+1"
    assert cells["x_m"] == "-3.000"


@pytest.mark.parametrize("separator", [";", "\t", "\n", "|"])
@pytest.mark.parametrize("start", ["=", "+", "-", "@", '"=', '""@'])
def test_formulas_are_defused_also_where_another_separator_is_taken(separator, start):
    """Where the comma is the decimal sign, a spreadsheet divides the line at semicolons, whatever quotes say."""
    row = replace(MEASURED, note=f"x{separator}{start}HYPERLINK(1)", species="oak; -5 cm")
    content = inventory_csv(Inventory((row,))).decode()
    for cell in re.split(r"[;\t\n|]", content.partition("\n")[2]):
        assert not cell.lstrip('"').startswith(("=", "+", "-", "@"))
    cells = next(csv.DictReader(io.StringIO(content, newline="")))
    assert cells["note"] == f"x{separator}'{start}HYPERLINK(1)" and cells["species"] == "oak; -5 cm"


def test_without_the_component_for_reference_systems_there_is_no_position(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    assert projected_epsg("EPSG:32633") == (False, None)


def test_only_an_inventory_is_replaced_by_an_inventory(tmp_path):
    path = tmp_path / "plot.csv"
    check_replaceable(path)
    check_absent(path)
    for rows in ((MEASURED, REFUSED), ()):
        write_inventory_csv(path, Inventory(rows), bom=not rows)
        check_replaceable(path)
        with pytest.raises(FileError, match="already"):
            check_absent(path)
    for content in (b"1,2,3\n4,5,6\n", b"", b"\xff\xfe", GOLDEN + b"1,2\n", GOLDEN[10:]):
        path.write_bytes(content)
        with pytest.raises(FileError, match="already") as caught:
            check_replaceable(path)
        assert caught.value.remedy
    with pytest.raises(FileError, match="already"):
        check_replaceable(tmp_path)


def test_what_is_read_is_never_written(tmp_path):
    source, folder = tmp_path / "plot.csv", tmp_path / "tiles"
    folder.mkdir()
    for path in (source, folder / "tile.csv"):
        path.write_text("1 2 3\n")
    (tmp_path / "hard.csv").hardlink_to(source)
    (tmp_path / "soft.csv").symlink_to(source)
    for target in (source, folder / ".." / "plot.csv", tmp_path / "hard.csv", tmp_path / "soft.csv"):
        with pytest.raises(FileError, match="read from it") as caught:
            check_not_source(target, [tmp_path / "gone.ply", source])
        assert caught.value.remedy
    with pytest.raises(FileError, match="read from it"):
        check_not_source(folder / "tile.csv", [folder])
    check_not_source(folder / "new.csv", [folder, source])
    check_not_source(tmp_path / "other.csv", [])


def test_writing_makes_the_folder_and_replaces_the_file_whole(tmp_path):
    path = tmp_path / "out" / "plot.csv"
    assert write_inventory_csv(path, Inventory((MEASURED, REFUSED))) == path
    assert path.read_bytes() == GOLDEN
    write_inventory_csv(path, Inventory())
    assert path.read_bytes().count(b"\n") == 1
    assert [child.name for child in path.parent.iterdir()] == ["plot.csv"]


def test_a_full_disk_leaves_the_old_table(tmp_path, monkeypatch):
    path = tmp_path / "plot.csv"
    write_inventory_csv(path, Inventory((MEASURED, REFUSED)))

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(FileError, match="No space left") as caught:
        write_inventory_csv(path, Inventory())
    assert caught.value.path == path and caught.value.remedy
    assert path.read_bytes() == GOLDEN
    assert [child.name for child in tmp_path.iterdir()] == ["plot.csv"]


def test_which_reference_systems_are_maps():
    pyproj = pytest.importorskip("pyproj")
    assert projected_epsg("EPSG:32633") == (True, 32633)
    assert projected_epsg(pyproj.CRS.from_epsg(25832).to_wkt()) == (True, 25832)
    assert projected_epsg("EPSG:25832+7837") == (True, 25832)
    assert projected_epsg("EPSG:4326") == (False, 4326)
    for unknown in (None, "", "here and there", "EPSG:999999"):
        assert projected_epsg(unknown) == (False, None)


@given(st.text(st.characters(codec="utf-8") | st.sampled_from("=+-@'\";|\t\n"), max_size=30))
def test_what_was_defused_can_be_had_back(text):
    plain = text.replace("\x00", "").replace("\r\n", "\n").replace("\r", "\n")
    assert undefused(defused(text)) == plain
    assert not defused(text).startswith(("=", "+", "-", "@", "\t", "\n"))


def test_fields_of_ones_own_are_columns_behind_ours():
    inventory = Inventory.of([MEASURED, REFUSED], {MEASURED.stem_id: (("=cut", "+1"), ("Species", "mine"))})
    content = inventory_csv(inventory).decode()
    header, *rows = list(csv.reader(io.StringIO(content, newline="")))
    assert header == [*COLUMNS, "'=cut", "Species_own"]
    assert sorted(row[-2:] for row in rows) == [["", ""], ["'+1", "mine"]]


def test_columns_of_ones_own_are_told_apart_in_every_format():
    names = ["DBH_cm", "dbh_in", "fid", "Geom", "x\x07y", "xy", "", "A" * 300, "a" * 300, "dbh_cm_own", "bark"]
    columns = list(own_columns(names).values())
    folded = [name.casefold() for name in columns]
    assert len(set(folded)) == len(names) and not {*folded} & {*COLUMNS, "fid", "geom", "dbh_in"}
    assert columns[-1] == "bark" and all(0 < len(name) <= 70 and name.isprintable() for name in columns)
    for name in ("DBH_cm", "fid", "bark"):
        assert own_field(own_columns([name])[name]) == name
    assert own_field("mine_own") == "mine_own"
