"""HDR references from brackets: the response, radiance, what moved, alignment; files and what is refused."""

from __future__ import annotations

import csv
import io

import cv2
import numpy as np
import pytest

from kalux.calibration.response import calibrate_response
from kalux.datasets import hdr
from kalux.datasets.registration import warped
from kalux.errors import FormatError, InputError
from kalux.models.camera import Response
from kalux.models.colour import LUMINANCE

from builders import blocks

TIMES = (4.0, 1.0, 1 / 4, 1 / 16)
SHAPE = (200, 260)


@pytest.fixture(scope="module")
def scene():
    """Radiance from 0.01 to 12: (H, W, 3), colours that are not far from grey."""
    grey = cv2.GaussianBlur(blocks(0.01, 12.0, shape=SHAPE), (0, 0), 0.7)
    return grey[..., None] * np.array([0.8, 1.0, 1.2])


def photographs(radiance, *, response=None, times=TIMES, change=None, seed=0):
    """What a camera of 8 bits with shot noise makes of it; ``change(k, radiance)`` alters exposure k."""
    rng, curve = np.random.default_rng(seed), response or Response.srgb()
    found = []
    for k, seconds in enumerate(times):
        seen = radiance if change is None else change(k, radiance)
        light = np.clip(seen * seconds, 0, 1)
        light = np.clip(light + rng.normal(size=light.shape) * np.sqrt(light / 8000 + 4e-7), 0, 1)
        found.append(hdr.Picture(f"{k}.png", np.rint(255 * curve(light)).astype(np.uint8), seconds))
    return found


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
    found = hdr.recover_response(photographs(scene, response=curve))
    level = np.linspace(30, 240, 50) / 255
    logs = np.log(found.inverse(level) / curve.inverse(level))
    assert np.abs(logs - np.median(logs)).max() < within


def test_the_response_is_that_which_a_calibration_finds(scene):
    """Of the very same photographs; and it is Debevec's, whose curve is right to a percent."""
    pictures = photographs(scene)
    found = hdr.recover_response(pictures)
    calibrated = calibrate_response([p.levels for p in pictures], [p.exposure for p in pictures])
    level = np.linspace(0, 1, 256)
    assert calibrated.fits[0][0].method == "debevec"
    assert np.array_equal(found.inverse(level), calibrated.curves[0].inverse(level))
    logs = np.log(found.inverse(level[20:245]) / Response.srgb().inverse(level[20:245]))
    assert np.std(logs) < 0.01


def test_radiance_is_measured(scene):
    found = hdr.hdr_reference(photographs(scene), aligned=False)
    typical, worst = relative_error(found, scene)
    assert typical < 0.02
    assert worst < 0.08
    assert found.valid.mean() > 0.98
    assert found.exposure == pytest.approx(np.median(TIMES), rel=0.05)
    assert relative_error(hdr.hdr_reference(photographs(scene), response="robertson"), scene)[0] < 0.3


def test_grey_and_16_bits(scene):
    linear = [
        hdr.Picture(str(t), np.rint(65535 * np.clip(scene[..., 1] * t, 0, 1)).astype(np.uint16), t)
        for t in TIMES
    ]
    found = hdr.hdr_reference(linear, response=Response.linear(), aligned=False)
    ratio = (found.radiance / (scene[..., 1] * found.exposure))[found.valid]
    assert np.abs(ratio - 1).max() < 0.01
    with pytest.raises(InputError, match="16 bits cannot be recovered"):
        hdr.hdr_reference(linear)


def test_what_is_clipped_in_every_exposure_is_not_valid(scene):
    bright = scene.copy()
    bright[20:40, 30:60] = 500.0
    bright[100:120, 30:60] = 1e-6
    found = hdr.hdr_reference(photographs(bright), aligned=False)
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
    found, kept = (hdr.hdr_reference(pictures, aligned=False, ghosts=g) for g in (True, False))
    still = hdr.hdr_reference(photographs(scene), aligned=False)
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


def test_nothing_moved_nothing_left_out(scene):
    pictures = photographs(scene)
    everywhere = [np.ones(SHAPE, bool)] * len(pictures)
    found = hdr.consistency(pictures, Response.srgb(), everywhere, 0.03)
    assert found.moved.mean() < 0.002
    assert found.unsettled.mean() < 0.002


def test_a_majority_is_needed(scene):
    """Of two exposures that see different things neither is believed."""
    first, second = photographs(scene, times=(1.0, 0.5))
    levels = second.levels.copy()
    levels[60:110, 80:150] = 250 - levels[60:110, 80:150] // 2
    changed = [first, hdr.Picture("1", levels, 0.5)]
    found = hdr.hdr_reference(changed, response=Response.srgb(), aligned=False)
    assert found.valid[62:108, 82:148].mean() < 0.2


def test_photographs_are_aligned(scene):
    """Shifted and turned by a few pixels: as sharp as if they had not been."""
    turn = np.array([[0.9995, -0.012, 4.0], [0.012, 0.9995, -2.5], [0.0, 0.0, 1.0]])

    def moved(k, radiance):
        return np.nan_to_num(warped(radiance, np.linalg.matrix_power(turn, k), SHAPE)) if k else radiance

    pictures = photographs(scene, change=moved)
    found = hdr.align(pictures)
    best = hdr.best_exposed(pictures)
    assert found[best].said == "the reference of the alignment"
    assert all("aligned" in a.said for k, a in enumerate(found) if k != best)
    inside = np.s_[30:-30, 30:-30]
    still = np.linalg.matrix_power(turn, best)
    truth = np.nan_to_num(warped(scene, still, SHAPE))
    reference = hdr.hdr_reference(pictures, response=Response.srgb())
    light = np.maximum(reference.luminance, 1e-6) / (truth @ LUMINANCE + 1e-6)
    ratio = np.log(light)[inside][reference.valid[inside]]
    assert 1.4826 * np.median(np.abs(ratio - np.median(ratio))) < 0.04


def test_an_exposure_that_cannot_be_aligned_is_told(scene):
    dark = hdr.Picture("dark.png", np.zeros((*SHAPE, 3), np.uint8), 1 / 4000)
    found = hdr.align([*photographs(scene), dark])
    assert "too few to align it" in found[-1].said
    assert found[-1].moved is None


def test_exposures_are_measured(scene):
    pictures = photographs(scene)
    stated = [
        hdr.Picture(p.name, p.levels, p.exposure * (1.3 if k == 3 else 1)) for k, p in enumerate(pictures)
    ]
    found = hdr.measured_exposures(stated, Response.srgb(), [np.ones(SHAPE, bool)] * 4)
    assert np.allclose(found, TIMES, rtol=0.02)


@pytest.mark.parametrize("suffix", [".exr", ".npz"])
def test_files_give_back_what_was_written(scene, tmp_path, suffix):
    found = hdr.hdr_reference(photographs(scene), response=Response.srgb(), aligned=False)
    path = tmp_path / f"scene{suffix}"
    path.write_bytes(hdr.encode_radiance(found, suffix))
    again = hdr.read_radiance(path)
    assert np.array_equal(again.radiance, found.radiance)
    assert np.array_equal(again.valid, found.valid)


def write(folder, pictures):
    folder.mkdir()
    for picture in pictures:
        cv2.imwrite(str(folder / picture.name), picture.levels[..., ::-1])
    return folder


def test_brackets_from_a_folder(scene, tmp_path):
    pictures = photographs(scene)
    folder = write(tmp_path / "b", pictures)
    with (tmp_path / "times.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["file", "exposure_s"])
        rows.writerows([["3.png", "1/16"], ["0.png", 4], ["1.png", 1]])
    found = hdr.read_bracket(folder, tmp_path / "times.csv")
    assert [(p.name, p.exposure) for p in found] == [("0.png", 4.0), ("1.png", 1.0), ("3.png", 1 / 16)]
    assert np.array_equal(found[1].levels, pictures[1].levels)
    assert [p.exposure for p in hdr.read_bracket(folder, TIMES)] == list(TIMES)


@pytest.mark.parametrize(
    ("times", "told"),
    [
        (None, "no exposure time in its EXIF"),
        ([1.0], "1 exposure times for 4 images"),
        ([1.0] * 4, "all exposures are equal"),
        ([1.0, 2.0, -1.0, 3.0], "must be positive"),
    ],
)
def test_exposures_are_needed(scene, tmp_path, times, told):
    folder = write(tmp_path / "b", photographs(scene))
    with pytest.raises(InputError, match=told):
        hdr.read_bracket(folder, times)


def test_damaged_and_unequal_photographs(scene, tmp_path):
    folder = write(tmp_path / "b", photographs(scene))
    cv2.imwrite(str(folder / "1.png"), np.zeros((50, 60, 3), np.uint8))
    with pytest.raises(InputError, match="all must be alike"):
        hdr.read_bracket(folder, TIMES)
    (folder / "1.png").write_bytes(b"text")
    with pytest.raises(FormatError, match=r"1\.png: not an image"):
        hdr.read_bracket(folder, TIMES)
    with pytest.raises(InputError, match="no such folder"):
        hdr.read_bracket(tmp_path / "none")


@pytest.mark.parametrize("listed", ["1/0", "two", "", '"'])
def test_a_list_of_exposures_that_is_none(scene, tmp_path, listed):
    folder = write(tmp_path / "b", photographs(scene))
    times = tmp_path / "times.csv"
    times.write_text(f"file,exposure_s\n0.png,{listed}\n")
    with pytest.raises(FormatError, match=r"times\.csv: not a CSV"):
        hdr.read_bracket(folder, times)


def _zip_of(at, value):
    """The bytes of an .npz of 20 x 30, one of them replaced."""
    file = io.BytesIO()
    np.savez_compressed(file, radiance=np.arange(600.0).reshape(20, 30))
    data = bytearray(file.getvalue())
    data[at] = value
    return bytes(data)


@pytest.mark.parametrize("data", [b"PK\x03\x04 cut off", _zip_of(70, 255), _zip_of(-6, 255)])
def test_damaged_radiance(tmp_path, data):
    (tmp_path / "r.npz").write_bytes(data)
    with pytest.raises(FormatError, match=r"r\.npz: not an \.npz with the array radiance, or damaged"):
        hdr.read_radiance(tmp_path / "r.npz")


def test_validity_must_fit_the_radiance(tmp_path):
    np.savez(tmp_path / "r.npz", radiance=np.ones((20, 30)), valid=np.ones((20, 31), bool))
    with pytest.raises(FormatError, match=r"valid is \(20, 31\), the radiance \(20, 30\)"):
        hdr.read_radiance(tmp_path / "r.npz")


def test_the_exposures_of_a_real_bracket(shared_data):
    """Canon EOS Rebel T2i: shutters are powers of two, which EXIF's exposure times round (1/30, 1/125)."""
    pytest.importorskip("PIL")
    pictures = hdr.read_bracket(shared_data / "exposures")
    stops = [np.log2(p.exposure / pictures[0].exposure) for p in pictures]
    assert np.allclose(stops, [0, -2, -4, -6, -8, -11, -13], atol=1e-9)


def test_a_real_bracket(shared_data):
    pytest.importorskip("PIL")
    found = hdr.hdr_reference(hdr.read_bracket(shared_data / "exposures"))
    assert found.valid.mean() > 0.95
    lit = found.luminance[found.valid]
    assert np.percentile(lit, 99.9) / np.percentile(lit, 1) > 1e4
    assert hdr.response_plot(found.pictures, found.response).shape == (480, 640, 3)
