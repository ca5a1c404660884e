"""The Python interface: open a plot, find the trunks, read the diameters."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dbh_studio.app import opening, pipeline
from dbh_studio.app.commands import change_settings
from dbh_studio.app.document import Direction
from dbh_studio.app.session import Session
from dbh_studio.core.inventory import Inventory
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.settings import MarkerSettings


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

    def scale_by_markers(
        self,
        cameras: Path | str | None = None,
        *,
        images: Path | str | None = None,
        side_m: float | None = None,
        sides_m: Mapping[str, float] | None = None,
        progress: Progress = ignore_progress,
    ) -> ScaleEstimate:
        """Take the scale from printed markers in the plot's photos; ``plot.session.document.evidence`` says on what.

        Args:
            cameras: The reconstruction with the photos' poses; None looks where the cloud is.
            images: Folder of the photos; None looks beside the reconstruction.
            side_m: Outer edge of the black squares. Without it, and with `sides_m`, other markers are ignored; without
                both it is 1 m.
            sides_m: Side per marker, by number (``"12"``) or dictionary and number (``"DICT_4X4_50 12"``).
            progress: Called once per photo.

        Returns:
            Metres per unit and its standard error.

        Raises:
            FileError: The photos or their poses cannot be read.
            CommandError: They do not belong to the cloud, or give no scale, or one that contradicts itself; says why.
            SettingError: A marker of `sides_m` was not seen, or a side cannot be.
        """
        from dbh_studio.app.photo_scale import PhotoRequest, scale_by_photos

        settings = MarkerSettings() if side_m is None else MarkerSettings().changed(side_m=side_m)
        request = PhotoRequest(
            cameras=None if cameras is None else Path(cameras),
            images_dir=None if images is None else Path(images),
            sides=dict(sides_m or {}),
            settings=settings,
            only_named=bool(sides_m) and side_m is None,
        )
        scale_by_photos(self.session, request, progress=progress)
        return self.session.document.scale

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
