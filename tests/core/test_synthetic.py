"""The plot generator: what it says of its trees must be true of its points."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from dbh_studio.core.synthetic import PlotRecipe, make_plot
from dbh_studio.core.synthetic.capture import draw_cells, visibility
from dbh_studio.core.synthetic.fields import WaveField
from dbh_studio.errors import CancelledError, SettingError

EXACT = PlotRecipe.simple(n_trees=3, points=400_000, noise=0.0, understorey=0.0, ground=0.1, seed=7)


@pytest.fixture(scope="module")
def exact():
    return make_plot(EXACT)


@pytest.fixture(scope="module")
def walked():
    recipe = PlotRecipe(
        n_trees=9, n_twins=1, n_hidden=1, n_thin=1, n_big=1, n_logs=1, side_m=16, points=150_000, lane_m=8, seed=5
    )
    return make_plot(recipe)


def stem_points(plot, tree):
    return plot.cloud.xyz[plot.tree_ids == tree.tree_id].astype(np.float64) + plot.cloud.origin


def across_axis(points, tree, *, low=1.2, high=1.4):
    """Section coordinates about the true axis of the points in a band of height."""
    lean, azimuth = np.radians([tree.lean_deg, tree.lean_azimuth_deg])
    w = np.array([np.sin(lean) * np.sin(azimuth), np.sin(lean) * np.cos(azimuth), np.cos(lean)])
    u = np.array([1.0, 0.0, 0.0]) - w[0] * w
    u /= np.linalg.norm(u)
    v = np.cross(w, u)
    from_centre = points - [tree.x_m, tree.y_m, tree.z_ground_m + 1.3]
    along = from_centre @ w
    band = (along > low - 1.3) & (along < high - 1.3)
    return np.stack([from_centre[band] @ u, from_centre[band] @ v], axis=1)


def test_same_recipe_same_bytes_and_another_seed_another_plot():
    recipe = PlotRecipe.simple(n_trees=2, points=5000, crowns=0.5, capture="walk", n_logs=1)
    first, second = make_plot(recipe), make_plot(recipe)
    assert first.cloud.xyz.tobytes() == second.cloud.xyz.tobytes()
    assert first.cloud.rgb.tobytes() == second.cloud.rgb.tobytes()
    assert first.tree_ids.tobytes() == second.tree_ids.tobytes()
    assert make_plot(recipe.changed(seed=2)).cloud.xyz.tobytes() != first.cloud.xyz.tobytes()


def test_a_round_stem_has_one_diameter_by_every_definition():
    plot = make_plot(EXACT.changed(irregularity=0.0, points=2000, dbh_min_cm=30.0, dbh_max_cm=30.0))
    for tree in plot.trees:
        for definition in ("tape", "curve", "area"):
            assert tree.diameter_cm(definition) == pytest.approx(30.0, rel=1e-5)


def test_tape_is_never_below_the_circle_of_equal_area(walked):
    for tree in walked.trees:
        assert (tree.tape_cm > tree.area_cm).all()
        assert (tree.curve_cm >= tree.area_cm).all()


def test_hull_of_noise_free_points_is_the_tape_truth(exact):
    for tree in exact.trees:
        # A thin band: the bark's ridges break off and begin anew, so the hull of a high band is wider than any section.
        section = across_axis(stem_points(exact, tree), tree, low=1.285, high=1.315)
        assert len(section) > 150
        assert 100 * ConvexHull(section).area / np.pi == pytest.approx(tree.diameter_cm("tape"), rel=0.01)


def test_mean_radius_of_noise_free_points_is_the_area_truth(exact):
    for tree in exact.trees:
        section = across_axis(stem_points(exact, tree), tree)
        angle = np.arctan2(section[:, 1], section[:, 0])
        sector = ((angle + np.pi) / (2 * np.pi) * 60).astype(int) % 60
        squared = np.bincount(sector, np.sum(section**2, axis=1), 60) / np.maximum(np.bincount(sector, minlength=60), 1)
        assert (np.bincount(sector, minlength=60) > 0).all()
        assert 200 * np.sqrt(squared.mean()) == pytest.approx(tree.diameter_cm("area"), rel=0.005)


def test_lean_and_position_are_those_of_the_points(exact):
    for tree in exact.trees:
        points = stem_points(exact, tree)
        height = points[:, 2] - tree.z_ground_m
        middles = []
        for level in (0.8, 1.8):
            ring = points[np.abs(height - level) < 0.1]
            hull = ring[ConvexHull(ring[:, :2]).vertices]
            middles.append((hull.max(axis=0) + hull.min(axis=0)) / 2)
        along = middles[1] - middles[0]
        lean = np.degrees(np.arctan2(np.hypot(along[0], along[1]), 1.0))
        assert lean == pytest.approx(tree.lean_deg, abs=0.8)
        middle = (middles[0] + middles[1]) / 2
        assert np.hypot(middle[0] - tree.x_m, middle[1] - tree.y_m) < 0.012


def test_ground_truth_is_the_ground_around_the_stem(exact):
    floor = exact.cloud.xyz[exact.tree_ids == 0].astype(np.float64)
    for tree in exact.trees:
        away = np.hypot(floor[:, 0] - tree.x_m, floor[:, 1] - tree.y_m)
        ring = np.abs(away - tree.diameter_cm("area") / 200 - 0.10) < 0.06
        assert ring.sum() > 20
        assert floor[ring, 2].mean() == pytest.approx(tree.z_ground_m, abs=0.04)


def test_noise_thickens_the_ring_in_proportion(exact):
    def thickness(plot):
        tree = plot.trees[0]
        section = across_axis(stem_points(plot, tree), tree)
        angle = np.arctan2(section[:, 1], section[:, 0])
        radius = np.hypot(section[:, 0], section[:, 1])
        sector = ((angle + np.pi) / (2 * np.pi) * 90).astype(int) % 90
        middle = np.array([np.median(radius[sector == s]) if (sector == s).any() else 0.0 for s in range(90)])
        return np.median(np.abs(radius - middle[sector]))

    little, much = (make_plot(EXACT.changed(noise=level)) for level in (2.0, 6.0))
    assert thickness(little) > 1.3 * thickness(exact)
    assert thickness(much) > 2.0 * thickness(little)


def test_a_hidden_stem_shows_too_little_and_the_others_enough(walked):
    hidden = walked.trees[2]
    assert hidden.seen_arc_deg < 75
    assert hidden.n_points_band > 0
    others = [tree.seen_arc_deg for tree in walked.trees if tree is not hidden]
    assert min(others) > 120


def test_seen_arc_is_that_of_the_points(exact):
    sparse = make_plot(EXACT.changed(capture="walk", side_m=20.0, lane_m=20.0, noise=0.0, seed=9))
    for plot in (exact, sparse):
        for tree in plot.trees:
            section = across_axis(stem_points(plot, tree), tree, low=1.22, high=1.52)
            angle = np.arctan2(section[:, 1], section[:, 0])
            seen = len(np.unique(((angle + np.pi) / (2 * np.pi) * 72).astype(int) % 72)) * 5
            assert abs(seen - tree.seen_arc_deg) <= 15
    assert any(tree.seen_arc_deg < 330 for tree in sparse.trees)


def test_twins_share_a_base_and_are_apart_at_breast_height(walked):
    one, other = walked.trees[:2]
    assert one.status == other.status == "twin"
    assert one.z_ground_m == pytest.approx(other.z_ground_m, abs=0.02)
    apart = np.hypot(one.x_m - other.x_m, one.y_m - other.y_m)
    assert (one.diameter_cm() + other.diameter_cm()) / 200 < apart < 2.0


def test_kinds_of_stems_are_as_ordered(walked):
    diameters = [tree.diameter_cm("area") for tree in walked.trees]
    assert len(diameters) == 9
    assert 59 < diameters[3] < 92
    assert 7.5 < diameters[4] < 12.5


def test_cloud_is_coloured_whole_and_does_not_give_the_truth_away(walked):
    assert len(walked.cloud) == pytest.approx(150_000, rel=0.1)
    assert np.isfinite(walked.cloud.xyz).all()
    assert walked.cloud.rgb is not None and walked.cloud.rgb.std() > 10
    assert not walked.cloud.attributes
    assert set(np.unique(walked.tree_ids)) == set(range(10))
    # The order must not sort the points by tree.
    assert (np.diff(walked.tree_ids) != 0).sum() > 1000
    for tree in walked.trees:
        # Those of a stem that the noise sent flying keep its id.
        assert (walked.tree_ids == tree.tree_id).sum() == tree.n_points


def test_the_walk_keeps_out_of_the_stems(walked):
    for tree in walked.trees:
        away = np.hypot(walked.cameras_m[:, 0] - tree.x_m, walked.cameras_m[:, 1] - tree.y_m)
        assert away.min() > tree.diameter_cm() / 200


@pytest.mark.parametrize("capture", ["walk", "all_round"])
@pytest.mark.parametrize(
    "absent",
    [{"n_trees": 0}, {"ground": 0.0}, {"understorey": 0.0, "crowns": 0.0}, {"slope_deg": 0.0, "relief_m": 0.0}],
)
def test_any_part_may_be_absent(absent, capture):
    plot = make_plot(PlotRecipe.simple(points=6000, crowns=0.3, capture=capture).changed(**absent))
    assert len(plot.cloud) == pytest.approx(6000, rel=0.15)
    assert len(plot.trees) == absent.get("n_trees", 5)


def test_a_patch_is_seen_from_the_side_it_faces_and_not_through_a_stem():
    points = np.array([[0.0, 0.0, 1.5], [0.0, 0.0, 1.5], [0.0, 0.0, 1.5]])
    normals = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0]])
    cameras = np.array([[4.0, 0.1, 1.5], [4.0, -0.1, 1.5]])
    free = visibility(points, normals, cameras, np.zeros((0, 3)))
    assert free.weight[0] > 0.2
    assert free.weight[1] == free.weight[2] == 0
    assert set(free.cameras[0]) == {0, 1}
    behind = visibility(points, normals, cameras, np.array([[2.0, 0.0, 0.3]]))
    assert behind.weight[0] == 0
    beside = visibility(points, normals, cameras, np.array([[2.0, 1.0, 0.3]]))
    assert beside.weight[0] == free.weight[0]
    assert visibility(points, normals, cameras[:1], np.zeros((0, 3))).weight[0] == 0  # one view is no match


def test_nearer_cameras_give_denser_points():
    def weight(distance):
        cameras = np.array([[distance, 0.2, 1.5], [distance, -0.2, 1.5]])
        return visibility(np.array([[0.0, 0.0, 1.5]]), np.array([[1.0, 0, 0]]), cameras, np.zeros((0, 3))).weight[0]

    assert weight(3.0) > 3 * weight(9.0) > 0


def test_cells_are_drawn_by_weight():
    drawn = draw_cells(np.random.default_rng(0), np.array([0.0, 1.0, 3.0]), 40_000)
    counts = np.bincount(drawn, minlength=3)
    assert counts[0] == 0
    assert counts[2] / counts[1] == pytest.approx(3, rel=0.05)
    assert counts.sum() == pytest.approx(40_000, rel=0.03)
    assert len(draw_cells(np.random.default_rng(0), np.zeros(3), 100)) == 0


def test_a_field_has_its_amplitude_and_is_smooth():
    rng = np.random.default_rng(3)
    field = WaveField.random(rng, n_dims=2, wavelengths_m=(1.0, 2.0), amplitude=0.5, n_waves=30)
    points = rng.uniform(0, 200, (20_000, 2))
    values = field(points)
    assert values.std() == pytest.approx(0.5, rel=0.05)
    assert np.abs(field(points + 0.005) - values).max() < 0.1


def test_truth_between_heights_and_bad_questions(exact):
    tree = exact.trees[0]
    assert tree.diameter_cm(height_m=1.37) < tree.diameter_cm(height_m=1.0)
    with pytest.raises(ValueError, match="definition 'girth'"):
        tree.diameter_cm("girth")
    with pytest.raises(ValueError, match="height 9"):
        tree.diameter_cm(height_m=9)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"n_tree": 3}, "n_tree is not known"),
        ({"points": 10}, "points is 10"),
        ({"slope_deg": float("nan")}, "slope_deg is nan"),
        ({"seed": "one"}, "seed is 'one'"),
        ({"n_trees": 2.5}, "n_trees must be a whole number"),
        ({"capture": "drone"}, "capture is 'drone'"),
        ({"n_trees": 3, "n_twins": 2}, "more thin, big, twin and hidden"),
        ({"dbh_min_cm": 50.0, "dbh_max_cm": 40.0}, "dbh_min_cm is larger"),
    ],
)
def test_a_bad_recipe_is_refused_by_name(values, message):
    with pytest.raises(SettingError, match=message):
        PlotRecipe.from_dict(values)


def test_a_recipe_survives_plain_values():
    recipe = PlotRecipe.simple(seed=12, n_logs=2)
    assert PlotRecipe.from_dict(recipe.to_dict()) == recipe


def test_progress_rises_and_can_stop_the_work():
    seen: list[float] = []
    make_plot(PlotRecipe.simple(points=3000), progress=lambda fraction, message="": seen.append(fraction))
    assert seen == sorted(seen)
    assert seen[0] == 0.0 and seen[-1] <= 1.0

    def stop(fraction, message=""):
        if fraction > 0.3:
            raise CancelledError

    with pytest.raises(CancelledError):
        make_plot(PlotRecipe.simple(points=3000), progress=stop)
