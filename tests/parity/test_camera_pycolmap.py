"""Pixels and rays equal pycolmap's, for every camera model it knows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.camera_models.lenses import LENSES

pytestmark = pytest.mark.parity
WIDTH, HEIGHT = 2000, 1200
MODELS = [kind for kind in LENSES if not kind.startswith(("METASHAPE", "OPENSFM"))]
RANGES = {
    "k": (-0.1, 0.1), "k1": (-0.1, 0.1), "k0": (-0.1, 0.1), "omega": (0.2, 1.2), "alpha": (0.0, 0.9),
    "beta": (0.5, 1.5),
}  # fmt: skip


@pytest.fixture(scope="module")
def pycolmap() -> Any:
    return pytest.importorskip("pycolmap", reason="pycolmap is not installed")


def _pair(pycolmap: Any, kind: str, rng: np.random.Generator) -> tuple[CameraModel, Any]:
    theirs = pycolmap.Camera.create_from_model_name(1, kind, rng.uniform(900, 1500), WIDTH, HEIGHT)
    params = np.array(theirs.params)
    for index, name in enumerate(LENSES[kind].names):
        if name in ("cx", "cy"):
            params[index] += rng.uniform(-40, 40)
        elif name == "fy":
            params[index] *= rng.uniform(0.95, 1.05)
        elif name not in ("f", "fx", "w", "h"):
            low, high = RANGES.get(name, (-0.01, 0.01) if name[0] == "k" else (-0.002, 0.002))
            params[index] = rng.uniform(low, high)
    theirs.params = params
    return CameraModel(kind, WIDTH, HEIGHT, tuple(params)), theirs


def test_no_model_is_left_out(pycolmap: Any) -> None:
    if tuple(int(part) for part in pycolmap.__version__.split(".")[:2]) < (4, 2):
        pytest.skip("an older pycolmap knows fewer models")
    known = set(pycolmap.CameraModelId.__members__) - {"INVALID"}
    assert known == set(MODELS)
    for kind in known:
        info = pycolmap.Camera.create_from_model_name(1, kind, 100.0, 10, 10).params_info
        assert tuple(part.strip() for part in info.split(",")) == LENSES[kind].names


@pytest.mark.parametrize("kind", MODELS)
def test_same_pixels_and_rays(pycolmap: Any, kind: str) -> None:
    if kind not in pycolmap.CameraModelId.__members__:
        pytest.skip(f"this pycolmap does not know {kind}")
    rng = np.random.default_rng(11)
    for _ in range(10):
        ours, theirs = _pair(pycolmap, kind, rng)
        points = rng.normal(size=(2000, 3)) * rng.uniform(0.5, 50, (2000, 1))
        if kind != "EQUIRECTANGULAR":
            points[:, 2] = np.abs(points[:, 2]) + 0.2
        pixels, is_visible = ours.project(points)
        assert is_visible.sum() > 200
        expected = theirs.img_from_cam(points)
        assert np.abs(pixels - expected)[is_visible].max() < 1e-6

        seen = rng.uniform(0, [WIDTH, HEIGHT], (1000, 2))
        rays = ours.rays(seen)
        exists = np.isfinite(rays).all(axis=1)
        assert exists.mean() > 0.75
        in_front = exists & (rays[:, 2] > 0.05)
        # Their own inverse stops a little earlier than ours, so it is asked in pixels too.
        assert np.abs(theirs.img_from_cam(rays[in_front]) - seen[in_front]).max() < 1e-6
        plane = theirs.cam_from_img(seen)
        both = in_front & np.isfinite(plane).all(axis=1)
        assert both.sum() > 200
        assert np.abs(rays[both, :2] / rays[both, 2:] - plane[both]).max() < 1e-6
