"""Events' steps: by what is stated, unless frames contradict it, else by an estimate, else by what is usual."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import kalux
from kalux import PRESETS, Recording, reconstruct
from kalux.planning import plan
from kalux.settings import altered

from builders import events, frame, moving_blocks, recording, unlabelled


def test_thresholds_of_the_settings_come_first():
    chosen = altered(PRESETS["default"], "events", threshold_on=0.31, threshold_off=0.32)
    made = plan(recording(), rate_hz=10, settings=chosen, preset="cf")
    assert made.threshold_origin == "settings"
    assert made.steps.thresholds is None
    assert (made.settings.events.threshold_on, made.settings.events.threshold_off) == (0.31, 0.32)
    assert made.settings.filter.kind == "akf"


def test_then_those_of_the_recording():
    made = plan(recording(), rate_hz=10)
    assert made.threshold_origin == "recording"
    assert (made.settings.events.threshold_on, made.settings.events.threshold_off) == (0.25, 0.2)
    half = plan(recording(), rate_hz=10, settings=altered(PRESETS["default"], "events", threshold_on=0.4))
    assert (half.settings.events.threshold_on, half.settings.events.threshold_off) == (0.4, 0.2)


def stating(simulation, *, times=1.0, aside=0):
    """A recording that states ``times`` the true thresholds, and whose frames are some columns aside."""
    made = simulation.recording()
    frames = [
        dataclasses.replace(shown, image=np.roll(shown.image, aside, axis=1)) for shown in simulation.frames
    ]
    on, off = made.contrast_threshold
    return Recording.from_arrays(
        simulation.events,
        frames,
        sensor_size=made.sensor_size,
        contrast_threshold=(times * on, times * off),
    )


@pytest.mark.parametrize("times", [0.6, 1.0, 1.4])
def test_unless_its_frames_contradict_them(times):
    made = plan(stating(moving_blocks(0.08, 0.9), times=times), rate_hz=10)
    assert made.threshold_origin == ("recording" if times == 1.0 else "estimate")
    assert made.steps.contradicted == (None if times == 1.0 else (0.2 * times, 0.2 * times))
    assert made.settings.events.threshold_on == pytest.approx(0.2, rel=0.12)
    assert made.settings.events.threshold_off == pytest.approx(0.2, rel=0.12)
    assert made.settings.events.extrapolation_gain == 1.0
    assert made.settings.events.extrapolation_trust == 1.0


def test_thresholds_of_the_settings_are_kept_but_believed_less_beyond_white():
    chosen = altered(PRESETS["default"], "events", threshold_on=0.3, threshold_off=0.3)
    made = plan(stating(moving_blocks(0.08, 0.9)), rate_hz=10, settings=chosen)
    assert (made.threshold_origin, made.settings.events.threshold_on) == ("settings", 0.3)
    assert made.steps.model.agreement.contradicts_thresholds
    assert made.settings.events.extrapolation_gain == pytest.approx(0.67 / 0.88, rel=0.1)
    given = plan(
        stating(moving_blocks(0.08, 0.9)),
        rate_hz=10,
        settings=altered(chosen, "events", extrapolation_gain=0.4, extrapolation_trust=0.2),
    )
    assert given.settings.events.extrapolation_gain == 0.4
    assert given.settings.events.extrapolation_trust == 0.2


def test_frames_beside_the_events_change_no_thresholds():
    """Estimated ones explain such frames no better than those that are stated."""
    made = plan(stating(moving_blocks(0.08, 0.9), aside=6), rate_hz=10)
    assert (made.threshold_origin, made.steps.contradicted) == ("recording", None)
    assert made.steps.model.agreement.explained < 0.5
    assert made.settings.events.extrapolation_gain < 0.7
    assert made.settings.events.extrapolation_trust == 0.0


def test_far_highlights_are_believed_in_causal_mode_if_asked_for():
    seen = stating(moving_blocks(0.08, 0.9))
    assert plan(seen, rate_hz=10, lookahead=False).settings.events.extrapolation_trust == 0.0
    chosen = altered(PRESETS["default"], "events", extrapolation_trust=0.5)
    asked = plan(seen, rate_hz=10, lookahead=False, settings=chosen)
    assert asked.settings.events.extrapolation_trust == 0.5


def test_then_an_estimate():
    made = plan(unlabelled(moving_blocks(0.08, 0.9)), rate_hz=10)
    assert made.threshold_origin == "estimate"
    assert made.settings.events.threshold_on == made.steps.thresholds.on == pytest.approx(0.2, rel=0.12)
    assert made.settings.events.threshold_off == made.steps.thresholds.off == pytest.approx(0.2, rel=0.12)


def test_and_last_an_assumption():
    made = plan(recording(0, None), rate_hz=10)
    assert made.threshold_origin == "assumed"
    assert made.steps.thresholds is None
    assert made.settings.events.threshold_on == made.settings.events.threshold_off == 0.25
    assert (made.settings.events.threshold_spread, made.settings.events.delay) == (0.5, 0)


def test_of_a_sensor_the_usual_is_assumed():
    """One frame tells no threshold, no delay and no step."""
    frames = [frame(100, 0, 10_000)]
    alone = Recording.from_arrays(events(), frames, sensor_size=(1, 1))
    made = plan(alone, at="frames", preset="davis346")
    usual = PRESETS["davis346"].events
    found = made.settings.events
    assert made.threshold_origin == "assumed"
    assert (found.threshold_on, found.threshold_off) == (usual.usual_threshold_on, usual.usual_threshold_off)
    assert (found.delay, found.step_variance) == (usual.usual_delay, usual.usual_step_variance)
    assert found.threshold_spread == 0.2


def test_a_sensors_usual_thresholds_give_way_to_the_recordings():
    known = plan(recording(), at="frames", preset="davis346")
    assert known.threshold_origin == "recording"
    assert (known.settings.events.threshold_on, known.settings.events.threshold_off) == (0.25, 0.2)
    told = plan(unlabelled(moving_blocks(0.08, 0.9)), at="frames", preset="davis240c")
    assert told.threshold_origin == "estimate"
    assert told.settings.events.threshold_on == pytest.approx(0.2, rel=0.12)


@pytest.mark.parametrize(
    ("name", "preset", "part"),
    [("newton_davis346.aedat4", "davis346", 0.6), ("slider_depth", "davis240c", 1.05)],
)
def test_a_sensors_preset_helps_where_there_is_one_frame(shared_data, name, preset, part):
    """The next frame is nearer to what is made of the frame before it and of the events."""
    unknown = {} if "aedat4" in name else {"exposure": 10_000}
    whole = kalux.open(shared_data / name, **unknown)
    shown, wanted = list(whole.frames())[2:4]
    near = [e[(e["t"] >= shown.exposure_start) & (e["t"] <= wanted.exposure_end)] for e in whole.events()]
    alone = Recording.from_arrays(np.concatenate(near), [shown], sensor_size=whole.sensor_size)

    def error(preset: str) -> float:
        (image,) = reconstruct(alone, times=[wanted.middle], preset=preset)
        return float(np.mean((image.intensity - wanted.normalised()) ** 2))

    assert error(preset) < part * error("default")
