"""Finding the photos: moved, renamed, resized, turned, damaged, missing."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import pytest
from PIL import Image

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import FileMissingError
from dbh_studio.io.photos import open_picture
from dbh_studio.io.posed import find_images, read_posed_images

WIDTH, HEIGHT = 80, 60


def posed_images(*names: str) -> PosedImages:
    camera = CameraModel("PINHOLE", WIDTH, HEIGHT, (60.0, 60.0, 40.0, 30.0))
    return PosedImages(tuple(PosedImage(name, camera, Similarity.identity()) for name in names))


def save(path: Path, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size).save(path)
    return path


@pytest.mark.parametrize(
    "name,file,is_renamed",
    [
        ("a.jpg", "a.jpg", False),
        ("day/a.jpg", "day/a.jpg", False),
        ("day/a.jpg", "a.jpg", True),
        ("a.jpg", "deep/er/a.jpg", True),
        ("C:/photos/day/a.jpg", "other/a.jpg", True),
        ("A.JPG", "a.jpg", True),
        ("a.tif", "a.png", True),
        ("a", "a.jpg", True),
        ("plot.001", "plot.001.jpg", True),
    ],
)
def test_safe_matches(tmp_path, name, file, is_renamed):
    path = save(tmp_path / file)
    save(tmp_path / "unrelated.jpg")
    match = find_images(posed_images(name), tmp_path)
    assert [image.path for image in match.found] == [str(path)]
    assert match.missing == () and match.wrong_size == {}
    assert dict(match.renamed) == ({name: str(path)} if is_renamed else {})


def test_the_same_name_in_two_folders_goes_by_the_folder(tmp_path):
    """Numbers of cameras repeat; what the name's own folder says decides."""
    for day in ("day1", "day2"):
        save(tmp_path / "copied" / day / "a.jpg")
    match = find_images(posed_images("x/day1/a.jpg", "x/day2/a.jpg"), tmp_path)
    assert {image.name: Path(image.path).parent.name for image in match.found} == {
        "x/day1/a.jpg": "day1",
        "x/day2/a.jpg": "day2",
    }


def test_a_guess_is_not_made(tmp_path):
    for day in ("day1", "day2"):
        save(tmp_path / day / "a.jpg")
    match = find_images(posed_images("a.jpg"), tmp_path)
    assert match.found == () and match.missing == ("a.jpg",) and dict(match.ambiguous) == {"a.jpg": 2}


def test_one_file_is_not_given_to_two_cameras(tmp_path):
    save(tmp_path / "a.jpg")
    match = find_images(posed_images("day1/a.jpg", "day2/a.jpg"), tmp_path)
    assert match.found == () and set(match.missing) == {"day1/a.jpg", "day2/a.jpg"}


def test_an_exact_name_comes_before_a_like_one(tmp_path):
    save(tmp_path / "a.jpg")
    save(tmp_path / "a.png")
    match = find_images(posed_images("a.jpg", "a.tif"), tmp_path)
    assert {image.name: Path(image.path).name for image in match.found} == {"a.jpg": "a.jpg", "a.tif": "a.png"}


def test_masks_under_the_same_name_are_not_the_photos(tmp_path):
    photo = save(tmp_path / "images/a.png")
    for folder in ("masks", "depth", "Thumbnails", ".hidden"):
        save(tmp_path / folder / "a.png")
    save(tmp_path / "images/a.png.png")
    assert [image.path for image in find_images(posed_images("a"), tmp_path).found] == [str(photo)]


def test_several_folders(tmp_path):
    save(tmp_path / "one/a.jpg")
    save(tmp_path / "two/b.jpg")
    match = find_images(posed_images("a.jpg", "b.jpg", "c.jpg"), [tmp_path / "one", tmp_path / "two"])
    assert len(match.found) == 2 and match.missing == ("c.jpg",) and match.renamed == {}


def test_a_resized_photo_gets_a_scaled_camera(tmp_path):
    save(tmp_path / "a.jpg", (2 * WIDTH, 2 * HEIGHT))
    match = find_images(posed_images("a.jpg"), tmp_path)
    camera = match.found[0].camera
    assert (camera.width_px, camera.height_px) == (160, 120) and camera.params == (120.0, 120.0, 80.0, 60.0)
    assert dict(match.resized) == {"a.jpg": (160, 120)}
    assert any("scaled" in note for note in match.notes())


@pytest.mark.parametrize("size,reason", [((HEIGHT, WIDTH), "turned"), ((WIDTH, HEIGHT - 20), "cropped")])
def test_another_aspect_is_an_error_entry(tmp_path, size, reason):
    save(tmp_path / "a.jpg", size)
    match = find_images(posed_images("a.jpg"), tmp_path)
    assert match.found == () and match.missing == ()
    assert reason in match.wrong_size["a.jpg"] and f"{size[0]} x {size[1]}" in match.wrong_size["a.jpg"]


def test_a_photo_marked_as_turned_keeps_its_stored_size(tmp_path):
    """EXIF says how to show it; poses belong to the pixels as stored."""
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "a.jpg", exif=exif)
    assert len(find_images(posed_images("a.jpg"), tmp_path).found) == 1


@pytest.mark.parametrize("content", [b"", b"no picture", b"\xff\xd8\xff\xe0"])
def test_a_damaged_photo_is_an_error_entry(tmp_path, content):
    (tmp_path / "a.jpg").write_bytes(content)
    match = find_images(posed_images("a.jpg"), tmp_path)
    assert match.found == () and "damaged" in match.wrong_size["a.jpg"]


def test_a_missing_folder_is_an_error(tmp_path):
    with pytest.raises(FileMissingError, match="no such folder"):
        find_images(posed_images("a.jpg"), tmp_path / "none")


def test_names_do_not_lead_out_of_the_folder(tmp_path):
    save(tmp_path / "secret.jpg")
    (tmp_path / "photos").mkdir()
    match = find_images(posed_images("../secret.jpg", "", "/"), tmp_path / "photos")
    assert match.found == ()


def test_applied_to_keeps_order_and_says_what_is_missing(tmp_path):
    save(tmp_path / "b.jpg")
    posed = posed_images("a.jpg", "b.jpg", "c.jpg")
    applied = find_images(posed, tmp_path).applied_to(posed)
    assert [image.name for image in applied] == ["a.jpg", "b.jpg", "c.jpg"]
    assert [image.path is not None for image in applied] == [False, True, False]
    assert any("2 photos were not found: a.jpg, c.jpg" in note for note in applied.notes)


HEADER = "name,width,height,model,params,qw,qx,qy,qz,tx,ty,tz\n"
ROW = "{},80,60,PINHOLE,60 60 40 30,1,0,0,0,0,0,0\n"


@pytest.mark.parametrize("place", ["sparse/0", "", "a/b"])
def test_photos_beside_the_reconstruction_are_found(tmp_path, place):
    path = tmp_path / place / "poses.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(HEADER + ROW.format("a.jpg") + ROW.format("b.jpg"))
    save(tmp_path / "images/a.jpg")
    posed = read_posed_images(path)
    assert [image.path and Path(image.path).name for image in posed] == ["a.jpg", None]
    assert any("b.jpg" in note for note in posed.notes)


def test_the_folder_said_is_the_folder_used(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text(HEADER + ROW.format("a.jpg"))
    save(tmp_path / "images/a.jpg")
    chosen = save(tmp_path / "elsewhere/a.jpg")
    assert read_posed_images(path, images_dir=chosen.parent).images[0].path == str(chosen)


@pytest.mark.parametrize("name", ["nothing.json", "none/at/all"])
def test_what_is_not_there_is_said(tmp_path, name):
    with pytest.raises(FileMissingError, match="no such file"):
        read_posed_images(tmp_path / name)


def test_a_very_large_panorama_is_a_photo(tmp_path):
    """More than Pillow takes for an attack; only its header is read, and Pillow's own limit stays for others."""
    limit = Image.MAX_IMAGE_PIXELS
    width, height = 24_000, 12_000
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header)) + struct.pack(">I", 1 << 20)
    path = tmp_path / "large.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunks + b"IDAT" + bytes(64))
    camera = CameraModel("EQUIRECTANGULAR", width, height, ())
    match = find_images(PosedImages((PosedImage("large.png", camera, Similarity.identity()),)), tmp_path)
    assert [image.path for image in match.found] == [str(path)] and match.wrong_size == {}
    with open_picture(path) as picture:
        assert picture.size == (width, height)
    assert limit == Image.MAX_IMAGE_PIXELS
