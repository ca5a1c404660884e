"""What a plot's report says: gathered of one state of the plot, its photographs included."""

from __future__ import annotations

import math
import platform
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any, Literal

from dbh_studio import __version__
from dbh_studio.app.document import Document
from dbh_studio.app.session import Session
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.section_drawing import CURVE_TITLES
from dbh_studio.io.column_names import M_PER_FOOT
from dbh_studio.io.exports.report_model import Pairs, Report, StemPage, TreePicture
from dbh_studio.io.exports.stem_map import North

if TYPE_CHECKING:
    from dbh_studio.app.tree_photos import TreePhoto
    from dbh_studio.core.stand import PlotArea, StandTable, Units
    from dbh_studio.io.exports.columns import Table
    from dbh_studio.io.exports.edit_log import LogEntry
    from dbh_studio.stages.measure import StemMeasurement

PictureSize = Literal["none", "small", "large"]

_SIZES_PX: dict[PictureSize, tuple[int, int]] = {"small": (330, 440), "large": (540, 720)}
_MOST_PICTURES = 4
# Of all photographs together: mail servers take 20 to 25 MB, and base64 adds a third.
_BUDGET_BYTES: dict[PictureSize, int] = {"small": 9_000_000, "large": 60_000_000}
_LEAST_PICTURE_BYTES = 18_000
_QUALITIES = (85, 75, 65, 50, 35)
_SOURCES = {
    "metres": "the file is in metres",
    "feet": "the file is in feet",
    "millimetres": "the file is in millimetres",
    "factor": "given by hand",
    "marker": "by markers of known size",
    "bars": "by known lengths",
    "camera_height": "by the height of the camera, which is a guess",
    "baseline": "by the distance between photos, which is a guess",
    "lidar": "carried over from a LiDAR cloud",
}
_SECTIONS = (
    ("ground", "Settings of the ground"),
    ("trunks", "Settings of the search"),
    ("measure", "Settings of measuring"),
)
_COMPASS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")
_FOUR_AND_A_HALF_FEET_M = 1.3716


@dataclass(frozen=True)
class ReportParts:
    """What a report is made of that others make too.

    Attributes:
        table: The inventory.
        stand: The stand table.
        area: Of the plot.
        log: What was done.
    """

    table: Table
    stand: StandTable
    area: PlotArea
    log: tuple[LogEntry, ...]


def make_report(
    session: Session,
    document: Document,
    parts: ReportParts,
    *,
    pictures: PictureSize = "small",
    progress: Progress = ignore_progress,
) -> Report:
    """Gather the report of a state of the plot; stems that are not measured yet are.

    Raises:
        CancelledError: From `progress`.
    """
    rows = list(parts.table.inventory)
    pages = []
    north = north_of(session, document)
    room = _room(document, len(rows), pictures)
    for number, row in enumerate(rows):
        progress(number / max(len(rows), 1), f"Stem {row.stem_id}")
        stem = session.measurement(row.stem_id, document=document)
        photos, note = _pictures(session, document, row.stem_id, pictures, room, north)
        record = document.record(row.stem_id)
        pages.append(StemPage(row, stem.result, _curve(stem, document), record, photos, note))
    return Report(
        title=document.plot_id,
        made=made_words(),
        table=parts.table,
        stand=parts.stand,
        area=parts.area,
        north=north,
        facts=facts_of(session, document, parts.table.units),
        pages=tuple(pages),
        log=parts.log,
        settings=tuple((title, tuple(_settings(getattr(document.settings, name)))) for name, title in _SECTIONS),
        versions=_versions(document),
    )


def made_words() -> str:
    """When the report was made, and by what."""
    now = datetime.now(timezone.utc)
    return f"Report of {now.day} {now:%B %Y}, {now:%H:%M} UTC, by DBH Studio {__version__}"


def facts_of(session: Session, document: Document, units: Units) -> Pairs:
    """What one must know of a plot to judge its numbers."""
    measure = document.settings.measure
    curve = CURVE_TITLES.get(measure.curve, measure.curve)
    has_interval = measure.curve in ("shrinkage", "circle")
    ends = "with 90 % intervals" if has_interval else "a curve without intervals"
    return (
        ("Scale", scale_words(document)),
        ("Method", f"{curve}, {ends}; diameter as {_title(measure, 'definition')}"),
        ("Protocol", protocol_words(document, units)),
        ("Cloud", f"{document.source.path.name}, {document.source.n_points:,} points"),
        ("Map system", session.cloud.crs if session.cloud.crs and len(session.cloud.crs) < 60 else ""),
    )


def scale_words(document: Document) -> str:
    """The scale with its error and where it is from."""
    scale = document.scale
    if not scale.is_known:
        return "not known"
    words = f"{scale.metres_per_unit:.6g} m per unit of the file: {_SOURCES.get(scale.source, scale.source)}"
    if scale.standard_error is None:
        return words + ("" if scale.source in ("metres", "feet", "millimetres") else "; its error is not known")
    return f"{words}; standard error {100 * scale.relative_sd:.2g} %, which is in the intervals"


def protocol_words(document: Document, units: Units) -> str:
    """Where a diameter is taken."""
    measure = document.settings.measure
    height = measure.breast_height_m
    at = f"{height:.2f} m" if units == "metric" else f"{height / M_PER_FOOT:.2f} ft ({height:.2f} m)"
    words = [f"breast height {at} above the ground"]
    words += [f"{title}: {measure_value}" for title, measure_value in _protocol(measure)]
    if units == "imperial" and abs(height - _FOUR_AND_A_HALF_FEET_M) > 0.005:
        words.append("not 4.5 ft, at which DIA is taken")
    return "; ".join(words)


def _protocol(measure: Any) -> Iterator[tuple[str, str]]:
    for name in ("base", "along", "above"):
        if hasattr(measure, name):
            yield type(measure).model_fields[name].title.lower(), str(getattr(measure, name))


def _title(measure: Any, name: str) -> str:
    words = {
        "tape": "a tape reads it (convex girth / π)",
        "curve": "perimeter / π",
        "area": "of the circle of equal area",
    }
    return words.get(getattr(measure, name), str(getattr(measure, name)))


def north_of(session: Session, document: Document) -> North:
    """What is known of north."""
    if document.north_direction is not None:
        return North("N", "up is north as it was set in the plot")
    from dbh_studio.io.inventory_csv import projected_epsg

    if document.up_direction == (0.0, 0.0, 1.0) and projected_epsg(session.cloud.crs)[0]:
        return North("N", "up is grid north of the map system")
    return North()


def _settings(section: Any) -> Iterator[tuple[str, str]]:
    """Titles and values of a section of the settings."""
    for name, field in type(section).model_fields.items():
        extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
        unit = str(extra.get("unit", ""))
        value = getattr(section, name)
        text = f"{value:g}" if isinstance(value, float) else str(value)
        yield field.title or name, f"{text} {unit}".strip()


def _versions(document: Document) -> Pairs:
    import numpy as np

    masks = document.masks
    return (
        ("Program", f"DBH Studio {__version__}"),
        ("Computed by", f"Python {platform.python_version()}, NumPy {np.__version__}"),
        ("Cloud", f"{document.source.path.name}, {document.source.n_points:,} points"),
        ("Fingerprint", document.source.fingerprint),
        (
            "Trunks found",
            "with masks of the photos" if masks is not None else "from the cloud alone, a file or by hand",
        ),
    )


def _curve(stem: StemMeasurement, document: Document) -> str:
    """The curve that gave the diameter, or was to."""
    said = document.record(stem.trunk_id).correction("curve")
    return str(getattr(stem.result, "curve", None) or said or document.settings.measure.curve)


# ---- photographs


def _room(document: Document, n_stems: int, size: PictureSize) -> tuple[int, int]:
    """How many photographs a stem has, and of how many bytes each, so that the report can be mailed."""
    if size == "none" or document.cameras is None or not n_stems:
        return 0, 0
    budget = _BUDGET_BYTES[size]
    most = min(_MOST_PICTURES, max(1, budget // (n_stems * _LEAST_PICTURE_BYTES)))
    return most, budget // (n_stems * most)


def _pictures(
    session: Session, document: Document, stem_id: int, size: PictureSize, room: tuple[int, int], north: North
) -> tuple[tuple[TreePicture, ...], str]:
    most, n_bytes = room
    if not most:
        return (), ""
    from dbh_studio.app.tree_photos import tree_photos

    found = tree_photos(session, stem_id, most=most, size_px=_SIZES_PX[size], document=document)
    pictures = (TreePicture(_jpeg(photo, n_bytes), _photo_words(photo, north)) for photo in found.photos)
    return tuple(pictures), found.note


def _jpeg(photo: TreePhoto, n_bytes: int) -> bytes:
    """As good as there is room for."""
    content = b""
    for quality in _QUALITIES:
        content = photo.jpeg(drawn=True, quality=quality)
        if len(content) <= n_bytes:
            break
    return content


def _photo_words(photo: TreePhoto, north: North) -> str:
    words = [f"{photo.distance_m:.1f} m away" if math.isfinite(photo.distance_m) else ""]
    if north.letter == "N" and math.isfinite(photo.bearing_deg):
        words.append(f"from the {_COMPASS[round(photo.bearing_deg / 45.0) % 8]}")
    return " · ".join(filter(None, (", ".join(filter(None, words)), photo.name)))
