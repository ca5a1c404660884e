"""The ground stems are counted on: as the cloud has it, and as a person's file of corners does."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.app.plot_areas import _covered, area_from_text
from dbh_studio.core.stand import PlotArea
from dbh_studio.errors import FileError, SettingError


def area_of(places: np.ndarray) -> float:
    return PlotArea.extent(_covered(places)).area_m2


@pytest.mark.parametrize("width", [0.4, 30.0, 200.0])
def test_the_rim_counts_though_most_points_are_in_the_middle(width):
    rng = np.random.default_rng(1)
    even, middle = rng.uniform(0, width, (60_000, 2)), rng.normal(width / 2, width / 20, (120_000, 2))
    places = np.concatenate([even, middle])
    # Around 98 % of the points it would be 3 % less each way, and of a narrower middle still less.
    assert width**2 * 0.99 <= area_of(places) <= width**2
    assert area_of(places + [500_000.0, 4_500_000.0]) == pytest.approx(area_of(places), rel=0.02)


def test_a_round_plot_is_never_taken_for_a_smaller_one():
    rng = np.random.default_rng(2)
    angle, radius = rng.uniform(0, 2 * np.pi, 80_000), 15 * rng.uniform(0, 1, 80_000)
    area = area_of(np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]))
    assert np.pi * 15**2 < area <= 30**2


def test_stray_points_are_no_plot():
    rng = np.random.default_rng(3)
    places = np.concatenate([rng.uniform(0, 30, (50_000, 2)), rng.uniform(-1e6, 1e6, (20, 2)), [[1e9, -1e9]]])
    # A cell more than there is, and what the strays among the cells move the share by.
    assert 890 <= area_of(places) <= 30.8**2


def test_points_at_one_place_or_nowhere_have_no_area():
    for places in (np.zeros((5, 2)), np.empty((0, 2))):
        with pytest.raises(ValueError, match=r"no area|how large"):
            PlotArea.extent(_covered(places))


@pytest.mark.parametrize(
    "text",
    [
        "0,5\t0,5\n20,5\t0,5\n20,5\t10,5\n0,5\t10,5\n",
        "0,5 0,5\n20,5 0,5\n20,5 10,5\n0,5 10,5\n",
        "x;y\n0,5;0,5\n20,5;0,5\n20,5;10,5\n0,5;10,5\n",
        "# north\n0.5, 0.5\n20.5, 0.5\n20.5, 10.5\n0.5, 10.5\n",
        "0.5 0.5 300\n20.5 0.5 300\n20.5 10.5 301\n0.5 10.5 301\n",
    ],
)
def test_corners_as_they_are_written_down(tmp_path, text):
    (tmp_path / "corners.txt").write_text(text)
    area = area_from_text(None, tmp_path / "corners.txt")
    assert area is not None and area.area_m2 == pytest.approx(200)


@pytest.mark.parametrize("first", [0, 1])
def test_numbered_corners_are_not_taken_for_places(tmp_path, first):
    corners = [(0, 0), (30, 0), (30, 30), (0, 30)]
    (tmp_path / "c.txt").write_text("".join(f"{k},{x},{y}\n" for k, (x, y) in enumerate(corners, start=first)))
    with pytest.raises(FileError, match="numbers the corners"):
        area_from_text(None, tmp_path / "c.txt")


def test_a_plot_of_two_corners_is_none(tmp_path):
    (tmp_path / "c.txt").write_text("0 0\n1 1\n")
    with pytest.raises(SettingError, match="three corners"):
        area_from_text(None, tmp_path / "c.txt")
