"""Published sets: what is found in folders laid out as they are published.

The sets themselves are not here. Folders are made of real payloads (events and frames of slider_depth) by our own
writers, in the published layouts.
"""

from __future__ import annotations

import cv2
import h5py
import numpy as np
import pytest
import scipy.io

import kalux
from kalux.datasets.published import SETS, check_sequence, contents, published_set, sequences
from kalux.errors import FormatError, InputError

SIZE = (180, 240)
COUNT = 2000


@pytest.fixture(scope="module")
def payload(shared_data):
    """The first events and frames of slider_depth."""
    recording = kalux.open(shared_data / "slider_depth", exposure=10_000)
    events = next(iter(recording.events()))[:COUNT].copy()
    frames = [frame for _, frame in zip(range(4), recording.frames(), strict=False)]
    return events, frames


def write_ijrr(folder, events, frames):
    (folder / "images").mkdir(parents=True)
    rows = (f"{e['t'] * 1e-6:.6f} {e['x']} {e['y']} {int(e['p'])}\n" for e in events)
    (folder / "events.txt").write_text("".join(rows))
    lines = []
    for i, frame in enumerate(frames):
        cv2.imwrite(str(folder / "images" / f"{i:08}.png"), frame.image)
        lines.append(f"{frame.exposure_start * 1e-6:.6f} images/{i:08}.png\n")
    (folder / "images.txt").write_text("".join(lines))


def write_mat(path, events, frames, **more):
    arrays = {
        "events": np.stack(
            [events["t"], events["x"] + 1, events["y"] + 1, np.where(events["p"], 1, -1)], axis=1
        ).astype(np.float64),
        "image": np.stack([f.image for f in frames], axis=2),
        "time_image": np.array([f.middle for f in frames], np.float64),
        "exposure": np.array([f.exposure for f in frames], np.float64),
        "im_height": SIZE[0],
        "im_width": SIZE[1],
    }
    scipy.io.savemat(path, arrays | more)


def write_hqf(path, events, frames):
    with h5py.File(path, "w") as file:
        for name, values in (
            ("xs", events["x"]),
            ("ys", events["y"]),
            ("ts", events["t"] * 1e-6),
            ("ps", events["p"]),
        ):
            file[f"events/{name}"] = values
        file.attrs["sensor_resolution"] = SIZE
        for i, frame in enumerate(frames):
            image = file.create_dataset(f"images/image{i:09}", data=frame.image)
            image.attrs["timestamp"] = frame.exposure_start * 1e-6


def write_dsec(folder, events):
    left = folder / "events" / "left"
    left.mkdir(parents=True)
    with h5py.File(left / "events.h5", "w") as file:
        for name in "txyp":
            file[f"events/{name}"] = events[name].astype(np.uint32 if name == "t" else np.uint16)
        file["t_offset"] = np.int64(0)
        file["ms_to_idx"] = np.zeros(1, np.uint64)


def test_text_folders_as_published(payload, tmp_path):
    events, frames = payload
    for name in ("slider_depth", "boxes_6dof"):
        write_ijrr(tmp_path / name, events, frames)
    (tmp_path / "notes.pdf").write_bytes(b"")
    (tmp_path / "stray.dat").write_bytes(b"")
    (tmp_path / "mine.bag").write_bytes(b"")
    (tmp_path / ".hidden").write_bytes(b"")
    found = contents("ijrr", tmp_path)
    assert [name for name, _ in found.found] == ["boxes_6dof", "slider_depth"]
    assert len(found.missing) == 25
    assert "slider_depth" not in found.missing
    assert found.incomplete == {"boxes_6dof": ("calib.txt",), "slider_depth": ("calib.txt",)}
    assert found.unknown == ("mine.bag", "stray.dat")  # the names of all sequences are known
    opened = dict(sequences("ijrr", tmp_path, exposure=10_000))
    for recording in opened.values():
        assert len(recording.events()) == COUNT
        assert [f.exposure for f in recording.frames()] == [10_000] * 4


def test_a_folder_that_is_a_sequence_itself(payload, tmp_path):
    write_ijrr(tmp_path / "slider_depth", *payload)
    assert [name for name, _ in contents("ijrr", tmp_path / "slider_depth").found] == ["slider_depth"]


def test_mat_files_with_truth(payload, tmp_path):
    events, frames = payload
    radiance = np.stack([np.stack([f.image * 2.0] * 3, axis=2) for f in frames], axis=3)
    radiance[:20] = 0  # not registered
    write_mat(tmp_path / "tree3.mat", events, frames, HDR_mat=radiance)
    [(name, path)] = contents("hdr", tmp_path).found
    found = check_sequence(name, path, whole=True)
    assert (name, found.events, found.frames, found.truth, found.sensor_size) == ("tree3", COUNT, 4, 4, SIZE)
    assert found.error == ""
    [(_, recording)] = sequences("hdr", tmp_path)
    assert not recording.ground_truth().masks[:, :20].any()


def test_curves_are_no_sequences(payload, tmp_path):
    write_mat(tmp_path / "mountain.mat", *payload)
    scipy.io.savemat(tmp_path / "s_curve_80.mat", {"s_curve": np.arange(256.0)})
    found = contents("ahdr", tmp_path)
    assert [name for name, _ in found.found] == ["mountain"]
    assert found.unknown == ()


def test_hdf5_of_hqf(payload, tmp_path):
    write_hqf(tmp_path / "still_life.h5", *payload)
    [(name, recording)] = sequences("hqf", tmp_path, exposure=5_000)
    assert (name, recording.sensor_size, len(recording.frames())) == ("still_life", SIZE, 4)
    assert len(contents("hqf", tmp_path).missing) == 13


def test_dsec_folders(payload, tmp_path):
    """Colour images of the other camera beside the events do not stand in the way."""
    folder = tmp_path / "train" / "interlaken_00_c"
    write_dsec(folder, payload[0])
    images = folder / "images" / "left" / "rectified"
    images.mkdir(parents=True)
    cv2.imwrite(str(images / "000000.png"), np.arange(36, dtype=np.uint8).reshape(3, 4, 3))
    found = contents("dsec", tmp_path)
    assert [name for name, _ in found.found] == ["train/interlaken_00_c"]
    assert found.unknown == ()
    assert found.incomplete["train/interlaken_00_c"] == (
        "events/left/rectify_map.h5",
        "images/left/exposure_timestamps.txt",
    )
    [(_, recording)] = sequences("dsec", tmp_path)
    assert len(recording.events()) == COUNT


def test_damage_is_told_and_does_not_end_the_check(payload, tmp_path):
    write_mat(tmp_path / "whole.mat", *payload)
    write_mat(tmp_path / "broken.mat", *payload)
    data = (tmp_path / "broken.mat").read_bytes()
    (tmp_path / "broken.mat").write_bytes(data[: len(data) // 2])
    found = [check_sequence(name, path, whole=True) for name, path in contents("hdr", tmp_path).found]
    assert [bool(one.error) for one in found] == [True, False]
    assert "broken.mat" in found[0].error
    with pytest.raises(FormatError, match=r"broken\.mat"):
        next(sequences("hdr", tmp_path))


def test_what_is_not_there(tmp_path):
    with pytest.raises(InputError, match="no set 'mnist'; known are hdr, ahdr"):
        published_set("mnist")
    with pytest.raises(InputError, match="no such folder"):
        contents("hqf", tmp_path / "none")
    with pytest.raises(InputError, match="no sequence of hqf is in it; expected is a ROS bag"):
        list(sequences("hqf", tmp_path))


def test_every_set_says_what_a_user_needs():
    assert [one.name for one in SETS] == sorted({one.name for one in SETS}, key=[o.name for o in SETS].index)
    for one in SETS:
        assert one.page.startswith("https://")
        assert one.licence
        assert one.files or one.marks
        assert len(set(one.sequences)) == len(one.sequences)
