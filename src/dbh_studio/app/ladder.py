"""The ladder: four ways to trunks, from the best that photos allow to the cloud alone, and which one is taken and why.

    ladder = look_at_ladder(session, cameras=cameras)
    for line in ladder.announcement: print(line)
    ladder.chosen                                # "detector", "prompted", "brought" or "geometry"

detector    detector and SAM: what the prompt names is found in the photos
prompted    SAM outlines trunks that geometry has found: minutes instead of an hour
brought     masks that were made elsewhere
geometry    the cloud alone

Nothing is computed here: models are neither opened nor hashed, photos and masks not read.
"""

from __future__ import annotations

import importlib.util
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from dbh_studio.app.brought_masks import MaskSet
from dbh_studio.app.derived import UNSCALED_REASON, UNSCALED_REMEDY
from dbh_studio.app.mask_costs import MaskCost, cost_of
from dbh_studio.app.mask_request import MakeRequest, MaskRequest
from dbh_studio.app.plot_masks import mask_store, masks_that_vote
from dbh_studio.core.mask_record import RUNG_TITLES, MaskRung
from dbh_studio.errors import ModelError

if TYPE_CHECKING:
    from dbh_studio.app.cameras import Cameras
    from dbh_studio.app.session import Session
    from dbh_studio.core.posed_images import PosedImage
    from dbh_studio.io.models import ModelStore

RUNGS: tuple[MaskRung, ...] = ("detector", "prompted", "brought", "geometry")
_METHOD_RUNGS: dict[str, MaskRung] = {
    "grounded_sam": "detector",
    "prompted_sam": "prompted",
    "imported": "brought",
    "painted": "brought",
}
# Before the photos are compared, `auto` takes about every fourth of a walk's panoramas.
_AUTO_SHARE = 0.25
_MIN_AUTO = 20


@dataclass(frozen=True)
class RungState:
    """One rung.

    Attributes:
        rung: Which.
        title: ``detector and SAM``, …
        is_available: Whether it can be taken: masks can be made, or are kept already.
        can_make: Whether (more) masks can be made on this rung now.
        why_not: Why none can be made or had, one sentence; empty where they can.
        remedy: The one thing that would change that; empty where nothing is missing.
        n_kept: Masks of this rung that are kept beside the plot and vote.
        cost: Of the masks that are still to be made, before photos are compared; None where none are to be made.
        cost_text: In plain words, for every rung.
    """

    rung: MaskRung
    title: str
    is_available: bool
    can_make: bool
    why_not: str = ""
    remedy: str = ""
    n_kept: int = 0
    cost: MaskCost | None = None
    cost_text: str = ""


@dataclass(frozen=True)
class Ladder:
    """All rungs, the highest first, and the one that is taken.

    Attributes:
        rungs: Of `RUNGS`, in that order.
        chosen: The one taken: the one asked for, else the highest that is available.
    """

    rungs: tuple[RungState, ...]
    chosen: MaskRung

    def __getitem__(self, rung: MaskRung) -> RungState:
        return next(state for state in self.rungs if state.rung == rung)

    @property
    def taken(self) -> RungState:
        """The rung that is taken."""
        return self[self.chosen]

    @property
    def announcement(self) -> tuple[str, ...]:
        """What is taken and its cost, then why no higher one, with the one thing that would change that."""
        lines = [f"Trunks by {self.taken.title} (rung {RUNGS.index(self.chosen) + 1} of 4): {self.taken.cost_text}."]
        for state in self.rungs[: RUNGS.index(self.chosen)]:
            if state.why_not:
                lines.append(f"Not by {state.title}: {state.why_not} {state.remedy}".rstrip())
            else:
                lines.append(f"Not by {state.title}, though it could be: another rung was asked for.")
        return tuple(lines)

    def as_json(self) -> dict[str, Any]:
        """For scripts."""
        rungs = [
            {
                "rung": state.rung,
                "title": state.title,
                "is_available": state.is_available,
                "why_not": state.why_not,
                "remedy": state.remedy,
                "n_kept": state.n_kept,
                "seconds": None if state.cost is None else round(state.cost.seconds),
                "is_measured": None if state.cost is None else state.cost.is_measured,
                "cost": state.cost_text,
            }
            for state in self.rungs
        ]
        return {"chosen": self.chosen, "rungs": rungs}


def look_at_ladder(
    session: Session,
    *,
    cameras: Cameras | None = None,
    models: ModelStore | None = None,
    request: MakeRequest = MakeRequest(),  # noqa: B008 - frozen
    brought: MaskRequest | MaskSet | None = None,
    wanted: MaskRung | Literal["auto"] = "auto",
) -> Ladder:
    """What is possible for a plot now, what it costs, and what will be taken.

    Args:
        session: The plot.
        cameras: Its photos; None takes those that were read already, and none where none were.
        models: Where the models are; None: the user's cache.
        request: How masks would be made, for the cost; its `rung` is not asked.
        brought: Masks a person brings, where they do.
        wanted: The rung a person asks for.

    Raises:
        ModelError: The rung asked for is not available; says why, and the one thing that would change that.
        FileError: The index of the kept masks cannot be read.
    """
    from dbh_studio.io.models import ModelStore

    known = session.cameras if cameras is None else cameras
    store = ModelStore() if models is None else models
    kept = masks_that_vote(mask_store(session), None if known is None else known.posed)
    counts = Counter(_METHOD_RUNGS.get(entry.recipe["method"], "brought") for entry in kept.entries.values())
    problem = _photo_problem(session, known)
    rungs = (
        _making("detector", known, store, request, problem, counts["detector"], session),
        _making("prompted", known, store, request, problem, counts["prompted"], session),
        _brought(brought, problem, counts["brought"]),
        RungState(
            "geometry", RUNG_TITLES["geometry"], True, True, cost_text="seconds to a few minutes, no photos needed"
        ),
    )
    if wanted != "auto":
        state = next(state for state in rungs if state.rung == wanted)
        if not state.is_available:
            raise ModelError(f"Trunks cannot be found by {state.title}: {state.why_not}", state.remedy)
        return Ladder(rungs, wanted)
    return Ladder(rungs, next(state.rung for state in rungs if state.is_available))


def _photo_problem(session: Session, cameras: Cameras | None) -> tuple[str, str]:
    """Why no photo can help, and what would change that; empty where they can."""
    if not session.document.scale.is_known:
        return UNSCALED_REASON, UNSCALED_REMEDY
    if cameras is None:
        return (
            "The plot has no photos with known poses.",
            "Say where the reconstruction is: --cameras, or step Scale in the studio.",
        )
    if cameras.fit.status == "moved":
        return cameras.fit.message, cameras.fit.remedy
    return "", ""


def _making(
    rung: Literal["detector", "prompted"],
    cameras: Cameras | None,
    models: ModelStore,
    request: MakeRequest,
    problem: tuple[str, str],
    n_kept: int,
    session: Session,
) -> RungState:
    title = RUNG_TITLES[rung]
    why_not, remedy = problem if any(problem) else _model_problem(rung, models, request)
    if not why_not and cameras is not None and not cameras.n_found:
        why_not = f"None of the {len(cameras.posed):,} photos is on this computer."
        remedy = "Say in which folder they are (--images)."
    kept = f"{n_kept:,} masks are kept" if n_kept else ""
    if why_not or cameras is None:
        # What was made before is used all the same, if the photos' poses are there.
        usable = bool(n_kept) and not any(problem)
        text = f"{kept}, no more can be made" if usable else "not available"
        return RungState(rung, title, usable, False, why_not, remedy, n_kept, None, text)
    cost = cost_of(
        _photos_about(cameras, request, n_kept),
        _names(rung, models, request),
        request.settings,
        request.run,
        is_prompted=rung == "prompted",
    )
    more = " more" if n_kept else ""
    text = f"{kept}; " if kept else ""
    guess = "about " if request.keyframes == "auto" and not request.photos else ""
    text += (
        f"{guess}{cost.n_photos:,}{more} of {len(cameras.posed):,} photos, {cost.text}"
        if cost.n_photos
        else "nothing to do"
    )
    if rung == "prompted" and (session.document.masks is not None or not len(session.document.trunks)):
        text += ", after trunks by geometry"
    return RungState(rung, title, True, True, "", "", n_kept, cost, text)


def _model_problem(rung: MaskRung, models: ModelStore, request: MakeRequest) -> tuple[str, str]:
    if importlib.util.find_spec("onnxruntime") is None:
        return "onnxruntime, which runs the models, is not installed.", "`dbh-studio doctor` says how to install it."
    fetch = "`dbh-studio models fetch` gets them (764 MB); without network: `dbh-studio models add FOLDER`."
    if models.offline:
        fetch = "Downloads are switched off; `dbh-studio models add FOLDER` takes files got by other means."
    wanted = {"segmenter": request.segmenter}
    if rung == "detector":
        wanted["detector"] = request.detector
    missing = [purpose for purpose, name in wanted.items() if not _is_there(models, purpose, name)]
    if not missing:
        return "", ""
    names = " and no ".join(sorted(missing))
    return f"No {names} is on this computer.", fetch


def _is_there(models: ModelStore, purpose: str, name: str) -> bool:
    return any(not name or spec.name == name for spec in models.ready(purpose))


def _names(rung: MaskRung, models: ModelStore, request: MakeRequest) -> tuple[str, ...]:
    """The models that would be taken, for the cost: nothing is hashed."""
    from dbh_studio.stages.onnx_runtime import choose_model

    wanted = [("detector", request.detector)] if rung == "detector" else []
    wanted.append(("segmenter", request.segmenter))
    specs = [choose_model(models.ready(purpose), request.run, name=name) for purpose, name in wanted]
    return tuple("" if spec is None else spec.name for spec in specs)


def _photos_about(cameras: Cameras, request: MakeRequest, n_kept: int) -> tuple[PosedImage, ...]:
    """As many photos as will most likely be chosen; which ones is for the plan to say."""
    here = tuple(photo for photo in cameras.posed if photo.path is not None)
    if request.photos:
        return tuple(photo for photo in here if photo.name in request.photos)
    if request.keyframes == "all":
        n = len(here)
    elif request.keyframes == "auto":
        n = max(round(_AUTO_SHARE * len(here)), min(len(here), _MIN_AUTO))
    else:
        n = min(int(request.keyframes), len(here))
    return here[: max(n - n_kept, 0)]


def _brought(brought: MaskRequest | MaskSet | None, problem: tuple[str, str], n_kept: int) -> RungState:
    rung: MaskRung = "brought"
    title = RUNG_TITLES[rung]
    if any(problem):
        return RungState(rung, title, False, False, *problem, n_kept, None, "not available")
    if isinstance(brought, MaskSet) and (brought.unclear or not brought.finds_trunks):
        why = brought.unclear or "The masks say what to ignore, not what is trunk."
        return RungState(rung, title, bool(n_kept), False, why, brought.remedy, n_kept, None, "not available")
    if brought is not None or n_kept:
        text = f"{n_kept:,} masks are kept beside the plot" if n_kept else f"those in {brought.path.name}"  # type: ignore[union-attr]
        return RungState(rung, title, True, brought is not None, "", "", n_kept, None, text)
    return RungState(
        rung,
        title,
        False,
        False,
        "No masks were brought.",
        "Say where they are: --masks FOLDER, or a COCO file.",
        0,
        None,
        "not available",
    )
