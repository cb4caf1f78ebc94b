"""The stream of events: whatever its chunks, the same events in the same order."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from kalux.datasets import (
    Sampling,
    SensorSettings,
    combine,
    handheld,
    pan,
    photograph_scene,
    sensor_preset,
    simulate,
)
from kalux.datasets.event_stream import draw_rates, event_chunks
from kalux.datasets.room import pink_noise
from kalux.events import check_events

SIZE = (24, 32)


@pytest.fixture(scope="module")
def scene():
    image = np.exp(1.2 * pink_noise((96, 128), np.random.default_rng(0)))
    return photograph_scene(
        image, combine(pan(60), handheld(1)), sensor_size=SIZE, duration=150_000, scale=2.0
    )


@pytest.mark.parametrize("preset", ["ideal", "davis240c", "davis346", "prophesee-vga"])
@pytest.mark.parametrize("resolution", [1, 1000])
def test_chunks_do_not_change_the_events(scene, preset, resolution) -> None:
    import dataclasses

    sensor = dataclasses.replace(sensor_preset(preset).settings, timestamp_resolution=resolution)
    whole = simulate(scene, sensor, seed=5).events
    assert len(whole) > 1000
    for chunk in (1, 300):
        chunks = list(event_chunks(scene, sensor, seed=5, sampling=Sampling(), chunk=chunk))
        assert len(chunks) > 3
        assert np.array_equal(np.concatenate(chunks), whole)
    check_events(whole, SIZE)


def test_events_are_in_order_of_time_row_and_column(scene) -> None:
    events = simulate(scene, sensor_preset("davis346").settings).events
    key = (events["t"] * SIZE[0] + events["y"]) * SIZE[1] + events["x"]
    assert (np.diff(key) >= 0).all()


def test_progress_is_told(scene) -> None:
    told: list[float] = []
    for _ in event_chunks(scene, SensorSettings(), seed=0, sampling=Sampling(), on_time=told.append):
        pass
    assert told == sorted(told)
    assert told[-1] == scene.end


INTERRUPTED = """
import os, signal, time
import numpy as np
from kalux.datasets import Sampling, SensorSettings, event_stream, log_ramp
from kalux.datasets.pixels import Segment

scene, sensor = log_ramp(0.1, 2.0, sensor_size=(50, 60)), SensorSettings()
advance = event_stream.advance

def slow(segment, pixels, buffer, count):
    first = np.zeros(3000), np.ones(3000)
    steps = Segment(segment.t0, segment.t1, first[0], first[0] + 300.0, first[1], first[1])
    advance(segment, pixels, buffer, count)  # compiled or loaded by now
    parent = os.getpid()
    if os.fork() == 0:
        time.sleep(0.01)
        os.kill(parent, signal.SIGINT)
        os._exit(0)
    return advance(steps, pixels, buffer, 0)  # millions of events

event_stream.advance = slow
try:
    for _ in event_stream.event_chunks(scene, sensor, seed=0, sampling=Sampling()):
        print("not interrupted")
except KeyboardInterrupt:
    print("interrupted")
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="another process interrupts")
def test_an_interrupt_inside_the_loop_waits_for_its_end() -> None:
    """Raised where compiled code gives its results to Python, it would crash the process."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", INTERRUPTED], capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stdout) == (0, "interrupted\n"), done.stderr


def test_rates_are_drawn_per_pixel() -> None:
    leak, noise = draw_rates((100, 100), SensorSettings(leak_rate=0.1, noise_rate=2.0, noise_spread=0.1), 0)
    for rates, median in ((leak, 0.1), (noise, 2.0)):
        assert np.median(rates) == pytest.approx(median, rel=0.02)
        assert np.log10(rates).std() == pytest.approx(0.1, rel=0.05)
    assert abs(np.corrcoef(leak.ravel(), noise.ravel())[0, 1]) < 0.05


def test_switching_a_cause_on_leaves_the_others(scene) -> None:
    """Noise events that reset nothing are added; the others stay as they are."""
    base = {"threshold_mismatch": 0.1, "leak_rate": 2.0, "noise_spread": 0.1, "settled": True}
    quiet = simulate(scene, SensorSettings(**base)).events
    noisy = simulate(scene, SensorSettings(**base, noise_rate=5.0)).events
    assert len(noisy) > len(quiet)
    assert set(quiet.tolist()) <= set(noisy.tolist())
