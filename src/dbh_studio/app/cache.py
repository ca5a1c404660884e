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


def why_not_writable(folder: Path) -> str:
    """Why files cannot be put into a folder, which may have to be made; empty where they can. Makes nothing."""
    above = (folder.absolute(), *folder.absolute().parents)
    # os.path, not pathlib: that one raises where a folder may not be entered.
    existing = next(path for path in above if os.path.exists(path))  # noqa: PTH110
    if not os.path.isdir(existing):  # noqa: PTH112
        return f"{existing.name} is not a folder"
    return "" if os.access(existing, os.W_OK | os.X_OK) else "permission denied"
