"""Settings: the paper's numbers, TOML there and back, and errors that name what is wrong."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from kalux import PRESETS, Reconstructor, Settings, preset, reconstruct
from kalux.datasets import SensorSettings
from kalux.errors import InputError, KaluxError, SettingsError
from kalux.settings import (
    _USED_BY,
    CameraSettings,
    EventSettings,
    FilterSettings,
    altered,
    completed,
    from_dict,
    load,
    to_dict,
    without_effect,
)

from builders import moving_blocks, unlabelled

DEFAULT = PRESETS["default"]
GROUPS = {"camera": CameraSettings, "events": EventSettings, "filter": FilterSettings}
NUMBERS = [
    (group, field.name)
    for group, kind in GROUPS.items()
    for field in dataclasses.fields(kind)
    if not isinstance(field.default, (str, bool))
]


# --- presets --------------------------------------------------------------------------------------------


def test_presets():
    sensors = ["davis240c", "davis346", "prophesee-flir"]
    assert list(PRESETS) == ["default", *sensors, "iccv2021", "iccv2021-flir", "cf"]
    assert all(preset(name) is PRESETS[name] for name in PRESETS)
    assert preset("default") == Settings()


def test_the_papers_numbers():
    """Section 5 of the paper; what it leaves open from the released code."""
    paper = preset("iccv2021")
    assert paper.events.sigma_proc2 == 0.0005
    assert paper.events.sigma_iso2 == 0.03
    assert paper.events.sigma_ref2 == 0.01
    assert paper.events.refractory_bound == 0.010
    assert paper.camera.confidence == 7e5
    assert paper.camera.log_offset == 1.0
    assert paper.camera.weight_floor == 0.09
    assert paper.filter.initial_variance == 0.09
    assert paper.filter.kind == "akf"
    assert paper.filter.augmentation == "paper"
    assert paper.filter.solution == "printed"
    assert paper.filter.deblur is True
    assert paper.filter.highlight_scale == 0.0


def test_flir_differs_in_its_confidence_only():
    flir = preset("iccv2021-flir")
    assert flir.camera.confidence == 7e7
    assert altered(flir, "camera", confidence=7e5) == preset("iccv2021")


def test_complementary_preset():
    """Held frames, as published: no deblurring, and no prior, since it has no covariance."""
    cf = preset("cf")
    assert (cf.filter.kind, cf.filter.cutoff, cf.filter.deblur) == ("cf", 1.0, False)
    assert cf.filter.highlight_scale == 0.0


@pytest.mark.parametrize("name", ["davis240c", "davis346", "prophesee-flir"])
def test_sensors_leave_what_a_recording_tells_to_the_recording(name):
    """They are the default but for what is usual, and for what nobody estimates."""
    chosen = preset(name)
    events, camera = chosen.events, chosen.camera
    assert events.threshold_on is events.threshold_off is events.delay is events.step_variance is None
    assert events.threshold_spread is events.noise_rate is None
    assert camera.log_offset is camera.reference_exposure is None
    assert camera.response == "auto"
    usual = {entry.name: entry.default for entry in dataclasses.fields(events) if "usual" in entry.name}
    same = altered(chosen, "events", **usual)
    assert altered(same, "camera", usual_frame_noise=0.006) == DEFAULT


def test_thresholds_of_davis_sensors_are_above_the_least_they_can_be_set_to():
    """11 %, and 14.3 and 22.5 % of contrast: Gallego et al., TPAMI 2022, Table 1."""
    small, large = preset("davis240c").events, preset("davis346").events
    assert min(small.usual_threshold_on, small.usual_threshold_off) > np.log(1.11)
    assert large.usual_threshold_on > np.log(1.143)
    assert large.usual_threshold_off > np.log(1.225)


def test_frame_noise_of_the_flir():
    """Read and photon noise at half of white of the IMX265, averaged over the pixels that become one."""
    electrons = np.hypot(2.3, np.sqrt(10_400 / 2))
    pixels = (2048 / 640) ** 2
    assert preset("prophesee-flir").camera.usual_frame_noise == pytest.approx(
        electrons / 10_400 / np.sqrt(pixels), rel=0.02
    )


def test_estimated_thresholds_are_doubted_beyond_white_as_far_as_a_recording_tells():
    """As in a live stream where it tells nothing; no more than the usual spread, since pixels tell the rest."""
    spreads = (0.02, 0.1, None, 0.5)
    found = [altered(PRESETS["default"], "events", threshold_spread=spread).events for spread in spreads]
    assert [events.believed_extrapolation for events in found] == [0.02, 0.1, 0.15, 0.1]


def test_what_is_usual_is_assumed_where_nothing_is_set():
    events = EventSettings(usual_threshold_on=0.3, usual_threshold_off=0.4, usual_spread=0.2, usual_delay=-7)
    assumed = events.assuming()
    assert (assumed.threshold_on, assumed.threshold_off, assumed.threshold_spread) == (0.3, 0.4, 0.2)
    half = dataclasses.replace(events, threshold_on=0.25, threshold_spread=0.5).assuming()
    assert (half.threshold_on, half.threshold_off, half.threshold_spread) == (0.25, 0.4, 0.5)
    known = dataclasses.replace(events, threshold_on=0.25, threshold_off=0.2)
    assert known.assuming() is known
    assert (events.lateness, dataclasses.replace(events, delay=0).lateness) == (-7, 0)


def test_unknown_preset():
    with pytest.raises(
        SettingsError,
        match=r"'iccv2022', did you mean iccv2021.; known are default, davis240c, .*, iccv2021, iccv2021-flir, cf",
    ):
        preset("iccv2022")
    for name in (None, 3, ["cf"]):
        with pytest.raises(SettingsError, match="unknown preset"):
            preset(name)


def test_a_preset_that_is_nearly_right_is_named():
    with pytest.raises(SettingsError, match="did you mean davis346"):
        preset("davis364")


def test_files_that_are_no_text_are_refused(tmp_path):
    (tmp_path / "bytes").write_bytes(b"[camera]\n\xff")
    for name, told in (
        ("bytes", "byte 9 is not UTF-8 text"),
        ("absent", "cannot be read: No such file"),
        (".", "Is a"),
    ):
        with pytest.raises(SettingsError, match=told):
            load(tmp_path / name, DEFAULT)


def test_settings_cannot_be_changed_in_place():
    with pytest.raises(dataclasses.FrozenInstanceError):
        preset("default").camera.log_offset = 0.5


# --- TOML -----------------------------------------------------------------------------------------------


def through_toml(settings, path, base=DEFAULT):
    path.write_text(tomli_w.dumps(to_dict(settings)), encoding="utf-8")
    return load(path, base)


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("base", PRESETS)
def test_a_file_holds_all_settings_whatever_the_base(name, base, tmp_path):
    assert through_toml(preset(name), tmp_path / "kalux.toml", preset(base)) == preset(name)


@given(
    offset=st.floats(1e-6, 10.0),
    threshold=st.none() | st.floats(0.01, 1.0),
    exposure=st.none() | st.integers(1, 10**7),
    deblur=st.booleans(),
    kind=st.sampled_from(["akf", "cf"]),
)
def test_round_trip(tmp_path_factory, offset, threshold, exposure, deblur, kind):
    changed = altered(DEFAULT, "camera", log_offset=offset, reference_exposure=exposure)
    changed = altered(changed, "events", threshold_on=threshold)
    changed = altered(changed, "filter", deblur=deblur, kind=kind)
    assert through_toml(changed, tmp_path_factory.getbasetemp() / "round_trip.toml") == changed


def test_what_is_not_said_stays(tmp_path):
    path = tmp_path / "few.toml"
    path.write_text("[camera]\nlog_offset = 0.25\n[filter]\nkind = 'cf'\n")
    base = altered(preset("iccv2021"), "events", threshold_on=0.3)
    expected = altered(altered(base, "camera", log_offset=0.25), "filter", kind="cf")
    assert load(path, base) == expected


def test_an_outputs_settings_tables_are_used(tmp_path):
    path = tmp_path / "kalux.toml"
    path.write_text("version = '0.1.0'\n[recording]\npath = 'x'\n[settings.events]\nnoise_rate = 7\n")
    assert load(path, DEFAULT) == altered(DEFAULT, "events", noise_rate=7)


def test_what_is_open_is_completed_and_what_is_stated_stays():
    stated = altered(DEFAULT, "events", threshold_on=0.3)
    found = completed(stated, "events", threshold_on=0.1, threshold_off=0.2)
    assert found == altered(stated, "events", threshold_off=0.2)
    with pytest.raises(SettingsError, match=r"events.noise_rate"):
        completed(DEFAULT, "events", noise_rate=-1.0)


def test_none_is_auto_in_files():
    """TOML has no None; left out, it could not undo the value of another preset."""
    assert to_dict(DEFAULT)["events"]["threshold_on"] == "auto"
    assert from_dict({"events": {"delay": "auto"}}, PRESETS["iccv2021"]).events.delay is None
    with pytest.raises(SettingsError, match=r"events.trail is 'auto'"):
        from_dict({"events": {"trail": "auto"}}, DEFAULT)
    assert to_dict(altered(DEFAULT, "events", threshold_on=0.3))["events"]["threshold_on"] == 0.3


# --- errors ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[sensor]\nx = 1", r"unknown group \[sensor\]; known are camera, events, filter"),
        ("camera = 3", "camera is not a table"),
        (
            "[camera]\nlog_ofset = 1",
            "setting camera.log_ofset, did you mean log_offset.; known are .*log_offset",
        ),
        ("[camera]\nlog-offset = 1", "camera.log-offset, did you mean log_offset"),
        ("[camera]\nbrightness = 1", "unknown setting camera.brightness; known are"),
        ("[camra]\nlog_offset = 1", r"unknown group \[camra\], did you mean camera"),
        ("log_offset = 1", r"log_offset is a setting of \[camera\] and has to follow that line"),
        ("preset = 'cf'", "a preset is given by --preset"),
        ("[camera]\nlog_offset = '1'", "camera.log_offset is '1'; a finite number is needed"),
        ("[camera]\nlog_offset = true", "camera.log_offset is True; a finite number is needed"),
        ("[camera]\nlog_offset = nan", "camera.log_offset is nan; a finite number is needed"),
        ("[camera]\nlog_offset = inf", "finite number is needed"),
        (f"[camera]\nlog_offset = {2**70}", "finite number is needed, at most 1000"),
        ("[camera]\nframe_noise = 1e-12", "frame_noise is 1e-12; 1e-09 is the least above 0"),
        ("[camera]\nconfidence = 1e11", "at most 1e[+]10"),
        ("[events]\ntrail = 11", "trail is 11; a finite number is needed, at most 10"),
        ("[events]\nthreshold_spread = 1e10", "at most 10"),
        ("[filter]\nhighlight_scale = 101", "at most 100"),
        ("[filter]\nhighlight_tail = 1e-300", "highlight_tail is 1e-300; 1e-12 is the least above 0"),
        (f"[camera]\nreference_exposure = {2**63}", "finite number is needed, at most 1e[+]18"),
        ("[events]\ndelay = -100000000", "at most 1e[+]07 us; kalux register brings clocks together"),
        ("[events]\nrefractory_period = 10000001", "at most 1e[+]07"),
        (
            "[camera]\nrow_time = -1000001",
            "row_time is -1000001; a finite number is needed, at most 1e[+]06$",
        ),
        ("[camera]\nlog_offset = 0", "camera.log_offset is 0; it must be positive"),
        ("[camera]\nlog_offset = -1", "camera.log_offset is -1; it must be positive"),
        ("[camera]\nresponse = 2.2", "camera.response is 2.2; str is needed"),
        ("[camera]\nsaturation = 1.01", "at most 1"),
        ("[camera]\nweight_floor = 1.01", "at most 1"),
        ("[camera]\nweight_floor = 0", "camera.weight_floor is 0; it must be positive"),  # f^w may be 0
        ("[events]\nnoise_rate = -0.1", "events.noise_rate is -0.1; it must be 0 or more"),
        ("[events]\nthreshold_on = 0.0", "events.threshold_on is 0.0; it must be positive"),
        ("[filter]\nkind = 'kf'", "filter.kind is 'kf'; it must be one of akf, cf"),
        ("[filter]\naugmentation = 1", "filter.augmentation is 1; it must be one of bridge, paper"),
        ("[filter]\nsolution = ''", "must be one of exact, printed"),
        ("[filter]\ndeblur = 1", "filter.deblur is 1; bool is needed"),
        ("[filter", "not valid TOML"),
        ("settings = 3", "settings"),
    ],
)
def test_errors_name_the_file_and_the_setting(text, message, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=message) as caught:
        load(path, DEFAULT)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(SettingsError, match="cannot be read"):
        load(tmp_path / "none.toml", DEFAULT)


@pytest.mark.parametrize(("group", "name"), NUMBERS)
@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf"), "0.1", True])
def test_every_number_is_checked(group, name, value):
    if (name, value) == ("row_time", -1.0):  # of a shutter that begins at the lowest row
        assert altered(DEFAULT, group, row_time=value).camera.row_time == value
        return
    with pytest.raises(SettingsError, match=f"{group}.{name}"):
        altered(DEFAULT, group, **{name: value})


def test_none_is_only_for_what_can_be_unknown():
    with pytest.raises(SettingsError, match=r"camera\.usual_frame_noise needs a number"):
        altered(DEFAULT, "camera", usual_frame_noise=None)


def test_from_dict_does_not_change_its_base():
    base = preset("default")
    from_dict({"camera": {"log_offset": 0.5}}, base)
    assert base.camera.log_offset is None


def test_settings_errors_are_input_errors():
    """So that one except clause, and exit code 2, serve them all."""
    assert issubclass(SettingsError, InputError)
    assert issubclass(SettingsError, KaluxError)
    assert issubclass(SettingsError, ValueError)


def test_a_response_that_does_not_exist_is_found_before_any_frame():
    with pytest.raises(SettingsError, match="unknown response 'log'"):
        Reconstructor((2, 2), settings=altered(DEFAULT, "camera", response="log"))


def test_every_setting_is_explained():
    text = (Path(__file__).parents[1] / "docs" / "tuning.md").read_text(encoding="utf-8")
    missing = [
        f"{group}.{field.name}"
        for group, kind in GROUPS.items()
        for field in dataclasses.fields(kind)
        if f"`{group}.{field.name}`" not in text
    ]
    assert missing == []


# --- settings of one filter -------------------------------------------------------------------------------

OTHER_VALUES = {
    "filter.cutoff": 3.0,
    "filter.solution": "exact",
    "filter.deblur": False,
    "filter.initial_variance": 0.3,
    "filter.highlight_scale": 0.5,
    "filter.highlight_tail": 1.0,
    "filter.unshown_tail": 0.1,
    "filter.unshown_scale": 3.0,
    "filter.dark_shares": "1 0 0 0 0 0 0 0 0 0",
    "filter.bright_tail": 0.1,
    "filter.neighbours": 0.05,
    "filter.motion": "off",
    "camera.fixed_pattern": 0.03,
    "camera.row_time": 150.0,
    "camera.confidence": 1e5,
    "camera.weight_floor": 0.9,
    "events.step_variance": 0.4,
    "events.dark_steps": "3 3 3 3 3 3",
    "events.lag_variance": 2.0,
    "events.refractory_period": 900,
    "events.refractory_spread": 0.5,
    "events.deblur_variance": 3.0,
    "events.noise_rate": 9.0,
    "events.extrapolation_spread": 0.9,
    "events.extrapolation_gain": 0.5,
    "events.extrapolation_trust": 0.1,
    "events.trail": 0.0,
    "events.sigma_proc2": 0.01,
    "events.sigma_iso2": 0.3,
    "events.sigma_ref2": 0.3,
    "events.refractory_bound": 0.1,
}


NEED_MORE = {
    "filter.motion",
    "filter.dark_shares",
    "camera.weight_floor",
    "events.extrapolation_spread",
    "events.refractory_spread",
}
"""Settings that change nothing of a recording of 24x32 pixels of blocks, nor without noise or losses."""


@pytest.fixture(scope="module")
def clipped():
    return unlabelled(
        moving_blocks(0.05, 3.0, sensor=SensorSettings(noise_rate=2.0), size=(24, 32), duration=300_000)
    )


@functools.cache
def images_of(recording, settings):
    images = list(reconstruct(recording, rate_hz=60, settings=settings))
    return np.array([image.intensity for image in images]), np.array([image.variance for image in images])


def test_every_setting_of_one_filter_is_tried():
    assert set(OTHER_VALUES) == set(_USED_BY)


@pytest.mark.parametrize("filter", ["default", "iccv2021", "cf"])
@pytest.mark.parametrize("key", OTHER_VALUES)
def test_settings_that_a_filter_does_not_use_change_nothing_and_others_do(clipped, filter, key):
    group, name = key.split(".")
    changed = altered(PRESETS[filter], group, **{name: OTHER_VALUES[key]})
    pairs = zip(images_of(clipped, PRESETS[filter]), images_of(clipped, changed), strict=True)
    same = all(np.array_equal(one, other) for one, other in pairs)
    if key in without_effect(PRESETS[filter], [key]):
        assert same
    elif key not in NEED_MORE:
        assert not same
