"""dendromatics from the Python Package Index: its circle of a section, asked in an environment of its own.

    python bench/bench_dendromatics.py --install

dendromatics is GPL-3 software (the library under 3DFin). It is neither shipped nor a dependency: this file starts
another Python, which has it, gives it points and reads back radii; started there (`--worker`), it imports dendromatics.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import venv
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

VERSION = "0.7.0"
FOLDER = Path(__file__).resolve().parent / "peers" / "dendromatics"
PYTHON = FOLDER / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
_HEIGHT_M = 1.30
# What 3DFin takes of a stem; its sections begin at their height.
SHIPPED_M = 0.05


def install() -> None:
    """Make the environment."""
    venv.create(FOLDER, with_pip=True)
    subprocess.run([str(PYTHON), "-m", "pip", "install", "--quiet", f"dendromatics=={VERSION}"], check=True)


def is_installed() -> bool:
    """Whether it can be asked."""
    return PYTHON.exists()


@dataclass(frozen=True)
class PeerCircle:
    """What dendromatics says of a section.

    Attributes:
        diameter_m: Of the circle; NaN where its checks refuse it (it then says 0.000).
    """

    diameter_m: float

    @property
    def refused(self) -> bool:
        """Whether it gives none."""
        return not np.isfinite(self.diameter_m)


class Dendromatics:
    """dendromatics in a process of its own, asked about one section after another."""

    def __init__(self) -> None:
        command = [str(PYTHON), str(Path(__file__).resolve()), "--worker"]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def circle(self, points_m: np.ndarray, *, section_m: float = SHIPPED_M) -> PeerCircle:
        """Its circle at breast height, by the settings it ships.

        Args:
            points_m: (N, 3) a stem, upright, heights above the ground.
            section_m: Height of the section, about breast height.
        """
        low = _HEIGHT_M - 0.5 * section_m
        ring = points_m[(points_m[:, 2] >= low) & (points_m[:, 2] < low + section_m)]
        content = np.ascontiguousarray(ring, "<f8").tobytes()
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(len(content).to_bytes(8, "little") + content)
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError("dendromatics ended; is it installed (--install)?")
        radius = json.loads(line)
        return PeerCircle(2.0 * radius if radius > 0 else float("nan"))

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def _work(source: IO[bytes], sink: IO[str]) -> None:
    """Answer until there are no more questions; runs where dendromatics is."""
    while size := source.read(8):
        points = np.frombuffer(source.read(int.from_bytes(size, "little")), "<f8").reshape(-1, 3)
        sink.write(json.dumps(_radius(points)) + "\n")
        sink.flush()


def _radius(ring: np.ndarray) -> float:
    from dendromatics.sections import compute_sections  # only there

    if len(ring) < 3:
        return 0.0
    low, high = ring[:, 2].min(), ring[:, 2].max()
    stem = np.column_stack([ring, ring[:, 2], np.zeros(len(ring))])
    # Its first three answers are the centre and the radius; 0 is its word for none.
    found = compute_sections(stem, np.array([low]), section_width=float(high - low) + 1e-9)
    return float(np.ravel(found[2])[0])


def main() -> None:
    """Set up, or answer."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--install", action="store_true", help="make the environment")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        _work(sys.stdin.buffer, sys.stdout)
    elif options.install:
        install()
    else:
        parser.print_help()


if __name__ == "__main__":
    main()
