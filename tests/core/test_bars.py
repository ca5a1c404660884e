import numpy as np
import pytest

from dbh_studio.core.bars import Bar, scale_from_bars

UP = np.array([0.0, 0.0, 1.0])
TRUE = 1.7


def bar(direction, length_m, *, factor=1.0, start=(3.0, -2.0, 5.0), **more):
    """A bar that measures `factor` times too long in a reconstruction of `TRUE` metres per unit."""
    unit = np.asarray(direction, float) / np.linalg.norm(direction)
    p = np.asarray(start, float)
    return Bar(p, p + unit * length_m * factor / TRUE, length_m, **more)


def test_exact_bars_give_the_exact_scale():
    report = scale_from_bars([bar([1, 0, 0], 2.0), bar([0, 0, 1], 1.0), bar([1, 1, 0], 3.0, role="check")], up_src=UP)
    assert report.estimate.metres_per_unit == pytest.approx(TRUE, rel=1e-12)
    assert report.estimate.source == "bars"
    assert report.horizontal_over_vertical == pytest.approx(1.0)
    assert report.verdict.level == "good"
    assert [r.lie for r in report.residuals] == ["horizontal", "vertical", "horizontal"]
    assert all(abs(r.residual_m) < 1e-12 for r in report.residuals)


def test_long_and_sure_bars_weigh_more():
    report = scale_from_bars([bar([1, 0, 0], 5.0), bar([0, 1, 0], 0.5, factor=1.002, length_se_m=0.002)])
    error = report.estimate.metres_per_unit / TRUE - 1
    assert -0.0005 < error < 0


def test_the_standard_error_covers_the_error_and_never_falls_below_the_floor():
    rng = np.random.default_rng(0)
    inside = []
    for _ in range(200):
        bars = [
            bar(rng.normal(size=3), 1.0, factor=1 + rng.normal(0, 0.002), sigma_src=0.002 / TRUE, length_se_m=1e-6)
            for _ in range(6)
        ]
        estimate = scale_from_bars(bars).estimate
        inside.append(abs(estimate.metres_per_unit - TRUE) < 2 * estimate.standard_error)
    assert np.mean(inside) > 0.93
    many = [bar(rng.normal(size=3), 10.0, length_se_m=1e-9) for _ in range(500)]
    estimate = scale_from_bars(many).estimate
    assert estimate.standard_error / estimate.metres_per_unit >= 0.0005


def test_what_no_number_of_bars_averages_out_is_that_of_the_caller():
    bars = [bar([1, 0, 0], 2.0, length_se_m=1e-9), bar([0, 1, 0], 2.0, length_se_m=1e-9)]
    for share in (0.002, 0.02):
        report = scale_from_bars(bars, systematic_share=share)
        assert [r.sigma_pct for r in report.residuals] == pytest.approx([100 * share] * 2, rel=1e-6)


def test_check_bars_do_not_set_the_scale():
    controls = [bar([1, 0, 0], 2.0), bar([0, 1, 0], 2.0)]
    alone = scale_from_bars(controls)
    tested = scale_from_bars([*controls, bar([1, 1, 0], 2.0, factor=1.05, role="check", name="rod 3")])
    assert tested.estimate == alone.estimate
    assert tested.verdict.code == "check_failed"
    assert "rod 3" in tested.verdict.message and "+5.00 %" in tested.verdict.message


def test_a_stretched_reconstruction_shows():
    bars = [bar([1, 0, 0], 2.0), bar([0, 1, 0], 2.0), bar([0, 0, 1], 2.0, factor=0.97)]
    report = scale_from_bars(bars, up_src=UP)
    assert report.horizontal_over_vertical == pytest.approx(1 / 0.97, rel=1e-6)
    assert report.verdict.code == "stretched"
    assert scale_from_bars(bars).horizontal_over_vertical is None


def test_controls_that_contradict_widen_the_error_and_are_named():
    report = scale_from_bars([bar([1, 0, 0], 1.0, name="a"), bar([0, 1, 0], 1.0, factor=1.03, name="b")])
    assert report.verdict.code == "inconsistent"
    assert report.estimate.standard_error / report.estimate.metres_per_unit > 0.01


def test_one_bar_is_usable_but_unchecked():
    report = scale_from_bars([bar([1, 0, 0], 1.0)])
    assert report.estimate.metres_per_unit == pytest.approx(TRUE)
    assert (report.verdict.level, report.verdict.code) == ("caution", "unchecked")


@pytest.mark.parametrize(
    ("bars", "code"),
    [
        ([], "no_control"),
        ([bar([1, 0, 0], 1.0, role="check")], "no_control"),
        ([Bar(np.zeros(3), np.ones(3), 0.0)], "no_length"),
        ([Bar(np.zeros(3), np.ones(3), -1.0)], "no_length"),
        ([Bar(np.zeros(3), np.ones(3), float("nan"))], "no_length"),
        ([Bar(np.ones(3), np.ones(3), 1.0)], "same_ends"),
        ([Bar(np.ones(3), np.full(3, np.nan), 1.0)], "same_ends"),
    ],
)
def test_what_cannot_give_a_scale_is_refused_with_a_remedy(bars, code):
    report = scale_from_bars(bars)
    assert report.estimate is None
    assert report.verdict.code == code
    assert report.verdict.level == "refused"
    assert report.verdict.remedy


def test_wrong_calls():
    with pytest.raises(ValueError, match="shape"):
        Bar(np.zeros(2), np.ones(3), 1.0)
    with pytest.raises(ValueError, match="role"):
        Bar(np.zeros(3), np.ones(3), 1.0, role="other")
    with pytest.raises(ValueError, match="negative"):
        Bar(np.zeros(3), np.ones(3), 1.0, sigma_src=-1.0)
