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


def listed_by_ijrr(text, files=()):
    """The list beside these files."""
    return list(read_ijrr(LIST, text, files.__contains__))


@pytest.mark.parametrize(("text", "expected"), TIMES.items())
def test_seconds_are_rounded_from_their_digits(text, expected):
    assert listed_by_ijrr(f"# t file\n\n{text} images/a b.png \n") == [(expected, "images/a b.png")]
    listed, exposure_known = read_csv(LIST, f"t_s,file\n{text}, a.png\n")
    assert listed == [Listed(LIST.parent / "a.png", expected, expected)]
    assert not exposure_known


@pytest.mark.parametrize("text", ["-1", "1e-3", "nan", ".", "1,5", "99999999999999", "1" * 400])
def test_what_is_no_time_is_refused_with_its_line(text):
    with pytest.raises(FormatError, match=r"folder/list: line 2: .* is not a plain number"):
        listed_by_ijrr(f"0.5 a.png\n{text} b.png\n")
    with pytest.raises(FormatError, match=r"folder/list: line 2: .* is not a plain number"):
        read_csv(LIST, f't_s;file\n"{text}";b.png\n')


def test_a_line_without_a_name_is_refused():
    with pytest.raises(FormatError, match=r"list: line 1: '0.5' is not 't file'"):
        listed_by_ijrr("0.5\n")


def test_exposures_of_a_csv_follow_its_stamps():
    listed, exposure_known = read_csv(LIST, "timestamp_us,exposure_ms,file\n1000,2.5,a.png\n")
    assert exposure_known
    assert listed == [Listed(LIST.parent / "a.png", 1000, 3500)]


@pytest.mark.parametrize("text", [*TIMES, "1540821843.7"])
def test_a_number_before_the_time_is_no_time_where_the_header_says_so(text):
    """UZH-FPV, whose images may also be missing; names may have blanks all the same."""
    (found,) = listed_by_ijrr(f"# id timestamp image_name\n17 {text} img/a b.png \n")
    assert found == (TIMES.get(text, 1_540_821_843_700_000), "img/a b.png")
    with pytest.raises(FormatError, match=r"list: line 3: '1 0.5' is not 'id t file'"):
        listed_by_ijrr("# id timestamp image_name\n0 0.25 a.png\n1 0.5\n")


def test_a_number_before_the_time_is_known_without_a_header_by_the_files():
    """Files whose names begin with a number and a blank stay what they are."""
    text = "0 0.25 img/a.png\n1 0.50 img/b c.png\n"
    assert listed_by_ijrr(text, ["img/a.png", "img/b c.png"]) == [
        (250_000, "img/a.png"),
        (500_000, "img/b c.png"),
    ]
    for files in ([], ["img/a.png"], ["0.25 img/a.png", "0.50 img/b c.png"]):
        assert listed_by_ijrr(text, files) == [(0, "0.25 img/a.png"), (1_000_000, "0.50 img/b c.png")]
