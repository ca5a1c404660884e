"""The Python interface, as its own documentation shows it."""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.threestems import STEMS, plot_cloud, stem_points

import dbh_studio
from dbh_studio import api
from dbh_studio.app.demo import write_laz
from dbh_studio.errors import (
    CommandError,
    FileError,
    FileMissingError,
    ProjectError,
    ProjectLockedError,
    UnscaledCloudError,
)
from dbh_studio.io.ply import write_ply
from dbh_studio.io.project import ProjectWriter
from dbh_studio.io.undo_log import UndoLog

GUIDE = Path(__file__).parents[1] / "docs" / "guide" / "python.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("api")
    write_laz(folder / "plot.laz", plot_cloud())
    write_ply(folder / "unscaled.ply", plot_cloud(unit_m=0.25))
    return folder


def blocks(docstring: str) -> list[str]:
    """The literal blocks of a docstring, as they stand."""
    lines = docstring.splitlines()
    found: list[list[str]] = []
    for before, line in zip(["", *lines], lines, strict=False):
        if line.startswith("    ") and found and (before.startswith("    ") or not before):
            found[-1].append(line[4:])
        elif not line and found:
            found[-1].append("")
        elif line.endswith("::"):
            found.append([])
        elif not line.startswith("    "):
            found.append([]) if found and found[-1] else None
    return ["\n".join(block).strip() for block in found if "".join(block)]


def run(code: str, **names: object) -> tuple[str, dict[str, object]]:
    """What some Python prints, and what it leaves."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, "example", "exec"), names)
    return printed.getvalue(), names


def test_the_examples_in_the_package_run_as_written(folder, monkeypatch):
    monkeypatch.chdir(folder)
    plot_example, stem_example = blocks(dbh_studio.__doc__)
    assert len([line for line in plot_example.splitlines() if line]) == 5
    printed, _ = run(plot_example)
    found = [line.split() for line in printed.splitlines()]
    assert [words[0] for words in found] == ["1", "2", "3"]
    assert [float(words[1]) for words in found] == pytest.approx([100 * d for _, _, d in STEMS], rel=0.02)
    printed, names = run(stem_example, points_m=stem_points(0.30), dbh_studio=dbh_studio)
    assert isinstance(names["estimate"], dbh_studio.DbhEstimate) and float(printed) == pytest.approx(30, rel=0.01)
    printed, names = run(stem_example, points_m=stem_points(0.30)[:10], dbh_studio=dbh_studio)
    assert isinstance(names["estimate"], dbh_studio.Refusal) and "points" in printed
    assert sorted(path.name for path in folder.iterdir()) == ["plot.laz", "unscaled.ply"]


def test_the_examples_in_the_guide_run_as_written(folder, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    names: dict[str, object] = {"points_m": stem_points(0.30)}
    found = re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(found) >= 4
    for code in found:
        _, names = run(code, **{name: value for name, value in names.items() if name != "__builtins__"})


@pytest.mark.parametrize("diameter_m", [0.08, 0.3, 1.1])
def test_a_stem_of_known_diameter(diameter_m):
    points = stem_points(diameter_m)
    smooth = dbh_studio.Settings().measure.changed(
        bark_share=0.0, bloat_m=0.0
    )  # these stems have no bark that a tape would lie on
    estimate = dbh_studio.measure_stem(points, settings=smooth)
    # Noise of 2 mm over thousands of points: the mean radius is known far better than that.
    assert estimate and estimate.dbh_cm == pytest.approx(100 * diameter_m, abs=0.15 + 0.3 * diameter_m)
    assert estimate.quality == "good" and 1 < estimate.rmse_mm < 3
    assert estimate.interval[0] < 100 * diameter_m < estimate.interval[1]
    again = dbh_studio.measure_stem(points[::-1].copy(), settings=smooth)
    assert again.dbh_cm == estimate.dbh_cm


def test_every_name_of_the_package_is_there():
    for name in dbh_studio.__all__:
        assert getattr(dbh_studio, name).__doc__, name
        assert name in dir(dbh_studio)
    with pytest.raises(AttributeError, match="nonsense"):
        _ = dbh_studio.nonsense


@pytest.mark.parametrize("code", ["import dbh_studio", "from dbh_studio.cli import main; assert main(['--help']) == 0"])
def test_neither_the_package_nor_help_loads_what_is_slow(code):
    check = "import sys; print([m for m in ('numpy', 'scipy', 'pydantic', 'viser', 'open3d') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", f"{code}\n{check}"], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


# ---- what the docstrings of Plot say


def test_a_plot_from_opening_to_the_table(folder, tmp_path):
    seen: list[float] = []
    project = tmp_path / "mine.dbh"
    with dbh_studio.open_plot(
        folder / "plot.laz", project_dir=project, progress=lambda f, m="": seen.append(f)
    ) as plot:
        assert isinstance(plot, api.Plot) and len(plot.inventory()) == 0
        notes = plot.settings("measure", curve="ellipse").settings("trunks", min_diameter_cm=36.0).find_trunks()
        assert all(isinstance(note, str) for note in notes)
        written = plot.write_csv(tmp_path / "new" / "trees.csv")
        with pytest.raises(ProjectLockedError):
            dbh_studio.open_plot(project)
        with dbh_studio.open_plot(project, read_only=True) as watched, pytest.raises(CommandError):
            watched.settings("measure", curve="fourier")
    assert seen == sorted(seen) and seen[-1] == 1.0
    rows = list(csv.DictReader(written.read_text(encoding="utf-8").splitlines()))
    # Only the thickest of the three is above the limit that was set.
    assert [float(row["dbh_cm"]) for row in rows] == pytest.approx([40], rel=0.02)
    assert {row["dbh_method"] for row in rows} == {"ellipse"}
    with dbh_studio.open_plot(project) as again:
        assert [row.stem_id for row in again.inventory()] == [int(row["stem_id"]) for row in rows]


def test_what_open_plot_and_settings_raise(folder, tmp_path):
    with pytest.raises(FileMissingError) as caught:
        dbh_studio.open_plot(tmp_path / "nothing.laz")
    assert isinstance(caught.value, dbh_studio.StudioError)
    plot = dbh_studio.open_plot(folder / "unscaled.ply")
    with pytest.raises(UnscaledCloudError):
        plot.find_trunks()
    for section, values in (("measure", {"curve": "square"}), ("measure", {"nonsense": 1}), ("nonsense", {})):
        with pytest.raises(CommandError):
            plot.settings(section, **values)
    for scale, unit_m in ((0.25, 0.25), ("0.25", 0.25), ("feet", 0.3048)):
        with dbh_studio.open_plot(folder / "unscaled.ply", scale=scale, up="+z") as scaled:
            assert np.ptp(scaled.session.points_world()[:, 2]) == pytest.approx(5 * unit_m / 0.25, rel=0.02)


def test_closing_tells_that_the_last_change_could_not_be_saved(folder, tmp_path, monkeypatch):
    plot = dbh_studio.open_plot(folder / "plot.laz", project_dir=tmp_path / "mine.dbh")

    def full(self, state, **options):
        raise ProjectError("The disk is full.")

    def no_room(self, content):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(ProjectWriter, "save", full)
        patch.setattr(UndoLog, "_write", no_room)
        plot.settings("measure", curve="ellipse")
        with pytest.raises(ProjectError, match="disk is full"):
            plot.close()
    dbh_studio.open_plot(tmp_path / "mine.dbh").close()


def test_the_table_never_takes_the_place_of_the_cloud(folder, tmp_path):
    cloud = tmp_path / "plot.laz"
    cloud.write_bytes((folder / "plot.laz").read_bytes())
    with dbh_studio.open_plot(cloud) as plot, pytest.raises(FileError, match="read from it"):
        plot.write_csv(cloud)
    assert cloud.read_bytes() == (folder / "plot.laz").read_bytes()


def test_the_scale_from_markers(photo_plot):
    pytest.importorskip("cv2")
    with dbh_studio.open_plot(photo_plot.cloud) as plot:
        scale = plot.scale_by_markers(photo_plot.poses, sides_m={"DICT_4X4_50 7": 1.0})
        assert scale.metres_per_unit == pytest.approx(photo_plot.metres_per_unit, rel=0.003)
        assert scale.source == "marker" and 0 < scale.standard_error < 0.01 * scale.metres_per_unit
        plot.find_trunks()
        assert [row.dbh_cm for row in plot.inventory()] == pytest.approx([100 * d for _, _, d in STEMS], rel=0.02)
        with pytest.raises(FileMissingError):
            plot.scale_by_markers("nowhere")
