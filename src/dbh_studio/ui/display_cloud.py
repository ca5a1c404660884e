"""The display sample of one plot: made once, shared by every tab, never measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Float32, Int32, Int64, UInt8
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.display import height_colours, rough_heights, sample_for_display
from dbh_studio.core.picking import PickCloud, PickHit
from dbh_studio.core.trunks import TrunkSet

CROWN_ABOVE_M = 6.0
_COLOURS_TO_M = 12.0
# How much of what lies under the cursor must belong to one trunk for a click to mean that trunk.
_MIN_SHARE = 0.2


@dataclass(frozen=True, eq=False)
class DisplayCloud:
    """What the browser gets, in the world frame.

    Attributes:
        indices: (M,) which points of the plot's cloud are shown, shuffled.
        points: (M, 3) world.
        rgb: (M, 3) the cloud's own colours; by height where it has none.
        by_height: (M, 3) colours by height above the lowest neighbour.
        is_crown: (M,) whether the point is so high that it hides the stems from above.
        picking: The same points, laid out for picking.
        has_rgb: Whether `rgb` are the cloud's own colours.
    """

    indices: Int64
    points: Float32
    rgb: UInt8
    by_height: UInt8
    is_crown: np.ndarray
    picking: PickCloud
    has_rgb: bool

    @classmethod
    def of(cls, cloud: PointCloud, points_world: Float32, *, budget: int, is_metric: bool) -> DisplayCloud:
        """Sample `cloud`; `points_world` are all its points in the world frame, in the cloud's order."""
        indices = sample_for_display(len(cloud), budget)
        points = points_world.take(indices, axis=0)  # whole rows: a third of the time of fancy indexing
        extent = float(max(np.ptp(points[:, 0]), np.ptp(points[:, 1]))) if len(points) else 1.0
        heights = rough_heights(points, cell=2.0 if is_metric else extent / 20.0)
        # The stems get the whole range: crowns are hidden at first, and told apart by nobody.
        by_height = height_colours(heights, top_m=_COLOURS_TO_M if is_metric else None)
        rgb = cloud.rgb.take(indices, axis=0) if cloud.rgb is not None else by_height
        is_crown = heights > CROWN_ABOVE_M if is_metric else np.zeros(len(points), bool)
        return cls(indices, points, rgb, by_height, is_crown, PickCloud(points), cloud.rgb is not None)

    @property
    def point_size(self) -> float:
        """A point size, in world units, at which surfaces look closed but edges stay sharp."""
        return float(np.clip(1.6 * self.picking.spacing, 1e-4, 0.06))

    def centre_and_radius(self) -> tuple[np.ndarray, float]:
        """(3,) middle of the plot at stem height, and half its width; stray points do not move it."""
        if len(self.points) == 0:
            return np.zeros(3), 1.0
        low, high = np.percentile(self.points[:: max(1, len(self.points) // 200_000)], [1, 99], axis=0)
        centre = 0.5 * (low + high)
        centre[2] = low[2] + min(0.15 * (high[2] - low[2]), 0.1 * float(np.max(high - low)))
        return centre, 0.5 * float(np.max((high - low)[:2], initial=0.1))

    def trunk_ids(self, rows: Int64, trunks: TrunkSet) -> Int32:
        """(K,) trunk id of (K,) points of this sample, 0 where none.

        Looked up for the few points under a click: labels of the whole cloud would cost the first click after every
        edit a tenth of a second for ten million points.
        """
        points = self.indices[rows].astype(np.int32)
        ids = np.zeros(len(points), np.int32)
        for trunk in trunks:
            if len(trunk):
                at = np.minimum(np.searchsorted(trunk.points, points), len(trunk) - 1)
                ids[trunk.points[at] == points] = trunk.id
        return ids

    def trunk_under(self, hit: PickHit, trunks: TrunkSet) -> int | None:
        """The trunk that most of what was picked belongs to; None where little of it is of any trunk."""
        labels = self.trunk_ids(hit.surface, trunks)
        ids, counts = np.unique(labels[labels > 0], return_counts=True)
        return int(ids[counts.argmax()]) if len(ids) and counts.max() >= _MIN_SHARE * len(labels) else None
