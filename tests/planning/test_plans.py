"""What is settled before a reconstruction begins, and from where."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from kalux import PRESETS, Frame, Recording, reconstruct
from kalux.errors import FrameError, InputError, SettingsError
from kalux.events import EVENT_DTYPE
from kalux.pipeline import execute
from kalux.planning import plan
from kalux.settings import altered

from builders import events, frame, moving_blocks, recording, unlabelled


@pytest.mark.parametrize(
    ("first", "options", "message"),
    [
        ("night.aedat4", {}, "recording is a str; a kalux.Recording is needed, from kalux.open"),
        (None, {}, "recording is a NoneType; a kalux.Recording is needed"),
        (
            recording,
            {"settings": {"filter": {"kind": "cf"}}},
            "settings is a dict; a kalux.Settings is needed",
        ),
        (recording, {"calibration": "c.toml"}, "calibration is a str; a kalux.Calibration is needed"),
    ],
)
def test_arguments_of_the_wrong_type_are_named(first, options, message):
    with pytest.raises(InputError, match=message):
        reconstruct(first() if callable(first) else first, rate_hz=10, **options)


@pytest.mark.parametrize(("bright_tail", "less"), [(0.3, True), (1.0, False)])
def test_highlights_are_believed_less_where_the_threshold_is_an_estimate(bright_tail, less):
    """The same numbers, known and estimated; but not less where frames show that the scene goes on beyond white."""
    simulation = moving_blocks(0.1, 4.0)
    settings = altered(PRESETS["default"], "filter", bright_tail=bright_tail)
    guessed = plan(unlabelled(simulation), at="frames", settings=settings)
    known = plan(unlabelled(simulation), at="frames", settings=guessed.settings)
    assert (guessed.threshold_origin, known.threshold_origin) == ("estimate", "settings")
    sums = []
    for made in (guessed, known):
        images = [image.intensity for image in execute(unlabelled(simulation), made)]
        sums.append(sum(image[image > 1].sum() for image in images))
    assert sums[0] < sums[1] if less else sums[0] == sums[1]


def test_white_is_the_median_exposure_unless_set():
    frames = [frame(100, 40_000 * k, 40_000 * k + e) for k, e in enumerate((2_000, 8_000, 4_000))]
    rec = Recording.from_arrays(events(), frames, sensor_size=(1, 1), contrast_threshold=0.2)
    assert plan(rec, at="frames").settings.camera.reference_exposure == 4_000
    images = list(reconstruct(rec, at="frames"))
    found = [image.intensity[0, 0] for image in images]
    np.testing.assert_allclose(found, np.array([2.0, 0.5, 1.0]) * 100 / 255, rtol=0.1)
    doubled = altered(PRESETS["default"], "camera", reference_exposure=8_000)
    twice = [image.intensity[0, 0] for image in reconstruct(rec, at="frames", settings=doubled)]
    assert twice[1] == pytest.approx(100 / 255, rel=0.1)


def test_a_recording_without_frames():
    rec = Recording.from_arrays(events((1, 0, 0, 1)), [], sensor_size=(1, 1), name="dark.aedat4")
    with pytest.raises(
        FrameError,
        match=r"dark\.aedat4: no frames; kalux needs frames .* join images or a video with --frames",
    ):
        reconstruct(rec, rate_hz=10)


def test_a_recording_without_events():
    frames = [frame(100, 40_000 * k, 40_000 * k + 4_000) for k in range(3)]
    rec = Recording.from_arrays(events(), frames, sensor_size=(1, 1))
    for image in reconstruct(rec, rate_hz=100):
        assert image.intensity[0, 0] == pytest.approx(100 / 255, rel=1e-4)


def test_unknown_preset():
    with pytest.raises(SettingsError, match="unknown preset 'iccv'"):
        reconstruct(recording(), rate_hz=10, preset="iccv")


def test_highlights_are_believed_less_where_thresholds_are_estimated():
    """A pixel that events take beyond white: by a prior of the tail's scale, rather than 1.5."""
    frames = [Frame(np.full((4, 4), 200, np.uint8), t, t + 1000) for t in (0, 50_000)]
    rise = np.zeros(8, EVENT_DTYPE)
    rise["t"], rise["p"] = np.arange(60_000, 68_000, 1000), True
    with pytest.warns(UserWarning, match="none of the 8 events lies between"):
        source = Recording.from_arrays(rise, frames, sensor_size=(4, 4))
    stated = altered(PRESETS["default"], "events", threshold_on=0.2, threshold_off=0.2)
    seen = []
    for origin in ("settings", "estimate"):
        chosen = dataclasses.replace(plan(source, times=[67_000], settings=stated), threshold_origin=origin)
        (image,) = execute(source, chosen)
        seen.append(image.intensity[0, 0])
    assert seen[0] > seen[1] > 1
