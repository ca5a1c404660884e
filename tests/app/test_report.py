"""The report: photographs that leave it small enough to be mailed, the scale in words, and every number explained."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
from tests.app.gridplot import grid_session

from dbh_studio.app import commands, report
from dbh_studio.app.document import CameraSource
from dbh_studio.app.exports import ExportRequest, export_plot
from dbh_studio.core.scale import ScaleEstimate

_MAIL_BYTES = 15_000_000


@dataclass(frozen=True)
class Photo:
    """A photograph of woodland, which packs badly."""

    name: str = "a&b.jpg"
    distance_m: float = 4.25
    bearing_deg: float = 350.0
    full_bytes: int = 120_000

    def jpeg(self, drawn: bool = True, quality: int = 85) -> bytes:
        assert drawn
        return bytes(self.full_bytes * quality // 100)


class Photos:
    """Stands in for `app.tree_photos`: as many photos as are asked for."""

    def __init__(self, photo: Photo | None = Photo(), note: str = "") -> None:
        self.photo, self.note, self.photos = photo, note, ()

    def __call__(self, session, trunk_id, *, most=4, size_px=(480, 640), document=None):
        self.photos = () if self.photo is None else (self.photo,) * most
        return self


@pytest.fixture
def photographed(monkeypatch, tmp_path):
    """A plot of sixty stems that has photos."""
    session = grid_session(60)
    session.do(commands.set_cameras(CameraSource.of(tmp_path / "poses.json")))
    monkeypatch.setattr("dbh_studio.app.tree_photos.tree_photos", Photos())
    return session


def written(session, folder, **request) -> str:
    (path,) = export_plot(session, folder, ExportRequest(("report",), **request))
    return path.read_text("utf-8")


def test_sixty_trees_with_four_photos_each_can_be_mailed(photographed, tmp_path):
    text = written(photographed, tmp_path)
    assert text.count("<img ") == 240 and len(text) < _MAIL_BYTES
    # As good as there is room for, and no better.
    assert len(text) > 0.5 * _MAIL_BYTES
    large = written(photographed, tmp_path / "large", pictures="large")
    assert large.count("<img ") == 240 and len(large) > len(text)
    assert "<img " not in written(photographed, tmp_path / "none", pictures="none")


def test_of_very_many_trees_each_has_fewer_photos(photographed):
    document = photographed.document
    most, n_bytes = report._room(document, 60, "small")
    assert most == 4 and 60 * most * n_bytes * 4 / 3 < _MAIL_BYTES
    for n_stems in (150, 400, 3000):
        most, n_bytes = report._room(document, n_stems, "small")
        assert 1 <= most < 4 and n_stems * most * n_bytes * 4 / 3 < _MAIL_BYTES
    assert report._room(document, 60, "none") == (0, 0)
    assert report._room(replace(document, cameras=None), 60, "small") == (0, 0)


def test_a_photo_says_from_where_it_is_and_the_side_only_where_north_is_known(photographed, tmp_path):
    text = written(photographed, tmp_path)
    assert "4.2 m away · a&amp;b.jpg" in text and "from the north" not in text
    photographed.do(commands.set_frame(north=(0.0, 1.0, 0.0)))
    text = written(photographed, tmp_path / "north")
    assert "4.2 m away, from the north · a&amp;b.jpg" in text and "north as it was set" in text


def test_why_a_tree_has_no_photo_is_said(photographed, tmp_path, monkeypatch):
    none = Photos(None, "This tree is hidden <behind> others.")
    monkeypatch.setattr("dbh_studio.app.tree_photos.tree_photos", none)
    text = written(photographed, tmp_path)
    assert text.count("This tree is hidden &lt;behind&gt; others.") == 60 and "<img " not in text


@pytest.mark.parametrize(
    ("scale", "said"),
    [
        (ScaleEstimate(1.332, "marker", 0.004), "by markers of known size; standard error 0.3 %, which is in"),
        (ScaleEstimate(1.332, "factor"), "given by hand; its error is not known"),
        (ScaleEstimate(1.0, "metres"), "the file is in metres"),
    ],
)
def test_the_scale_is_told_with_its_error(scale, said):
    session = grid_session()
    session.do(commands.set_scale(scale))
    words = report.scale_words(session.document)
    assert words.endswith(said) or said in words
    assert ("not known" in words) == (scale.source == "factor")


def test_feet_are_told_and_whether_it_is_the_height_dia_is_taken_at():
    session = grid_session()
    assert "4.27 ft (1.30 m)" in report.protocol_words(session.document, "imperial")
    assert "not 4.5 ft" in report.protocol_words(session.document, "imperial")
    session.do(commands.change_settings("measure", breast_height_m=1.37))
    assert "not 4.5 ft" not in report.protocol_words(session.document, "imperial")
    assert "ft" not in report.protocol_words(session.document, "metric").replace("after", "")


def test_every_setting_stands_in_the_report(tmp_path):
    session = grid_session()
    session.do(commands.change_settings("measure", ransac_samples=77))
    text = written(session, tmp_path)
    for section in ("ground", "trunks", "measure"):
        for field in type(getattr(session.document.settings, section)).model_fields.values():
            assert f"<td>{field.title}</td>" in text, field.title
    assert "<td>77 points</td>" in text and session.document.source.fingerprint in text
