"""What the masks of one photo say of a point: trunk, which instance, or nothing at all.

Both kinds answer the same question (`MaskView`): a mask as large as the photo, and masks of the photo's tiles, which
are asked as they are, because bringing them back to the panorama first would round every edge once more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from dbh_studio.core.arrays import Bool, Float, Int32, Int64, readonly
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.tiles import TileSet

# Two halves of a trunk in neighbouring tiles are one where they agree on this share of what both could see of it.
_SAME_SHARE = 0.5
_LEAST_SHARED_PX = 4
_PIECE = 1 << 16


class MaskView(Protocol):
    """The masks of one photo, by direction.

    Attributes:
        has_instances: Whether labels tell one trunk from the next, or only trunk from the rest.
    """

    @property
    def has_instances(self) -> bool:
        """Whether labels tell one trunk from the next."""

    def look_up(self, points_cam: Float) -> tuple[Int32, Bool]:
        """What is at (N, 3) points of the photo's camera frame.

        Returns:
            (N,) label, 0 where no trunk; (N,) whether the masks say anything there: False outside the photo, under
            whoever carried the camera, and within the margin of an edge.
        """


@dataclass(frozen=True, eq=False)
class ImageMask:
    """A mask over a whole photo.

    Attributes:
        camera: Of the photo; `labels` may be smaller, of the same aspect.
        labels: (H, W) bool or integers: 0 nothing, above 0 trunk.
        ignored: (H, W) bool where the mask says nothing (the walker's body); None where it always does.
        has_instances: Whether equal labels mean one trunk.
        edge_px: So near to a mask's outline it says nothing: outlines bleed.
    """

    camera: CameraModel
    labels: NDArray[Any]
    ignored: Bool | None = None
    has_instances: bool = False
    edge_px: int = 0

    def __post_init__(self) -> None:
        labels = _checked_labels(self.labels)
        if not self.camera.has_aspect_of(labels.shape[1], labels.shape[0]):
            raise ValueError(
                f"a mask of {labels.shape[1]} x {labels.shape[0]} pixels does not fit photos of "
                f"{self.camera.width_px} x {self.camera.height_px}"
            )
        if self.ignored is not None and self.ignored.shape != labels.shape:
            raise ValueError(f"ignored has shape {self.ignored.shape} but {labels.shape} is needed")
        ignored = None if self.ignored is None else np.asarray(self.ignored, bool)
        if self.edge_px > 0:
            edges = near_edges(labels, self.edge_px, wraps=self.camera.is_panorama)
            ignored = edges if ignored is None else ignored | edges
        object.__setattr__(self, "labels", readonly(labels))
        object.__setattr__(self, "ignored", None if ignored is None else readonly(ignored))

    def look_up(self, points_cam: Float) -> tuple[Int32, Bool]:
        """See `MaskView`."""
        camera = self.camera
        if camera.is_panorama and camera.params == (camera.width_px, camera.height_px):
            return self._look_round(points_cam)
        uv, is_seen = camera.project(points_cam)
        height, width = self.labels.shape
        rows = np.flatnonzero(is_seen)
        column, row = _pixels(uv[rows], width / self.camera.width_px, height / self.camera.height_px, width, height)
        found = np.zeros(len(points_cam), np.int32)
        found[rows] = self.labels[row, column]
        if self.ignored is not None:
            is_seen[rows] = ~self.ignored[row, column]
        return found, is_seen

    def _look_round(self, points_cam: Float) -> tuple[Int32, Bool]:
        """As above for whole panoramas, which see everything: in float32 and in pieces that stay in the cache.

        That is three times quicker, and off by less than a thousandth of a pixel.
        """
        height, width = self.labels.shape
        labels = self.labels.reshape(-1)
        ignored = None if self.ignored is None else self.ignored.reshape(-1)
        found, is_seen = np.empty(len(points_cam), np.int32), np.empty(len(points_cam), bool)
        across, down = np.float32(width / (2.0 * np.pi)), np.float32(height / np.pi)
        for start in range(0, len(points_cam), _PIECE):
            part = slice(start, start + _PIECE)
            x, y, z = (points_cam[part, axis].astype(np.float32) for axis in range(3))
            level = x * x
            level += z * z
            np.sqrt(level, out=level)
            column = np.arctan2(x, z)
            column *= across
            column += np.float32(0.5 * width)
            row = np.arctan2(y, level)
            row *= down
            row += np.float32(0.5 * height)
            seen = np.isfinite(row) & np.isfinite(column) & ((level > 0.0) | (y != 0.0))
            if not seen.all():
                column[~seen] = row[~seen] = 0.0
            pixel = np.minimum(row.astype(np.int32), height - 1)
            pixel *= width
            # Left and right meet: what rounds to the right edge is in the last column.
            pixel += np.minimum(column.astype(np.int32), width - 1)
            found[part] = labels[pixel] * seen
            is_seen[part] = seen if ignored is None else seen & ~ignored[pixel]
        return found, is_seen


@dataclass(frozen=True, eq=False)
class TileMasks:
    """Masks of the tiles of one photo.

    What two tiles show is said by the one in which it is the more central, but a trunk is believed before no trunk: one
    that a tile's border cuts is often missed there and found whole in the neighbour. A point gets one answer however
    many tiles show it, so nothing is doubled.

    Attributes:
        tiles: As they were rendered.
        labels: Per tile (size, size) bool or integers: 0 nothing, above 0 trunk. None where the tile was not looked at.
        has_instances: Whether equal labels *within a tile* mean one trunk; across tiles they are matched here.
        edge_px: As in `ImageMask`, in pixels of the tiles.
    """

    tiles: TileSet
    labels: Sequence[NDArray[Any] | None]
    has_instances: bool = False
    edge_px: int = 0

    def __post_init__(self) -> None:
        if len(self.labels) != len(self.tiles):
            raise ValueError(f"{len(self.labels)} masks for {len(self.tiles)} tiles")
        checked: list[NDArray[Any] | None] = []
        for tile, given in zip(self.tiles.tiles, self.labels, strict=True):
            labels = None if given is None else _checked_labels(given)
            if labels is not None and labels.shape[0] != labels.shape[1]:
                raise ValueError(f"the mask of a square tile of {tile.size_px} pixels has shape {labels.shape}")
            checked.append(labels)
        if self.has_instances:
            checked = self._joined(checked)
        known = [
            None if labels is None or not self.edge_px else ~near_edges(labels, self.edge_px, wraps=False)
            for labels in checked
        ]
        object.__setattr__(self, "labels", tuple(None if m is None else readonly(m) for m in checked))
        object.__setattr__(self, "_known", tuple(known))

    def look_up(self, points_cam: Float) -> tuple[Int32, Bool]:
        """See `MaskView`."""
        known: tuple[Bool | None, ...] = getattr(self, "_known")  # noqa: B009 - made in __post_init__
        found, is_known = np.zeros(len(points_cam), np.int32), np.zeros(len(points_cam), bool)
        best = np.full(len(points_cam), -1.0, np.float32)
        for index, labels in enumerate(self.labels):
            if labels is None:
                continue
            rows, uv, central = self.tiles.seen_in(index, points_cam)
            column, row = self._tile_pixels(index, labels, uv)
            here, inner = labels[row, column], known[index]
            rank = central + np.where(here > 0, np.float32(2.0), np.float32(0.0))
            better = rank > best[rows]
            rows, column, row = rows[better], column[better], row[better]
            found[rows], best[rows] = here[better], rank[better]
            is_known[rows] = True if inner is None else inner[row, column]
        return found, is_known

    def panorama(self) -> Int32:
        """(H, W) labels over the whole photo, to be shown or painted on: see the class for overlaps."""
        camera = self.tiles.camera
        directions = self.tiles.directions
        return self.look_up(np.nan_to_num(directions))[0].reshape(camera.height_px, camera.width_px)

    def _tile_pixels(self, index: int, labels: NDArray[Any], uv: Float) -> tuple[Int64, Int64]:
        scale = labels.shape[0] / self.tiles.tiles[index].size_px
        return _pixels(uv, scale, scale, labels.shape[1], labels.shape[0])

    def _joined(self, labels: list[NDArray[Any] | None]) -> list[NDArray[Any] | None]:
        """The same masks, numbered so that one trunk seen in two tiles has one label."""
        numbered, sizes = _renumbered(labels)
        if len(sizes) < 2:
            return numbered
        a, b = self._pairs_alike(numbered, len(sizes))
        graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(len(sizes), len(sizes)))
        group = connected_components(graph, directed=False)[1].astype(np.int32)
        table = np.concatenate([[0], group + 1]).astype(np.int32)
        return [None if mask is None else table[mask] for mask in numbered]

    def _pairs_alike(self, labels: list[NDArray[Any] | None], n: int) -> tuple[Int64, Int64]:
        """Labels of different tiles that cover the same part of what both tiles show."""
        found: list[tuple[Int64, Int64]] = []
        for index, mask in enumerate(labels):
            if mask is None:
                continue
            tile = self.tiles.tiles[index]
            row, column = np.nonzero(mask)
            scale = tile.size_px / mask.shape[0]
            rays = tile.rays((np.column_stack([column, row]) + 0.5) * scale).astype(np.float32)
            here = mask[row, column].astype(np.int64) - 1
            for other in range(len(labels)):
                theirs = labels[other]
                if other == index or theirs is None:
                    continue
                rows, uv, _ = self.tiles.seen_in(other, rays)
                across, down = self._tile_pixels(other, theirs, uv)
                there = theirs[down, across].astype(np.int64) - 1
                mine = here[rows]
                shown = np.bincount(mine, minlength=n)
                both = there >= 0
                pair, count = np.unique(mine[both] * n + there[both], return_counts=True)
                first, second = pair // n, pair % n
                same = (count >= _LEAST_SHARED_PX) & (count >= _SAME_SHARE * shown[first])
                found.append((first[same], second[same]))
        a = np.concatenate([np.empty(0, np.int64), *(first for first, _ in found)])
        b = np.concatenate([np.empty(0, np.int64), *(second for _, second in found)])
        # Both must agree: else a mask that bleeds over two trunks would make them one.
        mutual = np.isin(a * n + b, b * n + a)
        return a[mutual], b[mutual]


def near_edges(labels: NDArray[Any], distance_px: int, *, wraps: bool) -> Bool:
    """(H, W) which pixels have one of another label within `distance_px` rows or columns.

    Args:
        labels: (H, W).
        distance_px: 0 gives none.
        wraps: Whether left and right are neighbours.
    """
    if distance_px <= 0:
        return np.zeros(labels.shape, bool)
    size = 2 * distance_px + 1
    values = labels.astype(np.uint8) if labels.dtype == bool else labels
    mode = ("nearest", "wrap") if wraps else "nearest"
    low, high = (f(values, size=size, mode=mode) for f in (minimum_filter, maximum_filter))
    different: Bool = low != high
    return different


def _checked_labels(labels: NDArray[Any]) -> NDArray[Any]:
    array = np.asarray(labels)
    if array.ndim != 2 or not array.size or not (array.dtype == bool or np.issubdtype(array.dtype, np.integer)):
        raise ValueError(f"a mask has shape {array.shape} and type {array.dtype} but (H, W) bool or integer is needed")
    if np.issubdtype(array.dtype, np.signedinteger) and int(array.min()) < 0:
        raise ValueError("a mask has labels below 0")
    return array


def _pixels(uv_px: Float, x: float, y: float, width: int, height: int) -> tuple[Int64, Int64]:
    """(M,) columns and rows of the pixels that hold (M, 2) continuous positions, which x and y bring to the mask's."""
    column = np.clip((uv_px[:, 0] * x).astype(np.int64), 0, width - 1)
    row = np.clip((uv_px[:, 1] * y).astype(np.int64), 0, height - 1)
    return column, row


def _renumbered(labels: list[NDArray[Any] | None]) -> tuple[list[NDArray[Any] | None], Int64]:
    """Labels 1, 2, … over all tiles together, none used twice, and the size of each in pixels."""
    result: list[NDArray[Any] | None] = []
    sizes: list[Int64] = [np.empty(0, np.int64)]
    first = 0
    for mask in labels:
        if mask is None:
            result.append(None)
            continue
        values, inverse, counts = np.unique(mask, return_inverse=True, return_counts=True)
        is_trunk = values > 0
        number = np.where(is_trunk, first + np.cumsum(is_trunk), 0).astype(np.int32)
        result.append(number[inverse.reshape(mask.shape)])
        sizes.append(counts[is_trunk])
        first += int(is_trunk.sum())
    return result, np.concatenate(sizes)
