"""What is kept of a plot for the pictures of its trees: the cloud laid out, photos read last, pictures made last."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable
from typing import TYPE_CHECKING, Any

import numpy as np

from dbh_studio.app.cameras import Cameras
from dbh_studio.app.document import Document
from dbh_studio.app.tree_subject import TreeSubject
from dbh_studio.core.arrays import Int64, UInt8, readonly
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.core.transforms import Similarity

if TYPE_CHECKING:
    from dbh_studio.app.session import Session
    from dbh_studio.core.occluders import Occluders
    from dbh_studio.core.tree_views import TreeViews, Viewpoints

# Pictures of one tree take 4 MB, and twice that once they are drawn on.
_TREES_KEPT, _VIEWS_KEPT, _PHOTO_BYTES = 12, 400, 260_000_000


def frame_of(document: Document) -> Hashable:
    """What decides how the cloud lies in the world."""
    scale = document.scale.metres_per_unit if document.scale.is_known else None
    return document.up_direction, document.north_direction, document.origin_src, scale


class _Kept:
    """The values used last, by key."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._values: OrderedDict[Hashable, Any] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Hashable) -> Any:
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
            return self._values.get(key)

    def put(self, key: Hashable, value: Any) -> None:
        with self._lock:
            self._values[key] = value
            self._values.move_to_end(key)
            while len(self._values) > self._most:
                self._values.popitem(last=False)


class TreePhotoDesk:
    """What is kept of one plot."""

    def __init__(self) -> None:
        self.trees = _Kept(_TREES_KEPT)
        self.views = _Kept(_VIEWS_KEPT)
        self._laid_out: tuple[Hashable, Occluders] | None = None
        self._viewpoints: tuple[Hashable, Viewpoints] | None = None
        self._photos: OrderedDict[tuple[str | None, int], UInt8] = OrderedDict()
        self._lock = threading.Lock()
        self._photos_lock = threading.Lock()

    def find(
        self, session: Session, document: Document, cameras: Cameras, subject: TreeSubject, own: Int64, most: int
    ) -> TreeViews:
        """Choose the photos of a tree; the first time in a frame the cloud is laid out for it."""
        from dbh_studio.core.tree_views import choose_views

        with self._lock:
            occluders = self._occluders(session, document)
            viewpoints = self._photos_world(session, document, cameras)
        return choose_views(subject.line, viewpoints, occluders, own=own, most=most)

    def _occluders(self, session: Session, document: Document) -> Occluders:
        from dbh_studio.core.occluders import Occluders

        key = frame_of(document)
        if self._laid_out is None or self._laid_out[0] != key:
            self._laid_out = key, Occluders(session.points_world(document))
        return self._laid_out[1]

    def _photos_world(self, session: Session, document: Document, cameras: Cameras) -> Viewpoints:
        from dbh_studio.core.tree_views import Viewpoints

        key = (cameras, frame_of(document))
        if self._viewpoints is None or self._viewpoints[0] != key:
            world_from_source = document.world_from_source @ Similarity(np.eye(3), -session.cloud.origin)
            found = (photo for photo in cameras.posed if photo.path is not None)
            self._viewpoints = key, Viewpoints(tuple(photo.moved(world_from_source) for photo in found))
        return self._viewpoints[1]

    def pixels(self, photo: PosedImage, least_width_px: int) -> UInt8:
        """The photo, at least so wide where it is; within the bound on memory.

        Raises:
            FileError: It is missing or broken.
        """
        from dbh_studio.io.photos import read_photo

        with self._photos_lock:
            for (path, width), pixels in self._photos.items():
                if path == photo.path and width >= least_width_px and width <= 4 * max(least_width_px, 1):
                    self._photos.move_to_end((path, width))
                    return pixels
            pixels = readonly(read_photo(photo, least_width_px=max(least_width_px, 1)))
            self._photos[photo.path, pixels.shape[1]] = pixels
            while len(self._photos) > 1 and sum(each.nbytes for each in self._photos.values()) > _PHOTO_BYTES:
                self._photos.popitem(last=False)
            return pixels
