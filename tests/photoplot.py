"""The plot of `threestems` as a photographer leaves it: a cloud in an arbitrary unit, panoramas, poses."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tests.threestems import plot_points

from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.posed_images import PosedImages
from dbh_studio.core.synthetic.marker_plot import marker_plot
from dbh_studio.core.transforms import Similarity
from dbh_studio.io.marker_codes import marker_bits
from dbh_studio.io.ply import write_ply

LYING, STANDING = ("DICT_4X4_50", 7), ("DICT_APRILTAG_36h11", 3)
SIDES_M = {LYING: 1.0, STANDING: 0.5}
# Of the plot, metres: the markers stand around it.
MIDDLE_M = np.array([4.0, 3.5, 0.0])


@dataclass(frozen=True, eq=False)
class PhotoPlot:
    """What was written.

    Attributes:
        folder: Everything below it.
        cloud: The cloud, in source units.
        poses: The table of poses; the photos are in ``images`` beside it.
        posed: What the table says, without paths.
        metres_per_unit: The truth.
    """

    folder: Path
    cloud: Path
    poses: Path
    posed: PosedImages
    metres_per_unit: float


def write_photo_plot(folder: Path, *, seed: int = 104, n_photos: int = 7, width_px: int = 1536) -> PhotoPlot:
    """Render, and write all files; takes a few seconds."""
    from PIL import Image

    codes = [(key, marker_bits(*key), side) for key, side in SIDES_M.items()]
    made = marker_plot(seed, codes, n_photos=n_photos, width_px=width_px, reach_m=(1.8, 3.5))
    level = made.posed.moved(Similarity(made.source_from_world_rotation.T, np.zeros(3)))
    images = folder / "images"
    images.mkdir(parents=True)
    for name, picture in made.pictures.items():
        Image.fromarray(picture).save(images / name)
    cloud = folder / "cloud.ply"
    write_ply(cloud, PointCloud.from_points((plot_points() - MIDDLE_M) / made.metres_per_unit))
    poses = folder / "poses.json"
    poses.write_text(json.dumps({"images": [_pose(photo) for photo in level]}))
    return PhotoPlot(folder, cloud, poses, level, made.metres_per_unit)


def _pose(photo) -> dict[str, object]:
    rotation, centre = photo.cam_from_source.rotation, photo.centre_src
    entry = {"name": photo.name, "width": photo.camera.width_px, "height": photo.camera.height_px}
    entry |= {"model": photo.camera.kind, "params": list(photo.camera.params)}
    entry |= {f"r{row + 1}{column + 1}": float(rotation[row, column]) for row in range(3) for column in range(3)}
    return entry | dict(zip("xyz", map(float, centre), strict=True))
