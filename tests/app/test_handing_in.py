"""One id everywhere: after merging, splitting, undoing and renumbering, every file that is handed in has the same."""

from __future__ import annotations

import base64
import csv
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import laspy
import numpy as np
import pyogrio
import pytest
from tests.threestems import plot_points

from dbh_studio.app import commands, edits
from dbh_studio.app.exports import FORMATS, ExportRequest, export_plot
from dbh_studio.app.opening import open_plot
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.corrections import Correction
from dbh_studio.core.stand import PlotArea
from dbh_studio.core.tree_record import Review
from dbh_studio.core.trunks import TrunkSet
from dbh_studio.errors import FileError, MissingComponentError, SettingError
from dbh_studio.io.las import write_las

FIELD = 'Höhe "top" <m>;\'x'
NOTE = "cavity\x07 & <b>owl</b>\u2028</script>"
# Points of the three stems of the plot, in its order.
STEM = [np.arange(30_000 + 12_000 * k, 42_000 + 12_000 * k) for k in range(3)]


class _Page(HTMLParser):
    """Whether tags are closed as they were opened, and what the page would fetch."""

    void = frozenset({"meta", "img", "link", "br", "hr", "input"})

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.blocks: dict[str, str] = {}
        self._block = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.ids += [given["id"]] if "id" in given else []
        self.links += [given["href"]] if tag == "a" and "href" in given else []
        self.fetched += [given[name] for name in ("src", "srcset") if name in given]
        self.fetched += [given["href"]] if tag in ("link", "use", "image") and "href" in given else []
        self._block = given.get("id", "") if tag == "script" else ""
        if tag not in self.void:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in self.void:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self._block:
            self.blocks[self._block] = self.blocks.get(self._block, "") + data


@pytest.fixture(scope="module")
def plot(tmp_path_factory):
    """A saved plot whose three stems were cut up, joined, renumbered and talked about; and its stems' points by id."""
    folder = tmp_path_factory.mktemp("plot")
    cloud = PointCloud.from_points(plot_points() + [500_000.0, 4_500_000.0, 300.0], crs="EPSG:32633")
    write_las(folder / "stand.laz", cloud)
    session = open_plot(folder / "stand.laz", project_dir=folder / "stand.dbh", background_save=False)
    # Stem 1 is whole, stem 2 was found in two pieces, stem 3 and stem 4 were taken for one.
    halves = STEM[1][:6000], STEM[1][6000:]
    session.do(commands.replace_trunks(TrunkSet.from_point_sets([STEM[0][:6000], STEM[0][6000:], *halves, STEM[2]])))
    session.do(commands.describe_trees([1], species="oak", note=NOTE))
    session.do(commands.describe_trees([4], species="beech", tag="0017"))
    session.do(edits.merge_trunks([3, 4], into=4))
    session.do(edits.split_trunk(5, [STEM[2][:7000], STEM[2][7000:]]))
    session.do(edits.merge_trunks([1, 2], into=1))
    session.undo()
    session.redo()
    session.do(edits.renumber_trunk(5, 40))
    session.do(edits.group_stems([6, 40]))
    session.do(commands.set_tree_fields([4, 6], **{FIELD: "23,5", "dbh_cm": "by eye 24"}))
    session.do(
        commands.correct_measurement(4, Correction("tape", 24.2, "A. B.", "2026-05-03T09:00:00+00:00", "D-tape"))
    )
    found = session.measurement(1).result
    session.do(commands.review_trees({1: Review("accepted", found.dbh_cm, "", "A. B.", "2026-05-03T10:00:00+00:00")}))
    yield session, folder
    session.close()


@pytest.fixture(scope="module")
def handed_in(plot):
    """All files but the PDF, by format."""
    session, folder = plot
    formats = tuple(each for each in FORMATS if each != "pdf")
    area = PlotArea.circle((500_004, 4_500_003), 30)
    written = export_plot(session, folder / "hand in", ExportRequest(formats, area=area))
    return dict(zip(formats, written, strict=True))


def inventory_rows(handed_in):
    with handed_in["csv"].open(newline="", encoding="utf-8") as file:
        return {int(row["stem_id"]): row for row in csv.DictReader(file)}


def test_the_ids_are_those_that_outlive_merging_and_splitting(plot, handed_in):
    session, _ = plot
    assert session.document.trunks.ids == (1, 4, 6, 40)
    rows = inventory_rows(handed_in)
    assert list(rows) == [1, 4, 6, 40]
    assert [rows[i]["tree_id"] for i in rows] == ["1", "4", "6", "6"]
    assert rows[1]["species"] == "oak" and rows[4]["species"] == "beech" and rows[4]["tag"] == "0017"
    assert float(rows[4]["dbh_cm"]) == pytest.approx(24.0, rel=0.02) and rows[4]["field_tape_cm"] == "24.20"


def test_the_profile_has_every_stem_every_ten_centimetres_and_goes_through_its_diameter(handed_in):
    rows = inventory_rows(handed_in)
    with handed_in["profile"].open(newline="", encoding="utf-8") as file:
        heights = list(csv.DictReader(file))
    assert list(heights[0]) == [
        "plot_id", "tree_id", "stem_id", "tag",
        "height_m", "dbh_cm", "dbh_lo_cm", "dbh_hi_cm", "coverage_deg", "reason",
    ]  # fmt: skip
    assert {int(row["stem_id"]) for row in heights} == set(rows)
    for number, row in rows.items():
        along = {float(h["height_m"]): h for h in heights if int(h["stem_id"]) == number}
        apart = np.diff(sorted(along))
        assert len(along) > 15 and apart == pytest.approx(np.full(len(apart), 0.1), abs=1e-9)
        assert {(h["tree_id"], h["tag"]) for h in along.values()} == {(row["tree_id"], row["tag"])}
        assert all(bool(h["dbh_cm"]) != bool(h["reason"]) for h in along.values())
        if row["dbh_cm"]:
            here = along[1.3]
            assert float(here["dbh_cm"]) == pytest.approx(float(row["dbh_cm"]), rel=0.02)
            assert float(here["dbh_lo_cm"]) < float(row["dbh_cm"]) < float(here["dbh_hi_cm"])


def test_the_workbook_has_the_profiles_that_the_csv_has(handed_in):
    with handed_in["profile"].open(newline="", encoding="utf-8") as file:
        expected = list(csv.DictReader(file))
    layers = [name for name, _ in pyogrio.list_layers(handed_in["xlsx"])]
    assert layers == ["Stems", "Stand", "Stem profiles", "Edits", "About"]
    meta, _, _, columns = pyogrio.raw.read(handed_in["xlsx"], layer="Stem profiles", HEADERS="FORCE")
    names = list(meta["fields"])
    assert names == list(expected[0])
    assert all(len(column) == len(expected) > 60 for column in columns)
    for name, column in zip(names, columns, strict=True):
        texts = [row[name] for row in expected]
        if name in ("plot_id", "tag", "reason"):
            assert [cell or "" for cell in column] == texts
        else:
            numbers = [float(text) if text else np.nan for text in texts]
            assert np.asarray(column, float) == pytest.approx(
                np.array(numbers), abs=0.0501 if "deg" in name else 0.00501, nan_ok=True
            )


def test_a_workbook_without_profiles_looks_along_no_stem(plot, tmp_path, monkeypatch):
    """It would take minutes in place of seconds."""
    session, _ = plot
    monkeypatch.setattr(type(session), "profile", lambda *_, **__: pytest.fail("it looked along a stem"))
    (path,) = export_plot(session, tmp_path, ExportRequest(("xlsx",)))
    assert "Stem profiles" not in [name for name, _ in pyogrio.list_layers(path)]


def test_every_stem_is_looked_along_once_for_both_files(plot, tmp_path, monkeypatch):
    session, _ = plot
    seen = []
    monkeypatch.setattr(type(session), "profile", lambda self, stem_id, **_: seen.append(stem_id) or ())
    export_plot(session, tmp_path, ExportRequest(("profile", "xlsx")))
    assert seen == list(session.document.trunks.ids)


def test_every_table_and_map_has_the_same_stems(handed_in):
    rows = inventory_rows(handed_in)
    for kind, layer in (("gpkg", None), ("geojson", None), ("xlsx", "Stems")):
        meta, _, _, columns = pyogrio.raw.read(handed_in[kind], layer=layer)
        table = dict(zip(meta["fields"].tolist(), columns, strict=True))
        assert table["stem_id"].tolist() == list(rows), kind
        assert table["tree_id"].tolist() == [1, 4, 6, 6], kind
        assert table["species"].tolist()[:2] == ["oak", "beech"], kind
        # A field called as a column of ours does not take its place, in any format; odd names come through whole.
        assert table["dbh_cm_own"].tolist()[1] == "by eye 24" and table["dbh_cm"].dtype.kind == "f", kind
        assert table[FIELD].tolist()[1:3] == ["23,5", "23,5"], kind
        assert table["note"].tolist()[0] == NOTE.replace("\x07", ""), kind
    assert rows[4]["dbh_cm_own"] == "by eye 24" and rows[4][FIELD] == "23,5"
    meta, _, _, columns = pyogrio.raw.read(handed_in["dxf"])
    drawn = dict(zip(meta["fields"].tolist(), columns, strict=True))["Text"]
    assert sorted(int(text) for text in drawn if text) == list(rows)
    assert sorted(map(int, re.findall(r">(\d+)</text>", handed_in["svg"].read_text("utf-8")))) == list(rows)


def test_the_cloud_has_them_point_for_point(plot, handed_in):
    session, _ = plot
    labels = np.asarray(laspy.read(handed_in["laz"])["tree_id"])
    for stem_id in session.document.trunks.ids:
        assert np.array_equal(np.flatnonzero(labels == stem_id), session.document.trunks[stem_id].points)
    assert np.array_equal(labels > 0, session.document.trunks.labels(len(labels)) > 0)


def test_the_report_has_a_page_for_each_and_fetches_nothing(plot, handed_in):
    session, _ = plot
    text = handed_in["report"].read_text("utf-8")
    page = _Page(text)
    rows = inventory_rows(handed_in)
    assert [int(name[5:]) for name in page.ids if re.fullmatch(r"stem-\d+", name)] == list(rows)
    assert all(link[1:] in page.ids for link in page.links) and all(link.startswith("#") for link in page.links)
    assert page.fetched == [] and "<script" not in text and "url(" not in text and "@import" not in text
    assert "default-src 'none'" in text and "\x07" not in text
    assert "&lt;b&gt;owl&lt;/b&gt;" in text and "<b>owl" not in text
    for said in ("D-tape", "A. B.", "Undo: Merge", "accepted", "4 stems", "ground", "Fingerprint", "23,5"):
        assert said in text, said
    for row in session.inventory():
        assert row.dbh_cm is None or f"{row.dbh_cm:.1f} cm" in text, row.stem_id


def test_the_3d_page_has_the_points_of_each(plot, handed_in):
    session, _ = plot
    text = handed_in["3d"].read_text("utf-8")
    page = _Page(text)
    data = json.loads(page.blocks["scene-data"])
    assert [stem["id"] for stem in data["stems"]] == [1, 4, 6, 40] and page.fetched == []
    owners = np.frombuffer(base64.b64decode(page.blocks["scene-owners"]), "<u2")
    steps = np.frombuffer(base64.b64decode(page.blocks["scene-places"]), "<u2").reshape(-1, 3)
    assert len(owners) == len(steps) == data["n"] == len(session.cloud)
    places = np.array(data["low"]) + steps * np.array(data["step"])
    for k, stem_id in enumerate(session.document.trunks.ids, start=1):
        points = session.points_world()[session.document.trunks[stem_id].points]
        shown = places[owners == k]
        assert len(shown) == len(points)
        assert np.allclose(np.ptp(shown, axis=0), np.ptp(points, axis=0), atol=2e-3)
    # A ring of each measured diameter, at breast height above the ground.
    rows = inventory_rows(handed_in)
    for stem in data["stems"]:
        row = rows[stem["id"]]
        assert ("ring" in stem) == bool(row["dbh_cm"])
        if row["dbh_cm"]:
            ring = np.array(stem["ring"]).reshape(-1, 3)
            across = np.ptp(ring[:, :2], axis=0).mean()
            assert 100 * across == pytest.approx(float(row["dbh_cm"]), rel=0.05)


def test_the_log_says_who_did_what_undo_and_redo_too(handed_in):
    with handed_in["edits"].open(newline="", encoding="utf-8") as file:
        log = list(csv.DictReader(file))
    done = [row for row in log if row["kind"] in ("edit", "undo", "redo")]
    assert [row["kind"] for row in done].count("undo") == 1 == [row["kind"] for row in done].count("redo")
    assert any(row["what"].startswith("Undo: Merge") for row in done) and all(row["when"] for row in done)
    (tape,) = (row for row in log if row["kind"] == "correction")
    assert (tape["stem_id"], tape["who"], tape["value"], tape["why"]) == ("4", "A. B.", "24.2 cm", "D-tape")
    (review,) = (row for row in log if row["kind"] == "review")
    assert review["stem_id"] == "1" and review["value"].startswith("accepted")
    meta, _, _, columns = pyogrio.raw.read(handed_in["xlsx"], layer="Edits", HEADERS="FORCE")
    table = dict(zip(meta["fields"].tolist(), columns, strict=True))
    assert table["what"].tolist() == [row["what"] for row in log]


def test_imperial_is_one_switch_for_all(plot, tmp_path):
    session, _ = plot
    request = ExportRequest(("gpkg", "xlsx", "report", "3d"), units="imperial", pictures="none")
    layer, book, report, page = export_plot(session, tmp_path, request)
    assert "dbh_in" in pyogrio.raw.read(layer)[0]["fields"].tolist()
    assert "stems/acre" in pyogrio.raw.read(book, layer="Stand", max_features=1)[0]["fields"].tolist()
    inches = f"{session.measurement(4).result.dbh_cm / 2.54:.2f} in"
    text = report.read_text("utf-8")
    assert inches in text and inches in page.read_text("utf-8")
    assert "ft²/acre" in text and "not 4.5 ft" in text and "DBH cm" not in text and "24.2 cm" not in text


def test_a_polygon_may_be_of_the_map_or_of_the_plot(plot, tmp_path):
    session, _ = plot
    corners = np.array([[-1, -1], [9, -1], [9, 9], [-1, 9]], float)
    on_map = corners + [500_000.0, 4_500_000.0] - np.asarray(session.document.origin_src)[:2]

    def area_of(name, area, **frame):
        (book,) = export_plot(session, tmp_path / name, ExportRequest(("xlsx",), area=area, **frame))
        meta, _, _, columns = pyogrio.raw.read(book, layer="Stand", max_features=4, HEADERS="FORCE")
        table = dict(zip(meta["fields"].tolist(), columns, strict=True))
        return int(float(table["stems"][table["species"].tolist().index("all")]))

    world = session.document.world_from_source
    local = world.apply(np.c_[on_map - session.cloud.origin[:2], np.zeros(4)])[:, :2]
    assert area_of("a", PlotArea.polygon(on_map)) == area_of("b", PlotArea.polygon(local)) == 4
    assert area_of("c", PlotArea.polygon(on_map), area_frame="map") == 4
    assert area_of("d", PlotArea.polygon(on_map), area_frame="plot") == 0


def test_a_plot_without_a_map_has_no_easting(tmp_path):
    from tests.app.gridplot import grid_session

    with pytest.raises(SettingError, match="no map system"):
        export_plot(
            grid_session(), tmp_path, ExportRequest(("xlsx",), area=PlotArea.circle((0, 0), 5), area_frame="map")
        )
    assert list(tmp_path.iterdir()) == []


def test_a_plot_that_is_not_saved_has_the_log_of_what_stands(tmp_path):
    from tests.app.gridplot import grid_session

    session = grid_session()
    session.do(commands.correct_measurement(2, Correction("curve", "circle", "C")))
    (path,) = export_plot(session, tmp_path, ExportRequest(("edits",)))
    assert [row.split(",")[3] for row in path.read_text().splitlines()[1:]] == ["correction"]


def test_a_pdf_is_printed_by_a_browser_that_is_there(plot, tmp_path, chromium_path, monkeypatch):
    session, _ = plot
    (path,) = export_plot(session, tmp_path, ExportRequest(("pdf",)))
    content = path.read_bytes()
    assert content.startswith(b"%PDF") and len(re.findall(rb"/Type\s*/Page\b", content)) >= 5
    monkeypatch.setattr("dbh_studio.app.report_pdf.find_chromium", lambda: None)
    with pytest.raises(MissingComponentError, match="neither was found"):
        export_plot(session, tmp_path / "other", ExportRequest(("pdf",)))
    monkeypatch.setattr("dbh_studio.app.report_pdf.find_chromium", lambda: str(Path("/bin/false")))
    with pytest.raises(FileError, match="could not print"):
        export_plot(session, tmp_path / "another", ExportRequest(("pdf",)))
