"""Step 1: open a reconstruction, and read in plain words what it is."""

from __future__ import annotations

import os
from pathlib import Path

import viser

from dbh_studio.app import commands
from dbh_studio.app.document import Direction, unit_direction
from dbh_studio.app.session import Session
from dbh_studio.core.transforms import UP_AXES
from dbh_studio.errors import StudioError
from dbh_studio.io.project import FOLDER_SUFFIX
from dbh_studio.ui import html
from dbh_studio.ui.panels.base import Panel, set_content, set_disabled, set_value, set_visible, typed_path
from dbh_studio.ui.uploads import UploadedFile

_UP_AS_FOUND = "as recognised"
_VERDICTS = {
    "ok": ("ok", "Data check: all well."),
    "note": ("ok", "Data check: all well. Good to know:"),
    "warn": ("todo", "Data check: look at the lines marked !"),
    "stop": ("stop", "Data check: settle the line marked ✕ before measuring."),
}


class OpenPanel(Panel):
    """A path on this computer, or a file from the browser; then the data check."""

    step = "open"

    def build(self) -> None:
        """Add the inputs."""
        tab, gui = self.tab, self.gui
        self._path = gui.add_text(
            "File or folder",
            "",
            hint="on the computer the studio runs on: a cloud, a mesh, a folder, or a saved NAME.dbh",
        )
        self._open_button = gui.add_button("Open", icon=viser.Icon.FOLDER_OPEN, color="green")
        tab.worker.on_click(self._open_button, self._open)
        suffixes = tab.studio.suffixes()
        self._upload = gui.add_upload_button(
            "Upload a cloud",
            icon=viser.Icon.UPLOAD,
            color="gray",
            mime_type=",".join(suffixes),
            hint="from the computer you sit at; a large file is better opened by its path",
        )
        tab.worker.on_upload(self._upload, self._uploaded, allowed_suffixes=suffixes, on_progress=self._uploading)
        self._upload_bar = gui.add_progress_bar(0.0, visible=False)
        self._copy_folder = gui.add_text(
            "Save in", "", hint="a new folder NAME.dbh, on the computer the studio runs on", visible=False
        )
        self._copy = gui.add_button("Save a copy", icon=viser.Icon.COPY, color="green", visible=False)
        tab.worker.on_click(self._copy, self._save_copy)
        self._check = gui.add_html("")
        self._up = gui.add_dropdown("Up in the file", (_UP_AS_FOUND, *UP_AXES), visible=False, hint="turns the cloud")
        tab.worker.on_update(self._up, self._set_up)

    def refresh(self) -> None:
        """Show the data check of the open plot."""
        session = self.tab.session
        set_visible(self._up, session is not None)
        if session is None:
            self._offer_copy(None)
            set_content(self._check, html.message(f"Reads {self.tab.studio.formats()}.", level="ok"))
            return
        if session is not self._session_shown:  # later refreshes leave alone what is being typed
            self._session_shown = session
            set_value(self._path, str(session.document.source.path))
            set_value(self._copy_folder, "")
        self._offer_copy(session)
        set_value(self._up, _up_title(session))
        check = session.data_check
        items = [("warn", note, "") for note in session.reopening_notes]
        items += [("note", note, "") for note in session.notes]
        verdict = ""
        if check is not None:
            items += [(finding.level, finding.message, finding.remedy) for finding in check.findings]
            # A scale given since settles the line on units: the check is of the file, not of the plot.
            settled = check.level == "stop" and session.document.scale.is_known
            level, text = ("ok", "Data check: the scale has been set.") if settled else _VERDICTS[check.level]
            verdict = html.message(text, level=level)
        set_content(self._check, verdict + html.findings(items))

    _session_shown: object = None

    def _offer_copy(self, session: Session | None) -> None:
        """Offer to go on elsewhere where the plot cannot be changed, or not be saved, where it is."""
        is_stuck = session is not None and (session.is_read_only or bool(self.tab.studio.save_problem()))
        if is_stuck and not self._copy_folder.value:
            set_value(self._copy_folder, str(self.tab.studio.place_for_copy()))
        set_visible(self._copy_folder, is_stuck)
        set_visible(self._copy, is_stuck)

    def _save_copy(self) -> None:
        text = str(self._copy_folder.value).strip().strip("\"'")
        if not text:
            raise StudioError("No folder was named.", "Type where the copy is to be saved.")
        # os.path, not pathlib: that one raises where there is no such user.
        folder = Path(os.path.expanduser(text))  # noqa: PTH111
        self.tab.studio.save_copy(folder if folder.suffix == FOLDER_SUFFIX else Path(f"{folder}{FOLDER_SUFFIX}"))
        set_value(self._copy_folder, "")

    def set_busy(self, busy: bool) -> None:
        """One plot at a time."""
        set_disabled(self._open_button, busy)
        set_disabled(self._upload, busy)

    def _open(self) -> None:
        path = typed_path(self._path.value)
        if path is None:
            raise StudioError("No file was named.", "Type the path of a cloud, or use Upload a cloud.")
        self.tab.studio.open_plot(path)

    def _uploading(self, n_received: int, n_total: int) -> None:
        set_visible(self._upload_bar, n_received < n_total)
        set_value(self._upload_bar, 100.0 * n_received / max(n_total, 1))

    def _uploaded(self, uploaded: UploadedFile) -> None:
        set_visible(self._upload_bar, False)
        path = self.tab.studio.keep_upload(uploaded)
        # Where something else runs it can be opened later, and need not be sent again.
        set_value(self._path, str(path))
        self.tab.studio.open_plot(path)

    def _set_up(self, choice: str) -> None:
        session = self.tab.session
        if session is None:
            return
        session.do(commands.set_up(_recognised_up(session) if choice == _UP_AS_FOUND else choice))


def _recognised_up(session: Session) -> Direction:
    check = session.data_check
    return unit_direction(check.up_direction_src if check is not None else (0.0, 0.0, 1.0))


def _up_title(session: Session) -> str:
    """The choice that stands for the plot's up direction as it is now: Undo and other tabs change it, too."""
    up = session.document.up_direction
    if up == _recognised_up(session):
        return _UP_AS_FOUND
    return next((axis for axis in UP_AXES if up == unit_direction(axis)), _UP_AS_FOUND)
