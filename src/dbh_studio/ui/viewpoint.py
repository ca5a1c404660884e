"""Where to stand to see a tree."""

from __future__ import annotations

import numpy as np

from dbh_studio.core.arrays import Float32, Float64

# Turns about the tree, the smallest first: the camera stays on the side one is looking from if it can.
_TURNS_DEG = (0, 20, -20, 40, -40, 60, -60, 90, -90, 120, -120, 150, -150, 180)
_AISLE_M = 0.5
_OWN_M = 0.8
_FEW = 15


def clear_side(points: Float32, target: Float64, away: Float64, distance: float) -> Float64:
    """The horizontal direction from a tree in which least stands between it and someone `distance` away.

    Args:
        points: (N, 3) world, metres; a sample will do.
        target: (3,) what is looked at.
        away: (3,) horizontal unit vector one would rather stand in.
        distance: Metres.

    Returns:
        (3,) horizontal unit vector: `away`, or the nearest turn of it that is clear, or the clearest.
    """
    offset = points - target.astype(np.float32)
    near = offset[(np.abs(offset[:, :2]) < distance).all(axis=1) & (offset[:, 2] > -0.6) & (offset[:, 2] < 1.6)]
    best, fewest = away, len(near) + 1
    for turn in np.deg2rad(_TURNS_DEG):
        cos, sin = np.cos(turn), np.sin(turn)
        direction = np.array([cos * away[0] - sin * away[1], sin * away[0] + cos * away[1], 0.0])
        along = near @ direction.astype(np.float32)
        aside = np.abs(near[:, 0] * np.float32(direction[1]) - near[:, 1] * np.float32(direction[0]))
        n_between = int(np.count_nonzero((along > _OWN_M) & (along < distance + 0.5) & (aside < _AISLE_M)))
        if n_between < fewest:
            best, fewest = direction, n_between
        if n_between <= _FEW:
            break
    return best
