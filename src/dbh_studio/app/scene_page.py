"""The plot as a page to look at in 3D: which points of the cloud are taken, in which colours."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.app.document import Document
from dbh_studio.app.session import Session
from dbh_studio.app.tree_subject import ring_world
from dbh_studio.core.arrays import Bool, Float64, Int32, Int64, UInt8
from dbh_studio.core.display import height_colours, rough_heights, sample_for_display, tree_colour

if TYPE_CHECKING:
    from dbh_studio.io.exports.columns import Table
    from dbh_studio.io.exports.scene_html import Scene

MOST_POINTS = 300_000
# Of the points: the stems are what one looks at.
_SHARE_OF_STEMS = 0.4
_ROUGH_CELL_M = 1.0
# Stray points far from the plot would leave the plot a dot.
_STRAY_SHARE, _STRAY_ROOM_M = 0.001, 5.0


def make_scene(session: Session, document: Document, table: Table, *, most_points: int = MOST_POINTS) -> Scene:
    """Thin the cloud out and give the stems their colours and rings.

    Args:
        session: The plot.
        document: Its state.
        table: Its inventory.
        most_points: At most so many points are taken: evenly of the stems, and evenly of all else.
    """
    from dbh_studio.io.exports.scene_html import Scene

    labels = document.trunks.labels(len(session.cloud))
    chosen = _chosen(labels, most_points)
    points = session.points_world(document)[chosen].astype(np.float64)
    is_near = _near(points)
    chosen, points = chosen[is_near], points[is_near]
    inventory = table.inventory
    measured = {row.stem_id: session.measurement(row.stem_id, document=document) for row in inventory}
    words = f"{len(inventory)} stems, {inventory.n_measured} with a diameter; {len(points):,} of {len(labels):,} points"
    return Scene(
        title=document.plot_id,
        words=words,
        table=table,
        records=document.trees,
        points_m=points,
        rgb=_colours(session, chosen, points),
        owner=labels[chosen],
        colours={row.stem_id: tree_colour(row.stem_id) for row in inventory},
        rings={i: ring for i, stem in measured.items() if (ring := ring_world(stem)) is not None},
    )


def _chosen(labels: Int32, most: int) -> Int64:
    """Indices of the points taken."""
    of_stems, others = np.flatnonzero(labels), np.flatnonzero(labels == 0)
    room = max(round(_SHARE_OF_STEMS * most), most - len(others))
    n_stems = min(len(of_stems), room)
    parts = []
    for indices, budget in ((of_stems, n_stems), (others, most - n_stems)):
        if len(indices) and budget > 0:
            parts.append(indices[sample_for_display(len(indices), budget)])
    return np.concatenate(parts).astype(np.int64) if parts else np.empty(0, np.int64)


def _near(points: Float64) -> Bool:
    """(N,) which have a place, and one that is not far from nearly all others."""
    is_placed = np.isfinite(points).all(axis=1)
    if not is_placed.any():
        return np.asarray(is_placed, bool)
    low, high = np.quantile(points[is_placed], [_STRAY_SHARE, 1 - _STRAY_SHARE], axis=0)
    with np.errstate(invalid="ignore"):
        is_inside = ((points >= low - _STRAY_ROOM_M) & (points <= high + _STRAY_ROOM_M)).all(axis=1)
    return np.asarray(is_placed & is_inside, bool)


def _colours(session: Session, chosen: Int64, points: Float64) -> UInt8:
    """The cloud's own colours, or by height."""
    if session.cloud.rgb is not None:
        return np.asarray(session.cloud.rgb[chosen], np.uint8)
    if not len(points):
        return np.empty((0, 3), np.uint8)
    return height_colours(rough_heights(points.astype(np.float32), cell=_ROUGH_CELL_M))
