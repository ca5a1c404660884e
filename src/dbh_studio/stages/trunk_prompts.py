"""Boxes around trunks that geometry has found, as prompts for a segmenter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dbh_studio.core.arrays import Bool, Float, Float64, Int64, as_points, readonly
from dbh_studio.core.posed_images import PosedImage

# Points of a trunk beyond this many say nothing new about its box.
_MOST_POINTS = 2000
# A box is wider than the points by this share, for they do not reach the outline, and by so much at least.
_MARGIN, _MARGIN_PX = 0.08, 2.0
# A trunk is asked for where this share of it is in the picture, and this share of that is not behind nearer trunks.
_IN_PICTURE, _IN_SIGHT = 0.35, 0.5
_ROUND = 16


@dataclass(frozen=True, eq=False)
class TrunkShape:
    """A trunk as points on its surface.

    Attributes:
        id: The trunk's id.
        points: (K, 3) in the frame of the photos.
    """

    id: int
    points: Float64

    def __post_init__(self) -> None:
        points = as_points(self.points, name="points").astype(np.float64)
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) > _MOST_POINTS:
            points = points[np.linspace(0, len(points) - 1, _MOST_POINTS).astype(np.int64)]
        object.__setattr__(self, "points", readonly(points))

    @classmethod
    def cylinder(cls, id: int, foot: ArrayLike, top: ArrayLike, radius: float) -> TrunkShape:
        """A trunk of which only the axis and the radius are known.

        Args:
            id: The trunk's id.
            foot: (3,) lower end of the axis.
            top: (3,) upper end.
            radius: In the unit of both.

        Raises:
            ValueError: The axis has no length, or the radius is not positive.
        """
        low, high = np.asarray(foot, np.float64), np.asarray(top, np.float64)
        along = high - low
        length = float(np.linalg.norm(along))
        if low.shape != (3,) or high.shape != (3,) or not length > 0.0 or not radius > 0.0:
            raise ValueError(f"a cylinder from {foot!r} to {top!r} with radius {radius!r}")
        along /= length
        across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
        across /= np.linalg.norm(across)
        angles = np.arange(_ROUND) * 2.0 * np.pi / _ROUND
        ring = radius * (np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * np.cross(along, across))
        heights = np.linspace(0.0, length, 40)
        points = low + heights[:, None, None] * along + ring[None]
        return cls(id, points.reshape(-1, 3))


@dataclass(frozen=True, eq=False)
class TrunkBoxes:
    """Boxes of trunks in one picture, the nearest trunk first.

    Attributes:
        rows: (N,) which of the trunks.
        boxes_px: (N, 4) x0, y0, x1, y1, within the picture.
        distance: (N,) from the camera to the trunk's middle.
    """

    rows: Int64
    boxes_px: Float64
    distance: Float64


def trunk_boxes(
    photo: PosedImage, trunks: Sequence[TrunkShape], *, max_distance_m: float = 15.0, min_box_px: float = 4.0
) -> TrunkBoxes:
    """Upright boxes around trunks in a picture that is not a panorama: a photo, or a tile (`Tile.posed`).

    Trunks behind nearer ones, of which the picture shows a sliver only, which are too far or too thin get none: the
    segmenter would outline something else.

    Args:
        photo: In the frame of the trunks, metres.
        trunks: Any number.
        max_distance_m: Farther trunks are left out.
        min_box_px: Thinner boxes are left out.

    Raises:
        ValueError: The photo is a panorama, where a box over the seam is none.
    """
    if photo.camera.is_panorama:
        raise ValueError("a panorama has no upright boxes: give its tiles")
    middles = np.array([shape.points.mean(axis=0) if len(shape.points) else np.full(3, np.nan) for shape in trunks])
    distance = np.linalg.norm(middles.reshape(-1, 3) - photo.centre_src, axis=1)
    near = np.flatnonzero(distance <= max_distance_m)  # not those without points, whose distance is NaN
    rows: list[int] = []
    boxes: list[Float64] = []
    for row in near[np.argsort(distance[near], kind="stable")]:
        uv_px, is_seen = photo.project(trunks[row].points)
        if np.count_nonzero(is_seen) < _IN_PICTURE * len(is_seen):
            continue
        spots = uv_px[is_seen]
        if 1.0 - _covered(spots, boxes).mean() < _IN_SIGHT:
            continue
        box = _box(spots, photo.camera.width_px, photo.camera.height_px)
        if (box[2:] - box[:2] >= min_box_px).all():
            rows.append(int(row))
            boxes.append(box)
    index = np.array(rows, np.int64)
    return TrunkBoxes(index, np.array(boxes, np.float64).reshape(-1, 4), distance[index])


def _box(spots_px: Float, width_px: int, height_px: int) -> Float64:
    low, high = np.percentile(spots_px, [1.0, 99.0], axis=0)
    margin = np.maximum(_MARGIN * (high - low), _MARGIN_PX)
    # Up and down the trunk goes on: only its sides are its outline.
    margin[1] = _MARGIN_PX
    return np.clip(np.concatenate([low - margin, high + margin]), 0.0, [width_px, height_px, width_px, height_px])


def _covered(spots_px: Float, boxes: Sequence[Float64]) -> Bool:
    """(K,) which pixels lie in one of the boxes."""
    covered = np.zeros(len(spots_px), bool)
    for box in boxes:
        covered |= ((spots_px >= box[:2]) & (spots_px <= box[2:])).all(axis=1)
    return covered
