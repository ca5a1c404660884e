"""Masks to labels of points: what is counted, what is hidden, how it is put aside and taken up again."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.app.threads import map_in_threads
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.ground import PlaneGround
from dbh_studio.core.instances import InstanceGatherer
from dbh_studio.core.mask_views import ImageMask, TileMasks
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.tiles import TileSet, up_in_camera
from dbh_studio.core.transforms import Similarity
from dbh_studio.core.votes import PhotoVotes, VoteCounter, Votes
from dbh_studio.errors import CancelledError
from dbh_studio.settings import TrunkSettings, VoteSettings
from dbh_studio.stages.vote import make_voters, new_counter, trunk_candidates, vote

LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
PANORAMA = CameraModel("EQUIRECTANGULAR", 800, 400, ())
FISHEYE = CameraModel("SIMPLE_RADIAL_FISHEYE", 800, 800, (240.0, 400.0, 400.0, 0.01))
FLAT = CameraModel("SIMPLE_RADIAL", 900, 700, (500.0, 450.0, 350.0, -0.05))
GROUND = PlaneGround(np.zeros(3))


def photo(name: str, place: tuple[float, float, float], yaw_deg: float = 0.0, camera: CameraModel = PANORAMA):
    yaw = np.radians(yaw_deg)
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    rotation = LEVEL @ turn
    return PosedImage(name, camera, Similarity(rotation, -(rotation @ np.array(place))))


def cylinder(x: float, y: float, radius: float, spacing: float = 0.02, top: float = 3.0) -> np.ndarray:
    height, angle = np.arange(0.0, top, spacing), np.arange(0.0, 2 * np.pi, spacing / radius)
    h, a = (part.ravel() for part in np.meshgrid(height, angle))
    return np.column_stack([x + radius * np.cos(a), y + radius * np.sin(a), h])


def disc_mask(image: PosedImage, stems: list[tuple[float, float, float]], hidden: bool = True) -> np.ndarray:
    """True mask of upright cylinders of 3 m by intersecting the pixels' rays with them: 1, 2, … the nearest wins."""
    camera = image.camera
    across, down = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    origin, rays = image.ray(np.column_stack([across.ravel(), down.ravel()]))
    label, nearest = np.zeros(len(rays), np.int32), np.full(len(rays), np.inf)
    for number, (x, y, radius) in enumerate(stems, start=1):
        to = origin[:2] - [x, y]
        a = (rays[:, :2] ** 2).sum(axis=1)
        b = rays[:, :2] @ to
        with np.errstate(invalid="ignore", divide="ignore"):
            t = (-b - np.sqrt(b * b - a * (to @ to - radius**2))) / a
            z = origin[2] + t * rays[:, 2]
            hit = (t > 0) & (t < nearest) & (z >= 0.0) & (z <= 3.0)
        label[hit], nearest[hit] = number, t[hit]
    return label.reshape(camera.height_px, camera.width_px)


STEMS = [(0.0, 4.0, 0.3), (0.0, 7.0, 0.2), (3.0, 5.0, 0.15)]


def plot() -> tuple[np.ndarray, np.ndarray]:
    """Three stems, a wall of shrub behind the first, (N,) 1-3 the stem of each point or 0."""
    parts = [cylinder(*stem) for stem in STEMS]
    side, up = np.meshgrid(np.arange(-1.0, 1.0, 0.02), np.arange(0.0, 1.8, 0.02))
    parts.append(np.column_stack([side.ravel(), np.full(side.size, 5.2), up.ravel()]))
    ids = np.concatenate([np.full(len(part), k + 1 if k < 3 else 0) for k, part in enumerate(parts)])
    points = np.concatenate(parts)
    order = np.random.default_rng(0).permutation(len(points))
    return points[order].astype(np.float32), ids[order]


_MASKS: dict[tuple[object, ...], np.ndarray] = {}


def masks_of(images: PosedImages):
    masks = {}
    for image in images:
        key = (image.camera.kind, image.cam_from_source.translation.tobytes(), image.cam_from_source.rotation.tobytes())
        if key not in _MASKS:
            _MASKS[key] = disc_mask(image, STEMS)
        masks[image.name] = _MASKS[key]
    return lambda image: ImageMask(image.camera, masks[image.name], has_instances=True)


def walk() -> PosedImages:
    return PosedImages(tuple(photo(f"{k}", (x, 1.0 + 0.2 * k, 1.6), 40.0 * k) for k, x in enumerate((-1.0, 0.0, 1.0))))


@pytest.mark.parametrize("camera", [PANORAMA, FISHEYE, FLAT])
def test_what_a_trunk_hides_takes_no_vote_whatever_the_lens(camera):
    points, ids = plot()
    posed = PosedImages((photo("a", (0.0, 0.0, 1.6), 0.0, camera),))
    settings = VoteSettings(min_count=1)
    votes = trunk_candidates(points, posed, masks_of(posed), settings=settings)
    naive = trunk_candidates(points, posed, masks_of(posed), settings=VoteSettings.paper())
    behind = (ids == 0) & (np.abs(points[:, 0]) < 0.25) & (points[:, 2] < 1.7)
    assert behind.sum() > 500
    assert naive.is_trunk(VoteSettings.paper())[behind].mean() > 0.95
    assert (votes.n_seen[behind] == 0).all()
    # The front of the first stem is seen and called trunk, its back is neither.
    front = (ids == 1) & (points[:, 1] < 3.8) & (points[:, 2] > 0.5) & (points[:, 2] < 2.7)
    back = (ids == 1) & (points[:, 1] > 4.2)
    assert (votes.n_trunk[front] == 1).mean() > 0.97
    assert votes.n_seen[back].mean() < 0.03
    # What stands free beside it is seen and called no trunk.
    beside = (ids == 0) & (np.abs(points[:, 0]) > 0.6) & (points[:, 2] > 0.3)
    assert (votes.n_seen[beside] == 1).mean() > 0.97
    assert votes.n_trunk[beside].sum() == 0


def test_the_papers_rule_counts_every_photo_that_has_the_point_in_view():
    points, ids = plot()
    posed = walk()
    votes = trunk_candidates(points, posed, masks_of(posed), settings=VoteSettings.paper())
    assert (votes.n_seen == 3).all()
    inner = ids == 1
    assert (votes.n_trunk[inner] >= 1).mean() > 0.97


def test_the_true_masks_give_back_the_trunks():
    points, ids = plot()
    posed = PosedImages(
        tuple(
            photo(f"{k}", (4.5 * np.sin(a), 5.5 + 4.5 * np.cos(a), 1.6), 77.0 * k) for k, a in enumerate(np.arange(8))
        )
    )
    settings = VoteSettings()
    found = trunk_candidates(points, posed, masks_of(posed), ground=GROUND, settings=settings).is_trunk(settings)
    band = (points[:, 2] >= 0.3) & (points[:, 2] < 2.9)
    # Half a pixel is 1.5 cm here, and that near to its outline lies a tenth of what one sees of a cylinder.
    assert (found[band] == (ids[band] > 0)).mean() > 0.95
    assert not found[points[:, 2] < 0.29].any()


def test_masks_of_tiles_and_of_the_panorama_say_the_same():
    points, _ = plot()
    posed = walk()
    rings, parts = {}, {}
    for image in posed:
        ring = TileSet.ring(PANORAMA, size_px=300, up_cam=up_in_camera(image, (0.0, 0.0, 1.0)))
        rings[image.name] = ring
        parts[image.name] = [disc_mask(tile.posed(image, "tile"), STEMS) for tile in ring.tiles]

    def tiled(image):
        return TileMasks(rings[image.name], parts[image.name], has_instances=True)

    whole = trunk_candidates(points, posed, masks_of(posed))
    by_tiles = trunk_candidates(points, posed, tiled)
    assert (whole.n_seen > 0).mean() > 0.5
    np.testing.assert_array_equal(whole.n_seen, by_tiles.n_seen)
    # Pixels differ at outlines; two pixels from any they must agree.
    plain = masks_of(posed)
    inner = trunk_candidates(
        points, posed, lambda image: ImageMask(PANORAMA, plain(image).labels, edge_px=2), settings=VoteSettings()
    )
    clear = (inner.n_seen == whole.n_seen) & (whole.n_seen > 0)
    assert clear.sum() > 5_000 and (whole.n_trunk[clear] > 0).sum() > 1000
    np.testing.assert_array_equal(whole.n_trunk[clear], by_tiles.n_trunk[clear])


def test_instances_of_all_photos_become_the_stems():
    points, ids = plot()
    around = tuple(
        photo(f"{k}", (1.0 + 4.5 * np.sin(a), 5.5 + 4.5 * np.cos(a), 1.6), 50.0 * k)
        for k, a in enumerate(np.arange(12) * np.pi / 6)
    )
    posed = PosedImages(around)
    voters = make_voters(points, posed, ground=GROUND)
    gatherer = InstanceGatherer(voters.points.xyz)
    vote(voters, posed, masks_of(posed), on_photo=lambda _, photo: gatherer.add(photo))
    ties = gatherer.ties()
    stem = ids[voters.rows[voters.thinned.order[voters.thinned.starts]]]
    names = []
    for number in (1, 2, 3):
        found = ties.trunk_of_voter[stem == number]
        values, counts = np.unique(found[found > 0], return_counts=True)
        assert counts.max() > 0.8 * (stem == number).sum()
        names.append(int(values[counts.argmax()]))
    assert len(set(names)) == 3


def test_photos_without_a_mask_and_points_too_far_do_not_count():
    points, _ = plot()
    posed = walk()
    some = masks_of(posed)
    votes = trunk_candidates(points, posed, lambda image: None if image.name == "1" else some(image))
    assert votes.n_seen.max() == 2
    near = trunk_candidates(points, posed, some, settings=VoteSettings(max_distance_m=3.0))
    distance = np.min([np.linalg.norm(points - image.centre_src, axis=1) for image in posed], axis=0)
    assert near.n_seen[distance > 3.05].max() == 0 and near.n_seen[distance < 2.9].max() > 0


def test_stray_points_and_points_without_a_place_change_nothing():
    points, _ = plot()
    posed = walk()
    votes = trunk_candidates(points, posed, masks_of(posed))
    more = np.concatenate([points, [[np.nan] * 3, [5e7, 0, 0], [np.inf, 1, 1]]]).astype(np.float32)
    strayed = trunk_candidates(more, posed, masks_of(posed))
    np.testing.assert_array_equal(strayed.n_trunk[:-3], votes.n_trunk)
    assert strayed.n_seen[-3:].tolist() == [0, 0, 0]


def test_threads_and_an_interruption_change_no_vote():
    points, _ = plot()
    points = points[::4]
    posed, settings = walk(), VoteSettings(weighting="incidence")
    voters = make_voters(points, posed, settings=settings)
    whole = vote(voters, posed, masks_of(posed), settings=settings)
    threads = vote(voters, posed, masks_of(posed), settings=settings, map_photos=map_in_threads)
    counter = new_counter(voters, posed, settings)

    def stop(fraction: float, message: str = "") -> None:
        if fraction > 0.3:
            raise CancelledError

    with pytest.raises(CancelledError):
        vote(voters, posed, masks_of(posed), settings=settings, counter=counter, progress=stop)
    assert counter.done == {"0"}
    again = VoteCounter.from_state(counter.state(), n_voters=len(voters), key=counter.key)
    assert again is not None
    asked = []
    some = masks_of(posed)

    def counted(image: PosedImage):
        asked.append(image.name)
        return some(image)

    resumed = vote(voters, posed, counted, settings=settings, counter=again)
    assert asked == ["1", "2"]
    for other in (threads, resumed):
        for name in ("n_seen", "n_trunk", "weight_seen", "weight_trunk"):
            np.testing.assert_array_equal(getattr(other, name), getattr(whole, name))
    assert 0 < whole.weight_seen.max() < 3.0


def test_the_key_of_a_counter_tells_what_it_is_about():
    points, _ = plot()
    posed, settings = walk(), VoteSettings()
    voters = make_voters(points, posed, settings=settings)
    key = new_counter(voters, posed, settings).key
    assert new_counter(voters, posed, settings.changed(min_share=0.9, min_count=5)).key == key
    assert new_counter(voters, posed, settings.changed(tolerance_m=0.2)).key != key
    assert new_counter(voters, PosedImages(posed.images[:2]), settings).key != key
    moved = PosedImages((photo("0", (-1.0, 1.01, 1.6)), *posed.images[1:]))
    assert new_counter(voters, moved, settings).key != key
    assert new_counter(make_voters(points[:-9], posed, settings=settings), posed, settings).key != key


def test_a_state_of_something_else_is_not_taken_up():
    counter = VoteCounter(5, "a")
    counter.add(PhotoVotes("x", np.array([1, 3], np.int32), np.array([0, 2], np.int32)))
    counter.skip("y")
    state = counter.state()
    same = VoteCounter.from_state(state, n_voters=5, key="a")
    assert same is not None and same.done == {"x", "y"}
    np.testing.assert_array_equal(same.votes().n_trunk, [0, 0, 0, 1, 0])
    assert VoteCounter.from_state(state, n_voters=6, key="a") is None
    assert VoteCounter.from_state(state, n_voters=5, key="b") is None
    assert VoteCounter.from_state({**state, "version": np.array(99)}, n_voters=5, key="a") is None
    assert VoteCounter.from_state({}, n_voters=5, key="a") is None


def test_a_photo_counts_once():
    counter = VoteCounter(3)
    once = PhotoVotes("x", np.array([0, 2], np.int32), np.array([1, 0], np.int32), np.array([0.5, 2.0], np.float32))
    counter.add(once)
    counter.add(once)
    votes = counter.votes()
    assert votes.n_seen.tolist() == [1, 0, 1] and votes.weight_seen.tolist() == [0.5, 0.0, 2.0]
    np.testing.assert_array_equal(votes.share, [1.0, np.nan, 0.0])


def test_rules():
    seen, trunk = np.array([0, 1, 2, 10, 10, 10], np.uint16), np.array([0, 1, 2, 3, 4, 1], np.uint16)
    votes = Votes(seen, trunk, seen.astype(np.float32), trunk.astype(np.float32))
    assert votes.is_trunk(VoteSettings()).tolist() == [False, False, True, False, True, False]
    assert votes.is_trunk(VoteSettings(min_count=1)).tolist() == [False, True, True, False, True, False]
    assert votes.is_trunk(VoteSettings.paper()).tolist() == [False, True, True, True, True, True]


def test_nobody_to_ask_and_nothing_to_ask_about():
    points, _ = plot()
    nobody = trunk_candidates(points, PosedImages(()), lambda image: None)
    assert len(nobody) == len(points) and not nobody.is_trunk().any()
    posed = walk()
    assert len(trunk_candidates(np.empty((0, 3), np.float32), posed, masks_of(posed))) == 0
    far = trunk_candidates(points + np.float32(1000.0), posed, masks_of(posed), ground=GROUND)
    assert far.n_seen.max() == 0


def test_a_counter_of_other_voters_is_refused():
    points, _ = plot()
    posed = walk()
    voters = make_voters(points, posed, trunks=TrunkSettings())
    with pytest.raises(ValueError, match="3 voters"):
        vote(voters, posed, masks_of(posed), counter=VoteCounter(3))
