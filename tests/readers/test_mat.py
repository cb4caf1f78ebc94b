"""The .mat reader: versions 5 and 7.3, the authors' conventions, real files against scipy."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import scipy.io

from kalux import readers
from kalux.errors import EventError, FormatError
from kalux.readers import mat
from recordings import (
    SIZE,
    all_events,
    assert_only_clear_errors,
    damaged,
    same_frames,
    small_events,
    small_frames,
)


def variables(**changes):
    """The small recording as the authors' variables; None leaves one out."""
    events, frames = small_events(), small_frames()
    columns = [events["t"], events["x"] + 1, events["y"] + 1, np.where(events["p"], 1, -1)]
    found = {
        "events": np.column_stack(columns).astype(np.float64),
        "image": np.dstack([frame.image for frame in frames]),
        "time_image": np.array([[(f.exposure_start + f.exposure_end) / 2] for f in frames]),
        "exposure": np.array([[float(f.exposure)] for f in frames]),
        "f_Q": np.linspace(1, 2, 256)[:, None],
        "ct": 0.15,
        "post_process": 0.0,
        "im_height": float(SIZE[0]),
        "im_width": float(SIZE[1]),
    }
    return {name: value for name, value in (found | changes).items() if value is not None}


def save_5(path, values):
    scipy.io.savemat(path, values, do_compression=True)


def save_5_plain(path, values):
    scipy.io.savemat(path, values)


def save_73(path, values):
    """As MATLAB does: HDF5 behind a header of 512 bytes, dimensions in reverse, classes as attributes."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in values.items():
            array = np.atleast_2d(np.asarray(value))
            if array.size:
                packing = {"compression": "gzip", "chunks": True} if array.size > 1 else {}
                dataset = file.create_dataset(name, data=array.T, **packing)
            else:
                dataset = file.create_dataset(name, data=np.array(array.shape, np.uint64))
                dataset.attrs["MATLAB_empty"] = np.uint8(1)
            dataset.attrs["MATLAB_class"] = np.bytes_(
                {"float64": "double"}.get(array.dtype.name, array.dtype.name)
            )
        file.create_group("#refs#")
    header = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, HDF5 schema 1.00 .".ljust(124) + b"\x00\x02IM"
    with path.open("r+b") as file:
        file.write(header)


each_version = pytest.mark.parametrize("save", [save_5, save_5_plain, save_73])


@pytest.fixture
def path(tmp_path):
    return tmp_path / "recording.mat"


@each_version
def test_reads_the_layout(path, save):
    save(path, variables())
    source = readers.read(path)
    assert (source.format, source.sensor_size, source.exposure_known) == ("mat", SIZE, True)
    assert (source.count_events(), source.count_frames(), source.missing) == (500, 4, ())
    assert source.contrast_threshold == (0.15, 0.15)
    assert np.array_equal(source.inverse_covariance, np.linspace(1, 2, 256))
    assert source.ground_truth is None
    for _ in range(2):
        assert np.array_equal(all_events(source), small_events())
        assert same_frames(source.frames(), small_frames())


@each_version
@pytest.mark.parametrize("count", [1, 4])
def test_ground_truth_is_grey_and_relative_to_white(path, save, count):
    values = variables()
    values |= {name: values[name][:count] for name in ("time_image", "exposure")}
    values["image"] = values["image"][..., :count]
    radiance = np.random.default_rng(0).uniform(0, 2550, (*SIZE, 3, count)).astype(np.float32)
    save(path, values | {"HDR_mat": radiance if count > 1 else radiance[..., 0]})
    reference = readers.read(path).ground_truth()
    assert reference.images.dtype == np.float32
    assert np.allclose(reference.images, np.moveaxis(radiance.mean(axis=2), -1, 0) / 255, rtol=1e-5)
    assert reference.times.tolist() == [frame.middle for frame in small_frames(count)]


@each_version
def test_a_single_frame_loses_its_last_dimension(path, save):
    values = variables()
    save(
        path,
        variables(
            image=values["image"][..., 0],
            time_image=values["time_image"][:1],
            exposure=values["exposure"][:1],
        ),
    )
    assert same_frames(readers.read(path).frames(), small_frames(1))


@each_version
def test_times_are_rounded_and_thresholds_may_differ(path, save):
    values = variables()
    values["events"][:, 0] += 0.4
    save(path, values | {"ct": np.array([[0.1, 0.2]])})
    source = readers.read(path)
    assert np.array_equal(all_events(source)["t"], small_events()["t"])
    assert source.contrast_threshold == (0.1, 0.2)


@each_version
@pytest.mark.parametrize("exposure", [3_000.0, np.full((10, 10), 3_000.0)])
def test_one_exposure_for_all(path, save, exposure):
    save(path, variables(exposure=exposure))
    assert {frame.exposure for frame in readers.read(path).frames()} == {3_000}


@each_version
def test_without_exposure_the_stamp_is_the_middle(path, save):
    save(path, variables(exposure=None, f_Q=None, ct=None))
    source = readers.read(path)
    assert not source.exposure_known
    assert "--stamp middle" in source.missing[0]
    assert (source.contrast_threshold, source.inverse_covariance) == (None, None)
    assert [frame.exposure_start for frame in source.frames()] == [
        round((f.exposure_start + f.exposure_end) / 2) for f in small_frames()
    ]


@each_version
def test_events_only(path, save):
    save(path, variables(image=None, time_image=None, exposure=None))
    source = readers.read(path)
    assert (source.sensor_size, source.count_frames()) == (SIZE, 0)
    assert list(source.frames()) == []
    assert "no frames" in source.missing[0]


@each_version
def test_no_events(path, save):
    save(path, variables(events=np.empty((0, 4))))
    source = readers.read(path)
    assert source.count_events() == 0
    assert list(source.events()) == []
    assert "no events" in source.missing[0]


@each_version
def test_floating_point_images_keep_white(path, save):
    save(path, variables(image=variables()["image"].astype(np.float64)))
    frame = next(readers.read(path).frames())
    assert frame.image.dtype == np.float32
    assert frame.white_value == 255


@each_version
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"events": None}, "no variable 'events'"),
        ({"events": np.ones((5, 3))}, "events is 5 x 3; N x 4"),
        ({"time_image": None}, "no variable 'time_image'"),
        ({"time_image": np.ones((4, 2))}, "time_image has 8 values for 4 frames"),
        ({"time_image": np.linspace(0, 0.1, 4)}, "cannot be microseconds"),
        ({"exposure": np.array([1.0, 2.0])}, "exposure has 2 values for 4 frames"),
        ({"exposure": np.array([np.nan] * 4)}, "exposure is not"),
        ({"image": np.zeros((*SIZE, 3, 4), np.uint8)}, "image is 30 x 40 x 3 x 4"),
        ({"image": None, "img_color": np.zeros((*SIZE, 3, 4), np.uint8)}, "in colour only"),
        ({"image": None, "im_height": None}, "neither images nor im_height"),
        ({"im_width": 41.0}, "im_height x im_width is 30 x 41, but image is 30 x 40"),
        ({"ct": -0.1}, "ct is"),
        ({"f_Q": np.ones(255)}, r"f_Q is float64 \(255,\); 256 finite numbers"),
        ({"HDR_mat": np.ones((*SIZE, 3, 5))}, "HDR_mat is 30 x 40 x 3 x 5 for 4 frames"),
    ],
)
def test_other_layouts_are_refused(path, save, changes, message):
    save(path, variables(**changes))
    with pytest.raises(FormatError, match=message):
        readers.read(path)


@each_version
@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        (0, np.nan, "time of event 7 is nan"),
        (1, 0, "event 7 is at x=0.*begin at 1"),
        (2, 1.5, "y of event 7 is 1.5"),
        (3, 5, "polarity"),
    ],
)
def test_unusable_events_are_refused(path, save, column, value, message):
    events = variables()["events"]
    events[7, column] = value
    save(path, variables(events=events))
    with pytest.raises(EventError, match=message):
        all_events(readers.read(path))


@pytest.mark.parametrize("save", [save_5, save_5_plain])
def test_a_file_cut_short_is_refused(path, save):
    save(path, variables())
    data = path.read_bytes()
    for share in (0.01, 0.3, 0.6, 0.9):
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(FormatError, match=str(path)):
            readers.read(path)


@pytest.mark.parametrize("save", [save_5, save_5_plain])
def test_damage_gives_clear_errors(path, save):
    save(path, variables())
    assert_only_clear_errors(path, damaged(path.read_bytes(), 300))


def test_a_version_73_file_cut_short_gives_clear_errors(path):
    # Not changed inside: MATLAB's kind of HDF5 has no checksums, and the HDF5 library may then crash.
    save_73(path, variables())
    data = path.read_bytes()
    assert_only_clear_errors(path, (data[: len(data) * i // 40] for i in range(40)))


@pytest.mark.parametrize("variant", ["clean", "blur", "noisy"])
def test_real_files_agree_with_scipy_in_both_versions(shared_data, tmp_path, variant):
    original = shared_data / "hdr_pan" / f"Oxford_Church_{variant}.mat"
    theirs = {name: v for name, v in scipy.io.loadmat(original).items() if not name.startswith("_")}
    transcoded = tmp_path / "real payload, our writer.mat"
    save_73(transcoded, theirs)
    for path in (original, transcoded):
        source = mat.read(path)
        assert (source.sensor_size, source.count_frames()) == ((120, 160), 30)
        ours = all_events(source)
        assert np.array_equal(ours["t"], theirs["events"][:, 0])
        assert np.array_equal(ours["x"], theirs["events"][:, 1] - 1)
        assert np.array_equal(ours["y"], theirs["events"][:, 2] - 1)
        assert np.array_equal(ours["p"], theirs["events"][:, 3] == 1)
        assert np.array_equal(source.inverse_covariance, theirs["f_Q"].ravel())
        for index, frame in enumerate(source.frames()):
            assert np.array_equal(frame.image, theirs["image"][..., index])
            assert frame.exposure == theirs["exposure"][index, 0]
            assert frame.middle == theirs["time_image"][index, 0]
