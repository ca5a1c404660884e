"""The same work on many values, on two threads.

Threads, not processes: they start at once, share the cloud, and end with whatever ends the process they are in. Much
of the work on a stem runs in numpy and scipy without Python's lock: two threads take about three quarters of the time
of one. More would mostly wait for that lock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Value = TypeVar("Value")

_N_THREADS = 2
_N_AHEAD = 4  # so that a thread that is early finds work


def map_in_threads(function: Callable[[Item], Value], items: Sequence[Item]) -> Iterator[Value]:
    """``function(item)`` of every item, in their order; `function` must be safe to call from several threads.

    Where the caller stops listening, or a call raises, no more than the few calls under way are finished.
    """
    if len(items) < 2:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(_N_THREADS) as pool:
        begun = deque(pool.submit(function, item) for item in items[:_N_AHEAD])
        try:
            for done in range(len(items)):
                yield begun.popleft().result()
                begun.extend(pool.submit(function, item) for item in items[done + _N_AHEAD : done + _N_AHEAD + 1])
        finally:
            for future in begun:
                future.cancel()
