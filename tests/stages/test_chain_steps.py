"""What the search did with every point and cluster: labels and counts agree, and what is advised brings it back."""

from __future__ import annotations

import numpy as np
import pytest
from tests.stages.small_forest import STAND, Tree, ball, forest

from dbh_studio.core.chain_advice import story_of_cluster, story_of_miss, story_of_point
from dbh_studio.core.chain_steps import NO_NORMAL, ChainSteps, Cluster, NearMiss, Step
from dbh_studio.core.ground import StemBaseGround, fit_ground
from dbh_studio.settings import GroundSettings, TrunkSettings
from dbh_studio.stages.segment import SegmentationResult, segment_trunks

FLAT = StemBaseGround(np.zeros((1, 3)))


def check_partition(result: SegmentationResult, n_points: int) -> None:
    """Every point has one step, and every count can be had from the labels."""
    steps = result.steps
    assert steps.labels.shape == (n_points,) and steps.labels.dtype == np.uint8
    assert not steps.labels.flags.writeable
    assert sum(steps.counts) == n_points and steps.counts == tuple(np.bincount(steps.labels, minlength=8))
    assert sum(steps.joined_from) == steps.counts[Step.JOINED]
    in_trunks = np.zeros(n_points, bool)
    for points in result.point_sets:
        in_trunks[points] = True
    assert np.array_equal(in_trunks, steps.labels >= Step.KEPT)
    assert n_points >= steps.n_candidates >= steps.n_above_ground >= steps.n_facing_sideways >= steps.n_clustered
    assert steps.n_clustered == sum(cluster.n_points for cluster in steps.clusters)
    assert steps.n_in_clusters == sum(cluster.n_points for cluster in steps.clusters if cluster.kept)
    assert steps.n_expanded == in_trunks.sum()
    dropped = [steps.clusters[k].n_points for k in steps.dropped]
    found = np.bincount(steps.dropped_cluster, minlength=len(steps.clusters))[list(steps.dropped)]
    assert found.sum() + steps.joined_from[Step.DROPPED] == sum(dropped)
    assert len(steps.tilt_deg) == steps.counts[Step.NOT_SIDEWAYS]
    assert (steps.tilt_deg > steps.settings.normal_max_deg).all()


@pytest.mark.parametrize("rule", ["evidence", "otsu", "keep"])
@pytest.mark.parametrize("way", ["geometry", "masks", "paper"])
def test_labels_partition_the_cloud_and_agree_with_the_counts(rule, way):
    points, labels = forest(STAND, n_shrubs=8, outliers=0.01)
    ground_settings = GroundSettings.paper() if way == "paper" else GroundSettings()
    ground, rng = fit_ground(points, settings=ground_settings), np.random.default_rng(0)
    assert (ground.kind == "plane") == (way == "paper")
    # Masks miss a third of the trunks, and bleed.
    masks = ((labels > 0) & (rng.random(len(points)) < 0.7)) | (rng.random(len(points)) < 0.02)
    settings = TrunkSettings.paper() if way == "paper" else TrunkSettings()
    settings = settings.changed(small_clusters=rule)
    result = segment_trunks(points, ground, settings=settings, candidates=None if way == "geometry" else masks)
    check_partition(result, len(points))
    steps = result.steps
    assert steps.from_masks == (way != "geometry") and len(result.point_sets) > 0
    if way == "paper":
        assert steps.n_stems_detected == 0
    if way != "geometry":
        # What the masks never named is nothing but that, or near a trunk.
        assert set(np.unique(steps.labels[~masks])) <= {Step.NO_CANDIDATE, Step.JOINED}
        assert steps.n_candidates == masks.sum() and steps.joined_from[Step.NO_CANDIDATE] > 0


def test_nothing_found_still_tells_of_every_point():
    points, _ = forest([], n_shrubs=5)
    ground = fit_ground(points)
    for candidates in (None, np.zeros(len(points), bool)):
        result = segment_trunks(points, ground, candidates=candidates)
        check_partition(result, len(points))
        assert result.steps.clusters == () and result.steps.n_expanded == 0
    empty = segment_trunks(np.empty((0, 3), np.float32), FLAT)
    assert empty.steps.n_points == 0 and sum(empty.steps.counts) == 0


def made_cloud() -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """A cloud in masks, flat ground at 0, of which it is known what must happen to every part of it."""
    rng = np.random.default_rng(3)

    def tube(x: float, radius: float, low: float, high: float, n: int) -> np.ndarray:
        angle = rng.uniform(0, 2 * np.pi, n)
        return np.column_stack([x + radius * np.cos(angle), radius * np.sin(angle), rng.uniform(low, high, n)])

    # Thirty degrees from level: its normal is sixty from horizontal.
    across = rng.uniform(0.0, 1.0, 4000)
    shelf = np.column_stack([5.0 + across, rng.uniform(5, 6, 4000), 2.0 + np.tan(np.radians(30.0)) * across])
    parts = {
        "trunk": tube(0.0, 0.15, 0.35, 7.5, 20_000),
        "twig": tube(3.0, 0.06, 1.0, 1.6, 3000),
        "foot": tube(0.0, 0.15, 0.0, 0.25, 500),
        "crown": tube(0.0, 0.15, 9.0, 10.0, 500),
        "shelf": shelf,
        "dust": np.column_stack([np.arange(20) * 1.0 - 10, np.full(20, -6.0), np.full(20, 3.0)]),
        "beside": tube(0.0, 0.17, 2.0, 5.0, 300),
        "unseen": tube(-4.0, 0.15, 0.35, 7.5, 3000),
    }
    named = {name: np.full(len(part), k) for k, (name, part) in enumerate(parts.items())}
    points = np.concatenate(list(parts.values())).astype(np.float32)
    which = np.concatenate(list(named.values()))
    rows = {name: np.flatnonzero(which == k) for k, name in enumerate(parts)}
    candidates = ~np.isin(which, [list(parts).index("beside"), list(parts).index("unseen")])
    return points, candidates, rows


def test_every_reason_is_reached_and_named():
    points, candidates, rows = made_cloud()
    settings = TrunkSettings(part_touching=False, small_clusters="otsu")
    result = segment_trunks(points, FLAT, settings=settings, candidates=candidates)
    check_partition(result, len(points))
    labels = result.steps.labels
    expected = {
        "trunk": Step.KEPT,
        "twig": Step.DROPPED,
        "foot": Step.TOO_LOW,
        "crown": Step.TOO_HIGH,
        "shelf": Step.NOT_SIDEWAYS,
        "dust": Step.NOT_SIDEWAYS,
        "beside": Step.JOINED,
        "unseen": Step.NO_CANDIDATE,
    }
    for name, step in expected.items():
        assert (labels[rows[name]] == step).mean() > 0.97, name
    steps = result.steps
    # Single points have no normal.
    assert steps.tilt_of(int(rows["dust"][3])) == NO_NORMAL
    tilts = [steps.tilt_of(int(row)) for row in rows["shelf"] if labels[row] == Step.NOT_SIDEWAYS]
    assert np.median(tilts) == pytest.approx(60, abs=2)
    assert steps.tilt_of(int(rows["trunk"][0])) is None
    twig = [cluster for cluster in steps.clusters if not cluster.kept]
    assert len(twig) == 1 and twig[0].n_points > 2900
    assert twig[0].width_m == pytest.approx(0.12, abs=0.02)
    assert (twig[0].low_m, twig[0].high_m) == pytest.approx((1.0, 1.6), abs=0.05)
    assert twig[0].point in rows["twig"]
    own = rows["twig"][labels[rows["twig"]] == Step.DROPPED]
    index = steps.cluster_of(int(own[7]))
    assert index is not None and not steps.clusters[index].kept
    assert np.array_equal(steps.points_of_cluster(index), own)
    # Too few neighbours: points that face sideways but are in no cluster.
    loose = segment_trunks(points, FLAT, settings=settings.changed(cluster_min_points=3000), candidates=candidates)
    assert (loose.steps.labels[own] == Step.LOOSE).all()
    assert loose.steps.counts[Step.DROPPED] == 0


def tell(steps: ChainSteps, points: np.ndarray, row: int, **options: object):
    x, y, z = (float(value) for value in points[row])
    return story_of_point(steps, row, height_m=z, xy_m=(x, y), **options)


@pytest.mark.parametrize("part", ["foot", "crown", "shelf", "twig"])
def test_what_is_advised_for_a_point_takes_it_past_the_step_that_dropped_it(part):
    points, candidates, rows = made_cloud()
    settings = TrunkSettings(part_touching=False, small_clusters="otsu")
    steps = segment_trunks(points, FLAT, settings=settings, candidates=candidates).steps
    wanted = {"foot": Step.TOO_LOW, "crown": Step.TOO_HIGH, "shelf": Step.NOT_SIDEWAYS, "twig": Step.DROPPED}[part]
    row = int(rows[part][steps.labels[rows[part]] == wanted][0])
    story = tell(steps, points, row)
    assert story.step == steps.labels[row] and story.advice and story.advice[0].changes
    again = segment_trunks(
        points, FLAT, settings=settings.changed(**story.advice[0].changes), candidates=candidates
    ).steps
    assert again.labels[row] != story.step


def test_points_without_a_setting_that_helps_say_so():
    points, candidates, rows = made_cloud()
    steps = segment_trunks(points, FLAT, settings=TrunkSettings(part_touching=False), candidates=candidates).steps
    unseen = tell(steps, points, int(rows["unseen"][0]))
    assert "masks" in unseen.text and not unseen.advice[0].changes
    below = story_of_point(steps, int(rows["foot"][0]), height_m=-0.2, xy_m=(0.0, 0.0))
    assert "below the ground" in below.advice[0].text and not below.advice[0].changes
    stray = story_of_point(steps, int(rows["crown"][0]), height_m=2.0, xy_m=(0.0, 0.0))
    assert "outside" in stray.text
    dust = tell(steps, points, int(rows["dust"][0]))
    assert dust.advice[0].changes == {"normal_radius_m": 0.16}
    loose = segment_trunks(
        points, FLAT, settings=TrunkSettings(part_touching=False, cluster_min_points=3000), candidates=candidates
    ).steps
    few = tell(loose, points, int(rows["twig"][0]), n_near=120)
    assert few.advice[0].changes == {"cluster_min_points": 120}


@pytest.mark.parametrize(("way", "seed"), [("geometry", 0), ("masks", 1), ("paper", 2)])
def test_the_advised_setting_brings_the_cluster_back_and_what_it_says_beside(way, seed):
    rng = np.random.default_rng(seed)
    trees = [
        Tree(float(x) + rng.uniform(-0.5, 0.5), float(y), float(d), rng.uniform(0, 6), rng.uniform(0, 360))
        for (x, y), d in zip([(-3, -3), (3, -3), (0, 0), (-3, 3), (3, 3)], rng.uniform(0.06, 0.7, 5), strict=True)
    ]
    points, labels = forest(trees, size=9.0, spacing=0.04, crowns=False, n_shrubs=3, seed=seed)
    ground = fit_ground(points)
    candidates = None if way == "geometry" else (labels > 0) & (rng.random(len(points)) < 0.8)
    settings = TrunkSettings.paper() if way == "paper" else TrunkSettings(small_clusters="otsu")
    steps = segment_trunks(points, ground, settings=settings, candidates=candidates).steps
    assert steps.dropped, "the made plot must lose something"
    index = int(rng.choice(steps.dropped))
    story = story_of_cluster(steps, index)
    assert f"{steps.clusters[index].n_points:,} points" in story.text and story.advice
    came_back = []
    for advice in story.advice:
        changed = settings.changed(**advice.changes)
        after = segment_trunks(points, ground, settings=changed, candidates=candidates).steps
        assert after.clusters[index].n_points == steps.clusters[index].n_points
        assert after.clusters[index].kept, advice.text
        assert set(np.unique(after.labels[steps.points_of_cluster(index)])) <= {Step.KEPT}
        back = sum(now.kept and not then.kept for now, then in zip(after.clusters, steps.clusters, strict=True))
        assert back == advice.n_others + 1
        came_back.append(back)
    # What changes least comes first.
    assert came_back == sorted(came_back)


def sizes(
    *clusters: tuple[int, bool, bool], rule: str = "otsu", least: int = 0, threshold: float = 1000.0
) -> ChainSteps:
    """A search of which only the clusters matter: points, rings, kept."""
    return ChainSteps(
        labels=np.zeros(4, np.uint8),
        dropped_cluster=np.empty(0, np.int32),
        tilt_deg=np.empty(0, np.uint8),
        joined_from=(0,) * 8,
        clusters=tuple(Cluster(n, 0 if kept else -1, rings, kept) for n, rings, kept in clusters),
        size_threshold=threshold,
        settings=TrunkSettings(small_clusters=rule, smallest_cluster_points=least),
        from_masks=True,
    )


def test_why_and_what_in_words():
    steps = sizes((9000, True, True), (8000, True, True), (1240, True, False), (200, False, False), threshold=7999.5)
    story = story_of_cluster(steps, 2)
    assert story.text == (
        "1,240 points are fewer than the 8,000 that Otsu's threshold asks for, and size alone decides, though it has "
        "the rings of a stem."
    )
    assert [dict(advice.changes) for advice in story.advice] == [
        {"smallest_cluster_points": 1200},
        {"small_clusters": "evidence", "smallest_cluster_points": 0},
        {"small_clusters": "keep"},
    ]
    assert story.advice[0].text == "Set “Smallest cluster” to 1,200 (nothing else changes)."
    assert "1 other dropped cluster comes back too" in story.advice[2].text
    fixed = sizes((500, False, False), (50, False, False), rule="evidence", least=600, threshold=600.0)
    assert "“Smallest cluster” asks for, and no rings" in story_of_cluster(fixed, 0).text


def test_a_round_number_is_not_advised_where_it_would_bring_others():
    steps = sizes((9000, True, True), (1240, False, False), (1210, False, False))
    assert dict(story_of_cluster(steps, 1).advice[0].changes) == {"smallest_cluster_points": 1240}


def test_a_stem_that_settings_lose_is_a_near_miss_and_comes_back_with_what_is_advised():
    points, _ = forest(STAND, n_shrubs=12)
    ground = fit_ground(points)
    strict = TrunkSettings(min_arc_deg=200.0)
    steps = segment_trunks(points, ground, settings=strict).steps
    missed = [miss for miss in steps.near_misses if np.hypot(miss.x_m + 1.5, miss.y_m - 1.2) < 0.5]
    assert len(missed) == 1 and missed[0].reasons == ("min_arc_deg",)
    assert missed[0].diameter_m == pytest.approx(0.18, abs=0.04)
    story = story_of_miss(steps, missed[0])
    again = segment_trunks(points, ground, settings=strict.changed(**story.advice[0].changes)).steps
    assert again.n_stems_detected == steps.n_stems_detected + 1
    # A click on it tells the same; beside all stems another thing is said.
    at = (missed[0].x_m + 0.09, missed[0].y_m)
    row = int(np.flatnonzero(steps.labels == Step.NO_CANDIDATE)[0])
    assert story_of_point(steps, row, height_m=1.0, xy_m=at).text == story.text
    elsewhere = story_of_point(steps, row, height_m=1.0, xy_m=(50.0, 50.0))
    assert "200° of arc" in elsewhere.text and not elsewhere.advice[0].changes


def test_a_short_stretch_of_stem_is_a_near_miss():
    points, labels = forest(STAND[:1], crowns=False)
    height = points[:, 2]
    # Of the stem only what is between 1 and 2 m is seen.
    seen = (labels == 0) | ((height > 1.0) & (height < 2.0))
    rng = np.random.default_rng(0)
    bush = ball(3.0, 3.0, 1.0, 0.8, 3000, rng).astype(np.float32)
    cloud = np.concatenate([points[seen], bush])
    ground = fit_ground(cloud)
    strict = TrunkSettings(stem_length_m=1.5)
    steps = segment_trunks(cloud, ground, settings=strict).steps
    assert [miss.reasons for miss in steps.near_misses] == [("stem_length_m",)]
    advice = story_of_miss(steps, steps.near_misses[0]).advice[0]
    assert len(segment_trunks(cloud, ground, settings=strict.changed(**advice.changes)).point_sets) == 1


def test_a_near_miss_below_what_a_setting_allows_has_no_advice():
    miss = NearMiss(0.0, 0.0, 1.0, 1.1, 0.2, 0.3, 180.0, 4, ("stem_length_m",))
    assert story_of_miss(sizes((10, False, False)), miss).advice == ()
