"""Where the studio keeps what it can make again. Of packages nothing is needed: the doctor looks here, too."""

from __future__ import annotations

import os
from pathlib import Path

CACHE_VARIABLE = "DBH_STUDIO_CACHE"


def cache_folder(cache_dir: Path | None = None) -> Path:
    """The given folder, else the one named by the environment variable DBH_STUDIO_CACHE, else the user's cache.

    It may not be there yet.
    """
    if cache_dir is not None:
        return Path(cache_dir)
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        return Path(named)
    try:
        from platformdirs import user_cache_path
    except ImportError:
        return Path.home() / ".cache" / "dbh-studio"
    return user_cache_path("dbh-studio", appauthor=False)
