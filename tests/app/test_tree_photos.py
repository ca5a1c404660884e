"""The photographs of trees of a plot whose photos are known pixel by pixel."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests import maskplot, threestems
from tests.treescene import is_brown, is_ring, write_plot

from dbh_studio.app import commands, tree_photo_desk
from dbh_studio.app.cameras import cloud_sample, read_cameras
from dbh_studio.app.document import CameraSource
from dbh_studio.app.opening import open_plot
from dbh_studio.app.tree_photos import TreePhotos, forget_tree_photos, tree_photos
from dbh_studio.core import tree_views
from dbh_studio.core.transforms import Similarity
from dbh_studio.core.trunks import TrunkSet

N_GROUND, N_STEM = 30_000, 12_000
TRUE = dict(enumerate(threestems.STEMS, start=1))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The plot's files; tests do not change them."""
    return write_plot(tmp_path_factory.mktemp("tree_photos") / "plot")


def opened(made, *, scale=1.0, poses=None, images=None):
    """The plot with its three stems as trunks, and its photos."""
    session = open_plot(made.cloud, scale=scale)
    rows = [np.arange(N_GROUND + k * N_STEM, N_GROUND + (k + 1) * N_STEM) for k in range(3)]
    above = [each[session.cloud.xyz[each, 2] - session.cloud.xyz[:N_GROUND, 2].min() > 0.15] for each in rows]
    session.do(commands.replace_trunks(TrunkSet.from_point_sets(above)))
    session.do(commands.set_cameras(CameraSource.of(poses or made.poses, images or made.folder / "images")))
    return session


@pytest.fixture(scope="module")
def plain(files):
    """A plot that no test changes."""
    session = opened(files)
    yield session
    session.close()


@pytest.fixture
def session(files):
    session = opened(files)
    yield session
    session.close()


def brown_at_ring(photo):
    """Columns of the leftmost and rightmost brown pixel, and of the ring's, at the height of the ring."""
    marked = is_ring(photo.drawn)
    rows, columns = np.nonzero(marked)
    middle = round(float(np.median(rows)))
    stem = np.flatnonzero(is_brown(photo.image)[middle])
    # Other stems are brown too: the one in the middle is meant.
    gaps = np.flatnonzero(np.diff(stem) > 3)
    parts = np.split(stem, gaps + 1)
    centre = 0.5 * (columns.min() + columns.max())
    nearest = min(parts, key=lambda part: abs(part.mean() - centre))
    return (nearest[0], nearest[-1]), (columns.min(), columns.max())


@pytest.mark.parametrize("trunk_id", TRUE)
def test_rings_sit_on_the_stems(plain, trunk_id):
    found = tree_photos(plain, trunk_id)
    assert 2 <= len(found.photos) <= 4 and found.note == ""
    for photo in found.photos:
        assert photo.image.shape == photo.drawn.shape == (640, 480, 3)
        assert photo.image.dtype == np.uint8 and not photo.image.flags.writeable
        stem, ring = brown_at_ring(photo)
        # A pixel of these small panoramas is up to six of the picture.
        slack = 1.0 / photo.photo_px_per_px + 2.0
        assert abs(stem[0] - ring[0]) < slack and abs(stem[1] - ring[1]) < slack
        width_cm = (ring[1] - ring[0]) * photo.metres_per_pixel * 100
        assert width_cm == pytest.approx(100 * TRUE[trunk_id][2], rel=0.12)


@pytest.mark.parametrize("trunk_id", TRUE)
def test_where_they_were_taken_from(plain, trunk_id):
    x, y, _ = TRUE[trunk_id]
    centres = {photo.name: photo.centre_src for photo in maskplot.photos()}
    found = tree_photos(plain, trunk_id).photos
    for photo in found:
        away = centres[photo.name][:2] - [x, y]
        assert photo.distance_m == pytest.approx(np.hypot(*away), abs=0.02)
        bearing = np.degrees(np.arctan2(away[0], away[1]))
        assert abs((photo.bearing_deg - bearing + 180) % 360 - 180) < 1.0
        assert photo.seen > 0.8
        u, v = photo.at_px
        labels = maskplot.labels()[photo.name]
        assert labels[int(v), int(u)] in (0, trunk_id)
        assert trunk_id in labels[int(v) - 40 : int(v) + 40, int(u) - 3 : int(u) + 4]
    bearings = np.sort([photo.bearing_deg for photo in found])
    assert np.diff(bearings, append=bearings[0] + 360).min() > 14


def test_a_stem_behind_another_is_shown_from_where_it_is_seen(plain):
    shown = {trunk_id: {photo.name for photo in tree_photos(plain, trunk_id).photos} for trunk_id in TRUE}
    for trunk_id, names in shown.items():
        for name in names:
            assert (maskplot.labels()[name] == trunk_id).sum() > 500
    assert all(shown.values())


def test_jpegs_with_and_without_the_drawing(plain):
    photo = tree_photos(plain, 1, most=2, size_px=(240, 320)).photos[0]
    for drawn, original in ((True, photo.drawn), (False, photo.image)):
        read = np.asarray(Image.open(io.BytesIO(photo.jpeg(drawn=drawn, quality=92))))
        assert read.shape == (320, 240, 3)
        assert np.abs(read.astype(int) - original).mean() < 5
    assert len(photo.jpeg(quality=40)) < len(photo.jpeg(quality=95))


def test_what_was_found_is_kept_until_something_changes(session):
    first = tree_photos(session, 1)
    assert tree_photos(session, 1) is first
    assert tree_photos(session, 1, zoom=2.0) is not first
    session.do(commands.change_settings("measure", breast_height_m=1.0))
    lower = tree_photos(session, 1)
    assert lower is not first
    session.undo()
    assert tree_photos(session, 1) is first
    forget_tree_photos(session)
    again = tree_photos(session, 1)
    assert again is not first
    assert [photo.name for photo in again.photos] == [photo.name for photo in first.photos]


def test_an_earlier_state_can_be_asked_of(session):
    before = session.document
    session.do(commands.delete_trunk(2))
    with pytest.raises(KeyError):
        tree_photos(session, 2)
    assert len(tree_photos(session, 2, document=before).photos) >= 2


def test_no_more_than_wanted_and_closer(plain):
    assert len(tree_photos(plain, 3, most=2).photos) == 2
    near, far = (tree_photos(plain, 3, most=1, zoom=zoom).photos[0] for zoom in (2.0, 0.5))
    assert near.name == far.name
    assert near.metres_per_pixel < 0.6 * far.metres_per_pixel
    for size, zoom in (((4, 640), 1.0), ((480, 10_000), 1.0), ((480, 640), 0.0), ((480, 640), float("nan"))):
        with pytest.raises(ValueError):
            tree_photos(plain, 3, size_px=size, zoom=zoom)


def test_without_a_scale_there_is_no_ring_but_there_are_pictures(tmp_path):
    made = write_plot(tmp_path / "plot", unit_m=2.5)
    session = opened(made, scale=None)
    assert not session.document.scale.is_known
    found = tree_photos(session, 3)
    assert len(found.photos) >= 2
    for photo in found.photos:
        assert np.isnan(photo.distance_m) and np.isnan(photo.metres_per_pixel)
        assert not is_ring(photo.drawn).any()
        assert is_brown(photo.image)[:, 200:280].mean() > 0.2
    session.close()


def test_a_refused_stem_has_pictures_without_a_ring(session):
    session.do(commands.change_settings("measure", min_points=100_000))
    if session.measurement(1).result:
        pytest.fail("it was not refused")
    found = tree_photos(session, 1)
    assert len(found.photos) >= 2
    assert not any(is_ring(photo.drawn).any() for photo in found.photos)
    assert all((photo.drawn != photo.image).any() for photo in found.photos)


def test_photos_that_cannot_be_read_are_left_out_and_named(files, tmp_path):
    best = [photo.name for photo in read_names(files)]
    images = tmp_path / "images"
    images.mkdir()
    for path in (files.folder / "images").iterdir():
        (images / path.name).write_bytes(path.read_bytes())
    whole = (images / best[0]).read_bytes()
    (images / best[0]).write_bytes(whole[: len(whole) // 2])
    (images / best[1]).unlink()
    session = opened(files, images=images)
    found = tree_photos(session, 1)
    names = [photo.name for photo in found.photos]
    assert len(names) >= 2 and best[0] not in names and best[1] not in names
    assert best[0] in found.note and best[1] not in found.note
    # One that goes between finding and reading.
    (images / names[0]).unlink()
    forget_tree_photos(session)
    later = tree_photos(session, 1)
    assert names[0] not in [photo.name for photo in later.photos] and names[0] in later.note
    session.close()


def read_names(files):
    session = opened(files)
    found = tree_photos(session, 1).photos
    session.close()
    return found


def test_why_there_are_none(files, tmp_path):
    session = opened(files)
    session.do(commands.set_cameras(None))
    assert "no photos" in tree_photos(session, 1).note
    session.do(commands.set_cameras(CameraSource.of(tmp_path / "gone.json", tmp_path)))
    gone = tree_photos(session, 1)
    assert gone.photos == () and "cannot be read" in gone.note
    session.close()

    empty = tmp_path / "empty"
    empty.mkdir()
    poses = tmp_path / "poses.json"
    poses.write_bytes(files.poses.read_bytes())
    session = opened(files, poses=poses, images=empty)
    assert "on disk" in tree_photos(session, 1).note
    session.close()


def test_photos_of_another_frame_are_not_drawn_on(files, tmp_path):
    entries = json.loads(files.poses.read_text())
    for entry in entries["images"]:
        entry["x"] += 500.0
    poses = tmp_path / "poses.json"
    poses.write_text(json.dumps(entries))
    session = opened(files, poses=poses, images=files.folder / "images")
    found = tree_photos(session, 1)
    assert found.photos == () and "do not fit" in found.note
    session.close()


@pytest.mark.parametrize(
    ("why", "words"),
    [("far", "near enough"), ("out_of_frame", "outside"), ("hidden", "hidden"), ("no_photos", "no photos")],
)
def test_why_no_photo_shows_a_tree(plain, monkeypatch, why, words):
    forget_tree_photos(plain)
    monkeypatch.setattr(tree_views, "choose_views", lambda *_, **__: tree_views.TreeViews((), why))
    found = tree_photos(plain, 3)
    forget_tree_photos(plain)
    assert found.photos == () and words in found.note


def test_given_up_in_between_nothing_is_kept(plain):
    forget_tree_photos(plain)
    assert tree_photos(plain, 1, is_wanted=lambda: False) == TreePhotos()
    answers = iter([True, True, False, False, False])
    half = tree_photos(plain, 1, is_wanted=lambda: next(answers))
    assert len(half.photos) == 1
    assert len(tree_photos(plain, 1).photos) > 1


def test_memory_is_bounded(session, monkeypatch):
    monkeypatch.setattr(tree_photo_desk, "_PHOTO_BYTES", 1_600_000)  # one of these photos
    read = []
    from dbh_studio.io import photos

    real = photos.read_photo
    monkeypatch.setattr(photos, "read_photo", lambda photo, **how: read.append(photo.name) or real(photo, **how))
    forget_tree_photos(session)
    found = tree_photos(session, 1)
    assert read == [photo.name for photo in found.photos]
    tree_photos(session, 1, zoom=1.2)
    assert len(read) > len(found.photos)  # all but the last were forgotten
    for size in range(100, 140, 2):
        tree_photos(session, 1, size_px=(size, size))
    read.clear()
    assert tree_photos(session, 1) is not found


# ---- a rendered walk whose masks are known

WALK = Path(__file__).parents[2].parent / "shared" / "data" / "synthetic_360"


def test_the_pictures_of_a_walk_show_the_stems():
    if not WALK.exists():
        pytest.skip("synthetic_360 is not there: the shared data folder is absent")
    session = open_plot(WALK / "dense_unscaled.ply", scale=1.33231)
    known = json.loads((WALK / "world_from_model.json").read_text())
    from scipy.spatial.transform import Rotation

    true_from_model = Similarity(
        Rotation.from_quat(known["rotation_xyzw"]).as_matrix(), np.array(known["translation"]), known["metres_per_unit"]
    )
    points = true_from_model.apply(session.cloud.xyz + session.cloud.origin)
    stems = json.loads((WALK / "trees_gt.json").read_text())
    sets = []
    for tree in stems:
        height = points[:, 2] - tree["ground_z_mean"]
        near = np.hypot(points[:, 0] - tree["x"], points[:, 1] - tree["y"]) < 0.7
        sets.append(np.flatnonzero(near & (height > 0.5) & (height < 2.6)))
    session.do(commands.replace_trunks(TrunkSet.from_point_sets(sets)))
    session.do(commands.set_cameras(CameraSource.of(WALK / "colmap_equirectangular", WALK / "images")))
    session.remember_cameras(read_cameras(session.document.cameras, cloud_sample(session.cloud), is_chosen=True))
    shares, counts = [], []
    for number, tree in enumerate(stems, start=1):
        found = tree_photos(session, number)
        counts.append(len(found.photos))
        along = np.linspace(-0.9, 1.1, 30)[:, None]
        true = np.array(tree["centre_bh"]) + along * tree["axis_bh"]
        model = true_from_model.inverse().apply(true)
        for photo in found.photos:
            mask = np.asarray(Image.open(WALK / "masks" / f"{Path(photo.name).stem}.png"))
            posed = session.cameras.posed.by_name(photo.name)
            uv, _ = posed.project(model)
            size = np.array(mask.shape[::-1])
            at = np.floor(uv * size / [posed.camera.width_px, posed.camera.height_px]).astype(int) % size
            truly = float((mask[at[:, 1], at[:, 0]] == tree["tree_id"]).mean())
            shares.append((truly, photo.seen))
    session.close()
    assert min(counts) >= 2 and np.mean(counts) > 3
    truly, said = np.array(shares).T
    # The axis is on a stem's own pixels wherever nothing stands in front.
    assert np.quantile(truly, 0.05) > 0.5 and truly.mean() > 0.9
    assert np.abs(truly - said).mean() < 0.12
