"""Run lengths and polygons as COCO files hold them, to and from arrays.

A COCO run-length mask goes down the columns: the counts of pixels outside, inside, outside, … of the picture read
column by column. "Compressed" counts are the same numbers as text, five bits to a character, each from the fourth on as
the difference to the one two before it. After the description of the COCO API (cocodataset/cocoapi, ``maskApi.c``).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from dbh_studio.core.arrays import Bool, Float64, Int64

# A picture of four thousand million pixels is no picture.
_MAX_PIXELS = 1 << 32


def decode_counts(counts: ArrayLike, height_px: int, width_px: int) -> Bool:
    """(height, width) mask of uncompressed counts.

    Raises:
        ValueError: A count is negative, or they do not cover the picture exactly.
    """
    runs = np.asarray(counts)
    if runs.ndim != 1 or (runs.size and not np.issubdtype(runs.dtype, np.integer)):
        raise ValueError("the counts are no list of whole numbers")
    runs = runs.astype(np.int64)
    # Of each one first: a sum of huge ones could wrap around to the right number.
    if np.any(runs < 0) or np.any(runs > _MAX_PIXELS) or int(runs.sum()) != height_px * width_px:
        raise ValueError(f"the counts do not cover {width_px} x {height_px} pixels")
    inside = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    return np.ascontiguousarray(inside.reshape(width_px, height_px).T)


def encode_counts(mask: ArrayLike) -> Int64:
    """Uncompressed counts of an (H, W) mask; they begin with the pixels outside, of which there may be 0."""
    flat = np.asarray(mask, bool).T.ravel()
    if not flat.size:
        return np.zeros(0, np.int64)
    edges = np.concatenate([[0], np.flatnonzero(flat[1:] != flat[:-1]) + 1, [flat.size]])
    runs = np.diff(edges).astype(np.int64)
    return np.concatenate([[0], runs]) if flat[0] else runs


def decode_text(text: str | bytes) -> Int64:
    """The counts in a compressed run-length text.

    Raises:
        ValueError: A character that has no place there, or the text ends within a number.
    """
    data = np.frombuffer(text.encode("ascii") if isinstance(text, str) else text, np.uint8).astype(np.int64)
    codes = data - 48
    if np.any((codes < 0) | (codes > 63)):
        raise ValueError("the run-length text has a character that does not belong there")
    if not codes.size:
        return np.zeros(0, np.int64)
    is_last = (codes & 0x20) == 0
    if not is_last[-1]:
        raise ValueError("the run-length text ends too early")
    ends = np.flatnonzero(is_last)
    starts = np.concatenate([[0], ends[:-1] + 1])
    lengths = ends - starts + 1
    if lengths.max() > 8:
        raise ValueError("a number in the run-length text is too long")
    place = np.arange(len(codes)) - np.repeat(starts, lengths)
    values = np.add.reduceat((codes & 0x1F) << (5 * place), starts)
    # The last character's fifth bit is the sign of the whole number.
    values -= np.where(codes[ends] & 0x10, np.int64(1) << (5 * lengths), 0)
    # From the fourth on each is a difference to the one two before: two running sums, of the even and of the odd ones.
    values[1::2] = np.cumsum(values[1::2])
    if len(values) > 2:
        values[2::2] = np.cumsum(values[2::2])
    return values


def encode_text(counts: ArrayLike) -> str:
    """The compressed text of the counts."""
    values = np.asarray(counts, np.int64).copy()
    if len(values) > 3:
        values[3:] -= np.asarray(counts, np.int64)[1:-2]
    text = bytearray()
    for value in values.tolist():
        more = True
        while more:
            bits = value & 0x1F
            value >>= 5
            more = value != (-1 if bits & 0x10 else 0)
            text.append((bits | (0x20 if more else 0)) + 48)
    return text.decode("ascii")


def fill_polygons(polygons: Iterable[Sequence[float] | ArrayLike], height_px: int, width_px: int) -> Bool:
    """(height, width) mask of the union of polygons, each a flat list x, y, x, y, … in pixels.

    A pixel is inside where its centre is; the corner of the picture is (0, 0), that of its first pixel's centre
    (0.5, 0.5). Parts outside the picture are cut off.

    Raises:
        ValueError: A polygon has fewer than three corners, or a coordinate that is no number.
    """
    mask = np.zeros((height_px, width_px), bool)
    for polygon in polygons:
        corners = np.asarray(polygon, np.float64)
        if corners.size % 2 or corners.size < 6 or not np.isfinite(corners).all():
            raise ValueError("a polygon needs three corners or more, each of two numbers")
        _fill(mask, corners.reshape(-1, 2))
    return mask


def _fill(mask: Bool, corners: Float64) -> None:
    """Even-odd rule: at each crossing of an edge with a row of centres all pixels to the right change sides."""
    height_px, width_px = mask.shape
    # Far outside nothing changes but the numbers' size.
    corners = np.clip(corners, -1e6, 1e6)
    low = np.clip(np.floor(corners.min(axis=0)), 0, [width_px, height_px]).astype(int)
    high = np.clip(np.ceil(corners.max(axis=0)), 0, [width_px, height_px]).astype(int)
    if np.any(high <= low):
        return
    wide, tall = int(high[0] - low[0]), int(high[1] - low[1])
    changes = np.zeros((tall, wide + 1), np.uint8)
    x, y = (corners - low).T
    for x0, y0, x1, y1 in zip(x, y, np.roll(x, -1), np.roll(y, -1), strict=True):
        if y0 == y1:
            continue
        (top, bottom) = (y0, y1) if y0 < y1 else (y1, y0)
        first, stop = max(int(np.ceil(top - 0.5)), 0), min(int(np.ceil(bottom - 0.5)), tall)
        rows = np.arange(first, stop)
        crossing = x0 + (rows + 0.5 - y0) * ((x1 - x0) / (y1 - y0))
        columns = np.clip(np.ceil(crossing - 0.5), 0, wide).astype(int)
        changes[rows, columns] ^= 1
    inside = np.bitwise_xor.accumulate(changes[:, :wide], axis=1).astype(bool)
    mask[low[1] : high[1], low[0] : high[0]] |= inside
