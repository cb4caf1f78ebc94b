"""Text tables: names, separators, units, exact decimals, every malformed line."""

from __future__ import annotations

import io
from decimal import ROUND_HALF_UP, Decimal

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kalux import readers
from kalux.errors import FormatError
from kalux.readers import characters, table
from recordings import all_events, assert_only_clear_errors, damaged, small_events

EVENTS = small_events()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "events.csv"


def written(header="t_us,x,y,p", events=EVENTS, separator=","):
    rows = (separator.join(map(str, (t, x, y, int(p)))) for t, x, y, p in events.tolist())
    return "\n".join([header, *rows, ""])


def parse(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return all_events(readers.read(path)).tolist()


def test_a_table(path):
    path.write_text(written())
    source = readers.read(path)
    assert (source.format, source.count_events(), source.count_frames()) == ("table", 500, 0)
    assert source.sensor_size == (EVENTS["y"].max() + 1, EVENTS["x"].max() + 1)
    assert not source.sensor_size_known
    for _ in range(2):
        assert np.array_equal(all_events(source), EVENTS)


def test_blocks_of_text_join_without_a_seam(path, monkeypatch):
    path.write_text(written())
    monkeypatch.setattr(characters, "BLOCK_BYTES", 600)
    monkeypatch.setattr(characters, "LONGEST_LINE", 100)
    chunks = list(readers.read(path).events())
    assert len(chunks) > 5
    assert np.array_equal(np.concatenate(chunks), EVENTS)


@pytest.mark.parametrize(
    "text",
    [
        "t_us,x,y,p\n1000000,2,3,1\n1500000,4,5,0\n",
        "t_us,x,y,p\n1000000,2,3,1\n1500000,4,5,0",  # no end of the last line
        "timestamp,x,y,polarity\n1000000,2,3,1\n1500000,4,5,0\n",  # dv, as exported
        '\ufeff"t_us";"x";"y";"p"\r\n1000000; 2; 3; 1\r\n1500000;4 ;5;-1\r\n',
        "# t_s x y p\n1.0 2 3 1\n\n# comment\n 1.500000\t4  5 0 \n",
        "# a recording\n# t_s x y p\n1 2 3 1\n1.5 4 5 0\n",
        "# a line\u2028\n# t_s x y p\n1 2 3 1\n1.5 4 5 0\n",  # ends no line of the table
        "x y pol time(ms)\n2 3 true 1e3\n4 5 False 1.5E+3\n",
        "t_ns\tx\ty\tp\n1000000000\t2\t3\t+1\n1500000000\t4\t5\t0\n",
        "id,t_us,note,x,y,p,t_us\n7,1000000,abc,2,3,1,9\n8,1500000,,4,5,0,9\n",
        "t_us,x,y,p\n1.000000000000000000e+06,2.0e+00,3.0,1.0\n1500000.,4,5,-1.0\n",
    ],
)
def test_other_spellings(path, text):
    assert parse(path, text) == [(1_000_000, 2, 3, True), (1_500_000, 4, 5, False)]


def test_what_numpy_writes(path):
    rows = np.array([EVENTS["t"] / 1e6, EVENTS["x"], EVENTS["y"], EVENTS["p"]], float).T
    text = io.BytesIO()
    np.savetxt(text, rows, header="t_s x y p")
    assert parse(path, text.getvalue()) == EVENTS.tolist()


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    unit=st.sampled_from(["s", "ms", "us", "ns"]),
    times=st.lists(
        st.one_of(
            st.decimals(min_value=0, max_value=10**9, allow_nan=False, places=9).map(lambda v: f"{v:f}"),
            st.decimals(min_value=0, max_value=3, allow_nan=False, places=4).map(lambda v: f"{v:f}"),
            st.floats(0, 1e9, allow_nan=False).map(lambda v: f"{v:.12e}"),
            st.integers(0, 10**15).map(str),
        ).filter(lambda text: Decimal(text) < 10**11),
        min_size=1,
        max_size=20,
    ),
)
def test_times_are_rounded_from_their_digits(path, unit, times):
    path.write_text(f"t_{unit},x,y,p\n" + "".join(f"{time},1,1,1\n" for time in times))
    factor = {"s": Decimal(10**6), "ms": Decimal(1000), "us": Decimal(1), "ns": Decimal("0.001")}[unit]
    exact = [int((Decimal(time) * factor).to_integral_value(ROUND_HALF_UP)) for time in times]
    assert [event[0] for event in parse(path, path.read_text())] == exact


def test_times_with_decimals_need_a_unit(path):
    assert parse(path, "t,x,y,p\n1.0,2,3,1\n") == [(1, 2, 3, True)]
    with pytest.raises(FormatError, match="line 3: the time has decimals, but no unit; name the unit"):
        parse(path, "t,x,y,p\n1.0,2,3,1\n1.5,2,3,1\n")


@pytest.mark.parametrize(
    "header",
    [
        "# timestamp x y polarity\n",  # UZH-FPV, evlib
        "timestamp x y polarity\n",
        "# a comment\n# format: t x y p\n",
        "t\tx\ty\tp\n",
    ],
)
def test_decimals_without_a_unit_are_seconds_in_lines_like_those_of_events_txt(path, header):
    """The same lines without names are taken so, too; the note says it."""
    path.write_text(header + "0.0 2 3 1\n0.2500005 4 5 0\n")
    source = readers.read(path)
    assert all_events(source).tolist() == [(0, 2, 3, True), (250_001, 4, 5, False)]
    assert any("times taken as seconds" in text for text in source.missing)


@pytest.mark.parametrize("first", ["1.5 1.0 2.0 1.0", "1.5 1 2 -1", "1.5 1 2 True", "1 1 2 0"])
def test_decimals_without_a_unit_are_refused_in_other_lines(path, first):
    with pytest.raises(FormatError, match="the time has decimals, but no unit"):
        parse(path, f"t x y p\n{first}\n2.5 1 2 1\n")


@pytest.mark.parametrize("header", ["t x y p", "# t x y p"])
def test_whole_times_with_a_point_are_microseconds_all_the_same(path, header):
    assert parse(path, f"{header}\n1.0 2 3 1\n2.0 2 3 0\n") == [(1, 2, 3, True), (2, 2, 3, False)]
    assert parse(path, "x y t p\n2 3 1.0 1\n2 3 2.0 0\n") == [(1, 2, 3, True), (2, 2, 3, False)]


@pytest.mark.parametrize("separator", [" ", ","])
@pytest.mark.parametrize("unit", ["float s", "int32 us"])
@pytest.mark.parametrize("order", ["txyp", "xypt", "txyps"])
def test_the_header_that_jaer_writes(path, separator, unit, order):
    """Save As text: the names stand after "format:", the unit in the comment before; rows are turned."""
    legend = f"timestamp({unit}) x y polarity(off/on=-1/+1)".replace(" ", separator)
    header = [
        "# jAER DAVIS/DVS camera text file output",
        "# source-file: /home/u/Davis346B-2026.aedat4",
        f"# dvs-events: One event per line: {legend}",
        f"# format: {separator.join(order)}",
    ]
    times = {"float s": ("0.0123", "1.0E-5"), "int32 us": ("12300", "10")}[unit]
    rows = [{"t": times[1], "x": 2, "y": 3, "p": -1, "s": 0}, {"t": times[0], "x": 4, "y": 5, "p": 1, "s": 0}]
    lines = [separator.join(str(row[name]) for name in order) for row in rows]
    path.write_text("\n".join([*header, *lines]))
    source = readers.read(path)
    assert source.sensor_size == (6, 5)
    assert all_events(source).tolist() == [(10, 2, 6 - 1 - 3, False), (12_300, 4, 6 - 1 - 5, True)]
    assert any("from the bottom" in text for text in source.missing)
    assert not any("unit of time" in text for text in source.missing)


@pytest.mark.parametrize(
    ("legend", "line", "expected"),
    [
        ("timestamp(float s) x y polarity(off/on=0/1)", "0.000010 2 3 0", (10, 2, 0, False)),
        ("timestamp(int32 us) x y polarity(off/on=-1/+1)", "12300 4 5 1", (12_300, 4, 0, True)),
        ("x,y,polarity(off/on=0/1),(flipped),timestamp(int32,us)", "4,5,1,7", (7, 4, 0, True)),
        (
            "timestamp(float s) x y polarity(off/on=0/1) special(1=special,0=normal)",
            "1.5E-5 2 3 1 0",
            (15, 2, 0, True),
        ),
    ],
)
def test_the_legend_of_jaer_alone_names_columns(path, legend, line, expected):
    """As DavisTextOutputWriter writes them while a recording is played."""
    path.write_text(
        f"# jAER DAVIS/DVS camera text file output\n# dvs-events: One event per line:  {legend}\n{line}\n"
    )
    source = readers.read(path)
    assert all_events(source).tolist() == [expected]
    assert any("from the bottom" in text for text in source.missing)


def test_rows_of_files_that_only_lay_in_a_folder_of_jaer_stay(path):
    assert (
        parse(path, "# source-file: /home/u/jAER/text file output\n# t_us x y p\n7 2 3 1\n8 0 9 1\n")[0][2]
        == 3
    )


def test_a_comment_with_fewer_or_more_names_than_there_are_columns_names_none(path):
    assert parse(path, "# t x y p id\n# x y p t\n2 3 1 7\n") == [(7, 2, 3, True)]
    assert parse(path, "# t x y p\nid x y p t\n9 2 3 1 7\n") == [(7, 2, 3, True)]
    with pytest.raises(FormatError, match="line 2: it has fewer columns"):
        parse(path, "# t x y p id\n7 2 3 1\n")


def test_names_may_be_separated_by_other_characters_than_the_columns(path):
    """As where somebody puts the names before lines that a program wrote."""
    expected = [(7, 2, 3, True), (8, 2, 3, False)]
    assert parse(path, "t_us,x,y,p\n7 2 3 1\n8 2 3 0\n") == expected
    assert parse(path, "# t_us x y p\n7,2,3,1\n8,2,3,0\n") == expected
    assert parse(path, "t_us;x;y;p;note\n7;2;3;1;a,b,c,d,e\n8;2;3;0;c\n") == expected


def test_labels_of_signal_and_noise_are_skipped(path):
    """v2e with --label_signal_noise."""
    header = "#!events.txt\n# Format is time (float s), x, y, polarity (0=off, 1=on), signal/noise (1/0)\n# as at\n"
    path.write_text(header + "0.0 2 3 1 0\n1e-05 4 5 0 1\n")
    source = readers.read(path)
    assert all_events(source).tolist() == [(0, 2, 3, True), (10, 4, 5, False)]
    assert any("signal and noise, is not read" in text for text in source.missing)
    with pytest.raises(FormatError, match="does not name the columns"):
        parse(path, "# a comment\n0.0 2 3 1 0\n1e-05 4 5 0 1\n")


def test_an_assumed_unit_is_told(path):
    path.write_text(written("t,x,y,p"))
    assert any("unit of time" in sentence for sentence in readers.read(path).missing)
    path.write_text(written())
    assert not any("unit of time" in sentence for sentence in readers.read(path).missing)


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("-5,1,2,1", "time"),
        ("nan,1,2,1", "time"),
        ("1.2.3,1,2,1", "time"),
        (".,1,2,1", "time"),
        ("5e,1,2,1", "time"),
        ("1e30,1,2,1", "time"),
        (",1,2,1", "time"),
        ("5,-1,2,1", "x is not"),
        ("5,1.5,2,1", "x is not"),
        ("5,70000,2,1", "x is not"),
        ("5,1 1,2,1", "x is not"),
        ("5,,2,1", "x is not"),
        ("5,1,b,1", "y is not"),
        ("5,1,2,2", "polarity"),
        ("5,1,2,tru", "polarity"),
        ("5,1,2,truer", "polarity"),
        ("5,1,2,1,7", "more columns"),
        ("5,1,2,1,", "more columns"),
        ("5,1,2", "fewer columns"),
        ("5 1 2 1", "time"),
        ("5,1\0\0,2,1", "x is not"),
    ],
)
def test_a_malformed_line_is_named(path, line, fault):
    good = "1,1,1,1\n" * 7
    with pytest.raises(FormatError, match=rf"line 9: .*{fault}"):
        parse(path, f"t_us,x,y,p\n{good}{line}\n{good}")


def test_an_endless_line_is_refused(path):
    with pytest.raises(FormatError, match="line 4: it is too long"):
        parse(path, "t,x,y,p\n" + "1,1,1,1\n" * 2 + "7" * 20_000)


@pytest.mark.parametrize(
    "header",
    [
        "",
        "#!events.txt\n# Format is time (float s), x, y, polarity (0=off, 1=on) as specified at http://rpg\n",
    ],
    ids=["IJRR", "v2e"],
)
def test_lines_of_events_txt_need_no_names(path, header):
    path.write_text(header + "0.1 2 3 1\n0.2500005 4 5 0\n")
    source = readers.read(path)
    assert all_events(source).tolist() == [(100_000, 2, 3, True), (250_001, 4, 5, False)]
    assert any("taken as t (s), x, y, p" in text for text in source.missing)
    path.write_text(header + "0.1 2 3 1\n0.2 1\n")
    with pytest.raises(FormatError, match=rf"line {header.count(chr(10)) + 2}: it has fewer columns"):
        all_events(readers.read(path))


def test_a_first_line_of_two_numbers_is_the_size_of_the_sensor(path):
    """The text of rpg_e2vid: width and height, then the lines of IJRR's events.txt; with names, too."""
    for text in (
        "40 30\n0.1 2 3 1\n0.2500005 4 5 0\n",
        " 40\t30 \r\n# events\n0.1 2 3 1\r\n0.2500005 4 5 0",
        "# a recording\n40 30\n0.1 2 3 1\n\n0.2500005 4 5 0\n",
        "40 30\n# t_s x y p\n0.1 2 3 1\n0.2500005 4 5 0\n",
        "40 30\nt_s,x,y,p\n0.1,2,3,1\n0.2500005,4,5,0\n",
    ):
        assert parse(path, text) == [(100_000, 2, 3, True), (250_001, 4, 5, False)]
        source = readers.read(path)
        assert (source.format, source.sensor_size, source.sensor_size_known) == ("table", (30, 40), True)
        assert not any("sensor size" in sentence for sentence in source.missing)
    with pytest.raises(FormatError, match="line 4: x is not"):
        parse(path, "40 30\n# a comment\n0.1 2 3 1\n0.2 b 3 1\n")


@pytest.mark.parametrize(
    "text", ["40 30\n", "40 30\n40 30\n0.1 2 3 1\n", "0 30\n0.1 2 3 1\n", "40 30\na b c d\n"]
)
def test_two_numbers_alone_are_no_table(path, text):
    path.write_text(text)
    assert not table.recognises(path)


@pytest.mark.parametrize(("first", "t"), [("8.3e-05", 83), ("8e-05", 80), ("1.25E-4", 125)])
def test_the_first_time_of_v2e_may_be_a_power_of_ten(path, first, t):
    path.write_text(f"#!events.txt\n{first} 2 3 1\n0.2500005 4 5 0\n")
    assert all_events(readers.read(path)).tolist() == [(t, 2, 3, True), (250_001, 4, 5, False)]


def test_numbers_without_names_are_refused_with_a_hint(path):
    with pytest.raises(FormatError, match="put a line such as 't_us,x,y,p'"):
        parse(path, "1,2,3,1\n5,2,3,1\n")


@pytest.mark.parametrize(
    ("line", "names"),
    [
        ("7 2 3 1", "t_us x y p"),
        ("7;2;3;1", "t_us;x;y;p"),
        ("0.5,2,3,1", "t_s,x,y,p"),
        ("7, 2, 3, 1, 8, 9", "t_us,x,y,p,other1,other2"),
    ],
)
def test_the_hint_can_be_followed(path, line, names):
    """Its names are separated as the columns are, and as many; with a unit that decimals may have."""
    with pytest.raises(FormatError, match=f"put a line such as '{names}' there"):
        parse(path, line + "\n")
    assert parse(path, f"{names}\n{line}\n") == [(500_000 if "." in line else 7, 2, 3, True)]


def test_names_may_state_the_size_of_the_sensor(path):
    """As faery writes them."""
    assert parse(path, "t,x@346,y@260,on\n7,2,3,1\n") == [(7, 2, 3, True)]
    source = readers.read(path)
    assert (source.sensor_size, source.sensor_size_known) == ((260, 346), True)
    assert parse(path, "t,x@346,y,on\n7,2,3,1\n") == [(7, 2, 3, True)]
    assert not readers.read(path).sensor_size_known


@pytest.mark.parametrize("header", ["", "% date 2026\n", "x,y,polarity,timestamp_us\n", "t_us,x,y,p\n"])
def test_geometry_is_the_size_of_the_sensor(path, header):
    """Prophesee's standalone decoders: x, y, p, t unless there are names."""
    line = "7,2,3,1" if header.startswith("t") else "2,3,1,7"
    assert parse(path, f"%geometry:640,480\n{header}{line}\n") == [(7, 2, 3, True)]
    source = readers.read(path)
    assert (source.sensor_size, source.sensor_size_known) == ((480, 640), True)
    assert source.missing == ("The file has no frames.",)
    with pytest.raises(FormatError, match=rf"line {3 + len(header.splitlines())}: "):
        parse(path, f"%geometry:640,480\n{header}{line}\n2,b,0,9\n")


def test_lines_of_prophesee_need_no_names(path):
    """metavision_file_to_csv: the polarity, then the time; what else they might be is refused."""
    assert parse(path, "639,479,1,0\n2,3,0,7\n2,3,0,9\n") == [
        (0, 639, 479, True),
        (7, 2, 3, False),
        (9, 2, 3, False),
    ]
    assert any("taken as x, y, p, t (us)" in text for text in readers.read(path).missing)
    for text in (
        "9,3,0,1\n10,2,1,0\n",
        "2,3,1,9\n2,3,0,8\n",
        "2,3,1,9\n2,3,7,9\n",
        "2,3,1,9,0\n",
        "2 3 1 9\n",
    ):
        with pytest.raises(FormatError, match="does not name the columns"):
            parse(path, text)


@pytest.mark.parametrize(
    "text", ["events", "", "a,b,c,d\n1,2,3,4\n", "t,x,y\n1,2,3\n", "\0" * 50, b"\xff\xfe\x00t"]
)
def test_other_files_are_not_recognised(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert not table.recognises(path)


def test_no_events(path):
    with pytest.raises(FormatError, match="no events"):
        parse(path, "t_us,x,y,p\n")


def test_damage_gives_clear_errors(path):
    assert_only_clear_errors(path, damaged(written(events=EVENTS[:100]).encode(), 300, 60))


def test_a_real_payload(shared_data, path):
    """Real payload, our writer: slider_depth with commas and names."""
    with (shared_data / "slider_depth" / "events.txt").open("rb") as file:
        lines = file.readlines(1_000_000)
    path.write_bytes(b"t_s,x,y,p\n" + b"".join(lines).replace(b" ", b","))
    ours = all_events(readers.read(path))
    assert len(ours) == len(lines)
    assert np.array_equal(ours, next(readers.read(shared_data / "slider_depth").events())[: len(ours)])
