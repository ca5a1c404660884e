"""Scale bars: known distances between two points. Control bars set the scale, check bars only test it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from dbh_studio.core.arrays import Float64, readonly
from dbh_studio.core.scale import MeasuredLength, ScaleEstimate, ScaleSource, ScaleVerdict, combine_lengths

BarRole = Literal["control", "check"]
BarLie = Literal["horizontal", "vertical", "oblique", "unknown"]

# Poses bend and stretch by about this much even where every residual is small; no number of bars averages it out.
SYSTEMATIC_SHARE = 0.0005
_LEVEL_DEG = 30.0
_LOW_PROBABILITY = 0.01


class KnownLength(Protocol):
    """What a scale can be taken from: a bar, or the side of a square marker."""

    @property
    def name(self) -> str:
        """For the report."""

    @property
    def role(self) -> BarRole:
        """``control`` sets the scale, ``check`` only tests it."""

    @property
    def length_m(self) -> float:
        """The true length."""

    @property
    def length_se_m(self) -> float:
        """Standard error of it: the tape, the print."""

    @property
    def measured_src(self) -> float:
        """What it is in the reconstruction, source units."""

    @property
    def sigma_src(self) -> float:
        """Standard error of that from scatter."""

    @property
    def systematic_src(self) -> float:
        """Standard error of that from what all such lengths share."""

    def lie(self, up_src: Float64 | None) -> BarLie:
        """How it lies, where the up direction is known and it has a direction."""


@dataclass(frozen=True, eq=False)
class Bar:
    """A known distance between two points of the reconstruction.

    Attributes:
        p_src: (3,) one end, source coordinates.
        q_src: (3,) the other end.
        length_m: The true distance.
        length_se_m: Standard error of it: the tape, the print.
        role: ``control`` sets the scale, ``check`` only tests it.
        sigma_src: Standard error of the measured distance, source units.
        name: For the report.
    """

    p_src: Float64
    q_src: Float64
    length_m: float
    length_se_m: float = 0.001
    role: BarRole = "control"
    sigma_src: float = 0.0
    name: str = ""

    def __post_init__(self) -> None:
        for end in ("p_src", "q_src"):
            point = np.asarray(getattr(self, end), np.float64)
            if point.shape != (3,):
                raise ValueError(f"{end} has shape {point.shape} but (3,) is needed")
            object.__setattr__(self, end, readonly(point))
        if self.role not in ("control", "check"):
            raise ValueError(f"role is {self.role!r} but must be control or check")
        if not (self.length_se_m >= 0 and self.sigma_src >= 0):
            raise ValueError("standard errors must not be negative")

    @property
    def measured_src(self) -> float:
        """The distance in the reconstruction, source units."""
        return float(np.linalg.norm(self.q_src - self.p_src))

    @property
    def systematic_src(self) -> float:
        """Nothing of its own; see `scale_from_bars`."""
        return 0.0

    def lie(self, up_src: Float64 | None) -> BarLie:
        """Whether it lies or stands, where the up direction is known."""
        if up_src is None:
            return "unknown"
        up = np.asarray(up_src, np.float64)
        steepness = abs(float((self.q_src - self.p_src) @ up)) / (self.measured_src * float(np.linalg.norm(up)))
        angle_deg = float(np.degrees(np.arcsin(min(steepness, 1.0))))
        if angle_deg <= _LEVEL_DEG:
            return "horizontal"
        return "vertical" if angle_deg >= 90.0 - _LEVEL_DEG else "oblique"


@dataclass(frozen=True)
class BarResidual:
    """How one bar agrees with the scale.

    Attributes:
        name: The bar.
        role: ``control`` or ``check``.
        lie: Whether it lies or stands; ``unknown`` without an up direction.
        length_m: What it is.
        measured_m: What it measures with the scale found.
        residual_m: Measured less true.
        residual_pct: The same in percent.
        sigma_pct: Standard error of the residual, in percent.
    """

    name: str
    role: BarRole
    lie: BarLie
    length_m: float
    measured_m: float
    residual_m: float
    residual_pct: float
    sigma_pct: float

    @property
    def n_sigma(self) -> float:
        """How many standard errors the residual is."""
        return abs(self.residual_pct) / max(self.sigma_pct, 1e-12)


@dataclass(frozen=True)
class ScaleReport:
    """A scale with everything needed to judge it.

    Attributes:
        estimate: The scale; None where it is refused.
        residuals: Per bar or marker, in the order given.
        chi2: Of the controls about the scale.
        freedom: Controls less one.
        horizontal_over_vertical: Length of horizontal bars over that of vertical ones, each relative to the truth; 1 in
            a sound reconstruction, None where one kind is missing.
        ratio_se: Its standard error.
        n_views: Photos the least seen control was measured in; None where bars carry no views.
        verdict: In plain words.
    """

    estimate: ScaleEstimate | None
    residuals: tuple[BarResidual, ...]
    chi2: float
    freedom: int
    horizontal_over_vertical: float | None
    ratio_se: float | None
    n_views: int | None
    verdict: ScaleVerdict


def refused_scale(code: str, message: str, remedy: str) -> ScaleReport:
    """A report without a scale."""
    return ScaleReport(None, (), 0.0, 0, None, None, None, ScaleVerdict("refused", code, message, remedy))


def scale_from_bars(
    bars: Sequence[KnownLength],
    *,
    up_src: Float64 | None = None,
    source: ScaleSource = "bars",
    systematic_share: float = SYSTEMATIC_SHARE,
) -> ScaleReport:
    """The scale that fits the control bars best, tested on the check bars.

    Args:
        bars: Control and check bars (or other known lengths); in a plot with an up direction some should lie and some
            stand.
        up_src: (3,) up direction in the source; None leaves lying and standing bars apart unknown.
        source: What the estimate is to be called.
        systematic_share: Share of the scale that no number of bars averages out.

    Returns:
        The report; its estimate is None, with reason and remedy, where there is no control bar or one has no length.
    """
    problem = _unusable(bars)
    if problem is not None:
        return problem
    controls = [bar for bar in bars if bar.role == "control"]
    combined = combine_lengths(
        [
            MeasuredLength(
                bar.name,
                bar.length_m,
                bar.length_se_m,
                bar.measured_src,
                bar.sigma_src,
                float(np.hypot(systematic_share * bar.measured_src, bar.systematic_src)),
            )
            for bar in controls
        ]
    )
    estimate = ScaleEstimate(combined.metres_per_unit, source, combined.standard_error)
    relative_se = combined.standard_error / combined.metres_per_unit
    residuals = tuple(_residual(bar, combined.metres_per_unit, relative_se, systematic_share, up_src) for bar in bars)
    ratio, ratio_se = _ratio(residuals)
    verdict = _verdict(residuals, combined.chi2, combined.freedom, relative_se, ratio, ratio_se)
    return ScaleReport(estimate, residuals, combined.chi2, combined.freedom, ratio, ratio_se, None, verdict)


def _unusable(bars: Sequence[KnownLength]) -> ScaleReport | None:
    if not any(bar.role == "control" for bar in bars):
        return refused_scale("no_control", "No control bar is given.", "Mark at least one known distance as control.")
    for bar in bars:
        name = bar.name or "A bar"
        if not (np.isfinite(bar.length_m) and bar.length_m > 0):
            return refused_scale(
                "no_length", f"{name} has a length of {bar.length_m:g} m.", "Give its true length in metres, above 0."
            )
        if not (np.isfinite(bar.measured_src) and bar.measured_src > 0):
            return refused_scale(
                "same_ends", f"{name} has both ends in one place.", "Mark its two ends again in two or more photos."
            )
    return None


def _residual(
    bar: KnownLength, metres_per_unit: float, relative_se: float, systematic_share: float, up_src: Float64 | None
) -> BarResidual:
    measured_m = metres_per_unit * bar.measured_src
    own = float(np.hypot(bar.sigma_src / bar.measured_src, bar.length_se_m / bar.length_m))
    own = float(np.hypot(own, bar.systematic_src / bar.measured_src))
    # A check bar is not in the mean: the error of the mean comes on top of its own.
    sigma = float(np.hypot(own, relative_se if bar.role == "check" else systematic_share))
    residual_m = measured_m - bar.length_m
    return BarResidual(
        bar.name,
        bar.role,
        bar.lie(up_src),
        bar.length_m,
        measured_m,
        residual_m,
        100.0 * residual_m / bar.length_m,
        100.0 * max(sigma, 1e-9),
    )


def _ratio(residuals: Sequence[BarResidual]) -> tuple[float | None, float | None]:
    means = []
    for lie in ("horizontal", "vertical"):
        chosen = [r for r in residuals if r.lie == lie]
        if not chosen:
            return None, None
        weights = np.array([1 / r.sigma_pct**2 for r in chosen])
        excess = float(weights @ [r.residual_pct for r in chosen]) / float(weights.sum())
        means.append((1 + excess / 100, float(weights.sum()) ** -0.5 / 100))
    (across, across_se), (upright, upright_se) = means
    return across / upright, float(np.hypot(across_se, upright_se))


def _chance(chi2: float, freedom: int) -> float:
    """Probability of a larger chi-square."""
    from scipy.special import chdtrc  # slow to import, and a plot's Document needs this module

    return float(chdtrc(freedom, chi2))


def _verdict(
    residuals: Sequence[BarResidual],
    chi2: float,
    freedom: int,
    relative_se: float,
    ratio: float | None,
    ratio_se: float | None,
) -> ScaleVerdict:
    said = f"The scale is known to ±{100 * relative_se:.2f} %"
    if ratio is not None and ratio_se is not None and abs(ratio - 1) > max(3 * ratio_se, 0.003):
        return ScaleVerdict(
            "caution",
            "stretched",
            f"Lying bars measure {100 * (ratio - 1):+.1f} % against standing ones: the reconstruction is "
            "stretched or bent.",
            "Add photos from more heights and directions and align again; diameters are wrong by a part of this.",
        )
    checks = [r for r in residuals if r.role == "check"]
    failed = [r for r in checks if r.n_sigma > 3 and abs(r.residual_pct) > 0.1]
    if failed:
        worst = max(failed, key=lambda r: r.n_sigma)
        return ScaleVerdict(
            "caution",
            "check_failed",
            f"The check length {worst.name or 'without a name'} measures {worst.measured_m:.3f} m instead of "
            f"{worst.length_m:.3f} m ({worst.residual_pct:+.2f} %).",
            "Check its length and ends; if they are right, the reconstruction is bent or the controls are wrong.",
        )
    if freedom and _chance(chi2, freedom) < _LOW_PROBABILITY:
        worst = max((r for r in residuals if r.role == "control"), key=lambda r: r.n_sigma)
        return ScaleVerdict(
            "caution",
            "inconsistent",
            f"The known lengths contradict each other; {worst.name or 'one bar'} is {worst.residual_pct:+.2f} % off.",
            "Check the lengths typed in (side of the black square, not of the paper) and the ends marked.",
        )
    if relative_se > 0.01:
        return ScaleVerdict(
            "caution", "uncertain", f"{said} only.", "Use a longer bar, nearer photos or more photos of it."
        )
    if not freedom and not checks:
        return ScaleVerdict(
            "caution",
            "unchecked",
            f"{said} by one length, which nothing checks.",
            "A second known length would reveal a wrong one.",
        )
    return ScaleVerdict("good", "agrees", f"{said}; {len(residuals)} known lengths agree.")
