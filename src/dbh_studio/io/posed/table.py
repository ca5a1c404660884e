"""Poses as a plain table (CSV) or JSON, for every program that has no reader of its own here.

The layout is described, with examples, in ``docs/guide/posed-images.md``.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImages
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import MalformedFileError, UnsupportedFormatError
from dbh_studio.io.posed.common import (
    PosedBuilder,
    nearest_rotation,
    numbers,
    pose_from_centre,
    quaternion_to_rotation,
    read_text,
)
from dbh_studio.io.posed.opensfm import read_json

_CAMERA = ("width", "height", "model")
_QUATERNION = ("qw", "qx", "qy", "qz")
_MATRIX = tuple(f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))
_ANGLES = ("omega", "phi", "kappa")
_HELP = (
    "A table needs the columns name, width, height, model, params, a rotation (qw qx qy qz, or r11 to r33, or omega "
    "phi kappa) and a place (tx ty tz, or x y z of the camera's centre)."
)
_OTHER_NAMES = {
    "image": "name", "file": "name", "filename": "name", "label": "name", "width_px": "width", "height_px": "height",
    "camera_model": "model", "parameters": "params", "time": "time_s",
}  # fmt: skip


def is_table_header(line: str) -> bool:
    """Whether a line of text can be the header of a table of poses."""
    columns = {_column(part) for part in re.split(r"[,;\t]", line)}
    return "name" in columns and bool(columns & {*_QUATERNION, *_MATRIX, *_ANGLES})


def is_pose_list(content: Any) -> bool:
    """Whether JSON content is laid out as a list of poses."""
    return isinstance(content, dict) and isinstance(content.get("images"), list)


def read_table(path: Path, *, progress: Progress = ignore_progress) -> PosedImages:
    """Read a CSV of poses.

    Raises:
        FileError: It cannot be read, lacks a column, or a row cannot be used; says which.
    """
    lines = read_text(path).splitlines(keepends=True)
    first = next((i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")), None)
    if first is None or not is_table_header(lines[first]):
        raise UnsupportedFormatError(path, "This is no table of camera poses.", _HELP)
    delimiter = max(",;\t", key=lines[first].count)
    try:
        rows = list(csv.reader(io.StringIO("".join(lines[first:]), newline=""), delimiter=delimiter))
    except csv.Error as error:
        raise MalformedFileError(path, f"The table cannot be read ({error}).", _HELP) from None
    columns = [_column(part) for part in rows[0]]
    builder = PosedBuilder(path, "table")
    for number, row in enumerate(rows[1:], first + 2):
        if any(part.strip() for part in row) and not row[0].startswith("#"):
            values = {name: part.strip() for name, part in zip(columns, row, strict=False) if part.strip()}
            _add(values, f"Line {number:,}", builder, default_camera={})
    progress(1.0, "table read")
    return builder.build()


def read_pose_list(path: Path, *, content: Any = None, progress: Progress = ignore_progress) -> PosedImages:
    """Read a JSON of poses.

    Raises:
        FileError: As `read_table`.
    """
    content = read_json(path) if content is None else content
    if not is_pose_list(content):
        raise UnsupportedFormatError(path, "This JSON is no list of camera poses.", _HELP)
    builder = PosedBuilder(path, "table")
    cameras = content.get("cameras", {})
    for index, image in enumerate(content["images"]):
        where = f"Image number {index + 1:,}"
        if not isinstance(image, dict):
            raise MalformedFileError(path, f"{where} is no object with a name and a pose.", _HELP)
        default = cameras.get(str(image.get("camera")), {}) if isinstance(cameras, dict) else {}
        _add(_flattened(image), where, builder, default_camera=default if isinstance(default, dict) else {})
    points = content.get("points")
    xyz = None
    if points:
        rows = [numbers(point, 3, path=path, what="A point") for point in points] if isinstance(points, list) else []
        xyz = np.array(rows).reshape(-1, 3)
    progress(1.0, "file read")
    return builder.build(points=xyz)


def _column(text: str) -> str:
    name = text.strip().strip("\"'").lower()
    return _OTHER_NAMES.get(name, name)


def _flattened(image: Mapping[str, Any]) -> dict[str, Any]:
    """JSON's lists as the columns a table has."""
    values = {_column(key): value for key, value in image.items()}
    for key, names in (("quaternion", _QUATERNION), ("translation", ("tx", "ty", "tz")), ("centre", ("x", "y", "z"))):
        if isinstance(values.get(key), list):
            values.update(zip(names, values[key], strict=False))
    if isinstance(values.get("rotation"), list):
        flat = [value for row in values["rotation"] for value in (row if isinstance(row, list) else [row])]
        values.update(zip(_MATRIX, flat, strict=False))
    return values


def _add(values: Mapping[str, Any], where: str, builder: PosedBuilder, *, default_camera: Mapping[str, Any]) -> None:
    path = builder.path
    name = str(values.get("name", ""))
    if not name:
        raise MalformedFileError(path, f"{where} has no name.", _HELP)
    lens = {**{_column(key): value for key, value in default_camera.items()}, **values}
    missing = [column for column in _CAMERA if column not in lens]
    if missing:
        raise MalformedFileError(path, f"{where} ({name}) has no {', '.join(missing)}.", _HELP)
    width, height = numbers([lens["width"], lens["height"]], 2, path=path, what=f"The image size in {where.lower()}")
    params = lens.get("params", ())
    params = re.split(r"[\s;,]+", params.strip()) if isinstance(params, str) else params
    try:
        camera = CameraModel(
            str(lens["model"]).upper(), int(width), int(height),
            tuple(numbers(params, None, path=path, what=f"params in {where.lower()}")),
        )  # fmt: skip
        pose = _pose(values, where, path)
    except ValueError as error:
        raise MalformedFileError(path, f"{where} ({name}) cannot be used: {error}.", _HELP) from None
    time = values.get("time_s")
    time_s = None if time is None else float(numbers([time], 1, path=path, what=f"time_s in {where.lower()}")[0])
    builder.add(name, camera, pose, time_s)


def _pose(values: Mapping[str, Any], where: str, path: Path) -> Similarity:
    def get(names: tuple[str, ...]) -> Float64 | None:
        if not all(name in values for name in names):
            return None
        return numbers(
            [values[name] for name in names], len(names), path=path, what=f"{' '.join(names)} in {where.lower()}"
        )

    rotation = None
    if (quaternion := get(_QUATERNION)) is not None:
        rotation = quaternion_to_rotation(quaternion)
    elif (matrix := get(_MATRIX)) is not None:
        rotation = nearest_rotation(matrix.reshape(3, 3))
    elif (angles := get(_ANGLES)) is not None:
        rotation = _from_omega_phi_kappa(angles)
    if rotation is None:
        raise ValueError("it has no rotation")
    translation, centre = get(("tx", "ty", "tz")), get(("x", "y", "z"))
    if translation is not None:
        return Similarity(rotation, translation)
    if centre is not None:
        return pose_from_centre(rotation, centre)
    raise ValueError("it has no place")


def _from_omega_phi_kappa(angles_deg: Float64) -> Float64:
    """Camera from source, from photogrammetry's angles: Rx(omega) Ry(phi) Rz(kappa), camera x right, y up, z back."""
    (so, sp, sk), (co, cp, ck) = np.sin(np.radians(angles_deg)), np.cos(np.radians(angles_deg))
    about_x = np.array([[1, 0, 0], [0, co, -so], [0, so, co]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[ck, -sk, 0], [sk, ck, 0], [0, 0, 1]])
    return np.diag([1.0, -1.0, -1.0]) @ (about_x @ about_y @ about_z).T
