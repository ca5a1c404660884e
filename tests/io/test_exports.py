"""Everything that is handed in, read back with other programs' readers (GDAL through pyogrio, laspy)."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import fields, replace
from pathlib import Path

import laspy
import numpy as np
import pyogrio
import pytest

from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.dbh import Refusal
from dbh_studio.core.inventory import Inventory, InventoryRow, MapPosition, TreeRecord, inventory_row
from dbh_studio.core.measured import Diameter
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.stand import PlotArea, stand_table
from dbh_studio.core.stem_profile import ProfilePoint
from dbh_studio.errors import CancelledError, FileError
from dbh_studio.io.exports import (
    geopackage,
    profile_table,
    table_of,
    write_dxf,
    write_geojson,
    write_geopackage,
    write_labelled_cloud,
    write_svg,
    write_xlsx,
)
from dbh_studio.io.las import read_las, write_las

METRES = ScaleEstimate(1.0, "metres")
UTM = 32633
NOTE = '=HYPERLINK("http://x") & <b>«é»</b>'


def row(stem_id: int, dbh_cm: float | None, x: float, y: float, *, epsg: int | None = None, **said) -> InventoryRow:
    place = MapPosition(500_000 + x, 5_400_000 + y, epsg) if epsg else None
    made = inventory_row(
        Refusal("arc", "only 70° of the ring seen", "walk round it"),
        plot_id="plot",
        stem_id=stem_id,
        record=TreeRecord(**said),
        xy_m=np.array([x, y], float),
        z_ground_m=1.5,
        scale=METRES,
        position=place,
    )
    return made if dbh_cm is None else replace(made, dbh_cm=dbh_cm, reason="", remedy="", quality="good", hom_m=1.3)


def stems(epsg: int | None = None) -> Inventory:
    return Inventory.of(
        [
            row(3, 31.25, 0.0, 0.0, epsg=epsg, species="oak", note=NOTE),
            row(7, None, 4.0, -2.5, epsg=epsg, tag="0017"),
            row(12, 12.5, -3.0, 6.0, epsg=epsg, tree_id=3),
        ]
    )


def read(path: Path, **options):
    meta, _, geometry, columns = pyogrio.raw.read(path, **options)
    return meta, geometry, dict(zip(meta["fields"].tolist(), columns, strict=True))


def xy_of(wkb: bytes) -> tuple[float, float]:
    return tuple(np.frombuffer(wkb[5:21], "<f8").tolist())


# ---- the table


def test_imperial_names_and_numbers_change_places_do_not():
    metric, imperial = table_of(stems()), table_of(stems(), "imperial")
    assert [column.name for column in metric.columns] == [field.name for field in fields(InventoryRow)]
    first, refused, _ = imperial.records()
    assert first["dbh_in"] == pytest.approx(31.25 / 2.54) and first["hom_ft"] == pytest.approx(1.3 / 0.3048)
    assert first["x_m"] == 0.0 and "dbh_cm" not in first and refused["dbh_in"] is None
    assert first["rmse_mm"] is None


# ---- map formats


@pytest.mark.parametrize("epsg", [None, UTM])
def test_a_geopackage_is_read_by_gdal(tmp_path, epsg):
    path = write_geopackage(tmp_path / "new" / "stems.gpkg", table_of(stems(epsg)))
    meta, geometry, columns = read(path)
    assert meta["geometry_type"] == "Point" and (meta["crs"] == f"EPSG:{epsg}") == (epsg is not None)
    assert columns["stem_id"].tolist() == [3, 7, 12] and columns["tree_id"].tolist() == [3, 7, 3]
    assert columns["dbh_cm"][0] == 31.25 and np.isnan(columns["dbh_cm"][1])  # unknown is no number, never 0
    assert columns["note"][0] == NOTE and columns["tag"].tolist()[1] == "0017"
    assert columns["edited"].dtype == bool
    offset = (500_000.0, 5_400_000.0) if epsg else (0.0, 0.0)
    assert xy_of(geometry[1]) == (4.0 + offset[0], -2.5 + offset[1])
    with sqlite3.connect(path) as connection:
        bounds = connection.execute("SELECT min_x, min_y, max_x, max_y FROM gpkg_contents").fetchone()
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert connection.execute("PRAGMA application_id").fetchone() == (0x47504B47,)
    connection.close()
    assert bounds == (offset[0] - 3, offset[1] - 2.5, offset[0] + 4, offset[1] + 6)


def test_a_stem_without_a_place_has_no_geometry(tmp_path):
    table = table_of(Inventory.of([row(1, 20.0, float("nan"), 0.0)]))
    _, geometry, _ = read(write_geopackage(tmp_path / "a.gpkg", table))
    assert geometry[0] is None
    made = json.loads(write_geojson(tmp_path / "a.geojson", table).read_text("utf-8"))
    assert made["features"][0]["geometry"] is None
    assert "<circle" not in write_svg(tmp_path / "a.svg", table).read_text("utf-8")
    write_dxf(tmp_path / "a.dxf", table)


def test_geojson_is_longitude_and_latitude(tmp_path):
    path = write_geojson(tmp_path / "stems.geojson", table_of(stems(UTM)))
    meta, geometry, columns = read(path)
    assert meta["crs"] == "EPSG:4326" and columns["stem_id"].tolist() == [3, 7, 12]
    longitude, latitude = xy_of(geometry[0])
    # Zone 33's central meridian is 15° east; 5 400 000 m north is 48.75° at it.
    assert longitude == pytest.approx(15.0, abs=1e-7) and latitude == pytest.approx(48.752, abs=2e-3)
    made = json.loads(path.read_text("utf-8"))
    assert made["features"][1]["properties"]["dbh_cm"] is None and "note" not in made


def test_a_place_that_no_longitude_has_is_left_out(tmp_path):
    rows = stems(UTM).rows
    nowhere = Inventory.of([replace(rows[0], easting=1e30, northing=1e30), *rows[1:]])
    written = json.loads(write_geojson(tmp_path / "a.geojson", table_of(nowhere)).read_text())
    assert written["features"][0]["geometry"] is None
    assert written["features"][1]["geometry"] is not None


def test_geojson_without_a_map_system_says_so(tmp_path):
    made = json.loads(write_geojson(tmp_path / "stems.geojson", table_of(stems())).read_text("utf-8"))
    assert "no coordinate reference system" in made["note"]
    assert made["features"][2]["geometry"]["coordinates"] == [-3.0, 6.0]


# ---- a workbook


def test_a_workbook_is_read_by_gdal_and_holds_text_as_text(tmp_path):
    inventory = stems()
    stand = stand_table(inventory, PlotArea.circle((0, 0), 10))
    path = write_xlsx(
        tmp_path / "stems.xlsx", table_of(inventory), stand, about={"Plot": "A", "Breast height": "1.30 m"}
    )
    assert [name for name, _ in pyogrio.list_layers(path)] == ["Stems", "Stand", "About"]
    _, _, columns = read(path, layer="Stems")
    assert columns["note"].tolist()[0] == NOTE and columns["tag"].tolist()[1] == "0017"
    assert columns["dbh_cm"][0] == 31.25 and np.isnan(columns["dbh_cm"][1])
    _, _, sums = read(path, layer="Stand", max_features=3)
    assert sums["species"].tolist() == ["oak", "(not said)", "all"]
    assert sums["stems without a diameter"].astype(float).tolist() == [0, 1, 1]


def test_profiles_are_in_the_units_asked_for():
    along = ProfilePoint(1.3, Diameter(25.4, 22.86, None), 180.04, "")
    nothing = ProfilePoint(2.0, None, None, "only 70° of the ring seen")
    table = profile_table(stems(), [(7, [along, nothing]), (3, [])], "imperial")
    assert [column.name for column in table.columns] == [
        "plot_id", "tree_id", "stem_id", "tag",
        "height_ft", "dbh_in", "dbh_lo_in", "dbh_hi_in", "coverage_deg", "reason",
    ]  # fmt: skip
    first, second = table.rows
    assert first[:4] == ("plot", 7, 7, "0017")
    assert first[4:8] == (pytest.approx(1.3 / 0.3048), pytest.approx(10.0), pytest.approx(9.0), None)
    assert second[5:] == (None, None, None, None, "only 70° of the ring seen")


def test_an_empty_inventory_makes_empty_files(tmp_path):
    table = table_of(Inventory())
    stand = stand_table(Inventory(), PlotArea.circle((0, 0), 10))
    write_xlsx(tmp_path / "a.xlsx", table, stand)
    _, _, columns = read(write_geopackage(tmp_path / "a.gpkg", table))
    assert len(columns["stem_id"]) == 0
    assert json.loads(write_geojson(tmp_path / "a.geojson", table).read_text("utf-8"))["features"] == []
    write_svg(tmp_path / "a.svg", table)
    write_dxf(tmp_path / "a.dxf", table)


# ---- drawings


def test_a_dxf_has_circles_of_the_stems_and_their_numbers(tmp_path):
    area = PlotArea.polygon([(-5, -5), (5, -5), (5, 7), (-5, 7)])
    path = write_dxf(tmp_path / "map.dxf", table_of(stems()), area=area)
    _, geometry, columns = read(path)
    layers = columns["Layer"].tolist()
    assert {name: layers.count(name) for name in set(layers)} == {"STEMS": 2, "NUMBERS": 3, "REFUSED": 2, "PLOT": 4}
    assert [text for text in columns["Text"].tolist() if text] == ["3", "7", "12"]
    # GDAL draws a circle as a line string: its points are as far from the stem as its radius.
    ring = np.frombuffer(geometry[layers.index("STEMS")][9:], "<f8")
    ring = ring.reshape(-1, 3 if len(ring) % 3 == 0 and len(ring) % 2 else 2)[:, :2]
    assert np.hypot(*ring.T) == pytest.approx(0.15625, abs=1e-4)
    feet = write_dxf(tmp_path / "feet.dxf", table_of(stems(2227))).read_text("ascii")  # California zone 3, US feet
    assert f"\n40\n{0.15625 / 0.3048006:.4f}\n" in feet
    assert write_dxf(tmp_path / "utm.dxf", table_of(stems(UTM))).read_text("ascii").count("500004.") >= 1
    refused = table_of(Inventory.of([row(7, None, 4.0, -2.5, epsg=UTM)]))
    assert "500004." in write_dxf(tmp_path / "refused.dxf", refused).read_text("ascii")


def test_an_svg_shows_every_stem_and_escapes_what_people_type(tmp_path):
    inventory = Inventory.of([row(1, 20.0, 0, 0, species="<script>"), row(2, None, 3, 3)])
    drawn = write_svg(tmp_path / "map.svg", table_of(inventory), area=PlotArea.circle((0, 0), 8)).read_text("utf-8")
    assert "<script>" not in drawn and "&lt;script&gt;" in drawn
    assert drawn.count("<circle") == 1 and "no diameter: only 70°" in drawn and drawn.endswith("</svg>")


# ---- the cloud


@pytest.fixture
def las(tmp_path) -> Path:
    """Five points, the second of them noise, with an attribute of its own and an old tree_id."""
    xyz = np.array([[0, 0, 0], [9, 9, 9], [1, 0, 1], [0, 1, 2], [2, 2, 3]], np.float32)
    own = {
        "classification": np.array([1, 7, 2, 2, 2], np.uint8),
        "reflectance": np.arange(5, dtype=np.float32),
        "tree_id": np.full(5, 99, np.int32),
    }
    cloud = PointCloud(xyz, np.array([500_000.0, 4_500_000.0, 100.0]), None, own, "EPSG:32633", "a")
    write_las(tmp_path / "a.laz", cloud)
    return tmp_path / "a.laz"


def test_the_cloud_is_written_point_for_point_with_its_attributes(las, tmp_path):
    loaded = read_las(las)
    assert len(loaded.cloud) == 4  # the noise is no part of the plot
    values = {"tree_id": np.array([0, 5, 5, 6], np.int32), "height_above_ground": np.array([0, 1, 2, 3], np.float32)}
    out = write_labelled_cloud(tmp_path / "new" / "b.laz", loaded.cloud, values, source=las)
    before, after = laspy.read(las), laspy.read(out)
    for name in ("X", "Y", "Z", "classification", "reflectance"):
        assert np.array_equal(before[name], after[name]), name
    assert np.array_equal(before.header.scales, after.header.scales)
    assert after.header.parse_crs().to_epsg() == 32633
    assert after["tree_id"].tolist() == [0, 0, 5, 5, 6]
    height = np.asarray(after["height_above_ground"])
    assert np.isnan(height[1]) and height[[0, 2, 3, 4]].tolist() == [0, 1, 2, 3]
    assert np.asarray(laspy.read(las)["tree_id"]).tolist() == [99] * 5  # the source is as it was


def test_a_cloud_that_was_no_las_is_written_as_one(tmp_path):
    cloud = PointCloud(np.arange(12, dtype=np.float32).reshape(4, 3), np.zeros(3), attributes={"label": np.arange(4)})
    out = write_labelled_cloud(
        tmp_path / "b.las", cloud, {"label": np.array([4, 3, 2, 1], np.int32)}, source=tmp_path / "a.ply"
    )
    assert np.asarray(laspy.read(out)["label"]).tolist() == [4, 3, 2, 1]


def test_a_source_that_is_another_now_or_the_target_is_refused(las, tmp_path):
    cloud = read_las(las).cloud
    values = {"tree_id": np.zeros(4, np.int32)}
    content = las.read_bytes()
    with pytest.raises(FileError, match="plot is read from"):
        write_labelled_cloud(las, cloud, values, source=las)
    shorter = PointCloud(cloud.xyz[:3], cloud.origin)
    with pytest.raises(FileError, match="changed meanwhile"):
        write_labelled_cloud(tmp_path / "b.laz", shorter, {"tree_id": np.zeros(3, np.int32)}, source=las)
    with pytest.raises(ValueError, match="values for"):
        write_labelled_cloud(tmp_path / "b.laz", cloud, {"tree_id": np.zeros(3, np.int32)}, source=las)

    def cancel(*_):
        raise CancelledError

    with pytest.raises(CancelledError):
        write_labelled_cloud(tmp_path / "b.laz", cloud, values, source=las, progress=cancel)
    assert las.read_bytes() == content and sorted(p.name for p in tmp_path.iterdir()) == ["a.laz"]


@pytest.mark.parametrize("full", [sqlite3.OperationalError("database or disk is full"), OSError(28, "No space left")])
def test_a_full_disk_beside_the_geopackage_is_told(tmp_path, monkeypatch, full):
    def fill(*_):
        raise full

    monkeypatch.setattr(geopackage, "_fill", fill)
    with pytest.raises(FileError, match=r"stems.gpkg: It could not be written \(.*(full|No space)"):
        write_geopackage(tmp_path / "stems.gpkg", table_of(stems()))
    assert list(tmp_path.iterdir()) == []


def test_a_workbook_says_which_stems_are_too_thin_for_the_stand(tmp_path):
    stand = stand_table(stems(), PlotArea.circle((0, 0), 20), least_dbh_cm=20)
    path = write_xlsx(tmp_path / "a.xlsx", table_of(stems()), stand)
    columns = pyogrio.raw.read(path, layer="Stand")[3]
    assert any("thinner than 20.0 cm, which are left out: 1" in str(cell) for column in columns for cell in column)


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "stems.gpkg").mkdir()
    with pytest.raises(FileError, match="could not be written"):
        write_geopackage(tmp_path / "stems.gpkg", table_of(stems()))
