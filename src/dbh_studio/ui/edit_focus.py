"""What one looks at while correcting a trunk: all of the plot, the tree alone, or a slice of it at breast height.

View only, of one tab. What is hidden cannot be selected.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.app.document import Document
from dbh_studio.app.edit_pool import Pool, pool_about, pool_of
from dbh_studio.app.session import Session
from dbh_studio.core.dbh import DbhEstimate
from dbh_studio.errors import CommandError
from dbh_studio.ui.edit_scene import EditScene

if TYPE_CHECKING:
    from dbh_studio.ui.tab import Tab

SLICE_M = (0.05, 2.0)


class EditFocus:
    """Only the tab's own worker thread calls it.

    Attributes:
        only_own: Select among the points of the chosen tree only.
        hides_others: Show the chosen tree and what is within a metre of it only.
        is_slice: Show a slice at breast height only.
        slice_m: How thick it is.
    """

    def __init__(self, tab: Tab, scene: EditScene) -> None:
        self._tab = tab
        self._scene = scene
        self.only_own = True
        self.hides_others = False
        self.is_slice = False
        self.slice_m = 0.3
        self._about: tuple[tuple[object, ...], Pool] | None = None
        self._own: tuple[tuple[object, ...], Pool] | None = None
        self._drawn: tuple[object, ...] | None = None

    @property
    def is_alone(self) -> bool:
        """Whether the rest of the plot is hidden."""
        return self.hides_others or self.is_slice

    def forget(self) -> None:
        """The picture was made anew, or another plot is open."""
        self._about = self._own = self._drawn = None

    def set(self, *, hides_others: bool | None = None, is_slice: bool | None = None) -> None:
        """Hide or show the rest of the plot.

        Raises:
            CommandError: No tree is chosen.
            UnscaledCloudError: There is no breast height without a scale.
        """
        if hides_others or is_slice:
            if self._tab.view.selected is None:
                raise CommandError("No tree is chosen.", "Click the trunk you want to see alone.")
            if is_slice:
                self._tab.require_session().require_scale()
        self.hides_others = self.hides_others if hides_others is None else hides_others
        self.is_slice = self.is_slice if is_slice is None else is_slice

    def pool(self, session: Session, document: Document, trunk_id: int) -> Pool:
        """The points to select among: those seen, and with `only_own` only those of the tree."""
        if self.only_own and not self.is_alone:
            key = (session, session.points_world(document), document.trunks[trunk_id])
            if self._own is None or not _same(self._own[0], key):
                self._own = key, pool_of(session, document, [trunk_id])
            return self._own[1]
        seen = self.seen(session, document, trunk_id)
        if not self.only_own:
            return seen
        own = np.isin(seen.rows, document.trunks[trunk_id].points, assume_unique=True)
        return Pool(seen.rows[own], seen.points[own])

    def seen(self, session: Session, document: Document, trunk_id: int) -> Pool:
        """The tree and what is about it, of which only the slice where that is on."""
        thickness = self.slice_m if self.is_slice else 0.0
        key = (session, session.points_world(document), document.trunks[trunk_id], thickness)
        if self._about is None or not _same(self._about[0], key):
            pool = pool_about(session, document, trunk_id)
            if self.is_slice:
                middle = self._breast_height(session, document, trunk_id)
                pool = pool.between(middle - thickness / 2, middle + thickness / 2)
            self._about = key, pool
        return self._about[1]

    def _breast_height(self, session: Session, document: Document, trunk_id: int) -> float:
        """Where the tree is measured, or would be, world."""
        height = document.settings.measure.breast_height_m
        stem = self._tab.stem(document, trunk_id)
        if stem is not None and np.isfinite(stem.z_ground_m):
            if isinstance(stem.result, DbhEstimate):
                height = stem.result.section.hom_m
            return float(stem.z_ground_m + height)
        points = pool_of(session, document, [trunk_id]).points
        return float(points[:, 2].min(initial=0.0)) + height

    def draw(self, session: Session | None, document: Document | None, trunk_id: int | None) -> None:
        """Bring the picture in step; with nothing chosen all of the plot is shown."""
        if session is None or document is None or trunk_id is None or not self.is_alone:
            if self._drawn is not None:
                self._drawn = None
                self._scene.hide_alone()
                self._tab.scene.set_others(True)
            return
        pool = self.seen(session, document, trunk_id)
        key = (pool, document.trunks)
        if self._drawn is not None and _same(self._drawn, key):
            return
        rgb = session.cloud.rgb
        owners = pool.owners(document.trunks, session)
        own_rgb = None if rgb is None else rgb.take(pool.rows, axis=0)
        self._scene.show_alone(pool.points, owners, trunk_id, own_rgb, spacing=pool.picking.spacing)
        if self._drawn is None:
            self._tab.scene.set_others(False)
        self._drawn = key


def _same(one: tuple[object, ...], other: tuple[object, ...]) -> bool:
    """Whether two keys are of the very same objects; numbers by value."""
    return len(one) == len(other) and all(
        a is b or (isinstance(a, float) and isinstance(b, float) and a == b) for a, b in zip(one, other, strict=True)
    )
