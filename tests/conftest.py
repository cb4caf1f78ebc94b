"""Shared fixtures."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings

# As on the command line. Two processes with two threads each make small least squares take ten times as long.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# The first call of a compiled function compiles it, which takes longer than any deadline.
settings.register_profile("kalux", deadline=None)
settings.load_profile("kalux")

# A shell starts what runs in the background with Ctrl-C ignored, which many tests send.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real recordings beside the project, which do not ship with it."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"needs the real recordings in {folder}")
    return folder
