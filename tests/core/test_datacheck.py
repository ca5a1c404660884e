from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.datacheck import check_cloud
from dbh_studio.core.reconstruction import Provenance
from dbh_studio.core.stemcheck import low_surface, stem_evidence
from dbh_studio.core.transforms import UP_AXES, rotation_to_z_up
from dbh_studio.core.updirection import axis_vector, estimate_up, nearest_axis, rotation_from_up

SHARED = Path(__file__).parents[2].parent / "shared" / "data"
LAS, PLY = Provenance("las"), Provenance("ply")


def make_forest(seed=0, *, ground=True, crowns=True, slope=0.15, n_stems=9, radius=0.15, noise=0.004):
    """(N, 3) metres, +z up: a sloping ground with noise, upright cylinders on a grid, ball-shaped crowns."""
    rng = np.random.default_rng(seed)
    parts = []
    if ground:
        xy = rng.uniform(0, 20, (20_000, 2))
        parts.append(np.column_stack([xy, slope * xy[:, 0] + rng.normal(0, 0.02, 20_000)]))
    for i in range(n_stems):
        x, y = 4 + 6 * (i % 3) + rng.uniform(-1, 1), 4 + 6 * (i // 3) + rng.uniform(-1, 1)
        angle, z = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(0, 10, 3000)
        r = radius + rng.normal(0, noise, 3000)
        parts.append(np.column_stack([x + r * np.cos(angle), y + r * np.sin(angle), slope * x + z]))
        if crowns:
            ball = rng.normal(size=(2000, 3))
            ball *= (2.0 * rng.uniform(0, 1, 2000) ** (1 / 3) / np.linalg.norm(ball, axis=1))[:, None]
            parts.append(ball + np.array([x, y, slope * x + 11]))
    return np.vstack(parts)


def _cloud(points, **others):
    return PointCloud.from_points(points, **others)


def _angle_deg(a, b):
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


def _random_rotation(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.linalg.det(q)


# --- up -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", UP_AXES)
@pytest.mark.parametrize("ground", [True, False])
def test_every_axis_is_recognised(axis, ground):
    points = make_forest(ground=ground) @ rotation_to_z_up(axis)  # R.T applied to rows: +z becomes the axis.
    up = estimate_up(points)
    assert up.axis == axis
    assert _angle_deg(up.direction, axis_vector(axis)) < 2.0
    assert up.has_ground is ground


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("ground", [True, False])
def test_any_direction_is_recognised(seed, ground):
    turn = _random_rotation(seed)
    up = estimate_up(make_forest(seed, ground=ground) @ turn.T)
    assert _angle_deg(up.direction, turn @ [0, 0, 1.0]) < 2.0
    assert up.confidence > 0.15


def test_stems_not_the_slope_define_up():
    up = estimate_up(make_forest(slope=0.4))
    assert _angle_deg(up.direction, np.array([0, 0, 1.0])) < 2.0


def test_the_scale_does_not_matter():
    points = make_forest()
    for scale in (0.01, 1000.0):
        assert _angle_deg(estimate_up(points * scale).direction, estimate_up(points).direction) < 0.5


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_rotation_from_up_levels_and_is_proper(direction):
    up = np.array(direction)
    rotation = rotation_from_up(up)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert np.allclose(rotation @ (up / np.linalg.norm(up)), [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize("axis", UP_AXES)
def test_rotation_of_an_axis_is_the_named_one(axis):
    assert nearest_axis(axis_vector(axis)) == axis
    assert np.allclose(rotation_from_up(axis_vector(axis)), rotation_to_z_up(axis), atol=1e-15)


@pytest.mark.parametrize("bad", [np.zeros(3), np.array([1.0, np.nan, 0]), np.ones(2)])
def test_rotation_needs_a_direction(bad):
    with pytest.raises(ValueError, match="up direction"):
        rotation_from_up(bad)


def test_the_person_overrules():
    check = check_cloud(_cloud(make_forest()), up_axis="-y", provenance=PLY)
    assert (check.up_axis, check.up_confidence) == ("-y", 1.0)
    assert (check.up_direction_src == [0, -1, 0]).all()
    with pytest.raises(ValueError, match="up axis"):
        check_cloud(_cloud(make_forest()), up_axis="north")


def test_a_las_lying_on_its_side_is_turned_but_not_in_a_coordinate_system():
    points = make_forest() @ rotation_to_z_up("+y")
    assert check_cloud(_cloud(points), provenance=LAS).up_axis == "+y"
    assert check_cloud(_cloud(points, crs="EPSG:32632"), provenance=LAS).up_axis == "+z"


def test_noise_has_no_up():
    check = check_cloud(_cloud(np.random.default_rng(0).uniform(0, 5, (20_000, 3))), provenance=PLY)
    assert check.up_axis == "+z"
    assert check.up_confidence < 0.15
    assert check.finding("up").level == "warn"


# --- units --------------------------------------------------------------------------------------------------------


def test_lidar_formats_are_metres_where_plausible():
    check = check_cloud(_cloud(make_forest()), provenance=LAS)
    assert (check.unit, check.needs_scale, check.metres_per_unit) == ("metres", False, 1.0)
    assert check.finding("unit").level == check.finding("up").level == "ok"


@pytest.mark.parametrize("kind", ["ply", "obj", "glb", "stl", "xyz", ""])
def test_other_formats_need_a_scale_however_plausible(kind):
    check = check_cloud(_cloud(make_forest()), provenance=Provenance(kind))
    assert check.needs_scale
    assert check.metres_per_unit is None
    assert check.stems is None
    assert check.finding("unit").level == check.level == "stop"
    assert check.finding("unit").remedy


def test_las_of_photogrammetry_needs_a_scale():
    assert check_cloud(_cloud(make_forest()), provenance=Provenance("las", "Agisoft Metashape")).needs_scale
    declared = Provenance("las", "Agisoft Metashape", metres_per_unit=1.0)
    assert not check_cloud(_cloud(make_forest()), provenance=declared).needs_scale


@pytest.mark.parametrize(("factor", "unit"), [(1 / 0.3048, "feet"), (1000.0, "millimetres")])
def test_feet_and_millimetres_in_lidar_files_are_asked_about(factor, unit):
    points = make_forest() * [1, 1, 2] * factor
    check = check_cloud(_cloud(points), provenance=LAS)
    assert check.needs_scale
    assert check.unit == unit
    assert check.suggested_metres_per_unit == pytest.approx(1 / factor)


@pytest.mark.parametrize("factor", [0.02, 400.0])
def test_implausible_sizes_are_called_arbitrary(factor):
    check = check_cloud(_cloud(make_forest() * factor), provenance=PLY)
    assert check.needs_scale
    assert check.unit == ("millimetres" if factor == 400.0 else "arbitrary")


def test_lidar_stems_of_impossible_thickness_are_asked_about():
    assert check_cloud(_cloud(make_forest(radius=0.003, noise=0.0003, crowns=False)), provenance=LAS).needs_scale


def test_a_given_scale_settles_it():
    check = check_cloud(_cloud(make_forest() / 1.33231), metres_per_unit=1.33231, provenance=PLY)
    assert not check.needs_scale
    assert check.metres_per_unit == 1.33231
    assert check.stems.n_stems == 9
    assert check.stems.median_diameter_m == pytest.approx(0.30, rel=0.03)


def test_declared_feet_are_taken():
    points = make_forest() / 0.3048
    check = check_cloud(_cloud(points, crs="EPSG:2903"), provenance=Provenance("laz", metres_per_unit=0.3048))
    assert (check.unit, check.needs_scale) == ("feet", False)
    assert check.stems.median_diameter_m == pytest.approx(0.30, rel=0.03)


def test_degrees_are_refused_even_with_a_factor():
    check = check_cloud(_cloud(make_forest()), metres_per_unit=1.0, provenance=Provenance("las", is_geographic=True))
    assert check.needs_scale
    assert "degrees" in check.finding("unit").message


def test_a_doubtful_scale_is_said_to_be():
    right = check_cloud(_cloud(make_forest(crowns=False)), metres_per_unit=1.0, provenance=PLY)
    assert right.finding("unit").level == "ok"
    wrong = check_cloud(
        _cloud(make_forest(radius=0.003, noise=0.0003, crowns=False)), up_axis="+z", metres_per_unit=1.0, provenance=PLY
    )
    assert wrong.finding("unit").level == "warn"


@pytest.mark.parametrize("bad", [0.0, -1.0, float("inf"), float("nan")])
def test_bad_factors(bad):
    with pytest.raises(ValueError, match="metres per unit"):
        check_cloud(_cloud(make_forest()), metres_per_unit=bad)


# --- the rest -----------------------------------------------------------------------------------------------------


def test_extent_spacing_and_findings():
    points = make_forest()
    check = check_cloud(_cloud(points, rgb=np.zeros(points.shape, np.uint8)), provenance=LAS)
    assert check.n_points == len(points)
    assert check.extent_src == pytest.approx(np.ptp(points, axis=0), rel=1e-4)
    assert 0.01 < check.spacing_src < 0.2
    assert check.finding("colour").level == "ok"
    assert check.finding("crs").level == "note"
    assert len({finding.topic for finding in check.findings}) == len(check.findings)


@pytest.mark.parametrize("axis", UP_AXES)
def test_the_extent_is_that_of_the_levelled_cloud(axis):
    points = np.random.default_rng(0).uniform([0, 0, 0], [30, 20, 10], (5000, 3)) @ rotation_to_z_up(axis)
    cloud = _cloud(points)
    size = np.ptp(cloud.xyz.astype(float) @ rotation_to_z_up(axis).T, axis=0)
    assert check_cloud(cloud, up_axis=axis, provenance=PLY).extent_src == pytest.approx(size, rel=1e-6)


def test_the_extent_of_a_tilted_cloud():
    turn = _random_rotation(3)
    check = check_cloud(_cloud(make_forest() @ turn.T), provenance=PLY)
    size = np.ptp(make_forest() @ turn.T @ check.rotation_world_from_source.T, axis=0)
    assert check.up_direction_src == pytest.approx(turn @ [0, 0, 1.0], abs=0.04)
    assert check.extent_src == pytest.approx(size, rel=1e-5)


def test_few_planar_places_still_tell_the_axis():
    """A scan of little but leaves: a first look at a quarter of it finds too few normals to say anything."""
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(0, 4, (300, 2)), rng.normal(0, 0.002, 300)])
    leaves = rng.uniform([0, 0, 1.0], [4, 4, 4.0], (49_700, 3))
    for axis in UP_AXES:
        up = estimate_up(np.vstack([ground, leaves]) @ rotation_to_z_up(axis), axes_only=True)
        assert up.axis == axis
        assert up.confidence > 0.4


def test_spacing_of_a_grid():
    x, y = np.meshgrid(np.arange(700) * 0.01, np.arange(700) * 0.01)
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    points = points[np.random.default_rng(0).permutation(len(points))]
    # A thinned grid's neighbours are about half as far as a full grid's, scaled: a bound, not an equality.
    assert 0.004 < check_cloud(_cloud(points), provenance=LAS).spacing_src < 0.02


def test_density_counts_points_per_stem():
    stems = stem_evidence(make_forest(), metres_per_unit=1.0, share=1.0)
    # 3000 points over 10 m, a band of 0.30 m; the sloping base moves the band by up to its cell.
    assert stems.n_stems == stems.n_round == 9
    assert stems.points_per_stem == pytest.approx(90, rel=0.3)
    assert stem_evidence(make_forest(), metres_per_unit=1.0, share=0.5).points_per_stem == 2 * stems.points_per_stem


def test_sparse_stems_are_warned_about():
    assert check_cloud(_cloud(make_forest()[::3]), provenance=LAS).finding("density").level == "warn"


def test_low_surface_follows_a_slope_under_crowns():
    points = make_forest(slope=0.3)
    above = low_surface(points, cell=1.0).height_above(points[:20_000])
    assert np.abs(above).max() < 1.0


def test_a_stray_point_below_does_not_pull_the_surface_down():
    points = np.vstack([make_forest(), [[10.0, 10.0, -50.0]]])
    assert low_surface(points, cell=1.0).z.min() > -1.0


def test_slices_have_no_breast_height_finding_to_warn_about():
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, 5000)
    points = np.column_stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), rng.uniform(1.1, 1.5, 5000)])
    check = check_cloud(_cloud(points), provenance=Provenance("pcd"))
    assert not check.needs_scale
    assert check.up_axis == "+z"
    assert check.finding("density").level == "note"


@pytest.mark.parametrize("n", [0, 1, 2, 10])
def test_tiny_clouds_are_described_not_refused(n):
    check = check_cloud(PointCloud(np.zeros((n, 3), np.float32), np.zeros(3), name="a.las"))
    assert check.n_points == n
    assert check.level in ("warn", "stop")


def test_large_coordinates_do_not_matter():
    points = make_forest()
    near, far = (
        check_cloud(_cloud(points), provenance=LAS),
        check_cloud(_cloud(points + np.array([5e5, 4.5e6, 300])), provenance=LAS),
    )
    assert near.extent_src == pytest.approx(far.extent_src, abs=1e-3)
    assert near.stems.n_stems == far.stems.n_stems


def test_provenance_defaults_to_the_name():
    assert not check_cloud(_cloud(make_forest(), name="plot.laz")).needs_scale
    assert check_cloud(_cloud(make_forest(), name="plot.ply")).needs_scale


def test_tree_ids_are_mentioned():
    points = make_forest()
    cloud = _cloud(points, attributes={"treeID": np.ones(len(points), np.int32)})
    assert check_cloud(cloud, provenance=LAS).tree_id_attribute == "treeID"


# --- real files ---------------------------------------------------------------------------------------------------


def _read(name):
    if not SHARED.is_dir():
        pytest.skip("the folder shared/data with real files is not beside the project")
    from dbh_studio.io.reader import read_reconstruction

    return read_reconstruction(SHARED / name)


@pytest.mark.parametrize(
    "name", ["plots/pine_plot.laz", "plots/LPine1_demo.laz", "plots/pine.laz", "itsme_tree_1/pc_tree.las",
             "treescope_trunk_slices/tree_8_main_trunk.pcd"]
)  # fmt: skip
def test_scanned_plots_are_metres_and_upright(name):
    reconstruction = _read(name)
    check = check_cloud(reconstruction.cloud, provenance=reconstruction.provenance)
    assert (check.unit, check.needs_scale, check.up_axis) == ("metres", False, "+z")


@pytest.mark.parametrize("name", ["itsme_tree_1/pc_tree.ply", "itsme_tree_1/pc_tree.txt"])
def test_the_same_tree_without_provenance_is_asked_about(name):
    reconstruction = _read(name)
    assert check_cloud(reconstruction.cloud, provenance=reconstruction.provenance).needs_scale
    told = check_cloud(reconstruction.cloud, provenance=reconstruction.provenance, metres_per_unit=1.0)
    # TreeQSM gives 15.3 cm.
    assert told.stems.median_diameter_m == pytest.approx(0.153, rel=0.05)


def test_the_unscaled_plot_is_not_measured_and_is_levelled():
    reconstruction = _read("synthetic_360/dense_unscaled.ply")
    check = check_cloud(reconstruction.cloud, provenance=reconstruction.provenance)
    assert check.needs_scale
    assert check.level == "stop"
    assert check.up_axis == "-y"
    assert check.has_ground
    # Up in the model frame, from world_from_model.json.
    truth = np.array([0.00463052, -0.99938336, 0.03480609])
    assert _angle_deg(check.up_direction_src, truth) < 1.0
    scaled = check_cloud(reconstruction.cloud, provenance=reconstruction.provenance, metres_per_unit=1.33231)
    assert 12 <= scaled.stems.n_stems <= 30
