"""Work on masks that takes time, as jobs of the studio: looking at brought ones, making some, finding trunks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from dbh_studio.app.brought_masks import MaskSet, find_brought_masks
from dbh_studio.app.cameras import require_fit
from dbh_studio.app.image_trunks import ImageTrunks, apply_image_trunks, find_image_trunks, image_trunks_call
from dbh_studio.app.mask_making import MadeMasks, make_masks
from dbh_studio.app.mask_overlay import overlay_picture
from dbh_studio.app.mask_plan import MaskPlan, plan_masks
from dbh_studio.app.mask_request import MakeRequest, MaskRequest
from dbh_studio.app.plot_masks import copy_brought, masks_folder, plot_masks
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.errors import FileError, StudioError
from dbh_studio.settings import VoteSettings
from dbh_studio.ui.mask_html import WORDS, in_the_studio
from dbh_studio.ui.panel_words import errors_reworded
from dbh_studio.ui.photo_render import jpeg_url

if TYPE_CHECKING:
    from dbh_studio.app.cameras import Cameras
    from dbh_studio.app.jobs import Job
    from dbh_studio.app.session import Session
    from dbh_studio.core.posed_images import PosedImages
    from dbh_studio.io.masks import MaskMeaning
    from dbh_studio.ui.studio import Studio

_PICTURE_PX = 900


@dataclass(frozen=True, eq=False)
class MaskLook:
    """Masks a person brings, looked at and not used yet.

    Attributes:
        request: As asked for.
        masks: What was found.
        photo: The photo of the picture; empty where none can be drawn.
        picture: It, with its mask over it, as a ``data:`` address.
        notes: Why there is no picture.
    """

    request: MaskRequest
    masks: MaskSet
    photo: str = ""
    picture: str = ""
    notes: tuple[str, ...] = ()

    @property
    def may_confirm(self) -> bool:
        """Whether they can be used as they are shown: where only their meaning is in doubt, by a person's word."""
        masks = self.masks
        return masks.finds_trunks and (not masks.unclear or (self.request.meaning is None and masks.coco is None))


def look_at_brought(request: MaskRequest, posed: PosedImages, *, progress: Progress = ignore_progress) -> MaskLook:
    """Find the masks and draw one; for a job.

    Raises:
        StudioError: As `find_brought_masks`, in the words of the panel.
    """
    import cv2

    with errors_reworded(WORDS):
        masks = find_brought_masks(request, posed, progress=subprogress(progress, 0.0, 0.6))
    progress(0.7, "Drawing one of them")
    try:
        photo, picture = overlay_picture(masks, posed)
    except FileError as error:
        return MaskLook(request, masks, notes=(in_the_studio(str(error)),))
    scale = _PICTURE_PX / max(picture.shape[:2])
    if scale < 1.0:
        size = (round(picture.shape[1] * scale), round(picture.shape[0] * scale))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    return MaskLook(request, masks, photo, jpeg_url(picture))


class MaskJobs:
    """Starts them, and keeps what they left for the person to read. Shared by all tabs.

    Attributes:
        look: Masks that were looked at and are to be confirmed; None where there are none.
        said: How the last making of masks ended, in plain words.
        undone: How many masks were made of how many, where it was stopped; None otherwise.
        votes_for: The settings of the last voting.
    """

    def __init__(self, studio: Studio) -> None:
        self.look: MaskLook | None = None
        self.said: tuple[str, ...] = ()
        self.undone: tuple[int, int] | None = None
        self._studio = studio

    def plot_opened(self) -> None:
        """Forget what was about another plot."""
        self.look, self.said, self.undone = None, (), None

    # ---- brought

    def look_at(self, request: MaskRequest, *, then_use: bool = False) -> None:
        """Look at masks a person names; what they mean is asked before they are used.

        Args:
            request: Which.
            then_use: Use them where nothing is unclear any more.

        Raises:
            StudioError: There are no photos, they do not belong to the cloud, or another job runs.
        """
        session, cameras = self._plot()

        def done(look: MaskLook) -> None:
            self.look = look
            self._studio.refresh_tabs()
            if then_use and not look.masks.unclear and look.masks.finds_trunks:
                self.use_brought()

        self._studio.start_job("Looking at the masks", look_at_brought, (request, cameras.posed), session, done)

    def use_brought(self) -> None:
        """Copy the masks that were looked at beside the plot: there they are looked through and painted."""
        session, cameras = self._plot()
        look = self.look
        if look is None:
            return
        if not look.may_confirm:
            raise StudioError("What these masks mean is not clear yet.", "Choose what they mean.")
        if look.masks.unclear:  # the person says that they mean what they look like
            self.look_at(replace(look.request, meaning=look.masks.meaning), then_use=True)
            return
        desk = self._studio.masks
        desk.check_writable()
        desk.save()

        def done(problems: tuple[str, ...]) -> None:
            self.look, self.said = None, problems
            self._written()

        call = (masks_folder(session), look.masks, cameras.posed)
        self._write("Copying the masks beside the plot", copy_brought, call, session, done)

    def give_up(self) -> None:
        """Do not use the masks that were looked at."""
        self.look = None
        self._studio.refresh_tabs()

    # ---- made

    def make(self, request: MakeRequest) -> None:
        """Choose photos, then make their masks, each kept as soon as it is done.

        Raises:
            StudioError: There are no photos, or another job runs.
        """
        session, _ = self._plot()
        desk = self._studio.masks
        desk.check_writable()
        desk.save()

        def plan(progress: Progress, started: Callable[[Job], object]) -> MaskPlan:
            return plan_masks(
                session, request, models=desk.models, in_process=False, progress=progress, started=started
            )

        self._studio.start_work("Choosing photos for masks", plan, session, partial(self._make, session))

    def _make(self, session: Session, plan: MaskPlan) -> None:
        n_before = plan.n_kept

        def done(made: MadeMasks) -> None:
            self.undone = None
            self.said = _made_notes(made)
            self._written()

        if not plan.photos:
            self.undone, self.said = None, (plan.sentence,)
            self._studio.refresh_tabs()
            return
        self.said = (plan.sentence, *plan.notes)
        total = n_before + len(plan.photos)

        def failed(error: StudioError) -> None:
            kept = sum(state.has_mask for state in self._studio.masks.states().values())
            self.undone = (kept, max(total, kept))

        self._write("Making masks", make_masks, (plan,), session, done, failed=failed)

    # ---- trunks

    def find_trunks(self, votes: VoteSettings) -> None:
        """Let the kept masks vote and find the trunks: one undoable command.

        Raises:
            StudioError: There are no photos or masks, the plot has no scale, or another job runs.
        """
        session, cameras = self._plot()
        self._studio.masks.save()
        masks = plot_masks(session, cameras.posed)
        if not len(masks):
            raise StudioError("No mask votes.", "Make masks, bring some, or accept rejected ones again.")
        document = session.document
        call = image_trunks_call(session, document, cameras, masks, votes)

        def done(result: ImageTrunks) -> None:
            studio = self._studio
            before, studio.segmentation_notes = studio.segmentation_notes, (*result.notes, *masks.notes)
            studio.masks.votes_counted(session, result)
            try:
                apply_image_trunks(session, document, result)
            except StudioError:
                studio.segmentation_notes = before
                raise
            studio.refresh_tabs()

        self._studio.start_job(
            "Finding trunks from the masks",
            find_image_trunks,
            call,
            session,
            done,
            failed=lambda _: self._studio.measure_missing(),
        )

    # ---- common

    def _plot(self) -> tuple[Session, Cameras]:
        session = self._studio.session
        if session is None:
            raise StudioError("No plot is open.", "Open one in step 1.")
        if session.cameras is None:
            raise StudioError("This plot has no photos yet.", "Add them in step 2.")
        require_fit(session.cameras)
        return session, session.cameras

    def _write(
        self,
        title: str,
        function: Callable[..., Any],
        call: tuple[Any, ...],
        session: Session,
        done: Callable[[Any], None],
        *,
        failed: Callable[[StudioError], object] = lambda _: None,
    ) -> None:
        """Start a job that writes masks: meanwhile nobody else may."""
        desk = self._studio.masks

        def ended(result: Any) -> None:
            desk.forget()  # before anybody may paint: on what was there before, it would replace what was written
            desk.set_writing(False)
            done(result)

        def stopped(error: StudioError) -> None:
            if session is not self._studio.session:  # another plot is open: its masks are none of this job's business
                return
            desk.forget()
            desk.set_writing(False)
            failed(error)
            self._written()

        desk.set_writing(True)
        try:
            self._studio.start_job(
                title, function, call, session, ended, failed=stopped, if_stopped="what was made until then is kept."
            )
        except BaseException:
            desk.set_writing(False)
            raise

    def _written(self) -> None:
        self._studio.masks.forget()
        self._studio.refresh_tabs()


def _made_notes(made: MadeMasks) -> tuple[str, ...]:
    first = f"Masks made: {made.n_made:,}, outlines of trunks in them: {made.n_trunks:,}."
    problems = [f"{name} was left out: {why}" for name, why in sorted(made.problems.items())[:3]]
    if len(made.problems) > len(problems):
        problems.append(f"{len(made.problems) - len(problems):,} more photos were left out.")
    return (first, *problems, *made.notes)


def with_meaning(request: MaskRequest, meaning: MaskMeaning | None, categories: tuple[str, ...] = ()) -> MaskRequest:
    """The same masks, meant otherwise; None leaves it to what they look like."""
    return replace(request, meaning=meaning, categories=categories)
