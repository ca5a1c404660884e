"""What is asked for about masks: those a person brings, those to be made, the best there is; and how masks vote."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, TypeAlias

from dbh_studio.core.mask_record import MaskRecord
from dbh_studio.settings import MaskDetectorSettings, ModelRunSettings, VoteSettings

if TYPE_CHECKING:
    from dbh_studio.io.masks import MaskMeaning, TrunkMask

KeyframeChoice: TypeAlias = "int | Literal['auto', 'all']"
"""``auto``: until a photo adds less than a tenth of what one shows; ``all``; or so many, those that add most."""

MakingRung: TypeAlias = Literal["detector", "prompted"]


class VotingMasks(Protocol):
    """Masks as the voting asks for them: brought ones (`MaskSet`) or kept ones (`plot_masks.PlotMasks`). Picklable."""

    @property
    def finds_trunks(self) -> bool:
        """Whether they say what is trunk, and not only what to ignore."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What was found, in plain words."""

    def mask(self, name: str) -> TrunkMask | None:
        """The mask of a photo, by the photo's name; None where it has none. Raises FileError where it is damaged."""

    def where(self, name: str) -> Path:
        """The file of the mask of a photo that has one."""

    def record(self) -> MaskRecord:
        """What is saved with the trunks they find."""


@dataclass(frozen=True)
class MaskRequest:
    """Which masks, and what is known of them.

    Attributes:
        path: A folder, or a COCO file (``.json``), or one picture that is the mask of every photo.
        meaning: See `io.masks.MEANINGS`; None takes what the masks look like, where that is clear.
        style: How masks are named after photos: a key of `io.masks.MASK_STYLES`, or a template such as
            ``{stem}_segm.png``; None takes the one that fits most photos.
        categories: With numbered masks the numbers that are trunks (``7``, ``1-12``), of a COCO file the names or
            ids of the categories; empty takes all numbers, or the categories that are trunks by their names.
        votes: How masks become labels of points.
        ignore_path: More masks, as `path` is; they only say where a photo says nothing (the walker, the sky).
        ignore_side: Which side of these is to be ignored; ``dark`` as in masks for structure from motion.
        cameras: The reconstruction with the poses; None looks where the cloud is, or takes those of the saved plot.
        images_dir: Where the photos are; None beside the reconstruction. Only the overlay needs them.
        overlay: JPEG file to write, one photo with its mask drawn.
        accept_candidates: Take stems that only geometry sees as trunks, too.
    """

    path: Path
    meaning: MaskMeaning | None = None
    style: str | None = None
    categories: tuple[str, ...] = ()
    votes: VoteSettings = VoteSettings()  # noqa: RUF009 - frozen
    ignore_path: Path | None = None
    ignore_side: Literal["dark", "bright"] = "dark"
    cameras: Path | None = None
    images_dir: Path | None = None
    overlay: Path | None = None
    accept_candidates: bool = False


@dataclass(frozen=True)
class MakeRequest:
    """How masks are to be made.

    Attributes:
        rung: ``detector`` (detector and SAM), ``prompted`` (SAM with boxes of geometric trunks), or ``auto``: the first
            of them whose models are there.
        keyframes: Of how many photos; see `KeyframeChoice`.
        photos: Only of these, by name; empty leaves the choice to `keyframes`.
        settings: Prompt, thresholds, tiles or whole panoramas.
        run: Provider, precision, threads.
        detector: Name of the detector; empty takes the default that is there.
        segmenter: Name of the segmenter, likewise.
        max_distance_m: Stems farther from a photo are not asked of it, when photos are chosen and when SAM is prompted.
        redo: Make masks anew that are there, but those a person painted.
    """

    rung: Literal["auto", "detector", "prompted"] = "auto"
    keyframes: KeyframeChoice = "auto"
    photos: tuple[str, ...] = ()
    settings: MaskDetectorSettings = MaskDetectorSettings()  # noqa: RUF009 - frozen
    run: ModelRunSettings = ModelRunSettings()  # noqa: RUF009 - frozen
    detector: str = ""
    segmenter: str = ""
    max_distance_m: float = 10.0
    redo: bool = False


@dataclass(frozen=True)
class LadderRequest:
    """Trunks by the best that is there, instead of masks a person brings.

    Attributes:
        source: ``auto`` takes the ladder and makes what masks it can; ``stored`` takes the kept masks and makes none.
        make: How masks are made; its `rung` is the one asked for.
        votes: How masks become labels of points.
        cameras: The reconstruction with the poses; None looks where the cloud is, or takes those of the saved plot.
        images_dir: Where the photos are; None beside the reconstruction.
        accept_candidates: Take stems that only geometry sees as trunks, too.
    """

    source: Literal["auto", "stored"] = "auto"
    make: MakeRequest = MakeRequest()
    votes: VoteSettings = VoteSettings()  # noqa: RUF009 - frozen
    cameras: Path | None = None
    images_dir: Path | None = None
    accept_candidates: bool = False
