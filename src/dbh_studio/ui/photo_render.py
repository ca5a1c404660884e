"""Pictures of photos: decoded once, kept while there is room, and shown as a `Look` says."""

from __future__ import annotations

import base64
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np

from dbh_studio.core.arrays import UInt8
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.io.photos import read_photo
from dbh_studio.ui.photo_look import Look, PanoramaLook

# Four panoramas of 8192 x 4096 pixels; one of 16 384 x 8192 fits by itself.
CACHE_BYTES = 560_000_000
_JPEG_QUALITY = 86
_OUTSIDE = (58, 54, 52)


class PhotoPixels:
    """One decoded photo, and the smaller copies that are shown from afar.

    Args:
        pixels: (H, W, 3) RGB, of the camera's size or smaller.
        width_px: Of the camera's images: looks speak of its pixels.
    """

    def __init__(self, pixels: UInt8, width_px: int) -> None:
        self._levels: list[UInt8] = [pixels]
        self._lock = threading.Lock()
        self._per_camera_px = pixels.shape[1] / width_px

    @property
    def n_bytes(self) -> int:
        """Memory taken, with all smaller copies."""
        return int(self._levels[0].nbytes * 4 / 3)

    def render(self, look: Look) -> UInt8:
        """(height, width, 3) RGB as the look shows it; a dark grey beside the photo."""
        import cv2

        picture = self._level_for(look.zoom / self._per_camera_px)
        height, width = picture.shape[:2]
        u, v = look.maps()
        columns, rows = u * np.float32(width / look.camera.width_px), v * np.float32(height / look.camera.height_px)
        is_round = isinstance(look, PanoramaLook)
        outside = None if is_round else (columns < 0) | (columns > width) | (rows < 0) | (rows > height)
        view = cv2.remap(
            picture,
            columns - np.float32(0.5),
            # Beyond a pole there is no row.
            np.clip(rows - np.float32(0.5), 0.0, height - 1.0),
            cv2.INTER_CUBIC if look.zoom > 1.0 else cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_WRAP if is_round else cv2.BORDER_REPLICATE,
        )
        if outside is not None:
            view[outside] = _OUTSIDE
        return np.asarray(view, np.uint8)

    def _level_for(self, zoom: float) -> UInt8:
        """The copy with about one pixel per pixel of the view, never fewer: from finer ones the picture flickers."""
        import cv2

        level = 0
        with self._lock:  # two tabs may look at one photo
            while zoom * 2 ** (level + 1) <= 1.0 and min(self._levels[level].shape[:2]) >= 64:
                level += 1
                if level == len(self._levels):
                    height, width = self._levels[-1].shape[:2]
                    half: Any = cv2.resize(self._levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
                    self._levels.append(half)
            return self._levels[level]


class PhotoCache:
    """The photos looked at last, shared by all tabs, within a bound on memory.

    Args:
        read: Reads the pixels of a photo.
        most_bytes: Photos looked at longest ago are forgotten beyond it; the last one is always kept.
    """

    def __init__(self, read: Callable[[PosedImage], UInt8] = read_photo, *, most_bytes: int = CACHE_BYTES) -> None:
        self._read = read
        self._most_bytes = most_bytes
        self._kept: OrderedDict[tuple[str | None, int], PhotoPixels] = OrderedDict()
        self._lock = threading.Lock()

    def pixels(self, photo: PosedImage) -> PhotoPixels:
        """The photo's pixels; takes a third of a second for 8192 x 4096 where they are not known.

        Raises:
            FileError: The photo is missing or broken.
        """
        key = (photo.path, photo.camera.width_px)
        with self._lock:
            known = self._kept.get(key)
            if known is not None:
                self._kept.move_to_end(key)
                return known
        pixels = PhotoPixels(self._read(photo), photo.camera.width_px)
        with self._lock:
            self._kept[key] = pixels
            self._kept.move_to_end(key)
            while len(self._kept) > 1 and sum(each.n_bytes for each in self._kept.values()) > self._most_bytes:
                self._kept.popitem(last=False)
        return pixels

    def forget(self) -> None:
        """Drop everything: another plot is open."""
        with self._lock:
            self._kept.clear()


def jpeg_url(picture: UInt8) -> str:
    """A (H, W, 3) RGB picture as a ``data:`` address."""
    import cv2

    _, encoded = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")
