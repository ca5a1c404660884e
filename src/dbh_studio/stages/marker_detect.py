"""Markers in one photo: look everywhere, look a second time straight at each find, then fit its whole pattern."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dbh_studio.core.arrays import Float64, UInt8, readonly
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.io.marker_codes import (
    FAMILIES,
    dictionary,
    is_available,
    known_name,
    marker_bits,
    opencv,
    smallest_dictionary,
)
from dbh_studio.settings import MarkerSettings
from dbh_studio.stages.marker_fit import apply_homography, fit_marker, homography, view_rotation
from dbh_studio.stages.marker_views import View, needs_tiles, tiles_of, view_towards

_CROP_PX = 96
# Without a second sight, the pattern itself must match better.
_MATCH_UNCONFIRMED = 0.9


@dataclass(frozen=True, eq=False)
class Detection:
    """One marker in one photo.

    Attributes:
        image: Name of the photo.
        dictionary: The smallest of its family that has this marker.
        marker_id: Its number.
        corners_px: (4, 2) outer corners of the black border, top left first, clockwise as printed; COLMAP pixels.
        confidence: Correlation of its inner cells with the pattern, 0-1.
        crop: (96, 96, 3) straight view of it, for the picture.
        sigma_px: Standard error of a corner from the pixels' noise.
        pixel_rad: Angle of a pixel at the marker.
        blur_px: Sigma of the blur there.
    """

    image: str
    dictionary: str
    marker_id: int
    corners_px: Float64
    confidence: float
    crop: UInt8
    sigma_px: float
    pixel_rad: float
    blur_px: float

    @property
    def key(self) -> tuple[str, int]:
        """(dictionary, id), as sides are given by."""
        return self.dictionary, self.marker_id


@dataclass(frozen=True, eq=False)
class _Find:
    """A first sight: which code, and about where (4, 2) in the photo."""

    dictionary: str
    marker_id: int
    corners_px: Float64
    off_centre: float


class Detector:
    """OpenCV's detector for some dictionaries, and what it found by name."""

    def __init__(self, names: Sequence[str], ids: Sequence[int] = ()) -> None:
        self.names = [known_name(name) for name in names]
        self.ids = tuple(sorted(set(ids)))
        aruco = opencv().aruco
        parameters = aruco.DetectorParameters()
        parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
        parameters.adaptiveThreshWinSizeMax = 43
        codes = [_only(dictionary(name), self.ids) for name in self.names]
        # Several dictionaries at once share the search for squares, where OpenCV can do that.
        self._together = len(codes) > 1 and hasattr(aruco.ArucoDetector, "detectMarkersMultiDict")
        if self._together:
            self._detectors = [aruco.ArucoDetector(codes, parameters)]
        else:
            self._detectors = [aruco.ArucoDetector(code, parameters) for code in codes]

    def __call__(self, grey: UInt8) -> list[tuple[str, int, Float64]]:
        """(dictionary, id, (4, 2) corners) of each find; corners with (0, 0) the outer top-left corner."""
        if self._together:
            corners, ids, _, which = self._detectors[0].detectMarkersMultiDict(grey)
            found = zip(
                corners, [] if ids is None else ids.ravel(), [] if which is None else which.ravel(), strict=True
            )
        else:
            found = self._one_by_one(grey)
        return [
            (self.names[number], self._id(int(index)), np.asarray(quad, np.float64).reshape(4, 2) + 0.5)
            for quad, index, number in found
        ]

    def _one_by_one(self, grey: UInt8) -> Any:
        for number, detector in enumerate(self._detectors):
            corners, ids, _ = detector.detectMarkers(grey)
            for quad, index in zip(corners, [] if ids is None else ids.ravel(), strict=True):
                yield quad, index, number

    def _id(self, index: int) -> int:
        return self.ids[index] if self.ids else index


def _only(codes: Any, ids: Sequence[int]) -> Any:
    """A dictionary of a few codes: naming a find takes time in proportion to them."""
    if not ids:
        return codes
    chosen = [i for i in ids if i < codes.bytesList.shape[0]]
    return opencv().aruco.Dictionary(codes.bytesList[chosen], codes.markerSize, codes.maxCorrectionBits)


def all_dictionaries() -> list[str]:
    """The largest dictionary of each family that the installed OpenCV knows."""
    return [family[-1] for family in FAMILIES if is_available(family[-1])]


def detect_in_photo(photo: PosedImage, picture: UInt8, detector: Detector, settings: MarkerSettings) -> list[Detection]:
    """All markers in one photo, fitted.

    Args:
        photo: Its camera says how it is bent.
        picture: (H, W, 3) uint8 RGB; may be a resized one of the same aspect.
        detector: For the dictionaries to look for.
        settings: Search width and smallest match.

    Raises:
        ValueError: The picture has another aspect than the camera.
    """
    height, width = picture.shape[:2]
    camera = photo.camera
    if (width, height) != (camera.width_px, camera.height_px):
        camera = camera.scaled_to(width, height)
    grey = opencv().cvtColor(picture, opencv().COLOR_RGB2GRAY)
    to_photo = np.array([photo.camera.width_px / width, photo.camera.height_px / height])
    found = []
    for find in _distinct(_first_look(grey, camera, detector, settings.detection_width_px), camera):
        detection = _second_look(find, photo.name, picture, grey, camera, settings)
        if detection is not None:
            found.append(_rescaled(detection, to_photo))
    return _best_per_place(found, photo.camera)


def _rescaled(detection: Detection, factor: Float64) -> Detection:
    if (factor == 1).all():
        return detection
    mean = float(factor.mean())
    return Detection(
        detection.image,
        detection.dictionary,
        detection.marker_id,
        readonly(detection.corners_px * factor),
        detection.confidence,
        detection.crop,
        detection.sigma_px * mean,
        detection.pixel_rad / mean,
        detection.blur_px * mean,
    )


def _first_look(grey: UInt8, camera: CameraModel, detector: Detector, width_px: int) -> list[_Find]:
    factor = min(1.0, width_px / max(camera.width_px, camera.height_px))
    small, small_camera = grey, camera
    if factor < 1:
        size = (round(camera.width_px * factor), round(camera.height_px * factor))
        small, small_camera = opencv().resize(grey, size, interpolation=opencv().INTER_AREA), camera.scaled_to(*size)
    up = np.array([camera.width_px / small_camera.width_px, camera.height_px / small_camera.height_px])
    if not needs_tiles(small_camera):
        return [_Find(name, number, quad * up, 0.0) for name, number, quad in detector(small)]
    finds = []
    for view, tile in tiles_of(small, small_camera):
        for name, number, quad in detector(tile):
            uv, is_seen = small_camera.project(view.rays(quad))
            if is_seen.all():
                off_centre = float(np.linalg.norm(quad.mean(axis=0) - view.size_px / 2))
                finds.append(_Find(name, number, uv * up, off_centre))
    return finds


def _directions(camera: CameraModel, corners_px: Float64) -> Float64:
    rays = camera.rays(corners_px)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _distinct(finds: list[_Find], camera: CameraModel) -> list[_Find]:
    """One find per code and place: tiles overlap. The one nearest to the middle of its tile is the least bent."""
    kept: list[tuple[_Find, Float64]] = []
    for find in sorted(finds, key=lambda f: f.off_centre):
        rays = _directions(camera, find.corners_px)
        if not np.isfinite(rays).all():
            continue
        size = float(np.linalg.norm(rays[0] - rays[2]))
        again = any(
            find.dictionary == other.dictionary
            and find.marker_id == other.marker_id
            and np.linalg.norm(rays.mean(axis=0) - seen.mean(axis=0)) < 0.5 * size
            for other, seen in kept
        )
        if not again:
            kept.append((find, rays))
    return [find for find, _ in kept]


def _second_look(
    find: _Find, image: str, picture: UInt8, grey: UInt8, camera: CameraModel, settings: MarkerSettings
) -> Detection | None:
    """Look straight at the find with this one code in mind, then fit the pattern to the photo's own pixels."""
    rays = _directions(camera, find.corners_px)
    middle = rays.mean(axis=0)
    reach = float(np.arccos(np.clip(rays @ middle / np.linalg.norm(middle), -1, 1)).max())
    view = view_towards(camera, middle, 3.6 * reach)
    again = _corners_in_view(find, view, view.render(grey, camera))
    starts = [find.corners_px]
    if again is not None:
        starts.insert(0, camera.project(view.rays(again))[0])
    bits = marker_bits(find.dictionary, find.marker_id)
    for start in starts:
        fit = fit_marker(grey, camera, start, bits)
        enough = settings.min_match if again is not None else max(settings.min_match, _MATCH_UNCONFIRMED)
        if fit is not None and fit.correlation >= enough:
            return Detection(
                image,
                smallest_dictionary(find.dictionary, find.marker_id),
                find.marker_id,
                fit.corners_px,
                fit.correlation,
                _crop(picture, camera, fit.corners_px),
                fit.sigma_px,
                fit.pixel_rad,
                fit.blur_px,
            )
    return None


def _corners_in_view(find: _Find, view: View, tile: UInt8) -> Float64 | None:
    """(4, 2) corners of this very code in the view, nearest to its middle; None where it is not seen again."""
    seen = Detector([find.dictionary], [find.marker_id])(tile)
    quads = [quad for _, _, quad in seen]
    if not quads:
        return None
    return min(quads, key=lambda quad: float(np.linalg.norm(quad.mean(axis=0) - view.size_px / 2)))


def _crop(picture: UInt8, camera: CameraModel, corners_px: Float64) -> UInt8:
    """The marker as if seen from straight above, with its rim."""
    rays = _directions(camera, corners_px)
    rotation = view_rotation(rays.sum(axis=0))
    local = rays @ rotation.T
    edge = 0.14 * _CROP_PX
    inner = np.array([[edge, edge], [_CROP_PX - edge, edge], [_CROP_PX - edge] * 2, [edge, _CROP_PX - edge]])
    to_plane = homography(inner, local[:, :2] / local[:, 2:])
    columns, rows = np.meshgrid(np.arange(_CROP_PX), np.arange(_CROP_PX))
    plane = apply_homography(to_plane, np.column_stack([columns.ravel(), rows.ravel()]) + 0.5)
    uv, _ = camera.project(np.column_stack([plane, np.ones(len(plane))]) @ rotation)
    spots = np.nan_to_num(uv - 0.5, nan=-10.0).astype(np.float32).reshape(_CROP_PX, _CROP_PX, 2)
    cv2 = opencv()
    border = cv2.BORDER_WRAP if camera.is_panorama else cv2.BORDER_CONSTANT
    crop: UInt8 = readonly(cv2.remap(picture, spots, None, cv2.INTER_LINEAR, borderMode=border))
    return crop


def _overlap(rays: Float64, others: Float64) -> bool:
    """Whether the middle of one marker lies within the other: a pattern may hold what looks like a smaller marker."""
    size = max(float(np.linalg.norm(quad[0] - quad[2])) for quad in (rays, others))
    return bool(np.linalg.norm(rays.mean(axis=0) - others.mean(axis=0)) < 0.5 * size)


def _best_per_place(found: list[Detection], camera: CameraModel) -> list[Detection]:
    """Where two codes claim one place, the one whose pattern matches better."""
    kept: list[tuple[Detection, Float64]] = []
    for detection in sorted(found, key=lambda d: -d.confidence):
        # By direction: on a panorama a marker on the seam is in two places of the picture.
        rays = _directions(camera, detection.corners_px)
        if not any(_overlap(rays, other) for _, other in kept):
            kept.append((detection, rays))
    return [detection for detection, _ in kept]
