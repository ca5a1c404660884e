"""Metric scale from printed markers: find them in the photos, place them in space, compare with their known sides.

detections = find_markers(posed, settings=settings, read_image=read)
markers = triangulate_markers(detections, posed)
report = scale_from_markers(markers, {("DICT_4X4_50", 7): 1.0})
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import UInt8
from dbh_studio.core.bars import ScaleReport
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.errors import FileError
from dbh_studio.settings import MarkerSettings
from dbh_studio.stages.marker_detect import Detection, Detector, all_dictionaries, detect_in_photo
from dbh_studio.stages.marker_geometry import Marker3D, MarkerKey, frame_from_marker, triangulate_markers
from dbh_studio.stages.marker_scale import check_marker, scale_from_markers

__all__ = [
    "Detection",
    "Marker3D",
    "MarkerKey",
    "MarkerScale",
    "ReadImage",
    "check_marker",
    "find_markers",
    "frame_from_marker",
    "measure_scale",
    "scale_from_markers",
    "triangulate_markers",
]

ReadImage = Callable[[PosedImage], UInt8]
"""(H, W, 3) uint8 RGB of a photo; may be smaller than the camera says."""

_N_SURVEY = 12


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

    Where no dictionary is named, a dozen photos are searched for all of them first, and the rest for those seen.

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
    seen = sorted({detection.dictionary for detection in found})
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
    if unread and len(unread) == len(photos):
        raise unread[0]
    progress(1.0, f"{len(found)} sights of markers")
    return found


def measure_scale(
    posed: PosedImages,
    sides_m: Mapping[MarkerKey, float] | None = None,
    *,
    settings: MarkerSettings | None = None,
    read_image: ReadImage,
    progress: Progress = ignore_progress,
) -> MarkerScale:
    """All three steps; see `find_markers`, `triangulate_markers` and `scale_from_markers`."""
    settings = settings or MarkerSettings()
    detections = find_markers(posed, settings=settings, read_image=read_image, progress=progress)
    markers = triangulate_markers(detections, posed, settings=settings)
    placed = {marker.key for marker in markers}
    seen_once = sorted({detection.key for detection in detections} - placed)
    report = scale_from_markers(markers, sides_m, settings=settings, seen_once=seen_once)
    return MarkerScale(report, markers, detections)
