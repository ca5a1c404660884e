"""Measuring trunks in the world: on slopes, without ground, many at a time."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from dbh_studio.core.dbh import DbhEstimate, Refusal
from dbh_studio.core.protocols import Protocol
from dbh_studio.core.trunks import Trunk, TrunkSet
from dbh_studio.errors import CancelledError
from dbh_studio.settings import MeasureSettings
from dbh_studio.stages.measure import STEM_BASE_NOTE, measure_all, measure_trunk

DATA = Path(__file__).parents[2].parent / "shared" / "data"


@dataclass(frozen=True)
class Slope:
    """Ground z = z0 + rise · x."""

    z0: float = 0.0
    rise: float = 0.0
    kind: str = "terrain"
    notes: tuple[str, ...] = ()

    def z_at(self, xy_world):
        return self.z0 + self.rise * np.asarray(xy_world, np.float64)[:, 0]

    def height_above(self, points_world):
        return points_world[:, 2] - self.z_at(points_world[:, :2])


def stem(x=0.0, y=0.0, base=0.0, radius=0.2, lean_deg=0.0, z=(0.3, 4.0), n=5000, taper=0.0, seed=0):
    rng = np.random.default_rng(seed)
    t, w = rng.uniform(0, 2 * np.pi, n), rng.uniform(*z, n)
    r = radius - taper * w + 0.003 * rng.standard_normal(n)
    lean = np.radians(lean_deg)
    tilt = np.array([[np.cos(lean), 0, np.sin(lean)], [0, 1, 0], [-np.sin(lean), 0, np.cos(lean)]])
    return np.stack([r * np.cos(t), r * np.sin(t), w], axis=1) @ tilt.T + [x, y, base]


SMOOTH = MeasureSettings(bark_share=0.0, bloat_m=0.0)
"""The stems here have no bark: what is fitted is what a tape would lie on."""


def measured(points, ground, *, settings=SMOOTH, **options):
    return measure_trunk(points, trunk_id=7, ground=ground, settings=settings, **options)


def test_flat_ground():
    found = measured(stem(x=3, y=-4, base=10.0), Slope(z0=10.0))
    assert isinstance(found.result, DbhEstimate)
    assert found.trunk_id == 7
    assert found.n_points == 5000
    assert found.ground_kind == "terrain"
    assert found.z_ground_m == pytest.approx(10.0)
    np.testing.assert_allclose(found.xy_m, [3, -4], atol=0.005)
    assert found.result.dbh_cm == pytest.approx(40.0, rel=0.004)
    assert found.result.hom_m == pytest.approx(1.30)


@pytest.mark.parametrize("rise", [0.3, -0.8])
def test_slope_is_not_sheared_into_the_section(rise):
    """Heights above the terrain below each point would make a tilted ring, 5 % too wide on a rise of 0.3."""
    found = measured(stem(x=10, base=rise * 10), Slope(rise=rise))
    assert found.z_ground_m == pytest.approx(10 * rise, abs=0.01)
    assert found.result.dbh_cm == pytest.approx(40.0, rel=0.004)
    assert found.result.section.lean_deg < 0.3


@pytest.mark.parametrize("lean_deg", [15.0, -25.0])
def test_leaning_stem_stands_where_its_foot_is(lean_deg):
    """Its points are uphill or downhill of its foot; the ground there is not the stem's."""
    found = measured(stem(x=5, base=2.5, lean_deg=lean_deg), Slope(rise=0.5))
    assert found.z_ground_m == pytest.approx(2.5, abs=0.02)
    assert found.result.dbh_cm == pytest.approx(40.0, rel=0.005)
    offset = 1.30 * np.tan(np.radians(lean_deg))
    np.testing.assert_allclose(found.xy_m, [5 + offset, 0], atol=0.02)


def test_tapering_stem_shows_the_height_it_is_measured_at():
    """Wrong by 10 cm of height would be wrong by 4 mm."""
    found = measured(stem(radius=0.25, taper=0.02, base=-3.0), Slope(z0=-3.0))
    assert found.result.dbh_cm == pytest.approx(200 * (0.25 - 0.02 * 1.30), rel=0.003)


def test_float32_and_unordered():
    points = stem().astype(np.float32)
    shuffled = np.random.default_rng(0).permutation(points)
    assert measured(points, Slope()).result.dbh_cm == measured(shuffled, Slope()).result.dbh_cm


class TestWithoutGround:
    def test_foot_cut_off_by_the_segmentation(self):
        """The model knows the stem's lowest point; the trunk's own points begin 0.3 m higher."""
        found = measured(stem(base=5.0, taper=0.02, z=(0.3, 4)), Slope(z0=5.0, kind="stem_base"))
        assert found.z_ground_m == pytest.approx(5.0)
        assert found.ground_kind == "stem_base"
        assert STEM_BASE_NOTE in found.result.flags

    def test_stem_reaching_lower_than_the_model(self):
        found = measured(stem(base=2.0, z=(0.0, 4)), Slope(z0=3.0, kind="stem_base"))
        assert found.z_ground_m == pytest.approx(2.0, abs=0.03)

    def test_stem_seen_only_high_up_is_doubtful(self):
        found = measured(stem(base=0.0, z=(2.5, 7)), Slope(z0=0.0, kind="stem_base"))
        assert found.z_ground_m == pytest.approx(2.5, abs=0.05)
        assert any("2.5 m above the lowest" in flag for flag in found.result.flags)


def test_refused_stem_has_a_place_and_no_number():
    found = measured(stem(x=3, y=4, z=(2.0, 5.0)), Slope())
    assert isinstance(found.result, Refusal)
    assert found.result.code == "no_band"
    np.testing.assert_allclose(found.xy_m, [3, 4], atol=0.3)
    assert np.isfinite(found.z_ground_m)


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.full((20, 3), np.nan)], ids=["empty", "nan"])
def test_nothing_to_measure(points):
    found = measured(points, Slope())
    assert found.result.code == "no_points"
    assert found.n_points == len(points)
    assert np.isnan(found.xy_m).all()


def test_settings_and_curves_are_passed_on():
    found = measured(stem(), Slope(), settings=MeasureSettings(curve="ellipse", breast_height_m=1.4), curves=())
    assert found.result.curve == "ellipse"
    assert set(found.result.fits) == {"ellipse"}
    assert found.result.section.hom_m == pytest.approx(1.47)


class TestMeasureAll:
    def plot(self):
        stems = [stem(x=3 * i, radius=0.1 + 0.03 * i, n=3000, seed=i) for i in range(4)]
        trunks = TrunkSet.from_point_sets([np.arange(3000) + 3000 * i for i in range(4)])
        return trunks, np.concatenate(stems)

    def test_every_trunk(self):
        trunks, points = self.plot()
        found = measure_all(trunks, lambda trunk: points[trunk.points], ground=Slope(), curves=())
        assert list(found) == [1, 2, 3, 4]
        for i in range(4):
            assert found[i + 1].result.dbh_cm == pytest.approx(20 + 6 * i, rel=0.01)

    def test_reports_and_stops(self):
        trunks, points = self.plot()
        seen = []

        def progress(fraction, message=""):
            seen.append((fraction, message))
            if fraction >= 0.5:
                raise CancelledError

        with pytest.raises(CancelledError):
            measure_all(trunks, lambda trunk: points[trunk.points], ground=Slope(), curves=(), progress=progress)
        assert [fraction for fraction, _ in seen] == [0.0, 0.25, 0.5]
        assert seen[1][1] == "Measuring tree 2"

    def test_no_trunks(self):
        assert measure_all(TrunkSet(), lambda trunk: np.empty((0, 3)), ground=Slope()) == {}

    def test_one_bad_trunk_does_not_stop_the_others(self):
        trunks, points = self.plot()
        spoilt = points.copy()
        spoilt[:3000] = np.nan
        found = measure_all(trunks, lambda trunk: spoilt[trunk.points], ground=Slope(), curves=())
        assert not found[1].result
        assert all(found[i].result for i in (2, 3, 4))


def synthetic_plot():
    """Points in the world frame, and the true trees of the rendered plot."""
    folder = DATA / "synthetic_360"
    if not folder.is_dir():
        pytest.skip(f"the rendered plot is not at {folder.name} beside the repository")
    raw = (folder / "dense_unscaled.ply").read_bytes()
    start = raw.index(b"end_header\n") + 11
    points = np.frombuffer(raw[start:], [("xyz", "<f4", 3), ("rgb", "u1", 3)])["xyz"]
    truth = json.loads((folder / "world_from_model.json").read_text())
    x, y, z, w = truth["rotation_xyzw"]
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    world = truth["metres_per_unit"] * points @ rotation.T + truth["translation"]
    return world, list(csv.DictReader((folder / "gt_dbh.csv").read_text().splitlines()))


def test_rendered_plot_with_known_diameters():
    world, trees = synthetic_plot()
    errors, leans, held = [], [], 0
    for tree in trees:
        centre = np.array([float(tree["x"]), float(tree["y"])])
        z_ground, true_cm = float(tree["ground_z_mean"]), float(tree["dbh_tape_cm"])
        near = np.hypot(*(world[:, :2] - centre).T) < true_cm / 200 + 0.3
        points = world[near & (world[:, 2] > z_ground + 0.3) & (world[:, 2] < z_ground + 5)]
        found = measured(points, Slope(z0=z_ground), settings=MeasureSettings())
        assert isinstance(found.result, DbhEstimate)
        held += found.result.interval[0] <= true_cm <= found.result.interval[1]
        errors.append(found.result.dbh_cm / true_cm - 1)
        leans.append(found.result.section.lean_deg - float(tree["lean_deg"]))
        if found.result.quality == "good":
            assert abs(errors[-1]) < 0.06
    assert np.median(np.abs(errors)) < 0.03
    assert np.median(np.abs(leans)) < 0.5
    assert len(errors) == 12
    assert held >= 10


def test_trunk_type_is_what_the_plot_holds():
    trunk = Trunk(1, np.arange(5000))
    found = measure_all(TrunkSet((trunk,)), lambda trunk: stem()[trunk.points], ground=Slope())
    assert found[1].n_points == len(trunk)


def contact_heights(radius, lean_deg, rise):
    """Heights at which lines on a leaning cylinder's surface meet ground that rises along x, by formula."""
    lean, angle = np.radians(lean_deg), np.linspace(0, 2 * np.pi, 3600)
    u, w = np.array([np.cos(lean), 0, -np.sin(lean)]), np.array([np.sin(lean), 0, np.cos(lean)])
    start = radius * (np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * np.array([0.0, 1.0, 0.0]))
    along = (rise * start[:, 0] - start[:, 2]) / (w[2] - rise * w[0])
    return start[:, 2] + along * w[2]


@pytest.mark.parametrize("lean_deg", [0.0, 15.0, -20.0])
@pytest.mark.parametrize("rise", [0.3, -0.6])
@pytest.mark.parametrize("base", ["uphill", "midpoint", "downhill"])
def test_heights_count_from_the_side_of_the_slope_that_is_asked_for(base, rise, lean_deg):
    heights = contact_heights(0.2, lean_deg, rise)
    expected = {"uphill": heights.max(), "downhill": heights.min(), "midpoint": (heights.max() + heights.min()) / 2}
    points = stem(x=5, base=5 * rise, lean_deg=lean_deg, n=8000)
    found = measured(points, Slope(rise=rise), settings=SMOOTH.changed(base=base))
    assert found.z_ground_m == pytest.approx(5 * rise + expected[base], abs=0.01)
    assert found.result.hom_m == pytest.approx(1.30)
    section_z = found.z_ground_m + found.result.hom_m
    assert found.xy_m[0] == pytest.approx(5 + (section_z - 5 * rise) * np.tan(np.radians(lean_deg)), abs=0.01)
    assert found.protocol == Protocol(1.30, base, "vertical", "nothing")


@pytest.mark.parametrize("along", ["stem", "vertical"])
def test_a_ring_drawn_at_breast_height_along_a_leaning_stem_lies_there(along):
    settings = SMOOTH.changed(along=along)
    points = stem(lean_deg=25.0, n=8000)
    plain = measured(points, Slope(), settings=settings)
    angle = np.arange(48) * (2 * np.pi / 48)
    section = np.column_stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), np.zeros(48)])
    ring = plain.result.section.stem_from_section.apply(section)
    drawn = measured(points, Slope(), settings=settings, ring_m=ring)
    assert drawn.result.hom_m == pytest.approx(plain.result.hom_m, abs=0.005)
    assert drawn.result.flag_codes == ("drawn",)
    assert drawn.protocol.breast_height_m == 1.30 and drawn.protocol.along == along
    higher = measured(points, Slope(), settings=settings, ring_m=ring + [0.0, 0.0, 0.2])
    assert "not_at_height" in higher.result.flag_codes


def test_what_is_placed_goes_before_the_slope_and_is_told():
    points = stem(x=5, base=2.5)
    found = measured(points, Slope(rise=0.5), settings=SMOOTH.changed(base="uphill"), z_ground_m=2.8)
    assert found.z_ground_m == 2.8 and found.protocol.base == "placed"
    assert measured(stem(), Slope(kind="stem_base")).protocol.base == "stem"
