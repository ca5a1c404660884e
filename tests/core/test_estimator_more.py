"""The estimator on what is no stem, on coordinates that are none, and on points of which many are equal."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.estimator import EstimatorResult, estimate_diameter
from dbh_studio.core.estimator.estimate import assess_stem
from dbh_studio.core.estimator.sample import sample_points
from dbh_studio.core.measured import Refusal
from dbh_studio.core.stem_course import stem_course
from dbh_studio.core.transforms import Similarity
from dbh_studio.settings import EstimatorSettings

RADIUS_M = 0.15
LOW_M, HIGH_M = 0.8, 2.0


def rng() -> np.random.Generator:
    return np.random.default_rng(11)


def heights(n: int) -> np.ndarray:
    return np.random.default_rng(12).uniform(LOW_M, HIGH_M, n)


def stem(n: int = 900, *, radius_m: float = RADIUS_M, at_m: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    dice = rng()
    angle, radius = dice.uniform(0.0, 2 * np.pi, n), radius_m * (1.0 + dice.normal(0.0, 0.02, n))
    return np.column_stack([at_m[0] + radius * np.cos(angle), at_m[1] + radius * np.sin(angle), heights(n)])


def with_far(at_m: float, n: int) -> np.ndarray:
    return np.vstack([stem(), np.column_stack([rng().normal(0.0, at_m, (n, 2)), heights(n)])])


FLAT, LINE, NOTHING = np.linspace(-1.0, 1.0, 900), np.linspace(LOW_M, HIGH_M, 900), np.zeros(900)
NO_STEMS = {
    "one point": np.repeat([[0.0, 0.0, 1.3]], 1000, axis=0),
    "two points": np.repeat([[0.0, 0.0, 1.2], [0.3, 0.0, 1.4]], 1000, axis=0),
    "three points": np.repeat([[0.0, 0.0, 1.2], [0.3, 0.0, 1.4], [0.1, 0.2, 1.3]], 500, axis=0),
    "horizontal line": np.column_stack([FLAT, NOTHING, NOTHING + 1.3]),
    "vertical line": np.column_stack([NOTHING, NOTHING, LINE]),
    "slanting line": np.column_stack([FLAT, FLAT, LINE]),
    "wall": np.column_stack([rng().uniform(-1.0, 1.0, 2000), np.zeros(2000), heights(2000)]),
    "floor": np.column_stack([rng().uniform(-1.0, 1.0, (2000, 2)), np.full(2000, 1.3)]),
    "cube": np.column_stack([rng().uniform(-1.0, 1.0, (3000, 2)), heights(3000)]),
    "long tails": np.column_stack([rng().standard_cauchy((3000, 2)), heights(3000)]),
    "speck": np.column_stack([rng().normal(0.0, 1e-9, (900, 2)), heights(900)]),
    "ring of a nanometre": stem(radius_m=1e-9),
    "light years": np.column_stack([rng().normal(0.0, 1e20, (900, 2)), heights(900)]),
    "beyond squares": np.column_stack([rng().normal(0.0, 1e300, (900, 2)), heights(900)]),
}


def all_settings() -> list[EstimatorSettings]:
    bare = {"bloat_m": 0.0, "bloat_chance": 0.0, "bark_share": 0.0}
    return [
        EstimatorSettings(),
        EstimatorSettings(**bare),
        EstimatorSettings(method="circle", definition="area"),
        EstimatorSettings(method="circle", axis="vertical", definition="curve", **bare),
    ]


def check(result: EstimatorResult) -> None:
    assert set(result.diameters) == {"tape", "curve", "area"}
    for diameter in result.diameters.values():
        assert 0.0 < diameter.low_cm < diameter.value_cm < diameter.high_cm < np.inf
    for array in (result.outline_uv_m, result.outline_sd_m, result.position_m, result.spread.terms(0.5)):
        assert np.isfinite(array).all()


@pytest.mark.parametrize("settings", all_settings(), ids=["ring", "ring bare", "circle", "circle upright bare"])
@pytest.mark.parametrize("name", NO_STEMS)
def test_what_is_no_stem_is_refused(name, settings):
    found = assess_stem(NO_STEMS[name], settings=settings)
    assert isinstance(found.refusal, Refusal)
    if found.result is not None:
        check(found.result)


@pytest.mark.parametrize("settings", all_settings(), ids=["ring", "ring bare", "circle", "circle upright bare"])
@pytest.mark.parametrize("n", [30, 31, 60, 61, 900])
def test_intervals_hold_their_value_by_every_definition(settings, n):
    found = assess_stem(stem(n), settings=settings)
    assert found.result is not None
    check(found.result)
    assert found.result.diameters["area"].value_cm == pytest.approx(200.0 * RADIUS_M, rel=0.04)


@pytest.mark.parametrize("radius_m", [0.005, 0.012, 0.05, 1.4])
def test_thin_and_thick_stems_have_intervals(radius_m):
    found = assess_stem(stem(radius_m=radius_m))
    assert found.result is not None
    check(found.result)


@pytest.mark.parametrize("at_m", [1e12, 1e100, 1e300])
def test_points_absurdly_far_away_are_left_out(at_m):
    alone = estimate_diameter(stem())
    assert isinstance(alone, EstimatorResult)
    for n in (1, 40):
        result = estimate_diameter(with_far(at_m, n))
        assert isinstance(result, EstimatorResult)
        assert result.dbh_cm == alone.dbh_cm


def test_half_precision_will_do():
    result = estimate_diameter(stem().astype(np.float16))
    assert isinstance(result, EstimatorResult)
    assert result.dbh_cm == pytest.approx(200.0 * RADIUS_M, rel=0.03)


def test_the_sample_does_not_tell_zeros_apart():
    # Of rounded points about zero many are at 0 and many at -0, which are equal and yet other bits. Which of them the
    # median is, and so which ones are left when it is taken off, hangs on the order of the points.
    points = np.round(rng().normal(0.0, 0.2, (5000, 3)), 1)
    assert (np.signbit(points) & (points == 0.0)).sum() > 100
    first, second = (each[sample_points(each, 300, seed=0)] for each in (points, points + 0.0))
    np.testing.assert_array_equal(first, second)


def test_a_course_leaves_out_what_is_not_finite():
    points = stem(4000)
    angle = np.arange(72) * (2 * np.pi / 72)
    outline = RADIUS_M * np.column_stack([np.cos(angle), np.sin(angle)])
    frame = Similarity(np.eye(3), np.array([0.0, 0.0, 1.3]))
    broken = points.copy()
    broken[::7, 0], broken[1::7, 1], broken[2::7, 2] = np.nan, np.inf, -np.inf
    course = stem_course(broken, frame, outline)
    assert course.seen.sum() > 8
    np.testing.assert_allclose(course.log_size[course.seen], 0.0, atol=0.02)


def test_last_bits_of_the_points_do_not_matter():
    """The kind of processor decides them, where a cloud was turned; points must not be drawn by them."""
    dice = rng()
    angle, height = dice.uniform(-2.0, 2.0, 9000), dice.uniform(0.5, 2.3, 9000)
    radius = RADIUS_M + 0.01 * dice.standard_normal(9000)
    points = np.round(np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height]), 4)
    other = points * (1.0 + 4e-16 * dice.choice([-1, 1], points.shape))
    assert (other != points).any()
    assert estimate_diameter(other).dbh_cm == pytest.approx(estimate_diameter(points).dbh_cm, rel=1e-3)


def test_the_outline_is_as_large_as_the_diameter_where_passes_moved_it():
    dice = rng()
    angle, height = dice.uniform(-np.pi, np.pi, 6000), dice.uniform(0.8, 2.0, 6000)
    which = np.minimum(((angle + np.pi) / (2 * np.pi / 3)).astype(int), 2)
    shift = 0.02 * np.array([[1.0, 0.0], [-0.5, 0.9], [-0.3, -0.9]])[which]
    radius = 0.2 + 0.003 * dice.standard_normal(6000)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    points[:, :2] += shift
    result = estimate_diameter(points, settings=EstimatorSettings(bark_share=0.0, max_half_width=1.0))
    drawn_cm = 200.0 * float(np.sqrt((result.outline_uv_m**2).sum(axis=1).mean()))
    assert drawn_cm == pytest.approx(result.diameters["area"].value_cm, rel=0.004)
    assert 200.0 * result.rings[0].radius_m == pytest.approx(drawn_cm, rel=0.02)
