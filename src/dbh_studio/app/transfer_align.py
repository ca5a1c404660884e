"""Which way two clouds are laid on each other: by the walks, by the stems where those do not tell, or not at all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.app import commands, pipeline
from dbh_studio.app.session import Session
from dbh_studio.app.transfer_walks import walk_of
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import AlignmentError, CommandError

if TYPE_CHECKING:
    from dbh_studio.app.transfer_plot import TransferRequest
    from dbh_studio.core.dbh import Refusal
    from dbh_studio.core.trajectories import Trajectory
    from dbh_studio.stages.transfer import Alignment, Survey

# Verticals so far apart are told of; so far, one of them is wrong, and heights above ground mean nothing.
_TILTED_DEG, _WRONG_UP_DEG = 5.0, 20.0
# Of a straight walk: stems that must come to stand on stems before it is believed.
_LEAST_STEMS = 3
_LEAST_STEMS_SHARE = 0.5
_APART = (
    "Look whether both clouds are of one plot, and whether each trajectory is in the frame of its cloud and on a "
    "clock in seconds."
)


@dataclass(frozen=True, eq=False)
class Laid:
    """The photo plot on the LiDAR plot.

    Attributes:
        alignment: From the photo plot's world to the LiDAR plot's.
        error_m: Standard error at the trunks, where it rests on the walks alone; NaN otherwise.
        notes: What the person should know.
    """

    alignment: Alignment
    error_m: float
    notes: tuple[str, ...]


def lay_plots(
    photo: Session, lidar: Session, request: TransferRequest, *, progress: Progress = ignore_progress
) -> Laid:
    """Lay a photo plot on a LiDAR plot.

    A photo plot without a scale gets the LiDAR's in memory, and one without trunks gets trunks: the stems cannot be
    compared without. What is saved of it stays as it is.

    Raises:
        AlignmentError: It cannot be done; says why and what helps.
        StudioError: A trajectory cannot be read.
    """
    from dbh_studio.core.dbh import Refusal

    progress(0.0, "Comparing the walks")
    camera = walk_of(photo, request.photo_walk, whose="camera", option="photo", progress=progress)
    scanner = walk_of(lidar, request.lidar_walk, whose="scanner", option="lidar", progress=progress)
    notes = (*camera.notes, *scanner.notes)
    found: Alignment | Refusal | None = None
    if camera.walk is not None and scanner.walk is not None:
        found, must_confirm = _by_walks(camera.walk, scanner.walk, photo, request)
    else:
        must_confirm = False
        notes += (f"The walks were not compared: {camera.why_not or scanner.why_not}.",)
    progress(0.2, "Comparing the walks")
    alignment = None if found is None or isinstance(found, Refusal) else found
    if not photo.document.scale.is_known:
        alignment = _scaled(photo, alignment, found, notes)
    if not len(photo.document.trunks):
        notes += pipeline.segment(photo, progress=subprogress(progress, 0.2, 0.4), in_process=True)
        if not len(photo.document.trunks):
            raise CommandError("No trunks were found in the photo plot.", "Find them in the studio first.")
    surveys = _Surveys(photo, lidar, subprogress(progress, 0.4, 0.8))
    finish = subprogress(progress, 0.8, 1.0)
    if alignment is not None and must_confirm:
        alignment, found = _confirmed(alignment, surveys, request, finish)
    elif alignment is not None and request.refine:
        alignment = _refined(alignment, surveys, request, finish)
    if alignment is None:
        alignment = _by_stems(surveys, request, found, finish)
        why = getattr(found, "reason", "")
        notes += (f"{why} The stems were taken instead.",) if why else ()
    return _laid(alignment, photo, request, notes)


def _by_walks(
    camera: Trajectory, scanner: Trajectory, photo: Session, request: TransferRequest
) -> tuple[Alignment | Refusal, bool]:
    """By the walks, and whether stems and ground must confirm it: for a straight walk the verticals stand in."""
    from dbh_studio.core.dbh import Refusal
    from dbh_studio.stages.transfer import align_by_trajectories

    if not request.with_scale and not photo.document.scale.is_known:
        raise CommandError(
            "The photo plot has no scale, so a rigid fit would be a guess.", "Let the scale be fitted (--similarity)."
        )
    lay = partial(
        align_by_trajectories, camera, scanner, with_scale=request.with_scale, offset_s=request.clock_offset_s
    )
    found = lay()
    if not isinstance(found, Refusal) or found.code != "straight":
        return found, False
    upright = lay(upright=True)
    if isinstance(upright, Refusal):
        return found, False
    note = (
        "The walk went in one straight line, so the turn about it came from the verticals of both clouds; stems and "
        "ground confirm it."
    )
    return replace(upright, notes=(*upright.notes, note)), True


def _scaled(
    photo: Session, alignment: Alignment | None, found: Alignment | Refusal | None, notes: tuple[str, ...]
) -> Alignment:
    """Give the photo plot the scale of the walks; the alignment from its new world."""
    if alignment is None:
        why = getattr(found, "reason", "") or (notes[-1] if notes else "")
        raise AlignmentError(
            f"The photo plot has no scale, so its stems cannot be looked for, and the walks give none. {why}".strip(),
            getattr(found, "remedy", "") or "Give both trajectories, or set a rough scale first.",
        )
    scale = alignment.target_from_source.scale
    photo.do(commands.set_scale(ScaleEstimate(scale, "lidar")))
    smaller = Similarity(np.eye(3), np.zeros(3), 1.0 / scale)
    return replace(alignment, target_from_source=alignment.target_from_source @ smaller)


class _Surveys:
    """Stems and ground of both plots, gathered when they are asked for: finding the LiDAR's stems takes longest."""

    def __init__(self, photo: Session, lidar: Session, progress: Progress) -> None:
        self._photo, self._lidar, self._progress = photo, lidar, progress
        self._made: tuple[Survey, Survey] | None = None

    def __call__(self) -> tuple[Survey, Survey]:
        if self._made is None:
            from dbh_studio.stages.transfer import survey, survey_of_stems

            photo, lidar, progress = self._photo, self._lidar, self._progress
            trunks = photo.document.trunks
            stems = [(trunks[stem.trunk_id].points, stem) for stem in photo.measurements(progress)]
            source = survey_of_stems(photo.points_world(), stems, photo.ground())
            points, ground = lidar.points_world(), lidar.ground()
            settings = photo.document.settings.trunks
            self._made = source, survey(points, ground, settings=settings, progress=progress)
        return self._made


def _confirmed(
    alignment: Alignment, surveys: Callable[[], tuple[Survey, Survey]], request: TransferRequest, progress: Progress
) -> tuple[Alignment | None, Refusal | None]:
    """The alignment of a straight walk after refinement, where stems come to stand on stems; else why not."""
    from dbh_studio.core.dbh import Refusal
    from dbh_studio.stages.transfer import refined, stems_together

    source, target = surveys()
    better = refined(alignment, source, target, with_scale=request.with_scale, progress=progress)
    if not isinstance(better, Refusal):
        n = stems_together(source, target, better.target_from_source)
        if n >= max(_LEAST_STEMS, _LEAST_STEMS_SHARE * min(len(source.xy_m), len(target.xy_m))):
            return _with_scale_error(better, source, target, request), None
        reason = f"only {n} of {len(source.xy_m)} stems then stand on a stem of the LiDAR cloud"
    else:
        reason = better.reason
    return None, Refusal(
        "straight",
        f"The walk went in one straight line, so the turn about it is open; with the verticals of both clouds: "
        f"{reason.rstrip('.')}.",
        "Walk a loop or a bend next time; check the up directions of both plots.",
    )


def _refined(
    alignment: Alignment, surveys: Callable[[], tuple[Survey, Survey]], request: TransferRequest, progress: Progress
) -> Alignment:
    from dbh_studio.core.dbh import Refusal
    from dbh_studio.stages.transfer import refined

    source, target = surveys()
    better = refined(alignment, source, target, with_scale=request.with_scale, progress=progress)
    if isinstance(better, Refusal):
        raise AlignmentError(better.reason, _APART)
    return _with_scale_error(better, source, target, request)


def _with_scale_error(alignment: Alignment, source: Survey, target: Survey, request: TransferRequest) -> Alignment:
    from dbh_studio.stages.transfer import scale_error_of_surfaces

    if not request.with_scale:
        return alignment
    return replace(alignment, scale_error=scale_error_of_surfaces(source, target, alignment))


def _by_stems(
    surveys: Callable[[], tuple[Survey, Survey]],
    request: TransferRequest,
    walks: Alignment | Refusal | None,
    progress: Progress,
) -> Alignment:
    """By the stems alone: first with the scale the photo plot has, then with a free one."""
    from dbh_studio.core.dbh import Refusal
    from dbh_studio.stages.transfer import align_by_stems

    source, target = surveys()
    found = align_by_stems(source, target, scale=1.0, with_refinement=False)
    if isinstance(found, Refusal) and request.with_scale:
        found = align_by_stems(source, target, scale=None, with_refinement=False)
    if isinstance(found, Refusal):
        first = getattr(walks, "reason", "")
        remedy = getattr(walks, "remedy", "") or "Give the trajectories of both sensors."
        raise AlignmentError(f"{first} {found.reason}".strip(), remedy)
    better = _refined(found, lambda: (source, target), request, progress)
    n, rival = found.n_pairs, found.rival_pairs
    other = f"the next best way brings {rival} together" if rival else "no other way fits"
    sure = f"{n} of {len(source.xy_m)} stems stand on one of the LiDAR's {len(target.xy_m)}; {other}."
    return replace(better, notes=(*better.notes, sure))


def _laid(alignment: Alignment, photo: Session, request: TransferRequest, notes: tuple[str, ...]) -> Laid:
    document = photo.document
    tilt = np.degrees(np.arccos(np.clip(alignment.target_from_source.rotation[2, 2], -1.0, 1.0)))
    notes = (*notes, *alignment.notes)
    if tilt > _WRONG_UP_DEG:
        raise AlignmentError(
            f"The verticals of the two clouds are {tilt:.0f}° apart, so one of them is wrong.",
            "Set the up direction of the photo plot, or that of the LiDAR file (--lidar-up).",
        )
    if tilt > _TILTED_DEG:
        notes += (f"The verticals of the two clouds are {tilt:.1f}° apart: look at the up direction of both plots.",)
    error_m = float("nan")
    if alignment.walk is not None and not np.isfinite(alignment.surface_rms_m):
        points = photo.points_world()
        feet = np.array([points[trunk.points].mean(axis=0) for trunk in document.trunks], np.float64)
        scale = alignment.target_from_source.scale / alignment.walk.target_from_source.scale
        # The walks were compared before the photo plot had a scale: its world has grown by it since.
        error_m = alignment.walk.error_at(feet * scale)
        if request.with_scale and error_m > 0.5 * request.reach_m:
            notes += (
                f"At the trunks the walks are only sure to {100 * error_m:.0f} cm: fit stems and ground on each other "
                "too (--refine).",
            )
    return Laid(alignment, error_m, notes)
