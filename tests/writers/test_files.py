"""An output has one writer at a time, and one that was killed does not keep it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from kalux import readers
from kalux.errors import OutputError
from kalux.writers import files, open_writer
from kalux.writers.files import Claim, save, temporary_path, write_whole
from recordings import small_events, write_kalux

pytest.importorskip("fcntl", reason="locks are those of POSIX")


class Image(NamedTuple):
    """As of `kalux.writers.base.ImageLike`."""

    t: int
    intensity: NDArray[np.float32]
    variance: NDArray[np.float32]


IMAGE = Image(0, np.full((16, 16), 0.5, np.float32), np.ones((16, 16), np.float32))


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_second_claim_is_refused_until_the_first_ends(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    first = Claim(path)
    with pytest.raises(OutputError, match=r"a\.h5: it is being written already"):
        Claim(path)
    assert names(tmp_path) == {".a.h5.part"}
    first.release()
    assert names(tmp_path) == set()
    with Claim(path) as temporary:
        assert temporary == temporary_path(path)
    first.release()


def test_a_folder_is_claimed_itself(tmp_path: Path) -> None:
    with Claim(tmp_path, is_folder=True):
        with pytest.raises(OutputError, match="being written already"):
            Claim(tmp_path, is_folder=True)
        with Claim(tmp_path / "a.h5"):  # what lies in it is another output
            pass
    assert tmp_path.is_dir()


def test_what_another_writer_began_after_the_renaming_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    first = Claim(path)
    os.replace(first.temporary, path)
    second = Claim(path)
    first.release()
    assert second.temporary.exists()
    second.release()
    assert names(tmp_path) == {"a.h5"}


def test_a_file_that_is_renamed_while_it_is_being_locked_is_not_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lock would be on a finished output."""
    path = tmp_path / "a.h5"
    lock = files._lock
    locked: list[int] = []

    def late(descriptor: int) -> bool:
        if not locked:
            os.replace(temporary_path(path), path)
        locked.append(descriptor)
        return lock(descriptor)

    monkeypatch.setattr(files, "_lock", late)
    with Claim(path) as temporary:
        assert len(locked) == 2
        assert not os.path.samefile(temporary, path)


def test_what_a_killed_process_left_is_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    script = (
        "import os, sys; from pathlib import Path; from kalux.writers.files import Claim; "
        "claim = Claim(Path(sys.argv[1])); print(flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        with pytest.raises(OutputError, match="being written already"):
            save(path, "mine")
        other.send_signal(signal.SIGKILL)
        other.wait()
    assert names(tmp_path) == {".a.h5.part"}
    write_whole(path, b"mine")
    assert names(tmp_path) == {"a.h5"}


@pytest.mark.parametrize("format", ["mp4", "png", "npy"])
def test_two_writers_of_one_output(tmp_path: Path, format: str) -> None:
    out = tmp_path / ("v.mp4" if format == "mp4" else "images")
    with open_writer(out, format=format, overwrite=True) as writer:
        writer.write(IMAGE)
        with pytest.raises(OutputError, match="it is being written already"):
            open_writer(out, format=format, overwrite=True)
        writer.write(IMAGE._replace(t=10_000))
    assert writer.images == 2
    with open_writer(out, format=format, overwrite=True) as writer:
        writer.write(IMAGE)
    assert not list(tmp_path.rglob("*.part"))


def test_a_writer_that_nobody_closed_does_not_keep_its_output(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "images", format="png")
    del writer
    with open_writer(tmp_path / "images", format="png", overwrite=True):
        pass


def test_two_recordings_of_one_name(tmp_path: Path) -> None:
    """The first is whole, although a second is begun in the middle of it."""
    path = tmp_path / "a.h5"
    events = small_events()

    def chunks():
        yield events[:100]
        with pytest.raises(OutputError, match="it is being written already"):
            write_kalux(path, events=[events], ground_truth=None)
        yield events[100:]

    write_kalux(path, events=chunks(), ground_truth=None)
    assert readers.read(path).count_events() == len(events)
    assert names(tmp_path) == {"a.h5"}
