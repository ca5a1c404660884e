"""Grounding DINO in onnxruntime: boxes of what a text names in a picture.

What happens before and after the graph is done here as transformers does it, with numpy and Pillow; `tests/parity`
holds every step to it. Boxes are x0, y0, x1, y1 in pixels of the picture given, (0, 0) its outer top-left corner.

The public graphs are traced at one size, 800 x 800. Exports that call the sides open run at other sizes too and give
boxes that are wrong; they are refused, and the size is the one the graph declares. They are also traced with a prompt
of one phrase, and of several they mask all but the first wrongly, so a prompt of several is asked phrase by phrase.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, Float32, Float64, Int64, UInt8, readonly
from dbh_studio.errors import ModelError, SettingError
from dbh_studio.io.models.manifest import Signature, Tensor
from dbh_studio.settings import MaskDetectorSettings, ModelRunSettings
from dbh_studio.stages.onnx_runtime import Graph, not_of_family
from dbh_studio.stages.pictures import fitting_size, normalised, resized
from dbh_studio.stages.wordpiece import WordPiece, phrase_masks, phrases_of, read_vocabulary

_FAMILY = "Grounding DINO"
# Swin halves the picture five times; what is not divisible is padded inside, but no public graph is such.
_MIN_SIDE_PX = 64
_MOST_TOKENS = 256


@dataclass(frozen=True, eq=False)
class Detections:
    """Boxes, the surest first.

    Attributes:
        boxes_px: (N, 4) x0, y0, x1, y1, within the picture.
        scores: (N,) 0..1.
        phrases: The words of the prompt each box is said to show.
    """

    boxes_px: Float64
    scores: Float32
    phrases: tuple[str, ...]

    def __post_init__(self) -> None:
        n = len(self.boxes_px)
        if self.boxes_px.shape != (n, 4) or self.scores.shape != (n,) or len(self.phrases) != n:
            raise ValueError(f"{self.boxes_px.shape} boxes, {self.scores.shape} scores, {len(self.phrases)} phrases")
        object.__setattr__(self, "boxes_px", readonly(self.boxes_px))
        object.__setattr__(self, "scores", readonly(self.scores))

    def __len__(self) -> int:
        return len(self.boxes_px)

    def kept(self, rows: Bool | Int64) -> Detections:
        """Those of the given rows."""
        index = np.arange(len(self))[rows]
        return Detections(self.boxes_px[index], self.scores[index], tuple(self.phrases[i] for i in index))


class GroundingDino:
    """A text-prompted detector.

    Args:
        graph: Of the family's signature: pixel_values, input_ids, attention_mask and, where it has them, pixel_mask,
            token_type_ids, position_ids and text_token_mask; logits and pred_boxes.
        words: The tokenizer.
        phrases_together: Whether the graph is right for several phrases at once; None where only its signature tells:
            those that are given the text masks are.
        traced_px: (height, width) the graph was traced at, where that is known although it leaves the sides open: of a
            published file, known by its hash. At that size, and no other, such a graph is right.

    Attributes:
        size_px: (height, width) of the picture the graph takes.

    Raises:
        ModelError: The graph is of another family, or would give wrong boxes.
    """

    def __init__(
        self,
        graph: Graph,
        words: WordPiece,
        *,
        phrases_together: bool | None = None,
        traced_px: tuple[int, int] | None = None,
    ) -> None:
        self.graph, self._words = graph, words
        self.size_px = _checked_size(graph, traced_px)
        self._length = graph.inputs["input_ids"].shape[1]
        together = "text_token_mask" in graph.inputs
        self._phrases_together = together if phrases_together is None else phrases_together

    @classmethod
    def open(
        cls,
        paths: Mapping[str, Path],
        run: ModelRunSettings = ModelRunSettings(),  # noqa: B008 - frozen
        *,
        phrases_together: bool | None = None,
        traced_px: tuple[int, int] | None = None,
    ) -> GroundingDino:
        """Open the files ``model`` and ``vocabulary``, as `ModelStore.paths` gives them.

        Raises:
            FileError: A file is missing or not what it should be.
            MissingComponentError: onnxruntime is not there, or cannot do what is asked.
            ModelError: The graph is of another family, or would give wrong boxes.
        """
        words = read_vocabulary(paths["vocabulary"])
        graph = Graph(paths["model"], run)
        return cls(graph, words, phrases_together=phrases_together, traced_px=traced_px)

    def detect(self, rgb: UInt8, settings: MaskDetectorSettings = MaskDetectorSettings()) -> Detections:  # noqa: B008
        """Find what the prompt names.

        Args:
            rgb: (H, W, 3) uint8.
            settings: Prompt, thresholds and which boxes are left out.

        Returns:
            Without boxes that are the same, too wide or too thin, by the settings.

        Raises:
            SettingError: The prompt is empty or too long.
            ModelError: The graph failed, or gives no numbers.
        """
        phrases = phrases_of(settings.prompt)
        prompts = (" ".join(phrases),) if self._phrases_together else phrases
        pixels, mask = self.prepare(rgb, settings.picture_shape)
        found = [self._ask(rgb, pixels, mask, prompt, settings) for prompt in prompts]
        together = Detections(
            np.concatenate([part.boxes_px for part in found]),
            np.concatenate([part.scores for part in found]),
            tuple(phrase for part in found for phrase in part.phrases),
        )
        height, width = rgb.shape[:2]
        wanted = is_of_trunk_size(together.boxes_px, width, height, self.shrink(rgb, settings.picture_shape), settings)
        together = together.kept(wanted)
        return together.kept(unlike_boxes(together.boxes_px, together.scores, settings.box_overlap))

    def shrink(self, rgb: UInt8, shape: str) -> Float64:
        """(2,) pixels of the graph's picture per pixel of the given one, across and down."""
        height, width = self._fitted(rgb, shape)
        return np.array([width / rgb.shape[1], height / rgb.shape[0]])

    def prepare(self, rgb: UInt8, shape: str = "padded") -> tuple[Float32, Int64]:
        """A picture as the graph takes it.

        Args:
            rgb: (H, W, 3) uint8.
            shape: ``padded`` or ``squashed``.

        Returns:
            (1, 3, h, w) normalised, 0 in the padding; (1, h, w) 1 where the picture is.
        """
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or 0 in rgb.shape:
            raise ValueError(f"a picture has shape {rgb.shape} and type {rgb.dtype} but (H, W, 3) uint8 is needed")
        height, width = self._fitted(rgb, shape)
        pixels = np.zeros((1, 3, *self.size_px), np.float32)
        mask = np.zeros((1, *self.size_px), np.int64)
        pixels[0, :, :height, :width] = normalised(resized(rgb, width, height))
        mask[0, :height, :width] = 1
        return pixels, mask

    def read(self, prompt: str) -> dict[str, NDArray[Any]]:
        """A prompt as the graph takes it: inputs by name, more than some graphs ask for.

        Raises:
            SettingError: It is too long.
        """
        tokens = self._words.encode(prompt)
        longest = self._length or _MOST_TOKENS
        if len(tokens) > longest:
            raise SettingError(f"The prompt has {len(tokens)} words and signs.", f"At most {longest} can be read.")
        attention = np.ones(len(tokens), np.int64)
        together, places = phrase_masks(tokens, self._words.separators)
        spare = 0 if self._length is None else self._length - len(tokens)
        together = np.pad(together, (0, spare))
        np.fill_diagonal(together, 1)  # a token that may look at nothing gives no number
        return {
            "input_ids": np.pad(tokens, (0, spare), constant_values=self._words.padding)[None],
            "token_type_ids": np.zeros((1, len(tokens) + spare), np.int64),
            "attention_mask": np.pad(attention, (0, spare))[None],
            "position_ids": np.pad(places, (0, spare))[None],
            "text_token_mask": together[None],
        }

    def answer(self, pixels: Float32, mask: Int64, text: Mapping[str, NDArray[Any]]) -> tuple[Float32, Float32]:
        """What the graph says: (Q, L) logits of the prompt's tokens, (Q, 4) boxes as shares cx, cy, w, h.

        Raises:
            ModelError: The graph failed, or gives no numbers.
        """
        found = self.graph.run({"pixel_values": pixels, "pixel_mask": mask, **text})
        n_tokens = int(text["attention_mask"].sum())
        logits, boxes = found["logits"][0, :, :n_tokens], found["pred_boxes"][0]
        # Minus infinity is what tokens that are not asked about get; NaN is half precision overflowing.
        if np.isnan(logits).any() or not np.isfinite(boxes).all():
            raise ModelError(
                f"{self.graph.path.name} gives no numbers for a picture.",
                "Half precision does not suit this computer: choose the model in full precision (float32).",
            )
        return logits, boxes

    def _fitted(self, rgb: UInt8, shape: str) -> tuple[int, int]:
        """(height, width) of the picture within the graph's."""
        return self.size_px if shape == "squashed" else fitting_size(rgb.shape[0], rgb.shape[1], *self.size_px)

    def _ask(self, rgb: UInt8, pixels: Float32, mask: Int64, prompt: str, settings: MaskDetectorSettings) -> Detections:
        text = self.read(prompt)
        logits, shares = self.answer(pixels, mask, text)
        tokens = text["input_ids"][0, : logits.shape[1]]
        probability = 1.0 / (1.0 + np.exp(-np.clip(logits.astype(np.float64), -80.0, 80.0)))
        scores = probability.max(axis=1)
        rows = np.flatnonzero(scores > settings.box_threshold)
        rows = rows[np.argsort(-scores[rows], kind="stable")]
        said = probability[rows] > settings.text_threshold
        phrases = tuple(self._words.text(tokens[words]) for words in said)
        height, width = rgb.shape[:2]
        # With padding the graph's shares are of the picture without it.
        boxes = corners(shares[rows].astype(np.float64)) * [width, height, width, height]
        return Detections(np.clip(boxes, 0.0, [width, height, width, height]), scores[rows].astype(np.float32), phrases)


def corners(boxes: Float64) -> Float64:
    """(N, 4) x0, y0, x1, y1 of (N, 4) centre and size."""
    half = boxes[:, 2:] / 2.0
    return np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)


def is_of_trunk_size(
    boxes_px: Float64, width_px: int, height_px: int, shrink: Float64, settings: MaskDetectorSettings
) -> Bool:
    """(N,) which boxes are neither the whole picture nor a hair.

    Args:
        boxes_px: (N, 4).
        width_px: Of the picture.
        height_px: Of the picture.
        shrink: (2,) pixels the detector saw per pixel of the picture.
        settings: The bounds.
    """
    size = boxes_px[:, 2:] - boxes_px[:, :2]
    # A near trunk may fill most of the height, or much of the width, but hardly both.
    is_all = (size[:, 0] > settings.max_box_share * width_px) | (
        size.prod(axis=1) > settings.max_box_share * width_px * height_px
    )
    return np.asarray(~is_all & ((size * shrink) >= settings.min_box_px).all(axis=1))


def unlike_boxes(boxes_px: Float64, scores: Float32, overlap: float) -> Int64:
    """Rows of the boxes kept, the surest first: of those that overlap more than `overlap` (IoU), the surest.

    Args:
        boxes_px: (N, 4).
        scores: (N,).
        overlap: 1 keeps all.
    """
    waiting = np.argsort(-scores, kind="stable")
    area = np.prod(boxes_px[:, 2:] - boxes_px[:, :2], axis=1)
    kept = []
    while len(waiting):
        first, waiting = int(waiting[0]), waiting[1:]
        kept.append(first)
        low = np.maximum(boxes_px[waiting, :2], boxes_px[first, :2])
        high = np.minimum(boxes_px[waiting, 2:], boxes_px[first, 2:])
        shared = np.clip(high - low, 0.0, None).prod(axis=1)
        waiting = waiting[shared <= overlap * (area[waiting] + area[first] - shared)]
    return np.array(kept, np.int64)


def _checked_size(graph: Graph, traced_px: tuple[int, int] | None) -> tuple[int, int]:
    """(height, width) the graph is made for."""
    pixels = graph.inputs.get("pixel_values")
    if pixels is None or len(pixels.shape) != 4:
        shown = ", ".join(graph.inputs) or "none"
        raise not_of_family(graph, [f"it has no input pixel_values of a picture (its inputs are {shown})"], _FAMILY)
    height, width = pixels.shape[2:]
    is_open = height is None or width is None
    assumed = (height or 800, width or 800) if traced_px is None else traced_px
    # Every length the graph leaves open stays so, but the sides must be known: see the module.
    known = {
        "pixel_values": Tensor("pixel_values", "float", (1, 3, *assumed), is_fixed=traced_px is None),
        "pixel_mask": Tensor("pixel_mask", "int64", (1, *assumed)),
        "input_ids": Tensor("input_ids", "int64", (1, None)),
        "attention_mask": Tensor("attention_mask", "int64", (1, None)),
        "token_type_ids": Tensor("token_type_ids", "int64", (1, None)),
        "position_ids": Tensor("position_ids", "int64", (1, None)),
        "text_token_mask": Tensor("text_token_mask", "bool", (1, None, None)),
    }
    needed = ("pixel_values", "input_ids", "attention_mask")
    inputs = tuple(tensor for name, tensor in known.items() if name in needed or name in graph.inputs)
    outputs = (Tensor("logits", "float", (1, None, None)), Tensor("pred_boxes", "float", (1, None, 4)))
    problems = graph.problems(Signature(_FAMILY, inputs, outputs))
    if problems:
        raise not_of_family(graph, problems, _FAMILY)
    assert traced_px is not None or not is_open  # that they are fixed was among what was asked
    if min(assumed) < _MIN_SIDE_PX:
        raise not_of_family(graph, [f"its pictures have {assumed[1]} x {assumed[0]} pixels"], _FAMILY)
    return assumed
