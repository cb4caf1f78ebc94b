"""kalux: HDR video with per-pixel uncertainty from hybrid event cameras."""

from kalux.calibration.values import Calibration, load_calibration
from kalux.errors import KaluxError
from kalux.events import EVENT_DTYPE, as_events
from kalux.frames import Frame
from kalux.pipeline import reconstruct
from kalux.reconstructor import Image, Reconstructor
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
