"""Files from the browser: limits, names, damage on the way, and that nothing is left behind."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fakeclient import PART_BYTES, FakeClient
from hypothesis import given
from hypothesis import strategies as st
from panel import LONG

from dbh_studio.errors import EmptyFileError, FileError, UnsupportedFormatError
from dbh_studio.ui import uploads
from dbh_studio.ui.bind import TabWorker
from dbh_studio.ui.server import StudioServer, start_server
from dbh_studio.ui.uploads import UploadDesk, UploadedFile, UploadRule, receive, safe_name

LIMIT = 3 * PART_BYTES


@pytest.fixture(scope="module")
def server() -> Iterator[StudioServer]:
    running = start_server(port=0, max_upload_bytes=LIMIT)
    yield running
    running.stop()


class Inbox:
    """An upload button and what came of it."""

    def __init__(self, worker: TabWorker, **options: Any) -> None:
        self.worker = worker
        self.contents: list[tuple[str, bytes]] = []
        self.paths: list[Path] = []
        self.progress: list[tuple[int, int]] = []
        self.button = worker.client.gui.add_upload_button("Upload", mime_type=".ply")
        options = {"allowed_suffixes": (".ply", ".laz"), **options}
        worker.on_upload(self.button, self.take, on_progress=lambda *bytes_: self.progress.append(bytes_), **options)

    def take(self, file: UploadedFile) -> None:
        assert file.path.stat().st_size == file.size_bytes
        self.paths.append(file.path)
        self.contents.append((file.name, file.path.read_bytes()))


@pytest.fixture
def inbox(worker: TabWorker) -> Inbox:
    return Inbox(worker)


def n_files_kept(server: StudioServer) -> int:
    folder = server._uploads._folder
    return len(list(folder.iterdir())) if folder is not None else 0


def acknowledged(tab: FakeClient) -> list[int]:
    return [m["transferred_bytes"] for m in tab.messages if m["type"] == "FileTransferPartAck"]


# -- over the socket ------------------------------------------------------------------------------------------------


def test_a_file_arrives_whole_with_progress(server: StudioServer, inbox: Inbox, tab: FakeClient) -> None:
    content = bytes(range(256)) * (2 * PART_BYTES // 256) + b"end"
    tab.upload("Upload", "oak plot.PLY", content)
    tab.wait(lambda t: len(inbox.contents) > 0 and len(acknowledged(t)) == 3)
    assert inbox.contents == [("oak plot.PLY", content)]
    assert acknowledged(tab) == [PART_BYTES, 2 * PART_BYTES, len(content)]
    tab.settle()
    assert inbox.progress[-1] == (len(content), len(content))
    assert [a for a, _ in inbox.progress] == sorted(a for a, _ in inbox.progress)
    assert inbox.worker.join(LONG) and not inbox.paths[0].exists()  # what the handler did not keep is gone
    assert inbox.button.value.content == b""  # and no copy stays in memory


def test_the_file_is_kept_by_receive(inbox: Inbox, tab: FakeClient, tmp_path: Path) -> None:
    kept: list[Path] = []
    inbox.take = lambda file: kept.append(receive(file, tmp_path, allowed_suffixes=(".ply",)))  # type: ignore[method-assign]
    inbox.worker.on_upload(inbox.button, inbox.take, allowed_suffixes=(".ply",))
    tab.upload("Upload", "../../oak.ply", b"one")
    tab.upload("Upload", "C:\\plots\\oak.ply", b"two")
    tab.wait(lambda _: len(kept) == 2)
    assert [path.relative_to(tmp_path).as_posix() for path in kept] == ["oak.ply", "oak (2).ply"]
    assert [path.read_bytes() for path in kept] == [b"one", b"two"]


def refused(tab: FakeClient, inbox: Inbox, server: StudioServer, text: str) -> None:
    note = tab.wait_notification(text)
    assert note.color == "red"
    tab.settle()
    assert inbox.worker.join(LONG) and inbox.contents == [] and n_files_kept(server) == 0


def test_a_file_over_the_servers_limit_is_refused_at_once(server: StudioServer, inbox: Inbox, tab: FakeClient) -> None:
    tab.upload("Upload", "big.ply", b"x" * (LIMIT + 1))
    refused(tab, inbox, server, "an upload may have 2 MB")
    assert "by its path" in tab.notifications[-1].body
    assert tab.settle() and acknowledged(tab) == [LIMIT + 1]  # the page's button is free again


def test_a_button_may_have_a_lower_limit(server: StudioServer, tab: FakeClient) -> None:
    worker = TabWorker(tab.handle(server.viser))
    inbox = Inbox(worker, max_bytes=10)
    tab.upload("Upload", "big.ply", b"x" * 11)
    refused(tab, inbox, server, "big.ply: The file has")
    worker.close()


@pytest.mark.parametrize("name", ["virus.exe", "plot.ply.exe", "ply", "", "plot.las"])
def test_other_kinds_of_file_are_refused(server: StudioServer, inbox: Inbox, tab: FakeClient, name: str) -> None:
    tab.upload("Upload", name, b"abc")
    refused(tab, inbox, server, "not accepted here")


def test_an_empty_file_is_refused(server: StudioServer, inbox: Inbox, tab: FakeClient) -> None:
    tab.upload("Upload", "empty.ply", b"")
    refused(tab, inbox, server, "empty")


def test_more_bytes_than_announced_are_refused(server: StudioServer, inbox: Inbox, tab: FakeClient) -> None:
    source = tab.element("Upload").uuid
    tab.upload_start(source, "t", "liar.ply", 2, 10)
    tab.upload_part(source, "t", 0, b"x" * 8)
    tab.upload_part(source, "t", 1, b"x" * 8)
    refused(tab, inbox, server, "damaged")


def test_fewer_bytes_than_announced_are_refused(server: StudioServer, inbox: Inbox, tab: FakeClient) -> None:
    source = tab.element("Upload").uuid
    tab.upload_start(source, "t", "liar.ply", 1, 10)
    tab.upload_part(source, "t", 0, b"x" * 8)
    refused(tab, inbox, server, "incomplete")


@pytest.mark.parametrize("indices", [(1, 0), (0, 0), (0, 5), (0, -1)])
def test_parts_out_of_order_are_refused(
    server: StudioServer, inbox: Inbox, tab: FakeClient, indices: tuple[int, int]
) -> None:
    source = tab.element("Upload").uuid
    tab.upload_start(source, "t", "liar.ply", 2, 4)
    for index in indices:
        tab.upload_part(source, "t", index, b"xx")
    refused(tab, inbox, server, "damaged")


def test_a_button_without_a_rule_takes_nothing(server: StudioServer, tab: FakeClient) -> None:
    gui, seen = tab.handle(server.viser).gui, []
    for label, options in (("Bare", {}), ("Off", {"disabled": True}), ("Hidden", {"visible": False})):
        button = gui.add_upload_button(label, **options)  # type: ignore[arg-type]
        button.on_upload(lambda _: seen.append(1))
        if label != "Bare":
            rule = UploadRule((".ply",), 100, lambda _: seen.append(2), lambda _: seen.append(3))
            uploads.set_rule(button, rule)
        source = tab.element(label, force=True).uuid
        tab.upload_start(source, f"t-{label}", "a.ply", 1, 3)
        tab.upload_part(source, f"t-{label}", 0, b"abc")
    tab.settle()
    assert seen == [] and acknowledged(tab) == [] and n_files_kept(server) == 0


def test_a_shared_button_keeps_nothing_in_the_replay(server: StudioServer, tab: FakeClient) -> None:
    """viser keeps one acknowledgement per part for ever, for every later tab."""
    worker = TabWorker(tab.handle(server.viser))
    button = server.viser.gui.add_upload_button("Shared upload")
    done = threading.Event()
    worker.on_upload(button, lambda _: done.set(), allowed_suffixes=(".ply",))
    tab.upload("Shared upload", "a.ply", b"x" * (PART_BYTES + 1))
    assert done.wait(LONG)
    with FakeClient(server.url) as later:
        assert later.has("Shared upload") and acknowledged(later) == []
    worker.close()
    button.remove()


def test_a_closed_tab_leaves_no_partial_file(server: StudioServer) -> None:
    with FakeClient(server.url) as tab:
        worker = TabWorker(tab.handle(server.viser))
        Inbox(worker)
        source = tab.element("Upload").uuid
        tab.upload_start(source, "t", "half.ply", 2, 2 * PART_BYTES)
        tab.upload_part(source, "t", 0, b"x" * PART_BYTES)
        tab.wait(lambda _: n_files_kept(server) == 1)
        tab.close()
        tab.wait(lambda _: n_files_kept(server) == 0)
        worker.close()


def test_files_that_wait_when_the_tab_closes_are_deleted(server: StudioServer, inbox: Inbox, tab: FakeClient) -> None:
    go, started = threading.Event(), threading.Event()
    inbox.worker.post(lambda: (started.set(), go.wait(LONG)))
    assert started.wait(LONG)
    tab.upload("Upload", "a.ply", b"abc")
    tab.wait(lambda _: acknowledged(tab) == [3])
    assert n_files_kept(server) == 1
    inbox.worker.close()
    go.set()
    inbox.worker._thread.join(LONG)
    assert n_files_kept(server) == 0 and inbox.contents == []


def test_stopping_the_server_removes_its_folder() -> None:
    running = start_server(port=0)
    with FakeClient(running.url) as tab:
        worker = TabWorker(tab.handle(running.viser))
        inbox = Inbox(worker)
        tab.upload("Upload", "a.ply", b"abc")
        tab.wait(lambda _: len(inbox.contents) > 0)
        folder = running._uploads._folder
        assert folder is not None and folder.is_dir()
        running.stop()
        worker.close()
    assert not folder.exists()


# -- without a server -----------------------------------------------------------------------------------------------


class Answers:
    """A rule that notes what it is told."""

    def __init__(self) -> None:
        self.done: list[UploadedFile] = []
        self.errors: list[FileError] = []
        self.rule = UploadRule((".ply",), 1000, self.done.append, self.errors.append)


def test_one_tab_cannot_open_transfers_without_end() -> None:
    desk, answers = UploadDesk(), Answers()
    started = [desk.start(1, f"t{i}", answers.rule, "a.ply", 1, 10) for i in range(5)]
    assert started == [True] * uploads.MAX_TRANSFERS_PER_TAB + [False] * (5 - uploads.MAX_TRANSFERS_PER_TAB)
    assert desk.start(2, "t0", answers.rule, "a.ply", 1, 10)
    assert "still running" in answers.errors[0].problem
    desk.close()


def test_one_tab_cannot_write_into_the_transfer_of_another() -> None:
    desk, answers = UploadDesk(), Answers()
    desk.start(1, "t", answers.rule, "a.ply", 1, 3)
    assert desk.part(2, "t", 0, b"bad") is None
    assert desk.part(1, "t", 0, b"own") == (3, 3)
    assert answers.done[0].path.read_bytes() == b"own"
    desk.close()


def test_a_full_disk_is_said_before_the_upload(monkeypatch: pytest.MonkeyPatch) -> None:
    desk, answers = UploadDesk(), Answers()
    monkeypatch.setattr(uploads.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 5})())
    assert not desk.start(1, "t", answers.rule, "a.ply", 1, 3)
    assert "too full" in answers.errors[0].problem
    desk.close()


def test_kinds_of_refusal() -> None:
    desk, answers = UploadDesk(), Answers()
    desk.start(1, "a", answers.rule, "a.las", 1, 3)
    desk.start(1, "b", answers.rule, "a.ply", 0, 0)
    assert [type(error) for error in answers.errors] == [UnsupportedFormatError, EmptyFileError]
    desk.close()


@pytest.mark.parametrize(
    ("given_name", "expected"),
    [
        ("oak.ply", "oak.ply"),
        ("../../etc/passwd", "passwd"),
        ("..\\..\\boot.ini", "boot.ini"),
        ("a\x00b.ply", "ab.ply"),
        ("plot\n1.las", "plot1.las"),
        ("..", "upload"),
        ("", "upload"),
        (".ply", "ply"),
        ("CON.ply", "upload_CON.ply"),
        ("Bestand Süd.laz", "Bestand Süd.laz"),
        ('a<b>:"|?*.ply', "a_b______.ply"),
        ("plot.copc.laz", "plot.copc.laz"),
        ("trailing. ", "trailing"),
    ],
)
def test_names_are_made_safe(given_name: str, expected: str) -> None:
    assert safe_name(given_name) == expected


@given(st.text(max_size=300))
def test_every_name_is_safe(given_name: str) -> None:
    name = safe_name(given_name)
    assert name and len(name.encode()) <= 120 and name == safe_name(name)
    assert not set('/\\\0<>:"|?*') & set(name) and name not in (".", "..") and name.isprintable()
    assert Path(name).name == name


def test_receive_checks_the_kind_and_says_where_it_failed(tmp_path: Path) -> None:
    source = tmp_path / "part"
    source.write_bytes(b"abc")
    file = UploadedFile("a.ply", source, 3)
    with pytest.raises(UnsupportedFormatError, match=r"a\.ply"):
        receive(file, tmp_path / "plots", allowed_suffixes=(".las",))
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(FileError, match=r"a\.ply: The upload could not be kept"):
        receive(file, tmp_path / "file", allowed_suffixes=(".ply",))
    assert source.exists()
    assert receive(file, tmp_path / "plots", allowed_suffixes=(".ply",)).read_bytes() == b"abc"
    assert not source.exists()
    file.discard()


def test_a_temporary_folder_that_was_swept_away_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploads.tempfile, "tempdir", str(tmp_path))
    desk, done, refused = UploadDesk(), [], []
    rule = UploadRule((".ply",), LIMIT, done.append, refused.append)
    for transfer in ("first", "second"):
        assert desk.start(1, transfer, rule, "a.ply", 1, 3)
        desk.part(1, transfer, 0, b"ply")
        for folder in tmp_path.iterdir():
            uploads.shutil.rmtree(folder)
    assert len(done) == 2 and not refused
    desk.close()


def test_the_bar_of_an_upload_that_is_refused_goes(inbox: Inbox, tab: FakeClient) -> None:
    source = tab.element("Upload").uuid
    tab.upload_start(source, "t", "a.ply", 2, 2 * PART_BYTES)
    tab.upload_part(source, "t", 0, b"x" * PART_BYTES)
    tab.upload_part(source, "t", 7, b"x")
    tab.wait(lambda _: inbox.progress[-1:] == [(0, 0)])
