"""Work in other threads, in order: what one step makes is made while the next step uses what came before it.

Which thread does a thing never changes what comes out, only when. Standard library only.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from queue import SimpleQueue
from typing import Final, Generic, TypeVar

T = TypeVar("T")
U = TypeVar("U")

MOST_THREADS: Final = 8
"""Used where nothing is said, at most: one filters, and even EXR images, the slowest to encode, are done by seven."""


def cores() -> int:
    """How many processor cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS
        return os.cpu_count() or 1


def default_threads() -> int:
    """As many as this process has processor cores, up to `MOST_THREADS`."""
    return min(cores(), MOST_THREADS)


def ahead(items: Iterable[T], depth: int = 2, name: str = "ahead") -> Generator[T, None, None]:
    """The same items in the same order, made in a thread of their own, up to ``depth`` before they are asked for.

    An error in the making is raised where its item would have come. Closing the iterator, or an exception where it is
    used, ends the thread: at once where it waits, else after the item that it is making, and ``items`` is closed in it.
    The iterator must be run to its end or be closed, as generators are.

    Parameters
    ----------
    items
        Made one by one, in that thread only.
    depth
        How many are held, beside the one being made and the one in use: memory is bounded by it.
    name
        Of the thread, after "kalux-", for tools that show threads.
    """
    queue: _BoundedQueue[T] = _BoundedQueue(depth)
    thread = threading.Thread(target=_make, args=(items, queue), name=f"kalux-{name}", daemon=True)
    thread.start()
    try:
        while (item := queue.take()) is not None:
            yield item.value
    finally:
        queue.stop()
        thread.join()


def made_ahead(
    items: Iterable[T],
    make: Callable[[T], U],
    depth: int,
    threads: int,
    names: tuple[str, str] = ("items", "made"),
) -> Generator[U, None, None]:
    """What is made of each item, in the items' order, up to ``depth`` before it is asked for.

    As `ahead`, but ``make`` is called in ``threads`` other threads, for as many items at a time.

    Parameters
    ----------
    items
        Made one by one, in a thread of their own.
    make
        Called once for each item; the calls must not depend on their order.
    depth
        How many items, or what is made of them, are held, beside the item being made and the one in use.
    threads
        Number of threads, at least 1.
    names
        Of the thread of the items, and before their numbers of those that ``make``, after "kalux-".
    """
    pool = ThreadPoolExecutor(threads, f"kalux-{names[1]}")

    def given() -> Generator[Future[U], None, None]:
        with _closed(items) as iterator:
            for item in iterator:
                yield pool.submit(make, item)

    ready = ahead(given(), depth, names[0])
    try:
        for made in ready:
            yield made.result()
    finally:
        ready.close()
        pool.shutdown(cancel_futures=True)


class InOrder(Generic[T]):
    """Pieces of work that may be done at the same time; what they make is used in the order in which they were given.

    After an error, of a piece or of its use, the rest is given up and the threads end.

    Parameters
    ----------
    threads
        How many are done at a time, in threads of their own. 1: each is done where and when it is given.
    name
        As of `ahead`.
    """

    def __init__(self, threads: int, name: str = "in-order") -> None:
        self._most_pending = threads if threads > 1 else 0
        self._pool = ThreadPoolExecutor(threads, f"kalux-{name}") if threads > 1 else None
        self._pending: deque[Callable[[], T]] = deque()

    def give(self, work: Callable[[], T], use: Callable[[T], None]) -> None:
        """Add a piece of work; ``use``, here, what the first ones made, until only as many as threads are pending."""
        self._pending.append(work if self._pool is None else self._pool.submit(work).result)
        self._use_first(use, self._most_pending)

    def finish(self, use: Callable[[T], None]) -> None:
        """Use what is pending, once it is made."""
        self._use_first(use, 0)

    def end(self) -> None:
        """Give up what is pending, and end the threads."""
        self._pending.clear()
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def _use_first(self, use: Callable[[T], None], left: int) -> None:
        try:
            while len(self._pending) > left:
                use(self._pending.popleft()())
        except BaseException:
            self.end()
            raise


class _Item(Generic[T]):
    """An item, so that None can be one."""

    def __init__(self, value: T) -> None:
        self.value = value


class _End:
    """There are no more items; why, if it was an error."""

    def __init__(self, error: BaseException | None) -> None:
        self.error = error


class _BoundedQueue(Generic[T]):
    """A queue of bounded length between two threads, which either end can close.

    Made of two of the standard library's queues in C, one for items and one for room. Its conditions, and with them
    `queue.Queue`, are written in Python, which runs several times slower after loops over whole images have emptied the
    nearer caches of it.
    """

    def __init__(self, depth: int) -> None:
        self._items: SimpleQueue[_Item[T] | _End] = SimpleQueue()
        self._room: SimpleQueue[None] = SimpleQueue()
        self._stopped = False
        for _ in range(depth):
            self._room.put(None)

    def put(self, value: T) -> bool:
        """Wait for room; False: nobody wants it any more."""
        self._room.get()
        if not self._stopped:
            self._items.put(_Item(value))
        return not self._stopped

    def end(self, error: BaseException | None) -> None:
        """There are no more items; why, if it was an error."""
        self._items.put(_End(error))

    def take(self) -> _Item[T] | None:
        """Wait for the next item; None: that was all. Raises the error that ended them."""
        item = self._items.get()
        if isinstance(item, _Item):
            self._room.put(None)
            return item
        if item.error is not None:
            raise item.error
        return None

    def stop(self) -> None:
        """Nobody wants any more, neither items nor the errors of making them."""
        self._stopped = True
        self._room.put(None)


def _make(items: Iterable[T], queue: _BoundedQueue[T]) -> None:
    error: BaseException | None = None
    try:
        with _closed(items) as iterator:
            for value in iterator:
                if not queue.put(value):
                    break
    except BaseException as failure:  # raised in the thread that takes
        error = failure
    queue.end(error)


@contextlib.contextmanager
def _closed(items: Iterable[T]) -> Generator[Iterator[T], None, None]:
    """An iterator over items, which is closed afterwards, if it can be."""
    iterator = iter(items)
    try:
        yield iterator
    finally:
        close = getattr(iterator, "close", None)
        if close is not None:
            close()
