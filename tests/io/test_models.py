"""The list of models, their files on this computer, and whether they work; no network but this computer's own."""

from __future__ import annotations

import copy
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.io import tinymodels as tiny

from dbh_studio.errors import MalformedFileError, MissingComponentError, ModelError
from dbh_studio.io.models import (
    ModelStore,
    check_picture,
    models_folder,
    open_graph,
    read_manifest,
    self_check,
    signature_problems,
)
from dbh_studio.io.models import manifest as manifest_module


@pytest.fixture(scope="module")
def graphs(tmp_path_factory) -> Path:
    """A folder with a tiny graph for every file of the list."""
    folder = tmp_path_factory.mktemp("graphs")
    tiny.detector(folder / "model.onnx")
    tiny.mobile_sam(folder)
    tiny.sam2(folder)
    tiny.vocabulary(folder / "vocab.txt")
    (folder / "vision_encoder.onnx_data").write_bytes(b"weights")
    (folder / "prompt_encoder_mask_decoder.onnx_data").write_bytes(b"weight")
    return folder


def pinned(graphs: Path) -> dict:
    """The list with the sizes and hashes of the tiny graphs."""
    data = tiny.shipped_manifest()
    for model in data["models"]:
        for file in model["files"]:
            content = (graphs / file["name"]).read_bytes()
            file["bytes"], file["sha256"] = len(content), hashlib.sha256(content).hexdigest()
    return data


def store_of(data: dict, folder: Path, **options: object) -> ModelStore:
    folder.mkdir(exist_ok=True)
    (folder / "list.json").write_text(json.dumps(data))
    return ModelStore(read_manifest(folder / "list.json"), folder / "models", **options)


def test_running_a_model_reports_to_nobody(graphs, tmp_path):
    code = "import sys, pathlib\nfrom dbh_studio.io.models import open_graph\nopen_graph(pathlib.Path(sys.argv[1]))"
    environment = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    home = {name: str(tmp_path) for name in ("HOME", "USERPROFILE", "XDG_CACHE_HOME", "LOCALAPPDATA")}
    subprocess.run([sys.executable, "-c", code, str(graphs / "model.onnx")], env=environment | home, check=True)
    # Where it reports, it leaves the number it knows this computer by.
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.fixture
def store(graphs, tmp_path) -> ModelStore:
    return store_of(pinned(graphs), tmp_path, offline=True)


# --- the list ---


def test_the_shipped_list_is_sound():
    manifest = read_manifest()
    assert manifest.defaults == ("bert-uncased-vocabulary", "grounding-dino-tiny", "mobile-sam")
    for model in manifest.models:
        # Licences that forbid nothing a forester does.
        assert all(part.split(" ")[0] in ("Apache-2.0", "MIT") for part in model.licence.split(", "))
        assert model.source.startswith("https://") and model.licence_url.startswith("https://")
        for file in model.files:
            assert file.url.startswith(f"{model.source}/resolve/{model.revision}/")
            assert (file.signature is not None) == file.name.endswith(".onnx")
            # What nobody states is null and not invented; and what is stated was seen somewhere.
            assert (file.sha256 is None) == (file.hash_seen_in == 0)
    hashes = [file.sha256 for model in manifest.models for file in model.files]
    assert len(set(hashes)) == len(hashes)


def test_the_picture_of_grounding_dino_is_fixed():
    (file,) = read_manifest().get("grounding-dino-tiny").files
    pixels = next(tensor for tensor in file.signature.inputs if tensor.name == "pixel_values")
    assert pixels.shape == (1, 3, 800, 800) and pixels.is_fixed


def test_an_unknown_model_is_named_with_those_there_are():
    with pytest.raises(ModelError, match="mobile-sam"):
        read_manifest().get("sam")


@pytest.mark.parametrize(
    "change",
    [
        {"url": "http://example.org/model.onnx"},
        {"url": "ftp://example.org/model.onnx"},
        {"url": "http://127.0.0.1.example.org/model.onnx"},
        {"sha256": "abc"},
        {"bytes": -1},
        {"bytes": "many"},
        {"name": "../model.onnx"},
        {"name": ".hidden"},
        {"role": "cook"},
        {"signature": "unknown"},
    ],
)
def test_a_bad_list_is_refused(tmp_path, change):
    data = tiny.shipped_manifest()
    data["models"][1]["files"][0].update(change)
    path = tmp_path / "list.json"
    path.write_text(json.dumps(data))
    with pytest.raises(MalformedFileError):
        read_manifest(path)


def test_other_lists_that_are_none(tmp_path):
    path = tmp_path / "list.json"
    for edit in (
        lambda d: d.update(version=2),
        lambda d: d["models"].append(d["models"][0]),
        lambda d: d["models"][0].update(needs=["nothing"]),
        lambda d: d["models"][0].update(licence=""),
        lambda d: d["models"][0].update(files=[]),
        lambda d: d["models"][0].update(purpose="oracle"),
        lambda d: d.pop("models"),
    ):
        data = copy.deepcopy(tiny.shipped_manifest())
        edit(data)
        path.write_text(json.dumps(data))
        with pytest.raises(MalformedFileError):
            read_manifest(path)
    path.write_text("[")
    with pytest.raises(MalformedFileError):
        read_manifest(path)


def test_a_list_that_is_not_installed(monkeypatch, tmp_path):
    monkeypatch.setattr(manifest_module, "__file__", str(tmp_path / "a" / "b" / "c" / "d.py"))
    with pytest.raises(MissingComponentError):
        read_manifest()


def test_the_folder_follows_the_cache_variable(monkeypatch, tmp_path):
    monkeypatch.setenv("DBH_STUDIO_CACHE", str(tmp_path))
    assert models_folder() == tmp_path / "models"
    monkeypatch.delenv("DBH_STUDIO_CACHE")
    assert models_folder().name == "models" and models_folder(tmp_path) == tmp_path


# --- adding ---


def test_files_are_known_by_their_hash_whatever_they_are_called(store, graphs, tmp_path):
    (tmp_path / "download(1).bin").write_bytes((graphs / "vocab.txt").read_bytes())
    (state,) = store.add([tmp_path / "download(1).bin"])
    assert (state.spec.name, state.state, state.origin) == ("bert-uncased-vocabulary", "ready", "pinned")
    assert store.paths("bert-uncased-vocabulary")["vocabulary"].read_text().split() == tiny.WORDS


def test_a_folder_brings_all_models(store, graphs):
    states = store.add([graphs])
    # The four detectors have one tiny graph in common.
    assert {state.spec.name for state in states} == {model.name for model in store.manifest.models}
    assert [spec.name for spec in store.ready("segmenter")] == ["mobile-sam", "sam2.1-tiny"]
    assert store.ready("detector")[0].name == "grounding-dino-tiny"
    assert set(store.paths("grounding-dino-tiny")) == {"model", "vocabulary"}
    assert set(store.paths("sam2.1-tiny")) == {"encoder", "decoder"}


def test_weights_beside_a_graph_come_along(store, graphs):
    store.add([graphs / "vision_encoder.onnx", graphs / "prompt_encoder_mask_decoder.onnx"])
    assert store.state("sam2.1-tiny").state == "ready"


def test_a_detector_without_its_vocabulary_is_not_ready(store, graphs):
    store.add([graphs / "model.onnx"])
    assert store.ready("detector") == ()
    with pytest.raises(ModelError, match="models fetch bert-uncased-vocabulary"):
        store.paths("grounding-dino-tiny")


def test_a_link_takes_no_room(store, graphs):
    store.add([graphs / "vocab.txt"], link=True)
    path = store.paths("bert-uncased-vocabulary")["vocabulary"]
    assert path.is_symlink() and path.resolve() == (graphs / "vocab.txt").resolve()


def test_an_unknown_file_needs_a_name_and_the_right_signature(store, tmp_path):
    own = tiny.detector(tmp_path / "mine.onnx", seed=3)
    with pytest.raises(ModelError, match=r"mine\.onnx: sha256 .*--as"):
        store.add([own])
    (state,) = store.add([own], name="grounding-dino-tiny")
    assert (state.state, state.origin) == ("ready", "added")
    # It stays accepted, for the person has said so; and other copies of the list do not call it damaged.
    assert store.state("grounding-dino-tiny").state == "ready"


def test_the_right_one_of_two_unknown_graphs_is_taken(store, tmp_path):
    encoder, decoder = tiny.mobile_sam(tmp_path / "x")
    for number, path in enumerate((encoder, decoder)):
        path.rename(tmp_path / f"{number}.onnx")
        with (tmp_path / f"{number}.onnx").open("ab") as file:
            file.write(b"\x72\x00")  # an empty field of the model: other bytes, the same graph
    store.add([tmp_path / "0.onnx", tmp_path / "1.onnx"], name="mobile-sam")
    assert store.state("mobile-sam").state == "ready"
    assert self_check(store.manifest.get("mobile-sam"), store.paths("mobile-sam")).verdict == "ok"


@pytest.mark.parametrize("name", ["grounding-dino-tiny", "mobile-sam"])
def test_a_graph_of_another_family_is_refused(store, tmp_path, name):
    own = tiny.sam2(tmp_path)[0]
    with pytest.raises(ModelError):
        store.add([own], name=name)
    assert store.state(name).state == "absent"


def test_a_detector_with_open_sides_is_refused(store, tmp_path):
    own = tiny.detector(tmp_path / "model.onnx", side="side")
    with pytest.raises(ModelError, match="wrong boxes"):
        store.add([own], name="grounding-dino-tiny")


def test_what_is_no_graph_is_refused(store, tmp_path):
    (tmp_path / "model.onnx").write_bytes(b"<html>not found</html>")
    with pytest.raises(MalformedFileError):
        store.add([tmp_path / "model.onnx"], name="grounding-dino-tiny")
    with pytest.raises(MalformedFileError):
        open_graph(tmp_path / "nowhere.onnx")
    assert store.state("grounding-dino-tiny").state == "absent"


# --- checked before use ---


def test_a_changed_file_is_never_handed_out(store, graphs):
    store.add([graphs / "vocab.txt"])
    path = store.paths("bert-uncased-vocabulary")["vocabulary"]
    good = path.read_bytes()
    for content in (good[:-1], good.replace(b"tree", b"free")):
        path.write_bytes(content)
        with pytest.raises(ModelError, match="not the file that was accepted"):
            store.paths("bert-uncased-vocabulary")
    # The same content at another time is hashed and then taken.
    path.write_bytes(good)
    os.utime(path, ns=(5, 5))
    assert store.state("bert-uncased-vocabulary").state == "unchecked"
    store.paths("bert-uncased-vocabulary")
    assert store.state("bert-uncased-vocabulary").state == "ready"


def test_a_silent_change_is_found_when_asked_for(store, graphs):
    store.add([graphs / "vocab.txt"])
    path = store.paths("bert-uncased-vocabulary")["vocabulary"]
    times = path.stat().st_atime_ns, path.stat().st_mtime_ns
    path.write_bytes(path.read_bytes().replace(b"tree", b"free"))
    os.utime(path, ns=times)
    with pytest.raises(ModelError, match="models fetch"):
        store.rehash("bert-uncased-vocabulary")
    # And from then on it is not handed out either.
    with pytest.raises(ModelError):
        store.paths("bert-uncased-vocabulary")


def test_files_put_into_the_cache_by_hand_are_hashed_first(store, graphs):
    folder = store.folder / "bert-uncased-vocabulary"
    folder.mkdir(parents=True)
    (folder / "vocab.txt").write_bytes((graphs / "vocab.txt").read_bytes())
    assert store.state("bert-uncased-vocabulary").state == "unchecked"
    assert store.paths("bert-uncased-vocabulary")
    (folder / "vocab.txt").write_bytes(b"x" * (graphs / "vocab.txt").stat().st_size)
    with pytest.raises(ModelError):
        store.paths("bert-uncased-vocabulary")


def test_a_record_that_was_lost_or_spoilt_costs_a_hash(store, graphs):
    store.add([graphs / "vocab.txt"])
    record = store.folder / "bert-uncased-vocabulary" / "installed.json"
    for text in ("", "[1]", '{"vocab.txt": 3}', '{"vocab.txt": {"sha256": 4}}'):
        record.write_text(text)
        assert store.paths("bert-uncased-vocabulary")
    record.unlink()
    assert store.paths("bert-uncased-vocabulary") and record.is_file()


def test_a_new_list_wants_its_own_files(store, graphs, tmp_path):
    store.add([graphs / "vocab.txt"])
    data = pinned(graphs)
    data["models"][0]["files"][0]["sha256"] = "0" * 64
    with pytest.raises(ModelError):
        store_of(data, tmp_path).paths("bert-uncased-vocabulary")


def test_the_identity_changes_with_the_content_only(store, graphs, tmp_path):
    store.add([graphs])
    first = store.identity("mobile-sam")
    assert first == store.identity("mobile-sam") != store.identity("sam2.1-tiny")
    published = store.identity("grounding-dino-tiny-fp16")
    assert published == store.identity("grounding-dino-tiny")
    store.add([tiny.detector(tmp_path / "model.onnx", seed=1)], name="grounding-dino-tiny-fp16")
    assert store.identity("grounding-dino-tiny-fp16") != published


# --- signatures ---


def test_every_tiny_graph_has_the_public_signature(graphs):
    for model in read_manifest().models:
        for file in model.files:
            if file.signature is not None:
                assert signature_problems(open_graph(graphs / file.name), file.signature) == ()


def test_what_a_wrong_graph_lacks_is_said(graphs):
    wanted = read_manifest().get("grounding-dino-tiny").files[0].signature
    problems = " ".join(signature_problems(open_graph(graphs / "vision_encoder.onnx"), wanted))
    for word in ("no input pixel_mask", "no output logits", "pixel_values", "1 x 3 x 800 x 800"):
        assert word in problems
    encoder = read_manifest().get("sam2.1-tiny").files[0].signature
    problems = " ".join(signature_problems(open_graph(graphs / "model.onnx"), encoder))
    assert "inputs nobody will give" in problems and "is 1 x 3 x 800 x 800, not 1 x 3 x 1024 x 1024" in problems


# --- the check on the drawing ---


def test_the_drawing_is_what_it_says():
    drawing = check_picture(800)
    assert drawing.rgb.shape == (800, 800, 3) and drawing.masks.shape == (3, 800, 800)
    for box, mask in zip(drawing.boxes.astype(int), drawing.masks, strict=True):
        x0, y0, x1, y1 = box
        assert mask[y0:y1, x0:x1].sum() == mask.sum() and mask[y0].any() and mask[:, x1 - 1].any()
        brown = drawing.rgb[mask].mean(axis=0)
        assert brown[0] > brown[1] > brown[2]
    assert np.array_equal(check_picture(800).rgb, drawing.rgb)
    # The same at another size: boxes are shares of the side.
    assert check_picture(1024).boxes / 1024 == pytest.approx(drawing.boxes / 800, abs=0.003)


def test_models_that_work_pass(store, graphs):
    store.add([graphs])
    for model in store.manifest.models:
        check = self_check(model, store.paths(model.name))
        assert check.verdict == "ok", check
        assert (check.picture is None) == (model.purpose == "tokenizer")


def test_a_detector_that_answers_at_random_is_doubtful(store, graphs, tmp_path):
    paths = {"vocabulary": graphs / "vocab.txt"}
    spec = store.manifest.get("grounding-dino-tiny")
    for seed in range(4):
        check = self_check(spec, {**paths, "model": tiny.detector(tmp_path / "m.onnx", seed=seed)})
        assert check.verdict == "doubtful", check


def test_a_segmenter_that_answers_nonsense_is_doubtful(store, graphs, tmp_path, monkeypatch):
    monkeypatch.setattr(tiny, "BROWN", np.array([120.0, 160.0, 220.0]))  # looks for the sky
    for name, make in (("mobile-sam", tiny.mobile_sam), ("sam2.1-tiny", tiny.sam2)):
        encoder, decoder = make(tmp_path / name)
        check = self_check(store.manifest.get(name), {"encoder": encoder, "decoder": decoder})
        assert check.verdict == "doubtful", check


def test_a_model_that_gives_no_numbers_fails(store, graphs, tmp_path, monkeypatch):
    monkeypatch.setattr(tiny, "mask_logits", lambda graph, *_: graph.constant(np.full((1, 1, 256, 256), np.nan)))
    encoder, decoder = tiny.mobile_sam(tmp_path)
    check = self_check(store.manifest.get("mobile-sam"), {"encoder": encoder, "decoder": decoder})
    assert check.verdict == "failed" and "NaN" in check.message


def test_files_of_another_model_fail(store, graphs):
    spec = store.manifest.get("mobile-sam")
    swapped = {"encoder": graphs / "vision_encoder.onnx", "decoder": graphs / "sam_mask_decoder_single.onnx"}
    assert self_check(spec, swapped).verdict == "failed"
    spec = store.manifest.get("bert-uncased-vocabulary")
    assert self_check(spec, {"vocabulary": graphs / "model.onnx"}).verdict == "failed"


def test_an_empty_cache_is_no_error(tmp_path):
    store = ModelStore(folder=tmp_path / "nowhere")
    assert {state.state for state in store.states()} == {"absent"}
    assert store.ready("detector") == () and not (tmp_path / "nowhere").exists()
