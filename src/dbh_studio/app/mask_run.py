"""The ladder taken: masks made or kept, as `dbh-studio run --masks auto` and `--masks stored` ask for them.

taken = take_ladder(session, LadderRequest())
taken.masks                                  # a `PlotMasks` to vote with, or None: geometry alone
taken.notes                                  # which rung, what it cost, and why not a higher one
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from dbh_studio.app.cameras import Cameras
from dbh_studio.app.ladder import look_at_ladder
from dbh_studio.app.mask_costs import duration
from dbh_studio.app.mask_making import masks_for_plot
from dbh_studio.app.mask_request import LadderRequest
from dbh_studio.app.photo_scale import PhotoRequest, add_photos
from dbh_studio.app.plot_masks import PlotMasks, plot_masks
from dbh_studio.core.mask_record import MaskRung
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.errors import CommandError, FileError

if TYPE_CHECKING:
    from dbh_studio.app.session import Session
    from dbh_studio.io.models import ModelStore


@dataclass(frozen=True, eq=False)
class TakenRung:
    """What `take_ladder` took.

    Attributes:
        rung: Which.
        masks: Those that vote; None where geometry is to find the trunks.
        notes: What the person should know: which rung was taken, why not a higher one, and what was made.
    """

    rung: MaskRung
    masks: PlotMasks | None
    notes: tuple[str, ...]


def take_ladder(
    session: Session,
    request: LadderRequest = LadderRequest(),  # noqa: B008 - frozen
    *,
    models: ModelStore | None = None,
    in_process: bool = True,
    progress: Progress = ignore_progress,
) -> TakenRung:
    """Choose the rung, make the masks it needs, and say so.

    Args:
        session: A plot with a scale.
        request: What is asked for.
        models: Where the models are; None: the user's cache.
        in_process: Work here rather than in a child process.
        progress: Called in between.

    Raises:
        UnscaledCloudError: The plot has no scale.
        CommandError: No mask is kept (``stored``), or the photos that were named do not belong to the cloud.
        FileError: The reconstruction that was named cannot be read, or masks cannot be stored.
        ModelError: The rung asked for is not available, or a model failed.
        CancelledError: From `progress`; masks made until then are kept.
    """
    session.require_scale()
    part = subprogress(progress, 0.0, 0.05)
    if request.source == "stored":
        cameras = _photos(session, request, in_process=in_process, progress=part)
        kept = plot_masks(session, cameras.posed)
        if not len(kept):
            remedy = "`dbh-studio masks make` makes them; masks made elsewhere are brought by --masks PATH."
            raise CommandError(" ".join(["No kept mask can vote for this plot.", *kept.notes[1:]]), remedy)
        return TakenRung(kept.record().rung, kept, kept.notes)
    known, why = _photos_if_any(session, request, in_process=in_process, progress=part)
    wanted = request.make.rung
    ladder = look_at_ladder(session, cameras=known, models=models, request=request.make, wanted=wanted)
    notes = [*ladder.announcement, *([why] if why else [])]
    if ladder.chosen == "geometry" or known is None:
        return TakenRung("geometry", None, tuple(notes))
    if ladder.taken.can_make and ladder.chosen in ("detector", "prompted"):
        made = masks_for_plot(
            session,
            request.make,
            cameras=known,
            models=models,
            in_process=in_process,
            progress=subprogress(progress, 0.05, 1.0),
        )
        pace = "" if made.seconds_per_photo is None else f", {duration(made.seconds_per_photo)} each"
        notes += [f"Masks made: {made.n_made:,}{pace}; there before: {made.n_kept:,}.", *made.notes]
        notes += list(made.problems.values())
    kept = plot_masks(session, known.posed)
    return TakenRung(ladder.chosen, kept if len(kept) else None, (*notes, *kept.notes))


def _photos(session: Session, request: LadderRequest, *, in_process: bool, progress: Progress) -> Cameras:
    """The photos of the plot, read where they are not known; those read for the scale just now are not read again."""
    known, before = session.cameras, session.document.cameras
    if known is not None and before is not None:
        asked = (request.cameras or before.path).absolute(), request.images_dir or before.images_dir
        if asked[0] == before.path and (asked[1] is None or asked[1].absolute() == before.images_dir):
            return known
    return add_photos(
        session, PhotoRequest(request.cameras, request.images_dir), in_process=in_process, progress=progress
    )


def _photos_if_any(
    session: Session, request: LadderRequest, *, in_process: bool, progress: Progress
) -> tuple[Cameras | None, str]:
    """The photos, and why there are none: only those a person named, now or earlier, must be there."""
    try:
        return _photos(session, request, in_process=in_process, progress=progress), ""
    except (FileError, CommandError) as error:
        is_named = request.cameras is not None or session.document.cameras is not None
        if is_named or request.make.rung != "auto":
            raise
        return None, f"Photos were looked for: {error}"
