"""A plot whose panoramas really show its stems, in brown, and models of a few kilobytes that find what is brown."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from tests import onnx_graphs
from tests.drawn_trunks import BLUE, BROWN, GREEN
from tests.maskplot import MaskPlot, labels, photos, write_mask_plot

from dbh_studio.io.models import ModelStore


def write_make_plot(folder: Path, *, unit_m: float = 1.0) -> MaskPlot:
    """As `write_mask_plot`, with photos of stems and pole instead of plain ones."""
    from PIL import Image

    made = write_mask_plot(folder, unit_m=unit_m)
    for photo in photos():
        shown = labels()[photo.name] > 0
        picture = np.empty((*shown.shape, 3), np.uint8)
        picture[: len(shown) // 2], picture[len(shown) // 2 :] = BLUE, GREEN
        picture[shown] = BROWN
        Image.fromarray(picture).save(folder / "images" / photo.name, quality=95)
    return made


def write_graphs(folder: Path) -> Path:
    """The files of the usual pair of models."""
    folder.mkdir(parents=True, exist_ok=True)
    onnx_graphs.vocabulary(folder / "vocab.txt")
    onnx_graphs.detector(folder / "model.onnx")
    onnx_graphs.meta_encoder(folder / "encoder.onnx", raw=True)
    onnx_graphs.meta_decoder(folder / "decoder.onnx")
    return folder


def fill_store(store: ModelStore, graphs: Path, *, detector: bool = True) -> ModelStore:
    """Put them into a store, under the names of the public models."""
    store.add([graphs / "encoder.onnx", graphs / "decoder.onnx"], name="mobile-sam")
    if detector:
        store.add([graphs / "vocab.txt"], name="bert-uncased-vocabulary")
        store.add([graphs / "model.onnx"], name="grounding-dino-tiny")
    return store


def copied(plot: MaskPlot, folder: Path) -> MaskPlot:
    """The same plot elsewhere, to be changed."""
    shutil.copytree(plot.folder, folder)
    return MaskPlot(folder, plot.unit_m)
