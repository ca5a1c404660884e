"""A saved plot opened from its file: what could be undone, what was said of it, and the cloud untouched."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from tests.app.plots import make_cloud, make_trunks
from tests.app.random_edits import N_POINTS, of, random_step
from tests.app.test_undo_saving import abandon

from dbh_studio.app import commands
from dbh_studio.app.autosave import AUTHOR_VARIABLE
from dbh_studio.app.opening import open_or_read, open_plot, save_as
from dbh_studio.core.corrections import Correction
from dbh_studio.errors import CommandError, FileError, ProjectUnwritableError
from dbh_studio.io.lock import lock_file
from dbh_studio.io.masks import MaskRecipe, MaskStore, TrunkMask
from dbh_studio.io.ply import write_ply
from dbh_studio.io.project import read_history, read_project


def write_cloud(folder: Path) -> Path:
    path = folder / "plot.ply"
    write_ply(path, make_cloud(N_POINTS))
    os.utime(path, ns=(10**18, 10**18))
    return path


def test_random_work_with_kills_leaves_the_cloud_as_it_is_and_loses_nothing(tmp_path):
    path, folder, rng = write_cloud(tmp_path), tmp_path / "plot.dbh", np.random.default_rng(5)
    content = path.read_bytes()
    session = open_plot(path, scale="metres", project_dir=folder)
    first = of(session)[0]
    session.do(commands.replace_trunks(make_trunks(5)))
    for round_ in range(6):
        for _ in range(15):
            random_step(rng, session)
        expected = of(session)
        abandon(session) if round_ % 2 else session.close()
        session = open_plot(folder)
        assert of(session) == expected
        told = " ".join(session.reopening_notes)
        assert ("Nothing is lost" in told) == bool(round_ % 2) and "undone any more" not in told
    while session.can_undo:
        session.undo()
    assert of(session)[0] == first
    session.close()
    assert path.read_bytes() == content and path.stat().st_mtime_ns == 10**18
    assert sorted(each.name for each in tmp_path.iterdir()) == ["plot.dbh", "plot.ply"]


def test_a_plot_of_an_earlier_program_opens_as_before_and_can_be_undone_from_now_on(tmp_path):
    path, folder = write_cloud(tmp_path), tmp_path / "plot.dbh"
    session = open_plot(path, scale="metres", project_dir=folder)
    session.do(commands.replace_trunks(make_trunks(5)))
    session.close()
    content = json.loads((folder / "project.json").read_text(encoding="utf-8"))
    del content["undo"]
    (folder / "project.json").write_text(json.dumps({**content, "schema_version": 2}), encoding="utf-8")
    (folder / "undo.log").unlink()
    before = (folder / "project.json").read_bytes()
    looked_at = open_plot(folder)
    assert looked_at.reopening_notes == () and not looked_at.can_undo
    looked_at.close()
    assert (folder / "project.json").read_bytes() == before  # only looking at it is no reason to write
    session = open_plot(folder)
    session.do(commands.delete_trunk(3))
    abandon(session)
    again = open_plot(folder)
    assert again.document.trunks.ids == (1, 2, 4, 5) and again.undo_label == "Delete trunk 3"
    again.close()


@pytest.mark.parametrize("read_only", [False, True])
def test_what_is_lost_is_told_on_the_command_line_too(tmp_path, caplog, read_only):
    path, folder = write_cloud(tmp_path), tmp_path / "plot.dbh"
    session = open_plot(path, scale="metres", project_dir=folder)
    session.do(commands.replace_trunks(make_trunks(5)))
    session.close()
    open_plot(folder, read_only=read_only).close()
    assert not caplog.records
    (folder / "undo.log").write_bytes(b"no log")
    open_plot(folder, read_only=read_only).close()
    (record,) = caplog.records
    assert record.levelname == "WARNING" and "plot.dbh: What was done before cannot be undone" in record.message


def test_a_cloud_that_was_moved_keeps_what_can_be_undone(tmp_path):
    path, folder = write_cloud(tmp_path), tmp_path / "plot.dbh"
    session = open_plot(path, scale="metres", project_dir=folder)
    session.do(commands.replace_trunks(make_trunks(5)))
    session.do(commands.correct_measurement(2, Correction("tape", 31.5, "Ada", "2026-05-01", "bark off")))
    session.close()
    (tmp_path / "new").mkdir()
    shutil.move(path, tmp_path / "new" / "plot.ply")
    again = open_plot(folder, relocate=tmp_path / "new" / "plot.ply")
    again.undo()
    assert again.document.record(2).corrections == () and len(again.earlier) == 1
    assert again.document.source.path == tmp_path / "new" / "plot.ply"
    abandon(again)
    last = open_plot(folder)
    last.redo()
    assert last.document.record(2).corrections[0].why == "bark off"
    last.close()


def no_writing(monkeypatch, folder):
    """Nothing can be written in a folder; who runs the tests may be allowed everything."""

    def lock(path):
        if path.parent == folder:
            raise PermissionError(13, "Permission denied")
        return lock_file(path)

    monkeypatch.setattr("dbh_studio.io.project.lock_file", lock)


def test_a_plot_that_cannot_be_written_is_read_and_goes_on_in_a_copy(tmp_path, monkeypatch):
    path, folder = write_cloud(tmp_path), tmp_path / "plot.dbh"
    session = open_plot(path, scale="metres", project_dir=folder)
    session.do(commands.replace_trunks(make_trunks(5)))
    session.close()
    MaskStore(folder / "masks").put("a.jpg", path, TrunkMask(np.ones((2, 4), np.uint16)), MaskRecipe("painted"))
    before = {each: each.read_bytes() for each in folder.rglob("*") if each.is_file()}
    no_writing(monkeypatch, folder)
    with pytest.raises(ProjectUnwritableError, match="cannot be written"):
        open_plot(folder)
    session = open_or_read(folder)
    assert session.is_read_only and session.document.trunks.ids == (1, 2, 3, 4, 5)
    assert "Permission denied" in session.reopening_notes[0] and "Save a copy" in session.reopening_notes[0]
    with pytest.raises(CommandError, match=r"reading only.*copy"):
        session.do(commands.delete_trunk(1))
    save_as(session, tmp_path / "copy.dbh")
    assert session.reopening_notes == ()
    session.do(commands.delete_trunk(1))
    session.close()
    # Who did what is told in the copy, too.
    done = [(entry.what, entry.number) for entry in read_history(tmp_path / "copy.dbh")]
    assert done[:-2] == [(entry.what, entry.number) for entry in read_history(folder)] != []
    assert done[-1] == ("Delete trunk 1", done[-3][1] + 1)
    assert {each: each.read_bytes() for each in folder.rglob("*") if each.is_file()} == before
    assert len(MaskStore(tmp_path / "copy.dbh" / "masks")) == 1
    again = open_plot(tmp_path / "copy.dbh")
    assert again.document.trunks.ids == (2, 3, 4, 5) and again.reopening_notes == ()
    again.undo()
    assert again.document.trunks.ids == (1, 2, 3, 4, 5)
    again.close()


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="who runs the tests may write everything")
def test_files_that_can_be_written_in_a_folder_that_cannot_are_not_begun_with(tmp_path):
    path, folder = write_cloud(tmp_path), tmp_path / "plot.dbh"
    open_plot(path, scale="metres", project_dir=folder).close()
    folder.chmod(0o555)
    try:
        with pytest.raises(ProjectUnwritableError):
            open_plot(folder)
    finally:
        folder.chmod(0o755)


def test_masks_that_cannot_be_brought_along_do_not_make_a_save_look_failed(tmp_path, monkeypatch, caplog):
    path = write_cloud(tmp_path)
    session = open_plot(path, scale="metres", project_dir=tmp_path / "plot.dbh")
    session.do(commands.replace_trunks(make_trunks(5)))

    def fails(before, after, **_):
        raise FileError(after, "The disk is full.", "Make room.")

    monkeypatch.setattr("dbh_studio.app.opening.carry_masks", fails)
    save_as(session, tmp_path / "copy.dbh")
    (note,) = session.reopening_notes
    assert "saved in copy.dbh" in note and "The disk is full" in note and str(tmp_path / "plot.dbh" / "masks") in note
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    session.do(commands.delete_trunk(1))
    session.close()
    assert read_project(tmp_path / "copy.dbh").trunks.ids == (2, 3, 4, 5)


def test_a_plot_open_for_reading_shows_the_last_edit_and_writes_nothing(tmp_path):
    path, folder = write_cloud(tmp_path), tmp_path / "plot.dbh"
    session = open_plot(path, scale="metres", project_dir=folder)
    session.do(commands.replace_trunks(make_trunks(5)))
    session.do(commands.delete_trunk(1))
    session.saver.flush()
    before = {each.name: each.read_bytes() for each in folder.iterdir() if each.is_file()}
    beside = open_plot(folder, read_only=True)
    assert beside.document.trunks.ids == (2, 3, 4, 5) and beside.reopening_notes == ()
    with pytest.raises(CommandError, match="reading only"):
        beside.undo()
    beside.close()
    assert {each.name: each.read_bytes() for each in folder.iterdir() if each.is_file()} == before
    session.close()


def test_commands_sign_as_such_unless_somebody_is_named(tmp_path, monkeypatch):
    path, folder = write_cloud(tmp_path), tmp_path / "plot.dbh"
    monkeypatch.delenv(AUTHOR_VARIABLE, raising=False)
    monkeypatch.setattr("dbh_studio.app.autosave.user_name", lambda: "root")
    for name, is_command, expected in (("", True, "command line"), ("", False, "root"), (" Ada ", True, "Ada")):
        if name:
            monkeypatch.setenv(AUTHOR_VARIABLE, name)
        session = open_plot(path, scale="metres", project_dir=folder, background_save=not is_command)
        session.do(commands.rename_plot(f"as {expected}"))
        assert session.author == expected
        session.close()
        assert read_history(folder)[-1].who == expected
