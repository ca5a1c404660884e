"""Known lengths, photos and frame outlive the program; what may be deleted any time is no loss."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.app.plots import contents, make_session

from dbh_studio.app import commands
from dbh_studio.app.autosave import Autosave
from dbh_studio.app.document import CameraSource
from dbh_studio.app.marker_cache import keep_detections, kept_detections
from dbh_studio.app.saved_states import document_from_state
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.scale_evidence import MarkedPoint, MarkerSquare, ScaleBar, ScaleEvidence, Sight
from dbh_studio.core.transforms import Similarity
from dbh_studio.errors import ProjectError
from dbh_studio.io.project import ProjectWriter, read_project
from dbh_studio.stages.marker_detect import Detection

EVIDENCE = ScaleEvidence(
    bars=(
        ScaleBar(
            "Pole 1,30 m – “links”",
            (
                MarkedPoint((500_000.123456789, 4_500_000.1, 0.0), 0.003, (Sight("a/1.jpg", 10.25, 20.5),)),
                MarkedPoint((500_002.0, 4_500_000.0, 0.5)),
            ),
            1.3,
            0.002,
            "check",
        ),
    ),
    squares=(
        MarkerSquare(
            "DICT_4X4_50 7",
            tuple(MarkedPoint(corner, 0.001) for corner in ((0, 1, 0), (1, 1, 0), (1, 0, 0), (0, 0, 0))),
            0.5,
            marker=("DICT_4X4_50", 7),
            n_views=4,
            side_sigma_src=0.0007,
            systematic_src=0.0002,
        ),
        MarkerSquare("Marker 1", tuple(MarkedPoint((x, y, 1.0)) for x, y in ((0, 1), (1, 1), (1, 0), (0, 0))), 1.0),
    ),
    struck=(("a/1.jpg", "DICT_4X4_50", 9),),
)


def everything(document):
    """All a Document says, comparable."""
    said = (document.evidence, document.cameras, document.north_direction, document.origin_src)
    return (*contents(document), *said)


def saved(tmp_path, *steps):
    """A session whose plot was saved after these commands, and its folder."""
    session = make_session(n_trunks=2)[0]
    folder = tmp_path / "plot.dbh"
    saver = Autosave(session, ProjectWriter(folder), background=False, author="Ada")
    for step in steps:
        session.do(step)
    saver.close()
    return session, folder


def reopened(session, folder):
    return document_from_state(read_project(folder), session.document.source)


def test_everything_comes_back_as_it_was(tmp_path):
    cameras = CameraSource.of(tmp_path / "work" / "cameras.xml", tmp_path / "photos", "file")
    session, folder = saved(
        tmp_path,
        commands.set_evidence(EVIDENCE, label="Mark", scale=ScaleEstimate(0.384, "marker", 0.0004)),
        commands.set_cameras(cameras),
        commands.set_frame(up="+y", north=(1, 2, 0.5), origin_src=(1.25, -2.5, 1e-9)),
    )
    document = reopened(session, folder)
    assert everything(document) == everything(session.document)
    assert document.evidence == EVIDENCE
    assert document.cameras == cameras
    assert document.scale == ScaleEstimate(0.384, "marker", 0.0004)
    assert (document.up_direction, document.origin_src) == ((0.0, 1.0, 0.0), (1.25, -2.5, 1e-9))
    np.testing.assert_array_equal(document.north_direction, session.document.north_direction)


def test_undone_is_saved_as_undone(tmp_path):
    session, folder = saved(tmp_path)
    saver = Autosave(session, ProjectWriter(folder), background=False, author="Ada")
    session.do(commands.set_evidence(EVIDENCE, label="Mark"))
    assert reopened(session, folder).evidence == EVIDENCE
    session.undo()
    saver.close()
    assert reopened(session, folder).evidence == ScaleEvidence()


@pytest.mark.parametrize("source", ["marker", "bars", "camera_height", "baseline"])
def test_every_source_of_a_scale_comes_back(tmp_path, source):
    session, folder = saved(tmp_path, commands.set_scale(ScaleEstimate(0.5, source, 0.01)))
    assert reopened(session, folder).scale.source == source


def test_photos_that_moved_with_the_plot_are_found(tmp_path):
    (tmp_path / "before").mkdir()
    (tmp_path / "before" / "cameras.xml").touch()
    session, _ = saved(tmp_path / "before", commands.set_cameras(CameraSource.of(tmp_path / "before" / "cameras.xml")))
    (tmp_path / "before").rename(tmp_path / "after")
    document = reopened(session, tmp_path / "after" / "plot.dbh")
    assert document.cameras.path.resolve() == (tmp_path / "after" / "cameras.xml").resolve()


@pytest.mark.parametrize(
    "damage",
    [
        lambda evidence: evidence["bars"][0].update(role="judge"),
        lambda evidence: evidence["bars"][0]["ends"].pop(),
        lambda evidence: evidence["bars"][0]["ends"][0].update(sigma_src=-1.0),
        lambda evidence: evidence["squares"][0]["corners"].pop(),
        lambda evidence: evidence["squares"][0].update(name="Marker 1"),
        lambda evidence: evidence["bars"][0].update(length_m="long"),
    ],
)
def test_damaged_lengths_are_said_to_be_damaged(tmp_path, damage):
    session, folder = saved(tmp_path, commands.set_evidence(EVIDENCE, label="Mark"))
    content = json.loads((folder / "project.json").read_text(encoding="utf-8"))
    damage(content["evidence"])
    (folder / "project.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(ProjectError, match=r"project\.json"):
        reopened(session, folder)


# ---- the finds of the last search


def detections():
    rng = np.random.default_rng(0)
    return tuple(
        Detection(
            image=f"ä/{number}.jpg",
            dictionary="DICT_4X4_50",
            marker_id=number,
            corners_px=rng.uniform(0, 1000, (4, 2)),
            confidence=0.9,
            crop=rng.integers(0, 255, (96, 96, 3), dtype=np.uint8),
            sigma_px=0.05,
            pixel_rad=0.001,
            blur_px=0.6,
        )
        for number in range(3)
    )


def posed(n=3):
    camera = CameraModel("EQUIRECTANGULAR", 64, 32, ())
    return PosedImages(tuple(PosedImage(f"ä/{i}.jpg", camera, Similarity.identity()) for i in range(n)))


CAMERAS = CameraSource(Path("/plots/cameras.xml"), Path("/plots/photos"), "file")


def test_finds_come_back_with_their_pictures(tmp_path):
    keep_detections(tmp_path, CAMERAS, detections())
    for now, before in zip(kept_detections(tmp_path, CAMERAS, posed()), detections(), strict=True):
        assert (now.image, now.key, now.confidence) == (before.image, before.key, before.confidence)
        np.testing.assert_array_equal(now.corners_px, before.corners_px)
        np.testing.assert_array_equal(now.crop, before.crop)


def test_that_nothing_was_found_is_kept_too(tmp_path):
    assert kept_detections(tmp_path, CAMERAS, posed()) is None
    keep_detections(tmp_path, CAMERAS, ())
    assert kept_detections(tmp_path, CAMERAS, posed()) == ()


@pytest.mark.parametrize(
    "others",
    [CameraSource(Path("/plots/other.xml"), CAMERAS.images_dir, "file"), CameraSource(CAMERAS.path, None, "cloud")],
)
def test_finds_in_other_photos_are_not_used(tmp_path, others):
    keep_detections(tmp_path, CAMERAS, detections())
    assert kept_detections(tmp_path, others, posed()) is None
    assert kept_detections(tmp_path, CAMERAS, posed(2)) is None


def test_a_damaged_cache_is_no_cache(tmp_path):
    keep_detections(tmp_path, CAMERAS, detections())
    (file,) = (tmp_path / "cache").iterdir()
    whole = file.read_bytes()
    for content in (b"", b"no archive", whole[: len(whole) // 2], whole[:-100] + bytes(100)):
        file.write_bytes(content)
        assert kept_detections(tmp_path, CAMERAS, posed()) is None


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path):
    (tmp_path / "cache").write_text("in the way")
    keep_detections(tmp_path, CAMERAS, detections())
    assert kept_detections(tmp_path, CAMERAS, posed()) is None


def test_a_plot_with_a_cache_opens_and_saves_as_before(tmp_path):
    session, folder = saved(tmp_path, commands.set_evidence(EVIDENCE, label="Mark"))
    keep_detections(folder, CAMERAS, detections())
    assert reopened(session, folder).evidence == EVIDENCE
    saver = Autosave(session, ProjectWriter(folder), background=False, author="Ada")
    session.do(commands.remove_length("Marker 1"))
    saver.close()
    assert "Marker 1" not in reopened(session, folder).evidence
    assert kept_detections(folder, CAMERAS, posed()) is not None
