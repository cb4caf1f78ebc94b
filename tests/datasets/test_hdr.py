"""HDR references from brackets: the response, radiance, and what is left out."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.calibration.response import calibrate_response
from kalux.datasets.brackets import Picture, read_bracket
from kalux.datasets.hdr import hdr_reference, measured_exposures, recover_response
from kalux.errors import InputError
from kalux.models.camera import Response
from kalux.models.colour import LUMINANCE
from photographs import SHAPE, TIMES, photographs, scene_radiance


@pytest.fixture
def scene():
    return scene_radiance()


def relative_error(reference, radiance):
    """Robust standard deviation and 99th percentile of the log ratio, the scale taken off."""
    compared = reference.valid & (radiance.mean(axis=2) > 0.02)
    logs = np.log(reference.luminance[compared] / (radiance @ LUMINANCE)[compared])
    logs -= np.median(logs)
    return 1.4826 * np.median(np.abs(logs)), np.percentile(np.abs(logs), 99)


@pytest.mark.parametrize(
    ("curve", "within"), [(Response.srgb(), 0.1), (Response.gamma(1.8), 0.1), (Response.linear(), 0.25)]
)
def test_the_response_is_recovered(scene, curve, within):
    """Although exposures with equal ratios leave ripples of that period open, widest for a linear camera."""
    found = recover_response(photographs(scene, response=curve))
    level = np.linspace(30, 240, 50) / 255
    logs = np.log(found.inverse(level) / curve.inverse(level))
    assert np.abs(logs - np.median(logs)).max() < within


def test_the_response_is_that_which_a_calibration_finds(scene):
    """Of the very same photographs; and it is Debevec's, whose curve is right to a percent."""
    pictures = photographs(scene)
    found = recover_response(pictures)
    calibrated = calibrate_response([p.levels for p in pictures], [p.exposure for p in pictures])
    level = np.linspace(0, 1, 256)
    assert calibrated.fits[0][0].method == "debevec"
    assert np.array_equal(found.inverse(level), calibrated.curves[0].inverse(level))
    logs = np.log(found.inverse(level[20:245]) / Response.srgb().inverse(level[20:245]))
    assert np.std(logs) < 0.01


def test_radiance_is_measured(scene):
    found = hdr_reference(photographs(scene), aligned=False)
    typical, worst = relative_error(found, scene)
    assert typical < 0.02
    assert worst < 0.08
    assert found.valid.mean() > 0.98
    assert found.exposure == pytest.approx(np.median(TIMES), rel=0.05)
    assert relative_error(hdr_reference(photographs(scene), response="robertson"), scene)[0] < 0.3


def test_a_spread_that_is_only_the_least_is_not_said_to_be_measured(scene):
    exact = [Picture(str(t), np.rint(65535 * np.clip(scene * t, 0, 1)).astype(np.uint16), t) for t in TIMES]
    said = hdr_reference(exact, response=Response.linear(), aligned=False).said[-1]
    assert said == "exposures are taken to agree within 3 %, the least (one standard deviation)"


def test_grey_and_16_bits(scene):
    linear = [
        Picture(str(t), np.rint(65535 * np.clip(scene[..., 1] * t, 0, 1)).astype(np.uint16), t) for t in TIMES
    ]
    found = hdr_reference(linear, response=Response.linear(), aligned=False)
    ratio = (found.radiance / (scene[..., 1] * found.exposure))[found.valid]
    assert np.abs(ratio - 1).max() < 0.01
    with pytest.raises(InputError, match="16 bits cannot be recovered"):
        hdr_reference(linear)


def test_what_is_clipped_in_every_exposure_is_not_valid(scene):
    bright = scene.copy()
    bright[20:40, 30:60] = 500.0
    bright[100:120, 30:60] = 1e-6
    found = hdr_reference(photographs(bright), aligned=False)
    assert not found.valid[21:39, 31:59].any()
    assert not found.valid[101:119, 31:59].any()
    assert (found.luminance[21:39, 31:59] > 0.9 * found.exposure / TIMES[-1]).all()
    assert (found.luminance[101:119, 31:59] < 0.01).all()


@pytest.mark.parametrize("exposure", range(len(TIMES)))
def test_what_moved_is_left_out(scene, exposure):
    """A grey box passes through one of the exposures, over bright and dark: the radiance is that without it."""

    def box(k, radiance):
        if k != exposure:
            return radiance
        changed = radiance.copy()
        changed[60:110, 80:150] = 0.4 / TIMES[exposure]
        return changed

    pictures = photographs(scene, change=box)
    truth = scene[60:110, 80:150] @ LUMINANCE
    found, kept = (hdr_reference(pictures, aligned=False, ghosts=g) for g in (True, False))
    still = hdr_reference(photographs(scene), aligned=False)
    scale = np.median((still.luminance / (scene @ LUMINANCE))[still.valid])

    def wrong(reference):
        seen = np.maximum(reference.luminance[60:110, 80:150], 1e-6)
        off = np.abs(np.log(seen / scale / truth))
        return np.mean((off > 0.2) & reference.valid[60:110, 80:150])

    assert wrong(found) < 0.02
    if exposure == 0:  # the longest has the most weight
        assert wrong(kept) > 0.3
    outside = np.ones(SHAPE, bool)
    outside[55:115, 75:155] = False
    assert found.valid[outside].mean() > 0.97


def test_a_majority_is_needed(scene):
    """Of two exposures that see different things neither is believed."""
    first, second = photographs(scene, times=(1.0, 0.5))
    levels = second.levels.copy()
    levels[60:110, 80:150] = 250 - levels[60:110, 80:150] // 2
    changed = [first, Picture("1", levels, 0.5)]
    found = hdr_reference(changed, response=Response.srgb(), aligned=False)
    assert found.valid[62:108, 82:148].mean() < 0.2


def test_exposures_are_measured(scene):
    pictures = photographs(scene)
    stated = [Picture(p.name, p.levels, p.exposure * (1.3 if k == 3 else 1)) for k, p in enumerate(pictures)]
    found = measured_exposures(stated, Response.srgb(), [np.ones(SHAPE, bool)] * 4)
    assert np.allclose(found, TIMES, rtol=0.02)


def test_a_real_bracket(shared_data):
    pytest.importorskip("PIL")
    found = hdr_reference(read_bracket(shared_data / "exposures"))
    assert found.valid.mean() > 0.95
    lit = found.luminance[found.valid]
    assert np.percentile(lit, 99.9) / np.percentile(lit, 1) > 1e4
