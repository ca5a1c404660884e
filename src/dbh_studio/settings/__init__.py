"""Every setting a person may change: title, unit, bounds, and why one would.

The fields build the panels, ``--help`` and the error text, so what they say is said once. Frozen: a change is a new
value.
"""

from __future__ import annotations

from typing import Literal, get_args, get_origin

from dbh_studio.settings.base import SettingsModel, setting, setting_error
from dbh_studio.settings.estimator import EstimatorSettings
from dbh_studio.settings.markers import MarkerSettings
from dbh_studio.settings.masks import MaskDetectorSettings, ModelRunSettings, VoteSettings
from dbh_studio.settings.measure import CurveName, HeightAlong, MeasureAbove, MeasureSettings, SlopeBase
from dbh_studio.settings.trunks import GroundSettings, TrunkSettings

__all__ = [
    "CurveName",
    "EstimatorSettings",
    "GroundSettings",
    "HeightAlong",
    "MarkerSettings",
    "MaskDetectorSettings",
    "MeasureAbove",
    "MeasureSettings",
    "ModelRunSettings",
    "Settings",
    "SettingsModel",
    "SlopeBase",
    "TrunkSettings",
    "VoteSettings",
    "describe_settings",
    "setting",
    "setting_error",
]


class Settings(SettingsModel):
    """All settings of a plot."""

    ground: GroundSettings = GroundSettings()
    trunks: TrunkSettings = TrunkSettings()
    measure: MeasureSettings = MeasureSettings()


def describe_settings() -> str:
    """Every setting on a line of its own: name, default, unit, bounds, and what it is."""
    lines = []
    for section, owner in Settings.model_fields.items():
        model = owner.annotation
        assert isinstance(model, type) and issubclass(model, SettingsModel)
        for name, field in model.model_fields.items():
            extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
            kinds = ("ge", "gt", "le", "lt")
            bounds = {key: getattr(rule, key) for rule in field.metadata for key in kinds if hasattr(rule, key)}
            lowest, highest = (bounds.get(a, bounds.get(b, "")) for a, b in (("ge", "gt"), ("le", "lt")))
            limits = f" [{lowest}..{highest}]" if bounds else ""
            choices = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
            limits += f" [{' | '.join(map(str, choices))}]" if choices else ""
            text = f"{field.title}{': ' + field.description if field.description else ''}"
            value = (
                f"{section}.{name} = {field.default}{' ' + str(extra.get('unit')) if extra.get('unit') else ''}{limits}"
            )
            lines.append(f"{value}\n    {text}")
    return "\n".join(lines)
