"""Several numbers as one setting."""

from __future__ import annotations

import pytest

from kalux.models.stated import stated_numbers


def test_numbers_are_read_whatever_the_space_between():
    assert stated_numbers(" 0  1e-1\t3 ", 3, 3.0) == (0.0, 0.1, 3.0)


@pytest.mark.parametrize("text", ["", "1 2", "1 2 3 4", "1 2 x", "1 2 3.1", "1 2 -1", "1 2 nan", "1 2 inf"])
def test_what_is_not_that_is_none(text):
    assert stated_numbers(text, 3, 3.0) is None
