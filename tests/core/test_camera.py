"""Cameras: known pixels, there and back, the limits of a lens, other sizes."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from dbh_studio.core.camera import CAMERA_KINDS, CameraModel

WIDTH, HEIGHT = 2000, 1200
RANGES = {
    "k": (-0.12, 0.1), "k1": (-0.12, 0.1), "k0": (-0.1, 0.1), "omega": (0.2, 1.1), "alpha": (0.05, 0.9),
    "beta": (0.6, 1.4), "transition": (0.0, 1.0), "b1": (-20.0, 20.0), "b2": (-20.0, 20.0),
}  # fmt: skip


def random_camera(kind: str, rng: np.random.Generator) -> CameraModel:
    """A camera of about 90 degrees with distortion as real lenses have it."""
    if kind == "EQUIRECTANGULAR":
        return CameraModel(kind, 2048, 1024, ())
    empty = CameraModel(kind, WIDTH, HEIGHT, defaults(kind))
    is_offset = kind.startswith("METASHAPE")
    values = []
    for name in empty.param_names:
        if name in ("f", "fx", "fy"):
            values.append(rng.uniform(950.0, 1400.0))
        elif name in ("cx", "cy"):
            middle = 0.0 if is_offset else (WIDTH if name == "cx" else HEIGHT) / 2.0
            values.append(middle + rng.uniform(-40.0, 40.0))
        else:
            low, high = RANGES.get(name, (-0.01, 0.01) if name[0] == "k" else (-0.002, 0.002))
            values.append(rng.uniform(low, high))
    return CameraModel(kind, WIDTH, HEIGHT, tuple(values))


def defaults(kind: str) -> tuple[float, ...]:
    from dbh_studio.core.camera_models.lenses import LENSES

    known = {"f": 1000.0, "fx": 1000.0, "fy": 1000.0, "beta": 1.0, "transition": 1.0, "w": 2000.0, "h": 1000.0}
    centre = {} if kind.startswith("METASHAPE") else {"cx": WIDTH / 2.0, "cy": HEIGHT / 2.0}
    return tuple({**known, **centre}.get(name, 0.0) for name in LENSES[kind].names)


def pixel_grid(camera: CameraModel) -> np.ndarray:
    u, v = np.meshgrid(np.linspace(0.5, camera.width_px - 0.5, 41), np.linspace(0.5, camera.height_px - 0.5, 31))
    return np.stack([u.ravel(), v.ravel()], axis=1)


@pytest.mark.parametrize("kind", CAMERA_KINDS)
def test_pixel_to_ray_and_back(kind):
    rng = np.random.default_rng(1)
    for _ in range(5):
        camera = random_camera(kind, rng)
        pixels = pixel_grid(camera)
        rays = camera.rays(pixels)
        exists = np.isfinite(rays).all(axis=1)
        assert exists.mean() > 0.95, "a lens of this range sees nearly all of its image"
        assert np.allclose(np.linalg.norm(rays[exists], axis=1), 1.0, atol=1e-14)
        distance = rng.uniform(0.1, 100.0, (exists.sum(), 1))
        back, is_visible = camera.project(rays[exists] * distance)
        assert is_visible.all()
        assert np.abs(back - pixels[exists]).max() < 1e-7


@pytest.mark.parametrize("kind", CAMERA_KINDS)
def test_the_axis_hits_the_principal_point(kind):
    camera = CameraModel(kind, 2000, 1000 if kind == "EQUIRECTANGULAR" else HEIGHT, defaults(kind))
    uv, is_visible = camera.project([[0.0, 0.0, 3.0]])
    assert np.allclose(uv, [[1000.0, camera.height_px / 2.0]], atol=1e-9)
    assert is_visible.all()
    assert np.allclose(camera.rays(uv), [[0.0, 0.0, 1.0]], atol=1e-12)


def test_panorama_has_the_documented_corners_and_directions():
    camera = CameraModel("EQUIRECTANGULAR", 2048, 1024, ())
    assert camera.is_panorama
    points = [[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, -1, 1e-12], [0, 1, 1e-12], [1, 0, 1]]
    uv, is_visible = camera.project(np.array(points, float))
    expected = [[1024, 512], [1536, 512], [512, 512], [1024, 0], [1024, 1024], [1280, 512]]
    assert np.allclose(uv, expected, atol=1e-6)
    assert is_visible.all()
    behind, is_visible = camera.project([[1e-9, 0.0, -1.0], [-1e-9, 0.0, -1.0]])
    assert np.allclose(behind[:, 0], [2048.0, 0.0], atol=1e-5) and is_visible.all()


def test_a_panorama_sees_everything_but_its_own_centre():
    camera = CameraModel("EQUIRECTANGULAR", 2048, 1024, ())
    directions = np.random.default_rng(0).normal(size=(1000, 3))
    uv, is_visible = camera.project(np.vstack([directions, np.zeros((1, 3))]))
    assert is_visible[:-1].all() and not is_visible[-1]
    assert np.isnan(uv[-1]).all()


def test_known_pixel_of_a_pinhole():
    camera = CameraModel("PINHOLE", 640, 480, (500.0, 600.0, 320.0, 240.0))
    uv, is_visible = camera.project([[0.2, -0.1, 2.0], [0.2, -0.1, -2.0], [10.0, 0.0, 2.0]])
    assert np.allclose(uv[0], [320.0 + 50.0, 240.0 - 30.0])
    assert np.isnan(uv[1]).all(), "nothing behind a perspective camera has an image"
    assert is_visible.tolist() == [True, False, False]


def test_fisheye_sees_behind_itself():
    camera = CameraModel("SIMPLE_FISHEYE", 2000, 2000, (500.0, 1000.0, 1000.0))
    angle = np.radians(100.0)
    uv, is_visible = camera.project([[np.sin(angle), 0.0, np.cos(angle)]])
    assert np.allclose(uv, [[1000.0 + 500.0 * angle, 1000.0]]) and is_visible.all()
    assert np.allclose(camera.rays(uv), [[np.sin(angle), 0.0, np.cos(angle)]], atol=1e-12)


def test_metashape_frame_follows_its_manual():
    """x' = x (1 + k1 r2 + …) + p1 (r2 + 2 x2) + 2 p2 x y; u = w / 2 + cx + x' f + x' b1 + y' b2."""
    f, cx, cy, k1, k2, k3, k4, p1, p2, p3, p4, b1, b2 = (
        1500.0, 3.0, -7.0, -0.05, 0.02, 0.003, -0.001, 0.001, -0.002, 0.01, 0.02, 4.0, -3.0,
    )  # fmt: skip
    camera = CameraModel("METASHAPE_FRAME", 2000, 1500, (f, cx, cy, k1, k2, k3, k4, p1, p2, p3, p4, b1, b2))
    x, y = 0.31, -0.22
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    more = 1 + p3 * r2 + p4 * r2**2
    xd = x * radial + (p1 * (r2 + 2 * x * x) + 2 * p2 * x * y) * more
    yd = y * radial + (p2 * (r2 + 2 * y * y) + 2 * p1 * x * y) * more
    uv, _ = camera.project([[2 * x, 2 * y, 2.0]])
    assert np.allclose(uv, [[1000.0 + cx + xd * f + xd * b1 + yd * b2, 750.0 + cy + yd * f]], atol=1e-9)


def test_equisolid_radius():
    params = (600.0,) + (0.0,) * 12
    camera = CameraModel("METASHAPE_EQUISOLID", 2000, 2000, params)
    angle = np.radians(70.0)
    uv, _ = camera.project([[np.sin(angle), 0.0, np.cos(angle)]])
    assert np.isclose(uv[0, 0], 1000.0 + 600.0 * 2.0 * np.sin(angle / 2.0))


@pytest.mark.parametrize("transition,radius", [(1.0, np.tan(0.7)), (0.0, 0.7), (0.25, 0.25 * np.tan(0.7) + 0.75 * 0.7)])
def test_dual_mixes_perspective_and_fisheye(transition, radius):
    camera = CameraModel("OPENSFM_DUAL", 2000, 2000, (800.0, 1000.0, 1000.0, 0.0, 0.0, transition))
    uv, _ = camera.project([[np.sin(0.7), 0.0, np.cos(0.7)]])
    assert np.isclose(uv[0, 0], 1000.0 + 800.0 * radius)


def test_points_beyond_the_fold_of_a_lens_are_not_seen():
    """With k = -0.3 the radius r (1 - 0.3 r2) turns back at r = 1.05; a point at r = 1.7 would land in the image."""
    camera = CameraModel("SIMPLE_RADIAL", 2000, 1500, (1000.0, 1000.0, 750.0, -0.3))
    fold = np.sqrt(1 / 0.9)
    inside, outside = 0.97 * fold, 1.7
    uv, is_visible = camera.project([[inside, 0.0, 1.0], [outside, 0.0, 1.0]])
    assert 0 < uv[1, 0] < 2000, "else the test shows nothing"
    assert is_visible.tolist() == [True, False]


def test_a_pixel_the_lens_cannot_reach_has_no_ray():
    camera = CameraModel("SIMPLE_RADIAL", 2000, 1500, (1000.0, 1000.0, 750.0, -0.3))
    reach = 1000.0 * np.sqrt(1 / 0.9) * (2.0 / 3.0)
    rays = camera.rays([[1000.0 + 0.98 * reach, 750.0], [1000.0 + 1.02 * reach, 750.0]])
    assert np.isfinite(rays[0]).all() and np.isnan(rays[1]).all()


def test_division_wide_angle_goes_beyond_ninety_degrees():
    camera = CameraModel("SIMPLE_DIVISION", 2000, 2000, (600.0, 1000.0, 1000.0, -0.5))
    rays = camera.rays([[1950.0, 1000.0]])
    assert rays[0, 2] < 0.0
    uv, is_visible = camera.project(rays)
    assert np.allclose(uv, [[1950.0, 1000.0]]) and is_visible.all()


@pytest.mark.parametrize("kind", CAMERA_KINDS)
def test_scaled_camera_sees_the_same_directions(kind):
    camera = random_camera(kind, np.random.default_rng(3))
    small = camera.scaled_to(camera.width_px // 4, camera.height_px // 4)
    pixels = pixel_grid(camera)
    a, b = camera.rays(pixels), small.rays(pixels / 4.0)
    assert np.allclose(a, b, atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("size", [(1000, 600), (667, 400), (333, 200), (4000, 2400), (1999, 1199)])
def test_resized_images_are_recognised(size):
    assert CameraModel("PINHOLE", WIDTH, HEIGHT, defaults("PINHOLE")).has_aspect_of(*size)


@pytest.mark.parametrize("size", [(1200, 2000), (1000, 620), (2000, 1190), (0, 0), (2000, 1125)])
def test_other_aspects_are_refused(size):
    camera = CameraModel("PINHOLE", WIDTH, HEIGHT, defaults("PINHOLE"))
    with pytest.raises(ValueError, match="no resized ones"):
        camera.scaled_to(*size)


@pytest.mark.parametrize(
    "arguments",
    [
        ("NIKON", 10, 10, (1.0,)),
        ("PINHOLE", 0, 10, (1.0, 1.0, 1.0, 1.0)),
        ("PINHOLE", 10, 10, (1.0, 1.0, 1.0)),
        ("PINHOLE", 10, 10, (-1.0, 1.0, 1.0, 1.0)),
        ("PINHOLE", 10, 10, (np.nan, 1.0, 1.0, 1.0)),
        ("SIMPLE_PINHOLE", 10, 10, (0.0, 1.0, 1.0)),
    ],
)
def test_bad_cameras_are_refused(arguments):
    with pytest.raises(ValueError, match=r"camera kind|pixels|parameter|positive"):
        CameraModel(*arguments)


@pytest.mark.parametrize("shape", [(3,), (2, 2), (1, 4)])
def test_bad_shapes_are_refused(shape):
    camera = CameraModel("PINHOLE", WIDTH, HEIGHT, defaults("PINHOLE"))
    with pytest.raises(ValueError, match="points_cam"):
        camera.project(np.zeros(shape))


def test_no_points_give_none():
    camera = CameraModel("OPENCV", WIDTH, HEIGHT, defaults("OPENCV"))
    uv, is_visible = camera.project(np.zeros((0, 3)))
    assert uv.shape == (0, 2) and is_visible.shape == (0,)
    assert camera.rays(np.zeros((0, 2))).shape == (0, 3)


def test_not_a_number_is_not_seen():
    for kind in CAMERA_KINDS:
        camera = random_camera(kind, np.random.default_rng(0))
        _, is_visible = camera.project([[np.nan, 0.0, 1.0]])
        assert not is_visible.any(), kind
        assert np.isnan(camera.rays([[np.nan, 1.0]])).all(), kind


@pytest.mark.parametrize("kind", ["OPENCV", "METASHAPE_FISHEYE", "EQUIRECTANGULAR"])
def test_a_used_camera_travels_to_another_process(kind):
    camera = random_camera(kind, np.random.default_rng(0))
    pixels = pixel_grid(camera)
    before = camera.rays(pixels)
    assert np.array_equal(pickle.loads(pickle.dumps(camera)).rays(pixels), before, equal_nan=True)


def test_chunks_do_not_show():
    camera = random_camera("OPENCV", np.random.default_rng(0))
    pixels = np.random.default_rng(1).uniform(0, [WIDTH, HEIGHT], (300_000, 2))
    rays = camera.rays(pixels)
    assert np.array_equal(rays[-5:], camera.rays(pixels[-5:]))
    assert np.array_equal(rays[:5], camera.rays(pixels[:5]))
