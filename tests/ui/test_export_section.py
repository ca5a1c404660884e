"""The Export step writes the files to hand in, in a folder, and says what is in the way."""

from __future__ import annotations

import pyogrio
from panel import LONG

from dbh_studio.app import commands

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
