"""Recordings in colour from frames and events to images: simulated, for there is no real one to test with."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

import kalux
from kalux.datasets import SensorSettings, colour_photograph, combine, handheld, pan, simulate_colour
from kalux.errors import FrameError, SettingsError
from kalux.frames import MOSAICS, Frame
from kalux.models.colour import LUMINANCE, demosaic, luminance, sample_mosaic
from kalux.reconstructor import Reconstructor
from kalux.recording import Recording
from kalux.settings import PRESETS, altered

from builders import colour_blocks

DEFAULT = kalux.PRESETS["default"]


def between_frames(made):
    """Times halfway between frames, where the last frame is oldest."""
    middles = np.array([frame.middle for frame in made.frames])
    return (middles[3:-3] + middles[4:-2]) // 2


def colours(images):
    return np.stack([image.colour for image in images]).astype(np.float64)


def held(made, times):
    """The last frame of each time, in linear RGB."""
    last = [[f for f in made.frames if f.exposure_end <= t][-1] for t in times]
    values = [(frame.normalised().astype(np.float32), frame.mosaic) for frame in last]
    return np.stack([value if mosaic is None else demosaic(value, mosaic, 0.03) for value, mosaic in values])


def chromaticity_error(found, truth):
    """Mean distance in r, g, b = RGB / (R + G + B), where the truth is well exposed."""
    chosen = (luminance(truth) > 0.05) & (truth.max(axis=-1) < 0.95)
    apart = [values / (values.sum(axis=-1, keepdims=True) + 1e-6) for values in (found, truth)]
    return float(np.linalg.norm(apart[0] - apart[1], axis=-1)[chosen].mean())


@pytest.mark.parametrize("mosaic", [*MOSAICS, None])
def test_colours_are_nearer_to_the_truth_than_the_last_frame(mosaic):
    """In every channel, and in chromaticity."""
    scene, made = colour_blocks(mosaic, sensor=SensorSettings(read_noise=0.005, threshold_mismatch=0.05))
    times = between_frames(made)
    truth = np.stack([scene.radiance(float(t)) for t in times])
    found = colours(kalux.reconstruct(made.recording(), times=times))
    old = held(made, times)
    for channel in range(3):
        error, before = (np.mean((values - truth)[..., channel] ** 2) for values in (found, old))
        assert error < (0.65 if mosaic else 0.8) * before  # 0.1 to 0.6, and 0.1 to 0.7
    assert chromaticity_error(found, truth) < (0.6 if mosaic else 0.85) * chromaticity_error(old, truth)


@pytest.mark.parametrize("mosaic", [*MOSAICS, None])
def test_a_red_wall_is_red(mosaic):
    wall = np.broadcast_to(np.array([0.8, 0.2, 0.1]), (6, 8, 3))
    image = np.rint(255 * (wall if mosaic is None else sample_mosaic(wall, mosaic))).astype(np.uint8)
    live = Reconstructor((6, 8), contrast_threshold=0.2)
    live.push_frame(Frame(image, 0, 1000, mosaic=mosaic))
    read = live.read(1000)
    np.testing.assert_allclose(read.colour, wall, atol=0.01)
    np.testing.assert_allclose(read.grey().intensity, wall @ np.array(LUMINANCE), atol=0.01)
    assert read.grey().colour is None


def test_the_mosaic_is_filtered_like_a_grey_recording():
    """Intensity and variance of a mosaic are those of the same pixels without colour; colour is added to them.

    But for what neighbours know, and what the frames tell of the sensor's pattern: in a mosaic those of the same colour
    are two pixels away.
    """
    alone = altered(altered(PRESETS["default"], "filter", neighbours=0.0), "camera", fixed_pattern=0.0)
    _, made = colour_blocks("RGGB")
    grey = Recording.from_arrays(
        made.events,
        [dataclasses.replace(frame, mosaic=None) for frame in made.frames],
        sensor_size=made.scene.sensor_size,
        contrast_threshold=0.2,
    )
    pairs = zip(
        kalux.reconstruct(made.recording(), at="frames", settings=alone),
        kalux.reconstruct(grey, at="frames", settings=alone),
        strict=True,
    )
    for coloured, plain in pairs:
        np.testing.assert_array_equal(coloured.intensity, plain.intensity)
        np.testing.assert_array_equal(coloured.variance, plain.variance)
        assert plain.colour is None
        assert plain.grey() is plain
        dim = coloured.colour.max(axis=-1) <= 0.9
        np.testing.assert_array_equal(sample_mosaic(coloured.colour, "RGGB")[dim], coloured.intensity[dim])


def test_frames_in_rgb_lend_their_chromaticity_to_the_luminance():
    _, made = colour_blocks(None)
    for image in kalux.reconstruct(made.recording(), at="frames"):
        np.testing.assert_allclose(luminance(image.colour), image.intensity, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("mosaic", ["RGGB", None])
@pytest.mark.parametrize(
    "options", [{"smooth": True}, {"lookahead": False}, {"preset": "cf"}, {"preset": "iccv2021"}]
)
def test_every_way_of_filtering_has_colours(mosaic, options):
    _, made = colour_blocks(mosaic)
    times = between_frames(made)[:3]
    for image in kalux.reconstruct(made.recording(), times=times, **options):
        assert image.colour.shape == (*made.scene.sensor_size, 3)
        assert image.colour.dtype == np.float32
        assert np.isfinite(image.colour).all()
        assert image.colour.min() >= 0


def test_what_a_frame_does_not_measure_lends_no_colour():
    """Under the mask of the second of three grey frames is red."""
    images = [np.full((2, 2, 3), 100, np.uint8) for _ in range(3)]
    images[1][:] = (200, 0, 0)
    masks = (None, np.zeros((2, 2), np.bool_), None)
    made = Reconstructor((2, 2), settings=altered(PRESETS["default"], "events", delay=0))
    for k, (image, valid) in enumerate(zip(images, masks, strict=True)):
        made.push_frame(Frame(image, 40_000 * k, 40_000 * k + 10_000, valid=valid))
    made.finish()
    np.testing.assert_allclose(made.read(45_000).colour, 100 / 255, rtol=1e-3)


def test_a_clipped_frame_is_neutral_whatever_the_white_balance():
    """Gains would make magenta of what is white only because it is clipped."""
    image = np.full((4, 4, 3), 255, np.uint8)
    at_bounds = altered(DEFAULT, "filter", unshown_tail=0.0)
    live = Reconstructor(
        (4, 4), settings=altered(at_bounds, "camera", white_balance="1.9;1;1.6"), contrast_threshold=0.2
    )
    live.push_frame(Frame(image, 0, 1000))
    colour = live.read(1000).colour
    np.testing.assert_allclose(colour, colour[..., :1].repeat(3, axis=-1), rtol=1e-5)
    np.testing.assert_allclose(colour, 1, atol=0.05)


def test_a_clipped_mosaic_under_gains_is_neutral_too():
    image = np.full((6, 6), 255, np.uint8)
    live = Reconstructor(
        (6, 6), settings=altered(DEFAULT, "camera", white_balance="1.9;1;1.6"), contrast_threshold=0.2
    )
    live.push_frame(Frame(image, 0, 1000, mosaic="RGGB"))
    colour = live.read(1000).colour
    np.testing.assert_allclose(colour / luminance(colour)[..., None], 1, atol=0.15)


def test_a_sky_whose_blue_is_clipped_is_still_measured():
    """Its luminance is known but for the little that blue has of it, so that frames go on correcting the events."""
    sky = np.empty((4, 4, 3), np.uint8)
    sky[:] = (120, 170, 255)
    sun = np.empty((4, 4, 3), np.uint8)
    sun[:] = (255, 255, 200)
    variances = []
    for image in (sky, sun):
        live = Reconstructor((4, 4), contrast_threshold=0.2)
        live.push_frame(Frame(image, 0, 1000))
        variances.append(float(live.read(1000).variance.max()))
    assert variances[0] < 0.01
    assert variances[1] > 0.08  # K15: at least 0.3 in log intensity


def test_channels_have_their_own_response():
    wall = np.array([0.5, 0.3, 0.2])
    exponents = np.array([1.0, 2.0, 3.0])
    encoded = np.broadcast_to(wall ** (1 / exponents), (4, 6, 3))
    settings = altered(DEFAULT, "camera", response="linear;gamma:2;gamma:3")
    for mosaic in (None, "GRBG"):
        live = Reconstructor((4, 6), settings=settings, contrast_threshold=0.2)
        pixels = encoded if mosaic is None else sample_mosaic(encoded, mosaic)
        live.push_frame(Frame(np.ascontiguousarray(pixels), 0, 1000, mosaic=mosaic))
        np.testing.assert_allclose(live.read(1000).colour, np.broadcast_to(wall, (4, 6, 3)), rtol=0.02)
    live = Reconstructor((4, 6), settings=settings, contrast_threshold=0.2)
    with pytest.raises(SettingsError, match="three responses are for frames in colour"):
        live.push_frame(Frame(np.zeros((4, 6), np.uint8), 0, 1000))


def test_a_live_stream_cannot_measure_the_grey_world():
    settings = altered(DEFAULT, "camera", white_balance="grey-world")
    live = Reconstructor((4, 4), settings=settings, contrast_threshold=0.2)
    live.push_frame(Frame(np.zeros((4, 4), np.uint8), 0, 1000))  # grey needs none
    live = Reconstructor((4, 4), settings=settings, contrast_threshold=0.2)
    with pytest.raises(SettingsError, match="a live stream needs as-recorded or gains"):
        live.push_frame(Frame(np.zeros((4, 4), np.uint8), 0, 1000, mosaic="RGGB"))


def test_frames_cannot_change_their_colours():
    live = Reconstructor((4, 4), contrast_threshold=0.2)
    live.push_frame(Frame(np.zeros((4, 4), np.uint8), 0, 1000, mosaic="RGGB"))
    with pytest.raises(FrameError, match="is GBRG, those before it are RGGB"):
        live.push_frame(Frame(np.zeros((4, 4), np.uint8), 2000, 3000, mosaic="GBRG"))


class TestPattern:
    """The pattern of a recording that does not state it."""

    def test_demosaiced_frames_give_pixels_their_channel_back(self):
        """What vendors' software made RGB of a mosaic is filtered as the mosaic again, and is as good as it."""
        scene, made = colour_blocks("RGGB")
        stored = [
            dataclasses.replace(f, image=cv2.cvtColor(f.image, cv2.COLOR_BayerBG2RGB), mosaic=None)
            for f in made.frames
        ]
        size = made.scene.sensor_size
        rgb = Recording.from_arrays(made.events, stored, sensor_size=size, contrast_threshold=0.2)
        times = between_frames(made)
        truth = np.stack([scene.radiance(float(t)) for t in times])[:, 1:-1, 1:-1]
        errors = {}
        for name, recording in (
            ("mosaic", made.recording()),
            ("given back", Recording(rgb.source, mosaic="RGGB")),
            ("luminance", rgb),
        ):
            found = colours(kalux.reconstruct(recording, times=times))[:, 1:-1, 1:-1]
            errors[name] = np.mean((np.log(found + 0.03) - np.log(truth + 0.03)) ** 2)
        # What is estimated from either differs in the last digits.
        assert errors["given back"] == pytest.approx(errors["mosaic"], rel=0.05)
        assert errors["given back"] < 0.8 * errors["luminance"]

    def test_raw_mosaics_that_are_stored_as_grey(self):
        _, made = colour_blocks("BGGR")
        grey = [dataclasses.replace(f, mosaic=None) for f in made.frames]
        source = Recording.from_arrays(made.events, grey, sensor_size=made.scene.sensor_size).source
        assert [f.mosaic for f in Recording(source, mosaic="BGGR").frames()] == ["BGGR"] * len(grey)
        assert Recording(source).mosaic is None

    def test_a_wrong_pattern_can_be_taken_away(self):
        _, made = colour_blocks("BGGR")
        assert made.recording().mosaic == "BGGR"
        assert {f.mosaic for f in Recording(made.recording().source, mosaic="none").frames()} == {None}

    def test_unknown_patterns_are_refused(self):
        with pytest.raises(kalux.KaluxError, match="mosaic is 'RGBG'; it must be one of RGGB"):
            Recording(colour_blocks("BGGR")[1].recording().source, mosaic="RGBG")


def test_a_photograph_of_stained_glass(shared_data):
    """A window far beyond white: its colours and its brightness come from events alone."""
    file = shared_data / "hdr" / "Oxford_Church.hdr"
    picture = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[..., ::-1]
    picture = cv2.resize(picture, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    picture = picture / np.percentile(luminance(picture), 85)
    scene = colour_photograph(
        picture, combine(pan(60, 25), handheld(1)), sensor_size=(60, 80), duration=500_000, center=(126, 110)
    )
    made = simulate_colour(scene, SensorSettings(read_noise=0.005, threshold_mismatch=0.05), mosaic="RGGB")
    times = between_frames(made)
    truth = np.stack([scene.radiance(float(t)) for t in times])
    found = colours(kalux.reconstruct(made.recording(), times=times, smooth=True))
    old = held(made, times)
    log_errors = [np.mean((np.log(v + 0.03) - np.log(truth + 0.03)) ** 2) for v in (found, old)]
    assert log_errors[0] < 0.5 * log_errors[1]
