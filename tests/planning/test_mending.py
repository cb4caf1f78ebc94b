"""What a recording is mended by, and that it is only where it is asked for."""

from __future__ import annotations

from kalux import PRESETS, reconstruct
from kalux.datasets import SensorSettings, demo_scene, simulate
from kalux.plan_report import plan_report
from kalux.planning import plan
from kalux.settings import altered


def leaking_scene(pixels=0.005):
    """A room, seen by a camera of which some pixels leak."""
    scene = demo_scene(sensor_size=(48, 64), duration=500_000)
    return simulate(scene, SensorSettings(hot_pixels=pixels, hot_rate=200.0), seed=3)


def test_pixels_that_leak_are_found_and_left_out():
    """Where frames are clipped nothing contradicts their events: they would grow to many times what is there."""
    made = leaking_scene()
    seen = made.recording()
    settled = plan(seen, at="frames")
    clean = plan(leaking_scene(0.0).recording(), at="frames")
    assert clean.pixels is None
    assert clean.mends.hot_pixels == 0
    assert settled.pixels is not None
    assert settled.mends.hot_pixels == settled.pixels.hot.sum() > 3
    assert dict(plan_report(seen, settled, PRESETS["default"]))["hot pixels"] == (
        f"{settled.mends.hot_pixels} pixels whose events are left out (measured)"
    )
    assert "hot pixels" not in dict(plan_report(seen, clean, PRESETS["default"]))
    truth = made.truth()
    worst = max(
        float((image.intensity[settled.pixels.hot] / image_truth[settled.pixels.hot]).max())
        for image, image_truth in zip(reconstruct(seen, times=truth.times), truth.images, strict=True)
    )
    assert worst < 3


def test_the_paper_has_no_hot_pixels_and_who_says_so_neither():
    seen = leaking_scene().recording()
    assert plan(seen, at="frames", preset="iccv2021").pixels is None
    kept = altered(PRESETS["default"], "events", leave_out_hot=False)
    assert plan(seen, at="frames", settings=kept).pixels is None
