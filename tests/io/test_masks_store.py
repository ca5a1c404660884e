"""The masks kept beside a plot: small, resumed after a kill, and never another photo's or another model's."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dbh_studio.errors import FileError, UnsupportedFormatError
from dbh_studio.io.masks import MaskRecipe, MaskStore, TrunkMask
from dbh_studio.io.masks import store as store_module
from dbh_studio.io.masks.store import read_stored

RECIPE = MaskRecipe("grounded_sam", {"detector": "ab" * 32}, "tree trunk", {"box": 0.3})


def photo(folder: Path, name: str = "a.jpg", content: bytes = b"pixels") -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


def trunks(n: int = 2) -> TrunkMask:
    labels = np.zeros((60, 80), np.uint16)
    for number in range(1, n + 1):
        labels[10:50, number * 2] = number
    return TrunkMask(labels, has_instances=n > 1, scores={number: 0.5 for number in range(1, n + 1)})


def same(a: TrunkMask | None, b: TrunkMask) -> bool:
    ignored = a is not None and ((a.ignored is None) == (b.ignored is None))
    if ignored and b.ignored is not None:
        ignored = np.array_equal(a.ignored, b.ignored)
    return ignored and np.array_equal(a.labels, b.labels) and a.has_instances == b.has_instances


def test_what_is_stored_is_read_again_by_the_next_process(tmp_path):
    store, path = MaskStore(tmp_path / "masks"), photo(tmp_path)
    store.put("x/ä b.jpg", path, trunks(), RECIPE)
    for again in (store, MaskStore(tmp_path / "masks")):
        mask = again.get("x/ä b.jpg", path, RECIPE)
        assert same(mask, trunks()) and mask.scores == {1: 0.5, 2: 0.5}
        entry = again.entry("x/ä b.jpg")
        assert (entry.n_trunks, entry.width_px, entry.height_px) == (2, 80, 60)
        assert MaskRecipe(**entry.recipe) == RECIPE and len(again) == 1


@settings(max_examples=40)
@given(
    labels=hnp.arrays(np.uint16, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.integers(0, 65534)),
    limit=st.sampled_from([2, 254, 255, 256, 65534]),
    with_ignored=st.booleans(),
    has_instances=st.booleans(),
)
def test_any_mask_survives(tmp_path_factory, labels, limit, with_ignored, has_instances):
    folder = tmp_path_factory.mktemp("m")
    labels = (labels % limit).astype(np.uint16)
    ignored = (labels == 0) & (np.indices(labels.shape).sum(axis=0) % 2 == 0) if with_ignored else None
    mask = TrunkMask(labels, ignored if ignored is not None and ignored.any() else None, has_instances)
    MaskStore(folder).put("a", photo(folder), mask, RECIPE)
    assert same(MaskStore(folder).get("a"), mask)


def test_a_mask_takes_little_room(tmp_path):
    labels = np.zeros((2048, 4096), np.uint16)
    for left in range(100, 4000, 300):
        labels[600:1500, left : left + 40] = 1
    store = MaskStore(tmp_path / "m")
    store.put("a", photo(tmp_path), TrunkMask(labels), RECIPE)
    assert store.n_bytes < 20_000
    assert (tmp_path / "m" / store.entry("a").file).read_bytes()[24] == 1  # bits per pixel, in the PNG header


def test_used_again_only_where_nothing_changed(tmp_path):
    store, path = MaskStore(tmp_path / "m"), photo(tmp_path)
    store.put("a", path, trunks(), RECIPE)
    assert store.to_do({"a": path}, RECIPE) == ()
    for other in (
        replace(RECIPE, prompt="tree"),
        replace(RECIPE, models={"detector": "cd" * 32}),
        replace(RECIPE, options={"box": 0.31}),
        replace(RECIPE, method="prompted_sam"),
    ):
        assert store.get("a", path, other) is None and store.to_do({"a": path}, other) == ("a",)
    same_recipe = MaskRecipe("grounded_sam", dict(RECIPE.models), "tree trunk", dict(reversed(RECIPE.options.items())))
    assert store.get("a", path, same_recipe) is not None
    # A copied photo has another time but the same content.
    os.utime(path, ns=(1, 1))
    assert store.to_do({"a": path}, RECIPE) == ()
    path.write_bytes(b"Pixels")
    os.utime(path, ns=(1, 2))
    assert store.get("a", path, RECIPE) is None and store.to_do({"a": path}, RECIPE) == ("a",)
    path.unlink()
    assert store.get("a", path, RECIPE) is None and store.get("a") is not None


def test_what_a_person_painted_outlives_another_prompt(tmp_path):
    store, path = MaskStore(tmp_path / "m"), photo(tmp_path)
    store.put("a", path, trunks(), RECIPE, review="repainted")
    assert MaskStore(tmp_path / "m").get("a", path, replace(RECIPE, prompt="stem")) is not None
    store.set_review("a", "rejected")
    assert MaskStore(tmp_path / "m").entry("a").review == "rejected"
    with pytest.raises(KeyError):
        store.set_review("b", "accepted")
    with pytest.raises(ValueError):
        store.put("a", path, trunks(), RECIPE, review="nice")


def test_a_damaged_picture_is_made_again(tmp_path):
    store, path = MaskStore(tmp_path / "m"), photo(tmp_path)
    for name in ("a", "b", "c"):
        store.put(name, path, trunks(), RECIPE)
    files = {name: tmp_path / "m" / store.entry(name).file for name in ("a", "b", "c")}
    files["a"].write_bytes(files["a"].read_bytes()[:-9])
    files["b"].unlink()
    store = MaskStore(tmp_path / "m")
    assert store.to_do(dict.fromkeys("abc", path), RECIPE) == ("a", "b")
    assert store.get("a", path, RECIPE) is None and store.get("b") is None and store.get("c") is not None
    assert store.entry("a") is None
    store.put("a", path, trunks(), RECIPE)
    assert same(MaskStore(tmp_path / "m").get("a", path, RECIPE), trunks())


def test_a_picture_of_another_photo_is_not_taken(tmp_path):
    store, path = MaskStore(tmp_path / "m"), photo(tmp_path)
    store.put("a", path, trunks(), RECIPE)
    store.put("b", path, trunks(5), RECIPE)
    (tmp_path / "m" / store.entry("a").file).write_bytes((tmp_path / "m" / store.entry("b").file).read_bytes())
    assert store.get("a") is None


@pytest.mark.parametrize("cut", [1, 40, 200])
def test_half_a_line_at_the_end_costs_one_photo(tmp_path, cut):
    store, path = MaskStore(tmp_path / "m"), photo(tmp_path)
    store.put("a", path, trunks(), RECIPE)
    store.put("b", path, trunks(), RECIPE)
    index = tmp_path / "m" / "index.jsonl"
    index.write_bytes(index.read_bytes()[:-cut])
    store = MaskStore(tmp_path / "m")
    assert store.get("a", path, RECIPE) is not None
    store.put("c", path, trunks(), RECIPE)
    assert set(store.to_do(dict.fromkeys("abc", path), RECIPE)) == ({"b"} if cut > 1 else set())
    assert len(MaskStore(tmp_path / "m")) == (2 if cut > 1 else 3)


def test_lines_that_are_no_entries_are_passed_over(tmp_path):
    store, path = MaskStore(tmp_path / "m"), photo(tmp_path)
    store.put("a", path, trunks(), RECIPE)
    index = tmp_path / "m" / "index.jsonl"
    good = json.loads(index.read_text().splitlines()[1])
    bad = [{**good, "file": "../../secret.png"}, {**good, "width_px": -1}, {**good, "more": 1}, {**good, "review": 3}]
    bad += [{**good, "scores": {"1": "a"}}, {**good, "n_trunks": None}, {**good, "recipe": {}}]
    bad += [{**good, "recipe": {"method": ["painted"]}}]
    index.write_text(index.read_text() + "".join(json.dumps(line) + "\n" for line in [*bad, [], 7]) + "no json\n\x00\n")
    assert MaskStore(tmp_path / "m").get("a", path, RECIPE) is not None
    (entry,) = MaskStore(tmp_path / "m").entries
    assert (entry.recipe, entry.scores, entry.n_trunks) == (good["recipe"], good["scores"], good["n_trunks"])


def test_a_newer_programs_masks_are_left_alone(tmp_path):
    (tmp_path / "index.jsonl").write_text('{"format": "dbh-studio masks", "version": 2}\n')
    with pytest.raises(UnsupportedFormatError):
        MaskStore(tmp_path)


WORK = """
import sys, time
from pathlib import Path
import numpy as np
from dbh_studio.io.masks import MaskRecipe, MaskStore, TrunkMask
folder = Path(sys.argv[1])
store = MaskStore(folder / "m")
recipe = MaskRecipe("test")
photos = {f"{i}": folder / "a.jpg" for i in range(4000)}
labels = np.random.default_rng(0).integers(0, 2, (300, 300)).astype(np.uint16)
for name in store.to_do(photos, recipe):
    store.put(name, photos[name], TrunkMask(labels), recipe)
    print(name, flush=True)
print("done", flush=True)
"""


@pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL")
def test_a_killed_job_goes_on_where_it_was(tmp_path):
    photo(tmp_path)
    told: list[str] = []
    for n_lines in (5, 12):
        job = subprocess.Popen([sys.executable, "-c", WORK, str(tmp_path)], stdout=subprocess.PIPE, text=True)
        told += [job.stdout.readline().strip() for _ in range(n_lines)]
        job.send_signal(signal.SIGKILL)
        told += job.stdout.read().split()
        job.wait()
        job.stdout.close()
        store = MaskStore(tmp_path / "m")
        # All that was told as done is done, and at most the one under way is done besides.
        assert all(store.get(name, tmp_path / "a.jpg", MaskRecipe("test")) is not None for name in told)
        assert len(told) <= len(store) <= len(told) + 2
    assert len(set(told)) == len(told) < 4000


def test_a_folder_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    store, path = MaskStore(tmp_path / "m"), photo(tmp_path)
    store.put("a", path, trunks(), RECIPE)
    monkeypatch.setattr(store_module, "atomic_file", full)
    with pytest.raises(FileError, match="No space left"):
        store.put("b", path, trunks(), RECIPE)
    assert MaskStore(tmp_path / "m").get("a") is not None and store.get("b") is None
    with pytest.raises(FileError, match="photo"):
        store.put("b", tmp_path / "none.jpg", trunks(), RECIPE)


@pytest.mark.skipif(os.name == "nt", reason="links need rights there")
def test_a_planted_link_is_not_written_through(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("{}\n")
    (tmp_path / "m").mkdir()
    (tmp_path / "m" / "index.jsonl").symlink_to(victim)
    with pytest.raises(FileError):
        MaskStore(tmp_path / "m").put("a", photo(tmp_path), trunks(), RECIPE)
    assert victim.read_text() == "{}\n"


def test_removed_masks_are_gone(tmp_path):
    store, path = MaskStore(tmp_path / "m"), photo(tmp_path)
    for name in ("a", "b"):
        store.put(name, path, trunks(), RECIPE)
    store.remove(["a", "nobody"])
    assert [entry.image for entry in MaskStore(tmp_path / "m").entries] == ["b"]
    store.remove()
    assert len(list((tmp_path / "m").iterdir())) == 1 and len(MaskStore(tmp_path / "m")) == 0
    MaskStore(tmp_path / "none").remove()
    assert not (tmp_path / "none").exists()


def test_superseded_lines_are_dropped_in_time(tmp_path, monkeypatch):
    monkeypatch.setattr(store_module, "_MAX_STALE", 3)
    store, path = MaskStore(tmp_path / "m"), photo(tmp_path)
    for _ in range(6):
        store.put("a", path, trunks(), RECIPE)
    assert MaskStore(tmp_path / "m").get("a", path, RECIPE) is not None
    assert len((tmp_path / "m" / "index.jsonl").read_text().splitlines()) == 2


def test_one_store_takes_the_masks_of_another(tmp_path):
    here, there = MaskStore(tmp_path / "here"), MaskStore(tmp_path / "there")
    paths = {name: photo(tmp_path, name) for name in ("a.jpg", "b.jpg", "c.jpg")}
    here.put("a.jpg", paths["a.jpg"], trunks(1), RECIPE)
    here.put("c.jpg", paths["c.jpg"], trunks(1), RECIPE)
    there.put("a.jpg", paths["a.jpg"], trunks(3), RECIPE, review="accepted")
    lost = there.put("b.jpg", paths["b.jpg"], trunks(2), RECIPE)
    there.put("d.jpg", paths["b.jpg"], trunks(2), RECIPE)
    (tmp_path / "there" / lost.file).unlink()
    here.take(there)
    again = MaskStore(tmp_path / "here")
    # Of a photo that both have, the other's; what has lost its picture is made anew.
    assert [entry.image for entry in again.entries] == ["c.jpg", "a.jpg", "d.jpg"]
    assert same(again.get("a.jpg"), trunks(3)) and again.entry("a.jpg").review == "accepted"
    assert len(there) == 3


def test_whether_a_mask_is_of_a_photo_as_it_is_now(tmp_path):
    store, path = MaskStore(tmp_path / "masks"), photo(tmp_path)
    store.put("a.jpg", path, trunks(), RECIPE)
    assert store.is_of("a.jpg", path) and store.is_of("a.jpg", str(path)) and store.is_of("a.jpg", None)
    assert not store.is_of("b.jpg", path)
    path.write_bytes(b"other pixels")
    assert not store.is_of("a.jpg", path) and store.is_of("a.jpg", None)


def test_a_copied_photo_is_read_once_to_see_that_it_is_the_same(tmp_path, monkeypatch):
    store, path = MaskStore(tmp_path / "masks"), photo(tmp_path)
    store.put("a.jpg", path, trunks(), RECIPE)
    os.utime(path, ns=(10**18, 10**18))
    assert store.is_of("a.jpg", path)
    monkeypatch.setattr("builtins.open", lambda *_, **__: pytest.fail("the photo was read again"))
    assert store.is_of("a.jpg", path)


def test_a_stored_mask_is_read_without_its_store_and_a_damaged_one_is_told(tmp_path):
    store = MaskStore(tmp_path / "masks")
    entry = store.put("a.jpg", photo(tmp_path), trunks(), RECIPE)
    assert same(read_stored(store.folder, entry), trunks())
    picture = store.folder / entry.file
    picture.write_bytes(picture.read_bytes()[:-8])
    with pytest.raises(FileError, match="masks make"):
        read_stored(store.folder, entry)
    picture.unlink()
    with pytest.raises(FileError, match=entry.file[:-4]):
        read_stored(store.folder, entry)
