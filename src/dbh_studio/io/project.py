"""The saved plot: a folder ``NAME.dbh`` that is at any instant, crash or not, one whole state.

    project.json    everything but the points of the trunks; the one file that counts
    trunks-7.npz    the trunks project.json speaks of; an older or newer one is what a crash left, and is removed
    history.jsonl   what was done, by whom and when; for the record, never read by the program
    history-1.jsonl the history of a plot that this one has replaced
    lock            held by the process that writes the plot
    cache/          may be deleted at any time

Each save writes a new trunks file (where trunks changed), then project.json in one step, then removes the old trunks.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, field_validator

from dbh_studio.core.inventory import TreeRecord, check_text
from dbh_studio.core.scale import ScaleEstimate, ScaleSource
from dbh_studio.core.scale_evidence import MarkedPoint, MarkerSquare, ScaleBar, ScaleEvidence, Sight
from dbh_studio.core.trunks import MAX_TRUNK_ID, Trunk, TrunkSet
from dbh_studio.errors import ProjectError, ProjectVersionError
from dbh_studio.io.atomic import atomic_file
from dbh_studio.io.lock import lock_file
from dbh_studio.io.ownfile import open_own_file
from dbh_studio.settings import Settings

SCHEMA_VERSION = 1
FOLDER_SUFFIX = ".dbh"
PROJECT_FILE = "project.json"
HISTORY_FILE = "history.jsonl"
LOCK_FILE = "lock"

_TRUNKS_FILE = re.compile(r"trunks-(\d+)\.npz")
_TRUNK_ARRAYS = ("ids", "ends", "points", "origins")
_MAX_POINTS = 2**31 - 1  # trunks are int32 indices
# How often a reader beside a busy writer looks again before it gives up.
_N_LOOKS = 10


def _check_text(text: str) -> str:
    check_text("it", text)
    return text


Text = Annotated[str, AfterValidator(_check_text)]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SavedSource(_Model):
    """Where the cloud is; `relative_path` is from the saved plot, so that both may be moved together."""

    path: Text
    relative_path: Text | None
    used: tuple[Text, ...]
    n_points: int = Field(ge=0, le=_MAX_POINTS)
    fingerprint: Text


class SavedScale(_Model):
    """A `ScaleEstimate`."""

    metres_per_unit: float = Field(gt=0)
    source: ScaleSource
    standard_error: float | None = Field(ge=0)


class SavedTree(_Model):
    """A `TreeRecord`."""

    species: Text = ""
    status: Literal["live", "dead", ""] = ""
    note: Text = ""
    tag: Text = ""
    edited: bool = False
    tree_id: int | None = Field(None, gt=0, le=MAX_TRUNK_ID)


class SavedSight(_Model):
    """A `Sight`."""

    image: Text
    u_px: float
    v_px: float


class SavedPoint(_Model):
    """A `MarkedPoint`."""

    xyz_src: tuple[float, float, float]
    sigma_src: float = Field(0.0, ge=0)
    sights: tuple[SavedSight, ...] = ()


class SavedBar(_Model):
    """A `ScaleBar`."""

    name: Text
    ends: tuple[SavedPoint, SavedPoint]
    length_m: float = Field(gt=0)
    length_se_m: float = Field(ge=0)
    role: Literal["control", "check"]


class SavedSquare(_Model):
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


class SavedEvidence(_Model):
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


class SavedCameras(_Model):
    """Where the photos are; relative paths as of `SavedSource`."""

    path: Text
    relative_path: Text | None = None
    images_dir: Text | None = None
    relative_images_dir: Text | None = None
    frame: Literal["cloud", "file"] = "cloud"


class SavedProject(_Model):
    """project.json, schema version 1."""

    schema_version: Literal[1] = 1
    plot_id: Text
    source: SavedSource
    up_direction: tuple[float, float, float]
    scale: SavedScale
    settings: Settings
    trunks_file: str = Field(pattern=f"^{_TRUNKS_FILE.pattern}$")
    next_id: int = Field(ge=1, le=MAX_TRUNK_ID + 1)
    trees: dict[int, SavedTree]
    north_direction: tuple[float, float, float] | None = None
    origin_src: tuple[float, float, float] = (0.0, 0.0, 0.0)
    evidence: SavedEvidence = SavedEvidence()
    cameras: SavedCameras | None = None

    @field_validator("up_direction", "north_direction")
    @classmethod
    def _is_unit(cls, up: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
        if up is not None and abs(sum(part * part for part in up) - 1) > 1e-6:
            raise ValueError("is not of length 1")
        return up


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


def is_project(path: Path | str) -> bool:
    """Whether `path` is a saved plot, or looks like one that has lost its project.json."""
    path = Path(path)
    # os.path, not pathlib: that one raises where a name is too long or a folder may not be entered.
    if not os.path.isdir(path):  # noqa: PTH112
        return False
    return path.suffix == FOLDER_SUFFIX or os.path.exists(path / PROJECT_FILE)  # noqa: PTH110


# ---- reading


def read_project(folder: Path | str) -> PlotState:
    """Read a saved plot, which another process may be writing. Nothing is written, whatever is found.

    Raises:
        ProjectVersionError: It was saved by a newer program.
        ProjectError: A file is missing or damaged; says which.
    """
    folder = Path(folder).absolute()
    saved, trunks = _read_whole(folder)
    strangers = sorted(set(saved.trees) - set(trunks.ids))
    if strangers:
        raise _damaged(folder / PROJECT_FILE, f"it describes trees {strangers} that have no trunk")
    source_path, other_source_path = _locate(folder, saved.source)
    return PlotState(
        plot_id=saved.plot_id,
        source_path=source_path,
        other_source_path=other_source_path,
        source_used=tuple(Path(path) for path in saved.source.used),
        n_points=saved.source.n_points,
        fingerprint=saved.source.fingerprint,
        up_direction=saved.up_direction,
        scale=ScaleEstimate(saved.scale.metres_per_unit, saved.scale.source, saved.scale.standard_error),
        settings=saved.settings,
        trunks=trunks,
        trees={i: TreeRecord(**tree.model_dump()) for i, tree in saved.trees.items()},
        north_direction=saved.north_direction,
        origin_src=saved.origin_src,
        evidence=_evidence(folder, saved.evidence),
        cameras=None if saved.cameras is None else _camera_place(folder, saved.cameras),
    )


def _evidence(folder: Path, saved: SavedEvidence) -> ScaleEvidence:
    try:
        return saved.evidence()
    except ValueError as error:
        raise _damaged(folder / PROJECT_FILE, f"evidence: {error}") from None


def _camera_place(folder: Path, saved: SavedCameras) -> CameraPlace:
    path = _there(folder, saved.path, saved.relative_path)
    images = None if saved.images_dir is None else _there(folder, saved.images_dir, saved.relative_images_dir)
    return CameraPlace(path, images, saved.frame)


def _there(folder: Path, before: str, relative: str | None) -> Path:
    """Beside the saved plot if there is such a file, else where it was."""
    beside = None if relative is None else Path(os.path.normpath(folder / relative))
    # os.path, not pathlib: that one raises where a folder may not be entered.
    return beside if beside is not None and os.path.exists(beside) else Path(before)  # noqa: PTH110


def _read_whole(folder: Path) -> tuple[SavedProject, TrunkSet]:
    """project.json and the trunks it names, which a writer removes as soon as it has saved others."""
    saved = _parse(folder / PROJECT_FILE)
    for _ in range(_N_LOOKS):
        try:
            return saved, _read_trunks(folder / saved.trunks_file, saved)
        except FileNotFoundError:
            missing, saved = saved.trunks_file, _parse(folder / PROJECT_FILE)
            if saved.trunks_file == missing:
                break
    raise _damaged(folder / missing, "it is missing")


def _parse(path: Path) -> SavedProject:
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise ProjectError(f"{path.parent.name} is not a saved plot: it has no {PROJECT_FILE}.") from None
    except OSError as error:
        raise ProjectError(f"{path} could not be read ({error.strerror or error}).") from error
    except (ValueError, RecursionError) as error:
        raise _damaged(path, f"it is not JSON: {error}") from None
    version = content.get("schema_version") if isinstance(content, dict) else None
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise _damaged(path, "it has no schema_version")
    if version > SCHEMA_VERSION:
        raise ProjectVersionError(
            f"{path.parent.name} was saved by a newer DBH Studio (schema {version}; this one reads {SCHEMA_VERSION}).",
            "Update DBH Studio to open it.",
        )
    try:
        return SavedProject.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        raise _damaged(path, f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None


def _damaged(path: Path, problem: str) -> ProjectError:
    return ProjectError(
        f"{path.name} in {path.parent.name} is damaged ({problem}).",
        "Nothing was changed. Restore the folder from a backup, or open the cloud itself to begin anew.",
    )


def _locate(folder: Path, source: SavedSource) -> tuple[Path, Path | None]:
    """The source beside the plot if there is such a file, else where it was; and the other, if both are there."""
    before = Path(source.path)
    if source.relative_path is None:
        return before, None
    beside = Path(os.path.normpath(folder / source.relative_path))
    # os.path, not pathlib: that one raises where a folder may not be entered.
    if not os.path.exists(beside):  # noqa: PTH110
        return before, None
    return beside, before if before != beside and os.path.exists(before) else None  # noqa: PTH110


def _read_trunks(path: Path, saved: SavedProject) -> TrunkSet:
    """Raises FileNotFoundError where there is no such file, and ProjectError whatever else is wrong with it."""
    n_points = saved.source.n_points
    try:
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            if sorted(archive.namelist()) != sorted(f"{name}.npy" for name in _TRUNK_ARRAYS):
                raise ValueError("it holds other things than trunks")
            ids, ends, points, origins = (_read_array(archive, f"{name}.npy", n_points) for name in _TRUNK_ARRAYS)
        _check_trunk_arrays(ids, ends, points, origins, n_points)
        parts = np.split(points, ends)[:-1]
        trunks = tuple(Trunk(int(i), part, str(origin)) for i, part, origin in zip(ids, parts, origins, strict=True))
        return TrunkSet(trunks, saved.next_id)
    except (FileNotFoundError, MemoryError):
        raise
    except Exception as error:
        # Archives and array headers can be damaged in more ways than their readers have names for.
        raise _damaged(path, str(error)) from error


def _read_array(archive: zipfile.ZipFile, name: str, n_most: int) -> NDArray[Any]:
    """One array as `_write_trunks` writes it: not packed, of one dimension.

    `np.load` would make room for as many numbers as the header asks for; here that is `n_most`, and no more than
    there are bytes in the file.
    """
    info = archive.getinfo(name)
    if info.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{name} is packed")
    with archive.open(info) as member:
        if np.lib.format.read_magic(member) != (1, 0):
            raise ValueError(f"{name} is of another version")
        shape, _, dtype = np.lib.format.read_array_header_1_0(member)
        if len(shape) != 1 or not 0 <= shape[0] <= n_most:
            raise ValueError(f"{name} has the shape {shape}")
        content = member.read()
    if dtype.hasobject or len(content) != shape[0] * dtype.itemsize:
        raise ValueError(f"{name} is not what its header says")
    return np.ndarray(shape, dtype, content)


def _check_trunk_arrays(ids: Any, ends: Any, points: Any, origins: Any, n_points: int) -> None:
    """Raise ValueError unless the arrays are what `_write_trunks` writes, and the trunks are disjoint."""
    is_integer = all(array.ndim == 1 and array.dtype.kind in "iu" for array in (ids, ends, points))
    if not is_integer or origins.ndim != 1 or origins.dtype.kind != "U":
        raise ValueError("its arrays are of the wrong kind")
    if not len(ids) == len(ends) == len(origins):
        raise ValueError("its arrays are of different lengths")
    if (np.diff(ends, prepend=0) <= 0).any() or (ends[-1] if len(ends) else 0) != len(points):
        raise ValueError("its trunks do not add up to its points")
    if len(points) and not 0 <= points.min() <= points.max() < n_points:
        raise ValueError("it speaks of points the cloud does not have")
    is_taken = np.zeros(n_points, bool)
    is_taken[points] = True
    if np.count_nonzero(is_taken) != len(points):
        raise ValueError("two of its trunks share points")


# ---- writing


class ProjectWriter:
    """The right to write one saved plot, from the moment it is made until it is closed.

    Args:
        folder: The plot's folder; made where it does not exist.

    Raises:
        ProjectLockedError: Another process writes it, or this one already does.
        ProjectError: The folder cannot be made or locked.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder).absolute()
        self._saved: tuple[TrunkSet, str] | None = None
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock: IO[str] | None = lock_file(self.folder / LOCK_FILE)
        except OSError as error:
            raise ProjectError(
                f"The folder {self.folder} cannot be written ({error.strerror or error}).", "Choose another folder."
            ) from error
        self._next_number = 1 + max((number for number, _ in self._trunk_files()), default=0)

    def adopt(self, state: PlotState) -> None:
        """Say that `state` was just read from the folder, so that its trunks need not be written again."""
        saved = _parse(self.folder / PROJECT_FILE)
        self._saved = state.trunks, saved.trunks_file

    def save(self, state: PlotState, *, next_id: int = 1) -> None:
        """Make the folder hold `state`. Whatever goes wrong, it then holds either that or what it held before.

        Args:
            next_id: Lower bound of the next id, where ids were given out that no trunk has any more.

        Raises:
            ProjectError: It cannot be written (disk full, …).
            ValueError: The writer is closed.
        """
        if self._lock is None:
            raise ValueError("the writer is closed")
        try:
            trunks_file = self._save_trunks(state.trunks)
            content = _saved_project(state, self.folder, trunks_file, next_id).model_dump_json(indent=1).encode()
            with atomic_file(self.folder / PROJECT_FILE) as file:
                file.write(content)
            _sync_folder(self.folder)
        except OSError as error:
            raise ProjectError(
                f"The plot could not be saved in {self.folder} ({error.strerror or error}).",
                "What was saved before is intact. Make room on the disk; the next change saves everything.",
            ) from error
        self._saved = state.trunks, trunks_file
        self._remove_leftovers(trunks_file)

    def log(self, entries: Iterable[Mapping[str, str]]) -> None:
        """Append to the history.

        Raises:
            ProjectError: It cannot be written.
        """
        text = "".join(json.dumps(dict(entry), ensure_ascii=False) + "\n" for entry in entries)
        if not text:
            return
        try:
            descriptor = open_own_file(self.folder / HISTORY_FILE, os.O_RDWR | os.O_CREAT | os.O_APPEND)
            with open(descriptor, "a+b") as file:
                _append_whole(file, text.encode("utf-8", errors="replace"))
        except OSError as error:
            raise ProjectError(f"The history of the plot could not be written ({error.strerror or error}).") from error

    def put_history_aside(self) -> None:
        """Begin a new history, where another plot is to be saved in place of the one that is there.

        Raises:
            ProjectError: It cannot be renamed.
        """
        history = self.folder / HISTORY_FILE
        aside = (history.with_stem(f"{history.stem}-{number}") for number in itertools.count(1))
        try:
            history.rename(next(path for path in aside if not os.path.lexists(path)))
        except FileNotFoundError:
            pass
        except OSError as error:
            raise ProjectError(
                f"The history of the plot could not be put aside ({error.strerror or error})."
            ) from error

    def close(self) -> None:
        """Give the plot free for others. The lock file stays: removing it would race with the next writer."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _trunk_files(self) -> Sequence[tuple[int, Path]]:
        found = [(_TRUNKS_FILE.fullmatch(path.name), path) for path in self.folder.iterdir()]
        return [(int(match.group(1)), path) for match, path in found if match]

    def _save_trunks(self, trunks: TrunkSet) -> str:
        """The name of a file that holds `trunks`, written unless the last save wrote them."""
        if self._saved is not None and self._saved[0].trunks == trunks.trunks:
            return self._saved[1]
        name = f"trunks-{self._next_number}.npz"
        self._next_number += 1
        with atomic_file(self.folder / name) as file:
            _write_trunks(file, trunks)
        # Durable before project.json can name it.
        _sync_folder(self.folder)
        return name

    def _remove_leftovers(self, trunks_file: str) -> None:
        """Remove what project.json does not name: it is written, so nothing else is needed any more."""
        old = [path for _, path in self._trunk_files() if path.name != trunks_file]
        for path in [*old, *self.folder.glob(".*.part")]:
            with contextlib.suppress(OSError):
                path.unlink()


def _sync_folder(folder: Path) -> None:
    """Make the names in a folder durable. Windows has no such call and needs none."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _append_whole(file: IO[bytes], content: bytes) -> None:
    """Append lines, after closing a line that a full disk or a crash cut off."""
    end = file.seek(0, os.SEEK_END)
    if end:
        file.seek(end - 1)
        if file.read(1) != b"\n":
            content = b"\n" + content
    file.write(content)
    file.flush()
    os.fsync(file.fileno())


def _write_trunks(file: IO[bytes], trunks: TrunkSet) -> None:
    points = [trunk.points for trunk in trunks]
    np.savez(
        file,
        ids=np.array(trunks.ids, np.int32),
        ends=np.cumsum([len(part) for part in points], dtype=np.int64),
        points=np.concatenate([np.empty(0, np.int32), *points]),
        origins=np.array([trunk.origin for trunk in trunks], np.str_),
    )


def _saved_project(state: PlotState, folder: Path, trunks_file: str, next_id: int) -> SavedProject:
    scale = state.scale
    return SavedProject(
        plot_id=state.plot_id,
        source=SavedSource(
            path=str(state.source_path),
            relative_path=_relative(state.source_path, folder),
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
        cameras=None if state.cameras is None else _saved_cameras(state.cameras, folder),
    )


def _saved_cameras(cameras: CameraPlace, folder: Path) -> SavedCameras:
    images = cameras.images_dir
    return SavedCameras(
        path=str(cameras.path),
        relative_path=_relative(cameras.path, folder),
        images_dir=None if images is None else str(images),
        relative_images_dir=None if images is None else _relative(images, folder),
        frame=cameras.frame,
    )


def _relative(path: Path, folder: Path) -> str | None:
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # another drive, on Windows
        return None
