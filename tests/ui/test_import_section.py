"""The Export step takes one's own table back: first it says what would change, then it changes it."""

from __future__ import annotations

from panel import LONG

from dbh_studio.app import commands
from dbh_studio.io.inventory_csv import inventory_csv

LOOK, TAKE = "What would change?", "Take it over"


def to_import(tab) -> None:
    tab.bridge_send("step", "export")
    tab.wait(lambda t: t.has(LOOK), LONG)


def species(studio):
    return {i: record.species for i, record in studio.session.document.trees.items() if record.species}


def test_a_table_is_looked_at_and_taken_over(measured, studio, tmp_path):
    session = studio.session
    first = session.document.trunks.ids[0]
    session.do(commands.describe_trees([first], species="oak"))
    (tmp_path / "mine.csv").write_bytes(inventory_csv(session.inventory()))
    session.undo()
    to_import(measured)
    assert not measured.has(TAKE)
    measured.set("Table (CSV)", str(tmp_path / "mine.csv"))
    measured.press(LOOK)
    measured.wait_text("1 of the 5 stems in mine.csv change: species of 1", LONG)
    assert species(studio) == {}
    measured.wait(lambda t: t.has(TAKE), LONG)
    measured.press(TAKE)
    measured.wait_text("Taken over: 1 stems", LONG)
    assert species(studio) == {first: "oak"}
    session.undo()
    assert species(studio) == {}


def test_stems_that_do_not_fit_are_told_and_may_be_left_out(measured, studio, tmp_path):
    first = studio.session.document.trunks.ids[0]
    (tmp_path / "mine.csv").write_text(f"stem_id,species\n{first},oak\n99,ash\n")
    to_import(measured)
    measured.set("Table (CSV)", str(tmp_path / "mine.csv"))
    measured.press(LOOK)
    measured.wait_text("the plot has no stems 99", LONG)
    assert not measured.has(TAKE)
    measured.set("Leave out stems that do not fit", True)
    measured.press(LOOK)
    measured.wait_text("Left out: stems 99", LONG)
    measured.wait(lambda t: t.has(TAKE), LONG)
    measured.press(TAKE)
    measured.wait_text("Taken over", LONG)
    assert species(studio) == {first: "oak"}


def test_a_table_that_is_none_is_refused_in_words(measured, tmp_path):
    (tmp_path / "a.csv").write_text("species\noak\n")
    to_import(measured)
    measured.press(LOOK)
    measured.wait(lambda t: any("No table was named" in note.title + note.body for note in t.notifications), LONG)
    measured.set("Table (CSV)", str(tmp_path / "a.csv"))
    measured.press(LOOK)
    measured.wait(lambda t: any("no column stem_id" in note.title + note.body for note in t.notifications), LONG)
