"""The scale of a plot from markers and known lengths: found in photos, or marked by hand in the cloud or in photos."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.app.commands import Command, set_evidence, set_frame, set_scale
from dbh_studio.app.document import Document
from dbh_studio.app.lengths import check_length
from dbh_studio.core.arrays import Float64
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.scale import WEAK_SOURCES, ScaleEstimate
from dbh_studio.core.scale_evidence import WELL_SEEN, MarkedPoint, MarkerKey, MarkerSquare, Sight
from dbh_studio.errors import CommandError
from dbh_studio.settings import MarkerSettings

if TYPE_CHECKING:
    from dbh_studio.core.bars import ScaleReport
    from dbh_studio.core.cloud import PointCloud
    from dbh_studio.core.dbh import Refusal
    from dbh_studio.core.posed_images import PosedImages
    from dbh_studio.stages.marker_detect import Detection
    from dbh_studio.stages.marker_geometry import Marker3D

# How well a person hits a corner in a photo, pixels of it.
CLICK_SIGMA_PX = 1.0
# How well a person keeps the height of a camera, and knows the distance of two photos.
_HELD_SHARE = 0.05
_PATH_SHARE = 0.02
_MIN_CAMERAS = 3
# A marker that is off by more than this share, and by so many standard errors, is not of the size given.
_OTHER_SIZE, _OTHER_SIZE_SIGMAS = 0.01, 4.0
# A scale from elsewhere is not replaced unasked.
_MEASURED = frozenset({"unknown", "marker", "bars"})
# Rays that meet at less say little about the distance.
_GOOD_PARALLAX_DEG = 8.0


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


# ---- found in photos


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


# ---- marked by hand


def point_from_sights(
    sights: Sequence[Sight], posed: PosedImages, *, sigma_px: float = CLICK_SIGMA_PX
) -> TriangulatedPoint | Refusal:
    """The point that several photos show, or why they show none.

    Args:
        sights: One per photo.
        posed: The photos, in the cloud's frame.
        sigma_px: How well the point was hit.
    """
    from dbh_studio.core.dbh import Refusal
    from dbh_studio.core.triangulation import triangulate

    rays, origins, sigmas = [], [], []
    for sight in sights:
        try:
            photo = posed.by_name(sight.image)
        except KeyError:
            return Refusal("no_photo", f"The photo {sight.image} is gone.", "Take the point out of it.")
        uv = np.array([[sight.u_px, sight.v_px], [sight.u_px + 0.5, sight.v_px], [sight.u_px, sight.v_px + 0.5]])
        origin, directions = photo.ray(uv)
        if not np.isfinite(directions[0]).all():
            return Refusal("bad_ray", f"{sight.image} shows nothing there.", "Mark the point inside the picture.")
        # At the border of the lens the pixel beside may have no direction.
        beside = [_angle(directions[0], other) for other in directions[1:] if np.isfinite(other).all()]
        step = max(beside, default=0.0)
        origins.append(origin)
        rays.append(directions[0])
        sigmas.append(sigma_px * 2 * max(step, 1e-9))
    if not rays:
        return Refusal("one_view", "The point is marked in no photo.", "Mark it in two or more photos.")
    result = triangulate(np.array(origins), np.array(rays), np.array(sigmas))
    if isinstance(result, Refusal):
        return result
    distance = np.linalg.norm(np.array(origins) - result.point, axis=1)
    residual_px = result.residuals_rad / (np.array(sigmas) / sigma_px)
    sigma_src = float(np.sqrt(np.trace(result.covariance) / 3))
    point = MarkedPoint(tuple(result.point), sigma_src, tuple(sights))
    return TriangulatedPoint(
        point, tuple(residual_px), tuple(result.inliers.tolist()), result.parallax_deg, tuple(distance)
    )


def _angle(a: Float64, b: Float64) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


@dataclass(frozen=True)
class TriangulatedPoint:
    """A point from photos.

    Attributes:
        point: Where it is, with its error and sights.
        residuals_px: Per sight, how far the point is from where it was marked, pixels.
        is_used: Per sight, whether it agrees with the others.
        parallax_deg: Largest angle between two rays; below 5° the distance is weak.
        distances_src: Per sight, from camera to point.
    """

    point: MarkedPoint
    residuals_px: tuple[float, ...]
    is_used: tuple[bool, ...]
    parallax_deg: float
    distances_src: tuple[float, ...]


@dataclass(frozen=True)
class Suggestion:
    """A photo in which a point should be visible too: `u_px`, `v_px` where, `distance_src` how far from the camera."""

    image: str
    u_px: float
    v_px: float
    distance_src: float


def photos_of_point(
    point_src: Float64, posed: PosedImages, *, without: Sequence[str] = (), at_most: int = 12
) -> tuple[Suggestion, ...]:
    """Photos that have a point in view, nearest first; what stands in between is not known.

    Those that look at it from nearly the same side as one of `without` come last: they say little about its distance.

    Args:
        point_src: (3,) absolute source coordinates; roughly is enough.
        posed: The photos, in the cloud's frame.
        without: Photos not to name: the point is marked in them.
        at_most: How many.
    """
    point = np.asarray(point_src, np.float64)
    left_out = set(without)
    marked_from = [point - photo.centre_src for photo in posed if photo.name in left_out]
    found: list[tuple[bool, Suggestion]] = []
    for photo in posed:
        if photo.name in left_out or photo.path is None:
            continue
        uv, in_view = photo.project(point[None])
        if in_view[0]:
            towards = point - photo.centre_src
            is_alike = any(np.degrees(_angle(towards, other)) < _GOOD_PARALLAX_DEG for other in marked_from)
            suggestion = Suggestion(photo.name, float(uv[0, 0]), float(uv[0, 1]), float(np.linalg.norm(towards)))
            found.append((is_alike, suggestion))
    found.sort(key=lambda each: (each[0], each[1].distance_src))
    return tuple(suggestion for _, suggestion in found[:at_most])


def scale_from_evidence(document: Document, *, label: str = "Set the scale by known lengths") -> Command:
    """Take the scale from the control lengths of the plot.

    Raises:
        CommandError: They give none; says why.
    """
    report = document.evidence.report(np.array(document.up_direction))
    if report.estimate is None:
        raise CommandError(report.verdict.message, report.verdict.remedy)
    return Command(label, set_scale(report.estimate).apply)


# ---- where nothing else exists


def scale_from_baseline(posed: PosedImages, first: str, second: str, distance_m: float) -> ScaleEstimate:
    """From the distance between two photos, walked or of a rig. Weak.

    Raises:
        CommandError: The two are at one place, or the distance makes no sense.
    """
    check_length(distance_m, "The distance between the two photos")
    try:
        gap = float(np.linalg.norm(posed.by_name(first).centre_src - posed.by_name(second).centre_src))
    except KeyError as error:
        raise CommandError(f"There is no photo {error.args[0]}.", "Choose two photos of this plot.") from None
    if not gap > 0:
        raise CommandError("Both photos were taken at one place.", "Choose two photos that are farther apart.")
    scale = distance_m / gap
    return ScaleEstimate(scale, "baseline", _PATH_SHARE * scale)


def scale_from_camera_height(
    posed: PosedImages, cloud: PointCloud, up_direction: Float64, height_m: float
) -> ScaleEstimate:
    """From how high above the ground the camera was carried. Weak: ground and arm both move.

    The ground under a camera is the low side of the cloud around it, as far as the camera is high.

    Raises:
        CommandError: The ground is seen under fewer than three cameras, or the height makes no sense.
    """
    check_length(height_m, "The height of the camera")
    heights = _camera_heights(posed, cloud, np.asarray(up_direction, np.float64))
    if len(heights) < _MIN_CAMERAS:
        raise CommandError(
            "The ground is seen under too few of the cameras.", "Check the up axis, or mark a known distance instead."
        )
    middle = float(np.median(heights))
    spread = 1.4826 * float(np.median(np.abs(heights - middle))) / middle
    scale = height_m / middle
    return ScaleEstimate(scale, "camera_height", scale * float(np.hypot(_HELD_SHARE, spread / np.sqrt(len(heights)))))


def _camera_heights(posed: PosedImages, cloud: PointCloud, up: Float64) -> Float64:
    """(K,) heights of the cameras above the ground under them, source units."""
    from scipy.spatial import cKDTree

    from dbh_studio.core.updirection import rotation_from_up

    rotation = rotation_from_up(up)
    step = max(1, len(cloud) // 2_000_000)
    points = cloud.xyz[::step].astype(np.float64) @ rotation.T
    centres = (posed.centres_src - cloud.origin) @ rotation.T
    tree = cKDTree(points[:, :2])
    extent = float(np.ptp(centres[:, :2], axis=0).max())
    # In an unknown unit the only length at hand is the walk itself.
    radius = max(0.05 * extent, 1e-12)
    heights = []
    for centre, rows in zip(centres, tree.query_ball_point(centres[:, :2], radius), strict=True):
        if len(rows) >= 20:
            heights.append(centre[2] - float(np.quantile(points[rows, 2], 0.05)))
    found = np.array(heights, np.float64)
    return np.asarray(found[found > 0])


# ---- up, origin and north


def frame_from_square(
    square: MarkerSquare, cloud: PointCloud, *, up: bool = True, origin: bool = True, north: bool = True
) -> Command:
    """Let a marker that lies flat say where the sky, the plot's origin and north are.

    Raises:
        CommandError: Its corners span no plane.
    """
    try:
        normal, middle, top = square.frame()
    except ValueError as error:
        raise CommandError(f"{square.name} gives no directions: {error}.") from None
    offset = np.array(middle) - cloud.origin
    return set_frame(up=normal if up else None, north=top if north else None, origin_src=offset if origin else None)
