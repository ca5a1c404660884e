"""A stem's diameter by the plot's protocol: at breast height, along a leaning stem, or above what is swollen there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import finite_rows
from dbh_studio.core.axis import StemAxis
from dbh_studio.core.dbh import DbhEstimate, Refusal, axis_of_stem, measure_stem
from dbh_studio.core.measured import CurveFit, Flag
from dbh_studio.core.stem_course import StemCourse, stem_course
from dbh_studio.core.swelling import Swelling, profile_flag, swelling_at
from dbh_studio.core.transforms import Similarity
from dbh_studio.settings import MeasureSettings

_LOOK_UP_M = 4.0  # from breast height; a swelling that reaches higher is left to a person
_HEIGHT_MATTERS_M = 0.002  # where a stem loses 3 cm per metre, less changes its diameter by less than a table shows


def measure_by_protocol(
    points_m: NDArray[np.floating[Any]],
    *,
    settings: MeasureSettings,
    axis: StemAxis | None = None,
    curves: Sequence[str] | None = None,
    ground_note: str = "",
    scale_sd: float = 0.0,
) -> DbhEstimate | Refusal:
    """The diameter of one stem where the settings' protocol has it, held against the stem above and below.

    Arguments are those of `core.dbh.measure_stem`, which measures at one height whatever is there.

    Returns:
        Of a stem measured above a swelling, an estimate with the flag ``above_bulge`` or ``above_buttress`` and the
        height it was measured at; the refusal ``not_regular`` where nothing regular is seen above one. The flag
        ``profile`` where the diameter contradicts the stem above and below.

    Raises:
        ValueError: As there.
    """
    settings = along_the_stem(points_m, settings)
    measured = partial(measure_stem, curves=curves, ground_note=ground_note, scale_sd=scale_sd)
    result = measured(points_m, settings=settings, axis=axis)
    if settings.above != "nothing":
        swelling = _swelling(points_m, result, axis, settings)
        if swelling is not None and (swelling.kind == "bulge" or settings.above == "buttress"):
            if swelling.end_m is None or swelling.measure_m is None:
                return _not_regular(swelling, settings, result)
            # What is swollen must not be taken for the stem's taper.
            upper = points_m.copy()
            upper[points_m[:, 2] < swelling.end_m] = np.nan
            moved = settings.model_copy(update={"breast_height_m": round(swelling.measure_m, 2)})
            return _flagged(measured(upper, settings=moved), _above_flag(swelling, settings, moved))
    if isinstance(result, DbhEstimate):
        course = _course(points_m, result)
        diameter = result.diameters[result.definition]
        return _flagged(result, profile_flag(course, result.hom_m, diameter, scale_sd=scale_sd))
    return result


def along_the_stem(points_m: NDArray[np.floating[Any]], settings: MeasureSettings) -> MeasureSettings:
    """Settings whose breast height is the vertical height of the place that far along the stem.

    As they are where heights are vertical, or the stem of (N, 3) points hardly leans.
    """
    if settings.along != "stem" or not finite_rows(points_m).any():
        return settings
    axis = axis_of_stem(points_m, settings=settings)
    height = settings.breast_height_m * float(axis.direction[2])
    if settings.breast_height_m - height < _HEIGHT_MATTERS_M:
        return settings
    return settings.model_copy(update={"breast_height_m": height})


def _course(points_m: NDArray[np.floating[Any]], result: DbhEstimate, **options: Any) -> StemCourse:
    fit = result.fits[result.curve]
    assert isinstance(fit, CurveFit)
    return stem_course(points_m, result.section.stem_from_section, fit.outline_uv_m, **options)


def _swelling(
    points_m: NDArray[np.floating[Any]],
    result: DbhEstimate | Refusal,
    axis: StemAxis | None,
    settings: MeasureSettings,
) -> Swelling | None:
    """The swelling at breast height, also of a stem that has no diameter there; None where there is none."""
    height = settings.breast_height_m
    if isinstance(result, DbhEstimate):
        course = _course(points_m, result, reach_m=_LOOK_UP_M)
        return swelling_at(course, height, 0.01 * result.dbh_cm)
    if axis is None and finite_rows(points_m).any():
        axis = axis_of_stem(points_m, settings=settings)
    if axis is None or axis.ring is None:
        return None
    angle = np.arange(72) * (2 * np.pi / 72)
    circle = axis.ring.radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    course = stem_course(points_m, Similarity(axis.rotation(), axis.point_m), circle, reach_m=_LOOK_UP_M)
    return swelling_at(course, height, 2.0 * axis.ring.radius_m)


_WORDS = {"bulge": "a bulge", "buttress": "a buttress or root swell"}


def _above_flag(swelling: Swelling, settings: MeasureSettings, moved: MeasureSettings) -> Flag:
    share = f"{100 * swelling.share:.0f} % thicker"
    than = "than the stem beside it" if swelling.kind == "bulge" else "than the stem above continued"
    words = f"measured at {moved.breast_height_m:.2f} m, above {_WORDS[swelling.kind]}"
    said = f"at {settings.breast_height_m:.2f} m it is {share} {than}" if swelling.share > 0 else ""
    return Flag(f"above_{swelling.kind}", ": ".join(filter(None, (words, said))))


def _not_regular(swelling: Swelling, settings: MeasureSettings, result: DbhEstimate | Refusal) -> Refusal:
    return Refusal(
        "not_regular",
        f"At {settings.breast_height_m:.2f} m the stem has {_WORDS[swelling.kind]}, and nothing regular is seen above "
        f"it up to {swelling.seen_to_m:.1f} m.",
        "Set the height of measurement by hand, enter a tape value, or measure at breast height whatever is there.",
        result.section,
        result.fits,
        result.rings,
    )


def _flagged(result: DbhEstimate | Refusal, flag: Flag | None) -> DbhEstimate | Refusal:
    """The result with one more thing to look at; what a refusal says begins with it."""
    if flag is None:
        return result
    if isinstance(result, DbhEstimate):
        return replace(result, flags=(*result.flags, flag.words), flag_codes=(*result.flag_codes, flag.code))
    words = flag.words[:1].upper() + flag.words[1:]
    return replace(result, reason=f"{words}. {result.reason}")
