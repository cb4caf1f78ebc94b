"""Videos, which FFmpeg decodes (PyAV)."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from kalux.errors import FormatError
from kalux.readers.source import reading

if TYPE_CHECKING:
    from av.container import InputContainer


@contextlib.contextmanager
def opened_video(path: Path) -> Iterator[InputContainer]:
    """A video, open inside the block.

    Raises
    ------
    FormatError
        If it is none, or damaged, also where that shows inside the block.
    InputError
        If it cannot be read.
    """
    import av

    with reading(path, av.FFmpegError, ValueError, IndexError):
        try:
            container = av.open(str(path))
        except av.InvalidDataError as error:
            raise FormatError(
                f"{path}: neither an image nor a video, or a damaged video; copy or download it again if it is one"
            ) from error
        with container:
            yield container
