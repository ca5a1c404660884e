"""The demo plot: made once, the same everywhere, whole even when two ask at once, and honest about being made up."""

import csv
import dataclasses
import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path

import laspy
import numpy as np
import pytest

from dbh_studio.app import cache, demo
from dbh_studio.core.synthetic import PlotRecipe
from dbh_studio.errors import FileError, MalformedFileError, MissingComponentError
from dbh_studio.io.lock import lock_file

SMALL = PlotRecipe.simple(n_trees=3, points=4000, name="small")


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def ask(cache):
    return demo.demo_plot(cache, recipe=SMALL).path.read_bytes()


def test_made_once_and_then_taken_from_the_cache(tmp_path, monkeypatch):
    first = demo.demo_plot(tmp_path, recipe=SMALL)
    monkeypatch.setattr(demo, "make_plot", lambda *a, **k: pytest.fail("made again"))
    assert demo.demo_plot(tmp_path, recipe=SMALL) == first
    assert [path.name for path in tmp_path.iterdir()] == [first.path.parent.name]


def test_another_recipe_or_version_makes_another_plot(tmp_path, monkeypatch):
    first = demo.demo_plot(tmp_path, recipe=SMALL)
    assert demo.demo_plot(tmp_path, recipe=SMALL.changed(seed=9)).path != first.path
    monkeypatch.setattr(demo, "GENERATOR_VERSION", demo.GENERATOR_VERSION + 1)
    assert demo.demo_plot(tmp_path, recipe=SMALL).path != first.path


def test_same_recipe_same_file(tmp_path):
    assert ask(tmp_path / "one") == ask(tmp_path / "two")


def test_file_is_metres_coloured_synthetic_and_without_tree_ids(tmp_path):
    las = laspy.read(demo.demo_plot(tmp_path, recipe=SMALL).path)
    assert las.header.system_identifier == "SYNTHETIC"
    assert any("no such forest exists" in vlr.record_data.decode() for vlr in las.header.vlrs if vlr.record_id == 3)
    assert las.header.parse_crs() is None
    assert len(las) == pytest.approx(4000, rel=0.15)
    assert las.header.mins[0] + 0.5 >= 0 and las.header.maxs[0] < 12.5
    assert np.ptp(np.asarray(las.green)) > 10_000
    assert not list(las.point_format.extra_dimension_names)
    for dimension in ("classification", "point_source_id", "user_data", "intensity"):
        assert not np.asarray(las[dimension]).any()


def test_truth_says_what_is_true(tmp_path):
    truth = rows(demo.demo_plot(tmp_path, recipe=SMALL).truth_csv)
    plot = demo.make_plot(SMALL)
    assert [int(row["tree_id"]) for row in truth] == [1, 2, 3]
    for row, tree in zip(truth, plot.trees, strict=True):
        assert float(row["dbh_tape_cm"]) == pytest.approx(tree.diameter_cm("tape"), abs=0.001)
        assert float(row["dbh_curve_137_cm"]) == pytest.approx(tree.diameter_cm("curve", height_m=1.37), abs=0.001)
        assert float(row["x_m"]) == pytest.approx(tree.x_m, abs=0.001)
        assert row["species"] == tree.species


def test_a_damaged_cache_is_made_anew(tmp_path):
    made = demo.demo_plot(tmp_path, recipe=SMALL)
    whole = made.path.read_bytes()
    made.path.write_bytes(whole[:100])
    assert demo.demo_plot(tmp_path, recipe=SMALL).path.read_bytes() == whole


def test_two_processes_at_once_both_get_a_whole_plot(tmp_path):
    context = multiprocessing.get_context("spawn")
    with context.Pool(2) as pool:
        one, other = pool.map(ask, [tmp_path, tmp_path])
    assert one == other
    assert len(list(tmp_path.iterdir())) == 1


def test_second_to_finish_keeps_what_the_first_made(tmp_path, monkeypatch):
    made_by_other = []

    def slow(recipe, **options):
        if not made_by_other:
            made_by_other.append(None)
            made_by_other[0] = demo.demo_plot(tmp_path, recipe=SMALL).path.stat().st_ino
        return original(recipe, **options)

    original = demo.make_plot
    monkeypatch.setattr(demo, "make_plot", slow)
    assert demo.demo_plot(tmp_path, recipe=SMALL).path.stat().st_ino == made_by_other[0]


def test_a_cancelled_making_leaves_nothing(tmp_path):
    def stop(fraction, message=""):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        demo.demo_plot(tmp_path, recipe=SMALL, progress=stop)
    assert not list(tmp_path.iterdir())


def die_half_way(cache):
    demo.demo_plot(cache, recipe=SMALL, progress=lambda *_: os.kill(os.getpid(), signal.SIGKILL))


def grow_old(folder, seconds):
    for path in folder.iterdir():
        os.utime(path, times=(time.time() - seconds,) * 2)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
def test_what_a_killed_making_left_is_cleared_away(tmp_path):
    process = multiprocessing.get_context("spawn").Process(target=die_half_way, args=(tmp_path,))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL and len(list(tmp_path.iterdir())) == 2
    grow_old(tmp_path, 120)
    made = demo.demo_plot(tmp_path, recipe=SMALL)
    assert list(tmp_path.iterdir()) == [made.path.parent]


def test_what_others_are_making_is_left_alone(tmp_path):
    (tmp_path / ".demo-living").mkdir()
    (tmp_path / ".demo-unlocked").mkdir()
    (tmp_path / ".demo-abandoned").mkdir()
    with lock_file(tmp_path / ".demo-living.lock"):
        grow_old(tmp_path, 3600)
        os.utime(tmp_path / ".demo-abandoned", times=(time.time() - 3 * 86_400,) * 2)
        made = demo.demo_plot(tmp_path, recipe=SMALL)
        kept = {".demo-living", ".demo-living.lock", ".demo-unlocked", made.path.parent.name}
        assert {path.name for path in tmp_path.iterdir()} == kept


def test_cache_that_cannot_be_written_says_what_to_do(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="DBH_STUDIO_CACHE"):
        demo.demo_plot(tmp_path / "file", recipe=SMALL)


def test_cache_folder_follows_argument_then_environment(tmp_path, monkeypatch):
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path / "named"))
    assert cache.cache_folder() == tmp_path / "named"
    assert cache.cache_folder(tmp_path) == tmp_path
    monkeypatch.delenv(cache.CACHE_VARIABLE)
    assert "dbh-studio" in str(cache.cache_folder())


def test_shipped_recipe_has_what_the_tour_needs():
    recipe = demo.demo_recipe()
    assert "synthetic" in recipe.name
    assert recipe.n_trees == 24 and recipe.side_m == 30
    assert 1_000_000 <= recipe.points <= 1_500_000
    assert recipe.n_hidden == 1 and recipe.n_twins == 1 and recipe.n_thin >= 3 and recipe.n_big >= 2 and recipe.n_logs


def test_exactly_one_stem_of_the_demo_cannot_be_measured():
    # Fewer points than the real demo, which only makes the seen arcs smaller.
    recipe = dataclasses.replace(demo.demo_recipe(), points=400_000, ground=0.05, crowns=0.01, understorey=0.01)
    arcs = [tree.seen_arc_deg for tree in demo.make_plot(recipe).trees]
    assert sum(arc < 90 for arc in arcs) == 1
    assert sorted(arcs)[1] > 180


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"recipe": {"seed": []}}', '{"recipe": 3}'])
def test_an_edited_recipe_is_named(tmp_path, monkeypatch, text):
    package = tmp_path / "src" / "dbh_studio"
    (package / "app").mkdir(parents=True)
    (package / "assets").mkdir()
    (package / "assets" / "demo_plot.json").write_text(text)
    monkeypatch.setattr(demo, "__file__", str(package / "app" / "demo.py"))
    with pytest.raises(MalformedFileError, match="not a plot recipe"):
        demo.demo_recipe()


def test_a_missing_recipe_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "__file__", str(tmp_path / "src" / "dbh_studio" / "app" / "demo.py"))
    with pytest.raises(MissingComponentError, match=r"demo_plot\.json"):
        demo.demo_recipe()


def test_paths_are_paths(tmp_path):
    made = demo.demo_plot(tmp_path, recipe=SMALL)
    assert isinstance(made.path, Path) and made.path.suffix == ".laz" and made.truth_csv.suffix == ".csv"
