"""The whole program on real clouds and on a rendered plot whose truth is known.

The data are not part of the project; where they are not beside it, the tests are skipped.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from dbh_studio.app import plot_run
from dbh_studio.cli import main

DATA = Path(__file__).parents[1].parent / "shared" / "data"
ZOO = ("lasr", "laspy", "lidr")


def data(*parts: str) -> Path:
    path = DATA.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"the real data are not there: ../shared/data/{'/'.join(parts)}")
    return path


def run(path: Path, out: Path, *options: str) -> list[dict[str, str]]:
    """The table that `dbh-studio run` writes."""
    assert main(["run", str(path), "--out", str(out), "--quiet", *options]) == 0
    (table,) = out.glob("*.csv")
    return list(csv.DictReader(table.read_text(encoding="utf-8").splitlines()))


def diameters_cm(rows: list[dict[str, str]]) -> np.ndarray:
    return np.array([float(row["dbh_cm"]) for row in rows if row["dbh_cm"]])


def check_refusals(rows: list[dict[str, str]]) -> None:
    """A stem has a diameter, or a reason and a remedy."""
    for row in rows:
        assert bool(row["dbh_cm"]) != (row["quality"] == "refused")
        assert row["dbh_cm"] or (row["reason"] and row["remedy"])


def test_a_pine_plot(tmp_path):
    rows = run(data("plots", "pine_plot.laz"), tmp_path)
    assert 11 <= len(rows) <= 16
    check_refusals(rows)
    found = diameters_cm(rows)
    assert len(found) >= 11 and np.all((found > 8) & (found < 45)) and 15 < np.median(found) < 27


def test_one_pine(tmp_path):
    rows = run(data("plots", "pine.laz"), tmp_path)
    # A plain circle gives 25.4 cm.
    assert diameters_cm(rows) == pytest.approx([25.2], abs=0.8)


def test_lodgepole_pines_without_ground(tmp_path):
    rows = run(data("plots", "LPine1_demo.laz"), tmp_path)
    assert 13 <= len(rows) <= 15
    check_refusals(rows)
    assert len(diameters_cm(rows)) >= 13
    # What is known of the heights must be told with every one of them.
    assert all("no ground" in row["reason"] for row in rows if row["dbh_cm"])


def test_one_tree_in_three_formats(tmp_path, capsys):
    folder = data("itsme_tree_1")
    names = ("pc_tree.las", "pc_tree.txt", "pc_tree.ply")
    assert main(["measure", "--scale", "metres", "--json", *(str(folder / name) for name in names)]) == 0
    measured = [row["dbh_cm"] for row in json.loads(capsys.readouterr().out)]
    found = [diameters_cm(run(folder / name, tmp_path / name, "--scale", "metres")) for name in names]
    # 15.3 cm by TreeQSM.
    assert [len(part) for part in found] == [1, 1, 1]
    everything = [*measured, *np.concatenate(found)]
    assert np.ptp(everything) < 0.5 and everything == pytest.approx([15.3] * 6, abs=1.0)
    # Only the LAS file says what its unit is.
    assert main(["measure", str(folder / "pc_tree.txt")]) == 3


def test_tree_slices_with_a_field_tape(capsys):
    folder = data("treescope_trunk_slices")
    truth = {
        row["file"]: float(row["dbh_cm"]) for row in csv.DictReader((folder / "reference.csv").read_text().splitlines())
    }
    assert main(["measure", "--ground-z", "0", "--json", *(str(folder / name) for name in truth)]) == 0
    rows = json.loads(capsys.readouterr().out)
    error_cm = np.array([row["dbh_cm"] - truth[Path(row["file"]).name] for row in rows])
    assert len(error_cm) == 8
    assert np.sqrt(np.mean(error_cm**2)) <= 1.1 and abs(error_cm.mean()) <= 0.7
    assert all(row["quality"] != "poor" for row in rows)


# ---- the rendered plot


def test_the_rendered_plot_wants_a_scale(tmp_path, capsys):
    cloud = data("synthetic_360", "dense_unscaled.ply")
    assert main(["run", str(cloud), "--out", str(tmp_path / "out")]) == 3
    said = capsys.readouterr()
    assert said.out == "" and "--scale" in said.err and "dbh-studio open" in said.err
    assert not (tmp_path / "out").exists()


def test_the_rendered_plot_with_its_scale(tmp_path):
    folder = data("synthetic_360")
    pose = json.loads((folder / "world_from_model.json").read_text())
    scale = pose["metres_per_unit"]
    result = plot_run.run_plot(folder / "dense_unscaled.ply", tmp_path, scale=1.33231)
    result.session.close()
    rows = [row for row in result.session.inventory() if row.dbh_cm is not None]
    # The program stands the plot upright in a frame of its own: back to the file's, and from there to the truth's.
    source_from_world = result.session.document.world_from_source.inverse()
    places = np.array([(row.x_m, row.y_m, row.z_ground_m) for row in rows])
    model = source_from_world.apply(places) + result.session.cloud.origin
    true_from_model = scale * Rotation.from_quat(pose["rotation_xyzw"]).as_matrix()
    placed = model @ true_from_model.T + pose["translation"]

    truth = list(csv.DictReader((folder / "gt_dbh.csv").read_text().splitlines()))
    true_xy = np.array([(float(row["x"]), float(row["y"])) for row in truth])
    distance = np.linalg.norm(placed[:, None, :2] - true_xy, axis=2)
    found, true = linear_sum_assignment(np.minimum(distance, 5.0))
    near = distance[found, true] < 0.3
    assert len(truth) == 12 and near.sum() == 12
    assert np.abs(placed[found, 2] - [float(truth[i]["ground_z_mean"]) for i in true]).max() < 0.4
    tape = np.array([float(truth[i]["dbh_tape_cm"]) for i in true])
    error = np.array([rows[i].dbh_cm for i in found]) / tape - 1
    # Of some only one side is seen; where that makes a diameter wrong it must not be called good.
    assert np.median(np.abs(error)) < 0.03 and np.abs(error).max() < 0.25
    assert all(rows[i].quality == "poor" for i, part in zip(found, error, strict=True) if abs(part) > 0.10)


# ---- every format


@pytest.mark.parametrize("name", ZOO)
def test_every_file_of_the_zoo_is_read_or_told_of(name, tmp_path, capsys):
    files = sorted(data("format_zoo", name).iterdir())
    assert files
    for path in files:
        capsys.readouterr()
        status = main(["run", str(path), "--out", str(tmp_path / path.name)])
        said = capsys.readouterr()
        assert status in (0, 1, 3), path.name
        assert "Traceback" not in said.err and "Unexpected" not in said.err, path.name
        if status == 0:
            assert len(list((tmp_path / path.name).iterdir())) == 2, path.name
        else:
            assert said.err.startswith("dbh-studio: ") and said.err.rstrip().endswith("."), path.name
            assert not (tmp_path / path.name).exists()
