"""Which mask belongs to which photo, by name, in the naming styles of the programs that write masks."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.errors import FileMissingError, SettingError
from dbh_studio.io.posed.images import IMAGE_SUFFIXES, image_size, match_names

# Style → the mask's name. {path} is the photo's with its folders, {stem} that without its extension {ext}.
MASK_STYLES: dict[str, str] = {
    "colmap": "{path}.png",
    "suffix": "{stem}_mask.png",
    "dotted": "{stem}.mask.png",
    "trunk": "{stem}_trunk.png",
    "same": "{stem}.png",
}
STYLE_TITLES: dict[str, str] = {
    "colmap": "photo.jpg.png (COLMAP, OpenSfM)",
    "suffix": "photo_mask.png (Metashape, OpenDroneMap)",
    "dotted": "photo.mask.png",
    "trunk": "photo_trunk.png",
    "same": "photo.png, in a folder of its own",
    "template": "a template of your own",
    "one": "one mask for all photos",
    "coco": "as in the COCO file",
}
# What Metashape and people call the parts of a name.
_FIELDS = {"filename": "stem", "name": "path", "fileext": "ext", "image": "path"}
_MAX_FILES = 200_000


@dataclass(frozen=True, eq=False)
class MaskMatch:
    """Which masks of the photos are on disk.

    Attributes:
        style: A key of `STYLE_TITLES`.
        found: Image name → mask file.
        missing: Names of images without a mask, and of those for which several could be meant.
        wrong_size: Name → what is wrong with the mask found: another aspect, or damaged.
        renamed: Those of `found` in another folder or with other upper and lower case or extension.
        ambiguous: Name → how many files could be meant; these are among `missing`.
        n_unused: Image files in the folders that belong to no photo.
    """

    style: str
    found: Mapping[str, Path]
    missing: tuple[str, ...]
    wrong_size: Mapping[str, str] = field(default_factory=dict)
    renamed: Mapping[str, Path] = field(default_factory=dict)
    ambiguous: Mapping[str, int] = field(default_factory=dict)
    n_unused: int = 0

    def notes(self) -> tuple[str, ...]:
        """What the person should know, in plain words."""
        total = len(self.found) + len(self.missing) + len(self.wrong_size)
        notes = [f"Masks of {len(self.found):,} of {total:,} photos were found, named {STYLE_TITLES[self.style]}."]
        if self.missing:
            notes.append(f"{len(self.missing):,} photos have no mask: {_some(self.missing)}.")
        if self.ambiguous:
            notes.append(f"For {len(self.ambiguous):,} of them several files could be meant: {_some(self.ambiguous)}.")
        if self.wrong_size:
            name, why = next(iter(self.wrong_size.items()))
            notes.append(f"{len(self.wrong_size):,} masks cannot be used; {name}: {why}")
        if self.n_unused:
            notes.append(f"{self.n_unused:,} image files in the folder are the mask of no photo.")
        return tuple(notes)


def find_masks(
    posed: PosedImages,
    where: Path | str | Iterable[Path | str],
    *,
    style: str | None = None,
    template: str | None = None,
) -> MaskMatch:
    """Match masks to photos by name where that is safe, as `posed.find_images` matches photos.

    Args:
        posed: The photos.
        where: Folders, looked through with their subfolders; or one file, which is the mask of all photos.
        style: A key of `MASK_STYLES`; None takes the one that fits most photos.
        template: A name of your own such as ``{stem}_segm.png``, with {path}, {stem}, {ext} or Metashape's {filename};
            the mask's extension may differ.

    Raises:
        FileMissingError: A folder does not exist.
        SettingError: An unknown style, or a template that would give all photos the same mask.
    """
    places = [Path(where)] if isinstance(where, (str, Path)) else [Path(place) for place in where]
    if len(places) == 1 and places[0].is_file():
        return _checked(posed, "one", {image.name: places[0] for image in posed}, {}, {}, 0)
    files = _without_photos(posed, _list(places))
    best: tuple[int, str, dict[str, Path], dict[str, Path], dict[str, int]] | None = None
    for key, pattern in _patterns(style, template).items():
        wanted = {mask_name(pattern, image.name): image.name for image in posed}
        if len(wanted) < len(posed):  # a.jpg and a.png have one stem: neither may claim its mask
            wanted = _unique(pattern, posed)
        by_mask, renamed, ambiguous = match_names(list(wanted), places, files)
        if best is None or len(by_mask) > best[0]:
            matched = {wanted[name]: path for name, path in by_mask.items()}
            others = {wanted[name]: path for name, path in renamed.items()}
            unclear = {wanted[name]: count for name, count in ambiguous.items()}
            best = (len(by_mask), key, matched, others, unclear)
    assert best is not None  # there is always a pattern
    _, key, matched, others, unclear = best
    return _checked(posed, key, matched, others, unclear, len(files) - len(set(matched.values())))


def _without_photos(posed: PosedImages, files: list[Path]) -> list[Path]:
    """Without the photos themselves, which may lie in the same folders and bear the same names."""
    photos = {os.path.realpath(image.path) for image in posed if image.path is not None}
    lost = {PurePosixPath(image.name).name.lower() for image in posed if image.path is None}
    return [
        path
        for path in files
        if os.path.realpath(path) not in photos
        and (path.name.lower() not in lost or re.search("mask|label|segm", path.parent.name.lower()))
    ]


def mask_name(pattern: str, image_name: str) -> str:
    """The mask's name with ``/`` between folders, for a pattern as in `MASK_STYLES`."""
    path = PurePosixPath(image_name)
    # A label such as ``plot.001`` has no extension.
    stem = str(path.with_suffix("")) if path.suffix.lower() in IMAGE_SUFFIXES else image_name
    return pattern.format(path=image_name, stem=stem, ext=path.suffix.lstrip("."))


def _patterns(style: str | None, template: str | None) -> dict[str, str]:
    if template is not None:
        pattern = re.sub(r"\{(\w+)\}", lambda m: "{" + _FIELDS.get(m[1].lower(), m[1].lower()) + "}", template)
        try:
            names = {mask_name(pattern, "a.jpg"), mask_name(pattern, "b.jpg")}
        except (KeyError, IndexError, ValueError):
            names = set()
        if len(names) < 2:
            raise SettingError(f"{template!r} is no template for names.", "Use for example {stem}_mask.png.")
        return {"template": pattern}
    if style is None:
        return MASK_STYLES
    if style not in MASK_STYLES:
        raise SettingError(f"There is no naming style {style!r}.", f"Use {', '.join(MASK_STYLES)} or a template.")
    return {style: MASK_STYLES[style]}


def _unique(pattern: str, posed: PosedImages) -> dict[str, str]:
    claims: dict[str, list[str]] = {}
    for image in posed:
        claims.setdefault(mask_name(pattern, image.name), []).append(image.name)
    return {name: images[0] for name, images in claims.items() if len(images) == 1}


def _list(folders: list[Path]) -> list[Path]:
    """Every image file below the folders, sorted; unlike photos, also those in folders called masks."""
    files: dict[Path, None] = {}
    for root in folders:
        if not root.is_dir():
            raise FileMissingError(root, "There is no such folder.", "Choose the folder with the masks.")
        for folder, subfolders, names in os.walk(root):
            subfolders[:] = sorted(s for s in subfolders if not s.startswith("."))
            for name in sorted(names):
                if PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES and not name.startswith("."):
                    files[Path(folder) / name] = None
            if len(files) > _MAX_FILES:
                raise FileMissingError(root, "There are too many images below this folder.", "Choose a deeper folder.")
    return list(files)


def _checked(
    posed: PosedImages,
    style: str,
    matched: Mapping[str, Path],
    renamed: Mapping[str, Path],
    ambiguous: Mapping[str, int],
    n_unused: int,
) -> MaskMatch:
    """Without those whose size cannot be that of the photo."""
    found: dict[str, Path] = {}
    wrong: dict[str, str] = {}
    sizes: dict[Path, tuple[int, int] | None] = {}
    for image in posed:
        path = matched.get(image.name)
        if path is None:
            continue
        if path not in sizes:
            sizes[path] = image_size(path)
        problem = _size_problem(image, path, sizes[path])
        if problem:
            wrong[image.name] = problem
        else:
            found[image.name] = path
    missing = tuple(image.name for image in posed if image.name not in matched)
    others = {name: path for name, path in renamed.items() if name in found}
    return MaskMatch(style, found, missing, wrong, others, ambiguous, n_unused)


def _size_problem(image: PosedImage, path: Path, size: tuple[int, int] | None) -> str:
    camera = image.camera
    if size is None:
        return f"{path.name} is damaged or no image."
    if camera.has_aspect_of(*size):
        return ""
    turned = " It was turned." if camera.has_aspect_of(size[1], size[0]) else ""
    return f"{path.name} has {size[0]} x {size[1]} pixels, the photo {camera.width_px} x {camera.height_px}.{turned}"


def _some(names: Iterable[str]) -> str:
    names = list(names)
    return ", ".join(names[:3]) + (", …" if len(names) > 3 else "")
