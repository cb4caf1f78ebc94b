"""Settings fitted to held-out frames."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from kalux import PRESETS, Recording
from kalux.calibration.values import Calibration
from kalux.datasets import SensorSettings
from kalux.errors import InputError
from kalux.evaluation.fit import READS, _changed, fit_settings, score_settings
from kalux.evaluation.held_out import hold_out_frames
from kalux.settings import altered

from builders import colour_blocks, moving_blocks, unlabelled

SENSOR = SensorSettings(threshold_on=0.2, threshold_off=0.2, read_noise=0.01, threshold_mismatch=0.05)
WRONG = Calibration({"events": {"threshold_on": 0.3, "threshold_off": 0.3, "delay": 0}})


@pytest.fixture(scope="module")
def recording():
    return unlabelled(moving_blocks(0.05, 0.8, sensor=SENSOR, duration=600_000))


@pytest.fixture(scope="module")
def fit(recording):
    return fit_settings(recording, WRONG, evaluations=14)


def test_wrong_thresholds_are_mended_and_nothing_gets_worse(fit):
    assert fit.best.nll < fit.start.nll
    assert fit.best.mse <= fit.start.mse
    assert fit.settings["events"]["threshold_on"] < 0.27
    assert fit.evaluations <= 14


def test_the_result_scores_as_it_says(recording, fit):
    """And is the same again."""
    held = hold_out_frames(recording, reads=READS)
    settings = fit.calibration().apply(PRESETS["default"])
    reference = dataclasses.replace(settings.camera, reference_exposure=held.reference_exposure)
    again = score_settings(held, dataclasses.replace(settings, camera=reference))
    assert again == pytest.approx(fit.best)


def test_frame_noise_stays_above_rounding():
    """Likelihood may want less, of frames that hardly change: no frame has it."""
    settings = altered(PRESETS["default"], "camera", frame_noise=0.01, shot_noise=1e-4)
    changed = _changed(settings, {"camera.frame_noise": 1e-3}, 0.002)
    assert changed.camera.noise == pytest.approx((0.002, 4e-6))
    below = altered(settings, "camera", frame_noise=1e-3)
    assert _changed(below, {"camera.frame_noise": 0.5}, 0.002) == below


def test_one_evaluation_changes_nothing(recording):
    told = []
    found = fit_settings(recording, WRONG, evaluations=1, on_evaluation=lambda: told.append(1))
    assert found.best == found.start
    assert found.settings["events"]["threshold_on"] == 0.3
    assert len(told) == 1
    assert "nothing changed" in found.described()


def test_a_variance_that_is_far_off_is_less_likely(recording):
    """Likelihood judges the claimed variance, not only the image."""
    held = hold_out_frames(recording, reads=READS)
    good = altered(PRESETS["default"], "events", threshold_on=0.2, threshold_off=0.2, delay=0)
    timid = altered(good, "events", step_variance=20.0)
    assert score_settings(held, good).nll < score_settings(held, timid).nll
    assert np.isfinite(score_settings(held, timid).mse)


def test_frames_in_colour_are_scored_by_their_luminance():
    _, made = colour_blocks()
    found = score_settings(hold_out_frames(made.recording(), reads=READS), PRESETS["default"])
    assert np.isfinite(found.nll)
    assert found.mse < 0.01


def test_pixels_that_a_frame_does_not_measure_are_not_compared():
    """Whatever stands there in the frames that are held out."""
    made = moving_blocks(0.05, 0.8, sensor=SENSOR)
    valid = np.ones(made.scene.sensor_size, bool)
    valid[:, :9] = False
    frames = [dataclasses.replace(frame, valid=valid) for frame in made.frames]
    wrong = [dataclasses.replace(f, image=np.where(valid, f.image, 7)) for f in frames]
    scores = [
        score_settings(
            hold_out_frames(
                Recording.from_arrays(
                    made.events, shown, sensor_size=made.scene.sensor_size, contrast_threshold=0.2
                ),
                reads=READS,
            ),
            PRESETS["default"],
        )
        for shown in (frames, [b if i % 2 else a for i, (a, b) in enumerate(zip(frames, wrong, strict=True))])
    ]
    assert scores[0] == scores[1]


def test_no_evaluation_is_refused(recording):
    with pytest.raises(InputError, match="at least 1"):
        fit_settings(recording, evaluations=0)
