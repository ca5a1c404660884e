"""3DFin from the Python Package Index, run as a separate program in an environment of its own.

3DFin is GPL-3 software. It is never imported, shipped or depended upon: it is only started, for comparison.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import venv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_match import Table
from bench_process import Outcome, run

VERSION = "0.6.0"
FOLDER = Path(__file__).resolve().parent / "peers" / "3dfin"
_BIN = FOLDER / ("Scripts" if os.name == "nt" else "bin")
PROGRAM = _BIN / ("3DFin.exe" if os.name == "nt" else "3DFin")
# Its own advice when it stops: "decrease n_points".
_FEWER_POINTS = (200, 50)


@dataclass(frozen=True)
class PeerRun:
    """One run of 3DFin: what was done, how it went, what it found (None where it stopped)."""

    how: str
    outcome: Outcome
    found: Table | None


def install() -> None:
    """Make the environment. It is about 1 GB, for 3DFin brings a user interface along."""
    venv.create(FOLDER, with_pip=True)
    subprocess.run([str(_BIN / "python"), "-m", "pip", "install", "--quiet", f"3dfin=={VERSION}"], check=True)


def is_installed() -> bool:
    """Whether 3DFin can be started."""
    return PROGRAM.exists()


def version() -> str:
    """What the program says of itself."""
    done = subprocess.run([str(PROGRAM), "--version"], capture_output=True, text=True, env=_environment(), check=False)
    found = re.search(r"\d+\.\d+\.\d+", done.stdout + done.stderr)
    return found.group() if found else "unknown"


def run_3dfin(plot: Path, folder: Path, *, has_ground: bool, limit_s: float) -> list[PeerRun]:
    """Run with the parameters 3DFin ships; where it asks for fewer points, once more as it asks.

    A plot without ground is run twice: as it lies (its z taken for height), and normalised all the same.
    """
    runs = []
    for how, normalise, z_name in _ways(has_ground):
        for n_points in (None, *_FEWER_POINTS):
            values = {"z0_name": z_name, **({} if n_points is None else {"number_of_points": str(n_points)})}
            name = how if n_points is None else f"{how}, number_of_points={n_points}"
            runs.append(_run_once(plot, folder, name, normalise=normalise, values=values, limit_s=limit_s))
            if runs[-1].found is not None or "decrease n_points" not in runs[-1].outcome.output:
                break
    return runs


def _ways(has_ground: bool) -> list[tuple[str, bool, str]]:
    if has_ground:
        return [("default", True, "Z0")]
    return [("z as height", False, "z"), ("normalised without ground", True, "Z0")]


def _run_once(
    plot: Path, parent: Path, how: str, *, normalise: bool, values: dict[str, str], limit_s: float
) -> PeerRun:
    folder = parent / re.sub(r"\W+", "_", how)
    folder.mkdir(parents=True, exist_ok=True)
    parameters = folder / "parameters.ini"
    parameters.write_text(_parameters(values), encoding="utf-8")
    command = [str(PROGRAM), "cli", "--export_txt", *(["--normalize"] if normalise else [])]
    command += [str(plot), str(folder), str(parameters)]
    outcome = run(command, limit_s=limit_s, log=folder / "log.txt", environment=_environment())
    tables = list(folder.glob("*_dbh_and_heights.txt"))
    return PeerRun(how, outcome, _read(tables[0]) if tables and outcome.exit_code == 0 else None)


def _environment() -> dict[str, str]:
    # It opens no window on the command line, but loads the library that would.
    return {**os.environ, "QT_QPA_PLATFORM": "offscreen", "PYTHONPATH": ""}


def _parameters(values: dict[str, str]) -> str:
    """The parameter file that comes with 3DFin, with some values changed."""
    shipped = next(FOLDER.rglob("3DFinconfig.ini")).read_text(encoding="utf-8")
    for name, value in values.items():
        shipped, n_changed = re.subn(rf"(?m)^{name}\s*=.*$", f"{name}={value}", shipped)
        if n_changed != 1:
            sys.exit(f"3DFin's own parameter file has no single {name}.")
    return shipped


def _read(path: Path) -> Table:
    """Columns: height, diameter (m, 0 where there is none), x, y."""
    rows = np.loadtxt(path, ndmin=2).reshape(-1, 4)
    diameters = np.where(rows[:, 1] > 0, 100 * rows[:, 1], np.nan)
    return Table(tuple(str(i + 1) for i in range(len(rows))), rows[:, 2:4], diameters)
