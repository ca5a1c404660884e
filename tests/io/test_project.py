from __future__ import annotations

import errno
import itertools
import json
import os
import shutil
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from dbh_studio.core.inventory import TreeRecord
from dbh_studio.core.mask_record import MaskRecord
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.trunks import Trunk, TrunkSet
from dbh_studio.errors import ProjectError, ProjectLockedError, ProjectVersionError
from dbh_studio.io import project, project_read
from dbh_studio.io.project import HistoryEntry, PlotState, ProjectWriter, is_project, read_plot, read_project
from dbh_studio.settings import Settings

REPOSITORY = Path(__file__).parents[2]


def make_state(folder: Path, *, n_trunks: int = 3, **fields) -> PlotState:
    trunks = TrunkSet.from_point_sets([np.arange(10 * i, 10 * i + 5) for i in range(n_trunks)], first_id=2)
    state = PlotState(
        plot_id="Stand 4 – «Köln»",
        source_path=folder / "plot.ply",
        source_used=(folder / "plot.ply",),
        n_points=1000,
        fingerprint="00ff",
        up_direction=(0.0, 0.6, 0.8),
        scale=ScaleEstimate(1.33231, "marker", 0.002),
        settings=Settings(measure=Settings().measure.changed(curve="ellipse", breast_height_m=1.37)),
        trunks=trunks,
        trees={2: TreeRecord("Fagus sylvatica", "live", 'fork "low", =1', "A-7", True, 3)} if n_trunks else {},
    )
    return replace(state, **fields)


def same(a: PlotState, b: PlotState) -> bool:
    def plain(state: PlotState) -> tuple:
        trunks = [(t.id, t.origin, t.points.tolist(), t.points.dtype) for t in state.trunks]
        fields = (state.plot_id, state.n_points, state.fingerprint, state.up_direction, state.scale, state.settings)
        return (*fields, state.source_path, state.source_used, trunks, state.trunks.next_id, dict(state.trees))

    return plain(a) == plain(b)


def written(folder: Path, state: PlotState) -> None:
    writer = ProjectWriter(folder)
    writer.save(state)
    writer.close()


@pytest.mark.parametrize("n_trunks", [0, 1, 3])
def test_what_was_saved_is_read(tmp_path, n_trunks):
    state = make_state(tmp_path, n_trunks=n_trunks)
    written(tmp_path / "plot.dbh", state)
    assert same(read_project(tmp_path / "plot.dbh"), state)
    assert is_project(tmp_path / "plot.dbh") and not is_project(tmp_path)
    names = sorted(path.name for path in (tmp_path / "plot.dbh").iterdir())
    assert names == ["lock", "project.json", "trunks-1.npz"]


text = st.text(st.characters(codec="utf-8"), max_size=20)


@given(
    sizes=st.lists(st.integers(1, 30), max_size=5),
    factor=st.floats(1e-6, 1e6),
    words=st.tuples(text, text, text),
    first_id=st.integers(1, 10_000),
)
@hypothesis_settings(max_examples=25)
def test_any_state_survives(tmp_path_factory, sizes, factor, words, first_id):
    folder = tmp_path_factory.mktemp("plots")
    ends = np.cumsum([0, *sizes])
    sets = [np.arange(a, b) for a, b in itertools.pairwise(ends)]
    state = make_state(
        folder,
        scale=ScaleEstimate(factor, "factor"),
        plot_id=words[0],
        trunks=TrunkSet.from_point_sets(sets, origin=words[2].rstrip("\0"), first_id=first_id),
        trees={first_id: TreeRecord(species=words[1], note=words[2])} if sizes else {},
    )
    written(folder / "a.dbh", state)
    assert same(read_project(folder / "a.dbh"), state)


def test_trunks_are_written_only_when_they_changed_and_the_old_file_goes(tmp_path):
    folder = tmp_path / "plot.dbh"
    writer = ProjectWriter(folder)
    state = make_state(tmp_path)
    writer.save(state)
    first = (folder / "trunks-1.npz").stat().st_mtime_ns
    writer.save(replace(state, plot_id="other"))
    assert (folder / "trunks-1.npz").stat().st_mtime_ns == first
    fewer = replace(state, trunks=state.trunks.without(3))
    writer.save(fewer)
    assert [path.name for path in folder.glob("trunks*")] == ["trunks-2.npz"]
    writer.close()
    assert same(read_project(folder), fewer)
    again = ProjectWriter(folder)
    again.adopt(read := read_plot(folder))
    again.save(read.states.present)
    assert [path.name for path in folder.glob("trunks*")] == ["trunks-2.npz"]
    again.save(state, next_id=77)
    again.close()
    assert [path.name for path in folder.glob("trunks*")] == ["trunks-3.npz"]
    assert read_project(folder).trunks.next_id == 77


class Crash(BaseException):
    """The power goes."""


def _calls_of_one_save(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> int:
    n_calls = 0
    real = {name: getattr(os, name) for name in ("fsync", "replace")}

    def counted(name):
        def call(*args):
            nonlocal n_calls
            n_calls += 1
            return real[name](*args)

        return call

    with monkeypatch.context() as patch:
        for name in real:
            patch.setattr(os, name, counted(name))
        written(tmp_path / "count.dbh", make_state(tmp_path))
    return n_calls


@pytest.mark.parametrize("is_disk_full", [True, False], ids=["disk full", "crash"])
def test_at_whatever_step_a_save_breaks_the_folder_holds_one_whole_state(tmp_path, monkeypatch, is_disk_full):
    """Each fsync and each rename of a save fails once; what is read then is the old state or the new one."""
    old, new = make_state(tmp_path), make_state(tmp_path, n_trunks=5, plot_id="new")
    n_calls = _calls_of_one_save(tmp_path, monkeypatch)
    assert n_calls >= 6
    outcomes = []
    for failing in range(n_calls):
        folder = tmp_path / f"plot-{failing}.dbh"
        writer = ProjectWriter(folder)
        writer.save(old)
        countdown = [failing]
        with monkeypatch.context() as patch:
            for name in ("fsync", "replace"):
                real = getattr(os, name)

                def call(*args, real=real, countdown=countdown):
                    countdown[0] -= 1
                    if countdown[0] < 0:
                        raise OSError(errno.ENOSPC, "No space left on device") if is_disk_full else Crash
                    return real(*args)

                patch.setattr(os, name, call)
            with pytest.raises(ProjectError if is_disk_full else Crash) as caught:
                writer.save(new)
        if is_disk_full:
            assert "No space left" in caught.value.problem and "intact" in caught.value.remedy
        found = read_project(folder)
        assert same(found, old) or same(found, new)
        outcomes.append(found.plot_id)
        writer.save(new)
        writer.close()
        assert same(read_project(folder), new)
        assert sorted(path.name for path in folder.iterdir() if path.name.startswith((".", "trunks")))[1:] == []
    assert outcomes[0] == old.plot_id and outcomes[-1] == "new"


def test_a_disk_that_fills_while_trunks_are_written_leaves_the_old_plot(tmp_path, monkeypatch):
    folder = tmp_path / "plot.dbh"
    old = make_state(tmp_path)
    writer = ProjectWriter(folder)
    writer.save(old)

    def half(file, trunks):
        file.write(b"PK\x03\x04")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(project, "_write_trunks", half)
    with pytest.raises(ProjectError, match="No space left"):
        writer.save(make_state(tmp_path, n_trunks=5))
    writer.close()
    assert same(read_project(folder), old)
    assert list(folder.glob(".*")) == []


def test_what_a_crash_left_is_removed_by_the_next_save_and_ignored_before(tmp_path):
    folder = tmp_path / "plot.dbh"
    state = make_state(tmp_path)
    written(folder, state)
    (folder / "trunks-2.npz").write_bytes(b"PK\x03\x04 half a file")
    (folder / ".project.json.123.part").write_bytes(b"{")
    (folder / "cache").mkdir()
    assert same(read_project(folder), state)
    written(folder, state)
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["cache", "lock", "project.json", "trunks-3.npz"]


def test_two_writers_are_refused_in_one_process_and_the_lock_is_free_after_closing(tmp_path):
    folder = tmp_path / "plot.dbh"
    writer = ProjectWriter(folder)
    with pytest.raises(ProjectLockedError, match=str(os.getpid())):
        ProjectWriter(folder)
    writer.close()
    writer.close()
    with pytest.raises(ValueError, match="closed"):
        writer.save(make_state(tmp_path))
    ProjectWriter(folder).close()


_HOLDER = """
import sys, time
from dbh_studio.io.project import ProjectWriter
writer = ProjectWriter(sys.argv[1])
print("locked", flush=True)
time.sleep(600)
"""


def test_another_process_is_refused_until_it_is_killed(tmp_path):
    folder = tmp_path / "plot.dbh"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "src")}
    command = [sys.executable, "-c", _HOLDER, str(folder)]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "locked\n"
        with pytest.raises(ProjectLockedError, match=f"process {holder.pid}") as caught:
            ProjectWriter(folder)
        assert "reading only" in caught.value.remedy
        holder.kill()
        holder.wait()
    ProjectWriter(folder).close()


def _edited(**changes):
    def edit(folder: Path) -> None:
        path = folder / "project.json"
        content = json.loads(path.read_text())
        content.update(changes)
        path.write_text(json.dumps(content))

    return edit


def _trunks(**arrays):
    def edit(folder: Path) -> None:
        whole = {"ids": [1, 2], "ends": [2, 4], "points": [0, 1, 2, 3], "origins": ["hand", "hand"], **arrays}
        np.savez(folder / "trunks-1.npz", **{name: np.array(values) for name, values in whole.items()})

    return edit


def _members(**contents):
    """Rewrite the archive of the trunks, with the bytes of some members replaced."""

    def edit(folder: Path) -> None:
        path = folder / "trunks-1.npz"
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        members.update({f"{name}.npy": content for name, content in contents.items()})
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in members.items():
                archive.writestr(name, content)

    return edit


def _npy(header: str, content: bytes = b"") -> bytes:
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + content


def _plain_array(folder: Path) -> None:
    np.save(folder / "array.npy", np.arange(5))
    (folder / "array.npy").replace(folder / "trunks-1.npz")


def _compressed(folder: Path) -> None:
    with np.load(folder / "trunks-1.npz") as archive:
        arrays = dict(archive)
    np.savez_compressed(folder / "trunks-1.npz", **arrays)


def _flags(*, method: int, encrypted: int):
    """Say in the archive's headers that its members are packed in another way."""

    def edit(folder: Path) -> None:
        path = folder / "trunks-1.npz"
        content = bytearray(path.read_bytes())
        for signature, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
            start = content.find(signature)
            while start >= 0:
                content[start + offset] |= encrypted
                content[start + offset + 2] = method
                start = content.find(signature, start + 4)
        path.write_bytes(content)

    return edit


_HUGE = "{'descr': '<i4', 'fortran_order': False, 'shape': (100000000000000,), }"


def _cut(name: str, share: float):
    def edit(folder: Path) -> None:
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: int(share * len(content))])

    return edit


def _flip(folder: Path) -> None:
    content = bytearray((folder / "trunks-1.npz").read_bytes())
    # Inside the points: the archive is well-formed and its check sum is not.
    where = content.index(np.arange(5, dtype=np.int32).tobytes())
    content[where] ^= 1
    (folder / "trunks-1.npz").write_bytes(content)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda folder: (folder / "project.json").write_text("{not json"), "project.json"),
        (lambda folder: (folder / "project.json").write_bytes(b"\xff\xfe\x00"), "project.json"),
        (lambda folder: (folder / "project.json").write_text("[" * 100_000), "project.json"),
        (lambda folder: (folder / "project.json").write_text("[]"), "schema_version"),
        (lambda folder: (folder / "project.json").unlink(), "not a saved plot"),
        (_cut("project.json", 0.5), "project.json"),
        (_edited(schema_version="1"), "schema_version"),
        (_edited(schema_version=True), "schema_version"),
        (_edited(surprise=1), "surprise"),
        (_edited(up_direction=[0, 0, 0]), "up_direction"),
        (_edited(scale={"metres_per_unit": -1, "source": "factor", "standard_error": None}), "metres_per_unit"),
        (_edited(trunks_file="../../secret.npz"), "trunks_file"),
        (_edited(trees={"99": {}}), "99"),
        (lambda folder: (folder / "trunks-1.npz").unlink(), "trunks-1.npz"),
        (_cut("trunks-1.npz", 0.0), "trunks-1.npz"),
        (_cut("trunks-1.npz", 0.6), "trunks-1.npz"),
        (_flip, "trunks-1.npz"),
        (_trunks(points=[0, 1, 1, 2]), "share points"),
        (_trunks(points=[0, 1, 2, 1000]), "does not have"),
        (_trunks(points=[1, 0, 2, 3]), "sorted"),
        (_trunks(points=[0.0, 1.0, 2.0, 3.0]), "wrong kind"),
        (_trunks(points=np.array([object()] * 4)), "trunks-1.npz"),
        (_trunks(ends=[4, 4]), "add up"),
        (_trunks(ends=[2]), "lengths"),
        (_trunks(ids=[1, 1]), "same id"),
        (_trunks(ids=[0, 1]), "positive"),
        (_trunks(ids=[1, 2**31]), "trunks-1.npz"),
        (_trunks(surplus=[1]), "trunks-1.npz"),
        (_plain_array, "trunks-1.npz"),
        (_compressed, "trunks-1.npz"),
        (_flags(method=0, encrypted=1), "trunks-1.npz"),
        (_flags(method=99, encrypted=0), "trunks-1.npz"),
        (_flags(method=8, encrypted=0), "trunks-1.npz"),
        (_members(points=_npy(_HUGE)), "trunks-1.npz"),
        (_members(points=_npy("{'descr': '<i4', 'shape': ((((")), "trunks-1.npz"),
        (_members(points=_npy("{'descr': '<i4', 'fortran_order': False, 'shape': (), }", b"0000")), "trunks-1.npz"),
        (_members(points=b"no array"), "trunks-1.npz"),
        (
            _edited(source={"path": "p", "relative_path": None, "used": [], "n_points": 10**14, "fingerprint": ""}),
            "n_p",
        ),
        (_edited(next_id=2**31 + 1), "next_id"),
        (_edited(trees={"2": {"tree_id": 2**31}}), "tree_id"),
        (_edited(trees={"2": {"note": "\ud800"}}), "note"),
    ],
)
def test_a_damaged_plot_is_named_and_left_as_it_is(tmp_path, damage, words):
    folder = tmp_path / "plot.dbh"
    written(folder, make_state(tmp_path, trees={}))
    damage(folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(ProjectError) as caught:
        read_project(folder)
    assert words in str(caught.value) and not isinstance(caught.value, ProjectVersionError)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_plot_of_a_newer_program_says_to_update(tmp_path):
    written(tmp_path / "plot.dbh", make_state(tmp_path))
    _edited(schema_version=4, trunks="in a new way")(tmp_path / "plot.dbh")
    with pytest.raises(ProjectVersionError, match="newer") as caught:
        read_project(tmp_path / "plot.dbh")
    assert "Update" in caught.value.remedy


GOLDEN = """{
 "schema_version": 1,
 "plot_id": "Stand 4",
 "source": {"path": "/nowhere/plot.ply", "relative_path": "../plot.ply", "used": [], "n_points": 10,
            "fingerprint": "00ff"},
 "up_direction": [0.0, 0.0, 1.0],
 "scale": {"metres_per_unit": 0.3048, "source": "feet", "standard_error": null},
 "settings": {},
 "trunks_file": "trunks-1.npz",
 "next_id": 5,
 "trees": {"2": {"species": "oak", "status": "dead"}}
}"""


def test_schema_1_is_read_for_ever(tmp_path):
    folder = tmp_path / "plot.dbh"
    folder.mkdir()
    (folder / "project.json").write_text(GOLDEN)
    _trunks()(folder)
    state = read_project(folder)
    assert state.plot_id == "Stand 4" and state.scale == ScaleEstimate(0.3048, "feet")
    assert state.trunks.ids == (1, 2) and state.trunks.next_id == 5
    assert state.trunks[2].points.tolist() == [2, 3] and state.trunks[2].origin == "hand"
    assert state.trees == {2: TreeRecord("oak", "dead")} and state.settings == Settings()
    assert state.source_path == Path("/nowhere/plot.ply") and state.masks is None
    # Saved again, it is a plot of today, with all that it was.
    written(folder, state)
    assert json.loads((folder / "project.json").read_text())["schema_version"] == 3
    assert same(read_project(folder), state)


def test_a_plot_from_before_usual_bloat_was_taken_off_is_measured_as_it_was(tmp_path):
    for saved, expected in (
        ({"bark_share": 0.007}, 0.0),
        ({}, 0.001),
        ({"bark_share": 0.007, "bloat_m": 0.002}, 0.002),
    ):
        folder = tmp_path / f"{expected}.dbh"
        folder.mkdir()
        content = json.loads(GOLDEN) | {"settings": {"measure": saved}}
        (folder / "project.json").write_text(json.dumps(content))
        _trunks()(folder)
        assert read_project(folder).settings.measure.bloat_m == expected


def test_which_masks_the_trunks_came_from_is_kept_and_moves_along(tmp_path):
    (tmp_path / "old" / "masks").mkdir(parents=True)
    made = MaskRecord(
        "made", "detector", 40, prompt="tree trunk", models=("a", "b"), recipe="0123456789abcdef", digest="00-11"
    )
    brought = MaskRecord(
        "brought", "brought", 3, tmp_path / "old" / "masks", "labels", ("1-3", "7"), "same", digest="22-33"
    )
    for record in (made, brought):
        written(tmp_path / "old" / "plot.dbh", replace(make_state(tmp_path / "old"), masks=record))
        assert read_project(tmp_path / "old" / "plot.dbh").masks == record
    shutil.move(tmp_path / "old", tmp_path / "new")
    assert read_project(tmp_path / "new" / "plot.dbh").masks == replace(brought, path=tmp_path / "new" / "masks")


def test_a_plot_moved_together_with_its_cloud_finds_it(tmp_path):
    old = tmp_path / "old"
    old.mkdir()
    (old / "plot.ply").write_text("points")
    written(old / "plot.dbh", make_state(old))
    shutil.move(old, tmp_path / "new")
    assert read_project(tmp_path / "new" / "plot.dbh").source_path == tmp_path / "new" / "plot.ply"


def test_a_reader_beside_a_writer_sees_one_whole_state(tmp_path, monkeypatch):
    """The trunks it was told of go between its two looks: it looks again, as often as that happens."""
    folder = tmp_path / "plot.dbh"
    writer = ProjectWriter(folder)
    states = [make_state(tmp_path, n_trunks=n) for n in (1, 2, 3)]
    writer.save(states[0])
    later = iter(states[1:])
    parse = project_read._parse

    def then_written(path):
        saved = parse(path)
        for state in itertools.islice(later, 1):
            writer.save(state)
        return saved

    monkeypatch.setattr(project_read, "_parse", then_written)
    assert same(read_project(folder), states[2])
    writer.close()


def test_another_file_of_the_same_name_beside_the_plot_does_not_hide_the_old_place(tmp_path):
    for name in ("old", "new"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "plot.ply").write_text(name)
    written(tmp_path / "old" / "plot.dbh", make_state(tmp_path / "old"))
    shutil.move(tmp_path / "old" / "plot.dbh", tmp_path / "new" / "plot.dbh")
    state = read_project(tmp_path / "new" / "plot.dbh")
    assert state.source_path == tmp_path / "new" / "plot.ply"
    assert state.other_source_path == tmp_path / "old" / "plot.ply"
    (tmp_path / "new" / "plot.ply").unlink()
    state = read_project(tmp_path / "new" / "plot.dbh")
    assert state.source_path == tmp_path / "old" / "plot.ply" and state.other_source_path is None


@pytest.mark.skipif(os.name == "nt", reason="links and pipes are POSIX")
@pytest.mark.parametrize("name", ["lock", "history.jsonl"])
def test_a_link_or_pipe_in_a_plot_somebody_sent_is_refused_and_what_it_leads_to_left_alone(tmp_path, name):
    folder = tmp_path / "plot.dbh"
    written(folder, make_state(tmp_path))
    (folder / name).unlink(missing_ok=True)

    def use() -> None:
        writer = ProjectWriter(folder)
        try:
            writer.log([HistoryEntry("", "", "edit")])
        finally:
            writer.close()

    victim, absent = tmp_path / "victim", tmp_path / "absent"
    victim.write_text("precious")
    for target in (victim, absent):
        (folder / name).symlink_to(target)
        with pytest.raises(ProjectError, match="link"):
            use()
        (folder / name).unlink()
    assert victim.read_text() == "precious" and not absent.exists()
    os.mkfifo(folder / name)
    with pytest.raises(ProjectError, match="not a regular file"):
        use()


def test_the_history_of_a_replaced_plot_is_put_aside(tmp_path):
    folder = tmp_path / "plot.dbh"
    writer = ProjectWriter(folder)
    writer.put_history_aside()
    for number in range(3):
        writer.log([HistoryEntry("", "", str(number))])
        writer.put_history_aside()
    writer.close()
    assert not (folder / "history.jsonl").exists()
    kept = {path.name: json.loads(path.read_text())["what"] for path in folder.glob("history*")}
    assert kept == {"history-1.jsonl": "0", "history-2.jsonl": "1", "history-3.jsonl": "2"}


def test_the_history_is_appended_line_by_line_also_after_a_line_was_cut_off(tmp_path):
    folder = tmp_path / "plot.dbh"
    writer = ProjectWriter(folder)
    writer.log([HistoryEntry("", "", "Größe"), HistoryEntry("", "", "two\nlines")])
    writer.log([])
    with (folder / "history.jsonl").open("ab") as file:
        file.write(b'{"what": "cut o')
    writer.log([HistoryEntry("", "", "after")])
    writer.close()
    lines = (folder / "history.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["what"] for line in (lines[0], lines[1], lines[3])] == ["Größe", "two\nlines", "after"]


def test_a_folder_that_cannot_be_made_is_an_error_in_words(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ProjectError, match="cannot be written"):
        ProjectWriter(tmp_path / "file" / "plot.dbh")


def test_a_trunk_keeps_where_it_came_from(tmp_path):
    trunks = TrunkSet((Trunk(1, np.array([1, 2], np.int32), "hand"), Trunk(5, np.array([3], np.int32), "file")), 9)
    written(tmp_path / "a.dbh", make_state(tmp_path, trunks=trunks, trees={}))
    assert [trunk.origin for trunk in read_project(tmp_path / "a.dbh").trunks] == ["hand", "file"]
