"""The plot of `tests.maskplot` in the studio: panoramas with brown trunks, and tiny models that find what is brown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tests import maskplot, onnx_graphs

from dbh_studio.app import commands
from dbh_studio.app.cameras import cloud_sample, read_cameras
from dbh_studio.app.document import CameraSource
from dbh_studio.app.opening import open_plot
from dbh_studio.app.session import Session
from dbh_studio.io.models import ModelStore

BROWN, GREEN = (92, 66, 43), (90, 120, 80)


def write(folder: Path) -> maskplot.MaskPlot:
    """The plot, its photos as brown as the tiny models want the stems."""
    made = maskplot.write_mask_plot(folder)
    for name, labels in maskplot.labels().items():
        picture = np.where(labels[:, :, None] > 0, BROWN, GREEN).astype(np.uint8)
        Image.fromarray(picture).save(folder / "images" / name, quality=95)
    return made


def write_forest(folder: Path) -> maskplot.MaskPlot:
    """As `write`, with photos that look a little like a forest."""
    made, rng = write(folder), np.random.default_rng(5)
    for name, labels in maskplot.labels().items():
        height, width = labels.shape
        v, u = np.indices((height, width), dtype=float)
        grain = rng.normal(0.0, 1.0, (height, width, 1)) * np.where(v > height / 2, 9.0, 2.0)[:, :, None]
        sky = np.stack([200 - 30 * v / height, 214 - 20 * v / height, 228 - 8 * v / height], axis=2)
        far = np.array([74.0, 96.0, 60.0]) + 14 * np.sin(u / 7.0 + 9 * np.sin(u / 31.0))[:, :, None]
        ground = np.array([112.0, 98.0, 58.0]) + 12 * np.sin(u / 23.0 + v / 11.0)[:, :, None]
        picture = np.where((v > 0.5 * height)[:, :, None], ground, np.where((v > 0.41 * height)[:, :, None], far, sky))
        bark = np.array([104.0, 80.0, 58.0]) + 16 * np.sin(u / 1.3 + np.sin(v / 9.0))[:, :, None]
        picture = np.where((labels > 0)[:, :, None], bark, picture) + grain
        Image.fromarray(np.clip(picture, 0, 255).astype(np.uint8)).save(folder / "images" / name, quality=95)
    return made


def open_session(plot: maskplot.MaskPlot, project_dir: Path) -> Session:
    """The plot, scaled, with its photos."""
    session = open_plot(plot.cloud, project_dir=project_dir, scale=plot.unit_m)
    if session.document.cameras is None:
        session.do(commands.set_cameras(CameraSource.of(plot.poses, plot.folder / "images")))
    session.remember_cameras(read_cameras(session.document.cameras, cloud_sample(session.cloud)))
    return session


def tiny_models(folder: Path, *, detector: bool) -> ModelStore:
    """A segmenter, and a detector if wanted, of the published signatures."""
    folder.mkdir()
    onnx_graphs.vocabulary(folder / "vocab.txt")
    onnx_graphs.detector(folder / "model.onnx")
    onnx_graphs.meta_encoder(folder / "encoder.onnx", raw=True)
    onnx_graphs.meta_decoder(folder / "decoder.onnx")
    store = ModelStore(folder=folder / "models", offline=True)
    store.add([folder / "encoder.onnx", folder / "decoder.onnx"], name="mobile-sam")
    if detector:
        store.add([folder / "model.onnx"], name="grounding-dino-tiny")
        store.add([folder / "vocab.txt"], name="bert-uncased-vocabulary")
    return store


def calls(client: Any, action: str) -> list[str]:
    """The scripts that called the photo in the page."""
    return [script for script in list(client.javascript) if script.startswith(f"dbhPhoto.{action}(")]
