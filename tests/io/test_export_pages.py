"""Parts of the pages that are handed in: words in both units, charts, maps, the log, the thinned cloud."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from tests.io.test_exports import row, stems

from dbh_studio.core.corrections import Correction
from dbh_studio.core.inventory import Inventory
from dbh_studio.core.stand import PlotArea, stand_table
from dbh_studio.core.tree_record import Review, TreeRecord
from dbh_studio.io.exports import table_of
from dbh_studio.io.exports.charts import distribution_svg
from dbh_studio.io.exports.edit_log import decisions, history_entries, write_edits_csv
from dbh_studio.io.exports.pages import Words, data_block
from dbh_studio.io.exports.report_stems import stem_facts
from dbh_studio.io.exports.scene_html import Scene, scene_html
from dbh_studio.io.exports.stem_map import North, stem_map_svg
from dbh_studio.io.history import HistoryEntry

CIRCLE = PlotArea.circle((0, 0), 56.4189584)  # one hectare


def test_lengths_as_words():
    metric, imperial = Words(), Words("imperial")
    assert metric.diameter(31.25) == "31.2" and imperial.diameter(31.25, unit=True) == "12.30 in"
    assert metric.height(1.3, unit=True) == "1.30 m" and imperial.height(1.3716) == "4.50"
    assert metric.diameter(None) == imperial.height(None) == "–"
    assert metric.interval(row(1, 20.0, 0, 0)) == "–"


def bars(svg):
    """(height, title) of each bar."""
    return [
        (float(height), title)
        for height, title in re.findall(r'<rect[^>]*height="([\d.]+)"[^>]*><title>([^<]*)</title>', svg)
    ]


@pytest.mark.parametrize(("units", "said"), [("metric", "10–15 cm, oak: 2 per ha"), ("imperial", "4–6 in, oak: 1 per")])
def test_bars_are_as_high_as_their_classes_have_stems(units, said):
    inventory = Inventory.of(
        [row(k, dbh, k, 0, species=name) for k, (dbh, name) in enumerate(
            [(11.0, "oak"), (12.0, "oak"), (12.5, "ash"), (38.0, "oak"), (None, "oak")], start=1
        )]
    )  # fmt: skip
    stand = stand_table(inventory, CIRCLE, units=units)
    drawn = bars(distribution_svg(stand))
    assert any(title.startswith(said) for _, title in drawn)
    counts = [row.classes for row in stand.rows]
    expected = sorted(count for part in counts for count in part if count > 0)
    heights = sorted(height for height, _ in drawn)
    assert np.allclose(np.array(heights) / heights[-1], np.array(expected) / expected[-1], atol=1e-3)


def test_many_species_are_told_apart_and_the_rest_is_joined():
    inventory = Inventory.of([row(k, 10.0 + k, k, 0, species=f"<s{k}>") for k in range(1, 10)])
    picture = distribution_svg(stand_table(inventory, CIRCLE))
    assert picture.count("<i style") == 6 and "other species" in picture and "<s1>" not in picture
    assert distribution_svg(stand_table(Inventory(), CIRCLE)) == ""


def test_ids_of_the_map_do_not_cover_each_other_where_there_is_room():
    rng = np.random.default_rng(1)
    inventory = Inventory.of(
        [row(k + 100, 30.0, x, y) for k, (x, y) in enumerate(rng.uniform(0, 30, (60, 2)), start=1)]
    )
    drawn = stem_map_svg(table_of(inventory), north=North("N", "<grid> north"), links=True)
    places = [(float(x), float(y)) for x, y in re.findall(r'<text x="([\d.]+)" y="([\d.]+)"[^>]*>\d+</text>', drawn)]
    assert len(places) == 60 == drawn.count('<a href="#stem-')
    apart = np.abs(np.array(places)[:, None] - np.array(places)[None, :])
    covers = (apart[..., 0] < 20) & (apart[..., 1] < 11) & ~np.eye(60, dtype=bool)
    assert covers.sum() / 2 <= 1
    assert ">N</text>" in drawn and "&lt;grid&gt; north" in drawn


def test_stems_of_one_tree_are_joined_and_feet_are_drawn_in_feet():
    drawn = stem_map_svg(table_of(stems(), "imperial"))
    assert drawn.count("<polyline") == 1 and re.search(r">\d+ ft</text>", drawn) and "12.3 in" in drawn


def test_a_map_of_nothing_is_a_map():
    drawn = stem_map_svg(table_of(Inventory()), area=CIRCLE)
    assert "<polygon" in drawn and drawn.endswith("</svg>")


@pytest.mark.parametrize(("method", "said"), [("drawn", "Ring drawn by hand, as"), ("fourier", "Fourier, as")])
def test_what_a_diameter_was_read_from_has_a_name(method, said):
    stem = replace(row(1, 20.0, 0, 0), dbh_method=method, dbh_definition="tape")
    assert dict(stem_facts(stem, TreeRecord(), Words()))["Read from"].startswith(said)


def test_the_log_in_both_units_and_safe_in_a_spreadsheet(tmp_path):
    record = TreeRecord(
        corrections=(
            Correction("breast_height", 1.5, "=A", "2026-01-01T00:00:00+00:00", "=cmd|'x'"),
            Correction("left_out", (1, 2, 3)),
            Correction("tape", 30.0),
        ),
        review=Review("doubtful", None, "small_arc", "B", "2026-01-02T00:00:00+00:00"),
    )
    entries = decisions({4: record}, Words("imperial"))
    assert [entry.value for entry in entries] == [
        "4.92 ft", "3 points", "11.81 in", "doubtful: no diameter (small_arc)",
    ]  # fmt: skip
    done = history_entries([HistoryEntry("t", "=A", "Delete trunk 1"), HistoryEntry("t", "", "Undo: Delete trunk 1")])
    assert [entry.kind for entry in done] == ["edit", "undo"]
    content = write_edits_csv(tmp_path / "new" / "edits.csv", [*done, *entries]).read_text("utf-8")
    assert len(content.splitlines()) == 7 and ",=" not in content and "'=cmd|'x'" in content


def scene_of(inventory, points, owner):
    return Scene(
        "<plot>", "words", table_of(inventory), {}, points, np.full((len(points), 3), 128, np.uint8), owner,
        {each.stem_id: (1, 2, 3) for each in inventory}, {},
    )  # fmt: skip


def test_a_3d_page_of_nothing_and_of_one_point_is_a_page():
    empty = scene_html(scene_of(Inventory(), np.empty((0, 3)), np.empty(0, np.int32)))
    assert '"n":0' in empty and "&lt;plot&gt;" in empty
    one = scene_html(scene_of(Inventory.of([row(7, None, 1, 1)]), np.ones((1, 3)), np.array([7], np.int32)))
    data = json.loads(re.search(r'id="scene-data">(.*?)</script>', one)[1])
    assert data["n"] == 1 and data["stems"][0]["dbh"] == "no diameter" and "ring" not in data["stems"][0]


def test_data_of_a_page_cannot_end_its_element():
    block = data_block("x", {"note": "</script><script>alert(1)</script>\u2028"})
    assert block.count("</script>") == 1 and "\u2028" not in block
    assert json.loads(re.search(r">(.*)</script>", block)[1])["note"].startswith("</script>")
