"""A plot without a unit, with a 1 m and a 0.5 m marker in it, its cloud and its panoramas, and the true factor."""

from __future__ import annotations

import csv
import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dbh_studio.app import commands
from dbh_studio.app.cameras import cloud_sample, read_cameras
from dbh_studio.app.document import CameraSource
from dbh_studio.app.found_markers import MarkerSearch, place_markers
from dbh_studio.app.opening import open_plot
from dbh_studio.app.session import Session
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.posed_images import PosedImages
from dbh_studio.core.synthetic.marker_plot import MarkerPlot, marker_plot
from dbh_studio.core.synthetic.marker_scene import MarkerBoard, MarkerScene, PictureFlaws, noise_texture
from dbh_studio.core.transforms import Similarity
from dbh_studio.io.ply import write_ply
from dbh_studio.settings import MarkerSettings
from dbh_studio.stages.markers import Detection, find_markers

FLAT, UPRIGHT = ("DICT_4X4_50", 7), ("DICT_4X4_50", 13)
SIDES_M = {FLAT: 1.0, UPRIGHT: 0.5}
N_PHOTOS, WIDTH = 6, 1536
_N_GROUND, _N_BOARD, _N_STEMS = 24_000, 14_000, 12_000


@dataclass(frozen=True, eq=False)
class ScalePlot:
    """The truth.

    Attributes:
        metres_per_unit: What the studio is to find.
        scene: In metres; z is up in the cloud, too.
        posed: The photos, in the cloud's frame.
        pictures: Their pixels, by name.
        cloud: Without a unit.
    """

    metres_per_unit: float
    scene: MarkerScene
    posed: PosedImages
    pictures: dict[str, np.ndarray]
    cloud: PointCloud

    def corners(self, key: tuple[str, int] = FLAT) -> np.ndarray:
        """(4, 3) corners of a marker, source coordinates."""
        board = next(board for board in self.scene.boards if board.key == key)
        return board.corners_m / self.metres_per_unit


def _scene() -> MarkerScene:
    marker_codes = pytest.importorskip("dbh_studio.io.marker_codes")
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    flat = MarkerBoard(
        FLAT,
        marker_codes.marker_bits(*FLAT),
        SIDES_M[FLAT],
        np.array([0.2, -0.3, 0.01]),
        np.array([np.cos(0.3), np.sin(0.3), 0.0]),
        np.array([np.sin(0.3), -np.cos(0.3), 0.0]),
    )
    upright = MarkerBoard(
        UPRIGHT,
        marker_codes.marker_bits(*UPRIGHT),
        SIDES_M[UPRIGHT],
        np.array([-0.9, 0.9, 0.9]),
        np.array([1.0, 0.0, 0.0]),
        np.array([0.0, 0.0, -1.0]),
    )
    stems = np.array([[3.6, 1.0, 0.15], [-3.4, 2.0, 0.2], [1.0, 4.2, 0.12], [-2.2, -3.6, 0.18]])
    return MarkerScene((flat, upright), stems, np.zeros(2), noise_texture(np.random.default_rng(5)))


@functools.cache
def plot() -> ScalePlot:
    """Rendered once per run of the tests."""
    scene = _scene()
    flaws = PictureFlaws(blur_px=0.5, noise=1.5, jpeg_quality=0)
    made: MarkerPlot = marker_plot(
        31, (), n_photos=N_PHOTOS, width_px=WIDTH, reach_m=(1.8, 2.6), pose_sigma_mm=0.5, pose_sigma_deg=0.01,
        scene=scene, flaws=flaws,
    )  # fmt: skip
    # Upright, so that the picture in the studio is, too.
    posed = made.posed.moved(Similarity(made.source_from_world_rotation.T, np.zeros(3)))
    return ScalePlot(made.metres_per_unit, scene, posed, dict(made.pictures), _cloud(scene, made.metres_per_unit))


def _cloud(scene: MarkerScene, metres_per_unit: float) -> PointCloud:
    rng = np.random.default_rng(3)
    places, greys = [], []
    ground = rng.uniform(-5, 5, (_N_GROUND, 2))
    places.append(np.column_stack([ground, np.zeros(len(ground))]))
    greys.append(rng.uniform(90, 130, len(ground)))
    for x, y, radius in scene.stems_m:
        angle, height = rng.uniform(0, 2 * np.pi, _N_STEMS // 4), rng.uniform(0, 4, _N_STEMS // 4)
        places.append(np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle), height]))
        greys.append(np.full(len(angle), 70.0))
    for board in scene.boards:
        across = rng.uniform(-0.5 - board.margin, 0.5 + board.margin, (_N_BOARD, 2))
        places.append(board.centre_m + board.side_m * (across[:, :1] * board.right + across[:, 1:] * board.down))
        cells = len(board.bits)
        cell = np.floor((across + 0.5) * cells).astype(int)
        inside = ((cell >= 0) & (cell < cells)).all(axis=1)
        cell = np.clip(cell, 0, cells - 1)
        greys.append(np.where(~inside | board.bits[cell[:, 1], cell[:, 0]], 235.0, 20.0))
    xyz = np.concatenate(places)
    under = (np.abs(xyz[:, 2]) < 1e-9) & (np.linalg.norm(xyz[:, :2] - scene.boards[0].centre_m[:2], axis=1) < 0.6)
    grey = np.concatenate(greys)[~under]
    xyz = xyz[~under] + rng.normal(0, 0.002, (len(grey), 3))
    rgb = np.repeat(grey[:, None], 3, axis=1).astype(np.uint8)
    return PointCloud((xyz / metres_per_unit).astype(np.float32), np.zeros(3), rgb)


@functools.cache
def search(side_m: float) -> MarkerSearch:
    """What a search for markers finds, of those of one dictionary."""
    pictures = plot().pictures
    settings = MarkerSettings(dictionaries=(FLAT[0],), side_m=side_m)
    finds = find_markers(plot().posed, settings=settings, read_image=lambda photo: pictures[photo.name])
    return place_markers(finds, plot().posed, settings=settings)


@functools.cache
def two_sizes() -> MarkerSearch:
    """What a search finds where both markers are seen in all photos and both are taken for a metre."""
    crop = np.full((8, 8, 3), 128, np.uint8)
    finds = [
        Detection(photo.name, *key, photo.project(plot().corners(key))[0], 1.0, crop, 0.05, 2 * np.pi / WIDTH, 0.6)
        for photo in plot().posed
        for key in SIDES_M
    ]
    return place_markers(finds, plot().posed)


def write_plot(folder: Path, *, photos: bool = True) -> Path:
    """The cloud as a PLY; beside it, in ``cameras``, a table of poses and the photos."""
    path = folder / "unscaled.ply"
    write_ply(path, plot().cloud)
    if photos:
        write_photos(folder / "cameras")
    return path


def write_photos(folder: Path) -> None:
    """A table of poses and the photos it names."""
    folder.mkdir()
    with (folder / "cameras.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        rotation = [f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)]
        writer.writerow(["name", "width", "height", "model", "params", *rotation, "tx", "ty", "tz"])
        for photo in plot().posed:
            pose = photo.cam_from_source
            writer.writerow(
                [photo.name, WIDTH, WIDTH // 2, "EQUIRECTANGULAR", "", *map(repr, pose.rotation.ravel().tolist())]
                + [repr(value) for value in pose.translation.tolist()]
            )
            Image.fromarray(plot().pictures[photo.name]).save(folder / photo.name, quality=92)


def session_of(folder: Path, *, photos: bool = True) -> Session:
    """The plot opened, with its photos read."""
    session = open_plot(write_plot(folder, photos=photos), up="+z", project_dir=folder / "plot.dbh")
    if photos:
        cameras = read_cameras(CameraSource.of(folder / "cameras" / "cameras.csv"), cloud_sample(session.cloud))
        session.remember_cameras(cameras)
        session.do(commands.set_cameras(cameras.source))
    return session
