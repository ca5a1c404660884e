"""The models that find trunks in photos, chosen among those on this computer and opened together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.errors import ModelError
from dbh_studio.io.masks.store import MaskRecipe
from dbh_studio.io.models.store import ModelStore
from dbh_studio.settings import MaskDetectorSettings, ModelRunSettings
from dbh_studio.stages.grounding_dino import GroundingDino
from dbh_studio.stages.onnx_runtime import choose_model
from dbh_studio.stages.sam import Sam

Rung = Literal["detector", "prompted", "none"]


@dataclass(frozen=True)
class GroundedSam:
    """The models opened, and what they are.

    Attributes:
        segmenter: Outlines what is in a box.
        detector: Finds boxes; None where there is none: then boxes come from trunks that geometry has found.
        models: Names, the detector first.
        identities: Name → sha256 of its files.
    """

    segmenter: Sam
    detector: GroundingDino | None
    models: tuple[str, ...]
    identities: dict[str, str]

    def recipe(self, settings: MaskDetectorSettings) -> MaskRecipe:
        """What masks made with these models and settings are stored under."""
        return mask_recipe(self.identities, settings, prompted=self.detector is None)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the person should know of how the models run."""
        return (() if self.detector is None else self.detector.graph.notes) + self.segmenter.notes


def mask_recipe(identities: dict[str, str], settings: MaskDetectorSettings, *, prompted: bool) -> MaskRecipe:
    """What masks made with models of these identities are stored under; known before the models are opened.

    Args:
        identities: Model name → sha256 of its files.
        settings: Prompt, thresholds, tiles.
        prompted: Boxes come from trunks that geometry has found, not from a detector.
    """
    options = settings.model_dump(mode="json", exclude={"prompt"})
    if prompted:
        return MaskRecipe("prompted_sam", identities, "", options)
    return MaskRecipe("grounded_sam", identities, settings.prompt, options)


def rung(store: ModelStore) -> Rung:
    """What the models that are there allow.

    ``detector``: text to masks; ``prompted``: masks of trunks that geometry has found; ``none``: masks that the person
    brings, or geometry alone.
    """
    if not store.ready("segmenter"):
        return "none"
    return "detector" if store.ready("detector") else "prompted"


def open_grounded_sam(
    store: ModelStore,
    run: ModelRunSettings = ModelRunSettings(),  # noqa: B008 - frozen
    *,
    detector: str = "",
    segmenter: str = "",
    with_detector: bool = True,
    progress: Progress = ignore_progress,
) -> GroundedSam:
    """Open models that are on this computer; nothing is fetched.

    Args:
        store: Where they are.
        run: On what they run, and in which precision.
        detector: Name of the detector; empty takes the default that is there.
        segmenter: Name of the segmenter, likewise.
        with_detector: False leaves the detector out.
        progress: Called while files are checked and opened.

    Raises:
        ModelError: One is not there, or not what it should be.
        FileError: A file is broken.
        MissingComponentError: onnxruntime is not there, or cannot do what is asked.
        CancelledError: From `progress`.
    """
    checking = subprogress(progress, 0.0, 0.5)
    names = chosen_models(
        store, run, detector=detector, segmenter=segmenter, with_detector=with_detector, progress=checking
    )
    paths = [store.paths(name) for name in names]
    found = None
    if with_detector:
        progress(0.5, f"Opening {names[0]}")
        # Several phrases have the same signature as one: only the list knows which graph is right for them.
        found = GroundingDino.open(
            paths[0],
            run,
            phrases_together=names[0].endswith("-phrases") or None,
            traced_px=_traced_size(store, names[0]),
        )
    progress(0.9, f"Opening {names[-1]}")
    outlined = Sam.open(paths[-1], run)
    progress(1.0, "The models are ready.")
    return GroundedSam(outlined, found, names, {name: store.identity(name) for name in names})


def chosen_models(
    store: ModelStore,
    run: ModelRunSettings = ModelRunSettings(),  # noqa: B008 - frozen
    *,
    detector: str = "",
    segmenter: str = "",
    with_detector: bool = True,
    progress: Progress = ignore_progress,
) -> tuple[str, ...]:
    """Names of the models `open_grounded_sam` would open, the detector first; their files are checked, not opened.

    Raises:
        ModelError: One is not there, or not what it should be.
        MissingComponentError: onnxruntime is not there.
        CancelledError: From `progress`.
    """
    names = [_chosen(store, "detector", detector, run)] if with_detector else []
    names.append(_chosen(store, "segmenter", segmenter, run))
    for i, name in enumerate(names):
        store.paths(name, progress=subprogress(progress, i / len(names), (i + 1) / len(names)))
    return tuple(names)


def _chosen(store: ModelStore, purpose: str, name: str, run: ModelRunSettings) -> str:
    spec = choose_model(store.ready(purpose), run, name=name)
    if spec is not None:
        return spec.name
    if name:
        store.paths(name)  # says what is missing of it
    there = ", ".join(spec.name for spec in store.ready(purpose))
    if there:
        raise ModelError(
            f"No {purpose} in the precision {run.precision} is on this computer; there is {there}.",
            "Choose the precision auto, or fetch another: `dbh-studio models list`.",
        )
    raise ModelError(
        f"No {purpose} is on this computer.", "`dbh-studio models fetch` gets one; masks can also be brought."
    )


def _traced_size(store: ModelStore, name: str) -> tuple[int, int] | None:
    """(height, width) of the pictures of a published detector; None for one that a person brought."""
    state = store.state(name)
    if state.origin != "pinned":
        return None
    for file in state.spec.files:
        for tensor in file.signature.inputs if file.signature is not None else ():
            if tensor.name == "pixel_values" and len(tensor.shape) == 4:
                height, width = tensor.shape[2:]
                return None if height is None or width is None else (height, width)
    return None
