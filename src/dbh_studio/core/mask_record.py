"""Which masks the trunks of a plot came from: a small value that is saved with them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

MaskKind = Literal["made", "brought"]
MaskRung = Literal["detector", "prompted", "brought", "geometry"]

RUNG_TITLES: dict[MaskRung, str] = {
    "detector": "detector and SAM",
    "prompted": "SAM with boxes of geometric trunks",
    "brought": "masks that were brought",
    "geometry": "geometry alone",
}


@dataclass(frozen=True)
class MaskRecord:
    """Which masks a plot's trunks were found by. A plot whose trunks did not come from masks has none.

    Attributes:
        kind: ``made`` by models on this or another computer, or ``brought`` by a person.
        rung: Of the ladder: ``detector`` (detector and SAM), ``prompted`` (SAM with boxes of geometric trunks) or
            ``brought``.
        n_masks: How many voted.
        path: Where the brought ones are; None for those kept beside the plot.
        meaning: What they mean, as in `io.masks.MEANINGS`; empty for made ones.
        categories: Which categories or numbers were taken for trunks; empty for all.
        style: How they are named after photos; empty for made ones.
        prompt: What the detector looked for.
        models: Names of the models.
        recipe: Key of the `io.masks.MaskRecipe` most of them have; empty for brought ones.
        digest: Of the masks' content and of how they voted: equal digests gave equal label counts.
    """

    kind: MaskKind
    rung: MaskRung
    n_masks: int
    path: Path | None = None
    meaning: str = ""
    categories: tuple[str, ...] = ()
    style: str = ""
    prompt: str = ""
    models: tuple[str, ...] = ()
    recipe: str = ""
    digest: str = ""

    @property
    def sentence(self) -> str:
        """How many, and how they were made or whence they came."""
        count = f"{self.n_masks:,} {'mask' if self.n_masks == 1 else 'masks'}"
        if self.kind == "brought":
            where = f" from {self.path.name}" if self.path is not None else ""
            return f"{count} that were brought{where}."
        models = f" ({', '.join(self.models)})" if self.models else ""
        prompt = f', prompt "{self.prompt}"' if self.prompt else ""
        return f"{count} made by {RUNG_TITLES[self.rung]}{models}{prompt}."
