"""Do these files do what they should? A picture the program draws, and whether the trunks in it are found.

The picture is drawn at the size the graph takes, so that nothing but the graph is between drawing and answer. It is no
forest: a file that is the published one by its hash and finds no trunks here is not thereby broken, and the report says
"doubtful"; one that gives no numbers has failed.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dbh_studio.core.arrays import Bool, Float64, UInt8
from dbh_studio.errors import MalformedFileError, StudioError
from dbh_studio.io.models.manifest import ModelSpec, Signature
from dbh_studio.io.models.signature import open_graph, signature_problems

Verdict = Literal["ok", "doubtful", "failed"]
PROMPT = ("[CLS]", "tree", "trunk", ".", "[SEP]")
_MEAN, _STD = np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32)
_HORIZON = 0.55
# x of the middle, half width at the top and at the foot, y of the top and of the foot: shares of the picture's side.
_TRUNKS = ((0.20, 0.040, 0.050, 0.0, 0.80), (0.50, 0.062, 0.075, 0.0, 0.90), (0.80, 0.030, 0.038, 0.0, 0.72))
_MIN_SCORE, _MIN_BOX_IOU, _MIN_MASK_IOU = 0.30, 0.5, 0.6


@dataclass(frozen=True)
class CheckPicture:
    """A drawn stand of three trunks.

    Attributes:
        rgb: (S, S, 3) uint8.
        boxes: (3, 4) x0, y0, x1, y1 in pixels.
        masks: (3, S, S) bool.
    """

    rgb: UInt8
    boxes: Float64
    masks: Bool


@dataclass(frozen=True)
class SelfCheck:
    """What the check of one model found.

    Attributes:
        model: Its name.
        verdict: ``ok``; ``doubtful``: it runs, but does not find what is drawn; ``failed``: it does not run, or gives
            no numbers.
        message: What was found, in plain words.
        seconds: How long one picture took.
        picture: (S, S, 3) uint8 drawing with what was found; None where nothing ran.
    """

    model: str
    verdict: Verdict
    message: str
    seconds: float = 0.0
    picture: UInt8 | None = None


def check_picture(side_px: int) -> CheckPicture:
    """Sky, ground, and three brown trunks with bark, light from the left."""
    rng = np.random.default_rng(7)
    at = (np.arange(side_px) + 0.5) / side_px
    x, y = np.meshgrid(at, at)
    noise = rng.normal(0.0, 1.0, (side_px, side_px))
    sky, ground = np.array([178.0, 200.0, 214.0]), np.array([96.0, 122.0, 58.0])
    rgb = np.where((y < _HORIZON)[..., None], sky - 40 * y[..., None], ground + 30 * (y[..., None] - _HORIZON))
    rgb += np.where(y < _HORIZON, 3.0, 9.0)[..., None] * noise[..., None]
    # Bark: furrows along the stem, the same noise in every row but for a slow change.
    furrows = rng.normal(0.0, 1.0, side_px)[None, :] + 0.4 * noise
    masks = []
    for middle, top_half, foot_half, top, foot in _TRUNKS:
        half = top_half + (foot_half - top_half) * np.clip((y - top) / (foot - top), 0, 1)
        across = (x - middle) / half
        mask = (np.abs(across) <= 1) & (y >= top) & (y <= foot)
        light = 1.05 - 0.28 * across**2 - 0.15 * across
        bark = np.array([96.0, 70.0, 46.0]) * light[..., None] + 7.0 * furrows[..., None]
        rgb[mask] = bark[mask]
        masks.append(mask)
    boxes = []
    for mask in masks:
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        boxes.append([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1])
    picture = np.clip(np.round(rgb), 0, 255).astype(np.uint8)
    return CheckPicture(picture, np.array(boxes, np.float64), np.stack(masks))


def self_check(spec: ModelSpec, paths: Mapping[str, Path]) -> SelfCheck:
    """Run a model on the drawing.

    Args:
        spec: The model.
        paths: Role → file, as `ModelStore.paths` gives them.
    """
    try:
        if spec.purpose == "tokenizer":
            return _check_vocabulary(spec, paths["vocabulary"])
        sessions = {}
        for file in spec.files:
            if file.signature is not None:
                sessions[file.role] = _opened(paths[file.role], file.signature)
        if spec.purpose == "detector":
            return _check_detector(spec, sessions["model"], paths["vocabulary"])
        return _check_segmenter(spec, sessions["encoder"], sessions["decoder"])
    except StudioError as error:
        return SelfCheck(spec.name, "failed", str(error))
    # onnxruntime's exceptions have no common class of their own.
    except Exception as error:
        if isinstance(error, MemoryError):
            raise
        reason = str(error).strip().splitlines()[0][:300] if str(error).strip() else type(error).__name__
        return SelfCheck(spec.name, "failed", f"It does not run: {reason}")


def _opened(path: Path, signature: Signature) -> Any:
    session = open_graph(path)
    problems = signature_problems(session, signature)
    if problems:
        raise MalformedFileError(path, f"It is another model: {'; '.join(problems)}.", "Fetch it again.")
    return session


def _check_vocabulary(spec: ModelSpec, path: Path) -> SelfCheck:
    numbers = _token_numbers(path)
    return SelfCheck(spec.name, "ok", f'The prompt "tree trunk." is {" ".join(map(str, numbers))}.')


def _token_numbers(path: Path) -> list[int]:
    """The numbers of the prompt's words, each of which is a whole word of the vocabulary."""
    try:
        words = {word: number for number, word in enumerate(path.read_text(encoding="utf-8").splitlines())}
        return [words[word] for word in PROMPT]
    except (UnicodeDecodeError, KeyError) as error:
        raise MalformedFileError(path, f"It is no BERT vocabulary ({error}).", "Fetch it again.") from error


def _check_detector(spec: ModelSpec, session: Any, vocabulary: Path) -> SelfCheck:
    wanted = next(tensor for file in spec.files if file.signature for tensor in file.signature.inputs)
    side = wanted.shape[-1]
    assert side is not None  # the manifest fixes it
    drawing = check_picture(side)
    tokens = np.array([_token_numbers(vocabulary)], np.int64)
    start = time.perf_counter()
    boxes, scores = _detect(session, drawing.rgb, tokens)
    seconds = time.perf_counter() - start
    _, blank_scores = _detect(session, np.full_like(drawing.rgb, 128), tokens)
    if not (np.isfinite(boxes).all() and np.isfinite(scores).all()):
        return SelfCheck(spec.name, "failed", "It gives no numbers (NaN) for a picture.", seconds)
    strong = scores >= _MIN_SCORE
    overlap = _box_iou(drawing.boxes, boxes[strong]) >= _MIN_BOX_IOU
    n_found, n_right = int(overlap.any(axis=1).sum()), int(overlap.any(axis=0).sum())
    figures = (
        f"{n_found} of {len(overlap)} drawn trunks found; {n_right} of {strong.sum()} boxes with a score of at least "
        f"{_MIN_SCORE:.2f} are right; best score {scores.max():.2f}, on an empty picture {blank_scores.max():.2f}; "
        f"{seconds:.1f} s for a picture."
    )
    # Of boxes all over the picture some are right by chance.
    is_ok = n_found >= 2 and 2 * n_right >= strong.sum() and blank_scores.max() < scores.max()
    return SelfCheck(spec.name, "ok" if is_ok else "doubtful", figures, seconds, _drawn(drawing.rgb, boxes[strong]))


def _detect(session: Any, rgb: UInt8, tokens: Any) -> tuple[Float64, Float64]:
    """(N, 4) boxes in pixels and (N,) scores."""
    side = rgb.shape[0]
    feed = {
        "pixel_values": _normalised(rgb),
        "pixel_mask": np.ones((1, side, side), np.int64),
        "input_ids": tokens,
        "token_type_ids": np.zeros_like(tokens),
        "attention_mask": np.ones_like(tokens),
    }
    logits, boxes = session.run(["logits", "pred_boxes"], _as_wanted(session, feed))
    words = logits[0, :, : tokens.shape[1]].astype(np.float64)
    # Padding is minus infinity, which is a score of 0 and not a failure; of NaN the highest is NaN.
    scores = 1.0 / (1.0 + np.exp(-np.clip(words, -60, 60)))
    middle, half = boxes[0, :, :2].astype(np.float64), boxes[0, :, 2:].astype(np.float64) / 2
    return side * np.concatenate([middle - half, middle + half], axis=1), scores.max(axis=1)


def _check_segmenter(spec: ModelSpec, encoder: Any, decoder: Any) -> SelfCheck:
    drawing = check_picture(1024)
    start = time.perf_counter()
    if spec.family == "sam2":
        embeddings = _run(encoder, {"pixel_values": _normalised(drawing.rgb)})
    else:
        embeddings = _run(encoder, {"input_image": drawing.rgb.astype(np.float32)})
    logits = np.stack([_segment(spec.family, decoder, embeddings, box) for box in drawing.boxes])
    seconds = time.perf_counter() - start
    if not np.isfinite(logits).all():
        return SelfCheck(spec.name, "failed", "It gives no numbers (NaN) for a picture.", seconds)
    step = 1024 // logits.shape[-1]
    truth = drawing.masks[:, step // 2 :: step, step // 2 :: step]
    found = logits > 0
    union = np.count_nonzero(truth | found, axis=(1, 2))
    iou = np.count_nonzero(truth & found, axis=(1, 2)) / np.maximum(union, 1)
    is_ok = np.count_nonzero(iou >= _MIN_MASK_IOU) >= 2
    listed = ", ".join(f"{value:.2f}" for value in iou)
    message = f"The masks of the three drawn trunks agree by {listed} (1 is perfect), {seconds:.1f} s for a picture."
    shown = drawing.rgb.copy()
    on = np.kron(found.any(axis=0), np.ones((step, step), bool))
    shown[on] = (shown[on] * 0.4 + np.array([255, 80, 0]) * 0.6).astype(np.uint8)
    return SelfCheck(spec.name, "ok" if is_ok else "doubtful", message, seconds, _drawn(shown, drawing.boxes))


def _segment(family: str, decoder: Any, embeddings: Mapping[str, Any], box: Float64) -> Any:
    """(256, 256) logits of the best mask for one box."""
    if family == "sam2":
        prompt = {
            "input_points": np.zeros((1, 1, 0, 2), np.float32),
            "input_labels": np.zeros((1, 1, 0), np.int64),
            "input_boxes": box.reshape(1, 1, 4).astype(np.float32),
        }
        answer = _run(decoder, {**embeddings, **prompt})
        return answer["pred_masks"][0, 0][int(np.argmax(answer["iou_scores"][0, 0]))]
    prompt = {
        "point_coords": box.reshape(1, 2, 2).astype(np.float32),
        "point_labels": np.array([[2, 3]], np.float32),
        "mask_input": np.zeros((1, 1, 256, 256), np.float32),
        "has_mask_input": np.zeros(1, np.float32),
        "orig_im_size": np.array([1024, 1024], np.float32),
    }
    answer = _run(decoder, {**embeddings, **prompt})
    return answer["low_res_masks"][0][int(np.argmax(answer["iou_predictions"][0]))]


def _run(session: Any, feed: Mapping[str, Any]) -> dict[str, Any]:
    names = [value.name for value in session.get_outputs()]
    return dict(zip(names, session.run(names, _as_wanted(session, feed)), strict=True))


def _as_wanted(session: Any, feed: Mapping[str, Any]) -> dict[str, Any]:
    """Floats in the precision the graph declares, and nothing it does not ask for."""
    halves = {value.name for value in session.get_inputs() if value.type == "tensor(float16)"}
    asked = {value.name for value in session.get_inputs()}
    return {
        name: value.astype(np.float16) if name in halves else value for name, value in feed.items() if name in asked
    }


def _normalised(rgb: UInt8) -> Any:
    """(1, 3, S, S) float32 as ImageNet's models take it."""
    return ((rgb.astype(np.float32) / 255 - _MEAN) / _STD).transpose(2, 0, 1)[None].astype(np.float32)


def _box_iou(a: Float64, b: Float64) -> Float64:
    """(N, M) overlap of boxes."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = np.clip(high - low, 0, None).prod(axis=2)
    area_a, area_b = (a[:, 2:] - a[:, :2]).prod(axis=1), (b[:, 2:] - b[:, :2]).prod(axis=1)
    return shared / np.maximum(area_a[:, None] + area_b[None, :] - shared, 1e-9)


def _drawn(rgb: UInt8, boxes: Float64) -> UInt8:
    """The picture with the boxes' outlines."""
    picture, side = rgb.copy(), rgb.shape[0]
    for x0, y0, x1, y1 in np.clip(np.round(boxes), 0, side - 1).astype(int):
        for rows, columns in (
            (slice(y0, y0 + 3), slice(x0, x1 + 1)),
            (slice(max(y1 - 2, 0), y1 + 1), slice(x0, x1 + 1)),
            (slice(y0, y1 + 1), slice(x0, x0 + 3)),
            (slice(y0, y1 + 1), slice(max(x1 - 2, 0), x1 + 1)),
        ):
            picture[rows, columns] = (255, 0, 255)
    return picture
