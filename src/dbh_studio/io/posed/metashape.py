"""Agisoft Metashape's camera export ("Export Cameras", XML).

A camera's ``<transform>`` is camera-to-chunk, 16 numbers row by row; the chunk's (or its active component's) transform
brings the chunk to metres or to the chosen coordinate system. In a rig only the master camera has a transform; the
others follow from their sensor's ``<rotation>`` and ``<location>``, the slave's axes and centre in the master's frame.

Source: Agisoft Metashape User Manual, appendix "Camera models", and "Exporting results".
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImages
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.similarity_fit import fit_similarity
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import MalformedFileError, UnsupportedFormatError
from dbh_studio.io.posed.common import PosedBuilder, nearest_rotation, numbers, pose_from_centre, read_bytes

_KINDS = {
    "frame": "METASHAPE_FRAME",
    "fisheye": "METASHAPE_FISHEYE",
    "equidistant_fisheye": "METASHAPE_FISHEYE",
    "equisolid_fisheye": "METASHAPE_EQUISOLID",
    "spherical": "EQUIRECTANGULAR",
}
_BENDING = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2")


def read_metashape(path: Path, *, progress: Progress = ignore_progress) -> PosedImages:
    """Read a camera export.

    Raises:
        FileError: It cannot be read, is no such export, or no camera in it has a pose.
    """
    root = parse_xml_safely(path)
    progress(0.5, "file read")
    builder = PosedBuilder(path, "metashape")
    chunk = _choose_chunk(root, builder)
    sensors = {sensor.get("id", ""): _read_sensor(sensor, path) for sensor in chunk.iterfind("sensors/sensor")}
    components = {
        component.get("id", ""): _read_transform(component.find("transform"), path)
        for component in chunk.iterfind("components/component")
    }
    cameras = {camera.get("id", ""): camera for camera in chunk.iterfind("cameras//camera")}
    reader = _Cameras(path, sensors, cameras, components, _active_component(chunk, cameras))
    chunk_transform = _read_transform(chunk.find("transform"), path)
    if reader.active in components and components[reader.active] is not None:
        chunk_transform = components[reader.active]
    for camera in cameras.values():
        reader.add(camera, builder)
    cloud_from_cameras = _to_cloud(chunk, chunk_transform, builder)
    progress(1.0, "cameras read")
    return builder.build(cloud_from_cameras=cloud_from_cameras)


def parse_xml_safely(path: Path) -> ET.Element:
    """The root of an XML file; a document type, which could expand without end or reach other files, is refused.

    Raises:
        MalformedFileError: It is no XML, breaks off, or has a document type.
    """
    builder = ET.TreeBuilder()
    parser = expat.ParserCreate()
    parser.buffer_text = True

    def refuse(*_: Any) -> None:
        raise MalformedFileError(
            path, "It declares a document type, which a camera export never has.", "Export the cameras again."
        )

    parser.StartDoctypeDeclHandler = refuse
    parser.EntityDeclHandler = refuse
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(read_bytes(path), True)
        return builder.close()
    except expat.ExpatError as error:
        raise MalformedFileError(path, f"It is no complete XML file ({error}).", "Export the cameras again.") from None
    except (ValueError, LookupError) as error:
        raise MalformedFileError(path, f"Its text cannot be read ({error}).", "Export the cameras again.") from None


def _choose_chunk(root: ET.Element, builder: PosedBuilder) -> ET.Element:
    chunks = [root] if root.tag == "chunk" else list(root.iterfind("chunk"))
    chunks = [chunk for chunk in chunks if chunk.find("cameras") is not None]
    if root.tag not in ("document", "chunk") or not chunks:
        raise UnsupportedFormatError(
            builder.path, "This is XML, but no camera export of Metashape.", "In Metashape: File, Export Cameras."
        )

    def n_posed(chunk: ET.Element) -> int:
        return sum(camera.find("transform") is not None for camera in chunk.iterfind("cameras//camera"))

    best = max(chunks, key=n_posed)
    if len(chunks) > 1:
        builder.notes.append(
            f"It has {len(chunks)} chunks; {best.get('label', 'one')!r}, with the most aligned cameras, was read."
        )
    return best


def _active_component(chunk: ET.Element, cameras: dict[str, ET.Element]) -> str | None:
    """The component the chunk's transform belongs to; else the one with the most cameras."""
    components = chunk.find("components")
    known = [] if components is None else [component.get("id", "") for component in components]
    active = None if components is None else components.get("active_id")
    if active in known or not known:
        return active if known else None
    members = [camera.get("component_id", "") for camera in cameras.values()]
    return max(known, key=members.count)


@dataclass(frozen=True)
class _Sensor:
    """A calibrated camera, or why it cannot be used, and its place in the rig."""

    camera: CameraModel | None
    problem: str
    is_slave: bool
    master_from_slave: Similarity


@dataclass
class _Cameras:
    """Brings every camera of the file to the frame of the active component."""

    path: Path
    sensors: dict[str, _Sensor]
    cameras: dict[str, ET.Element]
    components: dict[str, Similarity | None]
    active: str | None
    _chunk_from_camera: dict[str, Similarity | None] = field(default_factory=dict)

    def add(self, element: ET.Element, builder: PosedBuilder) -> None:
        """Add one camera to `builder`, or say why not."""
        name = element.get("label") or f"camera {element.get('id', '?')}"
        sensor = self.sensors.get(element.get("sensor_id", ""))
        if element.get("enabled", "true").lower() in ("false", "0"):
            builder.skip(name, "switched off in Metashape")
            return
        if sensor is None or sensor.camera is None:
            builder.skip(name, sensor.problem if sensor else "their sensor is not in the file")
            return
        try:
            pose = self._pose(element, sensor)
        except ValueError as error:
            builder.skip(name, f"their transform cannot be used, {error}")
            return
        if pose is None:
            builder.skip(name, "not aligned")
            return
        to_active = self._active_from(element)
        if to_active is None:
            builder.skip(name, "in a component whose place is not known")
            return
        rotation = to_active.rotation @ pose.rotation
        builder.add(name, sensor.camera, pose_from_centre(rotation.T, to_active.apply(pose.translation[None])[0]))

    def _pose(self, element: ET.Element, sensor: _Sensor) -> Similarity | None:
        """Chunk from camera: the camera's own transform, or its master's and its place in the rig."""
        transform = element.find("transform")
        if transform is not None:
            return _camera_transform(transform, self.path)
        master = self.cameras.get(element.get("master_id", ""))
        if master is None or master is element or not sensor.is_slave:
            return None
        key = master.get("id", "")
        if key not in self._chunk_from_camera:
            own = master.find("transform")
            self._chunk_from_camera[key] = None if own is None else _camera_transform(own, self.path)
        of_master = self._chunk_from_camera[key]
        return None if of_master is None else of_master @ sensor.master_from_slave

    def _active_from(self, element: ET.Element) -> Similarity | None:
        own = element.get("component_id")
        if own is None or own == self.active or own not in self.components:
            return Similarity.identity()
        here, there = self.components.get(self.active or ""), self.components[own]
        # Without a transform each component floats in a frame of its own.
        return None if here is None or there is None else here.inverse() @ there


def _camera_transform(element: ET.Element, path: Path) -> Similarity:
    matrix = numbers((element.text or "").split(), 16, path=path, what="A camera's transform").reshape(4, 4)
    return Similarity(nearest_rotation(matrix[:3, :3]), matrix[:3, 3])


def _read_transform(element: ET.Element | None, path: Path) -> Similarity | None:
    """A chunk's or component's transform; parts that are left out change nothing."""
    if element is None or not len(element):
        return None
    rotation, translation, scale = np.eye(3), np.zeros(3), 1.0
    for part in element:
        values = (part.text or "").split()
        if part.tag == "rotation":
            matrix = numbers(values, 9, path=path, what="The chunk's rotation").reshape(3, 3)
            rotation = _checked_rotation(matrix, path)
        elif part.tag == "translation":
            translation = numbers(values, 3, path=path, what="The chunk's translation")
        elif part.tag == "scale":
            scale = float(numbers(values, 1, path=path, what="The chunk's scale")[0])
    if scale <= 0.0:
        raise MalformedFileError(path, f"The chunk's scale is {scale}.", "Export the cameras again.")
    return Similarity(rotation, translation, scale)


def _checked_rotation(matrix: Float64, path: Path) -> Float64:
    try:
        return nearest_rotation(matrix)
    except ValueError as error:
        raise MalformedFileError(path, f"A transform cannot be used: {error}.", "Export the cameras again.") from None


def _read_sensor(element: ET.Element, path: Path) -> _Sensor:
    rotation, location = element.find("rotation"), element.find("location")
    turn, place = np.eye(3), np.zeros(3)
    if rotation is not None and rotation.text:
        turn = _checked_rotation(
            numbers(rotation.text.split(), 9, path=path, what="A sensor's rotation").reshape(3, 3), path
        )
    if location is not None and location.text:
        place = numbers(location.text.split(), 3, path=path, what="A sensor's location")
    camera, problem = _read_lens(element, path)
    return _Sensor(camera, problem, element.get("master_id") is not None, Similarity(turn, place))


def _read_lens(element: ET.Element, path: Path) -> tuple[CameraModel | None, str]:
    """The sensor's camera, or None and why."""
    calibrations = element.findall("calibration")
    adjusted = [calibration for calibration in calibrations if calibration.get("class") == "adjusted"]
    calibration = next(iter(adjusted or calibrations), None)
    kind_name = element.get("type") or (calibration.get("type", "") if calibration is not None else "") or "frame"
    resolution = element.find("resolution")
    if calibration is not None and calibration.find("resolution") is not None:
        resolution = calibration.find("resolution")
    if kind_name not in _KINDS:
        return None, f"sensors of type {kind_name} cannot be used"
    if resolution is None:
        return None, "their sensor has no image size"
    width, height = (
        int(numbers([resolution.get(side)], 1, path=path, what="A sensor's resolution")[0])
        for side in ("width", "height")
    )
    try:
        if kind_name == "spherical":
            return _panorama(width, height)
        values = {} if calibration is None else _calibration_values(calibration, path)
        focal = values.get("f") or values.get("fy") or _nominal_focal(element, path)
        if focal is None:
            return None, "their sensor is not calibrated"
        return CameraModel(_KINDS[kind_name], width, height, _params(values, focal, width, height)), ""
    except ValueError as error:
        return None, f"their sensor cannot be used, {error}"


def _panorama(width: int, height: int) -> tuple[CameraModel | None, str]:
    if abs(width - 2 * height) > 2:
        return None, f"panoramas of {width} x {height} pixels do not show the whole sphere (2 : 1)"
    return CameraModel("EQUIRECTANGULAR", width, height, ()), ""


def _calibration_values(calibration: ET.Element, path: Path) -> dict[str, float]:
    names = ("f", "fx", "fy", "cx", "cy", "skew", *_BENDING)
    return {
        part.tag: float(numbers([part.text], 1, path=path, what=f"A sensor's {part.tag}")[0])
        for part in calibration
        if part.tag in names
    }


def _params(values: dict[str, float], focal: float, width: int, height: int) -> tuple[float, ...]:
    """In the order of METASHAPE_FRAME. Old exports give fx, fy and the centre from the corner."""
    values = dict(values)
    if "fx" in values:
        values["b1"] = values["fx"] - focal
        values["b2"] = values.get("skew", 0.0)
        values["cx"] = values.get("cx", width / 2.0) - width / 2.0
        values["cy"] = values.get("cy", height / 2.0) - height / 2.0
    return (focal, values.get("cx", 0.0), values.get("cy", 0.0), *(values.get(name, 0.0) for name in _BENDING))


def _nominal_focal(element: ET.Element, path: Path) -> float | None:
    """In pixels, from the millimetres of the photo's own data."""
    found = {part.get("name"): part.get("value") for part in element.iterfind("property")}
    if found.get("focal_length") is None or found.get("pixel_width") is None:
        return None
    length, pixel = numbers([found["focal_length"], found["pixel_width"]], 2, path=path, what="A sensor's focal length")
    return float(length / pixel) if length > 0.0 and pixel > 0.0 else None


def _to_cloud(chunk: ET.Element, transform: Similarity | None, builder: PosedBuilder) -> Similarity | None:
    """From the chunk's own frame to the coordinate system in which Metashape exports the cloud."""
    if transform is None:
        return None
    reference = (chunk.findtext("reference") or "").strip()
    if not reference or reference.upper().startswith("LOCAL_CS"):
        return transform
    try:
        crs_from_geocentric, left_m = _crs_from_geocentric(reference, builder, transform)
    except ImportError:
        builder.notes.append("The cameras are georeferenced; pyproj is needed to bring them to the cloud.")
        return None
    except (ValueError, RuntimeError) as error:
        builder.notes.append(f"The cameras cannot be brought to the cloud's coordinate system: {error}")
        return None
    builder.notes.append(
        f"The chunk is georeferenced ({_crs_name(reference)}); over this plot the map projection was taken as a turn, "
        f"a shift and a scale (within {1000 * left_m:.1f} mm)."
    )
    return crs_from_geocentric @ transform


def _crs_name(reference: str) -> str:
    found = re.search(r'"([^"]*)"', reference)
    return found.group(1) if found else "unknown"


def _crs_from_geocentric(reference: str, builder: PosedBuilder, transform: Similarity) -> tuple[Similarity, float]:
    """A georeferenced chunk is geocentric inside; over a plot the projection from there is a similarity."""
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError, ProjError

    corners = _around(np.array([image.centre_src for image in builder.images]), transform)
    try:
        crs = CRS.from_wkt(reference)
        if not crs.is_projected:
            raise ValueError(
                "it is in degrees. Export cloud and cameras in a projected coordinate system (metres), such as UTM."
            )
        geodetic = crs.geodetic_crs or CRS.from_epsg(4326)
        geocentric = CRS.from_json_dict(
            {
                "type": "GeodeticCRS",
                "name": "geocentric",
                **{key: value for key, value in geodetic.to_json_dict().items() if key in ("datum", "datum_ensemble")},
                "coordinate_system": {
                    "subtype": "Cartesian",
                    "axis": [
                        {"name": f"Geocentric {axis}", "abbreviation": axis, "direction": f"geocentric{axis}",
                         "unit": "metre"}
                        for axis in "XYZ"
                    ],
                },
            }
        )  # fmt: skip
        horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
        project = Transformer.from_crs(geocentric, horizontal.to_3d(), always_xy=True)
        projected = np.column_stack(project.transform(*corners.T))
    except (CRSError, ProjError) as error:
        raise ValueError(f"{error}.") from None
    if not np.isfinite(projected).all():
        raise ValueError("the cameras lie outside its area.")
    if crs.is_compound:
        builder.notes.append("Heights were taken above the ellipsoid; a geoid in the coordinate system is not applied.")
    return fit_similarity(corners, projected)


def _around(centres: Float64, transform: Similarity) -> Float64:
    """(27, 3) geocentric points on a lattice about the cameras, at least 20 m wide."""
    if not len(centres):
        raise ValueError("no camera has a pose.")
    placed = transform.apply(centres)
    middle = placed.mean(axis=0)
    reach = max(float(np.abs(placed - middle).max()), 10.0)
    steps = np.array([-1.0, 0.0, 1.0])
    return middle + reach * np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
