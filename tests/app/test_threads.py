"""`map_in_threads`: the results of `map`, from two threads. `CallAhead`: a call begun before it is wanted."""

import threading
import time

import numpy as np
import pytest

from dbh_studio.app.threads import CallAhead, map_in_threads
from dbh_studio.core.progress import ignore_progress
from dbh_studio.errors import CancelledError

PATIENCE_S = 120.0


@pytest.mark.parametrize("n", [0, 1, 2, 3, 4, 5, 50])
def test_results_come_in_the_order_of_the_items(n):
    assert list(map_in_threads(lambda i: i * i, range(n))) == [i * i for i in range(n)]


def test_two_calls_run_at_once():
    # Each waits for the other: alone, the first would never return.
    together = threading.Barrier(2, timeout=PATIENCE_S)
    list(map_in_threads(lambda _: together.wait(), range(8)))


def test_an_error_comes_out_after_the_results_before_it_and_ends_the_work():
    called = []

    def work(i):
        called.append(i)
        if i == 3:
            raise KeyError("three")
        return i

    seen = []
    with pytest.raises(KeyError, match="three"):
        for result in map_in_threads(work, range(100)):
            seen.append(result)  # noqa: PERF402 - what came before the error must be kept
    assert seen == [0, 1, 2]
    assert len(called) < 10


def test_what_nobody_waits_for_is_not_begun():
    called, before = [], set(threading.enumerate())
    results = map_in_threads(lambda i: called.append(i), range(100))
    next(results)
    results.close()
    assert len(called) <= 5
    left = set(threading.enumerate()) - before
    assert not [thread for thread in left if thread.name.startswith("ThreadPoolExecutor")]


def test_a_call_made_ahead_is_made_once_and_reports_to_who_waits_for_it():
    called, reports = [], []
    is_wanted = threading.Event()

    def total(points, factor, *, progress):
        called.append(factor)
        assert is_wanted.wait(PATIENCE_S)
        progress(0.5, "half")
        return factor * float(points.sum())

    def begin_to_wait(fraction, message=""):
        reports.append((fraction, message))

    points = np.arange(4.0)
    ahead = CallAhead()
    ahead.begin(total, points, 2.0)

    def go_on_when_it_is_waited_for():
        while ahead._progress is not begin_to_wait:
            time.sleep(0.001)
        is_wanted.set()

    threading.Thread(target=go_on_when_it_is_waited_for, daemon=True).start()
    assert ahead.call(total, points, 2.0, progress=begin_to_wait) == 12.0
    assert called == [2.0] and reports == [(0.5, "half")]


@pytest.mark.parametrize("change", ["array", "value", "function", "number"])
def test_another_call_than_the_one_begun_is_made_anew_and_the_begun_one_stops(change):
    stopped = threading.Event()

    def endless(points, factor, *, progress):
        try:
            while True:
                progress(0.0)
        except CancelledError:
            stopped.set()
            raise

    def total(points, factor=2.0, *, progress):
        return factor * float(points.sum())

    points = np.arange(4.0)
    ahead = CallAhead()
    ahead.begin(endless, points, 2.0)
    if change == "function":
        assert ahead.call(total, points, 2.0, progress=ignore_progress) == 12.0
    elif change == "number":
        assert ahead.call(total, points, progress=ignore_progress) == 12.0
    else:
        # An equal array is not the same: nobody compares millions of points.
        arguments = (points.copy(), 2.0) if change == "array" else (points, 3.0)

        def once(fraction, message=""):
            raise CancelledError

        with pytest.raises(CancelledError):
            ahead.call(endless, *arguments, progress=once)
    assert stopped.wait(PATIENCE_S)


def test_an_error_within_gives_the_call_up_and_its_own_error_comes_out_of_it():
    stopped = threading.Event()

    def endless(*, progress):
        try:
            while True:
                progress(0.0)
        finally:
            stopped.set()

    with pytest.raises(KeyError), CallAhead() as ahead:
        ahead.begin(endless)
        raise KeyError
    assert stopped.wait(PATIENCE_S)

    def fails(*, progress):
        raise ValueError("no points")

    ahead = CallAhead()
    ahead.begin(fails)
    with pytest.raises(ValueError, match="no points"):
        ahead.call(fails, progress=ignore_progress)


def test_small_items_are_done_here():
    here = threading.get_ident()
    assert set(map_in_threads(lambda _: threading.get_ident(), range(8), size=3_000)) == {here}
    assert here not in set(map_in_threads(lambda _: threading.get_ident(), range(8), size=1e6))
