"""Tables as people keep them: signs, encodings, units, names, what is odd, and the real ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbh_studio.core.stem_table import combined
from dbh_studio.errors import (
    EmptyFileError,
    FileError,
    FileMissingError,
    MalformedFileError,
    SettingError,
    UnsupportedFormatError,
)
from dbh_studio.io.table_columns import Reading, read_stem_table, stem_table_of
from dbh_studio.io.tables import cells_of, numbers, read_cells

REAL = Path(__file__).parents[2].parent / "shared" / "data" / "inventory_tables"


def real(name):
    if not (REAL / name).exists():
        pytest.skip(f"the real table {name} is not in ../shared/data/inventory_tables")
    return REAL / name


def read(text, reading=None, *, encoding="utf-8"):
    return stem_table_of(text.encode(encoding), reading, name="t.csv")


# ---- cells


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize("delimiter", [",", ";", "\t", "|"])
def test_any_sign_and_encoding(encoding, delimiter):
    text = f"Nr{delimiter}Art{delimiter}DBH\r\n1{delimiter}Säge{delimiter}30.5\r\n\r\n2{delimiter}{delimiter}40\r\n"
    table = cells_of(text.encode(encoding), "t.csv")
    assert dict(table.columns) == {"Nr": ("1", "2"), "Art": ("Säge", ""), "DBH": ("30.5", "40")}
    assert table.lines == (2, 4)
    assert bool(table.notes) == (encoding == "latin-1")


def test_quotes_comments_and_blanks_around():
    table = cells_of(b'# a plot, measured in May\n"id" , "note"\n1, "a, b\nand ""c""" \n2,x\n', "t.csv")
    assert table.columns["note"] == ('a, b\nand "c"', "x")
    assert table.lines == (3, 5)


def test_names_twice_or_missing():
    assert list(cells_of(b"id,dbh,dbh,\n1,2,3,4\n", "t.csv").columns) == ["id", "dbh", "dbh (2)", "column 4"]


def test_lines_that_end_early_are_told_and_filled():
    table = cells_of(b"id,x,dbh\n1,2,3\n4\n", "t.csv")
    assert table.columns["dbh"] == ("3", "")
    assert "1 lines end early" in table.notes[0]


@pytest.mark.parametrize(
    ("data", "error", "word"),
    [
        (b"", EmptyFileError, "empty"),
        (b"\n \n", EmptyFileError, "empty"),
        (b"id,dbh\n", EmptyFileError, "nothing else"),
        (b"id,dbh\n1,30,5\n", MalformedFileError, "line 2 has 3 cells"),
        (b"1,30\n2,40\n", MalformedFileError, "no names of columns"),
        (b"PK\x03\x04rest", UnsupportedFormatError, "workbook"),
        (b"id,dbh\n\x00\x01", UnsupportedFormatError, "no text"),
    ],
)
def test_files_that_are_no_table_say_so(data, error, word):
    with pytest.raises(error, match=word) as caught:
        cells_of(data, "t.csv")
    assert str(caught.value).startswith("t.csv: ")


def test_absent_files_and_folders(tmp_path):
    with pytest.raises(FileMissingError):
        read_cells(tmp_path / "nothing.csv")
    with pytest.raises(UnsupportedFormatError, match="folder"):
        read_cells(tmp_path)


@given(st.binary(max_size=300))
def test_whatever_the_bytes_the_answer_is_a_table_or_a_file_error(data):
    try:
        table = stem_table_of(data, Reading(find_methods=True), name="t.csv")
    except FileError as error:
        assert error.problem
    else:
        assert len(table) > 0


@pytest.mark.parametrize(
    ("cells", "values"),
    [
        (["30.5", "40"], [30.5, 40.0]),
        (["30,5", "40"], [30.5, 40.0]),
        (["1.234,5", "12,5"], [1234.5, 12.5]),
        (["1,234.5", "12.5"], [1234.5, 12.5]),
        (["5,096,039.4"], [5096039.4]),
        (["0,334", "0,303"], [0.334, 0.303]),
        (["12,345", "13,456"], [12.345, 13.456]),
        (["30,5", "40.5"], [30.5, 40.5]),
        (["−3", "1e2", "+7"], [-3.0, 100.0, 7.0]),
        (["", "NA", "Null", "#N/A", "-", "nan", "inf", "30 cm", "x"], [np.nan] * 9),
    ],
)
def test_numbers_as_people_write_them(cells, values):
    assert numbers(cells) == pytest.approx(values, nan_ok=True)


# ---- units


@pytest.mark.parametrize(
    ("text", "cm"),
    [
        ("id,DBH\n1,30.5\n2,22\n", [30.5, 22.0]),
        ("id,DBH\n1,0.305\n2,0.22\n", [30.5, 22.0]),
        ("id,DBH\n1,305\n2,220\n", [30.5, 22.0]),
        ("id,dbh_m\n1,3.05\n2,2.2\n", [305.0, 220.0]),
        ("id,DBH (mm)\n1,30.5\n2,22\n", [3.05, 2.2]),
        ("id,dbh_in\n1,10\n2,20\n", [25.4, 50.8]),
        ("CN,PLT_CN,TREE,DIA\n1,1,1,10\n1,1,2,20\n", [25.4, 50.8]),
        # A girth of 100 cm is a diameter of 100/π cm.
        ("id,girth_cm\n1,100\n2,50\n", [100.0 / np.pi, 50.0 / np.pi]),
        ("id;BHD\n1;30,5\n2;22\n", [30.5, 22.0]),
    ],
)
def test_units_by_name_and_by_size(text, cm):
    assert read(text).diameters_cm["dbh"] == pytest.approx(cm)


def test_thin_stems_in_cm_are_not_taken_for_metres():
    table = read("id,dbh\n" + "".join(f"{k},{d}\n" for k, d in enumerate([1.1, 1.4, 1.2, 1.7, 2.0, 43.0, 20.0])))
    assert table.diameters_cm["dbh"][5] == pytest.approx(43.0)


def test_the_unit_may_be_said_and_is_told():
    table = read("id,DBH\n1,12\n2,14\n", Reading(unit="in"))
    assert table.diameters_cm["dbh"] == pytest.approx([30.48, 35.56])
    assert "diameters from DBH (in)" in table.notes[0]
    assert "by size: the median is 13" in read("id,DBH\n1,12\n2,14\n").notes[0]


def test_what_is_no_diameter_is_told_with_its_line():
    table = read("id,dbh\n1,30\n2,0\n3,\n4,-5\n5,abc\n6,Null\n7,9999\n8,31\n9,32\n")
    assert table.diameters_cm["dbh"] == pytest.approx([30.0, *[np.nan] * 6, 31.0, 32.0], nan_ok=True)
    problems = table.problems["dbh"]
    assert problems[0] == ""
    assert "means unknown" in problems[1]
    assert "no diameter" in problems[2]
    assert "below zero" in problems[3]
    assert "“abc” in t.csv is no number" in problems[4]
    assert problems[5] == problems[2]
    assert "100 m, which is no tree" in problems[6]
    told = "\n".join(table.notes)
    assert "0, which means unknown in 1 of 9 rows (line 3)" in told
    assert "empty in 2 of 9 rows (lines 4, 7)" in told
    assert "not usable in 3 of 9 rows (lines 5, 6, 8)" in told


# ---- columns


def test_our_own_inventory_is_read_with_its_interval_and_its_reasons():
    text = (
        "plot_id,tree_id,stem_id,tag,dbh_cm,dbh_lo_cm,dbh_hi_cm,dbh_method,dbh_definition,hom_m,quality,reason,x_m,y_m,"
        "easting,northing,dbh_circle_cm\n"
        "p,1,1,,30.00,29.0,31.5,fourier,tape,1.3,good,,1.5,2.5,,,30.2\n"
        "p,1,2,,,,,,,,refused,only 70° of the ring seen,4.0,5.0,,,\n"
    )
    table = read(text, Reading(find_methods=True))
    assert table.ids == ("1", "2")
    assert table.xy_m.tolist() == [[1.5, 2.5], [4.0, 5.0]]
    assert table.intervals_cm["dbh"][0] == pytest.approx([29.0, 31.5])
    assert table.problems["dbh"][1] == "only 70° of the ring seen"
    assert table.methods == ("dbh", "circle")
    by_tree = read(text, Reading(by_tree=True))
    assert by_tree.ids == ("1", "1")
    assert by_tree.methods == ("dbh",)


def test_tags_go_before_our_own_numbers_where_they_are_filled_in():
    head = "stem_id,tree_id,tag,dbh_cm,dbh_definition\n"
    assert read(head + "1,1,A7,30,tape\n2,2,A8,31,tape\n3,3,,32,tape\n").ids == ("A7", "A8", "")
    assert read(head + "1,1,A7,30,tape\n2,2,,31,tape\n3,3,,32,tape\n").ids == ("1", "2", "3")


def test_a_column_that_is_the_same_for_all_is_no_place():
    text = "Tree,DBH,Field_X,Field_Y,Map_X,Map_Y,Easting,Northing\n" + "".join(
        f"{k},30,{k}.5,{2 * k},31203{k}.5,509603{k},312029.5,5096039.4\n" for k in range(5)
    )
    table = read(text)
    assert table.xy_m[1] == pytest.approx([312031.5, 5096031.0])
    assert "places from Map_X and Map_Y" in table.notes[0]


def test_distance_and_azimuth_are_places():
    # 10 m to the east and 5 m to the south of the middle.
    table = read("tree,dbh,dist,azimuth\n1,30,10,90\n2,31,5,180\n3,32,4,0\n")
    assert table.xy_m == pytest.approx(np.array([[10.0, 0.0], [0.0, -5.0], [0.0, 4.0]]))


def test_numbers_that_begin_anew_in_each_plot():
    text = "id,tree,dbh\n" + "".join(f"{plot},{tree},30\n" for plot in (1, 2, 3) for tree in (1, 2, 3))
    table = read(text)
    assert table.plots == ("1",) * 3 + ("2",) * 3 + ("3",) * 3
    assert table.ids == ("1", "2", "3") * 3


def test_columns_may_be_named():
    text = "nummer,durchmesser,rechts,hoch,a,b\n7,30.5,1,2,29,32\n8,31,3,4,,\n"
    with pytest.raises(MalformedFileError, match="no column of diameters"):
        read(text)
    columns = {"id": "Nummer", "dbh": "durchmesser", "x": "rechts", "y": "hoch", "low": "a", "high": "b"}
    table = read(text, Reading(columns=columns))
    assert table.ids == ("7", "8")
    assert table.diameters_cm["dbh"] == pytest.approx([30.5, 31.0])
    assert table.xy_m.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert table.intervals_cm["dbh"] == pytest.approx(np.array([[29.0, 32.0], [np.nan, np.nan]]), nan_ok=True)


def test_columns_may_be_left_out():
    text = "plot,tree,dbh,x,y\n1,1,30,0,1\n1,2,31,2,3\n"
    table = read(text, Reading(columns={"plot": "-", "id": "-", "x": "-"}))
    assert not (table.has_plots or table.has_ids or table.has_positions)


def test_several_diameter_columns_are_several_methods():
    table = read("id,fourier_cm,ellipse_cm\n1,30,31\n", Reading(diameters=("fourier_cm", "ellipse_cm")))
    assert table.methods == ("fourier_cm", "ellipse_cm")
    assert read("id,a\n1,30\n", Reading(diameters=("a",))).methods == ("dbh",)


def test_the_chosen_curve_is_not_told_twice():
    text = "file,dbh_cm,dbh_lo_cm,dbh_hi_cm,shrinkage_cm,circle_cm\na,30,29,31,30,31\nb,,,,,22\n"
    table = read(text, Reading(find_methods=True))
    assert table.methods == ("shrinkage", "circle")
    assert table.intervals_cm["shrinkage"][0].tolist() == [29.0, 31.0]
    assert np.isnan(table.diameters_cm["shrinkage"][1])


def test_each_method_has_its_own_interval():
    text = "stem_id,dbh_cm,dbh_lo_cm,dbh_hi_cm,dbh_area_cm,dbh_area_lo_cm,dbh_area_hi_cm,bare\n1,30,29,31,28,27,30,5\n"
    table = read(text, Reading(diameters=("dbh_area_cm", "dbh_cm", "bare")))
    assert table.intervals_cm["dbh_area_cm"].tolist() == [[27.0, 30.0]]
    assert table.intervals_cm["dbh_cm"].tolist() == [[29.0, 31.0]]
    assert set(table.intervals_cm) == {"dbh_area_cm", "dbh_cm"}


def test_an_interval_is_not_taken_for_that_of_another_method():
    table = read(
        "stem,dbh_cm,dbh_lo_cm,dbh_hi_cm,fourier_cm\n1,30,29,31,40\n2,20,19,21,28\n", Reading(diameters=("fourier_cm",))
    )
    assert table.diameters_cm["dbh"].tolist() == [40.0, 28.0] and not table.intervals_cm


def test_the_ends_of_a_girths_interval_are_girths():
    table = read("tree,girth_cm,girth_lo_cm,girth_hi_cm\n1,100,90,110\n2,60,50,70\n")
    assert table.diameters_cm["dbh"] == pytest.approx(np.array([100, 60]) / np.pi)
    assert table.intervals_cm["dbh"] == pytest.approx(np.array([[90, 110], [50, 70]]) / np.pi)


def test_a_wrong_name_is_answered_with_the_nearest():
    with pytest.raises(MalformedFileError, match=r"no column DHB\. Did you mean DBH\?"):
        read("id,DBH\n1,30\n", Reading(columns={"dbh": "DHB"}))
    with pytest.raises(MalformedFileError, match="only one of x and y"):
        read("id,DBH,a\n1,30,2\n", Reading(columns={"x": "a"}))
    with pytest.raises(SettingError, match="no 'hight'"):
        Reading(columns={"hight": "x"})


def test_stems_cut_out_are_known_by_their_file():
    table = read("file,dbh_cm\nplots/a/tree_3.pcd,30\nplots\\a\\tree_8.pcd,31\n")
    assert table.ids == ("tree_3.pcd", "tree_8.pcd")


def test_stems_of_a_tree_are_joined():
    table = combined(read("treeID,stemID,dbh\n1,1,30\n1,2,40\n2,3,20\n", Reading(by_tree=True)))
    assert table.diameters_cm["dbh"] == pytest.approx([50.0, 20.0])


# ---- the real ones, read as they are


@pytest.mark.parametrize(
    ("name", "n", "words", "median_cm"),
    [
        ("PRF025_field.csv", 62, "DBH (cm, by size: the median is 12.2); numbers from Tree; plots from Plot; places "
         "from Field_Xpj and Field_Ypj.", 12.2),
        ("PRF025_mls_lidar.csv", 93, "DBH (m, by size: the median is 0.117); numbers from treeID; plots from plotID; "
         "places from X and Y.", 11.66),
        ("rioja_field.csv", 659, "dbh (cm, by size: the median is 31); numbers from tree; plots from id; places from x "
         "and y.", 31.0),
        ("rioja_tls.csv", 604, "dbh (cm, by size: the median is 28.4); numbers from tree; plots from id", 28.4),
        ("urban_tamu_field_vs_mls.csv", 122, "dbh_m_f (m); numbers from treeID; places from X and Y.", 39.05),
        ("anumahan_field_measurements.csv", 16, "DBH (m, by size", 31.85),
        ("allodb_scbi_stem1.csv", 2287, "dbh (cm, by size", 1.67),
        ("biomass_forest_inv_exemple.csv", 2050, "D (cm, by size", 17.1),
        ("for_instance/tree_data_NIBIO.csv", 481, "DBH (cm, by size", 24.5),
        ("for_instance/tree_data_TUWIEN.csv", 165, "DBH (m, by size", 30.5),
        ("fia_ri_TREE.csv", 10093, "DIA (in, as in the FIA database)", 20.8),
    ],
)  # fmt: skip
def test_real_tables(name, n, words, median_cm):
    table = read_stem_table(real(name))
    assert len(table) == n
    assert words in table.notes[0]
    assert np.nanmedian(table.diameters_cm["dbh"]) == pytest.approx(median_cm, rel=0.03)


def test_a_real_workbook_is_told_to_be_saved_as_csv():
    with pytest.raises(UnsupportedFormatError, match="Save the sheet as CSV"):
        read_stem_table(real("anumahan_comparison_table.xlsx"))
