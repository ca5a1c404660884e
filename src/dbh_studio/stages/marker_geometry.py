"""From corners in photos to markers in space."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, Float64, readonly
from dbh_studio.core.posed_images import PosedImages
from dbh_studio.core.triangulation import SMALLEST_PARALLAX_DEG, linear_point, parallax, refine_point
from dbh_studio.settings import MarkerSettings
from dbh_studio.stages.marker_corners import PlacedCorners, place_corners
from dbh_studio.stages.marker_detect import Detection

MarkerKey = tuple[str, int]
SightKey = tuple[str, str, int]
"""(name of the photo, dictionary, id)."""

_MAX_PAIRS = 300
_MIN_VIEWS_OF_TWIN = 3
_SIDES = ((0, 1), (1, 2), (2, 3), (3, 0))
_DIAGONALS = ((0, 2), (1, 3))


@dataclass(frozen=True, eq=False)
class Marker3D:
    """One marker in the reconstruction.

    Attributes:
        dictionary: Its dictionary.
        marker_id: Its number.
        corners_src: (4, 3) outer corners, top left first, clockwise as printed.
        covariance: (12, 12) of the corners, from the spread over the photos and the noise of the pixels.
        views_used: Names of the photos it was measured in.
        views_rejected: Names of the photos whose rays miss it.
        views_far: Names of photos that agree, but from so far that they would only add shared error.
        residual_px: Root mean square distance of the corners to where the photos see them.
        footprint_src: Size of a photo's pixel on the marker, source units, as the photos weigh.
        parallax_deg: Largest angle between two of the views.
        front_share: Share of the views that stand before the printed side; about 0 where the poses are mirrored.
        size_drift: Standard error of the size from what photos of like distance share, as a share; None: not known.
        steepness: How many times more than usual far photos differ from near ones in the size they show.
        n_lost: Sights of the same code that agree with no marker.
    """

    dictionary: str
    marker_id: int
    corners_src: Float64
    covariance: Float64
    views_used: tuple[str, ...]
    views_rejected: tuple[str, ...]
    views_far: tuple[str, ...]
    residual_px: float
    footprint_src: float
    parallax_deg: float
    front_share: float
    size_drift: float | None = None
    steepness: float = 1.0
    n_lost: int = 0

    @property
    def key(self) -> MarkerKey:
        """(dictionary, id)."""
        return self.dictionary, self.marker_id

    @property
    def name(self) -> str:
        """For the report."""
        return f"{self.dictionary} {self.marker_id}"

    @property
    def sides_src(self) -> Float64:
        """(4,) lengths of the sides: top, right, bottom, left."""
        return _lengths(self.corners_src, _SIDES)

    @property
    def diagonals_src(self) -> Float64:
        """(2,) lengths of the diagonals."""
        return _lengths(self.corners_src, _DIAGONALS)

    @property
    def side_src(self) -> float:
        """The side of the square that its four sides and two diagonals say."""
        return float(_as_sides(self.corners_src).mean())

    @property
    def side_sigma_src(self) -> float:
        """Standard error of `side_src` from scatter."""
        gradient = np.zeros(12)
        for number in range(12):
            step = np.zeros(12)
            step[number] = 1e-6 * self.side_src
            up, down = self.corners_src + step.reshape(4, 3), self.corners_src - step.reshape(4, 3)
            gradient[number] = (_as_sides(up).mean() - _as_sides(down).mean()) / (2e-6 * self.side_src)
        return float(np.sqrt(gradient @ self.covariance @ gradient))

    @property
    def unevenness(self) -> float:
        """Largest departure of a side or diagonal from the square, or of a corner from the plane; share of the side."""
        sides = _as_sides(self.corners_src)
        normal = np.cross(self.corners_src[2] - self.corners_src[0], self.corners_src[3] - self.corners_src[1])
        normal /= max(float(np.linalg.norm(normal)), 1e-300)
        off_plane = np.abs((self.corners_src - self.corners_src.mean(axis=0)) @ normal).max()
        return float(max(np.abs(sides / sides.mean() - 1).max(), off_plane / sides.mean()))


def _lengths(corners: Float64, pairs: Sequence[tuple[int, int]]) -> Float64:
    return np.array([np.linalg.norm(corners[a] - corners[b]) for a, b in pairs])


def _as_sides(corners: Float64) -> Float64:
    """(6,) sides, and diagonals over the root of two."""
    return np.concatenate([_lengths(corners, _SIDES), _lengths(corners, _DIAGONALS) / np.sqrt(2)])


@dataclass(frozen=True, eq=False)
class _Sights:
    """All sights of one code: (V,) detections, (V, 3) camera centres, (V, 4, 3) unit directions, (V,) sigmas."""

    detections: tuple[Detection, ...]
    starts: Float64
    rays: Float64
    sigma_rad: Float64
    pixel_rad: Float64
    tolerance_rad: Float64

    def only(self, chosen: Bool) -> _Sights:
        kept = tuple(d for d, keep in zip(self.detections, chosen, strict=True) if keep)
        return _Sights(
            kept,
            self.starts[chosen],
            self.rays[chosen],
            self.sigma_rad[chosen],
            self.pixel_rad[chosen],
            self.tolerance_rad[chosen],
        )


def triangulate_markers(
    detections: Sequence[Detection],
    posed: PosedImages,
    *,
    settings: MarkerSettings | None = None,
    left_out: Collection[SightKey] = (),
) -> tuple[Marker3D, ...]:
    """Markers in space from their corners in the photos; the poses stay as they are.

    A photo whose rays miss the marker is left out as a whole, so that all four corners rest on the same photos: an
    error of a pose then moves the marker but hardly changes its size. A code seen at two places gives two markers.

    Args:
        detections: From `find_markers`.
        posed: The same photos.
        settings: The largest offset allowed.
        left_out: Sights struck out by the person: (name of the photo, dictionary, id).

    Returns:
        Sorted by dictionary and id; a code seen from less than two places gives none.
    """
    settings = settings or MarkerSettings()
    struck = set(left_out)
    detections = [d for d in detections if (d.image, *d.key) not in struck]
    markers: list[Marker3D] = []
    for key in sorted({d.key for d in detections}):
        rest = _sights([d for d in detections if d.key == key], posed, settings)
        needed, placed = 2, len(markers)
        while len(rest.detections) >= needed:
            agrees = _consensus(rest)
            if agrees.sum() < needed:
                break
            marker, used = _marker(rest, agrees, settings)
            if marker is None:
                break
            markers.append(marker)
            rest, needed = rest.only(~used), _MIN_VIEWS_OF_TWIN
        markers[placed:] = [replace(marker, n_lost=len(rest.detections)) for marker in markers[placed:]]
    return tuple(markers)


def _sights(detections: Sequence[Detection], posed: PosedImages, settings: MarkerSettings) -> _Sights:
    starts, rays = [], []
    for detection in detections:
        origin, directions = posed.by_name(detection.image).ray(detection.corners_px)
        starts.append(origin)
        rays.append(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    pixel = np.array([d.pixel_rad for d in detections])
    # On rendered plots corners are off by twice what the noise of the pixels says, and never by less than this.
    sigma = np.hypot([2 * d.sigma_px for d in detections], 0.02) * pixel
    return _Sights(
        tuple(detections),
        np.array(starts).reshape(-1, 3),
        np.array(rays).reshape(-1, 4, 3),
        sigma,
        pixel,
        settings.max_offset_px * pixel,
    )


def _offsets(corners: Float64, sights: _Sights) -> Float64:
    """(V, 4) angle between each ray and the direction to its corner."""
    towards = corners[None] - sights.starts[:, None]
    across = np.linalg.norm(np.cross(sights.rays, towards), axis=2)
    return np.asarray(np.arctan2(across, (sights.rays * towards).sum(axis=2)))


def _consensus(sights: _Sights) -> Bool:
    """(V,) the sights that agree with the pair most others agree with."""
    count = len(sights.detections)
    pairs = list(combinations(range(count), 2))
    if len(pairs) > _MAX_PAIRS:
        pairs = [pairs[i] for i in np.random.default_rng(0).choice(len(pairs), _MAX_PAIRS, replace=False)]
    best, best_score = np.zeros(count, bool), 0.0
    for pair in pairs:
        chosen = list(pair)
        if parallax(sights.rays[chosen].mean(axis=1)) < SMALLEST_PARALLAX_DEG:
            continue
        try:
            corners = np.array(
                [linear_point(sights.starts[chosen], sights.rays[chosen, k], np.ones(2)) for k in range(4)]
            )
        except np.linalg.LinAlgError:
            continue
        scaled = np.sqrt((_offsets(corners, sights) ** 2).mean(axis=1)) / (2 * sights.tolerance_rad)
        score = float(np.maximum(1 - scaled**2, 0).sum())
        if score > best_score:
            best, best_score = scaled < 1, score
    return best


def _marker(sights: _Sights, agrees: Bool, settings: MarkerSettings) -> tuple[Marker3D | None, Bool]:
    """Refine, reject, and refine again until the set of photos stays."""
    used = agrees
    corners = _corners(sights, used)
    for _ in range(8):
        if corners is None:
            return None, used
        kept = used & _plausible(corners, sights, used)
        if (kept == used).all():
            break
        if kept.sum() < 2:
            return None, used
        used = kept
        corners = _corners(sights, used)
    if corners is None:
        return None, used
    members = np.flatnonzero(used)
    agreeing = sights.only(used)
    placed = place_corners(
        agreeing.starts,
        agreeing.rays,
        agreeing.sigma_rad,
        agreeing.pixel_rad,
        corners.mean(axis=0),
        settings.systematic_px,
    )
    if placed is None:
        return None, used
    return _described(sights, members[placed.chosen], used, placed), used


def _plausible(corners: Float64, sights: _Sights, used: Bool) -> Bool:
    """(V,) within the tolerance, and the seen shape no farther off than the other photos' own is."""
    offsets = np.sqrt((_offsets(corners, sights) ** 2).mean(axis=1))
    shape = _shape_offsets(corners, sights) / sights.sigma_rad
    usual = max(float(np.median(shape[used])), 1.0)
    return np.asarray((offsets < sights.tolerance_rad) & (shape < 5 * usual))


def _shape_offsets(corners: Float64, sights: _Sights) -> Float64:
    """(V,) root mean square offset of the corners after taking out what they have in common: a pose's own error."""
    towards = corners[None] - sights.starts[:, None]
    towards /= np.linalg.norm(towards, axis=2, keepdims=True)
    off = sights.rays - towards
    return np.asarray(np.sqrt(((off - off.mean(axis=1, keepdims=True)) ** 2).sum(axis=2).mean(axis=1)))


def _corners(sights: _Sights, used: Bool) -> Float64 | None:
    """(4, 3) each corner from the same photos with the same weights.

    No Huber weights: they would differ from corner to corner, and what a pose's error has in common would become size.
    """
    weights = 1 / sights.sigma_rad[used] ** 2
    try:
        return np.array(
            [refine_point(sights.starts[used], sights.rays[used, k], weights, huber_sigma=np.inf)[0] for k in range(4)]
        )
    except np.linalg.LinAlgError:
        return None


def _described(sights: _Sights, chosen: NDArray[np.int64], agreeing: Bool, placed: PlacedCorners) -> Marker3D:
    detections, corners = sights.detections, placed.corners
    near = sights.only(np.isin(np.arange(len(agreeing)), chosen))
    middle = corners.mean(axis=0)
    footprint = np.linalg.norm(middle - sights.starts, axis=1) * sights.pixel_rad
    front = -np.cross(corners[1] - corners[0], corners[3] - corners[0])
    offsets = _offsets(corners, near) / near.pixel_rad[:, None]
    used = np.zeros(len(agreeing), bool)
    used[chosen] = True
    return Marker3D(
        dictionary=detections[0].dictionary,
        marker_id=detections[0].marker_id,
        corners_src=corners,
        covariance=placed.covariance,
        views_used=tuple(d.image for d in near.detections),
        views_rejected=tuple(d.image for d, u in zip(detections, agreeing, strict=True) if not u),
        views_far=tuple(d.image for d, u in zip(detections, agreeing & ~used, strict=True) if u),
        residual_px=float(np.sqrt((offsets**2).mean())),
        footprint_src=float(placed.weights.share @ footprint[chosen]),
        parallax_deg=parallax(near.rays.mean(axis=1)),
        front_share=float(((near.starts - middle) @ front > 0).mean()),
        size_drift=placed.weights.drift,
        steepness=placed.weights.steepness,
    )


def frame_from_marker(marker: Marker3D) -> tuple[Float64, Float64, Float64]:
    """Up, origin and north from a marker that lies flat.

    Returns:
        (3,) unit normal of the printed side, (3,) middle of the marker, and (3,) unit direction from the middle of its
        bottom edge to that of its top edge; source coordinates.
    """
    corners = marker.corners_src
    north = (corners[0] + corners[1] - corners[2] - corners[3]) / 2
    east = (corners[1] + corners[2] - corners[0] - corners[3]) / 2
    up = np.cross(east, north)
    up /= np.linalg.norm(up)
    north = north - (north @ up) * up
    return readonly(up), readonly(corners.mean(axis=0)), readonly(north / np.linalg.norm(north))
