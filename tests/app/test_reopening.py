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
from dbh_studio.app.opening import open_plot
from dbh_studio.core.corrections import Correction
from dbh_studio.errors import CommandError
from dbh_studio.io.ply import write_ply


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
