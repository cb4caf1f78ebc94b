"""Response curves from images at several exposures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from kalux.calibration.figures import require_matplotlib, response_figure
from kalux.calibration.photographs import read_exposure, read_photograph
from kalux.calibration.response import (
    aligned,
    calibrate_response,
    smooth_knots,
)
from kalux.errors import FormatError, FrameError, InputError, MissingDependencyError
from kalux.models.camera import Response

from builders import blocks

TIMES = [0.001, 0.003, 0.01, 0.03, 0.1]


def picture():
    return cv2.GaussianBlur(blocks(0.5, 300.0, shape=(80, 96)), (0, 0), 1.0)


def exposed(response, times=TIMES):
    return [np.rint(255 * response(np.minimum(picture() * t, 1.0))).astype(np.uint8) for t in times]


@pytest.mark.parametrize("name", ["linear", "srgb", "gamma:1.6"])
def test_known_responses_are_recovered(name):
    truth = Response.named(name)
    found = calibrate_response(exposed(truth), TIMES)
    level = np.linspace(0.05, 0.95, 50)
    assert np.abs(truth(found.curves[0].inverse(level)) - level).max() < 0.03
    assert found.residual < 0.01
    np.testing.assert_allclose(
        Response.named(found.setting).inverse(level), found.curves[0].inverse(level), atol=1e-4
    )


def test_photographs_are_predicted_to_two_percent_of_full_scale(shared_data):
    """Every pixel of seven photographs, 1/4096 to 2 s, from the radiance merged from them; clipped pixels included."""
    pytest.importorskip("PIL")
    paths = sorted((shared_data / "exposures").glob("*.jpg"))
    times = [read_exposure(path).seconds for path in paths]
    assert sorted(times) == [2.0**-k for k in (12, 10, 7, 5, 3, 1, -1)]
    found = calibrate_response([read_photograph(path) for path in paths], times)
    assert found.residual < 0.02
    assert np.sqrt(np.mean(found.left_out**2)) < 0.03
    weight = found.curves[0].weight(np.array([0.1, 0.5, 0.97]))
    assert weight[0] > weight[1] > weight[2] > 0
    assert found.calibration().settings["camera"]["response"].startswith("curve:0 ")


def test_a_curve_per_channel():
    curves = [Response.gamma(g) for g in (1.0, 1.5, 2.0)]
    images = [np.stack(channels, axis=-1) for channels in zip(*(exposed(c) for c in curves), strict=True)]
    found = calibrate_response(images, TIMES, per_channel=True)
    assert found.setting.count(";") == 2
    middle = [float(curve.inverse(np.array([0.5]))[0]) for curve in found.curves]
    np.testing.assert_allclose(middle, [0.5, 0.5**1.5, 0.25], atol=0.02)


def test_images_are_put_onto_one_another():
    images = np.stack(exposed(Response.linear(), [0.005, 0.01, 0.02]))[..., None]
    moved = np.stack([np.roll(images[0], (2, -1), (0, 1)), images[1], np.roll(images[2], (-1, 3), (0, 1))])
    put = aligned(moved)
    for one, other in ((put[0], put[1]), (put[2], put[1])):
        assert np.corrcoef(np.minimum(one, 120).ravel(), np.minimum(other, 120).ravel())[0, 1] > 0.9
    still = aligned(images)
    assert still.shape == images.shape


def test_knots_are_monotone_whatever_the_table():
    rng = np.random.default_rng(0)
    knots = smooth_knots(np.abs(np.linspace(0, 1, 256) + 0.3 * rng.standard_normal(256)), np.ones(256))
    assert (np.diff(knots) > 0).all()
    assert (knots[0], knots[-1]) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("images", "times", "kind", "message"),
    [
        (exposed(Response.linear())[:2], TIMES[:2], InputError, "three exposure times"),
        (exposed(Response.linear()), TIMES[:3], InputError, "5 images and 3 exposure times"),
        (exposed(Response.linear()), [-1.0, *TIMES[1:]], InputError, "must be positive"),
        ([image.astype(np.float32) for image in exposed(Response.linear())], TIMES, FrameError, "8 bits"),
        (
            [*exposed(Response.linear())[:4], np.zeros((4, 4), np.uint8)],
            TIMES,
            FrameError,
            "all must be alike",
        ),
        (
            exposed(Response.linear()),
            TIMES[::-1],
            InputError,
            "no curve fits the images; do they show one still",
        ),
        ([np.zeros((80, 96), np.uint8)] * 5, TIMES, InputError, "0 pixels are well exposed"),
    ],
)
def test_what_cannot_be_used_is_refused(images, times, kind, message):
    with pytest.raises(kind, match=message):
        calibrate_response(images, times)


def test_a_photograph_without_exposure_time(tmp_path):
    pytest.importorskip("PIL")
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 4), np.uint8))
    with pytest.raises(InputError, match="no exposure time"):
        read_exposure(tmp_path / "a.png")


def test_a_photograph_with_damaged_exif(shared_data, tmp_path):
    pytest.importorskip("PIL")
    data = min((shared_data / "exposures").glob("*.jpg")).read_bytes()
    (tmp_path / "a.jpg").write_bytes(data.replace(b"Exif\0\0MM\0*", b"Exif\0\0MM7*", 1))
    with pytest.raises(FormatError, match=r"a\.jpg: not an image, or damaged"):
        read_exposure(tmp_path / "a.jpg")


def test_a_shutter_speed_beyond_numbers_is_left_aside(tmp_path):
    pillow = pytest.importorskip("PIL.Image")
    exif = pillow.Exif()
    exif[0x8769] = {0x829A: 0.125, 0x9201: -5000.0}  # ExposureTime, ShutterSpeedValue
    pillow.new("L", (4, 4)).save(tmp_path / "a.jpg", exif=exif)
    assert read_exposure(tmp_path / "a.jpg").seconds == 0.125


def test_the_figure_needs_matplotlib_and_says_so(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib", None)
    with pytest.raises(MissingDependencyError, match=r"kalux\[plots\]"):
        require_matplotlib()


def test_the_figure_is_a_picture():
    pytest.importorskip("matplotlib")
    assert response_figure([Response.srgb()]).startswith(b"\x89PNG")
