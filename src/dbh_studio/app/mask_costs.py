"""What a mask costs: seconds measured on this computer, or figures stated before the first one was made."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dbh_studio.app.cache import cache_folder
from dbh_studio.io.atomic import atomic_file
from dbh_studio.settings import MaskDetectorSettings, ModelRunSettings

if TYPE_CHECKING:
    from dbh_studio.core.posed_images import PosedImage

# Processor-seconds of one picture, of the same architectures with random weights on a server's processor (AVX-512): the
# encoders and, of SAM, three outlines.
_STATED_S = {
    "grounding-dino-tiny": 10.5,
    "grounding-dino-tiny-fp16": 12.0,
    "grounding-dino-tiny-int8": 7.5,
    "grounding-dino-tiny-phrases": 10.5,
    "mobile-sam": 1.5,
    "sam2.1-tiny": 4.6,
}
_UNKNOWN_S = 10.0
# Beyond so many cores, these models are hardly quicker.
_MOST_CORES = 8
_SPEEDS_FILE = "mask-speeds.json"


@dataclass(frozen=True)
class MaskCost:
    """What masks will take.

    Attributes:
        n_photos: How many masks are to be made.
        n_views: Tiles and pictures the models look at for them.
        seconds_per_view: Of one of these.
        is_measured: On this computer, with these models; else from stated figures.
    """

    n_photos: int
    n_views: int
    seconds_per_view: float
    is_measured: bool

    @property
    def seconds(self) -> float:
        """For all of them."""
        return self.n_views * self.seconds_per_view

    @property
    def text(self) -> str:
        """``about 55 min on this computer, as measured``."""
        basis = "as measured" if self.is_measured else "not measured yet, perhaps twice that"
        return f"about {duration(self.seconds)} on this computer, {basis}" if self.n_photos else "nothing to do"


def duration(seconds: float) -> str:
    """``40 s``, ``12 min``, ``2 h 10 min``: as exact as an estimate is."""
    if seconds < 100:
        return f"{max(round(seconds), 1)} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02d} min"


def views_of(photo: PosedImage, settings: MaskDetectorSettings, *, is_prompted: bool = False) -> int:
    """How many pictures the models look at for one photo: its tiles, or 1."""
    if not photo.camera.is_panorama or (settings.panorama == "whole" and not is_prompted):
        return 1
    return sum(1 if abs(pitch) > 89.0 else settings.tile_count for pitch in settings.tile_pitches_deg)


def cost_of(
    photos: Iterable[PosedImage],
    models: Sequence[str],
    settings: MaskDetectorSettings,
    run: ModelRunSettings,
    *,
    is_prompted: bool = False,
) -> MaskCost:
    """What the masks of these photos will take with these models.

    Args:
        photos: Those that are to be made.
        models: Names, as `stages.mask_models.chosen_models` gives them.
        settings: Tiles.
        run: On what they run.
        is_prompted: Boxes come from geometric trunks, so that a panorama is always looked at in tiles.
    """
    views = [views_of(photo, settings, is_prompted=is_prompted) for photo in photos]
    measured = measured_seconds(models, run)
    return MaskCost(len(views), sum(views), measured or stated_seconds(models, run), measured is not None)


def stated_seconds(models: Iterable[str], run: ModelRunSettings) -> float:
    """Seconds of one picture by the figures above, on as many cores as there are."""
    cores = min(run.threads or os.cpu_count() or 1, os.cpu_count() or 1, _MOST_CORES)
    return sum(_STATED_S.get(name, _UNKNOWN_S) for name in models) / cores


def measured_seconds(models: Sequence[str], run: ModelRunSettings) -> float | None:
    """Seconds of one picture as they were measured last on this computer; None where they were not."""
    value = _speeds().get(_key(models, run))
    return float(value) if isinstance(value, (int, float)) and 0 < value < 1e5 else None


def remember_speed(models: Sequence[str], run: ModelRunSettings, seconds_per_view: float) -> None:
    """Keep what was measured, in the cache. That it cannot be written is no loss."""
    speeds = _speeds() | {_key(models, run): round(seconds_per_view, 3)}
    path = _path()
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as file:
            file.write(json.dumps(speeds, indent=1, sort_keys=True).encode())


def _path() -> Path:
    return cache_folder() / _SPEEDS_FILE


def _key(models: Sequence[str], run: ModelRunSettings) -> str:
    return f"{'+'.join(models)} {run.provider} {run.threads or 'all'} threads"


def _speeds() -> dict[str, object]:
    try:
        value = json.loads(_path().read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return value if isinstance(value, dict) else {}
