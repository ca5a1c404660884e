"""Settings: what one field alone cannot be checked for, and the words for it."""

from __future__ import annotations

import pytest

from dbh_studio.errors import SettingError
from dbh_studio.settings import EstimatorSettings, MeasureSettings, Settings, TrunkSettings


@pytest.mark.parametrize(
    ("settings", "values", "names"),
    [
        (TrunkSettings(), {"slab_low_m": 5.0, "slab_high_m": 1.0}, ("slab_low_m", "slab_high_m")),
        (TrunkSettings(), {"slab_low_m": 3.5}, ("slab_low_m", "slab_high_m")),
        (TrunkSettings(), {"slab_high_m": 1.0, "slab_low_m": 1.0}, ("slab_low_m", "slab_high_m")),
        (TrunkSettings(), {"min_diameter_cm": 100.0, "max_diameter_cm": 10.0}, ("min_diameter_cm", "max_diameter_cm")),
        (MeasureSettings(), {"max_diameter_cm": 10.0, "min_diameter_cm": 50.0}, ("min_diameter_cm", "max_diameter_cm")),
    ],
)
def test_bounds_the_wrong_way_round_name_both_settings(settings, values, names):
    with pytest.raises(SettingError) as caught:
        settings.changed(**values)
    for name in names:
        assert name in str(caught.value)
        assert type(settings).model_fields[name].title in str(caught.value)
    assert "{" not in str(caught.value)


def test_bounds_the_wrong_way_round_are_named_inside_all_settings_too():
    with pytest.raises(SettingError, match=r"slab_low_m.*slab_high_m"):
        Settings().changed(trunks={"slab_low_m": 5.0, "slab_high_m": 1.0})


def test_both_bounds_can_be_moved_past_the_old_ones_at_once():
    assert TrunkSettings().changed(slab_low_m=4.0, slab_high_m=6.0).slab_low_m == 4.0


def test_one_setting_out_of_its_own_bounds_is_still_named_alone():
    with pytest.raises(SettingError, match=r"Search from \(slab_low_m\)") as caught:
        TrunkSettings().changed(slab_low_m=50.0)
    assert "50" in caught.value.remedy


def test_a_plot_saved_before_there_were_intervals_keeps_its_method():
    """Every setting is in a saved plot: a new default changes no old number, and new settings take theirs."""
    new = ("max_half_width", "roundness", "bark_share", "bloat_chance")
    saved = {name: value for name, value in MeasureSettings().model_dump().items() if name not in new}
    saved |= {"curve": "fourier", "definition": "curve"}
    opened = Settings.model_validate({"measure": saved}).measure
    assert (opened.curve, opened.definition) == ("fourier", "curve")
    assert (MeasureSettings().curve, MeasureSettings().definition) == ("shrinkage", "tape")
    assert opened == MeasureSettings(curve="fourier", definition="curve")


def test_the_papers_way_in_one_word():
    paper = MeasureSettings.paper()
    assert (paper.curve, paper.definition, paper.ring_gate, paper.tolerance_share) == ("fourier", "curve", 0.0, 0.0)


def test_the_estimator_by_itself_expects_what_the_program_does() -> None:
    """What stands in both: a diameter by `estimate_diameter` is that of the studio."""
    alone, in_program = EstimatorSettings(), MeasureSettings()
    for name in set(type(alone).model_fields) & set(type(in_program).model_fields) - {"method", "axis", "definition"}:
        assert getattr(alone, name) == getattr(in_program, name), name
