"""Metashape's camera export: generated files of known geometry, hostile ones, and two real ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import EmptyFileError, FileError, MalformedFileError, UnsupportedFormatError
from dbh_studio.io.posed import read_posed_images

UTM_33 = (
    'PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,'
    '298.257223563,AUTHORITY["EPSG","7030"]],TOWGS84[0,0,0,0,0,0,0],AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,'
    'AUTHORITY["EPSG","8901"]],UNIT["degree",0.01745329251994328,AUTHORITY["EPSG","9102"]],AUTHORITY["EPSG","4326"]],'
    'PROJECTION["Transverse_Mercator",AUTHORITY["EPSG","9807"]],PARAMETER["latitude_of_origin",0],'
    'PARAMETER["central_meridian",15],PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],'
    'PARAMETER["false_northing",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]],AUTHORITY["EPSG","32633"]]'
)
LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'
FRAME = '<calibration type="frame" class="adjusted"><resolution width="4000" height="3000"/><f>3000</f><cx>12</cx><cy>-8</cy><k1>-0.05</k1><p1>0.001</p1><b1>2</b1></calibration>'  # noqa: E501


def numbers(values) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(values, float).ravel())


def matrix(rotation, centre) -> str:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, centre
    return f"<transform>{numbers(pose)}</transform>"


def sensor(number: int, inside: str = FRAME, kind: str = "frame", more: str = "", size=(4000, 3000)) -> str:
    return (
        f'<sensor id="{number}" label="unknown" type="{kind}" {more}><resolution width="{size[0]}" height="{size[1]}"/>'
        f"{inside}</sensor>"
    )


def camera(number: int, inside: str = "", *, of: int = 0, label: str = "", more: str = "") -> str:
    label = label or f"IMG_{number:04d}"
    return f'<camera id="{number}" sensor_id="{of}" label="{label}" {more}>{inside}</camera>'


def document(sensors: str, cameras: str, *, transform: str = "", components: str = "", reference: str = LOCAL) -> str:
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1" enabled="true">'
        f"<sensors>{sensors}</sensors>{components}<cameras>{cameras}</cameras>{transform}"
        f"<reference>{reference}</reference></chunk></document>"
    )


def chunk_transform(similarity: Similarity) -> str:
    return (
        f'<transform><rotation locked="false">{numbers(similarity.rotation)}</rotation><translation locked="false">'
        f'{numbers(similarity.translation)}</translation><scale locked="false">{similarity.scale!r}</scale></transform>'
    )


@pytest.fixture
def write(tmp_path):
    def save(text: str):
        path = tmp_path / "cameras.xml"
        path.write_text(text, encoding="utf-8")
        return path

    return save


@pytest.fixture
def turns():
    return Rotation.random(6, random_state=np.random.default_rng(2)).as_matrix()


def test_frame_camera_and_chunk_transform(write, turns):
    chunk = Similarity(turns[1], np.array([10.0, 20.0, 30.0]), 0.25)
    path = write(
        document(
            sensor(0),
            camera(0, matrix(turns[0], [1.0, 2.0, 3.0])) + camera(1) + camera(2, more='enabled="false"'),
            transform=chunk_transform(chunk),
        )
    )
    posed = read_posed_images(path)
    assert posed.source_format == "metashape" and len(posed) == 1
    image = posed.by_name("IMG_0000")
    assert np.allclose(image.centre_src, [1.0, 2.0, 3.0])
    assert np.allclose(image.cam_from_source.rotation, turns[0].T)
    assert image.camera.kind == "METASHAPE_FRAME"
    assert image.camera.params == (3000, 12, -8, -0.05, 0, 0, 0, 0.001, 0, 0, 0, 2, 0)
    assert any("not aligned (IMG_0001)" in note for note in posed.notes)
    assert any("switched off in Metashape (IMG_0002)" in note for note in posed.notes)
    # What the point shows must not depend on the frame it is said in.
    point = image.centre_src + turns[0] @ [0.1, -0.2, 5.0]
    in_cloud = posed.in_cloud_frame().by_name("IMG_0000")
    a, _ = image.project(point[None])
    b, is_visible = in_cloud.project(chunk.apply(point[None]))
    assert is_visible.all() and np.allclose(a, b, atol=1e-6)
    assert np.allclose(in_cloud.centre_src, chunk.apply(np.array([[1.0, 2.0, 3.0]]))[0])


@pytest.mark.parametrize("with_calibration", [False, True])
def test_spherical_sensor(write, turns, with_calibration):
    """A point ahead, to the right and above of the camera lies right of and above the image's centre."""
    calibration = (
        '<calibration type="spherical" class="adjusted"><resolution width="5760" height="2880"/></calibration>'
    )
    inside = calibration if with_calibration else ""
    path = write(
        document(sensor(0, inside, "spherical", size=(5760, 2880)), camera(0, matrix(turns[0], [1.0, 2.0, 3.0])))
    )
    image = read_posed_images(path).images[0]
    assert image.camera.is_panorama
    ahead_right_up = np.array([np.sin(np.pi / 4), -1.0, np.cos(np.pi / 4)])
    uv, is_visible = image.project((np.array([1.0, 2.0, 3.0]) + 4.0 * turns[0] @ ahead_right_up)[None])
    assert is_visible.all()
    assert np.allclose(uv, [[5760 * (0.5 + 1 / 8), 2880 * (0.5 - 1 / 4)]])


def test_a_part_of_a_sphere_is_refused_in_words(write, turns):
    path = write(document(sensor(0, "", "spherical", size=(5760, 1000)), camera(0, matrix(turns[0], [1, 2, 3]))))
    with pytest.raises(EmptyFileError, match="do not show the whole sphere"):
        read_posed_images(path)


@pytest.mark.parametrize(
    "kind,expected",
    [
        ("fisheye", "METASHAPE_FISHEYE"),
        ("equidistant_fisheye", "METASHAPE_FISHEYE"),
        ("equisolid_fisheye", "METASHAPE_EQUISOLID"),
    ],
)
def test_fisheye_sensors(write, turns, kind, expected):
    path = write(document(sensor(0, kind=kind), camera(0, matrix(turns[0], [1, 2, 3]))))
    assert read_posed_images(path).images[0].camera.kind == expected


def test_old_exports_give_fx_fy_and_the_centre_from_the_corner(write, turns):
    inside = (
        '<calibration type="frame" class="adjusted"><resolution width="4000" height="3000"/><fx>3010</fx><fy>3000</fy>'
        "<cx>2010</cx><cy>1490</cy><skew>1.5</skew></calibration>"
    )
    path = write(document(sensor(0, inside), camera(0, matrix(turns[0], [1, 2, 3]))))
    camera_model = read_posed_images(path).images[0].camera
    uv, _ = camera_model.project([[0.1, 0.2, 1.0]])
    assert np.allclose(uv, [[2010 + 3010 * 0.1 + 1.5 * 0.2, 1490 + 3000 * 0.2]])


def test_focal_length_from_the_photo_where_nothing_was_calibrated(write, turns):
    nominal = '<property name="pixel_width" value="0.0025"/><property name="focal_length" value="8"/>'
    poses = camera(0, matrix(turns[0], [1, 2, 3]))
    assert read_posed_images(write(document(sensor(0, nominal), poses))).images[0].camera.params[0] == 3200.0
    with pytest.raises(EmptyFileError, match="not calibrated"):
        read_posed_images(write(document(sensor(0, ""), poses)))


def test_rig_follows_its_master(write, turns):
    """The slave's axes and centre are given in the master's frame."""
    place = np.array([0.1, -0.02, 0.03])
    slave = FRAME + f"<rotation>{numbers(turns[1])}</rotation><location>{numbers(place)}</location>"
    turned_only = FRAME + f"<rotation>{numbers(turns[2])}</rotation>"
    sensors = sensor(0) + sensor(1, slave, more='master_id="0"') + sensor(2, turned_only, more='master_id="0"')
    cameras = (
        camera(0, matrix(turns[0], [1.0, 2.0, 3.0]))
        + camera(1, of=1, more='master_id="0"')
        + camera(2, of=2, more='master_id="0"')
        + camera(3)
        + camera(4, of=1, more='master_id="3"')
    )
    posed = read_posed_images(write(document(sensors, cameras)))
    assert [image.name for image in posed] == ["IMG_0000", "IMG_0001", "IMG_0002"]
    assert np.allclose(posed.by_name("IMG_0001").centre_src, [1.0, 2.0, 3.0] + turns[0] @ place)
    assert np.allclose(posed.by_name("IMG_0001").cam_from_source.rotation, (turns[0] @ turns[1]).T)
    assert np.allclose(posed.by_name("IMG_0002").centre_src, [1.0, 2.0, 3.0])
    assert any(note.startswith("2 images were left out: not aligned") for note in posed.notes)


def test_components_are_brought_together(write, turns):
    active = Similarity(turns[1], np.array([1.0, 0.0, 2.0]), 0.5)
    other = Similarity(turns[2], np.array([-3.0, 4.0, 0.0]), 2.0)
    components = (
        '<components active_id="1">'
        f'<component id="0">{chunk_transform(other)}</component><component id="1">{chunk_transform(active)}</component>'
        '<component id="2"/></components>'
    )
    cameras = (
        camera(0, matrix(turns[0], [1.0, 2.0, 3.0]), more='component_id="0"')
        + camera(1, matrix(turns[3], [4.0, 5.0, 6.0]), more='component_id="1"')
        + camera(2, matrix(turns[3], [4.0, 5.0, 6.0]), more='component_id="2"')
    )
    posed = read_posed_images(
        write(document(sensor(0), cameras, components=components, transform=chunk_transform(active)))
    )
    placed = posed.in_cloud_frame()
    assert np.allclose(placed.by_name("IMG_0000").centre_src, other.apply(np.array([[1.0, 2.0, 3.0]]))[0])
    assert np.allclose(placed.by_name("IMG_0001").centre_src, active.apply(np.array([[4.0, 5.0, 6.0]]))[0])
    assert np.allclose(placed.by_name("IMG_0000").cam_from_source.rotation, (turns[2] @ turns[0]).T)
    assert any("component whose place is not known" in note for note in posed.notes)


def test_a_georeferenced_chunk_is_brought_to_its_map_coordinates(write, turns):
    """The chunk's own frame becomes geocentric coordinates; the cloud is exported in UTM."""
    from pyproj import Transformer

    to_geocentric = Transformer.from_crs("EPSG:32633", "EPSG:4978", always_xy=True)
    utm = np.array([[448_000.0, 5_411_000.0, 520.0], [448_040.0, 5_411_000.0, 521.0], [448_020.0, 5_411_030.0, 530.0]])
    geocentric = np.column_stack(to_geocentric.transform(*utm.T))
    chunk = Similarity(turns[1], geocentric[0], 3.0)
    inner = chunk.inverse().apply(geocentric)
    cameras = "".join(camera(i, matrix(turns[0], place)) for i, place in enumerate(inner))
    posed = read_posed_images(write(document(sensor(0), cameras, transform=chunk_transform(chunk), reference=UTM_33)))
    assert posed.cloud_from_cameras is not None
    # UTM shrinks the plan by 0.4 mm per metre and the heights not, which no similarity can; the plot is 40 m wide.
    assert np.abs(posed.in_cloud_frame().centres_src - utm).max() < 0.0004 * 20
    assert any("WGS 84 / UTM zone 33N" in note for note in posed.notes)
    # North in the image stays north: a point 5 m north of the camera projects alike from both frames.
    north = np.column_stack(to_geocentric.transform(448_000.0, 5_411_005.0, 520.0))
    a, _ = posed.images[0].project(chunk.inverse().apply(north))
    b, _ = posed.in_cloud_frame().images[0].project(np.array([[448_000.0, 5_411_005.0, 520.0]]))
    assert np.allclose(a, b, atol=2.0, equal_nan=True)


def test_degrees_are_said_not_used(write, turns):
    path = write(
        document(
            sensor(0),
            camera(0, matrix(turns[0], [1, 2, 3])),
            transform=chunk_transform(Similarity(turns[1], np.array([4e6, 1e6, 4.8e6]), 3.0)),
            reference='GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257223563]],'
            'PRIMEM["Greenwich",0],UNIT["degree",0.01745329251994328]]',
        )
    )
    posed = read_posed_images(path)
    assert posed.cloud_from_cameras is None and any("degrees" in note for note in posed.notes)


def test_an_unreadable_coordinate_system_is_said(write, turns):
    text = document(
        sensor(0), camera(0, matrix(turns[0], [1, 2, 3])), transform="<transform><scale>2</scale></transform>",
        reference='PROJCS["half a system',
    )  # fmt: skip
    posed = read_posed_images(write(text))
    assert posed.cloud_from_cameras is None and any("cannot be brought" in note for note in posed.notes)


def test_labels_used_twice_get_a_number(write, turns):
    cameras = camera(0, matrix(turns[0], [1, 2, 3]), label="A") + camera(1, matrix(turns[1], [1, 2, 3]), label="A")
    posed = read_posed_images(write(document(sensor(0), cameras)))
    assert [image.name for image in posed] == ["A", "A#2"]
    assert any("name of another one" in note for note in posed.notes)


def test_cameras_in_groups_are_found(write, turns):
    grouped = f'<group id="0">{camera(0, matrix(turns[0], [1, 2, 3]))}</group>'
    assert len(read_posed_images(write(document(sensor(0), grouped)))) == 1


def test_a_bomb_is_refused_before_it_expands(write):
    bomb = (
        '<?xml version="1.0"?><!DOCTYPE lolz [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">'
        '<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;">]><document><chunk>&c;</chunk></document>'
    )
    with pytest.raises(MalformedFileError, match="document type"):
        read_posed_images(write(bomb))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_other_files_are_not_read_through_it(tmp_path, encoding):
    (tmp_path / "secret.txt").write_text("secret")
    text = (
        f'<?xml version="1.0" encoding="{encoding}"?><!DOCTYPE d [<!ENTITY x SYSTEM "secret.txt">]>'
        "<document><chunk><cameras>&x;</cameras></chunk></document>"
    )
    path = tmp_path / "cameras.xml"
    path.write_bytes(text.encode(encoding))
    with pytest.raises(MalformedFileError, match="document type"):
        read_posed_images(path)


@pytest.mark.parametrize("text", ["<html><body>404</body></html>", "<document><chunk/></document>", "<a/>"])
def test_other_xml_is_not_taken_for_cameras(write, text):
    with pytest.raises(UnsupportedFormatError):
        read_posed_images(write(text))


def test_damage_ends_in_a_message(write, turns, rng):
    whole = document(
        sensor(0), camera(0, matrix(turns[0], [1, 2, 3])) + camera(1, matrix(turns[1], [1, 2, 4])),
        transform="<transform><scale>2</scale></transform>",
    ).encode()  # fmt: skip
    path = write("")
    for length in range(0, len(whole), 37):
        path.write_bytes(whole[:length])
        with pytest.raises(FileError):
            read_posed_images(path)
    for _ in range(200):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(damaged), 2):
            damaged[at] = rng.integers(32, 127)
        path.write_bytes(damaged)
        try:
            posed = read_posed_images(path)
        except FileError as error:
            assert str(error)
        else:
            assert np.isfinite(posed.centres_src).all()


# -- real files ----------------------------------------------------------------------------------------------------


def test_real_rig_of_ten_sensors(shared_data):
    path = shared_data / "sfm/metashape_xml/perspective_cams_Multi-Camera-System.xml"
    posed = read_posed_images(path)
    assert len(posed) == 1030 and posed.notes == ()
    assert posed.cloud_from_cameras.scale == pytest.approx(0.19341704876581711)
    assert all(image.camera.kind == "METASHAPE_FRAME" for image in posed)
    # Ten views 36 degrees apart, of which A, B … go round to the right and _D and _U look down and up.
    first = {image.name.split("_", 2)[2]: image for image in posed.images[:10]}

    def forward(name):
        return first["A"].cam_from_source.rotation @ first[name].cam_from_source.rotation.T @ [0.0, 0.0, 1.0]

    assert np.degrees(np.arctan2(forward("B")[0], forward("B")[2])) == pytest.approx(36.0, abs=0.01)
    assert np.degrees(np.arctan2(forward("J")[0], forward("J")[2])) == pytest.approx(-36.0, abs=0.01)
    assert np.degrees(np.arctan2(forward("F")[0], -forward("F")[2])) == pytest.approx(0.0, abs=0.01)
    assert np.degrees(np.arcsin(forward("A_D")[1])) == pytest.approx(30.0, abs=0.01)
    assert np.degrees(np.arcsin(forward("A_U")[1])) == pytest.approx(-30.0, abs=0.01)
    centres = np.array([image.centre_src for image in first.values()])
    assert np.ptp(centres, axis=0).max() < 0.05, "the views of one panorama share its centre"


def test_real_frame_cameras_look_at_one_place(shared_data):
    posed = read_posed_images(shared_data / "sfm/metashape_xml/lab336_cameras_frame_v2.0.0.xml")
    assert len(posed) == 47 and posed.cloud_from_cameras is None
    region = np.array([0.036689259785485831, -0.085225743411207366, -2.3753613642569156])
    uv_and_view = [image.project(region[None]) for image in posed]
    assert np.mean([view.all() for _, view in uv_and_view]) > 0.9, "the chunk's region lies before its cameras"
