"""What a Session looks at before it takes a command: that a scale is possible, and a result not out of date."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from dbh_studio.app.document import Document
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.errors import SettingError, StaleResultError

# From micrometres to a reconstruction whose unit is ten kilometres: beyond it somebody slipped on the keyboard.
_LEAST_SCALE, _MOST_SCALE = 1e-6, 1e4

_FIELDS = {
    "plot_id": "the name of the plot",
    "source": "the cloud",
    "up_direction": "the up direction",
    "scale": "the scale",
    "settings": "the settings",
    "settings.ground": "the ground settings",
    "settings.trunks": "the trunk settings",
    "settings.measure": "the measurement settings",
    "trunks": "the trunks",
    "trees": "what is said about the trees",
    "north_direction": "the direction of north",
    "origin_src": "the plot's origin",
    "evidence": "the known lengths",
    "cameras": "the photos",
    "masks": "the masks the trunks were found by",
}
_ALL_FIELDS = tuple(name for name in _FIELDS if "." not in name)


def check_scale(scale: ScaleEstimate, name: str, *, is_geographic: bool = False) -> None:
    """Raise SettingError where the cloud called `name` cannot have this scale: before it overflows what follows."""
    if not scale.is_known:
        return
    if is_geographic:
        raise SettingError(
            f"The coordinates of {name} are degrees of longitude and latitude, which no scale turns into metres.",
            "Convert the cloud to a projected system (UTM, or the national grid) first.",
        )
    if not _LEAST_SCALE <= scale.metres_per_unit <= _MOST_SCALE:
        raise SettingError(
            f"{scale.metres_per_unit:g} metres per unit is beyond reason.",
            f"Give {_LEAST_SCALE:g} to {_MOST_SCALE:,.0f} metres per unit, or the name of a unit such as metres.",
        )


def _field(document: Document, name: str) -> Any:
    value: Any = document
    for part in name.split("."):
        value = getattr(value, part)
    return value


def check_fresh(then: Document, now: Document, reads: Iterable[str]) -> None:
    """Raise StaleResultError where a field of `reads`, or any if it names none, is no longer what it was."""
    for name in tuple(reads) or _ALL_FIELDS:
        if name not in _FIELDS:
            raise ValueError(f"{name!r} is not a field of a Document")
        value_then, value_now = _field(then, name), _field(now, name)
        if value_then is not value_now and value_then != value_now:
            raise StaleResultError(
                f"While the work ran, {_FIELDS[name]} changed, so its result no longer fits and was not used.",
                "Start it again.",
            )
