"""DBH Studio: tree diameters at breast height from point clouds of forest plots.

Read, segment and measure in five lines::

    import dbh_studio

    plot = dbh_studio.open_plot("plot.laz")               # a file, a folder or a saved NAME.dbh
    plot.find_trunks()                                    # ground, trunks
    for stem in plot.inventory():
        print(stem.stem_id, stem.dbh_cm, stem.reason)     # dbh_cm is None where it cannot be told; reason says why

or measure one stem that is already cut out, z being the height above the ground::

    estimate = dbh_studio.measure_stem(points_m)          # DbhEstimate, or a falsy Refusal with reason and remedy
    print(estimate.dbh_cm if estimate else estimate.reason)
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# From 1.29 on onnxruntime reports to its makers what it runs, and keeps a number for the computer, from the moment it
# is imported. Here, so that it is set before anything of this program, or a child of it, imports it.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

if TYPE_CHECKING:
    from dbh_studio.api import Plot, open_plot
    from dbh_studio.core.cloud import PointCloud
    from dbh_studio.core.dbh import DbhEstimate, Refusal, measure_stem
    from dbh_studio.errors import StudioError
    from dbh_studio.settings import Settings

_HOMES = {
    "Plot": "dbh_studio.api",
    "open_plot": "dbh_studio.api",
    "PointCloud": "dbh_studio.core.cloud",
    "DbhEstimate": "dbh_studio.core.dbh",
    "Refusal": "dbh_studio.core.dbh",
    "measure_stem": "dbh_studio.core.dbh",
    "Settings": "dbh_studio.settings",
    "StudioError": "dbh_studio.errors",
}

__all__ = ["DbhEstimate", "Plot", "PointCloud", "Refusal", "Settings", "StudioError", "measure_stem", "open_plot"]


def __getattr__(name: str) -> Any:
    # Imported on first use, so that `dbh-studio --help` and `doctor` need neither numpy nor a second.
    if name in _HOMES:
        from importlib import import_module

        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
