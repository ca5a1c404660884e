"""The panel's HTML: what a forester reads, and that no text from outside becomes markup."""

import re

import numpy as np
import pytest

from dbh_studio.core.dbh import DbhEstimate, Refusal, measure_stem
from dbh_studio.core.protocol_measure import measure_by_protocol
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.section_drawing import section_drawing
from dbh_studio.settings import MeasureSettings
from dbh_studio.ui import html, tree_card
from dbh_studio.ui.section_svg import section_svg
from dbh_studio.ui.steps import PlotStatus
from dbh_studio.ui.tree_table import TableRow, tree_table

FOURIER = MeasureSettings(curve="fourier", definition="curve")
ATTACK = "<img src=x onerror=alert(1)>\"'`"


def cylinder(radius_m: float = 0.15, *, arc_deg: float = 360.0, n: int = 6000) -> np.ndarray:
    rng = np.random.default_rng(5)
    angle = np.deg2rad(rng.uniform(0, arc_deg, n))
    radius = radius_m + rng.normal(0, 0.002, n)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0.2, 3.0, n)])


@pytest.fixture(scope="module")
def estimate() -> DbhEstimate:
    """By the paper's Fourier curve, with the other two beside it."""
    result = measure_stem(cylinder(), settings=FOURIER)
    assert isinstance(result, DbhEstimate)
    return result


@pytest.fixture(scope="module")
def half_seen() -> DbhEstimate:
    result = measure_stem(cylinder(arc_deg=200.0))
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
    card = tree_card.tree_card(7, estimate)
    assert "Tree 7" in card
    assert 'data-dbh="30.0"' in card
    assert "1.22 to 1.52 m" in card


def test_a_refused_tree_shows_reason_and_remedy_and_no_number():
    card = tree_card.tree_card(7, Refusal("small_arc", "only 40° were seen.", "Walk round it."))
    assert "Only 40° were seen." in card
    assert "Walk round it." in card
    assert "data-dbh" not in card
    assert "no diameter" in card
    assert "–" not in card


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
    table = tree_table(rows(), selected=None, column=column, descending=descending)
    assert ids_in(table) == expected


def test_the_selected_row_is_marked():
    table = tree_table(rows(), selected=10, column="id", descending=False)
    assert re.findall(r'data-id="(\d+)" data-selected="true"', table) == ["10"]


@pytest.mark.parametrize(
    "content",
    [
        tree_table([TableRow(1, 1.0, ATTACK, 1.0, ATTACK)], selected=None, column="id", descending=False),
        html.header(ATTACK, PlotStatus(), "open", saved=ATTACK, undo=ATTACK, redo=ATTACK),
        html.message(ATTACK, level=ATTACK, remedy=ATTACK),
        html.findings([(ATTACK, ATTACK, ATTACK)]),
        html.facts([(ATTACK, ATTACK)]),
        tree_card.tree_card(1, Refusal("x", ATTACK, ATTACK)),
        html.job_box(ATTACK),
    ],
    ids=["table", "header", "message", "findings", "facts", "card", "job"],
)
def test_text_from_outside_never_becomes_markup(content):
    assert "<img" not in content
    assert "&lt;img" in content


@pytest.mark.parametrize(
    "script",
    [
        html.job_js(0.5, ATTACK),
        html.view_bar_js([(ATTACK, ATTACK)], ATTACK, [(ATTACK, ATTACK, ATTACK)]),
    ],
    ids=["job", "view bar"],
)
def test_text_from_outside_never_ends_a_script(script):
    """It stays inside a string literal, without a `<` that could end the script."""
    assert "<" not in script.replace("i<n", "")
    assert "onerror" not in re.sub(r'"(?:[^"\\]|\\.)*"', "", script)
    assert "onerror" in script


def test_the_hint_leads_to_the_step_where_the_next_thing_is_done():
    status = PlotStatus(has_plot=True, is_scaled=True)
    elsewhere = html.header("plot", status, "open", saved="", undo="", redo="")
    assert 'data-do="next"' in elsewhere
    assert "3 Trunks" in elsewhere
    there = html.header("plot", status, "trunks", saved="", undo="", redo="")
    assert 'data-do="next"' not in there


def history_buttons(**options):
    """State and tooltip of Undo and Redo."""
    header = html.header("plot", PlotStatus(has_plot=True), "open", saved="", **options)
    found = re.findall(r'<button type="button" data-do="(?:undo|redo)" title="([^"]*)"[^>]*?( disabled)?>', header)
    return [("off" if off else "on", tip) for tip, off in found]


def test_undo_and_redo_can_be_pressed_where_there_is_something_and_say_why_not_on_a_plot_for_reading():
    labels = {"undo": "Delete trunk 3", "redo": ""}
    assert history_buttons(**labels) == [("on", "Undo: Delete trunk 3"), ("off", "")]
    both = history_buttons(undo="Delete trunk 3", redo="Merge", is_read_only=True)
    assert [state for state, _ in both] == ["off", "off"]
    assert all("reading only" in tip and "copy" in tip for _, tip in both)


def test_the_hint_gives_its_place_to_a_running_job():
    status = PlotStatus(has_plot=True, is_scaled=True)
    assert "Press Find trunks." not in html.header("plot", status, "trunks", saved="", undo="", redo="", is_busy=True)
    assert "Cancel" in html.job_box("Finding trunks")


@pytest.mark.parametrize(("fraction", "width"), [(-1.0, "0%"), (0.256, "26%"), (7.0, "100%")])
def test_the_bar_of_a_job_stays_in_its_box(fraction, width):
    assert f'"{width}"' in html.job_js(fraction, "")


def test_a_reason_begins_with_a_capital_and_keeps_the_rest():
    assert html.plain("curves disagree: Fourier 29.5 cm, B-spline 31.1 cm") == (
        "Curves disagree: Fourier 29.5 cm, B-spline 31.1 cm"
    )
    assert html.plain("") == ""


def test_the_view_bar_shows_which_colours_are_on():
    script = html.view_bar_js([("a", "First"), ("b", "Second")], "b", [])
    pressed = re.findall(r'data-mode=\\"(\w)\\" aria-pressed=\\"(\w+)\\"', script)
    assert pressed == [("a", "false"), ("b", "true")]


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
    result = measure_stem(cylinder(arc_deg=50), settings=FOURIER.changed(min_coverage_deg=180))
    assert isinstance(result, Refusal)
    assert " cm</span>" not in section_svg(result, curve="fourier")
    accepted = measure_stem(cylinder(), settings=FOURIER)
    assert " cm</span>" in section_svg(accepted, curve="fourier")


def test_every_curve_can_be_chosen_in_the_legend(estimate):
    picture = section_svg(estimate, curve="ellipse")
    assert re.findall(r'data-choose="(\w+)" aria-pressed="(\w+)"', picture) == [
        ("shrinkage", "false"),
        ("circle", "false"),
        ("fourier", "false"),
        ("ellipse", "true"),
        ("bspline", "false"),
    ]


def test_the_card_says_the_interval_in_brackets(half_seen):
    card = tree_card.tree_card(7, half_seen)
    low, high = half_seen.interval
    assert f"<b>{half_seen.dbh_cm:.1f}</b>" in card
    assert f">cm ({low:.1f}–{high:.1f})</small>" in card
    assert low < 30.0 < high
    assert f"{np.pi * half_seen.dbh_cm:.1f} (" in card  # the girth, as a tape reads it
    assert 'data-flag="partial_arc"' in card


def test_a_method_without_an_interval_says_so(estimate):
    card = tree_card.tree_card(7, estimate)
    assert ">cm</small>" in card
    assert "none: this method has none" in card


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (ScaleEstimate(2.0, "marker", 0.01), "±0.5 % of the scale included"),
        (ScaleEstimate(1.0, "metres"), ""),
        (ScaleEstimate(2.0, "factor"), "not known"),
    ],
)
def test_the_card_says_whether_the_scale_is_in_the_interval(half_seen, scale, words):
    said = tree_card.scale_words(scale)
    assert (words in said) if words else said == ""
    assert said in tree_card.tree_card(7, half_seen, scale=said)


def test_the_unseen_arc_is_dashed_and_the_interval_a_band(half_seen):
    picture = section_svg(half_seen, curve="shrinkage")
    outline = re.search(r'<polygon data-curve="shrinkage" [^>]+>', picture)
    assert outline is not None and "stroke-dasharray" in outline.group()
    seen = re.search(r'<path data-seen d="([^"]+)"', picture)
    assert seen is not None
    assert seen.group(1).count("M") == half_seen.fits["shrinkage"].outline_seen.sum()
    assert "data-band" in picture and "data-tape" in picture
    whole = section_svg(measure_stem(cylinder()), curve="shrinkage")
    drawn = re.search(r'<polygon data-curve="shrinkage" [^>]+>', whole)
    assert drawn is not None and "stroke-dasharray" not in drawn.group() and "data-seen" not in whole


@pytest.mark.parametrize("code", ["no_ring", "clutter", "small_arc"])
def test_what_is_said_to_be_no_ring_is_not_drawn_as_one_that_is_known(half_seen, code):
    refused = Refusal(code, "why", "what to do", section=half_seen.section, fits=half_seen.fits)
    picture = section_svg(refused, curve="shrinkage")
    is_known = code == "small_arc"  # its band says what else would agree with the points
    assert ("data-band" in picture) == ("90 % interval" in picture) == ("data-seen" in picture) == is_known
    assert ("data-band" in section_drawing(refused, curve="shrinkage")) == is_known  # what the report has
    outline = re.search(r'<polygon data-curve="shrinkage" [^>]+>', picture)
    assert outline is not None and "stroke-dasharray" in outline.group()


def test_a_diameter_of_another_height_than_the_plots_says_so(half_seen):
    at = half_seen.section.hom_m
    assert "as the plot" not in tree_card.tree_card(7, half_seen, plot_height_m=at)
    assert f"{at:.2f} m, not {at + 0.5:.2f} m as the plot" in tree_card.tree_card(7, half_seen, plot_height_m=at + 0.5)


@pytest.mark.parametrize("curve", ["shrinkage", "circle", "fourier", "ellipse", "bspline"])
def test_no_diameter_where_the_plots_rules_have_it_says_it_is_elsewhere(curve):
    """The paper's band reaches farther up than down, and along a stem that leans breast height lies lower."""
    c, s = np.cos(np.radians(25.0)), np.sin(np.radians(25.0))
    leaning = (cylinder() - [0, 0, 1.3]) @ [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    for points, along in ((cylinder(), "vertical"), (leaning + [0, 0, 1.3], "stem")):
        rules = MeasureSettings(curve=curve, along=along)
        result = measure_by_protocol(points, settings=rules)
        assert isinstance(result, DbhEstimate)
        card = tree_card.tree_card(7, result, plot_height_m=tree_card.height_of_plot_m(result, rules))
        assert "Measured at" in card and "as the plot" not in card
        moved = rules.changed(breast_height_m=1.5)
        card = tree_card.tree_card(7, result, plot_height_m=tree_card.height_of_plot_m(result, moved))
        assert "as the plot" in card


def test_the_band_is_the_interval_on_average(half_seen):
    fit = half_seen.fits["shrinkage"]
    low, high = half_seen.interval
    share = 1.645 * fit.outline_sd_m.mean() / np.hypot(*fit.outline_uv_m.T).mean()
    assert share == pytest.approx(0.5 * np.log(high / low), rel=0.02)


def test_compare_is_offered_until_every_method_was_fitted(half_seen):
    assert 'data-do="compare"' in section_svg(half_seen, curve="shrinkage")
    every = measure_stem(cylinder(arc_deg=200.0), curves=("shrinkage", "circle", "fourier", "ellipse", "bspline"))
    assert 'data-do="compare"' not in section_svg(every, curve="shrinkage")
    assert every.dbh_cm == half_seen.dbh_cm and every.quality == half_seen.quality
