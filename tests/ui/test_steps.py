"""What comes next, for every state of a plot."""

import pytest

from dbh_studio.ui.steps import STEP_TITLES, PlotStatus

STATES = [
    (PlotStatus(), "open"),
    (PlotStatus(has_plot=True), "scale"),
    (PlotStatus(has_plot=True, is_scaled=True), "trunks"),
    (PlotStatus(has_plot=True, is_scaled=True, n_trunks=5, n_measured=4), "inspect"),
    (PlotStatus(has_plot=True, is_scaled=True, n_trunks=5, n_measured=4, n_inspected=1), "export"),
    (PlotStatus(has_plot=True, is_scaled=True, n_trunks=5, n_measured=4, n_inspected=1, is_exported=True), "inspect"),
]


@pytest.mark.parametrize(("status", "expected"), STATES)
def test_the_first_step_that_is_not_done_comes_next(status, expected):
    assert status.next_step() == expected


@pytest.mark.parametrize("status", [status for status, _ in STATES])
def test_there_is_always_a_sentence_that_says_what_to_do(status):
    assert status.hint().endswith((".", "…"))


def test_trees_still_being_measured_are_not_called_refused():
    status = PlotStatus(has_plot=True, is_scaled=True, n_trunks=5, n_measured=2, n_waiting=3)
    assert "could not be measured" not in status.hint()
    assert "3 not measured yet" in status.hint()


def test_refused_trees_are_counted():
    assert "1 could not be measured" in PlotStatus(has_plot=True, is_scaled=True, n_trunks=5, n_measured=4).hint()


def test_an_unscaled_plot_with_trunks_still_needs_its_scale():
    status = PlotStatus(has_plot=True, n_trunks=5)
    assert status.next_step() == "scale"
    assert set(status.done()) == {"open", "trunks"}
    assert set(STEP_TITLES) > status.done()
