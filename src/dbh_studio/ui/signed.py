"""Who decided something, and when, as it is kept and as a person reads it."""

from __future__ import annotations

import contextlib
from datetime import datetime, timezone


def utc_now() -> str:
    """The time as it is kept: ISO 8601, UTC, to the second."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def signed_words(who: str, when: str) -> str:
    """Who and when, to the minute, in UTC; what is not known is left out, a time that is none stands as it is."""
    with contextlib.suppress(ValueError):
        when = datetime.fromisoformat(when).strftime("%d %b %Y %H:%M")
    return ", ".join(filter(None, (who, when)))
