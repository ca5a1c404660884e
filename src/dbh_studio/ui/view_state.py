"""What one tab is looking at: never saved, never undone."""

from __future__ import annotations

from dataclasses import dataclass

from dbh_studio.core.review_queue import QueueFilter
from dbh_studio.ui.scene import ColourMode
from dbh_studio.ui.steps import StepName


@dataclass
class ViewState:
    """Selection, step and table order of one tab. Only the tab's own worker thread changes it.

    Attributes:
        selected: The tree whose card is shown.
        several: All that are chosen, `selected` among them, where there are several; else empty.
        review_filter: Which trees the table shows.
    """

    step: StepName = "open"
    selected: int | None = None
    mode: ColourMode = "Original"
    sort_column: str = "id"
    sort_descending: bool = False
    n_inspected: int = 0
    several: frozenset[int] = frozenset()
    review_filter: QueueFilter = "all"

    @property
    def chosen(self) -> tuple[int, ...]:
        """The trees that are chosen, in order of number."""
        return tuple(sorted(self.several)) or (() if self.selected is None else (self.selected,))
