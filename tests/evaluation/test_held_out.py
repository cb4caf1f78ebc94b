"""Held-out frames, and blur consistency: which frames, what is compared with them, in which unit."""

from __future__ import annotations

import numpy as np
import pytest

import kalux
from kalux import Recording
from kalux.datasets import SensorSettings
from kalux.errors import FrameError, InputError
from kalux.evaluation.baselines import methods
from kalux.evaluation.consistency import blur_consistency, valid_pixels
from kalux.evaluation.exposures import End, end_of_frames
from kalux.evaluation.held_out import (
    clipped_as,
    evaluate_held_out,
    held_out_pairs,
    hold_out_frames,
    intensity_percentile,
    percentile_of_counts,
)
from kalux.evaluation.method import Estimated, Method
from kalux.evaluation.truth import evaluate_truth, prepare_reference
from kalux.frames import GroundTruth

from builders import frame, from_black, lifted, moving_blocks, passing_by, pixel_events, textured


def still(levels, exposures=None, size=(12, 12)):
    """A recording of frames of one value each."""
    exposures = exposures or [10] * len(levels)
    frames = [
        frame(level, 100 * i, 100 * i + exposure, size)
        for i, (level, exposure) in enumerate(zip(levels, exposures, strict=True))
    ]
    return Recording.from_arrays(pixel_events([], []), frames, sensor_size=size, contrast_threshold=0.2)


def constant(value):
    return Method("constant", lambda recording, times: (np.full(recording.sensor_size, value) for _ in times))


@pytest.mark.parametrize(
    ("images", "told"),
    [
        (lambda rec, ts: [np.zeros(rec.sensor_size)], r"odd: 1 images for \d+ times"),
        (lambda rec, ts: [np.zeros(rec.sensor_size)] * (len(ts) + 1), r"odd: more images than the \d+ times"),
        (
            lambda rec, ts: kalux.reconstruct(rec, times=ts),
            "odd: image 0 is of type Image; a NumPy array is needed",
        ),
    ],
)
def test_a_method_yields_one_array_per_time(images, told):
    held = hold_out_frames(still(range(100, 112)))
    with pytest.raises(InputError, match=told):
        evaluate_held_out(held, Method("odd", images))


SMALL = np.full((12, 12), 0.5, np.float32)


@pytest.mark.parametrize(
    ("method", "told"),
    [
        (Method("odd", lambda rec, ts: None), "odd: what it makes is a NoneType; an image for every time"),
        (
            Method("odd", lambda rec, ts: [SMALL[1:]] * len(ts)),
            r"odd: image 0 is float32 \(11, 12\); real numbers, ",
        ),
        (Method("odd", lambda rec, ts: [SMALL.astype(object)] * len(ts)), r"odd: image 0 is object"),
        (
            Method("odd", lambda *_: (), estimates=lambda rec, ts: [(SMALL, SMALL)] * len(ts)),
            "odd: image 0 is a tuple; of estimates an Estimated is needed",
        ),
        (
            Method(
                "odd", lambda *_: (), estimates=lambda rec, ts: [Estimated(SMALL[1:], SMALL[1:])] * len(ts)
            ),
            r"odd: image 0 is float32 \(11, 12\)",
        ),
        (
            Method("odd", lambda *_: (), estimates=lambda rec, ts: [Estimated(SMALL, SMALL[1:])] * len(ts)),
            r"odd: image 0: its variance is float32 \(11, 12\)",
        ),
        ("default", "method is a str; a Method is needed"),
    ],
)
@pytest.mark.parametrize(
    "compare",
    [
        lambda rec, method: evaluate_held_out(hold_out_frames(rec), method),
        lambda rec, method: evaluate_truth(
            rec, prepare_reference(rec, GroundTruth(np.array([505]), SMALL[np.newaxis])), method
        ),
        blur_consistency,
    ],
)
def test_what_a_method_of_ones_own_makes_is_checked(compare, method, told):
    """Whatever it is compared with."""
    with pytest.raises(InputError, match=told):
        compare(still(range(100, 112)), method)


def test_a_method_may_write_all_its_images_into_one_array():
    recording, array = still(range(100, 112)), np.zeros((12, 12), np.float32)

    def reused(rec, times):
        for k in range(len(times)):
            array[...] = 0.1 * (k % 7)
            yield array

    again = Method("reused", reused)
    fresh = Method("fresh", lambda rec, times: (image.copy() for image in reused(rec, times)))
    held = hold_out_frames(recording)
    assert evaluate_held_out(held, again).mse == evaluate_held_out(held, fresh).mse
    assert blur_consistency(recording, again).psnr == blur_consistency(recording, fresh).psnr


def test_what_is_held_out_is_of_a_recording_and_whole_numbers():
    recording = still([100] * 9)
    for numbers in ({"every": 2.5}, {"every": "2"}, {"reads": 2.5}):
        with pytest.raises(InputError, match="whole numbers, at least 2, are needed"):
            hold_out_frames(recording, **numbers)
    assert len(hold_out_frames(recording, np.int64(2)).compared) == 2
    with pytest.raises(InputError, match="hold_out_frames: recording is a str"):
        hold_out_frames("rec.h5")
    with pytest.raises(InputError, match="held is a Recording; a HeldOut is needed, from hold_out_frames"):
        evaluate_held_out(recording, methods()["hold"])


def test_every_nth_frame_is_dropped_and_compared_if_three_from_either_end():
    recording = still(range(100, 112))
    held = hold_out_frames(recording, 2)
    assert held.compared.tolist() == [3, 5, 7]
    assert [f.image[0, 0] for f in held.kept.frames()] == [100, 102, 104, 106, 108, 110]
    assert len(held.kept.frames()) == 6
    held = hold_out_frames(recording, 3)
    assert held.compared.tolist() == [5, 8]
    assert [f.image[0, 0] for f in held.kept.frames()] == [100, 101, 103, 104, 106, 107, 109, 110]
    assert "every 3rd dropped, 2 of them compared (numbers 5 to 8" in held.described()
    assert held.times.tolist() == [[500, 502, 505, 507, 510], [800, 802, 805, 807, 810]]


def test_one_frame_has_one_number():
    assert "1 of them compared (number 3, from 0)" in hold_out_frames(still(range(100, 107))).described()
    assert "every 22nd" in hold_out_frames(still(range(100, 126)), 22).described()


def test_the_scale_is_the_percentile_of_all_frames():
    rng = np.random.default_rng(0)
    frames = [frame(rng.integers(0, 256, (9, 11)), 100 * i, 100 * i + 10) for i in range(8)]
    recording = Recording.from_arrays(pixel_events([], []), frames, sensor_size=(9, 11))
    expected = np.percentile(np.stack([f.normalised() for f in frames]), 99.5)
    assert intensity_percentile(recording, 99.5, 10, "linear") == pytest.approx(expected, rel=1e-12)
    for percent in (0, 37.3, 100):
        assert percentile_of_counts(np.array([1.0, 2, 5]), np.array([2, 1, 3]), percent) == pytest.approx(
            np.percentile([1, 1, 2, 5, 5, 5], percent)
        )


def test_frames_of_which_no_pixel_is_valid():
    frames = [
        kalux.Frame(np.full((12, 12), 9, np.uint8), 100 * i, 100 * i + 10, valid=np.zeros((12, 12), np.bool_))
        for i in range(8)
    ]
    recording = Recording.from_arrays(pixel_events([], []), frames, sensor_size=(12, 12))
    with pytest.raises(FrameError, match="arrays: no pixel of any frame is valid"):
        hold_out_frames(recording)


def test_scores_by_hand():
    """Scale 0.8 (all frames 204 of 255), reconstruction 1.0: an error of (1.0 - 0.8) / 0.8."""
    held = hold_out_frames(still([204] * 8))
    scores = evaluate_held_out(held, constant(1.0))
    assert scores.mse == pytest.approx(0.25**2)
    assert scores.psnr == pytest.approx(10 * np.log10(16))
    assert scores.log_mse == pytest.approx(np.log(1.27 / 1.02) ** 2)
    assert [(image.t, image.pixels) for image in scores.images] == [(305, 144)]
    assert scores.scale == pytest.approx(0.8)
    assert scores.adjustments() == ["intensities divided by 0.8"]


def test_pixels_that_are_not_valid_do_not_count():
    """The frames are 100 where they are valid, and 255, which no method is punished for, elsewhere."""
    mask = np.zeros((12, 16), bool)
    mask[:, :12] = True
    image = np.where(mask, 100, 255).astype(np.uint8)
    frames = [kalux.Frame(image, 100 * i, 100 * i + 10, valid=mask) for i in range(9)]
    recording = Recording.from_arrays(
        pixel_events([], []), frames, sensor_size=(12, 16), contrast_threshold=0.2
    )
    held = hold_out_frames(recording)
    assert held.scale == pytest.approx(100 / 255)
    scores = evaluate_held_out(held, constant(100 / 255))
    assert scores.mse == pytest.approx(0, abs=1e-12)
    assert scores.images[0].pixels == mask.sum()
    np.testing.assert_array_equal(valid_pixels(frames[0], 0.98), mask)


def test_held_out_frames_in_colour_are_clipped_where_one_colour_is():
    image = np.full((12, 12, 3), 100, np.uint8)
    image[:, :3, 2] = 255
    frames = [kalux.Frame(image, 100 * i, 100 * i + 10) for i in range(9)]
    recording = Recording.from_arrays(
        pixel_events([], []), frames, sensor_size=(12, 12), contrast_threshold=0.2
    )
    pair = next(held_out_pairs(hold_out_frames(recording), constant(0.4)))
    np.testing.assert_array_equal(pair.clipped, np.arange(12)[None] + np.zeros((12, 1)) < 3)


def test_a_held_out_frames_own_noise_is_no_error_of_the_method():
    """A method that knows the noise-free scene, and says how well: z is 1 only with the noise of the frames."""
    rng = np.random.default_rng(0)
    size = (80, 100)
    truth = np.broadcast_to(np.linspace(0.2, 0.6, 100), size)
    shown = [np.rint(255 * (truth + 0.02 * rng.standard_normal(size))) for _ in range(12)]
    frames = [frame(values, 100 * i, 100 * i + 10) for i, values in enumerate(shown)]
    recording = Recording.from_arrays(pixel_events([], []), frames, sensor_size=size, contrast_threshold=0.2)
    held = hold_out_frames(recording)
    assert held.noise[0] == pytest.approx(0.02, rel=0.1)

    def estimates(recording, times):
        sigma = 0.01 / (truth + 0.03)
        for group in np.split(times, len(times) // held.times.shape[1]):
            error = 0.01 * rng.standard_normal(truth.shape)
            for _ in group:
                yield Estimated(truth + error, sigma**2, 0.03)

    method = Method("knows", lambda recording, times: iter(()), estimates=estimates)
    found = evaluate_held_out(held, method)
    assert found.uncertainty()["rms_z"] == pytest.approx(1.0, abs=0.06)


def test_a_pattern_that_the_held_out_frames_share_is_no_error_between_them():
    intensity, own = np.array([[0.1, 0.4]]), np.array([[0.01, 0.02]])
    made = Estimated(intensity, own + (0.05 / (intensity + 0.1)) ** 2, 0.1, 0.05)
    np.testing.assert_allclose(made.variance_of_frames, own)
    of_pixels = np.array([[0.05, 0.0]])
    first = Estimated(intensity, made.variance, 0.1, of_pixels).variance_of_frames
    np.testing.assert_allclose(first, [[own[0, 0], made.variance[0, 1]]])
    assert Estimated(intensity, own, 0.1).variance_of_frames is own
    assert Estimated(intensity, None, 0.1, 0.05).variance_of_frames is None


def test_nothing_is_clipped_unless_asked_for():
    held = hold_out_frames(still([255] * 8))
    assert evaluate_held_out(held, constant(3.0)).mse == pytest.approx(4.0)
    clipped = evaluate_held_out(held, constant(3.0), clip=True)
    assert clipped.mse == 0
    assert "clipped" in clipped.adjustments()[0]
    assert evaluate_held_out(held, constant(-0.5)).negative == 144


def test_auto_exposure_frames_are_scaled_to_the_kept_frames_median():
    """The same light, 0.4 at 20 us, seen with exposures of 10 and 20 us."""
    held = hold_out_frames(
        still([51 if i % 2 else 102 for i in range(9)], [10 if i % 2 else 20 for i in range(9)])
    )
    assert held.reference_exposure == 20
    assert evaluate_held_out(held, methods()["hold"]).mse == pytest.approx(0, abs=1e-12)
    short = frame(255, 0, 10)
    assert clipped_as(np.array([[5.0, -1.0]]), short, 20, End(0.98, 1.0)).tolist() == [[2.0, 0.0]]


def test_images_are_clipped_where_a_camera_ends_below_full_scale():
    """At 102 of 255, which events tell: highlights beyond are no error of theirs."""
    recording = passing_by(textured(1.2), 102, noise_rate=0.0)
    end = end_of_frames(recording, "linear")
    assert end == (pytest.approx(0.999 * 0.4), pytest.approx(0.4))
    held = hold_out_frames(recording)
    assert held.end == end
    bright = Method("bright", lambda rec, ts: (np.full(rec.sensor_size, 3.0) for _ in ts))
    for pair in held_out_pairs(held, bright, clip=True):
        np.testing.assert_allclose(pair.test, 0.4)
        assert 0.05 < np.mean(pair.clipped) < 0.9


def test_reads_are_averaged_across_the_exposure():
    """An image that brightens linearly with time is, at the middle, the frame."""
    recording = still([102] * 8, [40] * 8)
    rising = Method("rising", lambda rec, ts: (np.full((12, 12), 0.4 + (t - 320) / 100) for t in ts.tolist()))
    assert evaluate_held_out(hold_out_frames(recording), rising).mse == pytest.approx(0, abs=1e-12)


def test_what_a_method_does_not_know_is_interpolated_by_events():
    simulation = moving_blocks()
    held = hold_out_frames(simulation.recording())
    found = {name: evaluate_held_out(held, methods()[name]) for name in ("hold", "mean", "edi", "default")}
    assert found["default"].mse < 0.3 * found["mean"].mse
    assert found["default"].mse < found["edi"].mse < found["hold"].mse
    assert found["default"].ssim > found["hold"].ssim
    assert held.kept.ground_truth() is None


def test_hdr_vdp_is_computed_only_if_asked_for():
    held = hold_out_frames(moving_blocks().recording())
    assert evaluate_held_out(held, methods()["hold"]).q is None
    found = [evaluate_held_out(held, methods()[n], hdr_vdp=True).q for n in ("hold", "default")]
    assert found[0] < found[1] <= 10


def test_values_that_are_not_finite_are_told_with_method_and_time():
    with pytest.raises(
        InputError, match=r"constant, image at 305 us: test: 144 of 144 values are not finite"
    ):
        evaluate_held_out(hold_out_frames(still([204] * 8)), constant(np.nan))


@pytest.mark.parametrize(
    ("levels", "every", "told"),
    [([9] * 6, 2, "too few"), ([0] * 9, 2, "black"), ([9] * 9, 1, "at least 2"), ([9] * 9, 40, "too few")],
)
def test_what_cannot_be_held_out(levels, every, told):
    with pytest.raises((FrameError, InputError), match=told):
        hold_out_frames(still(levels), every)


def test_the_numbers_of_the_published_protocol(shared_data):
    """Drop, scale and average as docs/tuning.md says, written out for the simplest methods."""
    recording = kalux.open(shared_data / "newton_davis346.aedat4")
    values = np.stack([f.normalised() for f in recording.frames()])
    dropped = np.arange(3, len(values) - 3, 2)
    scale = np.percentile(values, 99.5)
    held = hold_out_frames(recording)
    for name, expected in (
        ("hold", values[dropped - 1]),
        ("mean", (values[dropped - 1] + values[dropped + 1]) / 2),
    ):
        error = np.mean(((expected - values[dropped]) / scale) ** 2)
        assert evaluate_held_out(held, methods()[name]).mse == pytest.approx(error, rel=1e-6)
    assert evaluate_held_out(held, methods()["default"]).ssim > 0.94


class TestBlurConsistency:
    def test_images_that_are_right_give_the_frames(self):
        """Long exposures in motion: sharp truth integrates to the blurred frame, held frames do not."""
        simulation = moving_blocks(sensor=SensorSettings(exposure=30_000), speed=120.0)
        truth = Method("truth", lambda rec, times: (simulation.scene.at(float(t)) for t in times))
        recording = simulation.recording()
        found = {
            m.label: blur_consistency(recording, m) for m in (truth, methods()["cf"], methods()["default"])
        }
        assert found["truth"].psnr > 40
        assert found["AKF default"].psnr > 35
        assert found["AKF default"].psnr > found["CF"].psnr + 5
        assert len(found["truth"].frames) == len(simulation.frames) - 2

    def test_clipped_and_black_pixels_do_not_count(self):
        levels = np.full((12, 12), 102)
        levels[0], levels[1] = 255, 0
        frames = [frame(levels, 100 * i, 100 * i + 10) for i in range(3)]
        recording = Recording.from_arrays(pixel_events([], []), frames, sensor_size=(12, 12))
        assert np.count_nonzero(valid_pixels(frames[0], 0.98)) == 120
        found = blur_consistency(recording, constant(0.5))
        assert found.frames == ((105, 120, pytest.approx(20.0)),)

    @pytest.mark.parametrize("gain", [0.5, 1.0, 2.0])
    def test_the_range_ends_at_what_a_frame_with_a_gain_can_show(self, gain):
        """A level of 0.4 and images that would be 0.5 of white, whatever white is."""
        frames = [
            kalux.Frame(np.full((12, 12), 102, np.uint8), 100 * i, 100 * i + 10, gain=gain) for i in range(3)
        ]
        recording = Recording.from_arrays(pixel_events([], []), frames, sensor_size=(12, 12))
        found = blur_consistency(recording, constant(0.5 / gain))
        assert found.frames == ((105, 144, pytest.approx(20.0)),)

    def test_frames_without_such_pixels_are_counted(self):
        assert blur_consistency(still([102, 255, 102, 102]), constant(0.4)).skipped == 1
        few = Method("few", lambda recording, times: [np.full(recording.sensor_size, 0.4, np.float32)])
        with pytest.raises(InputError, match="1 images for 18 times"):
            blur_consistency(still([102] * 4), few)
        with pytest.raises(FrameError, match="clipped or black"):
            blur_consistency(still([255] * 4), constant(1.0))
        with pytest.raises(FrameError, match="three frames"):
            blur_consistency(still([102] * 2), constant(1.0))


@pytest.mark.parametrize("name", ["hold", "edi", "default"])
def test_a_black_level_is_taken_off_what_is_compared_and_what_methods_are_given(name):
    """Scores in light, not in what a camera adds to it: those of a camera without one."""
    plain, raised = hold_out_frames(from_black()), hold_out_frames(lifted(from_black(), 16))
    assert raised.whole.black_level == raised.kept.black_level == pytest.approx(16 / 255, abs=1 / 255)
    assert raised.scale == pytest.approx(plain.scale, rel=0.01)
    expected = evaluate_held_out(plain, methods()[name])
    found = evaluate_held_out(raised, methods()[name])
    assert found.mse == pytest.approx(expected.mse, rel=0.1, abs=2e-5)
    assert "black level of 0.0628 of white taken off" in found.protocol
    assert "black" not in expected.protocol


def test_a_black_level_that_is_given_is_not_looked_for():
    held = hold_out_frames(lifted(from_black(), 16), black_level=0.0)
    assert held.whole.black_level == held.kept.black_level == 0
    assert next(held.frames()).black == 0
