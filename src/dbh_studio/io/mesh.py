"""Meshes: OBJ, GLB and STL through trimesh, PLY through our own reader. Shown, and sampled where there is no cloud."""

from __future__ import annotations

import json
import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float32, Float64, Int32, UInt8
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.reconstruction import Provenance, TriangleMesh
from dbh_studio.errors import EmptyFileError, FileError, MalformedFileError, MissingComponentError, TruncatedFileError
from dbh_studio.io.chunks import CloudBuilder
from dbh_studio.io.ply import read_faces, read_ply

SAMPLES_MOST = 2_000_000
SAMPLES_PER_FACE = 4
_AGAIN = "Export or copy the mesh again."


@dataclass(frozen=True, eq=False)
class LoadedMesh:
    """Vertices as a cloud (so that precision and dropped values are handled once) and the faces between them."""

    vertices: PointCloud
    faces: Int32
    notes: tuple[str, ...]
    provenance: Provenance

    def as_mesh(self, origin: Float64) -> TriangleMesh:
        """The mesh about `origin`."""
        shift = self.vertices.origin - origin
        xyz = self.vertices.xyz if not shift.any() else (self.vertices.xyz + shift).astype(np.float32)
        return TriangleMesh(xyz, self.faces, self.vertices.rgb)


def read_mesh(path: Path, *, kind: str, progress: Progress = ignore_progress) -> LoadedMesh:
    """Read a mesh.

    Args:
        path: The file.
        kind: ``obj``, ``ply``, ``glb`` or ``stl``, as its content says.
        progress: Told when reading and when done; trimesh reads in one go.

    Raises:
        FileError: `MalformedFileError`, `TruncatedFileError` or `EmptyFileError`.
    """
    progress(0.0, f"Reading {path.name}")
    if kind == "ply":
        loaded = read_ply(path, progress=progress)
        n_vertices = len(loaded.cloud)
        if any("dropped" in note for note in loaded.notes):
            raise MalformedFileError(path, "Some vertices of the mesh are not numbers.", _AGAIN)
        return LoadedMesh(loaded.cloud, read_faces(path, n_vertices), loaded.notes, loaded.provenance)
    _check(path, kind)
    vertices, faces, rgb = _through_trimesh(path, kind)
    builder = CloudBuilder(path, capacity=len(vertices), colour_dtype=None if rgb is None else np.uint8)
    builder.add(vertices, rgb)
    if builder.n_dropped:
        raise MalformedFileError(path, f"{builder.n_dropped:,} vertices of the mesh are not numbers.", _AGAIN)
    cloud, notes = builder.finish(name=path.name)
    inside = ((faces >= 0) & (faces < len(cloud))).all(axis=1)
    progress(1.0, f"Read {path.name}")
    return LoadedMesh(cloud, np.ascontiguousarray(faces[inside], np.int32), notes, Provenance(kind))


def _through_trimesh(path: Path, kind: str) -> tuple[Float64, NDArray[Any], UInt8 | None]:
    """(V, 3) vertices, (F, 3) faces and colours; a scene's parts are joined in its frame."""
    try:
        import trimesh
    except ImportError:
        raise MissingComponentError("Meshes need the package trimesh.", "Install trimesh, or export a cloud.") from None
    try:
        options: dict[str, Any] = {"skip_materials": True} if kind == "obj" else {}
        with open(path, "rb") as file:
            scene = trimesh.load_scene(file, file_type=kind, process=False, **options)
        parts: list[Any] = list(scene.dump()) if len(scene.geometry) else []
        return _joined(
            path, [part for part in parts if getattr(part, "vertices", None) is not None and len(part.vertices)]
        )
    except (FileError, OSError, MemoryError):
        raise
    except Exception as error:  # It raises whatever its parsers stumble over.
        text = re.sub(r"\s+", " ", str(error))[:160]
        raise MalformedFileError(path, f"The mesh is damaged ({type(error).__name__}: {text}).", _AGAIN) from error


def _joined(path: Path, parts: list[Any]) -> tuple[Float64, NDArray[Any], UInt8 | None]:
    if not parts:
        raise EmptyFileError(path, "There is no geometry in it.", _AGAIN)
    vertices = np.concatenate([np.asarray(part.vertices, np.float64) for part in parts])
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [
        np.asarray(getattr(p, "faces", np.zeros((0, 3))), np.int64).reshape(-1, 3) + s
        for p, s in zip(parts, starts[:-1], strict=True)
    ]
    colours = [_colours(part) for part in parts]
    known = [c for c in colours if c is not None]
    return vertices, np.concatenate(faces), np.concatenate(known) if len(known) == len(colours) else None


def _colours(part: Any) -> UInt8 | None:
    """(V, 3) vertex colours of a trimesh geometry; None where it has none or they are in a texture."""
    if hasattr(part, "faces"):
        if part.visual.kind != "vertex":
            return None
        rgba = np.asarray(part.visual.vertex_colors)
    else:
        rgba = np.asarray(part.colors) if part.colors is not None else np.zeros((0, 4))
    return rgba[:, :3].astype(np.uint8) if rgba.shape[:1] == (len(part.vertices),) and rgba.ndim == 2 else None


def _check(path: Path, kind: str) -> None:
    """Refuse counts that the file has no room for, before a library allocates them."""
    size = os.path.getsize(path)
    if kind == "stl":
        with open(path, "rb") as file:
            head = file.read(84)
        if len(head) == 84 and not head.startswith(b"solid"):
            count = struct.unpack_from("<I", head, 80)[0]
            if 84 + 50 * count > size:
                raise TruncatedFileError(
                    path, f"The header promises {count:,} triangles but the file is shorter.", _AGAIN
                )
    elif kind == "glb":
        _check_glb(path, size)


def _check_glb(path: Path, size: int) -> None:
    with open(path, "rb") as file:
        head = file.read(20)
        if len(head) < 20:
            raise TruncatedFileError(path, "The file ends within its GLB header.", _AGAIN)
        _, version, length, json_length, _ = struct.unpack("<4sIIII", head)
        if version != 2 or length > size or json_length > size:
            raise TruncatedFileError(
                path, "The file is shorter than its GLB header says, or of another version.", _AGAIN
            )
        try:
            tree = json.loads(file.read(json_length))
            counts = [int(accessor["count"]) for accessor in tree.get("accessors", [])]
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            raise MalformedFileError(path, "The description inside the GLB is damaged.", _AGAIN) from None
    # Draco and meshopt pack many values into a byte; nothing packs a thousand.
    if any(not 0 <= count <= 1000 * size for count in counts):
        raise MalformedFileError(path, "The GLB claims more values than the file can hold.", _AGAIN)


def sample_surface(mesh: LoadedMesh, path: Path, *, n_points: int | None = None, seed: int = 0) -> PointCloud:
    """Points spread evenly over the mesh's area, coloured between its vertices' colours.

    Args:
        mesh: What to sample; without faces its vertices are the cloud.
        path: For messages.
        n_points: How many; by default a few per face and at most two million.
        seed: Equal seeds give equal points.

    Raises:
        EmptyFileError: The mesh has no area.
    """
    if not len(mesh.faces):
        return mesh.vertices
    corners = mesh.vertices.xyz[mesh.faces].astype(np.float64)
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    total = np.cumsum(areas)
    if not total[-1] > 0 or not np.isfinite(total[-1]):
        raise EmptyFileError(path, "The mesh has no area to sample points from.", _AGAIN)
    if n_points is None:
        n_points = min(SAMPLES_MOST, max(100_000, SAMPLES_PER_FACE * len(mesh.faces)))
    rng = np.random.default_rng(seed)
    chosen = np.minimum(np.searchsorted(total, rng.random(n_points) * total[-1], side="right"), len(areas) - 1)
    root, along = np.sqrt(rng.random(n_points)), rng.random(n_points)
    weights = np.stack([1 - root, root * (1 - along), root * along], axis=1)
    points: Float32 = np.einsum("nk,nkd->nd", weights, corners[chosen]).astype(np.float32)
    rgb = None
    if mesh.vertices.rgb is not None:
        mixed = np.einsum("nk,nkd->nd", weights, mesh.vertices.rgb[mesh.faces[chosen]].astype(np.float64))
        rgb = np.rint(mixed).astype(np.uint8)
    return PointCloud(points, mesh.vertices.origin, rgb, {}, mesh.vertices.crs, path.name)
