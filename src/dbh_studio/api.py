"""The Python interface: open a plot, find the trunks, read the diameters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dbh_studio.app import opening, pipeline
from dbh_studio.app.commands import change_settings
from dbh_studio.app.document import Direction
from dbh_studio.app.session import Session
from dbh_studio.core.inventory import Inventory
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.scale import ScaleEstimate


class Plot:
    """One open plot; a context manager, which closes it.

    Thin: everything is done by `session`, which may be used directly for commands, undo and listeners.
    """

    def __init__(self, session: Session) -> None:
        self.session = session

    def __enter__(self) -> Plot:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def settings(self, section: str, **values: Any) -> Plot:
        """Change settings, such as ``plot.settings("measure", curve="ellipse")``; see ``dbh-studio settings``.

        Returns:
            The plot, so that calls can be chained.

        Raises:
            CommandError: There is no such setting, or the value is outside its bounds.
        """
        self.session.do(change_settings(section, **values))
        return self

    def find_trunks(self, *, progress: Progress = ignore_progress) -> tuple[str, ...]:
        """Find ground and trunks; returns notes in plain words.

        Raises:
            UnscaledCloudError: The plot has no scale yet.
        """
        return pipeline.segment(self.session, progress=progress, in_process=True)

    def inventory(self, *, progress: Progress = ignore_progress) -> Inventory:
        """One row per stem; measures what is not measured yet.

        Empty before `find_trunks`. A row has `dbh_cm` None where the stem cannot be measured; its `reason` and `remedy`
        say why and what would help. `reason` also names what to look at in a stem that was measured.
        """
        return self.session.inventory(progress)

    def write_csv(self, path: Path | str) -> Path:
        """Write the inventory as CSV; `path` is replaced whole or stays as it was. Returns it.

        Raises:
            FileError: The file cannot be written, or is what the plot is read from.
        """
        from dbh_studio.io.inventory_csv import check_not_source, write_inventory_csv

        check_not_source(Path(path), self.session.document.source.used)
        return write_inventory_csv(Path(path), self.inventory())

    def close(self) -> None:
        """Save what is left and release the saved plot.

        Raises:
            ProjectError: The last changes could not be saved; the plot is released all the same.
        """
        try:
            self.session.flush()
        finally:
            self.session.close()


def open_plot(
    path: Path | str,
    *,
    scale: float | str | ScaleEstimate | None = None,
    up: str | Direction | None = None,
    project_dir: Path | str | None = None,
    read_only: bool = False,
    progress: Progress = ignore_progress,
) -> Plot:
    """Open a cloud, a mesh, a folder of them, or a saved ``NAME.dbh``.

    Args:
        path: What to open.
        scale: Metres per unit, or ``metres``, ``feet``, ``millimetres``; None for what the data says.
        up: ``+z``, ``+y``, … or a direction in the source; None for what the data says.
        project_dir: Save every change there; without it nothing is written.
        read_only: Refuse changes; a saved plot may then be open elsewhere.
        progress: Told how far the reading is.

    Raises:
        StudioError: The file cannot be read, or the saved plot not be opened; the message says what to do.
    """
    session = opening.open_plot(
        path, scale=scale, up=up, project_dir=project_dir, read_only=read_only, progress=progress
    )
    return Plot(session)
