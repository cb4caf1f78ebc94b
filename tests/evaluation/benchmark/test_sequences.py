"""Sequences: found in folders, listed in TOML files, told apart."""

from __future__ import annotations

import pytest

from kalux.errors import ExposureError, InputError
from kalux.evaluation.benchmark.sequences import Options, gather, load, truth_beside
from kalux.readers import hdf5


def test_a_folder_gives_its_recordings_and_their_truth_but_not_the_truth_as_a_recording(small_set):
    (small_set.folder / "notes.md").write_text("not a recording")
    found = gather([small_set.folder]).sequences
    assert [s.name for s in found] == ["a", "b"]
    assert found[0].truth_file() == small_set.folder / "a_gt.npz"
    assert found[1].truth_file() is None
    assert found[0].files() == [small_set.folder / "a.h5", small_set.folder / "a_gt.npz"]


def test_held_out_frames_that_are_asked_for_win_over_truth(small_set):
    (found,) = gather([small_set.folder / "a.h5"], Options(hold_out_frames=3)).sequences
    assert found.truth_file() is None
    assert truth_beside(found.path) is not None


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
        ("[[sequence]]\npath = 'x'\ntruth = 'y'\nhold_out_frames = 2", "exclude each other"),
        ("methods = [3]\n[[sequence]]\npath = 'x'", "a list of names"),
    ],
)
def test_what_is_wrong_in_a_toml_file_is_named(tmp_path, text, told):
    path = tmp_path / "bench.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"bench\.toml") as caught:
        load(path)
    assert told in str(caught.value)


def test_sequences_of_one_name_are_told_apart(small_set, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / "a.h5").write_bytes((small_set.folder / "a.h5").read_bytes())
    files = [small_set.folder / "a.h5", other / "a.h5", other / "a.h5"]
    assert [s.name for s in gather(files).sequences] == ["set-a", "other-a", "other-a-2"]


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
