"""How long a correction takes: from the end of a gesture in the page to the new diameter in it.

    python bench/edit_latency.py [--points 1 5 20] [--trees 60] [--edits 10] [--gate]

Starts the studio in this process with generated plots whose stems are known and measured, and corrects trunks in a real
Chromium: merges two, cuts one along a drawn line, takes off what a lasso selects, lets one grow, undoes it all. The
clock runs in the page, from the event that ends the gesture (the mouse or the key is let go) until the bar over the
picture says the new number. The lasso itself has a row of its own: from its end until the points are selected.
`drawArrays` does nothing for clouds: that is everything but the drawing, which a graphics card does in milliseconds and
software does not. Prints a Markdown table of medians and 95th percentiles; `--gate` exits 1 where one is above 0.3 s.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE)]
from studio_latency import _LOOKS_AT, _NO_DRAWING, LONG_S, known_plot  # noqa: E402, I001 - sets the path of the tests

import browser  # noqa: E402
import numpy as np  # noqa: E402
from bench_plots import FIRST_SEED  # noqa: E402

from dbh_studio.app.autosave import Autosave  # noqa: E402
from dbh_studio.app.doctor import find_chromium  # noqa: E402
from dbh_studio.app.session import Session  # noqa: E402
from dbh_studio.core.dbh import DbhEstimate  # noqa: E402
from dbh_studio.io.project import ProjectWriter  # noqa: E402
from dbh_studio.ui.server import start_server  # noqa: E402
from dbh_studio.ui.studio import Studio  # noqa: E402

LIMIT_S = 0.3
# Notes when gestures end, before any script of the page can stop the event.
_NOTE_ENDS = """
window.editEnds = {};
for (const event of ['pointerup', 'keydown']) {
  window.addEventListener(event, () => { window.editEnds[event] = performance.now(); }, true);
}
"""
# Runs from the event until the text of an element has changed and fits.
_STOPWATCH = """([event, selector, pattern]) => {
  const words = () => (document.querySelector(selector) || {textContent: ''}).textContent;
  const before = words(), wanted = new RegExp(pattern);
  delete window.editEnds[event];
  window.editLatency = new Promise((done, fail) => {
    setTimeout(() => fail('nothing changed: ' + words()), 20000);
    const look = () => {
      const now = words(), start = window.editEnds[event];
      if (start === undefined || now === before || !wanted.test(now)) return setTimeout(look, 1);
      done((performance.now() - start) / 1000);
    };
    look();
  });
}"""
_EFFECT, _CHOSEN = "#dbh-edit .effect", "#dbh-edit .chosen"
_NUMBER = r"\d cm|no diameter|is gone"

Times = dict[str, list[float]]


def browser_error() -> type[Exception]:
    """What a page that does not answer raises."""
    from playwright.sync_api import Error

    return Error


class Bench:
    """One plot in one page."""

    def __init__(self, studio: Studio, page: Any) -> None:
        self.studio, self.page = studio, page
        self.times: Times = {}

    @property
    def session(self) -> Session:
        """The plot."""
        assert self.studio.session is not None
        return self.studio.session

    def clock(self, name: str, event: str, selector: str, pattern: str, act: Any) -> None:
        """Do something and keep how long the page took to show it; then wait until all else has followed."""
        self.page.evaluate(_STOPWATCH, [event, selector, pattern])
        act()
        try:
            seconds = float(self.page.evaluate("() => window.editLatency"))
        except browser_error():
            said = [each.inner_text() for each in self.page.query_selector_all(".mantine-Notification-root")]
            sys.exit(f"{name}: nothing came of it. {' | '.join(said)}")
        self.times.setdefault(name, []).append(seconds)
        self.rest()

    def rest(self) -> None:
        """Until nothing is under way."""
        if not self.studio.wait_idle(LONG_S):
            sys.exit("The studio did not come to rest.")
        browser.settle(self.page, self.studio)
        self.page.wait_for_timeout(250)

    def key(self, key: str) -> Any:
        """What presses a key."""
        return lambda: self.page.keyboard.press(key)

    def choose(self, *ids: int) -> None:
        """Choose trees, the first of them alone at first."""
        (tab,) = self.studio._tabs.values()
        several = frozenset(ids) if len(ids) > 1 else frozenset()
        tab.worker.post(lambda: tab.select(ids[0], several=several))
        words = "Trees " if several else f"Tree {ids[0]}"
        self.page.wait_for_function(f"() => document.querySelector('{_CHOSEN}')?.textContent.startsWith('{words}')")
        self.rest()

    def stand_before(self, tree: int) -> np.ndarray:
        """Look at a tree at breast height from the south; (3,) what is looked at."""
        stem = self.session.measurement(tree)
        target = np.array([*stem.xy_m, stem.z_ground_m + 1.3])
        position = target + np.array([0.0, -4.0, 0.5])
        (client,) = self.studio.server.viser.get_clients().values()
        client.camera.up_direction = (0.0, 0.0, 1.0)
        client.camera.position, client.camera.look_at = position, target
        self.page.wait_for_function(_LOOKS_AT, arg=[float(part) for part in (*position, *target)])
        self.page.wait_for_timeout(200)
        return target

    def take(self, tool: str, digit: str) -> None:
        """Take a tool in hand."""
        self.page.keyboard.press(digit)
        self.page.wait_for_selector(f"#dbh-edit button[data-edit=tool-{tool}][aria-pressed=true]")
        self.rest()

    def pixel(self, point: np.ndarray) -> tuple[float, float]:
        """Where a place of the plot is in the page."""
        return browser.pixel_of(self.page, [float(part) for part in point])

    def undo(self) -> None:
        """Take the last edit back, with the clock running."""
        self.clock("undo", "keydown", _EFFECT, _NUMBER, self.key("Control+z"))

    # ---- the edits

    def merge(self, one: int, two: int) -> None:
        """Merge two chosen trunks by a key, and take it back."""
        self.choose(one, two)
        self.clock("merge", "keydown", _EFFECT, _NUMBER, self.key("m"))
        self.undo()

    def cut(self, tree: int) -> None:
        """Cut a trunk across by a drawn line, and take it back."""
        self.choose(tree)
        self.take("line", "5")
        x, y = self.pixel(self.stand_before(tree) + [0.0, 0.0, 0.6])
        self.page.mouse.move(x - 120, y)
        self.page.mouse.down()
        self.page.mouse.move(x + 120, y, steps=6)
        self.clock("cut by a line", "pointerup", _EFFECT, _NUMBER, self.page.mouse.up)
        self.undo()

    def take_off(self, tree: int) -> None:
        """Select the east side of a trunk about breast height by a lasso, take it off, and take that back."""
        self.choose(tree)
        self.take("lasso", "3")
        x, y = self.pixel(self.stand_before(tree))
        self.page.mouse.move(x, y - 60)
        self.page.mouse.down()
        for off in ((90, -60), (90, 60), (0, 60), (0, -58)):
            self.page.mouse.move(x + off[0], y + off[1], steps=8)
        self.clock("lasso to selected points", "pointerup", _CHOSEN, "selected", self.page.mouse.up)
        self.clock("take off", "keydown", _EFFECT, _NUMBER, self.key("Delete"))
        self.undo()

    def grow(self, tree: int) -> None:
        """Let a trunk grow by a key, and take it back."""
        self.choose(tree)
        self.clock("grow", "keydown", _EFFECT, _NUMBER, self.key("+"))
        self.undo()


def measure(n_points: int, n_trees: int, n_edits: int, executable: str) -> tuple[int, Times]:
    """The times of one plot."""
    session = known_plot(n_points, n_trees, FIRST_SEED + 100)
    session.ground()
    session.measurements()
    good = [i for i in session.document.trunks.ids if isinstance(session.measurement(i).result, DbhEstimate)]
    with tempfile.TemporaryDirectory(prefix="dbh-edit-") as folder:
        Autosave(session, ProjectWriter(Path(folder) / "plot.dbh"))
        studio = Studio(start_server(port=0), uploads_folder=Path(folder))
        try:
            studio.adopt(session)
            with browser.chromium(executable) as running:
                page = running.new_context(viewport={"width": 1280, "height": 800}).new_page()
                page.set_default_timeout(1000 * LONG_S)
                page.add_init_script(_NO_DRAWING + _NOTE_ENDS)
                page.goto(studio.server.url)
                page.wait_for_selector(".dbh-table tr[data-id]")
                while any(thread.name == "stream" for thread in threading.enumerate()):
                    page.wait_for_timeout(200)
                browser.close_notifications(page)
                page.evaluate("() => dbh('edit', ['open', null])")
                page.wait_for_selector(_CHOSEN)
                while any(thread.name == "blocks" for thread in threading.enumerate()):
                    page.wait_for_timeout(100)
                bench = Bench(studio, page)
                bench.rest()
                step = max(1, len(good) // n_edits)
                for at in range(n_edits):
                    tree, other = good[at * step % len(good)], good[(at * step + 1) % len(good)]
                    bench.merge(tree, other)
                    bench.cut(tree)
                    bench.take_off(tree)
                    bench.grow(tree)
                return len(session.cloud), bench.times
        finally:
            studio.close()


def table(columns: list[tuple[int, Times]]) -> str:
    """Markdown: a row per edit; median and 95th percentile of each plot."""
    names = list(dict.fromkeys(name for _, times in columns for name in times))
    head = " | ".join(f"{n / 1e6:.1f} M: median s | 95 % s" for n, _ in columns)
    lines = [f"| | {head} |", "|---|" + "--:|--:|" * len(columns)]
    for name in names:
        cells = [f"{statistics.median(t[name]):.3f} | {np.quantile(t[name], 0.95):.3f}" for _, t in columns]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> int:
    """Measure the plots asked for and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--points", type=float, nargs="+", default=[1.0, 5.0, 20.0], metavar="MILLIONS")
    parser.add_argument("--trees", type=int, default=60, help="in each plot")
    parser.add_argument("--edits", type=int, default=10, help="of each kind, on different trees")
    parser.add_argument("--gate", action="store_true", help="exit 1 where an edit takes longer than 0.3 s")
    options = parser.parse_args()
    executable = find_chromium()
    if executable is None:
        sys.exit("There is no Chromium to be found.")
    columns = []
    for millions in options.points:
        columns.append(measure(round(1e6 * millions), options.trees, options.edits, executable))
        print(f"{columns[-1][0] / 1e6:.1f} M points done", file=sys.stderr, flush=True)
    print(table(columns))
    slow = [
        f"{n / 1e6:.1f} M points: {name} {np.quantile(seconds, 0.95):.3f} s"
        for n, times in columns
        for name, seconds in times.items()
        if np.quantile(seconds, 0.95) > LIMIT_S
    ]
    for line in slow:
        print(f"Too slow: {line}", file=sys.stderr)
    return 1 if options.gate and slow else 0


if __name__ == "__main__":
    sys.exit(main())
