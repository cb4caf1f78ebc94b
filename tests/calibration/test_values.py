"""Calibrations as values and as files."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

import kalux
from kalux import PRESETS, Frame, Reconstructor, Recording, load_calibration, settings
from kalux.calibration.values import Calibration, describe_calibration
from kalux.datasets import SensorSettings
from kalux.errors import FormatError, InputError, SettingsError
from kalux.pipeline import execute
from kalux.planning import plan
from kalux.settings import altered
from kalux.writers.calibration import save_calibration

from builders import events, moving_blocks, pixel_events

SHAPE = (3, 4)


def full():
    rng = np.random.default_rng(0)
    maps = {
        "threshold_on": rng.uniform(0.8, 1.2, SHAPE),
        "threshold_off": rng.uniform(0.8, 1.2, SHAPE),
        "threshold_on_variance": np.full(SHAPE, 0.01),
        "threshold_off_variance": np.full(SHAPE, 0.02),
        "hot": np.eye(*SHAPE, dtype=bool),
    }
    known = {"events": {"threshold_on": 0.3, "threshold_off": 0.25}, "camera": {"frame_noise": 0.004}}
    return Calibration(known, {"threshold_on": 0.01}, {"read_noise": 0.002}, maps, {"command": "by hand"})


def test_files_give_back_what_was_written(tmp_path):
    written = save_calibration(full(), tmp_path / "c.toml")
    assert [path.name for path in written] == ["c.npz", "c.toml"]
    again = load_calibration(tmp_path / "c.toml")
    before = full()
    assert (again.settings, again.errors, again.measured) == (before.settings, before.errors, before.measured)
    for name, values in before.maps.items():
        np.testing.assert_allclose(again.maps[name], values, rtol=1e-6)


def test_the_same_calibration_is_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        save_calibration(full(), tmp_path / name / "c.toml")
    for name in ("c.toml", "c.npz"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_the_file_says_units_and_is_a_settings_file_too(tmp_path):
    save_calibration(full(), tmp_path / "c.toml")
    assert "threshold_on = 0.3  # log intensity" in (tmp_path / "c.toml").read_text()
    assert settings.load(tmp_path / "c.toml", PRESETS["default"]).events.threshold_on == 0.3


@pytest.mark.parametrize("data", [b"", b"x", b"PK\x03\x04 no archive", b"\x93NUMPY\x01\x00"])
def test_maps_that_fit_their_checksum_but_are_none(tmp_path, data):
    path = tmp_path / "c.toml"
    path.with_suffix(".npz").write_bytes(data)
    path.write_text(
        f'kalux_calibration = 1\n[maps]\nfile = "c.npz"\nsha256 = "{hashlib.sha256(data).hexdigest()}"'
    )
    with pytest.raises(FormatError, match="no maps as kalux writes them"):
        load_calibration(path)


def test_a_map_of_text_is_refused(tmp_path):
    path = tmp_path / "c.toml"
    np.savez(path.with_suffix(".npz"), noise_rate=np.full((3, 4), b"abc"))
    checksum = hashlib.sha256(path.with_suffix(".npz").read_bytes()).hexdigest()
    path.write_text(f'kalux_calibration = 1\n[maps]\nfile = "c.npz"\nsha256 = "{checksum}"')
    with pytest.raises(FormatError, match=r"map noise_rate is \|S3; numbers are needed"):
        load_calibration(path)


@pytest.mark.parametrize(
    ("damage", "kind", "message"),
    [
        (lambda p: p.with_suffix(".npz").write_bytes(b"x"), FormatError, "checksum"),
        (lambda p: p.with_suffix(".npz").unlink(), FormatError, "cannot be read"),
        (lambda p: p.unlink(), InputError, "cannot be read"),
        (lambda p: p.write_text("a = ["), FormatError, "not valid TOML"),
        (lambda p: p.write_text("a = 1"), FormatError, "not a calibration"),
        (lambda p: p.write_text("kalux_offset = 1"), FormatError, "it is for kalux register --offset"),
        (lambda p: p.write_text("kalux_rig = 1"), FormatError, "it is for kalux register --rig"),
        (lambda p: p.write_text("kalux_calibration = 99"), FormatError, "version 99"),
        (
            lambda p: p.write_text("kalux_calibration = 1\n[settings.events]\nnonsense = 1"),
            SettingsError,
            "nonsense",
        ),
        *(
            (
                lambda p, name=name: p.write_text(
                    f'kalux_calibration = 1\n[maps]\nfile = "{name}"\nsha256 = ""'
                ),
                FormatError,
                "beside it",
            )
            for name in ("../c.npz", "..", "", r"\u0000")
        ),
    ],
)
def test_damage_is_one_clear_line(tmp_path, damage, kind, message):
    path = tmp_path / "c.toml"
    save_calibration(full(), path)
    damage(path)
    with pytest.raises(kind, match=message) as raised:
        load_calibration(path)
    assert str(tmp_path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_the_last_of_several_wins_and_brings_its_error():
    merged = full().merged(Calibration({"events": {"threshold_on": 0.5}}))
    assert merged.settings["events"] == {"threshold_on": 0.5, "threshold_off": 0.25}
    assert "threshold_on" not in merged.errors
    assert "hot" in merged.maps


def test_of_several_a_doubtful_white_is_kept_as_long_as_levels_are_shares_of_it():
    """Thresholds are not; a level that is measured again is not any more."""
    doubtful = Calibration(
        {"camera": {"saturation": 0.03}}, provenance={"white": 65535.0, "white_is_doubtful": True}
    )
    sure = {"white": 4095.0, "white_is_doubtful": False}
    thresholds = Calibration({"events": {"threshold_on": 0.2}}, provenance=sure)
    black = Calibration({"camera": {"black_level": 0.1}}, provenance=sure)
    better = Calibration({"camera": {"saturation": 0.9}}, provenance=sure)
    whites = [
        a.merged(b).provenance["white"]
        for a, b in [
            (doubtful, thresholds),
            (thresholds, doubtful),
            (doubtful, black),
            (doubtful, better),
            (black, doubtful),
        ]
    ]
    assert whites == [65535, 65535, 65535, 4095, 65535]


def test_text_has_values_errors_and_units():
    rows = dict(describe_calibration(full()))
    assert rows["threshold_on"] == "0.3 +- 0.01  (log intensity)"
    assert rows["map hot"] == "4x3: 3 pixels"
    assert rows["map threshold_on_variance"] == "4x3: median 0.01, 5 to 95 % from 0.01 to 0.01"
    curve = "curve:" + " ".join(["0.125"] * 33)
    ((_, short),) = describe_calibration(Calibration({"camera": {"response": curve}}))
    assert (short[:37], len(short.split("  ")[0])) == (curve[:37], 40)


# --- in a reconstruction ---------------------------------------------------------------------------------------


def recording(rows):
    frames = [Frame(np.full(SHAPE, 100, np.uint8), t, t + 5_000) for t in (0, 40_000, 80_000)]
    return Recording.from_arrays(rows, frames, sensor_size=SHAPE)


def test_events_of_hot_pixels_change_nothing():
    hot = Calibration(maps={"hot": np.eye(*SHAPE, dtype=bool)})
    some = events((10_000, 1, 0, 1), (20_000, 1, 1, 1), (30_000, 1, 1, 0), (50_000, 0, 0, 1))
    without = some[[0]]
    for smooth in (False, True):
        one, other = (
            [
                image.intensity
                for image in kalux.reconstruct(
                    recording(rows), times=[20_000, 60_000], calibration=hot, smooth=smooth
                )
            ]
            for rows in (some, without)
        )
        np.testing.assert_array_equal(one, other)


def test_pixels_whose_thresholds_are_not_mapped_differ_by_the_spread_that_is_found():
    """A file of hot pixels changes no image: neither the spread that a recording shows, nor one that is stated."""
    source = moving_blocks(sensor=SensorSettings(threshold_mismatch=0.15)).recording()
    known = Calibration(maps={"hot": np.zeros(source.sensor_size, np.bool_)})
    stated = altered(PRESETS["default"], "events", threshold_spread=0.03)
    for chosen in (None, stated):
        without, made = (plan(source, at="frames", settings=chosen, calibration=c) for c in (None, known))
        assert made.settings == without.settings
        assert (made.pixels.on_variance == made.settings.events.mismatch**2).all()
        images = [list(execute(source, each)) for each in (without, made)]
        for one, other in zip(*images, strict=True):
            np.testing.assert_allclose(one.intensity, other.intensity, rtol=1e-5)
    live = Reconstructor(source.sensor_size, settings=stated, calibration=known)
    assert live.settings.events.mismatch == 0.03
    assert known.pixels_of(0.03).off_variance.max() == 0.03**2


def test_thresholds_of_pixels_are_the_priors():
    """Beyond the last frame an event moves a pixel by its own threshold."""
    maps = full().maps
    known = Calibration({"events": {"threshold_on": 0.3, "threshold_off": 0.3, "noise_rate": 0.0}}, maps=maps)
    alone = altered(known.apply(PRESETS["default"]), "filter", neighbours=0.0)
    with pytest.warns(UserWarning, match="none of the 1 events lies between"):
        moving = recording(pixel_events([100_000], [1], x=0, y=1))
    images = list(kalux.reconstruct(moving, times=[90_000, 100_000], settings=alone, calibration=known))
    moved = np.log((images[1].intensity + 0.03) / (images[0].intensity + 0.03))
    assert moved[1, 0] == pytest.approx(0.3 * maps["threshold_on"][1, 0], rel=0.02)
    assert np.abs(np.delete(moved.ravel(), 4)).max() < 1e-6


def test_a_spread_that_is_left_open_is_the_usual():
    known = Calibration({"events": {"threshold_spread": "auto"}}, maps={"hot": np.zeros((4, 3), bool)})
    assert (known.pixels.on_variance == PRESETS["default"].events.usual_threshold_spread ** 2).all()


def test_calibrated_thresholds_count_as_measured_not_as_given():
    rows = pixel_events([10_000], [1])
    known = Calibration({"events": {"threshold_on": 0.3, "threshold_off": 0.25}})
    assert plan(recording(rows), rate_hz=10, calibration=known).threshold_origin == "calibration"
    given = altered(known.apply(PRESETS["default"]), "events", threshold_on=0.4)
    assert plan(recording(rows), rate_hz=10, calibration=known, settings=given).threshold_origin == "settings"


def test_a_calibration_of_another_sensor_is_refused():
    wrong = Calibration(maps={"hot": np.zeros((5, 5), bool)})
    with pytest.raises(InputError, match="5x5 pixels, the sensor has 4x3"):
        plan(recording(pixel_events([10_000], [1])), rate_hz=10, calibration=wrong)
