"""Masks a person brings: which photo each belongs to, and what it means."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from dbh_studio.app.mask_overlay import spread, write_overlay
from dbh_studio.app.mask_request import MaskRequest, VotingMasks
from dbh_studio.core.mask_record import MaskRecord
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.errors import FileError, FileMissingError, SettingError

if TYPE_CHECKING:
    from dbh_studio.core.mask_views import ImageMask
    from dbh_studio.core.posed_images import PosedImage, PosedImages
    from dbh_studio.io.masks import CocoMasks, MaskMatch, MaskMeaning, MaskPicture, TrunkMask

__all__ = ["IGNORING", "MaskReader", "MaskRequest", "MaskSet", "VotingMasks", "find_brought_masks", "read_masks"]

# Where more than this is trunk, most likely all classes of a picture, or the wrong side of a mask, were taken for it.
_MOST_TRUNK = 0.5
_LOSSY = frozenset({".jpg", ".jpeg", ".webp"})
IGNORING: tuple[str, ...] = ("ignore_dark", "ignore_bright")


@dataclass(frozen=True, eq=False)
class MaskSet:
    """The masks of a plot's photos, found and understood; none is read yet but a few to judge by. Picklable.

    Attributes:
        path: Where they are.
        match: Which photo has which.
        meaning: As said, or as guessed.
        trunk_labels: Numbers, or ids of categories, that are trunks; None takes all.
        coco: The COCO file; None for pictures.
        ignore: Further masks that only say what to ignore; None where there are none.
        ignore_side: Which side of these.
        unclear: Why a person must say more before these masks are used; empty where nothing is unclear.
        remedy: What to say.
        notes: What was found, in plain words.
    """

    path: Path
    match: MaskMatch
    meaning: MaskMeaning
    trunk_labels: tuple[int, ...] | None = None
    coco: CocoMasks | None = None
    ignore: MaskMatch | None = None
    ignore_side: Literal["dark", "bright"] = "dark"
    unclear: str = ""
    remedy: str = ""
    notes: tuple[str, ...] = ()
    _names: Mapping[str, str] = field(default_factory=dict, repr=False)

    @property
    def finds_trunks(self) -> bool:
        """Whether they say what is trunk, and not only what to ignore."""
        return self.meaning not in IGNORING

    @property
    def names(self) -> tuple[str, ...]:
        """The photos that have one."""
        return tuple(self.match.found)

    def where(self, name: str) -> Path:
        """The file of a photo's mask."""
        return self.match.found[name] if self.coco is None else self.path

    def record(self) -> MaskRecord:
        """What is saved with the trunks they find. A file that was changed changes its digest."""
        digest = hashlib.sha256(repr((self.meaning, self.trunk_labels, self.ignore_side)).encode())
        further = {} if self.ignore is None else self.ignore.found
        # Outlines are all in one file; what stands for their pictures is no path.
        files = [self.path] if self.coco is not None else [*self.match.found.values()]
        for path in sorted({*files, *further.values()}):
            try:
                status = path.stat()
                digest.update(f"{path}\t{status.st_size}\t{status.st_mtime_ns}\n".encode("utf-8", "replace"))
            except OSError:
                digest.update(f"{path}\n".encode("utf-8", "replace"))
        return MaskRecord(
            "brought",
            "brought",
            len(self.match.found),
            path=self.path.absolute(),
            meaning=self.meaning,
            categories=_as_ranges(self.trunk_labels or ()),
            style="" if self.coco is not None else self.match.style,
            digest=digest.hexdigest()[:16],
        )

    def mask(self, name: str) -> TrunkMask | None:
        """The mask of a photo, by the photo's name; None where it has none. What further masks ignore is in it.

        Raises:
            FileError: It cannot be read.
        """
        from dbh_studio.io.masks import read_mask_picture, understood

        path = self.match.found.get(name)
        if path is None:
            return None
        if self.coco is not None:
            mask = self.coco.mask(self._names[str(path)], self.trunk_labels)
        else:
            mask = understood(read_mask_picture(path), self.meaning, trunk_labels=self.trunk_labels)
        further = None if self.ignore is None else self.ignore.found.get(name)
        return mask if further is None else self._also_ignoring(mask, read_mask_picture(further))

    def _also_ignoring(self, mask: TrunkMask, picture: MaskPicture) -> TrunkMask:
        from dbh_studio.io.masks import TrunkMask, understood

        meaning: MaskMeaning = "ignore_dark" if self.ignore_side == "dark" else "ignore_bright"
        ignored = understood(picture, meaning).sized(*mask.size).ignored
        if ignored is not None and mask.ignored is not None:
            ignored = ignored | mask.ignored
        return TrunkMask(mask.labels, ignored, mask.has_instances, mask.scores)


class MaskReader:
    """The masks of photos as the voting asks for them; may be called from several threads.

    A mask that cannot be read is left out and told: one damaged file among 200 must not lose the others' work.

    Args:
        masks: Which.
        edge_px: So near to an outline a mask says nothing.

    Attributes:
        problems: Photo -> why its mask was left out.
        n_read: How many could be read.
    """

    def __init__(self, masks: VotingMasks, edge_px: int = 0) -> None:
        self.problems: dict[str, FileError] = {}
        self.n_read = 0
        self._masks = masks
        self._edge_px = edge_px
        self._lock = threading.Lock()

    def __call__(self, photo: PosedImage) -> ImageMask | None:
        """The mask of a photo, None where it has none."""
        from dbh_studio.core.mask_views import ImageMask

        try:
            mask = self._masks.mask(photo.name)
            if mask is None:
                return None
            view = ImageMask(photo.camera, mask.labels, mask.ignored, mask.has_instances, self._edge_px)
        except FileError as error:
            self.problems[photo.name] = error
            return None
        except ValueError as error:
            self.problems[photo.name] = FileError(self._masks.where(photo.name), f"It does not fit ({error}).")
            return None
        with self._lock:
            self.n_read += 1
        return view

    def notes(self) -> list[str]:
        """What was left out."""
        if not self.problems:
            return []
        name, error = min(self.problems.items())
        return [f"{len(self.problems):,} masks could not be read and were left out, that of {name} for one: {error}"]


def find_brought_masks(request: MaskRequest, posed: PosedImages, *, progress: Progress = ignore_progress) -> MaskSet:
    """Match masks to photos, and look at a few to see what they mean.

    Nothing is refused that a person could still settle: `MaskSet.unclear` says what is to be asked, and `read_masks`
    refuses then.

    Args:
        request: Where they are, and what is known of them.
        posed: The photos.
        progress: Called in between.

    Raises:
        FileError: There is nothing at the path, no mask belongs to any photo, or none can be read.
        SettingError: What is asked for contradicts itself.
    """
    from dbh_studio.io.masks import find_masks

    if not request.path.exists():
        raise FileMissingError(request.path, "There is no such file or folder.", "Say where the masks are (--masks).")
    if request.path.is_file() and request.path.suffix.lower() == ".json":
        found = _coco(request, posed)
    else:
        style = request.style
        template = style if style is not None and "{" in style else None
        match = find_masks(posed, request.path, style=None if template else style, template=template)
        _check_found(request.path, match, len(posed))
        progress(0.2, "Looking at the masks")
        found = _pictures(request, match, progress)
    if request.ignore_path is None:
        return found
    return _with_ignored(found, request, posed)


def read_masks(request: MaskRequest, posed: PosedImages, *, progress: Progress = ignore_progress) -> MaskSet:
    """The masks to use as they are asked for; the overlay is written first, also where it is refused afterwards.

    Raises:
        SettingError: What they mean is unclear; says how to say it.
        FileError: As `find_brought_masks`, or the overlay cannot be written.
    """
    masks = find_brought_masks(request, posed, progress=progress)
    if request.overlay is not None:
        write_overlay(request.overlay, masks, posed)
    if masks.unclear:
        looked = f" {request.overlay.name} shows how they would be read." if request.overlay is not None else ""
        raise SettingError(masks.unclear + looked, masks.remedy)
    return masks


# ---- what they mean


def _pictures(request: MaskRequest, match: MaskMatch, progress: Progress) -> MaskSet:
    """Mask pictures, by a few of them."""
    from dbh_studio.io.masks import MEANING_TITLES, guess_meaning

    is_one = match.style == "one" and len(match.found) > 1
    pictures = _sample(match)
    progress(1.0, "Looking at the masks")
    guess = guess_meaning(pictures)
    meaning = request.meaning or guess.meaning
    numbers = _numbers(request.categories) if request.categories else None
    if numbers is not None and request.meaning is None:
        meaning = "labels"
    unclear, remedy = "", ""
    notes = list(match.notes())
    if numbers is not None and meaning != "labels":
        raise SettingError(
            f"--mask-category needs masks with numbers, not {meaning.replace('_', '-')}.", "Leave one of them away."
        )
    if meaning == "labels" and any(path.suffix.lower() in _LOSSY for path in match.found.values()):
        notes.append("JPEG files change numbers where they meet: save numbered masks as PNG.")
    if is_one and meaning not in IGNORING:
        unclear = "One mask for all photos cannot say where the trunks are: the camera moved between them."
        remedy = "Give the folder with a mask for each photo, or use this one as --ignore-masks."
    elif request.meaning is None and numbers is None:
        if guess.is_clear and meaning not in IGNORING:
            notes.append(f"They are read as: {MEANING_TITLES[meaning]}. {guess.why}")
        else:
            unclear, remedy = _doubt(guess.why, meaning)
    masks = MaskSet(request.path, match, meaning, numbers, unclear=unclear, remedy=remedy, notes=tuple(notes))
    return masks if unclear or not masks.finds_trunks else _checked_share(masks, request, pictures)


def _doubt(why: str, meaning: str) -> tuple[str, str]:
    if meaning in IGNORING:
        return (
            f"These masks look as if they say what to ignore, not what is trunk: {why}",
            "If so, no trunk can be found by them: give them as --ignore-masks, beside masks of trunks. If they do "
            "show trunks, say it: --mask-meaning trunk-bright, trunk-dark or labels.",
        )
    return (
        f"What the masks mean is not clear: {why}",
        f"Say it: --mask-meaning trunk-bright, trunk-dark, ignore-dark, ignore-bright or labels; most likely it is "
        f"{meaning.replace('_', '-')}.",
    )


def _checked_share(masks: MaskSet, request: MaskRequest, pictures: Sequence[MaskPicture]) -> MaskSet:
    """With a doubt where most of the pictures would be trunk."""
    from dbh_studio.io.masks import understood

    of_trunk = [understood(each, masks.meaning, trunk_labels=masks.trunk_labels).labels > 0 for each in pictures]
    share = float(np.mean([np.count_nonzero(each) / each.size for each in of_trunk]))
    if share == 0.0:
        what = "The numbers named occur in none of them." if masks.trunk_labels else "Perhaps no trunk was in view."
        return replace(masks, notes=(*masks.notes, f"The masks looked at have no trunk at all. {what}"))
    if share <= _MOST_TRUNK:
        return masks
    text = f"{100 * share:.0f} % of the pixels would be trunk"
    if masks.meaning == "labels" and masks.trunk_labels is None:
        return replace(
            masks,
            unclear=f"With every number a trunk, {text}: some must be the ground or the sky.",
            remedy="Say which numbers are trunks: --mask-category 7, or --mask-category 1-12.",
        )
    if request.meaning is None:
        return replace(masks, unclear=f"{text}, which is hardly so.", remedy="Say what they mean: --mask-meaning.")
    return replace(masks, notes=(*masks.notes, f"{text}: look whether dark and bright are the right way round."))


def _coco(request: MaskRequest, posed: PosedImages) -> MaskSet:
    from dbh_studio.io.masks import read_coco

    if request.meaning not in (None, "labels"):
        raise SettingError("A COCO file says itself what its outlines are.", "Leave --mask-meaning away.")
    coco = read_coco(request.path)
    match = coco.match(posed)
    _check_found(request.path, match, len(posed))
    notes, unclear, remedy = list(match.notes()), "", ""
    known = ", ".join(f"{coco.categories[key]} ({count:,})" for key, count in sorted(coco.counts.items()))
    if request.categories:
        chosen = _category_ids(request.categories, coco, known)
    else:
        chosen = coco.likely_trunks()
        if chosen:
            named = ", ".join(coco.categories[key] for key in chosen)
            notes.append(f"Of its categories these are taken as trunks, by their names: {named}.")
        else:
            unclear = f"None of the categories in {request.path.name} is a trunk by its name: {known}."
            remedy = "Say which is: --mask-category NAME."
    names = {str(Path(name)): name for name in coco.images}
    return MaskSet(
        request.path, match, "labels", chosen, coco, unclear=unclear, remedy=remedy, notes=tuple(notes), _names=names
    )


def _category_ids(wanted: Sequence[str], coco: CocoMasks, known: str) -> tuple[int, ...]:
    chosen: list[int] = []
    for text in wanted:
        matching = [key for key, name in coco.categories.items() if text.strip().lower() in (name.lower(), str(key))]
        if not matching:
            raise SettingError(f"There is no category {text!r} in {coco.path.name}.", f"There are: {known}.")
        chosen += matching
    return tuple(sorted(set(chosen)))


def _numbers(wanted: Sequence[str]) -> tuple[int, ...]:
    """``7`` and ``1-12`` as numbers."""
    numbers: set[int] = set()
    for text in wanted:
        first, _, last = text.strip().partition("-")
        try:
            low, high = int(first), int(last or first)
            if not 0 < low <= high <= 65535:
                raise ValueError
        except ValueError:
            raise SettingError(
                f"--mask-category {text}: mask pictures have numbers from 1 to 65535 (0 is no trunk), not names.",
                "Use for example 7 or 1-12.",
            ) from None
        numbers.update(range(low, high + 1))
    return tuple(sorted(numbers))


def _as_ranges(numbers: Sequence[int]) -> tuple[str, ...]:
    """1, 2, 3, 7 as ``1-3`` and ``7``, as `MaskRequest.categories` takes them."""
    ranges: list[list[int]] = []
    for number in sorted(numbers):
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    return tuple(f"{low}" if low == high else f"{low}-{high}" for low, high in ranges)


def _with_ignored(masks: MaskSet, request: MaskRequest, posed: PosedImages) -> MaskSet:
    from dbh_studio.io.masks import find_masks

    path = request.ignore_path
    assert path is not None
    if not path.exists():
        raise FileMissingError(path, "There is no such file or folder.", "Say where these masks are (--ignore-masks).")
    match = find_masks(posed, path)
    _check_found(path, match, len(posed))
    shares = [
        float(np.mean(each.bright if request.ignore_side == "bright" else ~each.bright)) for each in _sample(match)
    ]
    share = float(np.mean(shares))
    other = "" if share <= _MOST_TRUNK else " Look whether dark and bright are the right way round (--ignore-side)."
    note = f"Of {len(match.found):,} photos {100 * share:.0f} % of the pixels are ignored.{other}"
    return replace(masks, ignore=match, ignore_side=request.ignore_side, notes=(*masks.notes, note))


def _check_found(path: Path, match: MaskMatch, n_photos: int) -> None:
    if match.found:
        return
    if match.wrong_size:
        name, why = next(iter(match.wrong_size.items()))
        raise FileError(
            path,
            f"None of its {len(match.wrong_size):,} masks fits its photo; {name}: {why}",
            "Use masks of the photos as the reconstruction has them, in any size but of the same aspect.",
        )
    why = f" In {len(match.ambiguous):,} cases several files could be meant." if match.ambiguous else ""
    raise FileError(
        path,
        f"It has no mask for any of the {n_photos:,} photos.{why}",
        "Masks are matched by name, such as photo.jpg.png, photo_mask.png or photo.png for photo.jpg; "
        "other names are told by --mask-style, such as {stem}_segm.png. Of outlines in COCO form give the .json file.",
    )


def _sample(match: MaskMatch) -> list[MaskPicture]:
    """A few pictures, spread over the folder, leaving out damaged ones."""
    from dbh_studio.io.masks import read_mask_picture

    pictures: list[MaskPicture] = []
    problem: FileError | None = None
    for path in spread(sorted(set(match.found.values()))):
        try:
            pictures.append(read_mask_picture(path))
        except FileError as error:
            problem = error
    if not pictures:
        assert problem is not None
        raise problem
    return pictures
