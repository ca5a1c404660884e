"""The bit patterns of printed markers, by the names OpenCV gives the dictionaries."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from dbh_studio.core.arrays import Bool, readonly
from dbh_studio.errors import MissingComponentError, SettingError

# Per family its dictionaries, the small ones first: each holds the markers of the one before it.
FAMILIES: tuple[tuple[str, ...], ...] = (
    ("DICT_4X4_50", "DICT_4X4_100", "DICT_4X4_250", "DICT_4X4_1000"),
    ("DICT_5X5_50", "DICT_5X5_100", "DICT_5X5_250", "DICT_5X5_1000"),
    ("DICT_6X6_50", "DICT_6X6_100", "DICT_6X6_250", "DICT_6X6_1000"),
    ("DICT_7X7_50", "DICT_7X7_100", "DICT_7X7_250", "DICT_7X7_1000"),
    ("DICT_ARUCO_ORIGINAL",),
    ("DICT_APRILTAG_16h5",),
    ("DICT_APRILTAG_25h9",),
    ("DICT_APRILTAG_36h10",),
    ("DICT_APRILTAG_36h11",),
    ("DICT_ARUCO_MIP_36h12",),
)
DICTIONARIES: tuple[str, ...] = tuple(name for family in FAMILIES for name in family)


def opencv() -> Any:
    """The module cv2 with its marker part.

    Raises:
        MissingComponentError: It is not installed, or too old.
    """
    try:
        import cv2
    except ImportError:
        raise MissingComponentError("Markers need OpenCV.", "Install it:  pip install opencv-python-headless") from None
    if not hasattr(getattr(cv2, "aruco", None), "ArucoDetector"):
        raise MissingComponentError(
            "This OpenCV has no marker detector.", "Install a newer one:  pip install -U opencv-python-headless"
        )
    return cv2


def known_name(name: str) -> str:
    """The dictionary's name as `DICTIONARIES` writes it; upper and lower case and ``DICT_`` do not matter.

    Raises:
        SettingError: There is no such dictionary.
    """
    wanted = name.upper().removeprefix("DICT_")
    for known in DICTIONARIES:
        if known.upper().removeprefix("DICT_") == wanted:
            return known
    raise SettingError(f"There is no marker dictionary {name!r}.", f"Choose one of: {', '.join(DICTIONARIES)}.")


def is_available(name: str) -> bool:
    """Whether the installed OpenCV knows the dictionary: a few came late."""
    return hasattr(opencv().aruco, name)


def dictionary(name: str) -> Any:
    """OpenCV's dictionary object.

    Raises:
        SettingError: There is no such dictionary, or this OpenCV does not know it.
        MissingComponentError: OpenCV is absent.
    """
    known = known_name(name)
    aruco = opencv().aruco
    if not hasattr(aruco, known):
        raise SettingError(f"The installed OpenCV does not know {known}.", "Install a newer one, or use another.")
    return aruco.getPredefinedDictionary(getattr(aruco, known))


@lru_cache(maxsize=256)
def marker_bits(name: str, marker_id: int) -> Bool:
    """(n, n) True where white, with the black border of one cell; row 0 is the printed top.

    Raises:
        SettingError: There is no such dictionary or id.
        MissingComponentError: OpenCV is absent.
    """
    codes = dictionary(name)
    count = int(codes.bytesList.shape[0])
    if not 0 <= marker_id < count:
        raise SettingError(f"{known_name(name)} has no marker {marker_id}.", f"Its ids are 0 to {count - 1}.")
    cells = int(codes.markerSize) + 2
    picture = opencv().aruco.generateImageMarker(codes, int(marker_id), cells, borderBits=1)
    bits: Bool = readonly(np.asarray(picture) > 127)
    return bits


def smallest_dictionary(name: str, marker_id: int) -> str:
    """The smallest dictionary of the same family that has this marker: 4X4_50 and 4X4_1000 share their first fifty."""
    for candidate in _family(name):
        limit = candidate.rsplit("_", 1)[-1]
        if candidate == name or (limit.isdigit() and marker_id < int(limit)):
            return candidate
    return name


def largest_dictionary(name: str) -> str:
    """The largest dictionary of the same family."""
    return _family(name)[-1]


def _family(name: str) -> tuple[str, ...]:
    return next((family for family in FAMILIES if name in family), (name,))
