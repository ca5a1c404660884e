"""What several commands share: the options that describe a cloud, settings by name, and a progress line."""

from __future__ import annotations

import argparse
import difflib
import math
import re
import shutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from dbh_studio.errors import SettingError, UnscaledCloudError

if TYPE_CHECKING:
    from dbh_studio.app.brought_masks import MaskRequest
    from dbh_studio.app.photo_scale import PhotoRequest

_SMALLEST_SIDE_M, _LARGEST_SIDE_M = 0.02, 10.0
UP_AXES = ("+z", "-z", "+y", "-y", "+x", "-x")


def add_cloud_options(parser: argparse.ArgumentParser, *, otherwise: str = "the command stops") -> None:
    """Options that say how a cloud is to be understood, and what happens without them."""
    parser.add_argument(
        "--scale",
        type=scale_argument,
        metavar="M_PER_UNIT",
        help="metres per unit of the file (1.33231), or the unit's name: metres, feet, us-feet, centimetres, "
        f"millimetres; without it the unit is taken from the file, and where that does not tell, {otherwise}",
    )
    parser.add_argument("--up", choices=UP_AXES, help="which way is up in the file")


def add_relocation_option(parser: argparse.ArgumentParser) -> None:
    """Where the cloud of a saved plot has gone."""
    parser.add_argument(
        "--cloud", type=path_argument, metavar="FILE", help="where the cloud of a saved NAME.dbh is now, if it moved"
    )


def add_settings_options(parser: argparse.ArgumentParser, *, only_measure: bool = False) -> None:
    """The settings used most under their own names, and all of them (or those of measuring) by ``--set``."""
    parser.add_argument(
        "--curve",
        choices=("shrinkage", "circle", "fourier", "ellipse", "bspline"),
        help="method the diameter is read by; shrinkage and circle give an interval",
    )
    parser.add_argument("--breast-height", type=float, metavar="M", help="1.30, 1.37 (4.5 ft), 1.40 or another, metres")
    parser.add_argument(
        "--protocol",
        choices=("paper", "fao", "fia", "champion", "nz"),
        help="breast height, --base, --along and --above by the rules of a manual; what is given beside it goes before",
    )
    parser.add_argument(
        "--base", choices=("uphill", "midpoint", "downhill"), help="side of a slope that breast height is measured from"
    )
    parser.add_argument(
        "--along", choices=("vertical", "stem"), help="height above the base, or along the axis of a leaning stem"
    )
    parser.add_argument(
        "--above",
        choices=("nothing", "bulge", "buttress"),
        help="what is measured above where it reaches breast height; buttress: bulges too",
    )
    if not only_measure:
        parser.add_argument("--ground", choices=("terrain", "plane"), help="terrain, or the paper's single plane")
    example = "measure.definition=tape" if only_measure else "trunks.min_diameter_cm=8"
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        dest="assignments",
        help=f"any setting, such as {example}; may be given several times; `dbh-studio settings` lists them",
    )


def add_photo_options(parser: argparse.ArgumentParser) -> None:
    """Options that take the scale from markers in photos."""
    photos = parser.add_argument_group("scale from markers in photos")
    photos.add_argument(
        "--cameras",
        type=path_argument,
        metavar="PATH",
        help="poses of the photos: a COLMAP model, Metashape XML, OpenSfM or ODM folder, or a table of poses; without "
        "it they are looked for beside the cloud",
    )
    photos.add_argument("--images", type=path_argument, metavar="DIR", help="folder of the photos, if not beside them")
    photos.add_argument(
        "--marker-side",
        type=finite_number,
        metavar="M",
        help="outer edge of the markers' black squares, metres; 1 if only --cameras is given",
    )
    photos.add_argument(
        "--marker",
        action="append",
        default=[],
        dest="markers",
        metavar="ID=M",
        help="side of one marker, such as 12=0.5 or DICT_4X4_50:12=0.5; may be given several times; without "
        "--marker-side other markers are ignored",
    )
    photos.add_argument(
        "--dictionary",
        action="append",
        default=[],
        dest="dictionaries",
        metavar="NAME",
        help="dictionary of the markers, such as DICT_4X4_50; guessed where none is named",
    )


def add_mask_options(parser: argparse.ArgumentParser) -> None:
    """Options that find trunks by masks of the photos."""
    masks = parser.add_argument_group(
        "trunks from masks of the photos", "The photos are those of --cameras and --images, above."
    )
    masks.add_argument(
        "--masks",
        type=path_argument,
        metavar="PATH|auto|stored",
        help="folder with a mask for each photo, named after it, or a COCO file (.json); auto: the best way to trunks "
        "there is, making masks where models are here; stored: the masks kept beside the plot. Markers are then "
        "looked for only where --marker-side, --marker or --dictionary is given",
    )
    masks.add_argument(
        "--mask-meaning",
        choices=("trunk-bright", "trunk-dark", "ignore-dark", "ignore-bright", "labels"),
        help="what the masks show; labels: a number for each trunk or class; guessed, and told, where it is clear",
    )
    masks.add_argument(
        "--mask-category",
        action="append",
        default=[],
        dest="mask_categories",
        metavar="NAME",
        help="what is trunk: a category of the COCO file, or numbers of the masks such as 7 or 1-12; may be given "
        "several times",
    )
    masks.add_argument(
        "--mask-style",
        metavar="STYLE",
        help="how masks are named: colmap (photo.jpg.png), suffix (photo_mask.png), dotted (photo.mask.png), trunk "
        "(photo_trunk.png), same (photo.png), or a template such as {stem}_segm.png; by default what fits most photos",
    )
    masks.add_argument(
        "--ignore-masks",
        type=path_argument,
        metavar="PATH",
        help="more masks, one for each photo or one picture for all: where they are dark, the photos say nothing",
    )
    masks.add_argument(
        "--ignore-side", choices=("dark", "bright"), help="which side of --ignore-masks is ignored; dark by default"
    )
    masks.add_argument(
        "--mask-overlay",
        type=path_argument,
        metavar="FILE.jpg",
        help="write one photo with its mask drawn, to see whether the masks are read as they are meant",
    )
    masks.add_argument(
        "--paper-votes",
        action="store_true",
        help="a point is trunk where one mask says so, also behind others, as in the paper; by default hidden points "
        "do not vote and masks must agree",
    )
    masks.add_argument(
        "--accept-candidates",
        action="store_true",
        help="take stems that geometry sees and the masks do not as trunks too, flagged; by default they are only "
        "offered in the studio",
    )


def mask_request(options: argparse.Namespace) -> MaskRequest | None:
    """What the mask options ask for; None where none is given.

    Raises:
        SettingError: Options about masks, and no masks.
    """
    if options.masks is None:
        about = {
            "--mask-meaning": options.mask_meaning,
            "--mask-category": options.mask_categories,
            "--mask-style": options.mask_style,
            "--ignore-masks": options.ignore_masks,
            "--ignore-side": options.ignore_side,
            "--mask-overlay": options.mask_overlay,
            "--paper-votes": options.paper_votes,
            "--accept-candidates": options.accept_candidates,
        }
        given = [name for name, value in about.items() if value]
        if given:
            raise SettingError(f"{given[0]} was given without masks.", "Say where the masks are: --masks PATH.")
        return None
    from dbh_studio.app.brought_masks import MaskRequest
    from dbh_studio.settings import VoteSettings

    return MaskRequest(
        options.masks,
        options.mask_meaning and options.mask_meaning.replace("-", "_"),
        options.mask_style,
        tuple(options.mask_categories),
        VoteSettings.paper() if options.paper_votes else VoteSettings(),
        ignore_path=options.ignore_masks,
        ignore_side=options.ignore_side or "dark",
        cameras=options.cameras,
        images_dir=options.images,
        overlay=options.mask_overlay,
        accept_candidates=options.accept_candidates,
    )


def photo_request(options: argparse.Namespace) -> PhotoRequest | None:
    """What the photo options ask for; None where none is given.

    Raises:
        SettingError: A side or a dictionary cannot be.
    """
    given = (options.marker_side, *options.markers, *options.dictionaries)
    if getattr(options, "masks", None) is None:
        # Photos that are there for masks need not show markers.
        given = (options.cameras, options.images, *given)
    if all(value is None for value in given):
        return None
    from dbh_studio.app.photo_scale import PhotoRequest
    from dbh_studio.io.marker_codes import known_name
    from dbh_studio.settings import MarkerSettings

    changes: dict[str, Any] = {"dictionaries": tuple(known_name(name) for name in options.dictionaries)}
    if options.marker_side is not None:
        changes["side_m"] = options.marker_side
    sides = dict(_marker_side(text) for text in options.markers)
    only_named = bool(sides) and options.marker_side is None
    return PhotoRequest(options.cameras, options.images, sides, MarkerSettings().changed(**changes), only_named)


def _marker_side(text: str) -> tuple[str, float]:
    """``12=0.5`` or ``DICT_4X4_50:12=0.5`` as the name of the marker and its side."""
    name, _, value = text.partition("=")
    dictionary, _, number = name.rpartition(":")
    try:
        side_m = float(value)
        if not number.strip().isdigit() or not _SMALLEST_SIDE_M <= side_m <= _LARGEST_SIDE_M:
            raise ValueError
    except ValueError:
        raise SettingError(
            f"--marker {text}: expected ID=SIDE, the side in metres.", "For example 12=0.5 or DICT_4X4_50:12=0.5."
        ) from None
    if not dictionary:
        return str(int(number)), side_m
    from dbh_studio.io.marker_codes import known_name, smallest_dictionary

    # What is found has the name of the smallest dictionary that holds it, whatever is printed on the board.
    return f"{smallest_dictionary(known_name(dictionary), int(number))} {int(number)}", side_m


def path_argument(text: str) -> Path:
    """A path; an empty one, as from an unset variable of a script, is not the folder one happens to be in."""
    if not text.strip():
        raise argparse.ArgumentTypeError("the path is empty")
    return Path(text)


def positive_integer(text: str) -> int:
    """A whole number above zero."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above zero")
    return value


def finite_number(text: str) -> float:
    """A number that is neither infinite nor no number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number")
    return value


def port_number(text: str) -> int:
    """A TCP port."""
    value = positive_integer(text)
    if value > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is not a port; ports are 1 to 65535")
    return value


def scale_argument(text: str) -> str:
    """A positive number or the name of a unit, as text."""
    from dbh_studio.app.opening import scale_from

    try:
        if text.strip() and scale_from(text).is_known:
            return text
    except SettingError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    raise argparse.ArgumentTypeError(f"{text!r} says nothing; leave --scale away where the scale is not known")


def settings_changes(options: argparse.Namespace, *, only_measure: bool = False) -> dict[str, dict[str, Any]]:
    """What the options change in the settings: section -> name -> value; checked.

    Raises:
        SettingError: An unknown name or a value outside its bounds.
    """
    from dbh_studio.settings import Settings

    changes: dict[str, dict[str, Any]] = {}
    if options.protocol is not None:
        from dbh_studio.core.protocols import PROTOCOLS

        changes["measure"] = dict(PROTOCOLS[options.protocol])
    for section, name, value in (
        ("measure", "curve", options.curve),
        ("measure", "breast_height_m", options.breast_height),
        ("measure", "base", options.base),
        ("measure", "along", options.along),
        ("measure", "above", options.above),
        ("ground", "method", getattr(options, "ground", None)),
    ):
        if value is not None:
            changes.setdefault(section, {})[name] = value
    for assignment in options.assignments:
        path, equals, value = assignment.partition("=")
        section, dot, name = path.strip().partition(".")
        if not equals or not dot:
            raise SettingError(
                f"--set {assignment}: expected SECTION.NAME=VALUE.", "For example measure.definition=tape."
            )
        _check_name(section, name)
        if only_measure and section != "measure":
            raise SettingError(
                f"--set {assignment}: only settings of measuring count here.", "They begin with measure."
            )
        changes.setdefault(section, {})[name] = value.strip()
    for section, values in changes.items():
        getattr(Settings(), section).changed(**values)
    return changes


def _check_name(section: str, name: str) -> None:
    from dbh_studio.settings import Settings

    if section not in Settings.model_fields:
        raise SettingError(f"There are no settings called {section!r}.", f"Use {', '.join(Settings.model_fields)}.")
    names = list(type(getattr(Settings(), section)).model_fields)
    if name not in names:
        near = difflib.get_close_matches(name, names, 1, 0.4)
        meant = f"Did you mean {section}.{near[0]}? " if near else ""
        raise SettingError(f"There is no setting {section}.{name}.", f"{meant}`dbh-studio settings` lists them.")


def unscaled_error(*, has_photos: bool = False) -> UnscaledCloudError:
    """What a person at the command line can do about a cloud without a scale, and with photos given for masks."""
    markers = " If the photos show a marker, add --marker-side, its side in metres." if has_photos else ""
    return UnscaledCloudError(
        "The file does not tell how long its unit is, so no diameter can be given.",
        "Say it: --scale metres (or feet, us-feet, centimetres, millimetres), or metres per unit such as "
        "--scale 1.332. A cloud from photographs has a scale of its own: measure it by markers or a known distance, "
        f"with `dbh-studio scale` or in the studio (`dbh-studio open`) under Scale.{markers}",
    )


def counted(n: int, noun: str) -> str:
    """``1 stem``, ``2 stems``."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def plain(text: str) -> str:
    """Text for a terminal: no control characters but the line feed, whatever a file is called."""
    return re.sub(r"[\x00-\x09\x0b-\x1f\x7f-\x9f]", "?", text)


class ProgressLine:
    """A `Progress` that rewrites one line of a terminal; silent where the output is not one."""

    _WIDTH = 28

    def __init__(self, stream: TextIO | None = None, *, enabled: bool = True) -> None:
        stream = stream if stream is not None else sys.stderr
        self._stream = stream
        self._enabled = enabled and stream is not None and stream.isatty()
        self._last_time = 0.0
        self._last_message = ""

    def __enter__(self) -> ProgressLine:
        return self

    def __exit__(self, *_: object) -> None:
        self.finish()

    def __call__(self, fraction: float, message: str = "") -> None:
        """Draw the bar, at most ten times a second."""
        now = time.monotonic()
        if not self._enabled or (now - self._last_time < 0.1 and fraction < 1 and message == self._last_message):
            return
        self._last_time, self._last_message = now, message
        done = round(self._WIDTH * min(max(fraction, 0.0), 1.0))
        bar = "#" * done + "-" * (self._WIDTH - done)
        line = plain(f"[{bar}] {100 * fraction:3.0f} % {message}").replace("\n", " ")
        # A line that wraps could not be taken back.
        self._stream.write(f"\r\x1b[K{line[: shutil.get_terminal_size().columns - 1]}")
        self._stream.flush()

    def finish(self) -> None:
        """Leave a clean line behind."""
        if self._enabled:
            self._stream.write("\r\x1b[K")
            self._stream.flush()


def progress_for(options: argparse.Namespace) -> ProgressLine:
    """A progress line unless the command was asked to be quiet."""
    return ProgressLine(enabled=not options.quiet)
