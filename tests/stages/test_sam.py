"""The segmenter: every export that is known outlines the same, and others are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests import onnx_graphs
from tests.drawn_trunks import BLUE, BROWN, iou
from tests.io import tinymodels

from dbh_studio.errors import FileMissingError, ModelError
from dbh_studio.stages.onnx_runtime import Graph
from dbh_studio.stages.sam import Sam

EXPORTS = {
    "MobileSAM": ("sam-meta", "raw.onnx", "four.onnx"),
    "one guess": ("sam-meta", "raw.onnx", "one.onnx"),
    "SAM": ("sam-meta", "normalised.onnx", "four.onnx"),
    "SAM 2.1": ("sam2", "vision_encoder.onnx", "prompt_encoder_mask_decoder.onnx"),
    "samexporter": ("sam2x", "sam2x_encoder.onnx", "sam2x_decoder.onnx"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("graphs")
    onnx_graphs.meta_encoder(path / "raw.onnx", raw=True)
    onnx_graphs.meta_encoder(path / "normalised.onnx", raw=False)
    onnx_graphs.meta_decoder(path / "four.onnx")
    onnx_graphs.meta_decoder(path / "one.onnx", guesses=1)
    onnx_graphs.sam2x(path)
    tinymodels.sam2(path)
    return path


def opened(folder: Path, name: str) -> Sam:
    _, encoder, decoder = EXPORTS[name]
    return Sam.open({"encoder": folder / encoder, "decoder": folder / decoder})


def drawn(width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A picture of 18 leaning trunks, (18, 4) their boxes, (18, H, W) where they are."""
    rgb = np.empty((height, width, 3), np.uint8)
    rgb[:] = BLUE
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    masks = []
    for i in range(18):
        middle = (i + 0.5) / 18 + 0.008 * (y - 0.5)
        masks.append((np.abs(x - middle) < 0.014) & (y > 0.05 * (i % 4)) & (y < 1 - 0.04 * (i % 5)))
        rgb[masks[-1]] = BROWN
    boxes = []
    for mask in masks:
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        boxes.append([columns[0] - 1, rows[0] - 1, columns[-1] + 2, rows[-1] + 2])
    return rgb, np.array(boxes, np.float64), np.stack(masks)


@pytest.mark.parametrize("name", EXPORTS)
@pytest.mark.parametrize("size", [(1024, 1024), (1500, 900), (700, 1100)])
def test_masks_are_what_is_in_the_boxes(folder: Path, name: str, size: tuple[int, int]) -> None:
    sam = opened(folder, name)
    assert sam.export.family == EXPORTS[name][0]
    assert sam.side_px == 1024
    rgb, boxes, truth = drawn(*size)
    found = list(sam.segment(sam.encode(rgb), boxes))
    assert len(found) == 18
    for (mask, score), wanted in zip(found, truth, strict=True):
        assert mask.shape == rgb.shape[:2]
        assert iou(mask, wanted) > 0.8
        # The guess that calls itself best of those that are meant for boxes.
        assert score in (pytest.approx(0.9), pytest.approx(0.8))


@pytest.mark.parametrize("name", EXPORTS)
def test_no_boxes_no_masks(folder: Path, name: str) -> None:
    sam = opened(folder, name)
    encoded = sam.encode(drawn(300, 200)[0])
    assert list(sam.segment(encoded, np.zeros((0, 4)))) == []
    with pytest.raises(ValueError, match=r"\(N, 4\)"):
        list(sam.segment(encoded, np.zeros((2, 3))))


def test_the_threshold_moves_the_outline(folder: Path) -> None:
    sam = opened(folder, "MobileSAM")
    rgb, boxes, _ = drawn(1024, 1024)
    encoded = sam.encode(rgb)
    sizes = [sum(mask.sum() for mask, _ in sam.segment(encoded, boxes, threshold=t)) for t in (0.4, 0.5, 0.6)]
    assert sizes[0] > sizes[1] > sizes[2] > 0


def test_many_boxes_are_asked_in_few_calls(folder: Path) -> None:
    rgb, boxes, _ = drawn(600, 600)
    asked: list[int] = []

    class Listening(Graph):
        def run(self, feed: dict) -> dict:
            asked.append(len(feed["point_coords"]))
            return super().run(feed)

    sam = Sam(Graph(folder / "sam2x_encoder.onnx"), Listening(folder / "sam2x_decoder.onnx"))
    assert len(list(sam.segment(sam.encode(rgb), np.tile(boxes, (2, 1))))) == 36
    assert asked == [16, 16, 4]


def test_padding_is_on_the_right_and_below(folder: Path) -> None:
    sam = opened(folder, "SAM")
    pixels, inner = sam.prepare(np.full((300, 600, 3), 255, np.uint8))
    assert inner == (512, 1024)
    assert (pixels[0, :, :512] > 2).all()
    assert not pixels[0, :, 512:].any()
    raw, inner = opened(folder, "MobileSAM").prepare(np.full((600, 301, 3), 255, np.uint8))
    assert raw.shape == (1024, 514, 3)
    assert inner == (1024, 514)
    assert raw.max() == 255
    squashed, inner = opened(folder, "SAM 2.1").prepare(np.full((300, 600, 3), 255, np.uint8))
    assert inner == (1024, 1024)
    assert (squashed > 2).all()
    with pytest.raises(ValueError, match="uint8"):
        sam.prepare(np.zeros((10, 10), np.uint8))


def test_no_numbers_are_an_error(folder: Path) -> None:
    class Overflowing(Graph):
        def run(self, feed: dict) -> dict:
            return {name: np.full_like(value, np.nan) for name, value in super().run(feed).items()}

    sam = Sam(Graph(folder / "raw.onnx"), Overflowing(folder / "four.onnx"))
    rgb, boxes, _ = drawn(300, 200)
    with pytest.raises(ModelError, match="float32"):
        list(sam.segment(sam.encode(rgb), boxes))


def test_other_exports_are_refused(folder: Path, tmp_path: Path) -> None:
    def refused(encoder: Path, decoder: Path) -> str:
        with pytest.raises(ModelError) as caught:
            Sam.open({"encoder": encoder, "decoder": decoder})
        return str(caught.value)

    points = onnx_graphs.points_only(tmp_path / "points.onnx")
    assert "takes points only" in refused(folder / "normalised.onnx", points)
    # Two models' halves.
    assert "? x ? x 3" in refused(folder / "raw.onnx", folder / "prompt_encoder_mask_decoder.onnx")
    message = refused(folder / "normalised.onnx", folder / "prompt_encoder_mask_decoder.onnx")
    assert "does not give image_embeddings.0" in message
    assert "one picture is expected" in refused(folder / "four.onnx", folder / "four.onnx")
    detector = onnx_graphs.detector(tmp_path / "dino.onnx")
    message = refused(folder / "raw.onnx", detector)
    assert "point_coords" in message
    assert "input_ids" in message
    half = onnx_graphs.meta_decoder(tmp_path / "half.onnx", without="has_mask_input")
    assert "no input has_mask_input" in refused(folder / "raw.onnx", half)
    small = onnx_graphs.meta_encoder(tmp_path / "small.onnx", raw=False, side=512)
    assert "64" in refused(small, folder / "four.onnx")
    open_sides = onnx_graphs.meta_encoder(tmp_path / "open.onnx", raw=False, side="any")
    assert "fixed square" in refused(open_sides, folder / "four.onnx")
    with pytest.raises(FileMissingError):
        Sam.open({"encoder": tmp_path / "none.onnx", "decoder": folder / "four.onnx"})
