"""One mask picture as plain levels, whatever program wrote it: 1 to 4 channels, palette, 8 or 16 bits."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import UInt8, readonly
from dbh_studio.errors import FileMissingError, MalformedFileError, TruncatedFileError, UnsupportedFormatError
from dbh_studio.io.photos import open_picture

UInt16 = NDArray[np.uint16]
LevelKind = Literal["binary", "labels", "soft", "blank"]

MAX_PIXELS = 400_000_000
# More colours than this are no classes but a photo.
_MAX_COLOURS = 4096
# What JPEG makes of a sharp edge still lies near one of the two levels nearly everywhere.
_NEAR_LEVEL, _SHARE_NEAR = 0.13, 0.97
# A smoothed edge is thin; a step of a probability from pixel to pixel is small.
_SHARE_EXTREME, _SHARE_FLAT, _SMALL_STEP, _MIN_SHADES = 0.9, 0.2, 0.01, 32
_LOSSY = frozenset({"JPEG", "MPO", "WEBP"})


@dataclass(frozen=True, eq=False)
class MaskPicture:
    """The levels of a mask, before anybody has said what they mean.

    Attributes:
        path: Where it came from.
        levels: (H, W) uint16, read-only: grey values, palette or colour numbers, or transparency, as stored.
        kind: ``binary``: two levels (0/1, 0/255, …); ``labels``: a number per class or instance; ``soft``: all shades,
            a probability; ``blank``: one level everywhere.
        channel: What was read: ``grey``, ``palette``, ``colour`` (each colour has a number; black is 0) or ``alpha``.
        threshold: Levels above it are bright.
    """

    path: Path
    levels: UInt16
    kind: LevelKind
    channel: str
    threshold: float

    @property
    def bright(self) -> NDArray[np.bool_]:
        """(H, W) where it is bright."""
        return self.levels > self.threshold

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.levels.shape[1], self.levels.shape[0]


def read_mask_picture(path: Path | str) -> MaskPicture:
    """Read one mask file; see `MaskPicture`.

    Where the picture has a transparency that varies, that is the mask: a cut-out. Else coloured pictures are numbered
    by their colours, and pictures without colour give their grey levels.

    Raises:
        FileError: The file is missing, damaged, too large, or a photo instead of a mask.
    """
    path = Path(path)
    try:
        with warnings.catch_warnings(), open_picture(path) as picture:
            warnings.simplefilter("ignore")  # odd metadata is no reason to fail, nor to tell anybody
            if picture.width * picture.height > MAX_PIXELS:
                raise MalformedFileError(path, f"It has {picture.width} x {picture.height} pixels.", "Make it smaller.")
            is_lossy = picture.format in _LOSSY
            levels, channel = _levels(path, picture)
    except FileNotFoundError:
        raise FileMissingError(path, "There is no such file.") from None
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        raise TruncatedFileError(path, f"It cannot be read as an image ({error}).", "Export the mask again.") from None
    kind, threshold = classify_levels(levels, is_lossy=is_lossy, is_numbered=channel in ("palette", "colour"))
    return MaskPicture(path, readonly(levels), kind, channel, threshold)


def classify_levels(levels: UInt16, *, is_lossy: bool = False, is_numbered: bool = False) -> tuple[LevelKind, float]:
    """What the levels look like, and above which one they are bright.

    Args:
        levels: (H, W) as stored.
        is_lossy: Whether the format changes levels (JPEG), so that many of them mean nothing.
        is_numbered: Whether the levels are numbers of colours and have no order.
    """
    counts = np.bincount(levels.ravel())
    present = np.flatnonzero(counts)
    if not present.size:
        return "blank", 0.0
    low, high = float(present[0]), float(present[-1])
    if present.size == 1:
        return "blank", 0.0
    if present.size == 2:
        return "binary", 0.5 * (low + high)
    if is_numbered:
        return "labels", 0.0
    if is_lossy:
        near = _NEAR_LEVEL * (high - low)
        share = counts[present[(present - low <= near) | (high - present <= near)]].sum() / levels.size
        return ("binary" if share >= _SHARE_NEAR else "soft"), 0.5 * (low + high)
    if _has_flat_steps(levels, low, high, present.size):
        return "labels", 0.0
    is_edge = counts[[int(low), int(high)]].sum() >= _SHARE_EXTREME * levels.size
    return ("binary" if is_edge else "soft"), 0.5 * (low + high)


def _has_flat_steps(levels: UInt16, low: float, high: float, n_levels: int) -> bool:
    """Whether the levels between the lowest and the highest are areas with sharp borders, as numbers of things are.

    A smoothed edge has next to no areas of one such level, and a probability goes from level to level in small steps.
    """
    here, right, below = levels[:-1, :-1], levels[:-1, 1:], levels[1:, :-1]
    between = (here > low) & (here < high)
    n_between = np.count_nonzero(between)
    if n_between == 0:
        return True
    if np.count_nonzero(between & (here == right) & (here == below)) < _SHARE_FLAT * n_between:
        return False
    if n_levels < _MIN_SHADES:
        return True
    steps = np.abs(here.astype(np.int32) - right)
    steps = steps[steps > 0]
    return bool(steps.size == 0 or np.mean(steps <= _SMALL_STEP * (high - low)) < 0.5)


def _levels(path: Path, picture: Any) -> tuple[UInt16, str]:
    """(H, W) and the name of what was read."""
    mode = picture.mode
    if mode == "P":
        return _palette(path, picture)
    if mode in ("1", "L"):
        array = np.asarray(picture)
        return array.astype(np.uint16), "grey"
    if mode.startswith("I") or mode == "F":
        return _wide(path, np.asarray(picture)), "grey"
    array = np.asarray(picture.convert("RGBA"))
    alpha = array[..., 3]
    if alpha.min() != alpha.max():
        return alpha.astype(np.uint16), "alpha"
    return _coloured(path, array[..., :3])


def _wide(path: Path, array: NDArray[Any]) -> UInt16:
    """16 or 32 bits or floating point, where the values are whole numbers that 16 bits hold; 0..1 becomes 0..255."""
    if not np.all(np.isfinite(array)) or array.min() < 0 or array.max() > 65535:
        raise UnsupportedFormatError(path, "It holds numbers a mask cannot have.", "Save it with 8 or 16 bits.")
    if np.issubdtype(array.dtype, np.floating) and np.any(array != np.floor(array)):
        if array.max() > 1:
            raise UnsupportedFormatError(path, "It holds fractions of numbers.", "Save it with 8 or 16 bits.")
        array = np.round(array * 255)
    levels: UInt16 = array.astype(np.uint16)
    return levels


def _palette(path: Path, picture: Any) -> tuple[UInt16, str]:
    """The number of each colour, which is how label maps are stored; but of a grey palette the greys."""
    index = np.asarray(picture)
    table = np.asarray(picture.convert("RGB"))
    if "transparency" in picture.info:
        alpha = np.asarray(picture.convert("RGBA"))[..., 3]
        if alpha.min() != alpha.max():
            return alpha.astype(np.uint16), "alpha"
    is_grey = bool(np.all(table[..., 0] == table[..., 1]) and np.all(table[..., 1] == table[..., 2]))
    # Index 0 may be white: two greys are what is seen. More greys than two are a viewer's ramp over instance numbers.
    if is_grey and len(np.unique(index)) <= 2:
        return table[..., 0].astype(np.uint16), "grey"
    return index.astype(np.uint16), "palette"


def _coloured(path: Path, rgb: UInt8) -> tuple[UInt16, str]:
    """Three equal channels are one; else each colour gets a number, black 0, the others in order of their value."""
    if np.array_equal(rgb[..., 0], rgb[..., 1]) and np.array_equal(rgb[..., 1], rgb[..., 2]):
        return rgb[..., 0].astype(np.uint16), "grey"
    packed = (rgb[..., 0].astype(np.int32) << 16) | (rgb[..., 1].astype(np.int32) << 8) | rgb[..., 2]
    colours, numbers = np.unique(packed, return_inverse=True)
    if len(colours) > _MAX_COLOURS:
        raise UnsupportedFormatError(
            path, "It has thousands of colours: it is a photo, not a mask.", "Choose the folder with the masks."
        )
    first = 0 if colours[0] == 0 else 1
    return (numbers.reshape(packed.shape) + first).astype(np.uint16), "colour"
