from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from tests.app import jobwork

from dbh_studio.app import jobs
from dbh_studio.app.jobs import Job, read_value, run_job, write_value
from dbh_studio.errors import CancelledError, MalformedFileError, StaleResultError, StudioError

REPOSITORY = Path(__file__).parents[2]
PATIENCE_S = 120.0


@pytest.fixture(autouse=True)
def scratch(tmp_path, monkeypatch):
    """A temporary folder of the test's own, which must be empty again at its end."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    # A child gets this process's path, and must find `tests` in it however pytest was started.
    monkeypatch.syspath_prepend(str(REPOSITORY))
    yield folder
    assert list(folder.iterdir()) == []


class Answers:
    """Collects what a job calls back with."""

    def __init__(self, *, on_progress=None):
        self.progress, self.results, self.errors = [], [], []
        self.has_progress = threading.Event()
        self._react = on_progress

    def on_progress(self, fraction, message=""):
        self.progress.append((fraction, message))
        self.has_progress.set()
        if self._react:
            self._react()

    def job(self, function, *args, **options) -> Job:
        return Job(
            function,
            args,
            options,
            on_progress=self.on_progress,
            on_done=self.results.append,
            on_error=self.errors.append,
        )


@pytest.mark.parametrize("mapped", [False, True])
def test_values_survive_the_file_with_their_arrays_aligned_and_as_writeable_as_they_were(tmp_path, mapped):
    fixed = np.arange(12, dtype=np.float32).reshape(4, 3)
    fixed.flags.writeable = False
    free = np.arange(5, dtype=np.int64)
    odd = np.zeros(3, np.uint8)
    value = {"fixed": fixed, "free": free, "odd": odd, "none": np.empty((0, 3)), "steps": fixed[::2], "text": "°"}
    write_value(tmp_path / "value", value)
    back = read_value(tmp_path / "value", mapped=mapped)
    assert back["text"] == "°" and list(back) == list(value)
    for name in ("fixed", "free", "odd", "none", "steps"):
        assert np.array_equal(back[name], value[name]) and back[name].dtype == value[name].dtype
    assert not back["fixed"].flags.writeable and back["free"].flags.writeable
    assert back["fixed"].flags.aligned and back["free"].flags.aligned
    back["free"][0] = 99
    assert read_value(tmp_path / "value", mapped=mapped)["free"][0] == 0


def test_the_result_comes_from_another_process_and_arguments_are_untouched():
    points = np.arange(300_000, dtype=np.float32).reshape(-1, 3)
    points.flags.writeable = False
    seen = []
    result = run_job(jobwork.double, points, offset=1, progress=lambda f, message="": seen.append((f, message)))
    assert np.array_equal(result["sum"], 2 * points + 1)
    assert result["pid"] != os.getpid() and not result["is_writeable"]
    assert seen == [(0.5, "half way")]
    mine = np.zeros(5)
    assert run_job(jobwork.write_into, mine).tolist() == [7] * 5
    assert mine.tolist() == [0] * 5


def test_large_results_come_back_whole():
    numbers, (ones, none) = run_job(jobwork.make_large, 1_000_000)
    assert numbers[-1] == 999_999 and ones.shape == (1_000_000, 2) and ones.all() and none.shape == (0, 3)
    numbers[0] = 1


def test_in_process_is_the_same_call():
    assert run_job(jobwork.double, np.ones(2), in_process=True)["pid"] == os.getpid()


def test_errors_of_the_child_arrive_as_they_are():
    with pytest.raises(MalformedFileError) as caught:
        run_job(jobwork.fail_with_file_error)
    assert caught.value.path == Path("a/plot.ply")
    assert str(caught.value) == "plot.ply: It stops in the middle. Copy it again."
    with pytest.raises(StaleResultError) as stale:
        run_job(jobwork.fail_with_stale)
    assert (stale.value.problem, stale.value.remedy) == ("The scale changed.", "Start again.")


@pytest.mark.parametrize(
    ("work", "words"),
    [
        (jobwork.fail_oddly, "OddError: an error that does not unpickle"),
        (jobwork.run_out_of_memory, "not enough memory"),
        (jobwork.exit_quietly, "exit status 3"),
        (jobwork.return_unpicklable, "stopped unexpectedly"),
        pytest.param(
            jobwork.kill_yourself,
            "memory ran out",
            marks=pytest.mark.skipif(os.name == "nt", reason="Windows has no signals"),
        ),
    ],
)
def test_every_other_end_is_one_error_in_words(work, words):
    with pytest.raises(StudioError, match=words) as caught:
        run_job(work)
    assert type(caught.value) is StudioError and caught.value.remedy


def test_cancel_stops_python_and_leaves_no_file(tmp_path):
    answers = Answers()
    job = answers.job(jobwork.leave_temporary_files_and_wait, str(tmp_path)).start()
    assert answers.has_progress.wait(PATIENCE_S)
    pid = int((tmp_path / "pid").read_text())
    assert job.is_running
    job.cancel()
    job.join(PATIENCE_S)
    assert not job.is_running and job.is_cancelled
    assert [type(error) for error in answers.errors] == [CancelledError] and answers.results == []
    assert not _is_alive(pid)


@pytest.mark.skipif(os.name == "nt", reason="calls the C library's sleep")
def test_cancel_stops_native_code_at_once():
    answers = Answers()
    job = answers.job(jobwork.wait_in_native_code).start()
    assert answers.has_progress.wait(PATIENCE_S)
    job.cancel()
    job.join(PATIENCE_S)
    assert [type(error) for error in answers.errors] == [CancelledError]


def test_a_cancel_before_the_start_counts(monkeypatch):
    answers = Answers()
    job = answers.job(jobwork.double, np.ones(3))
    job.cancel()
    job.start().join(PATIENCE_S)
    assert [type(error) for error in answers.errors] == [CancelledError] and answers.results == []


def test_a_cancel_while_the_arguments_are_written_counts(monkeypatch):
    """The child does not exist yet, and must not come to."""
    answers = Answers()
    job = answers.job(jobwork.double, np.ones(3))

    def write_and_cancel(path, value):
        write_value(path, value)
        job.cancel()

    monkeypatch.setattr(jobs, "write_value", write_and_cancel)
    monkeypatch.setattr(jobs._context, "Process", None)
    job.start().join(PATIENCE_S)
    assert [type(error) for error in answers.errors] == [CancelledError] and answers.results == []


def test_progress_may_cancel():
    def cancel(fraction, message=""):
        raise CancelledError

    with pytest.raises(CancelledError):
        run_job(jobwork.wait_in_native_code, progress=cancel)


def test_a_failing_callback_ends_the_child_and_is_reported():
    def fail():
        raise RuntimeError("the window is gone")

    answers = Answers(on_progress=fail)
    answers.job(jobwork.wait_in_native_code).start().join(PATIENCE_S)
    assert len(answers.errors) == 1 and "the window is gone" in str(answers.errors[0])


def test_a_result_that_no_longer_fits_is_reported_as_an_error():
    errors = []

    def refuse(result):
        raise StaleResultError("The scale changed.")

    job = Job(jobwork.double, (np.ones(2),), on_done=refuse, on_error=errors.append)
    job.start().join(PATIENCE_S)
    assert [type(error) for error in errors] == [StaleResultError]


def test_a_full_temporary_disk_is_said_so(monkeypatch):
    def full(path, value):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(jobs, "write_value", full)
    with pytest.raises(StudioError, match="No space left") as caught:
        run_job(jobwork.double, np.ones(2))
    assert "TMPDIR" in caught.value.remedy


_PARENT = """
import sys
from dbh_studio.app.jobs import run_job
from tests.app import jobwork

if __name__ == "__main__":
    run_job(jobwork.leave_temporary_files_and_wait, sys.argv[1], progress=lambda f, m="": print(m, flush=True))
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks into /proc")
def test_the_child_ends_with_the_studio_and_takes_the_files_along(tmp_path, scratch):
    script = tmp_path / "parent.py"
    script.write_text(_PARENT)
    paths = os.pathsep.join([str(REPOSITORY / "src"), str(REPOSITORY)])
    environment = {**os.environ, "PYTHONPATH": paths, "TMPDIR": str(scratch)}
    command = [sys.executable, str(script), str(tmp_path)]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as parent:
        assert Path(parent.stdout.readline().strip()).parent == scratch
        child = int((tmp_path / "pid").read_text())
        assert _is_alive(child)
        parent.kill()
        parent.wait()
    deadline = time.monotonic() + PATIENCE_S
    while (_is_alive(child) or list(scratch.iterdir())) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not _is_alive(child) and list(scratch.iterdir()) == []


def _is_alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and waits to be reaped does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):  # it may end between opening and reading
        return False
