"""Masks made, kept, reviewed and voted with, end to end, by graphs of a few kilobytes that find what is brown."""

from __future__ import annotations

import errno
import json
import os
import pickle
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.makeplot import copied, fill_store, write_graphs, write_make_plot
from tests.maskplot import N_PHOTOS, MaskPlot, labels
from tests.threestems import STEMS

from dbh_studio.app import mask_costs
from dbh_studio.app.brought_masks import MaskReader, MaskRequest, read_masks
from dbh_studio.app.cameras import Cameras
from dbh_studio.app.image_trunks import trunks_from_masks
from dbh_studio.app.jobs import Job, run_job
from dbh_studio.app.mask_making import MakeRequest, make_masks, masks_for_plot, plan_masks
from dbh_studio.app.opening import open_plot, save_as
from dbh_studio.app.photo_scale import PhotoRequest, add_photos
from dbh_studio.app.pipeline import segment
from dbh_studio.app.plot_masks import (
    carry_masks,
    copy_brought,
    has_masks,
    kept_mask,
    mask_states,
    mask_store,
    masks_folder,
    plot_masks,
    put_painted,
    same_masks,
    set_review,
    take_over_brought,
)
from dbh_studio.app.session import Session
from dbh_studio.app.vote_cache import kept_votes
from dbh_studio.core.mask_record import MaskRecord
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.errors import (
    CancelledError,
    CommandError,
    FileError,
    ModelError,
    SettingError,
    StudioError,
    UnscaledCloudError,
)
from dbh_studio.io.masks import MaskRecipe, MaskStore, TrunkMask
from dbh_studio.io.models import ModelStore
from dbh_studio.settings import MaskDetectorSettings, ModelRunSettings

# One look at each photo, for what is about photos and not about what is found in them.
WHOLE = MaskDetectorSettings(panorama="whole", mask_size_px=512)
TILES = MaskDetectorSettings(tile_count=4, tile_fov_deg=100.0, tile_size_px=512, mask_size_px=1024)
# The graphs are too small to share between threads.
RUN = ModelRunSettings(threads=1)
N_MADE = 4
PLACES = np.array([(x, y) for x, y, _ in STEMS])


@pytest.fixture(scope="module", autouse=True)
def own_cache(tmp_path_factory):
    """Speeds and masks of plots that are not saved are kept there."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DBH_STUDIO_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def plot(tmp_path_factory) -> MaskPlot:
    return write_make_plot(tmp_path_factory.mktemp("plot") / "plot")


@pytest.fixture(scope="module")
def graphs(tmp_path_factory) -> Path:
    return write_graphs(tmp_path_factory.mktemp("graphs"))


@pytest.fixture(scope="module")
def models(graphs, tmp_path_factory) -> ModelStore:
    return fill_store(ModelStore(folder=tmp_path_factory.mktemp("models"), offline=True), graphs)


def opened(plot: MaskPlot, folder: Path | None = None) -> tuple[Session, Cameras]:
    """The plot with its photos, kept in a folder where one is named."""
    session = open_plot(plot.cloud, scale="metres", project_dir=folder, background_save=False)
    return session, add_photos(session, PhotoRequest(plot.poses, plot.folder / "images"))


@pytest.fixture
def session(plot, tmp_path):
    session, _ = opened(plot, tmp_path / "plot.dbh")
    yield session
    session.close()


def brought(plot: MaskPlot, session: Session, **options):
    return read_masks(MaskRequest(plot.masks, **options), session.cameras.posed)


# ---- making


@pytest.fixture(scope="module")
def made_folder(plot, models, tmp_path_factory) -> Path:
    """Masks of all photos, in tiles, by detector and SAM."""
    folder = tmp_path_factory.mktemp("made") / "plot.dbh"
    session, _ = opened(plot, folder)
    plan = plan_masks(session, MakeRequest(keyframes=N_MADE, settings=TILES, run=RUN), models=models)
    assert plan.rung == "detector" and plan.models == ("grounding-dino-tiny", "mobile-sam")
    assert len(plan.photos) == N_MADE == plan.cost.n_photos and plan.cost.n_views == 4 * N_MADE
    assert plan.sentence.startswith("Masks of 4 of 8 photos, about ") and 0.5 < plan.share_covered < 1.0
    said: list[tuple[float, str]] = []
    made = make_masks(plan, progress=lambda fraction, message="": said.append((fraction, message)))
    session.close()
    assert (made.n_made, made.n_kept, dict(made.problems)) == (N_MADE, 0, {}) and made.n_trunks >= 3 * N_MADE
    fractions = [fraction for fraction, _ in said]
    assert fractions == sorted(fractions) and fractions[-1] == 1.0
    assert any("Photo 2 of 4, about" in text and "left: Tile 3 of 4" in text for _, text in said)
    return folder


@pytest.fixture
def made(made_folder, tmp_path):
    """The same plot, to be changed."""
    shutil.copytree(made_folder, tmp_path / "plot.dbh")
    session = open_plot(tmp_path / "plot.dbh", background_save=False)
    from dbh_studio.app.cameras import cameras_of

    cameras_of(session)
    yield session
    session.close()


def test_from_photos_to_trunks(made):
    masks = pickle.loads(pickle.dumps(plot_masks(made, made.cameras.posed)))
    assert len(masks) == N_MADE and masks.notes == ("4 masks of 8 photos are kept beside the plot and vote.",)
    truth = labels()
    for name in masks.entries:
        mask = masks.mask(name)
        known = mask.sized(1024, 512)
        shown = (known.labels > 0) & ~known.ignored
        assert np.mean(truth[name][shown] > 0) > 0.9  # what is outlined is a stem
        assert np.mean(shown[(truth[name] > 0) & ~known.ignored]) > 0.7
    trunks = trunks_from_masks(made, masks)
    assert trunks.rung == "masks" and trunks.n_masks == N_MADE
    # The pole is as brown as a stem.
    points, shift = made.points_world(), made.cloud.origin - [500_000.0, 4_500_000.0, 100.0]
    places = np.array([np.median(points[t.points, :2], axis=0) for t in made.document.trunks]) + shift[:2]
    assert len(places) == len(STEMS) + 1
    # Of each at least its own radius: four photos see no stem from all sides.
    away = np.linalg.norm(places[:, None] - PLACES[None], axis=2).min(axis=0)
    assert (away < [diameter / 2 for _, _, diameter in STEMS]).all()


def test_the_document_says_by_which_masks_and_forgets_it_with_them(made, tmp_path):
    before = made.document
    masks = plot_masks(made, made.cameras.posed)
    trunks_from_masks(made, masks)
    record = made.document.masks
    assert (record.kind, record.rung, record.n_masks, record.prompt) == ("made", "detector", N_MADE, "tree trunk")
    assert record.models == ("grounding-dino-tiny", "mobile-sam") and record.path is None
    assert "4 masks made by detector and SAM (grounding-dino-tiny, mobile-sam)" in record.sentence
    assert same_masks(made.document, masks)
    votes = kept_votes(made)
    assert votes is not None and len(votes) == len(made.cloud) and votes.n_trunk.max() >= 2
    # Saved, and there again with the plot; undone together with the trunks.
    made.close()
    again = open_plot(tmp_path / "plot.dbh", background_save=False)
    assert again.document.masks == record
    reread = kept_votes(again)
    assert np.array_equal(reread.n_trunk, votes.n_trunk) and np.array_equal(reread.weight_seen, votes.weight_seen)
    # Trunks by geometry are by no masks, and the label counts are not theirs.
    segment(again)
    assert again.document.masks is None and kept_votes(again) is None
    again.undo()
    assert again.document.masks == record and kept_votes(again) is not None
    (tmp_path / "plot.dbh" / "cache" / "votes.npz").write_bytes(b"PK damaged")
    assert kept_votes(again) is None
    again.close()
    assert before.masks is None


def test_a_rejected_mask_does_not_vote_and_an_accepted_one_does(made):
    posed = made.cameras.posed
    names = [photo.name for photo in posed if photo.name in plot_masks(made).entries]
    for name in names[1:]:
        set_review(made, name, "rejected")
    set_review(made, names[0], "accepted")
    masks = plot_masks(made, posed)
    assert list(masks.entries) == [names[0]] and "3 were rejected and do not vote." in masks.notes
    reader = MaskReader(masks)
    assert [photo.name for photo in posed if reader(photo) is not None] == [names[0]] and reader.n_read == 1
    # One mask is not enough for two votes: the trunks are those of geometry, and it is said.
    trunks = trunks_from_masks(made, masks)
    assert trunks.rung == "geometry" and made.document.masks is None
    for name in names[1:]:
        set_review(made, name, "")
    assert len(plot_masks(made, posed)) == N_MADE
    assert list(plot_masks(made, posed, only_accepted=True).entries) == [names[0]]
    assert not same_masks(made.document, masks)
    states = {state.photo: state for state in mask_states(made, posed)}
    assert states[names[0]].review == "accepted" and states[names[0]].votes and states[names[0]].origin == "detector"
    assert states[names[0]].n_trunks >= 3 and 0.3 < states[names[0]].score <= 1.0
    with pytest.raises(CommandError, match="no kept mask"):
        set_review(made, "nowhere.jpg", "accepted")


def test_what_a_person_painted_votes_and_is_never_made_anew(made, models):
    there = tuple(plot_masks(made).entries)
    photo = made.cameras.posed.by_name(there[0])
    painted = TrunkMask(np.zeros((128, 256), np.uint16))
    put_painted(made, photo, painted)
    assert not plot_masks(made, made.cameras.posed).mask(photo.name).labels.any()
    assert kept_mask(made, photo.name).size == (256, 128)
    plan = plan_masks(made, MakeRequest(photos=there, settings=WHOLE, run=RUN), models=models)
    assert photo.name not in [each.name for each in plan.photos] and len(plan.photos) == N_MADE - 1
    redo = plan_masks(made, MakeRequest(photos=there, settings=WHOLE, redo=True), models=models)
    assert len(redo.photos) == N_MADE - 1
    # Accepting it changes nothing: it stays painted.
    set_review(made, photo.name, "accepted")
    assert mask_store(made).entry(photo.name).review == "repainted"
    (state,) = (each for each in mask_states(made, made.cameras.posed) if each.photo == photo.name)
    assert state.origin == "painted" and state.votes
    with pytest.raises(CommandError, match="does not fit"):
        put_painted(made, photo, TrunkMask(np.zeros((128, 128), np.uint16)))
    with pytest.raises(FileError, match="not found"):
        put_painted(made, replace(photo, path=None), painted)


def test_what_a_person_painted_and_rejected_is_not_made_anew_either(plot, made, models):
    there = tuple(plot_masks(made).entries)
    painted, kept = made.cameras.posed.by_name(there[0]), mask_store(made).entry(there[0]).file
    put_painted(made, painted, TrunkMask(np.ones((128, 256), np.uint16)))
    set_review(made, painted.name, "rejected")
    before = (masks_folder(made) / kept).read_bytes()
    for request in (MakeRequest(photos=there, settings=WHOLE), MakeRequest(photos=there, settings=TILES, redo=True)):
        plan = plan_masks(made, replace(request, run=RUN), models=models)
        assert painted.name not in [each.name for each in plan.photos] and len(plan.photos) == N_MADE - 1
    given = brought(plot, made, meaning="labels", categories=("1-9",))
    assert copy_brought(masks_folder(made), given, made.cameras.posed, names=[painted.name]) == ()
    assert (masks_folder(made) / kept).read_bytes() == before
    assert mask_store(made).entry(painted.name).review == "rejected"


def test_what_a_person_brought_or_accepted_is_not_made_anew_unasked(plot, made, models):
    there = tuple(plot_masks(made).entries)
    set_review(made, there[0], "accepted")
    given = brought(plot, made, meaning="labels", categories=("1-9",))
    assert copy_brought(masks_folder(made), given, made.cameras.posed, names=[there[1]]) == ()
    for settings in (WHOLE, TILES):
        plan = plan_masks(made, MakeRequest(photos=there, settings=settings, run=RUN), models=models)
        assert not {there[0], there[1]} & {each.name for each in plan.photos}
    redo = plan_masks(made, MakeRequest(photos=there, settings=WHOLE, run=RUN, redo=True), models=models)
    assert {there[0], there[1]} <= {each.name for each in redo.photos}


def test_masks_made_in_several_ways_vote_together_and_that_is_told(made, models):
    assert not any("ways" in note for note in plot_masks(made).notes)
    other = MakeRequest(photos=tuple(plot_masks(made).entries)[:1], settings=WHOLE, run=RUN)
    masks_for_plot(made, other, models=models)
    assert any("made in 2 ways" in note and "--redo" in note for note in plot_masks(made).notes)


def test_a_photo_named_twice_is_made_once(session, models):
    plan = plan_masks(session, MakeRequest(photos=("01.jpg", "00.jpg", "01.jpg"), settings=WHOLE), models=models)
    assert [photo.name for photo in plan.photos] == ["01.jpg", "00.jpg"]


def test_an_undone_search_by_masks_is_said_to_be_no_longer_that_of_the_plot(made):
    segment(made, in_process=True)
    assert made.last_search.remarks(made.document) == ()
    n_trunks = len(made.document.trunks)
    trunks_from_masks(made, plot_masks(made, made.cameras.posed))
    assert made.last_search.remarks(made.document) == () and len(made.document.trunks) == n_trunks
    made.undo()
    (remark,) = made.last_search.remarks(made.document)
    assert "by masks" in remark and "another way" in remark and kept_votes(made) is None
    made.redo()
    assert made.last_search.remarks(made.document) == () and kept_votes(made) is not None


def test_a_changed_recipe_makes_masks_anew_and_the_same_does_not(made, models):
    same = plan_masks(made, MakeRequest(keyframes=N_MADE, settings=TILES), models=models)
    assert same.photos == () and same.n_kept == N_MADE and "nothing to do" in same.sentence
    assert make_masks(same).n_made == 0
    other = TILES.changed(box_threshold=0.4)
    assert len(plan_masks(made, MakeRequest(keyframes=N_MADE, settings=other), models=models).photos) == N_MADE
    # A rejected one is there, too: it is not made again to be rejected again.
    rejected = next(iter(plot_masks(made).entries))
    set_review(made, rejected, "rejected")
    instead = plan_masks(made, MakeRequest(keyframes=N_MADE, settings=TILES), models=models).photos
    assert len(instead) == 1 and instead[0].name != rejected
    assert plan_masks(made, MakeRequest(photos=(rejected,), settings=TILES), models=models).photos == ()
    redo = plan_masks(made, MakeRequest(keyframes=N_MADE, settings=TILES, redo=True), models=models)
    assert len(redo.photos) == N_MADE


def test_a_photo_that_changed_is_told_and_does_not_vote(plot, made_folder, tmp_path):
    elsewhere = copied(plot, tmp_path / "moved")
    session = open_plot(elsewhere.cloud, scale="metres", project_dir=tmp_path / "p.dbh", background_save=False)
    shutil.copytree(made_folder / "masks", tmp_path / "p.dbh" / "masks")
    cameras = add_photos(session, PhotoRequest(elsewhere.poses, elsewhere.folder / "images"))
    # Copied photos have another time and the same content.
    assert len(plot_masks(session, cameras.posed)) == N_MADE
    name = next(iter(plot_masks(session).entries))
    with (elsewhere.folder / "images" / name).open("ab") as file:
        file.write(b"more")
    masks = plot_masks(session, cameras.posed)
    assert len(masks) == N_MADE - 1 and "have changed since" in masks.notes[-1]
    (state,) = (each for each in mask_states(session, cameras.posed) if each.photo == name)
    assert state.is_outdated and not state.votes and not state.has_mask
    session.close()


# ---- stopping and going on


def test_killed_in_the_middle_it_goes_on_with_the_rest(session, models):
    request = MakeRequest(keyframes=4, settings=WHOLE, run=RUN)
    plan = plan_masks(session, request, models=models)
    assert len(plan.photos) == 4
    ended: list[StudioError] = []
    job: list[Job] = []

    def kill(fraction: float, message: str = "") -> None:
        if "Photo 3 of 4" in message:
            os.kill(job[0]._process.pid, signal.SIGKILL)

    job.append(Job(make_masks, (plan,), on_progress=kill, on_done=lambda _: None, on_error=ended.append))
    job[0].start().join()
    assert "stopped" in str(ended[0])
    done = [entry.image for entry in mask_store(session).entries]
    assert done == [photo.name for photo in plan.photos[:2]]
    rest = plan_masks(session, request, models=models)
    assert [photo.name for photo in rest.photos] == [photo.name for photo in plan.photos[2:]] and rest.n_kept == 2
    before = {entry.image: entry.sha256 for entry in mask_store(session).entries}
    assert make_masks(rest).n_made == 2
    after = {entry.image: entry.sha256 for entry in mask_store(session).entries}
    assert len(after) == 4 and before.items() <= after.items()
    # The speed was measured meanwhile.
    assert plan_masks(session, MakeRequest(keyframes=6, settings=WHOLE, run=RUN), models=models).cost.is_measured


def test_two_do_not_make_masks_of_one_plot_at_once(session, models):
    from dbh_studio.io.lock import lock_file

    plan = plan_masks(session, MakeRequest(keyframes=1, settings=WHOLE, run=RUN), models=models)
    plan.folder.mkdir(parents=True, exist_ok=True)
    with lock_file(plan.folder / "making.lock"), pytest.raises(CommandError, match="made already") as told:
        make_masks(plan)
    assert "kept" in told.value.remedy
    assert make_masks(plan).n_made == len(plan.photos)


def test_cancelled_it_keeps_what_is_made(session, models):
    request = MakeRequest(keyframes=3, settings=WHOLE, run=RUN)

    def cancel(fraction: float, message: str = "") -> None:
        if "Photo 2 of 3" in message:
            raise CancelledError

    with pytest.raises(CancelledError):
        masks_for_plot(session, request, models=models, in_process=True, progress=cancel)
    assert len(mask_store(session)) == 1
    assert masks_for_plot(session, request, models=models).n_made == 2


def test_a_full_disk_stops_it_with_what_is_made(session, models, monkeypatch):
    plan = plan_masks(session, MakeRequest(keyframes=3, settings=WHOLE, run=RUN), models=models)
    put, calls = MaskStore.put, []

    def full(store, *args, **options):
        calls.append(args[0])
        if len(calls) > 1:
            raise store._cannot_write(OSError(errno.ENOSPC, "No space left on device"))
        return put(store, *args, **options)

    monkeypatch.setattr(MaskStore, "put", full)
    with pytest.raises(FileError, match="No space left"):
        make_masks(plan)
    assert len(mask_store(session)) == 1


def test_a_photo_that_cannot_be_read_is_told_and_left_out(plot, models, tmp_path):
    elsewhere = copied(plot, tmp_path / "copy")
    bad = sorted((elsewhere.folder / "images").iterdir())
    bad[1].unlink()
    session, _ = opened(elsewhere, tmp_path / "p.dbh")
    bad[0].write_bytes(b"no picture")
    request = MakeRequest(keyframes="all", settings=WHOLE, run=RUN)
    plan = plan_masks(session, replace(request, photos=(bad[0].name, bad[2].name)), models=models)
    assert "1 of 8 photos are not on this computer." in plan.notes
    made = make_masks(plan)
    assert made.n_made == 1 and list(made.problems) == [bad[0].name] and "00.jpg" in made.problems[bad[0].name]
    with pytest.raises(CommandError, match=r"no photo 01\.jpg"):
        plan_masks(session, replace(request, photos=(bad[1].name,)), models=models)
    # Where none can be read, that is no success.
    with pytest.raises(FileError, match=r"00\.jpg"):
        make_masks(plan_masks(session, replace(request, photos=(bad[0].name,)), models=models))
    session.close()


# ---- prompted by geometry


def test_sam_alone_is_prompted_with_trunks_of_the_cloud(session, graphs, tmp_path):
    alone = fill_store(ModelStore(folder=tmp_path / "models", offline=True), graphs, detector=False)
    request = MakeRequest(keyframes=2, settings=TILES, run=RUN)
    plan = plan_masks(session, request, models=alone)
    assert plan.rung == "prompted" and len(plan.trunks) == 4 and not len(session.document.trunks)
    assert any("4 trunks that geometry found" in note for note in plan.notes)
    assert make_masks(plan).n_made == 2
    masks = plot_masks(session, session.cameras.posed)
    assert masks.record().rung == "prompted"
    truth = labels()
    for name in masks.entries:
        known = masks.mask(name).sized(1024, 512)
        shown = (known.labels > 0) & ~known.ignored
        assert np.mean(truth[name][shown] > 0) > 0.85
    trunks_from_masks(session, masks)
    assert len(session.document.trunks) == 4 and session.document.masks.rung == "prompted"
    # The trunks are those of the masks now: SAM is asked for those of the cloud all the same, and all is there.
    assert plan_masks(session, request, models=alone).photos == ()
    # Trunks that a person changed are others.
    session.undo()
    segment(session)
    from dbh_studio.app.commands import delete_trunk

    session.do(delete_trunk(session.document.trunks.ids[0]))
    fewer = plan_masks(session, request, models=alone)
    assert len(fewer.trunks) == 3 and len(fewer.photos) == 2


# ---- refusals


def test_what_is_missing_is_said(plot, models, session, tmp_path):
    empty = ModelStore(folder=tmp_path / "none", offline=True)
    with pytest.raises(ModelError, match=r"No models.*models fetch"):
        plan_masks(session, models=empty)
    with pytest.raises(ModelError, match="No detector"):
        plan_masks(session, MakeRequest(rung="detector"), models=empty)
    with pytest.raises(SettingError, match="gaps"):
        settings = MaskDetectorSettings(tile_count=3, tile_fov_deg=90.0)
        plan_masks(session, MakeRequest(settings=settings), models=models)
    bare = open_plot(plot.cloud, scale="metres")
    with pytest.raises(CommandError, match="no photos"):
        plan_masks(bare, models=models)
    lone = tmp_path / "lone"
    lone.mkdir()
    shutil.copy(plot.poses, lone)
    add_photos(bare, PhotoRequest(lone / "poses.json"))
    with pytest.raises(FileError, match="None of its 8 photos"):
        plan_masks(bare, models=models)
    from dbh_studio.app.commands import set_scale

    bare.do(set_scale(ScaleEstimate()))
    with pytest.raises(UnscaledCloudError):
        plan_masks(bare, models=models)


def test_a_plot_that_is_only_read_is_not_written(made_folder, models):
    session = open_plot(made_folder, read_only=True)
    assert has_masks(session) and len(plot_masks(session)) == N_MADE
    for forbidden in (
        lambda: plan_masks(session, models=models),
        lambda: set_review(session, "00.jpg", "rejected"),
        lambda: put_painted(session, None, TrunkMask(np.zeros((2, 4), np.uint16))),
    ):
        with pytest.raises(CommandError, match="reading only"):
            forbidden()
    session.close()


# ---- where they are kept


def test_masks_of_a_plot_that_is_not_saved_move_with_saving(plot, models, tmp_path):
    session, cameras = opened(plot)
    folder = masks_folder(session)
    assert not has_masks(session)
    masks_for_plot(session, MakeRequest(keyframes=1, settings=WHOLE, run=RUN), models=models)
    assert len(MaskStore(folder)) == 1
    # Opened anew, they are found; saved, they move along; saved elsewhere, both have them.
    session.close()
    session, cameras = opened(plot)
    assert len(plot_masks(session, cameras.posed)) == 1
    save_as(session, tmp_path / "a.dbh", background=False)
    assert not folder.exists() and len(plot_masks(session, cameras.posed)) == 1
    assert masks_folder(session) == tmp_path / "a.dbh" / "masks"
    save_as(session, tmp_path / "b.dbh", background=False)
    assert len(MaskStore(tmp_path / "a.dbh" / "masks")) == len(MaskStore(tmp_path / "b.dbh" / "masks")) == 1
    session.close()


def test_of_two_places_the_masks_written_last_are_taken_but_painted_ones_stay(plot, tmp_path):
    recipe, photos = MaskRecipe("grounded_sam"), plot.folder / "images"
    run, cache = MaskStore(tmp_path / "run"), MaskStore(tmp_path / "cache")
    sizes = {"old": (8, 4), "new": (16, 8), "painted": (32, 16)}
    shapes = {name: TrunkMask(np.ones((height, width), np.uint16)) for name, (width, height) in sizes.items()}
    run.put("00.jpg", photos / "00.jpg", shapes["old"], recipe)
    run.put("01.jpg", photos / "01.jpg", shapes["painted"], MaskRecipe("painted"), review="repainted")
    run.put("02.jpg", photos / "02.jpg", shapes["old"], recipe)
    cache.put("00.jpg", photos / "00.jpg", shapes["new"], recipe)
    cache.put("01.jpg", photos / "01.jpg", shapes["new"], recipe)
    os.utime(run.folder / "index.jsonl", ns=(10**18, 10**18))
    carry_masks(run.folder, cache.folder, move=False, newer_wins=True)
    taken = MaskStore(cache.folder)
    assert [taken.get(name).size for name in ("00.jpg", "01.jpg", "02.jpg")] == [(16, 8), (32, 16), (8, 4)]
    # What was done since in the place they came from counts again.
    run.set_review("00.jpg", "rejected")
    os.utime(run.folder / "index.jsonl", ns=(4 * 10**18, 4 * 10**18))
    carry_masks(run.folder, cache.folder, move=False, newer_wins=True)
    assert MaskStore(cache.folder).entry("00.jpg").review == "rejected"


# ---- brought ones


def test_brought_masks_are_taken_over_to_be_painted(plot, session):
    masks = brought(plot, session, categories=("1-3",))
    posed = session.cameras.posed
    put_painted(session, posed.images[0], TrunkMask(np.zeros((512, 1024), np.uint16)))
    assert take_over_brought(session, masks, posed) == ()
    kept = plot_masks(session, posed)
    assert len(kept) == N_PHOTOS and "1 of them painted by hand." in kept.notes
    assert not kept.mask("00.jpg").labels.any()
    same = kept.mask("01.jpg"), masks.mask("01.jpg")
    assert np.array_equal(same[0].labels, same[1].labels) and same[0].has_instances
    record = kept.record()
    assert (record.kind, record.path, record.meaning) == ("brought", plot.masks.absolute(), "labels")
    assert record.categories == ("1-3",) and "brought from masks" in record.sentence
    assert {state.origin for state in mask_states(session, posed)} == {"painted", "brought"}
    # In a child process, some of them; what cannot be read is told.
    (problem,) = run_job(
        copy_brought, masks_folder(session), masks, replace(posed, images=(replace(posed.images[1], path=None),))
    )
    assert "01.jpg" in problem


def test_trunks_of_brought_masks_say_where_these_are(plot, session):
    trunks_from_masks(session, brought(plot, session, categories=("1-3",)))
    record = session.document.masks
    assert (record.kind, record.rung, record.n_masks) == ("brought", "brought", N_PHOTOS)
    assert (record.path, record.meaning, record.categories, record.style) == (plot.masks, "labels", ("1-3",), "same")
    assert isinstance(record, MaskRecord) and kept_votes(session) is not None
    # What the masks are decides the digest, not when they were read.
    again = brought(plot, session, categories=("1-3",)).record().digest
    assert record.digest.startswith(again)
    assert not record.digest.startswith(brought(plot, session, categories=("1-2",)).record().digest)


# ---- costs


def test_durations_and_costs_in_words(monkeypatch, tmp_path, plot):
    assert [mask_costs.duration(s) for s in (0.2, 40, 99.4, 130, 3300, 7800)] == [
        "1 s",
        "40 s",
        "99 s",
        "2 min",
        "55 min",
        "2 h 10 min",
    ]
    monkeypatch.setenv("DBH_STUDIO_CACHE", str(tmp_path))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    run, names = MakeRequest().run, ("grounding-dino-tiny", "mobile-sam")
    from tests.maskplot import photos

    stated = mask_costs.cost_of(photos(), names, MaskDetectorSettings(), run)
    assert stated.n_views == 40 and stated.seconds == pytest.approx(40 * 6.0) and not stated.is_measured
    assert "not measured" in stated.text and "4 min" in stated.text
    mask_costs.remember_speed(names, run, 2.5)
    measured = mask_costs.cost_of(photos(), names, MaskDetectorSettings(tile_pitches_deg=(0.0, 90.0)), run)
    assert measured.n_views == 48 and measured.seconds == 120.0 and "as measured" in measured.text
    # Other models, or another provider, are another speed.
    assert mask_costs.measured_seconds(names[1:], run) is None
    assert mask_costs.measured_seconds(names, run.changed(provider="cuda")) is None
    (tmp_path / "mask-speeds.json").write_text("{damaged")
    assert mask_costs.measured_seconds(names, run) is None
    (tmp_path / "mask-speeds.json").write_text(json.dumps({"x": "y"}))
    assert mask_costs.measured_seconds(names, run) is None
    prompted = mask_costs.cost_of(photos(), names[1:], WHOLE, run, is_prompted=True)
    assert prompted.n_views == 40  # boxes need tiles, whatever the settings say
    assert mask_costs.cost_of((), names, WHOLE, run).text == "nothing to do"
