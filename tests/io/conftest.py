"""Small clouds and files for the readers' tests."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from dbh_studio.core.cloud import PointCloud

SHARED = Path(__file__).parents[2].parent / "shared" / "data"


@pytest.fixture
def shared_data() -> Path:
    if not SHARED.is_dir():
        pytest.skip("the folder shared/data with real files is not beside the project")
    return SHARED


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture
def survey_points(rng) -> np.ndarray:
    """(500, 3) float64, a plot at UTM coordinates."""
    return rng.uniform([0, 0, 0], [30.0, 20.0, 15.0], (500, 3)) + np.array([500_000.0, 4_500_000.0, 312.0])


@pytest.fixture
def survey_cloud(survey_points, rng) -> PointCloud:
    rgb = rng.integers(1, 256, (500, 3), dtype=np.uint8)
    values = {"treeID": rng.integers(0, 6, 500).astype(np.int32), "intensity": np.arange(500, dtype=np.uint16)}
    return PointCloud.from_points(survey_points, rgb=rgb, attributes=values, name="plot")


@pytest.fixture
def write_pcd():
    """A writer of PCD files: write(path, columns, encoding). LZF with literal runs only."""

    def write(path: Path, columns: dict[str, np.ndarray], encoding: str = "binary", **changes: object) -> None:
        n = len(next(iter(columns.values())))
        kinds = {"f": "F", "i": "I", "u": "U"}
        lines = {
            "VERSION": ".7",
            "FIELDS": " ".join(columns),
            "SIZE": " ".join(str(c.dtype.itemsize) for c in columns.values()),
            "TYPE": " ".join(kinds[c.dtype.kind] for c in columns.values()),
            "COUNT": " ".join("1" for _ in columns),
            "WIDTH": n,
            "HEIGHT": 1,
            "VIEWPOINT": "0 0 0 1 0 0 0",
            "POINTS": n,
            "DATA": encoding,
        } | changes
        header = "".join(f"{key} {value}\n" for key, value in lines.items()).encode()
        if encoding == "ascii":
            body = (
                "\n".join(" ".join(repr(v.item()) for v in row) for row in zip(*columns.values(), strict=True)) + "\n"
            )
            data = body.encode()
        elif encoding == "binary":
            records = np.empty(n, [(name, c.dtype) for name, c in columns.items()])
            for name, column in columns.items():
                records[name] = column
            data = records.tobytes()
        else:
            raw = b"".join(column.tobytes() for column in columns.values())
            runs = [raw[i : i + 32] for i in range(0, len(raw), 32)]
            packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
            data = struct.pack("<II", len(packed), len(raw)) + packed
        path.write_bytes(header + data)

    return write
