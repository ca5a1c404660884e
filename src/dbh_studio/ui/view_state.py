"""What one tab is looking at: never saved, never undone."""

from __future__ import annotations

from dataclasses import dataclass

from dbh_studio.ui.scene import ColourMode
from dbh_studio.ui.steps import StepName


@dataclass
class ViewState:
    """Selection, step and table order of one tab. Only the tab's own worker thread changes it."""

    step: StepName = "open"
    selected: int | None = None
    mode: ColourMode = "Original"
    sort_column: str = "id"
    sort_descending: bool = False
    n_inspected: int = 0
