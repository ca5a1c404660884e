"""One photo with its mask drawn over it: to see whether masks a person brings are read as they are meant."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from dbh_studio.errors import FileError, SettingError

if TYPE_CHECKING:
    from dbh_studio.app.brought_masks import MaskSet
    from dbh_studio.core.arrays import UInt8
    from dbh_studio.core.posed_images import PosedImage, PosedImages
    from dbh_studio.io.masks import TrunkMask

Item = TypeVar("Item")

_N_SAMPLE = 8
_OWN_COMMENT = b"DBH Studio mask overlay"


def spread(items: Sequence[Item]) -> list[Item]:
    """At most a few, from the first to the last: enough to tell what all are like."""
    return [items[k] for k in np.unique(np.linspace(0, len(items) - 1, min(len(items), _N_SAMPLE)).astype(int))]


def overlay_picture(masks: MaskSet, posed: PosedImages) -> tuple[str, UInt8]:
    """Name and (h, w, 3) picture of the photo with most trunk among a few, its mask drawn over it.

    Raises:
        FileError: No photo with a mask is on disk, or none of these masks can be read.
    """
    from dbh_studio.io.masks import overlay
    from dbh_studio.io.photos import read_photo

    shown = [photo for photo in posed if photo.path is not None and photo.name in masks.match.found]
    if not shown:
        raise FileError(
            masks.path, "No photo that has a mask was found, so none can be drawn.", "Say where photos are (--images)."
        )
    best: tuple[float, PosedImage, TrunkMask] | None = None
    problem: FileError | None = None
    for photo in spread(shown):
        try:
            mask = masks.mask(photo.name)
        except FileError as error:
            problem = error
            continue
        assert mask is not None  # it is among the found
        share = float(np.count_nonzero(mask.labels) / mask.labels.size)
        if best is None or share > best[0]:
            best = share, photo, mask
    if best is None:
        assert problem is not None
        raise problem
    return best[1].name, overlay(read_photo(best[1]), best[2])


def write_overlay(path: Path, masks: MaskSet, posed: PosedImages) -> str:
    """Write `overlay_picture` as JPEG; the name of its photo. Only an overlay of an earlier time is replaced.

    Raises:
        FileError: There is another file of this name, or as `overlay_picture`.
        SettingError: It is no name of a JPEG file.
        OSError: It cannot be written.
    """
    check_overlay_path(path)
    name, picture = overlay_picture(masks, posed)
    save_overlay(path, picture)
    return name


def check_overlay_path(path: Path) -> None:
    """Raise SettingError or FileError where an overlay may not be written: no JPEG, or a file that is no overlay."""
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        raise SettingError(f"{path.name}: the overlay is written as JPEG.", "Give it a name that ends in .jpg.")
    if os.path.lexists(path) and not _is_own_overlay(path):
        raise FileError(path, "There is such a file already, and it is no overlay.", "Choose another name for it.")


def save_overlay(path: Path, picture: UInt8) -> None:
    """Write an (h, w, 3) overlay, marked as such, so that it may be replaced.

    Raises:
        OSError: It cannot be written.
    """
    from PIL import Image

    from dbh_studio.io.atomic import atomic_file

    with atomic_file(path) as file:
        Image.fromarray(picture).save(file, "JPEG", quality=88, comment=_OWN_COMMENT)


def _is_own_overlay(path: Path) -> bool:
    from dbh_studio.io.photos import open_picture

    try:
        with open_picture(path) as picture:
            return picture.info.get("comment") == _OWN_COMMENT
    except (OSError, SyntaxError, ValueError):
        return False
