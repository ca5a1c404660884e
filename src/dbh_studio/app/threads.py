"""Work on a second thread: the same on many values, or a call that will most likely be wanted.

Threads, not processes: they start at once, share the cloud, and end with whatever ends the process they are in. Much
of the work on a stem runs in numpy and scipy without Python's lock: two threads take about three quarters of the time
of one. More would mostly wait for that lock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any, TypeVar

import numpy as np

from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.errors import CancelledError

Item = TypeVar("Item")
Value = TypeVar("Value")

_N_THREADS = 2
_N_AHEAD = 4  # so that a thread that is early finds work
# Short calls of numpy keep the interpreter's lock: stems of 3 000 points were measured 1.3 times slower by two threads
# than by one, stems of 50 000 points 1.5 times quicker.
_LEAST_POINTS = 15_000


def map_in_threads(
    function: Callable[[Item], Value], items: Sequence[Item], *, size: float = np.inf
) -> Iterator[Value]:
    """``function(item)`` of every item, in their order; `function` must be safe to call from several threads.

    Args:
        function: What is done.
        items: To what.
        size: How many points an item has, about: with few, it is done here, one after another.

    Where the caller stops listening, or a call raises, no more than the few calls under way are finished.
    """
    if len(items) < 2 or size < _LEAST_POINTS:
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


class CallAhead:
    """One long call, begun on a thread of its own before it is known to be wanted.

    What it gives is used only where the very same call is made in the end, so a wrong guess costs time and nothing
    else. As a context it gives the call up where an error is raised within.
    """

    def __init__(self) -> None:
        self._begun: tuple[Callable[..., Any], tuple[Any, ...], Future[Any]] | None = None
        self._progress: Progress = ignore_progress
        self._is_given_up = False

    def __enter__(self) -> CallAhead:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self.give_up()

    def begin(self, function: Callable[..., Value], *args: Any) -> None:
        """Begin ``function(*args, progress=…)``; once."""
        pool = ThreadPoolExecutor(1)
        self._begun = function, args, pool.submit(function, *args, progress=self._report)
        pool.shutdown(wait=False)

    def call(self, function: Callable[..., Value], *args: Any, progress: Progress) -> Value:
        """``function(*args, progress=progress)``: what was begun, if it is this call, else called now.

        Raises:
            Exception: What the call raises, `CancelledError` from `progress` among it.
        """
        if self._begun is None or not _is_same_call(self._begun[:2], (function, args)):
            self.give_up()
            return function(*args, progress=progress)
        self._progress = progress
        try:
            value: Value = self._begun[2].result()
        except BaseException:  # Ctrl+C while waiting
            self.give_up()
            raise
        return value

    def give_up(self) -> None:
        """Stop the call at its next report, and forget what it gives."""
        self._is_given_up = True
        self._begun = None

    def _report(self, fraction: float, message: str = "") -> None:
        if self._is_given_up:
            raise CancelledError
        self._progress(fraction, message)


def _is_same_call(
    first: tuple[Callable[..., Any], tuple[Any, ...]], second: tuple[Callable[..., Any], tuple[Any, ...]]
) -> bool:
    """Whether both call the same function with the same arrays (not copies of them) and equal other values."""
    if first[0] is not second[0] or len(first[1]) != len(second[1]):
        return False
    return all(
        a is b or (not isinstance(a, np.ndarray) and not isinstance(b, np.ndarray) and bool(a == b))
        for a, b in zip(first[1], second[1], strict=True)
    )
