"""The ladder says what is possible, why a higher rung is not, what would change that, and what is taken."""

from __future__ import annotations

import importlib.util
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.makeplot import fill_store, write_graphs
from tests.maskplot import MaskPlot, save_masks, write_mask_plot

from dbh_studio.app.brought_masks import MaskRequest, find_brought_masks
from dbh_studio.app.commands import set_scale
from dbh_studio.app.ladder import RUNGS, Ladder, look_at_ladder
from dbh_studio.app.mask_costs import remember_speed
from dbh_studio.app.mask_request import LadderRequest, MakeRequest
from dbh_studio.app.mask_run import take_ladder
from dbh_studio.app.opening import open_plot
from dbh_studio.app.photo_scale import PhotoRequest, add_photos
from dbh_studio.app.plot_masks import mask_store, take_over_brought
from dbh_studio.app.session import Session
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.errors import CommandError, ModelError, UnscaledCloudError
from dbh_studio.io.masks import MaskRecipe, TrunkMask
from dbh_studio.io.models import ModelStore
from dbh_studio.settings import ModelRunSettings


@pytest.fixture(scope="module")
def plot(tmp_path_factory) -> MaskPlot:
    return write_mask_plot(tmp_path_factory.mktemp("plot") / "plot")


@pytest.fixture(scope="module")
def stores(tmp_path_factory) -> dict[str, ModelStore]:
    """What models may be there."""
    graphs = write_graphs(tmp_path_factory.mktemp("graphs"))
    folder = tmp_path_factory.mktemp("models")
    return {
        "none": ModelStore(folder=folder / "none", offline=False),
        "segmenter": fill_store(ModelStore(folder=folder / "one"), graphs, detector=False),
        "both": fill_store(ModelStore(folder=folder / "both"), graphs),
    }


@pytest.fixture
def session(plot, tmp_path, monkeypatch):
    monkeypatch.setenv("DBH_STUDIO_CACHE", str(tmp_path / "cache"))
    session = open_plot(plot.cloud, scale="metres")
    add_photos(session, PhotoRequest(plot.poses, plot.folder / "images"))
    return session


def keep(session: Session, method: str, n: int) -> None:
    """Masks as if made before."""
    store, blank = mask_store(session), TrunkMask(np.ones((64, 128), np.uint16))
    for photo in session.cameras.posed.images[:n]:
        store.put(photo.name, Path(photo.path), blank, MaskRecipe(method, {"mobile-sam": "0"}))


def text(ladder: Ladder) -> str:
    return "\n".join(ladder.announcement)


def test_all_models_there(session, stores):
    ladder = look_at_ladder(session, models=stores["both"])
    assert ladder.chosen == "detector" and [state.rung for state in ladder.rungs] == list(RUNGS)
    assert ladder.announcement == (f"Trunks by detector and SAM (rung 1 of 4): {ladder.taken.cost_text}.",)
    assert "8 of 8 photos" in text(ladder) and "not measured yet" in text(ladder)
    # Boxes from geometry cost less than a tenth of a detector's.
    assert ladder["prompted"].cost.seconds < 0.2 * ladder["detector"].cost.seconds
    assert "after trunks by geometry" in ladder["prompted"].cost_text
    assert ladder["geometry"].is_available and "no photos" in ladder["geometry"].cost_text


def test_only_a_segmenter(session, stores):
    ladder = look_at_ladder(session, models=stores["segmenter"])
    assert ladder.chosen == "prompted"
    assert "rung 2 of 4" in text(ladder)
    assert "Not by detector and SAM: No detector is on this computer. `dbh-studio models fetch`" in text(ladder)


def test_no_models(session, stores):
    ladder = look_at_ladder(session, models=stores["none"])
    assert ladder.chosen == "geometry" and len(ladder.announcement) == 4
    assert "No detector and no segmenter is on this computer." in text(ladder) and "764 MB" in text(ladder)
    assert "Not by masks that were brought: No masks were brought. Say where they are: --masks" in text(ladder)
    offline = look_at_ladder(session, models=ModelStore(folder=stores["none"].folder, offline=True))
    assert "Downloads are switched off" in text(offline) and "models add" in text(offline)


def test_a_named_model_that_is_not_there(session, stores):
    request = MakeRequest(detector="grounding-dino-tiny-int8")
    ladder = look_at_ladder(session, models=stores["both"], request=request)
    assert ladder.chosen == "prompted" and "No detector is on this computer" in text(ladder)


def test_without_the_runtime(session, stores, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "onnxruntime" else find(name))
    ladder = look_at_ladder(session, models=stores["both"])
    assert ladder.chosen == "geometry" and "onnxruntime, which runs the models, is not installed" in text(ladder)


def test_photos_that_are_missing_or_of_another_cloud(session, plot, stores, tmp_path):
    bare = open_plot(plot.cloud, scale="metres")
    ladder = look_at_ladder(bare, models=stores["both"])
    assert ladder.chosen == "geometry" and text(ladder).count("no photos with known poses") == 3
    shutil.copy(plot.poses, tmp_path)
    lone = add_photos(bare, PhotoRequest(tmp_path / "poses.json"))
    ladder = look_at_ladder(bare, models=stores["both"])
    assert ladder.chosen == "geometry" and "None of the 8 photos is on this computer. Say in which" in text(ladder)
    moved = replace(lone, fit=replace(lone.fit, status="moved", message="They lie elsewhere.", remedy="Export again."))
    ladder = look_at_ladder(bare, cameras=moved, models=stores["both"], brought=MaskRequest(plot.masks))
    assert ladder.chosen == "geometry" and text(ladder).count("They lie elsewhere. Export again.") == 3


def test_without_a_scale(session, stores):
    session.do(set_scale(ScaleEstimate()))
    ladder = look_at_ladder(session, models=stores["both"])
    assert ladder.chosen == "geometry" and "unit" in ladder["detector"].why_not
    with pytest.raises(UnscaledCloudError):
        take_ladder(session, models=stores["both"])


def test_brought_masks_are_the_third_rung(session, plot, stores, tmp_path):
    ladder = look_at_ladder(session, models=stores["none"], brought=MaskRequest(plot.masks))
    assert ladder.chosen == "brought" and "those in masks" in text(ladder)
    # Above them are the models, unless the person asks for their own.
    assert look_at_ladder(session, models=stores["both"], brought=MaskRequest(plot.masks)).chosen == "detector"
    own = look_at_ladder(session, models=stores["both"], brought=MaskRequest(plot.masks), wanted="brought")
    assert own.chosen == "brought" and text(own).count("though it could be: another rung was asked for") == 2
    dark = save_masks(tmp_path / "dark", lambda each: 255 * (each == 0))
    posed = session.cameras.posed
    ignoring = find_brought_masks(MaskRequest(dark, "ignore_dark"), posed)
    assert "what to ignore" in look_at_ladder(session, models=stores["none"], brought=ignoring)["brought"].why_not
    unclear = find_brought_masks(MaskRequest(dark), posed)
    state = look_at_ladder(session, models=stores["none"], brought=unclear)["brought"]
    assert not state.is_available and state.why_not == unclear.unclear and state.remedy == unclear.remedy


def test_kept_masks_are_used_where_none_can_be_made(session, stores):
    keep(session, "grounded_sam", 5)
    ladder = look_at_ladder(session, models=stores["none"])
    assert ladder.chosen == "detector" and not ladder.taken.can_make and ladder.taken.n_kept == 5
    assert ladder.announcement == ("Trunks by detector and SAM (rung 1 of 4): 5 masks are kept, no more can be made.",)
    taken = take_ladder(session, models=stores["none"])
    assert taken.rung == "detector" and len(taken.masks) == 5
    more = look_at_ladder(session, models=stores["both"], request=MakeRequest(keyframes="all"))
    assert "5 masks are kept; 3 more of 8 photos" in text(more)
    assert look_at_ladder(session, models=stores["both"], request=MakeRequest(keyframes=5)).taken.cost_text == (
        "5 masks are kept; nothing to do"
    )


def test_masks_taken_over_are_brought_ones(session, plot, stores):
    masks = find_brought_masks(MaskRequest(plot.masks), session.cameras.posed)
    take_over_brought(session, masks, session.cameras.posed)
    ladder = look_at_ladder(session, models=stores["none"])
    assert ladder.chosen == "brought" and "8 masks are kept beside the plot" in text(ladder)
    taken = take_ladder(session, LadderRequest("stored"))
    assert taken.rung == "brought" and len(taken.masks) == 8


def test_what_is_measured_is_told(session, stores):
    remember_speed(("grounding-dino-tiny", "mobile-sam"), ModelRunSettings(), 1.5)
    ladder = look_at_ladder(session, models=stores["both"], request=MakeRequest(keyframes=4))
    assert "4 of 8 photos, about 30 s on this computer, as measured" in text(ladder)
    report = ladder.as_json()
    assert report["chosen"] == "detector" and report["rungs"][0]["seconds"] == 30 and report["rungs"][0]["is_measured"]


def test_the_rung_asked_for_or_the_reason(session, stores):
    assert look_at_ladder(session, models=stores["both"], wanted="geometry").chosen == "geometry"
    with pytest.raises(ModelError, match="Trunks cannot be found by detector and SAM: No detector") as caught:
        look_at_ladder(session, models=stores["segmenter"], wanted="detector")
    assert "models fetch" in caught.value.remedy


def test_taking_the_ladder_down_to_geometry(plot, stores, monkeypatch, tmp_path):
    monkeypatch.setenv("DBH_STUDIO_CACHE", str(tmp_path / "cache"))
    alone = tmp_path / "alone"
    alone.mkdir()
    shutil.copy(plot.cloud, alone)
    bare = open_plot(alone / plot.cloud.name, scale="metres")
    taken = take_ladder(bare, models=stores["both"])
    assert taken.rung == "geometry" and taken.masks is None
    assert "Trunks by geometry alone (rung 4 of 4)" in taken.notes[0] and "Photos were looked for" in taken.notes[-1]
    with pytest.raises(CommandError, match="No kept mask"):
        take_ladder(open_plot(plot.cloud, scale="metres"), LadderRequest("stored", cameras=plot.poses))
