"""The detector: tokens, pictures, boxes, and which graphs are refused; with a graph that finds what is brown."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests import onnx_graphs
from tests.drawn_trunks import BLUE, BROWN
from tests.io import tinymodels

from dbh_studio.errors import FileMissingError, MalformedFileError, MissingComponentError, ModelError, SettingError
from dbh_studio.io.models import read_manifest
from dbh_studio.settings import MaskDetectorSettings, ModelRunSettings
from dbh_studio.stages import onnx_runtime, wordpiece
from dbh_studio.stages.grounding_dino import GroundingDino, corners, is_of_trunk_size, unlike_boxes
from dbh_studio.stages.onnx_runtime import Graph, choose_model, choose_provider
from dbh_studio.stages.pictures import fitting_size, normalised, resized


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("graphs")
    onnx_graphs.vocabulary(path / "vocab.txt")
    onnx_graphs.detector(path / "dino.onnx")
    return path


@pytest.fixture(scope="module")
def detector(folder: Path) -> GroundingDino:
    return GroundingDino.open({"model": folder / "dino.onnx", "vocabulary": folder / "vocab.txt"})


def drawn(width: int, height: int, *boxes: tuple[int, int, int, int]) -> np.ndarray:
    rgb = np.empty((height, width, 3), np.uint8)
    rgb[:] = BLUE
    for x0, y0, x1, y1 in boxes:
        rgb[y0:y1, x0:x1] = BROWN
    return rgb


def words() -> wordpiece.WordPiece:
    return wordpiece.WordPiece({piece: i for i, piece in enumerate(onnx_graphs.WORDS)})


def test_words_are_cut_into_the_longest_pieces() -> None:
    assert words().encode("Trées, TRUNK.").tolist() == [1, 6, 9, 3, 7, 4, 2]
    assert words().text([1, 6, 9, 7, 2, 0]) == "trees trunk"


def test_vocabularies_are_read_in_both_forms(tmp_path: Path, folder: Path) -> None:
    listed = wordpiece.read_vocabulary(folder / "vocab.txt")
    entries = ",".join(f'"{piece}":{i}' for i, piece in enumerate(onnx_graphs.WORDS))
    (tmp_path / "tokenizer.json").write_text(f'{{"model": {{"type": "WordPiece", "vocab": {{{entries}}}}}}}')
    other = wordpiece.read_vocabulary(tmp_path / "tokenizer.json")
    assert listed.encode("tree trunks.").tolist() == other.encode("tree trunks.").tolist()
    assert listed.separators == (1, 2, 4, 5)
    (tmp_path / "tokenizer.json").write_text('{"model": {"type": "BPE", "vocab": {}}}')
    with pytest.raises(MalformedFileError, match="BPE"):
        wordpiece.read_vocabulary(tmp_path / "tokenizer.json")
    (tmp_path / "bad.txt").write_text("tree\ntrunk\n")
    with pytest.raises(MalformedFileError, match=r"lacks \[CLS\]"):
        wordpiece.read_vocabulary(tmp_path / "bad.txt")
    with pytest.raises(FileMissingError):
        wordpiece.read_vocabulary(tmp_path / "none.txt")


@given(st.text(max_size=60))
def test_any_text_can_be_read(text: str) -> None:
    numbers = words().encode(text)
    assert numbers[0] == 1
    assert numbers[-1] == 2
    assert ((numbers >= 0) & (numbers < len(onnx_graphs.WORDS))).all()


def test_prompts() -> None:
    assert wordpiece.phrases_of("Tree trunk") == ("tree trunk.",)
    assert wordpiece.phrases_of(" tree trunk. Pole . ") == ("tree trunk.", "pole.")
    with pytest.raises(SettingError, match="empty"):
        wordpiece.phrases_of(" . ")


def test_phrases_do_not_look_at_each_other() -> None:
    """[CLS] a b . c . [SEP]: places count within the phrase, and the ends belong to none."""
    together, places = wordpiece.phrase_masks(np.array([1, 6, 7, 4, 8, 4, 2]), (1, 2, 4))
    wanted = np.zeros((7, 7), int)
    wanted[0, 0] = wanted[6, 6] = 1
    wanted[1:4, 1:4] = wanted[4:6, 4:6] = 1
    assert np.array_equal(together, wanted)
    assert places.tolist() == [0, 0, 1, 2, 0, 1, 0]


@given(st.integers(100, 6000), st.integers(100, 6000))
def test_a_fitted_picture_fills_one_side_of_the_frame(height: int, width: int) -> None:
    for frame in ((800, 800), (800, 1333), (544, 960)):
        inner = fitting_size(height, width, *frame)
        assert 1 <= inner[0] <= frame[0]
        assert 1 <= inner[1] <= frame[1]
        # What is nearly as large as the frame stays as it is, by the models' own rule.
        assert inner[0] >= 0.99 * frame[0] or inner[1] >= 0.99 * frame[1]
        # Proportions are kept, but for the rounding of the shorter side.
        assert abs(inner[0] * width - inner[1] * height) <= 1.5 * max(height, width)


def test_a_resized_picture_is_the_mean_of_what_it_shows() -> None:
    rgb = np.zeros((400, 400, 3), np.uint8)
    rgb[::2] = 200
    small = resized(rgb, 100, 100)
    assert np.abs(small[5:-5].astype(float) - 100).max() <= 2
    assert resized(rgb, 400, 400) is rgb
    white = normalised(np.full((2, 2, 3), 255, np.uint8))
    assert np.allclose(white[:, 0, 0], [(1 - 0.485) / 0.229, (1 - 0.456) / 0.224, (1 - 0.406) / 0.225], atol=1e-6)


def test_the_picture_is_padded_and_the_mask_says_so(detector: GroundingDino) -> None:
    rgb = drawn(1600, 600)
    pixels, mask = detector.prepare(rgb)
    assert pixels.shape == (1, 3, 800, 800)
    assert mask[0, :300].all()
    assert not mask[0, 300:].any()
    assert not pixels[0, :, 300:].any()
    assert detector.prepare(rgb, "squashed")[1].all()
    with pytest.raises(ValueError, match="uint8"):
        detector.prepare(rgb.astype(np.float32))


@pytest.mark.parametrize("shape", ["padded", "squashed"])
@pytest.mark.parametrize("size", [(800, 800), (1600, 800), (600, 1200), (333, 250)])
def test_boxes_are_where_the_trunks_are(detector: GroundingDino, shape: str, size: tuple[int, int]) -> None:
    width, height = size
    wanted = np.array([[0.10, 0.10, 0.16, 0.90], [0.50, 0.0, 0.60, 0.70], [0.84, 0.30, 0.90, 1.0]])
    boxes = np.rint(wanted * [width, height, width, height]).astype(int)
    found = detector.detect(drawn(width, height, *boxes.tolist()), MaskDetectorSettings(picture_shape=shape))
    best = [np.abs(found.boxes_px - box).max(axis=1).argmin() for box in boxes]
    assert len(set(best)) == 3
    # The graph's cells are 8 x 4 pixels of its own picture.
    cell = np.array([8.0, 8.0] * 2) / np.tile(detector.shrink(drawn(width, height), shape), 2)
    assert (np.abs(found.boxes_px[best] - boxes) <= cell + 1).all()
    assert (found.scores[best] > 0.6).all()
    assert (np.diff(found.scores) <= 0).all()
    assert set(found.phrases) == {"tree trunk"}
    assert (found.boxes_px >= 0).all()
    assert (found.boxes_px <= [width, height, width, height]).all()


def test_the_prompt_decides(detector: GroundingDino) -> None:
    rgb = drawn(800, 800, (300, 100, 360, 700))
    assert len(detector.detect(rgb, MaskDetectorSettings(prompt="person"))) == 0
    both = detector.detect(rgb, MaskDetectorSettings(prompt="person. trunk"))
    assert set(both.phrases) == {"trunk"}
    assert len(detector.detect(drawn(800, 800))) == 0
    with pytest.raises(SettingError, match="At most 256"):
        detector.detect(rgb, MaskDetectorSettings(prompt="tree " * 300))


def test_several_phrases_are_asked_one_by_one(detector: GroundingDino, folder: Path) -> None:
    rgb, settings = drawn(800, 800, (300, 100, 360, 700)), MaskDetectorSettings(prompt="tree trunk. pole. person")
    asked: list[int] = []

    class Listening:
        path, inputs, outputs = detector.graph.path, detector.graph.inputs, detector.graph.outputs
        problems = detector.graph.problems

        def run(self, feed: dict) -> dict:
            asked.append(feed["input_ids"].shape[1])
            return detector.graph.run(feed)

    one_by_one = GroundingDino(Listening(), words()).detect(rgb, settings)
    assert asked == [5, 4, 4]
    asked.clear()
    together = GroundingDino(Listening(), words(), phrases_together=True).detect(rgb, settings)
    assert asked == [9]
    assert np.allclose(one_by_one.boxes_px, together.boxes_px)
    onnx_graphs.detector(folder / "masks.onnx", text_masks=True)
    given_masks = GroundingDino.open({"model": folder / "masks.onnx", "vocabulary": folder / "vocab.txt"})
    assert np.allclose(given_masks.detect(rgb, settings).boxes_px, together.boxes_px)


def test_a_graph_of_another_size_is_asked_in_its_own(folder: Path) -> None:
    onnx_graphs.detector(folder / "wide.onnx", side=(544, 960))
    detector = GroundingDino.open({"model": folder / "wide.onnx", "vocabulary": folder / "vocab.txt"})
    assert detector.size_px == (544, 960)
    found = detector.detect(drawn(1920, 1000, (960, 100, 1060, 900)))
    assert np.abs(found.boxes_px[0] - [960, 100, 1060, 900]).max() <= 17


def test_an_open_graph_is_used_only_at_the_size_it_was_traced_at(folder: Path, tmp_path: Path) -> None:
    path = onnx_graphs.detector(tmp_path / "open.onnx", opens=("pixel_values", "pixel_mask"))
    paths = {"model": path, "vocabulary": folder / "vocab.txt"}
    with pytest.raises(ModelError, match="wrong boxes"):
        GroundingDino.open(paths)
    detector = GroundingDino.open(paths, traced_px=(800, 800))
    assert detector.prepare(drawn(640, 480))[0].shape == (1, 3, 800, 800)
    with pytest.raises(ModelError, match="800 x 800"):
        GroundingDino.open({**paths, "model": folder / "dino.onnx"}, traced_px=(640, 640))


def test_a_prompt_is_filled_up_where_the_graph_wants_it(folder: Path, tmp_path: Path, detector: GroundingDino) -> None:
    rgb = drawn(800, 800, (300, 100, 360, 700))
    for text_masks in (False, True):
        path = onnx_graphs.detector(tmp_path / "long.onnx", length=16, text_masks=text_masks)
        fixed = GroundingDino.open({"model": path, "vocabulary": folder / "vocab.txt"})
        assert np.allclose(fixed.detect(rgb).boxes_px, detector.detect(rgb).boxes_px)
        assert fixed.read("tree.")["attention_mask"].tolist() == [[1] * 4 + [0] * 12]
        with pytest.raises(SettingError, match="At most 16"):
            fixed.read("tree " * 20)


def test_only_boxes_of_a_trunks_size_are_kept(detector: GroundingDino) -> None:
    boxes = np.array([[0.0, 0, 800, 600], [0, 0, 700, 100], [100, 0, 300, 780], [5, 5, 7, 700], [5, 5, 50, 7]])
    settings = MaskDetectorSettings()
    kept = is_of_trunk_size(boxes, 800, 800, np.ones(2), settings)
    assert kept.tolist() == [False, False, True, False, False]
    # A thin box of a large picture is thinner still in the one the detector sees.
    shrunk = is_of_trunk_size(np.array([[0.0, 0, 7, 700]]), 1600, 1600, np.full(2, 0.5), settings)
    assert not shrunk[0]
    assert is_of_trunk_size(np.array([[0.0, 0, 9, 700]]), 1600, 1600, np.full(2, 0.5), settings)[0]


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 0.9))
def test_unlike_boxes(seed: int, overlap: float) -> None:
    rng = np.random.default_rng(seed)
    boxes = corners(np.column_stack([rng.uniform(20, 80, (30, 2)), rng.uniform(2, 40, (30, 2))]))
    scores = rng.uniform(0, 1, 30).astype(np.float32)

    def iou(a: np.ndarray, b: np.ndarray) -> float:
        sides = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
        shared = np.clip(sides, 0, None).prod()
        return shared / ((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod() - shared)

    kept: list[int] = []
    for i in np.argsort(-scores, kind="stable"):
        if all(iou(boxes[i], boxes[j]) <= overlap for j in kept):
            kept.append(int(i))
    assert unlike_boxes(boxes, scores, overlap).tolist() == kept
    assert len(unlike_boxes(boxes, scores, 1.0)) == 30


def test_graphs_that_would_be_wrong_are_refused(folder: Path, tmp_path: Path) -> None:
    def refused(path: Path) -> str:
        with pytest.raises(ModelError) as caught:
            GroundingDino.open({"model": path, "vocabulary": folder / "vocab.txt"})
        return str(caught.value)

    for name in ("pixel_values", "pixel_mask"):
        onnx_graphs.detector(tmp_path / "open.onnx", opens=(name,))
        if name == "pixel_values":
            message = refused(tmp_path / "open.onnx")
            assert "wrong boxes" in message
            assert "800 x 800" in message
    encoder, _ = tinymodels.sam2(tmp_path)
    assert "input_ids" in refused(encoder)
    onnx_graphs.meta_encoder(tmp_path / "sam.onnx", raw=True)
    assert "no input pixel_values" in refused(tmp_path / "sam.onnx")


def test_a_broken_graph_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.onnx").write_bytes(b"\x08\x07 this is no model")
    with pytest.raises(MalformedFileError, match="no model"):
        Graph(tmp_path / "broken.onnx")
    with pytest.raises(FileMissingError):
        Graph(tmp_path / "none.onnx")


def test_no_numbers_are_an_error(detector: GroundingDino) -> None:
    class Overflowing:
        path, inputs, outputs = detector.graph.path, detector.graph.inputs, detector.graph.outputs
        problems = detector.graph.problems

        def run(self, feed: dict) -> dict:
            answer = detector.graph.run(feed)
            answer["logits"][0, 3, 2] = np.nan
            return answer

    with pytest.raises(ModelError, match="float32"):
        GroundingDino(Overflowing(), words()).detect(drawn(800, 800))


def test_a_failing_card_leaves_the_work_to_the_processor(
    folder: Path, detector: GroundingDino, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A provider that is listed but fails, at opening or at work; a real card is not here to fail."""
    import onnxruntime

    rgb = drawn(800, 800, (300, 100, 360, 700))
    expected = detector.detect(rgb)
    fails_at = ""
    real = onnxruntime.InferenceSession

    class Card:
        def __init__(self, path: str, options: object, providers: list) -> None:
            self.is_card = providers[0][0] == "CUDAExecutionProvider"
            if self.is_card and fails_at == "opening":
                raise RuntimeError("no driver")
            self.session = real(path, options, providers=[("CPUExecutionProvider", {})])

        def get_providers(self) -> list:
            return ["CUDAExecutionProvider" if self.is_card else "CPUExecutionProvider"]

        def run(self, names: list, feed: dict) -> list:
            if self.is_card:
                raise RuntimeError("out of memory\nlong trace")
            return self.session.run(names, feed)

        def __getattr__(self, name: str) -> object:
            return getattr(self.session, name)

    monkeypatch.setattr(onnxruntime, "InferenceSession", Card)
    listed = ["AzureExecutionProvider", "CPUExecutionProvider", "CUDAExecutionProvider"]
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: listed)
    assert onnx_runtime.available_providers() == ("cuda", "cpu")
    for moment, said in (("opening", "no driver"), ("work", "out of memory")):
        fails_at = moment
        graph = Graph(folder / "dino.onnx")
        found = GroundingDino(graph, words()).detect(rgb)
        assert np.allclose(found.boxes_px, expected.boxes_px)
        assert graph.provider == "CPUExecutionProvider"
        assert len(graph.notes) == 1
        assert said in graph.notes[0]
        assert "long trace" not in graph.notes[0]


def test_a_provider_that_is_not_there_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import onnxruntime

    listed = ["AzureExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: listed)
    assert choose_provider(ModelRunSettings()) == "CPUExecutionProvider"
    with pytest.raises(MissingComponentError, match="it can use: cpu"):
        Graph(folder / "dino.onnx", ModelRunSettings(provider="directml"))


def test_which_model_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    detectors = [spec for spec in read_manifest().models if spec.family == "gdino"]
    names = [spec.name for spec in detectors]
    cpu, card = ModelRunSettings(provider="cpu"), ModelRunSettings()
    assert choose_model(detectors, cpu).name == "grounding-dino-tiny"
    assert choose_model(detectors[1:], cpu.changed(precision="int8")).precision == "int8"
    assert choose_model(detectors, cpu, name=names[-1]).name == names[-1]
    assert choose_model([], cpu) is None
    assert choose_model(detectors[:1], cpu.changed(precision="int8")) is None
    monkeypatch.setattr(onnx_runtime, "available_providers", lambda: ("cuda", "cpu"))
    assert choose_model(detectors, card).precision == "float16"
