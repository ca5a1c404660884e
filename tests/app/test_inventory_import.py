"""One's own CSV brings back what was said, as one edit; what does not fit is said before anything is changed."""

from __future__ import annotations

import csv
import io

import pytest
from tests.app.gridplot import grid_session

from dbh_studio.app import commands, edits
from dbh_studio.app.inventory_import import ImportOptions, import_inventory, plan_import
from dbh_studio.core.corrections import Correction
from dbh_studio.core.tree_record import TreeRecord
from dbh_studio.errors import CommandError, FileError, MisfitError, StaleResultError
from dbh_studio.io.inventory_csv import inventory_csv

NOTE = '=HYPERLINK("http://x"); "oak", «é»\n\'-5 cm;+1'


def said_session(**options):
    """A plot about which all there is to say has been said."""
    session = grid_session(**options)
    session.do(commands.describe_trees([1, 2], species="Quercus robur", status="live", health="vital"))
    session.do(commands.describe_trees([3], note=NOTE, tag="0017", crown_class="dominant", status="dead"))
    session.do(commands.set_tree_fields([1, 4], **{"Höhe m": "23,5", "species": "mine", "=cut": "-1"}))
    session.do(commands.correct_measurement(5, Correction("tape", 31.4, "A", "2026-01-01T00:00:00+00:00", "D-tape")))
    session.do(commands.correct_measurement(5, Correction("tape_height", 1.37)))
    session.do(edits.group_stems([6, 7]))
    return session


def exported(session, path, **changes):
    path.write_bytes(inventory_csv(session.inventory()))
    return path


def rewritten(path, out, *, delimiter=",", encoding="utf-8", change=lambda row: row):
    """As another program saves it."""
    rows = list(csv.DictReader(io.StringIO(path.read_text("utf-8"))))
    rows = [change(dict(row)) for row in rows]
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]), delimiter=delimiter)
    writer.writeheader()
    writer.writerows(rows)
    out.write_bytes(text.getvalue().encode(encoding))
    return out


def what_is_said(session):
    return {
        i: (r.species, r.status, r.note, r.tag, r.health, r.crown_class, r.fields, r.tree_id, r.correction("tape"),
            r.correction("tape_height"))
        for i, r in session.document.trees.items()
    }  # fmt: skip


def test_all_comes_back_in_one_edit_that_can_be_undone(tmp_path):
    said = said_session()
    path = exported(said, tmp_path / "a.csv")
    bare = grid_session()
    before = bare.document
    plan = import_inventory(bare, path)
    assert what_is_said(bare) == what_is_said(said)
    assert plan.n_changed == 7 and plan.changes["species"] >= 2 and plan.changes["tape value"] == 1
    assert "New fields" in plan.notes[-1] and "7 of the 9 stems" in plan.words
    tape = next(each for each in bare.document.record(5).corrections if each.kind == "tape")
    assert tape.why == "from a.csv" and tape.when
    bare.undo()
    assert bare.document is before
    # Its own table again changes nothing, and leaves no trace in the history.
    n_changed = import_inventory(said, path).n_changed
    assert n_changed == 0 and said.undo_label.startswith("Group")


@pytest.mark.parametrize(
    ("delimiter", "encoding"), [(";", "utf-8-sig"), ("\t", "utf-16"), (",", "utf-8"), ("|", "utf-8")]
)
def test_as_other_programs_save_it(tmp_path, delimiter, encoding):
    said = said_session()
    path = exported(said, tmp_path / "a.csv")

    def european(row):
        names = ("x_m", "y_m", "field_tape_cm", "field_tape_height_m", "dbh_cm")
        numbers = {name: row[name].replace(".", ",") for name in names} if delimiter != "," else {}
        return {**row, **numbers, "stem_id": f"{row['stem_id']}.0", "tree_id": f"{row['tree_id']}.0"}

    again = rewritten(path, tmp_path / "b.csv", delimiter=delimiter, encoding=encoding, change=european)
    bare = grid_session()
    import_inventory(bare, again)
    assert what_is_said(bare) == what_is_said(said)


def test_inches_and_feet_are_read_by_their_headings(tmp_path):
    (tmp_path / "a.csv").write_text("stem_id,field_tape_in,field_tape_height_ft,Species\n2,12.5,4.5,oak\n")
    session = grid_session()
    plan = import_inventory(session, tmp_path / "a.csv")
    record = session.document.record(2)
    assert record.correction("tape") == pytest.approx(31.75) and record.species == "oak"
    assert record.correction("tape_height") == pytest.approx(1.3716)
    assert any("numbers alone" in note for note in plan.notes)


def test_inches_beside_our_empty_centimetres_are_taken(tmp_path):
    session = grid_session()
    path = exported(session, tmp_path / "a.csv")
    inches = {"2": "12.5", "3": "10"}
    filled = rewritten(
        path, tmp_path / "b.csv", change=lambda row: {**row, "field_tape_in": inches.get(row["stem_id"], "")}
    )
    plan = import_inventory(session, filled)
    assert plan.changes == {"tape value": 2} and session.document.record(2).correction("tape") == pytest.approx(31.75)
    # Its own inventory says the same in centimetres by now.
    again = rewritten(
        exported(session, path), filled, change=lambda row: {**row, "field_tape_in": inches.get(row["stem_id"], "")}
    )
    assert import_inventory(session, again).n_changed == 0
    inches["3"] = "11"
    rewritten(path, filled, change=lambda row: {**row, "field_tape_in": inches.get(row["stem_id"], "")})
    with pytest.raises(FileError, match=r"line 4: field_tape_cm and field_tape_in say different things"):
        plan_import(session, filled)


@pytest.mark.parametrize(("cell", "said"), [("0", "'0': 0.0 is not between"), ("abc", "'abc': that is no number")])
def test_a_tape_value_that_is_none_is_said_in_words(tmp_path, cell, said):
    (tmp_path / "a.csv").write_text(f"stem_id,field_tape_cm\n1,30\n2,{cell}\n")
    with pytest.raises(FileError, match=f"line 3: field_tape_cm is {said}"):
        plan_import(grid_session(), tmp_path / "a.csv")


def test_an_empty_cell_says_nothing_unless_it_is_to_clear(tmp_path):
    session = said_session()
    (tmp_path / "a.csv").write_text("stem_id,species,field_tape_cm\n1,,\n2,Fagus,\n5,,\n")
    import_inventory(session, tmp_path / "a.csv")
    assert session.document.record(1).species == "Quercus robur" and session.document.record(2).species == "Fagus"
    assert session.document.record(5).correction("tape") == 31.4
    import_inventory(session, tmp_path / "a.csv", ImportOptions(clear_empty=True))
    assert session.document.record(1).species == "" and session.document.record(5).correction("tape") is None
    assert session.document.record(1).health == "vital"  # there is no such column


def test_diameters_and_reviews_are_never_taken(tmp_path):
    said = said_session()
    path = exported(said, tmp_path / "a.csv")
    changed = rewritten(path, tmp_path / "b.csv", change=lambda row: {**row, "dbh_cm": "99", "review": "accepted"})
    bare = grid_session()
    import_inventory(bare, changed, ImportOptions(with_fields=False))
    assert all(not record.review and not record.fields for record in bare.document.trees.values())
    assert bare.inventory().n_measured == 0


def test_stems_the_plot_has_not_are_told_and_can_be_left_out(tmp_path):
    path = exported(said_session(), tmp_path / "a.csv")
    session = grid_session()
    session.do(commands.delete_trunk(2))
    session.do(commands.delete_trunk(6))
    before = session.document
    with pytest.raises(MisfitError, match=r"has no stems 2, 6: they were merged, split or deleted") as error:
        plan_import(session, path)
    assert "left out" in error.value.remedy and session.document is before
    plan = import_inventory(session, path, ImportOptions(skip_misfits=True))
    assert "Left out: stems 2, 6." in plan.notes
    assert session.document.record(1).species == "Quercus robur" and 2 not in session.document.trees
    assert session.document.record(7).tree_id == 6  # the number of its tree outlives the stem that gave it


def test_the_table_of_another_plot_is_refused(tmp_path):
    other = exported(said_session(seed=3, spacing_m=7.0), tmp_path / "other.csv")
    session = grid_session()
    before = session.document
    with pytest.raises(CommandError, match="is of another plot"):
        import_inventory(session, other)
    (tmp_path / "far.csv").write_text("stem_id,species\n70,oak\n71,oak\n")
    with pytest.raises(CommandError, match="None of the stems"):
        import_inventory(session, tmp_path / "far.csv")
    assert session.document is before


def test_one_stem_that_stands_elsewhere_is_told(tmp_path):
    path = exported(said_session(), tmp_path / "a.csv")
    moved = rewritten(
        path, tmp_path / "b.csv", change=lambda row: {**row, "x_m": "40"} if row["stem_id"] == "1" else row
    )
    session = grid_session()
    with pytest.raises(MisfitError, match="stems 1 stand elsewhere"):
        import_inventory(session, moved)
    import_inventory(session, moved, ImportOptions(skip_misfits=True))
    assert 1 not in session.document.trees and session.document.record(2).species == "Quercus robur"


def test_a_plot_whose_frame_was_moved_since_is_the_same_plot(tmp_path):
    path = exported(said_session(), tmp_path / "a.csv")
    session = grid_session()
    session.do(commands.set_frame(north=(0.6, 0.8, 0.0), origin_src=(30.0, -12.0, 0.0)))
    plan = import_inventory(session, path)
    assert any("frame has been moved" in note for note in plan.notes)
    assert session.document.record(1).species == "Quercus robur"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("species\noak\n", "no column stem_id"),
        ("stem_id,species\n1,oak\n1,ash\n", "lines 2 and 3 are both of stem 1"),
        ("stem_id,species\nfive,oak\n", "line 2: stem_id is 'five'"),
        ("stem_id,species\n,oak\n", "line 2 has no stem_id"),
        ("stem_id,status\n1,ill\n2,ill\n", "line 2 has the status 'ill', and 1 more"),
        ("stem_id,field_tape_cm\n1,0\n", "line 2: field_tape_cm is '0'"),
        ("stem_id,field_tape_cm\n1,thick\n", "line 2: field_tape_cm is 'thick'"),
        ("stem_id," + ",".join(f"c{k}" for k in range(40)) + "\n1" + ",1" * 40 + "\n", "40 columns that are no part"),
    ],
)
def test_what_cannot_be_understood_is_said_with_its_line(tmp_path, text, said):
    (tmp_path / "a.csv").write_text(text)
    session = grid_session()
    before = session.document
    with pytest.raises(FileError) as error:
        import_inventory(session, tmp_path / "a.csv")
    assert said in str(error.value) and session.document is before


def test_a_tree_is_taken_apart_where_the_table_says_so(tmp_path):
    session = said_session()
    path = exported(session, tmp_path / "a.csv")
    apart = rewritten(path, tmp_path / "b.csv", change=lambda row: {**row, "tree_id": row["stem_id"]})
    import_inventory(session, apart)
    assert all(session.document.record(i).tree_id is None for i in (6, 7))


def test_a_plan_for_a_plot_that_changed_since_is_not_applied(tmp_path):
    from dbh_studio.app.inventory_import import apply_import

    path = exported(said_session(), tmp_path / "a.csv")
    session = grid_session()
    document, plan = session.document, plan_import(session, path)
    session.do(commands.delete_trunk(9))
    with pytest.raises(StaleResultError):
        apply_import(session, document, plan)
    assert session.document.trees == {} and TreeRecord() == session.document.record(1)
