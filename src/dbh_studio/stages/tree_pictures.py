"""Pictures of trees: cut out of a photo, and drawn on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dbh_studio.core.arrays import Bool, Float64, UInt8
from dbh_studio.core.tree_crop import TreeCrop, dashes, runs

OUTSIDE_RGB = (52, 54, 58)
_RING_RGB, _OUTLINE_RGB, _HALO_RGB = (255, 214, 10), (64, 224, 208), (16, 18, 20)
_SHIFT_BITS = 4


@dataclass(frozen=True, eq=False)
class TrunkDrawing:
    """What is drawn on a picture, in its pixels.

    Attributes:
        edges: Left and right edge of the trunk, (K, 2) each; NaN where there is a gap.
        ring: (M, 2) the ring at breast height, closed; None where there is none.
        ring_seen: (M,) where it is drawn through; dashed elsewhere.
    """

    edges: Sequence[Float64] = ()
    ring: Float64 | None = None
    ring_seen: Bool | None = None


def cut_out(pixels: UInt8, crop: TreeCrop) -> UInt8:
    """(H, W, 3) the picture; a dark grey where the photo shows nothing.

    Args:
        pixels: (h, w, 3) of the photo, of the camera's size or smaller.
        crop: What to cut out.
    """
    import cv2

    camera = crop.photo.camera
    height, width = pixels.shape[:2]
    columns, rows = crop.maps()
    outside = ~np.isfinite(columns)
    x, y = np.float32(width / camera.width_px), np.float32(height / camera.height_px)
    columns, rows = columns * x - np.float32(0.5), rows * y - np.float32(0.5)
    columns[outside] = rows[outside] = 0.0
    is_finer = crop.photo_px_per_px() * float(x) > 1.0
    picture = cv2.remap(
        pixels,
        columns,
        # Beyond a pole there is no row.
        np.clip(rows, 0.0, height - 1.0),
        cv2.INTER_LINEAR if is_finer else cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_WRAP if camera.is_panorama else cv2.BORDER_REPLICATE,
    )
    picture[outside] = OUTSIDE_RGB
    return np.asarray(picture, np.uint8)


def drawn(picture: UInt8, drawing: TrunkDrawing) -> UInt8:
    """A copy of (H, W, 3) with the outline, and the ring over it."""
    result = picture.copy()
    size = max(picture.shape[:2]) / 640.0
    for edge in drawing.edges:
        pieces = [piece for piece, _ in runs(edge, np.ones(len(edge), bool))]
        _stroke(result, pieces, _OUTLINE_RGB, 1.4 * size)
    if drawing.ring is not None and drawing.ring_seen is not None:
        through: list[Float64] = []
        broken: list[Float64] = []
        for piece, is_seen in runs(drawing.ring, drawing.ring_seen):
            if is_seen:
                through.append(piece)
            else:
                broken.extend(dashes(piece, on_px=5.0 * size, off_px=6.0 * size))
        _stroke(result, broken, _RING_RGB, 1.2 * size)
        _stroke(result, through, _RING_RGB, 3.0 * size)
    return result


def _stroke(picture: UInt8, pieces: Sequence[Float64], rgb: tuple[int, int, int], width_px: float) -> None:
    """Draw lines with a dark edge, so that they show on bark and on sky."""
    import cv2

    reach = 4.0 * max(picture.shape[:2])
    lines = [piece for piece in pieces if len(piece) > 1 and np.abs(piece).max() < reach]
    # OpenCV's pixels have their middles at whole numbers.
    fixed: Any = [np.rint((line - 0.5) * (1 << _SHIFT_BITS)).astype(np.int32) for line in lines]
    if not fixed:
        return
    width = max(1, round(width_px))
    cv2.polylines(picture, fixed, False, _HALO_RGB, width + 2, cv2.LINE_AA, _SHIFT_BITS)
    cv2.polylines(picture, fixed, False, rgb, width, cv2.LINE_AA, _SHIFT_BITS)


def jpeg(picture: UInt8, quality: int = 85) -> bytes:
    """(H, W, 3) RGB as a JPEG file."""
    import cv2

    _, encoded = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, int(quality)])
    return bytes(encoded.tobytes())
