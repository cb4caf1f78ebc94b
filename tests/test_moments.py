"""What the frames around a moment say of it."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.filters.shots import take_shot
from kalux.models.camera import Camera
from kalux.moments import Moment

from builders import frame

CAMERA = Camera.named("linear", 0.98)


def shot(start, end, value=100):
    return take_shot(frame(value, start, end, size=(2, 3)), CAMERA, 10_000)


BEFORE, AFTER = shot(0, 10_000), shot(40_000, 60_000)


def test_half_way_between_two_frames():
    moment = Moment(27_500, BEFORE, AFTER, 0.5)
    assert (moment.between, moment.since(40_000), moment.chroma()) == (1.0, None, None)
    assert moment.exposed == pytest.approx(15_000 / 45_000)
    # The second frame's exposure is twice as long, so that it is white at half the intensity.
    assert moment.white(0.1) == pytest.approx((np.log(1.1) + np.log(0.6)) / 2)


def test_at_a_frame():
    for share, white in ((0.0, 1.1), (1.0, 0.6)):
        moment = Moment(5_000, BEFORE, AFTER, share)
        assert moment.between == 0.0
        assert moment.white(0.1) == pytest.approx(np.log(white))


def test_one_frame_alone():
    moment = Moment(25_000, BEFORE, None, 0.0)
    assert (moment.between, moment.exposed, moment.since(40_000)) == (1.0, 0.0, 0.5)
    assert moment.white(0.1) == pytest.approx(np.log(1.1))
    assert Moment(1_000, BEFORE, None, 0.0).since(40_000) == 0.1  # before the middle of its exposure


def test_the_chromaticity_goes_from_one_frames_to_the_nexts():
    colours = np.array([[[1.0, 1.0, 1.0]], [[2.0, 0.5, 0.5]]], np.float32)
    before, after = (
        s._replace(
            chroma=np.broadcast_to(c, (2, 3, 3)).astype(np.float32), chroma_weight=np.ones((2, 3), np.float32)
        )
        for s, c in zip((BEFORE, AFTER), colours, strict=True)
    )
    red = [
        Moment(t, before, after, 0.5).chroma()[0, 0, 0] for t in (0, 5_000, 27_500, 50_000, 60_000)
    ]  # of the middles, 5,000 and 50,000
    assert red[0] == red[1] < red[2] < red[3] == red[4]
    assert Moment(27_500, before, None, 0.0).chroma()[0, 0, 0] == red[0]
