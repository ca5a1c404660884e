"""Run a program and say how long it took and how much memory its processes held at the worst moment."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

_POLL_S = 0.05


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Attributes:
        seconds: Wall time from start to end.
        cpu_seconds: Processor time of all its processes; None where the system does not tell.
        peak_mb: Largest sum of resident memory over the process tree, in MB of 10^6 bytes; None where unknown.
        exit_code: What the program returned; None after the time limit.
        output: Standard output and error together.
    """

    seconds: float
    cpu_seconds: float | None
    peak_mb: float | None
    exit_code: int | None
    output: str


def _tree_bytes(root: int) -> int:
    """Resident memory of a process and its descendants now, or the most that one of them ever held if that is more."""
    parents, resident = {}, {}
    page = os.sysconf("SC_PAGE_SIZE")
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it ended while we looked
        parents[int(entry.name)] = int(fields[1])
        resident[int(entry.name)] = int(fields[21]) * page
    family, children = [], [root]
    while children:
        family += children
        children = [pid for pid, parent in parents.items() if parent in children]
    return max(sum(resident.get(pid, 0) for pid in family), *(_most_ever_bytes(pid) for pid in family))


def _most_ever_bytes(pid: int) -> int:
    """The high-water mark of one process since it started; 0 where it has ended."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    found = re.search(r"VmHWM:\s+(\d+) kB", status)
    return 1024 * int(found.group(1)) if found else 0


def run(command: Sequence[str], *, limit_s: float, log: Path, environment: Mapping[str, str] | None = None) -> Outcome:
    """Run `command`, sampling the memory of its process tree.

    The peak is the larger of the sampled sum and the high-water mark of the largest single process, so that a short
    spike between two samples is not lost. Programs may keep what they compile of themselves, whatever the shell says:
    else each start of a Python program would be timed compiling.
    """
    can_sample = sys.platform == "linux"
    peak, timed_out, before = 0, False, _children_usage()
    full_environment = {**os.environ, **(environment or {})}
    full_environment.pop("PYTHONDONTWRITEBYTECODE", None)
    with log.open("wb") as file:
        start = time.perf_counter()
        process = subprocess.Popen(list(command), stdout=file, stderr=subprocess.STDOUT, env=full_environment)
        while process.poll() is None:
            if can_sample:
                peak = max(peak, _tree_bytes(process.pid))
            if time.perf_counter() - start > limit_s:
                timed_out = True
                process.kill()
                process.wait()
                break
            time.sleep(_POLL_S)
        seconds = time.perf_counter() - start
    after = _children_usage()
    cpu = None if before is None or after is None else after[0] - before[0]
    # Without /proc there is only the largest child ever waited for: a new record can only be of this run. (On Linux
    # that figure counts what the parent held when it forked, so it is not used.)
    if not can_sample and before is not None and after is not None and after[1] > before[1]:
        peak = after[1]
    output = log.read_text(errors="replace")
    return Outcome(seconds, cpu, peak / 1e6 if peak else None, None if timed_out else process.returncode, output)


def _children_usage() -> tuple[float, int] | None:
    """Processor seconds and largest resident bytes of all children so far; None where the system does not tell."""
    try:
        import resource
    except ImportError:
        return None
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    unit = 1 if sys.platform == "darwin" else 1024
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss * unit


def calibrate() -> tuple[float, float]:
    """Wall and processor seconds of a fixed piece of numpy and scipy work, best of three: how fast this machine is."""
    import numpy as np
    from scipy.spatial import cKDTree

    wall, cpu = float("inf"), float("inf")
    for _ in range(3):
        rng = np.random.default_rng(12345)
        start, start_cpu = time.perf_counter(), time.process_time()
        points = rng.random((300_000, 3))
        cKDTree(points).query(points[:60_000], k=8)
        values = rng.random(3_000_000)
        np.sort(values)
        np.cos(values).sum()
        np.unique((values * 1e6).astype(np.int64))
        wall, cpu = min(wall, time.perf_counter() - start), min(cpu, time.process_time() - start_cpu)
    return wall, cpu
