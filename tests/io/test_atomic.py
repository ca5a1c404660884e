from __future__ import annotations

import os
import stat
import threading
from pathlib import Path

import pytest

from dbh_studio.io.atomic import atomic_file

needs_links = pytest.mark.skipif(os.name == "nt", reason="links and modes are POSIX")


def test_two_threads_that_write_one_file_leave_the_whole_of_one(tmp_path):
    path = tmp_path / "table.csv"
    both_are_open = threading.Barrier(2)
    failures: list[Exception] = []

    def write(letter: bytes) -> None:
        try:
            with atomic_file(path) as file:
                both_are_open.wait(30)
                for _ in range(100):
                    file.write(letter * 1000)
                    file.flush()
        except (OSError, threading.BrokenBarrierError) as error:
            failures.append(error)

    threads = [threading.Thread(target=write, args=(letter,)) for letter in (b"a", b"b")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    assert path.read_bytes() in (b"a" * 100_000, b"b" * 100_000)
    assert [child.name for child in tmp_path.iterdir()] == ["table.csv"]


@needs_links
def test_a_planted_link_leads_nowhere(tmp_path, monkeypatch):
    """Even one that guesses the temporary name is not written through."""
    victim = tmp_path / "victim"
    victim.write_text("precious")
    monkeypatch.setattr("secrets.token_hex", lambda n_bytes: "guessed")
    for guess in (f".table.csv.{os.getpid()}.part", ".table.csv.guessed.part"):
        (tmp_path / guess).symlink_to(victim)
    with pytest.raises(OSError), atomic_file(tmp_path / "table.csv") as file:
        file.write(b"inventory")
    assert victim.read_text() == "precious"


@needs_links
def test_who_may_read_a_file_stays_as_it_was(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("old")
    before = os.umask(0o022)
    try:
        for mode in (0o600, 0o664):
            path.chmod(mode)
            with atomic_file(path) as file:
                file.write(b"new")
            assert stat.S_IMODE(path.stat().st_mode) == mode
        with atomic_file(tmp_path / "another.csv") as file:
            file.write(b"new")
        assert stat.S_IMODE((tmp_path / "another.csv").stat().st_mode) == 0o644
    finally:
        os.umask(before)


def test_an_error_leaves_the_file_as_it_was(tmp_path):
    path: Path = tmp_path / "table.csv"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), atomic_file(path) as file:
        file.write(b"half")
        raise ZeroDivisionError
    assert path.read_text() == "old" and [child.name for child in tmp_path.iterdir()] == ["table.csv"]
