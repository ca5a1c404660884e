"""The steps of the last search in the studio: colours, legend, what was lost and what brings it back."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import numpy as np
import plots
import pytest
from fakeclient import FakeClient
from panel import LONG, find_trunks

from dbh_studio.app import commands
from dbh_studio.app.opening import open_plot
from dbh_studio.app.pipeline import apply_segmentation, segment_plot, segmentation_call
from dbh_studio.core.chain_advice import story_of_cluster
from dbh_studio.core.chain_steps import ChainSteps, Cluster, Step
from dbh_studio.settings import TrunkSettings
from dbh_studio.ui import chain_html


@pytest.fixture
def searched(studio, tmp_path):
    """A tab in step 3 of a plot of whose five stems size alone has dropped some."""
    session = open_plot(plots.write_laz(tmp_path), project_dir=tmp_path / "plot.dbh")
    session.do(commands.change_settings("trunks", small_clusters="otsu"))
    apply_segmentation(session, session.document, segment_plot(*segmentation_call(session, session.document)))
    assert session.last_search.steps.dropped
    studio.adopt(session)
    with FakeClient(studio.server.url) as tab:
        tab.wait(lambda t: "/labels" in t.scene, LONG)
        assert studio.wait_idle(LONG)
        tab.bridge_send("step", "trunks")
        tab.wait_text("Where trees were lost")
        yield tab


def ran(tab: FakeClient, text: str) -> bool:
    """Whether the last legend that was drawn has this in it."""
    drawn = [m["source"] for m in list(tab.messages) if "dbh-chain" in str(m.get("source", ""))]
    return bool(drawn) and text in drawn[-1]


def steps_of(studio) -> ChainSteps:
    return studio.session.last_search.steps


def row_of(studio, step: Step) -> int:
    """A point of the cloud of that step, far from other things."""
    return int(np.flatnonzero(steps_of(studio).labels == step)[0])


def test_the_mode_is_offered_once_there_is_a_search(studio, tmp_path):
    session = open_plot(plots.write_laz(tmp_path), project_dir=tmp_path / "plot.dbh")
    studio.adopt(session)
    with FakeClient(studio.server.url) as tab:
        tab.wait(lambda t: "/labels" in t.scene, LONG)
        tab.settle()  # the plot is shown: a step chosen before would be overtaken
        tab.bridge_send("step", "trunks")
        tab.wait(lambda t: t.has("Find trunks"))
        assert "Where trees were lost" not in tab.text()
        tab.bridge_send("colours", "Steps")
        tab.settle()
        assert not [name for name in tab.scene if name.startswith("/steps/")]
        find_trunks(tab, studio)
        tab.bridge_send("step", "trunks")
        tab.wait_text("Where trees were lost")
        tab.bridge_send("colours", "Steps")
        tab.wait(lambda t: "/steps/6" in t.scene and t.scene["/steps"].visible)


def test_every_step_has_its_points_colour_and_switch(searched, studio):
    steps = steps_of(studio)
    searched.bridge_send("colours", "Steps")
    searched.wait(lambda t: t.scene["/steps"].visible and not t.scene["/rgb"].visible)
    present = [step for step in Step if steps.counts[step]]
    nodes = {name for name in searched.scene if name.startswith("/steps/")}
    assert nodes == {f"/steps/{int(step)}" for step in present}
    points = studio.session.points_world()
    for step in (Step.DROPPED, Step.KEPT):
        drawn = searched.scene[f"/steps/{int(step)}"].props["points"]
        assert len(drawn) == steps.counts[step]
        np.testing.assert_allclose(np.sort(drawn[:, 0]), np.sort(points[steps.labels == step, 0]), atol=1e-4)
    searched.wait(lambda t: ran(t, "cluster dropped") and ran(t, f"{steps.counts[Step.DROPPED]:,}"))
    # Crowns would hide the stems; the rest is on.
    assert not searched.scene["/steps/2"].visible and searched.scene["/steps/5"].visible
    searched.bridge_send("chain_step", 5)
    searched.wait(lambda t: not t.scene["/steps/5"].visible)
    searched.bridge_send("chain_step", 5)
    searched.wait(lambda t: t.scene["/steps/5"].visible)
    searched.bridge_send("colours", "Original")
    searched.wait(lambda t: t.scene["/rgb"].visible and not t.scene["/steps"].visible)
    searched.wait(lambda t: ran(t, 'const c=""'))


def test_the_panel_tells_numbers_and_what_was_lost(searched, studio):
    steps = steps_of(studio)
    text = searched.text()
    assert "by geometry" in text and f"{steps.n_points:,}" in text and f"{steps.n_facing_sideways:,}" in text
    largest = steps.clusters[steps.dropped[0]]
    assert f"{largest.n_points:,} points are fewer than" in text and "Otsu" in text
    assert searched.html().count('data-go="cluster-') == len(steps.dropped)
    studio.session.do(commands.change_settings("trunks", min_arc_deg=120.0))
    searched.wait_text("Settings have changed since")


def test_go_there_try_it_and_search_again_brings_the_tree_back(searched, studio):
    steps = steps_of(studio)
    index, n_before = steps.dropped[0], len(studio.session.document.trunks)
    searched.bridge_send("chain_go", ["cluster", index])
    place = studio.session.points_world()[steps.clusters[index].point]
    searched.wait(lambda t: t.scene["/steps"].visible and "/highlight" in t.scene)
    camera = searched.handle(studio.server.viser).camera
    searched.wait(lambda t: np.linalg.norm(camera.look_at - place) < 0.01)
    searched.wait_text("Cluster dropped")
    searched.bridge_send("chain_try", ["cluster", index, 0])
    wanted = TrunkSettings.model_fields["smallest_cluster_points"].title
    searched.wait_text("Find the trunks again to try it")
    assert studio.session.document.settings.trunks.smallest_cluster_points == 0
    # Nothing is searched, and nothing else is typed over.
    assert wanted in searched.text()
    searched.press("Find trunks")
    searched.wait(lambda t: len(studio.session.document.trunks) > n_before, LONG)
    assert studio.wait_idle(LONG)
    advised = story_of_cluster(steps, index).advice[0].changes
    assert studio.session.document.settings.trunks.smallest_cluster_points == advised["smallest_cluster_points"]
    assert steps_of(studio).clusters[index].kept
    # The picture follows the new search.
    searched.wait(lambda t: len(t.scene["/steps/6"].props["points"]) == steps_of(studio).counts[Step.KEPT], LONG)


def click(tab: FakeClient, place: np.ndarray, away: tuple[float, float, float]) -> None:
    tab.look(place + np.array(away), place)
    tab.settle()
    tab.click_scene(place)


def test_a_click_tells_which_step_dropped_the_point(searched, studio):
    searched.bridge_send("colours", "Steps")
    searched.wait(lambda t: t.scene["/steps"].visible)
    steps, points = steps_of(studio), studio.session.points_world()
    cluster = steps.clusters[steps.dropped[0]]
    click(searched, points[cluster.point].astype(float), (0.0, -1.5, 0.3))
    searched.wait_text(f"{cluster.n_points:,} points are fewer than")
    searched.wait_text("Cluster dropped")
    ground = points[row_of(studio, Step.TOO_LOW)].astype(float)
    click(searched, ground, (0.0, -0.2, 1.5))
    searched.wait_text("Lower than 0.3 m")
    searched.wait_text("Ground clearance")
    # A trunk is chosen as in every other colour.
    kept = next(c for c in steps.clusters if c.kept)
    click(searched, points[kept.point].astype(float), (0.0, -1.5, 0.3))
    searched.wait_text("Scatter", LONG)


def test_messages_of_the_page_that_make_no_sense_do_nothing(searched, studio):
    before = studio.session.document
    for kind, payload in (
        ("chain_step", 99), ("chain_step", "5"), ("chain_step", True), ("chain_go", None), ("chain_go", ["cluster"]),
        ("chain_go", ["cluster", 10_000]), ("chain_go", ["cluster", -1]), ("chain_go", ["nothing", 0]),
        ("chain_go", ["point", 0]), ("chain_try", ["cluster", 0, 99]), ("chain_try", ["cluster", True, 0]),
        ("chain_try", ["point", 0, 0]), ("chain_go", {"a": 1}), ("chain_try", ["miss", 0, 0]),
    ):  # fmt: skip
        searched.bridge_send(kind, payload)
    searched.settle()
    assert studio.session.document is before and not searched.notifications


def test_a_reopened_plot_shows_its_steps(searched, studio, tmp_path):
    counts = steps_of(studio).counts
    studio.session.flush()
    folder = studio.session.saver.folder
    studio.session.close()
    studio.adopt(open_plot(folder))
    with FakeClient(studio.server.url) as tab:
        tab.wait(lambda t: "/labels" in t.scene, LONG)
        tab.settle()  # the plot is shown: a step chosen before would be overtaken
        tab.bridge_send("step", "trunks")
        tab.wait_text("Where trees were lost")
        assert steps_of(studio).counts == counts


# ---- what is drawn


def made(*clusters: tuple[int, bool], threshold: float = float("nan"), **settings: object) -> ChainSteps:
    return ChainSteps(
        labels=np.zeros(10, np.uint8),
        dropped_cluster=np.empty(0, np.int32),
        tilt_deg=np.empty(0, np.uint8),
        joined_from=(0,) * 8,
        clusters=tuple(Cluster(n, 0 if kept else -1, False, kept, 0, 0.3, 1.0, 2.0) for n, kept in clusters),
        size_threshold=threshold,
        settings=TrunkSettings(**settings),
        from_masks=True,
    )


@pytest.mark.parametrize(
    "clusters",
    [
        [(1, True)],
        [(5, False), (5, True)],
        [(10**k, k > 3) for k in range(8)],
        [(17 * k + 1, k % 2 == 0) for k in range(400)],
    ],
    ids=["one", "equal", "decades", "many"],
)
def test_the_histogram_has_every_cluster_once_and_stays_in_its_frame(clusters):
    threshold = float(np.median([n for n, _ in clusters]))
    picture = chain_html.histogram(made(*clusters, threshold=threshold))
    svg = ET.fromstring(re.search(r"<svg.*</svg>", picture)[0])
    bars = svg.findall("rect")
    assert {bar.get("fill") for bar in bars} <= {chain_html.colour(Step.KEPT), chain_html.colour(Step.DROPPED)}
    for bar in bars:
        x, y, width, height = (float(bar.get(name)) for name in ("x", "y", "width", "height"))
        assert x >= 0 and y >= 0 and x + width <= 340 and y + height <= 101 and width > 0
    assert f"Otsu {int(np.ceil(threshold)):,}" in picture
    n_kept = sum(kept for _, kept in clusters)
    assert f"{n_kept} kept" in picture and f"{len(clusters) - n_kept} dropped" in picture


def test_without_clusters_or_threshold_nothing_is_made_up():
    assert "no cluster" in chain_html.histogram(made())
    assert "Otsu" not in chain_html.histogram(made((10, True), small_clusters="keep"))
    assert "No cluster was dropped" in chain_html.lost(made((10, True)))


def test_the_list_is_bounded_and_says_how_many_more():
    steps = made(*[(1000 - k, False) for k in range(40)], (10**6, True), threshold=5000.0, small_clusters="otsu")
    page = chain_html.lost(steps)
    assert page.count('data-go="cluster-') == 12 and "and 28 smaller" in page


def test_the_colours_of_the_steps_are_far_apart_also_for_the_colour_blind():
    # Viénot, Brettel and Mollon 1999: linear RGB as seen without long and without medium cones.
    without = (
        np.array([[0.1121, 0.8853, -0.0005], [0.1127, 0.8897, -0.0001], [0.0045, 0.0000, 1.0019]]),
        np.array([[0.2920, 0.7054, -0.0003], [0.2934, 0.7089, 0.0000], [-0.0210, 0.0256, 0.9990]]),
    )
    steps = (Step.NO_CANDIDATE, Step.NOT_SIDEWAYS, Step.LOOSE, Step.DROPPED, Step.KEPT, Step.JOINED)
    rgb = np.array([chain_html.STEP_COLOURS[step] for step in steps]) / 255.0
    for seen in (np.eye(3), *without):
        shown = np.clip(rgb**2.2 @ seen.T, 0, 1) ** (1 / 2.2)
        apart = np.linalg.norm(shown[:, None] - shown[None], axis=2) + np.eye(len(steps))
        assert apart.min() > 0.12
