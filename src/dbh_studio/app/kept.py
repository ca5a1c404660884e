"""Reading back what is kept beside a plot and can be made again; what is of no use is as if it were not there."""

from __future__ import annotations

import json
import logging
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from dbh_studio.app.document import Document
from dbh_studio.errors import SettingError

log = logging.getLogger(__name__)

Value = TypeVar("Value")


def read_kept(
    path: Path,
    document: Document,
    build: Callable[[dict[str, Any], Mapping[str, Any]], Value],
    *,
    version: int,
    what: str,
) -> Value | None:
    """What `build` makes of the text ``about`` and the arrays of an archive; None where that is not of this cloud.

    Args:
        path: An ``.npz`` whose ``about`` is JSON with ``version``, ``fingerprint`` and ``n_points``.
        document: The plot.
        build: Given ``about`` and the archive; may raise whatever comes of a damaged file.
        version: Of the format.
        what: For the log: ``The candidates for trunks``.
    """
    if not path.is_file():
        return None
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as saved:
            about = json.loads(str(saved["about"]))
            named = (about["version"], about["fingerprint"], about["n_points"])
            if named != (version, document.source.fingerprint, document.source.n_points):
                return None
            return build(about, saved)
    except (OSError, ValueError, KeyError, TypeError, EOFError, SettingError, zipfile.BadZipFile) as error:
        log.warning("%s cannot be used: %s", what, error)
        return None
