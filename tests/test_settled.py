"""What a reconstruction settles: what is given, what is measured, and what is only usual."""

from __future__ import annotations

from kalux import PRESETS, Recording
from kalux.planning import plan
from kalux.settings import from_dict
from kalux.settled import settled

from builders import moving_blocks


def rows_of(recording, **groups):
    asked = from_dict(groups, PRESETS["default"])
    return dict(settled(recording, plan(recording, at="frames", settings=asked), asked))


def test_what_the_settings_state_is_given():
    rows = rows_of(
        moving_blocks().recording(),
        camera={"log_offset": 0.02, "frame_noise": 0.01, "reference_exposure": 5_000, "response": "srgb"},
        events={"threshold_on": 0.3, "threshold_off": 0.4, "delay": 700, "step_variance": 0.2},
    )
    for label in ("thresholds", "delay", "I_0", "step", "exposure", "noise", "response"):
        assert rows[label].endswith("(given)"), label
    assert rows["delay"].startswith("events 0.7 ms late")


def test_what_a_recording_without_events_does_not_tell_is_the_usual():
    simulation = moving_blocks()
    silent = Recording.from_arrays(
        simulation.events[:0], simulation.frames, sensor_size=simulation.scene.sensor_size
    )
    rows = rows_of(silent)
    for label in ("thresholds", "delay", "I_0", "step", "spread", "background"):
        assert "usual" in rows[label], (label, rows[label])
    assert rows["exposure"].endswith("(median of the frames)")
