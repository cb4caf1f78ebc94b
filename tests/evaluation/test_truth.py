"""Ground truth: its order, span and mask, and what is refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import kalux
from kalux.errors import FormatError, InputError
from kalux.evaluation.baselines import methods
from kalux.evaluation.method import Estimated, Method
from kalux.evaluation.truth import evaluate_truth, lies_between_frames, load_truth, prepare_reference
from kalux.frames import GroundTruth

from builders import from_black, lifted, moving_blocks


@pytest.fixture(scope="module")
def simulation():
    return moving_blocks(high=2.0)


@pytest.fixture(scope="module")
def recording(simulation):
    return simulation.recording()


def perfect(simulation):
    return Method(
        "truth", lambda rec, times: (simulation.scene.at(float(t)).astype(np.float32) for t in times)
    )


def test_the_truth_itself_has_no_error(simulation, recording):
    scores = evaluate_truth(recording, prepare_reference(recording, simulation.truth()), perfect(simulation))
    assert scores.mse == scores.log_mse == 0
    assert scores.psnr == np.inf
    assert scores.ssim == pytest.approx(1)
    assert scores.pixels == len(scores.images) * 32 * 40
    assert scores.adjustments() == []
    assert scores.data_range == simulation.truth().images.max()


def test_scores_are_means_over_images(simulation, recording):
    truth = simulation.truth()
    scores = evaluate_truth(recording, prepare_reference(recording, truth), methods()["hold"])
    held = np.stack(list(methods()["hold"].images(recording, truth.times)))
    assert scores.mse == pytest.approx(np.mean((held.astype(float) - truth.images) ** 2))
    assert [image.t for image in scores.images] == truth.times.tolist()


def test_the_noise_of_a_truth_that_a_camera_took_is_no_error_and_what_was_given_is_not_counted(recording):
    """z is 1 with the noise of both; where the recording's own frame measures the truth, nothing is counted."""
    rng = np.random.default_rng(0)
    frames = list(recording.frames())
    times = np.array([frames[2].middle, frames[2].middle + 1, frames[3].middle], np.int64)
    size = recording.sensor_size
    shown = 0.5 + 0.02 * rng.standard_normal((3, *size))
    truth = GroundTruth(times, shown.astype(np.float32), noise=(0.02, 0.0))

    def estimates(_, times):
        for _ in times:
            made = 0.5 + 0.01 * rng.standard_normal(size)
            yield Estimated(made, np.full(size, (0.01 / 0.6) ** 2), 0.1)

    method = Method("knows", lambda recording, times: iter(()), estimates=estimates)
    found = evaluate_truth(recording, prepare_reference(recording, truth), method)
    assert found.uncertainty()["rms_z"] == pytest.approx(1.0, abs=0.06)
    clipped = sum(np.count_nonzero(frames[k].normalised() >= 0.98) for k in (2, 3))
    assert found.calibration["all"]["pixels"] == size[0] * size[1] + clipped
    assert found.pixels == 3 * size[0] * size[1]


def test_a_method_without_variance_needs_no_noise_of_a_truth_that_is_black(simulation, recording):
    """I_0 is 0 there, and the noise of a black pixel's logarithm has no end."""
    truth = dataclasses.replace(
        simulation.truth(), images=np.zeros_like(simulation.truth().images), noise=(0.02, 0.0)
    )
    truth.images[:, :2] = 1.0
    scores = evaluate_truth(recording, prepare_reference(recording, truth), methods()["hold"])
    assert scores.calibration is None


def test_images_may_come_in_any_order(simulation, recording):
    truth = simulation.truth()
    shuffled = np.random.default_rng(0).permutation(len(truth.times))
    reference = prepare_reference(recording, GroundTruth(truth.times[shuffled], truth.images[shuffled]))
    assert evaluate_truth(recording, reference, perfect(simulation)).mse == 0


def test_truth_lies_between_frames_if_no_frame_sees_the_scene_at_any_of_its_times(recording):
    frames = list(recording.frames())
    first, second = frames[:2]
    between = [first.exposure_end + 1, second.exposure_start - 1, frames[-1].exposure_end + 5]
    assert lies_between_frames(recording, np.array(between[::-1]))
    for t in (first.exposure_start, second.middle, frames[-1].exposure_end):
        assert not lies_between_frames(recording, np.array([*between, t]))


def test_images_before_and_after_the_frames_are_left_out_and_told(simulation, recording):
    ends = simulation.frames[0].middle, simulation.frames[-1].exposure_end
    times = np.array([0, ends[0] - 1, *ends, ends[1] + 1])
    reference = prepare_reference(recording, simulation.truth(times))
    assert reference.times.tolist() == list(ends)
    assert "3 more lie before" in reference.described()
    for method in methods().values():
        assert len(evaluate_truth(recording, reference, method).images) == 2


def test_masked_pixels_may_hold_anything(simulation, recording):
    truth = simulation.truth()
    images, mask = truth.images.copy(), np.ones(truth.images.shape[1:], bool)
    mask[:, :10], images[:, :, :10] = False, np.nan
    spoilt = GroundTruth(truth.times, images)
    with pytest.raises(InputError, match="not finite; mend or mask them"):
        prepare_reference(recording, spoilt)
    reference = prepare_reference(recording, spoilt, mask)
    hold = evaluate_truth(recording, reference, methods()["hold"], hdr_vdp=True)
    assert hold.images[0].pixels == 32 * 30
    assert "not compared" in hold.protocol
    whole = evaluate_truth(recording, prepare_reference(recording, truth), methods()["hold"])
    assert hold.mse != whole.mse
    right = evaluate_truth(recording, reference, perfect(simulation), hdr_vdp=True)
    assert (right.mse, right.q) == (0, pytest.approx(10))


def test_pixels_that_no_frame_sees_are_not_compared(simulation):
    """A pixel that one frame sees is: what events carry is the method's to know."""
    masks = np.ones((len(simulation.frames), 32, 40), bool)
    masks[:, :, 30:] = False
    masks[2, :, 30:35] = True
    frames = [dataclasses.replace(f, valid=m) for f, m in zip(simulation.frames, masks, strict=True)]
    recording = kalux.Recording.from_arrays(simulation.events, frames, sensor_size=(32, 40))
    reference = prepare_reference(recording, simulation.truth())
    assert reference.masks.sum() == len(reference.times) * 32 * 35
    assert not reference.masks[:, :, 35:].any()
    assert "that no frame sees" in reference.described()
    assert evaluate_truth(recording, reference, perfect(simulation)).mse == 0


def test_an_image_that_is_masked_altogether_is_left_out_and_counted(simulation, recording):
    """It is no error: where a camera saturates, artificial HDR has such images."""
    truth = simulation.truth()
    mask = np.ones(truth.images.shape, bool)
    mask[3] = False
    brightest = truth.images.copy()
    brightest[3] = 100.0
    reference = prepare_reference(recording, GroundTruth(truth.times, brightest), mask)
    assert reference.times.tolist() == np.delete(truth.times, 3).tolist()
    assert (reference.masked, reference.left_out) == (1, 0)
    assert reference.data_range == truth.images.max()
    assert "not compared; 1 more is masked altogether" in reference.described()
    found = evaluate_truth(recording, reference, methods()["hold"])
    without = GroundTruth(np.delete(truth.times, 3), np.delete(truth.images, 3, 0))
    assert (
        found.means()
        == evaluate_truth(recording, prepare_reference(recording, without), methods()["hold"]).means()
    )


def test_an_image_without_a_window_has_no_ssim_and_the_others_have(simulation, recording):
    truth = simulation.truth()
    mask = np.ones(truth.images.shape, bool)
    mask[3], mask[3, :8, :8] = False, True
    found = evaluate_truth(recording, prepare_reference(recording, truth, mask), methods()["hold"])
    assert found.images[3].ssim is None
    assert found.images[3].pixels == 64
    assert found.ssim == pytest.approx(np.mean([i.ssim for i in np.delete(found.images, 3)]))
    assert found.mse == pytest.approx(np.mean([i.mse for i in found.images]))
    assert found.adjustments() == ["SSIM without 1 image whose mask leaves no window of 11 x 11 pixels"]
    nowhere = prepare_reference(recording, truth, mask[3])
    assert evaluate_truth(recording, nowhere, methods()["hold"]).ssim is None


def test_one_image_that_is_left_out_is_one(recording, simulation):
    truth = simulation.truth()
    late = GroundTruth(np.append(truth.times, 10**9), np.concatenate([truth.images, truth.images[:1]]))
    assert (
        prepare_reference(recording, late)
        .described()
        .endswith("; 1 more lies before the first or after the last frame")
    )


def test_values_whose_squares_are_no_numbers_are_refused(simulation, recording, tmp_path):
    truth = simulation.truth()
    images = truth.images.astype(float)
    images[0, 0, 0] = 1e300
    with pytest.raises(
        InputError, match=r"1 of \d+ values are negative, beyond 1e\+12 times white or not finite"
    ):
        prepare_reference(recording, GroundTruth(truth.times, images))
    np.savez(tmp_path / "t.npz", times=truth.times, gt=images)
    with pytest.raises(InputError, match="beyond"):
        prepare_reference(recording, *load_truth(tmp_path / "t.npz"))


def test_what_does_not_fit_is_refused(simulation, recording):
    truth = simulation.truth()
    for bad, mask, told in (
        (GroundTruth(truth.times[1:], truth.images), None, "T times"),
        (GroundTruth(truth.times, truth.images[:, 1:]), None, "sensor"),
        (GroundTruth(truth.times + 10**9, truth.images), None, "is its clock"),
        (GroundTruth(truth.times, -truth.images), None, "negative"),
        (GroundTruth(truth.times, 0 * truth.images), None, "black"),
        (truth, np.ones((3, 3), bool), "mask"),
        (truth, np.zeros(truth.images.shape, bool), "masked"),
    ):
        with pytest.raises(InputError, match=told):
            prepare_reference(recording, bad, mask)


def test_what_is_no_truth_is_named(simulation, recording):
    truth = simulation.truth()
    for given in ((truth.times, truth.images), None, truth.images):
        with pytest.raises(InputError, match=r"truth is a .*; a kalux\.frames\.GroundTruth is needed"):
            prepare_reference(recording, given)
    with pytest.raises(InputError, match=r"recording is a GroundTruth; a kalux\.Recording is needed"):
        prepare_reference(truth, recording)
    with pytest.raises(InputError, match=r"reference is a GroundTruth; .*Reference is needed, from prepare_"):
        evaluate_truth(recording, truth, methods()["hold"])


class TestFiles:
    @pytest.mark.parametrize("names", [("times_us", "gt"), ("times", "images")])
    def test_both_names(self, tmp_path, simulation, names):
        truth = simulation.truth()
        mask = truth.images[0] > 0.1
        np.savez(tmp_path / "t.npz", **dict(zip(names, (truth.times, truth.images), strict=True)), mask=mask)
        found, read_mask = load_truth(tmp_path / "t.npz")
        assert np.array_equal(found.times, truth.times)
        assert np.array_equal(found.images, truth.images)
        assert np.array_equal(read_mask, mask)

    def test_errors_name_the_file(self, tmp_path):
        path = tmp_path / "t.npz"
        with pytest.raises(InputError, match=r"t\.npz: cannot be read"):
            load_truth(path)
        np.savez_compressed(path, times=np.arange(2), images=np.random.default_rng(0).random((2, 30, 30)))
        damaged = bytearray(path.read_bytes())
        damaged[len(damaged) // 2 : len(damaged) // 2 + 200] = bytes(200)
        for content in (b"", b"text", b"PK\x03\x04 cut", damaged):
            path.write_bytes(content)
            with pytest.raises(FormatError, match=r"t\.npz: not an \.npz file"):
                load_truth(path)
        for arrays, told in (
            ({"gt": np.ones((1, 2, 2))}, "no array times_us or times"),
            ({"times": np.ones(1), "gt": np.ones((1, 2, 2))}, "whole us"),
            ({"times": np.ones(1, int), "gt": np.ones((2, 2))}, "T, H, W"),
            ({"times": np.ones(1, int), "gt": np.full((1, 2, 2), 200, np.uint8)}, "uint8, up to 200; linear"),
            ({"times": np.array([None]), "gt": np.ones((1, 2, 2))}, "plain arrays"),
        ):
            np.savez(path, **arrays)
            with pytest.raises(FormatError, match=told):
                load_truth(path)


def test_ground_truth_of_a_simulated_pan(shared_data):
    folder = shared_data / "hdr_pan"
    recording = kalux.open(folder / "Oxford_Church_clean.mat")
    reference = prepare_reference(recording, *load_truth(folder / "Oxford_Church_clean_gt.npz"))
    found = {name: evaluate_truth(recording, reference, methods()[name]) for name in ("hold", "default")}
    assert (100 * found["hold"].mse, found["hold"].ssim) == pytest.approx((7.950, 0.935), abs=5e-4)
    assert found["default"].mse < found["hold"].mse / 2


@pytest.mark.parametrize("name", ["hold", "default"])
def test_all_methods_are_given_frames_without_their_black_level(name):
    plain = from_black()
    frames = list(plain.frames())
    times = np.array([frame.middle for frame in frames], np.int64)
    images = np.stack([frame.normalised() for frame in frames]).astype(np.float32)
    reference = prepare_reference(plain, GroundTruth(times, images))
    expected = evaluate_truth(plain, reference, methods()[name])
    found = evaluate_truth(lifted(plain, 16), reference, methods()[name])
    assert found.mse == pytest.approx(expected.mse, rel=0.1, abs=2e-5)
    assert found.protocol.endswith("black level of 0.0628 of white taken off all frames")
