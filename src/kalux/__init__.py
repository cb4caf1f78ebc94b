"""kalux: HDR video with per-pixel uncertainty from hybrid event cameras."""

from pathlib import Path
from typing import TYPE_CHECKING

from kalux.kernel_cache import ensure_writable

if TYPE_CHECKING:
    from kalux.calibration.values import Calibration, load_calibration
    from kalux.errors import KaluxError
    from kalux.events import EVENT_DTYPE, as_events
    from kalux.frames import Frame
    from kalux.images import Image
    from kalux.pipeline import reconstruct
    from kalux.reconstructor import Reconstructor
    from kalux.recording import Recording, open
    from kalux.settings import PRESETS, Settings, preset

__version__ = "0.1.0"

__all__ = [
    "EVENT_DTYPE",
    "PRESETS",
    "Calibration",
    "Frame",
    "Image",
    "KaluxError",
    "Reconstructor",
    "Recording",
    "Settings",
    "as_events",
    "load_calibration",
    "open",
    "preset",
    "reconstruct",
]

ensure_writable(Path(__file__).parent)
del Path, ensure_writable

# Names are imported when they are first used: numba, OpenCV and h5py take half a second.
if not TYPE_CHECKING:
    _HOMES = {
        "Calibration": "calibration.values",
        "EVENT_DTYPE": "events",
        "Frame": "frames",
        "Image": "images",
        "KaluxError": "errors",
        "PRESETS": "settings",
        "Reconstructor": "reconstructor",
        "Recording": "recording",
        "Settings": "settings",
        "as_events": "events",
        "load_calibration": "calibration.values",
        "open": "recording",
        "preset": "settings",
        "reconstruct": "pipeline",
    }
    _MODULES = (
        "calibration",
        "datasets",
        "display",
        "errors",
        "evaluation",
        "events",
        "frames",
        "images",
        "pipeline",
        "reconstructor",
        "recording",
        "settings",
        "writers",
    )

    def __getattr__(name):
        """A public name, or a module of the package."""
        import importlib

        if name in _MODULES:
            return importlib.import_module(f"{__name__}.{name}")
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
        globals()[name] = value
        return value

    def __dir__():
        return sorted({*globals(), *__all__, *_MODULES})
