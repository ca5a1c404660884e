"""The scale of a reconstruction, as a measured quantity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

ScaleSource = Literal[
    "unknown", "metres", "feet", "millimetres", "factor", "marker", "bars", "camera_height", "baseline", "lidar"
]
# Where nothing better exists: how high a person holds a camera, and how far apart two photos are said to be.
WEAK_SOURCES: frozenset[ScaleSource] = frozenset({"camera_height", "baseline"})
VerdictLevel = Literal["good", "caution", "refused"]


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
        if self.standard_error is not None and not 0 <= self.standard_error < float("inf"):
            raise ValueError(f"the standard error is {self.standard_error} but must be 0 or more")

    @property
    def is_weak(self) -> bool:
        """Whether it rests on what a person can only guess."""
        return self.source in WEAK_SOURCES

    @property
    def relative_sd(self) -> float:
        """Relative standard error; 0 where nothing is known of it, which is no claim that it is 0."""
        return 0.0 if self.standard_error is None else self.standard_error / self.metres_per_unit

    @property
    def is_known(self) -> bool:
        """Whether lengths may be given in metres."""
        return self.source != "unknown"


@dataclass(frozen=True)
class ScaleVerdict:
    """What to think of a measured scale.

    Attributes:
        level: ``good``; ``caution``: usable, but look; ``refused``: there is no scale.
        code: Short name for tables and tests.
        message: One or two sentences for the forester.
        remedy: What to do; empty where all is well.
    """

    level: VerdictLevel
    code: str
    message: str
    remedy: str = ""


@dataclass(frozen=True)
class MeasuredLength:
    """One known length in the reconstruction.

    Attributes:
        name: For the report.
        length_m: What it is.
        length_se_m: Standard error of that (tape, print).
        measured_src: What it is in the reconstruction, source units.
        sigma_src: Standard error of that from scatter.
        systematic_src: Standard error of that from what all lengths of this kind share; it does not average out.
    """

    name: str
    length_m: float
    length_se_m: float
    measured_src: float
    sigma_src: float
    systematic_src: float = 0.0


@dataclass(frozen=True)
class CombinedScale:
    """Several lengths, one scale.

    Attributes:
        metres_per_unit: The weighted mean.
        standard_error: Of it; includes the systematic part, and is widened where the lengths disagree.
        relative_residuals: Per length, what the reconstruction has too much (+) as a share of the true length.
        relative_sigmas: Per length, its own standard error as a share, without the shared part.
        chi2: Weighted sum of squared residuals; about `freedom` where the errors are what they are said to be.
        freedom: Lengths less one.
    """

    metres_per_unit: float
    standard_error: float
    relative_residuals: tuple[float, ...]
    relative_sigmas: tuple[float, ...]
    chi2: float
    freedom: int


def combine_lengths(lengths: Sequence[MeasuredLength]) -> CombinedScale:
    """Weighted least squares in the logarithm, so that no length weighs more for being measured too short.

    The part of the error that all lengths share is added after averaging: ten markers seen by one camera blur alike.

    Raises:
        ValueError: There is no length, or one is not positive.
    """
    if not lengths:
        raise ValueError("there is no length to take the scale from")
    true_m = np.array([length.length_m for length in lengths])
    measured = np.array([length.measured_src for length in lengths])
    if not ((true_m > 0).all() and (measured > 0).all()):
        raise ValueError("lengths must be positive")
    scatter = np.array([length.sigma_src for length in lengths]) / measured
    sigmas = np.hypot(scatter, np.array([length.length_se_m for length in lengths]) / true_m)
    sigmas = np.maximum(sigmas, 1e-9)
    shared = np.array([length.systematic_src for length in lengths]) / measured
    logs = np.log(true_m / measured)
    # A length weighs by all its errors, also by the shared one: a far marker has more of it.
    weights = 1 / (sigmas**2 + shared**2)
    share = weights / weights.sum()
    mean = float(share @ logs)
    freedom = len(lengths) - 1
    # Relative to the mean, lengths differ by their own part and by how their shared parts differ.
    chi2 = float(((logs - mean) ** 2 / (sigmas**2 + shared**2)).sum())
    widening = max(1.0, chi2 / freedom) if freedom else 1.0
    variance = float((share**2 * sigmas**2).sum()) * widening + float(share @ shared) ** 2
    scale = float(np.exp(mean))
    residuals = np.expm1(mean - logs)
    return CombinedScale(
        scale, scale * float(np.sqrt(variance)), tuple(residuals), tuple(np.hypot(sigmas, shared)), chi2, freedom
    )
