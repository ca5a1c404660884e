"""Options that say how masks are made, shared by `masks make` and `run --masks auto`."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from dbh_studio.cli.common import positive_integer
from dbh_studio.errors import SettingError

if TYPE_CHECKING:
    from dbh_studio.app.mask_request import KeyframeChoice, LadderRequest, MakeRequest

_OWN_MASKS: dict[Path | None, Literal["auto", "stored"]] = {Path("auto"): "auto", Path("stored"): "stored"}


def add_making_options(parser: argparse.ArgumentParser) -> None:
    """Options that say how masks are made; also of `run --masks auto`."""
    making = parser.add_argument_group("masks made by trained models (`dbh-studio models`)")
    making.add_argument(
        "--rung",
        choices=("auto", "detector", "prompted"),
        default="auto",
        help="detector: text to boxes to outlines; prompted: SAM outlines trunks that geometry finds, minutes instead "
        "of an hour; auto: the first whose models are here",
    )
    making.add_argument("--prompt", metavar="TEXT", help='what is looked for; "tree trunk" by default')
    making.add_argument("--box-threshold", type=float, metavar="P", help="how sure the detector must be; 0.30")
    making.add_argument("--text-threshold", type=float, metavar="P", help="which words are said of a box; 0.25")
    making.add_argument(
        "--keyframes",
        type=_keyframes,
        default="auto",
        metavar="N|all|auto",
        help="of how many photos: N or all, those that add most; auto: until a photo adds little, about every fourth",
    )
    making.add_argument(
        "--panorama",
        choices=("tiles", "whole"),
        help="tiles: straight views all round; whole: the panorama as it is, quicker, thin stems are missed",
    )
    making.add_argument("--tiles", type=positive_integer, metavar="N", help="tiles all round a panorama; 5")
    making.add_argument("--detector", default="", metavar="NAME", help="as `models list` names it")
    making.add_argument("--segmenter", default="", metavar="NAME", help="as `models list` names it")
    making.add_argument("--provider", choices=("auto", "cpu", "cuda", "directml", "coreml"), help="what models run on")
    making.add_argument("--precision", choices=("auto", "float32", "float16", "int8"), help="of the models taken")
    making.add_argument("--threads", type=positive_integer, metavar="N", help="of the processor; one per core")


def _keyframes(text: str) -> KeyframeChoice:
    if text == "auto":
        return "auto"
    if text == "all":
        return "all"
    try:
        return positive_integer(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number of photos nor all or auto") from None


def make_request(options: argparse.Namespace) -> MakeRequest:
    """What the making options ask for.

    Raises:
        SettingError: A value is outside its bounds.
    """
    from dbh_studio.app.mask_request import MakeRequest
    from dbh_studio.settings import MaskDetectorSettings, ModelRunSettings

    looked_for = {
        "prompt": options.prompt,
        "box_threshold": options.box_threshold,
        "text_threshold": options.text_threshold,
        "panorama": options.panorama,
        "tile_count": options.tiles,
    }
    if options.tiles is not None:
        # Neighbours overlap by a tenth at least, so that a stem on the border is whole in one of them.
        looked_for["tile_fov_deg"] = max(90.0, math.ceil(1.1 * 360.0 / options.tiles))
    running = {"provider": options.provider, "precision": options.precision, "threads": options.threads}
    return MakeRequest(
        rung=options.rung,
        keyframes=options.keyframes,
        photos=tuple(getattr(options, "photos", ())),
        settings=MaskDetectorSettings().changed(**{name: v for name, v in looked_for.items() if v is not None}),
        run=ModelRunSettings().changed(**{name: value for name, value in running.items() if value is not None}),
        detector=options.detector,
        segmenter=options.segmenter,
        redo=getattr(options, "redo", False),
    )


def ladder_request(options: argparse.Namespace) -> LadderRequest | None:
    """What ``run --masks auto`` and ``--masks stored`` ask for; None for masks that are brought, or none.

    A folder of such a name is meant by ``./auto``.

    Raises:
        SettingError: An option about masks of another kind was given.
    """
    from dbh_studio.app.mask_request import LadderRequest
    from dbh_studio.settings import VoteSettings

    source: Literal["auto", "stored"] | None = _OWN_MASKS.get(options.masks)
    making = {
        f"--{name.replace('_', '-')}": getattr(options, name)
        for name in ("prompt", "box_threshold", "text_threshold", "panorama", "tiles", "detector", "segmenter")
    } | {f"--{name}": getattr(options, name) for name in ("provider", "precision", "threads")}
    making |= {"--keyframes": options.keyframes != "auto", "--rung": options.rung != "auto"}
    about_brought = {
        "--mask-meaning": options.mask_meaning,
        "--mask-category": options.mask_categories,
        "--mask-style": options.mask_style,
        "--ignore-masks": options.ignore_masks,
        "--ignore-side": options.ignore_side,
        "--mask-overlay": options.mask_overlay,
    }
    if source != "auto":
        _refuse(making, "is about making masks", "Add --masks auto.")
    if source is None:
        return None
    _refuse(about_brought, f"is about masks that are brought, not --masks {source}", "Leave it away.")
    return LadderRequest(
        source,
        make_request(options),
        VoteSettings.paper() if options.paper_votes else VoteSettings(),
        cameras=options.cameras,
        images_dir=options.images,
        accept_candidates=options.accept_candidates,
    )


def _refuse(given: dict[str, Any], why: str, remedy: str) -> None:
    for name, value in given.items():
        if value:
            raise SettingError(f"{name} {why}.", remedy)
