"""A photo read no larger than it is needed."""

import numpy as np
import pytest
from PIL import Image

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import MalformedFileError
from dbh_studio.io.photos import read_photo


def photo(path, width=1600, height=800):
    camera = CameraModel("EQUIRECTANGULAR", width, height, ())
    return PosedImage(path.name, camera, Similarity.identity(), str(path))


@pytest.fixture(params=["jpg", "png"])
def path(request, tmp_path):
    rows, columns = np.indices((800, 1600))
    picture = np.stack([columns / 8, rows / 4, np.full(rows.shape, 90)], axis=2).astype(np.uint8)
    Image.fromarray(picture).save(tmp_path / f"a.{request.param}", quality=95)
    return tmp_path / f"a.{request.param}"


@pytest.mark.parametrize(
    ("least", "width"), [(1600, 1600), (801, 1600), (800, 800), (399, 400), (1, 200), (9999, 1600)]
)
def test_it_is_halved_as_often_as_it_may(path, least, width):
    pixels = read_photo(photo(path), least_width_px=least)
    assert pixels.shape == (width // 2, width, 3)
    whole = read_photo(photo(path)).astype(float)
    step = 1600 // width
    mean = whole.reshape(width // 2, step, width, step, 3).mean(axis=(1, 3))
    assert np.abs(pixels - mean).max() < 6


def test_the_shape_of_the_whole_photo_is_what_counts(path):
    with pytest.raises(MalformedFileError):
        read_photo(photo(path, 1600, 900), least_width_px=200)
