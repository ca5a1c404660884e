"""The scale of a plot from lengths marked by hand, or from weaker things where nothing else exists; its frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.app.commands import Command, set_frame, set_scale
from dbh_studio.app.document import Document
from dbh_studio.app.lengths import check_length
from dbh_studio.core.arrays import Float64
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.scale_evidence import MarkerSquare
from dbh_studio.errors import CommandError

if TYPE_CHECKING:
    from dbh_studio.core.cloud import PointCloud
    from dbh_studio.core.posed_images import PosedImages

# How well a person keeps the height of a camera, and knows the distance of two photos.
_HELD_SHARE = 0.05
_PATH_SHARE = 0.02
_MIN_CAMERAS = 3


def scale_from_evidence(document: Document, *, label: str = "Set the scale by known lengths") -> Command:
    """Take the scale from the control lengths of the plot.

    Raises:
        CommandError: They give none; says why.
    """
    report = document.evidence.report(np.array(document.up_direction))
    if report.estimate is None:
        raise CommandError(report.verdict.message, report.verdict.remedy)
    return Command(label, set_scale(report.estimate).apply)


# ---- where nothing else exists


def scale_from_baseline(posed: PosedImages, first: str, second: str, distance_m: float) -> ScaleEstimate:
    """From the distance between two photos, walked or of a rig. Weak.

    Raises:
        CommandError: The two are at one place, or the distance makes no sense.
    """
    check_length(distance_m, "The distance between the two photos")
    try:
        gap = float(np.linalg.norm(posed.by_name(first).centre_src - posed.by_name(second).centre_src))
    except KeyError as error:
        raise CommandError(f"There is no photo {error.args[0]}.", "Choose two photos of this plot.") from None
    if not gap > 0:
        raise CommandError("Both photos were taken at one place.", "Choose two photos that are farther apart.")
    scale = distance_m / gap
    return ScaleEstimate(scale, "baseline", _PATH_SHARE * scale)


def scale_from_camera_height(
    posed: PosedImages, cloud: PointCloud, up_direction: Float64, height_m: float
) -> ScaleEstimate:
    """From how high above the ground the camera was carried. Weak: ground and arm both move.

    The ground under a camera is the low side of the cloud around it, as far as the camera is high.

    Raises:
        CommandError: The ground is seen under fewer than three cameras, or the height makes no sense.
    """
    check_length(height_m, "The height of the camera")
    heights = _camera_heights(posed, cloud, np.asarray(up_direction, np.float64))
    if len(heights) < _MIN_CAMERAS:
        raise CommandError(
            "The ground is seen under too few of the cameras.", "Check the up axis, or mark a known distance instead."
        )
    middle = float(np.median(heights))
    spread = 1.4826 * float(np.median(np.abs(heights - middle))) / middle
    scale = height_m / middle
    return ScaleEstimate(scale, "camera_height", scale * float(np.hypot(_HELD_SHARE, spread / np.sqrt(len(heights)))))


def _camera_heights(posed: PosedImages, cloud: PointCloud, up: Float64) -> Float64:
    """(K,) heights of the cameras above the ground under them, source units."""
    from scipy.spatial import cKDTree

    from dbh_studio.core.updirection import rotation_from_up

    rotation = rotation_from_up(up)
    step = max(1, len(cloud) // 2_000_000)
    points = cloud.xyz[::step].astype(np.float64) @ rotation.T
    centres = (posed.centres_src - cloud.origin) @ rotation.T
    tree = cKDTree(points[:, :2])
    extent = float(np.ptp(centres[:, :2], axis=0).max())
    # In an unknown unit the only length at hand is the walk itself.
    radius = max(0.05 * extent, 1e-12)
    heights = []
    for centre, rows in zip(centres, tree.query_ball_point(centres[:, :2], radius), strict=True):
        if len(rows) >= 20:
            heights.append(centre[2] - float(np.quantile(points[rows, 2], 0.05)))
    found = np.array(heights, np.float64)
    return np.asarray(found[found > 0])


# ---- up, origin and north


def frame_from_square(
    square: MarkerSquare, cloud: PointCloud, *, up: bool = True, origin: bool = True, north: bool = True
) -> Command:
    """Let a marker that lies flat say where the sky, the plot's origin and north are.

    Raises:
        CommandError: Its corners span no plane.
    """
    try:
        normal, middle, top = square.frame()
    except ValueError as error:
        raise CommandError(f"{square.name} gives no directions: {error}.") from None
    offset = np.array(middle) - cloud.origin
    return set_frame(up=normal if up else None, north=top if north else None, origin_src=offset if origin else None)
