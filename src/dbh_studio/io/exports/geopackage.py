"""GeoPackage (OGC 12-128r19): one layer of points, in the map system of the plot or as undefined Cartesian metres."""

from __future__ import annotations

import sqlite3
import struct
import tempfile
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from dbh_studio.io.exports.columns import Kind, Table, unwritten, written_whole

LAYER = "stems"

_APPLICATION_ID, _VERSION = 0x47504B47, 10300  # "GPKG", 1.3.0
_UNDEFINED_CARTESIAN = -1
_TYPES: dict[Kind, str] = {"text": "TEXT", "integer": "INTEGER", "real": "DOUBLE", "boolean": "BOOLEAN"}
# Tables every GeoPackage has (annex C of the standard).
_SCHEMA = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name), CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
"""


def write_geopackage(path: Path | str, table: Table) -> Path:
    """Write a point per stem with every column of the table; a stem whose place is not known has no geometry.

    Raises:
        FileError: It cannot be written.
    """
    path = Path(path)
    try:
        content = _content(table)
    except OSError as error:
        raise unwritten(path, error) from error
    except sqlite3.OperationalError as error:
        raise unwritten(path, OSError(str(error))) from error
    with written_whole(path) as file:
        file.write(content)
    return path


def _content(table: Table) -> bytes:
    """The whole file. Raises OSError and sqlite3.OperationalError where there is no room for it."""
    with tempfile.TemporaryDirectory() as folder:
        # SQLite wants a file of its own, with its journal beside; what is handed in appears whole or not at all.
        made = Path(folder) / "stems.gpkg"
        connection = sqlite3.connect(made)
        try:
            with connection:
                _fill(connection, table)
        finally:
            connection.close()
        return made.read_bytes()


def _fill(connection: sqlite3.Connection, table: Table) -> None:
    connection.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version = {_VERSION}")
    for statement in _SCHEMA.split(";"):
        connection.execute(statement)
    srs_id = _reference_systems(connection, table)
    columns = ", ".join(f"{_quoted(column.name)} {_TYPES[column.kind]}" for column in table.columns)
    connection.execute(f'CREATE TABLE "{LAYER}" (fid INTEGER PRIMARY KEY AUTOINCREMENT, geom POINT, {columns})')
    places = [_place(row, srs_id) for row in table.inventory]
    known = [place for place in places if place is not None]
    bounds = [f(place[axis] for place in known) if known else None for f in (min, max) for axis in (0, 1)]
    # The moment is metadata, not a result: two exports of one plot may differ in it.
    now = datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%S.000Z")
    connection.execute(
        "INSERT INTO gpkg_contents VALUES (?, 'features', ?, '', ?, ?, ?, ?, ?, ?)",
        (LAYER, LAYER, now, *bounds, srs_id),
    )
    connection.execute("INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', 'POINT', ?, 0, 0)", (LAYER, srs_id))
    marks = ", ".join("?" * (len(table.columns) + 1))
    names = ", ".join(_quoted(column.name) for column in table.columns)
    rows = [(_point(place, srs_id), *row) for place, row in zip(places, table.rows, strict=True)]
    connection.executemany(f'INSERT INTO "{LAYER}" (geom, {names}) VALUES ({marks})', rows)


def _quoted(name: str) -> str:
    """A name in SQL: people call their fields what they like."""
    return '"' + name.replace('"', '""') + '"'


def _reference_systems(connection: sqlite3.Connection, table: Table) -> int:
    """Enter the systems every file must have, and the plot's own; the number of that."""
    entries: list[tuple[Any, ...]] = [
        ("Undefined Cartesian SRS", -1, "NONE", -1, "undefined", "undefined Cartesian coordinate reference system"),
        ("Undefined geographic SRS", 0, "NONE", 0, "undefined", "undefined geographic coordinate reference system"),
        ("WGS 84 geodetic", 4326, "EPSG", 4326, _WGS_84, "longitude/latitude coordinates in decimal degrees"),
    ]
    codes = {row.epsg for row in table.inventory if row.epsg is not None}
    srs_id = codes.pop() if len(codes) == 1 else _UNDEFINED_CARTESIAN
    if srs_id not in (_UNDEFINED_CARTESIAN, 4326):
        name, definition = _described(srs_id)
        entries.append((name, srs_id, "EPSG", srs_id, definition, None))
    connection.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", entries)
    return srs_id


def _described(epsg: int) -> tuple[str, str]:
    """Name and WKT of a system; the code alone where pyproj is absent, which GIS programs look up themselves."""
    try:
        import pyproj
    except ImportError:
        return f"EPSG:{epsg}", "undefined"
    system = pyproj.CRS.from_epsg(epsg)
    return system.name, system.to_wkt("WKT1_GDAL")


def _place(row: Any, srs_id: int) -> tuple[float, float] | None:
    x, y = (row.x_m, row.y_m) if srs_id == _UNDEFINED_CARTESIAN else (row.easting, row.northing)
    return None if x is None or y is None else (x, y)


def _point(place: tuple[float, float] | None, srs_id: int) -> bytes | None:
    """A GeoPackage geometry: header of 8 bytes, little-endian and without envelope, then a WKB point."""
    if place is None:
        return None
    return struct.pack("<2sBBi", b"GP", 0, 1, srs_id) + struct.pack("<BIdd", 1, 1, *place)


_WGS_84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
    'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],UNIT["degree",0.0174532925199433,'
    'AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4326"]]'
)
