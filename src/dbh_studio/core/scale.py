"""The scale of a reconstruction, as a measured quantity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

ScaleSource = Literal["unknown", "metres", "feet", "millimetres", "factor", "marker", "bars"]


@dataclass(frozen=True)
class ScaleEstimate:
    """Metres per source unit, and where that number came from.

    Attributes:
        metres_per_unit: Positive; meaningless while `source` is ``unknown``.
        source: Who or what said so.
        standard_error: Of `metres_per_unit`, in metres per unit; None where nothing is known of it.
    """

    metres_per_unit: float = 1.0
    source: ScaleSource = "unknown"
    standard_error: float | None = None

    def __post_init__(self) -> None:
        if not 0 < self.metres_per_unit < float("inf"):
            raise ValueError(f"metres per unit is {self.metres_per_unit} but must be positive")

    @property
    def is_known(self) -> bool:
        """Whether lengths may be given in metres."""
        return self.source != "unknown"
