"""The runtime (onnxruntime, numpy, Pillow, OpenCV) equals transformers (torch) at every step, on random weights.

`make parity` runs it, in an environment of its own; `make test` has no torch and skips it.

Measured with torch 2.13.0 (CPU), transformers 5.23.0, tokenizers 0.23.3, onnxruntime 1.31.1, Pillow 13.0.0 and OpenCV
5.0.0, largest absolute difference (tolerance):

    tokens of 13 texts and 2 600 letters, prompts, phrase masks, size rule  equal
    pictures of Grounding DINO and SAM, 5 sizes, squashed and padded        7.2e-7 (1e-5); pixel masks equal
    pictures of SAM 2                                                       one grey level (one grey level)
    Grounding DINO: logits; boxes as shares; 1 and 3 phrases                1.2e-5 (2e-4); 4.8e-7 (1e-5)
    detections: scores; pixels of 400 x 260; phrases                        2.6e-6 (5e-5); 1.8e-4 (2e-3); equal
    SAM: features; logits; scores                                           3.1e-6 (1e-4); 2.7e-6 (1e-4); 3.0e-7 (1e-5)
    SAM 2, both exports: features; logits; scores                           4.5e-6 (1e-4); 4.3e-6 (1e-4); 8.9e-8 (1e-5)
    masks at the picture's size, 3 boxes: logits; pixels that differ        4.6e-6 (1e-4); 0 of 312 000 (2e-5 of them)

SAM 2's pictures are compared with torch's antialiased resizing, which its processor uses, rounded to grey levels as it
does; the processor itself wants torchvision and is not run.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: parity with transformers was not checked")
pytest.importorskip("transformers", reason="transformers is not installed: parity with it was not checked")
pytest.importorskip("onnx", reason="onnx is not installed: no models can be exported")

# These import torch, which the lines above may find missing.
from PIL import Image  # noqa: E402
from tests.parity import random_models as models  # noqa: E402
from tokenizers import BertWordPieceTokenizer  # noqa: E402
from transformers import BertTokenizerFast  # noqa: E402
from transformers.image_transforms import get_size_with_aspect_ratio  # noqa: E402
from transformers.models.grounding_dino import modeling_grounding_dino as dino_code  # noqa: E402
from transformers.models.grounding_dino import processing_grounding_dino as dino_processing  # noqa: E402
from transformers.models.grounding_dino.image_processing_pil_grounding_dino import (  # noqa: E402
    GroundingDinoImageProcessorPil,
)
from transformers.models.sam.image_processing_pil_sam import SamImageProcessorPil  # noqa: E402

from dbh_studio.settings import MaskDetectorSettings  # noqa: E402
from dbh_studio.stages import grounding_dino, pictures, sam, wordpiece  # noqa: E402
from dbh_studio.stages.onnx_runtime import Graph  # noqa: E402

pytestmark = pytest.mark.parity
_log = logging.getLogger(__name__)

SIDE = models.SIDE
SIZES = ((260, 400), (400, 260), (128, 128), (97, 301), (512, 512))
BOXES = np.array([[20.0, 10.0, 34.0, 240.0], [160.0, 10.0, 174.0, 240.0], [5.0, 5.0, 390.0, 250.0]])


def picture(height: int = 260, width: int = 400) -> np.ndarray:
    rng = np.random.default_rng(height * 1000 + width)
    rough = rng.integers(0, 255, (height // 8, width // 8, 3), np.uint8)
    rgb = np.array(Image.fromarray(rough).resize((width, height), Image.Resampling.BICUBIC))
    rgb[10:-20, 20::70] = (90, 60, 30)
    return rgb


def largest(ours: Any, theirs: Any) -> float:
    ours, theirs = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
    assert ours.shape == theirs.shape
    return float(np.abs(ours - theirs).max())


def agree(what: str, ours: Any, theirs: Any, tolerance: float, *, spread: float = 0.0) -> None:
    """Equal within the tolerance, and not because all is the same: their values spread at least so much."""
    difference = largest(ours, theirs)
    _log.info("%s: %.1e (allowed %.0e)", what, difference, tolerance)
    assert np.asarray(theirs).std() > spread
    assert difference <= tolerance


@dataclass(frozen=True)
class Dino:
    reference: Any
    ours: grounding_dino.GroundingDino
    tokenizer: Any


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("models")
    models.write_vocabulary(path / "vocab.txt")
    return path


@pytest.fixture(scope="module")
def words(folder: Path) -> wordpiece.WordPiece:
    return wordpiece.read_vocabulary(folder / "vocab.txt")


@pytest.fixture(scope="module")
def dino(folder: Path) -> Dino:
    reference = models.grounding_dino()
    path = models.export_grounding_dino(reference, folder / "dino.onnx")
    # This export masks the phrases rightly, and is therefore asked about several at once.
    ours = grounding_dino.GroundingDino.open({"model": path, "vocabulary": folder / "vocab.txt"}, phrases_together=True)
    pieces = (folder / "vocab.txt").read_text().splitlines()
    return Dino(reference, ours, BertTokenizerFast(vocab={piece: i for i, piece in enumerate(pieces)}))


@pytest.fixture(scope="module")
def sam1(folder: Path) -> tuple[Any, dict[str, sam.Sam]]:
    reference = models.sam()
    paths = models.export_sam(reference, folder)
    return reference, {kind: sam.Sam(Graph(paths["encoder"]), Graph(paths[kind])) for kind in ("multi", "single")}


@pytest.fixture(scope="module")
def sam2(folder: Path) -> tuple[Any, dict[str, sam.Sam]]:
    reference = models.sam2()
    paths = models.export_sam2(reference, folder)
    return reference, {
        "one box per call": sam.Sam(Graph(paths["encoder"]), Graph(paths["decoder"])),
        "many boxes per call": sam.Sam(Graph(paths["xencoder"]), Graph(paths["xdecoder"])),
    }


def ask_dino(model: Any, pixels: Any, mask: Any, tokens: Any) -> Any:
    with torch.no_grad():
        return model(
            pixel_values=torch.from_numpy(np.asarray(pixels)),
            pixel_mask=torch.from_numpy(np.asarray(mask)),
            input_ids=torch.from_numpy(tokens),
            attention_mask=torch.ones_like(torch.from_numpy(tokens)),
            token_type_ids=torch.zeros_like(torch.from_numpy(tokens)),
        )


@pytest.mark.parametrize(
    "text",
    [
        "tree trunk.",
        "Tree Trunk",
        "tree. person. pole.",
        "a tree-trunk, bark of the Trée!  ok?",
        "truèée\t x\ny",
        "中 tree 木trunk",
        "trunks treetrunk",
        "x" * 101 + " tree",
        "don't… naïve façade",
        "éclair № 5 ½ \u00a0tree\u200bs \x07trunk İ ẞ",
        "[tree] {trunk} ~pole^ `a` $of€",
        "",
        "  ",
    ],
)
def test_tokens(folder: Path, words: wordpiece.WordPiece, text: str) -> None:
    pieces = (folder / "vocab.txt").read_text().splitlines()
    theirs = BertWordPieceTokenizer({piece: i for i, piece in enumerate(pieces)}, lowercase=True)
    assert words.encode(text).tolist() == theirs.encode(text).ids


def test_every_letter_is_taken_apart_alike(folder: Path, words: wordpiece.WordPiece) -> None:
    """Latin with all its accents, signs, Greek, Cyrillic, punctuation; characters of newer Unicodes may differ."""
    pieces = (folder / "vocab.txt").read_text().splitlines()
    theirs = BertWordPieceTokenizer({piece: i for i, piece in enumerate(pieces)}, lowercase=True)
    for code in [*range(0x530), *range(0x1E00, 0x2070), *range(0x2E80, 0x3100), 0x4E00, 0x9FFF, 0xF900, 0x20000]:
        text = f"b{chr(code)}c"
        assert words.encode(text).tolist() == theirs.encode(text).ids, hex(code)


def test_prompt() -> None:
    """As their processor joins candidate labels, one phrase after the other."""
    prepared = dino_processing.GroundingDinoProcessor._preprocess_input_text
    for labels in (["Tree trunk"], ["tree", " Pole "], ["a", "b", "c"]):
        assert " ".join(wordpiece.phrases_of(". ".join(labels))) == prepared(None, [labels])[0]


@pytest.mark.parametrize(
    "tokens",
    [
        [101, 1030, 1031, 1012, 102],
        [101, 1030, 1012, 1031, 1032, 1012, 102],
        [101, 102],
        [101, 1030, 102],
        [101, 1012, 1012, 102],
        [101, 1030, 1029, 1031, 1012, 102],
        [101, *[1030, 1012] * 20, 102],
    ],
)
def test_phrases_are_kept_apart(words: wordpiece.WordPiece, tokens: list[int]) -> None:
    given = torch.tensor([tokens])
    special = torch.tensor(dino_code.SPECIAL_TOKENS)
    together, places = dino_code.generate_masks_with_special_tokens_and_transfer_map(given, special)
    ours = wordpiece.phrase_masks(np.array(tokens), words.separators)
    assert np.array_equal(ours[0], together[0].numpy())
    assert np.array_equal(ours[1], places[0].numpy())
    # What the exports below were made with is the same too.
    exported = models.exportable_text_masks(given, special)
    assert torch.equal(exported[0], together)
    assert torch.equal(exported[1], places)


def test_size_rule() -> None:
    rng = np.random.default_rng(0)
    for height, width in [*rng.integers(40, 9000, (300, 2)).tolist(), (2880, 5760), (800, 800), (800, 1200)]:
        for shortest, longest in ((800, 1333), (800, 800), (128, 128)):
            theirs = get_size_with_aspect_ratio((height, width), shortest, longest)
            assert pictures.edge_size(height, width, shortest, longest) == theirs


@pytest.mark.parametrize("size", SIZES)
def test_detector_pictures(dino: Dino, size: tuple[int, int]) -> None:
    rgb = picture(*size)
    processors = {
        "squashed": GroundingDinoImageProcessorPil(size={"height": SIDE, "width": SIDE}),
        "padded": GroundingDinoImageProcessorPil(
            size={"shortest_edge": SIDE, "longest_edge": SIDE}, pad_size={"height": SIDE, "width": SIDE}
        ),
    }
    for shape, processor in processors.items():
        theirs = processor(images=Image.fromarray(rgb), return_tensors="pt")
        pixels, mask = dino.ours.prepare(rgb, shape)
        agree(f"detector's picture, {shape} {size}", pixels, theirs["pixel_values"].numpy(), 1e-5, spread=0.5)
        assert np.array_equal(mask, theirs["pixel_mask"].numpy())


@pytest.mark.parametrize("prompt", ["tree trunk.", "tree.", "tree trunk. pole. person."])
@pytest.mark.parametrize("shape", ["padded", "squashed"])
def test_detector_answers(dino: Dino, prompt: str, shape: str) -> None:
    pixels, mask = dino.ours.prepare(picture(), shape)
    text = dino.ours.read(prompt)
    theirs = ask_dino(dino.reference, pixels, mask, text["input_ids"])
    n_tokens = text["input_ids"].shape[1]
    logits, boxes = dino.ours.answer(pixels, mask, text)
    agree(f"logits, {prompt} {shape}", logits, theirs.logits[0, :, :n_tokens].numpy(), 2e-4, spread=0.1)
    agree(f"boxes, {prompt} {shape}", boxes, theirs.pred_boxes[0].numpy(), 1e-5, spread=0.01)


@pytest.mark.parametrize("shape", ["padded", "squashed"])
@pytest.mark.parametrize("size", [(260, 400), (400, 260)])
def test_detections(dino: Dino, shape: str, size: tuple[int, int]) -> None:
    rgb, prompt = picture(*size), "tree trunk. pole."
    pixels, mask = dino.ours.prepare(rgb, shape)
    tokens = dino.ours.read(prompt)["input_ids"]
    outputs = ask_dino(dino.reference, pixels, mask, tokens)
    scores = torch.sigmoid(outputs.logits)[0].max(dim=1).values
    # Half way between two values, so that rounding decides nothing.
    middle = torch.sort(scores).values[29:31].mean().item()
    words = torch.sort(torch.sigmoid(outputs.logits[0, :, : tokens.shape[1]]).ravel()).values
    words = words[len(words) // 2 - 1 : len(words) // 2 + 1].mean().item()
    processor = dino_processing.GroundingDinoProcessor.__new__(dino_processing.GroundingDinoProcessor)
    processor.tokenizer = dino.tokenizer
    theirs = processor.post_process_grounded_object_detection(
        outputs, torch.from_numpy(tokens), threshold=middle, text_threshold=words, target_sizes=[size]
    )[0]
    settings = MaskDetectorSettings(
        prompt=prompt,
        box_threshold=middle,
        text_threshold=words,
        box_overlap=1.0,
        max_box_share=1.0,
        min_box_px=1.0,
        picture_shape=shape,
    )
    found = dino.ours.detect(rgb, settings)
    order = np.argsort(-theirs["scores"].numpy(), kind="stable")
    boxes = np.clip(theirs["boxes"].numpy()[order], 0, [size[1], size[0]] * 2)
    # Boxes of no size are left out by ours.
    is_box = ((boxes[:, 2:] - boxes[:, :2]) * dino.ours.shrink(rgb, shape) >= 1.0).all(axis=1)
    assert is_box.sum() >= 10
    agree(f"scores {shape} {size}", found.scores, theirs["scores"].numpy()[order][is_box], 5e-5)
    agree(f"boxes, pixels {shape} {size}", found.boxes_px, boxes[is_box], 2e-3, spread=1.0)
    said = [theirs["text_labels"][i] for i in order[is_box]]
    assert [phrase.replace(" ", "") for phrase in found.phrases] == [
        phrase.replace("[SEP]", "").replace(" ", "") for phrase in said
    ]
    assert len(set(found.phrases)) > 1


@pytest.mark.parametrize("size", SIZES)
def test_segmenter_pictures(sam1: Any, sam2: Any, size: tuple[int, int]) -> None:
    rgb = picture(*size)
    processor = SamImageProcessorPil(size={"longest_edge": SIDE}, pad_size={"height": SIDE, "width": SIDE})
    theirs = processor(images=Image.fromarray(rgb), return_tensors="pt")
    pixels, inner = sam1[1]["multi"].prepare(rgb)
    assert inner == tuple(theirs["reshaped_input_sizes"][0].tolist())
    agree(f"SAM's picture {size}", pixels, theirs["pixel_values"].numpy(), 1e-5, spread=0.5)
    raw = torch.from_numpy(rgb).permute(2, 0, 1)[None].float()
    small = torch.nn.functional.interpolate(raw, (SIDE, SIDE), mode="bilinear", antialias=True, align_corners=False)
    small = small.round().clamp(0, 255)[0].numpy().transpose(1, 2, 0).astype(np.uint8)
    pixels, _ = sam2[1]["one box per call"].prepare(rgb)
    # One grey level, in units of the smallest deviation.
    agree(f"SAM 2's picture {size}", pixels[0], pictures.normalised(small), 1.01 / 255 / 0.224, spread=0.5)


@pytest.mark.parametrize("kind", ["multi", "single"])
def test_sam(sam1: Any, kind: str) -> None:
    reference, ours = sam1[0], sam1[1][kind]
    rgb = picture()
    encoded = ours.encode(rgb)
    with torch.no_grad():
        embeddings = reference.get_image_embeddings(torch.from_numpy(ours.prepare(rgb)[0]))
        scaled = BOXES * np.tile(np.array(encoded.inner_px[::-1]) / np.array(rgb.shape[1::-1]), 2)
        theirs = reference(
            image_embeddings=embeddings, input_boxes=torch.from_numpy(scaled).float()[None], multimask_output=True
        )
    agree("SAM's features", encoded.features["image_embeddings"], embeddings.numpy(), 1e-4, spread=0.1)
    processor = SamImageProcessorPil(size={"longest_edge": SIDE}, pad_size={"height": SIDE, "width": SIDE})
    whole = processor.post_process_masks(
        theirs.pred_masks, [rgb.shape[:2]], [encoded.inner_px], mask_threshold=0.0, binarize=False
    )[0].numpy()
    _compare_masks(f"SAM {kind}", ours, encoded, theirs, whole, n_guesses=3 if kind == "multi" else 1)


@pytest.mark.parametrize("kind", ["one box per call", "many boxes per call"])
def test_sam2(sam2: Any, kind: str) -> None:
    reference, ours = sam2[0], sam2[1][kind]
    rgb = picture()
    encoded = ours.encode(rgb)
    with torch.no_grad():
        features = reference.get_image_embeddings(torch.from_numpy(ours.prepare(rgb)[0]))
        scaled = BOXES * np.tile(SIDE / np.array(rgb.shape[1::-1]), 2)
        theirs = reference(
            image_embeddings=features, input_boxes=torch.from_numpy(scaled).float()[None], multimask_output=True
        )
    named = [value for name, value in sorted(encoded.features.items()) if name != "image_embed"]
    for mine, reference_features in zip(named, features, strict=False):
        agree(f"SAM 2's features, {kind}", mine, reference_features.numpy(), 1e-4, spread=0.01)
    # As their `post_process_masks`.
    whole = torch.nn.functional.interpolate(
        theirs.pred_masks[0], rgb.shape[:2], mode="bilinear", align_corners=False
    ).numpy()
    _compare_masks(f"SAM 2, {kind}", ours, encoded, theirs, whole, n_guesses=3)


def _compare_masks(
    what: str, ours: sam.Sam, encoded: sam.Encoded, theirs: Any, whole: np.ndarray, *, n_guesses: int
) -> None:
    """Logits, scores, the best guess, and the mask at the picture's size."""
    logits, scores = ours.low_masks(encoded, BOXES)
    reference, fits = theirs.pred_masks[0].numpy(), theirs.iou_scores[0].numpy()
    best = fits.argmax(axis=1)
    pick: Callable[[np.ndarray], np.ndarray] = lambda array: array[np.arange(len(best)), best]  # noqa: E731
    if n_guesses == 1:
        agree(f"{what}: logits", logits[:, 0], pick(reference), 1e-4, spread=0.1)
        agree(f"{what}: scores", scores[:, 0], pick(fits), 1e-5)
    else:
        agree(f"{what}: logits", logits, reference, 1e-4, spread=0.1)
        agree(f"{what}: scores", scores, fits, 1e-5)
        assert np.array_equal(scores.argmax(axis=1), best)
    guess = 0 if n_guesses == 1 else best[0]
    enlarged = ours.enlarged(logits[0, guess], encoded)
    agree(f"{what}: logits at the picture's size", enlarged, whole[0, best[0]], 1e-4, spread=0.1)
    wrong = total = 0
    for row, (mask, _) in enumerate(ours.segment(encoded, BOXES)):
        wrong += int(np.count_nonzero(mask != (whole[row, best[row]] > 0.0)))
        total += mask.size
    _log.info("%s: %d of %d pixels of the masks differ", what, wrong, total)
    assert wrong <= 2e-5 * total
