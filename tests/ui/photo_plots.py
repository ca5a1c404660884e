"""The small plot with photos beside it: panoramas whose pixels are known, and a COLMAP model as pycolmap writes it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plots
import pytest
from PIL import Image

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.transforms import Similarity

WIDTH, HEIGHT = 1024, 512
N_PHOTOS = 6
# In every panorama: a white dot, its middle in pixels of the photo.
DOT = (560.0, 280.0)
_DOT_RADIUS = 4.0
# Camera axes (+x right, +y down, +z forward) of a level camera that looks north.
_LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def picture(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """(H, W, 3) sky above, ground below, bluer and redder to the right, and the dot; nothing else is white."""
    rows, columns = np.indices((height, width)) + 0.5
    sky = rows < height / 2
    image = np.stack([40 + 80 * columns / width, np.where(sky, 90, 60), np.where(sky, 150, 40)], axis=2)
    image[np.hypot(columns - DOT[0], rows - DOT[1]) < 2 * _DOT_RADIUS] = 0
    image[np.hypot(columns - DOT[0], rows - DOT[1]) < _DOT_RADIUS] = 255
    return image.astype(np.uint8)


def centres() -> np.ndarray:
    """(N_PHOTOS, 3) where the photos are taken: on a ring within the plot, in the cloud's coordinates."""
    cloud = plots.plot().cloud
    points = cloud.xyz + cloud.origin
    low, high = np.percentile(points, [2, 98], axis=0)
    turn = 2 * np.pi * np.arange(N_PHOTOS) / N_PHOTOS
    ring = 0.25 * (high - low)[:2] * np.column_stack([np.cos(turn), np.sin(turn)])
    return np.column_stack([0.5 * (low + high)[:2] + ring, np.full(N_PHOTOS, low[2] + 2.5)])


def cam_from_source(index: int) -> Similarity:
    """A level camera that looks the way it goes, more or less."""
    turn = 2 * np.pi * index / N_PHOTOS
    yaw = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    rotation = _LEVEL @ yaw
    return Similarity(rotation, -rotation @ centres()[index])


def write_photos(folder: Path, *, kind: str = "EQUIRECTANGULAR", shift: float = 0.0, photos: bool = True) -> Path:
    """A COLMAP model in `folder`/sparse/0 and its photos in `folder`/images; returns the folder.

    Args:
        folder: Is made.
        kind: EQUIRECTANGULAR, or PINHOLE.
        shift: How far the model lies from the cloud.
        photos: Whether the photos are there.
    """
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    params = () if kind == "EQUIRECTANGULAR" else (700.0, 700.0, WIDTH / 2, HEIGHT / 2)
    camera = CameraModel(kind, WIDTH, HEIGHT, params)
    model = pycolmap.Reconstruction()
    model.add_camera(pycolmap.Camera(model=kind, width=WIDTH, height=HEIGHT, params=list(camera.params), camera_id=1))
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1))
    model.add_rig(rig)
    away = np.array([shift, 0.0, 0.0])
    for index in range(N_PHOTOS):
        pose = cam_from_source(index)
        frame = pycolmap.Frame(frame_id=index + 1, rig_id=1)
        frame.rig_from_world = pycolmap.Rigid3d(
            pycolmap.Rotation3d(pose.rotation), pose.translation - pose.rotation @ away
        )
        image = pycolmap.Image(image_id=index + 1, camera_id=1, name=name(index))
        image.frame_id = index + 1
        frame.add_data_id(image.data_id)
        model.add_frame(frame)
        model.add_image(image)
        model.register_frame(index + 1)
    cloud = plots.plot().cloud
    for point in cloud.xyz[:: max(1, len(cloud) // 400)] + cloud.origin + away:
        model.add_point3D(point.astype(float), pycolmap.Track(), np.array([90, 90, 90], np.uint8))
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    model.write_binary(str(sparse))
    if photos:
        write_pictures(folder / "images")
    return folder


def write_pictures(folder: Path) -> Path:
    """The photos, all alike."""
    folder.mkdir()
    for index in range(N_PHOTOS):
        Image.fromarray(picture()).save(folder / name(index), quality=95)
    return folder


def name(index: int) -> str:
    """Of a photo."""
    return f"pano_{index:02d}.jpg"
