"""OpenSfM's and OpenDroneMap's ``reconstruction.json``.

Source: https://opensfm.org/docs/dataset.html ("reconstruction file format") and "Geometric models".
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from dbh_studio.core.arrays import Float64, UInt8
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImages
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import MalformedFileError, UnsupportedFormatError
from dbh_studio.io.posed.common import PosedBuilder, numbers, read_text, rotation_vector_to_rotation

_FISHEYE624 = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s0", "s1", "s2", "s3")
# Kind, whether there are two focal lengths and a centre, and the coefficients in the order of `CameraModel.params`.
_LENSES: dict[str, tuple[str, bool, tuple[str, ...]]] = {
    "perspective": ("RADIAL", False, ("k1", "k2")),
    "fisheye": ("RADIAL_FISHEYE", False, ("k1", "k2")),
    "dual": ("OPENSFM_DUAL", False, ("k1", "k2", "transition")),
    "brown": ("FULL_OPENCV", True, ("k1", "k2", "p1", "p2", "k3", "", "", "")),
    "fisheye_opencv": ("OPENCV_FISHEYE", True, ("k1", "k2", "k3", "k4")),
    "fisheye62": ("OPENSFM_FISHEYE624", True, _FISHEYE624),
    "fisheye624": ("OPENSFM_FISHEYE624", True, _FISHEYE624),
    "radial": ("OPENCV", True, ("k1", "k2", "", "")),
    "simple_radial": ("OPENCV", True, ("k1", "", "", "")),
}
_PANORAMAS = ("spherical", "equirectangular")


def read_json(path: Path) -> Any:
    """A JSON file's content.

    Raises:
        MalformedFileError: It is no JSON, breaks off, or is nested without end.
    """
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise MalformedFileError(path, f"It is no complete JSON file ({error}).", "Export or copy it again.") from None


def is_reconstruction(content: Any) -> bool:
    """Whether JSON content is laid out as an OpenSfM reconstruction."""
    parts = content if isinstance(content, list) else [content]
    return bool(parts) and all(isinstance(part, dict) and "shots" in part and "cameras" in part for part in parts)


def read_opensfm(path: Path, *, content: Any = None, progress: Progress = ignore_progress) -> PosedImages:
    """Read ``reconstruction.json``; of several partial reconstructions the largest.

    Args:
        path: The file.
        content: Its parsed JSON, where it was read already.
        progress: Called in between.

    Raises:
        FileError: It cannot be read, is no such file, or has no image with a pose.
    """
    content = read_json(path) if content is None else content
    progress(0.5, "file read")
    if not is_reconstruction(content):
        raise UnsupportedFormatError(
            path, "This is JSON, but no reconstruction of OpenSfM.", "Choose the file reconstruction.json."
        )
    builder = PosedBuilder(path, "opensfm")
    part = _largest(content if isinstance(content, list) else [content], builder)
    cameras = {str(key): _camera(value, path) for key, value in _items(part, "cameras", path)}
    poses = _rig_poses(part, path)
    for name, shot in _items(part, "shots", path):
        _add_shot(str(name), shot, cameras, poses, builder)
    points, rgb = _points(part, path)
    progress(1.0, "cameras read")
    return builder.build(points=points, rgb=rgb, cloud_from_cameras=_odm_offset(path, builder))


def _items(part: dict[str, Any], key: str, path: Path) -> list[tuple[str, dict[str, Any]]]:
    values = part.get(key) or {}
    if not isinstance(values, dict) or not all(isinstance(value, dict) for value in values.values()):
        raise MalformedFileError(path, f"Its {key!r} are not laid out as OpenSfM does.", "Export it again.")
    return list(values.items())


def _largest(parts: list[dict[str, Any]], builder: PosedBuilder) -> dict[str, Any]:
    sizes = [len(_items(part, "shots", builder.path)) for part in parts]
    best = int(np.argmax(sizes))
    if len(parts) > 1:
        builder.notes.append(
            f"The photos fell into {len(parts)} separate reconstructions of {', '.join(map(str, sizes))} images; the "
            f"largest was read. The others do not lie in the same frame."
        )
    return parts[best]


def _camera(value: dict[str, Any], path: Path) -> CameraModel | str:
    """The camera, or why there is none. OpenSfM's lengths are in units of the longer side of the image."""
    kind_name = str(value.get("projection_type", "perspective"))
    size = [value.get("width", 0), value.get("height", 0)]
    width, height = (int(v) for v in numbers(size, 2, path=path, what="A camera's size"))
    if width <= 0 or height <= 0:
        return "their camera has no image size"
    if kind_name in _PANORAMAS:
        if abs(width - 2 * height) > 2:
            return f"panoramas of {width} x {height} pixels do not show the whole sphere (2 : 1)"
        return CameraModel("EQUIRECTANGULAR", width, height, ())
    if kind_name not in _LENSES:
        return f"the projection {kind_name!r} is not known"
    kind, has_two, names = _LENSES[kind_name]
    longer = max(width, height)

    def get(name: str, default: float = 0.0) -> float:
        return float(numbers([value.get(name, default)], 1, path=path, what=f"A camera's {name}")[0])

    focal = get("focal")
    lengths = [get("focal_x", focal), get("focal_y", focal)] if has_two else [focal]
    centre = [get("c_x"), get("c_y")] if has_two else [0.0, 0.0]
    head = [longer * length for length in lengths]
    head += [longer * centre[0] + width / 2.0, longer * centre[1] + height / 2.0]
    bending = [get(name, 0.5 if name == "transition" else 0.0) if name else 0.0 for name in names]
    try:
        return CameraModel(kind, width, height, (*head, *bending))
    except ValueError as error:
        return f"their camera cannot be used, {error}"


def _pose(value: dict[str, Any], path: Path) -> Similarity:
    rotation = numbers(value["rotation"], 3, path=path, what="A rotation")
    translation = numbers(value.get("translation", (0.0, 0.0, 0.0)), 3, path=path, what="A translation")
    return Similarity(rotation_vector_to_rotation(rotation), translation)


def _rig_poses(part: dict[str, Any], path: Path) -> dict[str, Similarity]:
    """Poses of shots that are written only as a member of a rig."""
    if "rig_instances" not in part or "rig_cameras" not in part:
        return {}
    try:
        sensors = {key: _pose(value, path) for key, value in _items(part, "rig_cameras", path)}
        poses = {}
        for _, instance in _items(part, "rig_instances", path):
            rig_from_source = _pose(instance, path)
            for name, camera in instance.get("rig_camera_ids", {}).items():
                if camera in sensors:
                    poses[str(name)] = sensors[camera] @ rig_from_source
        return poses
    except (KeyError, TypeError, AttributeError):
        raise MalformedFileError(path, "Its rigs are not laid out as OpenSfM does.", "Export it again.") from None


def _add_shot(
    name: str,
    shot: dict[str, Any],
    cameras: dict[str, CameraModel | str],
    rig_poses: dict[str, Similarity],
    builder: PosedBuilder,
) -> None:
    camera = cameras.get(str(shot.get("camera")), "their camera is not in the file")
    if isinstance(camera, str):
        builder.skip(name, camera)
        return
    pose = _pose(shot, builder.path) if "rotation" in shot else rig_poses.get(name)
    if pose is None:
        builder.skip(name, "not aligned")
        return
    time = shot.get("capture_time")
    time_s = float(time) if isinstance(time, (int, float)) and np.isfinite(time) and time > 0.0 else None
    builder.add(name, camera, pose, time_s)


def _points(part: dict[str, Any], path: Path) -> tuple[Float64 | None, UInt8 | None]:
    """Points and their colours."""
    points = [value for _, value in _items(part, "points", path)]
    if not points:
        return None, None
    try:
        xyz = np.array([value["coordinates"] for value in points], np.float64)
        rgb = np.array([value.get("color", (128, 128, 128)) for value in points], np.float64)
    except (KeyError, TypeError, ValueError):
        raise MalformedFileError(path, "Its points are not laid out as OpenSfM does.", "Export it again.") from None
    if xyz.shape != (len(points), 3) or rgb.shape != xyz.shape:
        raise MalformedFileError(path, "A point does not have three coordinates and a colour.", "Export it again.")
    return xyz, np.clip(np.nan_to_num(rgb), 0, 255).astype(np.uint8)


def _odm_offset(path: Path, builder: PosedBuilder) -> Similarity | None:
    """OpenDroneMap moves a georeferenced reconstruction near zero; ``coords.txt`` holds by how much.

    It keeps the file before georeferencing as ``reconstruction.topocentric.json``; where that is absent,
    ``reconstruction.json`` itself is still in its own frame and the offset does not apply.
    """
    coords = path.parent.parent / "odm_georeferencing" / "coords.txt"
    if not coords.is_file() or not (path.parent / "reconstruction.topocentric.json").is_file():
        return None
    lines = read_text(coords).splitlines()
    if len(lines) < 2:
        return None
    east, north = numbers(lines[1].split()[:2], 2, path=coords, what="Its second line")
    builder.notes.append(
        f"OpenDroneMap: the georeferenced cloud lies {east:,.0f} m east and {north:,.0f} m north of the cameras' "
        f"origin ({lines[0].strip()})."
    )
    return Similarity(np.eye(3), np.array([east, north, 0.0]))
