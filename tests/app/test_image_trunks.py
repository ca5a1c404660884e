"""Trunks from masks a person brings: found, understood or asked about, voted, and put into the plot."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.maskplot import ORIGIN_M, POLE, MaskPlot, coco, labels, save_mask, save_masks, write_mask_plot
from tests.threestems import STEMS

from dbh_studio.app import commands
from dbh_studio.app.brought_masks import MaskRequest, find_brought_masks, read_masks
from dbh_studio.app.image_trunks import (
    apply_image_trunks,
    find_image_trunks,
    image_trunks_call,
    masks_of_plot,
    trunks_from_masks,
)
from dbh_studio.app.mask_overlay import overlay_picture, write_overlay
from dbh_studio.app.opening import open_plot
from dbh_studio.app.session import Session
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import CancelledError, FileError, FileMissingError, SettingError, StaleResultError
from dbh_studio.settings import VoteSettings

PLACES = np.array([(x, y) for x, y, _ in STEMS])


@pytest.fixture(scope="module")
def plot(tmp_path_factory) -> MaskPlot:
    return write_mask_plot(tmp_path_factory.mktemp("mask_plot"))


@pytest.fixture(scope="module")
def opened(plot: MaskPlot) -> Session:
    """The plot with its photos and no trunks; a test that adds some takes them away."""
    session = open_plot(plot.cloud, scale="metres")
    masks_of_plot(session, request(plot, categories=("1-3",)))
    return session


@pytest.fixture
def session(opened: Session):
    before = opened.document
    yield opened
    while opened.document is not before:
        opened.undo()


def request(plot: MaskPlot, path: Path | None = None, **options: object) -> MaskRequest:
    return MaskRequest(path or plot.masks, cameras=plot.poses, images_dir=plot.folder / "images", **options)


def places(session: Session) -> np.ndarray:
    """(T, 2) where the trunks stand, metres in the plot's own coordinates."""
    points = session.points_world()
    shift = session.cloud.origin * session.document.scale.metres_per_unit - ORIGIN_M
    return np.array([np.median(points[t.points, :2], axis=0) for t in session.document.trunks]) + shift[:2]


def found(session: Session, wanted: MaskRequest) -> tuple[str, ...]:
    masks = masks_of_plot(session, wanted)
    return masks.notes + trunks_from_masks(session, masks, wanted.votes).notes


def check_stems(session: Session) -> None:
    np.testing.assert_allclose(places(session), PLACES, atol=0.05)
    rows = list(session.inventory())
    assert [row.dbh_cm for row in rows] == pytest.approx([100 * d for _, _, d in STEMS], rel=0.02)


# ---- from masks to trunks


def test_only_what_the_masks_call_trunk_becomes_one(plot, session):
    notes = found(session, request(plot, categories=("1-3",)))
    assert "Trunks from 8 masks." in notes
    assert any("Masks of 8 of 8 photos were found" in note for note in notes)
    assert any("2 photos call it trunk, and 40 %" in note for note in notes)
    check_stems(session)
    # One step, and nothing else is undone with it.
    assert session.undo_label == "Find 3 trunks from 8 masks"
    session.undo()
    assert not len(session.document.trunks) and session.document.cameras is not None


def test_every_number_is_a_trunk_where_none_is_named(plot, session):
    notes = found(session, request(plot))
    assert any("They are read as: Each trunk or class has a number" in note for note in notes)
    wanted = np.array(sorted([*map(tuple, PLACES), POLE[:2]]))
    np.testing.assert_allclose(np.array(sorted(map(tuple, places(session)))), wanted, atol=0.05)


def test_a_plot_in_any_unit(tmp_path):
    plot = write_mask_plot(tmp_path / "plot", unit_m=0.37)
    session = open_plot(plot.cloud, scale=0.37)
    found(session, request(plot, categories=("1", "2", "3")))
    check_stems(session)


def test_in_a_child_process(plot, session):
    masks = masks_of_plot(session, request(plot, categories=("1-3",)))
    seen: list[float] = []
    result = trunks_from_masks(
        session, masks, in_process=False, progress=lambda fraction, message="": seen.append(fraction)
    )
    assert result.rung == "masks" and result.n_masks == 8 and seen == sorted(seen) and len(seen) > 8
    assert result.votes is not None and len(result.votes) == len(session.cloud)
    on_trunk = np.concatenate([trunk.points for trunk in result.trunks])
    assert result.votes.n_trunk[on_trunk].mean() > 2.0 and result.votes.n_trunk.max() <= 8
    check_stems(session)


def test_cancelling_changes_nothing(plot, session):
    masks = masks_of_plot(session, request(plot, categories=("1-3",)))
    before = session.document

    def press_cancel(fraction: float, message: str = "") -> None:
        if message.startswith("Photo 3"):
            raise CancelledError

    with pytest.raises(CancelledError):
        trunks_from_masks(session, masks, progress=press_cancel)
    assert session.document is before


def test_a_result_for_another_scale_is_refused(plot, session):
    masks = masks_of_plot(session, request(plot, categories=("1-3",)))
    document = session.document
    result = find_image_trunks(*image_trunks_call(session, document, session.cameras, masks))
    session.do(commands.set_scale(ScaleEstimate(0.9, "factor")))
    with pytest.raises(StaleResultError, match="scale"):
        apply_image_trunks(session, document, result)
    assert not len(session.document.trunks)


def test_the_papers_rule_and_ours(plot, session):
    """A photo sees one side of a stem; by the paper's rule it speaks of the far side, too."""
    masks = masks_of_plot(session, request(plot, categories=("1-3",)))
    call = image_trunks_call(session, session.document, session.cameras, masks)
    ours = find_image_trunks(*call)
    paper = find_image_trunks(*call[:-1], VoteSettings.paper())
    assert any("points behind others vote too" in note for note in paper.notes)
    assert np.count_nonzero(paper.votes.n_trunk) > 1.2 * np.count_nonzero(ours.votes.n_trunk)


# ---- what they mean


def test_bright_trunks_are_seen_to_be_that(plot, session, tmp_path):
    bright = save_masks(tmp_path, lambda each: 255 * ((each > 0) & (each < 9)), "_mask.png")
    masks = read_masks(request(plot, bright), session.cameras.posed)
    assert masks.meaning == "trunk_bright" and masks.match.style == "suffix"
    assert any("Trunks are bright" in note for note in masks.notes)


def test_dark_ones_may_also_be_for_structure_from_motion(plot, session, tmp_path):
    dark = save_masks(tmp_path, lambda each: 255 * ((each == 0) | (each == 9)))
    posed = session.cameras.posed
    assert "SfM" in find_brought_masks(request(plot, dark), posed).unclear
    with pytest.raises(SettingError, match="--mask-meaning"):
        read_masks(request(plot, dark), posed)
    found(session, request(plot, dark, meaning="trunk_dark"))
    check_stems(session)


def test_masks_that_only_ignore_find_no_trunks(plot, session, tmp_path):
    def under_the_camera(each: np.ndarray) -> np.ndarray:
        return np.where(np.arange(each.shape[0])[:, None] < 420, 255, 0) * np.ones_like(each, int)

    walker = save_masks(tmp_path, under_the_camera)
    with pytest.raises(SettingError, match=r"what to ignore.*--ignore-masks"):
        read_masks(request(plot, walker), session.cameras.posed)
    notes = found(session, request(plot, walker, meaning="ignore_dark"))
    assert any(note.startswith("Trunks by geometry alone, because the masks say what to ignore") for note in notes)
    assert len(session.document.trunks) == 4


def test_one_mask_for_all_photos(plot, session, tmp_path):
    save_mask(tmp_path / "one.png", labels()["00.jpg"])
    with pytest.raises(SettingError, match="the camera moved"):
        read_masks(request(plot, tmp_path / "one.png", meaning="labels"), session.cameras.posed)


def test_further_masks_say_what_to_ignore(plot, session, tmp_path):
    half = np.zeros((128, 256))
    half[:, 128:] = 255
    save_mask(tmp_path / "half.png", half)
    wanted = request(plot, categories=("1-3",), ignore_path=tmp_path / "half.png")
    masks = read_masks(wanted, session.cameras.posed)
    assert any("50 % of the pixels are ignored" in note for note in masks.notes)
    mask = masks.mask("03.jpg")
    assert mask.ignored[:, :512].all() and not mask.ignored[:, 512:].any()
    np.testing.assert_array_equal(mask.labels, np.where(labels()["03.jpg"] == 9, 0, labels()["03.jpg"]))
    other = read_masks(
        request(plot, categories=("1-3",), ignore_path=tmp_path / "half.png", ignore_side="bright"),
        session.cameras.posed,
    )
    np.testing.assert_array_equal(other.mask("03.jpg").ignored, ~mask.ignored)
    both = [
        find_image_trunks(*image_trunks_call(session, session.document, session.cameras, m)) for m in (masks, other)
    ]
    seen = [result.votes.n_seen.astype(int) for result in both]
    whole = find_image_trunks(
        *image_trunks_call(session, session.document, session.cameras, read_masks(request(plot), session.cameras.posed))
    )
    np.testing.assert_array_equal(seen[0] + seen[1], whole.votes.n_seen)
    assert seen[0].max() > 0 and seen[1].max() > 0


def test_numbers_for_ground_and_sky_are_asked_about(plot, session, tmp_path):
    classes = save_masks(tmp_path, lambda each: np.where(each > 0, 4, np.where(np.arange(512)[:, None] < 256, 1, 2)))
    with pytest.raises(SettingError, match="--mask-category 7"):
        read_masks(request(plot, classes), session.cameras.posed)
    masks = read_masks(request(plot, classes, categories=("4",)), session.cameras.posed)
    np.testing.assert_array_equal(masks.mask("00.jpg").labels > 0, labels()["00.jpg"] > 0)
    absent = read_masks(request(plot, classes, categories=("77",)), session.cameras.posed)
    assert any("occur in none" in note for note in absent.notes)


@pytest.mark.parametrize("text", ["trunk", "0", "5-2", "1-70000", "-3"])
def test_numbers_that_are_none(plot, session, text):
    with pytest.raises(SettingError, match="1-12"):
        read_masks(request(plot, categories=(text,)), session.cameras.posed)


def test_numbers_of_masks_without_numbers(plot, session):
    with pytest.raises(SettingError, match="needs masks with numbers"):
        read_masks(request(plot, categories=("1",), meaning="trunk_bright"), session.cameras.posed)


# ---- which file belongs to which photo


def test_nothing_there(plot, session, tmp_path):
    posed = session.cameras.posed
    with pytest.raises(FileMissingError, match="no such file or folder"):
        read_masks(request(plot, tmp_path / "nowhere"), posed)
    with pytest.raises(FileError, match="no mask for any of the 8 photos"):
        read_masks(request(plot, tmp_path), posed)
    with pytest.raises(FileMissingError, match="no such file or folder"):
        read_masks(request(plot, ignore_path=tmp_path / "nowhere"), posed)
    with pytest.raises(SettingError, match="naming style"):
        read_masks(request(plot, style="nonsense"), posed)


def test_missing_wrong_and_damaged_masks_are_told_and_the_others_used(plot, session, tmp_path):
    folder = Path(shutil.copytree(plot.masks, tmp_path / "masks"))
    (folder / "02.png").unlink()
    save_mask(folder / "05.png", np.zeros((300, 400)))
    whole = (folder / "07.png").read_bytes()
    (folder / "07.png").write_bytes(whole[: len(whole) // 2])
    notes = found(session, request(plot, folder, categories=("1-3",)))
    assert any("1 photos have no mask: 02.jpg" in note for note in notes)
    assert any("05.jpg" in note and "400 x 300" in note for note in notes)
    assert any("07.jpg" in note and "left out" in note for note in notes)
    assert "Trunks from 5 masks." in notes
    np.testing.assert_allclose(places(session), PLACES, atol=0.05)


def test_masks_of_another_size(plot, session, tmp_path):
    smaller = save_masks(tmp_path / "smaller", lambda each: each[::2, ::2])
    found(session, request(plot, smaller, categories=("1-3",)))
    np.testing.assert_allclose(places(session), PLACES, atol=0.05)
    square = save_masks(tmp_path / "square", lambda each: each[:400, :400])
    with pytest.raises(FileError, match="400 x 400 pixels, the photo 1024 x 512"):
        read_masks(request(plot, square), session.cameras.posed)


def test_a_template_for_names(plot, session, tmp_path):
    folder = save_masks(tmp_path, lambda each: each, "-segm.png")
    with pytest.raises(FileError, match="--mask-style"):
        read_masks(request(plot, folder), session.cameras.posed)
    assert len(read_masks(request(plot, folder, style="{stem}-segm.png"), session.cameras.posed).match.found) == 8


def test_masks_without_a_trunk_leave_it_to_geometry(plot, session, tmp_path):
    empty = save_masks(tmp_path, lambda each: 0 * each)
    with pytest.raises(SettingError, match="one level only"):
        read_masks(request(plot, empty), session.cameras.posed)
    notes = found(session, request(plot, empty, meaning="trunk_bright"))
    assert any(note.startswith("Trunks by geometry alone, because no point") for note in notes)
    assert len(session.document.trunks) == 4


# ---- COCO


def write_coco(path: Path, categories: dict[int, str]) -> Path:
    path.write_text(json.dumps(coco(categories, lambda label: 2 if label == 9 else 1)))
    return path


def test_a_coco_file(plot, session, tmp_path):
    path = write_coco(tmp_path / "masks.json", {1: "tree trunk", 2: "pole"})
    notes = found(session, request(plot, path))
    assert any("by their names: tree trunk." in note for note in notes)
    check_stems(session)


def test_categories_are_named_or_asked_for(plot, session, tmp_path):
    path = write_coco(tmp_path / "masks.json", {1: "thing", 2: "pole"})
    posed = session.cameras.posed
    with pytest.raises(SettingError, match=r"thing \(\d+\), pole \(\d+\).*--mask-category NAME"):
        read_masks(request(plot, path), posed)
    with pytest.raises(SettingError, match="'stone'"):
        read_masks(request(plot, path, categories=("stone",)), posed)
    with pytest.raises(SettingError, match="--mask-meaning"):
        read_masks(request(plot, path, meaning="trunk_dark"), posed)
    for name in ("Thing", "1"):
        mask = read_masks(request(plot, path, categories=(name,)), posed).mask("04.jpg")
        np.testing.assert_array_equal(mask.labels > 0, (labels()["04.jpg"] > 0) & (labels()["04.jpg"] < 9))


def test_a_coco_file_of_other_photos(plot, session, tmp_path):
    content = coco({1: "trunk"}, lambda label: 1)
    for image in content["images"]:
        image["file_name"] = "elsewhere_" + image["file_name"]
    (tmp_path / "masks.json").write_text(json.dumps(content))
    with pytest.raises(FileError, match="no mask for any"):
        read_masks(request(plot, tmp_path / "masks.json"), session.cameras.posed)


# ---- one to look at


def test_the_overlay_shows_the_mask_on_its_photo(plot, session, tmp_path):
    from PIL import Image

    posed = session.cameras.posed
    masks = read_masks(request(plot, categories=("1-3",), overlay=tmp_path / "look.jpg"), posed)
    name, picture = overlay_picture(masks, posed)
    drawn = np.abs(picture.astype(int) - [90, 120, 80]).max(axis=2) > 40
    label = labels()[name]
    assert np.mean(drawn == ((label > 0) & (label < 9))) > 0.99 and drawn.any()
    written = np.asarray(Image.open(tmp_path / "look.jpg"))
    assert np.abs(written.astype(int) - picture).mean() < 3
    # It may be written again, but over nothing else.
    write_overlay(tmp_path / "look.jpg", masks, posed)
    photo = shutil.copy(plot.folder / "images" / "00.jpg", tmp_path / "mine.jpg")
    before = Path(photo).read_bytes()
    with pytest.raises(FileError, match="no overlay"):
        write_overlay(Path(photo), masks, posed)
    assert Path(photo).read_bytes() == before
    with pytest.raises(SettingError, match=r"\.jpg"):
        write_overlay(tmp_path / "look.png", masks, posed)


def test_what_is_unclear_can_be_looked_at(plot, session, tmp_path):
    dark = save_masks(tmp_path / "masks", lambda each: 255 * (each == 0))
    with pytest.raises(SettingError, match=r"look\.jpg shows"):
        read_masks(request(plot, dark, overlay=tmp_path / "look.jpg"), session.cameras.posed)
    assert (tmp_path / "look.jpg").stat().st_size > 1000


# ---- a rendered walk whose masks are known


def test_a_quarter_of_the_masks_of_a_walk_finds_and_measures_the_trees_and_nothing_else(tmp_path):
    walk = Path(__file__).parents[2].parent / "shared" / "data" / "synthetic_360"
    if not walk.exists():
        pytest.skip(f"{walk.name} is not among the shared data.")
    for number in range(0, 64, 4):
        shutil.copy(walk / "masks" / f"frame_{number:04d}.png", tmp_path)
    session = open_plot(walk / "dense_unscaled.ply", scale=1.33231)
    wanted = MaskRequest(
        tmp_path,
        categories=("1-12",),
        ignore_path=walk / "operator_mask.png",
        cameras=walk / "colmap_equirectangular",
        images_dir=walk / "images",
    )
    notes = found(session, wanted)
    assert any("48 photos have no mask" in note for note in notes) and "Trunks from 16 masks." in notes
    known = json.loads((walk / "world_from_model.json").read_text())
    world_from_model = Similarity(
        Rotation.from_quat(known["rotation_xyzw"]).as_matrix(), np.array(known["translation"]), known["metres_per_unit"]
    )
    plot_from_true = session.document.world_from_source @ world_from_model.inverse()
    trees = json.loads((walk / "trees_gt.json").read_text())
    true = np.array([[tree["x"], tree["y"], tree["ground_z_mean"] + 1.3] for tree in trees])
    origin = session.document.world_from_source.apply(session.cloud.origin[None])[0]
    standing = (plot_from_true.apply(true) - origin)[:, :2]
    # The upper end of a stem that is hidden in between may be found on its own; it has no diameter.
    measured = np.array([[row.x_m, row.y_m] for row in session.inventory() if row.dbh_cm is not None])
    distance = np.linalg.norm(standing[:, None] - measured, axis=2)
    assert measured.shape == (12, 2) and (distance.min(axis=1) < 0.3).all()
