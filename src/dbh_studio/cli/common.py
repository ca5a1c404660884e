"""What several commands share: the options that describe a cloud, settings by name, and a progress line."""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any, TextIO

from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.errors import SettingError

SCALE_WORDS = ("metres", "feet", "millimetres")


def add_cloud_options(parser: argparse.ArgumentParser) -> None:
    """Options that say how a cloud is to be understood."""
    parser.add_argument(
        "--scale",
        type=scale_argument,
        metavar="M_PER_UNIT",
        help="metres per unit of the file (1.33231), or: metres, feet, millimetres; without it the unit is taken from "
        "the file where it can be told, and the command stops where it cannot",
    )
    parser.add_argument("--up", choices=("+z", "-z", "+y", "-y", "+x", "-x"), help="which way is up in the file")


def add_settings_options(parser: argparse.ArgumentParser) -> None:
    """The settings used most under their own names, and all of them by ``--set``."""
    parser.add_argument("--curve", choices=("fourier", "ellipse", "bspline"), help="curve the diameter is read from")
    parser.add_argument("--breast-height", type=float, metavar="M", help="1.30, 1.37 (4.5 ft), 1.40 or another, metres")
    parser.add_argument("--ground", choices=("terrain", "plane"), help="terrain surface, or the paper's single plane")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        dest="assignments",
        help="any setting, such as trunks.min_diameter_cm=8; `dbh-studio settings` lists them",
    )


def scale_argument(text: str) -> float | str:
    """A positive number or one of the unit names."""
    if text in SCALE_WORDS:
        return text
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is neither a positive number nor one of {', '.join(SCALE_WORDS)}")
    return value


def settings_from(options: argparse.Namespace) -> Any:
    """The `Settings` that the options describe.

    Raises:
        SettingError: An unknown name or a value outside its bounds.
    """
    from dbh_studio.settings import Settings

    chosen: dict[str, dict[str, Any]] = {}
    for section, name, value in (
        ("measure", "curve", options.curve),
        ("measure", "breast_height_m", options.breast_height),
        ("ground", "method", options.ground),
    ):
        if value is not None:
            chosen.setdefault(section, {})[name] = value
    for assignment in options.assignments:
        path, equals, value = assignment.partition("=")
        section, dot, name = path.strip().partition(".")
        if not equals or not dot:
            raise SettingError(f"--set {assignment}: expected SECTION.NAME=VALUE.", "For example trunks.small_clusters=otsu.")
        chosen.setdefault(section, {})[name] = value.strip()
    settings = Settings()
    for section, values in chosen.items():
        if section not in Settings.model_fields:
            raise SettingError(f"There are no settings called {section!r}.", f"Use {', '.join(Settings.model_fields)}.")
        settings = settings.model_copy(update={section: getattr(settings, section).changed(**values)})
    return settings


class ProgressLine:
    """A `Progress` that rewrites one line of a terminal; silent where the output is not one."""

    _WIDTH = 28

    def __init__(self, stream: TextIO | None = None, *, enabled: bool = True) -> None:
        self._stream = stream if stream is not None else sys.stderr
        self._enabled = enabled and self._stream.isatty()
        self._last_time = 0.0
        self._last_message = ""

    def __call__(self, fraction: float, message: str = "") -> None:
        """Draw the bar, at most ten times a second."""
        now = time.monotonic()
        if not self._enabled or (now - self._last_time < 0.1 and fraction < 1 and message == self._last_message):
            return
        self._last_time, self._last_message = now, message
        done = round(self._WIDTH * min(max(fraction, 0.0), 1.0))
        bar = "#" * done + "-" * (self._WIDTH - done)
        self._stream.write(f"\r\x1b[K[{bar}] {100 * fraction:3.0f} % {message}")
        self._stream.flush()

    def finish(self) -> None:
        """Leave a clean line behind."""
        if self._enabled:
            self._stream.write("\r\x1b[K")
            self._stream.flush()


def progress_for(options: argparse.Namespace) -> Progress:
    """A progress line unless the command was asked to be quiet or to speak JSON."""
    if getattr(options, "quiet", False):
        return ignore_progress
    return ProgressLine()
