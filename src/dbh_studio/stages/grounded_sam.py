"""Trunks in photos: a detector finds what the prompt names, a segmenter outlines it.

    models = mask_models.open_grounded_sam(store, run)
    masks = segment_photo(photo, models.detector, models.segmenter, settings, up_cam=up_in_camera(photo, up))
    votes = vote(voters, posed, {photo.name: masks}.get, ...)

The outline of one photo is a `core.mask_views.MaskView`, to vote with, and by `trunk_mask` a picture to store, show and
paint on. Without a detector, `segment_trunks` asks the segmenter for trunks that geometry has found.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dbh_studio.core.arrays import Float, UInt8, as_points
from dbh_studio.core.mask_views import ImageMask, TileMasks
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.tiles import TileSet
from dbh_studio.errors import SettingError
from dbh_studio.io.photos import read_photo
from dbh_studio.settings import MaskDetectorSettings
from dbh_studio.stages.grounding_dino import Detections
from dbh_studio.stages.instance_masks import InstanceMasks, PhotoMasks, mask_size, painted
from dbh_studio.stages.sam import Encoded, Sam
from dbh_studio.stages.trunk_prompts import TrunkShape, trunk_boxes

_UP = (0.0, -1.0, 0.0)
# What one picture shows and, where it is known which trunk is which, own number → label over the whole photo.
_Found: TypeAlias = tuple[InstanceMasks, "NDArray[np.int64] | None"]


class Detector(Protocol):
    """Finds boxes in a picture."""

    def detect(self, rgb: UInt8, settings: MaskDetectorSettings) -> Detections:
        """See `GroundingDino.detect`."""


def segment_image(
    rgb: UInt8,
    detector: Detector,
    segmenter: Sam,
    settings: MaskDetectorSettings = MaskDetectorSettings(),  # noqa: B008 - frozen
    *,
    progress: Progress = ignore_progress,
) -> InstanceMasks:
    """Outline what the prompt names in one picture, as it is.

    Args:
        rgb: (H, W, 3) uint8.
        detector: Finds boxes.
        segmenter: Outlines what is in them.
        settings: Prompt and thresholds.
        progress: Called between the two.

    Returns:
        Masks as large as the picture, or with the longest side the settings give.

    Raises:
        ModelError: A model failed, or gives no numbers.
        SettingError: The prompt is empty or too long.
        CancelledError: From `progress`.
    """
    progress(0.0, "Looking for trunks")
    found = detector.detect(rgb, settings)
    progress(0.6, f"Outlining {len(found)} trunks")
    return segment_boxes(
        rgb, found.boxes_px, segmenter, settings, scores=found.scores, phrases=found.phrases, progress=progress
    )


def segment_boxes(
    rgb: UInt8,
    boxes_px: ArrayLike,
    segmenter: Sam,
    settings: MaskDetectorSettings = MaskDetectorSettings(),  # noqa: B008 - frozen
    *,
    scores: Float | None = None,
    phrases: tuple[str, ...] = (),
    may_join: bool = True,
    progress: Progress = ignore_progress,
) -> InstanceMasks:
    """Outline what is in given boxes of one picture.

    Args:
        rgb: (H, W, 3) uint8.
        boxes_px: (N, 4) x0, y0, x1, y1 in pixels of the picture, the surest (or the nearest) first.
        segmenter: Outlines.
        settings: Thresholds.
        scores: (N,) how sure each box is; None takes how well the segmenter thinks its outline fits.
        phrases: Of each box, or none.
        may_join: Whether two boxes may show one trunk.
        progress: Called once; from 0.6 on.

    Raises:
        ModelError: The model failed, or gives no numbers.
        CancelledError: From `progress`.
    """
    return _outlined(rgb, boxes_px, segmenter, settings, scores, phrases, may_join, progress)[0]


def segment_photo(
    photo: PosedImage,
    detector: Detector,
    segmenter: Sam,
    settings: MaskDetectorSettings = MaskDetectorSettings(),  # noqa: B008 - frozen
    *,
    picture: UInt8 | None = None,
    up_cam: ArrayLike = _UP,
    progress: Progress = ignore_progress,
) -> PhotoMasks:
    """Outline the trunks of one photo: a panorama in tiles, or whole where the settings say so; others as they are.

    Args:
        photo: With its camera and, where `picture` is None, its path.
        detector: Finds boxes.
        segmenter: Outlines.
        settings: Prompt, thresholds, tiles.
        picture: (H, W, 3) uint8 its pixels, where they are at hand.
        up_cam: (3,) where up is in the camera's frame (`core.tiles.up_in_camera`), so that stems are upright in tiles.
        progress: Called between tiles.

    Raises:
        FileError: The photo cannot be read.
        ModelError: A model failed.
        SettingError: The tiles leave gaps, or the prompt is empty.
        CancelledError: From `progress`.
    """
    rgb = read_photo(photo) if picture is None else picture

    def look(shown: UInt8, index: int, part: Progress) -> _Found:
        return segment_image(shown, detector, segmenter, settings, progress=part), None

    if photo.camera.is_panorama and settings.panorama == "tiles":
        return _in_tiles(photo, rgb, photo_tiles(photo, settings, up_cam), look, progress)
    found = segment_image(rgb, detector, segmenter, settings, progress=progress)
    labels = found.labels
    if photo.camera.is_panorama:
        labels = _joined_at_seam(labels)
    view = ImageMask(photo.camera, labels, has_instances=True)
    return PhotoMasks(photo.name, photo.camera, view, (found,), _scores((labels,), (found,)), {})


def segment_trunks(
    photo: PosedImage,
    trunks: Sequence[TrunkShape],
    segmenter: Sam,
    settings: MaskDetectorSettings = MaskDetectorSettings(),  # noqa: B008 - frozen
    *,
    max_distance_m: float = 15.0,
    picture: UInt8 | None = None,
    up_cam: ArrayLike = _UP,
    progress: Progress = ignore_progress,
) -> PhotoMasks:
    """Outline trunks that geometry has found: no detector, which takes nine tenths of the time, is needed.

    Labels are the trunks' own, over all tiles: 1 + the row in `trunks`; `PhotoMasks.trunk_ids` gives the ids. A
    panorama is always looked at in tiles, and a tile that shows no trunk is not looked at.

    Args:
        photo: In the frame of the trunks.
        trunks: At most 65 535.
        segmenter: Outlines.
        settings: Thresholds and tiles.
        max_distance_m: Trunks farther away are not asked for.
        picture: As in `segment_photo`.
        up_cam: As in `segment_photo`.
        progress: Called between tiles.

    Raises:
        FileError: The photo cannot be read.
        ModelError: The model failed.
        CancelledError: From `progress`.
    """
    if len(trunks) >= 1 << 16:
        raise ValueError(f"{len(trunks)} trunks; at most 65 535 can be told apart in a mask")
    rgb = read_photo(photo) if picture is None else picture
    tiles = photo_tiles(photo, settings, up_cam) if photo.camera.is_panorama else None

    def look(shown: UInt8, index: int, part: Progress) -> _Found | None:
        seen = photo if tiles is None else tiles.tiles[index].posed(photo, photo.name)
        asked = trunk_boxes(seen, trunks, max_distance_m=max_distance_m, min_box_px=settings.min_box_px)
        part(0.0, f"Outlining {len(asked.rows)} trunks")
        scale = [shown.shape[1] / seen.camera.width_px, shown.shape[0] / seen.camera.height_px] * 2
        if not len(asked.rows):
            # Nothing was asked, so nothing is known: the tile has no vote.
            return None
        found, kept = _outlined(shown, asked.boxes_px * scale, segmenter, settings, None, (), False, part)
        return found, np.concatenate([[0], asked.rows[kept] + 1])

    if tiles is not None:
        masks = _in_tiles(photo, rgb, tiles, look, progress)
    else:
        masks = _as_is(photo, rgb, look(rgb, 0, progress), settings)
    return replace(masks, trunk_ids={label: trunks[label - 1].id for label in masks.scores})


def photo_tiles(photo: PosedImage, settings: MaskDetectorSettings, up_cam: ArrayLike = _UP) -> TileSet:
    """The tiles of a panorama.

    Args:
        photo: The panorama.
        settings: How many, how wide, and in which rows.
        up_cam: (3,) where up is in the camera's frame.

    Raises:
        SettingError: They leave gaps, or look beyond a pole.
    """
    count, fov_deg = settings.tile_count, settings.tile_fov_deg
    if count * fov_deg <= 360.0:
        raise SettingError(
            f"{count} tiles of {fov_deg:g}° leave gaps.", f"Tiles must be wider than {360.0 / count:g}°, or be more."
        )
    pitches = settings.tile_pitches_deg
    if not pitches or max(abs(pitch) for pitch in pitches) > 90.0:
        raise SettingError(f"Rows of tiles are at {pitches}.", "Give at least one, from -90 to 90 degrees.")
    rows = [(pitch, 1 if abs(pitch) > 89.0 else count) for pitch in pitches]
    return TileSet.rows(photo.camera, rows, fov_deg=fov_deg, size_px=settings.tile_size_px, up_cam=up_cam)


def _outlined(
    rgb: UInt8,
    boxes_px: ArrayLike,
    segmenter: Sam,
    settings: MaskDetectorSettings,
    scores: Float | None,
    phrases: tuple[str, ...],
    may_join: bool,
    progress: Progress,
) -> tuple[InstanceMasks, NDArray[np.int64]]:
    """The masks, and the rows of the boxes that became one."""
    boxes = as_points(boxes_px, name="boxes_px", n_columns=4).astype(np.float64)
    size = mask_size(rgb.shape[0], rgb.shape[1], settings.mask_size_px)
    if not len(boxes):
        return InstanceMasks.nothing(*size), np.empty(0, np.int64)
    progress(0.6, f"Outlining {len(boxes)} trunks")
    # Masks of another size than the picture: the decoder's boxes and answers are shares of it all the same.
    encoded: Encoded = replace(segmenter.encode(rgb), size_px=size)
    scaled = boxes * np.tile([size[1] / rgb.shape[1], size[0] / rgb.shape[0]], 2)
    progress(0.9, f"Outlining {len(boxes)} trunks")
    answers = segmenter.segment(encoded, scaled, threshold=settings.mask_threshold)
    if scores is not None:
        answers = ((mask, float(score)) for (mask, _), score in zip(answers, scores, strict=True))
    return painted(answers, scaled, size_px=size, overlap=settings.mask_overlap, phrases=phrases, may_join=may_join)


def _in_tiles(
    photo: PosedImage,
    rgb: UInt8,
    tiles: TileSet,
    look: Callable[[UInt8, int, Progress], _Found | None],
    progress: Progress,
) -> PhotoMasks:
    """What `look` finds in every tile, one trunk one label over all of them.

    Where `look` says which trunk each is, that is its label; else trunks are matched over the tiles.
    """
    found: list[_Found | None] = []
    for index in range(len(tiles)):
        part = subprogress(progress, index / len(tiles), (index + 1) / len(tiles))
        part(0.0, f"Tile {index + 1} of {len(tiles)}")
        found.append(look(tiles.render(rgb, index), index, part))
    progress(1.0, f"{photo.name} is done")
    is_numbered = any(one is not None and one[1] is not None for one in found)
    view = TileMasks(tiles, [_labels(one) for one in found], has_instances=not is_numbered)
    parts = tuple(None if one is None else one[0] for one in found)
    return PhotoMasks(photo.name, photo.camera, view, parts, _scores(view.labels, parts), {})


def _as_is(photo: PosedImage, rgb: UInt8, found: _Found | None, settings: MaskDetectorSettings) -> PhotoMasks:
    """What was found in a photo that was looked at as it is; without a vote where nothing was asked of it."""
    labels = _labels(found)
    ignored = None
    if labels is None:
        labels = np.zeros(mask_size(rgb.shape[0], rgb.shape[1], settings.mask_size_px), np.uint16)
        ignored = np.ones(labels.shape, bool)
    view = ImageMask(photo.camera, labels, ignored, has_instances=True)
    parts = (None if found is None else found[0],)
    return PhotoMasks(photo.name, photo.camera, view, parts, _scores((labels,), parts), {})


def _labels(found: _Found | None) -> NDArray[Any] | None:
    if found is None:
        return None
    masks, numbers = found
    return masks.labels if numbers is None else numbers.astype(np.uint16)[masks.labels]


def _scores(labels: Sequence[NDArray[Any] | None], parts: Sequence[InstanceMasks | None]) -> dict[int, float]:
    """Label → best score, of pictures with their final labels and what was found in them."""
    best: dict[int, float] = {}
    for final, found in zip(labels, parts, strict=True):
        if final is None or found is None:
            continue
        # Each trunk of a picture has one final label, so that any of its pixels tells it.
        table = np.zeros(len(found) + 1, np.int64)
        table[found.labels] = final
        for label, score in zip(table[1:].tolist(), found.scores.tolist(), strict=True):
            best[label] = max(best.get(label, 0.0), score)
    return best


def _joined_at_seam(labels: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """The same, with one number for the two halves of what crosses the seam of a panorama."""
    left, right = labels[:, 0], labels[:, -1]
    across = (left > 0) & (right > 0)
    table = np.arange(int(labels.max()) + 1)
    if not across.any():
        return labels
    pairs, counts = np.unique(np.stack([left, right])[:, across], axis=1, return_counts=True)
    for (a, b), count in zip(pairs.T.tolist(), counts.tolist(), strict=True):
        # Half of the rows of the shorter one must meet: else two trunks only touch.
        if 2 * count >= min(np.count_nonzero(left == a), np.count_nonzero(right == b)):
            table[table == max(table[a], table[b])] = min(table[a], table[b])
    return table[labels].astype(np.uint16)
