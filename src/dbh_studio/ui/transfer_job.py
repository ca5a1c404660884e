"""The transfer to LiDAR as a job of the studio: what it says is told in the words of the panel."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from dbh_studio.app.transfer_plot import check_outputs, transfer_plot
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.ui.panel_words import errors_reworded, reworded

if TYPE_CHECKING:
    from dbh_studio.app.transfer_plot import TransferReport, TransferRequest

_OPEN_IT = "open it by itself, set it there, and name its saved plot, NAME.dbh, here"
WORDS = (
    ("Say it: --lidar-scale metres, or metres per unit.", f"A scale is set in step 2: {_OPEN_IT}."),
    ("or that of the LiDAR file (--lidar-up)", f"or that of the LiDAR file: {_OPEN_IT}"),
    ("let it take the LiDAR's (--set-scale)", "tick “Take the LiDAR's scale”"),
    ("or say that it may be overwritten (--overwrite)", "or tick “Replace an earlier one”"),
    ("Choose another folder (--out)", "Choose another folder under “Save in”"),
    (", in the studio or with `dbh-studio run`", " in step 3"),
    (" (--similarity)", ""),
    (" (--refine)", ""),
)


def transfer(*call: Any, progress: Progress = ignore_progress) -> TransferReport:
    """As `transfer_plot`; for a job."""
    with errors_reworded(WORDS):
        report = transfer_plot(*call, progress=progress)
    return replace(report, notes=tuple(reworded(note, WORDS) for note in report.notes))


def check_before(request: TransferRequest) -> None:
    """As `check_outputs`."""
    with errors_reworded(WORDS):
        check_outputs(request)
