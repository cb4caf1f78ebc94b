"""Line charts: well-formed, everything within the frame, gaps where nothing is known."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import pytest

from kalux.evaluation.benchmark.svg import HEIGHT, STYLES, WIDTH, Axis, Series, chart, sample


def paths(text, kind):
    root = ElementTree.fromstring(text)
    return [e.get("d") for e in root.iter("path") if e.get("class").startswith(kind)]


def test_lines_lie_within_the_chart_and_larger_is_higher():
    text = chart("T", Axis("x"), Axis("y"), [Series("a", 0, [(0, 1.0), (1, 5.0), (2, 3.0)])])
    (line,) = paths(text, "line")
    points = [tuple(map(float, point.split())) for point in line[1:].split("L")]
    assert [x for x, _ in points] == sorted(x for x, _ in points)
    assert points[1][1] < points[2][1] < points[0][1]
    assert all(0 < x < WIDTH and 0 < y < HEIGHT for x, y in points)


@pytest.mark.parametrize("gap", [None, float("nan"), 0.0])
def test_a_line_is_broken_where_nothing_can_be_drawn(gap):
    points = [(0, 1.0), (1, 2.0), (2, gap), (3, 1.0), (4, 2.0)]
    assert len(paths(chart("T", Axis("x"), Axis("y", log=True), [Series("a", 0, points)]), "line")) == 2


def test_equal_values_and_single_points_have_a_scale():
    for log in (False, True):
        text = chart("T", Axis("x"), Axis("y", log=log), [Series("a", 0, [(0, 3.0)])])
        assert paths(text, "marker")


def test_nothing_gives_nothing():
    assert chart("T", Axis("x"), Axis("y"), [Series("a", 0, [(0, None)])]) == ""


def test_ticks_of_a_logarithm_are_round():
    text = chart("T", Axis("x"), Axis("y", log=True), [Series("a", 0, [(0, 0.02), (1, 40.0)])])
    labels = re.findall(r'class="tick left"[^>]*>([^<]+)<', text)
    assert labels == ["0.1", "1", "10"]
    text = chart("T", Axis("x"), Axis("y", log=True), [Series("a", 0, [(0, 0.2), (1, 4.0)])])
    assert re.findall(r'class="tick left"[^>]*>([^<]+)<', text) == ["0.2", "0.5", "1", "2"]


def test_styles_differ_without_colour():
    shapes = {re.sub(r"\bs\d", "", sample(i)) for i in range(STYLES)}
    assert len(shapes) == STYLES


def test_labels_are_escaped():
    text = chart("a < b", Axis("x & y"), Axis('"q"'), [Series("<m>", 0, [(0, 1.0), (1, 2.0)])], diagonal=True)
    assert "<m>" not in text
    ElementTree.fromstring(text)
