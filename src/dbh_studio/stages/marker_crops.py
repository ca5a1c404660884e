"""Pictures of detections, so that a person can see what was taken for a marker and how exactly."""

from __future__ import annotations

import numpy as np

from dbh_studio.core.arrays import Float64, UInt8
from dbh_studio.core.camera import CameraModel
from dbh_studio.io.marker_codes import opencv
from dbh_studio.stages.marker_fit import view_rotation
from dbh_studio.stages.marker_views import View, pixel_angle

# The picture reaches this much farther than the corners.
_ROUND_ABOUT = 1.35
_MAX_OVERSAMPLING = 6
_SUBPIXEL_BITS = 4
_LINE_RGB = (255, 210, 0)
_SHADE_RGB = (0, 0, 0)


def detection_crop(image_rgb: UInt8, camera: CameraModel, corners_px: Float64, size_px: int = 160) -> UInt8:
    """A straight view of a marker in its surroundings, its outline drawn and its first corner dotted.

    Args:
        image_rgb: (H, W, 3) uint8 picture; may be a resized one of the same aspect.
        camera: Of the photo, a panorama or any other.
        corners_px: (4, 2) corners as in `Detection`, in pixels of the camera.
        size_px: Side of the result.

    Returns:
        (size_px, size_px, 3) uint8 RGB.

    Raises:
        ValueError: The corners are not four places in the photo, or the picture has another aspect than the camera.
        MissingComponentError: OpenCV is absent.
    """
    corners = np.asarray(corners_px, np.float64)
    if corners.shape != (4, 2):
        raise ValueError(f"corners_px has shape {corners.shape} but (4, 2) is needed")
    rays = camera.rays(corners)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    if not np.isfinite(rays).all():
        raise ValueError("corners_px lie outside the photo")
    height, width = image_rgb.shape[:2]
    if (width, height) != (camera.width_px, camera.height_px):
        camera = camera.scaled_to(width, height)
    middle = rays.mean(axis=0)
    middle /= np.linalg.norm(middle)
    reach = min(_ROUND_ABOUT * float(np.arccos(np.clip(rays @ middle, -1, 1)).max()), 1.2)
    focal = size_px / 2 / np.tan(max(reach, 1e-4))
    # A marker that fills the photo would flicker: render finer, then average.
    angle = pixel_angle(camera, middle)
    finer = int(np.clip(np.ceil(1 / (focal * angle)), 1, _MAX_OVERSAMPLING)) if np.isfinite(angle) and angle > 0 else 1
    view = View(view_rotation(middle), size_px * finer, focal * finer)
    crop = view.render(np.ascontiguousarray(image_rgb), camera)
    if finer > 1:
        crop = opencv().resize(crop, (size_px, size_px), interpolation=opencv().INTER_AREA)
    local = rays @ view.rotation.T
    return _outlined(crop, focal * local[:, :2] / local[:, 2:] + size_px / 2)


def _outlined(crop: UInt8, corners_px: Float64) -> UInt8:
    cv2 = opencv()
    drawn = np.ascontiguousarray(crop)
    # OpenCV counts from the middle of the first pixel.
    spots = np.round((corners_px - 0.5) * 2**_SUBPIXEL_BITS).astype(np.int32)
    for colour, width in ((_SHADE_RGB, 3), (_LINE_RGB, 1)):
        cv2.polylines(drawn, [spots], True, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)
        cv2.circle(
            drawn, tuple(spots[0].tolist()), (1 + width) << _SUBPIXEL_BITS, colour, -1, cv2.LINE_AA, _SUBPIXEL_BITS
        )
    outlined: UInt8 = drawn
    return outlined
