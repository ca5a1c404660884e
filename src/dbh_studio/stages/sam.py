"""The Segment Anything models in onnxruntime: the outline of what stands in a box.

An encoder looks at the picture once, a decoder then answers for every box. The exports that are about differ in what
they take; each is known by the names of its inputs (`sam_exports`). Boxes are x0, y0, x1, y1 in pixels of the picture
given, (0, 0) its outer top-left corner.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, Float, Float32, UInt8, as_points
from dbh_studio.errors import ModelError
from dbh_studio.settings import ModelRunSettings
from dbh_studio.stages.onnx_runtime import Graph
from dbh_studio.stages.pictures import normalised, resized
from dbh_studio.stages.sam_exports import SamExport, export_of


@dataclass(frozen=True, eq=False)
class Encoded:
    """A picture the encoder has looked at.

    Attributes:
        features: What the encoder gave, by name.
        size_px: (height, width) of the picture.
        inner_px: (height, width) of the picture within the encoder's square.
    """

    features: Mapping[str, NDArray[Any]]
    size_px: tuple[int, int]
    inner_px: tuple[int, int]


class Sam:
    """A box-prompted segmenter.

    Args:
        encoder: The graph that looks at the picture.
        decoder: The graph that answers for boxes.

    Attributes:
        export: Which export they are.
        side_px: Of the encoder's square.

    Raises:
        ModelError: They are no export that is known, do not belong together, or take no boxes.
    """

    def __init__(self, encoder: Graph, decoder: Graph) -> None:
        self.export: SamExport = export_of(encoder, decoder)
        self.side_px = self.export.side_px
        self._encoder, self._decoder = encoder, decoder

    @classmethod
    def open(cls, paths: Mapping[str, Path], run: ModelRunSettings = ModelRunSettings()) -> Sam:  # noqa: B008 - frozen
        """Open the files ``encoder`` and ``decoder``, as `ModelStore.paths` gives them.

        Raises:
            FileError: A file is missing or not what it should be.
            MissingComponentError: onnxruntime is not there, or cannot do what is asked.
            ModelError: As for the class.
        """
        return cls(Graph(paths["encoder"], run), Graph(paths["decoder"], run))

    @property
    def notes(self) -> tuple[str, ...]:
        """What the person should know of how the graphs run."""
        return self._encoder.notes + self._decoder.notes

    def prepare(self, rgb: UInt8) -> tuple[Float32, tuple[int, int]]:
        """A picture as the encoder takes it, and its (height, width) within the encoder's square.

        Args:
            rgb: (H, W, 3) uint8.
        """
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or 0 in rgb.shape:
            raise ValueError(f"a picture has shape {rgb.shape} and type {rgb.dtype} but (H, W, 3) uint8 is needed")
        height, width = self.export.inner_size(rgb.shape[0], rgb.shape[1])
        small = resized(rgb, width, height)
        if self.export.takes_raw:
            return small.astype(np.float32), (height, width)
        pixels = np.zeros((1, 3, self.side_px, self.side_px), np.float32)
        # Padding is 0 after the normalisation, not black before it.
        pixels[0, :, :height, :width] = normalised(small)
        return pixels, (height, width)

    def encode(self, rgb: UInt8) -> Encoded:
        """Look at a picture once, for any number of boxes.

        Args:
            rgb: (H, W, 3) uint8.

        Raises:
            ModelError: The graph failed.
        """
        pixels, inner = self.prepare(rgb)
        features = self._encoder.run({self.export.picture: pixels})
        return Encoded(features, (rgb.shape[0], rgb.shape[1]), inner)

    def low_masks(self, encoded: Encoded, boxes_px: Float) -> tuple[Float32, Float32]:
        """What the decoder says.

        Args:
            encoded: From `encode`.
            boxes_px: (N, 4).

        Returns:
            (N, K, h, w) logits of K guesses at each box; (N, K) how well the decoder thinks each fits (IoU).

        Raises:
            ModelError: The graph failed, or gives no numbers.
        """
        boxes = as_points(boxes_px, name="boxes_px", n_columns=4)
        scale = np.array(encoded.inner_px[::-1]) / np.array(encoded.size_px[::-1])
        inner = (boxes * np.tile(scale, 2)).astype(np.float32)
        logits, scores = self.export.ask(self._decoder.run, encoded.features, inner, encoded.size_px)
        if not (np.isfinite(logits).all() and np.isfinite(scores).all()):
            raise ModelError(
                "The segmenter gives no numbers for a picture.",
                "Half precision does not suit this computer: choose the model in full precision (float32).",
            )
        return logits, scores

    def segment(self, encoded: Encoded, boxes_px: Float, *, threshold: float = 0.5) -> Iterator[tuple[Bool, float]]:
        """Box by box the best guess: (H, W) what is in it, and how well the decoder thinks it fits, 0..1.

        Args:
            encoded: From `encode`.
            boxes_px: (N, 4).
            threshold: Probability above which a pixel belongs to it.

        Raises:
            ModelError: The graph failed, or gives no numbers.
        """
        level = np.log(threshold / (1.0 - threshold))
        logits, scores = self.low_masks(encoded, boxes_px)
        best = scores.argmax(axis=1)
        for row, guess in enumerate(best):
            yield self.enlarged(logits[row, guess], encoded) > level, float(np.clip(scores[row, guess], 0.0, 1.0))

    def enlarged(self, logits: Float32, encoded: Encoded) -> Float32:
        """(H, W) logits at the picture's size, of (h, w): bilinear, in the two steps of the reference.

        Args:
            logits: One guess, as the decoder gives it.
            encoded: The picture it is about.
        """
        import cv2

        height, width = encoded.size_px
        whole = np.ascontiguousarray(logits, np.float32)
        if not self.export.is_squashed:
            side = self.side_px
            square = cv2.resize(whole, (side, side), interpolation=cv2.INTER_LINEAR)
            whole = np.ascontiguousarray(square[: encoded.inner_px[0], : encoded.inner_px[1]])
        return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
