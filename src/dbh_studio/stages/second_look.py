"""Where masks and geometry disagree: trunks that only masks see, and stems that only geometry sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dbh_studio.core.arrays import Bool, Float, Int32, UInt8
from dbh_studio.core.candidates import CandidateKind, CandidateTrunk
from dbh_studio.core.chain_steps import Step
from dbh_studio.core.ground import GroundModel
from dbh_studio.core.instances import InstanceGatherer, InView
from dbh_studio.settings import VoteSettings
from dbh_studio.stages.stem_detection import Stem
from dbh_studio.stages.vote import Voters

# A stem is one of the trunks where these hold so much of it; a trunk has a stem where they share so much of either.
_COVERED, _SHARED = 0.5, 0.3
# A stem whose points were so much in masks was lost by what came after them.
_WAS_TRUNK = 0.3
_HEIGHT_M = 1.3
# What ends below it and is no stem by its shape cannot be measured, and nearly always lies or grows there.
_LOW_M = 1.3

ONLY_MASKS = "only masks see it: no stem by its shape"
IN_PART = "masks show only a part of this stem, the rest is by its shape"
_LOST = {
    Step.TOO_LOW: "as too near the ground",
    Step.TOO_HIGH: "as above the trunk top",
    Step.NOT_SIDEWAYS: "because its surface does not face sideways",
    Step.LOOSE: "because its points are too few and far apart to be a cluster",
    Step.DROPPED: "because its cluster is too small",
}


@dataclass(frozen=True, eq=False)
class SecondLook:
    """What a person should look at.

    Attributes:
        candidates: Stems by geometry that are no trunk, and trunks that should be none, from west to east.
        flags: Number of a trunk -> what is odd about it.
        low: Numbers of the trunks that are candidates now.
        grown: Number of a trunk that has only a part of its stem -> the numbers of the trunks that are other parts, and
            the points that none has.
    """

    candidates: tuple[CandidateTrunk, ...]
    flags: dict[int, str]
    low: tuple[int, ...] = ()
    grown: dict[int, tuple[tuple[int, ...], Int32]] = field(default_factory=dict)


def look_again(
    points_world: Float,
    ground: GroundModel,
    voters: Voters,
    gatherer: InstanceGatherer,
    is_candidate: Bool,
    trunks: Sequence[Int32],
    trunk_stems: Sequence[Stem | None],
    shapes: Sequence[Int32],
    shape_stems: Sequence[Stem | None],
    *,
    settings: VoteSettings = VoteSettings(),  # noqa: B008 - frozen
    step_of_point: UInt8 | None = None,
) -> SecondLook:
    """Compare the trunks found by masks with the stems found without.

    Args:
        points_world: (N, 3) points, metres, +z up.
        ground: Of the plot.
        voters: Who voted.
        gatherer: Has been given every photo.
        is_candidate: (N,) points that the votes made trunk.
        trunks: Per trunk the sorted indices of its points.
        trunk_stems: What the detector saw of each among the points that masks call trunk.
        shapes: Per stem that geometry alone finds the sorted indices of its points.
        shape_stems: The stems themselves.
        settings: For the reasons.
        step_of_point: (N,) `Step` of every point in the search that made `trunks`; tells where a stem was lost.
    """
    owner = np.full(len(points_world), -1, np.int32)
    for number, points in enumerate(trunks):
        owner[points] = number
    has_shape = np.array([stem is not None for stem in trunk_stems], bool)
    candidates = []
    flags: dict[int, str] = {}
    grown: dict[int, tuple[tuple[int, ...], Int32]] = {}
    voter_of_row = voters.thinned.labels_of_points(np.arange(len(voters), dtype=np.int32))

    def in_view(rows: Int32) -> InView:
        at = np.minimum(np.searchsorted(voters.rows, rows), max(len(voters.rows) - 1, 0))
        own = np.unique(voter_of_row[at[voters.rows[at] == rows]]) if len(voters.rows) else np.empty(0, np.int64)
        return gatherer.in_view(own) if len(own) else InView(0, 0)

    for points, stem in zip(shapes, shape_stems, strict=True):
        inside = owner[points]
        names, counts = np.unique(inside[inside >= 0], return_counts=True)
        sizes = np.array([len(trunks[name]) for name in names])
        has_shape[names[(counts >= _SHARED * len(points)) | (counts >= _SHARED * sizes)]] = True
        if counts.sum() >= _COVERED * len(points) or stem is None:
            continue
        free = points[inside < 0]
        within = np.flatnonzero(counts >= _COVERED * sizes)
        if len(within):
            first, *others = names[within[np.argsort(-counts[within], kind="stable")]].tolist()
            grown[first] = tuple(others), free
            flags[first] = IN_PART
            continue
        seen = in_view(free)
        lost = "" if step_of_point is None else _lost_at(step_of_point[free])
        kind, reason = _why(seen, float(is_candidate[free].mean()), settings, lost)
        x, y = (float(part) for part in stem.xy_at(_HEIGHT_M))
        candidates.append(CandidateTrunk(free, (x, y), 2.0 * stem.radius_m, kind, reason, seen.n_seen, seen.n_called))
    low = []
    for number in np.flatnonzero(~has_shape).tolist():
        points = trunks[number]
        top_m = float(np.quantile(ground.height_above(points_world[points]), 0.98))
        if top_m >= _LOW_M:
            flags[number] = ONLY_MASKS
        else:
            low.append(number)
            candidates.append(_low_one(points_world, points, top_m, in_view(points)))
    return SecondLook(tuple(sorted(candidates, key=lambda each: each.xy_m)), flags, tuple(low), grown)


def _low_one(points_world: Float, points: Int32, top_m: float, seen: InView) -> CandidateTrunk:
    """What masks call trunk, but ends below breast height and has no rings."""
    xy = points_world[points, :2].astype(np.float64)
    x, y = (float(part) for part in np.median(xy, axis=0))
    width_m = 2.0 * float(np.median(np.hypot(*(xy - (x, y)).T)))
    photos = "1 photo calls" if seen.n_called == 1 else f"{seen.n_called} photos call"
    reason = f"{photos} it trunk, but it ends {top_m:.1f} m above ground and has no rings: a log or a bush?"
    return CandidateTrunk(points, (x, y), width_m, "low", reason, seen.n_seen, seen.n_called)


def _why(seen: InView, share: float, settings: VoteSettings, lost_at: str) -> tuple[CandidateKind, str]:
    if seen.n_seen == 0:
        return "unseen", "no photo with a mask has it in view"
    photos = "1 photo has" if seen.n_seen == 1 else f"{seen.n_seen} photos have"
    if share >= _WAS_TRUNK:
        where = f"dropped {lost_at}" if lost_at else "the steps after the masks lost it"
        return "dropped", f"{photos} it in view, {_calling(seen.n_called)} it trunk; {where}"
    if seen.n_called == 0:
        return "denied", f"{photos} it in view, none calls it trunk"
    rule = f"at least {settings.min_count}"
    if settings.rule == "share":
        rule += f" and {100 * settings.min_share:.0f} %"
    return "outvoted", f"{photos} it in view, only {_calling(seen.n_called)} it trunk ({rule} must)"


def _lost_at(steps: UInt8) -> str:
    """Where most of the points were dropped, for a person; empty where no step did."""
    counts = np.bincount(steps, minlength=len(Step))
    step = max(_LOST, key=lambda each: int(counts[each]))
    return _LOST[step] if counts[step] else ""


def _calling(number: int) -> str:
    return "1 calls" if number == 1 else f"{number or 'none'} call"
