"""COLMAP models: cameras, images, points3D, and rigs and frames where there are some; ``.bin`` and ``.txt``.

Read here without pycolmap, so that a model opens everywhere and a damaged file ends in a message, not in the loader's
abort. Format: https://colmap.github.io/format.html.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dbh_studio.core.arrays import Float64, UInt8
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.camera_models.lenses import LENSES
from dbh_studio.core.posed_images import PosedImages
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import FileMissingError, MalformedFileError, TruncatedFileError
from dbh_studio.io.posed.common import PosedBuilder, quaternion_to_rotation, read_bytes, read_text

MODEL_FILES = ("cameras", "images", "points3D", "rigs", "frames")
# The numbers are those of the binary format.
_MODEL_IDS = {
    0: "SIMPLE_PINHOLE", 1: "PINHOLE", 2: "SIMPLE_RADIAL", 3: "RADIAL", 4: "OPENCV", 5: "OPENCV_FISHEYE",
    6: "FULL_OPENCV", 7: "FOV", 8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE", 10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE", 12: "SIMPLE_DIVISION", 13: "DIVISION", 14: "SIMPLE_FISHEYE", 15: "FISHEYE",
    16: "EUCM", 17: "EQUIRECTANGULAR",
}  # fmt: skip
_CAMERA_SENSOR = 0
_MAX_NAME = 4096


@dataclass
class _Model:
    """What the files hold, before it is put together."""

    cameras: dict[int, CameraModel | str] = field(default_factory=dict)
    images: list[tuple[int, Float64, int, str]] = field(default_factory=list)
    sensor_from_rig: dict[tuple[int, int], Similarity | None] = field(default_factory=dict)
    rig_from_source: dict[int, tuple[int, Similarity]] = field(default_factory=dict)
    frame_of_image: dict[int, int] = field(default_factory=dict)


def is_model_folder(folder: Path) -> bool:
    """Whether the folder holds a COLMAP model."""
    return any((folder / f"cameras{s}").is_file() and (folder / f"images{s}").is_file() for s in (".bin", ".txt"))


def count_images(folder: Path) -> int:
    """How many images a model says it has, cheaply; -1 where that cannot be read."""
    try:
        if (folder / "images.bin").is_file():
            with (folder / "images.bin").open("rb") as file:
                return int(struct.unpack("<Q", file.read(8))[0])
        with (folder / "images.txt").open(encoding="utf-8", errors="replace") as file:
            return sum(1 for line in file if not line.startswith("#")) // 2
    except (OSError, struct.error):
        return -1


def read_colmap(folder: Path, *, progress: Progress = ignore_progress) -> PosedImages:
    """Read the model in `folder`.

    Raises:
        FileError: A file is missing, damaged or empty; names it.
    """
    suffix = next((s for s in (".bin", ".txt") if all((folder / f"{n}{s}").is_file() for n in MODEL_FILES[:2])), None)
    if suffix is None:
        raise FileMissingError(
            folder, "This is no COLMAP model: cameras and images (.bin or .txt) are needed.", "Choose its folder."
        )
    read = _BINARY if suffix == ".bin" else _TEXT
    model = _Model()
    for name in ("cameras", "rigs", "frames", "images"):
        path = folder / f"{name}{suffix}"
        if path.is_file():
            read[name](path, model)
    progress(0.4, "cameras read")
    builder = PosedBuilder(folder, "colmap")
    _assemble(model, builder)
    points = rgb = error = None
    path = folder / f"points3D{suffix}"
    if path.is_file():
        points, rgb, error = read["points3D"](path, model)
    else:
        builder.notes.append(f"There is no points3D{suffix} beside the cameras.")
    progress(1.0, "points read")
    return builder.build(points=points, rgb=rgb, reprojection_error_px=error)


def _assemble(model: _Model, builder: PosedBuilder) -> None:
    """Frames and rigs say where a camera is; older models say it in the images themselves."""
    for image_id, pose, camera_id, name in model.images:
        camera = model.cameras.get(camera_id)
        if not isinstance(camera, CameraModel):
            builder.skip(name, camera or "their camera is not in the file")
            continue
        frame = model.rig_from_source.get(model.frame_of_image.get(image_id, -1))
        try:
            if frame is None:
                cam_from_source = Similarity(quaternion_to_rotation(pose[:4]), pose[4:])
            else:
                sensor = model.sensor_from_rig.get((frame[0], camera_id))
                if sensor is None:
                    builder.skip(name, "their camera's place in the rig is not known")
                    continue
                cam_from_source = sensor @ frame[1]
            if not np.isfinite(cam_from_source.translation).all():
                raise ValueError("a position is not finite")
        except ValueError as error:
            builder.skip(name, f"their pose cannot be used, {error}")
            continue
        builder.add(name, camera, cam_from_source)


def _camera(kind: str | None, width: int, height: int, params: Any) -> CameraModel | str:
    """The camera, or why there is none."""
    if kind not in LENSES:
        return f"the camera model {kind} is not known"
    try:
        return CameraModel(str(kind), width, height, tuple(params))
    except ValueError as error:
        return f"their camera cannot be used, {error}"


class _Reader:
    """Takes numbers off a binary file; a file that ends early is an error that says so."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = read_bytes(path)
        self.at = 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """Unpack one little-endian struct."""
        layout = f"<{layout}"
        return struct.unpack_from(layout, self.data, self.skip(struct.calcsize(layout)))

    def skip(self, n_bytes: int) -> int:
        """Go on by `n_bytes`; returns where they start."""
        start = self.at
        if n_bytes < 0 or start + n_bytes > len(self.data):
            raise TruncatedFileError(
                self.path, f"The file ends at byte {len(self.data):,} in the middle of its data.", "Copy it again."
            )
        self.at = start + n_bytes
        return start

    def count(self, smallest_record: int) -> int:
        """A record count; one that cannot fit the file is refused before anything is allocated."""
        (n,) = self.take("Q")
        if n * smallest_record > len(self.data) - self.at:
            raise TruncatedFileError(
                self.path, f"It promises {n:,} records, more than its {len(self.data):,} bytes hold.", "Copy it again."
            )
        return int(n)

    def name(self) -> str:
        """A zero-terminated name."""
        end = self.data.find(b"\0", self.at, self.at + _MAX_NAME)
        if end < 0:
            raise MalformedFileError(self.path, f"An image's name at byte {self.at:,} has no end.", "Copy it again.")
        text = self.data[self.at : end].decode("utf-8", errors="replace")
        self.at = end + 1
        return text

    def pose(self) -> Float64:
        """Quaternion (scalar first) and translation, (7,)."""
        return np.array(self.take("7d"))

    def rigid(self) -> Similarity:
        """The same as a transform."""
        return _rigid(self.pose(), self.path)


def _rigid(pose: Float64, path: Path) -> Similarity:
    try:
        return Similarity(quaternion_to_rotation(pose[:4]), pose[4:])
    except ValueError as error:
        raise MalformedFileError(path, f"A pose cannot be used: {error}.", "Export the model again.") from None


def _cameras_bin(path: Path, model: _Model) -> None:
    reader = _Reader(path)
    for _ in range(reader.count(24)):
        camera_id, model_id, width, height = reader.take("IiQQ")
        kind = _MODEL_IDS.get(model_id)
        if kind is None:
            raise MalformedFileError(
                path, f"It uses camera model number {model_id}, which is not known.", "Export the model as text."
            )
        model.cameras[camera_id] = _camera(kind, width, height, reader.take(f"{len(LENSES[kind].names)}d"))


def _images_bin(path: Path, model: _Model) -> None:
    reader = _Reader(path)
    for _ in range(reader.count(73)):
        (image_id,) = reader.take("I")
        pose = reader.pose()
        (camera_id,) = reader.take("I")
        name = reader.name()
        reader.skip(24 * reader.count(24))
        model.images.append((image_id, pose, camera_id, name))


def _rigs_bin(path: Path, model: _Model) -> None:
    reader = _Reader(path)
    for _ in range(reader.count(8)):
        rig_id, n_sensors = reader.take("II")
        for index in range(n_sensors):
            kind, sensor_id = reader.take("iI")
            pose: Similarity | None = Similarity.identity()
            if index:
                pose = reader.rigid() if reader.take("B")[0] else None
            if kind == _CAMERA_SENSOR:
                model.sensor_from_rig[rig_id, sensor_id] = pose


def _frames_bin(path: Path, model: _Model) -> None:
    reader = _Reader(path)
    for _ in range(reader.count(68)):
        frame_id, rig_id = reader.take("II")
        model.rig_from_source[frame_id] = (rig_id, reader.rigid())
        for _ in range(reader.take("I")[0]):
            kind, _, data_id = reader.take("iIQ")
            if kind == _CAMERA_SENSOR:
                model.frame_of_image[data_id] = frame_id


def _points_bin(path: Path, model: _Model) -> tuple[Float64 | None, UInt8 | None, float | None]:
    reader = _Reader(path)
    starts = np.empty(reader.count(51), np.int64)
    at, end, length_of = reader.at, len(reader.data), struct.Struct("<Q").unpack_from
    # Records differ in length, so where each begins is known only from the one before.
    for index in range(len(starts)):
        if at + 51 > end:
            reader.skip(end + 1)
        starts[index] = at
        at += 51 + 8 * length_of(reader.data, at + 43)[0]
    reader.skip(at - reader.at)
    if not len(starts):
        return None, None, None
    record = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8")])
    raw = np.frombuffer(reader.data, np.uint8)[starts[:, None] + np.arange(record.itemsize)]
    records = raw.view(record)[:, 0]
    return records["xyz"].copy(), records["rgb"].copy(), _mean_error(records["error"])


def _mean_error(errors: Float64) -> float | None:
    known = errors[np.isfinite(errors) & (errors >= 0.0)]
    return float(known.mean()) if len(known) else None


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines that are no comments, with their numbers."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if not line.startswith("#"):
            yield number, line.strip()


def _bad_line(path: Path, number: int, what: str) -> MalformedFileError:
    return MalformedFileError(path, f"Line {number:,} is not {what}.", "Export the model again.")


def _cameras_txt(path: Path, model: _Model) -> None:
    for number, line in _lines(path):
        fields = line.split()
        if not fields:
            continue
        try:
            values = [float(value) for value in fields[4:]]
            model.cameras[int(fields[0])] = _camera(fields[1], int(fields[2]), int(fields[3]), values)
        except (ValueError, IndexError):
            raise _bad_line(path, number, "a camera (id, model, width, height, parameters)") from None


def _images_txt(path: Path, model: _Model) -> None:
    # Every second line lists 2D points and may be empty, so empty lines count once the first image has been seen.
    is_header = True
    for number, line in _lines(path):
        if is_header:
            if not line:
                continue
            fields = line.split(maxsplit=9)
            try:
                pose = np.array([float(value) for value in fields[1:8]])
                model.images.append((int(fields[0]), pose, int(fields[8]), fields[9]))
            except (ValueError, IndexError):
                raise _bad_line(path, number, "an image (id, rotation, translation, camera, name)") from None
        is_header = not is_header


def _points_txt(path: Path, model: _Model) -> tuple[Float64 | None, UInt8 | None, float | None]:
    values: list[list[float]] = []
    for number, line in _lines(path):
        if line:
            try:
                values.append([float(value) for value in line.split(maxsplit=8)[1:8]])
            except ValueError:
                raise _bad_line(path, number, "a point (id, x, y, z, r, g, b, error, track)") from None
            if len(values[-1]) != 7:
                raise _bad_line(path, number, "a point (id, x, y, z, r, g, b, error, track)")
    if not values:
        return None, None, None
    table = np.array(values)
    return table[:, :3], np.clip(np.nan_to_num(table[:, 3:6]), 0, 255).astype(np.uint8), _mean_error(table[:, 6])


def _rigs_txt(path: Path, model: _Model) -> None:
    for number, line in _lines(path):
        fields = line.split()
        if not fields:
            continue
        try:
            rig_id, n_sensors, at = int(fields[0]), int(fields[1]), 2
            for index in range(n_sensors):
                is_camera, sensor_id = fields[at] == "CAMERA", int(fields[at + 1])
                at += 2
                pose: Similarity | None = Similarity.identity()
                if index:
                    has_pose = int(fields[at])
                    at += 1
                    pose = _rigid(np.array([float(v) for v in fields[at : at + 7]]), path) if has_pose else None
                    at += 7 if has_pose else 0
                if is_camera:
                    model.sensor_from_rig[rig_id, sensor_id] = pose
        except (ValueError, IndexError):
            raise _bad_line(path, number, "a rig") from None


def _frames_txt(path: Path, model: _Model) -> None:
    for number, line in _lines(path):
        fields = line.split()
        if not fields:
            continue
        try:
            frame_id, rig_id = int(fields[0]), int(fields[1])
            model.rig_from_source[frame_id] = (rig_id, _rigid(np.array([float(v) for v in fields[2:9]]), path))
            for index in range(int(fields[9])):
                kind, _, data_id = fields[10 + 3 * index : 13 + 3 * index]
                if kind == "CAMERA":
                    model.frame_of_image[int(data_id)] = frame_id
        except (ValueError, IndexError):
            raise _bad_line(path, number, "a frame") from None


_BINARY: dict[str, Any] = {
    "cameras": _cameras_bin, "images": _images_bin, "rigs": _rigs_bin, "frames": _frames_bin, "points3D": _points_bin,
}  # fmt: skip
_TEXT: dict[str, Any] = {
    "cameras": _cameras_txt, "images": _images_txt, "rigs": _rigs_txt, "frames": _frames_txt, "points3D": _points_txt,
}  # fmt: skip
