"""The finds of the last search for markers, kept beside the plot so that a reload has them. May be deleted any time."""

from __future__ import annotations

import logging
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dbh_studio.app.document import CameraSource
from dbh_studio.core.posed_images import PosedImages
from dbh_studio.io.atomic import atomic_file

if TYPE_CHECKING:
    from dbh_studio.stages.marker_detect import Detection

log = logging.getLogger(__name__)

_FILE = Path("cache") / "markers.npz"
_VERSION = 1
_NUMBERS = ("confidence", "sigma_px", "pixel_rad", "blur_px")


def keep_detections(folder: Path, cameras: CameraSource, detections: Sequence[Detection]) -> None:
    """Write them into the folder of a saved plot. That it cannot be written is no loss, and only logged."""
    arrays: dict[str, Any] = {
        "version": _VERSION,
        "cameras": np.array(_named(cameras)),
        "image": np.array([each.image for each in detections], np.str_),
        "dictionary": np.array([each.dictionary for each in detections], np.str_),
        "marker_id": np.array([each.marker_id for each in detections], np.int64),
        "corners_px": np.array([each.corners_px for each in detections], np.float64).reshape(-1, 4, 2),
    }
    if detections:
        arrays["crop"] = np.stack([each.crop for each in detections])
    for name in _NUMBERS:
        arrays[name] = np.array([getattr(each, name) for each in detections], np.float64)
    try:
        (folder / _FILE).parent.mkdir(exist_ok=True)
        with atomic_file(folder / _FILE) as file:
            np.savez_compressed(file, **arrays)
    except OSError as error:
        log.warning("The finds of the search for markers were not kept: %s", error.strerror or error)


def kept_detections(folder: Path, cameras: CameraSource, posed: PosedImages) -> tuple[Detection, ...] | None:
    """What `keep_detections` wrote for the same photos; None where there is nothing that can be used."""
    from dbh_studio.stages.marker_detect import Detection

    path = folder / _FILE
    if not path.is_file():
        return None
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as saved:
            if int(saved["version"]) != _VERSION or saved["cameras"].tolist() != _named(cameras):
                return None
            count = len(saved["image"])
            numbers = {name: saved[name].astype(np.float64).reshape(count).tolist() for name in _NUMBERS}
            corners = saved["corners_px"].astype(np.float64).reshape(count, 4, 2)
            crops = saved["crop"] if count else np.empty((0, 1, 1, 3), np.uint8)
            if crops.dtype != np.uint8 or crops.ndim != 4 or len(crops) != count or not np.isfinite(corners).all():
                return None
            texts = zip(saved["image"].tolist(), saved["dictionary"].tolist(), saved["marker_id"].tolist(), strict=True)
            found = tuple(
                Detection(
                    image=image,
                    dictionary=dictionary,
                    marker_id=marker_id,
                    corners_px=corners[row],
                    crop=crops[row],
                    **{name: numbers[name][row] for name in _NUMBERS},
                )
                for row, (image, dictionary, marker_id) in enumerate(texts)
            )
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        log.warning("The finds of the last search for markers cannot be used: %s", error)
        return None
    names = {photo.name for photo in posed}
    return found if all(each.image in names for each in found) else None


def _named(cameras: CameraSource) -> list[str]:
    return [str(cameras.path), str(cameras.images_dir or ""), cameras.frame]
