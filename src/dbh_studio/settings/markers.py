"""Settings of the printed markers that give photos their scale."""

from __future__ import annotations

from dbh_studio.settings.base import SettingsModel, setting


class MarkerSettings(SettingsModel):
    """How printed markers are found in photos, and what is believed of their size."""

    dictionaries: tuple[str, ...] = setting(
        (), "Marker dictionaries", help="such as DICT_4X4_50; none named: they are guessed from the photos"
    )
    ids: tuple[int, ...] = setting((), "Marker ids", help="only these; none named: all of the dictionary")
    side_m: float = setting(
        1.0,
        "Marker side",
        unit="m",
        ge=0.02,
        le=10.0,
        help="outer edge of the black square, for markers without their own",
    )
    side_error_mm: float = setting(
        0.5, "Error of the side", unit="mm", ge=0.0, le=50.0, help="how well the side was measured with a ruler"
    )
    detection_width_px: int = setting(
        3072,
        "Search width",
        unit="px",
        ge=512,
        le=16384,
        help="photos are shrunk to this for the search, not for the fit",
    )
    min_match: float = setting(
        0.8, "Smallest match", ge=0.3, le=0.99, help="correlation of a marker's inner cells with its pattern"
    )
    systematic_px: float = setting(
        0.03,
        "Shared corner error",
        unit="px",
        ge=0.0,
        le=1.0,
        help="what blur leaves in every edge and no number of photos averages out",
    )
    max_offset_px: float = setting(
        3.0,
        "Largest offset",
        unit="px",
        ge=0.2,
        le=50.0,
        help="a photo whose ray misses the marker by more is left out",
    )
