"""GeoJSON (RFC 7946): longitude and latitude where the plot has a map system, else the plot's own metres, said so."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from dbh_studio.io.exports.columns import Table, written_whole

# 1e-8 of a degree is a millimetre.
_DEGREE_DIGITS = 8
_LOCAL_NOTE = "The plot has no coordinate reference system: coordinates are metres about the plot's own origin."


def write_geojson(path: Path | str, table: Table) -> Path:
    """Write a point per stem; a stem whose place is not known has no geometry.

    Raises:
        FileError: It cannot be written.
        MissingComponentError: The plot has a map system and pyproj is absent.
    """
    path = Path(path)
    placed = positions_lon_lat(table)
    features = []
    for number, record in enumerate(table.records()):
        place = placed[number] if placed is not None else _own(table, number)
        geometry = None if place is None else {"type": "Point", "coordinates": place}
        features.append({"type": "Feature", "id": record["stem_id"], "geometry": geometry, "properties": record})
    whole: dict[str, Any] = {"type": "FeatureCollection"}
    if placed is None:
        whole["note"] = _LOCAL_NOTE
    whole["features"] = features
    with written_whole(path) as file:
        file.write(json.dumps(whole, ensure_ascii=False, allow_nan=False, indent=1).encode())
    return path


def positions_lon_lat(table: Table) -> list[list[float] | None] | None:
    """Longitude and latitude (WGS 84) of every stem; None where the plot has no map system.

    Raises:
        MissingComponentError: pyproj is absent.
    """
    codes = {row.epsg for row in table.inventory if row.epsg is not None}
    if len(codes) != 1:
        return None
    transformer = _transformer(codes.pop())
    placed: list[list[float] | None] = []
    for row in table.inventory:
        if row.easting is None or row.northing is None:
            placed.append(None)
            continue
        longitude, latitude = transformer.transform(row.easting, row.northing)
        # Infinite where the place lies outside what the system can say.
        is_somewhere = math.isfinite(longitude) and math.isfinite(latitude)
        placed.append([round(longitude, _DEGREE_DIGITS), round(latitude, _DEGREE_DIGITS)] if is_somewhere else None)
    return placed


def _transformer(epsg: int) -> Any:
    from dbh_studio.errors import MissingComponentError

    try:
        import pyproj
    except ImportError as error:
        raise MissingComponentError(
            "Longitude and latitude need pyproj, which is not installed.",
            "Install it, or hand in the GeoPackage or the CSV, which keep the plot's own map system.",
        ) from error
    return pyproj.Transformer.from_crs(epsg, 4326, always_xy=True)


def _own(table: Table, number: int) -> list[float] | None:
    row = table.inventory.rows[number]
    return None if row.x_m is None or row.y_m is None else [round(row.x_m, 4), round(row.y_m, 4)]
