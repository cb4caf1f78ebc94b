"""Sequences: found in folders, listed in TOML files, told apart."""

from __future__ import annotations

import re

import numpy as np
import pytest

import kalux
from kalux.calibration.values import Calibration
from kalux.errors import ExposureError, InputError
from kalux.evaluation.benchmark.sequences import ArtificialHdr, Options, gather, load
from kalux.evaluation.truth import truth_beside
from kalux.models.camera import Response
from kalux.writers import hdf5
from kalux.writers.calibration import save_calibration


def test_a_folder_gives_its_recordings_and_their_truth_but_not_the_truth_as_a_recording(small_set):
    (small_set.folder / "notes.md").write_text("not a recording")
    found = gather([small_set.folder]).sequences
    assert [s.name for s in found] == ["a", "b"]
    assert found[0].truth_file() == small_set.folder / "a_gt.npz"
    assert found[1].truth_file() is None
    assert found[0].files() == [small_set.folder / "a.h5", small_set.folder / "a_gt.npz"]


def test_of_a_folder_numpy_files_are_recordings_if_they_hold_events(small_set):
    """Not truth of another name, maps of a calibration, or images."""
    np.savez(small_set.folder / "truth.npz", times_us=np.arange(3), gt=np.ones((3, 4, 5)))
    np.save(small_set.folder / "image.npy", np.ones((4, 5)))
    np.savez(small_set.folder / "c.npz", t=np.arange(3), x=np.arange(3), y=np.arange(3), p=np.ones(3, bool))
    assert [s.name for s in gather([small_set.folder]).sequences] == ["a", "b", "c"]


def test_held_out_frames_that_are_asked_for_win_over_truth(small_set):
    (found,) = gather([small_set.folder / "a.h5"], Options(hold_out_frames=3)).sequences
    assert found.truth_file() is None
    assert truth_beside(found.path).is_file()


def test_a_toml_file_lists_sequences_relative_to_itself(small_set):
    path = small_set.folder / "bench.toml"
    path.write_text(
        'title = "Two"\nmethods = ["hold", "cf"]\n'
        '[[sequence]]\npath = "b.h5"\nname = "pan"\ntruth = "a_gt.npz"\ngroup = "G"\n'
        '[[sequence]]\npath = "a.h5"\nhold_out_frames = 4\nresponse = "srgb"\nexposure = 10\nstamp = "end"\n'
    )
    found = gather([path])
    first, second = found.sequences
    assert (found.title, found.methods) == ("Two", ("hold", "cf"))
    assert (first.name, first.title, first.group) == ("pan", "pan", "G")
    assert first.truth_file() == small_set.folder / "a_gt.npz"
    assert second.options == Options(exposure=10, stamp="end", response="srgb", hold_out_frames=4)
    assert second.open().exposure_known


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[[sequence]", "not valid TOML"),
        ('title = "x"', "lists no sequence"),
        ("[[sequence]]\nname = 'x'", "sequence 1: has no path"),
        ("[[sequence]]\npath = 'x'\nexposur = 3", "unknown key 'exposur'; known are path"),
        ("[[sequence]]\npath = 'x'\nexposure = '3'", "exposure is '3'; int is needed"),
        ("[[sequence]]\npath = 'x'\nexposure = true", "int is needed"),
        ("[[sequence]]\npath = 'x'\nwhite = '4095'", "white is '4095'; int or float is needed"),
        ("[[sequence]]\npath = 'x'\ntruth = 'y'\nhold_out_frames = 2", "exclude each other"),
        ("[[sequence]]\npath = 'x'\nahdr = {cut = 30, low = 3}", "cut is for both ends"),
        ("[[sequence]]\npath = 'x'\nahdr = {low = 90, high = 10}", "black < white"),
        ("[[sequence]]\npath = 'x'\nahdr = {black = 3}", "says no level"),
        ("[[sequence]]\npath = 'x'\nahdr = {lo = 3}", "ahdr: unknown key 'lo'; known are cut"),
        ("[[sequence]]\npath = 'x'\nahdr = {low = '3'}", "low is '3'; int or float is needed"),
        ("[[sequence]]\npath = 'x'\ntruth = 'y'\nahdr = {cut = 30}", "originals are the truth"),
        ("[[sequence]]\npath = 'x'\ncalibration = 3", "str or list is needed"),
        ("[[sequence]]\npath = 'x'\ncalibration = [3]", "files of kalux calibrate"),
        ("methods = [3]\n[[sequence]]\npath = 'x'", "a list of names"),
        ("methods = []\n[[sequence]]\npath = 'x'", "methods is []; a list of names is needed"),
        ("[[sequence]]\npath = 'x'\nhold_out_frames = 0", "sequence 1: held-out frames: every is 0"),
        ("[[sequence]]\npath = 'x'\nexposure = 0", "sequence 1: exposure is 0 us"),
        ("[[sequence]]\npath = 'x'\nstamp = 'begin'", "sequence 1: stamp is 'begin'"),
        ("[[sequence]]\npath = 'x'\nwhite = -3", "sequence 1: white is -3"),
        ("[[sequence]]\npath = 'x'\nresponse = 'log'", "sequence 1: response: unknown response 'log'"),
        ("[[sequence]]\npath = 'x'\nahdr = {cut = 20, black = nan}", "ahdr: artificial HDR: black is nan"),
        ("[[sequence]]\npath = 'x'\nahdr = {cut = 20, saturation = 300}", "original saturates at 1.17"),
    ],
)
def test_what_is_wrong_in_a_toml_file_is_named(tmp_path, text, told):
    path = tmp_path / "bench.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"bench\.toml") as caught:
        load(path)
    assert told in str(caught.value)


def test_two_toml_files_have_the_methods_that_both_list(tmp_path):
    """Those of one are for a file that lists none, too; a folder is another one in another folder."""
    (tmp_path / "other").mkdir()
    files = {
        "a.toml": 'methods = ["hold", "m=r"]',
        "b.toml": 'methods = ["hold", "m=r"]',
        "c.toml": "",
        "d.toml": 'methods = ["hold"]',
        "other/e.toml": 'methods = ["hold", "m=r"]',
    }
    for name, methods in files.items():
        (tmp_path / name).write_text(f'title = "{name}"\n{methods}\n[[sequence]]\npath = "x.h5"\n')
    a, b, c, d, e = (tmp_path / name for name in files)
    found = gather([c, a, b])
    assert found.title == "c.toml, a.toml, b.toml"
    assert (found.methods, found.folder) == (("hold", "m=r"), tmp_path)
    told = "'a.toml' lists the methods hold, m=r, 'd.toml' lists hold; list the same, or give --methods"
    with pytest.raises(InputError, match=re.escape(told)):
        gather([a, d])
    with pytest.raises(InputError, match="list the same"):
        gather([a, e])
    assert gather([a, d], methods_of_files=False).methods is None


def test_sequences_of_one_name_are_told_apart(small_set, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / "a.h5").write_bytes((small_set.folder / "a.h5").read_bytes())
    files = [small_set.folder / "a.h5", other / "a.h5", other / "a.h5"]
    assert [s.name for s in gather(files).sequences] == ["set-a", "other-a", "other-a-2"]


def test_a_number_gives_no_name_that_is_taken(small_set, tmp_path):
    folder = tmp_path / "d"
    folder.mkdir()
    for name in ("d-run-2.h5", "run.h5", "run.hdf5"):
        (folder / name).write_bytes((small_set.folder / "a.h5").read_bytes())
    names = [s.name for s in gather([folder]).sequences]
    assert len({*names}) == len(names) == 3


def test_a_folder_without_recordings_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(InputError, match="neither a recording nor a folder"):
        gather([tmp_path])
    with pytest.raises(InputError, match="no sequence is given"):
        gather([])


def test_an_exposure_is_for_recordings_that_store_none(small_set, simulation):
    (known,) = gather([small_set.folder / "a.h5"], Options(exposure=7)).sequences
    stored = next(iter(known.open().frames()))
    assert stored.exposure == simulation.frames[0].exposure != 7
    path = small_set.folder / "c.h5"
    hdf5.write(
        path,
        sensor_size=simulation.scene.sensor_size,
        events=[simulation.events],
        frames=[type(f)(f.image, f.exposure_start, f.exposure_start) for f in simulation.frames],
        exposure_known=False,
    )
    (given,) = gather([path], Options(exposure=7)).sequences
    assert next(iter(given.open().frames())).exposure == 7
    with pytest.raises(ExposureError):
        gather([path]).sequences[0].open().frames()


@pytest.mark.parametrize("exposure_known", [True, False])
def test_a_toml_file_says_which_value_is_white(small_set, simulation, exposure_known):
    frames = [
        type(f)(
            f.image.astype(np.uint16),
            f.exposure_start,
            f.exposure_end if exposure_known else f.exposure_start,
        )
        for f in simulation.frames
    ]
    hdf5.write(
        small_set.folder / "deep.h5",
        sensor_size=simulation.scene.sensor_size,
        events=[simulation.events],
        frames=frames,
        exposure_known=exposure_known,
    )
    path = small_set.folder / "bench.toml"
    path.write_text('[[sequence]]\npath = "deep.h5"\nexposure = 7\nwhite = 255\n')
    (found,) = gather([path]).sequences
    assert {frame.white_value for frame in found.open().frames()} == {255.0}


def test_a_toml_file_makes_artificial_hdr_of_a_recording(small_set):
    path = small_set.folder / "bench.toml"
    path.write_text(
        '[[sequence]]\npath = "a.h5"\nahdr = {low = 10, high = 90.5}\nhold_out_frames = 2\n'
        '[[sequence]]\npath = "b.h5"\nahdr = {cut = 80, black = 14}\n'
    )
    first, second = gather([path]).sequences
    assert first.options.ahdr == ArtificialHdr(low=10, high=90.5)
    assert second.options.ahdr == ArtificialHdr(low=80, high=175, black=14)
    whole = kalux.open(small_set.folder / "a.h5")
    made = first.open()
    assert made.response == "s-curve:" + repr((10 / 255) / (90.5 / 255))
    assert len(made.frames()) == len(whole.frames()) - len(made.ground_truth().times)
    assert first.truth_file() is None, "the truth beside it is not that of the artificial camera"
    assert len(second.open().ground_truth().times) == len(whole.frames())


def test_what_a_calibration_says_of_the_camera_is_not_taken_for_an_artificial_one(small_set):
    settings = {"camera": {"response": "srgb"}, "events": {"threshold_on": 0.2}}
    save_calibration(Calibration(settings), small_set.folder / "cal.toml")
    path = small_set.folder / "bench.toml"
    path.write_text(
        '[[sequence]]\npath = "a.h5"\ncalibration = "cal.toml"\n'
        '[[sequence]]\npath = "b.h5"\ncalibration = ["cal.toml"]\nahdr = {cut = 30}\n'
    )
    real, artificial = gather([path]).sequences
    assert (real.response, artificial.response) == ("srgb", "auto")
    assert real.calibration.settings == settings
    assert artificial.calibration.settings == {"events": {"threshold_on": 0.2}}
    assert real.files()[-1] == artificial.files()[-1] == small_set.folder / "cal.toml"
    frame = next(iter(kalux.open(small_set.folder / "b.h5").frames()))
    known = Response.srgb().inverse(frame.normalised()) * 255 / 225
    truth = artificial.open().ground_truth().images[0]
    assert truth == pytest.approx(known, rel=1e-5), (
        "its originals are inverted by the response of the real one"
    )
