"""One entrance for every reconstruction: a file or a folder, told apart by what is in it rather than by its name."""

from __future__ import annotations

import os
import re
import stat
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.reconstruction import Provenance, Reconstruction, TriangleMesh
from dbh_studio.core.treeids import doubtful_tree_id_attribute, ids_of_tiles
from dbh_studio.errors import (
    EmptyFileError,
    FileError,
    FileMissingError,
    MalformedFileError,
    MissingComponentError,
    UnsupportedFormatError,
)
from dbh_studio.io import e57, las, mesh, pcd, ply, xyz
from dbh_studio.io.chunks import Attributes, LoadedCloud

FORMATS: dict[str, tuple[str, tuple[str, ...]]] = {
    "las": ("LAS and LAZ 1.0-1.4, COPC", (".las", ".laz")),
    "e57": ("E57 scans", (".e57",)),
    "ply": ("PLY cloud or mesh", (".ply",)),
    "pcd": ("PCD", (".pcd",)),
    "xyz": ("text: one point per line", (".xyz", ".txt", ".csv", ".asc", ".pts")),
    "obj": ("OBJ mesh", (".obj",)),
    "glb": ("GLB mesh", (".glb",)),
    "stl": ("STL mesh", (".stl",)),
}
SUPPORTED_SUFFIXES = tuple(suffix for _, suffixes in FORMATS.values() for suffix in suffixes)
_KIND_OF_SUFFIX = {suffix: kind for kind, (_, suffixes) in FORMATS.items() for suffix in suffixes}
_MESH_KINDS = ("obj", "glb", "stl")
_SNIFF_BYTES = 4096
# Text that lies next to reconstructions and is no cloud.
_NOT_CLOUDS = re.compile(
    r"^(cameras|images|points3d|frames|rigs|project|readme|licen[cs]e|requirements|transforms?|reference|gcp.*|geo)\.(txt|csv)$",
    re.IGNORECASE,
)
_FOREIGN = (
    (b"PK\x03\x04", "a ZIP archive", "Unpack it first."),
    (b"\x1f\x8b", "a gzip archive", "Unpack it first."),
    (b"7z\xbc\xaf", "a 7-Zip archive", "Unpack it first."),
    (b"Rar!", "a RAR archive", "Unpack it first."),
    (b"%PDF", "a PDF", "Choose the point cloud."),
    (b"\xff\xd8\xff", "a JPEG picture", "Choose the point cloud or mesh made from the pictures."),
    (b"\x89PNG", "a PNG picture", "Choose the point cloud or mesh made from the pictures."),
    (b"<!DOCTYPE", "a web page", "The download failed; download the file again."),
    (b"<html", "a web page", "The download failed; download the file again."),
    (b"version https://git-lfs", "a placeholder of Git LFS", "Fetch the real file with 'git lfs pull'."),
    (b"Kaydara FBX", "an FBX model", "Export it as OBJ, GLB or PLY."),
)


def describe_formats() -> str:
    """One line per format with its suffixes, for the open dialog and the command line."""
    return "\n".join(f"{title} ({', '.join(suffixes)})" for title, suffixes in FORMATS.values())


def sniff_format(path: Path) -> str:
    """The format of a file, one of `FORMATS`, from its first bytes.

    Raises:
        FileMissingError: It is not there or may not be read.
        EmptyFileError: It has no bytes.
        UnsupportedFormatError: It is something else; says what, where that is known.
        MalformedFileError: It is text under the name of a binary format.
    """
    try:
        size = os.path.getsize(path)
        with open(path, "rb") as file:
            head = file.read(_SNIFF_BYTES)
    except OSError as error:
        raise FileMissingError(path, f"The file cannot be read ({error.strerror}).", "Check the path.") from None
    suffix = path.suffix.lower()
    if not head:
        raise EmptyFileError(path, "The file is empty.", "Export or copy it again.")
    kind = _by_magic(head, size)
    if kind:
        return kind
    for magic, what, remedy in _FOREIGN:
        if head.lstrip().startswith(magic):
            raise UnsupportedFormatError(path, f"This is {what}, not a point cloud or mesh.", remedy)
    if not _is_text(head):
        wanted = FORMATS.get(_KIND_OF_SUFFIX.get(suffix, ""))
        if wanted:
            raise MalformedFileError(
                path, f"The content is not {wanted[0]}, as the name says.", "Export or copy it again."
            )
        raise UnsupportedFormatError(path, "The format is not known.", f"The studio reads:\n{describe_formats()}")
    if re.search(rb"(?m)^v[ \t]+[-+.\d]", head):
        return "obj"
    expected = _KIND_OF_SUFFIX.get(suffix)
    if expected == "obj" and re.search(rb"(?m)^(#|o |g |mtllib|usemtl|vn |vt )", head):
        return "obj"
    if expected in (None, "xyz"):
        return "xyz"
    raise MalformedFileError(
        path,
        f"The file is named {suffix} but its content is text.",
        f"If it lists points as x y z, rename it to {path.stem}.txt and open it again.",
    )


def _by_magic(head: bytes, size: int) -> str | None:
    if re.match(rb"ply[\r\n \t]", head):
        return "ply"
    for magic, kind in ((b"LASF", "las"), (b"ASTM-E57", "e57"), (b"glTF", "glb")):
        if head.startswith(magic):
            return kind
    if re.match(rb"\s*(#[^\n]*\n\s*)*(VERSION[ \t]+0?\.\d|FIELDS[ \t])", head):
        return "pcd"
    if re.match(rb"\s*solid\b", head) and b"facet" in head:
        return "stl"
    if len(head) >= 84 and not _is_text(head) and size == 84 + 50 * struct.unpack_from("<I", head, 80)[0]:
        return "stl"
    return None


def _is_text(head: bytes) -> bool:
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return True
    return not re.search(rb"[\x00-\x08\x0e-\x1a\x1c-\x1f]", head)


def read_reconstruction(
    path: Path,
    *,
    progress: Progress = ignore_progress,
    attributes: Attributes = "needed",
    merge: Literal["auto", "always", "never"] = "auto",
) -> Reconstruction:
    """Read a point cloud, a mesh, or a folder that holds them.

    Args:
        path: A file or a folder.
        progress: Called between chunks.
        attributes: ``needed`` keeps tree ids and the classification; ``all`` keeps everything, at a cost in memory.
        merge: Several clouds in a folder: ``auto`` merges them where they are tiles of one plot (names that differ only
            in numbers, areas that hardly overlap), ``always`` and ``never`` decide it.

    Raises:
        FileError: Names the file, what is wrong and what to do.
    """
    path = Path(path)
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise FileMissingError(path, "There is no such file or folder.", "Check the path.") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FileMissingError(path, f"It cannot be opened ({reason}).", "Check the path.") from None
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        # Looking into a pipe would wait for ever, and what was looked at would be gone.
        raise UnsupportedFormatError(path, "This is neither a file nor a folder.", "Save the cloud to a file first.")
    if stat.S_ISDIR(mode):
        if not os.access(path, os.R_OK | os.X_OK):
            raise FileMissingError(path, "The folder cannot be looked into (permission denied).", "Allow reading it.")
        return _with_offer(_read_folder(path, progress, attributes, merge))
    try:
        return _with_offer(_read_source(_Source.of(path), progress, attributes))
    except (OSError, MemoryError) as error:
        raise _io_error(path, error) from error


def _with_offer(reconstruction: Reconstruction) -> Reconstruction:
    """With a note where there may be tree ids under a name that means many things."""
    name = doubtful_tree_id_attribute(reconstruction.cloud)
    if name is None:
        return reconstruction
    note = (
        f"The values {name!r} do not look like trees (each in one place, from low to high), so they were not used. "
        "If they are the numbers of the trees, rename them treeID."
    )
    return replace(reconstruction, notes=(*reconstruction.notes, note))


def _io_error(path: Path, error: OSError | MemoryError) -> FileError:
    if isinstance(error, MemoryError):
        return MalformedFileError(
            path, "It needs more memory than there is.", "Thin the cloud out, or crop it to the plot."
        )
    return FileMissingError(path, f"The file cannot be read ({error.strerror or error}).", "Check it and its disk.")


@dataclass(frozen=True)
class _Source:
    """A file whose format is known, and whether it has faces."""

    path: Path
    kind: str
    is_mesh: bool

    @classmethod
    def of(cls, path: Path) -> _Source:
        """Look into a file. Raises FileError where it is nothing that can be read."""
        kind = sniff_format(path)
        return cls(path, kind, kind in _MESH_KINDS or (kind == "ply" and ply.read_header(path).count("face") > 0))

    @property
    def notes(self) -> tuple[str, ...]:
        """A remark where name and content disagree."""
        suffix = self.path.suffix.lower()
        if suffix in _KIND_OF_SUFFIX and _KIND_OF_SUFFIX[suffix] != self.kind:
            return (f"{self.path.name} is named {suffix} but is {FORMATS[self.kind][0]}; it was read as that.",)
        return ()


def _read_source(source: _Source, progress: Progress, attributes: Attributes) -> Reconstruction:
    """Read one file."""
    if not source.is_mesh:
        loaded = _read_cloud(source, progress, attributes)
        return Reconstruction(loaded.cloud, None, (source.path,), (*source.notes, *loaded.notes), loaded.provenance)
    surface = mesh.read_mesh(source.path, kind=source.kind, progress=progress)
    cloud = mesh.sample_surface(surface, source.path)
    if not len(surface.faces):
        return Reconstruction(cloud, None, (source.path,), (*source.notes, *surface.notes), surface.provenance)
    faces = f"{len(surface.faces):,} faces of the mesh"
    sampled = f"There is no point cloud: {len(cloud):,} points were sampled from the {faces}."
    notes = (*source.notes, *surface.notes, sampled)
    return Reconstruction(cloud, surface.as_mesh(cloud.origin), (source.path,), notes, surface.provenance)


def _read_cloud(source: _Source, progress: Progress, attributes: Attributes) -> LoadedCloud:
    readers = {"las": las.read_las, "e57": e57.read_e57, "ply": ply.read_ply, "pcd": pcd.read_pcd, "xyz": xyz.read_xyz}
    return readers[source.kind](source.path, progress=progress, attributes=attributes)


def _read_folder(folder: Path, progress: Progress, attributes: Attributes, merge: str) -> Reconstruction:
    """Read what a folder holds: its cloud (or tiles), and its mesh to show."""
    sources, notes = _find_sources(folder)
    clouds = [source for source in sources if not source.is_mesh]
    meshes = [source for source in sources if source.is_mesh]
    if not sources:
        detail = f" {notes[0]}" if notes else ""
        raise EmptyFileError(folder, f"There is no point cloud or mesh in this folder.{detail}", describe_formats())
    chosen_mesh = max(meshes, key=lambda source: source.path.stat().st_size) if meshes else None
    notes += [
        f"{other.path.name} ignored: {chosen_mesh.path.name} is larger."
        for other in meshes
        if chosen_mesh not in (None, other)
    ]
    try:
        if not clouds and chosen_mesh is not None:
            base = _read_source(chosen_mesh, progress, attributes)
            return replace(base, notes=(*notes, *base.notes))
        base = _read_clouds(clouds, subprogress(progress, 0.0, 0.8 if chosen_mesh else 1.0), attributes, merge)
        surface: TriangleMesh | None = None
        used = base.used
        if chosen_mesh is not None:
            surface, remark = _mesh_beside(chosen_mesh, base.cloud, subprogress(progress, 0.8, 1.0))
            notes += remark
            used = (*used, chosen_mesh.path) if surface is not None else used
    except (OSError, MemoryError) as error:
        raise _io_error(folder, error) from error
    return Reconstruction(base.cloud, surface, used, (*notes, *base.notes), base.provenance)


def _mesh_beside(source: _Source, cloud: PointCloud, progress: Progress) -> tuple[TriangleMesh | None, list[str]]:
    """The mesh about the cloud's origin. Without it there is only a picture less, so it does not stop the plot."""
    try:
        surface = mesh.read_mesh(source.path, kind=source.kind, progress=progress)
        return surface.as_mesh(cloud.origin), [*source.notes, f"{source.path.name} is shown; the points are measured."]
    except FileError as error:
        return None, [f"The mesh was left out. {error}"]
    except MissingComponentError as error:
        return None, [f"The mesh was left out. {source.path.name}: {error}"]


def _find_sources(folder: Path) -> tuple[list[_Source], list[str]]:
    """The folder's clouds and meshes; where it has none itself, those of its subfolders, two levels down."""
    notes: list[str] = []
    for pattern in ("*", "*/*", "*/*/*"):
        sources = []
        for path in sorted(folder.glob(pattern)):
            suffix = path.suffix.lower()
            if (
                suffix not in _KIND_OF_SUFFIX
                or path.name.startswith(".")
                or not path.is_file()
                or _NOT_CLOUDS.match(path.name)
            ):
                continue
            try:
                source = _Source.of(path)
                if source.kind == "xyz":
                    xyz.sniff_layout(path)
                sources.append(source)
            except FileError as error:
                notes.append(f"Ignored: {error}")
        if sources:
            return sources, notes
    return [], notes


def _read_clouds(clouds: list[_Source], progress: Progress, attributes: Attributes, merge: str) -> Reconstruction:
    """Choose among, or merge, the clouds of a folder."""
    best = _preferred(clouds)
    tiles = (
        clouds
        if merge == "always"
        else [c for c in clouds if c.kind == best.kind and _family(c.path) == _family(best.path)]
    )
    ignored = [f"{c.path.name} ignored: {best.path.name} was read." for c in clouds if c not in tiles]
    if len(tiles) == 1 or merge == "never":
        ignored = [f"{c.path.name} ignored: {best.path.name} was read." for c in clouds if c is not best]
        base = _read_source(best, progress, attributes)
        return replace(base, notes=(*ignored, *base.notes))
    share = 1.0 / len(tiles)
    parts = [_read_cloud(t, subprogress(progress, i * share, (i + 1) * share), attributes) for i, t in enumerate(tiles)]
    if merge == "auto" and not _are_tiles([part.cloud for part in parts]):
        largest = max(range(len(parts)), key=lambda i: len(parts[i].cloud))
        others = [t.path.name for i, t in enumerate(tiles) if i != largest]
        ignored.append(
            f"{', '.join(others)} ignored: not tiles beside {tiles[largest].path.name}, which has the most points."
        )
        part = parts[largest]
        return Reconstruction(part.cloud, None, (tiles[largest].path,), (*ignored, *part.notes), part.provenance)
    merged, remarks = merge_clouds([part.cloud for part in parts])
    notes = [*ignored, f"{len(tiles)} clouds were merged: {', '.join(tile.path.name for tile in tiles)}.", *remarks]
    notes += [
        f"{tile.path.name}: {note}"
        for tile, part in zip(tiles, parts, strict=True)
        for note in (*tile.notes, *part.notes)
    ]
    if len({part.cloud.crs for part in parts}) > 1:
        notes.append("The clouds name different coordinate systems; that of the first was kept.")
    same = all(part.provenance.metres_per_unit == parts[0].provenance.metres_per_unit for part in parts)
    origin = parts[0].provenance if same else Provenance()
    return Reconstruction(merged, None, tuple(tile.path for tile in tiles), tuple(notes), origin)


def _preferred(clouds: list[_Source]) -> _Source:
    """Formats that keep a coordinate system first, then the larger file."""
    order = list(FORMATS)
    return min(clouds, key=lambda source: (order.index(source.kind), -source.path.stat().st_size, source.path.name))


def _family(path: Path) -> str:
    """A name without its numbers: tiles of a plot have this in common."""
    return re.sub(r"\d+", "#", path.stem.lower())


def _are_tiles(clouds: list[PointCloud]) -> bool:
    """Whether the clouds lie beside each other: no two share more than a third of the smaller one's area."""
    boxes: list[Float64] = [cloud.bounds_src()[:, :2] for cloud in clouds]
    for i, a in enumerate(boxes):
        for b in boxes[i + 1 :]:
            common = np.clip(np.minimum(a[1], b[1]) - np.maximum(a[0], b[0]), 0.0, None).prod()
            if common > min((a[1] - a[0]).prod(), (b[1] - b[0]).prod()) / 3.0:
                return False
    return True


def merge_clouds(clouds: list[PointCloud]) -> tuple[PointCloud, tuple[str, ...]]:
    """All points about the first cloud's origin, and notes; colours and attributes only where every cloud has them.

    Tree ids that the clouds use for different trees are made different, see `ids_of_tiles`.
    """
    origin = clouds[0].origin
    total = sum(map(len, clouds))
    xyz_all = np.empty((total, 3), np.float32)
    start = 0
    for cloud in clouds:
        shift = cloud.origin - origin
        np.add(cloud.xyz, shift, out=xyz_all[start : start + len(cloud)], casting="unsafe")
        start += len(cloud)
    rgb = None
    colours = [cloud.rgb for cloud in clouds if cloud.rgb is not None]
    if len(colours) == len(clouds):
        rgb = np.concatenate(colours)
    names = [name for name in clouds[0].attributes if all(name in cloud.attributes for cloud in clouds)]
    columns = {name: ids_of_tiles(clouds, name) for name in names}
    values = {name: np.concatenate(parts) for name, (parts, _) in columns.items()}
    notes = tuple(note for _, note in columns.values() if note)
    return PointCloud(xyz_all, origin, rgb, values, clouds[0].crs, clouds[0].name), notes
