"""Several numbers as one setting: with spaces between."""

from __future__ import annotations


def stated_numbers(text: str, count: int, most: float) -> tuple[float, ...] | None:
    """``count`` numbers from 0 to ``most`` with spaces between; None: the text is not that."""
    try:
        numbers = tuple(float(part) for part in text.split())
    except ValueError:
        return None
    return numbers if len(numbers) == count and all(0 <= number <= most for number in numbers) else None
