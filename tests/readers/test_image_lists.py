"""Lists of images: the same numbers are times in both, and what is none is refused by its line."""

from __future__ import annotations

from pathlib import Path

import pytest

from kalux.errors import FormatError
from kalux.readers.image_lists import Listed, read_csv, read_ijrr

LIST = Path("folder/list")

TIMES = {
    "0": 0,
    "1.": 1_000_000,
    ".5": 500_000,
    "0.0479800000000000012": 47_980,
    "1.0000005": 1_000_001,  # half a microsecond, up
    "123456789012.0000005": 123_456_789_012_000_001,
}


@pytest.mark.parametrize(("text", "expected"), TIMES.items())
def test_seconds_are_rounded_from_their_digits(text, expected):
    assert list(read_ijrr(LIST, f"# t file\n\n{text} images/a b.png \n")) == [(expected, "images/a b.png")]
    listed, exposure_known = read_csv(LIST, f"t_s,file\n{text}, a.png\n")
    assert listed == [Listed(LIST.parent / "a.png", expected, expected)]
    assert not exposure_known


@pytest.mark.parametrize("text", ["-1", "1e-3", "nan", ".", "1,5", "99999999999999", "1" * 400])
def test_what_is_no_time_is_refused_with_its_line(text):
    with pytest.raises(FormatError, match=r"folder/list: line 2: .* is not a plain number"):
        list(read_ijrr(LIST, f"0.5 a.png\n{text} b.png\n"))
    with pytest.raises(FormatError, match=r"folder/list: line 2: .* is not a plain number"):
        read_csv(LIST, f't_s;file\n"{text}";b.png\n')


def test_a_line_without_a_name_is_refused():
    with pytest.raises(FormatError, match=r"list: line 1: '0.5' is not 't file'"):
        list(read_ijrr(LIST, "0.5\n"))


def test_exposures_of_a_csv_follow_its_stamps():
    listed, exposure_known = read_csv(LIST, "timestamp_us,exposure_ms,file\n1000,2.5,a.png\n")
    assert exposure_known
    assert listed == [Listed(LIST.parent / "a.png", 1000, 3500)]
