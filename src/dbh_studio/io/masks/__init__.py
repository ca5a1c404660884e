"""Masks of the photos: made elsewhere, or kept beside the plot."""

from __future__ import annotations

from dbh_studio.io.masks.coco import CocoImage, CocoMasks, read_coco
from dbh_studio.io.masks.match import MASK_STYLES, STYLE_TITLES, MaskMatch, find_masks
from dbh_studio.io.masks.meaning import (
    MEANING_TITLES,
    MEANINGS,
    MaskMeaning,
    MeaningGuess,
    TrunkMask,
    guess_meaning,
    overlay,
    same_aspect,
    understood,
)
from dbh_studio.io.masks.picture import MaskPicture, read_mask_picture
from dbh_studio.io.masks.store import MaskRecipe, MaskStore, Review, StoredMask

__all__ = [
    "MASK_STYLES",
    "MEANINGS",
    "MEANING_TITLES",
    "STYLE_TITLES",
    "CocoImage",
    "CocoMasks",
    "MaskMatch",
    "MaskMeaning",
    "MaskPicture",
    "MaskRecipe",
    "MaskStore",
    "MeaningGuess",
    "Review",
    "StoredMask",
    "TrunkMask",
    "find_masks",
    "guess_meaning",
    "overlay",
    "read_coco",
    "read_mask_picture",
    "same_aspect",
    "understood",
]
