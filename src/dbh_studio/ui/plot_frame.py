"""Between the picture, which is in metres about the plot's origin, and absolute source coordinates, which are kept."""

from __future__ import annotations

from typing import Any

import numpy as np

from dbh_studio.app.session import Session
from dbh_studio.core.arrays import Float64
from dbh_studio.core.scale_evidence import PointSrc


def world_of(session: Session, points_src: Any) -> Float64:
    """(N, 3) world of (N, 3) absolute source coordinates."""
    points = np.asarray(points_src, np.float64).reshape(-1, 3) - session.cloud.origin
    return np.asarray(session.document.world_from_source.apply(points), np.float64)


def source_of(session: Session, point_world: Any) -> PointSrc:
    """Absolute source coordinates of one world point."""
    point = np.asarray(point_world, np.float64).reshape(1, 3)
    x, y, z = (session.document.world_from_source.inverse().apply(point)[0] + session.cloud.origin).tolist()
    return x, y, z


def direction_in_world(session: Session, direction_src: Any) -> Float64:
    """(3,) a direction of the source, in the world."""
    return np.asarray(session.document.world_from_source.rotation @ np.asarray(direction_src, np.float64))
