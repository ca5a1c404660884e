"""Photos and markers in one go: what the command line asks for, and what `run` does on its way to diameters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from dbh_studio.app.cameras import Cameras, cameras_of, cloud_sample, read_cameras, require_fit
from dbh_studio.app.commands import set_cameras
from dbh_studio.app.document import CameraSource
from dbh_studio.app.found_markers import MarkerSearch, apply_search, checks_of, place_markers, search_markers
from dbh_studio.app.jobs import run_job
from dbh_studio.app.session import Session
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.scale_evidence import MarkerKey
from dbh_studio.errors import CommandError, FileError, SettingError
from dbh_studio.settings import MarkerSettings

if TYPE_CHECKING:
    from dbh_studio.stages.marker_detect import Detection

# With these verdicts the number may be off by the size of a marker: a person must look before trees are measured by it.
STOPPING_VERDICTS = frozenset({"inconsistent", "default_side"})


@dataclass(frozen=True)
class PhotoRequest:
    """Which photos, and what is known of their markers.

    Attributes:
        cameras: The reconstruction with the poses; None looks where the cloud is, or takes those of the saved plot.
        images_dir: Where the photos are; None beside the reconstruction.
        sides: Side of the black square per marker, metres: by number (``7``) or dictionary and number
            (``DICT_4X4_50 7``); the others have that of `settings`.
        settings: Dictionaries, ids, side.
        only_named: Ignore markers that `sides` does not name: a stand may carry others.
    """

    cameras: Path | None = None
    images_dir: Path | None = None
    sides: Mapping[str, float] = field(default_factory=dict)
    settings: MarkerSettings = MarkerSettings()  # noqa: RUF009 - frozen
    only_named: bool = False


def add_photos(
    session: Session, request: PhotoRequest, *, in_process: bool = True, progress: Progress = ignore_progress
) -> Cameras:
    """Read the photos of a plot and keep where they are, as one step.

    Raises:
        FileError: There are none, or they cannot be read.
        CommandError: They do not belong to the cloud.
    """
    if request.cameras is None and request.images_dir is None and session.document.cameras is not None:
        known = cameras_of(session, progress)
        assert known is not None
        require_fit(known)
        return known
    source = CameraSource.of(_place(session, request), request.images_dir)
    cameras: Cameras = run_job(
        read_cameras, source, cloud_sample(session.cloud), in_process=in_process, progress=progress
    )
    require_fit(cameras)
    session.remember_cameras(cameras)
    session.do(set_cameras(cameras.source))
    return cameras


def _place(session: Session, request: PhotoRequest) -> Path:
    if request.cameras is not None:
        return request.cameras
    before = session.document.cameras
    if before is not None:
        return before.path
    path = session.document.source.path
    return path if path.is_dir() else path.parent


def scale_by_photos(
    session: Session, request: PhotoRequest, *, in_process: bool = True, progress: Progress = ignore_progress
) -> MarkerSearch:
    """Read the photos, find the markers, and set the scale.

    Raises:
        FileError: The photos cannot be read.
        CommandError: They give no scale, or one that contradicts itself; says why. The scale is then as before.
    """
    cameras = add_photos(session, request, in_process=in_process, progress=subprogress(progress, 0.0, 0.05))
    if not cameras.n_found:
        raise FileError(
            cameras.source.path,
            f"None of its {len(cameras.posed)} photos was found.",
            "Say in which folder they are (--images).",
        )
    search: MarkerSearch = run_job(
        search_markers,
        cameras.posed,
        struck=session.document.evidence.struck,
        settings=request.settings,
        checks=tuple(checks_of(session.document)),
        in_process=in_process,
        progress=subprogress(progress, 0.05, 1.0),
    )
    sides = _sides(search.detections, request.sides)
    if sides:
        evidence = session.document.evidence
        believed = [each for each in search.detections if not request.only_named or each.key in sides]
        search = place_markers(
            believed, cameras.posed, sides, evidence.struck, request.settings, checks_of(session.document)
        )
    verdict = search.report.verdict
    if verdict.code in STOPPING_VERDICTS:
        raise CommandError(verdict.message, verdict.remedy)
    session.do(apply_search(session.document, search))
    return search


def _sides(detections: Iterable[Detection], wanted: Mapping[str, float]) -> dict[MarkerKey, float]:
    """Sides by (dictionary, id) of the markers that were seen.

    Raises:
        SettingError: A marker that was named was not seen.
    """
    keys = {detection.key for detection in detections}
    sides: dict[MarkerKey, float] = {}
    for name, side_m in wanted.items():
        matching = [key for key in keys if name in (str(key[1]), f"{key[0]} {key[1]}")]
        if not matching:
            seen = ", ".join(f"{dictionary} {number}" for dictionary, number in sorted(keys)) or "none"
            raise SettingError(f"Marker {name} was not seen in the photos.", f"Seen: {seen}.")
        sides |= dict.fromkeys(matching, side_m)
    return sides
