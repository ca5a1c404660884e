"""Comparing the open plot with field diameters, as a person does it in step 5."""

from __future__ import annotations

import re

import browser
import plots
import pytest
from fakeclient import FakeClient
from panel import LONG

from dbh_studio.app import commands


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
    html = measured.html()
    assert sorted(map(int, re.findall(r'data-tree="(\d+)" style', html))) == sorted(table_ids_of(measured))
    assert "<title>tree T" in html


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
    measured.wait_text("Type where a table with field diameters lies")


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
    page.get_by_text("Compare with field measurements").click(timeout=browser.TIMEOUT_MS)
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
