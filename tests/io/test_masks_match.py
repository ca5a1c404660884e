"""Which mask belongs to which photo: naming styles, folders, ambiguity, sizes; and COCO files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import (
    EmptyFileError,
    FileError,
    FileMissingError,
    MalformedFileError,
    SettingError,
    TruncatedFileError,
)
from dbh_studio.io.masks import find_masks, read_coco
from dbh_studio.io.masks.match import mask_name
from dbh_studio.io.masks.rle import encode_counts, encode_text

WIDTH, HEIGHT = 80, 60
NAMES = ("a/img_1.JPG", "a/img_2.JPG", "b/img_1.JPG")


def photos(*names: str) -> PosedImages:
    camera = CameraModel("PINHOLE", WIDTH, HEIGHT, (60.0, 60.0, 40.0, 30.0))
    return PosedImages(tuple(PosedImage(name, camera, Similarity.identity()) for name in names))


def save(path: Path, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", size).save(path)
    return path


@pytest.mark.parametrize(
    ("style", "files"),
    [
        ("colmap", ["a/img_1.JPG.png", "a/img_2.JPG.png", "b/img_1.JPG.png"]),
        ("suffix", ["a/img_1_mask.png", "a/img_2_mask.png", "b/img_1_mask.png"]),
        ("suffix", ["a/img_1_mask.JPG", "a/img_2_mask.JPG", "b/img_1_mask.JPG"]),
        ("dotted", ["a/img_1.mask.tif", "a/img_2.mask.tif", "b/img_1.mask.tif"]),
        ("same", ["a/img_1.png", "a/img_2.png", "b/img_1.png"]),
    ],
)
def test_the_style_is_recognised_and_folders_are_kept_apart(tmp_path, style, files):
    for file in files:
        save(tmp_path / "masks" / file)
    for where in (tmp_path / "masks", tmp_path):
        match = find_masks(photos(*NAMES), where)
        assert match.style == style and not match.missing and not match.n_unused
        assert [match.found[name] for name in NAMES] == [tmp_path / "masks" / file for file in files]


def test_open_drone_map_masks_beside_their_photos(tmp_path):
    """And the photos are not their own masks."""
    posed = photos("img_1.JPG", "img_2.JPG")
    for image in posed:
        save(tmp_path / image.name)
        save(tmp_path / image.name.replace(".JPG", "_mask.JPG"))
    for images in (posed, PosedImages(tuple(replace(i, path=str(tmp_path / i.name)) for i in posed))):
        match = find_masks(images, tmp_path)
        assert match.style == "suffix" and match.found["img_2.JPG"].name == "img_2_mask.JPG"


def test_photos_are_never_taken_for_masks(tmp_path):
    posed = photos("img_1.png", "img_2.png")
    for image in posed:
        save(tmp_path / image.name)
    assert not find_masks(posed, tmp_path).found
    known = PosedImages(tuple(replace(image, path=str(tmp_path / image.name)) for image in posed))
    assert not find_masks(known, tmp_path).found
    # Under the same names in a folder of their own they are the masks.
    for image in posed:
        save(tmp_path / "segmentation" / image.name)
    for images in (posed, known):
        assert find_masks(images, tmp_path).found["img_1.png"] == tmp_path / "segmentation" / "img_1.png"


def test_what_is_missing_wrong_or_unclear_is_listed(tmp_path):
    save(tmp_path / "img_1.JPG.png", (40, 30))
    save(tmp_path / "img_2.JPG.png", (40, 36))
    save(tmp_path / "img_3.JPG.png", (60, 80))
    (tmp_path / "img_4.JPG.png").write_bytes(b"no picture")
    save(tmp_path / "x" / "img_6.JPG.png")
    save(tmp_path / "y" / "img_6.JPG.png")
    save(tmp_path / "other.png")
    names = [f"img_{i}.JPG" for i in range(1, 7)]
    match = find_masks(photos(*names), tmp_path)
    assert set(match.found) == {"img_1.JPG"}  # smaller, of the same aspect
    assert set(match.wrong_size) == {"img_2.JPG", "img_3.JPG", "img_4.JPG"}
    assert "turned" in match.wrong_size["img_3.JPG"] and "turned" not in match.wrong_size["img_2.JPG"]
    assert match.missing == ("img_5.JPG", "img_6.JPG") and match.ambiguous == {"img_6.JPG": 2}
    assert match.n_unused == 3
    notes = " ".join(match.notes())
    assert "1 of 6 photos" in notes and "img_5.JPG" in notes and "several" in notes and "cannot be used" in notes


def test_photos_that_differ_in_their_extension_do_not_share_a_mask(tmp_path):
    save(tmp_path / "img_mask.png")
    match = find_masks(photos("img.jpg", "img.tif"), tmp_path)
    assert not match.found and len(match.missing) == 2


def test_a_template_in_either_language(tmp_path):
    save(tmp_path / "IMG_1_segm.png")
    for template in ("{filename}_segm.png", "{stem}_segm.png", "{stem}_segm.tif"):
        match = find_masks(photos("img_1.jpg"), tmp_path, template=template)
        assert match.style == "template" and match.renamed
    for template in ("mask.png", "{nobody}.png", "{stem"):
        with pytest.raises(SettingError):
            find_masks(photos("img_1.jpg"), tmp_path, template=template)
    with pytest.raises(SettingError, match="colmap"):
        find_masks(photos("img_1.jpg"), tmp_path, style="colmpa")


def test_one_mask_for_all_photos(tmp_path):
    path = save(tmp_path / "operator.png", (160, 120))
    match = find_masks(photos(*NAMES), path)
    assert match.style == "one" and set(match.found.values()) == {path} and len(match.found) == 3
    assert find_masks(photos(*NAMES), save(tmp_path / "b.png", (160, 160))).wrong_size


def test_a_label_is_no_extension():
    assert mask_name("{stem}_mask.png", "plot.001") == "plot.001_mask.png"
    assert mask_name("{path}.png", "a/b.jpg") == "a/b.jpg.png"


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(FileMissingError):
        find_masks(photos("a.jpg"), tmp_path / "nowhere")


def test_real_masks_of_opensfm():
    data = Path(__file__).parents[2].parent / "shared" / "data" / "sfm" / "opensfm" / "berlin"
    if not data.exists():
        pytest.skip("shared/data/sfm/opensfm/berlin is absent")
    names = [path.name.removesuffix(".png") for path in sorted((data / "masks").glob("*.png"))]
    with Image.open(data / "masks" / f"{names[0]}.png") as picture:
        width, height = picture.size
    camera = CameraModel("PINHOLE", width, height, (width, width, width / 2, height / 2))
    posed = PosedImages(tuple(PosedImage(name, camera, Similarity.identity()) for name in names))
    match = find_masks(posed, data)
    assert match.style == "colmap" and len(match.found) == len(names) == 3


# --- COCO ---

BOX = np.zeros((HEIGHT, WIDTH), bool)
BOX[10:50, 20:30] = True
SMALL = np.zeros((HEIGHT, WIDTH), bool)
SMALL[20:30, 25:28] = True


def coco_file(folder: Path, annotations: list[dict], **changes: object) -> Path:
    data = {
        "images": [
            {"id": 7, "file_name": "a/img_1.JPG", "width": WIDTH, "height": HEIGHT},
            {"id": 8, "file_name": "a/img_2.JPG", "width": WIDTH, "height": HEIGHT},
        ],
        "categories": [{"id": 1, "name": "Tree-Trunk"}, {"id": 2, "name": "sky"}],
        "annotations": [{"id": i, "image_id": 7, "category_id": 1, **a} for i, a in enumerate(annotations)],
        **changes,
    }
    path = folder / "c.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    return path


def compressed(mask: np.ndarray) -> dict:
    return {"size": [HEIGHT, WIDTH], "counts": encode_text(encode_counts(mask))}


def test_polygons_and_both_run_lengths_are_the_same(tmp_path):
    forms = [
        {"segmentation": [[20, 10, 30, 10, 30, 50, 20, 50]]},
        {"segmentation": {"size": [HEIGHT, WIDTH], "counts": encode_counts(BOX).tolist()}},
        {"segmentation": compressed(BOX)},
    ]
    for form in forms:
        coco = read_coco(coco_file(tmp_path, [form]))
        mask = coco.mask("a/img_1.JPG")
        assert np.array_equal(mask.labels, BOX) and mask.has_instances and mask.ignored is None
    assert coco.likely_trunks() == (1,) and coco.counts == {1: 1, 2: 0}
    # Looked at, and no trunk there: that is a mask too.
    assert not coco.mask("a/img_2.JPG").labels.any()


def test_instances_stay_apart_and_the_smaller_lies_on_top(tmp_path):
    path = coco_file(
        tmp_path,
        [
            {"segmentation": compressed(SMALL), "score": 0.5},
            {"segmentation": compressed(BOX), "score": 0.9},
            {"segmentation": compressed(~BOX), "category_id": 2},
            {"segmentation": compressed(~BOX), "iscrowd": 1},
            {"bbox": [0, 0, 5, 5]},
        ],
    )
    mask = read_coco(path).mask("a/img_1.JPG")
    assert mask.numbers == (1, 2) and mask.scores == {1: 0.9, 2: 0.5}
    assert np.array_equal(mask.labels == 2, SMALL) and np.array_equal(mask.labels == 1, BOX & ~SMALL)
    assert np.array_equal(mask.ignored, ~BOX)
    assert np.array_equal(read_coco(path).mask("a/img_1.JPG", [2]).labels, ~BOX)


def test_coco_photos_are_matched_by_name(tmp_path):
    coco = read_coco(coco_file(tmp_path, [{"segmentation": compressed(BOX)}]))
    match = coco.match(photos("IMG_1.jpg", "a/img_2.JPG", "img_9.JPG"))
    assert {name: path.as_posix() for name, path in match.found.items()} == {
        "IMG_1.jpg": "a/img_1.JPG",
        "a/img_2.JPG": "a/img_2.JPG",
    }
    assert match.missing == ("img_9.JPG",) and match.notes()
    windows = coco_file(
        tmp_path,
        [{"segmentation": compressed(BOX)}],
        images=[{"id": 7, "file_name": "a\\img_1.JPG", "width": WIDTH, "height": HEIGHT}],
    )
    coco = read_coco(windows)
    match = coco.match(photos(*NAMES))
    assert set(match.found) == {"a/img_1.JPG"}
    assert coco.mask(str(match.found["a/img_1.JPG"])).labels.any()


def test_coco_masks_of_another_aspect_are_not_used(tmp_path):
    images = [{"id": 7, "file_name": "a/img_1.JPG", "width": WIDTH, "height": HEIGHT + 9}]
    coco = read_coco(coco_file(tmp_path, [{"segmentation": [[0, 0, 9, 0, 9, 9]]}], images=images))
    assert set(coco.match(photos(*NAMES)).wrong_size) == {"a/img_1.JPG"}


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["tree", "trunk"], [1]),
        (["Baumstamm", "Krone"], [0]),
        (["tree", "person"], [0]),
        (["street"], [0]),
        (["person", "street"], []),
    ],
)
def test_trunk_categories_are_offered_by_name(tmp_path, names, expected):
    categories = [{"id": i, "name": name} for i, name in enumerate(names)]
    path = coco_file(tmp_path, [{"segmentation": compressed(BOX), "category_id": 0}], categories=categories)
    assert list(read_coco(path).likely_trunks()) == expected


@pytest.mark.parametrize(
    "segmentation",
    [
        [[1, 2, 3]],
        [["x", 1, 2, 3, 4, 5]],
        {"size": [HEIGHT, WIDTH + 1], "counts": [HEIGHT * (WIDTH + 1)]},
        {"size": [HEIGHT, WIDTH], "counts": [5, 5]},
        {"size": [HEIGHT, WIDTH], "counts": "Q"},
        {"size": [HEIGHT, WIDTH]},
        {"size": 4, "counts": [1]},
        3,
    ],
)
def test_a_damaged_annotation_is_named(tmp_path, segmentation):
    coco = read_coco(coco_file(tmp_path, [{"segmentation": segmentation}]))
    with pytest.raises(MalformedFileError, match=r"annotation 0 of a/img_1\.JPG"):
        coco.mask("a/img_1.JPG")


def test_what_is_no_coco_file(tmp_path):
    path = tmp_path / "c.json"
    with pytest.raises(FileMissingError):
        read_coco(path)
    for text, error in [
        ('{"images": [', TruncatedFileError),
        ("[" * 100_000, TruncatedFileError),
        ("[]", MalformedFileError),
        ('{"images": 3}', MalformedFileError),
        ('{"images": [{"id": 1}]}', MalformedFileError),
        ('{"images": [{"id": 1, "file_name": "a", "width": 9, "height": -9}]}', MalformedFileError),
        ('{"images": [3]}', MalformedFileError),
        ('{"images": [], "annotations": [{"image_id": 4, "segmentation": [[1]]}]}', MalformedFileError),
        ('{"images": []}', EmptyFileError),
    ]:
        path.write_text(text)
        with pytest.raises(error):
            read_coco(path)
    with pytest.raises(FileError):
        read_coco(tmp_path)
