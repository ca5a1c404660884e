"""Pictures as the public image models take them, as transformers prepares them."""

from __future__ import annotations

import numpy as np

from dbh_studio.core.arrays import Float32, UInt8

MEAN, STD = np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32)


def normalised(rgb: UInt8) -> Float32:
    """(3, H, W) float32, mean 0 and deviation 1 over ImageNet, of (H, W, 3) uint8."""
    scaled = rgb.astype(np.float32) * np.float32(1.0 / 255.0)
    return np.ascontiguousarray(((scaled - MEAN) / STD).transpose(2, 0, 1))


def resized(rgb: UInt8, width_px: int, height_px: int) -> UInt8:
    """(h, w, 3) uint8. Bilinear over all pixels that fall into one, as the models were trained: OpenCV's is not it."""
    if rgb.shape[:2] == (height_px, width_px):
        return rgb
    from PIL import Image

    small = Image.fromarray(rgb).resize((width_px, height_px), Image.Resampling.BILINEAR)
    return np.asarray(small)


def edge_size(height_px: int, width_px: int, shortest_px: int, longest_px: int) -> tuple[int, int]:
    """(height, width) with the shorter edge `shortest_px`, unless the longer one would then exceed `longest_px`.

    transformers' rule, with its roundings.
    """
    short, long = min(height_px, width_px), max(height_px, width_px)
    exact: float = shortest_px
    if long / short * shortest_px > longest_px:
        exact = longest_px * short / long
    edge = round(exact)
    if short == edge:
        return height_px, width_px
    other = int(exact * long / short)
    return (other, edge) if width_px < height_px else (edge, other)


def fitting_size(height_px: int, width_px: int, within_height_px: int, within_width_px: int) -> tuple[int, int]:
    """(height, width) of a picture in a fixed frame, its proportions kept.

    `edge_size` for the frame's edges where that fits, as it does unless one is upright and the other is not.
    """
    frame = within_height_px, within_width_px
    height, width = edge_size(height_px, width_px, min(frame), max(frame))
    if height > within_height_px or width > within_width_px:
        factor = min(within_height_px / height_px, within_width_px / width_px)
        height, width = round(height_px * factor), round(width_px * factor)
    return min(max(height, 1), within_height_px), min(max(width, 1), within_width_px)
