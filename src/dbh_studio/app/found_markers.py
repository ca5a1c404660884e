"""Markers found in the photos of a plot: placed in space, struck out or believed, and the scale taken from them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.app.commands import Command, set_evidence
from dbh_studio.app.document import Document
from dbh_studio.app.lengths import check_length
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.scale import WEAK_SOURCES, ScaleEstimate
from dbh_studio.core.scale_evidence import WELL_SEEN, MarkedPoint, MarkerKey, MarkerSquare, Sight
from dbh_studio.errors import CommandError
from dbh_studio.settings import MarkerSettings

if TYPE_CHECKING:
    from dbh_studio.core.bars import ScaleReport
    from dbh_studio.core.dbh import Refusal
    from dbh_studio.core.posed_images import PosedImages
    from dbh_studio.stages.marker_detect import Detection
    from dbh_studio.stages.marker_geometry import Marker3D

# A marker that is off by more than this share, and by so many standard errors, is not of the size given.
_OTHER_SIZE, _OTHER_SIZE_SIGMAS = 0.01, 4.0
# A scale from elsewhere is not replaced unasked.
_MEASURED = frozenset({"unknown", "marker", "bars"})


@dataclass(frozen=True, eq=False)
class MarkerSearch:
    """What a search for markers found.

    Attributes:
        detections: All sights, each with its picture.
        squares: The markers in space, with the side they were given; those that are not of this size as check.
        report: What the markers alone say of the scale.
        problems: Per marker left out: its name and why.
    """

    detections: tuple[Detection, ...]
    squares: tuple[MarkerSquare, ...]
    report: ScaleReport
    problems: tuple[tuple[str, Refusal], ...]


def search_markers(
    posed: PosedImages,
    sides_m: Mapping[MarkerKey, float] | None = None,
    struck: Sequence[tuple[str, str, int]] = (),
    settings: MarkerSettings = MarkerSettings(),  # noqa: B008 - frozen
    checks: Collection[MarkerKey] = (),
    *,
    progress: Progress = ignore_progress,
) -> MarkerSearch:
    """Look for markers in every photo and place them. Pure and picklable, for a job.

    Args:
        posed: The photos, in the cloud's frame.
        sides_m: Side of the black square per (dictionary, id); the others have `settings.side_m`.
        struck: (photo, dictionary, id) of detections to leave out.
        settings: Dictionaries, ids, side.
        checks: (dictionary, id) of markers that only test the scale.
        progress: Called once per photo.

    Raises:
        FileError: No photo can be read.
        MissingComponentError: OpenCV is absent.
        SettingError: There is no dictionary of that name.
    """
    from dbh_studio.core.bars import refused_scale
    from dbh_studio.io.photos import read_photo
    from dbh_studio.stages.markers import find_markers, why_none

    searching, looking = subprogress(progress, 0.0, 0.95), subprogress(progress, 0.95, 1.0)
    detections = find_markers(posed, settings=settings, read_image=read_photo, progress=searching)
    why = None if detections else why_none(posed, settings, read_photo, looking)
    if why is not None:
        return MarkerSearch((), (), refused_scale(why.code, why.reason, why.remedy), ())
    return place_markers(detections, posed, sides_m, struck, settings, checks)


def place_markers(
    detections: Sequence[Detection],
    posed: PosedImages,
    sides_m: Mapping[MarkerKey, float] | None = None,
    struck: Sequence[tuple[str, str, int]] = (),
    settings: MarkerSettings = MarkerSettings(),  # noqa: B008 - frozen
    checks: Collection[MarkerKey] = (),
) -> MarkerSearch:
    """The markers in space from detections, without those that were struck out. Takes well under a second.

    A marker that measures something else than it is said to be is kept as a check: it shows, and can be corrected.
    """
    from dbh_studio.stages.markers import check_marker, scale_from_markers, triangulate_markers

    sides = {_as_found(key): float(side_m) for key, side_m in (sides_m or {}).items()}
    left_out = set(struck)
    believed = [d for d in detections if (d.image, d.dictionary, d.marker_id) not in left_out]
    markers = triangulate_markers(believed, posed, settings=settings)
    sights = Counter(detection.key for detection in believed)
    report = scale_from_markers(
        markers,
        sides,
        settings=settings,
        seen_once=sorted(set(sights) - {marker.key for marker in markers}),
        sights=sights,
        left_out=checks,
    )
    used = {residual.name for residual in report.residuals}
    problems = [(marker.name, check_marker(marker)) for marker in markers]
    squares: list[MarkerSquare] = []
    for marker, (_, problem) in zip(markers, problems, strict=True):
        if problem is None:
            # A number that stands at two places gives two squares of one name.
            twins = sum(square.marker == marker.key for square in squares)
            side_m = sides.get(marker.key, settings.side_m)
            square = _square(marker, believed, side_m, settings, twins)
            if marker.key not in checks and marker.name in used:
                squares.append(square)
            elif marker.key in checks or _is_other_size(square, report.estimate, is_named=marker.key in sides):
                squares.append(replace(square, role="check"))
    return MarkerSearch(
        tuple(detections), tuple(squares), report, tuple((name, why) for name, why in problems if why is not None)
    )


def _as_found(key: MarkerKey) -> MarkerKey:
    """As finds call it: ``DICT_4X4_250`` and ``DICT_4X4_50`` share their first markers."""
    from dbh_studio.io.marker_codes import known_name, smallest_dictionary

    dictionary, number = key
    return smallest_dictionary(known_name(dictionary), number), number


def _is_other_size(square: MarkerSquare, scale: ScaleEstimate | None, *, is_named: bool) -> bool:
    """Whether a marker that was not used contradicts the scale of the others."""
    may_be_none = not is_named and square.n_views is not None and square.n_views < WELL_SEEN
    if scale is None or may_be_none:
        return False
    off = float(np.log(square.measured_src * scale.metres_per_unit / square.side_m))
    sigma = float(np.hypot(square.sigma_src, square.systematic_src)) / square.measured_src
    return abs(off) > max(_OTHER_SIZE, _OTHER_SIZE_SIGMAS * sigma)


def _square(
    marker: Marker3D, detections: Sequence[Detection], side_m: float, settings: MarkerSettings, twins: int
) -> MarkerSquare:
    used = [d for d in detections if d.key == marker.key and d.image in set(marker.views_used)]
    corners = []
    for number in range(4):
        block = marker.covariance[3 * number : 3 * number + 3, 3 * number : 3 * number + 3]
        sights = tuple(Sight(d.image, *(float(value) for value in d.corners_px[number])) for d in used)
        sigma = float(np.sqrt(np.trace(block) / 3))
        corners.append(MarkedPoint(tuple(marker.corners_src[number]), sigma, sights))
    first, second, third, fourth = corners
    # Both ends of every side move outwards or inwards alike; the photos may have told by how much.
    systematic = 2 * settings.systematic_px * marker.footprint_src
    if marker.size_drift is not None:
        systematic = marker.size_drift * marker.side_src
    return MarkerSquare(
        name=marker.name if not twins else f"{marker.name} ({twins + 1})",
        corners=(first, second, third, fourth),
        side_m=side_m,
        side_se_m=settings.side_error_mm / 1000,
        marker=marker.key,
        n_views=len(marker.views_used),
        side_sigma_src=marker.side_sigma_src,
        systematic_src=systematic,
    )


def apply_search(document: Document, search: MarkerSearch, *, keep_number: bool = False) -> Command:
    """One step: keep the markers found, and take the scale from them and the lengths marked by hand.

    Args:
        document: The plot.
        search: What was found.
        keep_number: Leave a scale alone that is the unit of the file or a factor; the markers then only say otherwise.

    Raises:
        CommandError: They give no scale; says why. The evidence is then not touched either.
    """
    evidence = document.evidence.with_found(search.squares)
    report = evidence.report(np.array(document.up_direction)) if search.squares else search.report
    if report.estimate is None:
        raise CommandError(report.verdict.message, report.verdict.remedy)
    if keep_number and document.scale.source not in _MEASURED | WEAK_SOURCES:
        return set_evidence(evidence, label="Find markers")
    return set_evidence(evidence, label="Set the scale by markers", scale=report.estimate)


def strike_out(
    document: Document,
    detections: Sequence[Detection],
    posed: PosedImages,
    sight: tuple[str, str, int],
    *,
    struck: bool = True,
    settings: MarkerSettings = MarkerSettings(),  # noqa: B008 - frozen
) -> Command:
    """One step: leave one detection out (or take it in again), place the markers anew, and take the scale from them.

    A scale that was not measured on known lengths is left alone, as is one for which nothing is left.

    Args:
        document: The plot.
        detections: All of the search.
        posed: The photos, in the cloud's frame.
        sight: (photo, dictionary, id).
        struck: Whether it is no marker.
        settings: Of the search; above all the side of markers that were not placed before.
    """
    others = tuple(each for each in document.evidence.struck if each != sight)
    left_out = (*others, sight) if struck else others
    what = f"{sight[1]} {sight[2]} in {sight[0]}"
    label = f"Strike out {what}" if struck else f"Use {what} again"
    search = place_markers(detections, posed, sides_of(document), left_out, settings, checks_of(document))
    return _placed_anew(document, search, left_out, label)


def use_marker(
    document: Document,
    detections: Sequence[Detection],
    posed: PosedImages,
    marker: MarkerKey,
    side_m: float,
    settings: MarkerSettings = MarkerSettings(),  # noqa: B008 - frozen
) -> Command:
    """One step: believe a marker that was left out, place the markers anew, and take the scale from them.

    Raises:
        CommandError: Also the person's word does not make a marker of it; says why.
    """
    name = f"{marker[0]} {marker[1]}"
    struck = document.evidence.struck
    sides = sides_of(document) | {marker: side_m}
    search = place_markers(detections, posed, sides, struck, settings, checks_of(document))
    if not any(square.marker == marker for square in search.squares):
        why = next((refusal for other, refusal in search.problems if other == name), None)
        if why is not None:
            raise CommandError(why.reason, why.remedy)
        if search.report.estimate is None and search.squares == ():
            raise CommandError(search.report.verdict.message, search.report.verdict.remedy)
        raise CommandError(
            f"{name} is not seen in two photos from different places that agree.", "Mark its corners by hand."
        )
    return _placed_anew(document, search, struck, f"Use {name}")


def _placed_anew(
    document: Document, search: MarkerSearch, struck: tuple[tuple[str, str, int], ...], label: str
) -> Command:
    evidence = replace(document.evidence, struck=struck).with_found(search.squares)
    report = evidence.report(np.array(document.up_direction))
    is_measured = document.scale.source in _MEASURED
    return set_evidence(evidence, label=label, scale=report.estimate if is_measured else None)


def sides_of(document: Document) -> dict[MarkerKey, float]:
    """The side of each marker found so far."""
    return {square.marker: square.side_m for square in document.evidence.squares if square.marker is not None}


def checks_of(document: Document) -> frozenset[MarkerKey]:
    """The markers found so far that only test the scale."""
    found = [square for square in document.evidence.squares if square.marker is not None]
    controls = {square.marker for square in found if square.role == "control"}
    return frozenset(square.marker for square in found if square.marker is not None and square.marker not in controls)


def change_side(document: Document, before_m: float, side_m: float) -> Command:
    """Give all markers found in photos that have the side `before_m` another one, in one step.

    Raises:
        CommandError: No marker can be as large.
    """
    check_length(side_m, "The side of the black square")
    squares = tuple(
        replace(square, side_m=side_m) if square.marker is not None and square.side_m == before_m else square
        for square in document.evidence.squares
    )
    evidence = replace(document.evidence, squares=squares)
    return set_evidence(evidence, label=f"Change the markers' side to {side_m:g} m")
