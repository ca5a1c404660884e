"""What hides a stem, on scenes whose answer is known."""

import numpy as np
import pytest
from tests.treescene import Stem

from dbh_studio.core.occluders import N_ACROSS, N_UP, Occluders, part_of_face, without_specks

STEM = Stem(0.0, 6.0, 0.4)
CAMERA = np.array([0.0, 0.0, 1.6])
SPACING = 0.02


def wall(x0, x1, z0, z1, y=3.0, spacing=SPACING):
    x, z = np.meshgrid(np.arange(x0, x1, spacing), np.arange(z0, z1, spacing))
    return np.c_[x.ravel(), np.full(x.size, y), z.ravel()]


def hidden(points, *, own=None, stem=STEM, camera=CAMERA):
    # A floor beside everything tells what the spacing is.
    x, y = np.meshgrid(np.arange(3.0, 8.0, SPACING), np.arange(0.0, 8.0, SPACING))
    floor = np.c_[x.ravel(), y.ravel(), np.zeros(x.size)]
    return Occluders(np.concatenate([points, floor])).hidden(camera, stem.line, own=own)


def test_nothing_in_front_hides_nothing():
    assert hidden(STEM.points()).shape == (N_UP, N_ACROSS)
    assert not hidden(STEM.points()).any()


def test_a_wall_hides_all_and_one_behind_or_beside_nothing():
    assert hidden(wall(-2, 2, 0, 4)).all()
    assert not hidden(wall(-2, 2, 0, 4, y=7.0)).any()
    assert not hidden(wall(0.5, 2.5, 0, 4)).any()
    assert not hidden(wall(-2, 2, 0, 4, y=-1.0)).any()


def test_a_low_wall_hides_the_foot():
    # Seen from 1.6 m, the top of a wall of 1 m half way is in line with 0.4 m on the stem.
    covered = hidden(wall(-2, 2, 0, 1.0))
    heights = 0.2 + (np.arange(N_UP) + 0.5) / N_UP * 2.4
    assert covered[heights < 0.35].all()
    assert not covered[heights > 0.55].any()


def test_half_a_wall_hides_the_left_half():
    covered = hidden(wall(-2, 0.0, 0, 4))
    assert covered[:, : N_ACROSS // 2].all()
    assert not covered[:, N_ACROSS // 2 + 2 :].any()


def test_stray_points_hide_nothing():
    rng = np.random.default_rng(3)
    stray = np.c_[rng.uniform(-0.3, 0.3, 8), rng.uniform(2.5, 3.0, 8), np.linspace(0.3, 2.5, 8)]
    assert not hidden(stray).any()


def test_whoever_holds_the_camera_hides_nothing():
    assert not hidden(wall(-0.3, 0.3, 1.0, 2.0, y=0.3)).any()


def test_the_trees_own_points_never_hide_it():
    branch = wall(-2, 2, 0, 4, y=5.0)
    assert hidden(branch).all()
    assert not hidden(branch, own=np.arange(len(branch))).any()


@pytest.mark.parametrize("unit", [0.01, 37.0])
def test_the_unit_does_not_matter(unit):
    points = np.concatenate([wall(-0.5, 0.05, 0, 1.7), STEM.points()])
    as_is = Occluders(points).hidden(CAMERA, STEM.line)
    line = STEM.line
    other = type(line)(line.point * unit, line.direction, line.radius * unit, line.low * unit, line.high * unit)
    scaled = Occluders(points * unit).hidden(CAMERA * unit, other)
    assert 0.1 < as_is.mean() < 0.9
    assert (scaled != as_is).mean() < 0.02


def test_a_leaning_stem_is_followed():
    line = STEM.line
    leaning = type(line)(line.point, np.array([0.5, 0.0, 1.0]), line.radius, line.low, line.high)
    covered = Occluders(wall(0.1, 0.5, 0, 4)).hidden(CAMERA, leaning)
    assert covered[-3:].mean() > 0.9 and not covered[:8].any()


def test_far_strays_and_nothing_at_all():
    far = np.array([[1e6, 0, 0], [np.nan, 0, 0], [-1e6, 5.0, 2.0]])
    assert hidden(np.concatenate([wall(-2, 2, 0, 4), far])).all()
    assert not Occluders(np.empty((0, 3))).hidden(CAMERA, STEM.line).any()
    assert len(Occluders(np.full((5, 3), np.nan))) == 0


def test_a_camera_and_a_tree_outside_the_cloud():
    assert hidden(wall(-2, 2, 0, 4), camera=np.array([0.0, -300.0, 1.6])).mean() > 0.9


def test_more_points_than_are_kept():
    occluders = Occluders(wall(-2, 2, 0, 4, spacing=0.005), most=20_000)
    assert len(occluders) <= 20_000
    assert occluders.hidden(CAMERA, STEM.line).mean() > 0.95


def test_parts_of_the_face():
    up, across = part_of_face(np.array([[-0.19, 5.9, 0.21], [0.19, 5.9, 2.59], [0.0, 5.8, 1.4]]), CAMERA, STEM.line)
    assert up.tolist() == [0, N_UP - 1, N_UP // 2]
    assert across.tolist() == [0, N_ACROSS - 1, N_ACROSS // 2]


def test_specks_go_and_what_is_large_stays():
    hidden = np.zeros((N_UP, N_ACROSS), bool)
    hidden[10, 3] = True
    assert not without_specks(hidden).any()
    hidden[12:, :] = True
    hidden[18, 2] = False
    cleaned = without_specks(hidden)
    assert cleaned[13:].all() and not cleaned[:10].any()
