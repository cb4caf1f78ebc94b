"""Read and shot noise of sensors where they are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import nnls

from kalux import EVENT_DTYPE, Frame, Recording, reconstruct
from kalux.calibration.frame_noise import (
    _beyond_neighbours,
    _comparable,
    _enough_frames,
    _not_negative,
    estimate_frame_noise,
    flat_noise,
    photon_transfer,
    quiet_noise,
    smooth_noise,
    trimmed_variance,
    typical_flat_noise,
    usual_noise,
)
from kalux.datasets import SensorSettings, demo_scene, simulate
from kalux.events import make_events
from kalux.models.camera import Response
from kalux.settings import CameraSettings

from builders import busy, unlabelled, without_events

CAMERA = CameraSettings()
NOTHING = np.empty(0, EVENT_DTYPE)
SCENE = demo_scene(sensor_size=(90, 120), duration=600_000)
LEVEL = 1 / 255 / np.sqrt(12)
RAMP = np.broadcast_to(np.linspace(0.02, 0.9, 200), (150, 200))


def still(
    irradiance, read, shot, *, frames=12, response=lambda i: i, changes=None, events=NOTHING, every=40_000
):
    """Frames of 8 bits, ``every`` us one, of a still scene; ``changes`` is added to every second one."""
    rng = np.random.default_rng(1)
    made = []
    for k in range(frames):
        now = irradiance if changes is None or k % 2 else irradiance + changes
        noise = np.sqrt(read**2 + shot * irradiance) * rng.standard_normal(irradiance.shape)
        values = np.rint(255 * response((now + noise).clip(0, 1))).astype(np.uint8)
        made.append(Frame(values, every * k, every * k + every // 4))
    return Recording.from_arrays(events, made, sensor_size=irradiance.shape)


def test_read_and_shot_noise_of_a_still_ramp():
    """Variance 0.005^2 + quantisation 1/12 of a level + intensity / 5000 electrons."""
    found = estimate_frame_noise(still(RAMP, 0.005, 1 / 5000), CAMERA)
    assert found.shot == pytest.approx(1 / 5000, rel=0.05)
    assert found.read == pytest.approx(np.hypot(0.005, LEVEL), rel=0.1)
    assert found.at_half == pytest.approx(np.sqrt(found.read**2 + found.shot / 2))
    assert found.is_reliable


def test_frames_that_follow_soon_tell_it_as_well():
    """They are not passed over, as where their changes are compared with events: twelve are enough, in 24 ms."""
    usual, soon = (
        estimate_frame_noise(still(RAMP, 0.005, 1 / 5000, every=t), CAMERA) for t in (40_000, 2_000)
    )
    assert (soon.read, soon.shot) == (usual.read, usual.shot)


def test_noise_of_less_than_half_a_level_is_the_rounding():
    found = estimate_frame_noise(still(RAMP, 1e-5, 0.0), CAMERA)
    assert found.read == 0.5 / 255
    assert found.shot < 1e-6


def test_faint_motion_and_flicker_are_no_noise():
    """Changes of up to five levels that neighbours share leave noise of less than one what it is."""
    y, x = np.indices(RAMP.shape)
    waves = 0.01 * np.sin(2 * np.pi * x / 40) * np.sin(2 * np.pi * y / 40)
    found = estimate_frame_noise(still(RAMP, 0.003, 0.0, changes=waves + 0.01), CAMERA)
    assert found.read == pytest.approx(np.hypot(0.003, LEVEL), rel=0.1)


def flickering(where):
    """A part of the scene flickers pixel by pixel, and says so; noise of 0.01."""
    rng = np.random.default_rng(3)
    changes = np.where(where, 0.2, 0.0) * rng.random(RAMP.shape)
    y, x = (i.ravel() for i in np.nonzero(changes))
    t = np.arange(0, 480_000, 20_000).repeat(len(x))
    events = make_events(t, np.tile(x, 24), np.tile(y, 24), np.ones(len(t), np.int64))
    return still(RAMP, 0.01, 0.0, changes=changes, events=events)


def test_pixels_with_events_around_do_not_count():
    found = estimate_frame_noise(flickering(np.arange(200) < 100), CAMERA)
    assert found.read == pytest.approx(np.hypot(0.01, LEVEL), rel=0.1)


def test_where_noise_leaves_no_pixel_alone_those_beside_one_must_do():
    """Two events in five of the pixels and intervals: 3x3 without any are one in a hundred."""
    rng = np.random.default_rng(4)
    there = rng.random((12, *RAMP.shape)) < 0.4
    k, y, x = np.nonzero(there)
    events = make_events(40_000 * k + 20_000, x, y, np.ones(len(k), np.int64))
    found = estimate_frame_noise(still(RAMP, 0.02, 1 / 800, events=events), CAMERA)
    assert found.is_reliable
    assert found.read == pytest.approx(0.02, rel=0.15)
    assert found.shot == pytest.approx(1 / 800, rel=0.2)


def test_unseen_motion_is_a_share_of_the_light():
    levels = np.linspace(0.02, 0.9, 12)
    moved = photon_transfer(levels, 1e-4 + 2e-4 * levels + 4e-3 * levels**2, np.ones(12), motion=True)
    assert moved.read == pytest.approx(0.01, rel=1e-6)
    assert moved.shot == pytest.approx(2e-4, rel=1e-6)
    assert moved.error < 1e-6


def test_a_response_that_is_not_linear():
    """It is that of the intensity, here 0.01 everywhere, whatever the slope of the response."""
    camera = CameraSettings(response="gamma:1.5")
    irradiance = np.broadcast_to(np.linspace(0.1, 0.8, 200), (150, 200))
    found = estimate_frame_noise(still(irradiance, 0.01, 0.0, response=lambda i: i ** (1 / 1.5)), camera)
    np.testing.assert_allclose(found.variances, 0.01**2, rtol=0.1)
    assert found.read == pytest.approx(0.01, rel=0.1)


def test_rounding_of_a_response_that_is_not_linear():
    """Of a scene without noise: what half a level over the root of three is in the light, at each level its own."""
    response, half = Response.gamma(2.2), 0.5 / 255
    found = estimate_frame_noise(
        still(RAMP, 1e-5, 0.0, response=response), CameraSettings(response="gamma:2.2")
    )
    seen = np.sqrt(found.read**2 + found.shot * found.levels)
    np.testing.assert_allclose(seen, half / 3**0.5 * 2.2 * found.levels ** (1.2 / 2.2), rtol=0.15)
    assert found.read < 0.1 * half


@pytest.mark.parametrize("read", [0.0, 0.004, 0.01])
def test_frames_in_motion_have_hardly_more_noise_than_still_ones(read):
    sensor = SensorSettings(noise_rate=0.5, read_noise=read)
    found = estimate_frame_noise(unlabelled(simulate(SCENE, sensor)), CAMERA)
    seen = np.sqrt(found.read**2 + found.shot * found.levels)
    assert (seen > 0.85 * np.hypot(read, LEVEL)).all()
    assert (seen < np.hypot(read, LEVEL) + 0.003).all()


def test_frames_between_which_events_are_lost_do_not_count():
    """What moves there has no events, and would be taken for noise of the frames."""
    recording = without_events(flickering(np.arange(150)[:, None] < 75), 90_000, 410_000)
    found = estimate_frame_noise(recording, CAMERA)
    assert found.read == pytest.approx(np.hypot(0.01, LEVEL), rel=0.1)


def test_the_estimate_looks_at_the_first_frames_only():
    recording = still(RAMP, 0.005, 0.0)
    some = estimate_frame_noise(recording, CAMERA, most_frames=4)
    assert some.read == pytest.approx(np.hypot(0.005, LEVEL), rel=0.1)
    assert some.read != estimate_frame_noise(recording, CAMERA).read


def test_of_a_larger_sensor_fewer_frames_are_enough():
    """As many pixels as 80 frames of a DAVIS346, and 20 frames at least."""
    assert [_enough_frames(size) for size in ((260, 346), (180, 240), (480, 640), (720, 1280))] == [
        80,
        80,
        24,
        20,
    ]


def test_levels_that_are_alike_do_not_tell_read_from_shot_noise():
    found = estimate_frame_noise(still(np.full((60, 80), 0.48), 0.01, 0.0), CAMERA)
    assert found.read == pytest.approx(np.hypot(0.01, LEVEL), rel=0.05)
    assert found.shot == 0.0


def busy_on_the_right(shape):
    return busy(np.broadcast_to(np.arange(shape[1]) >= shape[1] // 2, shape))


@pytest.mark.parametrize("electrons", [5_000, 20_000, np.inf])
def test_brighter_parts_that_change_smoothly_tell_how_the_noise_of_dark_still_pixels_grows(electrons):
    """These have 0.83 of it. No more than the usual at half of white is believed, or twice that in the dark."""
    x = np.arange(200)
    light = np.broadcast_to(
        np.where(x < 100, np.linspace(0.03, 0.09, 200), np.linspace(0.2, 0.9, 200)), (150, 200)
    )
    waves = np.broadcast_to(np.where(x < 100, 0.0, 0.1 * np.sin(x / 15)), light.shape)
    events = busy_on_the_right(light.shape)
    found = estimate_frame_noise(still(light, 0.002, 1 / electrons, changes=waves, events=events), CAMERA)
    assert found.at(0.045) == pytest.approx(np.sqrt(0.002**2 + LEVEL**2 + 0.045 / electrons), rel=0.1)
    told = 0.83 * np.sqrt(0.002**2 + LEVEL**2 + 0.5 / electrons)
    assert found.at_half == pytest.approx(
        min(max(told, found.at(0.045)), 2 * found.at(0.045), 0.006), rel=0.12
    )


def test_flat_parts_of_the_dark_tell_how_the_noise_of_bright_still_pixels_grows():
    """The dark is never still, and noise in it a third of that in the light."""
    light = np.broadcast_to(np.where(np.arange(200) < 100, np.linspace(0.4, 0.9, 200), 0.03), (150, 200))
    found = estimate_frame_noise(still(light, 0.002, 1e-4, events=busy_on_the_right(light.shape)), CAMERA)
    assert found.read == pytest.approx(np.hypot(0.002, LEVEL), rel=0.25)
    assert found.at(0.5) == pytest.approx(np.sqrt(0.002**2 + LEVEL**2 + 0.5e-4), rel=0.1)
    flickering = still(
        light, 0.002, 1e-4, events=busy_on_the_right(light.shape), changes=0.03 * (light < 0.1) * RAMP
    )
    assert estimate_frame_noise(flickering, CAMERA).at(0.5) == pytest.approx(found.at(0.5), rel=0.1)


def stored(light, noise, *, step=20):
    """8 bits of a light behind a gamma of 2.2, with a noise of its values; a picture that goes on by ``step`` rows."""
    rng = np.random.default_rng(5)
    made = []
    for k in range(12):
        values = np.roll(light, step * k, axis=0) ** (1 / 2.2) + noise * rng.standard_normal(light.shape)
        made.append(Frame(np.rint(255 * values.clip(0, 1)).astype(np.uint8), 40_000 * k, 40_000 * k + 10_000))
    events = busy(np.full(light.shape, step > 0))
    return Recording.from_arrays(events, made, sensor_size=light.shape)


def behind(noise, level):
    """What a noise of stored values is of the light, behind a gamma of 2.2; and 8 bits."""
    return np.hypot(noise, LEVEL) * 2.2 * level ** (1.2 / 2.2)


GAMMA = CameraSettings(response="gamma:2.2")
LEAST = 0.5 / 255 / np.sqrt(3)  # of the light in the dark: no more is believed of it


@pytest.mark.parametrize(("darkest", "brightest"), [(0.3, 0.8), (0.03, 0.08)])
def test_behind_a_response_that_bends_one_level_tells_all_others(darkest, brightest):
    """Its noise is that of stored values: a tenth of it, or ten times as much, at another level."""
    light = np.broadcast_to(np.linspace(darkest, brightest, 200), (150, 200))
    found = estimate_frame_noise(stored(light, 0.01, step=0), GAMMA)
    for level in (0.02, 0.05, 0.2, 0.7):
        assert found.at(level) == pytest.approx(behind(0.01, level), rel=0.25), level


@pytest.mark.parametrize("noise", [0.004, 0.012])
def test_smooth_parts_of_what_moves_tell_the_noise_behind_a_response_that_bends(noise):
    """Where what they have is as fine as noise: more than the usual, too. They have 0.83 of it."""
    y, x = np.indices((120, 160))
    light = 0.4 + 0.2 * np.sin(2 * np.pi * y / 120) * np.cos(x / 25)
    found = usual_noise(stored(light, noise), GAMMA)
    for level in (0.02, 0.1, 0.5):
        told = np.sqrt(found.read**2 + found.shot * level)
        assert told == pytest.approx(np.hypot(0.9 * behind(noise, level), LEAST), rel=0.2), level


@pytest.mark.parametrize("darkest", [0.02, 0.3])
def test_texture_is_no_noise_behind_a_response_that_bends(darkest):
    """It is coarser: no more is believed than the usual at half of white, and at other levels what goes with it."""
    rng = np.random.default_rng(6)
    texture = 1 + 3 * cv2.GaussianBlur(rng.uniform(-1, 1, (120, 160)), (0, 0), 1.2)
    found = usual_noise(stored(darkest * texture.clip(0.3), 0.002), GAMMA)
    for level in (0.05, 0.5):
        usual = np.hypot(CAMERA.usual_frame_noise * (2 * level) ** (1.2 / 2.2), LEAST)
        assert np.sqrt(found.read**2 + found.shot * level) == pytest.approx(usual, rel=0.1), level


def test_what_events_say_of_the_dark_is_the_same_of_all_stored_values_behind_a_response_that_bends():
    made = stored(np.full((20, 20), 0.1), 0.0)
    read, shot = quiet_noise(made, GAMMA, 0.0008)
    assert read == pytest.approx(LEAST)
    assert np.sqrt(read**2 + shot * 0.3) == pytest.approx(
        np.hypot(0.0008 * 15 ** (1.2 / 2.2), LEAST), rel=0.1
    )
    _, most = quiet_noise(made, GAMMA, 0.02)
    assert np.sqrt(most / 2) == pytest.approx(CAMERA.usual_frame_noise, rel=0.02)
    assert quiet_noise(made, CAMERA, 0.002) == pytest.approx((0.002, (0.004**2 - 0.002**2) / 0.5))


def test_parts_that_change_smoothly_bound_the_noise_of_bright_pixels_where_the_dark_is_told():
    """A dark half with a texture of its own, and a smooth bright one, all of which moves."""
    rng = np.random.default_rng(3)
    made = []
    for k in range(12):
        light = np.where(np.arange(160) < 80, rng.uniform(0.015, 0.04, (120, 160)), 0.4 + 0.002 * k)
        values = np.rint(255 * (light + 0.001 * rng.standard_normal(light.shape))).astype(np.uint8)
        made.append(Frame(values, 40_000 * k, 40_000 * k + 10_000))
    moving = Recording.from_arrays(busy(np.ones((120, 160))), made, sensor_size=(120, 160))
    found = usual_noise(moving, CAMERA)
    at_half = np.sqrt(found.read**2 + found.shot / 2)
    assert at_half < CAMERA.usual_frame_noise
    assert at_half == pytest.approx(max(found.read, np.hypot(0.001, LEVEL)), rel=0.15)


@pytest.mark.parametrize("texture", [0.0, 0.02])
def test_texture_that_changes_without_events_is_no_noise_where_smooth_parts_have_less(texture):
    """On the left; on the right light comes and goes in slopes, and has 0.83 of the noise."""
    fine = np.random.default_rng(8).normal(0, texture, RAMP.shape)
    changes = np.where(np.arange(200) < 100, fine, 0.1 * np.sin(np.arange(200) / 15))
    light = np.broadcast_to(np.linspace(0.4, 0.8, 200), RAMP.shape)
    recording = still(light, 0.004, 0.0, changes=changes, events=busy_on_the_right(light.shape))
    true = np.hypot(0.004, LEVEL)
    assert 0.8 * true < estimate_frame_noise(recording, CAMERA).at(0.5) < 1.1 * true


def test_nothing_to_be_told():
    y, x = (i.ravel() for i in np.indices((60, 80)))
    t = np.arange(12).repeat(len(x)) * 40_000
    busy = make_events(t, np.tile(x, 12), np.tile(y, 12), np.ones(len(t), np.int64))
    flat = np.full((60, 80), 0.48)
    assert estimate_frame_noise(still(flat, 0.002, 0.0), CAMERA) is None  # a single level
    assert estimate_frame_noise(still(RAMP[:60, :80], 0.002, 0.0, events=busy), CAMERA) is None
    assert estimate_frame_noise(still(RAMP, 0.01, 0.0, frames=1), CAMERA) is None


def test_dark_pixels_bound_the_noise_that_is_not_known():
    """Whatever moves elsewhere; at half of white it is the usual, or as much as in the dark where that is more."""
    usual, dark = CAMERA.usual_frame_noise, np.where(np.arange(200) < 100, 0.015, RAMP)
    moving = 0.1 * np.random.default_rng(6).random(RAMP.shape) * (np.arange(200) >= 100)
    read, shot, _ = usual_noise(still(dark, 0.003, 0.0, changes=moving), CAMERA)
    assert read == pytest.approx(np.hypot(0.003, LEVEL), rel=0.1)
    assert read**2 + shot / 2 == pytest.approx(usual**2)
    assert usual_noise(still(dark, 1e-5, 0.0), CAMERA)[0] == pytest.approx(
        LEVEL
    )  # no less than rounding makes
    noisy = usual_noise(still(dark + 0.01, 0.009, 0.0), CAMERA)
    assert noisy.read == pytest.approx(0.009, rel=0.15)
    assert (noisy.shot, noisy.silent) == (0.0, True)
    bright = usual_noise(still(RAMP[:20, 20:] + 0.05, 0.003, 0.0), CAMERA)
    assert bright == (usual, 0.0, False)  # nothing is dark, and too little is bright


@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_parts_that_change_smoothly_tell_the_noise_where_nothing_is_dark(noise):
    """Light that comes and goes, in slopes, and what pixels always have, are no noise; it may be more than the usual.

    The tenth of these parts from below have 0.83 of it. At half of white it is 1.4 times that in the dark.
    """
    rng = np.random.default_rng(4)
    bright = np.linspace(0.2, 0.7, 200) + rng.normal(0, 0.02, RAMP.shape)  # a fixed pattern
    changes = np.broadcast_to(np.linspace(0.2, -0.1, 200), RAMP.shape)
    read, shot, silent = usual_noise(still(bright, noise, 0.0, changes=changes), CAMERA)
    assert not silent
    assert read**2 + 0.5 * shot == pytest.approx((0.83 * np.hypot(noise, LEVEL)) ** 2, rel=0.15)
    assert read**2 + shot / 2 == pytest.approx(2 * read**2, rel=1e-6)


def test_smooth_parts_say_no_more_than_the_usual_where_texture_moves():
    """Texture is not alike everywhere, as noise is. Where it is the least of both is told."""
    usual, rng = CAMERA.usual_frame_noise, np.random.default_rng(5)
    bright = np.full(RAMP.shape, 0.4)
    texture = rng.normal(0, 1, RAMP.shape) * np.linspace(0.01, 0.1, 200)
    assert usual_noise(still(bright, 0.002, 0.0, changes=texture), CAMERA) == (usual, 0.0, False)
    fine = cv2.GaussianBlur(rng.normal(0, 0.12, RAMP.shape), (0, 0), 0.6)  # as lenses make it
    assert usual_noise(still(bright, 0.002, 0.0, changes=fine), CAMERA) == (usual, 0.0, False)
    least = usual_noise(still(bright, 0.002, 0.0, changes=texture / 8), CAMERA)
    assert np.hypot(0.002, LEVEL) < np.sqrt(least.read**2 + 0.4 * least.shot) < usual


@pytest.mark.parametrize("deviation", [0.025, 0.06])
@pytest.mark.parametrize("electrons", [np.inf, 400.0])
def test_what_is_as_fine_as_noise_is_noise_however_much(deviation, electrons):
    """Light that comes and goes in slopes leaves it; it grows from darker parts to brighter ones."""
    changes = np.broadcast_to(0.1 * np.sin(np.arange(200) / 15), RAMP.shape)
    light = np.broadcast_to(np.linspace(0.25, 0.7, 200), RAMP.shape)
    found = usual_noise(still(light, deviation, 1 / electrons, changes=changes), CAMERA)
    for level in (0.3, 0.6):
        true = np.sqrt(deviation**2 + LEVEL**2 + level / electrons)
        assert np.sqrt(found.read**2 + level * found.shot) == pytest.approx(true, rel=0.1)
    assert not found.is_doubtful  # by pixels that black cuts off


def test_dark_pixels_do_not_bound_noise_that_black_cuts_off():
    """Flat parts beside them, which are brighter, say more."""
    dark = np.where(np.arange(200) < 100, 0.015, np.linspace(0.13, 0.2, 200))
    changes = np.where(np.arange(200) < 100, 0.0, 0.05 * np.sin(np.arange(200) / 15))
    light = np.broadcast_to(np.where(np.arange(200) < 40, 0.09, dark), RAMP.shape)
    found = usual_noise(still(light, 0.04, 0.0, changes=changes), CAMERA)
    assert found.read == pytest.approx(0.04, rel=0.15)


def test_smooth_parts_are_bright_but_not_clipped_and_not_in_rgb():
    """Parts of 10x10 pixels from 0.12 of white on, twenty at least; what clips or is masked is in none."""

    def told(level, **parts):
        interval = next(_comparable(still(level, 0.004, 0.0), CAMERA, 2))
        pair = (shot._replace(**parts) for shot in (interval.first, interval.second))
        return smooth_noise(_beyond_neighbours(*pair))

    bright = np.full((80, 100), 0.4)
    found = told(bright)
    assert found.level == pytest.approx(0.4, abs=0.002)
    assert found.deviation == pytest.approx(0.83 * np.hypot(0.004, LEVEL), rel=0.1)
    assert found.is_noise
    assert told(bright, pitch=2).deviation == pytest.approx(found.deviation, rel=0.1)
    assert told(bright, chroma=np.ones((*bright.shape, 3))) is None
    assert told(bright / 4) is None
    assert told(bright * 2.5) is None
    masked = np.ones(bright.shape, np.bool_)
    masked[:, 55:] = False
    assert told(bright, valid=masked) is not None  # 4 by 6 parts away from the border
    masked[:, 45:] = False
    assert told(bright, valid=masked) is None


def all_moves(shape, noise, flat, *, frames=12):
    """A fine texture that is another one in every frame, but for its columns up to ``flat``; all pixels have events."""
    rng = np.random.default_rng(3)
    made = []
    for k in range(frames):
        texture = np.where(np.arange(shape[1]) < flat, 0.02, rng.uniform(0.005, 0.045, shape))
        values = np.rint(255 * (texture + noise * rng.standard_normal(shape)).clip(0, 1)).astype(np.uint8)
        made.append(Frame(values, 40_000 * k, 40_000 * k + 10_000))
    return Recording.from_arrays(busy(np.ones(shape), frames), made, sensor_size=shape)


@pytest.mark.parametrize("noise", [0.003, 0.009])
def test_flat_parts_of_what_moves_tell_the_noise_of_dark_pixels(noise):
    """A third of the image: more than the usual noise, too, while the texture changes by 0.016.

    They are a tenth too high where a third is flat, since the tenth part of all from below is taken.
    """
    found = usual_noise(all_moves((90, 120), noise, 40), CAMERA)
    assert 0.9 < found.read / np.hypot(noise, LEVEL) < 1.25
    assert not found.silent
    texture = usual_noise(all_moves((90, 120), noise, 0), CAMERA)
    assert texture.read > 0.008  # nothing is flat: it is taken for noise


@pytest.mark.parametrize(("flat", "least", "most"), [(0, 0.01, 0.02), (40, 0.0, 0.003)])
def test_what_moves_unseen_is_no_noise_where_flat_parts_have_less(flat, least, most):
    """One in four pixels has no event, nor have the four beside it, while the texture changes by 0.016."""
    recording = all_moves((90, 120), 0.001, flat)
    events = np.concatenate([*recording.events()])
    some = events[(events["x"] % 2 == 0) & (events["y"] % 2 == 0)]
    faint = Recording.from_arrays(some, [*recording.frames()], sensor_size=recording.sensor_size)
    found = estimate_frame_noise(faint, CAMERA)
    assert (found is None) == (flat > 0)
    read = usual_noise(faint, CAMERA).read if found is None else found.read
    assert least < read < most


def test_flat_parts_do_not_tell_the_noise_of_rgb():
    """Its neighbours share it. Those of a mosaic do not."""
    interval = next(_comparable(all_moves((90, 120), 0.004, 40), CAMERA, 2))
    first, second = interval.first, interval.second
    true, rgb = np.hypot(0.004, LEVEL), np.ones((90, 120, 3))
    assert flat_noise(_beyond_neighbours(first, second))[0] == pytest.approx(true, rel=0.2)
    mosaic = _beyond_neighbours(first._replace(pitch=2), second._replace(pitch=2))
    assert flat_noise(mosaic)[0] == pytest.approx(true, rel=0.2)
    demosaiced = _beyond_neighbours(first._replace(chroma=rgb), second._replace(chroma=rgb))
    assert flat_noise(demosaiced) == [None, None, None]


@pytest.mark.parametrize(("level", "told"), [(0.03, flat_noise), (0.4, smooth_noise)])
def test_pixels_of_a_mosaic_are_compared_with_those_of_their_own_colour(level, told):
    """Every second column becomes brighter by a third, as where a red thing comes; noise is what it was."""
    columns = np.where(np.arange(120) % 2, level / 3, 0.0)
    recording = still(np.full((90, 120), level), 0.004, 0.0, changes=np.broadcast_to(columns, (90, 120)))
    interval = next(_comparable(recording, CAMERA, 2))
    first, second = (shot._replace(pitch=2) for shot in (interval.first, interval.second))
    found = told(_beyond_neighbours(first, second))
    noise = found[0] if told is flat_noise else found.deviation / 0.83
    assert noise == pytest.approx(np.hypot(0.004, LEVEL), rel=0.15)


def test_flat_parts_that_black_cuts_off_do_not_count():
    """From two standard deviations of the noise on, unless nothing is less dark."""
    found = [[0.012, 0.016, 0.02], [0.012, 0.018, 0.022], [0.012, 0.017, 0.024]]
    assert typical_flat_noise(found) == 0.022
    assert typical_flat_noise([[0.007, *row[1:]] for row in found]) == 0.007
    assert typical_flat_noise([[0.012, 0.017, None], [None, None, None]]) == 0.017
    assert typical_flat_noise([[None, 0.004, 0.004]]) is None
    assert typical_flat_noise([]) is None


def test_levels_that_black_cuts_off_are_no_points_of_the_curve():
    """Noise of 0.03 is more than the darkest level."""
    found = estimate_frame_noise(still(RAMP, 0.03, 0.0), CAMERA)
    assert found.read == pytest.approx(0.03, rel=0.03)
    assert found.levels.min() > 0.05


def test_no_change_at_all_is_no_noise():
    """The mean squares of parts are sums that go up and down, so that rounding may leave less than nothing."""
    rng = np.random.default_rng(4)
    image = np.where(rng.random((60, 80)) < 0.2, 255, 6).astype(np.uint8)
    changed = image.copy()
    changed[:, 60:] = np.where(rng.random((60, 20)) < 0.5, 5, 9)
    frames = [Frame((image, changed)[k % 2], 40_000 * k, 40_000 * k + 10_000) for k in range(6)]
    recording = Recording.from_arrays(NOTHING, frames, sensor_size=image.shape)
    interval = next(_comparable(recording, CAMERA, 2))
    change = _beyond_neighbours(interval.first, interval.second)
    assert all(noise is None or noise >= 0.0 for noise in flat_noise(change))


def test_of_dark_pixels_those_without_events_bound_the_noise():
    """The others move; too few that do not, and all count."""
    dark = np.full(RAMP.shape, 0.015)
    columns = np.arange(200) >= 100
    moving = 0.008 * np.random.default_rng(6).random(dark.shape) * columns
    y, x = np.nonzero(np.broadcast_to(columns, dark.shape))
    t = np.arange(12).repeat(len(x)) * 40_000 + 20_000
    events = make_events(t, np.tile(x, 12), np.tile(y, 12), np.ones(len(t), np.int64))
    read, _, silent = usual_noise(still(dark, 0.002, 0.0, changes=moving, events=events), CAMERA)
    assert silent
    assert read == pytest.approx(np.hypot(0.002, LEVEL), rel=0.05)
    few = np.s_[:, 99:]  # the column that is still has an event beside it
    busy = make_events(t, np.tile(x - 99, 12), np.tile(y, 12), np.ones(len(t), np.int64))
    all_move = still(dark[few], 0.002, 0.0, changes=moving[few], events=busy)
    of_all = usual_noise(all_move, CAMERA)
    assert of_all.read > 1.2 * read
    assert not of_all.silent


@pytest.mark.parametrize("electrons", [0, 5000], ids=["no noise", "shot noise only"])
def test_frames_in_floats_without_read_noise_can_be_reconstructed(electrons):
    """Simulated frames can have none; settings need some."""
    rng = np.random.default_rng(1)
    frames = [
        Frame(rng.poisson(RAMP * electrons) / electrons if electrons else RAMP + 0.0, t, t + 10_000)
        for t in range(0, 480_000, 40_000)
    ]
    recording = Recording.from_arrays(NOTHING, frames, sensor_size=RAMP.shape)
    found = estimate_frame_noise(recording, CAMERA)
    assert 0.5 / 65535 <= found.read < (5e-4 if electrons else 1e-5)
    assert found.shot == pytest.approx(1 / electrons if electrons else 0.0, rel=0.05)
    images = list(reconstruct(recording, at="frames"))
    assert len(images) == len(frames)
    assert all(np.isfinite(image.intensity).all() for image in images)


def test_outliers_do_not_make_variance():
    rng = np.random.default_rng(0)
    values = rng.standard_normal(20_000)
    values[:200] += 50
    assert trimmed_variance(values) == pytest.approx(1.0, abs=0.05)
    assert trimmed_variance(values[200:]) == pytest.approx(values[200:][np.abs(values[200:]) < 4].var(), 1e-3)


def test_photon_transfer_is_a_line_without_negative_parts():
    levels = np.linspace(0.1, 0.9, 9)
    found = photon_transfer(levels, 1e-5 + 2e-4 * levels, np.ones(9))
    assert (found.read**2, found.shot) == (pytest.approx(1e-5), pytest.approx(2e-4))
    falling = photon_transfer(levels, 1e-4 * (1 - levels), np.ones(9))
    assert falling.shot == 0.0
    scattered = photon_transfer(levels, np.where(np.arange(9) % 2, 1e-4, 1e-6), np.ones(9))
    assert not scattered.is_reliable


@given(st.integers(0, 10**6), st.booleans())
def test_least_squares_without_negative_coefficients_are_scipys(seed, empty):
    rng = np.random.default_rng(seed)
    design, values = rng.normal(rng.normal(), 1, (9, 2)), rng.normal(rng.normal(), 2, 9)
    if empty:
        design[:, 1] = 0.0
    np.testing.assert_allclose(_not_negative(design, values), nnls(design, values)[0], atol=1e-12)
