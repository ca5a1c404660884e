"""What every settings class is made of: a field with its unit, a strict frozen model, an error in plain words."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from dbh_studio.errors import SettingError


def setting(default: Any, title: str, *, unit: str = "", help: str = "", **bounds: Any) -> Any:
    """A pydantic field with the unit kept where the panels and the command line find it."""
    return Field(default, title=title, description=help, json_schema_extra={"unit": unit}, **bounds)


class SettingsModel(BaseModel):
    """Frozen, and strict about names: a misspelt setting is an error, not silence.

    Attributes:
        ascending: Pairs of fields of which the first must be the smaller.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)
    ascending: ClassVar[tuple[tuple[str, str], ...]] = ()

    @model_validator(mode="after")
    def _check_ascending(self) -> SettingsModel:
        fields = type(self).model_fields
        for low, high in self.ascending:
            if not getattr(self, low) < getattr(self, high):
                raise ValueError(
                    f"{fields[low].title} ({low}) is {getattr(self, low)} but must be less than "
                    f"{fields[high].title} ({high}), which is {getattr(self, high)}"
                )
        return self

    def changed(self, **values: Any) -> Any:
        """A copy with some fields changed and checked.

        Raises:
            SettingError: Names the setting, the value and the allowed range.
        """
        try:
            return type(self).model_validate({**self.model_dump(), **values})
        except ValidationError as error:
            raise setting_error(type(self), error) from None


def setting_error(model: type[BaseModel], error: ValidationError) -> SettingError:
    """The first problem of a pydantic error, in plain words."""
    first = error.errors()[0]
    if first["type"] == "value_error":  # of our own checks, which name the settings themselves
        return SettingError(f"{first['ctx']['error']}.")
    path = [str(part) for part in first["loc"]]
    owner: Any = model
    for part in path[:-1]:
        annotation = owner.model_fields[part].annotation if part in getattr(owner, "model_fields", {}) else None
        owner = annotation if annotation is not None else owner
    field = getattr(owner, "model_fields", {}).get(path[-1]) if path else None
    title = f"{field.title} ({'.'.join(path)})" if field is not None and field.title else ".".join(path)
    return SettingError(f"{title}: {first['msg']}.", f"The value given was {first.get('input')!r}.")
