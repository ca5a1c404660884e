"""Trunks cut and joined by what the masks tell apart, with the consent of geometry."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.ground import fit_ground
from dbh_studio.core.instances import InstanceGatherer
from dbh_studio.core.mask_views import ImageMask
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.transforms import Similarity
from dbh_studio.settings import TrunkSettings, VoteSettings
from dbh_studio.stages.instance_ties import TiedTrunks, tie_trunks
from dbh_studio.stages.mask_trunks import MaskTrunks, trunks_from_votes
from dbh_studio.stages.vote import Voters, make_voters, vote

CAMERA = CameraModel("EQUIRECTANGULAR", 1024, 512, ())
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
RING = [(4.0 * np.cos(a), 4.0 * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 12, endpoint=False)]


def stem(x: float, y: float, radius: float, low: float = 0.0, high: float = 4.0, n: int = 6000) -> np.ndarray:
    """(N, 3) points all round a stem."""
    rng = np.random.default_rng(int(1000 * (x + 7 * y + 13 * low)) % 2**31)
    angle, z = rng.uniform(0, 2 * np.pi, n), rng.uniform(low, high, n)
    surface = np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle), z])
    return surface + rng.normal(0, 0.004, (n, 3))


def floor() -> np.ndarray:
    side = np.arange(-6.0, 6.0, 0.1)
    xy = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    return np.column_stack([xy, 0.01 * np.sin(20 * xy[:, 0])])


class Scene:
    """Stems on a floor, seen from a ring of panoramas whose masks are drawn from the points themselves."""

    def __init__(self, stems: list[np.ndarray]) -> None:
        self.points = np.concatenate([floor(), *stems]).astype(np.float32)
        self.tree = np.repeat(np.arange(len(stems) + 1), [len(floor()), *map(len, stems)])
        self.ground = fit_ground(self.points)
        self.posed = PosedImages(
            tuple(
                PosedImage(f"{k:02d}.jpg", CAMERA, Similarity(LEVEL, -(LEVEL @ np.array([x, y, 1.6]))), order=k)
                for k, (x, y) in enumerate(RING)
            )
        )
        self.masks = {photo.name: self._drawn(photo) for photo in self.posed}

    def _drawn(self, photo: PosedImage) -> np.ndarray:
        cam = photo.cam_from_source.apply(self.points.astype(np.float64))
        uv, _ = CAMERA.project(cam)
        column, row = (np.clip(uv[:, k].astype(int), 0, (1023, 511)[k]) for k in (0, 1))
        label = np.zeros((512, 1024), np.uint8)
        order = np.argsort(-np.linalg.norm(cam, axis=1))
        for dr in (-1, 0, 1):
            for dc in (-1, 0, 1):
                label[np.clip(row[order] + dr, 0, 511), (column[order] + dc) % 1024] = self.tree[order]
        return label

    def voted(self, masks: dict[str, np.ndarray] | None = None) -> tuple[Voters, object, InstanceGatherer]:
        masks = self.masks if masks is None else masks
        voters = make_voters(self.points, self.posed, ground=self.ground)
        gatherer = InstanceGatherer(voters.points.xyz)
        votes = vote(
            voters,
            self.posed,
            lambda photo: ImageMask(CAMERA, masks[photo.name], has_instances=True) if photo.name in masks else None,
            on_photo=lambda _, photo: gatherer.add(photo),
        )
        return voters, votes, gatherer

    def tied(self, point_sets: list[np.ndarray], masks: dict[str, np.ndarray] | None = None) -> TiedTrunks:
        voters, votes, gatherer = self.voted(masks)
        ties = gatherer.ties(votes.is_trunk())
        sets = [np.sort(points).astype(np.int32) for points in point_sets]
        tied = tie_trunks(self.points, self.ground, voters, ties, sets, [None] * len(sets))
        # Whatever happens, no point is lost and none is in two trunks.
        np.testing.assert_array_equal(np.sort(np.concatenate(tied.point_sets)), np.sort(np.concatenate(sets)))
        return tied

    def rows(self, *trees: int) -> np.ndarray:
        return np.flatnonzero(np.isin(self.tree, trees) & (self.points[:, 2] > 0.3))

    def purity(self, points: np.ndarray) -> float:
        return float(np.bincount(self.tree[points]).max() / len(points))


@pytest.fixture(scope="module")
def twins() -> Scene:
    """Two stems that touch, and one by itself."""
    return Scene([stem(-0.15, 0.0, 0.14), stem(0.14, 0.0, 0.14), stem(1.5, 1.0, 0.12)])


def relabelled(scene: Scene, change) -> dict[str, np.ndarray]:
    return {name: change(k, mask.copy()) for k, (name, mask) in enumerate(scene.masks.items())}


def test_two_stems_in_one_trunk_are_cut_where_masks_tell_them_apart(twins):
    tied = twins.tied([twins.rows(1, 2), twins.rows(3)])
    assert len(tied.point_sets) == 3 and tied.n_split == 1 and tied.n_joined == 0 and not tied.doubts
    assert all(twins.purity(points) > 0.95 for points in tied.point_sets)


def test_masks_over_both_cut_nothing(twins):
    masks = relabelled(twins, lambda k, mask: np.where(mask == 2, 1, mask))
    tied = twins.tied([twins.rows(1, 2), twins.rows(3)], masks)
    assert len(tied.point_sets) == 2 and tied.n_split == 0


def test_some_masks_over_both_do_not_hide_that_the_others_tell_them_apart(twins):
    masks = relabelled(twins, lambda k, mask: np.where(mask == 2, 1, mask) if k % 4 == 0 else mask)
    assert twins.tied([twins.rows(1, 2)], masks).n_split == 1


def test_wrong_masks_do_not_cut_a_good_stem(twins):
    """Every photo has the stem in two masks side by side; the section is one ring."""

    def halves(k: int, mask: np.ndarray) -> np.ndarray:
        rows, columns = np.nonzero(mask == 3)
        # Not where the seam cuts it.
        if len(columns) and np.ptp(columns) < 400:
            right = columns > np.median(columns)
            mask[rows[right], columns[right]] = 50
        return mask

    tied = twins.tied([twins.rows(3)], relabelled(twins, halves))
    assert len(tied.point_sets) == 1 and tied.n_split == 0


def test_masks_cut_by_a_branch_do_not_cut_the_stem(twins):
    """Upper and lower half have masks of their own in every photo: one above the other is one stem."""

    def stacked(k: int, mask: np.ndarray) -> np.ndarray:
        rows, columns = np.nonzero(mask == 3)
        upper = rows < 250
        mask[rows[upper], columns[upper]] = 60
        return mask

    assert len(twins.tied([twins.rows(3)], relabelled(twins, stacked)).point_sets) == 1


def test_fragments_of_one_stem_are_joined(twins):
    own, z = twins.rows(3), twins.points[twins.rows(3), 2]
    # With a gap, as where a whorl hides the stem.
    low, high = own[z < 1.6], own[z > 2.2]
    tied = twins.tied([low, twins.rows(1, 2), high])
    assert tied.n_joined == 1 and tied.n_split == 1
    assert any(np.array_equal(points, np.sort(np.concatenate([low, high]))) for points in tied.point_sets)


def test_front_and_back_of_one_stem_are_joined(twins):
    own = twins.rows(3)
    front = twins.points[own, 0] > 1.5
    tied = twins.tied([own[front], own[~front]])
    assert len(tied.point_sets) == 1 and tied.n_joined == 1


def test_trunks_the_masks_tell_apart_are_not_joined(twins):
    tied = twins.tied([twins.rows(1), twins.rows(2), twins.rows(3)])
    assert len(tied.point_sets) == 3 and tied.n_joined == 0


def test_one_mask_over_two_trees_joins_nothing_that_does_not_lie_on_one_axis(twins):
    masks = relabelled(twins, lambda k, mask: np.where(mask > 0, 1, 0).astype(np.uint8))
    tied = twins.tied([twins.rows(1), twins.rows(2), twins.rows(3)], masks)
    assert len(tied.point_sets) == 3


def test_masks_without_numbers_change_nothing(twins):
    voters, _, _ = twins.voted()
    silent = InstanceGatherer(voters.points.xyz)
    sets = [np.sort(twins.rows(1, 2)).astype(np.int32)]
    tied = tie_trunks(twins.points, twins.ground, voters, silent.ties(), sets, [None])
    assert tied.n_split == tied.n_joined == 0 and tied.point_sets[0] is sets[0]


@pytest.mark.parametrize("seed", range(6))
def test_no_point_is_lost_whatever_the_masks_say(twins, seed):
    rng = np.random.default_rng(seed)

    def noise(k: int, mask: np.ndarray) -> np.ndarray:
        table = rng.integers(0, 5, 256).astype(np.uint8)
        tile = rng.integers(0, 3, (16, 32)).astype(np.uint8)
        return np.where(mask > 0, table[mask] + np.kron(tile, np.ones((32, 32), np.uint8)), 0).astype(np.uint8)

    whole = np.flatnonzero(twins.tree > 0)
    cuts = np.sort(rng.choice(np.arange(1, len(whole)), 4, replace=False))
    twins.tied(np.split(rng.permutation(whole), cuts), relabelled(twins, noise))  # checks it


# ---- the second look


def found(scene: Scene, masks: dict[str, np.ndarray], **trunks: object) -> MaskTrunks:
    voters, votes, gatherer = scene.voted(masks)
    return trunks_from_votes(
        scene.points,
        scene.ground,
        voters,
        votes,
        gatherer,
        trunks=TrunkSettings().changed(**trunks),
        settings=VoteSettings(),
    )


@pytest.fixture(scope="module")
def apart() -> Scene:
    """Three stems by themselves, and a pile of wood, 1 m high."""
    rng = np.random.default_rng(5)
    side, along, z = rng.integers(0, 4, 6000), rng.uniform(-0.5, 0.5, 6000), rng.uniform(0.0, 1.0, 6000)
    across = np.where(side % 2, 0.5, -0.5)
    x, y = np.where(side < 2, along, across), np.where(side < 2, across, along)
    pile = np.column_stack([x - 2.0, y - 2.0, z]) + rng.normal(0, 0.004, (6000, 3))
    return Scene([stem(-2.0, 0.5, 0.15), stem(0.3, 0.4, 0.12), stem(1.8, -1.2, 0.14), pile])


def no_pile(scene: Scene) -> dict[str, np.ndarray]:
    return relabelled(scene, lambda k, mask: np.where(mask == 4, 0, mask))


def test_where_masks_and_shape_agree_nothing_is_said(apart):
    result = found(apart, no_pile(apart))
    assert len(result.point_sets) == 3 and not result.candidates and not result.flags


def test_a_stem_no_mask_shows_is_a_candidate(apart):
    masks = relabelled(apart, lambda k, mask: np.where(mask >= 3, 0, mask))
    result = found(apart, masks)
    assert len(result.point_sets) == 2
    (candidate,) = result.candidates
    assert candidate.kind == "denied" and candidate.n_called == 0 and candidate.n_seen >= 10
    assert f"{candidate.n_seen} photos have it in view, none calls it trunk" in candidate.reason
    np.testing.assert_allclose(candidate.xy_m, (1.8, -1.2), atol=0.03)
    assert candidate.diameter_m == pytest.approx(0.28, rel=0.1) and apart.purity(candidate.points) > 0.99
    assert any("1 candidate was found" in note for note in result.notes)


def test_a_stem_too_few_masks_show_is_a_candidate_that_says_so(apart):
    masks = relabelled(apart, lambda k, mask: np.where(mask == 4, 0, mask) if k < 2 else np.where(mask >= 3, 0, mask))
    (candidate,) = found(apart, masks).candidates
    assert candidate.kind == "outvoted" and candidate.n_called == 2 and "only 2 call it trunk" in candidate.reason


def test_a_stem_out_of_sight_of_the_masks_is_a_candidate_that_says_so(apart):
    """The only photo whose mask is there looks away: what it sees says nothing."""
    masks = no_pile(apart)
    ignored = {}
    for photo in apart.posed:
        blind = np.zeros((512, 1024), bool)
        blind[masks[photo.name] == 3] = True
        ignored[photo.name] = blind
    voters = make_voters(apart.points, apart.posed, ground=apart.ground)
    gatherer = InstanceGatherer(voters.points.xyz)
    votes = vote(
        voters,
        apart.posed,
        lambda photo: ImageMask(CAMERA, np.where(masks[photo.name] == 3, 0, masks[photo.name]), ignored[photo.name]),
        on_photo=lambda _, photo: gatherer.add(photo),
    )
    result = trunks_from_votes(apart.points, apart.ground, voters, votes, gatherer)
    (candidate,) = result.candidates
    assert candidate.kind == "unseen" and candidate.reason == "no photo with a mask has it in view"


def test_what_the_chain_lost_is_a_candidate_that_says_where(apart):
    """By the paper's rule the smaller half of the clusters goes."""
    result = found(apart, no_pile(apart), small_clusters="otsu", smallest_cluster_points=10**7)
    assert not result.point_sets and len(result.candidates) == 3
    assert {each.kind for each in result.candidates} == {"dropped"}
    assert all("its cluster is too small" in each.reason for each in result.candidates)


def test_a_stem_that_masks_show_in_part_is_completed_and_flagged(apart):
    """The masks end 1 m above ground, and have a second piece above 3 m."""

    def pieces(k: int, mask: np.ndarray) -> np.ndarray:
        rows, columns = np.nonzero(mask == 3)
        elevation = np.pi * (0.5 - (rows + 0.5) / 512)
        away = np.hypot(*(np.array(RING[k]) - (1.8, -1.2)))
        height = 1.6 + np.tan(elevation) * away
        hidden = (height > 1.0) & (height < 3.3)
        mask[rows[hidden], columns[hidden]] = 0
        return np.where(mask == 4, 0, mask)

    result = found(apart, relabelled(apart, pieces), small_clusters="keep")
    of_stem = [k for k, points in enumerate(result.point_sets) if np.bincount(apart.tree[points]).argmax() == 3]
    assert len(of_stem) == 1 and not result.candidates
    assert "only a part of this stem" in result.flags[of_stem[0]]
    assert np.isin(apart.rows(3), result.point_sets[of_stem[0]]).mean() > 0.95


def test_a_pile_called_trunk_is_offered_and_no_trunk(apart):
    result = found(apart, apart.masks, small_clusters="keep")
    low = [each for each in result.candidates if each.kind == "low"]
    assert len(result.point_sets) == 3 and len(low) >= 1
    assert all(each.n_called >= 2 and "a log or a bush?" in each.reason for each in low)
    assert {4} == {int(apart.tree[each.points[0]]) for each in low}


def test_a_trunk_only_masks_see_is_flagged(twins):
    """A flat board, 2.5 m high: no rings."""
    rng = np.random.default_rng(3)
    board = np.column_stack([rng.uniform(-0.6, 0.6, 5000), np.full(5000, 0.2), rng.uniform(0, 2.5, 5000)])
    scene = Scene([board + rng.normal(0, 0.004, board.shape), stem(1.5, 1.0, 0.12)])
    result = found(scene, scene.masks, small_clusters="keep")
    assert len(result.point_sets) == 2 and not result.candidates
    of_board = [index for index, points in enumerate(result.point_sets) if scene.tree[points[0]] == 1]
    assert list(result.flags) == of_board and "only masks see it" in result.flags[of_board[0]]


def test_without_a_second_look_nothing_is_compared(apart):
    voters, votes, gatherer = apart.voted(relabelled(apart, lambda k, mask: np.where(mask >= 3, 0, mask)))
    result = trunks_from_votes(
        apart.points, apart.ground, voters, votes, gatherer, settings=VoteSettings(second_look=False)
    )
    assert len(result.point_sets) == 2 and not result.candidates and not result.flags
