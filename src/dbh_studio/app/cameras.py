"""The photos of a plot: read once, brought to the cloud's frame, and told whether they belong to it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.app.document import CameraSource
from dbh_studio.core.arrays import Float64
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.errors import CommandError, FileError

if TYPE_CHECKING:
    from dbh_studio.app.session import Session
    from dbh_studio.core.posed_images import FrameFit, PosedImages

_N_SAMPLE = 100_000


@dataclass(frozen=True, eq=False)
class Cameras:
    """The photos of a plot, ready for use.

    Attributes:
        source: Where they were read from, with the frame that was found to fit.
        posed: In the cloud's frame: absolute source coordinates.
        fit: Whether they belong to the cloud.
        missing: Names of photos that were not found on disk.
    """

    source: CameraSource
    posed: PosedImages
    fit: FrameFit
    missing: tuple[str, ...]

    @property
    def n_found(self) -> int:
        """Photos that are on disk."""
        return len(self.posed) - len(self.missing)


def cloud_sample(cloud: PointCloud) -> Float64:
    """(about 100 000, 3) points spread over the cloud, absolute source coordinates."""
    step = max(1, len(cloud) // _N_SAMPLE)
    return np.asarray(cloud.xyz[::step].astype(np.float64) + cloud.origin)


def read_cameras(
    source: CameraSource, sample: Float64, *, is_chosen: bool = False, progress: Progress = ignore_progress
) -> Cameras:
    """Read the photos' poses and find the photos. Pure and picklable, for a job.

    Args:
        source: Where they are. Its `frame` is tried along with the other one, and the better one kept.
        sample: (N, 3) points of the cloud, from `cloud_sample`.
        is_chosen: Keep the frame of `source`, because a person or an earlier session chose it.
        progress: Called in between.

    Raises:
        FileError: Names the file, what is wrong and what to do.
    """
    from dbh_studio.core.posed_images import fit_check
    from dbh_studio.io.posed import read_posed_images

    posed = read_posed_images(source.path, images_dir=source.images_dir, progress=progress)
    if not len(posed):
        raise FileError(source.path, "It knows the pose of no photo.", "Export the cameras after they were aligned.")
    progress(0.9, "Comparing the photos with the cloud")
    fit = fit_check(sample, posed)
    frame = source.frame
    if not is_chosen:
        is_files_own = posed.cloud_from_cameras is not None and fit.cloud_from_source is posed.cloud_from_cameras
        frame = "file" if is_files_own else "cloud"
    placed = posed.in_cloud_frame() if frame == "file" else posed
    missing = tuple(photo.name for photo in posed if photo.path is None)
    return Cameras(replace(source, frame=frame), placed, fit, missing)


def require_fit(cameras: Cameras) -> None:
    """Raise CommandError where photos do not belong to the cloud: they would measure in another unit."""
    if cameras.fit.status == "moved":
        raise CommandError(cameras.fit.message, cameras.fit.remedy)


def cameras_of(session: Session, progress: Progress = ignore_progress) -> Cameras | None:
    """The photos of a plot, read where they are not known yet; None where it has none.

    Raises:
        FileError: They are not where the plot says, or cannot be read.
    """
    source = session.document.cameras
    if source is None:
        return None
    known = session.cameras
    if known is None:
        known = read_cameras(source, cloud_sample(session.cloud), is_chosen=True, progress=progress)
        session.remember_cameras(known)
    return known
