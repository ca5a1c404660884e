"""Comparing the open plot with field diameters, as a person does it in step 5."""

from __future__ import annotations

import csv
import html
import re
from decimal import ROUND_HALF_UP, Decimal

import browser
import endless
import numpy as np
import plots
import pytest
from fakeclient import FakeClient
from panel import LONG, idle

from dbh_studio.app import commands, pipeline
from dbh_studio.app.evaluation import EvaluationRequest, evaluate_files, evaluate_plot, report_files
from dbh_studio.core.comparison import Grouping
from dbh_studio.errors import FileError
from dbh_studio.io.evaluation_report import rounded
from dbh_studio.ui.evaluation_section import failure, lines_table, misfits, summary


@pytest.fixture
def field(tmp_path):
    """The plot's trees under other numbers and in a frame of their own; one more, and one without a diameter."""
    path = tmp_path / "field.csv"
    trees = plots.plot().trees
    lines = [
        f"T{k},{tree.diameter_cm('curve', height_m=1.37) / 100:.4f},{500.0 - tree.y_m:.3f},{tree.x_m - 80.0:.3f}"
        for k, tree in enumerate(trees)
    ]
    path.write_text("\n".join(["Tag,dbh_m,x,y", *lines, "T98,0.3,700,-70", "T99,0,510,-90"]))
    return path


def open_step(tab: FakeClient) -> None:
    tab.bridge_send("step", "export")
    tab.wait(lambda t: t.has("Compare"))


def compare(tab: FakeClient, field) -> None:
    open_step(tab)
    tab.set("Field table", str(field))
    tab.press("Compare")
    tab.wait_text("Median bias", LONG)
    tab.wait(lambda t: "data-pair=" in t.html(), LONG)  # it comes last


def test_bias_scatter_and_the_trees_without_a_pair(measured, field):
    compare(measured, field)
    n = len(plots.plot().trees)
    text = measured.text()
    assert f"Field trees found {n} of {n + 1}" in re.sub(r"\s+", " ", text)
    assert "RMSE" in text
    assert "Field tree T98 was not found" in text
    assert "Field tree T99 has no field diameter" in text
    assert "The frames differ" in text
    bias = re.search(r"Median bias\s*([+-][0-9.]+) cm", text)
    assert bias
    assert abs(float(bias[1])) < 1.5
    # Every tree is a point that names itself.
    shown = measured.html()
    assert sorted(map(int, re.findall(r'data-tree="(\d+)" style', shown))) == sorted(table_ids_of(measured))
    assert "<title>tree T" in shown


def table_ids_of(tab: FakeClient) -> list[int]:
    return [int(number) for number in re.findall(r'data-pair="(\d+)"', tab.html())]


def lines_of(tab: FakeClient) -> list[list[str]]:
    """The cells of the table by kind of tree and method."""
    rows = re.findall(r"<tr data-line=.*?</tr>", tab.html())
    return [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in rows]


def test_a_line_for_each_kind_of_tree_and_each_method(measured, field, tmp_path):
    trees = plots.plot().trees
    kinds = field.read_text().splitlines()
    field.write_text("\n".join(f"{line},{'Side' if k == 0 else 'NS'[k % 2]}" for k, line in enumerate(kinds)))
    compare(measured, field)
    assert lines_of(measured) == []  # one line is the summary
    # A column of the field table is there to be chosen once it was read; then no further press is needed.
    measured.set("Tell apart by", "Side (field table)")
    measured.wait(lambda t: len(lines_of(t)) == 3, LONG)
    everything, north, south = lines_of(measured)
    assert (everything[0], north[0], south[0]) == ("All", "N", "S")
    assert int(north[1]) + int(south[1]) == int(everything[1]) == len(trees)
    # Two trees or three: bias from three on.
    assert all((row[2] == "–") == (int(row[1]) < 3) for row in (north, south))
    assert everything[2] in measured.text()
    measured.set("Every method", True)
    measured.wait(lambda t: {"shrinkage", "circle", "fourier"} <= {row[1] for row in lines_of(t)}, LONG)
    by_method = {row[1]: row for row in lines_of(measured) if row[0] == "All"}
    assert by_method["shrinkage"][3:] == everything[2:]
    assert all(int(row[2]) == len(trees) for row in by_method.values())
    # The two with an interval say how often it holds the field value, the others do not.
    assert by_method["circle"][-1].endswith(f"/{len(trees)}") and by_method["ellipse"][-1] == "–"
    # What was chosen stays for the report.
    assert measured.value("Tell apart by") == "Side (field table)"
    measured.set("Report folder", "by side")
    measured.press("Write the report")
    measured.wait_notification("Report written", LONG)
    assert (tmp_path / "by side" / "scatter_by_Side.svg").is_file()
    assert "fourier" in (tmp_path / "by side" / "table.csv").read_text()


def test_a_click_on_a_point_chooses_the_tree(measured, field):
    compare(measured, field)
    number = table_ids_of(measured)[0]
    # What the point does in the page.
    assert f'data-tree="{number}" style="cursor:pointer" onclick="dbh(&quot;row&quot;,{number})"' in measured.html()
    measured.bridge_send("row", number)
    measured.wait_text(f"Tree {number}")


def test_the_worst_pair_comes_first(measured, field):
    compare(measured, field)
    errors = [abs(float(e)) for e in re.findall(r"<td>([+-][0-9.]+)</td></tr>", measured.html())]
    assert len(errors) == len(plots.plot().trees)
    assert errors == sorted(errors, reverse=True)


def test_the_report_is_written_beside_the_plot(measured, studio, field, tmp_path):
    compare(measured, field)
    measured.wait(lambda t: t.value("Report folder"))
    assert str(tmp_path) in measured.value("Report folder")
    measured.set("Report folder", "my report")
    measured.press("Write the report")
    measured.wait_notification("Report written", LONG)
    written = {path.name for path in (tmp_path / "my report").iterdir()}
    assert {"report.md", "table.tex", "pairs.csv", "scatter.svg", "sections.svg"} <= written


def test_a_change_of_the_plot_is_told(measured, studio, field):
    compare(measured, field)
    number = table_ids_of(measured)[0]
    studio.session.do(commands.set_tree_record(number, note="checked"))
    measured.wait_text("The plot has changed since")
    measured.press("Compare")
    measured.wait(lambda t: "The plot has changed since" not in t.text(), LONG)


def test_another_plot_begins_with_empty_fields(measured, studio, field, tmp_path):
    compare(measured, field)
    measured.wait(lambda t: t.value("Report folder"))
    (tmp_path / "other").mkdir()
    studio.adopt(plots.measured_session(tmp_path / "other"))
    measured.wait_text("Click a trunk in the picture", LONG)
    open_step(measured)
    measured.wait(lambda t: t.value("Field table") == "", LONG)
    compare(measured, field)
    # Else the report would be written over that of the first plot.
    measured.wait(lambda t: t.value("Report folder").startswith(str(tmp_path / "other")), LONG)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "there is no such file"),
        ("", "No table was named"),
        ("a,b\n1,2\n", "no column of diameters"),
        ("Tag,dbh\nT1,30\n", "could be paired"),
    ],
)
def test_a_table_that_does_not_help_is_told(measured, tmp_path, content, words):
    open_step(measured)
    path = tmp_path / "odd.csv"
    if content:
        path.write_text(content)
    measured.set("Field table", "" if content == "" else str(path))
    measured.press("Compare")
    measured.wait_notification(words)
    measured.wait_text(words)
    if content:
        measured.wait_text("odd.csv")  # which table it is about
    measured.wait(lambda t: "Type where a table" not in t.text())


def test_why_nothing_could_be_compared_names_the_file_as_text():
    told = failure(FileError("plots/<b>.csv", "it has no column <i>", "Name it <u>."))
    assert "&lt;b&gt;.csv: it has no column &lt;i&gt;" in told and "Name it &lt;u&gt;." in told
    assert "/: it is a folder" in failure(FileError("/", "it is a folder"))


def test_a_table_that_helps_takes_the_place_of_what_was_wrong_with_the_last(measured, field, tmp_path):
    open_step(measured)
    measured.set("Field table", str(tmp_path / "nowhere.csv"))
    measured.press("Compare")
    measured.wait_text("there is no such file")
    compare(measured, field)
    measured.wait(lambda t: "there is no such file" not in t.text())


def test_a_tree_without_a_diameter_is_named_by_its_number_here_and_a_click_leads_to_it(tmp_path):
    trees = {"A": 31.0, "B": 22.0, "C": 45.0, "<D>": None}
    inventory = ["tree_id,stem_id,dbh_cm,x_m,y_m"]
    inventory += [f"{k},{k},{cm or ''},{5 * k},{k * k}" for k, cm in enumerate(trees.values(), start=1)]
    field = ["Tree,DBH_cm,X,Y", *(f"{name},30,{5 * k},{k * k}" for k, name in enumerate(trees, start=1))]
    for name, lines in (("inventory.csv", inventory), ("field.csv", field)):
        (tmp_path / name).write_text("\n".join(lines), encoding="utf-8")
    request = EvaluationRequest(tmp_path / "field.csv", inventories=(tmp_path / "inventory.csv",))
    told = misfits(evaluate_files(request))
    assert 'data-refused="4" onclick="dbh(&quot;row&quot;,4)">Tree 4</button> (field tree &lt;D&gt;)' in told


def test_markup_in_the_table_stays_text(measured, field):
    field.write_text(field.read_text().replace("T0", "<img src=x onerror=alert(1)>"))
    compare(measured, field)
    assert "<img" not in measured.html()
    assert "&lt;img" in measured.html()


@pytest.mark.browser
def test_in_the_page_a_point_is_pressed_and_the_tree_is_chosen(studio, field, tmp_path, chromium):
    studio.adopt(plots.measured_session(tmp_path))
    page = browser.open_page(chromium, studio.server.url)
    page.locator('button[data-step="export"]').click(timeout=browser.TIMEOUT_MS)
    browser.unfold(page, "Compare with field measurements")
    inputs = "ancestor::div[contains(@class,'mantine-Flex-root')][1]//input"
    page.locator(f"//label[normalize-space()='Field table']/{inputs}").first.fill(str(field))
    page.get_by_role("button", name="Compare", exact=True).click()
    point = page.locator(".dbh-evaluation circle[data-tree]").first
    point.wait_for(timeout=browser.TIMEOUT_MS)
    number = point.get_attribute("data-tree")
    point.scroll_into_view_if_needed()
    point.click(force=True)
    page.locator(f'.dbh-card[data-tree="{number}"]').wait_for(timeout=browser.TIMEOUT_MS)
    assert browser.page_errors(page) == []


def test_field_values_are_kept_beside_the_estimates_and_taken_back(measured, studio, field):
    compare(measured, field)
    document = studio.session.document
    before = {row.stem_id: row.dbh_cm for row in studio.session.inventory()}
    measured.press("Keep these as tape values of the trees")
    measured.wait(lambda _: studio.session.document is not document)
    rows = {row.stem_id: row for row in studio.session.inventory()}
    assert all(row.field_tape_cm == pytest.approx(row.dbh_cm, rel=0.08) for row in rows.values())
    assert {i: row.dbh_cm for i, row in rows.items()} == before
    (tape,) = studio.session.document.record(next(iter(rows))).corrections
    assert (tape.who, tape.why) == (studio.session.author, "field.csv")
    studio.session.undo()
    assert studio.session.document is document


# ---- the same figures everywhere


def half_up(text: str, digits: int) -> Decimal:
    """A number as a person rounds it who sees it written."""
    return Decimal(text).quantize(Decimal(1).scaleb(-digits), ROUND_HALF_UP)


@pytest.mark.parametrize("digits", [0, 1, 2, 3])
def test_numbers_are_rounded_as_they_are_written(digits):
    rng = np.random.default_rng(digits)
    for _ in range(2000):
        text = f"{rng.integers(-100_000, 100_000)}.{rng.integers(0, 10_000):04d}"[: rng.integers(6, 12)].rstrip(".")
        shown = rounded(float(text), digits)
        assert Decimal(shown) == half_up(text, digits) and not shown.startswith("-0.000")
    assert [rounded(v, 1) for v in (40.05, -40.05, 40.15, -0.04, 2.25)] == ["40.1", "-40.1", "40.2", "0.0", "2.3"]
    assert rounded(7, digits) == "7" and rounded(None, digits, nothing="–") == "–"
    assert float(rounded(1e300, digits)) == 1e300 and rounded(float("nan"), digits) == "nan"


def random_tables(folder, rng):
    """An inventory and a field table with diameters in whole tenths of millimetres, many of which are ties."""
    n = int(rng.integers(3, 40))
    reference = np.round(rng.uniform(8, 80, n) * 20) / 20
    estimated = np.round((reference + rng.normal(0, 1.5, n)) * 20) / 20
    estimated[rng.random(n) < 0.1] = np.nan
    rows = [f"{k},{'' if np.isnan(e) else f'{e:.2f}'},{'NS'[k % 2]}" for k, e in enumerate(estimated)]
    (folder / "mine.csv").write_text("\n".join(["tree,dbh_cm,side", *rows]))
    (folder / "field.csv").write_text("\n".join(["tree,dbh_cm", *(f"{k},{r:.2f}" for k, r in enumerate(reference))]))
    return EvaluationRequest(folder / "field.csv", (folder / "mine.csv",), by=(Grouping.parse("inventory:side"),))


def cells_of(page: str, row: str) -> list[list[str]]:
    return [
        [html.unescape(cell) for cell in re.findall(r"<td[^>]*>(.*?)</td>", found)]
        for found in re.findall(rf"<tr {row}.*?</tr>", page)
    ]


@pytest.mark.parametrize("seed", range(12))
def test_every_figure_of_the_panel_is_that_of_the_report(tmp_path, seed):
    comparison = evaluate_files(random_tables(tmp_path, np.random.default_rng(seed)))
    files = report_files(comparison)
    markdown = [line.strip("| \n").split(" | ") for line in files["table.md"].decode().splitlines()[2:]]
    exact = list(csv.DictReader(files["table.csv"].decode().splitlines()))
    panel = cells_of(lines_table(comparison), "data-line=")
    assert len(panel) == len(markdown) == len(exact) == 3
    heads = ("median_bias_cm", "mad_cm", "rcv_pct", "r_squared", "median_rel_err_pct", "p90_rel_err_pct", "rmse_cm")
    for shown, told, numbers in zip(panel, markdown, exact, strict=True):
        assert shown[1:9] == [*told[2:9], told[10]]
        for text, head in zip(shown[2:9], heads, strict=True):
            if text != "–":
                digits = -int(Decimal(text).as_tuple().exponent)
                assert abs(Decimal(text) - Decimal(numbers[head])) <= Decimal("0.5005").scaleb(-digits), head
            else:
                assert numbers[head] == ""
    # The summary says what the first line says.
    said = re.findall(r"[-+]?\d+(?:\.\d+)?", re.sub(r"<[^>]*>|R²", " ", summary(comparison).split("Interval")[0]))
    for text in markdown[0][3:11]:
        assert text == "–" or {text, f"+{text}"} & set(said)
    # And the list of pairs what the file of pairs says.
    pairs = {row["stem"]: row for row in csv.DictReader(files["pairs.csv"].decode().splitlines())}
    listed = cells_of(misfits(comparison), "data-pair=")
    assert listed
    for stem, _, estimated, reference, error in listed:
        row = pairs[stem]
        assert Decimal(estimated) == half_up(row["estimated_cm"], 2)
        assert Decimal(reference) == half_up(row["reference_cm"], 2)
        assert abs(Decimal(error) - Decimal(row["error_pct"])) <= Decimal("0.0505")


# ---- every method, as a job


def test_measuring_by_every_method_can_be_cancelled(measured, studio, field, monkeypatch):
    compare(measured, field)
    before = lines_of(measured)
    with monkeypatch.context() as patch:
        patch.setattr("dbh_studio.app.pipeline.measure_stems", endless.work)
        measured.set("Every method", True)
        measured.wait_text("Measuring by every method", LONG)
        measured.wait(lambda t: any("Not done yet" in script for script in t.javascript), LONG)
        # The tab is there meanwhile, and what it showed.
        measured.wait_text("Median bias")
        measured.bridge_send("cancel")
        assert "by the plot's own diameters" in measured.wait_notification("Cancelled", LONG).body
        measured.wait(lambda t: t.value("Every method") is False)
        idle(measured, studio)
    assert lines_of(measured) == before and "Median bias" in measured.text()
    # Nothing of it is in the way of another try.
    measured.set("Every method", True)
    measured.wait(lambda t: len(lines_of(t)) == 5, LONG)


def test_methods_are_measured_once_for_every_question(measured, studio, field, monkeypatch):
    compare(measured, field)
    measured.set("Every method", True)
    measured.wait(lambda t: len(lines_of(t)) == 5, LONG)
    idle(measured, studio)
    monkeypatch.setattr("dbh_studio.app.pipeline.measure_stems", endless.work)
    measured.set("Tell apart by", "diameter")
    measured.wait(lambda t: len(lines_of(t)) > 5, LONG)
    measured.set("Every method", False)
    measured.wait(lambda t: len({row[1] for row in lines_of(t)}) > 1 and "bspline" not in t.text(), LONG)
    measured.set("Every method", True)
    measured.wait_text("bspline", LONG)
    assert studio._job is None


def test_while_another_job_runs_the_plots_own_diameters_are_compared(measured, studio, field, monkeypatch):
    monkeypatch.setattr("dbh_studio.app.pipeline.segment_plot", plots.endless_search)
    open_step(measured)
    studio.find_trunks()
    measured.wait_text("Finding trunks")
    measured.set("Every method", True)
    measured.set("Field table", str(field))
    measured.press("Compare")
    measured.wait_notification("Finding trunks is still running", LONG)
    measured.wait(lambda t: t.value("Every method") is False and "Median bias" in t.text())
    studio.cancel_job()
    idle(measured, studio)


def test_a_job_compares_what_is_compared_without_one(measured, studio, field):
    session, request = studio.session, EvaluationRequest(field, every_method=True)
    document = session.document
    compared = pipeline.measure_stems(*pipeline.comparison_call(session, document))
    beside = evaluate_plot(session, request, compared=compared)
    alone = evaluate_plot(session, request)
    assert beside.lines == alone.lines and len(beside.methods) == 5
