from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.errors import MalformedFileError, TruncatedFileError
from dbh_studio.io.e57 import read_e57

pye57 = pytest.importorskip("pye57")


def _scan(points, **others):
    return {
        name: points[:, i].astype(float) for i, name in enumerate(("cartesianX", "cartesianY", "cartesianZ"))
    } | others


def _absolute(cloud):
    return cloud.xyz.astype(np.float64) + cloud.origin


def test_scans_are_merged_with_their_poses(tmp_path, rng):
    path = tmp_path / "survey.e57"
    local = rng.normal(size=(200, 3))
    rgb = rng.integers(0, 256, (200, 3)).astype(np.uint8)
    colours = {name: rgb[:, i] for i, name in enumerate(("colorRed", "colorGreen", "colorBlue"))}
    half = np.sqrt(0.5)  # A quarter turn about z.
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw(_scan(local, **colours), translation=np.array([500_000.0, 4_500_000.0, 100.0]))
        file.write_scan_raw(
            _scan(local, **colours),
            rotation=np.array([half, 0, 0, half]),
            translation=np.array([500_010.0, 4_500_000.0, 100.0]),
        )
    loaded = read_e57(path)
    first = local + np.array([500_000.0, 4_500_000.0, 100.0])
    second = local[:, [1, 0, 2]] * [-1, 1, 1] + np.array([500_010.0, 4_500_000.0, 100.0])
    # The writer stores single precision, the reader must not lose more.
    assert np.abs(_absolute(loaded.cloud) - np.vstack([first, second])).max() < 1e-5
    assert (loaded.cloud.rgb == np.vstack([rgb, rgb])).all()
    assert any("2 scans" in note for note in loaded.notes)
    assert loaded.provenance.metres_per_unit == 1.0


def test_invalid_points_are_left_out_and_intensity_kept_on_request(tmp_path, rng):
    path = tmp_path / "survey.e57"
    points = rng.normal(size=(100, 3))
    state = np.zeros(100, np.int8)
    state[:30] = 1
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw(_scan(points, cartesianInvalidState=state, intensity=np.arange(100, dtype=np.float32)))
    loaded = read_e57(path, attributes="all")
    assert len(loaded.cloud) == 70
    assert "30 points" in " ".join(loaded.notes)
    assert loaded.cloud.attributes["intensity"].tolist() == list(range(30, 100))
    assert not read_e57(path).cloud.attributes


def test_blocks_join(tmp_path, rng, monkeypatch):
    monkeypatch.setattr("dbh_studio.io.e57._BUFFER_POINTS", 64)
    points = rng.normal(size=(200, 3)).astype(np.float32)
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        file.write_scan_raw(_scan(points))
    assert np.abs(read_e57(tmp_path / "a.e57").cloud.xyz - points).max() < 1e-6


def test_truncated_and_damaged(tmp_path, rng):
    path = tmp_path / "a.e57"
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw(_scan(rng.normal(size=(200, 3))))
    data = path.read_bytes()
    path.write_bytes(data[:-100])
    with pytest.raises(TruncatedFileError):
        read_e57(path)
    path.write_bytes(data[:1500] + b"\xff" * 20 + data[1520:])
    with pytest.raises(MalformedFileError):
        read_e57(path)
