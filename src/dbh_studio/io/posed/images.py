"""Finding the photos on disk: their folder moved, their names changed, their size changed."""

from __future__ import annotations

import os
import warnings
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.errors import FileMissingError
from dbh_studio.io.photos import open_picture

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp"})
# Pictures under the same names that are not the photos.
_OTHER_PICTURES = frozenset({"mask", "masks", "depth", "depths", "depth_maps", "normal_maps", "thumbnails", "thumbs"})
_MAX_FILES = 200_000


@dataclass(frozen=True, eq=False)
class ImageMatch:
    """Which photos of a reconstruction are on disk.

    Attributes:
        found: Images with their `path`; a photo of another size with the same aspect has a camera scaled to it.
        missing: Names of images without a photo, and of those for which several photos could be meant.
        wrong_size: Name → what is wrong with the photo found: another aspect, turned, or damaged.
        renamed: Name → path of each photo found under another name or in another folder.
        resized: Name → (width, height) of each photo found in another size.
        ambiguous: Name → how many files could be meant; these are among `missing`.
    """

    found: tuple[PosedImage, ...]
    missing: tuple[str, ...]
    wrong_size: Mapping[str, str]
    renamed: Mapping[str, str]
    resized: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    ambiguous: Mapping[str, int] = field(default_factory=dict)

    def applied_to(self, posed: PosedImages) -> PosedImages:
        """The same images, those found with their path and camera, and notes on the rest."""
        found = {image.name: image for image in self.found}
        images = tuple(found.get(image.name, image) for image in posed.images)
        return replace(posed, images=images, notes=(*posed.notes, *self.notes()))

    def notes(self) -> tuple[str, ...]:
        """What the person should know, in plain words; empty where every photo is there as named."""
        notes = []
        if self.missing:
            notes.append(f"{len(self.missing):,} photos were not found: {_some(self.missing)}.")
        if self.ambiguous:
            notes.append(f"For {len(self.ambiguous):,} of them several files could be meant: {_some(self.ambiguous)}.")
        if self.wrong_size:
            name, why = next(iter(self.wrong_size.items()))
            notes.append(f"{len(self.wrong_size):,} photos cannot be used; {name}: {why}")
        if self.renamed:
            notes.append(f"{len(self.renamed):,} photos have another name or folder than the cameras say.")
        if self.resized:
            notes.append(f"{len(self.resized):,} photos were resized since; their cameras were scaled to them.")
        return tuple(notes)


def find_images(posed: PosedImages, folders: Path | str | Iterable[Path | str]) -> ImageMatch:
    """Match photos by name where that is safe.

    In this order: the exact relative path; the same file name, the deeper the common folders the better; the same but
    for upper and lower case; the same but for the extension. A match must be the only one, from both sides; a guess
    would put a stem's outline on the wrong photo.

    Args:
        posed: The images looked for.
        folders: Where to look, with subfolders; folders named masks, depth or thumbnails are left out.

    Raises:
        FileMissingError: A folder does not exist.
    """
    roots = [Path(folders)] if isinstance(folders, (str, Path)) else [Path(folder) for folder in folders]
    files = list_images(roots)
    matched, renamed, ambiguous = match_names([image.name for image in posed.images], roots, files)
    found: list[PosedImage] = []
    wrong: dict[str, str] = {}
    resized: dict[str, tuple[int, int]] = {}
    for image in posed.images:
        path = matched.get(image.name)
        if path is None:
            continue
        size = image_size(path)
        camera = image.camera
        if size is None:
            wrong[image.name] = f"{path.name} is damaged or no image."
        elif not camera.has_aspect_of(*size):
            wrong[image.name] = _size_problem(image, path, size)
        else:
            if size != (camera.width_px, camera.height_px):
                camera = camera.scaled_to(*size)
                resized[image.name] = size
            found.append(replace(image, path=str(path), camera=camera))
    missing = tuple(image.name for image in posed.images if image.name not in matched)
    others = {name: str(path) for name, path in renamed.items() if name not in wrong}
    return ImageMatch(tuple(found), missing, wrong, others, resized, ambiguous)


def list_images(roots: Iterable[Path]) -> list[Path]:
    """Every image file below the folders, sorted, each once.

    Raises:
        FileMissingError: A folder does not exist.
    """
    files: dict[Path, None] = {}
    for root in roots:
        if not root.is_dir():
            raise FileMissingError(root, "There is no such folder.", "Choose the folder with the photos.")
        for folder, subfolders, names in os.walk(root):
            subfolders[:] = sorted(s for s in subfolders if s.lower() not in _OTHER_PICTURES and not s.startswith("."))
            for name in sorted(names):
                if PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES and not name.startswith("."):
                    files[Path(folder) / name] = None
            if len(files) > _MAX_FILES:
                raise FileMissingError(root, "There are too many images below this folder.", "Choose a deeper folder.")
    return list(files)


def image_size(path: Path) -> tuple[int, int] | None:
    """(width, height) as stored, without turning it as its EXIF data says; None where it is no image.

    Poses belong to the pixels as stored, so whoever reads the photo must not turn it either.
    """
    try:
        with warnings.catch_warnings():
            # Of a photo with damaged metadata the size is good all the same.
            warnings.simplefilter("ignore")
            with open_picture(path) as picture:
                return picture.size
    except (OSError, ValueError, SyntaxError):
        return None


def _size_problem(image: PosedImage, path: Path, size: tuple[int, int]) -> str:
    camera = image.camera
    sizes = f"{path.name} has {size[0]} x {size[1]} pixels, its camera {camera.width_px} x {camera.height_px}"
    if camera.has_aspect_of(size[1], size[0]):
        return f"{sizes}: it was turned after the reconstruction. Use the photos as the reconstruction had them."
    return f"{sizes}: it was cropped or is another photo. Use the photos as the reconstruction had them."


def match_names(
    names: Sequence[str], roots: Sequence[Path], files: Sequence[Path]
) -> tuple[dict[str, Path], dict[str, Path], dict[str, int]]:
    """Match names with ``/`` between folders to files below `roots`, in the order of `find_images`.

    Returns:
        Name → path, those of them renamed, and how many candidates the ambiguous ones have.
    """
    matched: dict[str, Path] = {}
    renamed: dict[str, Path] = {}
    known = set(files)
    for name in names:
        exact = [root / name for root in roots if root / name in known]
        if exact and name:
            matched[name] = exact[0]
    ambiguous: dict[str, int] = {}
    for key in (_base, _base_lower, _stem_lower):
        taken = set(matched.values())
        by_key: dict[str, list[Path]] = defaultdict(list)
        for path in files:
            if path not in taken:
                by_key[key(path.as_posix(), True)].append(path)
        wanted: dict[str, list[str]] = defaultdict(list)
        for name in names:
            if name not in matched:
                wanted[key(name, False)].append(name)
        for value, alike in wanted.items():
            pairs = _pair(alike, by_key.get(value, []))
            for name, candidates in pairs.items():
                if len(candidates) == 1:
                    matched[name] = renamed[name] = candidates[0]
                    ambiguous.pop(name, None)
                elif len(candidates) > 1:
                    ambiguous[name] = len(candidates)
    return matched, renamed, {name: count for name, count in ambiguous.items() if name not in matched}


def _pair(names: list[str], paths: list[Path]) -> dict[str, list[Path]]:
    """For each name the files that share most of its folders; a file wanted by two names goes to neither."""
    best: dict[str, list[Path]] = {}
    for name in names:
        shared = [(_common_tail(name, path), path) for path in paths]
        most = max((count for count, _ in shared), default=0)
        best[name] = [path for count, path in shared if count == most]
    claims: dict[Path, int] = defaultdict(int)
    for candidates in best.values():
        for path in candidates:
            claims[path] += 1
    return {
        name: candidates if len(candidates) != 1 or claims[candidates[0]] == 1 else [candidates[0], candidates[0]]
        for name, candidates in best.items()
    }


def _common_tail(name: str, path: Path) -> int:
    """How many folders above the file both share."""
    a, b = PurePosixPath(name).parts[-2::-1], path.parts[-2::-1]
    count = 0
    for mine, theirs in zip(a, b, strict=False):
        if mine.lower() != theirs.lower():
            break
        count += 1
    return count


def _base(name: str, is_file: bool) -> str:
    return PurePosixPath(name).name


def _base_lower(name: str, is_file: bool) -> str:
    return PurePosixPath(name).name.lower()


def _stem_lower(name: str, is_file: bool) -> str:
    """Without its extension; a label such as ``plot.001`` has none."""
    base = PurePosixPath(name)
    return base.stem.lower() if is_file or base.suffix.lower() in IMAGE_SUFFIXES else base.name.lower()


def _some(names: Iterable[str]) -> str:
    names = list(names)
    return ", ".join(names[:3]) + (", …" if len(names) > 3 else "")
