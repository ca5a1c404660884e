"""Trunks from the masks of photos: the rung of the ladder between models that find them and geometry alone.

    masks = read_masks(request, cameras.posed)
    result = find_image_trunks(*image_trunks_call(session, document, cameras, masks, request.votes), progress=…)
    apply_image_trunks(session, document, result)

or all of it by `trunks_from_masks`. `find_image_trunks` is pure and picklable, for a job.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from dbh_studio.app.brought_masks import MaskReader, MaskRequest, MaskSet, VotingMasks, read_masks
from dbh_studio.app.cameras import Cameras, cameras_of
from dbh_studio.app.candidates import accept_all, offering
from dbh_studio.app.commands import replace_trunks
from dbh_studio.app.document import CameraSource, Document
from dbh_studio.app.jobs import Job, run_job
from dbh_studio.app.last_search import apply_search
from dbh_studio.app.photo_scale import PhotoRequest, add_photos
from dbh_studio.app.pipeline import SEGMENTATION_READS, segment_plot, segmentation_call
from dbh_studio.app.session import Session
from dbh_studio.app.threads import map_in_threads
from dbh_studio.app.vote_cache import keep_votes, record_of
from dbh_studio.core.arrays import Float32
from dbh_studio.core.mask_record import MaskRecord
from dbh_studio.core.posed_images import PosedImages
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.transforms import Similarity
from dbh_studio.core.trunks import TrunkSet
from dbh_studio.settings import Settings, VoteSettings

if TYPE_CHECKING:
    from dbh_studio.core.candidates import CandidateTrunk
    from dbh_studio.core.chain_steps import ChainSteps
    from dbh_studio.core.ground import GroundModel
    from dbh_studio.core.votes import Votes

Rung = Literal["masks", "geometry"]

# What trunks from masks depend on, beside what those from geometry do.
IMAGE_TRUNK_READS = (*SEGMENTATION_READS, "cameras")

_NEARLY_ALL = 0.95
_ONLY_IGNORED = "the masks say what to ignore, not what is trunk"
_NO_CANDIDATE = (
    "no point of the cloud got enough votes of the masks. Look whether masks, poses and cloud belong together"
)


@dataclass(frozen=True, eq=False)
class ImageTrunks:
    """What masks and cloud gave.

    Attributes:
        ground: The ground.
        trunks: Numbered from west to east.
        notes: What the person should know, in plain words; the first says which rung of the ladder was used.
        rung: ``masks``, or ``geometry`` where the masks could not find trunks.
        n_masks: Masks that voted.
        votes: (N,) of every point, to colour the cloud by; None where no mask was asked.
        candidates: Where masks and shape disagree so much that a person should say, from west to east.
        flags: Trunk id -> what masks and geometry disagree about.
        steps: What the chain did with every point and cluster; None where no mask was asked.
        record: What is saved of the masks the trunks came from; None where they came from geometry.
    """

    ground: GroundModel
    trunks: TrunkSet
    notes: tuple[str, ...]
    rung: Rung
    n_masks: int = 0
    votes: Votes | None = None
    candidates: tuple[CandidateTrunk, ...] = ()
    flags: Mapping[int, str] = field(default_factory=dict)
    steps: ChainSteps | None = None
    record: MaskRecord | None = None


def find_image_trunks(
    points_world: Float32,
    settings: Settings,
    existing_ids: NDArray[Any] | None,
    posed_world: PosedImages,
    masks: VotingMasks,
    votes: VoteSettings = VoteSettings(),  # noqa: B008 - frozen
    *,
    progress: Progress = ignore_progress,
) -> ImageTrunks:
    """Find the ground, let the masks vote, and find the trunks. Pure and picklable, for a job.

    Where the masks only say what to ignore, or no point gets enough votes, the trunks are found as without masks; the
    first note says so.

    Args:
        points_world: (N, 3) points, metres, +z up.
        settings: Of the ground and the trunks.
        existing_ids: (N,) tree ids the cloud carries, or None; only used without the masks.
        posed_world: The photos, in the frame of the points; see `photos_in_world`.
        masks: From `brought_masks.read_masks`.
        votes: What hides a point and how many votes make it trunk.
        progress: Called after each photo, and in between.

    Raises:
        FileError: None of the masks can be read.
        CancelledError: From `progress`.
    """
    from dbh_studio.core.ground import fit_ground
    from dbh_studio.core.instances import InstanceGatherer
    from dbh_studio.stages.mask_trunks import trunks_from_votes
    from dbh_studio.stages.vote import make_voters, vote

    if not masks.finds_trunks:
        return _by_geometry(points_world, settings, existing_ids, _ONLY_IGNORED, progress=progress)
    ground = fit_ground(points_world, settings=settings.ground, progress=subprogress(progress, 0.0, 0.1))
    reader = MaskReader(masks, votes.edge_px)
    voters = make_voters(
        points_world,
        posed_world,
        ground=ground,
        settings=votes,
        trunks=settings.trunks,
        progress=subprogress(progress, 0.1, 0.2),
    )
    gatherer = InstanceGatherer(voters.points.xyz)
    # Reading a picture silences warnings for a moment, and two threads at once may leave them silent: undone here.
    with warnings.catch_warnings():
        of_voters = vote(
            voters,
            posed_world,
            reader,
            settings=votes,
            on_photo=lambda _, photo: gatherer.add(photo),
            map_photos=map_in_threads,
            progress=subprogress(progress, 0.2, 0.7),
        )
    if not reader.n_read and reader.problems:
        raise min(reader.problems.items())[1]
    counted = of_voters.carried_back(voters.thinned, voters.rows, voters.n_points)
    candidates = counted.is_trunk(votes)
    about = (*reader.notes(), _vote_note(counted, candidates, votes))
    rest = subprogress(progress, 0.7, 1.0)
    if not candidates.any():
        by_shape = _by_geometry(points_world, settings, existing_ids, _NO_CANDIDATE, ground=ground, progress=rest)
        return replace(by_shape, notes=(*by_shape.notes, *about), n_masks=reader.n_read, votes=counted)
    found = trunks_from_votes(
        points_world,
        ground,
        voters,
        of_voters,
        gatherer,
        trunks=settings.trunks,
        settings=votes,
        progress=rest,
        seed=settings.measure.seed,
    )
    progress(1.0, "")
    first = f"Trunks from {reader.n_read:,} {'mask' if reader.n_read == 1 else 'masks'}."
    return ImageTrunks(
        ground,
        TrunkSet.from_point_sets(found.point_sets, origin="masks"),
        (first, *about, *ground.notes, *found.notes),
        "masks",
        reader.n_read,
        counted,
        found.candidates,
        {index + 1: text for index, text in found.flags.items()},
        found.steps,
        record_of(masks, reader.n_read, votes),
    )


def _by_geometry(
    points_world: Float32,
    settings: Settings,
    existing_ids: NDArray[Any] | None,
    why: str,
    *,
    ground: GroundModel | None = None,
    progress: Progress,
) -> ImageTrunks:
    found = segment_plot(points_world, settings, existing_ids, ground=ground, progress=progress)
    notes = (f"Trunks by geometry alone, because {why}.", *found.notes)
    return ImageTrunks(found.ground, found.trunks, notes, "geometry", steps=found.steps)


def _vote_note(votes: Votes, candidates: NDArray[np.bool_], settings: VoteSettings) -> str:
    n_seen, n_trunk = int(np.count_nonzero(votes.n_seen)), int(np.count_nonzero(candidates))
    rule = f"at least {settings.min_count} {'photo calls' if settings.min_count == 1 else 'photos call'} it trunk"
    if settings.rule == "share":
        rule += f", and {100 * settings.min_share:.0f} % of those that see it"
    hidden = "" if settings.occlusion else "; points behind others vote too"
    doubt = " That is nearly all there is: ask for more votes." if n_trunk > _NEARLY_ALL * n_seen else ""
    return (
        f"{n_seen:,} points between ground and trunk top are in view of the masks, {n_trunk:,} of them are trunk "
        f"({rule}{hidden}).{doubt}"
    )


# ---- a plot


def photos_in_world(session: Session, document: Document, posed: PosedImages) -> PosedImages:
    """The photos, from the cloud's frame (absolute source coordinates) to metres with z up."""
    about_origin = Similarity(np.eye(3), -session.cloud.origin)
    return posed.moved(document.world_from_source @ about_origin)


def image_trunks_call(
    session: Session,
    document: Document,
    cameras: Cameras,
    masks: VotingMasks,
    votes: VoteSettings = VoteSettings(),  # noqa: B008 - frozen
) -> tuple[Any, ...]:
    """The arguments of `find_image_trunks` for a state of a plot.

    Raises:
        UnscaledCloudError: The scale is not known; says what to do.
    """
    points_world, settings, ids = segmentation_call(session, document)
    return points_world, settings, ids, photos_in_world(session, document, cameras.posed), masks, votes


def apply_image_trunks(session: Session, document: Document, result: ImageTrunks) -> None:
    """Put the result of `find_image_trunks`, run for `document`, into the plot: one command.

    Raises:
        StaleResultError: What it was computed from has changed meanwhile.
    """
    session.remember_ground(document, result.ground)
    label = f"Find {len(result.trunks)} trunks"
    label += f" from {result.n_masks} masks" if result.rung == "masks" else ""
    n_trunks = len(result.trunks)
    command = replace_trunks(result.trunks, label=label, masks=result.record, flags=result.flags)
    with offering(session, document, result.candidates):
        apply_search(session, document, command, result.steps, n_trunks=n_trunks, reads=IMAGE_TRUNK_READS)
    if result.votes is not None and result.record is not None:
        keep_votes(session, result.votes)


def masks_of_plot(
    session: Session, request: MaskRequest, *, in_process: bool = True, progress: Progress = ignore_progress
) -> MaskSet:
    """The photos of the plot, read and kept where it has none yet, and their masks; nothing is searched yet.

    Raises:
        FileError: Photos or masks are missing or cannot be read.
        SettingError: What the masks mean is unclear; says how to say it.
        CommandError: The photos do not belong to the cloud.
    """
    cameras = _cameras(session, request, in_process=in_process, progress=subprogress(progress, 0.0, 0.5))
    masks = read_masks(request, cameras.posed, progress=subprogress(progress, 0.5, 1.0))
    if cameras.fit.status == "fits":
        return masks
    return replace(masks, notes=(cameras.fit.message, *masks.notes))


def trunks_from_masks(
    session: Session,
    masks: VotingMasks,
    votes: VoteSettings = VoteSettings(),  # noqa: B008 - frozen
    *,
    accept_candidates: bool = False,
    in_process: bool = True,
    progress: Progress = ignore_progress,
    started: Callable[[Job], object] | None = None,
) -> ImageTrunks:
    """Find the trunks of a plot by masks and wait for them; they are in the plot, as one command.

    Args:
        session: A plot that has photos; see `masks_of_plot`.
        masks: Theirs.
        votes: What hides a point and how many votes make it trunk.
        accept_candidates: Take stems that only geometry sees as trunks, too: flagged, as a second command.
        in_process: Work here rather than in a child process.
        progress: Called in between; cancels by raising `CancelledError`.
        started: Given the job, so that another thread can cancel it.

    Raises:
        StudioError: As `find_image_trunks`, `image_trunks_call` and `apply_image_trunks`.
    """
    cameras = cameras_of(session)
    assert cameras is not None, "the plot has no photos"
    document = session.document
    call = image_trunks_call(session, document, cameras, masks, votes)
    result: ImageTrunks = run_job(find_image_trunks, *call, in_process=in_process, progress=progress, started=started)
    apply_image_trunks(session, document, result)
    if accept_candidates and (n_taken := accept_all(session)):
        what = "1 candidate was" if n_taken == 1 else f"{n_taken:,} candidates were"
        result = replace(result, notes=(*result.notes, f"{what} taken as trunks, and flagged."))
    return result


def _cameras(session: Session, request: MaskRequest, *, in_process: bool, progress: Progress) -> Cameras:
    """As `add_photos`, but what was read for the scale just now is not read again."""
    known = session.cameras
    if known is not None and request.cameras is not None:
        wanted = CameraSource.of(request.cameras, request.images_dir)
        if (wanted.path, wanted.images_dir) == (known.source.path, known.source.images_dir):
            return known
    return add_photos(
        session, PhotoRequest(request.cameras, request.images_dir), in_process=in_process, progress=progress
    )
