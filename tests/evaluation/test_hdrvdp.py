"""HDR-VDP against the original, stage by stage where a stage has a law of its own, and by its properties."""

from __future__ import annotations

import json
from dataclasses import astuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import fft, ndimage

from kalux.errors import InputError
from kalux.evaluation import HdrVdp, hdrvdp
from kalux.evaluation.hdr_vdp import constants, differences, pathway, pyramid, resampling, sensitivity
from kalux.evaluation.hdr_vdp.differences import band_errors

# shape, log10 luminance, pixels per degree, and what HDR-VDP 3.0.6 (the authors' MATLAB source, run in GNU Octave
# 7.3.0 with image 2.14.0) returns for `waves`: Q and Q_JOD of task "side-by-side", colour encoding "luminance".
ORIGINAL = [
    ((45, 61), 1.0, 26.398591232, 7.54907681670373, 8.36011816556768),
    ((48, 64), -2.0, 26.398591232, 9.43371427322929, 9.74904689468279),
    ((10, 200), 3.0, 26.398591232, 6.978124798243, 7.85546258732224),
    ((45, 61), 1.0, 15.0, 7.14082160513352, 8.0022569080861),
    ((131, 77), 1.0, 60.0, 8.35520541569101, 9.01624803728642),
]


def waves(shape, level):
    """A reference over two decades, and a test with a pattern on it and its highlights cut."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    reference = 10 ** (level + np.sin(x / 5) * np.cos(y / 7))
    return np.minimum(reference * (1 + 0.1 * np.sin(x * y / 11)), 10 ** (level + 0.7)), reference


def scene(shape=(96, 120), seed=0):
    rng = np.random.default_rng(seed)
    smooth = sum(size * ndimage.gaussian_filter(rng.normal(size=shape), size) for size in (1, 3, 9))
    return 10 ** (1.5 + smooth / smooth.std() / 2)


@pytest.mark.parametrize(("shape", "level", "pixels_per_degree", "q", "jod"), ORIGINAL)
def test_the_original_agrees(shape, level, pixels_per_degree, q, jod):
    found = hdrvdp(*waves(shape, level), pixels_per_degree=pixels_per_degree)
    assert astuple(found) == pytest.approx((q, jod), abs=1e-9)


def test_the_reference_pairs_agree(shared_data):
    folder = shared_data.parent / "reference" / "hdrvdp"
    if not folder.is_dir():
        pytest.skip(f"needs the reference pairs in {folder}")
    expected = json.loads((folder / "expected.json").read_text())
    with np.load(folder / "pairs.npz") as pairs:
        for case in expected:
            test, reference = (pairs[f"{case['name']}_{image}"] for image in ("test", "ref"))
            found = hdrvdp(test, reference, pixels_per_degree=case["pixels_per_degree"])
            assert astuple(found) == pytest.approx((case["Q"], case["Q_JOD"]), abs=1e-9), case["name"]
            errors = band_errors(
                test.astype(float), reference.astype(float), pixels_per_degree=case["pixels_per_degree"]
            )
            np.testing.assert_allclose(
                errors, case["Q_err_band"], rtol=1e-9, atol=1e-15, err_msg=case["name"]
            )
            levels = pyramid.height(test.shape, case["pixels_per_degree"])
            assert pyramid.frequencies(levels, case["pixels_per_degree"]) == case["band_freq"]


@pytest.mark.parametrize("shape", [(9, 9), (9, 300), (61, 46), (128, 128)])
def test_equal_images_are_of_the_best_quality(shape):
    assert hdrvdp(scene(shape), scene(shape)) == HdrVdp(10.0, 10.0)


@pytest.mark.parametrize("level", [0.0, 1e-6, 1.0, 1e8])
def test_uniform_images_hold_no_contrast(level):
    uniform = np.full((64, 80), level)
    assert hdrvdp(uniform, uniform).Q == 10
    assert hdrvdp(2 * uniform, uniform).Q > 10 - 1e-5


def test_quality_falls_as_noise_grows():
    reference = scene()
    noise = np.random.default_rng(1).normal(size=reference.shape)
    qualities = [
        hdrvdp(reference * np.exp(amount * noise), reference) for amount in (0.01, 0.03, 0.1, 0.3, 1)
    ]
    assert np.all(np.diff([found.Q for found in qualities]) < 0)
    assert np.all(np.diff([found.Q_JOD for found in qualities]) < 0)


def test_which_image_is_the_reference_hardly_matters():
    reference = scene()
    test = reference * np.exp(np.random.default_rng(1).normal(0, 0.2, reference.shape))
    one_way, other_way = hdrvdp(test, reference), hdrvdp(reference, test)
    assert astuple(one_way) == pytest.approx(astuple(other_way), abs=0.01)


def test_a_mirrored_world_looks_the_same():
    test, reference = waves((64, 96), 1.0)
    upright, on_its_side = hdrvdp(test, reference), hdrvdp(test.T, reference.T)
    assert astuple(on_its_side) == pytest.approx(astuple(upright), abs=1e-9)


def test_darkness_hides_what_daylight_shows():
    test, reference = waves((64, 96), 0.0)
    by_night, by_day = hdrvdp(test * 1e-3, reference * 1e-3), hdrvdp(test * 1e2, reference * 1e2)
    assert by_night.Q > by_day.Q + 1


def test_inputs_are_left_as_they_are():
    test, reference = (image.astype(np.float32) for image in waves((40, 50), 1.0))
    before = test.copy(), reference.copy()
    test.setflags(write=False)
    hdrvdp(test, reference)
    np.testing.assert_array_equal(test, before[0])
    np.testing.assert_array_equal(reference, before[1])


class TestStages:
    def test_glare_is_the_filter_of_an_image_mirrored_in_full(self):
        image = scene((37, 50))
        mirrored = np.block([[image, image[:, ::-1]], [image[::-1], image[::-1, ::-1]]])
        frequency = np.hypot(fft.fftfreq(74)[:, None], fft.fftfreq(100)) * 30
        whole = fft.ifft2(fft.fft2(mirrored) * sensitivity.modulation_transfer(frequency)).real
        np.testing.assert_allclose(pathway.scatter(image, 30.0), whole[:37, :50], rtol=1e-12)

    def test_a_small_gaussian_replicates_the_border(self):
        image = scene((30, 40))
        blurred = ndimage.gaussian_filter(image, 2.0, radius=6, mode="nearest")
        np.testing.assert_allclose(pathway.gaussian(image, 2.0), blurred, rtol=1e-12)

    def test_a_large_gaussian_wraps_the_last_row_and_column_around(self):
        image = scene((30, 40))
        padded = np.pad(image, ((60, 60), (80, 80)), mode="edge")
        padded[:60] = padded[[89]]
        padded[:, :80] = padded[:, [119]]
        blurred = ndimage.gaussian_filter(padded, 5.0, radius=45)[60:90, 80:120]
        np.testing.assert_allclose(pathway.gaussian(image, 5.0), blurred, rtol=1e-9)

    def test_pupils_at_the_standard_light(self):
        # Stanley and Davies: 7.75 mm in the dark, 2 mm in the brightest light.
        observer, standard = (7.75 + (age - 28.58) * (0.02132 - 0.009562 * 7.75) for age in (24, 28))
        assert pathway.pupil_gain(0.0, 100.0) == pytest.approx((observer / standard) ** 2)

    def test_rods_see_in_the_dark_and_cones_by_day(self):
        tables = sensitivity.response_tables()
        cones, rods = np.diff(tables.cones), np.diff(tables.rods)
        assert (cones > 0).all()
        assert (rods >= 0).all()
        dark, bright = 600, 1400  # 0.01 and 100 cd/m2
        assert rods[dark] > 1.5 * cones[dark]
        assert cones[bright] > 1000 * rods[bright]

    def test_contrast_sensitivity_peaks_between_1_and_8_cycles_per_degree(self):
        by_frequency = [sensitivity.contrast_sensitivity(f, np.array([2.0]))[0] for f in (0.1, 1, 3, 30)]
        assert max(by_frequency) == by_frequency[2]
        assert sensitivity.contrast_sensitivity(0.0, np.array([2.0]))[0] == 0

    @pytest.mark.parametrize("name", ["HIGH_RESIDUAL", "LOW_RESIDUAL", "BAND", "LOW_PASS"])
    @pytest.mark.parametrize("step", [1, 2])
    def test_correlation_mirrors_at_edge_pixels(self, name, step):
        quadrant = np.array(getattr(constants, name))
        half = np.concatenate([quadrant[:0:-1], quadrant])
        kernel = np.concatenate([half[:, :0:-1], half], axis=1)
        image = scene((21, 26))
        expected = ndimage.correlate(image, kernel, mode="mirror")[::step, ::step]
        np.testing.assert_allclose(pyramid.correlate(image, name, step), expected, atol=1e-12 * image.max())

    @pytest.mark.parametrize(
        ("shape", "pixels_per_degree", "levels"),
        [
            ((480, 640), 26.4, 3),
            ((12, 640), 26.4, 0),
            ((13, 13), 26.4, 1),
            ((480, 640), 2.1, 0),
            ((480, 640), 60, 4),
        ],
    )
    def test_the_pyramid_is_as_high_as_size_and_resolution_let_it(self, shape, pixels_per_degree, levels):
        assert pyramid.height(shape, pixels_per_degree) == levels

    def test_masking_is_the_mean_of_what_both_bands_hold(self):
        first, second = scene((12, 17), 1) - 30, scene((12, 17), 2) - 30
        common = np.minimum(abs(first), abs(second))
        expected = ndimage.convolve(common, np.full((3, 3), 1 / 9), mode="constant")
        np.testing.assert_allclose(differences.mutual_masking(first, second), expected, rtol=1e-12)

    @pytest.mark.parametrize(("row", "column"), [(0, 3), (5, 0), (5, 3), (8, 16)])
    def test_the_dominant_frequency_of_a_grating(self, row, column):
        y, x = np.mgrid[:16, :32]
        grating = 7 + np.cos(2 * np.pi * (row * y / 16 + column * x / 32))
        expected = np.hypot(row / 16, column / 32) * 8
        assert differences.dominant_frequency(grating, 8.0) == pytest.approx(expected)

    @given(size=st.integers(1, 40), more=st.integers(0, 40))
    @settings(max_examples=60, deadline=None)
    def test_more_pixels_keep_a_uniform_map(self, size, more):
        np.testing.assert_allclose(resampling.resize(np.ones((size, 3)), (size + more, 3)), 1, rtol=1e-12)

    @pytest.mark.parametrize(("size", "tolerance"), [(2, 1e-12), (346, 1e-12), (13, 3e-3), (121, 2e-4)])
    def test_half_the_pixels_keep_a_uniform_map_nearly(self, size, tolerance):
        half = resampling.resize(np.ones((size, 3)), (-(-size // 2), 3))
        np.testing.assert_allclose(half, 1, rtol=tolerance)

    def test_resampling_to_twice_the_size_and_back_by_hand(self):
        # Keys' kernel (a = -1/2) at distances of 1/4, 3/4, 5/4, 7/4.
        near, far, beyond, last = 0.8671875, 0.2265625, -0.0703125, -0.0234375
        row = np.array([[0, 0, 0, 1, 0, 0, 0]], float)
        twice = np.array([[0, 0, last, beyond, far, near, near, far, beyond, last, 0, 0, 0, 0]])
        twice = np.roll(twice, 1, axis=1)
        np.testing.assert_allclose(resampling.resize(row, (1, 14)), twice, atol=1e-15)


class TestErrors:
    @pytest.mark.parametrize(
        ("test", "reference", "message"),
        [
            (np.ones((20, 30)), np.ones((30, 20)), "differ in shape"),
            (np.ones((20, 30, 3)), np.ones((20, 30, 3)), r"\(H, W\)"),
            (np.ones((8, 300)), np.ones((8, 300)), "too small"),
            (np.ones((0, 9)), np.ones((0, 9)), "empty"),
            (np.ones((20, 30), complex), np.ones((20, 30)), "real numbers"),
        ],
    )
    def test_images_that_cannot_be_compared(self, test, reference, message):
        with pytest.raises(InputError, match=message):
            hdrvdp(test, reference)

    @pytest.mark.parametrize(
        ("value", "message"), [(-1.0, "negative"), (np.nan, "not finite"), (np.inf, "finite")]
    )
    def test_bad_values_are_counted(self, value, message):
        good, bad = np.ones((20, 30)), np.ones((20, 30))
        bad[3, 4:7] = value
        with pytest.raises(InputError, match=rf"test: 3 of 600 values are .*{message}"):
            hdrvdp(bad, good)
        with pytest.raises(InputError, match=r"reference: 3 of 600"):
            hdrvdp(good, bad)

    @pytest.mark.parametrize("pixels_per_degree", [0.0, 2.0, -30.0, np.nan, np.inf, 1001, 1e6, "26"])
    def test_resolution(self, pixels_per_degree):
        with pytest.raises(InputError, match="pixels_per_degree"):
            hdrvdp(np.ones((20, 30)), np.ones((20, 30)), pixels_per_degree=pixels_per_degree)
