"""The command line: what it prints, what it leaves behind, and that nothing makes it end in a traceback."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.threestems import STEMS, plot_cloud, plot_points, stem_points

from dbh_studio.app import commands, doctor, opening, plot_run
from dbh_studio.cli import build_parser, main
from dbh_studio.cli.common import ProgressLine, photo_request
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.inventory import COLUMNS
from dbh_studio.errors import ProjectExistsError
from dbh_studio.io.las import write_las
from dbh_studio.io.ply import write_ply
from dbh_studio.io.project import ProjectWriter, read_project

COMMANDS = (
    "open", "demo", "run", "measure", "scale", "marker", "masks", "models", "transfer", "evaluate", "export", "import",
    "doctor", "settings",
)  # fmt: skip
DIAMETERS_CM = [100 * diameter for _, _, diameter in STEMS]


@pytest.fixture(scope="module")
def las(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("cloud") / "plot.las"
    write_las(path, plot_cloud())
    return path


@pytest.fixture(scope="module")
def ply(tmp_path_factory) -> Path:
    """In units of 0.25 m, and not saying so."""
    path = tmp_path_factory.mktemp("cloud") / "scan.ply"
    write_ply(path, plot_cloud(unit_m=0.25))
    return path


@pytest.fixture(scope="module")
def stems(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("stems")
    for number, diameter in enumerate((0.30, 0.24)):
        # Not at zero: heights count from the stem's own lowest point, or from --ground-z.
        write_las(folder / f"stem{number}.las", PointCloud.from_points(stem_points(diameter) + [0, 0, 100]))
    return sorted(folder.iterdir())


@pytest.fixture(scope="module")
def saved_once(las, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("saved")
    assert main(["run", str(las), "--out", str(out), "--quiet"]) == 0
    return out / "plot.dbh"


@pytest.fixture
def saved(saved_once, tmp_path) -> Path:
    """A saved plot of one's own."""
    return Path(shutil.copytree(saved_once, tmp_path / "plot.dbh"))


def table(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def check_diameters(path: Path) -> list[dict[str, str]]:
    rows = table(path.read_text(encoding="utf-8"))
    assert [float(row["dbh_cm"]) for row in rows] == pytest.approx(DIAMETERS_CM, rel=0.02)
    return rows


def fails(capsys, arguments: list[object], status: int = 1) -> str:
    """Run; the one message on standard error, which is a sentence of the program."""
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == status
    message = capsys.readouterr().err
    assert message.startswith("dbh-studio" if status != 2 else ("usage", "dbh-studio"))
    assert "Traceback" not in message and "Unexpected" not in message
    return message


def start(arguments: list[object], *, before: str = "", **options) -> subprocess.Popen[str]:
    """A process of its own: `python -m dbh_studio …`, or with some Python `before` it."""
    program = ["-m", "dbh_studio"]
    if before:
        program = ["-c", f"import sys\nfrom dbh_studio.cli import main\n{before}\nsys.exit(main(sys.argv[1:]))"]
    # A shell that starts something in the background has it ignore Ctrl+C, and the children inherit that.
    preexec = None if os.name == "nt" else lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
    return subprocess.Popen(
        [sys.executable, *program, *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        stdout=options.pop("stdout", subprocess.PIPE),
        stderr=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        preexec_fn=preexec,
        **options,
    )


# ---- help


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_and_every_option_is_explained(command, capsys):
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    described, _, rest = text.partition("options:")
    assert f"dbh-studio {command}" in described and re.search(r"\n\n[A-Z][^\n]+", described)
    options = re.split(r"\n  (?=-)", rest)[1:]
    for option in options:
        assert re.search(r"(  |\n)\s*\w.*\w", option.partition(" ")[2]), option


def test_the_overview_names_every_command_and_what_the_status_means(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(re.search(rf"^ +{command} +\w", text, re.MULTILINE) for command in COMMANDS)
    assert re.search(r"0\s+done,\s+1\s+failed", text)
    assert main([]) == 2 and "usage" in capsys.readouterr().out
    assert main(["--version"]) == 0 and re.fullmatch(r"dbh-studio \d+\.\d+\.\d+\n", capsys.readouterr().out)


def test_the_guide_speaks_of_options_and_commands_there_are():
    guide = (Path(__file__).parents[1] / "docs" / "guide" / "command-line.md").read_text(encoding="utf-8")
    (commands,) = [action for action in build_parser()._actions if action.dest == "==SUPPRESS=="]
    known = {"--help"}.union(*(parser._option_string_actions for parser in commands.choices.values()))
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", guide)) <= known
    assert set(re.findall(r"dbh-studio ([a-z]+)", guide)) == set(commands.choices) == set(COMMANDS)


def test_doctor_and_settings_speak_json(capsys, monkeypatch):
    # All that the doctor looks at takes ten seconds, and is tested where it belongs.
    monkeypatch.setattr(doctor, "check_all", lambda: (doctor.check_python(), doctor.check_memory()))
    assert main(["doctor", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)
    assert main(["doctor"]) == 0
    assert "The studio works" in capsys.readouterr().out
    assert main(["settings", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["measure"]["breast_height_m"] == 1.3
    assert main(["settings"]) == 0
    assert "measure.breast_height_m = 1.3 m [0.3..5.0]" in capsys.readouterr().out


# ---- run


def test_run_writes_the_table_and_the_saved_plot_and_says_where(las, tmp_path, capsys):
    out = tmp_path / "new" / "out put"
    assert main(["run", str(las), "--out", str(out)]) == 0
    printed = capsys.readouterr()
    rows = check_diameters(out / "plot.csv")
    assert tuple(rows[0]) == COLUMNS and {row["dbh_method"] for row in rows} == {"shrinkage"}
    assert [float(row["x_m"]) for row in rows] == pytest.approx([x for x, _, _ in STEMS], abs=4.5)
    assert "3 stems, 3 with a diameter" in printed.out and str(out / "plot.csv") in printed.out
    # The line can be pasted into a shell although the folder has a space.
    assert f"dbh-studio open '{out / 'plot.dbh'}'" in printed.out
    assert sorted(path.name for path in out.iterdir()) == ["plot.csv", "plot.dbh"]
    assert len(read_project(out / "plot.dbh").trunks) == 3


def test_run_as_json(las, tmp_path, capsys):
    assert main(["run", str(las), "--out", str(tmp_path), "--json", "--name", "Stand 4/b", "--scale", "1.5"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result) == {
        "plot", "csv", "project", "n_stems", "n_measured", "n_refused", "metres_per_unit", "scale_source",
        "scale_err_pct", "notes", "seconds", "stems",
    }  # fmt: skip
    assert Path(result["csv"]) == tmp_path / "Stand 4_b.csv" and Path(result["project"]).is_dir()
    assert (result["plot"], result["metres_per_unit"], result["scale_source"]) == ("Stand 4/b", 1.5, "factor")
    assert set(result["stems"][0]) == {"stem_id", "dbh_cm", "x_m", "y_m", "quality", "reason"}
    found = [stem["dbh_cm"] for stem in result["stems"]]
    assert found == pytest.approx([1.5 * diameter for diameter in DIAMETERS_CM], rel=0.03)


def test_run_obeys_the_settings(las, tmp_path):
    options = ["--breast-height", "2.0", "--curve", "ellipse", "--ground", "plane", "--set", "measure.definition=tape"]
    assert main(["run", str(las), "--out", str(tmp_path), "--quiet", *options, "--set", "measure.seed = 3"]) == 0
    rows = check_diameters(tmp_path / "plot.csv")
    assert {(row["dbh_method"], row["dbh_definition"]) for row in rows} == {("ellipse", "tape")}
    assert all(1.9 < float(row["hom_m"]) < 2.3 for row in rows)
    settings = read_project(tmp_path / "plot.dbh").settings
    assert (settings.ground.method, settings.measure.seed) == ("plane", 3)


def test_a_scale_is_a_number_or_a_word_and_up_may_begin_with_a_minus(ply, tmp_path, capsys):
    for number, scale in enumerate(("0.25", "feet")):
        out = tmp_path / str(number)
        assert main(["run", str(ply), "--out", str(out), "--scale", scale, "--quiet"]) == 0
        unit_m = 0.25 if number == 0 else 0.3048
        found = [float(row["dbh_cm"]) for row in table((out / "scan.csv").read_text())]
        assert found == pytest.approx([d * unit_m / 0.25 for d in DIAMETERS_CM], rel=0.03)
    write_ply(tmp_path / "upside_down.ply", PointCloud.from_points(plot_points() * [1, -1, -1]))
    arguments = ["run", str(tmp_path / "upside_down.ply"), "--out", str(tmp_path / "o"), "--scale", "metres"]
    assert main([*arguments, "--up", "-z", "--quiet"]) == 0
    found = sorted(float(row["dbh_cm"]) for row in table((tmp_path / "o" / "upside_down.csv").read_text()))
    assert found == pytest.approx(sorted(DIAMETERS_CM), rel=0.02)


def test_a_cloud_without_a_scale_is_a_status_of_its_own_and_the_way_out_is_named(ply, tmp_path, capsys):
    for arguments in (["run", ply, "--out", tmp_path / "out"], ["measure", ply]):
        message = fails(capsys, arguments, 3)
        assert "--scale metres" in message and "--scale 1.332" in message
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("option", "said"),
    [
        (["--set", "curve"], "expected SECTION.NAME=VALUE"),
        (["--set", "trunk.otsu=1"], "Use ground, trunks"),
        (["--set", "trunks.min_diamter=8"], "Did you mean trunks.min_diameter_cm"),
        (["--set", "trunks.min_diameter_cm=eight"], "Thinnest trunk"),
        (["--set", "measure.curve=square"], "'fourier', 'ellipse' or 'bspline'"),
        (["--breast-height", "9"], "less than or equal to 5"),
        (["--breast-height", "nan"], "Breast height"),
        (["--scale", "furlongs"], "metres per unit"),
        (["--scale", "-1"], "metres per unit"),
        (["--scale", "unknown"], "leave --scale away"),
        (["--up", "sideways"], "invalid choice"),
        (["--curve", "square"], "invalid choice"),
        (["--nonsense"], "unrecognized arguments"),
    ],
)
def test_a_wrong_option_is_told_before_anything_is_read(option, said, tmp_path, capsys):
    assert said in fails(capsys, ["run", tmp_path / "nothing.las", "--out", tmp_path / "out", *option], 2)
    assert list(tmp_path.iterdir()) == []


def test_an_empty_path_is_not_the_folder_one_is_in(las, capsys):
    assert "path is empty" in fails(capsys, ["run", "", "--out", "x"], 2)
    assert "path is empty" in fails(capsys, ["run", las, "--out", ""], 2)


def test_an_earlier_plot_is_replaced_only_when_told(las, saved, tmp_path, capsys):
    edited = opening.open_plot(saved, background_save=False)
    edited.do(commands.delete_trunk(2))
    edited.close()
    message = fails(capsys, ["run", las, "--out", tmp_path])
    assert "plot.dbh" in message and "--overwrite" in message
    assert len(read_project(saved).trunks) == 2 and not (tmp_path / "plot.csv").exists()
    assert main(["run", str(las), "--out", str(tmp_path), "--overwrite", "--quiet"]) == 0
    check_diameters(tmp_path / "plot.csv")
    assert len(read_project(saved).trunks) == 3


def test_run_on_a_saved_plot_measures_its_trunks_and_changes_only_what_is_asked(saved, tmp_path, capsys):
    edited = opening.open_plot(saved, background_save=False)
    edited.do(commands.delete_trunk(2))
    edited.do(commands.change_settings("measure", definition="area"))
    edited.close()
    assert main(["run", str(saved), "--out", str(tmp_path / "again"), "--curve", "bspline"]) == 0
    assert "saved with (2)" in capsys.readouterr().err
    rows = table((tmp_path / "again" / "plot.csv").read_text())
    assert [(row["stem_id"], row["dbh_method"], row["dbh_definition"]) for row in rows] == [
        ("1", "bspline", "area"),
        ("3", "bspline", "area"),
    ]


def test_the_cloud_of_a_saved_plot_may_be_elsewhere(las, tmp_path, capsys):
    moved = tmp_path / "elsewhere.las"
    shutil.copy(las, tmp_path / "plot.las")
    assert main(["run", str(tmp_path / "plot.las"), "--out", str(tmp_path), "--quiet"]) == 0
    (tmp_path / "plot.las").rename(moved)
    saved = tmp_path / "plot.dbh"
    assert "not there any more" in fails(capsys, ["run", saved, "--out", tmp_path])
    assert main(["run", str(saved), "--out", str(tmp_path), "--cloud", str(moved), "--quiet"]) == 0
    assert read_project(saved).source_path == moved


def test_run_takes_a_folder(las, tmp_path, capsys):
    folder = tmp_path / "scans of today"
    folder.mkdir()
    shutil.copy(las, folder)
    (folder / "photo.jpg").write_bytes(b"\xff\xd8\xff")
    # Twice, and into the folder itself: a table of an earlier run is no cloud.
    for _ in range(2):
        assert main(["run", str(folder), "--out", str(folder), "--overwrite", "--quiet"]) == 0
        check_diameters(folder / "scans of today.csv")


# ---- what cannot be


def test_wrong_files_are_told_in_a_sentence(tmp_path, capsys):
    def named(name: str, content: bytes) -> Path:
        (tmp_path / name).write_bytes(content)
        return tmp_path / name

    (tmp_path / "folder.laz").mkdir()
    one = PointCloud.from_points(np.full((1, 3), 5.0))
    write_las(tmp_path / "one.las", one)
    write_las(tmp_path / "same.las", PointCloud.from_points(np.full((1000, 3), 5.0)))
    out = ["--out", tmp_path / "out"]
    for path, said in (
        (tmp_path / "nothing.laz", "no such file"),
        (tmp_path / ("x" * 300 + ".laz"), "too long"),
        (named("empty.laz", b""), "empty"),
        (named("words.txt", b"this is no cloud\n"), "three numbers"),
        (named("noise.laz", bytes(range(256)) * 20), "not LAS"),
        (named("cloud.las.gz", b"\x1f\x8b" + bytes(100)), "gzip"),
        (named("nan.xyz", b"nan nan nan\n" * 50), "unusable"),
        (tmp_path / "folder.laz", "no point cloud or mesh in this folder"),
    ):
        assert said in fails(capsys, ["run", path, *out]), path.name
        assert said in fails(capsys, ["measure", path]), path.name
    assert not (tmp_path / "out").exists()
    for name in ("one.las", "same.las"):
        assert fails(capsys, ["run", tmp_path / name, *out], 3)
        # Nothing to find is no failure: an empty table, and a note that says so.
        assert main(["run", str(tmp_path / name), *map(str, out), "--scale", "metres"]) == 0
        assert "No trunk was found" in capsys.readouterr().err


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names here")
def test_a_pipe_is_refused_rather_than_waited_for(tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe.las")
    assert "neither a file nor a folder" in fails(capsys, ["run", tmp_path / "pipe.las", "--out", tmp_path / "out"])


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="who runs the tests may read everything")
def test_what_one_may_not_read_or_write(las, tmp_path, capsys):
    shutil.copy(las, tmp_path)
    (tmp_path / "plot.las").chmod(0)
    assert "ermission denied" in fails(capsys, ["run", tmp_path / "plot.las", "--out", tmp_path / "out"])
    locked = tmp_path / "locked"
    locked.mkdir(0o500)
    assert "permission denied" in fails(capsys, ["run", las, "--out", locked])
    locked.chmod(0)
    assert "ermission denied" in fails(capsys, ["run", locked, "--out", tmp_path / "out"])
    locked.chmod(0o700)


def test_a_folder_that_cannot_be_written_is_told_before_the_work(las, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(plot_run, "open_plot", lambda *_, **__: pytest.fail("the cloud was read"))
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        assert "file is not a folder" in fails(capsys, ["run", las, "--out", out])
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "permission denied" in fails(capsys, ["run", las, "--out", tmp_path / "out"])
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="file names are text here")
def test_names_of_all_kinds(las, tmp_path, capsys):
    nasty = tmp_path / "ünï cødé 木\n\x1b[31m.las"
    shutil.copy(las, nasty)
    assert main(["run", str(nasty), "--out", str(tmp_path / "out put")]) == 0
    printed = capsys.readouterr()
    assert "\x1b" not in printed.out + printed.err
    (found,) = (tmp_path / "out put").glob("*.csv")
    check_diameters(found)
    long = tmp_path / ("木" * 80 + ".las")
    shutil.copy(las, long)
    assert main(["run", str(long), "--out", str(tmp_path / "long"), "--quiet"]) == 0
    no_text = os.fsdecode(os.fsencode(tmp_path) + b"/pl\xffot.las")
    shutil.copy(las, no_text)
    assert "UTF-8" in fails(capsys, ["run", no_text, "--out", tmp_path / "out"])


def test_a_full_disk_leaves_nothing_half_written(las, stems, tmp_path, capsys, monkeypatch):
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    assert "No space left" in fails(capsys, ["run", las, "--out", tmp_path / "out"])
    assert "No space left" in fails(capsys, ["measure", stems[0], "--csv", tmp_path / "stems.csv"])
    left = [path.name for path in tmp_path.rglob("*") if path.is_file()]
    assert left == ["lock"], left


def test_a_defect_is_a_sentence_too_and_the_memory_may_run_out(las, tmp_path, capsys, monkeypatch):
    for error, said in ((MemoryError(), "memory"), (KeyError("axis"), "--verbose"), (KeyboardInterrupt(), "interr")):
        monkeypatch.setattr(plot_run, "segment", lambda *_, error=error, **__: (_ for _ in ()).throw(error))
        status = main(["run", str(las), "--out", str(tmp_path / "out")])
        message = capsys.readouterr().err
        assert said in message and "Traceback" not in message
        assert status == (130 if isinstance(error, KeyboardInterrupt) else 1)
    assert not (tmp_path / "out").exists()


# ---- two at once, and ends that come too early


def test_two_runs_at_once_into_one_folder_do_not_mix(las, tmp_path, capsys, monkeypatch):
    arguments = ["run", str(las), "--out", str(tmp_path)]
    segment = plot_run.segment

    def overtaken(*args, **options):
        monkeypatch.setattr(plot_run, "segment", segment)
        assert main([*arguments, "--quiet", "--breast-height", "2"]) == 0
        return segment(*args, **options)

    monkeypatch.setattr(plot_run, "segment", overtaken)
    assert "already" in fails(capsys, arguments)
    assert read_project(tmp_path / "plot.dbh").settings.measure.breast_height_m == 2
    assert float(table((tmp_path / "plot.csv").read_text())[0]["hom_m"]) > 1.9


def test_a_plot_that_appears_while_one_waits_for_the_lock_is_kept(las, tmp_path, monkeypatch):
    def overtaken(folder: Path) -> ProjectWriter:
        folder.mkdir()
        (folder / "project.json").write_text("that of the other")
        return ProjectWriter(folder)

    monkeypatch.setattr(opening, "ProjectWriter", overtaken)
    session = opening.open_plot(las)
    with pytest.raises(ProjectExistsError):
        opening.save_as(session, tmp_path / "plot.dbh")
    assert (tmp_path / "plot.dbh" / "project.json").read_text() == "that of the other"
    ProjectWriter(tmp_path / "plot.dbh").close()


def test_a_plot_that_is_being_written_is_left_alone(las, saved, tmp_path, capsys):
    writer = ProjectWriter(saved)
    before = (saved / "project.json").read_bytes()
    for arguments in (["run", las, "--out", tmp_path, "--overwrite"], ["run", saved, "--out", tmp_path]):
        assert "being written by process" in fails(capsys, arguments)
    writer.close()
    assert (saved / "project.json").read_bytes() == before


def stuck(step: str) -> str:
    """Python that makes `run` say so, and hang, where it comes to a step."""
    # Many short sleeps: a signal that comes just before a sleep begins, or to another thread, is told when it ends.
    return (
        "import time\nfrom dbh_studio.app import plot_run\n"
        f"plot_run.{step} = lambda *_, **__: (print('here', flush=True), [time.sleep(0.05) for _ in range(2400)])"
    )


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
@pytest.mark.parametrize(("name", "status"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_an_interrupted_run_leaves_nothing_behind(name, status, las, tmp_path):
    with start(["run", las, "--out", tmp_path / "out"], before=stuck("segment")) as process:
        assert process.stdout.readline() == "here\n"
        process.send_signal(getattr(signal, name))
        _, message = process.communicate(timeout=120)
    assert process.returncode == status
    assert message == f"dbh-studio: {'interrupted' if status == 130 else 'terminated'}\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
def test_a_killed_run_can_be_taken_up(las, tmp_path, capsys):
    with start(["run", las, "--out", tmp_path], before=stuck("write_inventory_csv")) as process:
        assert process.stdout.readline() == "here\n"
        process.kill()
        process.wait(timeout=120)
    # The plot was whole already, and its lock went with the process.
    assert "--overwrite" in fails(capsys, ["run", las, "--out", tmp_path])
    assert main(["run", str(tmp_path / "plot.dbh"), "--out", str(tmp_path), "--quiet"]) == 0
    check_diameters(tmp_path / "plot.csv")
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.skipif(os.name == "nt", reason="Windows has neither these pipes nor this device")
def test_output_that_nobody_takes():
    read_end, write_end = os.pipe()
    os.close(read_end)
    with start(["settings"], stdout=write_end) as process:
        os.close(write_end)
        assert process.stderr.read() == "" and process.wait(timeout=120) == 0


def the_full_device_is_full() -> bool:
    """Some sandboxes have a `/dev/full` that takes everything."""
    try:
        with open("/dev/full", "wb", buffering=0) as full:
            full.write(b"x")
    except FileNotFoundError:
        return False
    except OSError as error:
        return error.errno == errno.ENOSPC
    return False


@pytest.mark.skipif(not the_full_device_is_full(), reason="there is no device that is always full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_output_to_a_full_disk(unbuffered, monkeypatch):
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    with open("/dev/full", "w") as full, start(["settings"], stdout=full) as process:
        assert "No space left" in process.stderr.read() and process.wait(timeout=120) == 1


def test_a_terminal_without_degree_signs(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    assert main(["settings"]) == 0
    assert "trunks.normal_max_deg = 45.0 \\xb0" in stream.buffer.getvalue().decode("ascii")


def test_the_progress_line_cleans_up_after_itself(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setenv("COLUMNS", "60")
    terminal = Terminal()
    with pytest.raises(KeyError), ProgressLine(terminal) as progress:
        progress(0.5, "Reading a\nvery long \x1b[2J name" + "x" * 100)
        raise KeyError
    lines = terminal.getvalue().split("\r\x1b[K")
    assert lines[0] == lines[-1] == "" and lines[1].startswith("[##############--------------]  50 % Reading a very")
    assert len(lines[1]) == 59 and "\n" not in terminal.getvalue() and "\x1b[2J" not in terminal.getvalue()
    silent = io.StringIO()
    with ProgressLine(silent) as progress:
        progress(0.5, "nobody looks")
    assert silent.getvalue() == ""


# ---- measure


def test_measure_prints_a_row_for_each_stem(stems, tmp_path, capsys):
    assert main(["measure", *map(str, stems)]) == 0
    printed = capsys.readouterr().out
    rows = table(printed)
    assert [row["file"] for row in rows] == [str(path) for path in stems]
    assert [float(row["dbh_cm"]) for row in rows] == pytest.approx([30, 24], rel=0.01)
    # 2 mm of noise, 1.30 m above its own lowest point; smooth, so that the tape's allowance for bark is too much.
    assert all(float(row["hom_m"]) == pytest.approx(1.30) and 1 < float(row["rmse_mm"]) < 3 for row in rows)
    assert all(float(row["dbh_lo_cm"]) < float(row["dbh_cm"]) < float(row["dbh_hi_cm"]) for row in rows)
    for name in ("shrinkage", "circle", "fourier", "ellipse"):
        assert [float(row[f"{name}_cm"]) for row in rows] == pytest.approx([30, 24], rel=0.02)
    assert main(["measure", *map(str, stems), "--csv", str(tmp_path / "new" / "stems.csv")]) == 0
    assert (tmp_path / "new" / "stems.csv").read_text() == printed
    assert "2 stems, 2 with a diameter" in capsys.readouterr().out


def test_measure_counts_heights_from_the_ground_it_is_told(stems, capsys):
    assert main(["measure", str(stems[0]), "--ground-z", "100", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["dbh_cm"] == pytest.approx(30, rel=0.01) and row["quality"] == "good"
    # Of a stem from 100 to 105 m nothing is near 1.3 m above 0 m: no diameter, which is no failure either.
    assert main(["measure", str(stems[0]), "--ground-z", "0", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["dbh_cm"] is None and row["quality"] == "refused" and row["reason"] and row["remedy"]
    assert main(["measure", str(stems[0]), "--ground-z", "-1.5", "--json"]) == 0


def test_a_bad_file_among_good_ones(stems, ply, tmp_path, capsys):
    (tmp_path / "bad.las").write_bytes(b"LASF")
    assert main(["measure", str(stems[0]), str(tmp_path / "bad.las"), str(stems[1]), "--json"]) == 1
    printed = capsys.readouterr()
    rows = json.loads(printed.out)
    assert [row["dbh_cm"] is not None for row in rows] == [True, False, True]
    assert rows[1]["reason"] and printed.err.startswith("dbh-studio: bad.las: ") and len({*map(len, rows)}) == 1
    assert main(["measure", str(stems[0]), str(ply)]) == 3
    printed = capsys.readouterr()
    rows = table(printed.out)
    assert rows[0]["dbh_cm"] and not rows[1]["dbh_cm"] and "scan.ply: " in printed.err


def test_measure_never_writes_its_table_over_a_stem(tmp_path, capsys):
    stem = tmp_path / "stem.csv"
    np.savetxt(stem, stem_points(0.30)[:500], fmt="%.4f", delimiter=",")
    before = stem.read_bytes()
    assert "read from it" in fails(capsys, ["measure", stem, "--scale", "metres", "--csv", stem])
    assert "read from it" in fails(capsys, ["measure", tmp_path, "--scale", "metres", "--csv", stem])
    assert stem.read_bytes() == before


def test_measure_takes_only_settings_of_measuring(stems, capsys):
    assert main(["measure", str(stems[0]), "--curve", "ellipse", "--set", "measure.definition=tape"]) == 0
    (row,) = table(capsys.readouterr().out)
    assert (row["dbh_method"], row["dbh_definition"]) == ("ellipse", "tape")
    assert "begin with measure" in fails(capsys, ["measure", stems[0], "--set", "trunks.slab_low_m=1"], 2)


def test_a_name_that_a_spreadsheet_would_run(stems, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(stems[0], "=1+1.las")
    assert main(["measure", "=1+1.las"]) == 0
    (row,) = table(capsys.readouterr().out)
    assert row["file"] == "'=1+1.las" and row["dbh_cm"]
    # As in the inventory: also behind a semicolon, where that separates cells.
    shutil.copy(stems[0], "a;=1+1.las")
    assert main(["measure", "a;=1+1.las"]) == 0
    assert table(capsys.readouterr().out)[0]["file"] == "a;'=1+1.las"
    assert main(["measure", "=1+1.las", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["file"] == "=1+1.las"


@pytest.mark.parametrize("height", ["nan", "inf", "low"])
def test_a_ground_that_is_no_height_is_wrong_usage(stems, capsys, height):
    assert "not a number" in fails(capsys, ["measure", stems[0], "--ground-z", height], 2)


def test_a_marker_is_named_by_any_dictionary_that_holds_it():
    """DICT_4X4_250 begins with the markers of DICT_4X4_50, under whose name they are found."""
    arguments = ["--marker", "4x4_250:7=0.5", "--marker", "DICT_4X4_250:200=0.4", "--marker", "12=0.3"]
    options = build_parser().parse_args(["run", "plot.las", "--out", "out", *arguments])
    assert photo_request(options).sides == {"DICT_4X4_50 7": 0.5, "DICT_4X4_250 200": 0.4, "12": 0.3}


def test_measure_writes_the_profile_of_each_stem(stems, tmp_path, capsys):
    path = tmp_path / "new" / "profile.csv"
    assert main(["measure", *map(str, stems), "--profile", str(path), "--quiet"]) == 0
    rows = table(path.read_text())
    assert {row["file"] for row in rows} == {str(stem) for stem in stems}
    thick = [row for row in rows if row["file"] == str(stems[0]) and row["dbh_cm"]]
    assert len(thick) >= 10
    assert all(float(row["dbh_lo_cm"]) < 30 < float(row["dbh_hi_cm"]) for row in thick)
    steps = np.diff([float(row["height_m"]) for row in thick])
    assert steps == pytest.approx(0.1)
    assert table(capsys.readouterr().out)[0]["dbh_cm"]
    assert "Choose another" in fails(capsys, ["measure", stems[0], "--profile", stems[0]], 1)
