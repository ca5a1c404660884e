from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.app.plots import contents, make_cloud, make_document, trunk

from dbh_studio.app import commands
from dbh_studio.app.document import Document, fingerprint, rotation_to_world, unit_direction
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.inventory import TreeRecord
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.transforms import UP_AXES, rotation_to_z_up
from dbh_studio.core.trunks import TrunkSet
from dbh_studio.errors import CommandError


@pytest.fixture
def document() -> Document:
    return make_document(make_cloud(), n_trunks=3)


@pytest.mark.parametrize(
    "command",
    [
        commands.rename_plot("  "),
        commands.set_up((0, 0, 0)),
        commands.set_up("up"),
        commands.set_up((0, float("nan"), 1)),
        commands.change_settings("measure", min_points=-1),
        commands.change_settings("measure", no_such_setting=1),
        commands.change_settings("colours", red=1),
        commands.replace_trunks(TrunkSet((trunk(1, 0, 1), trunk(2, 1, 2)))),
        commands.replace_trunks(TrunkSet((trunk(1, 999, 1000),))),
        commands.replace_trunks(TrunkSet((trunk(1, -1, 3),))),
        commands.replace_trunks(TrunkSet((trunk(1),))),
        commands.delete_trunk(9),
        commands.set_tree_record(9, species="oak"),
        commands.set_tree_record(1, status="sleeping"),
        commands.set_tree_record(1, colour="red"),
        commands.set_tree_record(1, species=5),
        commands.set_tree_record(1, tree_id=0),
        commands.set_tree_record(1, tree_id=2**31),
        commands.set_tree_record(1, note="half a pair \ud800"),
        commands.set_tree_record(1, edited="yes"),
        commands.rename_plot("half a pair \ud800"),
    ],
    ids=lambda command: ascii(command.label),
)
def test_an_illegal_command_is_refused_in_words_and_changes_nothing(document, command):
    before = contents(document)
    with pytest.raises(CommandError) as caught:
        command.apply(document)
    assert len(caught.value.problem) > 10
    assert contents(document) == before


@pytest.mark.parametrize(
    "command",
    [
        commands.rename_plot("plot"),
        commands.set_scale(ScaleEstimate(1.0, "metres")),
        commands.set_up("+z"),
        commands.set_up((0, 0, 5)),
        commands.change_settings("ground", method="terrain"),
        commands.set_tree_record(1, species=""),
    ],
    ids=lambda command: command.label,
)
def test_a_command_that_changes_nothing_returns_the_same_document(document, command):
    assert command.apply(document) is document


def test_a_command_shares_what_it_does_not_touch(document):
    after = commands.set_scale(ScaleEstimate(2.0, "factor")).apply(document)
    assert after.trunks is document.trunks and after.trees is document.trees and after.settings is document.settings
    assert after.scale.metres_per_unit == 2.0
    after = commands.change_settings("measure", curve="ellipse").apply(document)
    assert after.settings.measure.curve == "ellipse"
    assert after.settings.ground is document.settings.ground
    deleted = commands.delete_trunk(2).apply(document)
    assert deleted.trunks[1] is document.trunks[1] and deleted.trunks[3] is document.trunks[3]


def test_deleting_takes_the_record_along_and_never_gives_the_id_out_again(document):
    described = commands.set_tree_record(2, species="beech", tag="A7").apply(document)
    deleted = commands.delete_trunk(2).apply(described)
    assert deleted.trunks.ids == (1, 3) and 2 not in deleted.trees
    assert deleted.trunks.next_id == 4
    last = commands.delete_trunk(3).apply(deleted)
    assert last.trunks.next_id == 4
    restored = commands.restore_trunk(described, 2).apply(deleted)
    assert restored.trunks[2] is document.trunks[2]
    assert restored.trees[2] == TreeRecord(species="beech", tag="A7")


def test_a_trunk_is_not_restored_over_another_or_from_another_plot(document):
    with pytest.raises(CommandError, match="still there"):
        commands.restore_trunk(document, 1).apply(document)
    with pytest.raises(CommandError, match="no trunk 9"):
        commands.restore_trunk(document, 9).apply(document)
    deleted = commands.delete_trunk(1).apply(document)
    taken = replace(deleted, trunks=deleted.trunks.with_trunk(trunk(7, 9, 500)))
    with pytest.raises(CommandError, match="belong to trunk 7"):
        commands.restore_trunk(document, 1).apply(taken)
    other = make_document(make_cloud(seed=1), n_trunks=3)
    with pytest.raises(CommandError, match="another cloud"):
        commands.restore_trunk(other, 1).apply(deleted)


def test_the_first_trunks_keep_their_own_numbers():
    document = make_document(make_cloud())
    after = commands.replace_trunks(TrunkSet((trunk(17, 1, 2), trunk(230, 5, 6)))).apply(document)
    assert after.trunks.ids == (17, 230) and after.trunks.next_id == 231


def test_a_files_own_numbers_stay_unless_another_trunk_has_them(document):
    """Whatever numbers were given out meanwhile: in the field the trees bear those of the file."""
    emptied = replace(document, trunks=TrunkSet(next_id=308))
    own = TrunkSet((trunk(107, 1, 2, origin="file"), trunk(207, 5, 6, origin="file"), trunk(9, 7, 8)))
    after = commands.replace_trunks(own).apply(emptied)
    assert after.trunks.ids == (107, 207, 308) and after.trunks.next_id == 309
    assert after.trunks[308].points.tolist() == [7, 8]
    # Present are trunks 1 to 3 on points 0..29: one is found again, one number is taken, one is free and high.
    found = TrunkSet((trunk(2, 500, 501, origin="file"), trunk(50, *range(20, 30), origin="file"), trunk(4, 7, 8)))
    found = found.with_trunk(trunk(77, 600, 601, origin="file"))
    after = commands.replace_trunks(found).apply(commands.set_tree_record(2, species="oak").apply(document))
    points = {t.id: t.points[0] for t in after.trunks}
    assert points[3] == 20 and points[77] == 600 and 2 not in points and after.trees.get(2) is None
    assert sorted(points) == [3, 77, 78, 79] and after.trunks.next_id == 80


def test_where_no_number_is_left_it_says_so(document):
    full = replace(document, trunks=TrunkSet(document.trunks.trunks, 2**31 - 1))
    two = TrunkSet((trunk(1, 500, 501), trunk(2, 600, 601)))
    with pytest.raises(CommandError, match="number"):
        commands.replace_trunks(two).apply(full)
    assert commands.replace_trunks(two.without(2)).apply(full).trunks.ids == (2**31 - 1,)
    with pytest.raises(ValueError, match="at most"):
        trunk(2**31, 1)


@pytest.mark.parametrize("error", [float("nan"), float("inf"), -0.1])
def test_a_standard_error_is_a_number(error):
    with pytest.raises(ValueError, match="standard error"):
        ScaleEstimate(1.0, "marker", error)


def test_trunks_found_again_keep_id_and_record_and_others_get_new_ids(document):
    described = commands.set_tree_record(2, species="oak", edited=True).apply(document)
    # Old trunk 2 is points 10..19: eight of them and one more are still that trunk; half of trunk 1 is not.
    found = TrunkSet((trunk(1, *range(10, 18), 500), trunk(2, *range(0, 5)), trunk(3, 700, 701)))
    after = commands.replace_trunks(found).apply(described)
    assert after.trunks.ids == (2, 4, 5)
    assert after.trunks[2].points.tolist() == [*range(10, 18), 500]
    assert after.trunks[4].points.tolist() == [0, 1, 2, 3, 4]
    assert dict(after.trees) == {2: TreeRecord(species="oak", edited=False)}
    assert after.trunks.next_id == 6


def test_an_emptied_record_is_no_record(document):
    described = commands.set_tree_record(1, note="fork").apply(document)
    assert dict(described.trees) == {1: TreeRecord(note="fork")}
    assert dict(commands.set_tree_record(1, note="").apply(described).trees) == {}


def test_the_six_axes_turn_exactly_and_any_direction_turns_to_z():
    for axis in UP_AXES:
        assert np.array_equal(rotation_to_world(unit_direction(axis)), rotation_to_z_up(axis))
    rng = np.random.default_rng(0)
    for direction in rng.normal(size=(50, 3)):
        up = unit_direction(direction)
        rotation = rotation_to_world(up)
        assert rotation @ up == pytest.approx([0, 0, 1], abs=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        # Making a document of a document must not move it.
        assert unit_direction(up) == up


def test_the_world_is_about_the_clouds_origin_and_in_metres():
    cloud = make_cloud()
    document = make_document(cloud, scale=ScaleEstimate(0.5, "factor"), up_direction=unit_direction("+y"))
    world = document.world_from_source.apply(cloud.xyz)
    assert world.dtype == np.float32
    assert np.allclose(world, 0.5 * cloud.xyz[:, [0, 2, 1]] * [1, -1, 1])
    unscaled = replace(document, scale=ScaleEstimate(7.0, "unknown"))
    assert unscaled.world_from_source.scale == 1.0


def test_a_document_is_a_value():
    document = make_document(make_cloud(), n_trunks=1)
    with pytest.raises(TypeError):
        document.trees[1] = TreeRecord()
    with pytest.raises(ValueError, match="no trunk"):
        replace(document, trees={5: TreeRecord()})


def test_the_fingerprint_sees_points_order_and_origin_and_nothing_else():
    cloud = make_cloud()
    moved = cloud.xyz.copy()
    moved[500, 1] = np.nextafter(moved[500, 1], np.float32(100))
    others = [
        PointCloud(cloud.xyz[::-1], cloud.origin),
        PointCloud(cloud.xyz[:-1], cloud.origin),
        PointCloud(cloud.xyz, cloud.origin + 1),
        PointCloud(moved, cloud.origin),
    ]
    assert len({fingerprint(cloud), *(fingerprint(other) for other in others)}) == 5
    same = PointCloud(cloud.xyz.copy(), cloud.origin, rgb=np.zeros(cloud.xyz.shape, np.uint8), name="copy.ply")
    assert fingerprint(same) == fingerprint(cloud)
