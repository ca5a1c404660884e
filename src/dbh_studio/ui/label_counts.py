"""The cloud coloured by label count: how many masks call each point trunk, and grey where none looks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.core.arrays import Int64, UInt8, readonly

if TYPE_CHECKING:
    from dbh_studio.core.votes import Votes

UNSEEN = (178, 184, 190)
# From pale to dark through yellow and red: orders itself also in grey, and on a white page.
_SCALE = np.array(
    [[255, 247, 188], [254, 217, 118], [253, 171, 73], [252, 110, 51], [227, 42, 29], [177, 3, 38], [103, 0, 31]], float
)
# So few points may have more votes than the darkest colour says.
_BEYOND_SHARE = 0.01
_MOST_STEPS = 9


class LabelCounts:
    """The colours of one voting.

    Args:
        votes: Of every point of the cloud.
        rows: (M,) the points that are shown.

    Attributes:
        colours: (M, 3) of them.
        legend: (count, colour as ``#rrggbb``), from none to most; the last stands for more, too, where it says so.
    """

    def __init__(self, votes: Votes, rows: Int64) -> None:
        counts, is_seen = votes.n_trunk[rows].astype(np.int64), votes.n_seen[rows] > 0
        most = most_shown(votes)
        scale = _colours(np.arange(most + 1) / max(most, 1))
        colours = scale[np.minimum(counts, most)]
        colours[~is_seen] = UNSEEN
        self.colours: UInt8 = readonly(colours)
        steps = np.unique(np.linspace(0, most, min(most + 1, _MOST_STEPS)).round().astype(int))
        is_beyond = int(votes.n_trunk.max(initial=0)) > most
        self.legend = tuple(
            (f"{step}{'+' if is_beyond and step == most else ''}", "#{:02x}{:02x}{:02x}".format(*scale[step]))
            for step in steps
        )


def most_shown(votes: Votes) -> int:
    """The label count that gets the darkest colour: nearly no point has more."""
    found = votes.n_trunk[votes.n_trunk > 0]
    if not len(found):
        return 1
    of_count = np.bincount(found)
    beyond = len(found) - np.cumsum(of_count)
    return max(int(np.argmax(beyond <= _BEYOND_SHARE * len(found))), 1)


def _colours(shares: np.ndarray) -> UInt8:
    """(K, 3) of (K,) shares 0..1 of the scale."""
    at = np.clip(shares, 0.0, 1.0) * (len(_SCALE) - 1)
    stops = np.arange(len(_SCALE))
    return np.stack([np.interp(at, stops, channel) for channel in _SCALE.T], axis=1).round().astype(np.uint8)
