"""``kalux reconstruct``: outputs that are right and reproducible, and nothing half-written."""

from __future__ import annotations

import csv
import dataclasses
import errno
import os
import signal
import time
import tomllib

import av
import cv2
import numpy as np
import pytest

import kalux
from kalux.calibration.values import Calibration
from kalux.cli import reconstruct as reconstruct_command
from kalux.datasets import SensorSettings, colour_photograph, pan, simulate_colour
from kalux.errors import InputError
from kalux.models.colour import luminance
from kalux.writers import folder
from kalux.writers.calibration import save_calibration

from builders import own_threads


def times_in(path):
    with (path / "timestamps.csv").open() as file:
        return [int(row["t_us"]) for row in csv.DictReader(file)]


def images_in(path):
    return [np.load(file) for file in sorted(path.glob("*.npy"))]


@pytest.fixture(scope="module")
def coloured(tmp_path_factory, write_recording):
    """A recording of a sensor with a mosaic, which does not say so: its pattern is GRBG."""
    painted = np.random.default_rng(0).uniform(0.05, 1.2, (8, 10, 3)).repeat(12, 0).repeat(12, 1)
    scene = colour_photograph(painted, pan(60.0), sensor_size=(32, 40), duration=400_000)
    made = simulate_colour(scene, SensorSettings(), mosaic="GRBG")
    frames = [dataclasses.replace(frame, mosaic=None) for frame in made.frames]
    path = tmp_path_factory.mktemp("coloured") / "rec.h5"
    return write_recording(path, events=[made.events], frames=frames)


class TestColour:
    def test_a_pattern_makes_colours(self, cli, coloured, tmp_path):
        found = cli(
            "reconstruct",
            coloured,
            "-o",
            tmp_path / "o",
            "--format",
            "npy",
            "--at",
            "frames",
            "--bayer",
            "grbg",
        )
        assert found.code == 0, found.err
        assert "Bayer mosaic GRBG, demosaiced after the filter; white balance as-recorded" in found.out
        expected = kalux.reconstruct(kalux.open(coloured, mosaic="GRBG"), at="frames")
        for read, image in zip(images_in(tmp_path / "o"), expected, strict=True):
            np.testing.assert_array_equal(read, [*np.moveaxis(image.colour, 2, 0), image.variance])
        assert tomllib.loads((tmp_path / "o/kalux.toml").read_text())["input"]["bayer"] == "GRBG"

    def test_grey_is_the_luminance(self, cli, coloured, tmp_path):
        flags = ("--format", "npy", "--at", "frames", "--bayer", "GRBG")
        assert cli("reconstruct", coloured, "-o", tmp_path / "c", *flags).code == 0
        assert cli("reconstruct", coloured, "-o", tmp_path / "g", *flags, "--grey").code == 0
        for colour, grey in zip(images_in(tmp_path / "c"), images_in(tmp_path / "g"), strict=True):
            assert grey.shape == (2, 32, 40)
            np.testing.assert_array_equal(grey[0], luminance(np.moveaxis(colour[:3], 0, 2)))

    @pytest.mark.parametrize("name", ["v.mp4", "pictures"])
    def test_videos_and_pictures_are_in_colour(self, cli, coloured, tmp_path, name):
        out = tmp_path / name
        assert cli("reconstruct", coloured, "-o", out, "--rate", 50, "--bayer", "GRBG").code == 0
        if out.suffix:
            with av.open(str(out)) as video:
                picture = next(video.decode(video=0)).to_ndarray(format="rgb24")
        else:
            picture = cv2.imread(str(out / "000000.png"), cv2.IMREAD_UNCHANGED)
            assert picture.dtype == np.uint16
        assert picture.shape == (32, 40, 3)
        assert np.ptp(picture.astype(float), axis=-1).mean() > 0.05 * np.iinfo(picture.dtype).max

    def test_the_gains_that_were_measured_are_written_down(self, cli, coloured, tmp_path):
        flags = ("--at", "frames", "--bayer", "GRBG", "--camera.white-balance", "grey-world")
        assert cli("reconstruct", coloured, "-o", tmp_path / "o", *flags).code == 0
        written = tomllib.loads((tmp_path / "o/kalux.toml").read_text())["settings"]["camera"][
            "white_balance"
        ]
        assert len(written.split(";")) == 3
        again = ("--settings", tmp_path / "o/kalux.toml", "--at", "frames", "--bayer", "GRBG")
        assert cli("reconstruct", coloured, "-o", tmp_path / "again", *again).code == 0
        for file in (tmp_path / "o").glob("*.png"):
            assert file.read_bytes() == (tmp_path / "again" / file.name).read_bytes()

    def test_an_unknown_pattern_is_one_line(self, cli, coloured, tmp_path):
        found = cli("reconstruct", coloured, "-o", tmp_path / "o", "--bayer", "RGBG")
        assert found.code == 2
        assert "RGBG" in found.error
        assert "RGGB" in found.error

    def test_info_and_evaluate_know_it(self, cli, coloured):
        found = cli("info", coloured, "--bayer", "grbg", "--no-estimate")
        assert "Bayer mosaic GRBG" in found.out
        assert "Bayer" not in cli("info", coloured, "--no-estimate").out
        assert cli("evaluate", coloured, "--bayer", "grbg", "--methods", "hold,default", "--quiet").code == 0


class TestOutput:
    def test_npy_holds_what_the_api_returns(self, cli, recording, tmp_path):
        assert (
            cli("reconstruct", recording, "-o", tmp_path / "out", "--format", "npy", "--rate", 40).code == 0
        )
        expected = list(kalux.reconstruct(kalux.open(recording), rate_hz=40))
        assert times_in(tmp_path / "out") == [image.t for image in expected]
        for found, image in zip(images_in(tmp_path / "out"), expected, strict=True):
            np.testing.assert_array_equal(found, np.stack([image.intensity, image.variance]))

    def test_a_folder_gets_png_at_100_hz_by_default(self, cli, recording, tmp_path):
        assert cli("reconstruct", recording, "-o", tmp_path / "out").code == 0
        assert {file.suffix for file in (tmp_path / "out").iterdir()} == {".png", ".csv", ".toml"}
        assert set(np.diff(times_in(tmp_path / "out"))) == {10_000}

    def test_a_name_with_mp4_gets_a_video(self, cli, recording, tmp_path):
        found = cli("reconstruct", recording, "-o", tmp_path / "out.mp4", "--crf", 30, "--slow-motion", 4)
        assert found.code == 0
        with av.open(str(tmp_path / "out.mp4")) as video:
            assert float(video.streams.video[0].average_rate) == 25
        assert (tmp_path / "out.mp4.kalux.toml").exists()

    def test_at_frames_gives_the_middles_of_the_exposures(self, cli, recording, simulation, tmp_path):
        assert cli("reconstruct", recording, "-o", tmp_path / "out", "--at", "frames").code == 0
        assert times_in(tmp_path / "out") == [frame.middle for frame in simulation.frames]

    def test_times_come_from_a_table_by_the_name_of_their_column(self, cli, recording, tmp_path):
        """As baselines.md asks for, and evaluate takes."""
        (tmp_path / "t.csv").write_text("file, t_us\na.png,100000\nb.png,300000\n")
        assert cli("reconstruct", recording, "-o", tmp_path / "a", "--times", tmp_path / "t.csv").code == 0
        assert times_in(tmp_path / "a") == [100_000, 300_000]

    def test_times_come_from_text_npy_or_a_former_output(self, cli, recording, tmp_path):
        wanted = [100_000, 150_001, 150_001, 300_000]
        (tmp_path / "t.txt").write_text("# us\n100000\n150001\n150001\n\n300000\n")
        np.save(tmp_path / "t.npy", wanted)
        for name, file in (("a", "t.txt"), ("b", "t.npy"), ("c", "a/timestamps.csv")):
            assert cli("reconstruct", recording, "-o", tmp_path / name, "--times", tmp_path / file).code == 0
            assert times_in(tmp_path / name) == wanted
        found = cli("reconstruct", recording, "-o", tmp_path / "v.mp4", "--times", tmp_path / "t.txt")
        assert (found.code, "a time comes twice" in found.error) == (2, True)

    @pytest.mark.parametrize(
        ("name", "content", "told"),
        [
            ("t.csv", b"index,t_us,file\n5\n", "line 2: '' is not a whole number"),
            ("t.csv", b"t_us,file\n5,a\nx,b\n", "line 3: 'x' is not a whole number"),
            ("t.npy", b"PK\x03\x04", "not a NumPy array"),
            ("t.npy", np.array([1 << 63], np.uint64), "times[0] is 9223372036854775808; whole microseconds"),
        ],
    )
    def test_times_that_are_none_are_refused(self, cli, recording, tmp_path, name, content, told):
        if isinstance(content, bytes):
            (tmp_path / name).write_bytes(content)
        else:
            np.save(tmp_path / name, content)
        found = cli("reconstruct", recording, "-o", tmp_path / "out", "--times", tmp_path / name)
        assert found.code == 2
        assert told in found.error

    def test_a_part_has_the_same_images_as_the_whole(self, cli, recording, simulation, tmp_path):
        flags = ("--format", "npy", "--rate", 50)
        cli("reconstruct", recording, "-o", tmp_path / "whole", *flags)
        cli("reconstruct", recording, "-o", tmp_path / "part", *flags, "--start", 0.1, "--end", 0.2)
        begin = simulation.frames[0].exposure_start
        kept = [i for i, t in enumerate(times_in(tmp_path / "whole")) if 1e5 <= t - begin <= 2e5]
        whole, part = images_in(tmp_path / "whole"), images_in(tmp_path / "part")
        assert len(part) == len(kept) > 3
        for i, image in zip(kept, part, strict=True):
            np.testing.assert_array_equal(image, whole[i])

    def test_the_complementary_filter_has_an_infinite_variance(self, cli, recording, tmp_path):
        found = cli("reconstruct", recording, "-o", tmp_path / "out", "--preset", "cf", "--format", "npy")
        assert found.code == 0
        assert np.isinf(images_in(tmp_path / "out")[0][1]).all()

    def test_causal_begins_when_the_first_frame_is_finished(self, cli, recording, simulation, tmp_path):
        assert cli("reconstruct", recording, "-o", tmp_path / "out", "--causal").code == 0
        assert times_in(tmp_path / "out")[0] == simulation.frames[0].exposure_end

    def test_display_flags_reach_the_pictures(self, cli, recording, tmp_path):
        flags = ("--display", "linear", "--display.white", 4, "--display.encoding", "srgb", "--png-bits", 8)
        assert cli("reconstruct", recording, "-o", tmp_path / "out", "--at", "frames", *flags).code == 0
        output = tomllib.loads((tmp_path / "out" / "kalux.toml").read_text())["output"]
        assert output["display"]["linear"] == {"black": 0.0, "white": 4.0}
        assert (output["display"]["encoding"], output["bits"]) == ("srgb", 8)

    def test_a_former_output_is_replaced_only_on_request(self, cli, recording, tmp_path):
        command = ("reconstruct", recording, "-o", tmp_path / "out", "--at", "frames")
        assert cli(*command).code == 0
        refused = cli(*command)
        assert refused.code == 2
        assert "--overwrite" in refused.error
        assert cli(*command, "--overwrite").code == 0


class TestSettings:
    def test_flags_win_over_the_file_and_the_file_over_the_preset(self, cli, recording, tmp_path):
        (tmp_path / "s.toml").write_text("[camera]\nlog_offset = 0.1\n[filter]\ncutoff = 3.0\n")
        flags = ("--preset", "cf", "--settings", tmp_path / "s.toml", "--camera.log-offset", 0.2)
        assert cli("reconstruct", recording, "-o", tmp_path / "out", "--at", "frames", *flags).code == 0
        used = tomllib.loads((tmp_path / "out" / "kalux.toml").read_text())["settings"]
        assert (used["camera"]["log_offset"], used["filter"]["cutoff"], used["filter"]["kind"]) == (
            0.2,
            3.0,
            "cf",
        )

    def test_settings_of_a_run_in_another_mode_are_told(self, cli, write_recording, tmp_path):
        """Flags alone choose the mode: without a word the images would be taken for the same."""
        recording = write_recording(tmp_path / "rec.h5")
        flags = ("--at", "frames", "--format", "npy")
        cli("reconstruct", recording, "-o", tmp_path / "a", *flags, "--smooth")
        again = (*flags, "--settings", tmp_path / "a" / "kalux.toml")
        told = "is of a run --smooth; settings do not say so, and these images are others"
        assert told in cli("reconstruct", recording, "-o", tmp_path / "b", *again).err
        assert told not in cli("reconstruct", recording, "-o", tmp_path / "c", *again, "--smooth").err
        for first, second in zip(images_in(tmp_path / "a"), images_in(tmp_path / "c"), strict=True):
            np.testing.assert_array_equal(first, second)

    def test_settings_of_a_run_with_a_calibration_are_told_where_it_is_missing(
        self, cli, recording, tmp_path
    ):
        """Its maps of pixels are no settings: without a word the images would be taken for the same."""
        hot = np.zeros((32, 40), bool)
        hot[3, 5] = True
        calibration = tmp_path / "cal.toml"
        save_calibration(Calibration({"events": {"threshold_on": 0.21}}, maps={"hot": hot}), calibration)
        flags = ("--at", "frames")
        cli("reconstruct", recording, "-o", tmp_path / "a", *flags, "--calibration", calibration)
        again = (*flags, "--settings", tmp_path / "a" / "kalux.toml")
        told = f"is of a run with --calibration {calibration}; settings have no maps of pixels"
        assert told in cli("reconstruct", recording, "-o", tmp_path / "b", *again).err
        also = ("--calibration", calibration)
        assert told not in cli("reconstruct", recording, "-o", tmp_path / "c", *again, *also).err
        for first, second in zip(images_in(tmp_path / "a"), images_in(tmp_path / "c"), strict=True):
            np.testing.assert_array_equal(first, second)

    def test_flags_of_another_filter_are_told(self, cli, recording, tmp_path):
        flags = ("--at", "frames", "--filter.cutoff", 3.0)
        told = "--filter.cutoff has no effect: it is a setting of --preset cf"
        assert told in cli("reconstruct", recording, "-o", tmp_path / "a", *flags).err
        assert told not in cli("reconstruct", recording, "-o", tmp_path / "b", *flags, "--preset", "cf").err

    @pytest.mark.parametrize("threshold", [None, (0.2, 0.2)])
    def test_an_outputs_settings_reproduce_it(self, cli, write_recording, tmp_path, threshold):
        """Also where thresholds were estimated, which makes the engine believe highlights less."""
        recording = write_recording(tmp_path / "rec.h5", contrast_threshold=threshold)
        flags = ("--at", "frames", "--format", "npy")
        first = (*flags, "--camera.log-offset", 0.05, "--events.step-variance", 0.3, "--filter.deblur", "no")
        cli("reconstruct", recording, "-o", tmp_path / "a", *first)
        again = (*flags, "--settings", tmp_path / "a" / "kalux.toml", "--preset", "iccv2021")
        cli("reconstruct", recording, "-o", tmp_path / "b", *again)
        a, b = (tomllib.loads((tmp_path / name / "kalux.toml").read_text()) for name in "ab")
        assert a["settings"] == b["settings"]
        assert (
            a["thresholds"]["origin"]
            == b["thresholds"]["origin"]
            == ("recording" if threshold else "estimate")
        )
        for first_image, second_image in zip(
            images_in(tmp_path / "a"), images_in(tmp_path / "b"), strict=True
        ):
            np.testing.assert_array_equal(first_image, second_image)

    def test_the_settings_file_says_what_was_run(self, cli, recording, tmp_path):
        cli("reconstruct", recording, "-o", tmp_path / "out", "--rate", 20, "--end", 0.2)
        told = tomllib.loads((tmp_path / "out" / "kalux.toml").read_text())
        assert told["complete"] is True
        assert told["command"].startswith("kalux reconstruct ")
        assert told["input"] == {"path": str(recording), "format": "kalux", "height": 32, "width": 40}
        assert {"kalux", "python", "numpy", "numba"} <= {*told["versions"]}
        assert (told["preset"], told["images_wanted"]["end"], told["output"]["rate_hz"]) == (
            "default",
            0.2,
            20.0,
        )


class TestWhatIsSaid:
    def test_decisions_before_and_a_summary_after(self, cli, recording, tmp_path):
        lines = cli("reconstruct", recording, "-o", tmp_path / "out").out.splitlines()
        assert [line.split()[0] for line in lines] == [
            "recording",
            "thresholds",
            "agreement",
            "delay",
            "I_0",
            "step",
            "refractory",
            "spread",
            "background",
            "exposure",
            "noise",
            "pattern",
            "bright",
            "unshown",
            "response",
            "black",
            "motion",
            "filter",
            "images",
            "wrote",
        ]
        assert "40x32 pixels" in lines[0]
        assert "from the recording" in lines[1]

    @pytest.mark.parametrize(("spread", "warns"), [(0.12, True), (0.08, False)])
    def test_estimated_thresholds_are_a_warning_unless_they_are_exact(
        self, cli, write_recording, tmp_path, monkeypatch, spread, warns
    ):
        made = reconstruct_command.make_plan

        def inexact(*arguments):
            found = made(*arguments)
            thresholds = found.steps.thresholds._replace(spread=spread)
            return dataclasses.replace(found, steps=found.steps._replace(thresholds=thresholds))

        monkeypatch.setattr(reconstruct_command, "make_plan", inexact)
        recording = write_recording(tmp_path / "rec.h5", contrast_threshold=None)
        found = cli("reconstruct", recording, "-o", tmp_path / "out", "--at", "frames", "--quiet")
        assert (found.code, found.out) == (0, "")
        assert found.err.startswith("kalux: warning: the contrast thresholds are estimated") == warns
        assert found.err.count("\n") == warns

    @pytest.mark.parametrize(("preset", "hinted"), [("default", True), ("davis346", False)])
    def test_one_frame_tells_no_threshold_and_a_preset_is_hinted_at(
        self, cli, write_recording, simulation, tmp_path, preset, hinted
    ):
        recording = write_recording(
            tmp_path / "rec.h5", contrast_threshold=None, frames=simulation.frames[:1]
        )
        flags = ("--at", "frames", "--quiet", "--preset", preset)
        found = cli("reconstruct", recording, "-o", tmp_path / "out", *flags)
        assert "thresholds are unknown and assumed" in found.err
        assert ("or the sensor's --preset" in found.err) == hinted

    def test_images_where_there_is_no_frame_for_long_are_a_warning(
        self, cli, simulation, write_recording, tmp_path
    ):
        """A clock that leaps: nobody wants to wait for the images of an hour without a frame."""
        *others, last = simulation.frames
        late = dataclasses.replace(
            last,
            exposure_start=last.exposure_start + 3_600_000_000,
            exposure_end=last.exposure_end + 3_600_000_000,
        )
        path = write_recording(tmp_path / "leap.h5", frames=[*others, late])
        found = cli("reconstruct", path, "-o", tmp_path / "o", "--format", "npy", "--rate", 0.01)
        assert found.code == 0, found.err
        assert "there is no frame for 3,600 s" in found.err
        assert "36 of 37 images lie there" in found.err
        part = cli("reconstruct", path, "-o", tmp_path / "p", "--format", "npy", "--end", 0.2, "--quiet")
        assert "no frame" not in part.err

    @pytest.mark.parametrize("shift", [None, 10**9])
    def test_events_that_say_nothing_of_the_frames_are_a_warning(
        self, cli, write_recording, simulation, tmp_path, shift
    ):
        events = simulation.events[:0] if shift is None else simulation.events.copy()
        events["t"] += shift or 0
        recording = write_recording(tmp_path / "rec.h5", events=[events])
        found = cli("reconstruct", recording, "-o", tmp_path / "out", "--at", "frames")
        assert found.code == 0
        assert ("no events" if shift is None else "same clock") in found.err


DAMAGES = {
    "event outside the sensor": "sensor",
    "events not sorted": "event",
    "no frames": "no frames",
    "zero exposure": "exposure of 0 us",
    "frames overlap": "exposure of frame",
    "NaN": "x=5, y=3",
    "frames of another size": "40x32",
    "no exposure times": "--exposure",
}


class TestBadInput:
    @pytest.mark.parametrize("damage", DAMAGES)
    @pytest.mark.parametrize("name", ["out", "out.mp4"])
    def test_damage_is_one_line_and_nothing_is_written(self, cli, damaged, tmp_path, damage, name):
        found = cli("reconstruct", damaged(damage), "-o", tmp_path / name, "--rate", 20)
        assert found.code == 2
        assert DAMAGES[damage] in found.error
        assert found.out == ""
        assert [file.name for file in tmp_path.iterdir()] == ["damaged.h5"]

    def test_a_truncated_file(self, cli, recording, tmp_path):
        (tmp_path / "cut.h5").write_bytes(recording.read_bytes()[:-2000])
        found = cli("reconstruct", tmp_path / "cut.h5", "-o", tmp_path / "out")
        assert found.code == 2
        assert "cut.h5" in found.error
        assert not (tmp_path / "out").exists()

    def test_a_missing_file(self, cli, tmp_path):
        found = cli("reconstruct", tmp_path / "none.aedat4", "-o", tmp_path / "out")
        assert (found.code, found.error) == (2, f"{tmp_path}/none.aedat4: no such file or folder")

    def test_a_line_break_in_a_name_stays_one_line(self, cli, tmp_path):
        assert "a b" in cli("reconstruct", tmp_path / "a\nb", "-o", tmp_path / "out").error

    @pytest.mark.parametrize(
        ("flags", "told"),
        [
            (["--exposure", "0"], "must be positive"),
            (["--exposure", "soon"], "'soon' is not a whole number"),
            (["--stamp", "end"], "--exposure"),
            (["--rate", "fast"], "'fast' is not a number"),
            (["--rate", "-3"], "rate is -3"),
            (["--rate", "0"], "rate is 0"),
            (["--rate", "nan"], "rate is nan"),
            (["--rate", "10", "--at", "frames"], "not allowed with"),
            (["--start", "100"], "no image"),
            (["--end", "nan"], "--end is nan"),
            (["--preset", "best"], "unknown preset 'best'; known are default"),
            (["--camera.log-ofset", "1"], "did you mean --camera.log-offset?"),
            (["--camera.log-offset", "-1"], "camera.log_offset is -1.0"),
            (["--camera.response", "film"], "unknown response 'film'"),
            (["--filter.kind", "kalman"], "akf, cf"),
            (["--filter.deblur", "perhaps"], "'perhaps' is not true or false"),
            (["--GROUP.NAME", "1"], "--help-settings"),
            (["--display", "bright"], "auto, linear"),
            (["--display", "linear", "--display.knee", "1"], "it has black, white"),
            (["--display.lift", "99"], "lift is 99"),
            (["--display.gamma", "2"], "--display.gamma has no effect: it is for --display.encoding gamma"),
            (["--png-bits", "12"], "--png-bits"),
            (["--crf", "20"], "--crf is for mp4"),
            (["--format", "exr", "--display", "drago"], "--display is for png and mp4"),
            (["--format", "tiff"], "'tiff'"),
            (["--settings", "none.toml"], "none.toml"),
            (["--times", "none.txt"], "none.txt: cannot be read"),
            (["extra"], "extra: one argument too many"),
        ],
    )
    def test_flags(self, cli, recording, tmp_path, flags, told):
        found = cli("reconstruct", recording, "-o", tmp_path / "out", *flags)
        assert found.code == 2
        assert told in found.error
        assert not (tmp_path / "out").exists()

    @pytest.mark.parametrize(
        ("name", "content", "told"),
        [
            ("t.txt", "100000\n90000\n", "t.txt: times[1] is 90000 us"),
            ("t.txt", "100000\n0.5 s\n", "line 2: '0.5 s'"),
            ("t.txt", "# nothing\n", "at least one"),
            ("t.txt", "9" * 40, "out of range"),
            ("t.txt", b"\xff\xfe\x00", "neither text"),
            ("t.txt", "1\n", "1 us lies before"),
            ("t.txt", "900000000\n", "after the recording's end"),
            ("t.npy", b"not an array", "not a NumPy array"),
            ("t.npy", np.array([0.5]), "t.npy: times[0] is 0.5; whole microseconds"),
            ("t.npy", np.array([np.nan]), "whole microseconds"),
            ("t.npy", np.array([[1, 2]]), "must be a list"),
        ],
    )
    def test_times(self, cli, recording, tmp_path, name, content, told):
        path = tmp_path / name
        if isinstance(content, np.ndarray):
            np.save(path, content)
        else:
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
        found = cli("reconstruct", recording, "-o", tmp_path / "out", "--times", path)
        assert found.code == 2
        assert told in found.error
        assert not (tmp_path / "out").exists()

    @pytest.mark.parametrize(
        ("content", "told"),
        [("camera = 3", "not a table"), ("[lens]\nf = 1", "unknown group"), ("[camera", "not valid TOML")],
    )
    def test_settings_files(self, cli, recording, tmp_path, content, told):
        (tmp_path / "s.toml").write_text(content)
        found = cli("reconstruct", recording, "-o", tmp_path / "out", "--settings", tmp_path / "s.toml")
        assert found.code == 2
        assert told in found.error
        assert "s.toml" in found.error


class TestBadOutput:
    def test_other_files_are_left_alone(self, cli, recording, tmp_path):
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "kalux.toml").write_text("mine")
        for flags, told in (((), "not empty"), (("--overwrite",), "not an output of kalux")):
            found = cli("reconstruct", recording, "-o", tmp_path / "out", "--quiet", *flags)
            assert found.code == 2
            assert told in found.error
        assert (tmp_path / "out" / "kalux.toml").read_text() == "mine"

    @pytest.mark.parametrize("name", ["out.avi", "out.h5", "file", "file/out", "folder.mp4"])
    def test_names_that_cannot_be_used(self, cli, recording, tmp_path, name):
        (tmp_path / "file").write_text("")
        (tmp_path / "folder.mp4").mkdir()
        found = cli("reconstruct", recording, "-o", tmp_path / name)
        assert found.code == 2
        assert str(tmp_path) in found.error

    @pytest.mark.skipif(os.getuid() == 0, reason="root may write everywhere")
    def test_a_folder_without_permission(self, cli, recording, tmp_path):
        (tmp_path / "closed").mkdir(mode=0o500)
        found = cli("reconstruct", recording, "-o", tmp_path / "closed" / "out")
        assert found.code == 2
        assert "no permission" in found.error

    def test_a_full_disk(self, cli, recording, tmp_path, monkeypatch):
        """The images before it stay, and one line says so."""
        whole = folder.write_within

        def full(path, data):
            if path.name == "000003.png":
                raise OSError(errno.ENOSPC, "No space left on device")
            whole(path, data)

        monkeypatch.setattr(folder, "write_within", full)
        found = cli("reconstruct", recording, "-o", tmp_path / "out", "--quiet")
        assert found.code == 2
        assert "no space is left" in found.error
        assert "the 3 images" in found.error
        assert len(times_in(tmp_path / "out")) == 3


class TestRealRecordings:
    @pytest.mark.parametrize(
        ("name", "flags"),
        [
            ("newton_davis346.aedat4", ()),
            ("slider_depth", ("--exposure", 10_000, "--stamp", "start", "--end", 0.5)),
        ],
    )
    def test_become_a_video(self, cli, shared_data, tmp_path, name, flags):
        found = cli("reconstruct", shared_data / name, "-o", tmp_path / "v.mp4", "--rate", 100, *flags)
        assert found.code == 0
        with av.open(str(tmp_path / "v.mp4")) as video:
            assert video.streams.video[0].frames == 51

    def test_exposures_that_are_missing_are_asked_for(self, cli, shared_data, tmp_path):
        found = cli("reconstruct", shared_data / "slider_depth", "-o", tmp_path / "v.mp4")
        assert found.code == 2
        assert "--exposure 10000" in found.error


class TestThreads:
    @pytest.mark.parametrize("kind", ["png", "exr", "npy", "mp4"])
    def test_results_do_not_depend_on_them(self, cli, recording, tmp_path, kind):
        contents = {}
        for threads in (1, 2, 4):
            out = tmp_path / f"{threads}" / ("o.mp4" if kind == "mp4" else "o")
            flags = () if kind == "mp4" else ("--format", kind)
            done = cli("reconstruct", recording, "-o", out, "--rate", 200, "--threads", threads, *flags)
            assert done.code == 0, done.err
            files = [out] if kind == "mp4" else sorted(out.glob(f"*.{kind}"))
            assert len(files) == (1 if kind == "mp4" else len(times_in(out)))
            contents[threads] = {file.name: file.read_bytes() for file in files}
        for threads in (2, 4):
            assert contents[threads].keys() == contents[1].keys()
            differing = [name for name, data in contents[1].items() if contents[threads][name] != data]
            assert not differing, (threads, tmp_path)

    @pytest.mark.parametrize("threads", ["0", "-1", "two"])
    def test_at_least_one(self, cli, recording, tmp_path, threads):
        found = cli("reconstruct", recording, "-o", tmp_path / "o", "--threads", threads)
        assert found.code == 2
        assert "--threads" in found.error

    @pytest.mark.parametrize("threads", [1, 2, 4])
    def test_a_reader_that_fails_late_leaves_the_images_before(
        self, cli, recording, tmp_path, monkeypatch, threads
    ):
        """The file changes after it was checked: nothing hangs, and what is finished stays valid."""
        events = kalux.Recording._checked_events
        done = told_when_planned(monkeypatch)

        def failing(self):
            for chunk in events(self):
                yield chunk[: len(chunk) // 2]
                if done:
                    raise InputError("the file has changed")
                yield chunk[len(chunk) // 2 :]

        monkeypatch.setattr(kalux.Recording, "_checked_events", failing)
        out = tmp_path / "out"
        found = cli(
            "reconstruct", recording, "-o", out, "--rate", 200, "--format", "npy", "--threads", threads
        )
        assert found.code == 2
        assert "the file has changed" in found.err
        assert len(images_in(out)) == len(times_in(out)) > 5
        assert f"{len(images_in(out))} images finished and valid in {out}" in found.err
        assert tomllib.loads((out / "kalux.toml").read_text())["complete"] is False
        assert not own_threads()

    @pytest.mark.parametrize("threads", [1, 2, 4])
    def test_a_writer_that_fails_ends_the_filter(self, cli, recording, tmp_path, monkeypatch, threads):
        whole = folder.write_within

        def full(path, data):
            if path.name == "000003.npy":
                raise OSError(errno.ENOSPC, "No space left on device")
            whole(path, data)

        monkeypatch.setattr(folder, "write_within", full)
        out = tmp_path / "out"
        found = cli(
            "reconstruct", recording, "-o", out, "--rate", 5000, "--format", "npy", "--threads", threads
        )
        assert found.code == 2
        assert "no space is left" in found.err
        assert len(times_in(out)) == len(images_in(out)) == 3
        assert not own_threads()

    @pytest.mark.parametrize("threads", [1, 3])
    @pytest.mark.parametrize("name", ["v.mp4", "npy"])
    def test_an_interrupt_in_the_filter(self, cli, recording, tmp_path, monkeypatch, threads, name):
        image = kalux.Reconstructor.image

        def interrupted(self, estimate, **options):
            if estimate.t > first + 100_000:
                raise KeyboardInterrupt
            return image(self, estimate, **options)

        first = next(iter(kalux.open(recording).frames())).exposure_start
        monkeypatch.setattr(kalux.Reconstructor, "image", interrupted)
        out = tmp_path / name
        flags = () if name == "v.mp4" else ("--format", "npy")
        found = cli("reconstruct", recording, "-o", out, "--rate", 200, "--threads", threads, *flags)
        assert found.code == 130
        assert f"interrupted; 21 images finished and valid in {out}" in found.err
        assert not own_threads()


def told_when_planned(monkeypatch):
    """A list that holds something once the plan is made."""
    done = []
    make_plan = reconstruct_command.make_plan

    def planned(*arguments):
        made = make_plan(*arguments)
        done.append(made)
        return made

    monkeypatch.setattr(reconstruct_command, "make_plan", planned)
    return done


class TestInterrupt:
    @pytest.mark.parametrize(
        ("number", "threads"),
        [(signal.SIGINT, 1), (signal.SIGINT, 4), (signal.SIGTERM, 4), (signal.SIGHUP, 4)],
    )
    def test_what_is_finished_stays_valid(self, start_cli, recording, tmp_path, number, threads):
        if signal.getsignal(number) == signal.SIG_IGN:
            pytest.skip("the signal is ignored, as under nohup")
        out = tmp_path / "out"
        process = start_cli(
            "reconstruct", recording, "-o", out, "--rate", 100_000, "--format", "npy", "--threads", threads
        )
        wait_for(process, lambda: (out / "000020.npy").exists())
        process.send_signal(number)
        _, stderr = process.communicate(timeout=30)
        assert process.returncode == 130
        finished = len(times_in(out))
        assert stderr.splitlines()[-1] == (
            f"kalux: interrupted; {finished:,} images finished and valid in {out}"
        )
        assert "Traceback" not in stderr
        assert len(images_in(out)) == finished >= 20
        told = tomllib.loads((out / "kalux.toml").read_text())
        assert (told["complete"], told["images"]) == (False, finished)

    def test_a_video_can_be_played(self, start_cli, recording, tmp_path):
        out = tmp_path / "out.mp4"
        process = start_cli("reconstruct", recording, "-o", out, "--rate", 20_000, "--crf", 0)
        part = tmp_path / ".out.mp4.part"
        wait_for(process, lambda: part.exists() and part.stat().st_size > 0)
        process.terminate()
        _, stderr = process.communicate(timeout=30)
        assert process.returncode == 130
        with av.open(str(out)) as video:
            assert f"{video.streams.video[0].frames:,} images finished and valid in {out}" in stderr

    @pytest.mark.parametrize("threads", [1, 4])
    def test_before_the_first_image(self, cli, recording, tmp_path, monkeypatch, threads):
        def interrupt(*arguments):
            raise KeyboardInterrupt

        monkeypatch.setattr("kalux.cli.checking.check_recording", interrupt)
        found = cli("reconstruct", recording, "-o", tmp_path / "out", "--threads", threads)
        assert (found.code, found.err) == (130, "kalux: interrupted; nothing was written\n")
        assert not (tmp_path / "out").exists()


def wait_for(process, ready):
    deadline = time.monotonic() + 60
    while not ready():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.parametrize("out", ["out", "out.mp4"])
def test_names_need_not_be_utf8(cli, recording, tmp_path, out):
    """Linux's names are bytes; in the settings file, which is UTF-8, "?" stands for what is not."""
    source = tmp_path / os.fsdecode(b"rec\xff.h5")
    source.write_bytes(recording.read_bytes())
    target = tmp_path / os.fsdecode(os.fsencode(out).replace(b"u", b"\xff"))
    assert cli("reconstruct", source, "-o", target, "--at", "frames", "--quiet").code == 0
    settings = target / "kalux.toml" if target.is_dir() else tmp_path / f"{target.name}.kalux.toml"
    assert "rec?.h5" in tomllib.loads(settings.read_text())["command"]
    again = cli("reconstruct", source, "-o", tmp_path / "again.mp4", "--at", "frames", "--settings", settings)
    assert again.code == 0


def test_a_recording_that_is_a_folder_is_not_written_into(cli, tmp_path):
    folder = tmp_path / "rec"
    (folder / "images").mkdir(parents=True)
    (folder / "events.txt").write_text("40 30\n0.000001 3 4 1\n")
    before = sorted(tmp_path.rglob("*"))
    for out in (folder, folder / "images", folder / "new.mp4"):
        found = cli("reconstruct", folder, "--exposure", "1000", "-o", out, "--overwrite")
        assert (found.code, "lies in the recording" in found.error) == (2, True)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("threshold", [None, (0.2, 0.2)])
def test_events_that_contradict_the_frames_are_told(cli, write_recording, simulation, tmp_path, threshold):
    """Of the wrong polarity, or of another view."""
    inverted, apart = simulation.events.copy(), simulation.events.copy()
    inverted["p"] = ~inverted["p"]
    apart["y"], apart["x"] = apart["x"] * 31 // 39, apart["y"] * 39 // 31
    for name, events, told in (
        ("right", simulation.events, None),
        ("inverted", inverted, "their polarity 1 is darker (correlation 0.9"),
        ("apart", apart, "do not explain how the frames change"),
    ):
        path = write_recording(tmp_path / f"{name}.h5", events=[events], contrast_threshold=threshold)
        found = cli("reconstruct", path, "-o", tmp_path / name, "--at", "frames", "--quiet")
        assert found.code == 0
        assert told is None or told in found.err
        assert ("do not explain" in found.err) == (name == "apart")


def test_thresholds_that_contradict_the_frames_are_told(cli, write_recording, simulation, tmp_path):
    """Those that the recording states are not used, those that are given are."""
    stated = write_recording(tmp_path / "stated.h5", contrast_threshold=(0.4, 0.4))
    found = cli("reconstruct", stated, "-o", tmp_path / "a", "--at", "frames")
    assert (
        "that the recording states, 0.4 on and 0.4 off, contradict its frames and are not used" in found.err
    )
    assert "give --camera.response srgb" in found.err  # these would come out at half of the true ones, too
    assert "; the recording states 0.4 and 0.4" in found.out
    half = write_recording(tmp_path / "half.h5", contrast_threshold=(0.1, 0.1))
    found = cli("reconstruct", half, "-o", tmp_path / "c", "--at", "frames")
    assert "contradict its frames and are not used; to insist" in found.err
    flags = ("--events.threshold-on", "0.4", "--events.threshold-off", "0.4")
    found = cli("reconstruct", stated, "-o", tmp_path / "b", "--at", "frames", *flags)
    assert "the given contrast thresholds contradict the frames" in found.err
    assert "on 0.400, off 0.400 log intensity (given)" in found.out


def test_what_is_wrong_with_frames_is_told(cli, write_recording, simulation, tmp_path):
    frames = [dataclasses.replace(frame, image=frame.image.copy()) for frame in simulation.frames]
    frames[3].image[:] = frames[2].image
    frames[6].image[:] = 0
    for index in range(8, len(frames)):
        frames[index].image[:] = frames[index].image // 2
    path = write_recording(tmp_path / "wrong.h5", frames=frames)
    found = cli("reconstruct", path, "-o", tmp_path / "out", "--at", "frames")
    assert found.code == 0
    for told in (
        "left out: 1 frame, first frame 3: the same as the one before, though events show motion; 1 frame, first "
        "frame 6: empty (--camera.leave-out-faulty false keeps them)",
        "the brightness of the frames steps at 1 frame, first at frame 8, by up to a factor of 2",
    ):
        assert told in found.err
    kept = ["--camera.leave-out-faulty", "false", "--camera.even-gain", "false", "--quiet"]
    found = cli("reconstruct", path, "-o", tmp_path / "kept", "--at", "frames", *kept)
    assert found.code == 0
    assert "left out" not in found.err
    assert "steps" not in found.err
