"""The statistics against numbers worked by hand, every stem accounted for, and figures that are XML."""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbh_studio.core.comparison import Grouping, compare
from dbh_studio.core.evaluation import (
    MIN_N,
    Sample,
    measured_arrays,
    relative_error_pct,
    statistics,
    table_lines,
    tukey_box,
)
from dbh_studio.core.evaluation_figures import SectionPicture, boxes_svg, scatter_svg, sections_svg
from dbh_studio.core.stem_table import StemTable, combined, id_key
from dbh_studio.errors import SettingError, StudioError

# Reference y  20  30  40  50  60      median 40, mean 40
# Estimate ŷ   21  29  44  48  66      mean 41.6
# e = ŷ − y    +1  −1  +4  −2  +6      sorted −2 −1 1 4 6: median bias 1; mean 8/5 = 1.6
# |e − 1|       0   2   3   3   5      sorted 0 2 3 3 5:   MAD 3; rCV = 3/40 = 7.5 %
# e²            1   1  16   4  36      sum 58: RMSE = √(58/5) = √11.6
# |e|/y in %    5  10/3 10  4  10      sorted 10/3 4 5 10 10: median 5
# R²: x = y − 40 = −20 −10 0 10 20, Σx² = 1000; z = ŷ − 41.6 = −20.6 −12.6 2.4 6.4 24.4,
#     Σz² = 424.36 + 158.76 + 5.76 + 40.96 + 595.36 = 1225.2; Σxz = 412 + 126 + 0 + 64 + 488 = 1090;
#     R² = 1090² / (1000 · 1225.2) = 1188100 / 1225200
REFERENCE = [20.0, 30.0, 40.0, 50.0, 60.0]
ESTIMATED = [21.0, 29.0, 44.0, 48.0, 66.0]


def test_the_papers_statistics_are_those_worked_by_hand():
    s = statistics(ESTIMATED, REFERENCE)
    assert s.n == 5
    assert s.median_bias_cm == pytest.approx(1.0)
    assert s.mad_cm == pytest.approx(3.0)
    assert s.rcv_pct == pytest.approx(7.5)
    assert s.r_squared == pytest.approx(1_188_100 / 1_225_200)
    assert s.median_rel_err_pct == pytest.approx(5.0)
    assert s.mean_bias_cm == pytest.approx(1.6)
    assert s.rmse_cm == pytest.approx(np.sqrt(11.6))
    assert s.p90_rel_err_pct is None  # of five values the 90th percentile would be the largest


def test_relative_error_has_no_sign():
    assert relative_error_pct([18.0, 22.0], [20.0, 20.0]) == pytest.approx([10.0, 10.0])


def test_the_90th_percentile_is_interpolated():
    # Eleven references of 100 with errors 0, 1, … 10 cm: |e|/y = 0 … 10 %. Place 0.9 · 10 = 9 in the order: 9 %.
    s = statistics(100.0 + np.arange(11.0), np.full(11, 100.0))
    assert s.p90_rel_err_pct == pytest.approx(9.0)
    # Ten values 0 … 9 %: place 0.9 · 9 = 8.1 between the values 8 and 9: 8.1 %.
    assert statistics(100.0 + np.arange(10.0), np.full(10, 100.0)).p90_rel_err_pct == pytest.approx(8.1)


def test_coverage_counts_the_ends_and_only_stems_with_an_interval():
    # Ten intervals: [18, 22] holds 20; [20, 22] holds it at its end; [21, 25] does not. 8 + 1 of 10 hold: 90 %.
    interval = [[18.0, 22.0]] * 8 + [[20.0, 22.0], [21.0, 25.0], [np.nan, np.nan]]
    s = statistics(np.full(11, 21.0), np.full(11, 20.0), interval)
    assert (s.n, s.n_intervals, s.n_covered) == (11, 10, 9)
    assert s.coverage_pct == pytest.approx(90.0)
    few = statistics(np.full(4, 21.0), np.full(4, 20.0), interval[:4])
    assert (few.n_covered, few.coverage_pct) == (4, None)


@pytest.mark.parametrize("n", range(MIN_N))
def test_too_few_pairs_give_a_count_and_no_statistic(n):
    s = statistics(ESTIMATED[:n], REFERENCE[:n])
    assert s.n == n
    assert {s.median_bias_cm, s.mad_cm, s.rcv_pct, s.r_squared, s.median_rel_err_pct, s.rmse_cm} == {None}


def test_no_r_squared_without_spread_or_with_four_pairs():
    assert statistics(ESTIMATED[:4], REFERENCE[:4]).r_squared is None
    assert statistics(ESTIMATED, [30.0] * 5).r_squared is None
    assert statistics([30.1] * 5, REFERENCE).r_squared is None


@pytest.mark.parametrize(
    ("estimated", "reference"),
    [([1.0], [1.0, 2.0]), ([np.nan], [1.0]), ([1.0], [0.0]), ([1.0], [-3.0]), ([[1.0]], [[1.0]])],
)
def test_what_is_no_pair_of_diameters_is_a_wrong_call(estimated, reference):
    with pytest.raises(ValueError, match="diameters"):
        statistics(estimated, reference)


@given(
    st.lists(st.tuples(st.floats(5.0, 120.0), st.floats(-4.0, 4.0)), min_size=10, max_size=40),
    st.floats(-3.0, 3.0),
    st.floats(0.5, 3.0),
)
def test_a_shift_moves_the_biases_only_and_a_unit_scales_all_lengths(pairs, shift, unit):
    reference = np.array([y for y, _ in pairs])
    estimated = reference + np.array([e for _, e in pairs])
    plain, moved = statistics(estimated, reference), statistics(estimated + shift, reference)
    assert moved.median_bias_cm == pytest.approx(plain.median_bias_cm + shift, abs=1e-9)
    assert moved.mean_bias_cm == pytest.approx(plain.mean_bias_cm + shift, abs=1e-9)
    assert moved.mad_cm == pytest.approx(plain.mad_cm, abs=1e-9)
    scaled = statistics(unit * estimated, unit * reference)
    assert scaled.rcv_pct == pytest.approx(plain.rcv_pct, abs=1e-9)
    assert scaled.rmse_cm == pytest.approx(unit * plain.rmse_cm, abs=1e-9)


def test_a_tukey_box_worked_by_hand():
    # 1 … 9 and 30: quartiles at places 2.25 and 6.75 of 0 … 9: 3.25 and 7.75; range 4.5, reach 6.75;
    # whiskers within −3.5 … 14.5: 1 and 9; 30 is beyond. Median 5.5.
    box = tukey_box([30.0, *range(1, 10)])
    assert box.quartiles == pytest.approx((3.25, 7.75))
    assert box.median == pytest.approx(5.5)
    assert box.whiskers == (1.0, 9.0)
    assert box.outliers == (30.0,)
    assert tukey_box([1.0, 2.0]) is None


# ---- every stem is accounted for


def table(name, ids, diameters, *, xy=None, plots=None, cells=None, problems=None, intervals=None):
    n = len(ids)
    return StemTable(
        name,
        tuple(ids),
        tuple(plots or [""] * n),
        np.full((n, 2), np.nan) if xy is None else np.asarray(xy, float),
        {"dbh": np.asarray(diameters, float)},
        {} if intervals is None else {"dbh": np.asarray(intervals, float)},
        {} if problems is None else {"dbh": tuple(problems)},
        {k: tuple(v) for k, v in (cells or {}).items()},
    )


def by_tree(comparison):
    return {(s.tree or f"extra {s.stem}"): s for s in comparison.samples}


def test_found_refused_missed_extra_and_unknown():
    inventory = table("mine", "ABCX", [21.0, np.nan, 30.0, 9.0], problems=["", "only 70° of the ring seen", "", ""])
    reference = table("field", "ABCD", [20.0, 25.0, np.nan, 40.0], problems=["", "", "0, which means unknown", ""])
    comparison = compare([inventory], reference)
    samples = by_tree(comparison)
    assert {k: s.outcome for k, s in samples.items()} == {
        "A": "measured", "B": "refused", "C": "unknown", "D": "missed", "extra X": "extra",
    }  # fmt: skip
    assert samples["A"].error_cm == pytest.approx(1.0)
    assert samples["A"].error_pct == pytest.approx(5.0)
    assert samples["B"].reason == "only 70° of the ring seen"
    assert samples["C"].reason == "0, which means unknown"
    assert "no number D" in samples["D"].reason
    (line,) = comparison.lines
    assert (line.n_reference, line.n_measured, line.n_refused, line.n_missed, line.n_extra) == (3, 1, 1, 1, 1)
    assert line.found_pct == pytest.approx(200 / 3)
    assert line.statistics.n == 1
    assert line.statistics.median_bias_cm is None


def test_categories_of_the_reference_count_what_was_missed_and_those_of_the_inventory_do_not():
    inventory = table("mine", "ABCX", [21.0, 31.0, 41.0, 5.0], cells={"quality": ["good", "poor", "good", "poor"]})
    reference = table("field", "ABCD", [20.0, 30.0, 40.0, 50.0], cells={"Status": ["L", "L", "D", "L"]})
    comparison = compare([inventory], reference, by=[Grouping("Status"), Grouping("quality")])
    lines = {(line.column, line.category): line for line in comparison.lines}
    assert lines["Status", "L"].n_missed == 1
    assert lines["Status", "L"].n_reference == 3
    assert lines["Status", "L"].n_extra is None
    assert lines["quality", "poor"].n_extra == 1
    assert lines["quality", "poor"].n_missed is None
    assert lines["quality", "poor"].found_pct is None
    assert [c for c in comparison.categories["Status"]] == ["D", "L"]


def test_classes_of_numbers():
    grouping = Grouping.parse("reference:arc:180,270")
    assert grouping == Grouping("arc", (180.0, 270.0), "reference")
    cells = {"arc": ["120", "180", "269.9", "270", ""]}
    reference = table("field", "ABCDE", [20.0] * 5, cells=cells)
    inventory = table("mine", "ABCDE", [20.0] * 5)
    samples = by_tree(compare([inventory], reference, by=[grouping]))
    assert [samples[t].groups["arc"] for t in "ABCDE"] == [
        "below 180", "180 to 270", "180 to 270", "270 and over", "not given",
    ]  # fmt: skip


def test_many_different_numbers_become_thirds_and_few_stay():
    ids = [str(i) for i in range(30)]
    cells = {"size": [f"{i + 0.5}" for i in range(30)], "plot": [str(i % 3) for i in range(30)]}
    reference = table("field", ids, [20.0] * 30, cells=cells)
    comparison = compare([table("mine", ids, [21.0] * 30)], reference, by=[Grouping("size"), Grouping("plot")])
    assert comparison.categories["size"] == ("below 10.2", "10.2 to 19.8", "19.8 and over")
    assert comparison.categories["plot"] == ("0", "1", "2")
    assert [line.n_measured for line in comparison.lines if line.column == "size"] == [10, 10, 10]


def test_the_reference_diameter_is_a_column_of_its_own():
    reference = table("field", "ABC", [8.0, 20.0, 35.0])
    comparison = compare(
        [table("mine", "ABC", [8.0, 20.0, 35.0])], reference, by=[Grouping.parse("reference_cm:10,30")]
    )
    assert comparison.categories["reference_cm"] == ("below 10", "10 to 30", "30 and over")


@pytest.mark.parametrize("text", ["", "dbh:30,20", ":10", "reference:"])
def test_groupings_that_cannot_be(text):
    with pytest.raises(SettingError):
        Grouping.parse(text)


def test_a_column_that_no_table_has_and_classes_of_words():
    reference = table("field", "ABC", [8.0, 20.0, 35.0], cells={"Spp": ["a", "b", "c"]})
    inventory = table("mine", "ABC", [8.0, 20.0, 35.0])
    with pytest.raises(SettingError, match="No table has a column height"):
        compare([inventory], reference, by=[Grouping("height")])
    with pytest.raises(SettingError, match="holds no numbers"):
        compare([inventory], reference, by=[Grouping("Spp", (1.0,))])


def test_a_column_of_names_is_no_category():
    ids = [str(i) for i in range(300)]
    reference = table("field", ids, [20.0] * 300, cells={"name": [f"tree {i}" for i in ids]})
    with pytest.raises(SettingError, match="300 different values"):
        compare([table("mine", ids, [21.0] * 300)], reference, by=[Grouping("name")])


def test_rival_inventories_are_methods_and_pooled_ones_are_samples():
    reference = table("field.csv", "ABC", [20.0, 30.0, 40.0])
    one, two = table("one.csv", "ABC", [21.0, 31.0, 41.0]), table("two.csv", "AB", [22.0, 32.0])
    rivals = compare([one, two], reference)
    assert rivals.methods == ("one", "two")
    assert [line.n_missed for line in rivals.lines] == [0, 1]
    pooled = compare([one, two], reference, by=[Grouping("inventory")], pool=True)
    assert pooled.methods == ("dbh",)
    assert pooled.lines[0].statistics.n == 5
    assert {line.category: line.n_measured for line in pooled.lines[1:]} == {"one.csv": 3, "two.csv": 2}


def test_a_unit_mixed_up_is_suspected():
    reference = table("field", "ABCDEF", [10.0, 12.0, 15.0, 18.0, 20.0, 25.0])
    inches = table("mine", "ABCDEF", np.array([10.0, 12.0, 15.0, 18.0, 20.0, 25.0]) / 2.54)
    assert any("inches" in note for note in compare([inches], reference).notes)
    right = table("mine", "ABCDEF", np.array([10.0, 12.0, 15.0, 18.0, 20.0, 25.0]) * 0.8)
    assert not any("mixed up" in note for note in compare([right], reference).notes)


# ---- trees of many stems


def test_stems_are_joined_by_the_root_of_the_sum_of_squares():
    stems = table(
        "field", ["1", "1", "2", "3", "3", ""], [30.0, 40.0, 20.0, 10.0, np.nan, 7.0],
        xy=[[0, 0], [1, 0], [5, 5], [8, 8], [8, 9], [2, 2]],
        problems=["", "", "", "", "no diameter", ""],
        intervals=[[28, 32], [38, 42], [19, 21], [9, 11], [np.nan, np.nan], [6, 8]],
    )  # fmt: skip
    trees = combined(stems)
    assert trees.ids == ("1", "2", "3", "")
    # √(30² + 40²) = 50
    assert trees.diameters_cm["dbh"] == pytest.approx([50.0, 20.0, np.nan, 7.0], nan_ok=True)
    assert trees.xy_m[0] == pytest.approx([0.5, 0.0])
    assert np.isnan(trees.intervals_cm["dbh"][0]).all()
    assert trees.intervals_cm["dbh"][1] == pytest.approx([19.0, 21.0])
    assert "one of its 2 stems has no diameter" in trees.problems["dbh"][2]
    assert combined(trees) is trees


@pytest.mark.parametrize(("one", "other"), [("007", "7"), ("7.0", "7"), (" a1 ", "A1"), ("T-3", "t-3")])
def test_numbers_that_mean_the_same(one, other):
    assert id_key(one) == id_key(other)
    assert id_key("70") != id_key("7")


def test_a_table_of_unequal_parts_is_a_wrong_call():
    with pytest.raises(ValueError, match="do not all have"):
        StemTable("t", ("1", "2"), ("",), np.zeros((2, 2)), {"dbh": np.zeros(2)})


# ---- figures


def samples_of(method, n, *, factor=1.05, category="a"):
    reference = np.linspace(10.0, 60.0, n)
    return [
        Sample(method, "inv", "measured", tree=f"<{k}>", stem=str(k), estimated_cm=factor * y, reference_cm=y,
               interval_cm=(0.9 * y, 1.2 * y), groups={"c": category})
        for k, y in enumerate(reference.tolist())
    ]  # fmt: skip


def test_the_scatter_has_every_pair_where_it_belongs():
    samples = samples_of("fourier & co", 12)
    svg = scatter_svg({"all <trees>": samples}, ["fourier & co"], marks=lambda s: f'data-tree="{s.stem}"')
    root = ET.fromstring(svg)
    dots = [node for node in root.iter() if node.get("data-tree")]
    assert [node.get("data-tree") for node in dots] == [str(k) for k in range(12)]
    x, y = (np.array([float(node.get(key)) for node in dots]) for key in ("cx", "cy"))
    estimated, reference, _ = measured_arrays(samples)
    # One scale for both axes, y downwards: pixels are an affine image of centimetres.
    slope_x, slope_y = np.polyfit(reference, x, 1)[0], np.polyfit(estimated, y, 1)[0]
    assert slope_x > 0
    assert slope_y == pytest.approx(-slope_x, rel=0.01)
    assert np.abs(np.polyval(np.polyfit(reference, x, 1), reference) - x).max() < 0.1
    assert "<0>" in dots[0][0].text  # the title a page shows on hovering, unescaped again


def test_boxes_say_n_and_where_there_are_too_few():
    samples = [*samples_of("a", 12), *samples_of("b", 2)]
    root = ET.fromstring(boxes_svg({"all": samples}, ["a", "b"]))
    words = [node.text for node in root.iter() if node.tag.endswith("text")]
    assert "n = 12" in words
    assert "n = 2" in words
    assert "too few" in words


def test_a_wild_value_is_counted_at_the_edge_and_does_not_flatten_the_boxes():
    samples = samples_of("a", 12)
    wild = Sample("a", "inv", "measured", estimated_cm=500.0, reference_cm=10.0)
    words = "".join(ET.fromstring(boxes_svg({"all": [*samples, wild]}, ["a"])).itertext())
    assert "1 more, up to 4900" in words


def test_what_stands_under_many_boxes_does_not_run_into_one_another():
    methods = [f"m{k}" for k in range(12)]
    samples = [Sample(m, "t", "measured", estimated_cm=20.0 + k, reference_cm=20.0) for m in methods for k in range(4)]
    samples += [Sample(m, "t", "measured", estimated_cm=900.0, reference_cm=20.0) for m in methods]
    root = ET.fromstring(boxes_svg({"a": samples, "b": samples}, methods))
    words = [(float(e.get("x")), e.get("y"), e.text) for e in root.iter() if (e.text or "").startswith(("n = ", "▲"))]
    assert len(words) == 48
    for line in {y for _, y, _ in words}:
        at = sorted((x, text) for x, y, text in words if y == line)
        # A letter of 11 px is 6 px wide, about.
        assert all(b - a > 6.0 * len(text) for (a, text), (b, _) in itertools.pairwise(at))
    width = float(root.get("viewBox").split()[2])
    assert max(x for x, _, _ in words) < width


def test_nothing_to_draw_is_a_picture_all_the_same():
    for svg in (scatter_svg({"": []}, []), boxes_svg({"": []}, []), sections_svg([])):
        ET.fromstring(svg)


def test_a_section_shows_the_reference_as_a_circle_of_its_size():
    angle = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    ring = 0.15 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    picture = SectionPicture("tree 5\x00", ring, np.ones(200, bool), {"circle": ring}, 15.0)
    root = ET.fromstring(sections_svg([picture]))
    (circle,) = [node for node in root.iter() if node.tag.endswith("circle")]
    (outline,) = [node for node in root.iter() if node.tag.endswith("polygon")]
    x = [float(point.split(",")[0]) for point in outline.get("points").split()]
    # The reference is half as thick as what was measured.
    assert 2.0 * float(circle.get("r")) == pytest.approx(0.5 * (max(x) - min(x)), rel=0.01)


def test_lines_come_in_the_order_asked_for():
    samples = [*samples_of("b", 4, category="z"), *samples_of("a", 4, category="k")]
    lines = table_lines(samples, {"c": ("z", "k", "nobody")})
    assert [(line.category, line.method) for line in lines] == [("All", "b"), ("All", "a"), ("z", "b"), ("k", "a")]


def test_tables_without_anything_common_are_told():
    with pytest.raises(StudioError, match="could be paired"):
        compare([table("mine", "AB", [1.0, 2.0])], table("field", "XY", [1.0, 2.0]))
