"""What a person says about the measurement of one stem, against the plot's way of measuring: at most one of a kind.

Places are in the source frame (units from the cloud's origin), so that a new scale, up direction or ground leaves them
where the person put them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal, get_args

from dbh_studio.settings import CurveName, HeightAlong, MeasureAbove, SlopeBase

CorrectionKind = Literal[
    "breast_height", "base", "along", "above", "ground", "curve", "least_arc", "left_out", "ring", "tape", "tape_height"
]
CORRECTION_KINDS: tuple[CorrectionKind, ...] = get_args(CorrectionKind)

# A tape is read in centimetres; beyond this somebody typed millimetres.
_THICKEST_CM = 2000.0
_HIGHEST_M = 20.0


@dataclass(frozen=True)
class Correction:
    """One thing a person decided about the measurement of one stem, with who, when and why.

    Attributes:
        kind: Which thing.
        value: Of `kind`: ``breast_height`` metres above the base; ``base``, ``along`` and ``above`` a word of
            `SlopeBase`, `HeightAlong`, `MeasureAbove`; ``ground`` an (x, y, z) place of the ground; ``curve`` a
            `CurveName`; ``least_arc`` degrees of the ring that are enough; ``left_out`` sorted indices of the cloud's
            points that are not to be measured; ``ring`` a closed polygon of (x, y, z) drawn around the stem; ``tape`` a
            diameter read in the field, cm, kept beside the estimate; ``tape_height`` the height it was read at, metres.
        who: Who said so; empty where nobody signed.
        when: ISO 8601, UTC; empty where unknown.
        why: In the person's words.
    """

    kind: CorrectionKind
    value: Any
    who: str = ""
    when: str = ""
    why: str = ""

    def __post_init__(self) -> None:
        if self.kind not in _CHECKS:
            raise ValueError(f"there is no correction of the kind {self.kind!r}")
        object.__setattr__(self, "value", _CHECKS[self.kind](self.value))


def with_correction(corrections: Iterable[Correction], new: Correction) -> tuple[Correction, ...]:
    """The corrections with another in place of the one of its kind, in the order of `CORRECTION_KINDS`."""
    others = [each for each in corrections if each.kind != new.kind]
    return tuple(sorted([*others, new], key=lambda each: CORRECTION_KINDS.index(each.kind)))


def without_correction(corrections: Iterable[Correction], kind: CorrectionKind) -> tuple[Correction, ...]:
    """The corrections but for one kind."""
    return tuple(each for each in corrections if each.kind != kind)


# ---- values


def _number(low: float, high: float, unit: str) -> Callable[[Any], float]:
    def checked(value: Any) -> float:
        number = float(value)
        if not (math.isfinite(number) and low <= number <= high):
            raise ValueError(f"{value!r} is not between {low:g} and {high:g} {unit}")
        return number

    return checked


def _one_of(words: tuple[str, ...]) -> Callable[[Any], str]:
    def checked(value: Any) -> str:
        if value not in words:
            raise ValueError(f"{value!r} is none of {', '.join(words)}")
        return str(value)

    return checked


def _place(value: Any) -> tuple[float, float, float]:
    x, y, z = (float(part) for part in value)
    if not all(map(math.isfinite, (x, y, z))):
        raise ValueError(f"{value!r} is no place")
    return x, y, z


def _ring(value: Any) -> tuple[tuple[float, float, float], ...]:
    ring = tuple(_place(corner) for corner in value)
    if len(ring) < 3:
        raise ValueError("a ring needs three corners or more")
    return ring


def _indices(value: Any) -> tuple[int, ...]:
    indices = tuple(sorted({int(index) for index in value}))
    if not indices or indices[0] < 0:
        raise ValueError("the points left out are indices of the cloud, one or more")
    return indices


_CHECKS: dict[str, Callable[[Any], Any]] = {
    "breast_height": _number(0.1, _HIGHEST_M, "m"),
    "base": _one_of(get_args(SlopeBase)),
    "along": _one_of(get_args(HeightAlong)),
    "above": _one_of(get_args(MeasureAbove)),
    "ground": _place,
    "curve": _one_of(get_args(CurveName)),
    "least_arc": _number(0.0, 360.0, "degrees"),
    "left_out": _indices,
    "ring": _ring,
    "tape": _number(0.1, _THICKEST_CM, "cm"),
    "tape_height": _number(0.0, _HIGHEST_M, "m"),
}
