"""Mask pictures of every make, what they mean, and what is guessed of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from dbh_studio.errors import FileError, FileMissingError, UnsupportedFormatError
from dbh_studio.io.masks import (
    MEANING_TITLES,
    MEANINGS,
    TrunkMask,
    guess_meaning,
    overlay,
    read_mask_picture,
    same_aspect,
    understood,
)
from dbh_studio.io.masks.meaning import colours_of

DATA = Path(__file__).parents[2].parent / "shared" / "data"
HEIGHT, WIDTH = 120, 160
TRUNK = np.zeros((HEIGHT, WIDTH), bool)
TRUNK[20:110, 60:80] = True


def saved(path: Path, array: np.ndarray, **options: object) -> Path:
    Image.fromarray(array).save(path, **options)
    return path


def as_palette(index: np.ndarray, colours: list[int]) -> Image.Image:
    paletted = Image.fromarray(index.astype(np.uint8)).convert("P")
    paletted.putpalette(colours + [0] * (768 - len(colours)))
    return paletted


def of_every_make(folder: Path) -> dict[str, Path]:
    """The same trunk, bright, as the programs write it."""
    grey = np.where(TRUNK, 255, 0).astype(np.uint8)
    rgb = np.repeat(grey[..., None], 3, axis=2)
    opaque = np.full_like(grey, 255)
    paths = {
        "grey": saved(folder / "a.png", grey),
        "0/1": saved(folder / "b.png", (grey // 255).astype(np.uint8)),
        "one bit": saved(folder / "c.png", TRUNK),
        "rgb": saved(folder / "d.png", rgb),
        "rgba opaque": saved(folder / "e.png", np.dstack([rgb, opaque])),
        "16 bit": saved(folder / "f.png", grey.astype(np.uint16) * 257),
        "16 bit 0/1": saved(folder / "g.tif", TRUNK.astype(np.uint16)),
        "jpeg": saved(folder / "h.jpg", rgb, quality=80),
        "tiff": saved(folder / "i.tif", grey),
        "float": saved(folder / "j.tif", TRUNK.astype(np.float32)),
        "cut-out": saved(folder / "k.png", np.dstack([np.full((HEIGHT, WIDTH, 3), 90, np.uint8), grey])),
    }
    # White is number 0 in this palette: what is seen counts, not the number.
    picture = as_palette(np.where(TRUNK, 0, 1), [255, 255, 255, 0, 0, 0])
    paths["palette"] = folder / "l.png"
    picture.save(paths["palette"])
    return paths


MAKES = ["grey", "0/1", "one bit", "rgb", "rgba opaque", "16 bit", "16 bit 0/1", "jpeg", "tiff", "float", "cut-out"]
MAKES += ["palette"]


@pytest.mark.parametrize("make", MAKES)
def test_the_same_trunk_from_every_make(tmp_path, make):
    picture = read_mask_picture(of_every_make(tmp_path)[make])
    assert picture.kind == "binary"
    bright = understood(picture, "trunk_bright")
    if make == "jpeg":  # a pixel beside the edge may fall to either side
        assert np.mean((bright.labels > 0) != TRUNK) < 0.003
    else:
        assert np.array_equal(bright.labels, TRUNK)
        assert np.array_equal(understood(picture, "trunk_dark").labels, ~TRUNK)


def test_a_smoothed_edge_is_no_class(tmp_path):
    large = Image.fromarray(np.where(TRUNK, 255, 0).astype(np.uint8)).resize((311, 233), Image.Resampling.BICUBIC)
    large.save(tmp_path / "a.png")
    picture = read_mask_picture(tmp_path / "a.png")
    assert picture.kind == "binary"
    expected = np.asarray(large) > 127
    assert np.array_equal(understood(picture, "trunk_bright").labels > 0, expected)


def test_a_probability_is_soft_and_cut_at_half(tmp_path):
    ramp = np.tile(np.linspace(0, 255, WIDTH * 2), (HEIGHT, 1)).astype(np.uint8)
    picture = read_mask_picture(saved(tmp_path / "a.png", ramp))
    assert picture.kind == "soft"
    assert np.array_equal(understood(picture, "trunk_bright").labels > 0, ramp > 127.5)


@pytest.mark.parametrize("level", [0, 1, 255])
def test_one_level_only_is_all_or_nothing(tmp_path, level):
    picture = read_mask_picture(saved(tmp_path / "a.png", np.full((9, 9), level, np.uint8)))
    assert picture.kind == "blank"
    assert understood(picture, "trunk_bright").labels.all() == (level > 0)
    assert (understood(picture, "trunk_bright").labels == 0).all() == (level == 0)


@pytest.mark.parametrize("numbers", [(1, 2, 3), (7, 90, 200), (1, 2, 255), (300, 301, 40000), (1, 1000, 65535)])
def test_a_number_per_trunk(tmp_path, numbers):
    labels = np.zeros((HEIGHT, WIDTH), np.uint16 if max(numbers) > 255 else np.uint8)
    for column, number in zip((10, 60, 110), numbers, strict=True):
        labels[20:, column : column + 25] = number
    picture = read_mask_picture(saved(tmp_path / "a.png", labels))
    assert picture.kind == "labels"
    mask = understood(picture, "labels")
    assert mask.has_instances and np.array_equal(mask.labels, labels) and mask.numbers == numbers
    chosen = understood(picture, "labels", trunk_labels=numbers[1:])
    assert chosen.numbers == numbers[1:] and np.array_equal(chosen.labels > 0, np.isin(labels, numbers[1:]))


def test_hundreds_of_numbers_are_no_probability(tmp_path):
    numbers = np.random.default_rng(1).permutation(400).reshape(20, 20)
    labels = np.kron(numbers, np.ones((8, 8))).astype(np.uint16)
    assert read_mask_picture(saved(tmp_path / "a.png", labels)).kind == "labels"


def test_colours_are_numbered_with_black_as_nothing(tmp_path):
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    rgb[:, 20:40], rgb[:, 80:90], rgb[:, 120:] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    picture = read_mask_picture(saved(tmp_path / "a.png", rgb))
    assert (picture.kind, picture.channel) == ("labels", "colour")
    labels = understood(picture, "labels").labels
    # In the order of their values: blue, green, red.
    assert [labels[0, column] for column in (0, 130, 85, 30)] == [0, 1, 2, 3]


def test_a_colour_palette_keeps_its_numbers(tmp_path):
    index = np.zeros((HEIGHT, WIDTH), int)
    index[:, 20:40], index[:, 80:90] = 1, 15
    colours = np.random.default_rng(0).integers(0, 255, 48)
    colours[:3] = 0
    as_palette(index, colours.tolist()).save(tmp_path / "a.png")
    picture = read_mask_picture(tmp_path / "a.png")
    assert (picture.kind, picture.channel) == ("labels", "palette")
    assert np.array_equal(understood(picture, "labels").labels, index)


def test_a_photo_is_no_mask(tmp_path):
    photo = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    with pytest.raises(UnsupportedFormatError, match="photo"):
        read_mask_picture(saved(tmp_path / "a.png", photo))


def test_what_cannot_be_read_says_which_file(tmp_path):
    path = saved(tmp_path / "a.png", np.where(TRUNK, 255, 0).astype(np.uint8))
    path.write_bytes(path.read_bytes()[:150])
    with pytest.raises(FileError, match=r"a\.png"):
        read_mask_picture(path)
    with pytest.raises(FileMissingError):
        read_mask_picture(tmp_path / "b.png")
    (tmp_path / "c.png").write_bytes(b"")
    with pytest.raises(FileError):
        read_mask_picture(tmp_path / "c.png")
    with pytest.raises(FileError):
        read_mask_picture(saved(tmp_path / "d.tif", np.full((4, 4), -1.5, np.float32)))


def test_ignored_is_not_trunk(tmp_path):
    picture = read_mask_picture(saved(tmp_path / "a.png", np.where(TRUNK, 0, 255).astype(np.uint8)))
    mask = understood(picture, "ignore_dark")
    assert not mask.labels.any() and np.array_equal(mask.ignored, TRUNK)
    assert np.array_equal(understood(picture, "ignore_bright").ignored, ~TRUNK)
    with pytest.raises(ValueError):
        understood(picture, "white")
    assert set(MEANING_TITLES) == set(MEANINGS)


# --- size ---


@given(st.integers(1, 4000), st.integers(1, 4000), st.floats(0.1, 1.0))
def test_a_rounded_smaller_size_has_the_same_aspect(width, height, factor):
    smaller = max(round(width * factor), 1), max(round(height * factor), 1)
    assert same_aspect((width, height), smaller) and same_aspect(smaller, (width, height))


def test_another_aspect_is_refused():
    assert not same_aspect((2048, 1024), (2048, 1000))
    assert not same_aspect((2048, 1024), (1024, 2048))
    with pytest.raises(ValueError, match="none of"):
        TrunkMask(np.zeros((10, 20), np.uint16)).sized(20, 20)


def test_a_smaller_mask_is_scaled_by_whole_pixels():
    labels = np.arange(12, dtype=np.uint16).reshape(3, 4)
    mask = TrunkMask(labels, labels > 8, has_instances=True)
    large = mask.sized(8, 6)
    assert np.array_equal(large.labels, np.kron(labels, np.ones((2, 2))))
    assert np.array_equal(large.ignored, np.kron(labels > 8, np.ones((2, 2))))
    assert np.array_equal(large.sized(4, 3).labels, labels)
    assert mask.sized(4, 3) is mask


def test_masks_cannot_be_changed():
    mask = TrunkMask(np.zeros((3, 3), np.uint16))
    with pytest.raises(ValueError):
        mask.labels[0, 0] = 1
    with pytest.raises(ValueError):
        TrunkMask(np.zeros(3))
    with pytest.raises(ValueError):
        TrunkMask(np.zeros((3, 3)), ignored=np.zeros((2, 3), bool))


# --- guessing ---


def pictures_of(folder: Path, masks: list[np.ndarray]) -> list:
    paths = [saved(folder / f"{i}.png", np.where(mask, 255, 0).astype(np.uint8)) for i, mask in enumerate(masks)]
    return [read_mask_picture(path) for path in paths]


def trunks(seed: int) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    for left in np.random.default_rng(seed).integers(0, 150, 4):
        mask[25:95, left : left + 8] = True
    return mask


def test_trunks_bright_are_guessed(tmp_path):
    guess = guess_meaning(pictures_of(tmp_path, [trunks(i) for i in range(5)]))
    assert (guess.meaning, guess.is_clear) == ("trunk_bright", True)
    assert "bright" in guess.why


def test_trunks_dark_are_guessed_with_doubt(tmp_path):
    guess = guess_meaning(pictures_of(tmp_path, [~trunks(i) for i in range(5)]))
    assert (guess.meaning, guess.is_clear) == ("trunk_dark", False)


def operator() -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[100:, 50:110] = True
    return mask


def sky() -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:30] = True
    return mask


def pole() -> np.ndarray:
    return np.roll(TRUNK, 5, axis=1)


@pytest.mark.parametrize(("shape", "word"), [(operator, "bottom"), (sky, "top"), (pole, "every photo")])
def test_masks_for_structure_from_motion_are_not_taken_for_trunks(tmp_path, shape, word):
    guess = guess_meaning(pictures_of(tmp_path, [~shape() for _ in range(4)]))
    assert (guess.meaning, guess.is_clear) == ("ignore_dark", True)
    assert word in guess.why
    inverted = guess_meaning(pictures_of(tmp_path, [shape() for _ in range(4)]))
    assert (inverted.meaning, inverted.is_clear) == ("ignore_bright", False)


def test_blank_masks_tell_nothing(tmp_path):
    assert not guess_meaning(pictures_of(tmp_path, [np.ones((9, 9), bool)])).is_clear
    assert not guess_meaning([]).is_clear


# --- overlay ---


def test_the_overlay_colours_trunks_and_leaves_the_rest():
    photo = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
    labels = np.zeros((HEIGHT // 2, WIDTH // 2), np.uint16)
    labels[10:50, 30:40], labels[10:50, 60:70] = 1, 2
    ignored = np.zeros(labels.shape, bool)
    ignored[:, 75:] = True
    picture = overlay(photo, TrunkMask(labels, ignored, True))
    assert picture.shape == photo.shape
    assert (picture[:, :58] == 100).all() and (picture[HEIGHT // 2, 65] != 100).any()
    assert (picture[60, 65] != picture[60, 125]).any()
    # 40 % of the photo and 60 % of light or dark stripes.
    assert np.unique(picture[:, 152:]).tolist() == [76, 142]
    assert overlay(photo, TrunkMask(labels), max_side_px=40).shape == (30, 40, 3)
    with pytest.raises(ValueError):
        overlay(photo, TrunkMask(np.zeros((10, 10))))


def test_neighbouring_numbers_have_different_colours():
    colours = colours_of(np.arange(1, 12))
    assert np.abs(np.diff(colours, axis=0)).max(axis=1).min() > 60
    assert colours.min() >= 0 and colours.max() <= 255


# --- real files ---


def real(*parts: str) -> Path:
    path = DATA.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"shared/data/{'/'.join(parts)} is absent")
    return path


def test_a_real_trunk_mask():
    picture = read_mask_picture(real("aruco_photo", "trunk_mask.png"))
    assert (picture.kind, picture.size) == ("binary", (1440, 1920))
    assert guess_meaning([picture]).meaning == "trunk_bright"
    # 3,081,771 of 4 x 1440 x 1920 values are 255, alpha among them.
    assert understood(picture, "trunk_bright").labels.sum() == (3_081_771 - 1440 * 1920) / 3


def test_real_label_maps_and_the_operator():
    picture = read_mask_picture(real("synthetic_360", "masks", "frame_0000.png"))
    assert picture.kind == "labels" and guess_meaning([picture]).meaning == "labels"
    assert set(understood(picture, "labels", trunk_labels=range(1, 13)).numbers) <= set(range(1, 13))
    guess = guess_meaning([read_mask_picture(real("synthetic_360", "operator_mask.png"))])
    assert guess.meaning == "ignore_dark" and guess.is_clear


def test_real_structure_from_motion_masks():
    folder = real("sfm", "opensfm", "berlin", "masks")
    guess = guess_meaning([read_mask_picture(path) for path in sorted(folder.glob("*.png"))])
    assert not (guess.meaning == "trunk_bright" and guess.is_clear), guess
