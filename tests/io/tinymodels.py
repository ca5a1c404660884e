"""Graphs of a few kilobytes with the signatures of the public models, which really find what is brown.

The detector looks at the columns of the picture: a box is good where its columns are brown and those beside it are not.
The segmenters give a mask of what is brown within the box.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

F, I = TensorProto.FLOAT, TensorProto.INT64  # noqa: E741
MEAN, STD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
BROWN = np.array([92.0, 66.0, 43.0])
WORDS = ["[PAD]", "[CLS]", "[SEP]", "[UNK]", ".", "tree", "trunk", "##s"]
N_BINS = 40


class Graph:
    """Nodes and constants under names that nobody needs to invent."""

    def __init__(self) -> None:
        self.nodes: list = []
        self.constants: list = []

    def constant(self, value: object, dtype: object = np.float32) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def ints(self, *values: int) -> str:
        return self.constant(values, np.int64)

    def op(self, kind: str, *inputs: str, out: str = "", **attributes: object) -> str:
        out = out or f"t{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [out], **attributes))
        return out

    def unused(self, *names: str) -> str:
        """A zero that depends on these inputs, so that the graph keeps them."""
        total = self.constant(0.0)
        for name in names:
            flat = self.op("Cast", self.op("ReduceSum", name, keepdims=0), to=F)
            total = self.op("Add", total, self.op("Mul", flat, self.constant(0.0)))
        return total

    def save(self, path: Path, inputs: list, outputs: list) -> Path:
        sides = [[helper.make_tensor_value_info(*value) for value in side] for side in (inputs, outputs)]
        graph = helper.make_graph(self.nodes, "tiny", *sides, self.constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        onnx.checker.check_model(model)
        path.parent.mkdir(parents=True, exist_ok=True)
        onnx.save(model, str(path))
        return path


def brownness(graph: Graph, pixels: str, *, raw: bool = False) -> str:
    """(1, 1, H, W) 1 where (1, 3, H, W) pixels are brown, 0 elsewhere."""
    reference = BROWN if raw else (BROWN / 255 - MEAN) / STD
    scale = 60.0 if raw else 60.0 / 255 / 0.225
    away = graph.op("Sub", pixels, graph.constant(reference.reshape(1, 3, 1, 1)))
    square = graph.op("ReduceSum", graph.op("Mul", away, away), graph.ints(1), keepdims=1)
    return graph.op("Cast", graph.op("Less", square, graph.constant(scale**2)), to=F)


def detector(path: Path, *, side: int | str = 800, seed: int | None = None) -> Path:
    """Grounding DINO's signature; `seed` makes one that answers at random."""
    graph = Graph()
    boxes, weights = [], []
    for first in range(1, N_BINS - 1):
        for width in range(1, min(8, N_BINS - first - 1)):
            inside = np.zeros(N_BINS)
            inside[first : first + width] = 1 / width
            inside[[first - 1, first + width]] -= 0.5
            # Of boxes as good as each other the wider one, so that a trunk is one box.
            weights.append(inside * (1 + 0.01 * width))
            boxes.append([(first + width / 2) / N_BINS, 0.4, width / N_BINS, 0.8])
    if seed is not None:
        weights = list(np.random.default_rng(seed).normal(0, 1, (len(weights), N_BINS)))
    pool = 800 // N_BINS
    brown = brownness(graph, "pixel_values")
    column = graph.op("AveragePool", brown, kernel_shape=[400, pool], strides=[400, pool])
    column = graph.op("Slice", column, graph.ints(0), graph.ints(1), graph.ints(2))
    values = graph.op("Reshape", column, graph.ints(1, N_BINS))
    score = graph.op("MatMul", values, graph.constant(np.array(weights).T))
    logit = graph.op("Sub", graph.op("Mul", score, graph.constant(8.0)), graph.constant(5.0))
    logit = graph.op("Reshape", logit, graph.ints(1, len(boxes), 1))
    extra = graph.unused("pixel_mask", "token_type_ids", "attention_mask")
    words = graph.op("Mul", graph.op("Cast", "input_ids", to=F), graph.constant(0.0))
    words = graph.op("Add", graph.op("Unsqueeze", words, graph.ints(1)), extra)
    row = graph.op("Add", logit, words)
    length = graph.op("Shape", "input_ids", start=1, end=2)
    zero = graph.ints(0)
    padding = graph.op("Concat", zero, zero, zero, zero, zero, graph.op("Sub", graph.ints(256), length), axis=0)
    graph.op("Pad", row, padding, graph.constant(-np.inf), out="logits")
    graph.op("Identity", graph.constant(np.array(boxes)[None]), out="pred_boxes")
    inputs = [("pixel_values", F, [1, 3, side, side]), ("pixel_mask", I, [1, side, side])]
    inputs += [(name, I, [1, "length"]) for name in ("input_ids", "token_type_ids", "attention_mask")]
    return graph.save(path, inputs, [("logits", F, [1, "q", 256]), ("pred_boxes", F, [1, "q", 4])])


def within_box(graph: Graph, corners: list[str]) -> str:
    """(1, 1, 256, 256) 1 within the box of the four scalars, pixels of a picture of 1024."""
    middle = (np.arange(256) + 0.5) * 4
    x, y = graph.constant(middle.reshape(1, 1, 1, 256)), graph.constant(middle.reshape(1, 1, 256, 1))
    x0, y0, x1, y1 = corners
    horizontal = graph.op("And", graph.op("Greater", x, x0), graph.op("Less", x, x1))
    vertical = graph.op("And", graph.op("Greater", y, y0), graph.op("Less", y, y1))
    return graph.op("Cast", graph.op("And", horizontal, vertical), to=F)


def mask_logits(graph: Graph, embeddings: str, corners: list[str]) -> str:
    brown = graph.op("Slice", embeddings, graph.ints(0), graph.ints(1), graph.ints(1))
    sizes = graph.ints(1, 1, 256, 256)
    mode = {"mode": "linear", "coordinate_transformation_mode": "half_pixel"}
    brown = graph.op("Resize", brown, "", "", sizes, **mode)
    both = graph.op("Mul", brown, within_box(graph, corners))
    return graph.op("Sub", both, graph.constant(0.5))


def corner(graph: Graph, source: str, *at: int) -> str:
    """One number of an input, as a scalar that broadcasts."""
    ends = graph.ints(*(i + 1 for i in at))
    part = graph.op("Slice", source, graph.ints(*at), ends, graph.ints(*range(len(at))))
    return graph.op("Reshape", part, graph.ints(1, 1, 1, 1))


def padded(graph: Graph, brown: str, factor: int, channels: int, out: str) -> str:
    small = graph.op("AveragePool", brown, kernel_shape=[factor, factor], strides=[factor, factor])
    return graph.op("Pad", small, graph.ints(0, 0, 0, 0, 0, channels - 1, 0, 0), out=out)


def mobile_sam(folder: Path) -> tuple[Path, Path]:
    graph = Graph()
    pixels = graph.op("Unsqueeze", graph.op("Transpose", "input_image", perm=[2, 0, 1]), graph.ints(0))
    padded(graph, brownness(graph, pixels, raw=True), 16, 256, "image_embeddings")
    encoder = graph.save(
        folder / "mobile_sam_image_encoder.onnx",
        [("input_image", F, ["h", "w", 3])],
        [("image_embeddings", F, [1, 256, 64, 64])],
    )
    graph = Graph()
    corners = [corner(graph, "point_coords", 0, i, j) for i in (0, 1) for j in (0, 1)]
    logits = mask_logits(graph, "image_embeddings", corners)
    extra = graph.unused("point_labels", "mask_input", "has_mask_input", "orig_im_size")
    graph.op("Add", logits, extra, out="low_res_masks")
    graph.op("Identity", "low_res_masks", out="masks")
    graph.op("Identity", graph.constant([[0.9]]), out="iou_predictions")
    inputs = [("image_embeddings", F, [1, 256, 64, 64]), ("point_coords", F, [1, "n", 2])]
    inputs += [("point_labels", F, [1, "n"]), ("mask_input", F, [1, 1, 256, 256])]
    inputs += [("has_mask_input", F, [1]), ("orig_im_size", F, [2])]
    outputs = [("masks", F, [1, 1, "h", "w"]), ("iou_predictions", F, [1, 1]), ("low_res_masks", F, [1, 1, 256, 256])]
    return encoder, graph.save(folder / "sam_mask_decoder_single.onnx", inputs, outputs)


EMBEDDINGS = [
    ("image_embeddings.0", F, [1, 32, 256, 256]),
    ("image_embeddings.1", F, [1, 64, 128, 128]),
    ("image_embeddings.2", F, [1, 256, 64, 64]),
]


def sam2(folder: Path) -> tuple[Path, Path]:
    graph = Graph()
    brown = brownness(graph, "pixel_values")
    for (name, _, shape), factor in zip(EMBEDDINGS, (4, 8, 16), strict=True):
        padded(graph, brown, factor, shape[1], name)
    encoder = graph.save(folder / "vision_encoder.onnx", [("pixel_values", F, ["b", 3, 1024, 1024])], EMBEDDINGS)
    graph = Graph()
    logits = mask_logits(graph, "image_embeddings.0", [corner(graph, "input_boxes", 0, 0, i) for i in range(4)])
    extra = graph.unused("input_points", "input_labels", "image_embeddings.1", "image_embeddings.2")
    logits = graph.op("Unsqueeze", graph.op("Add", logits, extra), graph.ints(1))
    worse = graph.op("Sub", logits, graph.constant(9.0))
    graph.op("Concat", worse, logits, worse, axis=2, out="pred_masks")
    graph.op("Identity", graph.constant([[[0.2, 0.9, 0.1]]]), out="iou_scores")
    graph.op("Identity", graph.constant([[[9.0]]]), out="object_score_logits")
    inputs = [("input_points", F, [1, 1, "n", 2]), ("input_labels", I, [1, 1, "n"]), ("input_boxes", F, [1, "b", 4])]
    outputs = [
        ("iou_scores", F, [1, 1, 3]),
        ("pred_masks", F, [1, 1, 3, 256, 256]),
        ("object_score_logits", F, [1, 1, 1]),
    ]
    return encoder, graph.save(folder / "prompt_encoder_mask_decoder.onnx", inputs + EMBEDDINGS, outputs)


def vocabulary(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(WORDS) + "\n")
    return path


def shipped_manifest() -> dict:
    """The list that ships with the program, as JSON."""
    return json.loads((Path(__file__).parents[2] / "assets" / "models.json").read_text())
