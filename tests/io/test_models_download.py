"""Downloads against a server on this computer that breaks off, lies, moves files and knows no ranges."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import http.server
import json
import random
import shutil
import socket
import threading
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.io import tinymodels as tiny

from dbh_studio.errors import CancelledError, ModelError
from dbh_studio.io.lock import lock_file
from dbh_studio.io.models import ModelStore, read_manifest
from dbh_studio.io.models import download as download_module
from dbh_studio.io.models import store as store_module
from dbh_studio.io.models.download import download

DATA = random.Random(0).randbytes(1_500_000)


class Server(http.server.ThreadingHTTPServer):
    """Answers with what `files` holds, in the way `mode` says, and notes who asked for which range."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, bytes] = {"/model.onnx": DATA}
        self.mode = ""
        self.asked: list[tuple[str, str]] = []
        self.refusals: list[int] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(http.server.BaseHTTPRequestHandler):
    server: Server

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        mode, asked = self.server.mode, self.headers.get("Range", "")
        self.server.asked.append((self.path, asked))
        if self.server.refusals:
            self.send_error(self.server.refusals.pop(0))
            return
        if self.path.startswith("/moved"):
            self.send_response(302)
            self.send_header("Location", self.path.removeprefix("/moved"))
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        body = self.server.files.get(self.path)
        if body is None:
            self.send_error(404)
            return
        start = int(asked[6:-1]) if asked and mode != "no ranges" else 0
        if start >= len(body) and start:
            self.send_error(416)
            return
        self.send_response(206 if start else 200)
        if start:
            first = start + (1 if mode == "shifted" else 0)
            self.send_header("Content-Range", f"bytes {first}-{len(body) - 1}/{len(body)}")
        if mode != "no length":
            self.send_header("Content-Length", str(len(body) - start))
        self.end_headers()
        part = body[start : start + 400_000] if mode == "breaks off" else body[start:]
        part = part[:100] if mode == "stuck" and not start else b"" if mode == "stuck" else part
        with contextlib.suppress(ConnectionError):
            self.wfile.write(part + (b"more" * 1000 if mode == "endless" else b""))
        self.close_connection = True


@pytest.fixture
def server(monkeypatch) -> Iterator[Server]:
    for name in ("http_proxy", "https_proxy", "all_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.delenv("DBH_STUDIO_OFFLINE", raising=False)
    monkeypatch.setattr(store_module, "download", functools.partial(download, sleep=lambda _: None))
    server = Server()
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def store_for(server: Server, folder: Path, *, path: str = "/model.onnx", **changes: object) -> ModelStore:
    """A store whose list has one vocabulary, published by the server."""
    data = tiny.shipped_manifest()
    model = data["models"][0]
    file = {**model["files"][0], "url": server.url + path, "bytes": len(DATA)}
    file = {**file, "sha256": hashlib.sha256(DATA).hexdigest(), **changes}
    data["models"] = [{**model, "name": "m", "files": [file]}]
    folder.mkdir(exist_ok=True)
    (folder / "list.json").write_text(json.dumps(data))
    return ModelStore(read_manifest(folder / "list.json"), folder / "models")


def content(store: ModelStore) -> bytes:
    return store.paths("m")["vocabulary"].read_bytes()


def parts(store: ModelStore) -> list[str]:
    return sorted(path.name for path in (store.folder / "m").iterdir() if not path.name.startswith("."))


def test_a_model_is_fetched_once(server, tmp_path):
    store = store_for(server, tmp_path)
    told = []
    (state,) = store.fetch(["m"], progress=lambda fraction, message="": told.append((fraction, message)))
    assert (state.state, state.origin) == ("ready", "pinned") and content(store) == DATA
    assert parts(store) == ["installed.json", "vocab.txt"]
    fractions = [fraction for fraction, _ in told]
    assert fractions == sorted(fractions) and fractions[-1] == 1.0 and len(told) > 4
    assert any("MB" in message for _, message in told)
    store.fetch()
    assert len(server.asked) == 1


def test_a_broken_connection_is_taken_up_where_it_ended(server, tmp_path):
    server.mode = "breaks off"
    store = store_for(server, tmp_path)
    store.fetch()
    assert content(store) == DATA
    assert [asked for _, asked in server.asked] == ["", "bytes=400000-", "bytes=800000-", "bytes=1200000-"]


def test_the_next_run_goes_on_after_a_cancel(server, tmp_path):
    store = store_for(server, tmp_path)

    def stop(fraction: float, message: str = "") -> None:
        if fraction > 0.4:
            raise CancelledError

    with pytest.raises(CancelledError):
        store.fetch(progress=stop)
    (installed,) = store.state("m").files
    assert store.state("m").state == "partial" and 0.4 * len(DATA) < installed.n_bytes < len(DATA)
    store.fetch()
    assert content(store) == DATA
    assert server.asked[-1][1] == f"bytes={installed.n_bytes}-"


@pytest.mark.parametrize("mode", ["no ranges", "shifted", "no length", ""])
def test_servers_with_ranges_of_their_own(server, tmp_path, mode):
    store = store_for(server, tmp_path)
    (store.folder / "m").mkdir(parents=True)
    (store.folder / "m" / "vocab.txt.part").write_bytes(DATA[:1000])
    server.mode = mode
    if mode == "shifted":  # it never sends what is asked for, but the whole is right
        store.fetch()
        assert [asked for _, asked in server.asked] == ["bytes=1000-", ""]
    else:
        store.fetch()
    assert content(store) == DATA


def test_a_part_of_another_version_is_thrown_away(server, tmp_path):
    store = store_for(server, tmp_path)
    (store.folder / "m").mkdir(parents=True)
    for old in (b"x" * 1000, DATA + b"too much", b"x" * len(DATA)):
        shutil.rmtree(store.folder / "m")
        (store.folder / "m").mkdir()
        (store.folder / "m" / "vocab.txt.part").write_bytes(old)
        store.fetch()
        assert content(store) == DATA


def test_another_content_is_refused_and_deleted(server, tmp_path):
    server.files["/model.onnx"] = DATA[:-1] + b"x"
    store = store_for(server, tmp_path)
    with pytest.raises(ModelError, match="sha256") as caught:
        store.fetch()
    assert "models add" in caught.value.remedy and store.state("m").state == "absent"
    assert parts(store) == []


def test_another_size_is_refused_before_it_is_fetched(server, tmp_path):
    store = store_for(server, tmp_path, bytes=len(DATA) - 5)
    with pytest.raises(ModelError, match=r"1,500,000 bytes, but 1,499,995"):
        store.fetch()
    assert store.state("m").state == "absent"


def test_a_server_that_never_ends_is_cut_off(server, tmp_path):
    server.mode = "endless"
    server.files["/model.onnx"] = DATA
    store = store_for(server, tmp_path)
    store.fetch()  # what is behind the announced length is not read
    assert content(store) == DATA
    server.mode, shorter = "no length", store_for(server, tmp_path / "b", bytes=1000)
    with pytest.raises(ModelError, match="does not send what it announces"):
        shorter.fetch()


@pytest.mark.parametrize(
    ("code", "word"), [(404, "no such file"), (403, "not allowed"), (401, "login"), (410, "Gone"), (407, "proxy")]
)
def test_what_the_server_refuses_is_said(server, tmp_path, code, word):
    server.refusals = [code]
    store = store_for(server, tmp_path)
    with pytest.raises(ModelError, match=f"{code}.*{word}"):
        store.fetch()
    assert len(server.asked) == 1


def test_a_busy_server_is_asked_again(server, tmp_path):
    server.refusals = [503, 429, 500]
    store = store_for(server, tmp_path)
    store.fetch()
    assert content(store) == DATA and len(server.asked) == 4


def test_a_server_that_gets_nowhere_is_given_up(server, tmp_path):
    server.mode = "stuck"
    store = store_for(server, tmp_path)
    with pytest.raises(ModelError, match=r"100 of 1,500,000 bytes") as caught:
        store.fetch()
    assert "goes on where it stopped" in caught.value.remedy
    assert 3 <= len(server.asked) <= 6 and store.state("m").state == "partial"


def test_a_moved_file_is_followed_with_its_range(server, tmp_path):
    server.mode = "breaks off"
    store = store_for(server, tmp_path, path="/moved/model.onnx")
    store.fetch()
    assert content(store) == DATA and ("/model.onnx", "bytes=400000-") in server.asked


def test_an_encrypted_address_never_leads_to_an_open_one():
    handler = download_module._NoDowngrade()
    request = download_module.urllib.request.Request("https://a.example/x")
    with pytest.raises(OSError, match="unencrypted"):
        handler.redirect_request(request, None, 302, "Found", {}, "http://a.example/x")
    assert handler.redirect_request(request, None, 302, "Found", {}, "https://b.example/x") is not None


def test_without_a_hash_the_first_download_decides(server, tmp_path):
    store = store_for(server, tmp_path, sha256=None, bytes=None)
    (state,) = store.fetch()
    assert (state.state, state.origin) == ("ready", "first use")
    assert state.files[0].sha256 == hashlib.sha256(DATA).hexdigest()
    # From then on nothing else is taken for it.
    path = store.paths("m")["vocabulary"]
    path.write_bytes(b"x" * len(DATA))
    with pytest.raises(ModelError):
        store.paths("m")


def test_without_a_hash_a_graph_must_have_its_signature(server, tmp_path):
    encoder, decoder = tiny.mobile_sam(tmp_path / "graphs")
    data = tiny.shipped_manifest()
    model = next(model for model in data["models"] if model["name"] == "mobile-sam")
    data["models"] = [model]
    for file, source in zip(model["files"], (encoder, decoder), strict=True):
        file.update(url=f"{server.url}/{source.name}", bytes=None, sha256=None)
        server.files[f"/{source.name}"] = source.read_bytes()
    (tmp_path / "list.json").write_text(json.dumps(data))
    good = ModelStore(read_manifest(tmp_path / "list.json"), tmp_path / "good")
    assert good.fetch()[0].origin == "first use"
    assert set(good.paths("mobile-sam")) == {"encoder", "decoder"}
    server.files[f"/{decoder.name}"] = encoder.read_bytes()
    for number, bad in enumerate((encoder.read_bytes(), b"<html>")):
        server.files[f"/{decoder.name}"] = bad
        store = ModelStore(read_manifest(tmp_path / "list.json"), tmp_path / f"bad{number}")
        with pytest.raises(ModelError, match="is not a MobileSAM file"):
            store.fetch()
        assert store.state("mobile-sam").state == "partial"


def test_a_damaged_file_is_fetched_again(server, tmp_path):
    store = store_for(server, tmp_path)
    store.fetch()
    path = store.paths("m")["vocabulary"]
    for bad in (DATA[:10], b"x" * len(DATA), b""):
        path.write_bytes(bad)
        store.fetch()
        assert content(store) == DATA
    path.unlink()
    path.symlink_to(tmp_path / "gone")
    store.fetch()
    assert content(store) == DATA


def test_offline_downloads_nothing_and_says_what_would_be_needed(server, tmp_path, monkeypatch):
    store = store_for(server, tmp_path)
    store.offline = True
    with pytest.raises(ModelError, match="switched off") as caught:
        store.fetch()
    for word in (f"{server.url}/model.onnx", hashlib.sha256(DATA).hexdigest(), "models add"):
        assert word in caught.value.remedy
    store.offline = False
    store.fetch()
    store.offline = True
    store.fetch()  # what is here is here
    for value, expected in (("1", True), ("true", True), ("0", False), ("", False)):
        monkeypatch.setenv("DBH_STUDIO_OFFLINE", value)
        assert ModelStore(store.manifest, tmp_path).offline is expected
    assert len(server.asked) == 1


def test_no_network_is_said_at_once(server, tmp_path, monkeypatch):
    store = store_for(server, tmp_path)

    def nobody(*_: object, **__: object) -> None:
        raise socket.gaierror(-3, "Temporary failure in name resolution")

    with monkeypatch.context() as patch:
        patch.setattr(socket, "getaddrinfo", nobody)
        with pytest.raises(ModelError, match=r"cannot be reached .*name resolution") as caught:
            store.fetch()
    assert "HTTPS_PROXY" in caught.value.remedy and "models add" in caught.value.remedy
    server.server_close()
    with pytest.raises(ModelError, match="refused"):
        store.fetch()


def test_the_proxy_variables_are_respected(server, tmp_path, monkeypatch):
    monkeypatch.setenv("http_proxy", server.url)
    monkeypatch.setenv("no_proxy", "")
    server.files["http://models.invalid/model.onnx"] = DATA
    part = tmp_path / "x.part"
    download("http://models.invalid/model.onnx", part, n_bytes=None, progress=lambda *_: None, label="x")
    assert part.read_bytes() == DATA and server.asked == [("http://models.invalid/model.onnx", "")]


def test_a_disk_without_room_is_said_before_anything_is_fetched(server, tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    store = store_for(server, tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10, 10, 1_000_000))
    with pytest.raises(ModelError, match=r"2 MB are needed, 1 MB are free") as caught:
        store.fetch()
    assert "DBH_STUDIO_CACHE" in caught.value.remedy and parts(store) == []


def test_a_disk_that_fills_up_keeps_what_is_there(server, tmp_path):
    resource = pytest.importorskip("resource")
    store = store_for(server, tmp_path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (600_000, hard))
    try:
        with pytest.raises(ModelError, match="cannot be written"):
            store.fetch()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert store.state("m").state == "partial" and len(server.asked) == 1
    store.fetch()
    assert content(store) == DATA


def test_a_folder_that_cannot_be_made_is_named(server, tmp_path):
    store = store_for(server, tmp_path)
    store.folder = tmp_path / "list.json" / "models"
    with pytest.raises(ModelError, match=r"list\.json"):
        store.fetch()


def test_two_processes_do_not_fetch_the_same_model(server, tmp_path):
    store = store_for(server, tmp_path)
    (store.folder / "m").mkdir(parents=True)
    with lock_file(store.folder / "m" / ".lock"), pytest.raises(ModelError, match="Another process"):
        store.fetch()
    store.fetch()
    assert content(store) == DATA


def test_a_planted_link_is_not_written_through(server, tmp_path):
    store = store_for(server, tmp_path)
    victim = tmp_path / "victim"
    victim.write_bytes(b"mine")
    (store.folder / "m").mkdir(parents=True)
    (store.folder / "m" / "vocab.txt.part").symlink_to(victim)
    with pytest.raises(ModelError):
        store.fetch()
    assert victim.read_bytes() == b"mine"
