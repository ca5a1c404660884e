from __future__ import annotations

import struct

import laspy
import numpy as np
import pytest

from dbh_studio.core.cloud import PointCloud
from dbh_studio.errors import CancelledError, EmptyFileError, FileError, MalformedFileError, TruncatedFileError
from dbh_studio.io.las import read_las, write_las


def _absolute(cloud):
    return cloud.xyz.astype(np.float64) + cloud.origin


def _las(path, points, *, version="1.2", point_format=3, scale=0.0001, **columns):
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = np.full(3, scale), np.floor(points.min(axis=0)) if len(points) else np.zeros(3)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    for name, values in columns.items():
        if name not in las.point_format.dimension_names:
            las.add_extra_dim(laspy.ExtraBytesParams(name=name, type=values.dtype))
        las[name] = values
    las.write(str(path))


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(("version", "point_format"), [("1.2", 0), ("1.2", 3), ("1.3", 1), ("1.4", 6), ("1.4", 7)])
def test_no_millimetre_is_lost_at_utm(tmp_path, survey_points, suffix, version, point_format):
    path = tmp_path / f"plot{suffix}"
    _las(path, survey_points, version=version, point_format=point_format)
    loaded = read_las(path)
    assert np.abs(_absolute(loaded.cloud) - survey_points).max() < 0.0001
    assert loaded.provenance.format == suffix[1:]
    assert loaded.provenance.is_lidar


@pytest.mark.parametrize("shift", [0, 8])
def test_colours_of_8_and_16_bits(tmp_path, survey_points, rng, shift):
    rgb = rng.integers(0, 256, (500, 3))
    rgb[0] = 255
    path = tmp_path / "plot.las"
    _las(
        path,
        survey_points,
        **{n: (rgb[:, i] << shift).astype(np.uint16) for i, n in enumerate(("red", "green", "blue"))},
    )
    assert (read_las(path).cloud.rgb == rgb).all()


def test_colours_become_16_bits_in_a_later_chunk(tmp_path, survey_points, monkeypatch):
    monkeypatch.setattr("dbh_studio.io.las.CHUNK_POINTS", 100)
    red = np.full(500, 200, np.uint16)
    red[400:] = 0x8000
    path = tmp_path / "plot.las"
    _las(path, survey_points, red=red, green=red, blue=red)
    assert read_las(path).cloud.rgb[:, 0].tolist() == (red >> 8).tolist()


def test_unused_colours_are_no_colours(tmp_path, survey_points):
    _las(tmp_path / "plot.las", survey_points)
    assert read_las(tmp_path / "plot.las").cloud.rgb is None


def test_tree_ids_are_kept_and_the_rest_on_request(tmp_path, survey_points):
    ids = np.arange(500, dtype=np.int32) % 4
    path = tmp_path / "plot.laz"
    _las(path, survey_points, PredInstance=ids, intensity=np.arange(500, dtype=np.uint16))
    needed = read_las(path).cloud.attributes
    assert set(needed) == {"PredInstance", "classification"}
    assert (needed["PredInstance"] == ids).all()
    everything = read_las(path, attributes="all").cloud.attributes
    assert {"intensity", "gps_time", "return_number", "PredInstance"} <= set(everything)
    assert (everything["intensity"] == np.arange(500)).all()


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_round_trip(tmp_path, survey_cloud, suffix):
    path = tmp_path / f"out{suffix}"
    extra = {"trunk": np.arange(500, dtype=np.int32)}
    cloud = PointCloud(
        survey_cloud.xyz, survey_cloud.origin, survey_cloud.rgb, survey_cloud.attributes, "EPSG:32632", "plot"
    )
    write_las(path, cloud, attributes=extra)
    loaded = read_las(path, attributes="all")
    assert np.abs(_absolute(loaded.cloud) - _absolute(cloud)).max() < 0.0001
    assert (loaded.cloud.rgb == cloud.rgb).all()
    assert loaded.cloud.crs == "EPSG:32632"
    assert loaded.provenance.metres_per_unit == 1.0
    assert (loaded.cloud.attributes["trunk"] == extra["trunk"]).all()
    assert (loaded.cloud.attributes["treeID"] == cloud.attributes["treeID"]).all()
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("size", [1e-4, 1.0, 1e5])
def test_writing_keeps_small_and_large_units_exact(tmp_path, rng, size):
    xyz = rng.uniform(-size, size, (50, 3)).astype(np.float32)
    write_las(tmp_path / "a.las", PointCloud(xyz, np.zeros(3)))
    assert np.abs(_absolute(read_las(tmp_path / "a.las").cloud) - xyz).max() < max(
        1e-6 * size, 1e-4 if size >= 1 else 0
    )


def test_writing_checks_lengths(tmp_path, survey_cloud):
    with pytest.raises(ValueError, match="trunk"):
        write_las(tmp_path / "a.las", survey_cloud, attributes={"trunk": np.zeros(3, np.int32)})
    assert not list(tmp_path.iterdir())


def test_feet_of_the_coordinate_system(tmp_path, survey_points):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets = np.floor(survey_points.min(axis=0))
    pyproj = pytest.importorskip("pyproj")
    header.add_crs(pyproj.CRS("EPSG:2903"))
    las = laspy.LasData(header)
    las.x, las.y, las.z = survey_points.T
    las.write(str(tmp_path / "feet.las"))
    loaded = read_las(tmp_path / "feet.las")
    assert loaded.cloud.crs == "EPSG:2903"
    assert loaded.provenance.metres_per_unit == pytest.approx(0.3048006, abs=1e-6)


def test_degrees_are_recognised(tmp_path, survey_cloud):
    pytest.importorskip("pyproj")
    cloud = PointCloud(survey_cloud.xyz, np.array([10.0, 46.0, 300.0]), crs="EPSG:4326")
    write_las(tmp_path / "degrees.las", cloud)
    assert read_las(tmp_path / "degrees.las").provenance.is_geographic


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("keep", [0.02, 0.3, 0.6, 0.95])
def test_truncated(tmp_path, survey_points, suffix, keep):
    path = tmp_path / f"plot{suffix}"
    _las(path, survey_points)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])
    with pytest.raises(TruncatedFileError):
        read_las(path)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_a_huge_count_is_refused(tmp_path, survey_points, suffix):
    path = tmp_path / f"plot{suffix}"
    _las(path, survey_points, version="1.4", point_format=6)
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, 247, 10**12)
    path.write_bytes(data)
    with pytest.raises(FileError) as caught:
        read_las(path)
    assert isinstance(caught.value, MalformedFileError)


def test_no_points(tmp_path):
    _las(tmp_path / "none.las", np.zeros((0, 3)))
    with pytest.raises(EmptyFileError):
        read_las(tmp_path / "none.las")


def test_progress_rises_and_cancels(tmp_path, survey_points, monkeypatch):
    monkeypatch.setattr("dbh_studio.io.las.CHUNK_POINTS", 100)
    _las(tmp_path / "plot.laz", survey_points)
    seen: list[float] = []
    read_las(tmp_path / "plot.laz", progress=lambda fraction, message="": seen.append(fraction))
    assert seen == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])

    def cancel(fraction, message=""):
        raise CancelledError

    with pytest.raises(CancelledError):
        read_las(tmp_path / "plot.laz", progress=cancel)


def _with_classes(path, points, classes, *, point_format=6):
    version = "1.4" if point_format >= 6 else "1.2"
    _las(path, points, version=version, point_format=point_format, classification=np.asarray(classes, np.uint8))


@pytest.mark.parametrize("point_format", [6, 7, 1])
def test_points_classified_as_noise_are_left_out(tmp_path, survey_points, point_format):
    classes = np.full(500, 5)
    classes[:20], classes[20:30], classes[30:40] = 7, 18, 2
    _with_classes(tmp_path / "plot.laz", survey_points, classes, point_format=point_format)
    loaded = read_las(tmp_path / "plot.laz")
    # Class 18 is high noise in the point formats of LAS 1.4, and nothing in the older ones.
    wanted = (classes != 7) & ((classes != 18) | (point_format < 6))
    assert np.abs(_absolute(loaded.cloud) - survey_points[wanted]).max() < 0.0001
    assert (loaded.cloud.attributes["classification"] == classes[wanted]).all()
    n_noise = 500 - np.count_nonzero(wanted)
    assert [note for note in loaded.notes if f"{n_noise} points" in note and "noise" in note]


def test_a_class_with_the_number_of_noise_that_most_points_have_is_kept(tmp_path, survey_points):
    _with_classes(tmp_path / "plot.laz", survey_points, np.where(np.arange(500) < 300, 7, 2))
    loaded = read_las(tmp_path / "plot.laz")
    assert len(loaded.cloud) == 500
    assert any("300 points" in note and "kept" in note for note in loaded.notes)


def test_a_cloud_without_noise_says_nothing_of_it(tmp_path, survey_points):
    _with_classes(tmp_path / "plot.laz", survey_points, np.full(500, 2))
    assert read_las(tmp_path / "plot.laz").notes == ()
