"""The trunks of a photo plot carried to a LiDAR cloud of the same place, and both diameters side by side.

    report = transfer_plot(*photo_side(session), request, progress=…)

`transfer_plot` is pure but for the files it writes, and picklable, for a job. It lays the clouds on each other (by the
walks of the two sensors as in the paper, else by the stems), carries the labels, saves the LiDAR plot
``NAME_lidar.dbh`` with trunks of the same ids, measures it with the photo plot's settings, and writes the table.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from dbh_studio.app import commands
from dbh_studio.app.document import Direction, Document
from dbh_studio.app.opening import open_plot, save_as
from dbh_studio.app.session import Session
from dbh_studio.app.transfer_align import Laid, lay_plots
from dbh_studio.app.transfer_report import TreeComparison, WalkPicture, compare_trees, write_comparison
from dbh_studio.app.transfer_walks import WalkFile
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.inventory import TreeRecord
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.transforms import Similarity
from dbh_studio.core.trunks import Trunk, TrunkSet
from dbh_studio.errors import AlignmentError, CommandError, ProjectExistsError, SettingError, UnscaledCloudError
from dbh_studio.io.inventory_csv import check_absent, check_not_source
from dbh_studio.io.project import FOLDER_SUFFIX, PROJECT_FILE, is_project

if TYPE_CHECKING:
    from dbh_studio.stages.label_carry import CarriedLabels, CarriedTrunks

# Below this share of the trunks' points with a LiDAR point in reach, the clouds do not lie on each other.
_LEAST_COVERED = 0.2
# A scanner's own range error over a plot, as a share: no scale taken from it is surer.
_SCANNER_SHARE = 5e-4
# A label from farther away says nothing.
_FARTHEST_M = 2.0
# Bytes of NAME; file systems allow 255 with what is put behind it.
_LONGEST_NAME = 200


@dataclass(frozen=True)
class TransferRequest:
    """What is to be carried where.

    Attributes:
        lidar: A cloud, or a saved plot, which stays as it is.
        out_dir: Where ``NAME_lidar.dbh`` and ``NAME_lidar_comparison.csv`` go.
        name: NAME, as that of the photo plot's folder.
        photo_walk: The camera's trajectory; None takes the photos of the plot.
        lidar_walk: The scanner's; None lays the clouds on each other by their stems.
        clock_offset_s: Scanner's clock minus the camera's; None searches for it.
        with_scale: Similarity: the LiDAR may stretch the photo cloud. False is rigid.
        refine: Fit stems and ground on each other afterwards.
        reach_m: How far a label is carried; the paper's is 0.2.
        set_scale: The photo plot is to have the LiDAR's scale; one without trunks gets its trunks by it.
        lidar_scale: Metres per unit of the LiDAR file, or a unit's name; None for what the file says.
        lidar_up: Likewise.
        overwrite: Replace what an earlier transfer left.
    """

    lidar: Path
    out_dir: Path
    name: str
    photo_walk: WalkFile | None = None
    lidar_walk: WalkFile | None = None
    clock_offset_s: float | None = None
    with_scale: bool = True
    refine: bool = False
    reach_m: float = 0.2
    set_scale: bool = False
    lidar_scale: str | None = None
    lidar_up: str | Direction | None = None
    overwrite: bool = False


@dataclass(frozen=True, eq=False)
class TransferReport:
    """What came of it. Picklable.

    Attributes:
        project_dir: The LiDAR plot.
        csv_path: The table of the two diameters.
        method: ``trajectories`` or ``stems``.
        lidar_from_photo: World of the photo plot to that of the LiDAR plot.
        n_pairs: Poses or stems it rests on.
        rms_m: Of these.
        surface_rms_m: Of stems and ground after refinement; NaN where it was not refined.
        error_m: Standard error at the trunks, where it rests on the walks alone; NaN otherwise.
        clock_offset_s: Scanner's clock minus the camera's; None without walks.
        covered: Share of the trunks' points with a LiDAR point in reach.
        walk: The residuals, for a picture; None without walks.
        scale: Metres per unit of the photo cloud as the LiDAR has it; None where the fit was rigid.
        scale_change: By how much that differs from the photo plot's own, as a share; None where it has none.
        photo_scale: Whose scale the photo diameters in the table have.
        trees: One row for each trunk of the photo plot.
        lost: Ids that no LiDAR point lies near to.
        found_trunks: Trunks of the photo plot that were looked for by the LiDAR's scale; None where it had some.
        notes: What the person should know, in plain words.
    """

    project_dir: Path
    csv_path: Path
    method: Literal["given", "picked", "stems", "trajectories"]
    lidar_from_photo: Similarity
    n_pairs: int
    rms_m: float
    surface_rms_m: float
    error_m: float
    clock_offset_s: float | None
    covered: float
    walk: WalkPicture | None
    scale: ScaleEstimate | None
    scale_change: float | None
    photo_scale: Literal["own", "lidar"]
    trees: tuple[TreeComparison, ...]
    lost: tuple[int, ...]
    found_trunks: TrunkSet | None
    notes: tuple[str, ...]


def _rescaled(lidar_from_photo: Similarity, photo: Session, before: float) -> Similarity:
    """The same from the photo plot's world after its scale has changed."""
    factor = before / photo.document.world_from_source.scale
    return lidar_from_photo @ Similarity(np.eye(3), np.zeros(3), factor)


def photo_side(session: Session) -> tuple[PointCloud, Document]:
    """What a transfer reads of an open plot."""
    document = session.document
    # Ids given out and taken back must not be given out again, or the two plots would mean other trees by them.
    return session.cloud, replace(document, trunks=replace(document.trunks, next_id=session.next_id))


def plot_file_name(folder: Path) -> str:
    """NAME of a saved plot's folder ``NAME.dbh``."""
    return folder.absolute().name.removesuffix(FOLDER_SUFFIX) or "plot"


def apply_scale(session: Session, report: TransferReport) -> None:
    """Give the photo plot the LiDAR's scale, and the trunks that were found by it where it had none: one step each.

    Raises:
        CommandError: The fit gave no scale.
    """
    if report.scale is None:
        raise CommandError("A rigid fit gives no scale.", "Let the scale be fitted.")
    session.do(commands.set_scale(report.scale))
    if report.found_trunks is not None and not len(session.document.trunks):
        session.do(commands.replace_trunks(report.found_trunks))


def transfer_plot(
    cloud: PointCloud, document: Document, request: TransferRequest, *, progress: Progress = ignore_progress
) -> TransferReport:
    """Carry the trunks of a photo plot to a LiDAR cloud.

    Args:
        cloud: Of the photo plot.
        document: Of the photo plot; nothing of it is changed.
        request: See there.
        progress: Called in between.

    Raises:
        AlignmentError: The clouds cannot be laid on each other; says why and what helps.
        CommandError: The photo plot has no trunks, or no scale where one is needed.
        UnscaledCloudError: The LiDAR file does not tell its unit.
        ProjectExistsError: There is such a plot already and `overwrite` is False.
        StudioError: A file cannot be read or written.
    """
    project_dir, csv_path = output_paths(request)
    check_outputs(request)
    _check_photo(document, request)
    photo = Session(cloud, document)
    lidar = _open_lidar(request, subprogress(progress, 0.0, 0.2))
    laid = lay_plots(photo, lidar, request, progress=subprogress(progress, 0.2, 0.6))
    carried, trunks, covered, notes = _carry(photo, lidar, laid, request, subprogress(progress, 0.6, 0.8))
    lengths = photo.document.world_from_source.scale
    scale, scale_change = _scale(photo, document.scale, laid, request)
    photo_scale: Literal["own", "lidar"] = "own"
    if scale is not None and (request.set_scale or not document.scale.is_known):
        photo.do(commands.set_scale(scale))
        photo_scale = "lidar"
        notes += ("The photo diameters have the LiDAR's scale, so their mean agrees with it by construction.",)
    lidar_from_photo = _rescaled(laid.alignment.target_from_source, photo, lengths)
    trees = _saved(photo, lidar, trunks, lidar_from_photo, request, subprogress(progress, 0.8, 1.0))
    alignment = laid.alignment
    return TransferReport(
        project_dir=project_dir,
        csv_path=csv_path,
        method=alignment.method,
        lidar_from_photo=lidar_from_photo,
        n_pairs=alignment.n_pairs,
        rms_m=alignment.rms_m,
        surface_rms_m=alignment.surface_rms_m,
        error_m=laid.error_m,
        clock_offset_s=None if alignment.walk is None else alignment.walk.offset_s,
        covered=covered,
        walk=WalkPicture.of(alignment.walk),
        scale=scale,
        scale_change=scale_change,
        photo_scale=photo_scale,
        trees=trees,
        lost=carried.lost,
        found_trunks=photo.document.trunks if not len(document.trunks) else None,
        notes=(*laid.notes, *notes),
    )


def _saved(
    photo: Session,
    lidar: Session,
    trunks: CarriedTrunks,
    lidar_from_photo: Similarity,
    request: TransferRequest,
    progress: Progress,
) -> tuple[TreeComparison, ...]:
    """Measure both plots, then save the LiDAR plot and the table."""
    project_dir, csv_path = output_paths(request)
    new = _lidar_session(photo.document, lidar, trunks)
    try:
        trees = compare_trees(photo, new, lidar_from_photo, trunks.n_carried, progress=subprogress(progress, 0.0, 0.9))
        progress(0.9, "Saving the LiDAR plot")
        n = len(trunks.point_sets)
        label = f"Carry {n} {'trunk' if n == 1 else 'trunks'} from {photo.document.plot_id}"
        save_as(new, project_dir, overwrite=request.overwrite, background=False, label=label)
        write_comparison(csv_path, trees)
        new.flush()
    finally:
        new.close()
    progress(1.0, "")
    return trees


def output_paths(request: TransferRequest) -> tuple[Path, Path]:
    """Where the LiDAR plot and the table go."""
    name = f"{request.name.encode('utf-8', 'replace')[:_LONGEST_NAME].decode('utf-8', 'ignore')}_lidar"
    return request.out_dir / f"{name}{FOLDER_SUFFIX}", request.out_dir / f"{name}_comparison.csv"


def check_outputs(request: TransferRequest) -> None:
    """Raise ProjectExistsError or FileError where the results would take the place of something."""
    project_dir, csv_path = output_paths(request)
    if os.path.realpath(request.lidar) == os.path.realpath(project_dir):
        raise ProjectExistsError(
            f"{project_dir.name} is what the trunks are to be carried to, and would be overwritten.",
            "Choose another folder (--out).",
        )
    check_not_source(csv_path, [request.lidar])
    if request.overwrite:
        return
    if (project_dir / PROJECT_FILE).exists():
        raise ProjectExistsError(
            f"There is a plot {project_dir.name} from an earlier transfer, perhaps with edits.",
            "Choose another folder (--out), or say that it may be overwritten (--overwrite).",
        )
    check_absent(csv_path)


def _check_photo(document: Document, request: TransferRequest) -> None:
    if not 0.0 < request.reach_m <= _FARTHEST_M:
        raise SettingError(
            f"Labels cannot be carried {request.reach_m:g} m far.", f"Give more than 0 and at most {_FARTHEST_M:g} m."
        )
    if len(document.trunks):
        return
    if document.scale.is_known:
        remedy = "Find them first, in the studio or with `dbh-studio run`."
    elif not request.set_scale:
        remedy = "It has no scale either: let it take the LiDAR's (--set-scale), and its trunks are found by that."
    else:
        return
    raise CommandError(f"The plot {document.plot_id} has no trunks to carry.", remedy)


def _open_lidar(request: TransferRequest, progress: Progress) -> Session:
    if is_project(request.lidar) and (request.lidar_scale is not None or request.lidar_up is not None):
        raise SettingError(
            f"{request.lidar.name} is a saved plot and has its own scale and up direction.",
            "Leave --lidar-scale and --lidar-up away, or change them in that plot.",
        )
    lidar = open_plot(
        request.lidar, scale=request.lidar_scale, up=request.lidar_up, read_only=True, progress=progress
    )  # fmt: skip
    if not lidar.document.scale.is_known:
        lidar.close()
        raise UnscaledCloudError(
            f"{request.lidar.name} does not tell how long its unit is.",
            "Say it: --lidar-scale metres, or metres per unit.",
        )
    return lidar


def _carry(
    photo: Session, lidar: Session, laid: Laid, request: TransferRequest, progress: Progress
) -> tuple[CarriedLabels, CarriedTrunks, float, tuple[str, ...]]:
    """The labels, the trunks made of them, how much of the photo trunks the LiDAR covers, and notes.

    Raises:
        AlignmentError: The clouds do not lie on each other.
    """
    from dbh_studio.stages.label_carry import carried_trunks, carry_labels, share_covered

    document = photo.document
    source, labels = photo.points_world(), document.trunks.labels(len(photo.cloud))
    is_trunk = labels > 0
    source, labels = source[is_trunk], labels[is_trunk]
    target, onto = lidar.points_world(), laid.alignment.target_from_source
    first = subprogress(progress, 0.0, 0.4)
    carried = carry_labels(source, labels, target, onto, reach_m=request.reach_m, progress=first)
    covered = share_covered(source, target, carried, onto, reach_m=request.reach_m)
    if covered < _LEAST_COVERED:
        help_ = (
            "" if request.refine else " If they are nearly right, fit stems and ground on each other too (--refine)."
        )
        raise AlignmentError(
            f"The clouds do not lie on each other: only {covered:.0%} of the trunks' points have a LiDAR point within "
            f"{request.reach_m:g} m.",
            f"Look whether both are of one place and each trajectory is in the frame of its cloud.{help_}",
        )
    ground, settings = lidar.ground(subprogress(progress, 0.4, 0.6)), document.settings.trunks
    trunks = carried_trunks(target, ground, carried, settings=settings, progress=subprogress(progress, 0.6, 1.0))
    if not trunks.point_sets:
        raise AlignmentError(
            "No stem could be made out among the LiDAR points that lie near the trunks.",
            "Look at the ground and the up direction of the LiDAR cloud.",
        )
    notes: tuple[str, ...] = ()
    if trunks.as_carried:
        names = ", ".join(str(i) for i in trunks.as_carried)
        notes += (f"No stem could be made out among the points carried for {names}: they are as they came over.",)
    missing = [i for i in document.trunks.ids if i not in trunks.point_sets]
    if missing:
        names = ", ".join(str(i) for i in missing)
        notes += (f"Not in the LiDAR cloud: {names}.",)
    return carried, trunks, covered, notes


def _scale(
    photo: Session, before: ScaleEstimate, laid: Laid, request: TransferRequest
) -> tuple[ScaleEstimate | None, float | None]:
    """The photo cloud's scale as the LiDAR has it, and by which share it differs from the one before."""
    if not request.with_scale:
        return None, None
    alignment = laid.alignment
    metres_per_unit = photo.document.scale.metres_per_unit * alignment.target_from_source.scale
    share = alignment.scale_error
    error = (
        None if share is None or not np.isfinite(share) else metres_per_unit * float(np.hypot(share, _SCANNER_SHARE))
    )
    change = metres_per_unit / before.metres_per_unit - 1.0 if before.is_known else None
    return ScaleEstimate(metres_per_unit, "lidar", error), change


def _lidar_session(photo: Document, lidar: Session, trunks: CarriedTrunks) -> Session:
    """The LiDAR plot with the trunks: the photo plot's ids, settings, and what is said about the trees."""
    made = TrunkSet(tuple(Trunk(i, rows, "carried") for i, rows in trunks.point_sets.items()), photo.trunks.next_id)
    # Whose points a person changed was said of the other cloud.
    trees = {i: replace(record, edited=False) for i, record in photo.trees.items() if i in made}
    document = replace(
        lidar.document,
        plot_id=f"{photo.plot_id}_lidar",
        trunks=made,
        trees={i: record for i, record in trees.items() if record != TreeRecord()},
        settings=photo.settings,
    )
    return Session(lidar.cloud, document, data_check=lidar.data_check, mesh=lidar.mesh, notes=lidar.notes)
