"""How long work reports and is stopped, without knowing threads, bars or browsers."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called between chunks of long work.

    It reports and it stops: an implementation raises `errors.CancelledError` when the person has pressed Cancel.
    """

    def __call__(self, fraction: float, message: str = "") -> None:
        """Report that `fraction` (0..1) of the work is done, and what is being done now."""


def ignore_progress(fraction: float, message: str = "") -> None:
    """The `Progress` of a caller that does not care."""


def subprogress(progress: Progress, start: float, stop: float) -> Progress:
    """Map a step's own 0..1 onto the interval [start, stop] of the whole."""

    def report(fraction: float, message: str = "") -> None:
        progress(start + (stop - start) * min(max(fraction, 0.0), 1.0), message)

    return report
