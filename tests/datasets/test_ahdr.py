"""Artificial HDR: what the artificial camera sees, the truth in its units, frames held out."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import kalux
from kalux.datasets.ahdr import ArtificialCamera, artificial_hdr
from kalux.errors import FrameError, InputError, SettingsError
from kalux.evaluation.baselines import methods
from kalux.evaluation.truth import evaluate_truth, prepare_reference
from kalux.models.camera import Response
from kalux.models.colour import luminance
from kalux.recording import Recording
from kalux.writers import hdf5

from builders import colour_blocks, frame, moving_blocks

LEVELS = np.arange(256, dtype=np.uint8).reshape(16, 16)


def recording_of(images, exposures=None):
    exposures = exposures or [1000] * len(images)
    frames = [
        frame(i, 10_000 * k, 10_000 * k + e) for k, (i, e) in enumerate(zip(images, exposures, strict=True))
    ]
    return kalux.Recording.from_arrays(np.empty(0, kalux.EVENT_DTYPE), frames, sensor_size=images[0].shape)


@pytest.mark.parametrize("cut", [30, 50, 80, 100, 115])  # of the published data
def test_ends_are_cut_and_the_rest_is_what_it_was(cut):
    """Below the cut black, above 255 - cut white; between, the stated response gives back the original."""
    found = artificial_hdr(recording_of([LEVELS] * 3), ArtificialCamera.with_cut(cut))
    image = next(iter(found.frames())).image
    assert (image[cut >= LEVELS] == 0).all()
    assert (image[255 - cut <= LEVELS] == 255).all()
    assert (np.diff(image.ravel().astype(int)) >= 0).all()
    inner = (image > 10) & (image < 245)
    back = Response.named(found.response).inverse(image / 255.0)[inner] * (255 - cut)
    assert np.abs(back - LEVELS[inner]).max() < 0.7
    assert inner.sum() > 0.6 * (255 - 2 * cut)


def test_the_truth_is_the_original_in_units_of_artificial_white():
    exposures = [1000, 2000, 1000]
    camera = ArtificialCamera(20 / 255, 100 / 255)
    truth = artificial_hdr(recording_of([LEVELS] * 3, exposures), camera).ground_truth()
    assert truth.times.tolist() == [500, 11_000, 20_500]
    for image, exposure in zip(truth.images, exposures, strict=True):
        assert np.allclose(image, LEVELS / 100 * (1000 / exposure), rtol=1e-5)
    assert np.array_equal(truth.masks[0], LEVELS / 255 < 0.98)
    lower = artificial_hdr(recording_of([LEVELS] * 3), camera, saturation=112 / 255).ground_truth()
    assert np.array_equal(lower.masks[0], LEVELS < 112)


def test_black_and_the_real_response_are_taken_off():
    camera = ArtificialCamera(0.1, 0.5)
    found = artificial_hdr(recording_of([LEVELS] * 2), camera, response="gamma:2", black=14 / 255)
    expected = np.maximum((LEVELS - 14.0) / 241, 0) ** 2 / 0.5
    assert np.allclose(found.ground_truth().images[0], expected, atol=2e-3)


def test_black_and_gain_that_frames_state_are_taken_off_once():
    camera = ArtificialCamera(0.0, 1.0)
    stated = [
        dataclasses.replace(frame(LEVELS, 10_000 * k, 10_000 * k + 1000), black=14.0, gain=gain)
        for k, gain in enumerate([1.0, 2.0])
    ]
    source = kalux.Recording.from_arrays(np.empty(0, kalux.EVENT_DTYPE), stated, sensor_size=LEVELS.shape)
    found = artificial_hdr(source, camera)
    seen = np.clip((LEVELS - 14.0) / 241, 0, 1)
    for one, truth, gain in zip(found.frames(), found.ground_truth().images, [1.0, 2.0], strict=True):
        assert (one.black, one.gain) == (0.0, gain)
        back = Response.named(found.response).inverse(one.normalised())
        steep = (seen > 0.1) & (seen < 0.85)  # where a level is little light
        assert np.allclose(back[steep], seen[steep], atol=0.005)
        assert np.allclose(truth, seen / gain, atol=1e-6)


def test_held_out_frames_are_the_truth_alone():
    found = artificial_hdr(recording_of([LEVELS] * 7), ArtificialCamera.with_cut(50), every=3)
    assert [f.exposure_start for f in found.frames()] == [0, 10_000, 30_000, 40_000, 60_000]
    assert len(found.frames()) == 5
    assert found.ground_truth().times.tolist() == [20_500, 50_500]


@pytest.fixture(scope="module")
def simulation():
    return moving_blocks(high=0.9)


def test_a_recording_is_evaluated_as_it_is_written(simulation, tmp_path):
    """The response is in the file: the defaults reconstruct and compare in the right units."""
    found = artificial_hdr(simulation.recording(), ArtificialCamera(0.02, 0.3))
    truth = found.ground_truth()
    assert truth.images.max() > 2
    hdf5.write(
        tmp_path / "a.h5",
        sensor_size=found.sensor_size,
        events=found.events(),
        frames=found.frames(),
        contrast_threshold=found.contrast_threshold,
        ground_truth=truth,
        response=found.response,
    )
    again = kalux.open(tmp_path / "a.h5")
    assert again.response == found.response == "s-curve:0.06666666666666667"
    reference = prepare_reference(again, again.ground_truth())
    scores = {name: evaluate_truth(again, reference, methods()[name]) for name in ("hold", "default")}
    linear = evaluate_truth(again, reference, methods("linear")["default"])
    assert scores["default"].mse < 0.5 * scores["hold"].mse
    assert scores["default"].log_mse < 0.5 * linear.log_mse


def test_held_frames_are_perfect_where_they_are_not_clipped(simulation):
    found = artificial_hdr(simulation.recording(), ArtificialCamera(0.0, 1.0))
    scores = evaluate_truth(found, prepare_reference(found, found.ground_truth()), methods()["hold"])
    assert scores.mse < 2e-4  # its S is flat at both ends: quantisation


@pytest.mark.parametrize("mosaic", [None, "RGGB"])
def test_colours_stay_and_the_truth_of_rgb_is_its_luminance(mosaic):
    _, made = colour_blocks(mosaic)
    found = artificial_hdr(made.recording(), ArtificialCamera(0.0, 0.5))
    assert [f.image.shape for f in found.frames()] == [f.image.shape for f in made.frames]
    assert {f.mosaic for f in found.frames()} == {found.mosaic} == {mosaic}
    truth, original = found.ground_truth(), made.frames[0].normalised()
    shown = original if mosaic else luminance(original)
    np.testing.assert_allclose(truth.images[0], shown / 0.5, rtol=1e-5)


def test_what_is_said_of_the_mosaic_is_kept():
    """Where the recording itself says nothing, or something else."""
    _, made = colour_blocks("RGGB")
    silent = [dataclasses.replace(frame, mosaic=None) for frame in made.frames]
    source = Recording.from_arrays(made.events, silent, sensor_size=made.scene.sensor_size).source
    found = artificial_hdr(Recording(source, mosaic="RGGB"), ArtificialCamera.with_cut(30))
    assert next(iter(found.frames())).mosaic == found.mosaic == "RGGB"


def test_what_a_frame_does_not_measure_is_no_truth():
    valid = np.ones(LEVELS.shape, bool)
    valid[0] = False
    recording = recording_of([LEVELS] * 3)
    frames = [dataclasses.replace(frame, valid=valid) for frame in recording.frames()]
    masked = Recording.from_arrays(np.empty(0, kalux.EVENT_DTYPE), frames, sensor_size=valid.shape)
    found = artificial_hdr(masked, ArtificialCamera.with_cut(30))
    assert not found.ground_truth().masks[:, 0].any()
    assert all((frame.valid == valid).all() for frame in found.frames())


def test_what_cannot_be():
    recording = recording_of([LEVELS] * 3)
    for bad in (lambda: ArtificialCamera.with_cut(128), lambda: ArtificialCamera(0.5, 0.4)):
        with pytest.raises(InputError, match="artificial camera"):
            bad()
    camera = ArtificialCamera.with_cut(30)
    with pytest.raises(InputError, match="every is 1"):
        artificial_hdr(recording, camera, every=1)
    with pytest.raises(InputError, match=r"saturates at 1\.1"):
        artificial_hdr(recording, camera, saturation=1.1)
    with pytest.raises(InputError, match="black is 1"):
        artificial_hdr(recording, camera, black=1.0)
    with pytest.raises(FrameError, match="too few"):
        artificial_hdr(recording_of([LEVELS]), camera)
    with pytest.raises(FrameError, match="3 frames, too few to leave out every 4th"):
        artificial_hdr(recording, camera, every=4)
    with pytest.raises(FrameError, match="black"):
        artificial_hdr(recording_of([LEVELS * 0] * 3), camera)
    with pytest.raises(SettingsError, match="s-curve is black up to 1"):
        Response.s_curve(1.0)


def test_the_truth_has_the_noise_of_the_original_in_its_units():
    rng = np.random.default_rng(0)
    clean = np.broadcast_to(np.linspace(40, 120, 160), (120, 160))
    images = [np.rint(clean + 2 * rng.standard_normal(clean.shape)).astype(np.uint8) for _ in range(24)]
    camera = ArtificialCamera(20 / 255, 100 / 255)
    read, shot = artificial_hdr(recording_of(images), camera).ground_truth().noise
    assert np.sqrt(read**2 + shot * 0.8) == pytest.approx(2 / 100, rel=0.1)
    assert artificial_hdr(recording_of(images), camera, response="gamma:2").ground_truth().noise is None
