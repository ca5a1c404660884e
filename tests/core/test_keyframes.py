"""The choice of photos worth a mask, on rings and walks whose best choice is known."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.keyframes import choose_keyframes, places_at_eye_height, sides_seen
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.transforms import Similarity

PANORAMA = CameraModel("EQUIRECTANGULAR", 1024, 512, ())
PINHOLE = CameraModel("PINHOLE", 900, 600, (450, 450, 450, 300))
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # looks along +y
ON_TREE = np.array([[0.0, 0.0, 1.5]])


def photos(centres: np.ndarray, camera: CameraModel = PANORAMA) -> PosedImages:
    poses = [Similarity(LEVEL, -LEVEL @ centre) for centre in centres]
    return PosedImages(tuple(PosedImage(f"{i:03d}.jpg", camera, pose) for i, pose in enumerate(poses)))


def ring(n: int, radius: float) -> np.ndarray:
    angle = (np.arange(n) + 0.5) * 2 * np.pi / n
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(n, 1.5)])


def walk(n: int, step: float = 0.5) -> np.ndarray:
    return np.column_stack([np.arange(n) * step, np.zeros(n), np.full(n, 1.6)])


def test_a_photo_sees_the_sides_that_face_it():
    seen = sides_seen(ON_TREE, photos(ring(8, 4.0)), n_sides=8)
    # Each of eight photos round a stem is straight on to one side, and sees its two neighbours at 45°.
    expected = sum(np.roll(np.eye(8), shift, axis=1) for shift in (-1, 0, 1)) > 0
    assert np.array_equal(seen, expected)
    assert not sides_seen(ON_TREE, photos(ring(8, 11.0)), max_distance=10.0).any()
    # A camera with a lens sees what is before it: those south of the tree, for all look north.
    before = sides_seen(ON_TREE, photos(ring(8, 4.0), PINHOLE)).any(axis=1)
    assert before.tolist() == [False] * 4 + [False, True, True, False]
    assert sides_seen(np.empty((0, 3)), photos(ring(3, 4.0))).shape == (3, 0)
    with pytest.raises(ValueError, match="targets"):
        sides_seen(np.zeros((2, 2)), photos(ring(3, 4.0)))


def test_many_targets_are_thinned_and_memory_stays_bounded():
    targets = np.column_stack([np.linspace(0, 5, 50_000)] * 2 + [np.full(50_000, 1.5)])
    assert sides_seen(targets, photos(ring(2, 3.0)), n_sides=4).shape == (2, 16_000)


def test_the_choice_covers_and_leaves_out_what_says_nothing_new():
    # 40 photos round each of two trees far apart: eight views give two of every side.
    centres = np.concatenate([ring(40, 4.0), ring(40, 4.0) + [40.0, 0.0, 0.0]])
    targets = np.concatenate([ON_TREE, ON_TREE + [40.0, 0.0, 0.0]])
    sees = sides_seen(targets, photos(centres))
    chosen = choose_keyframes(sees)
    assert 8 <= len(chosen) <= 16
    # Both trees get their share, and every side has two photos.
    assert abs(np.count_nonzero(chosen.rows < 40) - len(chosen) / 2) <= 1
    assert (sees[chosen.rows].sum(axis=0) >= 2).all() and chosen.share == 1.0
    assert (np.diff(chosen.covered) >= 0).all() and len(set(chosen.rows.tolist())) == len(chosen)
    # The same in every run.
    assert np.array_equal(choose_keyframes(sees).rows, chosen.rows)


def test_a_walk_needs_a_part_of_its_photos_and_greedy_beats_every_nth():
    rng = np.random.default_rng(3)
    targets = np.column_stack([rng.uniform(0, 100, 200), rng.uniform(-9, 9, 200), np.full(200, 1.5)])
    sees = sides_seen(targets, photos(walk(200)))
    chosen = choose_keyframes(sees)
    assert 20 < len(chosen) < 80 and chosen.share > 0.9
    demand = np.minimum(sees.sum(axis=0), 2)
    every = np.linspace(0, 199, len(chosen)).astype(int)
    evenly = np.minimum(sees[every].sum(axis=0), demand).sum() / demand.sum()
    assert chosen.share > evenly
    # What it says of itself is what it covers.
    assert np.minimum(sees[chosen.rows].sum(axis=0), demand).sum() / demand.sum() == pytest.approx(chosen.share)


def test_what_is_there_already_is_not_chosen_again_and_the_choice_goes_on_where_it_stopped():
    rng = np.random.default_rng(4)
    targets = np.column_stack([rng.uniform(0, 30, 60), rng.uniform(-6, 6, 60), np.full(60, 1.5)])
    sees = sides_seen(targets, photos(walk(60)))
    whole = choose_keyframes(sees)
    begun = whole.rows[:4].tolist()
    rest = choose_keyframes(sees, already=begun)
    assert np.array_equal(rest.rows, whole.rows[4:])
    assert rest.covered_before == pytest.approx(whole.covered[3]) and rest.share == pytest.approx(whole.share)
    done = choose_keyframes(sees, already=whole.rows.tolist())
    assert len(done) == 0 and done.share == pytest.approx(whole.share)


def test_budgets():
    sees = sides_seen(ON_TREE, photos(ring(40, 4.0)))
    assert len(choose_keyframes(sees, budget=3)) == 3
    assert len(choose_keyframes(sees, budget=5, already=[0, 1])) == 3
    assert len(choose_keyframes(sees, budget=2, already=[0, 1, 2])) == 0
    assert len(choose_keyframes(sees, budget=0)) == 0
    # More than are needed are spread round the tree, too, and do not follow the order of capture.
    many = choose_keyframes(sees, budget=20)
    quarters = np.bincount(many.rows // 10, minlength=4)
    assert len(many) == 20 and quarters.min() >= 3
    assert sorted(choose_keyframes(sees, budget=99).rows.tolist()) == list(range(40))


def test_photos_that_are_not_on_disk_are_not_chosen():
    sees = sides_seen(ON_TREE, photos(ring(16, 4.0)))
    here = np.arange(16) % 2 == 0
    chosen = choose_keyframes(sees, may_choose=here)
    assert len(chosen) and (chosen.rows % 2 == 0).all() and chosen.share == 1.0
    assert len(choose_keyframes(sees, budget=99, may_choose=here)) == 8


def test_nothing_to_cover():
    empty = choose_keyframes(np.zeros((5, 0), bool))
    assert len(empty) == 0 and empty.share == 1.0
    assert len(choose_keyframes(np.zeros((5, 0), bool), budget=2)) == 2
    assert len(choose_keyframes(np.zeros((0, 8), bool))) == 0
    with pytest.raises(ValueError, match="shape"):
        choose_keyframes(np.zeros(3, bool))
    with pytest.raises(ValueError, match="budget"):
        choose_keyframes(np.zeros((3, 3), bool), budget=-1)


def test_before_any_trunk_is_known_places_at_eye_height_are_covered():
    centres = walk(10, 1.0) + [0.0, 0.0, 100.0]
    stem = np.column_stack([np.full(50, 3.4), np.full(50, 4.6), np.linspace(100.0, 110.0, 50)])
    floor = np.column_stack([np.linspace(0, 9, 500), np.linspace(-5, 5, 500), np.full(500, 100.0)])
    far = stem + [60.0, 0.0, 0.0]
    lost = np.full((1, 3), np.nan)
    places = places_at_eye_height(np.concatenate([stem, floor, far, lost]), centres)
    # One place: the stem, between 0.4 and 2.4 m; neither floor, crown nor what no camera is near.
    assert places.shape == (1, 3)
    assert places[0] == pytest.approx([3.4, 4.6, 101.4], abs=0.2)
    # Where nothing is at that height, the cameras' own places stand in.
    assert np.array_equal(places_at_eye_height(floor, centres), centres)
    assert np.array_equal(places_at_eye_height(np.empty((0, 3)), centres), centres)
