"""The panel's HTML: what a forester reads, and that no text from outside becomes markup."""

import re

import numpy as np
import pytest

from dbh_studio.core.dbh import DbhEstimate, Refusal, measure_stem
from dbh_studio.settings import MeasureSettings
from dbh_studio.ui import html
from dbh_studio.ui.html import TableRow
from dbh_studio.ui.section_svg import section_svg
from dbh_studio.ui.steps import PlotStatus

ATTACK = "<img src=x onerror=alert(1)>\"'`"


def cylinder(radius_m: float = 0.15, *, arc_deg: float = 360.0, n: int = 6000) -> np.ndarray:
    rng = np.random.default_rng(5)
    angle = np.deg2rad(rng.uniform(0, arc_deg, n))
    radius = radius_m + rng.normal(0, 0.002, n)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0.2, 3.0, n)])


@pytest.fixture(scope="module")
def estimate() -> DbhEstimate:
    result = measure_stem(cylinder())
    assert isinstance(result, DbhEstimate)
    return result


def rows() -> list[TableRow]:
    return [
        TableRow(1, 30.25, "good", 355.0, ""),
        TableRow(2, None, "", None, "too few points"),
        TableRow(10, 12.0, "poor", 140.0, "oak"),
    ]


def ids_in(content: str) -> list[int]:
    return [int(found) for found in re.findall(r'<tr data-id="(\d+)"', content)]


def test_the_card_shows_the_number_and_where_it_was_measured(estimate):
    card = html.tree_card(7, estimate, curve_title="Fourier")
    assert "Tree 7" in card
    assert 'data-dbh="30.0"' in card
    assert "1.22–1.52 m" in card


def test_a_refused_tree_shows_reason_and_remedy_and_no_number():
    card = html.tree_card(7, Refusal("small_arc", "Only 40° were seen.", "Walk round it."), curve_title="Fourier")
    assert "Only 40° were seen." in card
    assert "Walk round it." in card
    assert "data-dbh" not in card
    assert not re.search(r"\d+(\.\d+)?<small> cm", card)


def test_an_unknown_diameter_is_a_dash_never_zero():
    cells = rows()[1].cells()
    assert cells[1] == cells[3] == "–"
    assert "0" not in "".join(cells[1:4])


@pytest.mark.parametrize(
    ("column", "descending", "expected"),
    [
        ("id", False, [1, 2, 10]),
        ("id", True, [10, 2, 1]),
        ("dbh", False, [10, 1, 2]),
        ("dbh", True, [1, 10, 2]),
        ("quality", False, [1, 10, 2]),
        ("arc", True, [1, 10, 2]),
    ],
)
def test_sorting_keeps_unknown_values_at_the_end(column, descending, expected):
    table = html.tree_table(rows(), selected=None, column=column, descending=descending)
    assert ids_in(table) == expected


def test_the_selected_row_is_marked():
    table = html.tree_table(rows(), selected=10, column="id", descending=False)
    assert re.findall(r'data-id="(\d+)" data-selected="true"', table) == ["10"]


@pytest.mark.parametrize(
    "content",
    [
        html.tree_table([TableRow(1, 1.0, ATTACK, 1.0, ATTACK)], selected=None, column="id", descending=False),
        html.header(ATTACK, PlotStatus(), "open", saved=ATTACK, undo=ATTACK, redo=ATTACK),
        html.message(ATTACK, level=ATTACK, remedy=ATTACK),
        html.findings([(ATTACK, ATTACK, ATTACK)]),
        html.facts([(ATTACK, ATTACK)]),
        html.tree_card(1, Refusal("x", ATTACK, ATTACK), curve_title=ATTACK),
    ],
    ids=["table", "header", "message", "findings", "facts", "card"],
)
def test_text_from_outside_never_becomes_markup(content):
    assert "<img" not in content
    assert "&lt;img" in content


def test_the_section_shows_points_and_all_three_curves(estimate):
    picture = section_svg(estimate, curve="fourier")
    assert set(re.findall(r'data-curve="(\w+)"', picture)) == {"fourier", "ellipse", "bspline"}
    # The chosen curve is drawn last, over the others.
    assert re.findall(r'data-curve="(\w+)"', picture)[-1] == "fourier"
    assert picture.count("M") > 100
    assert "10 cm" in picture


def test_the_outline_is_drawn_to_scale(estimate):
    picture = section_svg(estimate, curve="fourier")
    outline = re.search(r'data-curve="fourier" points="([^"]+)"', picture)
    assert outline is not None
    xy = np.array([[float(v) for v in point.split(",")] for point in outline.group(1).split()])
    bar = re.search(r'd="M12 [\d.]+h([\d.]+)"', picture)
    assert bar is not None
    pixels_per_cm = float(bar.group(1)) / 10
    assert np.ptp(xy, axis=0) / pixels_per_cm == pytest.approx([30, 30], rel=0.03)


def test_a_refusal_without_a_section_has_no_picture():
    assert section_svg(Refusal("no_band", "a", "b"), curve="fourier") == ""


def test_a_refusal_never_shows_a_diameter_in_the_legend():
    result = measure_stem(cylinder(arc_deg=50), settings=MeasureSettings(min_coverage_deg=180))
    assert isinstance(result, Refusal)
    assert " cm</span>" not in section_svg(result, curve="fourier")
