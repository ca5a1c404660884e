"""`dbh-studio evaluate`: from tables to a folder, what is refused, and the real plots."""

from __future__ import annotations

import csv
import json
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from dbh_studio.app.opening import open_plot
from dbh_studio.app.pipeline import segment
from dbh_studio.cli import EXIT_ERROR, EXIT_OK, EXIT_USAGE, main
from dbh_studio.core.synthetic import PlotRecipe, make_plot
from dbh_studio.io.inventory_csv import write_inventory_csv
from dbh_studio.io.las import write_las

REAL = Path(__file__).parents[1].parent / "shared" / "data" / "inventory_tables"
# Estimates and references of tests/core/test_evaluation.py, worked by hand there.
INVENTORY = (
    "tree;dbh;lo;hi;arc\nA;21,0;19;23;350\nB;29,0;28;29,5;340\nC;44,0;;;200\nD;48,0;;;190\nE;66,0;;;180\nX;9;;;90\n"
)
REFERENCE = "Tag,DBH,Spp\nA,0.20,oak\nB,0.30,oak\nC,0.40,=SUM(A1)\nD,0.50,oak\nE,0.60,=SUM(A1)\nF,0.7,oak\nG,0,oak\n"
FILES = {"evaluation.json", "pairs.csv", "report.md", "table.csv", "table.md", "table.tex", "scatter.svg",
         "relative_error.svg"}  # fmt: skip


@pytest.fixture
def tables(tmp_path):
    inventory, reference = tmp_path / "mine.csv", tmp_path / "field.csv"
    inventory.write_text(INVENTORY)
    reference.write_text(REFERENCE)
    return inventory, reference


def evaluate(*arguments):
    return main(["evaluate", *map(str, arguments)])


def rows(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_from_two_tables_to_a_folder(tables, tmp_path, capsys):
    out = tmp_path / "out"
    columns = ("--inventory-column", "low=lo", "--inventory-column", "high=hi")
    assert evaluate(*tables, "--out", out, "--by", "Spp", "--by", "arc:300", *columns) == EXIT_OK
    told = capsys.readouterr().out
    assert "DBH (m, by size" in told
    assert "0, which means unknown in 1 of 7 rows (line 8)" in told
    assert "the interval holds the reference in 1 of 2" in told
    figures = {f"{name}_by_{column}.svg" for name in ("scatter", "relative_error") for column in ("Spp", "arc")}
    assert {path.name for path in out.iterdir()} == FILES | figures
    first = rows(out / "table.csv")[0]
    assert (first["n_reference"], first["n_measured"], first["n_missed"], first["n_extra"]) == ("6", "5", "1", "1")
    assert (first["median_bias_cm"], first["mad_cm"], first["rcv_pct"]) == ("1.000", "3.000", "7.500")
    assert float(first["r_squared"]) == pytest.approx(1_188_100 / 1_225_200, abs=1e-4)
    assert first["p90_rel_err_pct"] == ""
    pairs = {row["tree"] or row["stem"]: row for row in rows(out / "pairs.csv")}
    assert pairs["C"]["error_cm"] == "4.000"
    assert pairs["A"]["lo_cm"] == "19.000"
    assert pairs["F"]["outcome"] == "missed"
    assert pairs["G"]["outcome"] == "unknown"
    assert pairs["X"]["outcome"] == "extra"
    # What a spreadsheet would run is defused; LaTeX and Markdown mean nothing but themselves.
    assert pairs["C"]["by Spp"] == "'=SUM(A1)"
    for name in figures | {"scatter.svg"}:
        ET.parse(out / name)
    record = json.loads((out / "evaluation.json").read_text())
    assert record["lines"][0]["rmse_cm"] == pytest.approx(11.6**0.5)
    report = (out / "report.md").read_text()
    assert "| All | mine | 5 | 1.00 | 3.00 | 7.50 | 0.97 | 5.0 | – |" in report


def test_names_mean_nothing_to_latex_and_markdown(tmp_path):
    kinds = ("[5,10)", "<20 & 50%", "a_b|c", "*&amp;*")
    field = tmp_path / "field.csv"
    field.write_text("tree,dbh_cm,[seen]\n" + "".join(f'{k},{20 + k},"{kinds[k % 4]}"\n' for k in range(16)))
    assert evaluate(field, field, "--by", "[seen]", "--out", tmp_path / "out") == EXIT_OK
    text = (tmp_path / "out" / "table.tex").read_text()
    assert text.startswith("% Needs \\usepackage{booktabs,multirow}.\n")
    assert r"{[}seen{]}: \textless{}20 \& 50\% & field & 4 &" in text
    assert r"{[}seen{]}: a\_b\textbar{}c & field & 4 &" in text
    body = text.split("\\midrule", 1)[1].split("\\bottomrule")[0]
    # Behind the end of a row a bracket or star would be taken for the row's own.
    assert all(not line.startswith(("[", "*")) for line in body.splitlines())
    assert body.count("{") == body.count("}")
    markdown = (tmp_path / "out" / "table.md").read_text()
    assert r"\[seen\]: \*&amp;amp;\*" in markdown and r"&lt;20 &amp; 50%" in markdown


def test_a_table_against_itself_has_no_errors_and_its_figures_are_drawn(tables, tmp_path):
    assert evaluate(tables[1], tables[1], "--out", tmp_path / "out") == EXIT_OK
    first = rows(tmp_path / "out" / "table.csv")[0]
    assert (first["median_bias_cm"], first["rmse_cm"], first["r_squared"]) == ("0.000", "0.000", "1.0000")
    drawn = ET.parse(tmp_path / "out" / "relative_error.svg")
    assert "nan" not in (tmp_path / "out" / "relative_error.svg").read_text() and len(list(drawn.iter())) > 10


def test_a_folder_is_named_even_where_it_is_the_one_at_hand(tables, capsys):
    assert evaluate(".", tables[1]) == EXIT_ERROR
    assert ".: this is a folder" in capsys.readouterr().err


def test_numbers_of_other_trees_are_doubted_and_places_tell_them_apart(tmp_path, capsys):
    """Two tables of one stand, numbered each for itself."""
    thick = [20, 35, 28, 41, 23, 52, 38, 31, 26, 45, 33, 24]
    mine, field, placed = tmp_path / "mine.csv", tmp_path / "field.csv", tmp_path / "placed.csv"
    mine.write_text("tree,dbh_cm\n" + "".join(f"{k},{d}\n" for k, d in enumerate(thick)))
    field.write_text("tree,dbh_cm\n" + "".join(f"{(7 * k + 3) % 12},{d}\n" for k, d in enumerate(thick)))
    assert evaluate(mine, field) == EXIT_OK
    told = capsys.readouterr().out
    assert "next to nothing to do with each other" in told and "columns x and y" in told
    assert evaluate(mine, mine) == EXIT_OK
    assert "next to nothing" not in capsys.readouterr().out
    # Where places have told that the numbers are the same trees, a bad estimate is a bad estimate.
    places = [(3.0 * k % 11, 7.0 * k % 13) for k in range(12)]
    for path, shift in ((mine, 0), (placed, 3)):
        rolled = thick[shift:] + thick[:shift]
        path.write_text(
            "tree,x,y,dbh_cm\n"
            + "".join(f"{k},{x},{y},{d}\n" for k, ((x, y), d) in enumerate(zip(places, rolled, strict=True)))
        )
    assert evaluate(mine, placed) == EXIT_OK
    assert "next to nothing" not in capsys.readouterr().out


def test_stems_measured_from_their_own_files_go_by_their_names(tmp_path, capsys):
    mine, field = tmp_path / "mine.csv", tmp_path / "field.csv"
    heads = "file,stem_id,dbh_cm,dbh_definition,quality,reason\n"
    mine.write_text(heads + "".join(f"cut/trunk_{k}.pcd,,{20 + k},tape,good,\n" for k in range(6)))
    field.write_text("tree_id,file,dbh_cm\n" + "".join(f"{90 - k},trunk_{k}.pcd,{20 + k}\n" for k in range(6)))
    assert evaluate(mine, field) == EXIT_OK
    told = capsys.readouterr().out
    assert "6/6" in told and "numbers from file instead" in told
    # Not where the usual numbers fit, nor where somebody has said which they are.
    assert evaluate(mine, field, "--reference-column", "id=tree_id") == EXIT_ERROR


def test_latex_is_the_papers_table(tables, tmp_path):
    evaluate(*tables, tables[0], tables[1], "--out", tmp_path / "out")  # three inventories, the last the reference
    assert evaluate(tables[0], tables[0], tables[1], "--out", tmp_path / "out") == EXIT_OK
    text = (tmp_path / "out" / "table.tex").read_text()
    assert r"\multirow{2}{*}{All} & mine (1) & 5 & 1.00 & 3.00 & 7.50 & 0.97 \\" in text
    assert text.count("&") % 6 == 0
    assert r"Data & Method & $n$ & Median bias (cm) & MAD (cm) & rCV (\%) & $R^2$ \\" in text


def test_json_and_nothing_written(tables, tmp_path, capsys):
    before = set(tmp_path.iterdir())
    assert evaluate(*tables, "--json") == EXIT_OK
    assert json.loads(capsys.readouterr().out)["paired_by"] == ["id"]
    assert set(tmp_path.iterdir()) == before


def test_units_and_columns_can_be_said(tables, tmp_path, capsys):
    table = tmp_path / "odd.csv"
    table.write_text("who,thick,note\nA,8.267,x\nB,11.417,x\nC,17.323,x\nD,18.898,x\nE,25.984,x\n")
    said = ("--inventory-column", "id=who", "--inventory-column", "dbh=thick", "--inventory-unit", "in")
    assert evaluate(table, tables[1], *said, "--json") == EXIT_OK
    line = json.loads(capsys.readouterr().out)["lines"][0]
    assert line["median_bias_cm"] == pytest.approx(1.0, abs=0.01)
    assert evaluate(table, tables[1], "--inventory-column", "dbh=thik") == EXIT_ERROR
    assert "Did you mean thick?" in capsys.readouterr().err


def test_stems_joined(tmp_path, capsys):
    mine, field = tmp_path / "mine.csv", tmp_path / "field.csv"
    mine.write_text("tree,dbh\n1,50\n2,21\n3,22\n")
    field.write_text("tree,dbh\n1,30\n1,40\n2,20\n3,20\n")
    assert evaluate(mine, field, "--combine-stems", "--json") == EXIT_OK
    assert json.loads(capsys.readouterr().out)["lines"][0]["n_measured"] == 3
    assert evaluate(mine, field) == EXIT_OK
    assert "their number is there more than once" in capsys.readouterr().out


def test_several_methods_in_one_table(tmp_path, capsys):
    mine, field = tmp_path / "m.csv", tmp_path / "field.csv"
    mine.write_text("file,dbh_cm,fourier_cm,circle_cm\na/1.pcd,20,21,22\na/2.pcd,30,31,32\na/3.pcd,40,41,42\n")
    field.write_text("file,dbh_cm\n1.pcd,20\n2.pcd,30\n3.pcd,40\n")
    assert evaluate(mine, field, "--json") == EXIT_OK
    lines = json.loads(capsys.readouterr().out)["lines"]
    assert [(line["method"], line["median_bias_cm"]) for line in lines] == [
        ("dbh", pytest.approx(0.0)), ("fourier", pytest.approx(1.0)), ("circle", pytest.approx(2.0)),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("more", "status", "words"),
    [
        (["--distance", "0"], EXIT_USAGE, "above zero"),
        (["--by", "dbh:3,2"], EXIT_USAGE, "ascending"),
        (["--by", "hight"], EXIT_USAGE, "No table has a column hight"),
        (["--by", "Spp", "--by", "Spp:1"], EXIT_USAGE, "twice"),
        (["--inventory-column", "dbh"], EXIT_USAGE, "ROLE=NAME"),
        (["--reference-column", "thing=Spp"], EXIT_USAGE, "no 'thing'"),
        (["--plot", "x.dbh"], EXIT_USAGE, "without --out"),
        (["--match", "position"], EXIT_ERROR, "has no places"),
    ],
)
def test_wrong_usage_is_told(tables, more, status, words, capsys):
    assert evaluate(*tables, *more) == status
    assert words in capsys.readouterr().err


def test_one_table_is_not_enough(tables, capsys):
    assert evaluate(tables[0]) == EXIT_USAGE
    assert "the reference last" in capsys.readouterr().err


def test_a_reference_without_diameters_is_told(tables, tmp_path, capsys):
    empty = tmp_path / "empty.csv"
    empty.write_text("tree,dbh\nA,0\nB,NA\n")
    assert evaluate(tables[0], empty) == EXIT_ERROR
    assert "no usable diameter" in capsys.readouterr().err


def test_files_of_others_are_not_written_over(tables, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "pairs.csv").write_text("mine")
    assert evaluate(*tables, "--out", out) == EXIT_ERROR
    assert "no evaluation wrote it" in capsys.readouterr().err
    assert (out / "pairs.csv").read_text() == "mine"
    assert evaluate(*tables, "--out", out, "--overwrite") == EXIT_OK
    assert evaluate(*tables, "--out", out) == EXIT_OK  # now it is ours
    # Not even then a table that is read from.
    copy = shutil.copy(tables[0], out / "pairs.csv")
    assert evaluate(copy, tables[1], "--out", out, "--overwrite") == EXIT_ERROR
    assert (out / "pairs.csv").read_text() == INVENTORY


def test_files_of_one_name_are_told_apart(tables, tmp_path):
    first = tmp_path / "east" / "inventory.csv"
    second = tmp_path / "west" / "inventory.csv"
    for path in (first, second):
        path.parent.mkdir()
        shutil.copy(tables[0], path)
    out = tmp_path / "out"
    assert evaluate(first, second, tables[1], "--out", out) == EXIT_OK
    assert {row["method"] for row in rows(out / "table.csv")} == {"east/inventory", "west/inventory"}


def test_figures_of_an_earlier_report_go(tables, tmp_path):
    out = tmp_path / "out"
    assert evaluate(*tables, "--out", out, "--by", "Spp") == EXIT_OK
    (out / "mine.svg").write_text("<svg/>")
    assert (out / "scatter_by_Spp.svg").exists()
    assert evaluate(*tables, "--out", out) == EXIT_OK
    assert {path.name for path in out.iterdir()} == FILES | {"mine.svg"}
    # A record somebody has changed removes nothing of others.
    record = out / "evaluation.json"
    (tmp_path / "other.svg").write_text("<svg/>")
    content = json.loads(record.read_text()) | {"files": ["../other.svg", "mine.svg"]}
    record.write_text(json.dumps(content))
    assert evaluate(*tables, "--out", out) == EXIT_OK
    assert (tmp_path / "other.svg").exists()
    assert (out / "mine.svg").exists()


def test_cross_sections_of_the_saved_plot(tmp_path, capsys):
    plot = make_plot(PlotRecipe.simple(points=60_000, seed=7))
    write_las(tmp_path / "plot.laz", plot.cloud)
    with_trunks = open_plot(tmp_path / "plot.laz", project_dir=tmp_path / "plot.dbh", background_save=False)
    segment(with_trunks, in_process=True)
    inventory = write_inventory_csv(tmp_path / "mine.csv", with_trunks.inventory())
    with_trunks.close()
    field = tmp_path / "field.csv"
    # The frame of the reference is turned by a quarter.
    lines = [f"{t.tree_id},{t.diameter_cm('curve', height_m=1.37):.2f},{-t.y_m:.3f},{t.x_m:.3f}" for t in plot.trees]
    field.write_text("\n".join(["no,dbh,x,y", *lines]))
    out = tmp_path / "out"
    assert evaluate(inventory, field, "--out", out, "--plot", tmp_path / "plot.dbh") == EXIT_OK
    assert "turned by +90" in capsys.readouterr().out
    line = rows(out / "table.csv")[0]
    assert line["n_measured"] == str(len(plot.trees))
    assert abs(float(line["median_bias_cm"])) < 1.0
    root = ET.parse(out / "sections.svg").getroot()
    assert sum(node.tag.endswith("circle") for node in root.iter()) == len(plot.trees)
    assert "sections.svg" in (out / "report.md").read_text()


# ---- the real plots, as they are


def real(*names):
    if not all((REAL / name).exists() for name in names):
        pytest.skip("the real tables are not in ../shared/data/inventory_tables")
    return [REAL / name for name in names]


def test_petawawa_laser_against_tape(capsys):
    tables = real("PRF025_mls_lidar.csv", "PRF025_field.csv")
    assert evaluate(*tables, "--json") == EXIT_OK
    record = json.loads(capsys.readouterr().out)
    (line,) = record["lines"]
    assert record["paired_by"] == ["position"]
    assert line["n_reference"] == 62
    assert line["n_measured"] == 57
    assert line["r_squared"] > 0.95
    assert line["rmse_cm"] < 1.0
    assert record["frames"][0]["turn_deg"] == pytest.approx(2.9, abs=0.3)
    # As they lie, half a metre of offset pairs neighbours: three times the error.
    assert evaluate(*tables, "--same-frame", "--json") == EXIT_OK
    assert json.loads(capsys.readouterr().out)["lines"][0]["rmse_cm"] > 2.0


def test_rioja_laser_against_calliper(capsys):
    tables = real("rioja_tls.csv", "rioja_field.csv")
    assert evaluate(*tables, "--by", "partial.occlusion", "--json") == EXIT_OK
    record = json.loads(capsys.readouterr().out)
    assert len(record["frames"]) == 16
    # The north of the compass and that of the scanner, 16 times independently.
    assert all(-10.0 < frame["turn_deg"] < -7.0 for frame in record["frames"])
    whole, seen, hidden = record["lines"]
    assert whole["n_reference"] == 659
    assert whole["n_measured"] >= 575
    assert whole["median_bias_cm"] == pytest.approx(-2.2, abs=0.1)
    assert seen["mad_cm"] < hidden["mad_cm"]


def test_field_and_laser_in_one_table(capsys):
    (table,) = real("urban_tamu_field_vs_mls.csv")
    columns = ("--inventory-column", "dbh=dbh_m_mls", "--reference-column", "dbh=dbh_m_f")
    assert evaluate(table, table, *columns, "--json") == EXIT_OK
    (line,) = json.loads(capsys.readouterr().out)["lines"]
    assert line["median_bias_cm"] == pytest.approx(5.6, abs=0.1)
    assert line["n_refused"] > 50
