"""The public names."""

from __future__ import annotations

import subprocess
import sys

import pytest

import kalux


def test_all_is_what_there_is():
    assert sorted(set(kalux.__all__)) == sorted(kalux.__all__)
    assert len(kalux.__all__) <= 25
    for name in kalux.__all__:
        assert getattr(kalux, name) is not None


def test_the_names_that_users_were_promised():
    """The design's examples: a name may come, none may go."""
    promised = {"open", "Recording", "reconstruct", "Reconstructor", "Frame", "Image", "Settings", "preset"}
    assert promised | {"PRESETS", "KaluxError", "EVENT_DTYPE", "as_events"} <= set(kalux.__all__)


def test_a_star_import_does_not_hide_the_builtin_that_tests_rely_on():
    """`kalux.open` opens recordings; the package itself must not be broken by it."""
    names: dict[str, object] = {}
    exec("from kalux import *", names)
    assert names["open"] is kalux.open
    assert set(kalux.__all__) <= set(names)


def test_import_reads_nothing_and_prints_nothing():
    done = subprocess.run(
        [sys.executable, "-c", "import kalux; print(kalux.__version__)"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == kalux.__version__
    assert done.stderr == ""


def test_import_waits_with_heavy_libraries():
    """Half a second of numba and OpenCV is for the first name that needs them, 0.1 s of h5py for a file of HDF5."""
    code = "import sys, kalux; print(*sys.modules); kalux.Settings; kalux.Recording; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    before, after = (set(line.split()) for line in done.stdout.splitlines())
    assert not {"numpy", "numba", "cv2", "h5py", "scipy"} & before
    assert {"numba", "cv2"} <= after
    assert "h5py" not in after


def test_names_are_listed_before_they_are_imported():
    code = "import kalux; print(*dir(kalux))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert {*kalux.__all__, "settings", "display", "pipeline"} <= set(done.stdout.split())


def test_a_name_that_is_not_there_is_an_error():
    with pytest.raises(AttributeError, match="no attribute 'reconstrct'"):
        kalux.reconstrct  # noqa: B018
    assert not hasattr(kalux, "__wrapped__")


def test_modules_are_there_without_their_own_import():
    """All that docs/api.md sends readers to."""
    code = "import kalux; kalux.evaluation.mse, kalux.datasets.simulate, kalux.writers.open_writer, "
    code += "kalux.display.tone_map; print(kalux.settings.Settings is kalux.Settings)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"


def test_every_error_is_a_kalux_error():
    from kalux import errors

    kinds = [v for v in vars(errors).values() if isinstance(v, type) and issubclass(v, Exception)]
    assert len(kinds) >= 9
    assert all(issubclass(kind, kalux.KaluxError) for kind in kinds)
    assert all(kind.__doc__ for kind in kinds)
