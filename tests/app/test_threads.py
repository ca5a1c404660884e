"""`map_in_threads`: the results of `map`, from two threads."""

import threading

import pytest

from dbh_studio.app.threads import map_in_threads


@pytest.mark.parametrize("n", [0, 1, 2, 3, 4, 5, 50])
def test_results_come_in_the_order_of_the_items(n):
    assert list(map_in_threads(lambda i: i * i, range(n))) == [i * i for i in range(n)]


def test_two_calls_run_at_once():
    # Each waits for the other: alone, the first would never return.
    together = threading.Barrier(2, timeout=30)
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
    called = []
    results = map_in_threads(lambda i: called.append(i), range(100))
    next(results)
    results.close()
    assert len(called) <= 5
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("ThreadPoolExecutor")]
