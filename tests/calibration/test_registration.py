"""Frames warped into the event camera's pixels, and what of them is measured."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from kalux import Frame
from kalux.calibration.registration import Registration, require_overlap, undistortion_maps
from kalux.calibration.rig import Lens
from kalux.errors import FrameError, InputError
from kalux.models.camera import Camera
from rig_scene import example_rig
from rigs import DISTANCE, SENSOR, distant_recording, small_rig

SIZE = (30, 40)
LENS = Lens.pinhole(SIZE)


def shifted(dx, dy, scale=1.0):
    return Registration(LENS, LENS, np.array([[scale, 0, dx], [0, scale, dy], [0, 0, 1.0]]))


def noise(dtype=np.uint8):
    return np.random.default_rng(0).integers(0, 200, SIZE).astype(dtype)


def test_the_identity_leaves_frames_as_they_are():
    image = noise()
    frame = shifted(0, 0).frame(Frame(image, 5, 9))
    np.testing.assert_array_equal(frame.image, image.astype(np.uint16) * 257)
    assert frame.valid.all()
    assert (frame.exposure_start, frame.exposure_end, frame.white_value) == (5, 9, 65535)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_where_both_cameras_are_one_nothing_is_resampled(dtype):
    """As resampling with a shift of nothing would have it, to the bit."""
    image = noise(dtype)
    same, resampled = Registration.same_pixels(SIZE), Registration(LENS, Lens.pinhole(SIZE), np.eye(3))
    assert same.is_identity
    assert not resampled.is_identity
    np.testing.assert_array_equal(same.resampled(image), resampled.resampled(image))
    for found, expected in zip(same.maps, resampled.maps, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-5)
        assert found.dtype == expected.dtype


def test_a_shift_takes_the_mask_along():
    image = noise()
    frame = shifted(3, -2).frame(Frame(image, 0, 1))
    np.testing.assert_array_equal(frame.valid[2:, :-3], True)
    assert not frame.valid[:2].any()
    assert not frame.valid[:, -3:].any()
    np.testing.assert_array_equal(frame.image[2:, :-3], image[:-2, 3:].astype(np.uint16) * 257)
    # Outside it shows the nearest pixel: a guess for the filter to start with.
    np.testing.assert_array_equal(
        frame.image[2:, -3:], np.repeat(image[:-2, -1:], 3, axis=1).astype(int) * 257
    )


def test_pixels_made_of_clipped_and_unclipped_ones_are_not_measured():
    image = np.full(SIZE, 100, np.uint8)
    image[:, 20:] = 255
    frame = shifted(0.5, 0).frame(Frame(image, 0, 1))
    assert not frame.valid[:, 19].any()
    assert frame.valid[:, :19].all()
    assert frame.valid[:, 20:-1].all()
    assert (frame.image[:, 20:] == 65535).all()


def test_a_mask_of_the_frame_itself_is_kept():
    mask = np.ones(SIZE, bool)
    mask[10:20, 10:20] = False
    frame = shifted(0.5, 0).frame(Frame(noise(), 0, 1, valid=mask))
    assert not frame.valid[10:20, 9:20].any()
    assert frame.valid[:10, :-1].all()


def test_floats_and_their_white_stay():
    image = np.random.default_rng(0).uniform(0, 3, SIZE).astype(np.float32)
    frame = shifted(0, 0).frame(Frame(image, 0, 1, white=4.0))
    assert frame.image.dtype == np.float32
    assert frame.white == 4.0
    np.testing.assert_allclose(frame.image, image, rtol=1e-6)


def test_fine_detail_does_not_alias():
    """Stripes of one frame pixel, seen by event pixels four times as large, are grey."""
    large = Lens.pinhole((120, 160), focal=160.0)
    registration = Registration(LENS, large, np.diag([4.0, 4.0, 1.0]))
    stripes = np.tile(np.array([0, 200], np.uint8), (120, 80))
    image = registration.frame(Frame(stripes, 0, 1)).image / 65535
    assert registration.scale == pytest.approx(4, rel=1e-3)
    np.testing.assert_allclose(image[:, 1:-1], 100 / 255, atol=0.01)


LARGE = Registration(LENS, Lens.pinhole((120, 160), focal=160.0), np.diag([4.0, 4.0, 1.0]))
"""Event pixels four times as large as those of the frame."""


@pytest.mark.parametrize("response", ["srgb", "bt709", "gamma:2.2", "s-curve:0.1"])
def test_light_is_averaged_whatever_the_response(response):
    """Stripes of 0.02 and 0.8 are 0.41 together; the mean of their sRGB values is that of 0.25."""
    camera = Camera.named(response, 1.0)
    light = np.tile(np.array([0.02, 0.02, 0.8, 0.8]), (120, 40))
    coded = Frame(camera.response(light).astype(np.float32), 0, 1)
    plain = Frame(light.astype(np.float32), 0, 1)
    found = camera.response.inverse(LARGE.frame(coded, camera=camera).normalised())
    np.testing.assert_allclose(found, LARGE.frame(plain).normalised(), atol=1e-4)


def test_every_channel_has_a_response_of_its_own():
    camera = Camera.named("srgb;linear;gamma:2.2", 1.0)
    light = np.random.default_rng(0).uniform(0, 0.9, (120, 160, 3))
    channels = [camera.of_channel(c).response for c in range(3)]
    coded = np.stack([r(light[..., c]) for c, r in enumerate(channels)], axis=2)
    found = LARGE.frame(Frame(coded, 0, 1), camera=camera).image
    expected = LARGE.frame(Frame(light, 0, 1)).image
    for c, response in enumerate(channels):
        np.testing.assert_allclose(response.inverse(found[..., c]), expected[..., c], atol=1e-5)


def test_a_response_leaves_what_is_not_averaged_as_it_is():
    """Also beyond white, of floats."""
    camera = Camera.named("srgb", 1.0)
    image = noise()
    np.testing.assert_array_equal(
        shifted(0, 0).frame(Frame(image, 5, 9), camera=camera).image, image.astype(np.uint16) * 257
    )
    bright = np.random.default_rng(0).uniform(0, 3, SIZE).astype(np.float32)
    np.testing.assert_allclose(
        shifted(0, 0).frame(Frame(bright, 0, 1), camera=camera).image, bright, rtol=1e-5
    )


def test_undistortion_is_that_of_opencv():
    lens = example_rig().frames
    x, y, inside = undistortion_maps(lens)
    ours = cv2.initUndistortRectifyMap(
        lens.matrix, lens.distortion, np.eye(3), lens.matrix, lens.sensor_size[::-1], cv2.CV_32FC1
    )
    assert inside.mean() > 0.9
    np.testing.assert_allclose(x[inside], ours[0][inside], atol=1e-2)
    np.testing.assert_allclose(y[inside], ours[1][inside], atol=1e-2)


def test_a_frame_of_the_rig_shows_what_the_event_camera_sees():
    """Rendered through lens, pose and plane on one side, warped by the registration on the other."""
    rig, seen = small_rig(), distant_recording()
    frame = seen.frames[8]
    warped = Registration.of_rig(rig, DISTANCE).frame(frame)
    truth = seen.scene.at(frame.exposure_start + SENSOR.exposure / 2 + 7_300)
    valid = warped.valid & (truth < 0.9)
    error = warped.normalised()[valid] - truth[valid]
    assert np.sqrt(np.mean(error**2)) < 0.02
    far = Registration.of_rig(rig).frame(frame)  # infinitely far: half a pixel off
    both = valid & far.valid
    assert np.mean((far.normalised() - truth)[both] ** 2) > 2 * np.mean(error**2)


def test_what_cannot_be_registered():
    with pytest.raises(FrameError, match="frame 3 is 5x4 pixels, the frame camera 40x30"):
        shifted(0, 0).frame(Frame(np.zeros((4, 5), np.uint8), 0, 1), index=3)
    with pytest.raises(InputError, match="look the same way"):
        require_overlap(shifted(39, 0))
