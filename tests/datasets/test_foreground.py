"""Sprites before a scene: where they are, how large, and what they hide."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.datasets import Pose, static
from kalux.datasets.foreground import Sprite, ball, crossing, with_foreground
from kalux.errors import InputError

SIZE = (60, 80)
SQUARE = Sprite(np.full((40, 40), 2.0), np.ones((40, 40)))


def test_a_sprite_has_its_place_and_size() -> None:
    scene = with_foreground(static(0.1, sensor_size=SIZE), SQUARE, lambda t: Pose(30.0, 20.0), size=10.0)
    shown = scene.at(0.0)
    share = (shown - 0.1) / 1.9
    assert share.sum() == pytest.approx(100, rel=0.05)
    y, x = np.mgrid[:60, :80]
    assert (share * x).sum() / share.sum() == pytest.approx(30.0, abs=0.01)
    assert (share * y).sum() / share.sum() == pytest.approx(20.0, abs=0.01)
    assert shown[20, 30] == pytest.approx(2.0, rel=1e-5)
    assert shown[50, 70] == pytest.approx(0.1, rel=1e-5)


@pytest.mark.parametrize(("size", "margin"), [(129, 2.0), (137, 8.0)])
def test_a_ball_is_round_within_its_margin(size: int, margin: float) -> None:
    radius = (size - 1) / 2 - margin
    drawn = ball(size, margin, cap=0.5)
    assert drawn.alpha.sum() == pytest.approx(np.pi * radius**2, rel=1e-3)
    assert drawn.radiance[size // 2, size // 2] == 0.5


def test_a_sprite_zooms_and_turns() -> None:
    bar = Sprite(np.ones((40, 40)), np.zeros((40, 40)))
    bar.alpha[18:22, 20:] = 1.0  # to the right of the middle
    scene = static(0.0, sensor_size=SIZE)
    right = with_foreground(scene, bar, lambda t: Pose(40.0, 30.0), size=20.0).at(0.0)
    down = with_foreground(scene, bar, lambda t: Pose(40.0, 30.0, np.pi / 2), size=20.0).at(0.0)
    large = with_foreground(scene, bar, lambda t: Pose(40.0, 30.0, 0.0, 2.0), size=20.0).at(0.0)
    assert right[30, 45] > 0.5 > right[35, 40]
    assert down[35, 40] > 0.5 > down[30, 45]
    assert large.sum() == pytest.approx(4 * right.sum(), rel=0.1)


def test_the_background_is_not_changed() -> None:
    background = static(0.1, sensor_size=SIZE)
    with_foreground(background, SQUARE, lambda t: Pose(30.0, 20.0), size=10.0).at(0.0)
    assert (background.at(0.0) == 0.1).all()


def test_crossing_starts_and_ends_outside() -> None:
    path = crossing(SIZE, 10.0, 100.0, turn=1.0, height=0.25)
    assert path(0.0) == pytest.approx(Pose(-10.0, 14.75, 0.0))
    assert path(500_000.0) == pytest.approx(Pose(40.0, 14.75, 0.5))
    assert path(999_999.0).x == pytest.approx(90.0, abs=0.01)
    assert path(1_000_001.0).x == pytest.approx(-10.0, abs=0.01)


def test_the_ball_is_round() -> None:
    sprite = ball()
    assert sprite.alpha.sum() == pytest.approx(np.pi * 62**2, rel=0.02)
    assert sprite.radiance.max() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("sprite", "size", "told"),
    [
        (Sprite(np.ones((4, 4)), np.ones((4, 5))), 5.0, "two equal"),
        (Sprite(-np.ones((4, 4)), np.ones((4, 4))), 5.0, "negative"),
        (Sprite(np.ones((4, 4)), 2 * np.ones((4, 4))), 5.0, "alpha"),
        (SQUARE, 0.0, "size is 0"),
        (SQUARE, float("nan"), "size is nan"),
        (SQUARE, 1e300, "size is 1e"),
    ],
)
def test_sprites_that_cannot_be_used(sprite: Sprite, size: float, told: str) -> None:
    with pytest.raises(InputError, match=told):
        with_foreground(static(sensor_size=SIZE), sprite, lambda t: Pose(), size=size)
