"""The pixels of one photo, as stored."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.core.arrays import UInt8
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.errors import FileMissingError, MalformedFileError, TruncatedFileError

if TYPE_CHECKING:
    from PIL.Image import Image

# A 16K panorama is a third of it. Pillow itself takes less than half of it for an attack.
_MAX_PIXELS = 400_000_000
_MOST_SHRINK = 8
_opening = threading.Lock()


def open_picture(path: Path) -> Image:
    """A picture of any size, of which only the header has been read; the caller closes it.

    Raises:
        OSError: It is missing, or no picture.
        SyntaxError: It is damaged.
        ValueError: It is damaged.
    """
    from PIL import Image

    with _opening:
        # Pillow asks when it opens, and it asks a variable of the whole program.
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            return Image.open(path)
        finally:
            Image.MAX_IMAGE_PIXELS = limit


def read_photo(photo: PosedImage, *, least_width_px: int | None = None) -> UInt8:
    """(H, W, 3) uint8 RGB, not turned as the EXIF data says: poses belong to the pixels as stored.

    Args:
        photo: Which.
        least_width_px: A copy will do that is a half, a quarter or an eighth as wide and at least so many pixels: a
            JPEG is read in a fraction of the time, and the copy takes a fraction of the memory.

    Raises:
        FileError: The photo is missing, broken, too large, or has another shape than its camera.
    """
    if photo.path is None:
        raise FileMissingError(photo.name, "The photo was not found.", "Say in which folder the photos are.")
    path = Path(photo.path)
    try:
        with open_picture(path) as picture:
            width, height = picture.size
            if width * height > _MAX_PIXELS:
                raise MalformedFileError(path, f"It has {width} x {height} pixels.", "Use a smaller photo.")
            if not photo.camera.has_aspect_of(width, height):
                raise MalformedFileError(
                    path,
                    f"It has {width} x {height} pixels, its camera {photo.camera.width_px} x {photo.camera.height_px}.",
                    "Use the photos as the reconstruction had them.",
                )
            shrink = 1
            while least_width_px is not None and shrink < _MOST_SHRINK and width // (2 * shrink) >= least_width_px:
                shrink *= 2
            if shrink > 1:
                picture.draft("RGB", (width // shrink, height // shrink))
                left = round(width / picture.size[0])
                if left < shrink:  # no JPEG
                    return np.array(picture.convert("RGB").reduce(shrink // left))
            return np.array(picture.convert("RGB"))
    except FileNotFoundError:
        raise FileMissingError(path, "There is no such file.", "Say in which folder the photos are.") from None
    except (OSError, SyntaxError, ValueError) as error:
        raise TruncatedFileError(path, f"It cannot be read as an image ({error}).", "Copy the photo again.") from None
