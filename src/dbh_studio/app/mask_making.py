"""Making masks of a plot's photos: which photos, with which models, and then one after the other, safely.

    plan = plan_masks(session, MakeRequest(keyframes="auto"))
    print(plan.sentence)                        # "40 of 200 photos, about 55 min on this computer, …"
    made = run_job(make_masks, plan, progress=…, started=…)

or both by `masks_for_plot`. Each mask is on the disk before the next one is begun, so that a cancelled, killed or full
computer loses one photo at most, and the next plan is what is left. `make_masks` is pure and picklable, for a job.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from dbh_studio.app.cameras import Cameras
from dbh_studio.app.jobs import Job, run_job
from dbh_studio.app.mask_costs import duration, remember_speed, views_of
from dbh_studio.app.mask_plan import MaskPlan, keyframes_of, plan_masks
from dbh_studio.app.mask_request import KeyframeChoice, MakeRequest, MakingRung
from dbh_studio.app.session import Session
from dbh_studio.core.arrays import UInt8
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.errors import CommandError, FileError, ProjectLockedError

if TYPE_CHECKING:
    from dbh_studio.io.masks import TrunkMask
    from dbh_studio.io.models import ModelStore
    from dbh_studio.stages.mask_models import GroundedSam

__all__ = [
    "KeyframeChoice",
    "MadeMasks",
    "MakeRequest",
    "MaskPlan",
    "keyframes_of",
    "make_masks",
    "masks_for_plot",
    "plan_masks",
]

# Photos whose pace tells how long the others will take.
_N_PACE = 7


@dataclass(frozen=True, eq=False)
class MadeMasks:
    """What `make_masks` did.

    Attributes:
        rung: With which models.
        n_made: Masks made now.
        n_kept: Masks that were there.
        n_trunks: Trunks in the new ones, each counted in every photo that shows it.
        problems: Photo → why it has none, in plain words.
        seconds_per_photo: Measured; None where none was made.
        notes: What the person should know.
    """

    rung: MakingRung
    n_made: int
    n_kept: int
    n_trunks: int = 0
    problems: Mapping[str, str] = field(default_factory=dict)
    seconds_per_photo: float | None = None
    notes: tuple[str, ...] = ()


# ---- making


def make_masks(plan: MaskPlan, *, progress: Progress = ignore_progress) -> MadeMasks:
    """Make the masks of a plan, each stored as soon as it is done. Pure and picklable, for a job.

    A photo that cannot be read is told and left out. `progress` says which photo it is and how long it will take.

    Raises:
        CommandError: They are being made already, by another process.
        FileError: The masks cannot be stored (a full disk), or none of the photos can be read.
        ModelError: A model cannot be opened, or failed.
        CancelledError: From `progress`; all masks made until then are kept.
    """
    if not plan.photos:
        return MadeMasks(plan.rung, 0, plan.n_kept, notes=plan.notes)
    with _only_maker(plan.folder):
        return _make(plan, progress)


@contextmanager
def _only_maker(folder: Path) -> Iterator[None]:
    """Nobody else makes masks into the folder meanwhile. A cloud that is not saved as a plot has no other lock."""
    from dbh_studio.io.lock import lock_file

    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = lock_file(folder / "making.lock")
    except ProjectLockedError as error:
        raise CommandError(
            f"Masks of this plot are being made already: {error.problem}",
            "Wait until that ends, or stop it there; the masks it has made are kept.",
        ) from None
    except OSError as error:
        raise FileError(
            folder, f"Masks cannot be kept there ({error.strerror or error}).", "Make the folder writable."
        ) from None
    try:
        yield
    finally:
        lock.close()


def _make(plan: MaskPlan, progress: Progress) -> MadeMasks:
    from dbh_studio.io.masks import MaskStore
    from dbh_studio.io.models import ModelStore
    from dbh_studio.io.photos import read_photo
    from dbh_studio.stages.mask_models import open_grounded_sam

    models = open_grounded_sam(
        ModelStore(folder=plan.models_folder),
        plan.request.run,
        detector=plan.models[0] if plan.rung == "detector" else "",
        segmenter=plan.models[-1],
        with_detector=plan.rung == "detector",
        progress=subprogress(progress, 0.0, 0.01),
    )
    store = MaskStore(plan.folder)
    pace = _Pace(plan, progress)
    problems: dict[str, FileError] = {}
    n_trunks = 0
    for photo in plan.photos:
        pace.begin(photo)
        try:
            picture = read_photo(photo)
        except FileError as error:
            problems[photo.name] = error
            pace.skip(photo)
            continue
        mask = _mask_of(plan, models, photo, picture, pace.report)
        store.put(photo.name, Path(str(photo.path)), mask, plan.recipe)
        n_trunks += len(mask.numbers)
        pace.end(photo)
    if len(problems) == len(plan.photos):
        raise min(problems.items())[1]
    progress(1.0, "")
    return MadeMasks(
        plan.rung,
        len(plan.photos) - len(problems),
        plan.n_kept,
        n_trunks,
        {name: str(error) for name, error in problems.items()},
        pace.seconds_per_photo,
        (*plan.notes, *models.notes),
    )


def masks_for_plot(
    session: Session,
    request: MakeRequest = MakeRequest(),  # noqa: B008 - frozen
    *,
    cameras: Cameras | None = None,
    models: ModelStore | None = None,
    in_process: bool = True,
    progress: Progress = ignore_progress,
    started: Callable[[Job], object] | None = None,
) -> MadeMasks:
    """Plan and make, and wait. Arguments and errors as in `plan_masks` and `make_masks`."""
    plan = plan_masks(
        session,
        request,
        cameras=cameras,
        models=models,
        in_process=in_process,
        progress=subprogress(progress, 0.0, 0.05),
        started=started,
    )
    rest = subprogress(progress, 0.05, 1.0)
    made: MadeMasks = run_job(make_masks, plan, in_process=in_process, progress=rest, started=started)
    return made


class _Pace:
    """Where the work is, and how long it will take; remembers the speed for the next estimate."""

    def __init__(self, plan: MaskPlan, progress: Progress) -> None:
        self._plan = plan
        self._progress = progress
        self._prompted = plan.rung == "prompted"
        self._views = {p.name: views_of(p, plan.request.settings, is_prompted=self._prompted) for p in plan.photos}
        self._total = max(sum(self._views.values()), 1)
        self._n_views = self._n_photos = 0
        self._begun = 0.0
        self._seconds: list[float] = []
        self._rates: list[float] = []
        self._name = ""

    @property
    def seconds_per_photo(self) -> float | None:
        """The median so far."""
        return median(self._seconds) if self._seconds else None

    def begin(self, photo: PosedImage) -> None:
        self._name, self._begun = photo.name, time.monotonic()
        self.report(0.0)

    def report(self, fraction: float, message: str = "") -> None:
        """A `Progress` of the photo at hand."""
        views = self._n_views + fraction * self._views[self._name]
        left = duration((self._total - views) * self._per_view())
        text = f"Photo {self._n_photos + 1} of {len(self._plan.photos)}, about {left} left"
        # The models themselves were 1 %.
        self._progress(0.01 + 0.99 * min(views / self._total, 1.0), f"{text}: {message}" if message else text)

    def end(self, photo: PosedImage) -> None:
        seconds = time.monotonic() - self._begun
        self._seconds.append(seconds)
        self._rates.append(seconds / self._views[photo.name])
        self._n_photos += 1
        self._n_views += self._views[photo.name]
        remember_speed(self._plan.models, self._plan.request.run, self._per_view())

    def skip(self, photo: PosedImage) -> None:
        self._n_photos += 1
        self._n_views += self._views[photo.name]

    def _per_view(self) -> float:
        """Seconds: of the last photos, so that a computer that is wanted elsewhere now is told of."""
        return median(self._rates[-_N_PACE:]) if self._rates else self._plan.cost.seconds_per_view


def _mask_of(plan: MaskPlan, models: GroundedSam, photo: PosedImage, picture: UInt8, progress: Progress) -> TrunkMask:
    from dbh_studio.core.tiles import up_in_camera
    from dbh_studio.stages.grounded_sam import segment_photo, segment_trunks

    settings, up = plan.request.settings, up_in_camera(photo, [0.0, 0.0, 1.0])
    if models.detector is not None:
        found = segment_photo(
            photo, models.detector, models.segmenter, settings, picture=picture, up_cam=up, progress=progress
        )
    else:
        found = segment_trunks(
            photo,
            plan.trunks,
            models.segmenter,
            settings,
            max_distance_m=plan.request.max_distance_m,
            picture=picture,
            up_cam=up,
            progress=progress,
        )
    return found.trunk_mask(settings.mask_size_px)
