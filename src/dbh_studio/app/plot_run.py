"""The whole unattended run of a plot: read it, find its trunks, measure them, write the table and the saved plot."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dbh_studio.app.cache import why_not_writable
from dbh_studio.app.commands import change_settings, rename_plot
from dbh_studio.app.document import Direction
from dbh_studio.app.mask_request import LadderRequest, MaskRequest
from dbh_studio.app.names import file_name
from dbh_studio.app.opening import open_plot, plot_name, read_cloud, save_as
from dbh_studio.app.pipeline import segment, segment_plot, trunks_from_ids
from dbh_studio.app.plot_masks import MASKS_FOLDER, carry_masks, masks_folder
from dbh_studio.app.session import Session
from dbh_studio.app.threads import CallAhead
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.errors import CommandError, ProjectError, ProjectExistsError
from dbh_studio.io.inventory_csv import check_absent, check_not_source, check_replaceable, write_inventory_csv
from dbh_studio.io.project import FOLDER_SUFFIX, PROJECT_FILE, is_project
from dbh_studio.settings import Settings

if TYPE_CHECKING:
    from dbh_studio.app.brought_masks import MaskSet, VotingMasks
    from dbh_studio.app.photo_scale import PhotoRequest
    from dbh_studio.core.reconstruction import Reconstruction

__all__ = ["RunResult", "run_plot"]


@dataclass(frozen=True, eq=False)
class RunResult:
    """What `run_plot` made.

    Attributes:
        session: The plot, still open; close it.
        csv_path: The inventory.
        project_dir: The saved plot.
        notes: What the person should know, in plain words.
        timings_s: Seconds by step.
    """

    session: Session
    csv_path: Path
    project_dir: Path
    notes: tuple[str, ...]
    timings_s: dict[str, float] = field(default_factory=dict)


def run_plot(
    path: Path | str,
    out_dir: Path | str,
    *,
    scale: float | str | ScaleEstimate | None = None,
    up: str | Direction | None = None,
    settings: Settings | Mapping[str, Mapping[str, Any]] | None = None,
    photos: PhotoRequest | None = None,
    masks: MaskRequest | LadderRequest | None = None,
    plot_id: str = "",
    relocate: Path | str | None = None,
    overwrite: bool = False,
    needs_search: bool = False,
    in_process: bool = True,
    progress: Progress = ignore_progress,
) -> RunResult:
    """Read a plot, find its trunks, measure them, and write ``NAME.csv`` and the saved plot ``NAME.dbh``.

    A saved plot is measured where it is, with the trunks it has; trunks are looked for only if it has none.

    Args:
        settings: Instead of the defaults, or of those the saved plot has; as section -> name -> value, only the named
            ones are changed.
        photos: Take the scale from markers in these photos.
        masks: Find the trunks by these masks of the photos, or by the best that is there (`LadderRequest`). Those a
            saved plot has are replaced, if `overwrite` allows.
        plot_id: What to call the plot; the file's name by default.
        relocate: Where the cloud of a saved plot is now.
        overwrite: Replace a plot that an earlier run left in `out_dir`, and ``NAME.csv``. Edits made in them are lost.
        needs_search: The steps of the search for trunks are wanted: fail before the work where there will be none.
        in_process: Work here rather than in a child process.

    Raises:
        CommandError: `needs_search`, and the trunks were not searched for.
        UnscaledCloudError: The data does not tell its unit and no scale was given.
        ProjectExistsError: `out_dir` has such a plot already and `overwrite` is False.
        ProjectError: `out_dir` cannot be written; told before the work is done.
        FileError: ``NAME.csv`` is what the plot is read from, or was not written by this plot and `overwrite` is False.
        StudioError: What `open_plot` and the stages raise.
    """
    path, out_dir = Path(path), Path(out_dir)
    name = file_name(plot_id or plot_name(path))
    is_saved = is_project(path)
    project_dir = path if is_saved else out_dir / f"{name}{FOLDER_SUFFIX}"
    if not is_saved and not overwrite and (project_dir / PROJECT_FILE).exists():
        raise ProjectExistsError(
            f"There is a saved plot {project_dir.name} from an earlier run, perhaps with edits.",
            "Run on it to measure it again, choose another folder, or say that it may be overwritten.",
        )
    csv_path = out_dir / f"{name}.csv"
    _check_table(csv_path, path, is_saved=is_saved, overwrite=overwrite)
    _check_writable(out_dir)
    timings_s: dict[str, float] = {}
    # Both cores from the beginning: the trunks are looked for while the data are still being looked at.
    ahead = CallAhead() if in_process and not (is_saved or photos or settings or masks) else None
    with _timed(timings_s, "read"), ahead or nullcontext():
        part = subprogress(progress, 0.0, 0.3)
        read = read_cloud if ahead is None else partial(_read_and_begin, ahead)
        session = open_plot(
            path, scale=scale, up=up, relocate=relocate, background_save=False, read=read, progress=part
        )
    try:
        # Only now are the files of a folder known, and where a saved plot found its cloud.
        check_not_source(csv_path, session.document.source.used)
        _configure(session, settings, plot_id)
        notes = [*session.notes]
        if needs_search and masks is None:
            _check_searched(session)
        mask_set: VotingMasks | None = None
        if masks is not None:
            _check_replaceable_trunks(session, overwrite=overwrite)
        if isinstance(masks, MaskRequest):
            # Before the markers are looked for, which takes minutes: a wrong path is told at once.
            if photos is None:
                session.require_scale()
            with _timed(timings_s, "look at the masks"):
                mask_set = _masks(session, masks, progress=progress)
                notes += mask_set.notes
        if photos is not None:
            with _timed(timings_s, "scale"):
                notes += _scaled(session, photos, in_process=in_process, progress=progress)
        session.require_scale()
        if isinstance(masks, LadderRequest):
            with _timed(timings_s, "masks"):
                kept_before = None if is_saved else project_dir
                part = subprogress(progress, 0.3, 0.6)
                mask_set, said = _by_ladder(session, masks, kept_before, in_process=in_process, progress=part)
                notes += said
        if masks is not None and mask_set is not None:
            with _timed(timings_s, "ground, votes and trunks"):
                part = subprogress(progress, 0.6 if isinstance(masks, LadderRequest) else 0.3, 0.7)
                notes += _by_masks(session, mask_set, masks, in_process=in_process, progress=part)
        elif masks is not None or not len(session.document.trunks):
            with _timed(timings_s, "ground and trunks"):
                part = subprogress(progress, 0.6 if masks is not None else 0.3, 0.7)
                notes += segment(session, progress=part, in_process=in_process, ahead=ahead)
        elif is_saved:
            notes.append(f"The trunks are those the plot was saved with ({len(session.document.trunks)}).")
        with _timed(timings_s, "diameters"):
            inventory = session.inventory(subprogress(progress, 0.7, 0.99))
        with _timed(timings_s, "write"):
            if not is_saved:
                label = f"Create the plot and find {len(inventory)} trunks"
                save_as(session, project_dir, overwrite=overwrite, background=False, label=label)
            write_inventory_csv(csv_path, inventory)
            session.flush()
    except BaseException:
        if ahead is not None:
            ahead.give_up()
        session.close()
        raise
    if inventory.n_refused:
        notes.append(f"{inventory.n_refused} of {len(inventory)} stems have no diameter; the table says why.")
    progress(1.0, "")
    return RunResult(session, csv_path, project_dir, tuple(notes), timings_s)


def _scaled(session: Session, photos: PhotoRequest, *, in_process: bool, progress: Progress) -> list[str]:
    """Set the scale by markers; what the person should know of it."""
    from dbh_studio.app.photo_scale import scale_by_photos

    verdict = scale_by_photos(session, photos, in_process=in_process, progress=progress).report.verdict
    return [f"{verdict.message} {verdict.remedy}".strip()]


def _check_replaceable_trunks(session: Session, *, overwrite: bool) -> None:
    if len(session.document.trunks) and not overwrite:
        raise CommandError(
            f"The saved plot has {len(session.document.trunks)} trunks already, perhaps with edits.",
            "Measure it without masks, or say that its trunks may be replaced (--overwrite).",
        )


def _check_searched(session: Session) -> None:
    """Raise CommandError where the trunks of a run come from elsewhere than a search."""
    from dbh_studio.core.treeids import find_tree_id_attribute

    if len(session.document.trunks):
        if session.last_search is None:
            raise CommandError(
                "The trunks of this plot were not searched for, so there are no steps to write.",
                "Find them first: `dbh-studio run` on the cloud itself searches for them. Or leave --steps away.",
            )
        return
    settings = session.document.settings
    name = find_tree_id_attribute(session.cloud) if settings.trunks.use_existing_ids else None
    if name is not None and len(trunks_from_ids(session.cloud.attributes[name], settings.measure.min_points)[0]):
        raise CommandError(
            f"The trees are taken over from the file (its attribute {name}), so there are no steps of a search.",
            "Leave --steps away, or have them searched for: `--set trunks.use_existing_ids=false`.",
        )


def _masks(session: Session, request: MaskRequest, *, progress: Progress) -> MaskSet:
    from dbh_studio.app.image_trunks import masks_of_plot

    return masks_of_plot(session, request, progress=subprogress(progress, 0.3, 0.3))


def _by_ladder(
    session: Session, request: LadderRequest, kept_before: Path | None, *, in_process: bool, progress: Progress
) -> tuple[VotingMasks | None, tuple[str, ...]]:
    """Masks to vote with, None where geometry is to find the trunks; and what the person should know.

    Those an earlier run left where this one will be saved are used again, as far as their photos are the same.
    """
    from dbh_studio.app.mask_run import take_ladder

    if kept_before is not None:
        carry_masks(kept_before / MASKS_FOLDER, masks_folder(session), move=False, newer_wins=True)
    taken = take_ladder(session, request, in_process=in_process, progress=progress)
    return taken.masks, taken.notes


def _by_masks(
    session: Session, masks: VotingMasks, request: MaskRequest | LadderRequest, *, in_process: bool, progress: Progress
) -> tuple[str, ...]:
    """Find the trunks by masks; what the person should know of it."""
    from dbh_studio.app.image_trunks import trunks_from_masks

    found = trunks_from_masks(
        session,
        masks,
        request.votes,
        accept_candidates=request.accept_candidates,
        in_process=in_process,
        progress=progress,
    )
    return found.notes


def _read_and_begin(ahead: CallAhead, path: Path, *, progress: Progress = ignore_progress) -> Reconstruction:
    """Read a cloud, and begin to look for its trunks as it lies: nearly every LiDAR file is in metres with +z up."""
    from dbh_studio.core.treeids import find_tree_id_attribute

    # Decompressing holds no lock of Python's, so the imports of what comes next go on beside it.
    imports = threading.Thread(target=_import_stages)
    imports.start()
    try:
        reconstruction = read_cloud(path, progress=progress)
    finally:
        imports.join()
    if reconstruction.provenance.is_lidar and find_tree_id_attribute(reconstruction.cloud) is None:
        ahead.begin(segment_plot, reconstruction.cloud.xyz, Settings(), None)
    return reconstruction


def _import_stages() -> None:
    """Import what the next steps need; what is broken is told where it is used."""
    with suppress(Exception):
        import dbh_studio.core.datacheck
        import dbh_studio.stages.measure
        import dbh_studio.stages.segment  # noqa: F401


@contextmanager
def _timed(timings_s: dict[str, float], step: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    timings_s[step] = time.perf_counter() - start


def _check_table(csv_path: Path, path: Path, *, is_saved: bool, overwrite: bool) -> None:
    """Raise FileError where the table of a run would take the place of something that cannot be had again."""
    if not path.is_dir():
        check_not_source(csv_path, [path])
    if overwrite:
        return
    # A saved plot writes its table again; one that is yet to be made has none.
    if is_saved:
        check_replaceable(csv_path)
    else:
        check_absent(csv_path)


def _check_writable(folder: Path) -> None:
    """Raise ProjectError unless `folder` can be written or made; makes nothing."""
    if problem := why_not_writable(folder):
        raise ProjectError(f"The folder {folder} cannot be written ({problem}).", "Choose another folder.")


def _configure(session: Session, settings: Settings | Mapping[str, Mapping[str, Any]] | None, plot_id: str) -> None:
    if plot_id:
        session.do(rename_plot(plot_id))
    changes = settings.model_dump() if isinstance(settings, Settings) else settings or {}
    for section, values in changes.items():
        session.do(change_settings(section, **values))
