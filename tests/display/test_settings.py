"""Parameters out of range, and settings as a table."""

from __future__ import annotations

import pytest

from kalux.display import (
    CURVES,
    Auto,
    Clahe,
    DisplaySettings,
    Drago,
    Linear,
    Percentile,
    Reinhard,
    curve_from_name,
    settings_table,
)
from kalux.errors import SettingsError


@pytest.mark.parametrize(
    "make",
    [
        lambda: Linear(black=1, white=1),
        lambda: Linear(white=float("nan")),
        lambda: Percentile(low=50, high=50),
        lambda: Percentile(low=-1),
        lambda: Reinhard(key=0),
        lambda: Reinhard(key=1e-308),
        lambda: Reinhard(white=1e308),
        lambda: Reinhard(white=0),
        lambda: Drago(bias=0.5),
        lambda: Clahe(clip=0.5),
        lambda: Clahe(tiles=0),
        lambda: Auto(knee=1),
        lambda: Auto(lift=0.5),
        lambda: DisplaySettings(smoothing=-1),
        lambda: DisplaySettings(gamma=0),
        lambda: DisplaySettings(encoding="rec709"),
        lambda: DisplaySettings("auto"),
        lambda: curve_from_name("filmic"),
        lambda: curve_from_name("linear", knee=1),
    ],
)
def test_settings_out_of_range_are_refused(make):
    with pytest.raises(SettingsError):
        make()


@pytest.mark.parametrize("name", CURVES)
def test_settings_survive_a_table(name):
    table = settings_table(DisplaySettings(curve_from_name(name)))
    assert curve_from_name(table["curve"], **table[name]) == curve_from_name(name)
