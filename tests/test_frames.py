"""Frames: white, exposures, and the checks on a sequence."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.errors import ExposureError, FrameError
from kalux.frames import Frame, check_frame, exposure_doubt, place_exposure


def frame(start=100, end=200, dtype=np.uint8, shape=(3, 4), white=None, mosaic=None):
    return Frame(np.ones(shape, dtype), start, end, white, mosaic)


@pytest.mark.parametrize(
    ("dtype", "white", "expected"),
    [
        (np.uint8, None, 255),
        (np.uint16, None, 65535),
        (np.uint16, 1023, 1023),
        (np.float32, None, 1),
        (np.float64, 4.0, 4),
    ],
)
def test_white(dtype, white, expected):
    one = frame(dtype=dtype, white=white)
    assert one.white_value == expected
    assert np.allclose(one.normalised(), 1 / expected)
    assert one.normalised().dtype == np.float64


def test_frames_less_a_dark_frame_are_black_where_they_are_negative():
    one = Frame(np.array([[-0.2, 0.0, 0.5]], np.float32), 0, 1)
    assert one.normalised().tolist() == [[0.0, 0.0, 0.5]]


def test_exposure_and_middle():
    one = frame(100, 205)
    assert (one.exposure, one.middle) == (105, 152)


@pytest.mark.parametrize("kind", [np.uint64, np.int32, np.float64])
def test_times_of_any_type_are_kept_as_int(kind):
    """Those of `numpy.uint64`, as a file may hold them, would wrap round below 0."""
    one = frame(kind(100), kind(200))
    assert [type(t) for t in (one.exposure_start, one.exposure_end, one.exposure, one.middle)] == [int] * 4
    with pytest.raises(ExposureError, match="an exposure of -50 us"):
        check_frame(frame(kind(100), kind(50)), (3, 4))


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_values_of_any_type_are_kept_as_float(kind):
    """A gain of `numpy.uint8` could not be multiplied by an exposure."""
    one = Frame(np.full((3, 4), 21, np.uint8), 0, 10_000, kind(101), black=kind(1), gain=kind(2))
    assert [type(value) for value in (one.white, one.black, one.gain, one.full_scale)] == [float] * 4
    assert (one.amplified_exposure, one.normalised()[0, 0]) == (20_000.0, 0.2)


def test_an_exposure_that_is_amplified():
    one = Frame(np.ones((3, 4), np.uint8), 100, 300, gain=1.5)
    assert one.amplified_exposure == 300.0


@pytest.mark.parametrize("kind", [bool, object, complex, "U1"])
def test_pixels_of_no_known_type_are_told(kind):
    with pytest.raises(FrameError, match=r"has dtype .*; uint8, uint16, float32 or float64"):
        check_frame(frame(dtype=kind), (3, 4))


@pytest.mark.parametrize(("stamp", "start"), [("start", 100), ("middle", 95), ("end", 89)])
def test_place_exposure(stamp, start):
    placed = place_exposure(frame(100, 100), 11, stamp)
    assert (placed.exposure_start, placed.exposure_end) == (start, start + 11)


def test_placing_an_exposure_keeps_the_rest():
    placed = place_exposure(frame(100, 100, np.uint16, white=1023, mosaic="GBRG"), 11, "start")
    assert (placed.white, placed.mosaic) == (1023, "GBRG")


def test_a_frame_tells_itself_in_a_line():
    assert repr(frame()) == "<kalux.Frame uint8 (3, 4), grey, exposed from 100 to 200 us>"
    assert repr(Frame([[1]], 0, 1, mosaic="RGGB")) == "<kalux.Frame list, RGGB, exposed from 0 to 1 us>"
    assert repr(Frame(None, 0, 1)) == "<kalux.Frame NoneType, grey, exposed from 0 to 1 us>"


@pytest.mark.parametrize("last", [(90, 91), (90, 140), (120, 170)])
def test_a_last_exposure_no_longer_than_a_frame_interval_is_believed(last):
    assert exposure_doubt(np.array([(0, 50), (50, 90), last])) is None


@pytest.mark.parametrize("starts", [(), (7,)])
def test_without_a_frame_interval_no_exposure_is_doubted(starts):
    assert exposure_doubt(np.array([(t, 10**9) for t in starts], np.int64).reshape(-1, 2)) is None


def test_a_last_exposure_longer_than_every_frame_interval_is_doubted():
    """The other exposures have to end before the next one begins; nothing begins after the last."""
    doubt = exposure_doubt(np.array([(0, 10), (30, 40), (50, 5_050)]))
    assert doubt == (
        "the last frame is exposed for 5,000 us, from 50 to 5050 us, though frames follow each other within 30 us; "
        "is the end of its exposure right?"
    )


def test_exposures_in_milliseconds_are_doubted():
    starts = np.arange(5) * 38_760
    doubt = exposure_doubt(np.stack([starts, starts + 10], axis=1))
    assert "every 38,760 us and are exposed for 10 us" in doubt
    assert "if that was meant in ms, it is 10,000 us" in doubt
    assert exposure_doubt(np.stack([starts, starts + 39], axis=1)) is None


def test_colours():
    assert frame().colours == "grey"
    assert frame(shape=(3, 4, 3)).colours == "RGB"
    assert frame(mosaic="BGGR").colours == "BGGR"


def check(one, **options):
    check_frame(one, (3, 4), where="here", index=7, **options)


@pytest.mark.parametrize("white", [0, -1.0, np.nan, np.inf, 1e-320, 1e24, "255", [255]])
def test_a_white_value_is_positive(white):
    with pytest.raises(FrameError, match="frame 7 has the white value"):
        check(frame(white=white))


def test_a_white_value_that_no_pixel_can_have_is_refused():
    with pytest.raises(FrameError, match="white value 256, but no pixel of uint8 is above 255"):
        check(frame(white=256))
    check(frame(white=256.0, dtype=np.uint16))


@pytest.mark.parametrize(
    "times", [(0.01, 0.02), (100, np.nan), (100.5, 200), (100, None), (2 * 10**18, 3 * 10**18)]
)
def test_times_are_whole_microseconds(times):
    """Seconds would otherwise pass as exposures of nothing."""
    with pytest.raises(FrameError, match=r"frame 7 has an exposure from .* whole microseconds"):
        check(frame(*times))


@pytest.mark.parametrize(
    "what",
    [
        np.ones((3, 4), np.uint8),
        Frame([[1, 2]], 0, 1),
        Frame(np.ma.masked_equal(np.ones((3, 4), np.uint8), 1), 0, 1),
        None,
    ],
)
def test_what_is_no_frame_is_told(what):
    with pytest.raises(FrameError, match=r"frame 7 is a .*; a kalux.Frame with a NumPy array is needed"):
        check(what)


def test_good_frames_pass():
    check(frame(), previous=frame(0, 100))
    check(frame(100, 100), exposure_known=False, previous=frame(50, 50))
    for dtype in (np.uint16, np.float32, np.float64):
        check(frame(dtype=dtype))
        check(frame(dtype=dtype, shape=(3, 4, 3)))
    check(frame(white=255))
    check(Frame(np.full((3, 4), 9e14), 100, 200, white=1000))
    check(frame(mosaic="RGGB"), previous=frame(0, 100, mosaic="RGGB"))


def not_finite():
    image = np.ones((3, 4), np.float32)
    image[1, 2] = np.nan
    return Frame(image, 100, 200)


@pytest.mark.parametrize(
    ("one", "options", "kind", "message"),
    [
        (frame(shape=(4, 3)), {}, FrameError, "frame 7 is 3x4 pixels, the sensor is 4x3"),
        (frame(shape=(3, 4, 2)), {}, FrameError, "frame 7 is 4x3x2 pixels.*must be grey or RGB"),
        (frame(mosaic="RGBG"), {}, FrameError, "mosaic 'RGBG'; known are RGGB, BGGR, GRBG, GBRG"),
        (frame(shape=(3, 4, 3), mosaic="RGGB"), {}, FrameError, "a mosaic is"),
        (
            frame(mosaic="RGGB"),
            {"previous": frame(0, 50)},
            FrameError,
            "frame 7 is RGGB, those before it are grey",
        ),
        (frame(shape=(3, 4, 3)), {"previous": frame(0, 50)}, FrameError, "is RGB, those before it are grey"),
        (frame(dtype=np.int16), {}, FrameError, "dtype int16"),
        (frame(dtype=">u2"), {}, FrameError, "dtype >u2; .*in this machine's order of bytes"),
        (not_finite(), {}, FrameError, "not finite .* at x=2, y=1"),
        (
            Frame(np.full((3, 4), 1e300), 100, 200),
            {},
            FrameError,
            r"values up to 1e\+300, white is 1; at most 1e\+12",
        ),
        (
            Frame(np.full((3, 4), -2e15), 100, 200, white=1000),
            {},
            FrameError,
            r"values up to 2e\+15, white is 1000",
        ),
        (frame(100, 100), {}, ExposureError, "exposure of 0 us"),
        (frame(100, 90), {}, ExposureError, "exposure of -10 us"),
        (frame(), {"previous": frame(100, 150)}, FrameError, "not after the frame before it"),
        (frame(), {"previous": frame(50, 101)}, ExposureError, "has ended"),
    ],
)
def test_bad_frames_are_named(one, options, kind, message):
    with pytest.raises(kind, match="here.*" + message):
        check(one, **options)


@pytest.mark.parametrize("valid", [np.ones((3, 5), bool), np.ones((3, 4), np.uint8), [[True] * 4] * 3])
def test_a_mask_of_another_size_or_type_is_refused(valid):
    masked = Frame(np.ones((3, 4), np.uint8), 100, 200, valid=valid)
    with pytest.raises(FrameError, match=r"mask of valid pixels of .*bool \(3, 4\) is needed"):
        check_frame(masked, (3, 4))


def test_a_placed_exposure_keeps_the_mask():
    mask = np.eye(3, 4, dtype=bool)
    masked = Frame(np.ones((3, 4), np.uint8), 100, 100, valid=mask)
    assert place_exposure(masked, 10, "start").valid is mask
    check_frame(masked, (3, 4), exposure_known=False)


@pytest.mark.parametrize("gain", [0.0, -1.0, float("nan"), float("inf"), "2"])
def test_a_gain_that_cannot_be_is_refused(gain):
    frame = Frame(np.zeros((2, 2), np.uint8), 0, 10, gain=gain)
    with pytest.raises(FrameError, match="frame 3 has a gain of"):
        check_frame(frame, (2, 2), index=3)
