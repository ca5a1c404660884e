"""What a mask means: trunk, not trunk, "do not look here", or a number per trunk.

A mask made for structure from motion says "ignore what is black": the walker, the sky, moving things. Read as trunks
it would make a tree of the walker's head. So the meaning is asked; what is guessed here is only what is offered first,
with the reason.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, UInt8, readonly
from dbh_studio.io.masks.picture import MaskPicture, UInt16

MaskMeaning = Literal["trunk_bright", "trunk_dark", "ignore_dark", "ignore_bright", "labels"]
MEANINGS: tuple[MaskMeaning, ...] = get_args(MaskMeaning)
MEANING_TITLES: dict[MaskMeaning, str] = {
    "trunk_bright": "Trunks are bright, all else is dark",
    "trunk_dark": "Trunks are dark, all else is bright",
    "ignore_dark": "Dark is to be ignored (a mask made for structure from motion)",
    "ignore_bright": "Bright is to be ignored",
    "labels": "Each trunk or class has a number or colour of its own",
}
MAX_INSTANCES = 65534


@dataclass(frozen=True, eq=False)
class TrunkMask:
    """What one photo shows, pixel by pixel.

    Attributes:
        labels: (H, W) uint16, read-only: 0 no trunk, else the number of the trunk in this photo.
        ignored: (H, W) bool of pixels that say nothing, neither for nor against; None where all do.
        has_instances: Whether each number is one trunk; else 1 is all trunks together.
        scores: Number → how sure the model was, 0..1; empty where nobody said.
    """

    labels: UInt16
    ignored: Bool | None = None
    has_instances: bool = False
    scores: dict[int, float] | None = None

    def __post_init__(self) -> None:
        labels = np.asarray(self.labels)
        if labels.ndim != 2:
            raise ValueError(f"labels has shape {labels.shape} but (H, W) is needed")
        object.__setattr__(self, "labels", readonly(labels.astype(np.uint16, copy=False)))
        if self.ignored is not None:
            if self.ignored.shape != labels.shape:
                raise ValueError(f"ignored has shape {self.ignored.shape} but {labels.shape} is needed")
            object.__setattr__(self, "ignored", readonly(np.asarray(self.ignored, bool)))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.labels.shape[1], self.labels.shape[0]

    @property
    def numbers(self) -> tuple[int, ...]:
        """The numbers that occur, without 0."""
        occurs = np.zeros(65536, bool)
        occurs[self.labels] = True  # counting would need eight bytes a pixel
        return tuple(int(n) for n in np.flatnonzero(occurs) if n)

    def sized(self, width_px: int, height_px: int) -> TrunkMask:
        """The same in another size of the same picture: every pixel takes what lies at its centre.

        Raises:
            ValueError: The other size has another aspect.
        """
        if self.size == (width_px, height_px):
            return self
        if not same_aspect(self.size, (width_px, height_px)):
            raise ValueError(f"a mask of {self.size[0]} x {self.size[1]} is none of {width_px} x {height_px} pixels")
        rows = ((np.arange(height_px) + 0.5) * (self.size[1] / height_px)).astype(int)
        columns = ((np.arange(width_px) + 0.5) * (self.size[0] / width_px)).astype(int)
        ignored = None if self.ignored is None else self.ignored[np.ix_(rows, columns)]
        return TrunkMask(self.labels[np.ix_(rows, columns)], ignored, self.has_instances, self.scores)


def same_aspect(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two (width, height) are one picture in two sizes: the sides agree to a pixel's rounding."""
    (w, h), (wide, high) = sorted([size, other])
    if w <= 0 or h <= 0:
        return False
    # The smaller one's sides were rounded to whole pixels: is there one factor that gives both?
    return max((w - 1) / wide, (h - 1) / high) <= min((w + 1) / wide, (h + 1) / high)


def understood(picture: MaskPicture, meaning: MaskMeaning, *, trunk_labels: Iterable[int] | None = None) -> TrunkMask:
    """The mask as the person says it is meant.

    Args:
        picture: The levels.
        meaning: See `MEANING_TITLES`.
        trunk_labels: With ``labels``: the levels that are trunks; None takes all but 0.

    Raises:
        ValueError: An unknown meaning.
    """
    if meaning == "labels":
        if trunk_labels is None:
            return TrunkMask(picture.levels, has_instances=True)
        chosen = np.zeros(65536, np.uint16)
        wanted = np.asarray(sorted(set(trunk_labels)), int)
        chosen[wanted[(wanted > 0) & (wanted < 65536)]] = 1
        return TrunkMask(picture.levels * chosen[picture.levels], has_instances=True)
    bright = picture.bright
    if meaning in ("trunk_bright", "trunk_dark"):
        return TrunkMask((bright if meaning == "trunk_bright" else ~bright).astype(np.uint16))
    if meaning in ("ignore_dark", "ignore_bright"):
        return TrunkMask(np.zeros(bright.shape, np.uint16), bright if meaning == "ignore_bright" else ~bright)
    raise ValueError(f"unknown meaning {meaning!r}; known: {', '.join(MEANINGS)}")


@dataclass(frozen=True)
class MeaningGuess:
    """What the masks look like; to be offered, never to be used unasked.

    Attributes:
        meaning: The likeliest.
        is_clear: Whether another meaning is improbable.
        why: What was seen, in plain words.
    """

    meaning: MaskMeaning
    is_clear: bool
    why: str


_SIDE = 64
# A picture's lowest quarter is the nadir and the walker, its highest third the sky.
_BOTTOM, _TOP = 48, 22


def guess_meaning(pictures: Sequence[MaskPicture]) -> MeaningGuess:
    """Guess from a few masks of one folder, by the share of the smaller side, where it lies, and whether it moves.

    Args:
        pictures: Three to ten masks, spread over the folder; more only take longer.
    """
    told = [picture for picture in pictures if picture.kind != "blank"]
    if not told:
        return MeaningGuess("trunk_bright", False, "The masks looked at have one level only, which tells nothing.")
    if sum(picture.kind == "labels" for picture in told) * 2 > len(told):
        numbers = max(len(np.unique(picture.levels)) - 1 for picture in told)
        return MeaningGuess(
            "labels", True, f"The masks have up to {numbers} numbers or colours besides the background."
        )
    bright = [_small(picture.bright) for picture in told]
    share = float(np.mean([field.mean() for field in bright]))
    side = "dark" if share > 0.5 else "bright"
    fields = [1.0 - field if side == "dark" else field for field in bright]
    percent = f"{100 * min(share, 1 - share):.0f} % of the pixels are {side}"
    reason = _reason_to_ignore(fields)
    if reason:
        meaning: MaskMeaning = "ignore_dark" if side == "dark" else "ignore_bright"
        return MeaningGuess(
            meaning, side == "dark", f"{percent}, {reason}, as in a mask made for structure from motion."
        )
    if side == "bright":
        return MeaningGuess("trunk_bright", share < 0.35, f"{percent}, in other places from photo to photo.")
    return MeaningGuess(
        "trunk_dark", False, f"{percent}, in other places from photo to photo; it may also be an SfM mask."
    )


def _reason_to_ignore(fields: list[NDArray[np.float64]]) -> str:
    """Why the smaller side is no trunks; empty where nothing says so."""
    total = sum(field.sum() for field in fields)
    if total <= 0:
        return ""
    if sum(field[_BOTTOM:].sum() for field in fields) > 0.6 * total:
        return "most of them at the bottom, where the camera's carrier is"
    if sum(field[:_TOP].sum() for field in fields) > 0.6 * total:
        return "most of them at the top, where the sky is"
    if len(fields) >= 3:
        always = np.min(fields, axis=0).sum() * len(fields)
        if always > 0.5 * total:
            return "nearly the same ones in every photo"
    return ""


def _small(mask: Bool) -> NDArray[np.float64]:
    """(64, 64) share of the pixels in each cell."""
    starts = [np.linspace(0, n, _SIDE, endpoint=False).astype(int) for n in mask.shape]
    sums = np.add.reduceat(np.add.reduceat(mask, starts[0], axis=0, dtype=np.int32), starts[1], axis=1)
    sides = [np.maximum(np.diff(start, append=n), 1) for start, n in zip(starts, mask.shape, strict=True)]
    return sums / np.outer(*sides)


def overlay(photo: UInt8, mask: TrunkMask, *, max_side_px: int = 1280, strength: float = 0.55) -> UInt8:
    """(h, w, 3) uint8 picture of the photo with its trunks in colours and what is ignored hatched in grey.

    Args:
        photo: (H, W, 3) uint8 RGB; the mask may have another size of the same aspect.
        mask: What to show.
        max_side_px: The longer side of the picture; photos are only made smaller.
        strength: Share of the colour in the mix, 0..1.

    Raises:
        ValueError: The mask is of another aspect than the photo.
    """
    height, width = photo.shape[:2]
    factor = min(1.0, max_side_px / max(height, width))
    size = max(round(width * factor), 1), max(round(height * factor), 1)
    if not same_aspect(mask.size, (width, height)):
        raise ValueError(f"a mask of {mask.size} pixels does not fit a photo of {(width, height)}")
    rows = ((np.arange(size[1]) + 0.5) * (height / size[1])).astype(int)
    columns = ((np.arange(size[0]) + 0.5) * (width / size[0])).astype(int)
    picture = photo[np.ix_(rows, columns)].astype(np.float32)
    rows_of_mask = ((np.arange(size[1]) + 0.5) * (mask.size[1] / size[1])).astype(int)
    columns_of_mask = ((np.arange(size[0]) + 0.5) * (mask.size[0] / size[0])).astype(int)
    labels = mask.labels[np.ix_(rows_of_mask, columns_of_mask)]
    on = labels > 0
    picture[on] = (1 - strength) * picture[on] + strength * colours_of(labels[on])
    picture[_outline(labels)] = 255.0
    if mask.ignored is not None:
        ignored = mask.ignored[np.ix_(rows_of_mask, columns_of_mask)]
        stripes = (np.add.outer(np.arange(size[1]), np.arange(size[0])) // 6) % 2 == 0
        picture[ignored] = 0.4 * picture[ignored] + 0.6 * np.where(stripes[ignored], 170, 60)[:, None]
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


def colours_of(numbers: NDArray[np.integer]) -> NDArray[np.float32]:
    """(N, 3) colours 0..255 of instance numbers; neighbours in number differ clearly."""
    hue = (np.asarray(numbers, np.float64) * 0.618033988749895) % 1.0
    phase = (hue[:, None] + np.array([0.0, 2 / 3, 1 / 3])) % 1.0
    return (255 * np.clip(2 - np.abs(6 * phase - 3) * 1.0, 0.1, 1.0)).astype(np.float32)


def _outline(labels: UInt16) -> Bool:
    """Pixels of a trunk whose right or lower neighbour is something else."""
    edge = np.zeros(labels.shape, bool)
    edge[:, :-1] |= labels[:, :-1] != labels[:, 1:]
    edge[:-1] |= labels[:-1] != labels[1:]
    return edge & (labels > 0)
