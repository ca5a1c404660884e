"""In place of work in a child process, where a test needs the time to press Cancel; light to import there."""

from __future__ import annotations

import time
from typing import Any

from dbh_studio.core.progress import Progress


def work(*_args: Any, progress: Progress, **_options: Any) -> None:
    """Longer than any test waits."""
    for step in range(10_000):
        progress(0.1 + step / 20_000, "Not done yet")
        time.sleep(0.02)
