"""Damaged files give a named error or a cloud, never another exception and never a huge allocation."""

from __future__ import annotations

import tracemalloc
import warnings

import numpy as np
import pytest
import trimesh

from dbh_studio.errors import FileError
from dbh_studio.io.las import write_las
from dbh_studio.io.ply import write_ply
from dbh_studio.io.reader import read_reconstruction

_KINDS = [
    "las",
    "laz",
    "ply",
    "xyz",
    "csv",
    "e57",
    "pcd_a",
    "pcd_b",
    "pcd_c",
    "obj",
    "glb",
    "stl",
    "mesh_ply",
    "mesh_ascii_ply",
]
_TRIES = 60
_MOST_BYTES = 200_000_000


@pytest.fixture
def make(tmp_path, survey_cloud, write_pcd):
    def make_file(kind):
        if kind in ("las", "laz"):
            write_las(path := tmp_path / f"a.{kind}", survey_cloud)
        elif kind == "ply":
            write_ply(path := tmp_path / "a.ply", survey_cloud)
        elif kind in ("xyz", "csv"):
            path = tmp_path / f"a.{kind}"
            np.savetxt(
                path,
                np.column_stack([survey_cloud.xyz, survey_cloud.rgb]),
                fmt="%.4f",
                delimiter=" " if kind == "xyz" else ",",
            )
        elif kind == "e57":
            pye57 = pytest.importorskip("pye57")
            path = tmp_path / "a.e57"
            axes = ("cartesianX", "cartesianY", "cartesianZ")
            with pye57.E57(str(path), mode="w") as file:
                file.write_scan_raw({axis: survey_cloud.xyz[:, i].astype(float) for i, axis in enumerate(axes)})
        elif kind.startswith("pcd"):
            encoding = {"a": "ascii", "b": "binary", "c": "binary_compressed"}[kind[-1]]
            write_pcd(path := tmp_path / "a.pcd", {a: survey_cloud.xyz[:, i] for i, a in enumerate("xyz")}, encoding)
        else:
            path = tmp_path / f"m.{kind.split('_')[-1]}"
            options = {"encoding": "ascii"} if "ascii" in kind else {}
            trimesh.creation.icosphere(1).export(path, **options)
        return path

    return make_file


def _damaged(data, rng):
    damaged = bytearray(data)
    mode = rng.integers(3)
    if mode == 0:
        return damaged[: rng.integers(len(damaged))]
    # Half of the damage goes to the header, where it hurts.
    region = len(damaged) if mode == 1 else min(len(damaged), 500)
    for _ in range(rng.integers(1, 6)):
        damaged[rng.integers(region)] = rng.choice([0, 255, rng.integers(256)])
    return damaged


@pytest.mark.parametrize("kind", _KINDS)
def test_damage_is_named(make, kind):
    path = make(kind)
    data = path.read_bytes()
    assert len(read_reconstruction(path).cloud)
    rng = np.random.default_rng(_KINDS.index(kind))
    outcomes = set()
    tracemalloc.start()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # A damaged coordinate may overflow inside trimesh.
            for _ in range(_TRIES):
                path.write_bytes(_damaged(data, rng))
                try:
                    outcomes.add(len(read_reconstruction(path).cloud) > 0)
                except FileError as error:
                    assert str(error).startswith(path.name)
                    assert error.problem
                    outcomes.add("named")
        assert tracemalloc.get_traced_memory()[1] < _MOST_BYTES
    finally:
        tracemalloc.stop()
    assert False not in outcomes
    assert "named" in outcomes
