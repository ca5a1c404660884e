"""The trunks of one picture as numbered pixels, and those of a whole photo, over all its tiles."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, Float, Float32, Float64, Int32, Int64, readonly
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.mask_views import ImageMask, TileMasks
from dbh_studio.core.tiles import TileSet
from dbh_studio.io.masks.meaning import TrunkMask

UInt16 = NDArray[np.uint16]

# A surer mask of which this much lies in a longer one is a part of the same trunk, but not where the other is so much
# larger that it rather shows something else.
_PART = 0.8
_LONGER, _TOO_LARGE = 1.25, 3.0
# Fewer pixels are no mask of anything.
_MIN_PIXELS = 16


@dataclass(frozen=True, eq=False)
class InstanceMasks:
    """The trunks of one picture; no pixel belongs to two.

    Attributes:
        labels: (H, W) uint16: 0 nothing, i + 1 the trunk of row i.
        scores: (N,) how sure the detector was, 0..1; without one, the segmenter.
        boxes_px: (N, 4) x0, y0, x1, y1 what was asked for, in pixels of `labels`.
        phrases: What each is said to be; empty where nothing said so.
    """

    labels: UInt16
    scores: Float32
    boxes_px: Float64
    phrases: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.scores)
        if self.labels.ndim != 2 or self.labels.dtype != np.uint16:
            raise ValueError(f"labels has shape {self.labels.shape} and type {self.labels.dtype}; (H, W) uint16 needed")
        if self.boxes_px.shape != (n, 4) or (self.phrases and len(self.phrases) != n):
            raise ValueError(f"{n} scores, {self.boxes_px.shape} boxes and {len(self.phrases)} phrases")
        for name in ("labels", "scores", "boxes_px"):
            object.__setattr__(self, name, readonly(getattr(self, name)))

    def __len__(self) -> int:
        return len(self.scores)

    @classmethod
    def nothing(cls, height_px: int, width_px: int) -> InstanceMasks:
        """A picture without trunks."""
        return cls(np.zeros((height_px, width_px), np.uint16), np.zeros(0, np.float32), np.zeros((0, 4)))


@dataclass(frozen=True, eq=False)
class PhotoMasks:
    """The trunks of one photo; a `core.mask_views.MaskView`.

    Attributes:
        name: Of the photo.
        camera: Of the photo.
        view: The masks, as they answer for a direction; equal labels are one trunk.
        parts: Per tile what was found in it, None where it was not looked at; a single one without tiles.
        scores: Label → the best score of its parts.
        trunk_ids: Label → which of the trunks asked for it is; empty where none was asked for.
    """

    name: str
    camera: CameraModel
    view: ImageMask | TileMasks
    parts: tuple[InstanceMasks | None, ...]
    scores: dict[int, float]
    trunk_ids: dict[int, int]

    @property
    def has_instances(self) -> bool:
        """Whether labels tell one trunk from the next: always."""
        return True

    def __len__(self) -> int:
        return len(self.scores)

    def look_up(self, points_cam: Float) -> tuple[Int32, Bool]:
        """See `MaskView`."""
        return self.view.look_up(points_cam)

    def trunk_mask(self, longest_px: int = 2048) -> TrunkMask:
        """One mask over the whole photo, to be stored, shown and painted on.

        What no tile looked at is ignored: nothing is said of it.

        Args:
            longest_px: Of the mask's longer side; it is never larger than the photo.
        """
        height, width = mask_size(self.camera.height_px, self.camera.width_px, longest_px)
        if isinstance(self.view, TileMasks):
            small = TileSet(self.camera.scaled_to(width, height), self.view.tiles.tiles)
            found, is_known = self.view.look_up(np.nan_to_num(small.directions))
            labels, ignored = found.reshape(height, width).astype(np.uint16), ~is_known.reshape(height, width)
            return TrunkMask(labels, ignored if ignored.any() else None, True, dict(self.scores))
        whole = TrunkMask(np.asarray(self.view.labels).astype(np.uint16), self.view.ignored, True, dict(self.scores))
        return whole.sized(width, height) if whole.size[0] > width else whole


def mask_size(height_px: int, width_px: int, longest_px: int) -> tuple[int, int]:
    """(height, width) of the mask of a picture: its own, or with the longer side `longest_px`."""
    factor = min(longest_px / max(height_px, width_px), 1.0)
    return max(round(height_px * factor), 1), max(round(width_px * factor), 1)


def painted(
    masks: Iterable[tuple[Bool, float]],
    boxes_px: Float64,
    *,
    size_px: tuple[int, int],
    overlap: float,
    phrases: tuple[str, ...] = (),
    may_join: bool = True,
) -> tuple[InstanceMasks, Int64]:
    """Put masks into one picture, each pixel to the first that claims it.

    One that holds an earlier one and more is the same trunk seen longer, so the earlier one grows; one that holds
    several has run over several trunks and is left out; and so is one that earlier ones cover.

    Args:
        masks: (H, W) and score of each, the surest (or the nearest) first.
        boxes_px: (N, 4) of each.
        size_px: (H, W).
        overlap: Share of a mask above which it counts as covered.
        phrases: Of each, or none.
        may_join: Whether two may be one trunk; not where it is known that they are two.

    Returns:
        The picture, and (M,) rows of the masks that became its trunks.
    """
    labels = np.zeros(size_px, np.uint16)
    rows: list[int] = []
    scores: list[float] = []
    for row, (mask, score) in enumerate(masks):
        size = int(np.count_nonzero(mask))
        if size < _MIN_PIXELS:
            continue
        shared = np.bincount(labels[mask], minlength=len(rows) + 1)[1:]
        held = np.empty(0, np.int64)
        if may_join and shared.any():
            areas = np.bincount(labels.ravel(), minlength=len(rows) + 1)[1:]
            held = np.flatnonzero(shared >= _PART * areas)
        if len(held) > 1:
            continue
        grows = len(held) == 1 and _LONGER <= size / areas[held[0]] <= _TOO_LARGE
        if not grows and shared.sum() > overlap * size:
            continue
        number = int(held[0]) + 1 if grows else len(rows) + 1
        if not grows:
            rows.append(row)
            scores.append(score)
        labels[mask & (labels == 0)] = number
    index = np.array(rows, np.int64)
    said = tuple(phrases[row] for row in rows) if phrases else ()
    return InstanceMasks(labels, np.array(scores, np.float32), boxes_px[index].reshape(-1, 4), said), index
