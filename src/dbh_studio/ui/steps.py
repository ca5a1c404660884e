"""The five steps a newcomer follows, what is done, and what comes next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

StepName = Literal["open", "scale", "trunks", "inspect", "export"]
STEP_TITLES: dict[StepName, str] = {
    "open": "Open",
    "scale": "Scale",
    "trunks": "Trunks",
    "inspect": "Inspect",
    "export": "Export",
}


@dataclass(frozen=True)
class PlotStatus:
    """As much of a plot as decides which step comes next."""

    has_plot: bool = False
    is_scaled: bool = False
    n_trunks: int = 0
    n_measured: int = 0
    n_waiting: int = 0
    n_inspected: int = 0
    n_reviewed: int = 0
    is_exported: bool = False
    has_photos: bool = False

    def done(self) -> frozenset[StepName]:
        """The steps that need nothing more."""
        reached: dict[StepName, bool] = {
            "open": self.has_plot,
            "scale": self.has_plot and self.is_scaled,
            "trunks": self.n_trunks > 0,
            "inspect": self.n_inspected > 0 or 0 < self.n_trunks <= self.n_reviewed,
            "export": self.is_exported,
        }
        return frozenset(name for name, is_done in reached.items() if is_done)

    def next_step(self) -> StepName:
        """The first step that is not done; ``inspect`` once everything is."""
        done = self.done()
        return next((name for name in STEP_TITLES if name not in done), "inspect")

    def hint(self) -> str:
        """One sentence: what to do now."""
        n_refused = self.n_trunks - self.n_measured - self.n_waiting
        refused = f", {n_refused} could not be measured" if n_refused else ""
        if self.n_waiting:
            return f"{self.n_trunks} trunks found, {self.n_waiting} not measured yet."
        hints: dict[StepName, str] = {
            "open": "Open a point cloud, or upload one.",
            "scale": "This cloud has no scale yet. Find the markers in its photos, or mark a length you know."
            if self.has_photos
            else "This cloud has no scale yet. Mark a length you know, or say how long one unit of it is.",
            "trunks": "Press Find trunks.",
            "inspect": f"{self.n_trunks} trunks found{refused}. Click a trunk in the picture or a row in the table.",
            "export": f"{self.n_measured} of {self.n_trunks} trees measured, {self.n_reviewed} reviewed. "
            + ("Export them." if self.n_reviewed >= self.n_trunks else "In step 4, Space accepts a tree."),
        }
        if self.done() >= set(STEP_TITLES):
            return "The inventory has been exported. Changes after that are not in the file."
        return hints[self.next_step()]
