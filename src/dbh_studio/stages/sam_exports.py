"""The exports of Segment Anything models that can be given boxes, known by the names of their inputs.

- ``sam-meta``: Meta's own script, samexporter and MobileSAM. One box per call, as two points with the labels 2 and 3.
- ``sam2``: SAM 2.1 of onnx-community, three embeddings. One box per call: how its graph takes several is not published.
- ``sam2x``: SAM 2 and 2.1 of samexporter. Many boxes per call, as points with the labels 2 and 3.

What another export makes of a box would be a mask of something else, without an error: others are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float32
from dbh_studio.errors import ModelError
from dbh_studio.io.models.manifest import Signature, Tensor
from dbh_studio.stages.onnx_runtime import Graph, not_of_family

Run: TypeAlias = Callable[[Mapping[str, NDArray[Any]]], dict[str, NDArray[Any]]]
Arrays: TypeAlias = Mapping[str, NDArray[Any]]

# Boxes in one call of a decoder that takes many: bounds the memory of its attention.
_BATCH = 16
_SAM2 = ("image_embeddings.0", "image_embeddings.1", "image_embeddings.2")
_SAM2X = ("image_embed", "high_res_feats_0", "high_res_feats_1")
_POINT_INPUTS = ("point_coords", "point_labels", "mask_input", "has_mask_input", "orig_im_size")


@dataclass(frozen=True)
class SamExport:
    """One way of being exported.

    Attributes:
        family: ``sam-meta``, ``sam2`` or ``sam2x``.
        side_px: Of the encoder's square.
        picture: Name of the encoder's input.
        takes_raw: Whether the encoder takes (H, W, 3) of 0..255 and normalises and pads inside.
        low_px: Side of the decoder's masks.
        per_box: Whether ``has_mask_input`` has one number for each box.
    """

    family: Literal["sam-meta", "sam2", "sam2x"]
    side_px: int
    picture: str
    takes_raw: bool
    low_px: int
    per_box: bool = True

    @property
    def is_squashed(self) -> bool:
        """Whether the picture is stretched over the square, rather than padded."""
        return self.family != "sam-meta"

    def inner_size(self, height_px: int, width_px: int) -> tuple[int, int]:
        """(height, width) of a picture within the encoder's square."""
        if self.is_squashed:
            return self.side_px, self.side_px
        factor = self.side_px / max(height_px, width_px)
        # Rounded as the models' authors do, half up.
        return max(int(height_px * factor + 0.5), 1), max(int(width_px * factor + 0.5), 1)

    def ask(self, run: Run, features: Arrays, boxes: Float32, size_px: tuple[int, int]) -> tuple[Float32, Float32]:
        """(N, K, h, w) logits and (N, K) scores of (N, 4) boxes in the encoder's square; see `Sam.low_masks`."""
        if not len(boxes):
            return np.zeros((0, 1, self.low_px, self.low_px), np.float32), np.zeros((0, 1), np.float32)
        many = _BATCH if self.family == "sam2x" else 1
        answers = [
            self._answer(run({**features, **self._prompt(boxes[first : first + many], size_px)}))
            for first in range(0, len(boxes), many)
        ]
        return np.concatenate([logits for logits, _ in answers]), np.concatenate([scores for _, scores in answers])

    def _prompt(self, boxes: Float32, size_px: tuple[int, int]) -> Arrays:
        n = len(boxes)
        if self.family == "sam2":
            return {
                "input_points": np.zeros((1, n, 0, 2), np.float32),
                "input_labels": np.zeros((1, n, 0), np.int64),
                "input_boxes": boxes[None],
            }
        return {
            "point_coords": boxes.reshape(n, 2, 2),
            "point_labels": np.tile(np.array([2.0, 3.0], np.float32), (n, 1)),
            "mask_input": np.zeros((n, 1, self.low_px, self.low_px), np.float32),
            "has_mask_input": np.zeros(n if self.per_box else 1, np.float32),
            "orig_im_size": np.array(size_px, np.float32),
        }

    def _answer(self, found: Arrays) -> tuple[Float32, Float32]:
        if self.family == "sam2":
            return found["pred_masks"][0], found["iou_scores"][0]
        if self.family == "sam2x":
            return found["masks"], found["iou_predictions"]
        logits, scores = found["low_res_masks"], found["iou_predictions"]
        if logits.shape[1] == 4:
            # The first is for prompts of a single point; the authors' own code never takes it for a box.
            logits, scores = logits[:, 1:], scores[:, 1:]
        return logits, scores


def export_of(encoder: Graph, decoder: Graph) -> SamExport:
    """Which export two graphs are.

    Raises:
        ModelError: They are none that is known, do not belong together, or take no boxes.
    """
    names = decoder.inputs
    if "image_embed" in names:
        return _sam2x(encoder, decoder)
    if "point_coords" in names:
        return _meta(encoder, decoder)
    if "input_boxes" in names and _SAM2[0] in names:
        return _sam2(encoder, decoder)
    if "input_points" in names and "input_boxes" not in names:
        raise ModelError(
            f"{decoder.path.name} takes points only, and trunks are given to it as boxes.",
            "Use MobileSAM or SAM 2.1, which take boxes: `dbh-studio models list`.",
        )
    known = "point_coords and image_embeddings (MobileSAM, SAM), image_embed (SAM 2), input_boxes and " + _SAM2[0]
    shown = ", ".join(names) or "none"
    raise not_of_family(decoder, [f"its inputs are {shown}, and known are {known} (SAM 2.1)"], "a mask decoder")


def _meta(encoder: Graph, decoder: Graph) -> SamExport:
    picture = _picture_of(encoder)
    takes_raw = len(encoder.inputs[picture].shape) == 3
    side = 1024 if takes_raw else _side_of(encoder, picture)
    cells = side // 16
    wanted = Signature(
        "sam-meta",
        (
            Tensor("image_embeddings", "float", (1, None, cells, cells)),
            Tensor("point_coords", "float", (1, None, 2)),
            Tensor("point_labels", "float", (1, None)),
            Tensor("mask_input", "float", (1, 1, 4 * cells, 4 * cells)),
            Tensor("has_mask_input", "float", (1,)),
            Tensor("orig_im_size", "float", (2,)),
        ),
        (
            Tensor("low_res_masks", "float", (None, None, 4 * cells, 4 * cells)),
            Tensor("iou_predictions", "float", (None, None)),
        ),
    )
    _check(encoder, decoder, wanted, ("image_embeddings",))
    return SamExport("sam-meta", side, picture, takes_raw, 4 * cells)


def _sam2(encoder: Graph, decoder: Graph) -> SamExport:
    picture = _picture_of(encoder)
    side = _side_of(encoder, picture)
    embeddings = tuple(
        Tensor(name, "float", (1, None, side // part, side // part))
        for name, part in zip(_SAM2, (4, 8, 16), strict=True)
    )
    wanted = Signature(
        "sam2",
        (
            Tensor("input_points", "float", (1, None, None, 2)),
            Tensor("input_labels", "int64", (1, None, None)),
            Tensor("input_boxes", "float", (1, None, 4)),
            *embeddings,
        ),
        (
            Tensor("pred_masks", "float", (None, None, None, side // 4, side // 4)),
            Tensor("iou_scores", "float", (None, None, None)),
        ),
    )
    _check(encoder, decoder, wanted, _SAM2)
    return SamExport("sam2", side, picture, False, side // 4)


def _sam2x(encoder: Graph, decoder: Graph) -> SamExport:
    picture = _picture_of(encoder)
    side = _side_of(encoder, picture)
    declared = decoder.inputs["has_mask_input"].shape if "has_mask_input" in decoder.inputs else ()
    inputs = [
        Tensor(name, "float", (1, None, side // part, side // part))
        for name, part in zip(_SAM2X, (16, 4, 8), strict=True)
    ]
    inputs += [Tensor("point_coords", "float", (None, None, 2)), Tensor("point_labels", "float", (None, None))]
    inputs += [
        Tensor("mask_input", "float", (None, 1, side // 4, side // 4)),
        Tensor("has_mask_input", "float", (None,)),
    ]
    if "orig_im_size" in decoder.inputs:
        inputs.append(Tensor("orig_im_size", decoder.inputs["orig_im_size"].dtype, (2,)))
    wanted = Signature(
        "sam2x",
        tuple(inputs),
        (
            Tensor("masks", "float", (None, None, None, None)),
            Tensor("iou_predictions", "float", (None, None)),
        ),
    )
    _check(encoder, decoder, wanted, _SAM2X)
    return SamExport("sam2x", side, picture, False, side // 4, per_box=declared != (1,))


def _check(encoder: Graph, decoder: Graph, wanted: Signature, embeddings: tuple[str, ...]) -> None:
    problems = decoder.problems(wanted)
    if problems:
        raise not_of_family(decoder, problems, f"a {wanted.name} mask decoder")
    missing = [name for name in embeddings if name not in encoder.outputs]
    if missing:
        shown = ", ".join(encoder.outputs)
        problem = f"it does not give {', '.join(missing)}, which {decoder.path.name} asks for (it gives {shown})"
        raise not_of_family(encoder, [problem], "the encoder of these two")
    for name in embeddings:
        given, asked = encoder.outputs[name].shape, decoder.inputs[name].shape
        known = [(a, b) for a, b in zip(given, asked, strict=False) if a is not None and b is not None]
        if len(given) == len(asked) and any(a != b for a, b in known):
            problem = f"its {name} is {given}, and {decoder.path.name} takes {asked}"
            raise not_of_family(encoder, [problem], "the encoder of these two")


def _picture_of(encoder: Graph) -> str:
    """Name of the one input."""
    if len(encoder.inputs) != 1:
        shown = ", ".join(encoder.inputs) or "none"
        raise not_of_family(encoder, [f"it takes {shown}, and one picture is expected"], "an image encoder")
    (picture,) = encoder.inputs
    shape = encoder.inputs[picture].shape
    if not (len(shape) == 4 and shape[1] == 3) and not (len(shape) == 3 and shape[2] == 3):
        problem = f"its input is {shape}, and (1, 3, side, side) or (height, width, 3) is expected"
        raise not_of_family(encoder, [problem], "an image encoder")
    return picture


def _side_of(encoder: Graph, picture: str) -> int:
    """Side of the square picture, which the graph must fix: a size it was not made for gives wrong masks."""
    shape = encoder.inputs[picture].shape
    height, width = shape[2:] if len(shape) == 4 else (None, None)
    if height is None or height != width or height % 16:
        shown = " x ".join("?" if length is None else str(length) for length in shape)
        raise not_of_family(
            encoder, [f"its picture is {shown}, and 1 x 3 x side x side is expected, a fixed square"], "this encoder"
        )
    return height
