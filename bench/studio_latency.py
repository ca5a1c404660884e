"""How long the studio takes to answer: from a click on a trunk to its number, and from one colouring to the next.

    python bench/studio_latency.py [--points 1 10] [--trees 60] [--clicks 20] [--browser] [--gate]

Starts the studio in this process with a generated plot whose stems are known and measured, and drives it twice: with
the tests' own client, which speaks the page's protocol and shows what the server needs, and with `--browser` in a real
Chromium whose `drawArrays` does nothing for clouds: that is everything but the drawing itself, which a graphics card
does in milliseconds and software does not. Prints a Markdown table; `--gate` exits 1 where a click takes longer than
0.3 s or a change of colours longer than 0.2 s.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / "src"), str(HERE.parent / "tests" / "ui")]
# As the command line does; read when numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np  # noqa: E402
from bench_plots import FIRST_SEED  # noqa: E402
from fakeclient import FakeClient  # noqa: E402

from dbh_studio.app.document import Document, SourceInfo  # noqa: E402
from dbh_studio.app.session import Session  # noqa: E402
from dbh_studio.core.scale import ScaleEstimate  # noqa: E402
from dbh_studio.core.synthetic import PlotRecipe, make_plot  # noqa: E402
from dbh_studio.core.trunks import Trunk, TrunkSet  # noqa: E402
from dbh_studio.ui.server import start_server  # noqa: E402
from dbh_studio.ui.studio import Studio  # noqa: E402

CLICK_S, COLOURS_S = 0.3, 0.2
LONG_S = 300.0
# Those that every plot has. The studio begins with red trunks: every step is a change.
_MODES = ["Segmentation (by tree)", "Height", "Original", "Segmentation (red)"] * 6
_NO_DRAWING = """
const draw = WebGL2RenderingContext.prototype.drawArrays;
WebGL2RenderingContext.prototype.drawArrays = function (mode, first, count) {
  if (count <= 2000) return draw.call(this, mode, first, count);
};
"""
# Arms a stopwatch: from the release of the mouse until `test` holds, or from now until then and the next frame.
_STOPWATCH = """([fromMouse, test]) => {
  const holds = eval(test);
  let start = fromMouse ? null : performance.now();
  const released = () => { start = performance.now(); };
  if (fromMouse) window.addEventListener('pointerup', released, {capture: true, once: true});
  window.studioLatency = new Promise((done, fail) => {
    setTimeout(() => fail('the page did not change within a minute'), 60000);
    const look = () => {
      if (start === null || !holds()) return setTimeout(look, 2);
      const finish = () => done((performance.now() - start) / 1000);
      if (fromMouse) finish(); else requestAnimationFrame(finish);
    };
    look();
  });
}"""


# Whether the page's camera has come to where it was sent.
_LOOKS_AT = """([px, py, pz, x, y, z]) => {
  const m = window.__viserMutable, camera = m.camera;
  camera.updateMatrixWorld();
  const at = new camera.position.constructor(px, py, pz), to = new camera.position.constructor(x, y, z);
  m.nodeRefFromName[''].localToWorld(at);
  m.nodeRefFromName[''].localToWorld(to).project(camera);
  return at.distanceTo(camera.position) < 0.01 && Math.abs(to.x) < 0.01 && Math.abs(to.y) < 0.01;
}"""


@dataclass
class Figures:
    """What was measured on one plot: seconds and megabytes by name."""

    n_points: int
    n_trees: int
    values: dict[str, float] = field(default_factory=dict)

    def times(self, name: str, seconds: list[float]) -> None:
        """Keep the median, the 95th percentile and the first of many."""
        self.values[f"{name}, median s"] = statistics.median(seconds)
        self.values[f"{name}, 95 % s"] = float(np.quantile(seconds, 0.95))
        self.values[f"{name}, first s"] = seconds[0]

    def too_slow(self) -> list[str]:
        """What misses its limit."""
        limits = {"click": CLICK_S, "colours": COLOURS_S}
        return [
            f"{self.n_points / 1e6:g} M points: {name} {value:.3f} s"
            for name, value in self.values.items()
            if ", 95 %" in name and value > next((s for word, s in limits.items() if word in name), np.inf)
        ]


def timed(action: Callable[[], Any]) -> float:
    """Seconds that `action` takes."""
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


def resident_mb() -> float:
    """Memory of this process, MB of 10^6 bytes; NaN where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def known_plot(n_points: int, n_trees: int, seed: int) -> Session:
    """A plot whose trunks are the true ones: what is measured here is the studio, not the segmentation."""
    side_m = max(14.0, 5.8 * n_trees**0.5)
    made = make_plot(PlotRecipe(name="latency", seed=seed, n_trees=n_trees, side_m=side_m, points=n_points))
    order = np.argsort(made.tree_ids, kind="stable").astype(np.int32)
    edges = np.searchsorted(made.tree_ids[order], np.arange(1, n_trees + 2))
    sets = [np.sort(order[edges[i] : edges[i + 1]]) for i in range(n_trees)]
    trunks = TrunkSet(tuple(Trunk(i + 1, points) for i, points in enumerate(sets) if len(points)))
    source = SourceInfo(Path("latency.laz"), (Path("latency.laz"),), len(made.cloud), "")
    return Session(made.cloud, Document("latency", source, scale=ScaleEstimate(1.0, "metres"), trunks=trunks))


def clickable(studio: Studio, fov_rad: float, height_px: int, n_most: int) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """(id, camera position, point) of stems that nothing hides from some side, spread over the plot."""
    session, display = studio.session, studio.display
    assert session is not None and display is not None
    found = []
    slope = 2.0 * np.tan(fov_rad / 2) / height_px
    for trunk in session.document.trunks:
        points = session.points_world()[trunk.points]
        band = points[np.abs(points[:, 2] - points[:, 2].min() - 1.5) < 0.2].astype(float)
        for angle in np.arange(8) * np.pi / 4 if len(band) else ():
            toward = np.array([np.cos(angle), np.sin(angle), 0.0])
            target = band[(band @ toward).argmax()]
            camera = target + 3.0 * toward + [0.0, 0.0, 0.3]
            hit = display.picking.pick(camera, target - camera, slope)
            if hit is None:
                continue
            on_trunk = np.isin(display.indices[hit.surface], trunk.points)
            if on_trunk.mean() > 0.6:
                found.append((trunk.id, camera, target))
                break
    step = max(1, len(found) // n_most)
    return found[::step][:n_most]


def drive_server(studio: Studio, figures: Figures, n_clicks: int) -> None:
    """What the server needs: clicks and colours through its own websocket."""
    start = time.perf_counter()
    with FakeClient(studio.server.url, size=(1280, 800)) as client:
        client.wait(lambda t: any(m["type"] == "PointCloudMessage" for m in t.messages), LONG_S)
        figures.values["server: first points after s"] = time.perf_counter() - start
        # Before there are red trunks in the picture nobody clicks one.
        client.wait(lambda t: any(name.startswith("/red/") for name in t.scene), LONG_S)
        figures.values["server: trunks in the picture after s"] = time.perf_counter() - start
        targets = clickable(studio, client.fov_rad, client.size[1], n_clicks)
        seconds = [click(client, *target) for target in targets]
        figures.values["clicks"] = len(seconds)
        figures.times("server: click to text while the cloud is sent", seconds)
        client.settle(1.0)
        figures.values["server: whole cloud after s, at most"] = time.perf_counter() - start
        figures.times("server: click to text", [click(client, *target) for target in targets])
        figures.times("server: colours", [switch(client, mode) for mode in _MODES])


def click(client: FakeClient, trunk_id: int, camera: np.ndarray, target: np.ndarray) -> float:
    """Seconds from a click on a trunk until the page has been told its number."""
    client.look(camera, target)
    client.settle(0.05)
    # The card's own title: other numbers stand in the table.
    title = f"<h3>Tree {trunk_id}<"

    def act() -> None:
        client.click_scene(target)
        client.wait(lambda t: title in t.html(), LONG_S)

    return timed(act)


def switch(client: FakeClient, mode: str) -> float:
    """Seconds until the page has been told to show other colours."""
    parent = {"Segmentation (red)": "/red", "Segmentation (by tree)": "/tree", "Height": "/height"}.get(mode, "/rgb")
    overlays = {"/red", "/tree"}

    def shown(t: FakeClient) -> bool:
        scene = t.scene
        visible = {name for name in ("/rgb", "/height", "/red", "/tree") if scene[name].visible}
        return parent in visible and (parent in overlays or not visible & overlays)

    def act() -> None:
        client.bridge_send("colours", mode)
        client.wait(shown, LONG_S)

    return timed(act)


def drive_browser(studio: Studio, figures: Figures, n_clicks: int) -> None:
    """The same in a real page, without the drawing."""
    import browser

    executable = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if executable is None or studio.display is None:
        sys.exit("There is no Chromium to be found.")
    with browser.chromium(executable) as running:
        page = running.new_context(viewport={"width": 1280, "height": 800}).new_page()
        page.set_default_timeout(1000 * LONG_S)
        page.add_init_script(_NO_DRAWING)
        start = time.perf_counter()
        page.goto(studio.server.url)
        page.wait_for_function("() => window.__viserTestpoints?.rendererInfo?.render.points > 10000")
        figures.values["page: first points after s"] = time.perf_counter() - start
        # Crowns are hidden at first; the rest has come when it is all in the picture.
        n_low = int(np.count_nonzero(~studio.display.is_crown))
        page.wait_for_function("n => window.__viserTestpoints.rendererInfo.render.points >= n", arg=n_low)
        figures.values["page: the cloud without crowns after s"] = time.perf_counter() - start
        browser.close_notifications(page)
        figures.times("page: click to text while the cloud is sent", page_clicks(studio, page, 5))
        while any(thread.name == "stream" for thread in threading.enumerate()):
            page.wait_for_timeout(200)
        page.wait_for_timeout(5000)
        figures.values["page: all is sent, at the latest after s"] = time.perf_counter() - start
        figures.times("page: click to text", page_clicks(studio, page, n_clicks))
        figures.times("page: colours", [page_colours(page, mode) for mode in _MODES])


def page_clicks(studio: Studio, page: Any, n_clicks: int) -> list[float]:
    """Seconds from the release of the mouse until the card of that tree is in the page."""
    import browser

    camera = next(iter(studio.server.viser.get_clients().values())).camera
    seconds = []
    for trunk_id, position, target in clickable(studio, camera.fov, camera.image_height, n_clicks):
        camera.position, camera.look_at = position, target
        page.wait_for_function(_LOOKS_AT, arg=[float(part) for part in (*position, *target)])
        page.wait_for_timeout(300)
        test = f"() => [...document.querySelectorAll('h3')].some(e => e.textContent === 'Tree {trunk_id}')"
        page.evaluate(_STOPWATCH, [True, test])
        page.mouse.click(*browser.pixel_of(page, target))
        seconds.append(float(page.evaluate("() => window.studioLatency")))
    return seconds


def page_colours(page: Any, mode: str) -> float:
    """Seconds until the page shows other colours."""
    test = f"() => document.querySelector('#dbh-view [aria-pressed=true]')?.dataset.mode === '{mode}'"
    page.evaluate(_STOPWATCH, [False, test])
    page.evaluate("mode => dbh('colours', mode)", mode)
    seconds = float(page.evaluate("() => window.studioLatency"))
    page.wait_for_timeout(300)
    return seconds


def measure(n_points: int, n_trees: int, n_clicks: int, *, in_browser: bool) -> Figures:
    """All figures of one plot."""
    session = known_plot(n_points, n_trees, FIRST_SEED + 100)
    figures = Figures(len(session.cloud), len(session.document.trunks))
    figures.values["the cloud itself MB"] = (session.cloud.xyz.nbytes + 3 * len(session.cloud)) / 1e6
    figures.values["fit the ground s"] = timed(session.ground)
    figures.values["measure all trees s"] = timed(session.measurements)
    with tempfile.TemporaryDirectory(prefix="dbh-latency-") as folder:
        studio = Studio(start_server(port=0), uploads_folder=Path(folder))
        try:
            before = resident_mb()
            figures.values["show the plot in the studio s"] = timed(lambda: studio.adopt(session))
            figures.values["memory for showing it MB"] = resident_mb() - before
            drive_server(studio, figures, n_clicks)
            if in_browser:
                drive_browser(studio, figures, n_clicks)
        finally:
            studio.close()
    return figures


def table(columns: list[Figures]) -> str:
    """Markdown: a row per figure, a column per plot."""
    names = list(dict.fromkeys(name for column in columns for name in column.values))
    head = " | ".join(f"{column.n_points / 1e6:.1f} M points, {column.n_trees} trees" for column in columns)
    lines = [f"| | {head} |", "|---|" + "--:|" * len(columns)]
    for name in names:
        values = (column.values.get(name, float("nan")) for column in columns)
        cells = (f"{value:.3f}" if value < 100 else f"{value:.0f}" for value in values)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> int:
    """Measure the plots asked for and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--points", type=float, nargs="+", default=[1.0, 10.0], metavar="MILLIONS", help="of each plot")
    parser.add_argument("--trees", type=int, default=60, help="in each plot")
    parser.add_argument("--clicks", type=int, default=20, help="on different trees")
    parser.add_argument("--browser", action="store_true", help="in a real Chromium as well")
    parser.add_argument("--gate", action="store_true", help="exit 1 where an answer takes too long")
    options = parser.parse_args()
    columns = []
    for millions in options.points:
        columns.append(measure(round(1e6 * millions), options.trees, options.clicks, in_browser=options.browser))
        print(f"{columns[-1].n_points / 1e6:.1f} M points done", file=sys.stderr, flush=True)
    print(table(columns))
    slow = [line for column in columns for line in column.too_slow()]
    for line in slow:
        print(f"Too slow: {line}", file=sys.stderr)
    return 1 if options.gate and slow else 0


if __name__ == "__main__":
    sys.exit(main())
