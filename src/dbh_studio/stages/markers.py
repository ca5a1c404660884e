"""Metric scale from printed markers: find them in the photos, place them in space, compare with their known sides.

detections = find_markers(posed, settings=settings, read_image=read)
markers = triangulate_markers(detections, posed)
report = scale_from_markers(markers, {("DICT_4X4_50", 7): 1.0})
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import UInt8
from dbh_studio.core.bars import ScaleReport, refused_scale
from dbh_studio.core.dbh import Refusal
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.errors import FileError
from dbh_studio.io.marker_codes import largest_dictionary
from dbh_studio.settings import MarkerSettings
from dbh_studio.stages.marker_crops import detection_crop
from dbh_studio.stages.marker_detect import Detection, Detector, all_dictionaries, detect_in_photo
from dbh_studio.stages.marker_geometry import Marker3D, MarkerKey, SightKey, frame_from_marker, triangulate_markers
from dbh_studio.stages.marker_scale import check_marker, scale_from_markers

__all__ = [
    "Detection",
    "Marker3D",
    "MarkerKey",
    "MarkerScale",
    "ReadImage",
    "SightKey",
    "check_marker",
    "detection_crop",
    "find_markers",
    "frame_from_marker",
    "measure_scale",
    "scale_from_detections",
    "scale_from_markers",
    "triangulate_markers",
]

ReadImage = Callable[[PosedImage], UInt8]
"""(H, W, 3) uint8 RGB of a photo; may be smaller than the camera says."""

_N_SURVEY = 12
_N_LAST_LOOK = 5


@dataclass(frozen=True, eq=False)
class MarkerScale:
    """Everything the markers said.

    Attributes:
        report: The scale and its verdict.
        markers: The markers in space.
        detections: All sights, for the pictures.
    """

    report: ScaleReport
    markers: tuple[Marker3D, ...]
    detections: tuple[Detection, ...]


def find_markers(
    posed: PosedImages,
    *,
    settings: MarkerSettings | None = None,
    read_image: ReadImage,
    progress: Progress = ignore_progress,
) -> tuple[Detection, ...]:
    """Every marker in every photo.

    Where no dictionary is named, a dozen photos are searched for all of them first, and the rest for those seen and for
    the numbers of their families that were not.

    Args:
        posed: The photos.
        settings: Dictionaries, ids, search width.
        read_image: Reads one photo.
        progress: Called once per photo.

    Raises:
        FileError: No photo can be read.
        MissingComponentError: OpenCV is absent.
        SettingError: There is no dictionary of that name.
    """
    settings = settings or MarkerSettings()
    photos = list(posed.images)
    if settings.dictionaries:
        return tuple(_search(photos, Detector(settings.dictionaries, settings.ids), settings, read_image, progress))
    everything = Detector(all_dictionaries(), settings.ids)
    first = [photos[i] for i in np.unique(np.linspace(0, len(photos) - 1, min(len(photos), _N_SURVEY)).astype(int))]
    share = len(first) / max(len(photos), 1)
    found = _search(first, everything, settings, read_image, subprogress(progress, 0.0, share))
    # The small dictionaries too: the fewer codes, the more damage to one is made good.
    small = {detection.dictionary for detection in found}
    seen = sorted(small | {largest_dictionary(name) for name in small})
    others = [photo for photo in photos if photo not in first]
    detector = Detector(seen, settings.ids) if seen else everything
    found += _search(others, detector, settings, read_image, subprogress(progress, share, 1.0))
    order = {photo.name: number for number, photo in enumerate(photos)}
    return tuple(sorted(found, key=lambda detection: order[detection.image]))


def _search(
    photos: Sequence[PosedImage],
    detector: Detector,
    settings: MarkerSettings,
    read_image: ReadImage,
    progress: Progress,
) -> list[Detection]:
    found: list[Detection] = []
    unread: list[FileError] = []
    for number, photo in enumerate(photos):
        progress(number / len(photos), f"looking for markers in photo {number + 1} of {len(photos)}")
        try:
            picture = read_image(photo)
        except FileError as error:
            # One lost photo of many does not matter; none at all does.
            unread.append(error)
            continue
        found += detect_in_photo(photo, picture, detector, settings)
        # Not two decoded panoramas at a time.
        del picture
    if unread and len(unread) == len(photos):
        raise unread[0]
    progress(1.0, f"{len(found)} sights of markers")
    return found


def scale_from_detections(
    detections: Sequence[Detection],
    posed: PosedImages,
    sides_m: Mapping[MarkerKey, float] | None = None,
    *,
    settings: MarkerSettings | None = None,
    left_out: Collection[SightKey] = (),
    only_named: bool = False,
) -> MarkerScale:
    """Place and scale again without looking at the photos: after a side was corrected or a sight struck out.

    Args:
        detections: From `find_markers`.
        posed: The same photos.
        sides_m: Side of the black square per (dictionary, id); the others have `settings.side_m`.
        settings: As for `triangulate_markers` and `scale_from_markers`.
        left_out: Sights struck out by the person: (name of the photo, dictionary, id).
        only_named: Whether markers without a side of their own in `sides_m` are ignored.
    """
    settings = settings or MarkerSettings()
    struck = set(left_out)
    kept = [detection for detection in detections if (detection.image, *detection.key) not in struck]
    markers = triangulate_markers(kept, posed, settings=settings)
    sights = Counter(detection.key for detection in kept)
    unplaced = sorted(set(sights) - {marker.key for marker in markers})
    report = scale_from_markers(
        markers, sides_m, settings=settings, seen_once=unplaced, sights=sights, only_named=only_named
    )
    return MarkerScale(report, markers, tuple(detections))


def measure_scale(
    posed: PosedImages,
    sides_m: Mapping[MarkerKey, float] | None = None,
    *,
    settings: MarkerSettings | None = None,
    read_image: ReadImage,
    progress: Progress = ignore_progress,
    left_out: Collection[SightKey] = (),
) -> MarkerScale:
    """All three steps; see `find_markers` and `scale_from_detections`.

    Where nothing is found, a few photos are looked at again for what may be wrong: other dictionaries, mirrored photos.
    """
    settings = settings or MarkerSettings()
    detections = find_markers(
        posed,
        settings=settings,
        read_image=read_image,
        progress=subprogress(progress, 0.0, 0.95 if len(posed) else 1.0),
    )
    if not detections and len(posed):
        why = why_none(posed, settings, read_image, subprogress(progress, 0.95, 1.0))
        if why is not None:
            return MarkerScale(refused_scale(why.code, why.reason, why.remedy), (), ())
    progress(1.0, f"{len(detections)} sights of markers")
    return scale_from_detections(detections, posed, sides_m, settings=settings, left_out=left_out)


def why_none(posed: PosedImages, settings: MarkerSettings, read_image: ReadImage, progress: Progress) -> Refusal | None:
    """What a few photos show where the search found nothing; None where they show nothing of the kind either."""
    everything = Detector(all_dictionaries())
    photos = list(posed.images)
    some = [photos[i] for i in np.unique(np.linspace(0, len(photos) - 1, min(len(photos), _N_LAST_LOOK)).astype(int))]
    for number, photo in enumerate(some):
        progress(number / len(some), "looking for other and for mirrored markers")
        try:
            picture = read_image(photo)
        except FileError:
            continue
        if settings.dictionaries or settings.ids:
            others = detect_in_photo(photo, picture, everything, settings)
            if others:
                return Refusal(
                    "other_markers",
                    f"Photo {photo.name} shows {others[0].dictionary} {others[0].marker_id}, which was not looked for.",
                    "Choose its dictionary and number, or leave both open.",
                )
        mirrored = np.ascontiguousarray(picture[:, ::-1])
        if detect_in_photo(photo, mirrored, everything, settings):
            return Refusal(
                "mirrored_photos",
                f"Photo {photo.name} shows a marker mirrored.",
                "The photos, or the printed marker, are mirrored: export the photos again as they were taken.",
            )
    return None
