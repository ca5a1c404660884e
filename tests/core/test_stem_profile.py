"""Diameters along the stem, against stems of which they are known by formula."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.dbh import measure_stem
from dbh_studio.core.measured import Diameter
from dbh_studio.core.stem_profile import ProfilePoint, breast_height_flag, stem_profile
from dbh_studio.settings import MeasureSettings

SMOOTH = MeasureSettings(bark_share=0.0, bloat_m=0.0)


def stem(*, taper=0.01, z=(0.2, 3.0), arc_deg=360.0, n=9000, seed=0):
    """40 cm thick at 1.30 m, round, upright."""
    rng = np.random.default_rng(seed)
    t, height = np.radians(rng.uniform(0, arc_deg, n)), rng.uniform(*z, n)
    r = 0.2 - taper * (height - 1.3) + 0.004 * rng.standard_normal(n)
    return np.column_stack([r * np.cos(t), r * np.sin(t), height])


def test_a_tapering_stem_every_ten_centimetres():
    profile = stem_profile(stem(), settings=SMOOTH)
    heights = [point.height_m for point in profile]
    assert heights == pytest.approx(np.arange(0.3, 2.95, 0.1))
    for point in profile:
        assert point.diameter is not None and point.reason == ""
        assert point.diameter.value_cm == pytest.approx(40.0 - 2.0 * (point.height_m - 1.3), rel=0.01)
        assert point.diameter.holds(40.0 - 2.0 * (point.height_m - 1.3))


def test_where_the_stem_is_hidden_there_is_a_reason_and_no_number():
    points = stem(z=(0.2, 4.0))
    points = points[(points[:, 2] < 1.6) | (points[:, 2] > 2.6)]
    by_height = {point.height_m: point for point in stem_profile(points, settings=SMOOTH)}
    hidden = by_height[2.1]
    assert hidden.diameter is None and hidden.arc_deg is None and "No points" in hidden.reason
    assert by_height[1.3].diameter is not None and by_height[3.3].diameter is not None


def test_no_points_no_profile():
    assert stem_profile(np.empty((0, 3)), settings=SMOOTH) == ()
    assert stem_profile(np.full((100, 3), np.nan), settings=SMOOTH) == ()
    with pytest.raises(ValueError, match="points_m"):
        stem_profile(np.zeros((5, 2)), settings=SMOOTH)


def test_the_order_of_points_does_not_matter():
    points = stem(n=3000)
    assert stem_profile(points, settings=SMOOTH) == stem_profile(points[::-1].copy(), settings=SMOOTH)


def test_scale_widens_and_a_curve_of_the_paper_has_the_shrinkage_profile():
    points = stem(n=3000, z=(0.8, 1.8))
    plain = stem_profile(points, settings=SMOOTH)
    unsure = stem_profile(points, settings=SMOOTH, scale_sd=0.05)
    assert all(b.diameter.half_width > a.diameter.half_width for a, b in zip(plain, unsure, strict=True))
    assert stem_profile(points, settings=SMOOTH.changed(curve="fourier")) == plain


def straight(slope=-2.0):
    return tuple(
        ProfilePoint(height, Diameter(value, 0.98 * value, 1.02 * value), 360.0)
        for height in np.round(np.arange(0.4, 2.3, 0.1), 2)
        for value in [40.0 + slope * (height - 1.3)]
    )


@pytest.mark.parametrize(("value", "word"), [(47.0, "thicker"), (34.0, "thinner")])
def test_a_section_that_the_stem_contradicts_is_flagged(value, word):
    flag = breast_height_flag(straight(), 1.3, Diameter(value, 0.97 * value, 1.03 * value))
    assert flag is not None and flag.code == "profile"
    assert word in flag.words and "40.0 cm" in flag.words


@pytest.mark.parametrize("value", [39.0, 40.0, 41.0])
def test_a_section_that_goes_with_the_stem_is_not_flagged(value):
    assert breast_height_flag(straight(), 1.3, Diameter(value, 0.97 * value, 1.03 * value)) is None


def test_an_uncertain_section_or_too_little_stem_is_not_flagged():
    assert breast_height_flag(straight(), 1.3, Diameter(47.0, 35.0, 63.0)) is None
    above = tuple(point for point in straight() if point.height_m > 1.3)
    assert breast_height_flag(above, 1.3, Diameter(47.0, 45.0, 49.0)) is None
    assert breast_height_flag((), 1.3, Diameter(47.0, 45.0, 49.0)) is None


def test_a_collar_that_a_curve_in_a_band_believes_is_caught_by_the_stem():
    points = stem(taper=0.0)
    points[np.abs(points[:, 2] - 1.37) < 0.2, :2] *= 1.25  # as of ivy: a clean ring, and a wrong diameter
    fourier = measure_stem(points, settings=SMOOTH.changed(curve="fourier"))
    assert fourier.dbh_cm > 48.0
    flag = breast_height_flag(stem_profile(points, settings=SMOOTH), fourier.hom_m, fourier.diameters["tape"])
    assert flag is not None and "thicker" in flag.words


def test_the_scales_error_excuses_no_difference_between_the_diameters_of_one_stem():
    """A weakly scaled cloud: every diameter may be 20 % off, but all by the same."""
    half = 1.645 * np.hypot(0.02, 0.12)
    weak = Diameter(47.0, 47.0 * (1 - half), 47.0 * (1 + half))
    assert breast_height_flag(straight(), 1.3, weak) is None
    flag = breast_height_flag(straight(), 1.3, weak, scale_sd=0.12)
    assert flag is not None and flag.code == "profile"
    points = stem(taper=0.0)
    points[np.abs(points[:, 2] - 1.37) < 0.2, :2] *= 1.25
    circle = measure_stem(points, settings=SMOOTH.changed(curve="circle"), scale_sd=0.12)
    half = circle.diameters["tape"].half_width
    told = Diameter(50.0, 50.0 * (1 - half), 50.0 * (1 + half))
    profile = stem_profile(points, settings=SMOOTH, scale_sd=0.12)
    assert breast_height_flag(profile, 1.3, told, scale_sd=0.12) is not None
    assert breast_height_flag(profile, 1.3, told) is None
