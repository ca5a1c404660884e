"""What project.json holds, as models that check it, and the way between them and the program's own types.

Schema 1 had no `masks`; a plot of that time is read as one whose trunks did not come from masks. Schema 2
had no health, crown class, own fields, corrections and reviews of trees, and no undo log.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from dbh_studio.core.corrections import Correction, CorrectionKind
from dbh_studio.core.mask_record import MaskKind, MaskRecord, MaskRung
from dbh_studio.core.scale import ScaleEstimate, ScaleSource
from dbh_studio.core.scale_evidence import MarkedPoint, MarkerSquare, ScaleBar, ScaleEvidence, Sight
from dbh_studio.core.tree_record import Review, ReviewDecision, TreeRecord, TreeStatus, check_text
from dbh_studio.core.trunks import MAX_TRUNK_ID, TrunkSet
from dbh_studio.settings import Settings

SCHEMA_VERSION = 3
TRUNKS_FILE = re.compile(r"trunks-(\d+)\.npz")
_MAX_POINTS = 2**31 - 1  # trunks are int32 indices


def _check_text(text: str) -> str:
    check_text("it", text)
    return text


def _is_unit(direction: tuple[float, float, float]) -> tuple[float, float, float]:
    if abs(sum(part * part for part in direction) - 1) > 1e-6:
        raise ValueError("is not of length 1")
    return direction


Text = Annotated[str, AfterValidator(_check_text)]
UnitDirection = Annotated[tuple[float, float, float], AfterValidator(_is_unit)]


class Model(BaseModel):
    """What is read from a saved plot: nothing unknown, and no number that is none."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SavedSource(Model):
    """Where the cloud is; `relative_path` is from the saved plot, so that both may be moved together."""

    path: Text
    relative_path: Text | None
    used: tuple[Text, ...]
    n_points: int = Field(ge=0, le=_MAX_POINTS)
    fingerprint: Text


class SavedScale(Model):
    """A `ScaleEstimate`."""

    metres_per_unit: float = Field(gt=0)
    source: ScaleSource
    standard_error: float | None = Field(ge=0)


class SavedCorrection(Model):
    """A `Correction`; places and indices as lists."""

    kind: CorrectionKind
    value: Any
    who: Text = ""
    when: Text = ""
    why: Text = ""


class SavedReview(Model):
    """A `Review`."""

    decision: ReviewDecision
    dbh_cm: float | None = Field(None, gt=0)
    refusal: Text = ""
    who: Text = ""
    when: Text = ""


class SavedTree(Model):
    """A `TreeRecord`."""

    species: Text = ""
    status: TreeStatus = ""
    note: Text = ""
    tag: Text = ""
    edited: bool = False
    tree_id: int | None = Field(None, gt=0, le=MAX_TRUNK_ID)
    flag: Text = ""
    health: Text = ""
    crown_class: Text = ""
    fields: tuple[tuple[Text, Text], ...] = ()
    corrections: tuple[SavedCorrection, ...] = ()
    review: SavedReview | None = None

    def record(self) -> TreeRecord:
        """What was saved. Raises ValueError where it contradicts itself."""
        nested = {
            "corrections": tuple(Correction(**each.model_dump()) for each in self.corrections),
            "review": None if self.review is None else Review(**self.review.model_dump()),
        }
        return TreeRecord(**(self.model_dump() | nested))


class SavedSight(Model):
    """A `Sight`."""

    image: Text
    u_px: float
    v_px: float


class SavedPoint(Model):
    """A `MarkedPoint`."""

    xyz_src: tuple[float, float, float]
    sigma_src: float = Field(0.0, ge=0)
    sights: tuple[SavedSight, ...] = ()


class SavedBar(Model):
    """A `ScaleBar`."""

    name: Text
    ends: tuple[SavedPoint, SavedPoint]
    length_m: float = Field(gt=0)
    length_se_m: float = Field(ge=0)
    role: Literal["control", "check"]


class SavedSquare(Model):
    """A `MarkerSquare`."""

    name: Text
    corners: tuple[SavedPoint, SavedPoint, SavedPoint, SavedPoint]
    side_m: float = Field(gt=0)
    side_se_m: float = Field(ge=0)
    role: Literal["control", "check"]
    marker: tuple[Text, int] | None = None
    n_views: int | None = Field(None, ge=0)
    side_sigma_src: float | None = Field(None, ge=0)
    systematic_src: float = Field(0.0, ge=0)


class SavedEvidence(Model):
    """A `ScaleEvidence`."""

    bars: tuple[SavedBar, ...] = ()
    squares: tuple[SavedSquare, ...] = ()
    struck: tuple[tuple[Text, Text, int], ...] = ()

    @classmethod
    def of(cls, evidence: ScaleEvidence) -> SavedEvidence:
        """What is saved of it."""
        return cls.model_validate(asdict(evidence))

    def evidence(self) -> ScaleEvidence:
        """What was saved. Raises ValueError where it contradicts itself."""
        bars = tuple(
            ScaleBar(bar.name, _points(bar.ends), bar.length_m, bar.length_se_m, bar.role)  # type: ignore[arg-type]
            for bar in self.bars
        )
        squares = tuple(
            MarkerSquare(**(square.model_dump(exclude={"corners"}) | {"corners": _points(square.corners)}))
            for square in self.squares
        )
        return ScaleEvidence(bars, squares, self.struck)


def _points(saved: Iterable[SavedPoint]) -> tuple[MarkedPoint, ...]:
    return tuple(
        MarkedPoint(point.xyz_src, point.sigma_src, tuple(Sight(**sight.model_dump()) for sight in point.sights))
        for point in saved
    )


class SavedCameras(Model):
    """Where the photos are; relative paths as of `SavedSource`."""

    path: Text
    relative_path: Text | None = None
    images_dir: Text | None = None
    relative_images_dir: Text | None = None
    frame: Literal["cloud", "file"] = "cloud"


class SavedMasks(Model):
    """A `MaskRecord`; relative paths as of `SavedSource`."""

    kind: MaskKind
    rung: MaskRung
    n_masks: int = Field(ge=0)
    path: Text | None = None
    relative_path: Text | None = None
    meaning: Text = ""
    categories: tuple[Text, ...] = ()
    style: Text = ""
    prompt: Text = ""
    models: tuple[Text, ...] = ()
    recipe: Text = ""
    digest: Text = ""

    @classmethod
    def of(cls, record: MaskRecord, folder: Path) -> SavedMasks:
        """What is saved of it in a plot at `folder`."""
        path = record.path
        paths = {} if path is None else {"path": str(path), "relative_path": relative_to(path, folder)}
        return cls(**(asdict(record) | {"path": None} | paths))

    def record(self, folder: Path) -> MaskRecord:
        """What was saved."""
        path = None if self.path is None else there(folder, self.path, self.relative_path)
        return MaskRecord(**(self.model_dump(exclude={"relative_path"}) | {"path": path}))


class SavedUndo(Model):
    """Which undo log goes with the plot, and how much had been done when the plot was saved; see `io.undo_log`."""

    log: str = Field(pattern="^[0-9a-f]{32}$")
    number: int = Field(ge=0)


class SavedProject(Model):
    """project.json, schema version 3."""

    schema_version: Literal[3] = 3
    plot_id: Text
    source: SavedSource
    up_direction: UnitDirection
    scale: SavedScale
    settings: Settings
    trunks_file: str = Field(pattern=f"^{TRUNKS_FILE.pattern}$")
    next_id: int = Field(ge=1, le=MAX_TRUNK_ID + 1)
    trees: dict[int, SavedTree]
    north_direction: UnitDirection | None = None
    origin_src: tuple[float, float, float] = (0.0, 0.0, 0.0)
    evidence: SavedEvidence = SavedEvidence()
    cameras: SavedCameras | None = None
    masks: SavedMasks | None = None
    undo: SavedUndo | None = None


@dataclass(frozen=True)
class CameraPlace:
    """Where the photos of a plot are: the reconstruction, the photos, and how the poses come to the cloud."""

    path: Path
    images_dir: Path | None
    frame: Literal["cloud", "file"]


@dataclass(frozen=True, eq=False)
class PlotState:
    """What a saved plot holds, in the program's own types.

    Attributes:
        source_path: Where the cloud is, absolute: beside the plot as it was saved, or else where it was then.
        other_source_path: Where it was then, if there is a file of its name at both places; only one is the cloud.
    """

    plot_id: str
    source_path: Path
    source_used: tuple[Path, ...]
    n_points: int
    fingerprint: str
    up_direction: tuple[float, float, float]
    scale: ScaleEstimate
    settings: Settings
    trunks: TrunkSet
    trees: Mapping[int, TreeRecord]
    other_source_path: Path | None = None
    north_direction: tuple[float, float, float] | None = None
    origin_src: tuple[float, float, float] = (0.0, 0.0, 0.0)
    evidence: ScaleEvidence = ScaleEvidence()
    cameras: CameraPlace | None = None
    masks: MaskRecord | None = None


def migrated(content: dict[str, Any]) -> dict[str, Any]:
    """What an earlier program wrote, as this one would have."""
    # Each version so far has only added what may be absent.
    content = content | {"schema_version": SCHEMA_VERSION}
    settings = content.get("settings")
    measure = settings.get("measure") if isinstance(settings, dict) else None
    if isinstance(settings, dict) and isinstance(measure, dict) and "bark_share" in measure:
        # The bark under the tape was set low to make up for bloat that was not taken off: one goes with the other.
        content["settings"] = settings | {"measure": {"bloat_m": 0.0} | measure}
    return content


def camera_place(folder: Path, saved: SavedCameras) -> CameraPlace:
    """Where the photos are now, of what was saved in `folder`."""
    path = there(folder, saved.path, saved.relative_path)
    images = None if saved.images_dir is None else there(folder, saved.images_dir, saved.relative_images_dir)
    return CameraPlace(path, images, saved.frame)


def there(folder: Path, before: str, relative: str | None) -> Path:
    """Beside the saved plot if there is such a file, else where it was."""
    beside = None if relative is None else Path(os.path.normpath(folder / relative))
    # os.path, not pathlib: that one raises where a folder may not be entered.
    return beside if beside is not None and os.path.exists(beside) else Path(before)  # noqa: PTH110


def locate(folder: Path, source: SavedSource) -> tuple[Path, Path | None]:
    """The source beside the plot if there is such a file, else where it was; and the other, if both are there."""
    before = Path(source.path)
    if source.relative_path is None:
        return before, None
    beside = Path(os.path.normpath(folder / source.relative_path))
    # os.path, not pathlib: that one raises where a folder may not be entered.
    if not os.path.exists(beside):  # noqa: PTH110
        return before, None
    return beside, before if before != beside and os.path.exists(before) else None  # noqa: PTH110


def saved_project(
    state: PlotState, folder: Path, trunks_file: str, next_id: int, undo: SavedUndo | None = None
) -> SavedProject:
    """What is written to project.json in `folder`, beside `trunks_file`."""
    scale = state.scale
    return SavedProject(
        plot_id=state.plot_id,
        source=SavedSource(
            path=str(state.source_path),
            relative_path=relative_to(state.source_path, folder),
            used=tuple(str(path) for path in state.source_used),
            n_points=state.n_points,
            fingerprint=state.fingerprint,
        ),
        up_direction=state.up_direction,
        scale=SavedScale(
            metres_per_unit=scale.metres_per_unit, source=scale.source, standard_error=scale.standard_error
        ),
        settings=state.settings,
        trunks_file=trunks_file,
        next_id=max(state.trunks.next_id, next_id),
        trees={i: SavedTree(**asdict(record)) for i, record in sorted(state.trees.items())},
        north_direction=state.north_direction,
        origin_src=state.origin_src,
        evidence=SavedEvidence.of(state.evidence),
        cameras=None if state.cameras is None else saved_cameras(state.cameras, folder),
        masks=None if state.masks is None else SavedMasks.of(state.masks, folder),
        undo=undo,
    )


def saved_cameras(cameras: CameraPlace, folder: Path) -> SavedCameras:
    """What is saved of them in a plot at `folder`."""
    images = cameras.images_dir
    return SavedCameras(
        path=str(cameras.path),
        relative_path=relative_to(cameras.path, folder),
        images_dir=None if images is None else str(images),
        relative_images_dir=None if images is None else relative_to(images, folder),
        frame=cameras.frame,
    )


def relative_to(path: Path, folder: Path) -> str | None:
    """As seen from a folder; None from another drive."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # another drive, on Windows
        return None
