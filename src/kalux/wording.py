"""Small pieces of the sentences that people read."""

from __future__ import annotations


def how_many(count: int, noun: str) -> str:
    """``1 frame``, ``12,345 frames``; of nouns whose plural ends in s."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


def ordinal(number: int) -> str:
    """``1st``, ``12th``, ``22nd``."""
    last = 0 if number % 100 in (11, 12, 13) else number % 10
    return f"{number}{ {1: 'st', 2: 'nd', 3: 'rd'}.get(last, 'th') }"


def one_line(error: BaseException) -> str:
    """What another library's error says, on one line of printable characters."""
    text = " ".join(str(error).split()) or type(error).__name__
    text = "".join(c if c.isprintable() else "?" for c in text)
    return text if len(text) <= 200 else text[:200] + "..."
