"""Photos with known cameras and places, from whatever program reconstructed the plot."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from dbh_studio.core.posed_images import PosedImages
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.errors import EmptyFileError, FileError, FileMissingError, MalformedFileError, UnsupportedFormatError
from dbh_studio.io.posed import colmap, metashape, opensfm, table
from dbh_studio.io.posed.images import ImageMatch, find_images

__all__ = ["ImageMatch", "describe_posed_formats", "find_images", "holds_poses", "read_posed_images"]

_SNIFF_BYTES = 1 << 16
_MAX_DEPTH = 4
_MAX_FOLDERS = 2_000


def describe_posed_formats() -> str:
    """One line per format, for the open dialog and the command line."""
    return (
        "COLMAP model (the folder with cameras and images, .bin or .txt)\n"
        "Agisoft Metashape (File, Export, Export Cameras: .xml)\n"
        "OpenSfM and OpenDroneMap (reconstruction.json, or the project's folder)\n"
        "Table of poses (.csv or .json, as the guide describes)"
    )


def read_posed_images(
    path: Path, *, images_dir: Path | None = None, progress: Progress = ignore_progress
) -> PosedImages:
    """Read the cameras and places of a plot's photos, and find the photos.

    Args:
        path: A file, or a folder that holds a reconstruction or a whole project.
        images_dir: Where the photos are; None looks beside the reconstruction, where the programs put them.
        progress: Called in between.

    Raises:
        FileError: Names the file, what is wrong and what to do.
    """
    path = Path(path)
    try:
        posed, base = _read(path, progress)
        return _with_photos(posed, base, images_dir)
    except OSError as error:
        raise FileMissingError(path, f"It cannot be read ({error.strerror or error}).", "Check the path.") from None
    except MemoryError:
        raise MalformedFileError(path, "It needs more memory than there is.", "Is it the right file?") from None


def holds_poses(folder: Path) -> bool:
    """Whether a folder seems to hold a reconstruction: by names and beginnings, nothing is read."""
    try:
        _find_reconstruction(folder)
    except (FileError, OSError):
        return False
    return True


def _read(path: Path, progress: Progress) -> tuple[PosedImages, Path]:
    """The images, and the folder their reconstruction is in."""
    if path.is_dir():
        chosen, notes = _find_reconstruction(path)
        if chosen.is_dir():
            posed, base = colmap.read_colmap(chosen, progress=progress), chosen
        else:
            posed, base = _read(chosen, progress)
        return replace(posed, notes=(*notes, *posed.notes)), base
    if not path.is_file():
        raise FileMissingError(path, "There is no such file or folder.", "Check the path.")
    folder = path.parent
    if path.stem in colmap.MODEL_FILES and path.suffix.lower() in (".bin", ".txt"):
        return colmap.read_colmap(folder, progress=progress), folder
    with path.open("rb") as file:
        head = file.read(_SNIFF_BYTES)
    text = _decoded(head).lstrip("\ufeff \t\r\n")
    if text.startswith("<"):
        return metashape.read_metashape(path, progress=progress), folder
    if text.startswith(("{", "[")):
        content = opensfm.read_json(path)
        if table.is_pose_list(content):
            return table.read_pose_list(path, content=content, progress=progress), folder
        return opensfm.read_opensfm(path, content=content, progress=progress), folder
    if not head.strip():
        raise EmptyFileError(path, "The file is empty.", "Export or copy it again.")
    header = next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
    if table.is_table_header(header):
        return table.read_table(path, progress=progress), folder
    raise UnsupportedFormatError(
        path, "It holds no camera poses the studio can read.", f"The studio reads:\n{describe_posed_formats()}"
    )


def _decoded(head: bytes) -> str:
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return head.decode("utf-16", errors="replace")
    return head.decode("utf-8", errors="replace")


def _find_reconstruction(folder: Path) -> tuple[Path, tuple[str, ...]]:
    """A COLMAP model's folder or a file; the shallowest, of COLMAP's models the one with the most images."""
    models: list[tuple[int, Path]] = []
    files: list[tuple[int, int, Path]] = []
    for depth, place, names in _walk(folder):
        if colmap.is_model_folder(place):
            models.append((depth, place))
        for name in names:
            rank = _rank(place / name)
            if rank is not None:
                files.append((depth, rank, place / name))
    if models:
        best = max(models, key=lambda item: (colmap.count_images(item[1]), -item[0]))[1]
        others = [place for _, place in models if place != best]
        if not others:
            return best, ()
        beside = ", ".join(_relative(place, folder) for place in others[:3]) + (", …" if len(others) > 3 else "")
        return best, (f"The model {_relative(best, folder)} has the most images and was read; not: {beside}.",)
    if not files:
        raise UnsupportedFormatError(
            folder, "There are no camera poses in this folder.", f"The studio reads:\n{describe_posed_formats()}"
        )
    files.sort()
    chosen, others_ = files[0][2], [path for _, _, path in files[1:]]
    ignored = ", ".join(_relative(path, folder) for path in others_[:3])
    return chosen, (f"{_relative(chosen, folder)} was read; not: {ignored}.",) if others_ else ()


def _walk(folder: Path) -> Iterable[tuple[int, Path, list[str]]]:
    """(depth, folder, file names) downwards, but not without end."""
    for count, (place, subfolders, names) in enumerate(os.walk(folder)):
        here = Path(place)
        depth = len(here.relative_to(folder).parts)
        subfolders[:] = sorted(s for s in subfolders if not s.startswith(".")) if depth < _MAX_DEPTH else []
        yield depth, here, sorted(names)
        if count >= _MAX_FOLDERS:
            return


def _rank(path: Path) -> int | None:
    """How likely a file of this name and beginning holds the poses: 0 is best; None where it does not."""
    suffix = path.suffix.lower()
    if path.name == "reconstruction.json":
        return 0  # Others of the kind lie beside it: reconstruction.topocentric.json.
    if suffix not in (".xml", ".csv", ".json", ".txt"):
        return None
    try:
        with path.open("rb") as file:
            text = _decoded(file.read(4096)).lstrip("\ufeff \t\r\n")
    except OSError:
        return None
    if suffix == ".xml":
        return 1 if "<document" in text and "<chunk" in text else None
    if suffix == ".json":
        if "reconstruction" in path.name and text.startswith(("[", "{")) and '"cameras"' in text:
            return 1
        return 3 if text.startswith("{") and '"images"' in text else None
    header = next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
    return 2 if table.is_table_header(header) else None


def _relative(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix() if path != folder else path.name


def _with_photos(posed: PosedImages, base: Path, images_dir: Path | None) -> PosedImages:
    """Paths of the photos: from `images_dir`, or from the first place near the reconstruction that has any."""
    if images_dir is not None:
        return find_images(posed, images_dir).applied_to(posed)
    near = [base, *list(base.parents)[:3]]
    for folder in [place / "images" for place in near] + [base]:
        names = [image.name for image in posed.images]
        if folder.is_dir() and any((folder / name).is_file() for name in names if name):
            return find_images(posed, folder).applied_to(posed)
    # Labels without an extension are matched too, but only in a folder that is surely meant.
    likely = next((place / "images" for place in near if (place / "images").is_dir()), None)
    if likely is None:
        return posed
    match = find_images(posed, likely)
    return match.applied_to(posed) if match.found or match.wrong_size else posed
