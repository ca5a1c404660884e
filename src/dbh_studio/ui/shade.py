"""Colours that mark a trunk and still let one see that it is round, and its bark."""

from __future__ import annotations

import numpy as np

from dbh_studio.core.arrays import Float32, UInt8

_LIGHT = np.array([-0.5, -0.87], np.float32)


def shaded(points: Float32, colour: tuple[int, int, int], rgb: UInt8 | None) -> UInt8:
    """One colour over a whole trunk, darker away from a light in the south-west and where the bark is dark.

    Args:
        points: (N, 3) of one trunk, world.
        colour: Of the lit side.
        rgb: (N, 3) the cloud's own colours of these points, or None.

    Returns:
        (N, 3).
    """
    if len(points) == 0:
        return np.zeros((0, 3), np.uint8)
    # The trunk's axis: a straight line through its points, so that a leaning trunk is lit as an upright one.
    z = points[:, 2] - points[:, 2].mean()
    slope = (z @ (points[:, :2] - points[:, :2].mean(axis=0))) / max(float(z @ z), 1e-9)
    aside = points[:, :2] - points[:, :2].mean(axis=0) - z[:, None] * slope
    facing = (aside @ _LIGHT) / np.maximum(np.linalg.norm(aside, axis=1), 1e-6)
    brightness = 0.84 + 0.16 * facing
    if rgb is not None:
        luminance = rgb @ np.array([0.3, 0.59, 0.11], np.float32)
        brightness = brightness * np.clip(luminance / max(float(luminance.mean()), 1.0), 0.55, 1.1)
    return np.clip(brightness[:, None] * np.array(colour, np.float32), 0, 255).astype(np.uint8)
