"""Inputs made from the settings models: titles, units, bounds and help are written once, in `settings`."""

from __future__ import annotations

import typing
from typing import Any, Generic, TypeVar

import viser

from dbh_studio.errors import SettingError
from dbh_studio.settings import SettingsModel
from dbh_studio.ui.panels.base import set_value

Model = TypeVar("Model", bound=SettingsModel)


class SettingsForm(Generic[Model]):
    """One input for each field of a settings model. Nothing takes effect until the form is read.

    A value that is half typed is not a decision, so the plot changes only when a button reads the whole form.
    """

    def __init__(self, gui: viser.GuiApi, values: Model, *, first: tuple[str, ...] = ()) -> None:
        """Add the inputs at the GUI's current place.

        Args:
            gui: The tab's GUI.
            values: The model to show.
            first: The fields most people want, in this order; the others are in a closed folder. All where empty.
        """
        self._values = values
        every = tuple(type(values).model_fields)
        self._handles = {name: _add_input(gui, values, name) for name in first or every}
        others = [name for name in every if name not in self._handles]
        if others:
            with gui.add_folder("More settings", expand_by_default=False):
                self._handles.update((name, _add_input(gui, values, name)) for name in others)

    def handle(self, name: str) -> Any:
        """The input of one field, for those that take effect at once."""
        return self._handles[name]

    def read(self) -> Model:
        """The model as the inputs say.

        Raises:
            SettingError: A value is outside its bounds; it says which one and what is allowed.
        """
        typed = {name: _typed(self._values, name, handle.value) for name, handle in self._handles.items()}
        changed: Model = self._values.changed(**typed)
        return changed

    def show(self, values: Model) -> None:
        """Bring the inputs in step with a changed model (undo, reopen, another tab).

        Where the model is as it was, what is being typed stays.
        """
        if values == self._values:
            return
        self._values = values
        for name, handle in self._handles.items():
            set_value(handle, _shown(getattr(values, name)))


def _add_input(gui: viser.GuiApi, values: SettingsModel, name: str) -> Any:
    field = type(values).model_fields[name]
    extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
    unit = str(extra.get("unit", ""))
    label = f"{field.title} ({unit})" if unit else str(field.title)
    value, hint = getattr(values, name), _hint(type(values), name, unit)
    if typing.get_origin(field.annotation) is typing.Literal:
        return gui.add_dropdown(label, typing.get_args(field.annotation), initial_value=value, hint=hint)
    if isinstance(value, bool):
        return gui.add_checkbox(label, value, hint=hint)
    if isinstance(value, (str, tuple)):
        return gui.add_text(label, _shown(value), hint=hint)
    low, high = bounds(type(values), name)
    step: Any = 1 if isinstance(value, int) else 0.01 if value < 10 else 0.5
    return gui.add_number(label, value, min=low, max=high, step=step, hint=hint)


def _shown(value: Any) -> Any:
    """A value as its input shows it: several numbers with commas between."""
    return ", ".join(f"{number:g}" for number in value) if isinstance(value, tuple) else value


def _typed(values: SettingsModel, name: str, text: Any) -> Any:
    """The value of a field from what its input holds; `_shown` backwards."""
    if not isinstance(getattr(values, name), tuple):
        return text
    try:
        return tuple(float(part) for part in str(text).replace(";", ",").split(",") if part.strip())
    except ValueError:
        title = type(values).model_fields[name].title
        raise SettingError(f"{title}: {text!r} is no list of numbers.", "Write them with commas between.") from None


def _hint(model: type[SettingsModel], name: str, unit: str) -> str | None:
    """What the setting is, and from where to where it goes."""
    low, high = bounds(model, name)
    limits = "" if low is None or high is None else f"{low:g} to {high:g} {unit}".rstrip()
    return "; ".join(text for text in (model.model_fields[name].description, limits) if text) or None


def bounds(model: type[SettingsModel], name: str) -> tuple[Any, Any]:
    """Lower and upper bound of a field, None where open."""
    low = high = None
    for rule in model.model_fields[name].metadata:
        low = getattr(rule, "ge", low)
        high = getattr(rule, "le", high)
    return low, high
