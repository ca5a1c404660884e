"""Picking on scenes whose answer is known: trunks near and far, noise, gaps, and what lies behind the camera."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dbh_studio.core import picking
from dbh_studio.core.picking import PickCloud, View, plane_through, ray_plane

GROUND, NEAR, FAR = 0, 1, 2
CENTRES = {NEAR: np.array([0.0, 3.0]), FAR: np.array([4.0, 20.0])}
RADIUS_M = 0.15


def forest(n: int, *, seed: int = 0, unit: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Flat ground 60 m wide and two trunks of 0.3 m seen from the origin side; float32 points and their labels."""
    rng = np.random.default_rng(seed)
    n_trunk = n // 4
    ground = np.column_stack([rng.uniform(-30, 30, (n - 2 * n_trunk, 2)), rng.normal(0, 0.01, n - 2 * n_trunk)])
    parts, labels = [ground], [np.full(len(ground), GROUND)]
    for label, centre in CENTRES.items():
        angle, height = rng.uniform(0, 2 * np.pi, n_trunk), rng.uniform(0, 6, n_trunk)
        ring = centre + RADIUS_M * np.column_stack([np.cos(angle), np.sin(angle)])
        parts.append(np.column_stack([ring, height]))
        labels.append(np.full(n_trunk, label))
    order = rng.permutation(n)
    return (np.concatenate(parts) * unit).astype(np.float32)[order], np.concatenate(labels)[order]


def label_at(cloud: PickCloud, labels: np.ndarray, view: View, target: np.ndarray) -> int | None:
    """What a click at the place where `target` is drawn selects, by vote over the surface."""
    screen = view.project(np.asarray(target, float)[None])[0]
    hit = cloud.pick(view.origin, view.ray(screen), view.pixel_angle_rad)
    return None if hit is None else int(np.bincount(labels[hit.surface]).argmax())


@pytest.mark.parametrize("unit", [1.0, 0.01, 1000.0], ids=["metres", "small unit", "large unit"])
@pytest.mark.parametrize("n", [20_000, 100_000, 400_000])
def test_clicks_on_trunks_select_them_near_and_far_in_any_unit(n: int, unit: float) -> None:
    xyz, labels = forest(n, unit=unit)
    cloud = PickCloud(xyz)
    view = View.looking_at([0, 0, 1.6 * unit], [0.3 * unit, 8 * unit, 1.5 * unit], fov_rad=1.2)
    for label, centre in CENTRES.items():
        for height in (1.0, 1.3, 2.0):
            assert label_at(cloud, labels, view, np.array([*centre, height]) * unit) == label, (label, height)


def test_a_click_on_the_ground_and_one_into_the_sky() -> None:
    xyz, labels = forest(200_000)
    cloud = PickCloud(xyz)
    view = View.looking_at([0, -5, 3], [0, 8, 1])
    assert label_at(cloud, labels, view, np.array([-3.0, 5.0, 0.0])) == GROUND
    assert cloud.pick(view.origin, [0.0, 0.2, 1.0], view.pixel_angle_rad) is None


def test_a_ray_between_the_samples_of_a_close_trunk_does_not_reach_the_ground_behind() -> None:
    """3 cm between samples and a cone of millimetres: only the spacing keeps the trunk closed."""
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 32, endpoint=False), np.arange(0, 3, 0.03))
    trunk = np.column_stack([0.15 * np.cos(angle.ravel()), 3 + 0.15 * np.sin(angle.ravel()), height.ravel()])
    x, y = np.meshgrid(np.arange(-10, 10, 0.03), np.arange(4, 24, 0.03))
    ground = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    cloud = PickCloud(np.concatenate([trunk, ground]))
    assert cloud.spacing == pytest.approx(0.03, rel=0.1)
    view = View.looking_at([0, 0, 1.6], [0, 3, 0.8])
    for target in trunk[(trunk[:, 1] < 3) & (trunk[:, 2] > 0.5) & (trunk[:, 2] < 1.4)] + [0.013, 0, 0.015]:
        hit = cloud.pick(view.origin, target - view.origin, view.pixel_angle_rad, radius_px=1.0)
        assert hit is not None and hit.index < len(trunk) and (hit.surface < len(trunk)).all()


def test_a_floating_point_does_not_steal_the_click() -> None:
    xyz, labels = forest(100_000)
    target = np.array([*CENTRES[FAR], 1.3])
    view = View.looking_at([0, 0, 1.6], target)
    noise = view.origin + 0.3 * (target - view.origin)
    cloud = PickCloud(np.concatenate([xyz, noise[None].astype(np.float32)]))
    hit = cloud.pick(view.origin, target - view.origin, view.pixel_angle_rad)
    assert hit is not None and hit.index != len(xyz) and labels[hit.index] == FAR
    alone = cloud.pick(view.origin, target - view.origin, view.pixel_angle_rad, min_support=1)
    assert alone is not None and alone.index == len(xyz)


def test_the_point_nearest_to_the_ray_is_named_with_its_distances() -> None:
    grid = (
        np.stack(np.meshgrid(np.arange(-5, 6), [10], np.arange(-5, 6), indexing="ij"), -1).reshape(-1, 3).astype(float)
    )
    hit = PickCloud(grid).pick(np.zeros(3), np.array([0.21, 2.0, 0.0]), 1e-3)
    assert hit is not None
    np.testing.assert_array_equal(grid[hit.index], [1, 10, 0])
    direction = np.array([0.21, 2.0, 0.0]) / np.hypot(0.21, 2.0)
    assert hit.depth == pytest.approx(grid[hit.index] @ direction, rel=1e-5)
    assert hit.offset == pytest.approx(np.linalg.norm(np.cross(grid[hit.index], direction)), rel=1e-4)
    assert hit.index in hit.surface and not hit.surface.flags.writeable


def test_what_is_behind_the_camera_is_never_picked() -> None:
    xyz, _ = forest(50_000)
    cloud = PickCloud(xyz)
    view = View.looking_at([0, 40, 1.6], [0, 80, 1.6])
    assert cloud.pick(view.origin, view.ray((0.5, 0.5)), view.pixel_angle_rad) is None
    assert len(cloud.rectangle(view, (0, 0), (1, 1))) == 0
    assert len(cloud.lasso(view, np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]))) == 0
    assert np.isnan(view.project(xyz[:5])).all()


@pytest.mark.parametrize("n", [0, 1, 2])
def test_clouds_of_next_to_nothing(n: int) -> None:
    cloud = PickCloud(np.array([[0.0, 5.0, 0.0], [0.0, 5.0, 0.1]])[:n].reshape(-1, 3))
    view = View.looking_at([0, 0, 0], [0, 1, 0])
    hit = cloud.pick(view.origin, [0, 1, 0], view.pixel_angle_rad)
    assert (hit is None) if n == 0 else (hit is not None and hit.index == 0)
    assert len(cloud) == n == len(cloud.rectangle(view, (0.4, 0.4), (0.6, 0.6)))
    assert len(cloud.lasso(view, [[0.4, 0.4], [0.6, 0.4], [0.6, 0.6], [0.4, 0.6]])) == n


def test_identical_and_unusable_points_do_no_harm() -> None:
    same = PickCloud(np.ones((100, 3)))
    assert same.spacing == 0.0
    hit = same.pick(np.zeros(3), np.ones(3), 1e-3)
    assert hit is not None and len(hit.surface) == 100
    xyz, labels = forest(40_000)
    broken = xyz.copy()
    broken[::50] = np.nan
    broken[7] = np.inf
    cloud = PickCloud(broken)
    assert cloud.spacing == pytest.approx(PickCloud(xyz).spacing, rel=0.5)
    view = View.looking_at([0, 0, 1.6], [0, 3, 1.3])
    hit = cloud.pick(view.origin, view.ray((0.5, 0.5)), view.pixel_angle_rad)
    assert hit is not None and labels[hit.index] == NEAR
    chosen = cloud.rectangle(view, (0, 0), (1, 1))
    assert len(chosen) and np.isfinite(broken[chosen]).all()


@pytest.mark.parametrize("n", [1_000, 50_000])
@pytest.mark.parametrize("step", [0.002, 0.5])
def test_spacing_of_a_regular_sheet_is_its_step(n: int, step: float) -> None:
    side = int(n**0.5)
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    sheet = np.column_stack([x.ravel(), y.ravel(), 0.3 * x.ravel()]) * step
    assert PickCloud(sheet).spacing == pytest.approx(step, rel=0.05)
    assert PickCloud(np.repeat(sheet, 3, axis=0)).spacing == pytest.approx(step, rel=0.05)  # duplicates do not count


# -- regions --------------------------------------------------------------------------------------------------------


def brute_inside(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """Even-odd rule, one point at a time against one edge at a time."""
    inside = np.zeros(len(points), bool)
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if a[1] != b[1]:
            spans = (a[1] > points[:, 1]) != (b[1] > points[:, 1])
            inside ^= spans & (points[:, 0] < a[0] + (points[:, 1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0]))
    return inside


def test_a_rectangle_takes_exactly_what_projects_into_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(picking, "_CHUNK", 1000)  # pieces must not show
    xyz, _ = forest(20_000)
    view = View.looking_at([2, -4, 3], [0, 8, 1], aspect=1.9, fov_rad=0.9)
    screen = view.project(xyz)
    low, high = np.array([0.3, 0.45]), np.array([0.61, 0.8])
    expected = np.flatnonzero(((screen >= low) & (screen <= high)).all(axis=1))
    assert 100 < len(expected) < len(xyz)
    cloud = PickCloud(xyz)
    # float32 decides differently on the very edge only
    assert len(np.setxor1d(cloud.rectangle(view, low, high), expected)) <= 1e-4 * len(xyz)
    np.testing.assert_array_equal(cloud.rectangle(view, high, low), cloud.rectangle(view, low, high))


@settings(max_examples=25, deadline=None)
@given(st.integers(3, 12), st.integers(0, 2**31))
def test_a_lasso_takes_what_is_inside_its_polygon(n_corners: int, seed: int) -> None:
    """Any polygon, self-crossing too, against the even-odd rule; within 1/500 of its size of an edge both will do."""
    rng = np.random.default_rng(seed)
    polygon = rng.uniform(0.1, 0.9, (n_corners, 2))
    screen = rng.uniform(0, 1, (4000, 2))
    view = View.looking_at([0, 0, 0], [0, 1, 0])
    depth = rng.uniform(1, 50, (4000, 1))
    forward = view.rotation[2]
    points = np.array([view.ray(xy) for xy in screen])
    points *= depth / (points @ forward)[:, None]
    got = np.zeros(4000, bool)
    got[PickCloud(points).lasso(view, polygon)] = True
    tolerance = np.ptp(polygon, axis=0).max() / 500
    differ = screen[got != brute_inside(screen, polygon)]
    assert (_edge_distance(differ, polygon) <= tolerance).all()


def _edge_distance(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    a, edge = polygon, np.roll(polygon, -1, axis=0) - polygon
    along = np.clip(((points[:, None] - a) * edge).sum(-1) / (edge**2).sum(-1), 0, 1)
    return np.linalg.norm(points[:, None] - a - along[..., None] * edge, axis=-1).min(axis=1, initial=np.inf)


def test_a_lasso_beyond_the_screen_is_cut_at_nothing() -> None:
    xyz, _ = forest(5_000)
    view = View.looking_at([2, -40, 30], [0, 8, 1])
    everything = PickCloud(xyz).lasso(view, [[-9, -9], [9, -9], [9, 9], [-9, 9.0]])
    np.testing.assert_array_equal(everything, np.arange(5_000))


@pytest.mark.parametrize("polygon", [np.empty((0, 2)), [[0.1, 0.1], [0.9, 0.9]], [[0.5, 0.1], [0.5, 0.9], [0.5, 0.3]]])
def test_a_lasso_without_area_takes_nothing(polygon: list[list[float]]) -> None:
    xyz, _ = forest(2_000)
    assert len(PickCloud(xyz).lasso(View.looking_at([0, -5, 2], [0, 5, 1]), polygon)) == 0


# -- the camera -----------------------------------------------------------------------------------------------------


def test_a_view_by_hand() -> None:
    """From (0, -2, 0) along +y with z up: x is right, z is up, so screen y falls as z rises. tan(fov/2) = 1/2."""
    view = View.looking_at([0, -2, 0], [0, 5, 0], fov_rad=2 * np.arctan(0.5), aspect=2.0, height_px=100)
    np.testing.assert_allclose(view.rotation, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(
        view.project(np.array([[0.0, 0, 0], [2, 0, 1], [-1, 0, -0.5]])), [[0.5, 0.5], [1, 0], [0.25, 0.75]], atol=1e-12
    )
    assert view.pixel_angle_rad == pytest.approx(0.01)


@given(st.floats(0, 1), st.floats(0, 1), st.floats(0.2, 2.5), st.floats(0.3, 4))
def test_rays_and_projection_are_inverse(x: float, y: float, fov_rad: float, aspect: float) -> None:
    view = View.looking_at([3, -4, 2], [-1, 7, 0.5], fov_rad=fov_rad, aspect=aspect)
    np.testing.assert_allclose(view.project((view.origin + 7 * view.ray((x, y)))[None])[0], [x, y], atol=1e-9)


@pytest.mark.parametrize(
    "change", [{"fov_rad": 0.0}, {"fov_rad": 3.2}, {"aspect": 0.0}, {"height_px": 0}, {"fov_rad": np.nan}]
)
def test_impossible_views_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="no view"):
        View.looking_at([0, 0, 0], [0, 1, 0], **change)  # type: ignore[arg-type]


def test_bad_calls() -> None:
    cloud = PickCloud(np.zeros((3, 3)))
    with pytest.raises(ValueError, match="no direction"):
        cloud.pick(np.zeros(3), np.zeros(3), 1e-3)
    with pytest.raises(ValueError, match="xyz has shape"):
        PickCloud(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="line of sight"):
        View.looking_at([0, 0, 5], [0, 0, 0])
    with pytest.raises(ValueError, match="not finite"):
        cloud.lasso(View.looking_at([0, 0, 0], [0, 1, 0]), [[0, 0], [np.nan, 0], [0, 1]])


# -- planes ---------------------------------------------------------------------------------------------------------


def test_a_click_beside_the_samples_of_a_marker_lands_on_its_plane() -> None:
    rng = np.random.default_rng(1)
    true_normal = np.array([0.1, -1.0, 0.2]) / np.linalg.norm([0.1, -1.0, 0.2])
    u = np.cross(true_normal, [0, 0, 1.0])
    u /= np.linalg.norm(u)
    v = np.cross(true_normal, u)
    uv = rng.uniform(-0.1, 0.1, (500, 2))
    noise_m = 0.001
    points = np.array([1.0, 4.0, 1.0]) + uv @ [u, v] + rng.normal(0, noise_m, (500, 1)) * true_normal
    centre, normal = plane_through(points)
    # Slope error of a fitted plane: noise / (spread * sqrt(n)); five of them.
    assert abs(normal @ true_normal) > np.cos(5 * noise_m / (0.1 / np.sqrt(3) * np.sqrt(500)))
    corner = np.array([1.0, 4.0, 1.0]) + 0.08 * u - 0.05 * v
    landed = ray_plane([0, 0, 1.5], corner - [0, 0, 1.5], centre, normal)
    assert landed is not None and np.linalg.norm(landed - corner) < 0.3 * noise_m


def test_rays_that_miss_a_plane() -> None:
    centre, normal = np.zeros(3), np.array([0.0, 0, 1])
    assert ray_plane([0, 0, 1], [1, 0, 0], centre, normal) is None
    assert ray_plane([0, 0, 1], [0, 0, 1], centre, normal) is None


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.zeros((2, 3)), np.outer(np.arange(9.0), [1, 2, 3])])
def test_points_without_a_plane(points: np.ndarray) -> None:
    with pytest.raises(ValueError, match="not on a line"):
        plane_through(points)
