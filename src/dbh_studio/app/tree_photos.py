"""The photographs of a tree: the best views of it, cut upright out of the plot's photos, with ring and outline.

    for photo in tree_photos(session, 7).photos:
        Path(f"{photo.name}.jpg").write_bytes(photo.jpeg())

What was found is kept: which photos show a tree, for as long as the plot lies as it does; the pictures of the trees
looked at last. Photo files are read when a picture is wanted, no larger than it needs them, and few are kept.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np

from dbh_studio.app.cameras import Cameras, cameras_of
from dbh_studio.app.document import Document
from dbh_studio.app.tree_photo_desk import TreePhotoDesk, frame_of
from dbh_studio.app.tree_subject import TreeSubject
from dbh_studio.core.arrays import UInt8, readonly
from dbh_studio.errors import FileError

if TYPE_CHECKING:
    from dbh_studio.app.session import Session
    from dbh_studio.core.tree_crop import TreeCrop
    from dbh_studio.core.tree_views import TreeView, TreeViews

log = logging.getLogger(__name__)

DEFAULT_SIZE_PX = (480, 640)
# Photos whose files cannot be read are left out, and the next best shown; so many are tried beyond those wanted.
_SPARE = 4

_REASONS = {
    "no_photos": "The plot has no photos.",
    "far": "No photo was taken near enough to this tree.",
    "out_of_frame": "This tree is outside of every photo that was taken near it.",
    "hidden": "This tree is hidden in every photo that was taken near it.",
}


@dataclass(frozen=True, eq=False)
class TreePhoto:
    """One picture of a tree, upright.

    Attributes:
        image: (H, W, 3) uint8 RGB, with nothing drawn on it.
        name: Of the photo it was cut from.
        distance_m: Level distance from the camera to the stem; NaN where the plot has no scale.
        bearing_deg: From the tree to the camera, clockwise from the plot's north (+y).
        seen: Share 0 to 1 of the lower stem that is in the photo and not hidden.
        metres_per_pixel: Of `image`, at the stem; NaN where the plot has no scale.
        at_px: The pixel of the photo in the middle of the picture.
        photo_px_per_px: How many pixels of the photo one pixel of the picture is wide.
    """

    image: UInt8
    name: str
    distance_m: float
    bearing_deg: float
    seen: float
    metres_per_pixel: float
    at_px: tuple[float, float]
    photo_px_per_px: float
    _drawing: Any = field(repr=False)

    @cached_property
    def drawn(self) -> UInt8:
        """(H, W, 3) uint8 RGB with the trunk's outline and, where it was measured, the ring at breast height.

        The ring is drawn through where it is seen, and dashed behind the stem and behind what stands before it.
        """
        from dbh_studio.stages.tree_pictures import drawn

        return readonly(drawn(self.image, self._drawing))

    def jpeg(self, drawn: bool = True, quality: int = 85) -> bytes:
        """The picture as a JPEG file."""
        from dbh_studio.stages.tree_pictures import jpeg

        return jpeg(self.drawn if drawn else self.image, quality)


@dataclass(frozen=True)
class TreePhotos:
    """The pictures of one tree, best first.

    Attributes:
        photos: None to as many as were asked for.
        note: Why there are none, or fewer than two, or what else is to be known; empty where all is well.
    """

    photos: tuple[TreePhoto, ...] = ()
    note: str = ""


def tree_photos(
    session: Session,
    trunk_id: int,
    *,
    most: int = 4,
    size_px: tuple[int, int] = DEFAULT_SIZE_PX,
    document: Document | None = None,
    zoom: float = 1.0,
    is_wanted: Callable[[], bool] = lambda: True,
) -> TreePhotos:
    """The two to four best pictures of a tree.

    Where the plot's photos have not been read yet they are read now, and where the stem has not been measured it is.

    Args:
        session: The plot.
        trunk_id: Of the tree.
        most: How many pictures at most.
        size_px: Width and height of each.
        document: The state of the plot; the present one by default.
        zoom: Above 1 shows less of the stem, and larger.
        is_wanted: Asked in between; where it says no, what is there so far is returned, and nothing is kept.

    Raises:
        KeyError: There is no such trunk.
        ValueError: A size or zoom that is no size.
    """
    if min(size_px) < 16 or max(size_px) > 8192 or not 0.05 <= zoom <= 20.0:
        raise ValueError(f"pictures of {size_px[0]} x {size_px[1]} pixels, zoom {zoom:g}")
    document = document or session.document
    trunk = document.trunks[trunk_id]
    cameras, note = _cameras(session, document)
    if cameras is None:
        return TreePhotos((), note)
    desk = _desk_of(session)
    stem = session.measurement(trunk_id, document=document) if document.scale.is_known else None
    key = (trunk, stem, cameras, frame_of(document))
    pictures_key = (*key, most, size_px, zoom)
    known = desk.trees.get(pictures_key)
    if known is not None:
        return known
    subject = TreeSubject.of(session, document, trunk_id, stem)
    if subject is None:
        return TreePhotos((), "The trunk has too few points to look for it in the photos.")
    if not is_wanted():
        return TreePhotos()
    views = desk.views.get((*key, most))
    if views is None:
        views = desk.find(session, document, cameras, subject, trunk.points.astype(np.int64), most + _SPARE)
        desk.views.put((*key, most), views)
    found = _pictures(desk, subject, views, document, most, size_px, zoom, is_wanted)
    if is_wanted():
        desk.trees.put(pictures_key, found)
    return found


def forget_tree_photos(session: Session) -> None:
    """Free the memory that pictures of a plot's trees take."""
    with _desks_lock:
        _desks.pop(session, None)


def _cameras(session: Session, document: Document) -> tuple[Cameras | None, str]:
    """The plot's photos, or None and why there are none."""
    if document.cameras is None:
        return None, "The plot has no photos. They are added in the step Scale."
    cameras = session.cameras
    if cameras is None or cameras.source != document.cameras:
        if session.document.cameras != document.cameras:
            return None, "The photos of the plot were changed since."
        try:
            cameras = cameras_of(session)
        except FileError as error:
            return None, f"The photos cannot be read. {error}"
    if cameras is None:
        return None, "The plot has no photos. They are added in the step Scale."
    if cameras.fit.status == "moved":
        return None, f"{cameras.fit.message} {cameras.fit.remedy}"
    if not cameras.n_found:
        return None, "None of the photos was found on disk. Say in the step Scale in which folder they are."
    return cameras, ""


def _pictures(
    desk: TreePhotoDesk,
    subject: TreeSubject,
    views: TreeViews,
    document: Document,
    most: int,
    size_px: tuple[int, int],
    zoom: float,
    is_wanted: Callable[[], bool],
) -> TreePhotos:
    if views.why_none:
        return TreePhotos((), _REASONS[views.why_none])
    photos: list[TreePhoto] = []
    broken: list[tuple[str, str]] = []
    for view in views.views:
        if len(photos) >= most or not is_wanted():
            break
        try:
            photos.append(_picture(desk, subject, view, size_px, zoom))
        except FileError as error:
            log.info("A photo of a tree is left out: %s", error)
            broken.append((view.photo.name, error.problem))
    return TreePhotos(tuple(photos), _note(len(photos), views, broken))


def _note(n_photos: int, views: TreeViews, broken: list[tuple[str, str]]) -> str:
    said = []
    if n_photos == 1 and len(views.views) == 1:
        said.append("No other photo shows this tree from another side.")
    if broken:
        names = ", ".join(name for name, _ in broken)
        said.append(f"Left out because it cannot be read: {names}. {broken[0][1]}")
    return " ".join(said)


def _picture(
    desk: TreePhotoDesk, subject: TreeSubject, view: TreeView, size_px: tuple[int, int], zoom: float
) -> TreePhoto:
    from dbh_studio.core.tree_crop import tree_crop
    from dbh_studio.stages.tree_pictures import cut_out

    crop = tree_crop(view.photo, subject.line, tall=subject.tall / zoom, foot=subject.foot, size_px=size_px)
    finer = crop.photo_px_per_px()
    pixels = desk.pixels(view.photo, int(view.photo.camera.width_px / max(finer, 1.0)))
    metres = 1.0 if subject.is_metric else float("nan")
    return TreePhoto(
        image=readonly(cut_out(pixels, crop)),
        name=view.photo.name,
        distance_m=view.distance * metres,
        bearing_deg=view.bearing_deg,
        seen=view.seen,
        metres_per_pixel=crop.units_per_px * metres,
        at_px=crop.middle_in_photo(),
        photo_px_per_px=finer,
        _drawing=_drawing(subject, view, crop),
    )


def _drawing(subject: TreeSubject, view: TreeView, crop: TreeCrop) -> Any:
    from dbh_studio.core.occluders import part_of_face, without_specks
    from dbh_studio.core.tree_crop import outline_px, ring_px
    from dbh_studio.stages.tree_pictures import TrunkDrawing

    edges = outline_px(crop.view, subject.points)
    if subject.ring is None:
        return TrunkDrawing(edges)
    up, across = part_of_face(subject.ring, view.photo.centre_src, subject.line)
    ring, seen = ring_px(crop.view, subject.ring, without_specks(view.hidden)[up, across])
    return TrunkDrawing(edges, ring, seen)


_desks: WeakKeyDictionary[Session, TreePhotoDesk] = WeakKeyDictionary()
_desks_lock = threading.Lock()


def _desk_of(session: Session) -> TreePhotoDesk:
    with _desks_lock:
        return _desks.setdefault(session, TreePhotoDesk())
