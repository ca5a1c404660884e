"""`dbh-studio models` as a person types it."""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path

import pytest
from PIL import Image
from tests.io import tinymodels as tiny

from dbh_studio.cli import models
from dbh_studio.errors import ModelError


def run(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    models.add_commands(parser.add_subparsers())
    options = parser.parse_args(["models", *arguments])
    return options.command(options)


@pytest.fixture
def graphs(tmp_path, monkeypatch) -> Path:
    """Tiny graphs of the usual pair; the cache is empty and nothing may be downloaded."""
    monkeypatch.setenv("DBH_STUDIO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("DBH_STUDIO_OFFLINE", "1")
    folder = tmp_path / "graphs"
    tiny.detector(folder / "model.onnx")
    tiny.mobile_sam(folder)
    return folder


@pytest.fixture
def pinned(graphs, monkeypatch) -> Path:
    """The same, and the list has their hashes."""
    from dbh_studio.io.models import manifest as module

    tiny.vocabulary(graphs / "vocab.txt")
    data = tiny.shipped_manifest()
    data["models"] = [m for m in data["models"] if m["is_default"]]
    for model in data["models"]:
        for file in model["files"]:
            content = (graphs / file["name"]).read_bytes()
            file.update(bytes=len(content), sha256=hashlib.sha256(content).hexdigest())
    (graphs.parent / "list.json").write_text(json.dumps(data))
    monkeypatch.setattr(module, "_shipped", lambda: graphs.parent / "list.json")
    return graphs


def test_the_list_names_licence_size_and_state(graphs, capsys):
    assert run("list") == 0
    text = capsys.readouterr().out
    for word in ("* grounding-dino-tiny ", "719 MB", "45 MB", "232 kB", "? MB", "Apache-2.0", "not here", "cache"):
        assert word in text, word


def test_the_list_as_json(graphs, capsys):
    assert run("list", "--json") == 0
    data = json.loads(capsys.readouterr().out)
    assert data["folder"].endswith("models")
    detector = next(model for model in data["models"] if model["name"] == "grounding-dino-tiny")
    (file,) = detector["files"]
    assert (detector["state"], file["state"], file["bytes"]) == ("absent", "absent", 718_761_381)
    assert file["signature"]["inputs"][0] == {
        "name": "pixel_values", "dtype": "float", "shape": [1, 3, 800, 800], "fixed": True,
    }  # fmt: skip


def test_fetch_shows_size_and_licence_first_and_offline_says_what_is_needed(graphs, capsys):
    with pytest.raises(ModelError) as caught:
        run("fetch", "mobile-sam")
    assert "28" not in caught.value.problem and caught.value.remedy.count("sha256") == 2
    text = capsys.readouterr().out
    assert "45 MB" in text and "MIT (export)" in text and "huggingface.co" in text
    with pytest.raises(ModelError, match="no model 'sam'"):
        run("fetch", "sam")


def test_offline_as_an_option(graphs, monkeypatch):
    monkeypatch.delenv("DBH_STUDIO_OFFLINE")
    with pytest.raises(ModelError, match="switched off"):
        run("fetch", "--offline", "--quiet")


def test_add_then_verify(pinned, tmp_path, capsys):
    assert run("add", str(pinned), "--quiet") == 0
    assert "mobile-sam: ready" in capsys.readouterr().out
    assert run("fetch", "--json") == 0  # all is here, so nothing is downloaded
    assert {model["state"] for model in json.loads(capsys.readouterr().out)} == {"ready"}
    assert run("verify", "--pictures", str(tmp_path / "shown")) == 0
    text = capsys.readouterr().out
    assert text.count("ok") == 3 and "3 of 3 drawn trunks found" in text
    assert {path.name for path in (tmp_path / "shown").iterdir()} == {"grounding-dino-tiny.png", "mobile-sam.png"}
    with Image.open(tmp_path / "shown" / "mobile-sam.png") as picture:
        assert picture.size == (1024, 1024)


def test_verify_finds_a_changed_file_and_goes_on(pinned, tmp_path, capsys):
    run("add", str(pinned))
    path = tmp_path / "cache" / "models" / "bert-uncased-vocabulary" / "vocab.txt"
    path.write_bytes(path.read_bytes().replace(b"tree", b"free"))
    capsys.readouterr()
    assert run("verify", "--json") == 1
    checks = {check["model"]: check for check in json.loads(capsys.readouterr().out)}
    assert {name: check["verdict"] for name, check in checks.items()} == {
        "bert-uncased-vocabulary": "failed",
        "grounding-dino-tiny": "failed",  # it needs the vocabulary
        "mobile-sam": "ok",
    }
    assert "models fetch" in checks["bert-uncased-vocabulary"]["message"]


def test_verify_is_doubtful_about_a_detector_that_finds_nothing(pinned, tmp_path, capsys):
    run("add", str(pinned))
    own = tiny.detector(tmp_path / "own.onnx", seed=2)
    run("add", str(own), "--as", "grounding-dino-tiny", "--link")
    assert "added by hand" in capsys.readouterr().out
    assert run("verify", "grounding-dino-tiny") == 1
    text = capsys.readouterr().out
    assert "doubtful" in text and "--pictures" in text


def test_nothing_to_verify(graphs):
    with pytest.raises(ModelError, match="No models"):
        run("verify")
    with pytest.raises(ModelError, match="no model 'sam'"):
        run("verify", "sam")


def test_wrong_usage(graphs, capsys):
    for arguments in ((), ("add",), ("add", ""), ("steal",)):
        with pytest.raises(SystemExit) as ended:
            run(*arguments)
        assert ended.value.code == 2
    capsys.readouterr()
