"""The Export step writes the files to hand in, in a folder, and says what is in the way."""

from __future__ import annotations

import plots
import pyogrio
from fakeclient import FakeClient
from panel import LONG

from dbh_studio.app import commands
from dbh_studio.app.opening import open_plot

TITLE = "Write the files"


def to_export(tab) -> None:
    tab.bridge_send("step", "export")
    tab.wait(lambda t: t.has(TITLE), LONG)


def test_the_chosen_files_are_written_to_the_folder(measured, tmp_path):
    to_export(measured)
    folder = tmp_path / "hand in"
    measured.set("Folder", str(folder))
    measured.set("Stem map (SVG)", True)
    measured.set("Excel, with stand table", False)
    measured.press(TITLE)
    measured.wait_text("Written to", LONG)
    assert sorted(path.suffix for path in folder.iterdir()) == [".csv", ".gpkg", ".svg"]
    (layer,) = folder.glob("*.gpkg")
    meta, _, _, _ = pyogrio.raw.read(layer)
    assert "dbh_cm" in meta["fields"].tolist()


def test_files_of_an_earlier_state_are_told(measured, studio, tmp_path):
    to_export(measured)
    measured.set("Folder", "beside the plot")
    for box in ("Map layer (GeoPackage)", "Excel, with stand table"):
        measured.set(box, False)
    measured.press(TITLE)
    measured.wait_text("Written to", LONG)
    assert (studio.session.saver.folder.parent / "beside the plot").is_dir()
    studio.session.do(commands.set_tree_record(studio.session.document.trunks.ids[0], note="checked"))
    measured.wait_text("The plot has changed since", LONG)


def test_files_that_are_there_are_not_replaced_unasked(measured, tmp_path):
    to_export(measured)
    measured.set("Folder", str(tmp_path))
    for box in ("Map layer (GeoPackage)", "Excel, with stand table"):
        measured.set(box, False)
    measured.press(TITLE)
    measured.wait_text("Written to", LONG)
    (table,) = tmp_path.glob("*.csv")
    table.write_text("mine")
    measured.press(TITLE)
    measured.wait(lambda t: any("already" in note.title + note.body for note in t.notifications), LONG)
    assert table.read_text() == "mine"
    measured.set("Replace files of these names", True)
    measured.press(TITLE)
    measured.wait(lambda t: table.read_text() != "mine", LONG)


def test_inches_and_a_circle(measured, tmp_path):
    to_export(measured)
    measured.set("Folder", str(tmp_path / "out"))
    measured.set("Units", "inches, feet, acres")
    measured.set("Plot area", "circle")
    measured.wait(lambda t: t.has("Radius (m)"), LONG)
    measured.set("Radius (m)", 500.0)
    measured.press(TITLE)
    measured.wait_text("Written to", LONG)
    (layer,) = (tmp_path / "out").glob("*.gpkg")
    assert "dbh_in" in pyogrio.raw.read(layer)[0]["fields"].tolist()


def test_nothing_chosen_is_said(measured, tmp_path):
    to_export(measured)
    for box in ("Inventory (CSV)", "Map layer (GeoPackage)", "Excel, with stand table"):
        measured.set(box, False)
    measured.press(TITLE)
    measured.wait(lambda t: any("No file was chosen" in note.body + note.title for note in t.notifications), LONG)


def test_report_page_and_log_are_written_and_a_polygon_is_read(measured, tmp_path):
    to_export(measured)
    (tmp_path / "corners.txt").write_text("0 0\n1000 0\n1000 1000\n0 1000\n")
    measured.set("Folder", str(tmp_path / "out"))
    for box in ("Inventory (CSV)", "Map layer (GeoPackage)", "Excel, with stand table"):
        measured.set(box, False)
    for box in ("Report (HTML)", "3D page (HTML)", "Edit log (CSV)"):
        measured.set(box, True)
    measured.set("Plot area", "polygon")
    measured.wait(lambda t: t.has("File with corners"), LONG)
    measured.press(TITLE)
    measured.wait(lambda t: any("No file with corners" in note.body + note.title for note in t.notifications), LONG)
    measured.set("File with corners", str(tmp_path / "corners.txt"))
    measured.press(TITLE)
    measured.wait_text("Written to", LONG)
    names = sorted(path.name.split("_")[-1] for path in (tmp_path / "out").iterdir())
    assert names == ["3d.html", "edits.csv", "report.html"]


def test_there_is_nothing_to_download_before_trunks_are_found(studio, tmp_path):
    studio.adopt(open_plot(plots.write_laz(tmp_path), project_dir=tmp_path / "plot.dbh"))
    with FakeClient(studio.server.url) as tab:
        tab.wait_text("Press Find trunks", LONG)
        tab.bridge_send("step", "export")
        tab.wait_text("nothing to export yet", LONG)
        assert not tab.has("Download the inventory (CSV)") and not tab.has(TITLE)
