"""One trunk outlined by the segmenter where a person clicks, or draws a box, in a picture on screen."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from dbh_studio.core.arrays import Bool, Float64, UInt8
from dbh_studio.errors import ModelError

if TYPE_CHECKING:
    from dbh_studio.io.models.store import ModelStore
    from dbh_studio.stages.sam import Encoded, Sam

# About a click a box is tried, shares of the picture's sides: stems are upright and narrow.
_HALF_WIDTH, _HALF_HEIGHT = 0.05, 0.22
_LEAST_BOX_PX = 6.0
_KEPT = 4


class ClickSegmenter:
    """The segmenter, opened when it is first asked; any thread may call, one is served at a time.

    Args:
        store: Where the models are.
        open_sam: Opens the segmenter.
    """

    def __init__(self, store: ModelStore, *, open_sam: Callable[[ModelStore], Sam] | None = None) -> None:
        self._store = store
        self._open = open_sam or _open_segmenter
        self._sam: Sam | None = None
        self._encoded: OrderedDict[Hashable, Encoded] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def is_available(self) -> bool:
        """Whether a segmenter is on this computer."""
        return self._sam is not None or bool(self._store.ready("segmenter"))

    def outline(self, picture: Callable[[], UInt8], key: Hashable, box_px: ArrayLike) -> Bool:
        """(h, w) what stands in a box.

        Args:
            picture: Gives (h, w, 3) RGB; asked only where the segmenter has not looked at it yet: that takes seconds.
            key: The same for the same picture.
            box_px: (4,) x0, y0, x1, y1; see `box_about` for a click.

        Raises:
            ModelError: There is no segmenter, it failed, or it outlines nothing there.
            FileError: Its files are broken.
            MissingComponentError: onnxruntime is not there.
        """
        with self._lock:
            if self._sam is None:
                self._sam = self._open(self._store)
            encoded = self._encoded.get(key)
            if encoded is None:
                encoded = self._sam.encode(np.ascontiguousarray(picture()))
            self._encoded[key] = encoded
            self._encoded.move_to_end(key)
            while len(self._encoded) > _KEPT:
                self._encoded.popitem(last=False)
            box = np.asarray(box_px, np.float64).reshape(1, 4)
            shape, _ = next(iter(self._sam.segment(encoded, box)))
        if not shape.any():
            raise ModelError(
                "The model outlines nothing there.", "Draw a box round the trunk, or paint it with the brush."
            )
        return shape


def box_about(corners_xy: Float64, width_px: int, height_px: int) -> Float64:
    """(4,) the box of two corners within the picture; one about the place where both are the same.

    Args:
        corners_xy: (2, 2) in the picture.
        width_px: Of the picture.
        height_px: Of the picture.
    """
    low, high = np.sort(np.asarray(corners_xy, np.float64), axis=0)
    if (high - low).max() < _LEAST_BOX_PX:
        half = np.array([_HALF_WIDTH * width_px, _HALF_HEIGHT * height_px])
        middle = 0.5 * (low + high)
        low, high = middle - half, middle + half
    size = np.array([width_px, height_px], np.float64)
    box: Float64 = np.concatenate([np.clip(low, 0.0, size - 1.0), np.clip(high, 1.0, size)])
    return box


def _open_segmenter(store: ModelStore) -> Sam:
    from dbh_studio.stages.mask_models import open_grounded_sam

    return open_grounded_sam(store, with_detector=False).segmenter
