"""Opening a plot: a cloud, a mesh, a folder of them, or what was saved of one; and saving it elsewhere."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dbh_studio.app.autosave import Autosave
from dbh_studio.app.candidates import keep_offers, kept_offers
from dbh_studio.app.commands import set_scale, set_up
from dbh_studio.app.document import Direction, Document, SourceInfo, unit_direction
from dbh_studio.app.last_search import keep_search, kept_search
from dbh_studio.app.plot_masks import MASKS_FOLDER, carry_masks, masks_folder
from dbh_studio.app.saved_states import history_from_states
from dbh_studio.app.session import History, Session
from dbh_studio.app.session_checks import check_scale
from dbh_studio.app.vote_cache import carry_votes, votes_folder
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.scale import ScaleEstimate, ScaleSource
from dbh_studio.core.transforms import UP_AXES
from dbh_studio.errors import (
    FileError,
    FileMissingError,
    ProjectError,
    ProjectExistsError,
    ProjectMismatchError,
    ProjectUnwritableError,
    SettingError,
)
from dbh_studio.io.project import (
    PROJECT_FILE,
    PlotState,
    ProjectWriter,
    UndoStates,
    is_project,
    read_history,
    read_plot,
    read_project,
)

if TYPE_CHECKING:
    from dbh_studio.core.datacheck import DataCheck
    from dbh_studio.core.reconstruction import Reconstruction

_log = logging.getLogger(__name__)

# Called as ``read(path, progress=…)``.
Reader = Callable[..., "Reconstruction"]

_UNITS: dict[str, tuple[float, ScaleSource]] = {
    "metres": (1.0, "metres"),
    "m": (1.0, "metres"),
    "feet": (0.3048, "feet"),
    "ft": (0.3048, "feet"),
    # The survey foot of the USA, 1200/3937 m, in which its state plane coordinates were given until 2022.
    "us-feet": (1200 / 3937, "feet"),
    "centimetres": (0.01, "factor"),
    "cm": (0.01, "factor"),
    "millimetres": (0.001, "millimetres"),
    "mm": (0.001, "millimetres"),
}


def scale_from(value: float | str | ScaleEstimate | None) -> ScaleEstimate:
    """A scale as a person gives it: metres per unit, the name of a unit, or ``unknown``.

    Raises:
        SettingError: It is none of these, not positive, or beyond reason.
    """
    if isinstance(value, ScaleEstimate):
        check_scale(value, "the cloud")
        return value
    if value is None or value == "unknown":
        return ScaleEstimate()
    if isinstance(value, str) and value.lower() in _UNITS:
        metres_per_unit, source = _UNITS[value.lower()]
        return ScaleEstimate(metres_per_unit, source)
    try:
        scale = ScaleEstimate(float(value), "factor")
    except ValueError:
        names = ", ".join(_UNITS)
        raise SettingError(
            f"The scale {value!r} was not understood.", f"Give metres per unit, such as 1.332, or one of: {names}."
        ) from None
    check_scale(scale, "the cloud")
    return scale


@dataclass(frozen=True)
class _Wish:
    """What the person says about a cloud, where they do."""

    scale: ScaleEstimate | None = None
    up: Direction | None = None


# ---- opening


def open_plot(
    path: Path | str,
    *,
    scale: float | str | ScaleEstimate | None = None,
    up: str | Direction | None = None,
    project_dir: Path | str | None = None,
    read_only: bool = False,
    relocate: Path | str | None = None,
    background_save: bool = True,
    read: Reader | None = None,
    progress: Progress = ignore_progress,
) -> Session:
    """Open a cloud, a mesh, a folder of them, or a saved plot.

    Args:
        path: What to open. A saved plot (``NAME.dbh``) opens as it was left.
        scale: Metres per unit, a unit's name, or None for what the data says; where that is nothing, it is unknown.
        up: A named axis or a direction in the source; None for what the data says.
        project_dir: Where to save from now on. If a plot of this cloud is there already, it is opened.
        read_only: Write nothing and refuse commands; needs no lock.
        relocate: Where the cloud of a saved plot is now.
        background_save: Save on a thread of its own, see `Autosave`.
        read: How to read the cloud: `read_cloud` here, or a call that runs it in a child process.

    Raises:
        FileError: The cloud cannot be read, or is not where the saved plot says.
        ProjectError: The saved plot is damaged, locked, newer, or of another cloud (`ProjectMismatchError`).
        SettingError: `scale` or `up` is not understood, or the scale is given for degrees.
    """
    path = Path(path)
    wish = _Wish(None if scale is None else scale_from(scale), None if up is None else _up_from(up))
    if is_project(path):
        folder, source = path, relocate
    elif project_dir is not None and (Path(project_dir) / PROJECT_FILE).exists():
        folder, source = Path(project_dir), path
    else:
        session = _open_new(path, wish, read or read_cloud, read_only=read_only, progress=progress)
        # Only now: a cloud that cannot be read must not leave an empty saved plot.
        if project_dir is not None and not read_only:
            save_as(session, project_dir, background=background_save)
        return session
    session = _reopen(
        folder, source, read or read_cloud, read_only=read_only, background=background_save, progress=progress
    )
    try:
        if wish.up is not None:
            session.do(set_up(wish.up))
        if wish.scale is not None:
            session.do(set_scale(wish.scale))
    except BaseException:
        session.close()
        raise
    return session


def open_or_read(path: Path | str, **options: Any) -> Session:
    """As `open_plot`; a plot that lies where nothing can be written is opened for reading only, and says so."""
    try:
        return open_plot(path, **options)
    except ProjectUnwritableError as error:
        session = open_plot(path, **{**options, "read_only": True})
        what = "It is open for reading only, and cannot be changed here."
        how = "To go on with it, press “Save a copy” in step 1: what you do from then on is saved in the copy."
        say_read_only(session, "its folder cannot be written", f"{error.problem} {what} {how}")
        return session


def say_read_only(session: Session, why: str, note: str) -> None:
    """Say of a plot why it is only read: in a few words for the header, and in whole ones."""
    session.held_by, session.read_only_note = why, note
    session.reopening_notes = (note, *session.reopening_notes)


def save_as(
    session: Session,
    folder: Path | str,
    *,
    overwrite: bool = False,
    background: bool = True,
    label: str = "Create the plot",
) -> Autosave:
    """Keep a plot in `folder` from now on; what it was kept in before stays as it is, and is released.

    One that was open for reading only can be changed from then on. Masks that cannot be brought along are told in its
    `reopening_notes`: the plot itself is saved.

    Args:
        overwrite: Replace a plot that is there already.
        label: What the history says of it.

    Raises:
        ProjectExistsError: There is a saved plot already.
        ProjectError: The folder cannot be written; the plot is kept where it was.
    """
    folder = Path(folder)
    if not overwrite:
        _check_is_new(folder)
    masks_before, votes_before = masks_folder(session), votes_folder(session)
    # What is there stays there.
    earlier = session.saver.folder if session.saver is not None else session.read_from
    writer = ProjectWriter(folder)
    try:
        # Again, now that nobody else can write it: two processes may have come this far at once.
        if not overwrite:
            _check_is_new(folder)
        writer.put_history_aside()
        if earlier is not None:
            writer.log(read_history(earlier))
    except ProjectError:
        writer.close()
        raise
    # The old one goes on until the new one has saved, so that no edit is between the two.
    before = session.saver
    saver = Autosave(session, writer, background=background, label=label)
    if saver.status.state == "not_saved":
        problem = saver.status.problem
        saver.close()
        session.saver = before
        raise ProjectError(problem)
    if before is not None:
        before.close()
    session.is_read_only, session.held_by, session.read_from = False, "", None
    session.reopening_notes = tuple(note for note in session.reopening_notes if note != session.read_only_note)
    try:
        carry_masks(masks_before, folder.absolute() / MASKS_FOLDER, move=earlier is None)
    except FileError as error:
        note = f"The plot is saved in {folder.name}, but its masks are not all there; they are still in {masks_before}."
        session.reopening_notes = (*session.reopening_notes, f"{note} {error}")
        _log.warning("%s %s", note, error)
    carry_votes(votes_before, folder.absolute() / "cache")
    keep_search(folder, session)
    keep_offers(folder, session)
    return saver


def _check_is_new(folder: Path) -> None:
    if (folder / PROJECT_FILE).exists():
        raise ProjectExistsError(
            f"There is a saved plot {folder.name} already, perhaps with edits.",
            "Choose another name, or open that one.",
        )


def _up_from(up: str | Direction) -> Direction:
    try:
        return unit_direction(up)
    except ValueError as error:
        raise SettingError(f"The up direction was not understood: {error}.") from None


def read_cloud(path: Path, *, progress: Progress = ignore_progress) -> Reconstruction:
    """Read what a plot is made from. Picklable, for a job."""
    from dbh_studio.io.reader import read_reconstruction

    return read_reconstruction(path, progress=progress, attributes="needed")


def _open_new(path: Path, wish: _Wish, read: Reader, *, read_only: bool, progress: Progress) -> Session:
    _check_name(path)
    reconstruction = read(path, progress=subprogress(progress, 0.0, 0.8))
    if wish.scale is not None:
        check_scale(wish.scale, path.name, is_geographic=reconstruction.provenance.is_geographic)
    progress(0.8, "Looking at the data")
    check = _check(reconstruction, wish)
    document = Document(
        plot_id=plot_name(path),
        source=SourceInfo.of(reconstruction.cloud, path, reconstruction.used),
        up_direction=wish.up or unit_direction(check.up_direction_src),
        scale=wish.scale or scale_from_check(check),
    )
    progress(1.0, "")
    return _session(reconstruction, document, check, read_only)


def _check_name(path: Path) -> None:
    """Raise FileError where the path is no text, for then neither a saved plot nor a table can name it."""
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError:
        raise FileError(path, "Its name, or that of a folder it is in, is not UTF-8.", "Rename it.") from None


def _check(reconstruction: Reconstruction, wish: _Wish) -> DataCheck:
    """Look at the data in the light of what the person already said."""
    from dbh_studio.core.datacheck import check_cloud

    return check_cloud(
        reconstruction.cloud,
        up_axis=next((axis for axis in UP_AXES if wish.up == unit_direction(axis)), None),
        metres_per_unit=wish.scale.metres_per_unit if wish.scale is not None and wish.scale.is_known else None,
        provenance=reconstruction.provenance,
    )


def scale_from_check(check: DataCheck) -> ScaleEstimate:
    """The scale the data itself tells; unknown where a person must say it."""
    if check.needs_scale or check.metres_per_unit is None:
        return ScaleEstimate()
    sources: dict[str, ScaleSource] = {"metres": "metres", "feet": "feet", "millimetres": "millimetres"}
    return ScaleEstimate(check.metres_per_unit, sources.get(check.unit, "factor"))


def _history(states: UndoStates, info: SourceInfo) -> tuple[History, tuple[str, ...]]:
    """The plot with what Undo and Redo lead to; without that, and with words for it, where that contradicts itself."""
    try:
        return history_from_states(states, info), ()
    except ValueError as error:
        alone = history_from_states(replace(states, past=(), future=()), info)
        return alone, (f"What was done before cannot be undone any more, because it contradicts itself ({error}).",)


def _session(
    reconstruction: Reconstruction,
    document: Document,
    check: DataCheck,
    read_only: bool,
    history: History | None = None,
) -> Session:
    return Session(
        reconstruction.cloud,
        document,
        data_check=check,
        mesh=reconstruction.mesh,
        notes=reconstruction.notes,
        read_only=read_only,
        history=history,
        is_geographic=reconstruction.provenance.is_geographic,
    )


def plot_name(path: Path) -> str:
    """What to call a plot until a person does: the file's name without suffix and without control characters."""
    return re.sub(r"[\x00-\x1f\x7f]+", " ", path.absolute().stem).strip() or "plot"


def _reopen(
    folder: Path,
    source: Path | str | None,
    read: Reader,
    *,
    read_only: bool,
    background: bool,
    progress: Progress,
) -> Session:
    """Open a saved plot; locked before it is read, so that nobody writes it in between."""
    if not (folder / PROJECT_FILE).exists():
        read_project(folder)  # raises, with the words for it
    writer = None if read_only else ProjectWriter(folder)
    try:
        saved = read_plot(folder)
        state = saved.states.present
        path = Path(source) if source is not None else state.source_path
        if not path.exists():
            raise FileMissingError(
                path,
                f"The cloud of the saved plot {folder.name} is not there any more ({path}).",
                "Put it back, or say where it is now.",
            )
        reconstruction, info = _read_source_of(
            state, (path, None if source is not None else state.other_source_path), folder, read, progress
        )
        history, notes = _history(saved.states, info)
        document = history.present
        check = _check(reconstruction, _Wish(document.scale, document.up_direction))
        session = _session(reconstruction, document, check, read_only, history)
        # Beside a program that writes the plot, it is not closed as a matter of course.
        session.reopening_notes = (*(saved.lost if read_only else saved.notes), *notes)
        for note in (*saved.lost, *notes):  # on the command line nobody else says it
            _log.warning("%s: %s", folder.name, note)
        session.last_search = kept_search(folder, document)
        session.read_from = folder.absolute() if read_only else None
        session.offers = kept_offers(folder, document)
        if writer is not None:
            # A new place is told to the saved plot at once: the next program may not be told.
            has_moved = info.path != state.source_path
            label = f"Find the cloud at {info.path}"
            Autosave(session, writer, background=background, opened=saved, is_new=has_moved, label=label)
    except BaseException:
        if writer is not None:
            writer.close()
        raise
    progress(1.0, "")
    return session


def _read_source_of(
    state: PlotState, paths: tuple[Path, Path | None], folder: Path, read: Reader, progress: Progress
) -> tuple[Reconstruction, SourceInfo]:
    """The cloud the plot was made from, at the first of `paths` or else at the second.

    Raises:
        ProjectMismatchError: It is at neither; speaks of the first.
    """
    found: list[SourceInfo] = []
    for path in filter(None, paths):
        reconstruction = read(path, progress=subprogress(progress, 0.4 * len(found), 0.8))
        found.append(SourceInfo.of(reconstruction.cloud, path, reconstruction.used))
        if (found[-1].n_points, found[-1].fingerprint) == (state.n_points, state.fingerprint):
            return reconstruction, found[-1]
    raise _other_cloud(folder, found[0].path, state.n_points, found[0].n_points)


def _other_cloud(folder: Path, path: Path, n_saved: int, n_found: int) -> ProjectMismatchError:
    difference = f"it has {n_found:,} points instead of {n_saved:,}" if n_found != n_saved else "its points are others"
    return ProjectMismatchError(
        f"{path.name} is not the cloud that the saved plot {folder.name} was made from: {difference}.",
        f"Its trunks were not put on it. Put the original file back, or move {folder.name} away to begin anew.",
    )
