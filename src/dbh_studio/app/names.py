"""Names of files that are made for a plot."""

from __future__ import annotations

import re

# Bytes. File systems allow 255, and what is written beside adds a suffix and a process number.
_LONGEST_NAME = 180
# Of devices, on Windows, whatever suffix follows.
_DEVICES = re.compile(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\.|\Z)")


def file_name(plot_id: str) -> str:
    """A plot's name as that of a file: portable, and short enough for what is put around it."""
    name = re.sub(r'[\x00-\x1f\x7f\\/:*?"<>|]+', "_", plot_id).strip(". ")
    name = name.encode("utf-8", "replace")[:_LONGEST_NAME].decode("utf-8", "ignore").rstrip(". ") or "plot"
    return f"_{name}" if _DEVICES.match(name) else name
