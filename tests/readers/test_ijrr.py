"""The IJRR text reader: exact decimals, every malformed line, folders and zips, the real slider_depth."""

from __future__ import annotations

import shutil
import tempfile
import zipfile
from decimal import ROUND_HALF_UP, Decimal
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalux import readers
from kalux.errors import FormatError
from kalux.readers import characters, ijrr
from recordings import (
    SIZE,
    all_events,
    assert_only_clear_errors,
    complaint,
    damaged,
    small_events,
    small_frames,
)


def write_folder(folder, *, events=None, frames=None):
    """A recording in the published layout."""
    events = small_events() if events is None else events
    frames = small_frames() if frames is None else frames
    (folder / "images").mkdir(parents=True, exist_ok=True)
    lines = [f"{t / 1e6:.6f} {x} {y} {int(p)}\n" for t, x, y, p in events.tolist()]
    (folder / "events.txt").write_text("".join(lines))
    names = [f"images/frame_{i:08d}.png" for i in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        cv2.imwrite(str(folder / name), frame.image)
    (folder / "images.txt").write_text(
        "".join(f"{f.exposure_start / 1e6:.9f} {name}\n" for f, name in zip(frames, names, strict=True))
    )
    return folder


def zipped(folder, path, top=""):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*")):
            archive.write(file, top + str(file.relative_to(folder)))
    return path


@pytest.fixture
def folder(tmp_path):
    return write_folder(tmp_path / "recording")


def assert_is_small(source):
    assert (source.format, source.sensor_size, source.exposure_known) == ("ijrr", SIZE, False)
    assert np.array_equal(all_events(source), small_events())
    assert source.count_events() == 500
    frames = list(source.frames())
    assert len(frames) == source.count_frames() == 4
    for ours, theirs in zip(frames, small_frames(), strict=True):
        assert np.array_equal(ours.image, theirs.image)
        assert ours.exposure_start == ours.exposure_end == theirs.exposure_start


def test_folder(folder):
    source = readers.read(folder)
    assert_is_small(source)
    assert any("exposure times" in sentence for sentence in source.missing)


@pytest.mark.parametrize("top", ["", "slider/"])
def test_zip(folder, tmp_path, top):
    assert_is_small(readers.read(zipped(folder, tmp_path / "recording.zip", top)))


def test_blocks_of_text_join_without_a_seam(folder, monkeypatch):
    monkeypatch.setattr(characters, "BLOCK_BYTES", 1000)
    monkeypatch.setattr(characters, "LONGEST_LINE", 100)
    chunks = list(readers.read(folder).events())
    assert len(chunks) > 5
    assert np.array_equal(np.concatenate(chunks), small_events())


def parse(folder, text):
    (folder / "events.txt").write_bytes(text)
    return all_events(readers.read(folder)).tolist()


def test_other_spellings(folder):
    expected = [(1_000_000, 2, 3, True), (1_500_000, 4, 5, False)]
    for text in (
        b"1.0 2 3 1\n1.5 4 5 0\n",
        b"1.0 2 3 1\n1.5 4 5 0",  # no end of the last line
        b"1. 2 3 1\r\n1.50 4 5 0\r\n",
        b"# t x y p\n\n  1.000000000\t2  3 1 \n1.5 4 5 0\n\n",
        b"40 30\n1.0 2 3 1\n1.5 4 5 0\n",  # header: width height
    ):
        assert parse(folder, text) == expected
    assert parse(folder, b".0000005 2 3 1\n") == [(1, 2, 3, True)]
    assert parse(folder, b"") == []


@settings(deadline=None)  # the first example compiles the parser
@given(
    st.lists(
        st.one_of(
            st.decimals(min_value=0, max_value=10**11, allow_nan=False, places=9),
            st.decimals(min_value=0, max_value=2, allow_nan=False, places=7),
        ).map(lambda value: f"{value:f}"),
        min_size=1,
        max_size=20,
    )
)
def test_times_are_rounded_from_their_digits(times):
    with tempfile.TemporaryDirectory() as folder:
        found = parse(Path(folder), "".join(f"{time} 1 1 1\n" for time in times).encode())
    exact = [int((Decimal(time) * 10**6).to_integral_value(ROUND_HALF_UP)) for time in times]
    assert [t for t, *_ in found] == exact


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        (b"-0.5 1 2 1", "time"),
        (b"1.5e3 1 2 1", "time"),
        (b"nan 1 2 1", "time"),
        (b"1.2.3 1 2 1", "time"),
        (b". 1 2 1", "time"),
        (b"1234567890123.5 1 2 1", "time"),
        (b"0.5,1,2,1", "time"),
        (b"0.5 -1 2 1", "x is not"),
        (b"0.5 1.5 2 1", "x is not"),
        (b"0.5 70000 2 1", "x is not"),
        (b"0.5 1 b 1", "y is not"),
        (b"0.5 1 2 2", "polarity"),
        (b"0.5 1 2 -1", "polarity"),
        (b"0.5 1 2 1 7", "more than four"),
        (b"0.5 1 2", "fewer than four"),
        (b"0.5", "fewer than four"),
        (b"0.5 1\x00\x00 2 1", "y is not"),
        (b"\xff\xfe", "time"),
    ],
)
def test_a_malformed_line_is_named(folder, line, fault):
    good = b"0.1 1 1 1\n" * 7
    (folder / "events.txt").write_bytes(good + line + b"\n" + good)
    with pytest.raises(FormatError, match=rf"events\.txt, line 8: .*{fault}"):
        all_events(readers.read(folder))


def test_an_endless_line_is_refused(folder):
    (folder / "events.txt").write_bytes(b"0.1 1 1 1\n" * 3 + b"7" * 20_000)
    with pytest.raises(FormatError, match="line 4: the line is too long"):
        all_events(readers.read(folder))


def test_times_that_are_not_seconds_are_refused(folder):
    (folder / "events.txt").write_bytes(b"1000 1 1 1\n2000 1 1 1\n")
    with pytest.raises(FormatError, match="no decimal point"):
        readers.read(folder)


def test_without_images(folder):
    (folder / "images.txt").unlink()
    source = readers.read(folder)
    events = small_events()
    assert source.sensor_size == (events["y"].max() + 1, events["x"].max() + 1)
    assert list(source.frames()) == []
    assert any(r"images.txt" in sentence for sentence in source.missing)
    assert any("sensor size" in sentence for sentence in source.missing)
    assert not source.sensor_size_known
    text = (folder / "events.txt").read_text()
    (folder / "events.txt").write_text("240 180\n" + text)
    source = readers.read(folder)
    assert (source.sensor_size, source.sensor_size_known) == ((180, 240), True)


def test_nothing_at_all(folder):
    (folder / "events.txt").write_bytes(b"")
    (folder / "images.txt").write_bytes(b"")
    with pytest.raises(FormatError, match="has no events, and does not say"):
        readers.read(folder)


def test_missing_image(folder):
    (folder / "images" / "frame_00000002.png").unlink()
    with pytest.raises(FormatError, match=r"1 of 4 images .*frame_00000002"):
        readers.read(folder)


def test_malformed_image_list(folder):
    (folder / "images.txt").write_text("0.1 images/frame_00000000.png\nimages/frame_00000001.png\n")
    with pytest.raises(FormatError, match=r"images\.txt: line 2"):
        readers.read(folder)


@pytest.mark.parametrize("name", ["dynamic_6dof.txt", "data/dynamic_6dof.txt"])
@pytest.mark.parametrize("header", ["40 30\n", ""])
def test_a_zip_with_nothing_but_a_text_of_events(folder, tmp_path, name, header):
    """As rpg_e2vid takes and publishes them; what other systems leave beside it does not count."""
    text = header + (folder / "events.txt").read_text()
    path = tmp_path / "recording.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, text)
        archive.writestr(f"__MACOSX/._{name}", b"\0\5\x16\7")
    source = readers.read(path)
    assert (source.format, source.count_frames(), source.sensor_size_known) == ("ijrr", 0, bool(header))
    assert source.sensor_size == SIZE
    assert np.array_equal(all_events(source), small_events())
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(name, text + "0.5 b 1 1\n")
    with pytest.raises(FormatError, match=rf"dynamic_6dof\.txt, line {501 + len(header.splitlines())}: x is"):
        all_events(readers.read(path))


@pytest.mark.parametrize("texts", [["read me\n"], ["0 img.png\n"], ["1 2 3 1\n"], ["0.1 2 3 1\n"] * 2, []])
def test_other_zips_are_not_recognised(tmp_path, texts):
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("data.bin", b"0.1 2 3 1\n")
        for number, text in enumerate(texts):
            archive.writestr(f"{number}.txt", text)
    assert not ijrr.recognises(tmp_path / "other.zip")


@pytest.mark.parametrize("header", ["# id timestamp image_name\n", ""])
def test_the_images_of_uzh_fpv_have_numbers_before_their_times(folder, tmp_path, header):
    lines = (folder / "images.txt").read_text().splitlines()
    text = "".join(f"{number} {line}\n" for number, line in enumerate(lines))
    (folder / "images.txt").write_text(header + text)
    (folder / "events.txt").write_text("# timestamp x y polarity\n" + (folder / "events.txt").read_text())
    assert_is_small(readers.read(folder))
    assert_is_small(readers.read(zipped(folder, tmp_path / "recording.zip")))


def test_images_in_colour(folder):
    name = folder / "images" / "frame_00000000.png"
    grey = small_frames()[0].image
    cv2.imwrite(str(name), np.dstack([grey] * 3))  # grey, saved as colour
    assert np.array_equal(next(readers.read(folder).frames()).image, grey)
    cv2.imwrite(str(name), np.dstack([255 - grey, grey, grey // 2]))  # blue, green, red
    frames = list(readers.read(folder).frames())
    assert np.array_equal(frames[0].image, np.dstack([grey // 2, grey, 255 - grey]))
    assert {frame.image.shape for frame in frames} == {(*SIZE, 3)}  # also those that are grey


def test_an_image_in_colour_among_grey_ones_is_refused(folder):
    """Whether a recording is in colour is told from its first, its middle and its last image."""
    grey = small_frames()[1].image
    cv2.imwrite(str(folder / "images" / "frame_00000001.png"), np.dstack([grey, grey, 255 - grey]))
    with pytest.raises(
        FormatError, match=r"frame_00000001\.png' is in colour, but the images before it are grey"
    ):
        list(readers.read(folder).frames())


def test_16_bit_images(folder):
    image = small_frames()[0].image.astype(np.uint16) * 257
    cv2.imwrite(str(folder / "images" / "frame_00000000.png"), image)
    frame = next(readers.read(folder).frames())
    assert frame.image.dtype == np.uint16
    assert np.array_equal(frame.image, image)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_cut_image_is_refused(folder, capfd, suffix):
    data = cv2.imencode(suffix, small_frames()[0].image)[1].tobytes()
    name = folder / "images" / "frame_00000000.png"
    for end in (0, 1, 10, 100, len(data) // 2, len(data) - 3):
        name.write_bytes(data[:end])
        with pytest.raises(FormatError, match="not an image, or damaged"):
            readers.read(folder)
    assert capfd.readouterr().err == ""  # decoders would print


def test_damaged_events_give_clear_errors(folder):
    data = (folder / "events.txt").read_bytes()
    for changed in damaged(data, 150):
        (folder / "events.txt").write_bytes(changed)
        message = complaint(folder)
        assert "\n" not in message
        assert not message or str(folder) in message


def test_damaged_zips_give_clear_errors(folder, tmp_path):
    data = zipped(folder, tmp_path / "whole.zip").read_bytes()
    assert_only_clear_errors(tmp_path / "damaged.zip", damaged(data, 300))


def test_slider_depth(shared_data):
    source = readers.read(shared_data / "slider_depth")
    assert (source.sensor_size, source.count_events(), source.count_frames()) == ((180, 240), 1_078_541, 87)
    ours = all_events(source)
    with (shared_data / "slider_depth" / "events.txt").open() as file:
        theirs = np.loadtxt(file, max_rows=100_000)
    assert np.array_equal(ours["t"][:100_000], np.rint(theirs[:, 0] * 1e6))
    for column, field in enumerate("xyp", 1):
        assert np.array_equal(ours[field][:100_000], theirs[:, column])
    frames = list(source.frames())
    assert len(frames) == 87
    assert {frame.image.shape for frame in frames} == {(180, 240)}


def test_slider_depth_zipped(shared_data, tmp_path):
    folder = tmp_path / "part"
    shutil.copytree(shared_data / "slider_depth" / "images", folder / "images")
    shutil.copy(shared_data / "slider_depth" / "images.txt", folder)
    with (shared_data / "slider_depth" / "events.txt").open("rb") as file:
        (folder / "events.txt").write_bytes(b"".join(file.readlines(2_000_000)))
    source = readers.read(zipped(folder, tmp_path / "part.zip", "slider_depth/"))
    assert source.count_frames() == 87
    assert np.array_equal(all_events(source), all_events(readers.read(folder)))
