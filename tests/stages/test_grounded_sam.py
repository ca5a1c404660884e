"""From a photo to its trunks, end to end, with graphs that find what is brown; the truth is drawn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from tests import onnx_graphs
from tests.drawn_trunks import EYE_M, Stand, iou
from tests.io import tinymodels

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.mask_views import MaskView
from dbh_studio.core.posed_images import PosedImages
from dbh_studio.core.tiles import up_in_camera
from dbh_studio.errors import CancelledError, FileMissingError, ModelError, SettingError
from dbh_studio.io.models import ModelStore
from dbh_studio.settings import MaskDetectorSettings, ModelRunSettings, VoteSettings
from dbh_studio.stages import mask_models
from dbh_studio.stages.grounded_sam import photo_tiles, segment_boxes, segment_image, segment_photo, segment_trunks
from dbh_studio.stages.grounding_dino import GroundingDino
from dbh_studio.stages.instance_masks import PhotoMasks, painted
from dbh_studio.stages.sam import Sam
from dbh_studio.stages.trunk_prompts import TrunkShape, trunk_boxes
from dbh_studio.stages.vote import trunk_candidates

# The first stands on the seam, the second across the border of two tiles, the sixth near, two are neighbours.
STAND = Stand(
    (
        (0.1, -4.0, 0.20),
        (3.2, 4.4, 0.15),
        (-4.0, 1.0, 0.25),
        (5.0, -2.0, 0.20),
        (-2.0, 5.0, 0.14),
        (-1.4, -2.0, 0.30),
        (-1.2, 5.1, 0.14),
    )
)
PANORAMA = CameraModel("EQUIRECTANGULAR", 1280, 640, ())
SMALL = MaskDetectorSettings(tile_size_px=512, mask_size_px=1280)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("graphs")
    onnx_graphs.vocabulary(path / "vocab.txt")
    onnx_graphs.detector(path / "model.onnx")
    onnx_graphs.meta_encoder(path / "encoder.onnx", raw=True)
    onnx_graphs.meta_decoder(path / "decoder.onnx")
    tinymodels.sam2(path)
    return path


@pytest.fixture(scope="module")
def detector(folder: Path) -> GroundingDino:
    return GroundingDino.open({"model": folder / "model.onnx", "vocabulary": folder / "vocab.txt"})


@pytest.fixture(scope="module")
def sam(folder: Path) -> Sam:
    return Sam.open({"encoder": folder / "encoder.onnx", "decoder": folder / "decoder.onnx"})


@pytest.fixture(scope="module")
def panorama() -> tuple[np.ndarray, np.ndarray]:
    return STAND.draw(STAND.photo(PANORAMA))


@pytest.fixture(scope="module")
def found(detector: GroundingDino, sam: Sam, panorama: tuple[np.ndarray, np.ndarray]) -> PhotoMasks:
    return segment_photo(STAND.photo(PANORAMA), detector, sam, SMALL, picture=panorama[0])


def check_one_label_per_trunk(labels: np.ndarray, truth: np.ndarray, known: np.ndarray, *, least_iou: float) -> None:
    """Each trunk, as far as something is known of it, is one label, whole and by itself."""
    taken = []
    for number in range(1, len(STAND.trunks) + 1):
        wanted = (truth == number) & known
        here, counts = np.unique(labels[wanted], return_counts=True)
        label = here[np.argmax(counts)]
        assert label > 0, number
        assert not set(here.tolist()) - {0, int(label)}, number
        assert iou((labels == label) & known, wanted) > least_iou, number
        taken.append(int(label))
    assert len(set(taken)) == len(taken)
    assert set(np.unique(labels).tolist()) == {0, *taken}


def test_every_trunk_of_a_panorama_is_one(found: PhotoMasks, panorama: tuple[np.ndarray, np.ndarray]) -> None:
    mask = found.trunk_mask(1280)
    assert mask.size == (1280, 640)
    assert mask.ignored is not None
    check_one_label_per_trunk(mask.labels, panorama[1], ~mask.ignored, least_iou=0.8)
    # The first stands on the seam.
    assert (mask.labels[:, 0] > 0).any()
    assert (mask.labels[:, -1] > 0).any()
    assert set(found.scores) == set(mask.numbers)
    assert len(found) == len(STAND.trunks)
    assert all(0.3 < score <= 1.0 for score in found.scores.values())
    # Beyond the tiles, near the poles, nothing is known.
    assert mask.ignored[[0, -1]].all()
    assert not mask.ignored[320].any()
    assert found.trunk_mask(500).size == (500, 250)


def test_a_panorama_answers_for_points(found: PhotoMasks) -> None:
    view: MaskView = found
    photo = STAND.photo(PANORAMA)
    for number, (x, y, radius) in enumerate(STAND.trunks):
        away = np.hypot(x, y)
        near = np.array([x, y, 0]) * (1 - radius / away) + [0, 0, EYE_M]
        beside = np.array([x, y, 0]) + 3 * radius * np.array([y, -x, 0]) / away + [0, 0, EYE_M]
        points = np.stack([near, beside])
        labels, is_known = view.look_up((points - photo.centre_src) @ photo.cam_from_source.rotation.T)
        assert is_known.all()
        assert labels[0] > 0
        if number not in (4, 6):  # beside these stands the other
            assert labels[1] == 0
    assert view.has_instances


def test_stems_are_upright_in_the_tiles_of_a_tilted_panorama(detector: GroundingDino, sam: Sam) -> None:
    photo = STAND.photo(PANORAMA, Rotation.from_euler("xz", [25, 15], degrees=True).as_matrix())
    rgb, truth = STAND.draw(photo)
    masks = segment_photo(photo, detector, sam, SMALL, picture=rgb, up_cam=up_in_camera(photo, [0.0, 0.0, 1.0]))
    mask = masks.trunk_mask(1280)
    check_one_label_per_trunk(mask.labels, truth, ~mask.ignored, least_iou=0.75)


def test_a_pole_is_looked_at_where_it_is_asked_for(detector: GroundingDino, sam: Sam) -> None:
    photo = STAND.photo(PANORAMA)
    tiles = photo_tiles(photo, SMALL.changed(tile_pitches_deg=(0.0, 90.0)))
    assert len(tiles) == 6
    assert np.allclose(tiles.tiles[-1].tile_from_cam[2], [0.0, -1.0, 0.0])


def test_the_papers_way_looks_at_the_panorama_as_it_is(
    detector: GroundingDino, sam: Sam, panorama: tuple[np.ndarray, np.ndarray]
) -> None:
    masks = segment_photo(STAND.photo(PANORAMA), detector, sam, SMALL.changed(panorama="whole"), picture=panorama[0])
    mask = masks.trunk_mask(1280)
    assert mask.ignored is None
    assert len(masks.parts) == 1
    # Both halves of the trunk on the seam have one label.
    first = np.unique(mask.labels[:, 0])[1:]
    assert np.array_equal(first, np.unique(mask.labels[:, -1])[1:])
    assert len(first) == 1
    wanted = panorama[1] == 1
    assert iou(mask.labels == first[0], wanted) > 0.6


@pytest.mark.parametrize(
    "camera",
    [
        CameraModel("PINHOLE", 900, 600, (450, 450, 450, 300)),
        CameraModel("OPENCV_FISHEYE", 700, 700, (260, 260, 350, 350, 0.01, 0, 0, 0)),
    ],
)
def test_other_photos_are_looked_at_as_they_are(detector: GroundingDino, sam: Sam, camera: CameraModel) -> None:
    stand = Stand(((-1.0, 4.0, 0.2), (0.6, 5.0, 0.2)))
    photo = stand.photo(camera)
    rgb, truth = stand.draw(photo)
    masks = segment_photo(photo, detector, sam, picture=rgb)
    mask = masks.trunk_mask()
    assert mask.size == (camera.width_px, camera.height_px)
    for number in (1, 2):
        here, counts = np.unique(mask.labels[truth == number], return_counts=True)
        label = here[np.argmax(counts)]
        assert label > 0
        assert iou(mask.labels == label, truth == number) > 0.6
    assert len(masks) == 2


def test_a_photo_is_read_from_its_file(detector: GroundingDino, sam: Sam, tmp_path: Path) -> None:
    stand = Stand(((0.0, 4.0, 0.25),))
    photo = stand.photo(CameraModel("PINHOLE", 400, 400, (300, 300, 200, 200)))
    Image.fromarray(stand.draw(photo)[0]).save(tmp_path / "photo.png")
    with pytest.raises(FileMissingError):
        segment_photo(photo, detector, sam)
    masks = segment_photo(replace(photo, path=str(tmp_path / "photo.png")), detector, sam)
    assert len(masks) == 1


def test_a_photo_without_trunks_says_so(detector: GroundingDino, sam: Sam) -> None:
    photo = Stand(()).photo(PANORAMA)
    masks = segment_photo(photo, detector, sam, SMALL, picture=Stand(()).draw(photo)[0])
    assert len(masks) == 0
    labels, is_known = masks.look_up(np.array([[0.0, 0.0, 5.0]]))
    assert is_known.all()
    assert not labels.any()


def test_trunks_of_the_geometry_are_outlined_without_a_detector(
    sam: Sam, panorama: tuple[np.ndarray, np.ndarray]
) -> None:
    masks = segment_trunks(STAND.photo(PANORAMA), STAND.shapes(), sam, SMALL, picture=panorama[0])
    assert masks.trunk_ids == {i + 1: i + 11 for i in range(len(STAND.trunks))}
    mask = masks.trunk_mask(1280)
    _, rays = STAND.photo(PANORAMA).ray(_pixels(1280, 640))
    low = (rays[:, 2] * 3.0 + EYE_M < 3.0).reshape(640, 1280)  # the part below the cylinders' tops, at 3 m and beyond
    for number in range(1, len(STAND.trunks) + 1):
        wanted = (panorama[1] == number) & low & ~mask.ignored
        assert np.mean(mask.labels[wanted] == number) > 0.75, number
        others = (panorama[1] > 0) & (panorama[1] != number)
        assert not (mask.labels[others] == number).any(), number


def test_trunks_in_a_photo_that_is_no_panorama(sam: Sam) -> None:
    stand = Stand(((-1.0, 4.0, 0.2), (0.6, 5.0, 0.2), (0.0, -4.0, 0.2)))
    photo = stand.photo(CameraModel("PINHOLE", 900, 600, (450, 450, 450, 300)))
    rgb, truth = stand.draw(photo)
    masks = segment_trunks(photo, stand.shapes(), sam, picture=rgb)
    assert masks.trunk_ids == {1: 11, 2: 12}
    labels = masks.trunk_mask().labels
    for number in (1, 2):
        assert iou(labels == number, truth == number) > 0.6
    # Where nothing was asked nothing is known: such a photo must not vote against.
    nothing = segment_trunks(photo, stand.shapes()[2:], sam, picture=rgb)
    assert len(nothing) == 0
    assert not nothing.look_up(np.array([[0.0, 0.0, 5.0]]))[1].any()
    assert (
        segment_trunks(STAND.photo(PANORAMA), [], sam, SMALL, picture=np.zeros((640, 1280, 3), np.uint8)).scores == {}
    )


def test_boxes_of_trunks() -> None:
    camera = CameraModel("PINHOLE", 900, 600, (450, 450, 450, 300))
    stand = Stand(
        (
            (0.0, 4.0, 0.20),
            (0.1, 9.0, 0.15),  # behind the first
            (2.0, 6.0, 0.20),
            (-2.0, 30.0, 0.20),  # far away
            (0.0, -4.0, 0.20),  # behind the camera
            (-4.17, 4.0, 0.20),  # cut by the border
            (-1.5, 8.0, 0.01),  # thin
        )
    )
    photo = stand.photo(camera)
    asked = trunk_boxes(photo, stand.shapes(), max_distance_m=15.0, min_box_px=6.0)
    assert asked.rows.tolist() == [0, 2]
    assert asked.distance == pytest.approx([np.hypot(4.0, 0.55), np.sqrt(40 + 0.55**2)], rel=0.01)
    truth = stand.draw(photo)[1]
    for row, box in zip(asked.rows, asked.boxes_px, strict=True):
        columns = np.flatnonzero((truth == row + 1).any(axis=0))
        assert box[0] == pytest.approx(columns[0], abs=8)
        assert box[2] == pytest.approx(columns[-1] + 1, abs=8)
        assert box[0] <= columns[0]
        assert box[2] >= columns[-1] + 1
    with pytest.raises(ValueError, match="tiles"):
        trunk_boxes(stand.photo(PANORAMA), stand.shapes())
    with pytest.raises(ValueError, match="cylinder"):
        TrunkShape.cylinder(1, (0, 0, 0), (0, 0, 0), 0.1)
    assert len(trunk_boxes(photo, [TrunkShape(1, np.full((3, 3), np.nan))]).rows) == 0


def test_given_boxes_are_outlined(sam: Sam) -> None:
    rgb = np.full((300, 400, 3), 200, np.uint8)
    rgb[20:280, 100:140] = rgb[20:280, 250:290] = (92, 66, 43)
    masks = segment_boxes(rgb, [[95, 15, 145, 285], [245, 15, 295, 285]], sam)
    assert len(masks) == 2
    assert masks.labels[150, 120] == 1
    assert masks.labels[150, 270] == 2
    assert masks.scores == pytest.approx([0.9, 0.9])
    assert len(segment_boxes(rgb, np.zeros((0, 4)), sam)) == 0
    # A mask need not be as fine as the picture.
    small = segment_boxes(rgb, [[95, 15, 145, 285]], sam, MaskDetectorSettings(mask_size_px=256))
    assert small.labels.shape == (192, 256)
    assert iou(small.labels == 1, masks.labels[::, ::][_rows(300, 192)][:, _rows(400, 256)] == 1) > 0.9


def test_masks_that_overlap_become_one_trunk_or_two() -> None:
    def block(x0: int, x1: int, y0: int, y1: int) -> np.ndarray:
        mask = np.zeros((100, 100), bool)
        mask[y0:y1, x0:x1] = True
        return mask

    masks = [
        (block(10, 20, 0, 50), 0.9),
        (block(10, 20, 0, 90), 0.8),  # the first, seen longer
        (block(40, 50, 0, 90), 0.7),
        (block(11, 19, 10, 40), 0.6),  # a part of the first
        (block(8, 52, 0, 95), 0.5),  # over both
        (block(48, 60, 0, 90), 0.4),  # a neighbour that overlaps a little
        (block(70, 72, 0, 2), 0.3),  # nothing
        (block(10, 20, 0, 92), 0.2),  # the first once more
        (block(80, 84, 0, 20), 0.2),
        (block(78, 99, 0, 90), 0.1),  # holds the one before, but is no trunk that is seen longer
    ]
    found, rows = painted(masks, np.zeros((10, 4)), size_px=(100, 100), overlap=0.5)
    assert rows.tolist() == [0, 2, 5, 8, 9]
    assert found.scores == pytest.approx([0.9, 0.7, 0.4, 0.2, 0.1])
    assert np.array_equal(found.labels == 1, masks[1][0])
    assert np.array_equal(found.labels == 2, masks[2][0])
    assert np.array_equal(found.labels == 3, masks[5][0] & ~masks[2][0])
    apart, rows = painted(masks[:3], np.zeros((3, 4)), size_px=(100, 100), overlap=0.7, may_join=False)
    assert rows.tolist() == [0, 1, 2]
    assert apart.labels[60, 15] == 2


def test_progress_goes_up_and_stops_the_work(
    detector: GroundingDino, sam: Sam, panorama: tuple[np.ndarray, np.ndarray]
) -> None:
    said: list[tuple[float, str]] = []

    def cancel_late(fraction: float, message: str = "") -> None:
        said.append((fraction, message))
        if fraction > 0.45:
            raise CancelledError

    with pytest.raises(CancelledError):
        segment_photo(STAND.photo(PANORAMA), detector, sam, SMALL, picture=panorama[0], progress=cancel_late)
    fractions = [fraction for fraction, _ in said]
    assert fractions == sorted(fractions)
    assert any("Tile 3 of 5" in message for _, message in said)
    done: list[float] = []
    segment_image(panorama[0][:, :640], detector, sam, progress=lambda fraction, message="": done.append(fraction))
    assert done == sorted(done)


def test_tiles_that_leave_gaps_are_refused() -> None:
    photo = STAND.photo(PANORAMA)
    with pytest.raises(SettingError, match="gaps"):
        photo_tiles(photo, MaskDetectorSettings(tile_count=4, tile_fov_deg=90.0))
    with pytest.raises(SettingError, match="Rows"):
        photo_tiles(photo, MaskDetectorSettings(tile_pitches_deg=(95.0,)))
    with pytest.raises(SettingError, match="Rows"):
        photo_tiles(photo, MaskDetectorSettings(tile_pitches_deg=()))


def test_masks_of_photos_find_the_trunks_of_a_cloud(detector: GroundingDino, sam: Sam) -> None:
    """The whole way: pictures, tiles, boxes, masks, votes."""
    rng = np.random.default_rng(0)
    stand = Stand(STAND.trunks[:4])
    photos = []
    for i, place in enumerate([(0.8, -0.6), (-0.9, 0.7)]):
        seen = Stand(tuple((x - place[0], y - place[1], r) for x, y, r in stand.trunks))
        photo = seen.photo(PANORAMA)
        masks = segment_photo(photo, detector, sam, SMALL, picture=seen.draw(photo)[0])
        rotation = photo.cam_from_source.rotation
        moved = replace(photo.cam_from_source, translation=-(rotation @ [*place, EYE_M]))
        photos.append((replace(photo, name=f"{i}.jpg", cam_from_source=moved), masks))
    angle = rng.uniform(0, 2 * np.pi, (4, 1500))
    bark = [
        np.column_stack([x + r * np.cos(a), y + r * np.sin(a), rng.uniform(0.4, 2.8, a.size)])
        for (x, y, r), a in zip(stand.trunks, angle, strict=True)
    ]
    air = rng.uniform([-6, -6, 0.4], [6, 6, 2.8], (6000, 3))
    trunks = np.array(stand.trunks)
    gap = (np.linalg.norm(air[:, None, :2] - trunks[None, :, :2], axis=2) - trunks[:, 2]).min(axis=1)
    air = air[gap > 0.25]
    points = np.concatenate([*bark, air])
    by_name = {photo.name: masks for photo, masks in photos}
    settings = VoteSettings(occlusion=False, min_share=0.6)
    votes = trunk_candidates(
        points, PosedImages(tuple(photo for photo, _ in photos)), lambda photo: by_name[photo.name], settings=settings
    )
    is_trunk = votes.is_trunk(settings)
    is_bark = np.arange(len(points)) < 6000
    # Both photos must say so: on the limb of a trunk one of them does not see it.
    assert np.mean(is_trunk[is_bark]) > 0.85
    assert np.mean(is_bark[is_trunk]) > 0.9


def test_models_are_opened_from_the_store(folder: Path, tmp_path: Path) -> None:
    store = ModelStore(folder=tmp_path / "models", offline=True)
    assert mask_models.rung(store) == "none"
    with pytest.raises(ModelError, match="No segmenter"):
        mask_models.open_grounded_sam(store, with_detector=False)
    store.add([folder / "vision_encoder.onnx", folder / "prompt_encoder_mask_decoder.onnx"], name="sam2.1-tiny")
    # Its weights are in files of their own, which the tiny graphs do not have; MobileSAM's are not.
    assert mask_models.rung(store) == "none"
    store.add([folder / "encoder.onnx", folder / "decoder.onnx"], name="mobile-sam")
    assert mask_models.rung(store) == "prompted"
    with pytest.raises(ModelError, match="No detector"):
        mask_models.open_grounded_sam(store)
    alone = mask_models.open_grounded_sam(store, with_detector=False)
    settings = MaskDetectorSettings()
    assert alone.recipe(settings).method == "prompted_sam"
    (tmp_path / "vocab.txt").write_text((folder / "vocab.txt").read_text())
    store.add([tmp_path / "vocab.txt"], name="bert-uncased-vocabulary")
    store.add([folder / "model.onnx"], name="grounding-dino-tiny")
    assert mask_models.rung(store) == "detector"
    done: list[float] = []
    models = mask_models.open_grounded_sam(store, progress=lambda fraction, message="": done.append(fraction))
    assert models.models == ("grounding-dino-tiny", "mobile-sam")
    assert done == sorted(done)
    assert models.notes == ()
    recipe = models.recipe(settings)
    assert recipe.method == "grounded_sam"
    assert recipe.prompt == "tree trunk"
    assert set(recipe.models) == set(models.models)
    assert recipe.key != models.recipe(settings.changed(box_threshold=0.2)).key
    assert recipe.key == models.recipe(MaskDetectorSettings()).key
    with pytest.raises(ModelError, match="precision int8"):
        mask_models.open_grounded_sam(store, ModelRunSettings(precision="int8"))
    with pytest.raises(ModelError, match="not on this computer"):
        mask_models.open_grounded_sam(store, detector="grounding-dino-tiny-int8")
    rgb = np.full((400, 400, 3), 200, np.uint8)
    rgb[40:380, 180:210] = (92, 66, 43)
    assert len(segment_image(rgb, models.detector, models.segmenter)) == 1


def _pixels(width: int, height: int) -> np.ndarray:
    across, down = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.column_stack([across.ravel(), down.ravel()])


def _rows(n: int, wanted: int) -> np.ndarray:
    """Rows of n at the centres of `wanted` ones."""
    return ((np.arange(wanted) + 0.5) * n / wanted).astype(int)
