"""The masks kept beside a plot, `NAME.dbh/masks`: what is there, what a person said of it, and how it votes.

    masks = plot_masks(session, cameras.posed)          # a snapshot that `find_image_trunks` takes like a `MaskSet`
    states = mask_states(session, cameras.posed)        # a row per photo, for a list
    set_review(session, "a.jpg", "rejected")            # it does not vote any more
    put_painted(session, photo, mask)                   # what a person painted; never made anew by a model
    take_over_brought(session, brought, cameras.posed)  # brought masks become kept ones, so that they can be painted

A plot that is not saved yet has its masks in the cache, under the cloud's fingerprint, so that work on it is found
again; saving the plot moves them beside it (`carry_masks`). Every function reads the index anew: a job may have written
it.
"""

from __future__ import annotations

import hashlib
import logging
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from dbh_studio.app.cache import cache_folder, why_not_writable
from dbh_studio.core.mask_record import MaskRecord
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.errors import CommandError, FileError

if TYPE_CHECKING:
    from dbh_studio.app.brought_masks import MaskSet
    from dbh_studio.app.document import Document
    from dbh_studio.app.session import Session
    from dbh_studio.core.posed_images import PosedImage, PosedImages
    from dbh_studio.io.masks import MaskStore, Review, StoredMask, TrunkMask

_log = logging.getLogger(__name__)

MASKS_FOLDER = "masks"
_INDEX = "index.jsonl"
_UNSAVED = "unsaved-masks"
_METHODS: dict[str, Literal["detector", "prompted", "brought"]] = {
    "grounded_sam": "detector",
    "prompted_sam": "prompted",
    "imported": "brought",
}


# ---- where they are


def masks_folder(session: Session) -> Path:
    """Where the masks of a plot are: beside the saved plot, else in the cache. It may not be there yet.

    Where the cache cannot be written they are in a folder that goes when the program ends; that is logged once.
    """
    folder = session.saver.folder if session.saver is not None else session.read_from
    if folder is not None:
        return folder / MASKS_FOLDER
    unsaved = cache_folder() / _UNSAVED
    if problem := why_not_writable(unsaved):
        if _passing_folder is None:
            words = "The cache %s cannot be written (%s): masks are kept for this run only, until the plot is saved."
            _log.warning(words, unsaved, problem)
        unsaved = _passing()
    return unsaved / session.document.source.fingerprint


_passing_folder: tempfile.TemporaryDirectory[str] | None = None


def _passing() -> Path:
    """A folder that goes with the program."""
    global _passing_folder
    if _passing_folder is None:
        _passing_folder = tempfile.TemporaryDirectory(prefix="dbh-studio-masks-", ignore_cleanup_errors=True)
    return Path(_passing_folder.name)


def mask_store(session: Session) -> MaskStore:
    """The store of a plot's masks, its index read now. Only one may write at a time: close to a job, read only.

    Raises:
        FileError: The index cannot be read.
    """
    from dbh_studio.io.masks import MaskStore

    return MaskStore(masks_folder(session))


def has_masks(session: Session) -> bool:
    """Whether any mask is kept for the plot."""
    return (masks_folder(session) / _INDEX).is_file()


def carry_masks(before: Path, after: Path, *, move: bool, newer_wins: bool = False) -> None:
    """Bring the masks of one place to another that may have some already; of a photo that both have, that of `before`.

    Args:
        before: A folder of masks; nothing is done where there is none.
        after: The folder they come to.
        move: Leave nothing behind: for the masks of a plot that was not saved yet.
        newer_wins: Of a photo that both have, take what a person painted, else that of the place written last.

    Raises:
        FileError: They cannot be read or written.
    """
    from dbh_studio.io.masks import MaskStore

    if before == after or not (before / _INDEX).is_file():
        return
    theirs, own = MaskStore(before), MaskStore(after)
    own.take(theirs, _wanted(theirs, own) if newer_wins else None)
    if move:
        with suppress(OSError):
            shutil.rmtree(before)


def _wanted(theirs: MaskStore, own: MaskStore) -> frozenset[str]:
    """The photos whose mask is better than the own one: painted, else from the place that was written last."""
    if not len(own):
        return frozenset(entry.image for entry in theirs.entries)
    times = [(store.folder / _INDEX).stat().st_mtime_ns for store in (theirs, own)]
    wanted = set()
    for entry in theirs.entries:
        mine = own.entry(entry.image)
        if mine is None or (entry.is_painted if entry.is_painted != mine.is_painted else times[0] > times[1]):
            wanted.add(entry.image)
    return frozenset(wanted)


# ---- as the voting asks for them


@dataclass(frozen=True, eq=False)
class PlotMasks:
    """The kept masks that vote, as they were when this was made; picklable. See `app.brought_masks.VotingMasks`.

    Attributes:
        folder: Where they are.
        entries: Photo → what is known of its mask; only those that vote.
        notes: What the person should know: how many there are, and which do not vote.
    """

    folder: Path
    entries: Mapping[str, StoredMask]
    notes: tuple[str, ...] = ()
    finds_trunks: bool = field(default=True, init=False)

    def __len__(self) -> int:
        return len(self.entries)

    def mask(self, name: str) -> TrunkMask | None:
        """The mask of a photo; None where it has none that votes.

        Raises:
            FileError: It is damaged.
        """
        from dbh_studio.io.masks.store import read_stored

        entry = self.entries.get(name)
        return None if entry is None else read_stored(self.folder, entry)

    def where(self, name: str) -> Path:
        """The file of a photo's mask."""
        return self.folder / self.entries[name].file

    def record(self) -> MaskRecord:
        """What is saved with the trunks they find: the rung, recipe and models that most of them have."""
        by_recipe = Counter(entry.key for entry in self.entries.values() if entry.recipe["method"] in _METHODS)
        n_masks, digest = len(self.entries), self._digest()
        if not by_recipe:
            return MaskRecord("brought", "brought", n_masks, digest=digest)
        key = min(by_recipe.items(), key=lambda item: (-item[1], item[0]))[0]
        recipe: Any = next(entry.recipe for entry in self.entries.values() if entry.key == key)
        rung = _METHODS[recipe["method"]]
        if rung == "brought":
            options = recipe["options"]
            return MaskRecord(
                "brought",
                rung,
                n_masks,
                path=Path(options["path"]),
                meaning=options["meaning"],
                categories=tuple(options["categories"]),
                style=options["style"],
                digest=digest,
            )
        return MaskRecord(
            "made", rung, n_masks, prompt=recipe["prompt"], models=tuple(recipe["models"]), recipe=key, digest=digest
        )

    def _digest(self) -> str:
        digest = hashlib.sha256()
        for name in sorted(self.entries):
            digest.update(f"{name}\t{self.entries[name].sha256}\n".encode("utf-8", "replace"))
        return digest.hexdigest()[:16]


def plot_masks(session: Session, posed: PosedImages | None = None, *, only_accepted: bool = False) -> PlotMasks:
    """The kept masks of a plot that vote: not the rejected ones, nor those of photos that are others now.

    Args:
        session: The plot.
        posed: Its photos, in any frame. Masks of other photos are left out, and so are those whose photo has changed
            since; None takes all.
        only_accepted: Take only what a person accepted or painted.

    Raises:
        FileError: The index cannot be read.
    """
    return masks_that_vote(mask_store(session), posed, only_accepted=only_accepted)


def masks_that_vote(store: MaskStore, posed: PosedImages | None = None, *, only_accepted: bool = False) -> PlotMasks:
    """As `plot_masks`, of a store."""
    photos = None if posed is None else {photo.name: photo.path for photo in posed}
    voting: dict[str, StoredMask] = {}
    n_rejected = n_strange = n_waiting = n_painted = 0
    recipes: set[str] = set()
    for entry in store.entries:
        if photos is not None and (entry.image not in photos or not store.is_of(entry.image, photos[entry.image])):
            n_strange += 1
        elif entry.review == "rejected":
            n_rejected += 1
        elif only_accepted and not entry.review:
            n_waiting += 1
        else:
            n_painted += entry.is_painted
            recipes |= set() if entry.is_painted else {entry.key}
            voting[entry.image] = entry
    of = "" if photos is None else f" of {len(photos):,} photos"
    notes = [f"{len(voting):,} masks{of} are kept beside the plot and vote."]
    for count, text in (
        (n_painted, "of them painted by hand."),
        (n_rejected, "were rejected and do not vote."),
        (n_waiting, "were not accepted yet and do not vote."),
        (n_strange, "belong to photos that are not here, or have changed since, and do not vote."),
    ):
        if count:
            notes.append(f"{count:,} {text}")
    if len(recipes) > 1:
        notes.append(
            f"They were made in {len(recipes)} ways (models, prompt or settings differ); reject those that are not "
            "to vote, or make all alike: `dbh-studio masks make --redo --keyframes all`."
        )
    return PlotMasks(store.folder, voting, tuple(notes))


# ---- what is there, for people


@dataclass(frozen=True)
class MaskState:
    """A photo and its mask, as a list shows them.

    Attributes:
        photo: The photo's name.
        has_photo: Whether its file is on this computer.
        has_mask: Whether a mask is kept for it, and the photo has not changed since.
        votes: Whether that mask votes.
        review: What a person said: empty, ``accepted``, ``rejected`` or ``repainted``.
        origin: ``detector``, ``prompted``, ``brought``, ``painted``, or empty without a mask.
        n_trunks: How many trunks are in it; 1 where they are not told apart.
        score: The best of the models' scores, 0..1; None where nobody said.
        is_outdated: The file of the photo has changed since: the mask does not vote and will be made anew.
    """

    photo: str
    has_photo: bool
    has_mask: bool
    votes: bool
    review: Review
    origin: str
    n_trunks: int
    score: float | None
    is_outdated: bool


def mask_states(session: Session, posed: PosedImages) -> tuple[MaskState, ...]:
    """One row per photo, in the order of capture.

    Raises:
        FileError: The index cannot be read.
    """
    return states_of(mask_store(session), posed)


def states_of(store: MaskStore, posed: PosedImages) -> tuple[MaskState, ...]:
    """As `mask_states`, of a store."""
    rows = []
    for photo in posed:
        entry = store.entry(photo.name)
        if entry is None:
            rows.append(MaskState(photo.name, photo.path is not None, False, False, "", "", 0, None, False))
            continue
        is_current = store.is_of(photo.name, photo.path)
        method = str(entry.recipe.get("method", ""))
        origin = "painted" if entry.review == "repainted" else _METHODS.get(method, method)
        rows.append(
            MaskState(
                photo=photo.name,
                has_photo=photo.path is not None,
                has_mask=is_current,
                votes=is_current and entry.review != "rejected",
                review=entry.review,
                origin=origin,
                n_trunks=entry.n_trunks,
                score=max(entry.scores.values(), default=None),
                is_outdated=not is_current,
            )
        )
    return tuple(rows)


def kept_mask(session: Session, name: str) -> TrunkMask | None:
    """The mask kept for a photo, rejected or not, to be shown or painted on; None where there is none.

    Raises:
        FileError: The index cannot be read.
    """
    return mask_store(session).get(name)


# ---- what a person does


def set_review(session: Session, name: str, review: Review) -> None:
    """Accept (``accepted``) or reject (``rejected``) the mask of a photo, or take back what was said (empty).

    It takes effect when the trunks are found anew.

    Raises:
        CommandError: The photo has no kept mask, or the plot is open for reading only.
        FileError: It cannot be written.
    """
    _check_writable(session)
    review_in(mask_store(session), name, review)


def review_in(store: MaskStore, name: str, review: Review) -> None:
    """As `set_review`, of a store."""
    entry = store.entry(name)
    if entry is None:
        raise CommandError(f"There is no kept mask of {name}.", "`dbh-studio masks list` shows which there are.")
    # What was painted stays so when its acceptance is taken back: no model may make it anew.
    store.set_review(name, "repainted" if entry.is_painted and review in ("", "accepted") else review)


def put_painted(session: Session, photo: PosedImage, mask: TrunkMask) -> StoredMask:
    """Keep what a person painted over a photo. It votes, and no model makes it anew.

    Args:
        session: The plot.
        photo: With its path.
        mask: Of the photo's aspect, in any size.

    Raises:
        CommandError: The plot is open for reading only, or the mask is of another aspect than the photo.
        FileError: The photo is not there, or the mask cannot be written.
    """
    from dbh_studio.io.masks import MaskRecipe

    _check_writable(session)
    if not photo.camera.has_aspect_of(*mask.size):
        raise CommandError(f"A mask of {mask.size[0]} x {mask.size[1]} pixels does not fit {photo.name}.")
    return mask_store(session).put(photo.name, _file_of(photo), mask, MaskRecipe("painted"), review="repainted")


def take_over_brought(
    session: Session,
    masks: MaskSet,
    posed: PosedImages,
    *,
    names: Iterable[str] | None = None,
    progress: Progress = ignore_progress,
) -> tuple[str, ...]:
    """Keep brought masks beside the plot, so that they can be reviewed and painted on; what was painted stays as it is.

    Args:
        session: The plot.
        masks: From `app.brought_masks.read_masks`.
        posed: The photos.
        names: Only these photos; None takes all that have a mask and a file.
        progress: Called after each photo.

    Returns:
        What could not be taken over and why, in plain words; empty where all could.

    Raises:
        CommandError: The plot is open for reading only.
        FileError: The store cannot be written.
        CancelledError: From `progress`; what was taken over until then stays.
    """
    _check_writable(session)
    return copy_brought(masks_folder(session), masks, posed, names=names, progress=progress)


def copy_brought(
    folder: Path,
    masks: MaskSet,
    posed: PosedImages,
    *,
    names: Iterable[str] | None = None,
    progress: Progress = ignore_progress,
) -> tuple[str, ...]:
    """As `take_over_brought`, into a folder of masks. Pure and picklable, for a job: 0.1 s for each mask."""
    from dbh_studio.io.masks import MaskRecipe, MaskStore

    record = masks.record()
    options = {
        "path": str(record.path),
        "meaning": record.meaning,
        "categories": list(record.categories),
        "style": record.style,
    }
    recipe = MaskRecipe("imported", options=options)
    store = MaskStore(folder)
    wanted = set(masks.names if names is None else names)
    photos = [photo for photo in posed if photo.name in wanted]
    problems = []
    for index, photo in enumerate(photos):
        progress(index / len(photos), f"Mask {index + 1} of {len(photos)}")
        entry = store.entry(photo.name)
        if entry is not None and entry.is_painted:
            continue
        try:
            path, mask = _file_of(photo), masks.mask(photo.name)
        except FileError as error:
            problems.append(f"The mask of {photo.name} was left out: {error}")
            continue
        if mask is not None:
            store.put(photo.name, path, mask, recipe)
    progress(1.0, "")
    return tuple(problems)


def same_masks(document: Document, masks: PlotMasks) -> bool:
    """Whether the trunks of the plot came from these masks as they are: nothing was reviewed, painted or made since."""
    return document.masks is not None and document.masks.digest.startswith(masks.record().digest)


def _file_of(photo: PosedImage) -> Path:
    if photo.path is None:
        raise FileError(photo.name, "The photo was not found.", "Say in which folder the photos are.")
    return Path(photo.path)


def _check_writable(session: Session) -> None:
    if session.is_read_only:
        raise CommandError("The plot is open for reading only.", "Open it for writing, or save a copy, to change it.")
