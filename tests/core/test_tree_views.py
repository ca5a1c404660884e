"""Which photos of a tree are chosen, on scenes whose answer is known."""

import numpy as np
import pytest
from tests.treescene import FISHEYE, PANORAMA, PERSPECTIVE, Stem, facing, photo, turned

from dbh_studio.core.occluders import Occluders
from dbh_studio.core.tree_views import Viewpoints, choose_views

TREE = Stem(0.0, 0.0, 0.4)


def cloud(*stems):
    x, y = np.meshgrid(np.arange(-12, 12, 0.05), np.arange(-12, 12, 0.05))
    ground = np.c_[x.ravel(), y.ravel(), np.zeros(x.size)]
    return Occluders(np.concatenate([ground, *[stem.points(0.03) for stem in (TREE, *stems)]]))


def around(camera, distances, bearings_deg, **turn):
    photos = []
    for index, (distance, bearing) in enumerate(zip(distances, bearings_deg, strict=True)):
        angle = np.radians(bearing)
        place = (distance * np.sin(angle), distance * np.cos(angle), 1.6)
        photos.append(facing(f"{index}.jpg", camera, place, TREE, **turn))
    return Viewpoints(tuple(photos))


def names(found):
    return [view.photo.name for view in found.views]


def test_the_best_are_near_and_from_different_sides():
    found = choose_views(TREE.line, around(PANORAMA, [3, 3, 3, 3, 9, 3], [0, 90, 180, 270, 45, 3]), cloud())
    assert found.why_none == "" and len(found.views) == 4
    assert sorted(round(view.bearing_deg) % 90 for view in found.views) in ([0, 0, 0, 0], [0, 0, 0, 3])
    assert {round(view.bearing_deg / 90.0) % 4 for view in found.views} == {0, 1, 2, 3}
    assert all(view.distance == pytest.approx(3.0) and view.seen == 1.0 for view in found.views)


def test_bearings_are_from_the_tree_to_the_camera_clockwise_from_north():
    east = choose_views(TREE.line, around(PANORAMA, [4], [90]), cloud()).views[0]
    assert east.bearing_deg == pytest.approx(90.0)
    assert east.photo.centre_src == pytest.approx([4.0, 0.0, 1.6])


def test_a_hidden_tree_is_not_chosen_and_a_farther_open_view_is():
    before = Stem(0.0, 1.5, 0.9)
    found = choose_views(TREE.line, around(PANORAMA, [3, 7], [0, 120]), cloud(before))
    assert names(found) == ["1.jpg"]
    none = choose_views(TREE.line, around(PANORAMA, [3, 7], [0, 2]), cloud(before))
    assert none.views == () and none.why_none == "hidden" and none.n_near == 2


def test_what_looks_the_other_way_is_not_chosen():
    away = facing("away.jpg", PERSPECTIVE, (0.0, 3.0, 1.6), TREE, aside_deg=180)
    towards = facing("towards.jpg", PERSPECTIVE, (0.0, 5.0, 1.6), TREE)
    assert names(choose_views(TREE.line, Viewpoints((away, towards)), cloud())) == ["towards.jpg"]
    assert choose_views(TREE.line, Viewpoints((away,)), cloud()).why_none == "out_of_frame"


def test_the_middle_of_the_frame_is_better_than_its_border():
    aside = facing("aside.jpg", PERSPECTIVE, (0.0, 4.0, 1.6), TREE, aside_deg=33)
    middle = facing("middle.jpg", PERSPECTIVE, (0.01, 4.0, 1.6), TREE)
    assert names(choose_views(TREE.line, Viewpoints((aside, middle)), cloud())) == ["middle.jpg"]


def test_from_one_side_one_photo_is_enough():
    found = choose_views(TREE.line, around(PANORAMA, [3, 3.5, 4, 4.5], [0, 4, 8, 12]), cloud())
    assert len(found.views) == 1


@pytest.mark.parametrize("camera", [PANORAMA, PERSPECTIVE, FISHEYE])
@pytest.mark.parametrize("turn", [{}, {"pitch_deg": 20, "roll_deg": 90}, {"pitch_deg": -15, "roll_deg": 180}])
def test_every_lens_however_it_is_held(camera, turn):
    found = choose_views(TREE.line, around(camera, [4, 4, 4], [0, 120, 240], **turn), cloud())
    assert len(found.views) == 3
    assert all(view.seen > 0.6 for view in found.views)


def test_the_poles_and_the_seam_of_a_panorama():
    # Turned so that the tree is at the zenith, at the nadir, and on the seam.
    turns = [turned(yaw_deg=180, pitch_deg=p) for p in (90.0, -90.0)] + [turned(yaw_deg=0.0)]
    places = [(4 * np.sin(a), 4 * np.cos(a), 1.4) for a in (0.0, 2.0, 4.0)]
    photos = tuple(photo(f"{i}.jpg", PANORAMA, p, t) for i, (p, t) in enumerate(zip(places, turns, strict=True)))
    found = choose_views(TREE.line, Viewpoints(photos), cloud())
    assert sorted(names(found)) == ["0.jpg", "1.jpg", "2.jpg"]
    assert all(view.seen == 1.0 for view in found.views)


def test_why_there_is_none():
    assert choose_views(TREE.line, Viewpoints(()), cloud()).why_none == "no_photos"
    far = choose_views(TREE.line, around(PANORAMA, [60.0], [0]), cloud())
    assert far.views == () and far.why_none == "far"
    inside = choose_views(TREE.line, around(PANORAMA, [0.1], [0]), cloud())
    assert inside.views == ()


def test_hundreds_of_photos():
    rng = np.random.default_rng(1)
    many = around(PANORAMA, rng.uniform(2, 25, 500), rng.uniform(0, 360, 500))
    found = choose_views(TREE.line, many, cloud(Stem(0.0, 2.0, 0.5)))
    assert len(found.views) == 4
    assert all(view.seen > 0.9 and view.distance < 6.0 for view in found.views)
    bearings = np.sort([view.bearing_deg for view in found.views])
    assert np.diff(bearings, append=bearings[0] + 360.0).min() > 30.0


def test_the_order_of_the_photos_does_not_matter():
    viewpoints = around(PANORAMA, [3, 3.3, 3.7, 4.1, 5], [0, 77, 150, 210, 300])
    forth = choose_views(TREE.line, viewpoints, cloud())
    back = choose_views(TREE.line, Viewpoints(viewpoints.photos[::-1]), cloud())
    assert names(forth) == names(back)
