"""The pixels of one photo, as stored."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dbh_studio.core.arrays import UInt8
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.errors import FileMissingError, MalformedFileError, TruncatedFileError

# Pillow takes more for an attack; a 16K panorama is a third of it.
_MAX_PIXELS = 400_000_000


def read_photo(photo: PosedImage) -> UInt8:
    """(H, W, 3) uint8 RGB, not turned as the EXIF data says: poses belong to the pixels as stored.

    Raises:
        FileError: The photo is missing, broken, too large, or has another shape than its camera.
    """
    from PIL import Image

    if photo.path is None:
        raise FileMissingError(photo.name, "The photo was not found.", "Say in which folder the photos are.")
    path = Path(photo.path)
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        with Image.open(path) as picture:
            width, height = picture.size
            if width * height > _MAX_PIXELS:
                raise MalformedFileError(path, f"It has {width} x {height} pixels.", "Use a smaller photo.")
            if not photo.camera.has_aspect_of(width, height):
                raise MalformedFileError(
                    path,
                    f"It has {width} x {height} pixels, its camera {photo.camera.width_px} x {photo.camera.height_px}.",
                    "Use the photos as the reconstruction had them.",
                )
            return np.array(picture.convert("RGB"))
    except FileNotFoundError:
        raise FileMissingError(path, "There is no such file.", "Say in which folder the photos are.") from None
    except (OSError, SyntaxError, ValueError) as error:
        raise TruncatedFileError(path, f"It cannot be read as an image ({error}).", "Copy the photo again.") from None
    finally:
        Image.MAX_IMAGE_PIXELS = limit
