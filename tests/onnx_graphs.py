"""Graphs of a few kilobytes with the signatures of the public models, which find what is brown.

More is asked of them than of `tests.io.tinymodels`: the detector respects the padding, finds how high a trunk goes and
listens to the prompt; the segmenters keep a quarter of a cell, and some of their guesses are wrong on purpose.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from onnx import TensorProto
from tests.io.tinymodels import EMBEDDINGS, F, Graph, I, brownness, corner, padded, within_box

WORDS = ["[PAD]", "[CLS]", "[SEP]", "[UNK]", ".", "?", "tree", "trunk", "person", "##s"]
TREE, TRUNK = WORDS.index("tree"), WORDS.index("trunk")
_BIN = 8  # pixels of the detector's columns
_WIDEST = 20


def vocabulary(path: Path) -> Path:
    path.write_text("\n".join(WORDS) + "\n")
    return path


def detector(
    path: Path, *, side: tuple = (800, 800), opens: tuple = (), text_masks: bool = False, length: int | str = "length"
) -> Path:
    """Grounding DINO's signature.

    `opens` names inputs whose lengths are declared open; `text_masks` asks for the phrases' masks too; `length` is that
    of the prompt, where it is fixed.
    """
    height, width = side
    n_bins, n_rows = width // _BIN, height // 4
    graph = Graph()
    inside, beside, shares = [], [], []
    for first in range(n_bins):
        for count in range(1, min(_WIDEST, n_bins - first) + 1):
            window = np.zeros(n_bins)
            window[first : first + count] = 1 / count
            neighbours = np.zeros(n_bins)
            neighbours[[i for i in (first - 1, first + count) if 0 <= i < n_bins]] = 0.5
            inside.append(window)
            beside.append(neighbours)
            shares.append([(first + count / 2) / n_bins, count / n_bins])
    mask = graph.op("Unsqueeze", graph.op("Cast", "pixel_mask", to=F), graph.ints(1))
    brown = graph.op("Mul", brownness(graph, "pixel_values"), mask)
    cells = graph.op("AveragePool", brown, kernel_shape=[4, _BIN], strides=[4, _BIN])
    cells = graph.op("Reshape", cells, graph.ints(n_rows, n_bins))
    valid_width, valid_height = _valid(graph, mask, 2), _valid(graph, mask, 3)
    # A column counts where a tenth of the picture's height is brown.
    column = graph.op("ReduceMean", cells, axes=[0], keepdims=1)
    column = graph.op("Div", column, graph.op("Mul", valid_height, graph.constant(0.1)))
    column = graph.op("Min", column, graph.constant(1.0))
    windows = graph.constant(np.array(inside))
    score = graph.op("MatMul", column, graph.op("Transpose", windows, perm=[1, 0]))
    score = graph.op("Sub", score, graph.op("MatMul", column, graph.constant(np.array(beside).T)))
    score = graph.op("Sub", graph.op("Mul", score, graph.constant(9.0)), graph.constant(5.0))
    logit = graph.op("Reshape", score, graph.ints(1, len(inside), 1))
    _words(graph, logit)
    top, bottom = _rows(graph, windows, cells, n_rows, valid_height)
    across, wide = (graph.constant(np.array(shares)[:, i].reshape(1, -1, 1)) for i in (0, 1))
    half = graph.constant(0.5)
    graph.op(
        "Concat",
        graph.op("Div", across, valid_width),
        graph.op("Mul", graph.op("Add", top, bottom), half),
        graph.op("Div", wide, valid_width),
        graph.op("Sub", bottom, top),
        axis=2,
        out="pred_boxes",
    )
    inputs = [("pixel_values", F, [1, 3, height, width]), ("pixel_mask", I, [1, height, width])]
    texts = ["input_ids", "token_type_ids", "attention_mask", *(["position_ids"] if text_masks else [])]
    inputs += [(name, I, [1, length]) for name in texts]
    inputs += [("text_token_mask", TensorProto.BOOL, [1, length, length])] if text_masks else []
    inputs = [(n, t, [1, "?a", "?b", "?c"][: len(s)] if n in opens else s) for n, t, s in inputs]
    return graph.save(path, inputs, [("logits", F, [1, "q", 256]), ("pred_boxes", F, [1, "q", 4])])


def _valid(graph: Graph, mask: str, axis: int) -> str:
    """(1, 1, 1) share of the frame that is picture: of the columns where axis is 2, of the rows where it is 3."""
    line = graph.op("ReduceMax", mask, axes=[axis], keepdims=1)
    return graph.op("Reshape", graph.op("ReduceMean", line, keepdims=0), graph.ints(1, 1, 1))


def _words(graph: Graph, logit: str) -> None:
    """`logits`: the boxes' at the words tree and trunk, nothing elsewhere, minus infinity behind the prompt."""
    is_word = graph.op(
        "Or",
        graph.op("Equal", "input_ids", graph.constant(TREE, np.int64)),
        graph.op("Equal", "input_ids", graph.constant(TRUNK, np.int64)),
    )
    row = graph.op("Where", graph.op("Unsqueeze", is_word, graph.ints(1)), logit, graph.constant(-20.0))
    zero = graph.ints(0)
    length = graph.op("Shape", "input_ids", start=1, end=2)
    spare = graph.op("Sub", graph.ints(256), length)
    padding = graph.op("Concat", zero, zero, zero, zero, zero, spare, axis=0)
    graph.op("Pad", row, padding, graph.constant(-np.inf), out="logits")


def _rows(graph: Graph, windows: str, cells: str, n_rows: int, valid_height: str) -> tuple[str, str]:
    """(1, Q, 1) first and last brown row of each window, as shares of the picture's height."""
    share = graph.op("MatMul", windows, graph.op("Transpose", cells, perm=[1, 0]))
    is_brown = graph.op("Cast", graph.op("Greater", share, graph.constant(0.4)), to=F)
    backwards = graph.op("Gather", is_brown, graph.constant(np.arange(n_rows)[::-1], np.int64), axis=1)
    ends = []
    for rows, sign, start in ((is_brown, 1.0, 0.0), (backwards, -1.0, n_rows)):
        first = graph.op("Cast", graph.op("ArgMax", rows, axis=1, keepdims=1), to=F)
        place = graph.op("Add", graph.op("Mul", first, graph.constant(sign)), graph.constant(start))
        share = graph.op("Div", graph.op("Unsqueeze", place, graph.ints(0)), graph.constant(float(n_rows)))
        ends.append(graph.op("Div", share, valid_height))
    return ends[0], ends[1]


def meta_encoder(path: Path, *, raw: bool, side: int | str = 1024) -> Path:
    """SAM's encoder: `raw` takes (H, W, 3) of 0..255 and pads inside, as MobileSAM's does."""
    graph = Graph()
    pixels = "input_image" if raw else "images"
    if raw:
        pixels = graph.op("Unsqueeze", graph.op("Transpose", "input_image", perm=[2, 0, 1]), graph.ints(0))
    brown = brownness(graph, pixels, raw=raw)
    if raw:
        size = graph.op("Shape", brown, start=2, end=4)
        spare = graph.op("Sub", graph.ints(1024, 1024), size)
        brown = graph.op("Pad", brown, graph.op("Concat", graph.ints(0, 0, 0, 0, 0, 0), spare, axis=0))
    small = graph.op("AveragePool", brown, kernel_shape=[4, 4], strides=[4, 4])
    packed = graph.op("SpaceToDepth", small, blocksize=4)
    graph.op("Pad", packed, graph.ints(0, 0, 0, 0, 0, 240, 0, 0), out="image_embeddings")
    inputs = [("input_image", F, ["h", "w", 3])] if raw else [("images", F, [1, 3, side, side])]
    return graph.save(path, inputs, [("image_embeddings", F, [1, 256, 64, 64])])


def meta_decoder(path: Path, *, guesses: int = 4, without: str = "") -> Path:
    """SAM's decoder. Of four guesses the first is all over the picture and calls itself the best, as it may."""
    graph = Graph()
    packed = graph.op("Slice", "image_embeddings", graph.ints(0), graph.ints(16), graph.ints(1))
    brown = graph.op("DepthToSpace", packed, blocksize=4)
    corners = [corner(graph, "point_coords", 0, i, j) for i in (0, 1) for j in (0, 1)]
    logits = _within(graph, brown, corners)
    # Labels of the corners must be 2 and 3: else nothing is found.
    labels = graph.op("Equal", "point_labels", graph.constant([[2.0, 3.0]]))
    right = graph.op("ReduceMin", graph.op("Cast", labels, to=F), keepdims=0)
    wrong = graph.op("Mul", graph.op("Sub", right, graph.constant(1.0)), graph.constant(100.0))
    logits = graph.op("Add", logits, wrong)
    others = [name for name in ("mask_input", "has_mask_input", "orig_im_size") if name != without]
    logits = graph.op("Add", logits, graph.unused(*others))
    if guesses == 4:
        everywhere = graph.op("Add", graph.op("Mul", logits, graph.constant(0.0)), graph.constant(9.0))
        less = graph.op("Sub", logits, graph.constant(9.0))
        graph.op("Concat", everywhere, less, logits, less, axis=1, out="low_res_masks")
        graph.op("Identity", graph.constant([[0.99, 0.2, 0.9, 0.1]]), out="iou_predictions")
    else:
        graph.op("Identity", logits, out="low_res_masks")
        graph.op("Identity", graph.constant([[0.9]]), out="iou_predictions")
    graph.op("Identity", "low_res_masks", out="masks")
    inputs = [("image_embeddings", F, [1, 256, 64, 64]), ("point_coords", F, [1, "n", 2])]
    inputs += [("point_labels", F, [1, "n"]), ("mask_input", F, [1, 1, 256, 256])]
    inputs += [("has_mask_input", F, [1]), ("orig_im_size", F, [2])]
    outputs = [("masks", F, [1, guesses, "h", "w"]), ("iou_predictions", F, [1, guesses])]
    return graph.save(
        path,
        [value for value in inputs if value[0] != without],
        [*outputs, ("low_res_masks", F, [1, guesses, 256, 256])],
    )


def sam2x(folder: Path) -> tuple[Path, Path]:
    """SAM 2 as samexporter gives it: many boxes in one call."""
    names = ("high_res_feats_0", "high_res_feats_1", "image_embed")
    values = [(name, F, shape) for name, (_, _, shape) in zip(names, EMBEDDINGS, strict=True)]
    graph = Graph()
    brown = brownness(graph, "image")
    for (name, _, shape), factor in zip(values, (4, 8, 16), strict=True):
        padded(graph, brown, factor, shape[1], name)
    encoder = graph.save(folder / "sam2x_encoder.onnx", [("image", F, [1, 3, 1024, 1024])], values)
    graph = Graph()
    brown = graph.op("Slice", names[0], graph.ints(0), graph.ints(1), graph.ints(1))
    middle = (np.arange(256) + 0.5) * 4
    x, y = graph.constant(middle.reshape(1, 1, 1, 256)), graph.constant(middle.reshape(1, 1, 256, 1))
    edges = []
    for i in (0, 1):
        for j in (0, 1):
            part = graph.op("Slice", "point_coords", graph.ints(i, j), graph.ints(i + 1, j + 1), graph.ints(1, 2))
            edges.append(graph.op("Reshape", part, graph.ints(-1, 1, 1, 1)))
    horizontal = graph.op("And", graph.op("Greater", x, edges[0]), graph.op("Less", x, edges[2]))
    vertical = graph.op("And", graph.op("Greater", y, edges[1]), graph.op("Less", y, edges[3]))
    box = graph.op("Cast", graph.op("And", horizontal, vertical), to=F)
    logits = graph.op("Sub", graph.op("Mul", brown, box), graph.constant(0.5))
    logits = graph.op("Add", logits, graph.unused("mask_input", "has_mask_input", "point_labels", *names[1:]))
    worse = graph.op("Sub", logits, graph.constant(9.0))
    graph.op("Concat", logits, worse, worse, axis=1, out="masks")
    boxes = graph.op("Shape", "point_coords", start=0, end=1)
    scores = graph.op("Concat", boxes, graph.ints(3), axis=0)
    graph.op("Expand", graph.constant([[0.8, 0.2, 0.1]]), scores, out="iou_predictions")
    inputs = [*values, ("point_coords", F, ["n", "p", 2]), ("point_labels", F, ["n", "p"])]
    inputs += [("mask_input", F, ["n", 1, 256, 256]), ("has_mask_input", F, ["n"])]
    outputs = [("masks", F, ["n", 3, 256, 256]), ("iou_predictions", F, ["n", 3])]
    return encoder, graph.save(folder / "sam2x_decoder.onnx", inputs, outputs)


def points_only(path: Path) -> Path:
    """A decoder that takes no boxes, as the SAM of transformers.js has it."""
    graph = Graph()
    zero = graph.unused("input_points", "input_labels", "image_embeddings", "image_positional_embeddings")
    graph.op("Add", graph.constant(np.zeros((1, 1, 3, 256, 256))), zero, out="pred_masks")
    graph.op("Identity", graph.constant(np.zeros((1, 1, 3))), out="iou_scores")
    inputs = [("input_points", F, [1, "p", "n", 2]), ("input_labels", I, [1, "p", "n"])]
    inputs += [(name, F, [1, 256, 64, 64]) for name in ("image_embeddings", "image_positional_embeddings")]
    return graph.save(path, inputs, [("iou_scores", F, [1, 1, 3]), ("pred_masks", F, [1, 1, 3, 256, 256])])


def _within(graph: Graph, brown: str, corners: list[str]) -> str:
    """(1, 1, 256, 256) 0.5 for what is brown within the box, -0.5 elsewhere."""
    return graph.op("Sub", graph.op("Mul", brown, within_box(graph, corners)), graph.constant(0.5))
