"""The points that a gesture may choose among, laid out for it: of one trunk, of what is about it, or of a view.

A lasso over all points of a large plot takes seconds. Nobody means all of them: a person corrects one trunk, and looks
at what is about it.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from dbh_studio.app.commands import existing_trunk
from dbh_studio.app.document import Document
from dbh_studio.app.session import Session
from dbh_studio.core.arrays import Float32, Float64, Int32, Int64
from dbh_studio.core.picking import PickCloud, View
from dbh_studio.core.point_blocks import PointBlocks
from dbh_studio.core.trunk_edits import in_order
from dbh_studio.core.trunks import Trunk, TrunkSet

_log = logging.getLogger(__name__)

# What is about a trunk: so far from its points, metres; without a scale a part of the trunk's own size.
ABOUT_M, _ABOUT_PART = 1.0, 0.15
# Of a view nobody has chosen a tree in: what lies so much before and behind the middle of the drawing.
_BEFORE_M, _BEHIND_M = 1.0, 1.5
_N_DABS = 24


@dataclass(frozen=True, eq=False)
class Pool:
    """Points to choose among.

    Attributes:
        rows: (K,) sorted indices into the cloud.
        points: (K, 3) where they are, world.
    """

    rows: Int64
    points: Float32

    def __len__(self) -> int:
        return len(self.rows)

    @cached_property
    def picking(self) -> PickCloud:
        """The same, laid out for picking."""
        return PickCloud(self.points)

    def lasso(self, view: View, polygon_xy: Any) -> Int64:
        """(K,) sorted indices of those that appear inside a polygon on the screen, hidden ones too."""
        return self.rows[self.picking.lasso(view, polygon_xy)]

    def rectangle(self, view: View, lower_xy: Any, upper_xy: Any) -> Int64:
        """(K,) sorted indices of those that appear between two corners 0..1."""
        return self.rows[self.picking.rectangle(view, lower_xy, upper_xy)]

    def brushed(self, view: View, path_xy: Any, radius: float) -> Int64:
        """(K,) sorted indices of the points that a ball touches as it is drawn over the surface seen.

        Args:
            view: The camera.
            path_xy: (M, 2) where the pointer was, 0..1; at most some dozens of places of it are used.
            radius: Of the ball, in the unit of the points.
        """
        path = np.asarray(path_xy, np.float64).reshape(-1, 2)
        path = path[np.linspace(0, len(path) - 1, min(len(path), _N_DABS)).astype(int)] if len(path) else path
        touched = np.zeros(len(self.rows), bool)
        for place in path:
            ray = view.ray(place)
            hit = self.picking.pick(view.origin, ray, view.pixel_angle_rad)
            if hit is not None:
                touched[self.picking.ball(view.origin + hit.depth * ray, radius)] = True
        return self.rows[touched]

    def between(self, low_z: float, high_z: float) -> Pool:
        """Those between two heights, world."""
        inside = (self.points[:, 2] >= low_z) & (self.points[:, 2] <= high_z)
        return Pool(self.rows[inside], self.points[inside])

    def owners(self, trunks: TrunkSet, session: Session) -> Int32:
        """(K,) whose each point is, 0 where nobody's."""
        ids = np.zeros(len(self.rows), np.int32)
        if not len(self.rows):
            return ids
        lower, upper = self.points.min(axis=0), self.points.max(axis=0)
        points = session.points_world()
        for trunk in trunks:
            box = _box_of(trunk, points)
            if box is None or (box[0] > upper).any() or (box[1] < lower).any():
                continue
            at = np.minimum(np.searchsorted(trunk.points, self.rows), len(trunk) - 1)
            ids[trunk.points[at] == self.rows] = trunk.id
        return ids


def pool_of(session: Session, document: Document, ids: Iterable[int]) -> Pool:
    """The points of trunks.

    Raises:
        CommandError: One is not there.
    """
    own = [existing_trunk(document, trunk_id).points for trunk_id in sorted(set(ids))]
    rows = in_order(*own).astype(np.int64)
    return Pool(rows, session.points_world(document).take(rows, axis=0))


def pool_about(session: Session, document: Document, trunk_id: int) -> Pool:
    """The points of a trunk and all about it, the ground and its neighbours too.

    Raises:
        CommandError: There is no such trunk.
    """
    points = session.points_world(document)
    box = _box_of(existing_trunk(document, trunk_id), points)
    if box is None:
        return Pool(np.empty(0, np.int64), np.empty((0, 3), np.float32))
    about = reach_of(document, box)
    rows = blocks_of(session, document).in_box(box[0] - about, box[1] + about)
    return Pool(rows, points.take(rows, axis=0))


def reach_of(document: Document, box: Float32) -> float:
    """How far about a trunk one looks, in the unit of the world."""
    return ABOUT_M if document.scale.is_known else _ABOUT_PART * float((box[1] - box[0]).max())


def pool_in_view(session: Session, document: Document, view: View, corners_xy: Any) -> Pool:
    """The points on a part of the screen about as far away as the front-most ones in its middle.

    Args:
        session: The plot.
        document: As it is now.
        view: The camera.
        corners_xy: (2, 2) corners of that part, 0..1.
    """
    points, corners = session.points_world(document), np.sort(np.asarray(corners_xy, np.float64), axis=0)
    rows = blocks_of(session, document).perhaps_in_view(view, corners)
    pool = Pool(rows, points.take(rows, axis=0))
    middle = 0.25 * (corners[::-1] - corners) + corners
    ahead = pool.points[PickCloud.over(pool.points).rectangle(view, *np.sort(middle, axis=0))]
    if not len(ahead):
        return pool
    forward = view.rotation[2]
    depth = (ahead - view.origin) @ forward
    first = float(np.quantile(depth, 0.05))
    unit = 1.0 if document.scale.is_known else 0.1 * first
    depth = (pool.points - view.origin) @ forward
    near = (depth >= first - _BEFORE_M * unit) & (depth <= first + _BEHIND_M * unit)
    return Pool(rows[near], pool.points[near])


# ---- blocks and boxes, remembered


_blocks: WeakKeyDictionary[Session, PointBlocks] = WeakKeyDictionary()
_boxes: WeakKeyDictionary[Trunk, tuple[Float32, Float32 | None]] = WeakKeyDictionary()
_lock = threading.Lock()
_building = threading.Lock()


def blocks_of(session: Session, document: Document | None = None) -> PointBlocks:
    """The blocks of a plot's points, made where they are not there: a second for 20 million points."""
    points = session.points_world(document)
    with _building:  # who asks while they are made waits for them, and makes none
        with _lock:
            known = _blocks.get(session)
        if known is not None and known.xyz is points:
            return known
        made = PointBlocks(points)
        with _lock:
            _blocks[session] = made
        return made


def prepare(session: Session) -> None:
    """Make ready in the background what the first gesture would wait for."""

    def work() -> None:
        try:
            blocks_of(session)
            points = session.points_world()
            for trunk in session.document.trunks:
                _box_of(trunk, points)
        except Exception:  # noqa: BLE001 - whoever needs it makes it, and is told what is wrong
            _log.exception("Could not prepare the plot for corrections")

    threading.Thread(target=work, daemon=True, name="blocks").start()


def _box_of(trunk: Trunk, points: Float32) -> Float32 | None:
    """(2, 3) lower and upper corner of a trunk, world; None where it has no points."""
    with _lock:
        known = _boxes.get(trunk)
    if known is not None and known[0] is points:
        return known[1]
    own = points.take(trunk.points, axis=0)
    own = own[np.isfinite(own).all(axis=1)]
    box = np.stack([own.min(axis=0), own.max(axis=0)]) if len(own) else None
    with _lock:
        _boxes[trunk] = points, box
    return box


def middle_of(session: Session, document: Document, trunk_id: int) -> Float64:
    """(3,) the middle of a trunk's box, world.

    Raises:
        CommandError: There is no such trunk.
    """
    box = _box_of(existing_trunk(document, trunk_id), session.points_world(document))
    return np.zeros(3) if box is None else np.asarray(box.mean(axis=0), np.float64)
