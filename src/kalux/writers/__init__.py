"""Writing images: folders of PNG, EXR or NPY, videos, and contact sheets.

Whatever happens (an interrupt, a full disk, a crash), no partial file stands under its final name, and what
was finished stays valid and says whether it is complete.
"""

from kalux.writers.base import ImageLike, Writer
from kalux.writers.contact_sheet import Panel, colour_map, contact_sheet, variance_limits
from kalux.writers.opening import FORMATS, open_writer
from kalux.writers.video import VideoSettings

__all__ = [
    "FORMATS",
    "ImageLike",
    "Panel",
    "VideoSettings",
    "Writer",
    "colour_map",
    "contact_sheet",
    "open_writer",
    "variance_limits",
]
