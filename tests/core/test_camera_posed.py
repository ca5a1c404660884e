"""Posed images as values, and whether photos and cloud lie in one frame."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage, PosedImages, fit_check
from dbh_studio.core.similarity_fit import fit_similarity
from dbh_studio.core.transforms import Similarity

PANORAMA = CameraModel("EQUIRECTANGULAR", 2000, 1000, ())


def image_at(centre, name="a.jpg", camera=PANORAMA, seed=0) -> PosedImage:
    rotation = Rotation.random(random_state=np.random.default_rng(seed)).as_matrix()
    return PosedImage(name, camera, Similarity(rotation, -rotation @ np.asarray(centre, float)))


def forest(rng) -> np.ndarray:
    """(N, 3) ten stems on rough ground, 20 m wide."""
    ground = np.column_stack([rng.uniform(-10, 10, (30_000, 2)), rng.normal(0, 0.02, 30_000)])
    stems = []
    for x, y in rng.uniform(-8, 8, (10, 2)):
        angle, height = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(0, 4, 3000)
        stems.append(np.column_stack([x + 0.2 * np.cos(angle), y + 0.2 * np.sin(angle), height]))
    return np.concatenate([ground, *stems])


@pytest.fixture
def scene():
    rng = np.random.default_rng(4)
    cloud = forest(rng)
    sparse = cloud[rng.permutation(len(cloud))[:3000]] + rng.normal(0, 0.01, (3000, 3))
    images = tuple(
        image_at([6 * np.cos(t), 6 * np.sin(t), 1.7], f"{i}.jpg", seed=i) for i, t in enumerate(np.linspace(0, 6, 12))
    )
    return cloud, PosedImages(images, sparse)


def test_a_pixels_ray_goes_through_its_point():
    image = image_at([1.0, 2.0, 3.0])
    points = np.random.default_rng(1).normal(size=(100, 3)) * 10
    uv, is_visible = image.project(points)
    origin, directions = image.ray(uv)
    assert is_visible.all() and np.allclose(origin, [1.0, 2.0, 3.0])
    away = points - origin
    assert np.allclose(directions, away / np.linalg.norm(away, axis=1, keepdims=True), atol=1e-12)


def test_survey_coordinates_keep_their_millimetres():
    """4 500 000 m times a rotation in float64 is good to a nanometre; to be so the centre is subtracted first."""
    near, far = np.array([1.0, 2.0, 3.0]), np.array([500_000.0, 4_500_000.0, 300.0])
    a, _ = image_at(near).project(near + [[0.3, 0.4, 0.5]])
    b, _ = image_at(far).project(far + [[0.3, 0.4, 0.5]])
    assert np.abs(a - b).max() < 1e-4


def test_moving_images_changes_no_pixel():
    move = Similarity(Rotation.from_rotvec([1, 2, 3]).as_matrix(), np.array([5.0, 6.0, 7.0]), 3.5)
    points = np.random.default_rng(1).normal(size=(100, 3)) * 10
    posed = PosedImages((image_at([1.0, 2.0, 3.0]),), points, cloud_from_cameras=move)
    placed = posed.in_cloud_frame()
    a, _ = posed.images[0].project(points)
    b, _ = placed.images[0].project(placed.sparse_points_src)
    assert np.abs(a - b).max() < 1e-8
    assert placed.images[0].cam_from_source.scale == 1.0
    assert np.allclose(placed.cloud_from_cameras.rotation, np.eye(3)) and placed.cloud_from_cameras.scale == 1.0
    assert PosedImages(posed.images).in_cloud_frame().images == posed.images


def test_values_are_checked_and_read_only():
    image = image_at([0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="scale"):
        PosedImage("a", PANORAMA, Similarity(np.eye(3), np.zeros(3), 2.0))
    with pytest.raises(ValueError, match="same name"):
        PosedImages((image, image))
    with pytest.raises(ValueError, match="sparse_rgb"):
        PosedImages((image,), np.zeros((2, 3)), np.zeros((3, 3), np.uint8))
    posed = PosedImages((image,), np.zeros((2, 3)))
    with pytest.raises(ValueError, match="read-only"):
        posed.sparse_points_src[0] = 1
    with pytest.raises(ValueError, match="read-only"):
        posed.centres_src[0] = 1
    again = pickle.loads(pickle.dumps(posed))
    assert again.by_name("a.jpg").camera.params == image.camera.params


def test_fit_similarity_finds_the_truth():
    rng = np.random.default_rng(0)
    truth = Similarity(Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3), 0.37)
    source = rng.normal(size=(20, 3))
    found, rms = fit_similarity(source, truth.apply(source))
    assert rms < 1e-12 and found.scale == pytest.approx(0.37)
    assert np.allclose(found.rotation, truth.rotation) and np.allclose(found.translation, truth.translation)
    rigid, rms = fit_similarity(source, truth.apply(source), with_scale=False)
    assert rigid.scale == 1.0 and rms > 0.1
    # A mirrored copy has no rotation that fits; the answer stays a proper one.
    mirrored, rms = fit_similarity(source, source * [1, 1, -1])
    assert np.linalg.det(mirrored.rotation) > 0 and rms > 0.1


@pytest.mark.parametrize("source", [np.zeros((2, 3)), np.outer(np.arange(5.0), [1, 2, 3]), np.zeros((5, 3))])
def test_too_little_for_a_similarity_is_refused(source):
    with pytest.raises(ValueError, match=r"three pairs|one line"):
        fit_similarity(source, source)


def test_photos_fit_their_own_cloud(scene):
    cloud, posed = scene
    fit = fit_check(cloud, posed)
    assert fit.status == "fits" and fit.remedy == ""
    assert fit.share_in_view == 1.0 and fit.share_cameras_inside == 1.0
    assert np.allclose(fit.cloud_from_source.translation, 0.0)


@pytest.mark.parametrize(
    "move",
    [
        Similarity(np.eye(3), np.array([0.5, 0.0, 0.0])),
        Similarity(np.eye(3), np.array([0.0, 0.0, -0.4])),
        Similarity(np.eye(3), np.array([500_000.0, 5_400_000.0, 300.0])),
        Similarity(np.eye(3), np.zeros(3), 1.3),
        Similarity(Rotation.from_rotvec([np.pi / 2, 0, 0]).as_matrix(), np.zeros(3)),
    ],
    ids=["half a metre aside", "lower", "survey coordinates", "scaled", "another axis up"],
)
def test_a_moved_cloud_is_noticed_and_mended_by_the_file(scene, move):
    cloud, posed = scene
    fit = fit_check(move.apply(cloud), posed)
    assert fit.status == "moved" and fit.cloud_from_source is None
    assert fit.message and fit.remedy
    told = fit_check(move.apply(cloud), replace(posed, cloud_from_cameras=move))
    assert told.status == "fits"
    assert told.cloud_from_source.scale == pytest.approx(move.scale)


def test_a_plot_cut_out_of_the_reconstruction_still_fits(scene):
    cloud, posed = scene
    assert fit_check(cloud[(np.abs(cloud[:, :2]) < 4).all(axis=1)], posed).status == "fits"


def test_without_points_it_stays_unclear(scene):
    cloud, posed = scene
    bare = replace(posed, sparse_points_src=None)
    fit = fit_check(cloud, bare)
    assert fit.status == "unclear" and "confirm" in fit.message and fit.cloud_from_source is not None
    assert fit_check(cloud + [1000.0, 0.0, 0.0], bare).status == "moved"


@pytest.mark.parametrize("n", [0, 5])
def test_too_few_points_to_tell(scene, n):
    assert fit_check(scene[0][:n], scene[1]).status == "unclear"
    assert fit_check(scene[0], PosedImages(())).status == "unclear"
