"""The plot of `threestems` with a pole that is no tree, seen by panoramas whose true masks are known."""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tests.threestems import STEMS, plot_points, stem_points

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.transforms import Similarity
from dbh_studio.io.ply import write_ply

# Centre x and y, diameter, metres; as tall and as round as the stems, so that only a mask can tell it from one.
POLE = (4.0, 2.5, 0.20)
ORIGIN_M = np.array([500_000.0, 4_500_000.0, 100.0])
N_PHOTOS, WIDTH_PX = 8, 1024
_LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class MaskPlot:
    """What was written: ``plot.ply``, ``poses.json``, ``images``, ``masks`` (0 nothing, 1-3 the stems, 9 the pole)."""

    folder: Path
    unit_m: float

    @property
    def cloud(self) -> Path:
        return self.folder / "plot.ply"

    @property
    def poses(self) -> Path:
        return self.folder / "poses.json"

    @property
    def masks(self) -> Path:
        return self.folder / "masks"


@functools.cache
def photos() -> PosedImages:
    """Panoramas around the middle of the plot, metres."""
    camera = CameraModel("EQUIRECTANGULAR", WIDTH_PX, WIDTH_PX // 2, ())
    images = []
    for k, angle in enumerate(np.arange(N_PHOTOS) * 2 * np.pi / N_PHOTOS):
        yaw = 1.3 * k
        turn = np.array([[np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        place = np.array([4.0 + 3.3 * np.cos(angle), 3.0 + 3.3 * np.sin(angle), 1.6])
        images.append(PosedImage(f"{k:02d}.jpg", camera, Similarity(_LEVEL @ turn, -(_LEVEL @ turn @ place)), order=k))
    return PosedImages(tuple(images))


@functools.cache
def labels() -> dict[str, np.ndarray]:
    """Name → (H, W) uint8: the pixels' rays cut with upright cylinders of 5 m; the nearest wins."""
    return {photo.name: _cast(photo) for photo in photos()}


def _cast(photo: PosedImage) -> np.ndarray:
    height, width = photo.camera.height_px, photo.camera.width_px
    across, down = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    origin, rays = photo.ray(np.column_stack([across.ravel(), down.ravel()]))
    label, nearest = np.zeros(len(rays), np.uint8), np.full(len(rays), np.inf)
    for number, (x, y, diameter) in [*enumerate(STEMS, start=1), (9, POLE)]:
        to = origin[:2] - [x, y]
        a, b = (rays[:, :2] ** 2).sum(axis=1), rays[:, :2] @ to
        with np.errstate(invalid="ignore", divide="ignore"):
            t = (-b - np.sqrt(b * b - a * (to @ to - diameter**2 / 4))) / a
            z = origin[2] + t * rays[:, 2]
            hit = (t > 0) & (t < nearest) & (z >= 0.0) & (z <= 5.0)
        label[hit], nearest[hit] = number, t[hit]
    return label.reshape(height, width)


def save_mask(path: Path, values: np.ndarray) -> None:
    """(H, W) as a grey picture."""
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(values, np.uint8)).save(path)


def save_masks(folder: Path, of_labels, suffix: str = ".png") -> Path:
    """A mask per photo: what `of_labels` makes of its labels."""
    for name, each in labels().items():
        save_mask(folder / (Path(name).stem + suffix), of_labels(each))
    return folder


def write_mask_plot(folder: Path, *, unit_m: float = 1.0) -> MaskPlot:
    """Write all files; a second."""
    from PIL import Image

    made = MaskPlot(folder, unit_m)
    (folder / "images").mkdir(parents=True)
    pole = stem_points(POLE[2], seed=9) + [POLE[0], POLE[1], 0.0]
    write_ply(made.cloud, PointCloud.from_points((np.concatenate([plot_points(), pole]) + ORIGIN_M) / unit_m))
    entries = []
    for photo in photos():
        rotation, centre = photo.cam_from_source.rotation, (photo.centre_src + ORIGIN_M) / unit_m
        entry = {"name": photo.name, "width": WIDTH_PX, "height": WIDTH_PX // 2, "model": photo.camera.kind}
        entry |= {f"r{i + 1}{j + 1}": float(rotation[i, j]) for i in range(3) for j in range(3)}
        entries.append(entry | dict(zip("xyz", map(float, centre), strict=True)))
        Image.new("RGB", (WIDTH_PX, WIDTH_PX // 2), (90, 120, 80)).save(folder / "images" / photo.name)
    made.poses.write_text(json.dumps({"images": entries}))
    save_masks(made.masks, lambda each: each)
    return made


def coco(categories: dict[int, str], category_of) -> dict[str, object]:
    """The masks as COCO run lengths; `category_of` gives the category of a label."""
    images, annotations = [], []
    for k, (name, each) in enumerate(labels().items()):
        images.append({"id": k, "file_name": name, "width": each.shape[1], "height": each.shape[0]})
        for label in np.unique(each[each > 0]):
            flat = (each == label).ravel(order="F").astype(np.int8)
            edges = np.flatnonzero(np.diff(np.concatenate([[0], flat, [0]])))
            counts = np.diff(np.concatenate([[0], edges, [flat.size]])).tolist()
            annotations.append(
                {
                    "id": len(annotations),
                    "image_id": k,
                    "category_id": category_of(int(label)),
                    "segmentation": {"size": list(each.shape), "counts": counts},
                }
            )
    named = [{"id": key, "name": name} for key, name in categories.items()]
    return {"images": images, "annotations": annotations, "categories": named}
