"""Small pieces of sentences."""

from __future__ import annotations

import pytest

from kalux.wording import how_many, one_line, ordinal


@pytest.mark.parametrize(
    ("count", "said"), [(0, "0 frames"), (1, "1 frame"), (2, "2 frames"), (12_345, "12,345 frames")]
)
def test_how_many(count, said):
    assert how_many(count, "frame") == said


def test_ordinals():
    said = "1st 2nd 3rd 4th 11th 12th 13th 21st 22nd 33rd 100th 111th"
    assert [ordinal(int(word[:-2])) for word in said.split()] == said.split()


def test_errors_of_others_are_one_line_that_can_be_printed():
    assert one_line(OSError("no\n such\x00 file")) == "no such? file"
    assert one_line(KeyError()) == "KeyError"
    assert len(one_line(ValueError("x" * 1000))) < 210
