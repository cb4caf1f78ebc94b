"""Work in other threads: the same items in order, errors where they belong, and no thread left."""

from __future__ import annotations

import itertools
import threading
import time

import pytest

from kalux.threads import MOST_THREADS, InOrder, ahead, default_threads, made_ahead


@pytest.fixture(autouse=True)
def no_thread_is_left():
    before = threading.active_count()
    yield
    assert threading.active_count() == before


@pytest.mark.parametrize("depth", [1, 2, 100])
@pytest.mark.parametrize("count", [0, 1, 3, 1000])
def test_the_same_items_in_order(depth, count):
    assert list(ahead(range(count), depth)) == list(range(count))


def test_none_is_an_item():
    assert list(ahead([None, 1, None])) == [None, 1, None]


def test_they_are_made_in_another_thread_and_only_there():
    def made():
        try:
            yield threading.get_ident()
            yield threading.get_ident()
        finally:
            idents.append(threading.get_ident())

    idents = []
    idents += ahead(made())
    assert len(set(idents)) == 1
    assert idents[0] != threading.get_ident()


@pytest.mark.parametrize("depth", [1, 3])
def test_not_more_is_made_than_asked_for(depth):
    """Back-pressure: what is held, what is being made, and what is in use."""
    made = []

    def count():
        for k in range(100):
            made.append(k)
            yield k

    items = ahead(count(), depth)
    for k in range(5):
        assert next(items) == k
        deadline = time.monotonic() + 5
        while len(made) < k + depth + 2 and time.monotonic() < deadline:
            time.sleep(0.001)
        time.sleep(0.01)
        assert len(made) == k + depth + 2
    items.close()


def test_nothing_starts_before_the_first_item_is_asked_for():
    items = ahead(iter([1]))
    assert "kalux-ahead" not in [thread.name for thread in threading.enumerate()]
    items.close()


@pytest.mark.parametrize("kind", [ValueError, KeyboardInterrupt, SystemExit])
def test_an_error_comes_where_its_item_would_have(kind):
    def failing():
        yield from range(3)
        raise kind("here")

    seen = []
    with pytest.raises(kind, match="here"):
        seen.extend(ahead(failing(), 10))
    assert seen == [0, 1, 2]


def test_an_error_before_the_first_item():
    class Unreadable:
        def __iter__(self):
            raise OSError("no file")

    with pytest.raises(OSError, match="no file"):
        next(ahead(Unreadable()))


@pytest.mark.parametrize("endless", [True, False], ids=["waiting", "at the end"])
def test_closing_ends_the_making(endless):
    closed = []

    def numbers():
        try:
            yield from itertools.count() if endless else range(2)
        finally:
            closed.append(True)

    items = ahead(numbers())
    next(items)
    items.close()
    assert closed == [True]
    assert list(items) == []


def test_an_exception_where_the_items_are_used_ends_the_making():
    def use():
        for item in ahead(itertools.count()):
            if item == 3:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        use()


def test_what_nobody_asked_for_may_fail():
    def failing():
        yield 1
        raise ValueError("never met")

    items = ahead(failing(), 5)
    assert next(items) == 1
    items.close()


def test_one_in_another():
    inner = ahead(range(1000), 1)
    assert list(ahead((k * k for k in inner), 1)) == [k * k for k in range(1000)]
    inner = ahead(itertools.count(), 1)
    outer = ahead((k for k in inner), 1)
    assert next(outer) == 0
    outer.close()
    inner.close()


class TestMadeAhead:
    @pytest.mark.parametrize("depth", [1, 2, 100])
    @pytest.mark.parametrize("threads", [1, 3])
    @pytest.mark.parametrize("count", [0, 1, 500])
    def test_in_the_order_of_the_items_whichever_is_made_first(self, depth, threads, count):
        def slowly(k):
            time.sleep(0.0005 * (k % 3 == 0))
            return k * k

        assert list(made_ahead(range(count), slowly, depth, threads)) == [k * k for k in range(count)]

    def test_none_is_an_item_and_can_be_made(self):
        assert list(made_ahead([None, 1], lambda item: item, 2, 2)) == [None, 1]
        assert list(made_ahead([1, 2], lambda item: None, 2, 2)) == [None, None]

    def test_several_are_made_at_a_time(self):
        """Each of two waits for the other."""
        both = threading.Barrier(2)
        assert sorted(made_ahead(range(2), lambda _: both.wait(timeout=20), 2, 2)) == [0, 1]

    def test_items_are_made_in_one_thread_and_used_in_others(self):
        def items():
            for _ in range(50):
                yield threading.current_thread()

        made = list(made_ahead(items(), lambda item: (item, threading.current_thread()), 3, 2))
        makers = {maker for maker, _ in made}
        assert {maker.name for maker in makers} == {"kalux-items"}
        assert {user.name.split("_")[0] for _, user in made} == {"kalux-made"}
        assert len(makers) == 1

    def test_not_more_items_are_taken_than_asked_for(self):
        """Back-pressure: what is held, the item being made, and the one in use."""
        taken = []

        def items():
            for k in range(100):
                taken.append(k)
                yield k

        made = made_ahead(items(), str, 3, 2)
        for k in range(5):
            assert next(made) == str(k)
            deadline = time.monotonic() + 5
            while len(taken) < k + 5 and time.monotonic() < deadline:
                time.sleep(0.001)
            time.sleep(0.01)
            assert len(taken) == k + 5
        made.close()

    @pytest.mark.parametrize("kind", [ValueError, KeyboardInterrupt, SystemExit])
    @pytest.mark.parametrize("threads", [1, 3])
    def test_an_error_in_making_comes_where_its_item_would_have(self, kind, threads):
        def fail_at_three(k):
            if k == 3:
                raise kind("here")
            return k

        seen = []
        with pytest.raises(kind, match="here"):
            seen.extend(made_ahead(itertools.count(), fail_at_three, 10, threads))
        assert seen == [0, 1, 2]

    def test_an_error_of_the_items_comes_after_all_that_was_made(self):
        def failing():
            yield from range(3)
            raise ValueError("no more")

        seen = []
        with pytest.raises(ValueError, match="no more"):
            seen.extend(made_ahead(failing(), lambda k: time.sleep(0.01) or k, 10, 2))
        assert seen == [0, 1, 2]

    def test_closing_ends_the_items_and_gives_up_the_rest(self):
        closed, made = [], []

        def items():
            try:
                yield from itertools.count()
            finally:
                closed.append(threading.current_thread().name)

        def make(k):
            made.append(k)
            time.sleep(0.02)
            return k

        images = made_ahead(items(), make, 50, 1)
        assert next(images) == 0
        images.close()
        assert closed == ["kalux-items"]
        assert len(made) <= 3

    def test_an_exception_where_it_is_used_ends_all(self):
        def use():
            for k in made_ahead(itertools.count(), str, 2, 2):
                if k == "3":
                    raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            use()


class TestInOrder:
    @pytest.mark.parametrize("threads", [1, 2, 4])
    def test_what_is_made_is_used_in_the_order_of_giving(self, threads):
        """All but the last few pieces at once, and these at the end; with one thread every one at once."""
        work, used = InOrder(threads), []
        for k in range(20):
            work.give(lambda k=k: time.sleep(0.001 * (k % 3)) or k, used.append)
            assert used == list(range(k + 1 if threads == 1 else max(k + 1 - threads, 0)))
        work.finish(used.append)
        assert used == list(range(20))
        work.end()

    def test_several_are_done_at_a_time(self):
        """Each of two waits for the other."""
        work, both, used = InOrder(2), threading.Barrier(2), []
        for _ in range(2):
            work.give(lambda: both.wait(timeout=20), used.append)
        work.finish(used.append)
        assert sorted(used) == [0, 1]
        work.end()

    @pytest.mark.parametrize("threads", [1, 3])
    @pytest.mark.parametrize("fails", ["work", "use"])
    def test_an_error_comes_where_its_result_would_have_and_the_rest_is_given_up(self, threads, fails):
        work, used = InOrder(threads), []

        def use(divisor):
            used.append(1 // divisor)

        def give_all():
            for divisor in (1, 0, 2, 1):
                if fails == "work":
                    work.give(lambda divisor=divisor: 1 // divisor, used.append)
                else:
                    work.give(lambda divisor=divisor: divisor, use)
            work.finish(used.append if fails == "work" else use)

        with pytest.raises(ZeroDivisionError):
            give_all()
        assert used == [1]
        work.finish(used.append)
        assert used == [1]

    def test_the_end_gives_up_what_was_not_used(self):
        work, used = InOrder(50), []
        for _ in range(50):
            work.give(lambda: time.sleep(0.1), used.append)
        start = time.monotonic()
        work.end()
        work.finish(used.append)
        assert used == []
        assert time.monotonic() - start < 0.5


def test_the_default_is_the_cores_there_are(monkeypatch):
    assert 1 <= default_threads() <= MOST_THREADS
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: set(range(64)), raising=False)
    assert default_threads() == MOST_THREADS
    monkeypatch.delattr("os.sched_getaffinity")
    monkeypatch.setattr("os.cpu_count", lambda: None)
    assert default_threads() == 1
