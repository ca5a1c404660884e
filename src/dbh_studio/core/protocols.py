"""Where on a stem its diameter is measured: by the plot's rules, and by what a person said of it.

The rules are four settings of `MeasureSettings`: breast height, which ground it counts from on a slope, whether along a
leaning stem or upright, and what to do where the stem is swollen there.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, Float64, readonly
from dbh_studio.core.corrections import Correction, CorrectionKind
from dbh_studio.core.transforms import Similarity
from dbh_studio.settings import HeightAlong, MeasureAbove, MeasureSettings

BaseUsed = Literal["uphill", "midpoint", "downhill", "placed", "stem"]

PROTOCOLS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "paper": {
            "breast_height_m": 1.30, "band_below_m": 0.08, "band_above_m": 0.22,
            "base": "midpoint", "along": "vertical", "above": "nothing",
        },
        "fao": {"breast_height_m": 1.30, "base": "uphill", "along": "stem", "above": "buttress"},
        "fia": {"breast_height_m": 1.3716, "base": "uphill", "along": "stem", "above": "buttress"},
        "champion": {"breast_height_m": 1.3716, "base": "midpoint", "along": "stem", "above": "nothing"},
        "nz": {"breast_height_m": 1.40, "base": "uphill", "along": "vertical", "above": "nothing"},
    }
)  # fmt: skip
"""Rules by name, as changes of `MeasureSettings`; where they come from stands in docs/guide/protocols.md."""

_OF_SETTINGS: Mapping[CorrectionKind, str] = {
    "breast_height": "breast_height_m",
    "base": "base",
    "along": "along",
    "above": "above",
    "curve": "curve",
    "least_arc": "min_coverage_deg",
}
_OF_THE_STEM: tuple[CorrectionKind, ...] = ("ground", "left_out", "ring")


@dataclass(frozen=True)
class Protocol:
    """By which rules a stem was measured, so that its number can be repeated.

    Attributes:
        breast_height_m: The height looked for; where the section lies in the end is its height of measurement.
        base: What heights count from: a side of the slope, a ground a person has ``placed``, or the lowest points of
            the ``stem`` where the cloud has no ground.
        along: Whether the height is vertical or along the stem.
        above: What is measured above.
    """

    breast_height_m: float = 1.30
    base: BaseUsed = "midpoint"
    along: HeightAlong = "vertical"
    above: MeasureAbove = "nothing"

    @classmethod
    def of(cls, settings: MeasureSettings, *, base: BaseUsed | None = None) -> Protocol:
        """The rules of settings, the base apart where it was another."""
        return cls(settings.breast_height_m, base or settings.base, settings.along, settings.above)


def measured_by(corrections: Iterable[Correction]) -> tuple[CorrectionKind, ...]:
    """Kinds of the corrections a measurement rests on; what a tape read is only kept beside it."""
    return tuple(each.kind for each in corrections if each.kind in _OF_SETTINGS or each.kind in _OF_THE_STEM)


def own_settings(corrections: Iterable[Correction], settings: MeasureSettings) -> MeasureSettings:
    """How one stem is measured: the plot's settings, and over them what a person said of this stem.

    Who sets the height of a stem has looked at it, so the plot's rule for swollen stems does not move it again.
    """
    said = {each.kind: each.value for each in corrections}
    changes = {name: said[kind] for kind, name in _OF_SETTINGS.items() if kind in said}
    if "breast_height" in said:
        changes.setdefault("above", "nothing")
    if "least_arc" in said:  # it was accepted, not asked for: a plot that is content with less goes before
        changes["min_coverage_deg"] = min(said["least_arc"], settings.min_coverage_deg)
    changes = {name: value for name, value in changes.items() if value != getattr(settings, name)}
    # Not `changed`: the bounds are those of a plot's rule, and a person may measure a stem much higher.
    return settings.model_copy(update=changes) if changes else settings


def setup_key(corrections: Iterable[Correction], settings: MeasureSettings) -> Hashable:
    """What of the corrections and settings a measurement depends on: not who said it, nor what a tape read."""
    corrections = tuple(corrections)
    of_the_stem = tuple((each.kind, each.value) for each in corrections if each.kind in _OF_THE_STEM)
    # What the plot asks for is said with an arc that was accepted.
    usual = settings.min_coverage_deg if any(each.kind == "least_arc" for each in corrections) else None
    return own_settings(corrections, settings), of_the_stem, usual


@dataclass(frozen=True, eq=False)
class StemSetup:
    """How one stem is measured, in the world.

    Attributes:
        settings: The plot's, or its own.
        z_ground_m: Height of a ground that a person placed; None where the ground model says.
        ring_m: (M, 3) a ring drawn by hand; None where there is none.
        left_out: (N,) which of the stem's points are not measured; None where all are.
        usual_arc_deg: The arc the plot asks for, where a person accepted a smaller one; None elsewhere.
    """

    settings: MeasureSettings
    z_ground_m: float | None = None
    ring_m: Float64 | None = None
    left_out: Bool | None = None
    usual_arc_deg: float | None = None

    @property
    def placed(self) -> dict[str, Any]:
        """What a person put there or accepted, as arguments of `stages.measure.measure_trunk`; mostly empty."""
        given = {"z_ground_m": self.z_ground_m, "ring_m": self.ring_m, "usual_arc_deg": self.usual_arc_deg}
        return {name: value for name, value in given.items() if value is not None}

    def measured(self, points: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """(N, 3) the stem's points without those left out: these are NaN, so that the others keep their places."""
        if self.left_out is None:
            return points
        points = points.copy()
        points[self.left_out] = np.nan
        return points


def stem_setup(
    corrections: Iterable[Correction],
    settings: MeasureSettings,
    *,
    points: NDArray[np.integer[Any]],
    world_from_source: Similarity,
) -> StemSetup:
    """How one stem is measured, by what was said about it.

    Args:
        corrections: Of the stem.
        settings: Of the plot.
        points: (N,) indices of the stem's points in the cloud.
        world_from_source: Where the cloud lies; corrections keep their places in the source.
    """
    corrections = tuple(corrections)
    own = own_settings(corrections, settings)
    said = {each.kind: each.value for each in corrections}
    ground, ring, left_out = said.get("ground"), said.get("ring"), said.get("left_out")
    return StemSetup(
        own,
        None if ground is None else float(world_from_source.apply(np.array([ground], np.float64))[0, 2]),
        None if ring is None else readonly(world_from_source.apply(np.array(ring, np.float64)).astype(np.float64)),
        None if left_out is None else readonly(np.isin(points, np.array(left_out))),
        settings.min_coverage_deg if own.min_coverage_deg < settings.min_coverage_deg else None,
    )
