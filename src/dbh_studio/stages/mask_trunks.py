"""From the votes of all photos to trunks: the paper's chain, put right by the masks, compared with geometry alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Float, Int32, readonly
from dbh_studio.core.candidates import CandidateTrunk
from dbh_studio.core.chain_steps import ChainSteps
from dbh_studio.core.ground import GroundModel
from dbh_studio.core.instances import InstanceGatherer
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.votes import Votes
from dbh_studio.settings import TrunkSettings, VoteSettings
from dbh_studio.stages.instance_ties import TiedTrunks, tie_trunks
from dbh_studio.stages.second_look import SecondLook, look_again
from dbh_studio.stages.segment import segment_trunks
from dbh_studio.stages.stem_detection import Stem
from dbh_studio.stages.vote import Voters


@dataclass(frozen=True, eq=False)
class MaskTrunks:
    """Trunks by masks.

    Attributes:
        point_sets: Per trunk the sorted indices into the cloud; disjoint, from west to east.
        stems: What the detector saw of each; None for one that came from masks alone.
        notes: What the person should know, in plain words.
        steps: What the chain did with every point and cluster.
        candidates: Where masks and shape disagree so much that a person should say: from west to east.
        flags: Index of a trunk -> what masks and geometry disagree about.
    """

    point_sets: tuple[Int32, ...]
    stems: tuple[Stem | None, ...]
    notes: tuple[str, ...]
    steps: ChainSteps
    candidates: tuple[CandidateTrunk, ...]
    flags: dict[int, str]


def trunks_from_votes(
    points_world: Float,
    ground: GroundModel,
    voters: Voters,
    votes: Votes,
    gatherer: InstanceGatherer,
    *,
    trunks: TrunkSettings = TrunkSettings(),  # noqa: B008 - frozen
    settings: VoteSettings = VoteSettings(),  # noqa: B008 - frozen
    progress: Progress = ignore_progress,
    seed: int = 0,
) -> MaskTrunks:
    """Find the trunks among the points that enough masks call trunk.

    Args:
        points_world: (N, 3) points, metres, +z up.
        ground: Of the plot.
        voters: Who voted.
        votes: (M,) of the voters.
        gatherer: Has been given every photo.
        trunks: Every parameter of the chain and the detector.
        settings: How many votes make a point trunk, and what follows the chain.
        progress: Called in between.
        seed: Of the random samples.

    Raises:
        CancelledError: From `progress`.
    """
    points = points_world
    candidates = votes.carried_back(voters.thinned, voters.rows, voters.n_points).is_trunk(settings)
    found = segment_trunks(
        points, ground, settings=trunks, candidates=candidates, progress=subprogress(progress, 0.0, 0.5), seed=seed
    )
    tied = TiedTrunks(found.point_sets, found.stems, {})
    if settings.tell_apart:
        progress(0.5, "Comparing masks")
        ties = gatherer.ties(votes.is_trunk(settings))
        tied = tie_trunks(points, ground, voters, ties, found.point_sets, found.stems, settings=trunks)
    look = SecondLook((), {})
    if settings.second_look:
        # By their rings: what the chain drops by size must not drop it here, too.
        by_rings = trunks.changed(small_clusters="evidence", smallest_cluster_points=0, part_touching=True)
        shapes = segment_trunks(points, ground, settings=by_rings, progress=subprogress(progress, 0.6, 0.95), seed=seed)
        look = look_again(
            points,
            ground,
            voters,
            gatherer,
            candidates,
            tied.point_sets,
            tied.stems,
            shapes.point_sets,
            shapes.stems,
            settings=settings,
            step_of_point=found.steps.labels,
        )
    said = {number: [text] for number, text in tied.doubts.items()}
    for number, text in look.flags.items():
        said.setdefault(number, []).append(text)
    sets, stems = _grown(tied, look)
    order = [k for k in _west_to_east(sets, points) if k not in look.low]
    return MaskTrunks(
        tuple(sets[k] for k in order),
        tuple(stems[k] for k in order),
        (*found.notes, *_notes(tied, len(look.candidates), sum(k in said for k in order))),
        found.steps,
        look.candidates,
        {index: "; ".join(said[k]) for index, k in enumerate(order) if k in said},
    )


def _grown(tied: TiedTrunks, look: SecondLook) -> tuple[list[Int32], list[Stem | None]]:
    """The trunks, those that have only a part of their stem completed; what went into another one is empty."""
    sets, stems = list(tied.point_sets), list(tied.stems)
    for number, (others, free) in look.grown.items():
        sets[number] = readonly(np.sort(np.concatenate([sets[number], *(sets[k] for k in others), free])))
        stems[number] = next((stems[k] for k in (number, *others) if stems[k] is not None), None)
        for k in others:
            sets[k] = np.empty(0, np.int32)
    return sets, stems


def _west_to_east(point_sets: Sequence[Int32], points: Float) -> list[int]:
    """Numbers of the sets by their median position to the centimetre, then south to north."""

    def position(number: int) -> tuple[float, float, int]:
        rows = point_sets[number]
        x, y = np.round(np.median(points[rows, :2], axis=0).astype(np.float64), 2)
        return float(x), float(y), int(rows[0])

    return sorted((k for k, rows in enumerate(point_sets) if len(rows)), key=position)


def _notes(tied: TiedTrunks, n_candidates: int, n_flags: int) -> list[str]:
    notes = []
    if tied.n_split:
        what = "1 trunk was" if tied.n_split == 1 else f"{tied.n_split:,} trunks were"
        notes.append(f"{what} cut, because the masks show two stems there.")
    if tied.n_joined:
        what = "1 fragment was" if tied.n_joined == 1 else f"{tied.n_joined:,} fragments were"
        notes.append(f"{what} joined to the trunk that the masks show it belongs to.")
    if n_flags:
        what = "1 trunk is" if n_flags == 1 else f"{n_flags:,} trunks are"
        notes.append(f"{what} flagged, because masks and shape disagree there; the table says why.")
    if n_candidates:
        what = "1 candidate was" if n_candidates == 1 else f"{n_candidates:,} candidates were"
        notes.append(f"{what} found, where masks and shape disagree: the studio lists them in step 3.")
    return notes
