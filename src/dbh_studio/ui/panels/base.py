"""What every panel is: a part of the tab that is built once and brought in step with the plot."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dbh_studio.errors import FileMissingError
from dbh_studio.ui.steps import StepName

if TYPE_CHECKING:
    from dbh_studio.ui.tab import Tab


class Panel(ABC):
    """One step of the work. Subclasses add their inputs in `build` and show the plot in `refresh`."""

    step: StepName

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        self.gui = tab.client.gui
        self.folder = self.gui.add_folder(None, visible=False)
        with self.folder:
            self.build()

    @abstractmethod
    def build(self) -> None:
        """Add the panel's inputs at the GUI's current place."""

    @abstractmethod
    def refresh(self) -> None:
        """Show the plot as it is now; cheap where nothing changed."""

    def set_busy(self, busy: bool) -> None:  # noqa: B027 - most panels start nothing
        """Lock what cannot be started while a job runs."""

    def leave_tree(self) -> None:  # noqa: B027 - most panels ask nothing about it
        """Keep what was typed about the chosen tree: another one is about to be chosen."""

    def show(self, visible: bool) -> None:
        """Show or hide the whole panel."""
        set_visible(self.folder, visible)


class Section(ABC):
    """A part of a panel, built at the GUI's current place; the panel brings it in step with the plot."""

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        self.gui = tab.client.gui
        self.build()

    @abstractmethod
    def build(self) -> None:
        """Add the section's inputs at the GUI's current place."""

    @abstractmethod
    def refresh(self) -> None:
        """Show the plot as it is now; cheap where nothing changed."""

    def set_busy(self, busy: bool) -> None:  # noqa: B027 - most sections start nothing
        """Lock what cannot be started while a job runs."""

    def leave_tree(self) -> None:  # noqa: B027 - most sections ask nothing about it
        """Keep what was typed about the chosen tree: another one is about to be chosen."""


def set_value(handle: Any, value: Any) -> None:
    """Show a value in an input, where it is not there already: an assignment is a message to the page."""
    if handle.value != value:
        handle.value = value


def set_content(handle: Any, content: str) -> None:
    """Assign HTML only where it differs: the same text again would still reset the scroll position."""
    if handle.content != content:
        handle.content = content


def show_anew(handle: Any, content: str) -> None:
    """Assign HTML so that the page draws it again though it is the same: what was typed into its fields goes."""
    handle.content = content if content != handle.content else content + " "


def set_disabled(handle: Any, disabled: bool) -> None:
    """Lock or release an input, where it is not so already."""
    if handle.disabled != disabled:
        handle.disabled = disabled


def set_visible(handle: Any, visible: bool) -> None:
    """Show or hide an element, where it is not so already."""
    if handle.visible != visible:
        handle.visible = visible


def typed_path(text: str) -> Path | None:
    """The path that was typed, on the computer the studio runs on; None where nothing was.

    Raises:
        FileMissingError: There is no such file or folder.
    """
    text = text.strip().strip("\"'")
    if not text:
        return None
    # os.path, not pathlib: that one raises where a folder may not be entered or a name is too long.
    path = Path(os.path.expanduser(text))  # noqa: PTH111
    if not os.path.exists(path):  # noqa: PTH110
        raise FileMissingError(path, "there is no such file or folder on this computer.", "Check the path.")
    return path
