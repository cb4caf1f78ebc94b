"""Progress on stderr: a bar on a terminal, else a line every few seconds."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Self, TextIO, TypeVar, cast

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

    from kalux.recording import Recording

T = TypeVar("T")

LINE_EVERY = 5.0
"""Seconds between lines where stderr is not a terminal."""

BAR_EVERY = 0.1
"""Seconds between updates of the bar."""


class Progress:
    """Counts images and events, in whatever threads they are made; a context manager that draws meanwhile.

    Parameters
    ----------
    title
        What is being done, a word.
    images
        How many images there will be; 0: none are made.
    events
        How many events there will be, where only those are counted; 0: unknown.
    quiet
        Draw nothing.
    unit
        What is counted as ``images``, where that is something else.
    """

    def __init__(
        self, title: str, *, images: int = 0, events: int = 0, quiet: bool = False, unit: str = "images"
    ) -> None:
        self._title, self._unit = title, unit
        self._total_images, self._total_events = images, events
        self.images = self.events = 0
        self._quiet = quiet
        self._started = self._drawn = time.monotonic()
        self._warm: tuple[float, int] | None = None
        self._bar: Bar | None = None
        self._lock = threading.Lock()

    @property
    def seconds(self) -> float:
        """Time since the start."""
        return time.monotonic() - self._started

    def __enter__(self) -> Self:
        self._started = self._drawn = time.monotonic()
        if not self._quiet and sys.stderr.isatty():
            self._bar = _bar()
            self._bar.add_task(self._title, total=self._total_images or self._total_events or None, text="")
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def add(self, *, images: int = 0, events: int = 0) -> None:
        """Count, and draw if it is time to."""
        with self._lock:
            self.images += images
            self.events += events
            now = time.monotonic()
            if self._warm is None and self._done:
                self._warm = (now - self._started, self._done)
            if self._quiet or now - self._drawn < (LINE_EVERY if self._bar is None else BAR_EVERY):
                return
            self._drawn = now
            self._draw()

    @property
    def _done(self) -> int:
        return self.images if self._total_images else self.events

    def _draw(self) -> None:
        text = progress_text(
            self.images,
            self._total_images,
            self.events,
            self._total_events,
            self.seconds,
            self._unit,
            warm=self._warm or (0.0, 0),
        )
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=self._done, text=text)
            return
        with contextlib.suppress(OSError):
            print(f"kalux: {self._title}: {text}", file=sys.stderr, flush=True)


class Stages:
    """Progress of one stage after another over the same recording, each of which reads its events anew.

    Parameters
    ----------
    quiet
        Draw nothing.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._quiet = quiet
        self._current: Progress | None = None

    def watched(self, recording: Recording) -> Recording:
        """The same recording, whose events count for the stage that is going on when they are read."""
        from kalux.recording import with_counted_events

        return with_counted_events(recording, self._add)

    @contextlib.contextmanager
    def stage(self, title: str) -> Iterator[None]:
        """Inside the block, a stage goes on."""
        with Progress(title, quiet=self._quiet) as self._current:
            try:
                yield
            finally:
                self._current = None

    def _add(self, events: int) -> None:
        current = self._current
        if current is not None:
            current.add(events=events)


def counted(items: Iterable[T], count: Callable[[T], None]) -> Iterator[T]:
    """The same items, each of which is counted when it has been used."""
    for item in items:
        yield item
        count(item)


def _bar() -> Bar:
    from rich.console import Console  # 0.02 s, for a terminal only
    from rich.progress import BarColumn, Progress, TextColumn

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[text]}"),
        console=Console(file=cast(IO[str], _Tolerant(sys.stderr))),
        transient=True,
    )


class _Tolerant:
    """What goes to it may be lost, as in a terminal that was closed."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            return self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._stream.flush()


def progress_text(
    images: int,
    total_images: int,
    events: int,
    total_events: int,
    seconds: float,
    unit: str = "images",
    warm: tuple[float, int] = (0.0, 0),
) -> str:
    """Such as ``120/360 images, 85 images/s, 4.2M events/s, 0:03 left``.

    ``warm`` is when, s, and with how many the first were done, which often take as long as many others.
    """
    seconds = max(seconds, 1e-3)
    parts = []
    if total_images:
        parts.append(f"{images}/{total_images} {unit}")
        if images:
            parts.append(f"{short_number(images / seconds)} {unit}/s")
    else:
        parts.append(f"{short_number(events)} events")
    if events or not total_images:
        parts.append(f"{short_number(events / seconds)} events/s")
    done, total = (images, total_images) if total_images else (events, total_events)
    if total and done > warm[1]:
        parts.append(f"{clock((seconds - warm[0]) * max(total - done, 0) / (done - warm[1]))} left")
    return ", ".join(parts)


def short_number(value: float) -> str:
    """Three digits and a unit: ``12.3M``."""
    for size, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= 0.9995 * size:
            return f"{value / size:.3g}{unit}"
    return f"{value:.3g}"


def clock(seconds: float) -> str:
    """``1:02:03`` or ``2:03``."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
