"""NumPy files: the layouts that peers save, units of time, damage."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest

from kalux import readers
from kalux.errors import FormatError
from kalux.readers import numpy_files
from recordings import SIZE, all_events, assert_only_clear_errors, damaged, small_events

EVENTS = small_events()
NEEDED = (int(EVENTS["y"].max()) + 1, int(EVENTS["x"].max()) + 1)


def structured(names, types):
    """The small events as peers name and type them."""
    out = np.empty(len(EVENTS), list(zip(names, types, strict=True)))
    for ours, name in zip("txyp", names, strict=True):
        out[name] = EVENTS[ours]
    return out


LAYOUTS = {
    "tonic": structured(["t", "x", "y", "p"], ["<i8", "<i2", "<i2", "?"]),
    "dv-processing": structured(["timestamp", "x", "y", "polarity"], ["<i8", "<i2", "<i2", "i1"]),
    "metavision": structured(["t", "x", "y", "p"], ["<i8", "<u2", "<u2", "<i2"]),
    "event_stream": structured(["t", "x", "y", "on"], ["<u8", "<u2", "<u2", "?"]),
    "big endian": structured(["ts", "xs", "ys", "ps"], [">i8", ">u2", ">u2", "u1"]),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_structured_arrays(tmp_path, layout, suffix):
    path = tmp_path / f"events{suffix}"
    np.save(path, LAYOUTS[layout]) if suffix == ".npy" else np.savez(
        path, events=LAYOUTS[layout], other=np.eye(3)
    )
    source = readers.read(path)
    assert (source.format, source.sensor_size, source.sensor_size_known) == (suffix[1:], NEEDED, False)
    assert (source.count_events(), source.count_frames()) == (500, 0)
    for _ in range(2):
        assert np.array_equal(all_events(source), EVENTS)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_an_array_per_field(tmp_path, save):
    columns = {"timestamps": EVENTS["t"], "x": EVENTS["x"], "y": EVENTS["y"], "polarity": EVENTS["p"] * 2 - 1}
    save(tmp_path / "events.npz", **columns, height=30, width=np.array([40]))
    source = readers.read(tmp_path / "events.npz")
    assert (source.sensor_size, source.sensor_size_known) == (SIZE, True)
    assert np.array_equal(all_events(source), EVENTS)


def test_pieces_join_without_a_seam(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "e.npz", t=EVENTS["t"], x=EVENTS["x"], y=EVENTS["y"], p=EVENTS["p"])
    monkeypatch.setattr(numpy_files, "CHUNK_EVENTS", 64)
    chunks = list(readers.read(tmp_path / "e.npz").events())
    assert [len(chunk) for chunk in chunks] == [64] * 7 + [52]
    assert np.array_equal(np.concatenate(chunks), EVENTS)


@pytest.mark.parametrize(
    ("name", "times", "assumed"),
    [
        ("t", EVENTS["t"], True),
        ("t_us", EVENTS["t"].astype(float), False),
        ("timestamp_ns", EVENTS["t"] * 1000, False),
        ("Time (ms)", EVENTS["t"] / 1e3, False),
        ("ts_s", EVENTS["t"] / 1e6, False),
        ("t[us]", EVENTS["t"], False),
    ],
)
def test_the_unit_of_time_is_in_the_name(tmp_path, name, times, assumed):
    np.savez(tmp_path / "e.npz", **{name: times, "x": EVENTS["x"], "y": EVENTS["y"], "p": EVENTS["p"]})
    source = readers.read(tmp_path / "e.npz")
    assert np.array_equal(all_events(source), EVENTS)
    assert any("unit of time" in sentence for sentence in source.missing) == assumed


def test_frames_that_are_not_read_are_named(tmp_path):
    columns = {name: EVENTS[name] for name in "txyp"}
    np.savez(tmp_path / "e.npz", **columns, times=np.arange(2), images=np.zeros((2, 30, 40), np.uint8))
    (about,) = (sentence for sentence in readers.read(tmp_path / "e.npz").missing if "frames" in sentence)
    assert "images (2, 30, 40)" in about
    assert "from_arrays" in about


@pytest.mark.parametrize(
    ("arrays", "told"),
    [
        ({"a": np.zeros((5, 4))}, r"\(N, 4\) array.*columns='txyp'"),
        ({"t": np.arange(3), "x": np.arange(3)}, r"holds t \(3,\), x \(3,\); an array for each"),
        ({"t": np.arange(3), "x": np.arange(3), "y": np.arange(3), "p": np.ones(2, int)}, "p 2"),
        ({"t": np.arange(3.0), "x": np.arange(3), "y": np.arange(3), "p": np.ones(3, int)}, "as t_s, t_ms"),
        (
            {"t": np.arange(3), "x": np.arange(3) + 0.5, "y": np.arange(3), "p": np.ones(3, int)},
            "x of event 0 is 0.5",
        ),
        (
            {"t": np.arange(3), "x": np.arange(3), "y": np.arange(3), "p": np.full(3, 7)},
            "polarity of event 0",
        ),
        ({"t": np.array([None] * 3), "x": np.arange(3), "y": np.arange(3), "p": np.ones(3, int)}, "objects"),
        ({"a": LAYOUTS["tonic"], "b": LAYOUTS["tonic"]}, "one structured array"),
        ({"height": 0, "width": 5, "events": LAYOUTS["tonic"]}, "5x0 pixels"),
    ],
)
def test_other_contents_are_refused(tmp_path, arrays, told):
    np.savez(tmp_path / "e.npz", **arrays)
    with pytest.raises(FormatError, match=told):
        all_events(readers.read(tmp_path / "e.npz"))


def test_an_n_by_4_array_is_refused_with_a_hint(tmp_path):
    np.save(tmp_path / "e.npy", np.zeros((5, 4)))
    with pytest.raises(FormatError, match="does not say which column"):
        readers.read(tmp_path / "e.npy")


def test_objects_are_never_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("unpickled",))

    np.save(tmp_path / "e.npy", np.array([Trap()], object), allow_pickle=True)
    with pytest.raises(FormatError):
        readers.read(tmp_path / "e.npy")


def test_a_length_that_is_not_there(tmp_path):
    header = io.BytesIO()
    descr = [("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "?")]
    np.lib.format.write_array_header_1_0(header, {"descr": descr, "fortran_order": False, "shape": (10**12,)})
    (tmp_path / "e.npy").write_bytes(header.getvalue() + bytes(100))
    with pytest.raises(FormatError, match="cut short"):
        readers.read(tmp_path / "e.npy")


def test_zips_of_other_things_are_not_recognised(tmp_path):
    with zipfile.ZipFile(tmp_path / "e.zip", "w") as archive:
        archive.writestr("model/weights.npy", b"")
        archive.writestr("notes.txt", b"")
    assert not numpy_files.recognises(tmp_path / "e.zip")


@pytest.mark.parametrize("save", ["npy", "npz", "compressed"])
def test_damage_gives_clear_errors(tmp_path, save):
    path = tmp_path / ("e.npy" if save == "npy" else "e.npz")
    fields = {name: EVENTS[name] for name in "txyp"}
    if save == "npy":
        np.save(path, EVENTS)
    else:
        (np.savez if save == "npz" else np.savez_compressed)(path, **fields, height=30, width=40)
    assert_only_clear_errors(path, damaged(path.read_bytes(), 150, 150))


def test_a_real_payload(shared_data, tmp_path):
    """Real payload, NumPy's writer."""
    events = all_events(readers.read(shared_data / "newton_davis346.aedat4"))
    np.savez_compressed(tmp_path / "e.npz", t=events["t"], x=events["x"], y=events["y"], p=events["p"])
    assert np.array_equal(all_events(readers.read(tmp_path / "e.npz")), events)
