"""The steps from a cloud to diameters, one call each: ground and trunks, measuring, comparing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from dbh_studio.app.commands import replace_trunks
from dbh_studio.app.derived import stem_setup_of
from dbh_studio.app.document import Document
from dbh_studio.app.jobs import run_job
from dbh_studio.app.last_search import apply_search
from dbh_studio.app.session import Session
from dbh_studio.app.threads import CallAhead, map_in_threads
from dbh_studio.core.arrays import Float32
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.protocols import StemSetup
from dbh_studio.core.trunks import Trunk, TrunkSet
from dbh_studio.settings import CurveName, GroundSettings, Settings

if TYPE_CHECKING:
    from dbh_studio.core.chain_steps import ChainSteps
    from dbh_studio.core.ground import GroundModel
    from dbh_studio.stages.measure import StemMeasurement

__all__ = [
    "SEGMENTATION_READS",
    "Segmentation",
    "apply_segmentation",
    "comparison_call",
    "measure_stems",
    "measurement_call",
    "segment",
    "segment_plot",
    "segmentation_call",
    "trunks_from_ids",
]

# What a segmentation depends on; a job that ran while one of them changed is stale. Of the measurement it reads only
# how many points are too few and the seed, which are no reason to throw away minutes of work.
SEGMENTATION_READS = (
    "source",
    "up_direction",
    "north_direction",
    "origin_src",
    "scale",
    "settings.ground",
    "settings.trunks",
    "trunks",
)


@dataclass(frozen=True, eq=False)
class Segmentation:
    """What `segment_plot` found.

    Attributes:
        ground: The ground.
        trunks: Numbered from west to east; those taken over keep the file's numbers.
        notes: What the person should know, in plain words.
        steps: What became of every point and every cluster; None where trees were taken over.
    """

    ground: GroundModel
    trunks: TrunkSet
    notes: tuple[str, ...]
    steps: ChainSteps | None = None


# ---- finding trunks


def segment_plot(
    points_world: Float32,
    settings: Settings,
    existing_ids: NDArray[Any] | None = None,
    *,
    candidates: NDArray[np.bool_] | None = None,
    ground: GroundModel | None = None,
    progress: Progress = ignore_progress,
) -> Segmentation:
    """Find the ground and the trunks. Pure and picklable, for a job.

    Args:
        points_world: (N, 3) points, metres, +z up.
        settings: Of the ground and the trunks.
        existing_ids: (N,) tree ids the cloud carries, or None. Trees with too few points to be measured are left out.
        candidates: (N,) points that masks of photos call trunk; they go before ids. None finds stems by their shape.
        ground: Where it is known already.
        progress: Called in between.

    Returns:
        The ground, the trunks and notes in plain words.
    """
    from dbh_studio.core.ground import fit_ground

    if ground is None:
        ground = fit_ground(points_world, settings=settings.ground, progress=subprogress(progress, 0.0, 0.4))
    notes = list(ground.notes)
    trunks, steps = TrunkSet(), None
    if candidates is None and existing_ids is not None and settings.trunks.use_existing_ids:
        trunks, remarks = trunks_from_ids(existing_ids, settings.measure.min_points)
        notes += remarks
    if not len(trunks):
        from dbh_studio.stages.segment import segment_trunks

        found = segment_trunks(
            points_world,
            ground,
            settings=settings.trunks,
            candidates=candidates,
            progress=subprogress(progress, 0.4, 1.0),
            seed=settings.measure.seed,
        )
        trunks = TrunkSet.from_point_sets(_in_order(found.point_sets, points_world))
        notes += found.notes
        steps = found.steps
    progress(1.0, "")
    return Segmentation(ground, trunks, tuple(notes), steps)


def _in_order(point_sets: Sequence[NDArray[Any]], points_world: Float32) -> list[NDArray[Any]]:
    """From west to east, then south to north, by the median position to the centimetre."""

    def position(points: NDArray[Any]) -> tuple[float, float, int]:
        x, y = np.round(np.median(points_world[points, :2], axis=0).astype(np.float64), 2)
        return float(x), float(y), int(points.min())

    return sorted((points for points in point_sets if len(points)), key=position)


def trunks_from_ids(ids: NDArray[Any], min_points: int) -> tuple[TrunkSet, list[str]]:
    """The trees the cloud's own ids tell apart, under these ids.

    Args:
        ids: (N,) tree id of every point.
        min_points: Trees with fewer are left out.

    Returns:
        The trees and notes in plain words.
    """
    from dbh_studio.core.treeids import point_sets_from_ids

    groups = point_sets_from_ids(ids)
    kept = [group for group in groups if len(group) >= min_points]
    notes = [f"{len(kept)} trees were taken over from the file's own tree ids."] if kept else []
    if len(groups) > len(kept):
        n_dropped = len(groups) - len(kept)
        notes.append(f"{n_dropped} trees of the file have fewer than {min_points} points and were left out.")
    if kept and int(ids[kept[-1][0]]) >= 2**31 - 1:
        notes.append("Their ids are too large, so they were numbered anew.")
        return TrunkSet.from_point_sets(kept, origin="file"), notes
    return TrunkSet(tuple(Trunk(int(ids[group[0]]), group.astype(np.int32), "file") for group in kept)), notes


def segmentation_call(session: Session, document: Document) -> tuple[Float32, Settings, NDArray[Any] | None]:
    """The arguments of `segment_plot` for a state of a plot.

    Raises:
        UnscaledCloudError: The scale is not known; says what to do.
    """
    from dbh_studio.core.treeids import find_tree_id_attribute

    session.require_scale(document)
    name = find_tree_id_attribute(session.cloud) if document.settings.trunks.use_existing_ids else None
    ids = session.cloud.attributes[name] if name is not None else None
    return session.points_world(document), document.settings, ids


def apply_segmentation(session: Session, document: Document, result: Segmentation) -> None:
    """Put the result of `segment_plot`, run for `document`, into the plot: one command.

    Raises:
        StaleResultError: What it was computed from has changed meanwhile.
    """
    session.remember_ground(document, result.ground)
    command, n_trunks = replace_trunks(result.trunks), len(result.trunks)
    apply_search(session, document, command, result.steps, n_trunks=n_trunks, reads=SEGMENTATION_READS)


def segment(
    session: Session,
    *,
    progress: Progress = ignore_progress,
    in_process: bool = False,
    ahead: CallAhead | None = None,
) -> tuple[str, ...]:
    """Find the trunks of a plot and wait for them; the notes. `ahead` may have begun with it, as in `plot_run`."""
    document = session.document
    call = segmentation_call(session, document)
    result: Segmentation
    if ahead is not None:
        result = ahead.call(segment_plot, *call, progress=progress)
    else:
        result = run_job(segment_plot, *call, progress=progress, in_process=in_process)
    apply_segmentation(session, document, result)
    return result.notes


# ---- measuring


def measure_stems(
    stems: Sequence[tuple[int, Float32, StemSetup]],
    ground: GroundModel,
    scale_sd: float = 0.0,
    curves: Sequence[str] | None = None,
    *,
    progress: Progress = ignore_progress,
) -> list[StemMeasurement]:
    """Measure many stems, given as (id, (K, 3) points_world, how). Pure and picklable, for a job.

    `curves` are fitted beside the chosen one.
    """
    from dbh_studio.stages.measure import measure_trunk

    def measure(stem: tuple[int, Float32, StemSetup]) -> StemMeasurement:
        trunk_id, points, setup = stem
        return measure_trunk(
            setup.measured(points),
            trunk_id=trunk_id,
            ground=ground,
            settings=setup.settings,
            scale_sd=scale_sd,
            curves=curves,
            **setup.placed,
        )

    measured: list[StemMeasurement] = []
    progress(0.0, "Measuring the stems")
    size = sum(len(points) for _, points, _ in stems) / max(len(stems), 1)
    for stem in map_in_threads(measure, stems, size=size):
        measured.append(stem)
        progress(len(measured) / len(stems), f"Measured {len(measured)} of {len(stems)} stems")
    progress(1.0, "")
    return measured


def ground_of(points_world: Float32, settings: GroundSettings, *, progress: Progress = ignore_progress) -> GroundModel:
    """The ground of a cloud. Pure and picklable, for a job; its result goes to ``session.remember_ground``."""
    from dbh_studio.core.ground import fit_ground

    return fit_ground(points_world, settings=settings, progress=progress)


def ground_call(session: Session, document: Document) -> tuple[Float32, GroundSettings]:
    """The arguments of `ground_of` for a state of a plot."""
    return session.points_world(document), document.settings.ground


def measurement_call(session: Session, document: Document) -> tuple[Any, ...]:
    """The arguments of `measure_stems` for the stems of a state that are not measured yet.

    Give the result to ``session.remember_measurements(document, result)``; it is right whatever happened meanwhile.
    """
    return _stems_call(session, document, session.unmeasured(document))


def comparison_call(session: Session, document: Document) -> tuple[Any, ...]:
    """The arguments of `measure_stems` for all stems of a state, with every other method beside the chosen one."""
    return *_stems_call(session, document, document.trunks.ids), get_args(CurveName)


def _stems_call(session: Session, document: Document, ids: Sequence[int]) -> tuple[Any, ...]:
    points_world = session.points_world(document)
    trunks = document.trunks
    stems = [(i, points_world[trunks[i].points], stem_setup_of(document, i)) for i in ids]
    return stems, session.ground(document=document), document.scale.relative_sd
