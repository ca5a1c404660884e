"""Trajectories of the two sensors, brought to the worlds of their plots."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.app.cameras import cameras_of, cloud_sample, read_cameras, require_fit
from dbh_studio.app.document import CameraSource
from dbh_studio.app.session import Session
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.errors import SettingError

if TYPE_CHECKING:
    from dbh_studio.core.trajectories import Trajectory
    from dbh_studio.io.trajectories import RecordedTrajectory


@dataclass(frozen=True)
class WalkFile:
    """A trajectory on disk.

    Attributes:
        path: A file, or the folder of a reconstruction from photos.
        times: A file with one time a line, for formats without times.
        rate_hz: Poses or frames a second, where there are no times.
    """

    path: Path
    times: Path | None = None
    rate_hz: float | None = None


@dataclass(frozen=True, eq=False)
class WalkRead:
    """A trajectory in the world of its plot.

    Attributes:
        walk: None where there is none, or none with times.
        why_not: Why there is none; empty where there is one.
        notes: What was left out or assumed.
    """

    walk: Trajectory | None
    why_not: str = ""
    notes: tuple[str, ...] = ()


def walk_of(
    session: Session, file: WalkFile | None, *, whose: str, option: str, progress: Progress = ignore_progress
) -> WalkRead:
    """Read a trajectory, and bring it to the world of the plot; without a file, that of the plot's photos.

    Args:
        session: The plot.
        file: Where it is.
        whose: ``camera`` or ``scanner``, for messages.
        option: Beginning of the command line's options, ``photo`` or ``lidar``.
        progress: Called while photos are read.

    Raises:
        FileError: It cannot be read.
        CommandError: Its poses do not belong to the cloud.
        SettingError: The rate makes no sense.
    """
    from dbh_studio.core.trajectories import Trajectory

    if file is not None and file.rate_hz is not None and not (0 < file.rate_hz < 1e6):
        raise SettingError(f"{file.rate_hz:g} poses a second make no sense.", "Give a rate such as 2 or 10.")
    recorded = _recorded(session, file, progress)
    if recorded is None:
        return WalkRead(None, f"there is no trajectory of the {whose}")
    if recorded.time_s is None:
        return WalkRead(
            None,
            f"{recorded.path.name} tells no times; give poses a second (--{option}-rate) or a file of times "
            f"(--{option}-times)",
            recorded.notes,
        )
    local = recorded.xyz - session.cloud.origin
    places = np.asarray(session.document.world_from_source.apply(local), np.float64)
    return WalkRead(Trajectory(recorded.time_s, places), "", recorded.notes)


def _recorded(session: Session, file: WalkFile | None, progress: Progress) -> RecordedTrajectory | None:
    from dbh_studio.io.trajectories import holds_photos, read_trajectory, trajectory_of_photos, with_times

    if file is None:
        cameras = cameras_of(session, progress)
        return None if cameras is None else trajectory_of_photos(cameras.posed, cameras.source.path)
    if not holds_photos(file.path):
        return read_trajectory(file.path, times=file.times, rate_hz=file.rate_hz)
    # By way of the cameras: which of two frames the poses are in is seen from the cloud.
    cameras = read_cameras(CameraSource.of(file.path), cloud_sample(session.cloud), progress=progress)
    require_fit(cameras)
    recorded = trajectory_of_photos(cameras.posed, file.path, rate_hz=file.rate_hz)
    return recorded if file.times is None else with_times(recorded, file.times)
