"""What a reconstruction settles: what is given, what is measured, and what is only usual."""

from __future__ import annotations

import dataclasses
import re

import numpy as np

from kalux import PRESETS, Recording
from kalux.datasets import SensorSettings, simulate
from kalux.plan_report import plan_report
from kalux.planning import plan
from kalux.settings import altered, from_dict

from builders import all_given, dark_scene, moving_blocks, passing_by, textured


def rows_of(recording, **groups):
    asked = from_dict(groups, PRESETS["default"])
    return dict(plan_report(recording, plan(recording, at="frames", settings=asked), asked))


def test_what_the_settings_state_is_given():
    rows = rows_of(
        moving_blocks().recording(),
        camera={"log_offset": 0.02, "frame_noise": 0.01, "reference_exposure": 5_000, "response": "srgb"},
        events={"threshold_on": 0.3, "threshold_off": 0.4, "delay": 700, "step_variance": 0.2},
    )
    for label in ("thresholds", "delay", "I_0", "step", "exposure", "noise", "response"):
        assert rows[label].endswith("(given)"), label
    assert rows["delay"].startswith("events 0.7 ms late")


def test_says_where_frames_end():
    rows = rows_of(passing_by(textured(1.2), 102))
    told = r"from 0.4 of white \(frames end at 0.4, where events go on by \d+ %\)"
    assert re.fullmatch(told, rows["saturation"])
    deep = passing_by(textured(1.2), 255)
    frames = [
        dataclasses.replace(frame, image=np.minimum(frame.image.astype(np.uint16) * 17, 4095))
        for frame in deep.frames()
    ]
    rows = rows_of(
        Recording.from_arrays(np.concatenate(list(deep.events())), frames, sensor_size=deep.sensor_size)
    )
    assert rows["white"] == "4095, where the 16-bit frames end"
    assert "saturation" not in rows


def test_what_a_recording_without_events_does_not_tell_is_the_usual():
    simulation = moving_blocks()
    silent = Recording.from_arrays(
        simulation.events[:0], simulation.frames, sensor_size=simulation.scene.sensor_size
    )
    rows = rows_of(silent)
    for label in ("thresholds", "delay", "I_0", "step", "spread", "background"):
        assert "usual" in rows[label], (label, rows[label])
    assert rows["exposure"].endswith("(median of the frames)")


def test_says_what_is_wrong_with_frames_and_events():
    made = moving_blocks(0.02, 1.5, duration=1_000_000)
    frames = [dataclasses.replace(frame, image=frame.image.copy()) for frame in made.frames]
    frames[3].image[:] = frames[2].image
    for index, frame in enumerate(frames):
        frame.image[16, 20] = 0
        if index >= 12:
            frame.image[:] = frame.image // 2
    mirrored = made.events.copy()
    mirrored["x"] = 39 - mirrored["x"]
    rows = rows_of(Recording.from_arrays(mirrored, frames, sensor_size=(32, 40), name="wrong"))
    assert rows["left out"] == "1 frame, first frame 3: the same as the one before, though events show motion"
    assert rows["gain"].startswith(
        "the brightness of the frames steps at 1 frame, first at frame 12, by up to a factor"
    )
    assert rows["stuck"].startswith("1 pixel always the same though the light changes")
    assert re.fullmatch(
        r"events follow the frames if their x counts from the other side \(correlation 0.\d\d\): put right",
        rows["layout"],
    )


def test_says_how_far_events_are_believed_beyond_white():
    made = moving_blocks(0.08, 0.9)
    text = "events explain [0-9]+ % of how the frames change; where they say 1, frames change by [0-9.]+"
    assert re.fullmatch(text, rows_of(made.recording())["agreement"])
    doubted = rows_of(
        made.recording(), events={"extrapolation_gain": 0.8, "extrapolation_trust": 0.3, "step_variance": 0.2}
    )
    assert re.fullmatch(
        f"{text}: beyond white 80 % is believed, and far beyond it 30 %", doubted["agreement"]
    )


def test_says_what_is_known_of_pixels_that_no_frame_has_shown():
    """And by what, if it is not given; nothing where no frame clips any."""
    beyond = passing_by(textured(6.0))
    told = r"[12].* times as far beyond white as frames make expect \(told by pixels that leave .*: \d+ for \d+ .*\)"
    assert re.fullmatch(told, rows_of(beyond)["unshown"])
    given = rows_of(beyond, filter={"unshown_scale": 0.25})["unshown"]
    assert given == "0.25 times as far beyond white as frames make expect (given)"
    assert "unshown" not in rows_of(passing_by(textured(0.9)))


def test_whether_motion_is_followed():
    """By the sensor's size, as asked for, and both ways in time always; where it could be, as not in causal mode."""
    small = moving_blocks().recording()
    events, frames = np.concatenate(list(small.events())), list(small.frames())
    height, width = 400, 301
    large = Recording.from_arrays(
        events,
        [dataclasses.replace(frame, image=np.resize(frame.image, (height, width))) for frame in frames],
        sensor_size=(height, width),
    )

    def told(recording, motion="auto", **how):
        asked = altered(all_given(), "filter", motion=motion)
        made = plan(recording, at="frames", settings=asked, **how)
        return dict(plan_report(recording, made, asked)).get("motion")

    assert told(small) == "followed between frames (usual of sensors of this size)"
    assert told(small, "off") == "not followed between frames (given)"
    assert "--filter.motion on does" in told(large)
    assert told(large, "on") == "followed between frames (given)"
    assert told(large, smooth=True) == "followed between frames (as both ways in time always)"
    assert told(small, lookahead=False) is None


def test_says_how_far_a_refractory_period_that_frames_tell_may_be_wrong():
    """And nothing of one that is given."""
    sensor = SensorSettings(exposure=2_000, log_offset=0.004, refractory=2_000.0, noise_rate=0.0)
    lossy = simulate(dark_scene(), sensor, seed=1).recording()
    told = re.fullmatch(
        r"(\d\.\d+) ms \+- (\d+) % \(estimated from [\d,]+ samples\)", rows_of(lossy)["refractory"]
    )
    assert told is not None
    assert abs(float(told[1]) / 2 - 1) < 2 * float(told[2]) / 100 < 0.5
    assert rows_of(lossy, events={"refractory_period": 2_000})["refractory"] == "2 ms (given)"
