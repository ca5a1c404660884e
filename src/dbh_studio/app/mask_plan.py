"""Planning masks: with which models, of which photos, in which order, and what that costs. See `app.mask_making`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from dbh_studio.app.cameras import Cameras, cameras_of, require_fit
from dbh_studio.app.jobs import Job, run_job
from dbh_studio.app.mask_costs import MaskCost, cost_of
from dbh_studio.app.mask_request import KeyframeChoice, MakeRequest, MakingRung
from dbh_studio.app.plot_masks import mask_store, masks_folder
from dbh_studio.app.session import Session
from dbh_studio.core.arrays import Float64
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import CommandError, FileError, ModelError

if TYPE_CHECKING:
    from dbh_studio.app.document import Document
    from dbh_studio.core.keyframes import Keyframes
    from dbh_studio.io.masks import MaskRecipe, MaskStore
    from dbh_studio.io.models import ModelStore
    from dbh_studio.stages.trunk_prompts import TrunkShape

_MOST_SAMPLED = 300_000


@dataclass(frozen=True, eq=False)
class MaskPlan:
    """What `make_masks` will do; picklable.

    Attributes:
        rung: Which models are used.
        request: As asked for.
        folder: Where the masks go.
        models_folder: Where the models are.
        models: Their names, the detector first.
        photos: Those to be made, in the order in which they add most, in metres with z up.
        n_photos: How many photos the plot has.
        n_kept: Masks that are there and stay as they are.
        share_covered: Share (0..1) of what all photos could show that kept and new masks show together; None where the
            photos were named.
        recipe: What the masks are stored under.
        trunks: What SAM is prompted with; empty with a detector.
        cost: Estimated.
        notes: What the person should know.
    """

    rung: MakingRung
    request: MakeRequest
    folder: Path
    models_folder: Path
    models: tuple[str, ...]
    photos: tuple[PosedImage, ...]
    n_photos: int
    n_kept: int
    share_covered: float | None
    recipe: MaskRecipe
    trunks: tuple[TrunkShape, ...]
    cost: MaskCost
    notes: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """How many masks, how long it will take, and what they show."""
        kept = f" ({self.n_kept:,} more are there already)" if self.n_kept else ""
        if not self.photos:
            return f"There is nothing to do: {self.n_kept:,} masks are there already, of {self.n_photos:,} photos."
        seen = "" if self.share_covered is None else f" They show {100 * self.share_covered:.0f} % of what all would."
        return f"Masks of {len(self.photos):,} of {self.n_photos:,} photos, {self.cost.text}{kept}.{seen}"


def plan_masks(
    session: Session,
    request: MakeRequest = MakeRequest(),  # noqa: B008 - frozen
    *,
    cameras: Cameras | None = None,
    models: ModelStore | None = None,
    in_process: bool = True,
    progress: Progress = ignore_progress,
    started: Callable[[Job], object] | None = None,
) -> MaskPlan:
    """Choose models and photos. With a detector that takes a second; without, trunks are found by geometry first.

    Args:
        session: A plot with a scale and photos.
        request: How masks are to be made.
        cameras: The photos, where they are at hand; None takes the plot's.
        models: Where the models are; None: the user's cache.
        in_process: Find trunks here rather than in a child process.
        progress: Called in between.
        started: Given the job that finds trunks, so that another thread can cancel it.

    Raises:
        UnscaledCloudError: The plot has no scale.
        CommandError: It has no photos, they do not belong to the cloud, it is open for reading only, or a photo that
            was named is not there.
        FileError: None of the photos is on this computer.
        ModelError: The models are not there; says how to get them.
        MissingComponentError: onnxruntime is missing.
        SettingError: The tiles leave gaps.
        CancelledError: From `progress`.
    """
    from dbh_studio.io.models import ModelStore
    from dbh_studio.stages.mask_models import chosen_models, mask_recipe, rung

    document = session.document
    session.require_scale(document)
    if session.is_read_only:
        raise CommandError("The plot is open for reading only.", "Open it for writing to make masks.")
    posed = _photos(session, document, cameras)
    known = ModelStore() if models is None else models
    chosen: MakingRung = _rung(request, rung(known))
    names = chosen_models(
        known,
        request.run,
        detector=request.detector,
        segmenter=request.segmenter,
        with_detector=chosen == "detector",
        progress=subprogress(progress, 0.0, 0.2),
    )
    _check_tiles(posed, request)
    recipe = mask_recipe(
        {name: known.identity(name) for name in names}, request.settings, prompted=chosen == "prompted"
    )
    trunks: tuple[TrunkShape, ...] = ()
    if chosen == "prompted":
        part = subprogress(progress, 0.2, 0.9)
        trunks = _geometric_trunks(session, document, in_process=in_process, progress=part, started=started)
        recipe = replace(
            recipe, options={**recipe.options, "trunks": _digest(trunks), "max_distance_m": request.max_distance_m}
        )
    store = mask_store(session)
    photos, n_kept, covered = _chosen_photos(session, document, posed, request, store, recipe)
    missing = sum(photo.path is None for photo in posed)
    notes = [f"{missing:,} of {len(posed):,} photos are not on this computer."] if missing else []
    if chosen == "prompted":
        notes.append(f"SAM is prompted with boxes of {len(trunks):,} trunks that geometry found: others stay unseen.")
    progress(1.0, "")
    return MaskPlan(
        rung=chosen,
        request=request,
        folder=masks_folder(session),
        models_folder=known.folder,
        models=names,
        photos=photos,
        n_photos=len(posed),
        n_kept=n_kept,
        share_covered=covered,
        recipe=recipe,
        trunks=trunks,
        cost=cost_of(photos, names, request.settings, request.run, is_prompted=chosen == "prompted"),
        notes=tuple(notes),
    )


def keyframes_of(
    session: Session,
    document: Document,
    posed_world: PosedImages,
    choice: KeyframeChoice,
    *,
    already: Sequence[int] = (),
    never: Sequence[int] = (),
    max_distance_m: float = 10.0,
) -> Keyframes:
    """The photos to make masks of, those that add most first.

    Covered are the sides of the plot's trunks; before any is known, of places with points at the cameras' height.

    Args:
        session: The plot.
        document: Its state.
        posed_world: Its photos, metres, z up.
        choice: How many.
        already: Rows of photos that have a mask.
        never: Rows of photos that must not be chosen, beside those that are not on this computer.
        max_distance_m: Stems farther away are not asked.
    """
    from dbh_studio.core.keyframes import choose_keyframes, sides_seen

    targets = _targets(session, document, posed_world, max_distance_m)
    may_choose = np.array([photo.path is not None for photo in posed_world], bool)
    may_choose[np.asarray(never, np.int64)] = False
    budget = len(posed_world) if choice == "all" else None if choice == "auto" else int(choice)
    sees = sides_seen(targets, posed_world, max_distance=max_distance_m)
    return choose_keyframes(sees, already=already, budget=budget, may_choose=may_choose)


def _photos(session: Session, document: Document, cameras: Cameras | None) -> PosedImages:
    """In metres with z up.

    Raises:
        CommandError: There are none, or they do not belong to the cloud.
        FileError: None is on this computer.
    """
    known = cameras_of(session) if cameras is None else cameras
    if known is None:
        raise CommandError(
            "The plot has no photos, so no masks can be made.",
            "Say where their poses are: --cameras (and --images), or step Scale in the studio.",
        )
    require_fit(known)
    if not known.n_found:
        raise FileError(
            known.source.path,
            f"None of its {len(known.posed)} photos was found.",
            "Say in which folder they are (--images).",
        )
    about_origin = Similarity(np.eye(3), -session.cloud.origin)
    return known.posed.moved(document.world_from_source @ about_origin)


def _rung(request: MakeRequest, possible: Literal["detector", "prompted", "none"]) -> MakingRung:
    if request.rung != "auto":
        return request.rung  # what is missing is told where the models are chosen
    if possible == "none":
        raise ModelError(
            "No models are on this computer that could find trunks in photos.",
            "`dbh-studio models fetch` gets them; masks made elsewhere can be brought (--masks).",
        )
    return possible


def _check_tiles(posed: PosedImages, request: MakeRequest) -> None:
    """Raise SettingError where the tiles leave gaps: now, and not after the models were opened."""
    from dbh_studio.stages.grounded_sam import photo_tiles

    panorama = next((photo for photo in posed if photo.camera.is_panorama), None)
    if panorama is not None and (request.settings.panorama == "tiles" or request.rung == "prompted"):
        photo_tiles(panorama, request.settings)


def _geometric_trunks(
    session: Session,
    document: Document,
    *,
    in_process: bool,
    progress: Progress,
    started: Callable[[Job], object] | None,
) -> tuple[TrunkShape, ...]:
    """The plot's trunks where geometry or a person found them, else what geometry finds now; the plot stays as it is.

    Trunks that masks found are not asked for again: the boxes would follow from the masks they are to make.
    """
    from dbh_studio.app.pipeline import segment_plot, segmentation_call
    from dbh_studio.stages.trunk_prompts import TrunkShape

    trunks = document.trunks
    if document.masks is not None or not len(trunks):
        points_world, settings, ids = segmentation_call(session, document)
        found = run_job(
            segment_plot, points_world, settings, ids, in_process=in_process, progress=progress, started=started
        )
        trunks = found.trunks
    if not len(trunks):
        raise CommandError(
            "Geometry found no trunk, so SAM cannot be asked for any.",
            "Get a detector (`dbh-studio models fetch`), or look at the settings of the trunks.",
        )
    points_world = session.points_world(document)
    # TrunkShape thins by rows, which may lie in any order in the cloud.
    return tuple(TrunkShape(trunk.id, points_world[trunk.points].astype(np.float64)) for trunk in trunks)


def _digest(trunks: Sequence[TrunkShape]) -> str:
    digest = hashlib.sha256()
    for trunk in trunks:
        digest.update(f"{trunk.id}".encode())
        digest.update(np.round(trunk.points, 3).astype("<f4").tobytes())
    return digest.hexdigest()[:16]


def _chosen_photos(
    session: Session,
    document: Document,
    posed: PosedImages,
    request: MakeRequest,
    store: MaskStore,
    recipe: MaskRecipe,
) -> tuple[tuple[PosedImage, ...], int, float | None]:
    """The photos to do, in order; how many masks stay; and what share is then covered."""
    here = {photo.name: Path(photo.path) for photo in posed if photo.path is not None}
    if request.redo:
        to_do = {name for name in here if not _is_painted(store, name)}
    else:
        to_do = {name for name in store.to_do(here, recipe) if not _is_settled(store, name, here[name])}
    done = [name for name in here if name not in to_do]
    if request.photos:
        strange = sorted(set(request.photos) - set(here))
        if strange:
            raise CommandError(
                f"There is no photo {strange[0]} on this computer.", "`dbh-studio masks list` shows all."
            )
        named = dict.fromkeys(request.photos)
        return tuple(posed.by_name(name) for name in named if name in to_do), len(done), None
    rows = {photo.name: row for row, photo in enumerate(posed)}
    rejected = [rows[name] for name in done if _is_rejected(store, name)]
    already = sorted(set(rows[name] for name in done) - set(rejected))
    frames = keyframes_of(
        session,
        document,
        posed,
        request.keyframes,
        already=already,
        never=rejected,
        max_distance_m=request.max_distance_m,
    )
    return tuple(posed.images[row] for row in frames.rows), len(done), frames.share


def _is_painted(store: MaskStore, name: str) -> bool:
    entry = store.entry(name)
    return entry is not None and entry.is_painted


def _is_settled(store: MaskStore, name: str, photo: Path) -> bool:
    """Whether a person brought or accepted the mask: another recipe is no reason to make it anew."""
    entry = store.entry(name)
    if entry is None or not (entry.review == "accepted" or entry.recipe.get("method") == "imported"):
        return False
    return store.is_of(name, photo)


def _is_rejected(store: MaskStore, name: str) -> bool:
    entry = store.entry(name)
    return entry is not None and entry.review == "rejected"


def _targets(session: Session, document: Document, posed: PosedImages, max_distance_m: float) -> Float64:
    """(T, 3) what the photos are to show."""
    from dbh_studio.core.keyframes import places_at_eye_height

    points = session.points_world(document)
    if len(document.trunks):
        return np.array([np.median(points[trunk.points], axis=0) for trunk in document.trunks], np.float64)
    step = max(1, len(points) // _MOST_SAMPLED)
    return places_at_eye_height(points[::step], posed.centres_src, max_distance=max_distance_m)
