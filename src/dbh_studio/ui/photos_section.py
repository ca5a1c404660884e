"""The photos of the plot: offered, added by path, and what is wrong with them. A part of the Scale step."""

from __future__ import annotations

from typing import TYPE_CHECKING

import viser

from dbh_studio.app import commands
from dbh_studio.app.cameras import Cameras
from dbh_studio.errors import FileError, StudioError
from dbh_studio.ui import html
from dbh_studio.ui.panels.base import set_content, set_disabled, set_value, set_visible, typed_path
from dbh_studio.ui.photo_desk import FORMATS

if TYPE_CHECKING:
    from dbh_studio.ui.tab import Tab

_NAMES_SHOWN = 3


class PhotosSection:
    """Built at the GUI's current place, in a panel that brings it in step with the plot."""

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        self._shown_for: object = None
        gui, worker = tab.client.gui, tab.worker
        self._folder = gui.add_folder("Photos")
        with self._folder:
            self._state = gui.add_html("")
            self._offer = gui.add_button("Show them", icon=viser.Icon.PHOTO, color="green", visible=False)
            worker.on_click(self._offer, self._take_offer)
            self._first = gui.add_button("Look at the photos", icon=viser.Icon.PHOTO, color="green", visible=False)
            worker.on_click(self._first, self._open_first)
            self._path = gui.add_text(
                "Cameras",
                "",
                hint="on the computer the studio runs on: a COLMAP, Metashape, OpenSfM or ODM export, or its folder",
            )
            self._images = gui.add_text(
                "Photos in", "", hint="the folder with the photos; empty where they lie beside the cameras"
            )
            self._add = gui.add_button("Add photos", icon=viser.Icon.CAMERA_PLUS, color="gray")
            worker.on_click(self._add, self._add_pressed)
            self._remove = gui.add_button("Remove the photos", icon=viser.Icon.CAMERA_OFF, color="gray", visible=False)
            worker.on_click(self._remove, self._remove_pressed)

    @property
    def needs_attention(self) -> bool:
        """Whether something about the photos must be read before they are used."""
        cameras = self.tab.session.cameras if self.tab.session is not None else None
        return cameras is not None and (bool(cameras.missing) or cameras.fit.status == "moved")

    def refresh(self) -> None:
        """Say which photos there are, whether they fit, and what is missing."""
        session, desk = self.tab.session, self.tab.studio.photos
        set_visible(self._folder, session is not None)
        if session is None:
            return
        source, cameras = session.document.cameras, session.cameras
        shown = (session, source)
        if shown != self._shown_for:  # later refreshes leave alone what is being typed
            self._shown_for = shown
            set_value(self._path, str(source.path) if source is not None else "")
            set_value(self._images, str(source.images_dir) if source is not None and source.images_dir else "")
        offer = desk.offer if source is None else None
        set_visible(self._offer, offer is not None)
        set_visible(self._remove, source is not None)
        set_visible(self._first, cameras is not None and cameras.n_found > 0)
        # Where all is well the boxes would only be in the way; removing the photos brings them back.
        is_complete = cameras is not None and not self.needs_attention
        for handle in (self._path, self._images, self._add):
            set_visible(handle, not is_complete)
        if self._add.label != (label := "Add photos" if source is None else "Read the photos again"):
            self._add.label = label
        if cameras is not None:
            content = describe(cameras)
        elif source is not None and desk.problem is not None:
            problem = desk.problem
            said = f"{source.path.name}: {problem.problem}" if isinstance(problem, FileError) else problem.problem
            content = html.message(
                f"The photos of this plot cannot be shown. {said}",
                level="stop",
                remedy=f"{problem.remedy} If they were moved, type where they are now and read them again.",
            )
        elif source is not None:
            content = html.message("The photos of this plot have not been read yet.")
        elif offer is not None:
            missing = f", {offer.n_missing} of them not on disk" if offer.n_missing else ""
            content = html.message(
                f"{_count(offer.n_photos)} found beside the cloud ({_format(offer.source_format)}{missing}).",
                level="ok",
            )
        else:
            content = html.message(
                "Type where the cameras are: the project's folder, or the cameras as COLMAP, Metashape, OpenSfM or ODM "
                "exported them.",
                level="ok",
            )
        set_content(self._state, content)

    def set_busy(self, busy: bool) -> None:
        """Photos are read one after another."""
        for button in (self._offer, self._add):
            set_disabled(button, busy)

    def _take_offer(self) -> None:
        session, offer = self.tab.require_session(), self.tab.studio.photos.offer
        if offer is not None:
            self.tab.studio.photos.add(session, offer.folder, None)

    def _open_first(self) -> None:
        session = self.tab.require_session()
        cameras = session.cameras
        if cameras is not None:
            self.tab.photos.open(next(photo.name for photo in cameras.posed if photo.path is not None))

    def _add_pressed(self) -> None:
        session = self.tab.require_session()
        path = typed_path(self._path.value)
        if path is None:
            raise StudioError("No file was named.", "Type where the cameras are: the project's folder is enough.")
        images = typed_path(self._images.value)
        if images is not None and not images.is_dir():
            raise StudioError(f"{images.name} is no folder.", "Type the folder the photos are in.")
        self.tab.studio.photos.add(session, path, images)

    def _remove_pressed(self) -> None:
        self.tab.require_session().do(commands.set_cameras(None))


def describe(cameras: Cameras) -> str:
    """HTML that says how many photos there are, whether they fit the cloud, what is missing and what was assumed."""
    posed, fit = cameras.posed, cameras.fit
    n_missing = len(cameras.missing)
    parts = []
    if fit.status == "moved":  # before anything is projected
        parts.append(html.message(fit.message, level="stop", remedy=fit.remedy))
    on_disk = "all on disk" if not n_missing else f"{cameras.n_found} on disk"
    read = f"{_count(len(posed))} ({_format(posed.source_format)}), {on_disk}."
    parts.append(html.message(f"{read} They fit the cloud." if fit.status == "fits" else read, level="ok"))
    if fit.status == "unclear":
        parts.append(html.message(fit.message, remedy=fit.remedy))
    if n_missing:
        names = ", ".join(cameras.missing[:_NAMES_SHOWN]) + (", …" if n_missing > _NAMES_SHOWN else "")
        parts.append(
            html.message(
                f"{n_missing} of {len(posed)} photos were not found: {names}.",
                remedy="Type the folder they are in under “Photos in”, and read the photos again.",
            )
        )
    if posed.notes:
        parts.append(html.findings([("note", note, "") for note in posed.notes]))
    return "".join(parts)


def _count(number: int) -> str:
    return f"{number:,} photo{'s' if number != 1 else ''}"


def _format(source_format: str) -> str:
    return FORMATS.get(source_format, source_format)
