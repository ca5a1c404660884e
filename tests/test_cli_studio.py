"""`dbh-studio open` and `dbh-studio demo`, as a person starts and ends them."""

from __future__ import annotations

import csv
import http.cookiejar
import re
import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import pytest
from tests.threestems import plot_cloud

from dbh_studio.app import commands, demo, opening
from dbh_studio.app.cache import CACHE_VARIABLE
from dbh_studio.cli import main
from dbh_studio.cli import studio as studio_cli
from dbh_studio.core.synthetic import PlotRecipe
from dbh_studio.errors import ProjectError
from dbh_studio.io.las import write_las
from dbh_studio.io.project import ProjectWriter, read_project

# ---- open


@pytest.fixture(scope="module")
def las(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("open") / "plot.las"
    write_las(path, plot_cloud())
    return path


_TALKING = {
    "stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True,
    "encoding": "utf-8",
}  # fmt: skip


def start(*arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "dbh_studio", "open", "--no-browser", *map(str, arguments)],
        **_TALKING,
    )


def url_of(process: subprocess.Popen[str]) -> str:
    """The link the program prints; the test fails with what it said instead, where it ends."""
    for line in process.stdout:
        found = re.search(r"http://\S+\?token=\S+", line)
        if found:
            return found[0]
    pytest.fail(f"no address was printed: {process.stderr.read()}")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no polite kill")
def test_open_serves_the_plot_to_who_has_the_link_and_ends_politely(las):
    with start(las) as process:
        try:
            url = url_of(process)
            assert f"kept in {las.with_suffix('.dbh')}" in process.stdout.readline() + process.stdout.readline()
            browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(http.cookiejar.CookieJar()))
            with browser.open(url, timeout=120) as page:
                assert page.status == 200 and b"<html" in page.read().lower()
            with pytest.raises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(url.partition("?")[0], timeout=120)
            assert refused.value.code == 401
            refused.value.close()
            # A second one, of the same plot: told at once, by whom it is held, and what to do.
            with start(las) as second:
                _, message = second.communicate(timeout=120)
            assert second.returncode == 1
            assert f"being written by process {process.pid}" in message and "--read-only" in message
            with start(las, "--read-only") as third:
                assert url_of(third) != url
                third.send_signal(signal.SIGINT if can_interrupt() else signal.SIGTERM)
                said = third.stdout.read()
                assert third.wait(timeout=120) == 0 and "reading only" in said
        finally:
            process.terminate()
        _, message = process.communicate(timeout=120)
    assert process.returncode == 0 and "Traceback" not in message
    saved = las.with_suffix(".dbh")
    assert read_project(saved).source_path == las
    ProjectWriter(saved).close()


def can_interrupt() -> bool:
    """Whether children hear Ctrl+C: those of a shell's background job do not."""
    return signal.getsignal(signal.SIGINT) is not signal.SIG_IGN


def test_open_tells_of_a_wrong_file_on_the_command_line_and_ends(tmp_path):
    (tmp_path / "empty.laz").write_bytes(b"")
    with start(tmp_path / "empty.laz") as process:
        printed, message = process.communicate(timeout=120)
    assert process.returncode == 1 and printed == ""
    assert message == "dbh-studio: empty.laz: The file is empty. Export or copy it again.\n"
    assert [path.name for path in tmp_path.iterdir()] == ["empty.laz"]


@pytest.mark.parametrize("option", [["--port", "0"], ["--port", "70000"], ["--display-points", "-5"], ["--scale", "x"]])
def test_wrong_options(option, capsys):
    assert main(["open", *option]) == 2
    assert option[0] in capsys.readouterr().err


def test_a_cloud_that_is_named_for_what_is_no_saved_plot(las, capsys):
    assert main(["open", str(las), "--cloud", str(las)]) == 1
    assert "not a saved plot" in capsys.readouterr().err


# ---- demo


@pytest.fixture(scope="module")
def demo_out(tmp_path_factory) -> Path:
    """A folder with the demo of a tiny recipe in it, made by the command; its cache is beside it."""
    folder = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as patch:
        use_recipe(patch, folder / "cache", seed=1)
        assert main(["demo", "--no-serve", "--quiet", "--out", str(folder / "out")]) == 0
    return folder / "out"


def use_recipe(patch: pytest.MonkeyPatch, cache: Path, *, seed: int) -> None:
    recipe = PlotRecipe(
        name="Tiny", seed=seed, n_trees=3, n_thin=0, n_big=0, n_twins=0, n_hidden=0, n_dead=0, n_logs=0,
        side_m=10.0, points=150_000, understorey=0.0, crowns=0.2,
    )  # fmt: skip
    patch.setenv(CACHE_VARIABLE, str(cache))
    patch.setattr(demo, "demo_recipe", lambda: recipe)


@pytest.fixture
def out(demo_out, tmp_path, monkeypatch) -> Path:
    """A copy of the demo's folder, with the cache it was made from."""
    use_recipe(monkeypatch, demo_out.parent / "cache", seed=1)
    return Path(shutil.copytree(demo_out, tmp_path / "out"))


def run_demo(out: Path) -> int:
    return main(["demo", "--no-serve", "--quiet", "--out", str(out)])


def stem_ids(path: Path) -> list[str]:
    return [row["stem_id"] for row in csv.DictReader(path.read_text(encoding="utf-8").splitlines())]


def edit(out: Path) -> None:
    session = opening.open_plot(out / "demo_plot_synthetic.dbh", background_save=False)
    session.do(commands.delete_trunk(2))
    session.close()


def test_demo_finds_its_trees_and_says_where_everything_is(out, capsys):
    assert stem_ids(out / "demo_plot_synthetic.csv") == ["1", "2", "3"]
    assert run_demo(out) == 0
    printed = capsys.readouterr().out
    assert "synthetic" in printed and str(out / "demo_plot_synthetic.csv") in printed
    truth = Path(re.search(r"true diameters: +(\S.*)", printed)[1])
    assert len(truth.read_text().splitlines()) == 4


def test_a_second_demo_keeps_what_was_done_in_the_first(out):
    edit(out)
    assert run_demo(out) == 0
    assert stem_ids(out / "demo_plot_synthetic.csv") == ["1", "3"]
    assert sorted(path.name for path in out.iterdir()) == ["demo_plot_synthetic.csv", "demo_plot_synthetic.dbh"]


def test_the_demo_of_a_newer_generator_leaves_the_older_one_with_its_edits_alone(out, tmp_path, monkeypatch, capsys):
    edit(out)
    use_recipe(monkeypatch, tmp_path / "cache", seed=2)
    before = (out / "demo_plot_synthetic.dbh" / "project.json").read_bytes()
    # Twice: what was made once is found again.
    for _ in range(2):
        assert run_demo(out) == 0
        printed = capsys.readouterr()
        assert "demo_plot_synthetic-2.csv" in printed.out and "kept as it is" in printed.err
    assert (out / "demo_plot_synthetic.dbh" / "project.json").read_bytes() == before
    assert stem_ids(out / "demo_plot_synthetic-2.csv") == ["1", "2", "3"]
    assert sorted(path.name for path in out.glob("*.dbh")) == ["demo_plot_synthetic-2.dbh", "demo_plot_synthetic.dbh"]


def test_a_damaged_demo_does_not_stop_the_demo(out, capsys):
    (out / "demo_plot_synthetic.dbh" / "project.json").write_text("{")
    assert run_demo(out) == 0
    assert "demo_plot_synthetic-2.csv" in capsys.readouterr().out
    assert (out / "demo_plot_synthetic.dbh" / "project.json").read_text() == "{"


def test_a_demo_that_was_interrupted_before_its_trunks_were_found_is_finished(out):
    session = opening.open_plot(out / "demo_plot_synthetic.dbh", background_save=False)
    for trunk_id in session.document.trunks.ids:
        session.do(commands.delete_trunk(trunk_id))
    session.close()
    assert run_demo(out) == 0
    assert len(stem_ids(out / "demo_plot_synthetic.csv")) == 3


def test_a_demo_that_is_open_elsewhere_is_told(out, capsys):
    writer = ProjectWriter(out / "demo_plot_synthetic.dbh")
    assert run_demo(out) == 1
    assert "open already" in capsys.readouterr().err
    writer.close()


def test_a_demo_folder_that_cannot_be_written(out, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert run_demo(tmp_path / "file") == 1
    assert "not a folder" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no polite kill")
def test_the_demo_is_served(out):
    # The plot is in `out` already; the process finds it by the recipe, which it gets as the tests do.
    recipe = demo.demo_recipe()
    program = (
        "import sys, json\nfrom dbh_studio.app import demo\nfrom dbh_studio.core.synthetic import PlotRecipe\n"
        f"demo.demo_recipe = lambda: PlotRecipe.from_dict({recipe.to_dict()!r})\n"
        "from dbh_studio.cli import main\nsys.exit(main(sys.argv[1:]))"
    )
    arguments = [sys.executable, "-c", program, "demo", "--no-browser", "--quiet", "--out", str(out)]
    with subprocess.Popen(arguments, **_TALKING) as process:
        try:
            url = url_of(process)
            with pytest.raises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(url.partition("?")[0], timeout=120)
            refused.value.close()
        finally:
            process.terminate()
        _, message = process.communicate(timeout=120)
    assert process.returncode == 0 and message.count("\n") <= 1


def test_ending_the_studio_tells_that_the_last_change_could_not_be_saved(monkeypatch):
    """The signal is there already: serving ends at once."""
    saved = []

    class Session:
        saver, read_only_note = None, ""

        def flush(self):
            saved.append("tried")
            raise ProjectError("The disk is full.")

    server = SimpleNamespace(note="", url="http://127.0.0.1:8080/")
    stopped = SimpleNamespace(wait=lambda seconds: True, set=lambda: None)
    monkeypatch.setattr(studio_cli.threading, "Event", lambda: stopped)
    with pytest.raises(ProjectError, match="disk is full"):
        studio_cli._serve(SimpleNamespace(server=server, session=Session()), SimpleNamespace(no_browser=True))
    assert saved == ["tried"]
