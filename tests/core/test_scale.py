import numpy as np
import pytest

from dbh_studio.core.scale import MeasuredLength, ScaleEstimate, combine_lengths


def length(measured, sigma=0.001, systematic=0.0, true=1.0):
    return MeasuredLength("", true, 0.0, measured, sigma, systematic)


def test_scatter_averages_out_but_the_shared_part_does_not():
    one = combine_lengths([length(1.0, 0.004, 0.003)])
    many = combine_lengths([length(1.0, 0.004, 0.003)] * 100)
    assert one.standard_error == pytest.approx(np.hypot(0.004, 0.003), rel=1e-6)
    assert many.standard_error == pytest.approx(np.hypot(0.0004, 0.003), rel=1e-6)


def test_residuals_are_relative_to_the_truth_and_balance():
    combined = combine_lengths([length(1.01), length(0.99)])
    assert combined.metres_per_unit == pytest.approx(1.0, rel=3e-4)
    assert combined.relative_residuals == pytest.approx((0.01, -0.01), rel=0.02)
    assert combined.freedom == 1
    assert combined.chi2 == pytest.approx(200, rel=0.05)


def test_a_zero_sigma_does_not_break_it():
    assert combine_lengths([length(2.0, 0.0)]).metres_per_unit == pytest.approx(0.5)


@pytest.mark.parametrize("lengths", [[], [length(0.0)], [length(1.0, true=-1.0)]])
def test_wrong_calls(lengths):
    with pytest.raises(ValueError):
        combine_lengths(lengths)


@pytest.mark.parametrize("value", [0.0, -1.0, float("inf"), float("nan")])
def test_a_scale_is_positive(value):
    with pytest.raises(ValueError, match="positive"):
        ScaleEstimate(value, "marker")
